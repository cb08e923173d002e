"""Export of what must be encoded elsewhere: movies of which a network makes features.

A folder holds ``README.md``, ``trials.csv`` (name of the trial, movie, number of its frames),
``movies/``, and ``encode.py``, which writes ``features.npz`` and needs torch, but not this package.
Nothing in it tells an outcome, unless whole movies are asked for. `physion.models.feature_table`
reads what comes back.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import folder_for_writing, remove_leftovers, write_atomic
from physion.scenes.scene import OBSERVED_FRAMES
from physion.trials.dataset import Dataset
from physion.trials.files import IndexedFile
from physion.trials.making.pairs import without_pairs

SPLITS = ("readout", "testing")
"""Splits of an evaluation: trials that fit a readout, and trials that are predicted."""
_README = """\
# Features of {count} movies
1. `trials.csv` lists trials, their movies and numbers of frames. {shown}
2. A frame of a movie is 0.01 s of physics; the movies play {rate:g} of them a second.
3. Put your network into `network` of `encode.py`, choose `FRAMES` there, and run
   `python encode.py` (needs torch, numpy and av). It writes features.npz.
4. The file holds `names` (n), `frames` (T), `features` (n, T, D), `model` and `readout`; rows may
   have any order. HDF5 with arrays of these names is read, too.
5. `frames` says for each time step the last frame that it depends on: a network that
   joins frames depends on the last of them.
6. `physion evaluate --features features.npz {dataset}` fits the readouts and prints the table.
"""
_SEEN = "Movies end with the last frame that may be seen, {last}."
_WHOLE = "Movies are whole: features of them have the readout full, which sees the outcome."
_SCRIPT = '''\
"""Encode the movies of this folder with a network of your own, and write features.npz."""

import csv

import av
import numpy as np
import torch

FRAMES = range(2, {stop}, 6)  # of each movie; a movie that is shorter repeats its last frame
READOUT = "{readout}"
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def network(clip: torch.Tensor) -> torch.Tensor:
    """Return features (T, D) of pictures (T, 3, H, W) in 0..1: put your own network here."""
    return torch.nn.functional.adaptive_avg_pool2d(clip, 8).flatten(1)


names, features = [], []
with open("trials.csv", newline="") as table, torch.no_grad():
    for row in csv.DictReader(table):
        with av.open(row["movie"]) as movie:
            shown = [frame.to_ndarray(format="rgb24") for frame in movie.decode(video=0)]
        clip = np.stack([shown[min(frame, len(shown) - 1)] for frame in FRAMES])
        pictures = torch.from_numpy(clip).to(DEVICE).permute(0, 3, 1, 2) / 255
        names.append(row["trial"])
        features.append(network(pictures).float().cpu().numpy())
arrays = {{"names": np.array(names), "frames": np.array(FRAMES), "features": np.stack(features)}}
np.savez("features.npz", **arrays, model="my network", readout=READOUT)
'''


def export_features_request(
    folder: Path,
    out: Path,
    *,
    readout: Literal["observed", "full"] = "observed",
    split: str | None = None,
    scenario: str | None = None,
    verify: bool = True,
    progress: Progress | None = None,
) -> list[Path]:
    """Write movies, their names, and a script that encodes them, into ``out``.

    Parameters
    ----------
    folder, out
        Folder of the dataset, and folder to write into.
    readout
        ``observed``: movies that end with the last observed frame; ``full``: whole movies.
    split, scenario
        Trials; by default all of the splits readout and testing.
    verify
        Compare movies with their SHA-256 in the index.
    progress
        Called after every movie.

    Returns
    -------
    paths
        The README, the list of trials, and the script.

    Raises
    ------
    UnknownNameError
        For an unknown split or scenario.
    BadInputError
        If there is no such trial, or one without a movie.
    """
    dataset = without_pairs(Dataset(folder, verify=verify))
    index = dataset.index.sort_values("trial")
    for column, wanted in (("split", split), ("scenario", scenario)):
        if wanted is not None and wanted not in set(index[column]):
            raise UnknownNameError(column, wanted, set(index[column]))
        index = index if wanted is None else index[index[column] == wanted]
    index = index if split is not None else index[index["split"].isin(SPLITS)]
    if index.empty:
        raise BadInputError(f"{folder} has no trial of the splits {' and '.join(SPLITS)} to encode")
    files = dataset.files("observed_movie" if readout == "observed" else "movie")
    missing = [str(trial) for trial in index["trial"] if trial not in files]
    if missing:
        raise BadInputError(
            f"trial {missing[0]!r} has no movie to encode; make the trials with movies "
            "(physion generate without --no-movies)"
        )
    frames = index["observed_frames" if readout == "observed" else "frames"].astype(int)
    stop = OBSERVED_FRAMES if readout == "observed" else int(frames.max())
    rate = float((index["frames"] / index["playback_seconds"]).iloc[0])
    shown = _SEEN.format(last=OBSERVED_FRAMES - 1) if readout == "observed" else _WHOLE
    name = folder.resolve().name
    rows = [f"{t},movies/{t}.mp4,{n}" for t, n in zip(index["trial"], frames, strict=True)]
    texts = {
        "README.md": _README.format(count=len(index), shown=shown, rate=rate, dataset=name),
        "trials.csv": "\n".join(["trial,movie,frames", *rows, ""]),
        "encode.py": _SCRIPT.format(stop=stop, readout=readout),
    }
    with folder_for_writing(out):
        remove_leftovers(out)
        (out / "movies").mkdir(exist_ok=True)
        chosen: list[IndexedFile] = [files[str(trial)] for trial in index["trial"]]
        for file in tracked(chosen, "movies", len(chosen), progress):
            write_atomic(out / "movies" / f"{file.trial}.mp4", file.read())
        for name, text in texts.items():
            write_atomic(out / name, text.encode())
    return [out / name for name in texts]
