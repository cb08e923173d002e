"""Export of a dataset as a LeRobot dataset, version 3.0: one episode for each trial.

Layout of the folder:

- ``README.md``: where the states come from;
- ``meta/info.json``: features, frame rate, number of episodes, splits as ranges of episodes;
- ``meta/tasks.parquet``: the question of every trial; ``meta/stats.json``: statistics for scaling,
  of pictures from the first one of each episode;
- ``meta/episodes/chunk-000/file-000.parquet``: for each episode its frames and files, and of ours
  ``trial``, ``scenario``, ``split``, ``contact`` and ``first_contact_frame`` (-1 for none);
- ``data/chunk-000/file-000.parquet``: one row for each frame, one row group for each episode;
- ``videos/observation.images.camera/chunk-000/file-NNN.mp4``: the full movie of an episode, as it
  is in the dataset.

Features of a frame, besides those that every such dataset has:

- ``observation.state`` (S * 13): for each object its position (metres), rotation (quaternion w, x,
  y, z), velocity of its centre of mass (m/s) and angular velocity (rad/s); first the agent, then
  the patient, then the others in the order of the scene, and zeros up to the largest number S of
  objects in the dataset. A cloth is given by the mean of its vertices, without rotation.
- ``action`` (P * 7): for each push just before this frame its impulse (newton seconds), point
  (metres, the centre of mass if the scene names none), and place in the state of the object that
  gets it; zeros and -1 for none, up to the largest number P of pushes in a frame of the dataset.
- ``timestamp``: seconds of the movie. Frames are `FRAME_TIME` seconds of physics apart, and
  velocities are per second of physics.
- ``next.success``: agent and patient have touched, in this frame or before. ``next.done``: the last
  frame.

References
----------
LeRobotDataset v3.0, https://huggingface.co/docs/lerobot/lerobot-dataset-v3
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError
from physion.core.files import folder_for_writing, remove_leftovers, write_atomic
from physion.numerics.rotations import rotate_vectors
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import FRAME_TIME, Scene
from physion.trials.dataset import Dataset
from physion.trials.making.pairs import without_pairs
from physion.trials.share.card import check_readme, refuse_movies, write_readme
from physion.trials.share.questions import WORDINGS
from physion.trials.state import mass_centers
from physion.trials.video import open_movie

VERSION = "v3.0"
CAMERA = "observation.images.camera"
CHUNK = 1000
"""Largest number of movies in a folder."""
NAMES = (
    *("x", "y", "z", "qw", "qx", "qy", "qz"),
    *("vx", "vy", "vz", "wx", "wy", "wz"),
)
ACTION = ("impulse_x", "impulse_y", "impulse_z", "point_x", "point_y", "point_z", "object")
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
TITLE = "# Physion trials as a LeRobot dataset"
UNITS = (
    f"Frames are {FRAME_TIME} s of physics apart, and velocities are metres and radians per second "
    "of physics; movies are slower, or as fast."
)
README = (
    "Each trial is an episode; `meta/info.json` names the columns. `LeRobotDataset` of LeRobot "
    f"opens the folder. {UNITS} `timestamp` is the time in the movie."
)
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)


def export_lerobot(
    folder: Path,
    out: Path,
    *,
    split: str | None = None,
    scenario: str | None = None,
    verify: bool = True,
    progress: Progress | None = None,
) -> list[Path]:
    """Write trials of a dataset as a LeRobot dataset, and return its ``meta/info.json``.

    ``split``, ``scenario``: only these. ``verify``: whether files are compared with the index.

    Raises
    ------
    BadInputError
        If no trial is chosen, one has no motion, label or movie, the frame of a contact is not
        known, or movies differ in size or rate.
    """
    dataset, names = labelled(folder, split, scenario, verify=verify)
    index = dataset.index.set_index("trial")
    check_readme(out, TITLE)
    with folder_for_writing(out):
        remove_leftovers(out)
        write_readme(out, TITLE, README, index.loc[names, "engine"])
        episodes = _write_episodes(dataset, names, out, progress)
        return [_write_meta(out, episodes, index.loc[names, "split"].tolist())]


def labelled(
    folder: Path, split: str | None, scenario: str | None, *, verify: bool
) -> tuple[Dataset, list[str]]:
    """Return a dataset without pairs and its chosen trials, by split.

    All must have a motion, and labels with the frame of a contact.
    """
    dataset = without_pairs(Dataset(folder, verify=verify))
    index = dataset.index.sort_values("split", kind="stable").set_index("trial")
    chosen = set(dataset.chosen(split, scenario))
    names = [str(name) for name in index.index if name in chosen]
    if unlabelled := [name for name in names if pd.isna(index.loc[name, "contact"])]:
        raise BadInputError(f"trial {unlabelled[0]!r} has no label: choose a split with labels")
    refuse_movies(index.loc[names])
    timeless = index["contact"] & index["first_frame"].isna()
    if unknown := [name for name in names if timeless[name]]:
        raise BadInputError(f"trial {unknown[0]!r} has a contact, but its first frame is not known")
    return dataset, names


@dataclass
class _Episodes:
    """What `_write_meta` needs to know of the episodes.

    ``slots``: largest number of objects; ``pushes``: of pushes in a frame. ``movie``: height,
    width, frames per second. ``pictures``: colours of the first one of each episode, (H * W, 3) in
    [0, 1].
    """

    slots: int
    pushes: int
    movie: tuple[int, int, int] | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)
    states: list[NDArray[Any]] = field(default_factory=list)
    actions: list[NDArray[Any]] = field(default_factory=list)
    pictures: list[NDArray[Any]] = field(default_factory=list)


def _write_episodes(
    dataset: Dataset, names: list[str], out: Path, progress: Progress | None
) -> _Episodes:
    """Write movies and rows of all trials; return what `_write_meta` needs."""
    episodes = _Episodes(*most_of(dataset, names))
    schema = pa.schema(
        {
            "observation.state": pa.list_(pa.float32(), episodes.slots * len(NAMES)),
            "action": pa.list_(pa.float32(), episodes.pushes * len(ACTION)),
            "next.success": pa.bool_(),
            "next.done": pa.bool_(),
            "timestamp": pa.float32(),
            **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), pa.int64()),
        }
    )
    path = out / "data" / f"{FILE.format(chunk_index=0, file_index=0)}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = pa.BufferOutputStream()
    with pq.ParquetWriter(buffer, schema) as writer:
        for number, name in enumerate(tracked(names, "episodes", len(names), progress)):
            fps = _copy_movie(dataset, name, number, out, episodes)
            trial = dataset.trial(name)
            states = states_of(trial.scene, trial.trajectory, episodes.slots)
            actions = actions_of(trial.scene, trial.trajectory, episodes.pushes)
            start, frames = sum(row["length"] for row in episodes.rows), len(states)
            labels = trial.known_labels()
            first = frames if labels.first_frame is None else labels.first_frame
            columns = {
                "observation.state": list(states),
                "action": list(actions),
                "next.success": np.arange(frames) >= first,
                "next.done": np.arange(frames) == frames - 1,
                "timestamp": (np.arange(frames) / fps).astype(np.float32),
                "frame_index": np.arange(frames),
                "episode_index": np.full(frames, number),
                "index": start + np.arange(frames),
                "task_index": np.zeros(frames, np.int64),
            }
            writer.write_table(pa.table(columns, schema=schema))
            episodes.states.append(states)
            episodes.actions.append(actions)
            meta = trial.metadata
            episodes.rows.append(
                {
                    "episode_index": number,
                    "tasks": [WORDINGS[0]],
                    "length": frames,
                    "dataset_from_index": start,
                    "dataset_to_index": start + frames,
                    "data/chunk_index": 0,
                    "data/file_index": 0,
                    "meta/episodes/chunk_index": 0,
                    "meta/episodes/file_index": 0,
                    f"videos/{CAMERA}/chunk_index": number // CHUNK,
                    f"videos/{CAMERA}/file_index": number % CHUNK,
                    f"videos/{CAMERA}/from_timestamp": 0.0,
                    f"videos/{CAMERA}/to_timestamp": frames / fps,
                    "trial": meta.trial,
                    "scenario": meta.scenario,
                    "split": meta.split,
                    "contact": labels.contact,
                    "first_contact_frame": -1 if labels.first_frame is None else labels.first_frame,
                }
            )
    write_atomic(path, buffer.getvalue().to_pybytes())
    return episodes


def _copy_movie(dataset: Dataset, name: str, number: int, out: Path, episodes: _Episodes) -> int:
    """Copy the full movie of a trial, note its first picture, and return its frame rate."""
    movie = dataset.file(name, "movie")
    if movie is None:
        raise BadInputError(f"trial {name!r} has no movie: make the trials without --no-movies")
    with open_movie(movie.path) as decoder:
        rate = decoder.properties.rate
    picture = dataset.frames(name, count=1)[0]
    found = (*picture.shape[:2], int(rate))
    if rate != int(rate) or episodes.movie not in (None, found):
        raise BadInputError(
            f"the movie of trial {name!r} has other frames or another rate than the movies before "
            "it; export each scenario or dataset by itself"
        )
    episodes.movie = found
    episodes.pictures.append(picture.reshape(-1, 3) / 255.0)
    place = FILE.format(chunk_index=number // CHUNK, file_index=number % CHUNK)
    path = out / "videos" / CAMERA / f"{place}.mp4"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, movie.read())
    return int(rate)


def places(scene: Scene) -> list[int]:
    """Return the indices of the objects of a scene: the agent, the patient, then the others."""
    roles = [scene.index(scene.roles.agent), scene.index(scene.roles.patient)]
    return roles + [index for index in range(len(scene.names())) if index not in roles]


def states_of(scene: Scene, path: Trajectory, slots: int) -> NDArray[np.float32]:
    """Return the states of all frames (F, slots * 13), as in ``observation.state``."""
    states = np.zeros((len(path), slots, len(NAMES)), np.float32)
    for place, index in enumerate(places(scene)):
        if index < len(scene.bodies):
            arrays = (path.positions, path.rotations, path.velocities, path.angular_velocities)
            states[:, place] = np.concatenate([array[:, index] for array in arrays], axis=1)
            continue
        counts = [cloth.resolution**2 for cloth in scene.cloths]
        start = sum(counts[: index - len(scene.bodies)])
        stop = start + counts[index - len(scene.bodies)]
        middle = path.cloth_vertices[:, start:stop].mean(axis=1, dtype=np.float64)
        states[:, place, :3], states[:, place, 3] = middle, 1.0
        states[1:, place, 7:10] = np.diff(middle, axis=0) / FRAME_TIME
    return states.reshape(len(path), -1)


def most_of(dataset: Dataset, names: Sequence[str]) -> tuple[int, int]:
    """Return the largest number of objects of trials, and of pushes in a frame, at least 1."""
    scenes = [dataset.trial(name).scene for name in names]
    counts = [Counter(push.frame for push in scene.pushes).values() for scene in scenes]
    most = max((count for each in counts for count in each), default=1)
    return max(len(scene.names()) for scene in scenes), most


def actions_of(scene: Scene, path: Trajectory, pushes: int = 1) -> NDArray[np.float32]:
    """Return what is done to the objects before every frame (F, pushes * 7), as in ``action``."""
    actions = np.zeros((len(path), pushes, len(ACTION)), np.float32)
    actions[:, :, -1] = -1
    order, count = places(scene), Counter[int]()
    for push in scene.pushes:
        if push.frame < len(path):
            index = scene.index(push.body)
            point = push.point or _pushed_center(scene, path, index, push.frame)
            actions[push.frame, count[push.frame]] = (*push.impulse, *point, order.index(index))
            count[push.frame] += 1
    return actions.reshape(len(path), -1)


def _pushed_center(scene: Scene, path: Trajectory, index: int, frame: int) -> NDArray[Any]:
    """Return the centre of mass (3,) of a body before the step to a frame, after its events."""
    body = scene.bodies[index]
    position, rotation = np.array(body.position), np.array(body.rotation)
    if frame > 0:
        position, rotation = path.positions[frame - 1, index], path.rotations[frame - 1, index]
    for event in scene.events:
        if event.body == body.name and event.frame == frame:
            position = position if event.position is None else np.array(event.position)
            rotation = rotation if event.rotation is None else np.array(event.rotation)
    arm = rotate_vectors(rotation[None].astype(np.float64), mass_centers(scene)[index][None])
    return np.asarray(position + arm[0])


# Files about all episodes.


def _write_meta(out: Path, episodes: _Episodes, splits: list[str]) -> Path:
    """Write the files of ``meta`` and return ``info.json``; ``splits``: of each episode."""
    assert episodes.movie is not None
    height, width, fps = episodes.movie
    whole: dict[str, Any] = {"dtype": "int64", "shape": [1], "names": None}
    features: dict[str, Any] = {
        CAMERA: {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": fps,
                "video.channels": 3,
                "has_audio": False,
            },
        },
        "observation.state": {
            "dtype": "float32",
            "shape": [episodes.slots * len(NAMES)],
            "names": [
                f"{object_}.{value}"
                for object_ in ["agent", "patient", *map(str, range(2, episodes.slots))]
                for value in NAMES
            ],
        },
        "action": {
            "dtype": "float32",
            "shape": [episodes.pushes * len(ACTION)],
            "names": [
                *ACTION,
                *(f"{name}.{push}" for push in range(2, episodes.pushes + 1) for name in ACTION),
            ],
        },
        "next.success": {**whole, "dtype": "bool"},
        "next.done": {**whole, "dtype": "bool"},
        "timestamp": {**whole, "dtype": "float32"},
        **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), whole),
    }
    ranges = {
        name: f"{splits.index(name)}:{splits.index(name) + splits.count(name)}"
        for name in dict.fromkeys(splits)
    }
    info = {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(splits),
        "total_frames": sum(row["length"] for row in episodes.rows),
        "total_tasks": 1,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": ranges,
        "data_path": f"data/{FILE}.parquet",
        "video_path": "videos/{video_key}/" + f"{FILE}.mp4",
        "features": features,
    }
    columns = {"observation.state": episodes.states, "action": episodes.actions}
    stats = {name: _statistics(np.concatenate(rows)) for name, rows in columns.items()}
    colors = _statistics(np.concatenate(episodes.pictures))
    stats[CAMERA] = {
        name: values if name == "count" else [[[value]] for value in values]
        for name, values in colors.items()
    }
    meta = out / "meta"
    path = meta / "episodes" / f"{FILE.format(chunk_index=0, file_index=0)}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, _parquet(pa.Table.from_pylist(episodes.rows)))
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([WORDINGS[0]], name="task"))
    write_atomic(meta / "tasks.parquet", _parquet(pa.Table.from_pandas(tasks)))
    write_atomic(meta / "stats.json", _json(stats))
    # Last: a folder without it is not a dataset.
    write_atomic(meta / "info.json", _json(info))
    return meta / "info.json"


def _statistics(rows: NDArray[Any]) -> dict[str, list[Any]]:
    """Return statistics of each column over the rows."""
    values = rows.astype(np.float64)
    found = {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
    }
    quantiles = np.quantile(values, QUANTILES, axis=0)
    found |= {f"q{100 * q:02.0f}": row for q, row in zip(QUANTILES, quantiles, strict=True)}
    return {name: row.tolist() for name, row in found.items()} | {"count": [len(values)]}


def _parquet(table: pa.Table) -> bytes:
    buffer = pa.BufferOutputStream()
    pq.write_table(table, buffer)
    return bytes(buffer.getvalue().to_pybytes())


def _json(values: Any) -> bytes:
    return f"{json.dumps(values, indent=1)}\n".encode()
