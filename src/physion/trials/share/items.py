"""Items for language models: which trial is shown how, what is asked, and which answer is right."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import write_atomic
from physion.core.seeds import stable_hash
from physion.trials.dataset import Dataset
from physion.trials.files import IndexedFile
from physion.trials.making.make import make_movies
from physion.trials.making.pairs import without_pairs
from physion.trials.share.questions import CONTACT, YES_NO, item_id, options_of
from physion.trials.trial_file import Trial
from physion.trials.video import encode_movie, read_chosen

Shown = Literal["observed", "grey", "still"]
"""What is shown of a trial: its observed movie, the same without colours, or its first frame all
the time. The last two make the other answer of a perception question right."""

LEAST_VISIBLE = 0.002
"""Fraction of the first frame that an object must cover to be asked about."""
LEAST_APART = 0.1
"""Least distance from left to right of the two objects, as a fraction of the width, to be asked
which is further to the left."""
MOVED = (40, 0.002)
"""Something moves if more than this fraction of the pixels (second) changes by more than so much
of 255 (first) between the first and the last frame that is shown."""


@dataclass(frozen=True)
class Item:
    """A question about a trial, with the options in one of their two orders."""

    trial: str
    scenario: str
    question: str
    truth: str
    order: int
    shown: Shown = "observed"

    @property
    def id(self) -> str:
        """Name of the item, unique in a dataset."""
        return item_id(self.trial, self.question, self.order)

    @property
    def options(self) -> tuple[str, str]:
        """The options in their order."""
        return options_of(self.question, self.order)


def items_of(
    dataset: Dataset, *, split: str = "testing", scenario: str | None = None, control: bool = False
) -> list[Item]:
    """Return the items of a split, two for each question, sorted by trial.

    Parameters
    ----------
    dataset
        Dataset of the trials.
    split, scenario
        Trials; by default all of the split testing.
    control
        Ask what is seen (`physion.trials.share.questions.PERCEPTION`), not what will happen.

    Raises
    ------
    UnknownNameError
        For an unknown split or scenario.
    BadInputError
        For a trial without a label.
    """
    index = without_pairs(dataset).index.sort_values("trial")
    for column, wanted in (("split", split), ("scenario", scenario)):
        if wanted is not None and wanted not in set(index[column]):
            raise UnknownNameError(column, wanted, set(index[column]))
        index = index if wanted is None else index[index[column] == wanted]
    found = []
    for row in index.to_dict("records"):
        trial = str(row["trial"])
        if pd.isna(row["contact"]):
            raise BadInputError(f"trial {trial!r} has no label: choose a split with labels")
        asked: list[tuple[str, str, Shown]] = [
            (CONTACT, YES_NO[0 if row["contact"] else 1], "observed")
        ]
        if control:
            asked = list(_perception(dataset, trial))
        found += [
            Item(trial, str(row["scenario"]), question, truth, order, shown)
            for question, truth, shown in asked
            for order in (0, 1)
        ]
    return found


def _perception(dataset: Dataset, trial: str) -> Iterator[tuple[str, str, Shown]]:
    """Yield question, right answer and what is shown, of the questions that a trial can be asked.

    Half of the trials are shown without what a question asks for, by the hash of their names.
    """
    red, yellow = _roles(dataset, trial)
    if min(red.mean(), yellow.mean()) < LEAST_VISIBLE:
        return
    columns = np.arange(red.shape[1])
    apart = np.average(columns, weights=yellow.sum(axis=0)) - np.average(
        columns, weights=red.sum(axis=0)
    )
    if abs(apart) >= LEAST_APART * red.shape[1]:
        yield "left", "red" if apart > 0 else "yellow", "observed"
    if stable_hash("view", trial) % 2:
        yield "view", "no", "grey"
    else:
        yield "view", "yes", "observed"
    if stable_hash("moves", trial) % 2:
        yield "moves", "no", "still"
    else:
        first, last = _pictures(dataset, trial, [0, _row(dataset, trial)["observed_frames"] - 1])
        changed = np.abs(first.astype(np.int16) - last).max(axis=-1) > MOVED[0]
        if changed.mean() > MOVED[1]:
            yield "moves", "yes", "observed"


def _roles(dataset: Dataset, trial: str) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the pixels (H, W) of agent and patient in the first frame."""
    file = dataset.file(trial, "map")
    if file is None:
        opened = dataset.trial(trial)
        roles = opened.scene.roles
        agent, patient = (opened.scene.index(name) + 1 for name in (roles.agent, roles.patient))
        return opened.ids == agent, opened.ids == patient
    picture = np.asarray(Image.open(io.BytesIO(file.read())).convert("RGBA"))
    there, yellow = picture[..., 3] > 0, picture[..., 1] > 127
    return there & ~yellow, there & yellow


