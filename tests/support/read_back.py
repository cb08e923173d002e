"""Read an export with the library that it is for; started by a test with that library's own Python.

`python read_back.py LAYOUT FOLDER`: prints one JSON object. For the layout ``lance`` FOLDER is the
dataset, which is exported first, since pylance is in the same environment.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any


def decode(path: Path, timestamps: list[float], tolerance: float, backend: Any) -> Any:
    """Frames of a movie at given times (N, 3, H, W) in 0..1, in place of torchcodec's decoder.

    That decoder needs libraries of FFmpeg that are not installed everywhere.
    """
    import av
    import torch

    found = {}
    with av.open(str(path)) as movie:
        for frame in movie.decode(video=0):
            for wanted in timestamps:
                if abs(frame.time - wanted) < tolerance:
                    found[wanted] = torch.from_numpy(frame.to_ndarray(format="rgb24"))
    return torch.stack([found[wanted] for wanted in timestamps]).permute(0, 3, 1, 2) / 255


def lerobot(folder: Path) -> dict[str, Any]:
    """What `LeRobotDataset` reads of three frames."""
    from lerobot.datasets import lerobot_dataset
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    lerobot_dataset.decode_video_frames = decode
    known = LeRobotDataset("local/physion", root=folder)
    items = [known[place] for place in (0, 67, len(known) - 1)]
    return {
        "episodes": known.num_episodes,
        "frames": known.num_frames,
        "fps": known.fps,
        "names": sorted(known.features),
        "task": items[0]["task"],
        "states": [item["observation.state"].tolist() for item in items],
        "actions": [item["action"].tolist() for item in items],
        "success": [bool(item["next.success"]) for item in items],
        "episode": [int(item["episode_index"]) for item in items],
        "picture": list(items[0]["observation.images.camera"].shape),
        "color": [float(item["observation.images.camera"].mean()) for item in items],
    }


def lance(folder: Path) -> dict[str, Any]:
    """What stable-worldmodel reads of clips of four frames."""
    import stable_worldmodel.data as data
    from lance import dataset as table
    from stable_worldmodel.data.formats.lance import LanceDataset

    from physion.cli.main import main as physion
    from physion.trials.dataset import Dataset

    out = folder.parent / "lance"
    arguments = ["export", str(folder), str(out), "--layout", "lance", "--json"]
    file = Dataset(folder).file("drop_2", "movie")
    assert file is not None
    movie = file.path
    kept = movie.read_bytes()
    movie.write_bytes(kept[:100])
    broken = [physion(arguments), len(list(out.glob("*.lance")))]
    movie.write_bytes(kept)
    again = [physion(arguments), physion(arguments)]
    known = data.load_dataset(str(out / "trials.lance"), num_steps=4)
    assert isinstance(known, LanceDataset)
    # 57 clips of four frames in an episode of 60.
    clips = [known[place] for place in (0, 57 + 6, len(known) - 1)]
    return {
        "again": again,
        "broken": broken,
        "lengths": [int(length) for length in known.lengths],
        "clips": len(known),
        "names": sorted(known.column_names),
        "states": [clip["state"][0].tolist() for clip in clips],
        "actions": [clip["action"].tolist() for clip in clips],
        "success": [clip["success"].flatten().tolist() for clip in clips],
        "done": clips[-1]["done"].flatten().tolist(),
        "picture": list(clips[0]["pixels"].shape),
        "color": [float(clip["pixels"][0].float().mean()) for clip in clips],
        "trials": table(out / "trials_episodes.lance").to_table().to_pylist(),
    }


if __name__ == "__main__":
    print(json.dumps({"lerobot": lerobot, "lance": lance}[sys.argv[1]](Path(sys.argv[2]))))
