"""Show what the segmentation network finds in movies of the study, and print it.

    python benchmarks/models/real_frames.py MOVIE... [--out PICTURE.png]

Movies have 30 frames a second. The picture has a row for each: four of the fifteen observed frames
that `intuition-pixels` sees, each beside the objects that are found in it. Agent and patient are
red and yellow there, other objects have other colours.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import av
import numpy as np
from PIL import Image

from physion.clips.batch import AGENT_ID, FIRST_OTHER_ID, PATIENT_ID
from physion.core.seeds import generator
from physion.models.build import build_model
from physion.models.segmentation import SIDE, segment

SHOWN, WIDTH = (0, 5, 10, 14), 160


def main() -> None:
    """Print how many objects are found, and how many pixels of agent and patient."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("movies", type=Path, nargs="+")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    frames = build_model("intuition-pixels", weights="random").spec.context_frames()
    colors = generator("real frames").integers(70, 230, (256, 3)).astype(np.uint8)
    colors[[0, AGENT_ID, PATIENT_ID]] = (255, 255, 255), (220, 30, 30), (230, 200, 20)
    rows = []
    for path in options.movies:
        with av.open(str(path)) as movie:
            pictures = [frame.to_image() for frame in movie.decode(video=0)]
        seen = [pictures[frame] for frame in frames]
        small = [np.asarray(picture.resize((SIDE, SIDE), Image.Resampling.BOX)) for picture in seen]
        ids = segment(np.stack(small))
        others = [len(np.unique(one[one >= FIRST_OTHER_ID])) for one in ids]
        agent, patient = ((ids == number).sum((1, 2)) for number in (AGENT_ID, PATIENT_ID))
        print(
            f"{path.name}: {min(others)} to {max(others)} other objects in a frame; pixels of the "
            f"agent {agent.min()} to {agent.max()}, of the patient {patient.min()} to "
            f"{patient.max()}, of {SIDE**2}"
        )
        size = WIDTH, WIDTH
        for k in SHOWN:
            found = Image.fromarray(colors[ids[k]]).resize(size, Image.Resampling.NEAREST)
            rows += [np.asarray(seen[k].resize(size)), np.asarray(found)]
    if options.out is not None:
        width = 2 * len(SHOWN)
        lines = [np.concatenate(rows[i : i + width], 1) for i in range(0, len(rows), width)]
        Image.fromarray(np.concatenate(lines)).save(options.out, optimize=True)


if __name__ == "__main__":
    main()
