"""Reading of a dataset: a folder of trials with its index, and marks of unusable trials.

What reads trial files and movies is imported when it is used: an index is known without it.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import read_plain, write_atomic
from physion.core.tables import check_table, must, parse_csv
from physion.trials.files import IndexedFile, TrialPaths
from physion.trials.index import read_index

if TYPE_CHECKING:
    from physion.trials.trial_file import Trial


class Dataset:
    """Dataset in a folder: a map from row numbers to trials, and from names to files and frames.

    The index is read at once, trials and movies on request.

    Parameters
    ----------
    folder
        Folder that `physion.generate` or ``physion import`` made.
    verify
        Compare every file with its SHA-256 in the index before it is used: movies once in a
        process, trial files whenever they are read.

    Raises
    ------
    BadInputError
        If there is no index, or it is damaged. Methods that read a file raise it if the file is
        missing, damaged or changed. Methods that take the name of a trial raise `UnknownNameError`
        for an unknown one.
    """

    def __init__(self, folder: Path | str, *, verify: bool = True) -> None:
        self.folder, self.verify = Path(folder), verify
        self.index: pd.DataFrame = read_index(self.folder)
        """Index: one row per trial; columns as in `physion.trials.index.INDEX_COLUMNS`."""

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, row: int) -> Trial:
        """Open and check the trial in a row of the index."""
        return self.trial(self.trials()[row])

    def trials(self, split: str | None = None, scenario: str | None = None) -> list[str]:
        """Return the names of the trials of a split and a scenario, by default of all, in order."""
        table = self.index
        if split is not None:
            table = table[table["split"] == split]
        if scenario is not None:
            table = table[table["scenario"] == scenario]
        return [str(name) for name in table["trial"]]

    def chosen(self, split: str | None = None, scenario: str | None = None) -> list[str]:
        """Return what `trials` does; raise `BadInputError` if there is none."""
        if names := self.trials(split, scenario):
            return names
        raise BadInputError(
            f"{self.folder} has no trial of split {split or 'any'} and scenario {scenario or 'any'}"
        )

    def known_trials(self) -> set[str]:
        """Return the names of all trials."""
        return set(self.index["trial"])

    def paths(self, trial: str) -> TrialPaths:
        """Return the paths of the files of a trial."""
        if trial not in self._rows:
            raise UnknownNameError("trial", trial, self._rows)
        row = self.index.iloc[self._rows[trial]]
        return TrialPaths(self.folder, row["split"], row["scenario"], trial)

    def file(self, trial: str, column: str) -> IndexedFile | None:
        """Return a file of a trial, by its column of the index; None if the trial has no such."""
        if trial not in self._rows:
            raise UnknownNameError("trial", trial, self._rows)
        return indexed_file(
            self.folder, self.index.iloc[self._rows[trial]], column, verify=self.verify
        )

    def files(self, column: str) -> dict[str, IndexedFile]:
        """Return the files of one column of the index by trial, without trials that have none."""
        rows = self.index[["trial", "split", "scenario", f"{column}_sha256"]].to_dict("records")
        found = [indexed_file(self.folder, row, column, verify=self.verify) for row in rows]
        return {file.trial: file for file in found if file is not None}

    def trial(self, trial: str) -> Trial:
        """Open and check a trial file."""
        from physion.trials.trial_file import Trial

        file = self.file(trial, "trial_file")
        if file is None:
            raise BadInputError(f"trial {trial!r} has no trial file in the index of {self.folder}")
        return Trial(file.read(), f"trial file {file.path}")

    def frames(
        self,
        trial: str,
        *,
        start: int = 0,
        count: int | None = None,
        stride: int = 1,
        size: tuple[int, int] | None = None,
    ) -> NDArray[np.uint8]:
        """Return frames of the full movie (T, H, W, 3) in sRGB; see `video.read_frames`."""
        from physion.trials.video import read_frames

        path = _checked(self.file(trial, "movie"), trial)
        return read_frames(path, start=start, count=count, stride=stride, size=size)

    def observed_frames(
        self,
        trial: str,
        *,
        count: int | None = None,
        stride: int = 1,
        size: tuple[int, int] | None = None,
    ) -> NDArray[np.uint8]:
        """Return frames of the observed movie (T, H, W, 3) in sRGB; see `video.read_frames`.

        No file with the future is opened.
        """
        from physion.trials.video import read_frames

        path = _checked(self.file(trial, "observed_movie"), trial)
        frames = read_frames(path, count=count, stride=stride, size=size)
        observed = self.index["observed_frames"].iloc[self._rows[trial]]
        if (len(frames) - 1) * stride >= observed:
            raise BadInputError(f"{path} shows more than the {observed} observed frames")
        return frames

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {str(name): row for row, name in enumerate(self.index["trial"])}


class JoinedDataset(Dataset):
    """Trials of several datasets, under names that differ; each keeps its files where they are.

    Parameters
    ----------
    parts
        Datasets, and the splits that are taken from each.

    Raises
    ------
    BadInputError
        If two trials have one name.
    """

    def __init__(self, parts: Sequence[tuple[Dataset, Collection[str]]]) -> None:
        tables = [part.index[part.index["split"].isin(list(splits))] for part, splits in parts]
        self.folder, self.verify = parts[0][0].folder, all(part.verify for part, _ in parts)
        self.index = pd.concat(tables, ignore_index=True)
        self._known = {str(name) for part, _ in parts for name in part.index["trial"]}
        twice = self.index["trial"][self.index["trial"].duplicated()]
        if len(twice):
            folders = " and ".join(str(part.folder) for part, _ in parts)
            raise BadInputError(f"{folders} both have a trial {twice.iloc[0]!r}")
        self._parts = {
            str(trial): part
            for (part, _), table in zip(parts, tables, strict=True)
            for trial in table["trial"]
        }

    def known_trials(self) -> set[str]:
        """Return the names of all trials of the parts, of the other splits too."""
        return self._known

    def paths(self, trial: str) -> TrialPaths:
        """Return the paths of the files of a trial."""
        return self._part(trial).paths(trial)

    def file(self, trial: str, column: str) -> IndexedFile | None:
        """Return a file of a trial, by its column of the index; None if the trial has no such."""
        return self._part(trial).file(trial, column)

    def files(self, column: str) -> dict[str, IndexedFile]:
        """Return the files of one column of the index by trial, without trials that have none."""
        return {
            trial: file
            for part in dict.fromkeys(self._parts.values())
            for trial, file in part.files(column).items()
            if self._parts.get(trial) is part
        }

    def _part(self, trial: str) -> Dataset:
        if trial not in self._parts:
            raise UnknownNameError("trial", trial, self._parts)
        return self._parts[trial]


def indexed_file(
    folder: Path, row: Mapping[Any, Any] | pd.Series[Any], column: str, *, verify: bool = True
) -> IndexedFile | None:
    """Return the file of a trial by its column of the index; None if the trial has no such file.

    ``row`` is the trial's row of the index. The path follows the layout, since one in the index
    could lead out of the folder.
    """
    sha256 = row.get(f"{column}_sha256")
    if sha256 is None or pd.isna(sha256):
        return None
    paths = TrialPaths(folder, str(row["split"]), str(row["scenario"]), str(row["trial"]))
    return IndexedFile(paths.trial, getattr(paths, column), str(sha256), verify)


def _checked(file: IndexedFile | None, trial: str) -> Path:
    """Return the path of a movie that was compared with its SHA-256."""
    if file is None:
        raise BadInputError(f"trial {trial!r} has no such movie; Trial.render makes its pictures")
    file.check()
    return file.path


# Trials that someone has looked at and found unusable, with the reason, in a file of the dataset's
# folder. A study that is made from the dataset leaves these trials out; the trials themselves stay.

UNUSABLE = "unusable.csv"
UNUSABLE_COLUMNS = (
    must("trial", "text", "Name of the trial"),
    must("reason", "text", "Why it is unusable"),
)
"""Columns of `UNUSABLE`."""
_MAX_BYTES = 10_000_000


def read_unusable(dataset: Dataset) -> dict[str, str]:
    """Return the reasons by trial; none without a file.

    Raises `BadInputError` for a file without the two columns, and for a trial without a reason or
    that the dataset does not have.
    """
    path = dataset.folder / UNUSABLE
    if not path.exists():
        return {}
    rows = check_table(
        parse_csv(read_plain(path, _MAX_BYTES), str(path)), UNUSABLE_COLUMNS, str(path)
    )
    unknown = rows["trial"][~rows["trial"].isin(dataset.index["trial"])]
    if len(unknown):
        trial = unknown.iloc[0][:100]
        raise BadInputError(
            f"{path}, row {unknown.index[0] + 1}: the dataset has no trial {trial!r}"
        )
    return dict(zip(rows["trial"], rows["reason"], strict=True))


def mark_unusable(dataset: Dataset, reasons: Mapping[str, str]) -> dict[str, str]:
    """Add trials with their reasons to the file of a dataset; return all of its marks.

    An empty reason takes the mark back. Raises `UnknownNameError` for a trial that the dataset does
    not have.
    """
    marks = read_unusable(dataset)
    known = set(dataset.index["trial"])
    for trial, reason in reasons.items():
        if trial not in known:
            raise UnknownNameError(f"trial of {dataset.folder}:", trial, known)
        words = " ".join(reason.split())
        if words:
            marks[trial] = words
        else:
            marks.pop(trial, None)
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([["trial", "reason"], *sorted(marks.items())])
    write_atomic(dataset.folder / UNUSABLE, buffer.getvalue().encode())
    return marks