def _row(dataset: Dataset, trial: str) -> Any:
    """Return the row of a trial in the index."""
    return dataset.index.loc[dataset.index["trial"] == trial].iloc[0]


def _movie(dataset: Dataset, trial: str) -> IndexedFile | None:
    """Return the observed movie with a red agent and a yellow patient, if there is one."""
    free = _row(dataset, trial)["look"] != "redyellow"
    return None if free else dataset.file(trial, "observed_movie")


def _pictures(dataset: Dataset, trial: str, frames: Sequence[int]) -> NDArray[np.uint8]:
    """Return observed frames, which do not decrease, as (len(frames), H, W, 3), sRGB.

    They are read from the movie or, where there is none in red and yellow, rendered.
    """
    file = _movie(dataset, trial)
    if file is not None:
        file.check()
        return read_chosen(file.path, frames)
    opened = _with_motion(dataset, trial)
    shown = {int(frame): opened.render(frame, look="redyellow").color for frame in set(frames)}
    return np.stack([np.asarray(shown[frame]) for frame in frames])


def _with_motion(dataset: Dataset, trial: str) -> Trial:
    opened = dataset.trial(trial)
    if not np.isfinite(opened.trajectory.positions).all():
        raise BadInputError(f"trial {trial!r} has neither a movie in red and yellow nor a motion")
    return opened


def true_movie(dataset: Dataset, trial: str, made: Path) -> Path:
    """Return the full movie with a red agent and a yellow patient; render it if there is none.

    It is then written to ``made``, if it is not there.
    """
    free = _row(dataset, trial)["look"] != "redyellow"
    file = None if free else dataset.file(trial, "movie")
    if file is not None:
        file.check()
        return file.path
    if not made.is_file():
        opened = _with_motion(dataset, trial)
        renderer = opened.renderer(look="redyellow")
        write_atomic(made, make_movies(renderer, opened.metadata.playback_rate)[0])
    return made


def frames_of(dataset: Dataset, item: Item, count: int | None = None) -> NDArray[np.uint8]:
    """Return what an item shows: ``count`` frames (count, H, W, 3), sRGB, or all of them.

    They are evenly spaced from the first to the last observed one.
    """
    there = int(_row(dataset, item.trial)["observed_frames"])
    chosen = np.linspace(0, there - 1, count or there).round().astype(int).tolist()
    if item.shown == "still":
        return np.repeat(_pictures(dataset, item.trial, [0]), len(chosen), axis=0)
    frames = _pictures(dataset, item.trial, chosen)
    if item.shown == "grey":
        grey = (frames @ np.array([0.2126, 0.7152, 0.0722])).round().astype(np.uint8)
        frames = np.repeat(grey[..., None], 3, axis=-1)
    return frames


def movie_of(dataset: Dataset, item: Item) -> bytes:
    """Return what an item shows as a movie (MP4)."""
    file = _movie(dataset, item.trial)
    if item.shown == "observed" and file is not None:
        return file.read()
    row = _row(dataset, item.trial)
    rate = round(row["frames"] / row["playback_seconds"])
    return encode_movie(frames_of(dataset, item), rate=rate)
