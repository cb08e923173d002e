"""Changed copies of trials, which show what predictions depend on.

`physion.readout.check` evaluates a model on each of them. Only tested trials are changed; trials
that fit a readout stay as they are. A copy has the same motions, labels and settings everywhere
else, and an index that fits its files, so that it is a dataset like any other.
"""

from __future__ import annotations

import dataclasses
import functools
import glob
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.core.files import digest_of
from physion.models.baselines.pixels import color_masks
from physion.physics.labels import Labels
from physion.physics.trajectory import Contacts, Trajectory
from physion.readout.folds import READOUT, TESTING
from physion.trials.dataset import Dataset
from physion.trials.files import FILES, TrialPaths, encode_png
from physion.trials.index import as_table, write_index
from physion.trials.state import DRAWN
from physion.trials.trial_file import Trial, TrialWriter
from physion.trials.video import encode_movie, read_frames, repack_movie, replace_end

Pictures = NDArray[np.uint8]
_MOTION = (
    "positions", "rotations", "velocities", "angular_velocities", "cloth_vertices",
    "cloth_distance",
)  # fmt: skip
_WHOLE, _OBSERVED = ("movie", "free_movie"), ("observed_movie", "free_observed_movie")
_FACTS = (
    "preset", "seed", "attempt", "first_frame", "min_distance", "robust", "elements",
    "distractors", "occluders", "agent_fraction", "patient_fraction", "engine", "renderer",
    "package", "scene_digest", *DRAWN,
)  # fmt: skip
"""Columns of the index that no evaluation reads."""
_CELL = 8
"""Pixels per side of a square of noise; single pixels take a video encoder far longer."""
_LARGEST = 1 << 26
"""Bytes of the largest file that is copied and belongs to no trial."""
_STILL = 15
"""Frames for which a picture of noise stands."""


# The trials that are checked: some of a dataset, in a folder of their own.


def take_trials(dataset: Dataset, folder: Path, most: int) -> Dataset:
    """Copy about ``most`` trials, half of them tested, into a new folder; return their dataset.

    Scenarios have equally many, and both outcomes equally many where there are enough. Where a
    scenario has no trial of the split readout, half of its tested trials fit the readout instead.
    Files keep their time of change, and trials their names and order.
    """
    index = dataset.index[dataset.index["contact"].notna()]
    scenarios = sorted(set(index["scenario"][index["split"] == TESTING]))
    if not scenarios:
        raise BadInputError(f"{dataset.folder} has no labelled trial in the split {TESTING!r}")
    count = max(2, most // (2 * len(scenarios)))
    kept: list[pd.DataFrame] = []
    for scenario in scenarios:
        rows = index[index["scenario"] == scenario]
        tested = rows[rows["split"] == TESTING]
        fit = rows[(rows["split"] == READOUT) & ~rows["digest"].isin(tested["digest"])]
        if len(fit) == 0:
            place = tested.groupby(tested["contact"].astype(bool)).cumcount()
            fit, tested = tested[place % 2 == 1], tested[place % 2 == 0]
        kept += [
            _balanced(fit, count).assign(split=READOUT),
            _balanced(tested, count).assign(split=TESTING),
        ]
    chosen = pd.concat(kept).sort_index()
    for row in chosen.to_dict("records"):
        here = dataset.paths(row["trial"]).trial_file
        there = TrialPaths(folder, row["split"], row["scenario"], row["trial"]).trial_file
        there.parent.mkdir(parents=True, exist_ok=True)
        # Also files that are in no index, from which a model could read.
        for path in here.parent.glob(f"{glob.escape(here.stem)}[._]*"):
            if path.is_file():
                shutil.copy2(path, there.parent)
    write_index(folder, chosen.reset_index(drop=True))
    return Dataset(folder)


def copy_others(dataset: Dataset, folder: Path) -> list[Path]:
    """Copy files that belong to no trial to their places in ``folder``; return those left out.

    Those are the files of `_LARGEST` bytes or more. What is in ``folder`` already stays.
    """
    names = dataset.index[["split", "scenario", "trial"]].itertuples(index=False)
    every = [TrialPaths(dataset.folder, *map(str, name)) for name in names]
    of_trials = {getattr(paths, column) for paths in every for column in FILES}
    left_out = []
    for place, folders, files in os.walk(dataset.folder):
        here = Path(place)
        folders[:] = sorted(name for name in folders if (here / name).resolve() != folder.resolve())
        for path in (here / name for name in sorted(files)):
            there = folder / path.relative_to(dataset.folder)
            if path in of_trials or there.exists() or not path.is_file():
                continue
            if path.stat().st_size >= _LARGEST:
                left_out.append(path)
                continue
            there.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, there)
    return left_out


def _balanced(rows: pd.DataFrame, count: int) -> pd.DataFrame:
    """Return ``count`` rows, half of them with contact where there are enough, in their order."""
    contact = rows["contact"].astype(bool)
    place = rows.groupby(contact).cumcount()
    return rows.loc[place.sort_values(kind="stable").index[:count]].sort_index()


def _link(source: str, target: str) -> None:
    """Link a file, or copy it where the file system has no hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


class ChangedTrials:
    """Copy of trials that `take_trials` made, in which the tested ones are changed.

    Files that stay as they are are links to the first ones. ``names`` has the name in the copy by
    the original name of every tested trial. Randomness comes from ``rng``. ``splits``: whose trials
    are changed, where it is not only the tested ones. ``last``: by scenario the last frame that may
    be seen, where it is not the last observed one.
    """

    def __init__(
        self,
        source: Dataset,
        folder: Path,
        rng: np.random.Generator,
        splits: Sequence[str] = (TESTING,),
        last: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        shutil.copytree(source.folder, folder, copy_function=_link)
        self.folder, self.rng, self.last = folder, rng, last
        rows = source.index.to_dict("records")
        self._fit = [row for row in rows if row["split"] not in splits]
        self._rows: dict[str, dict[Any, Any]] = {
            str(row["trial"]): row for row in rows if row["split"] in splits
        }
        self.names = {trial: trial for trial in self._rows}

    def finish(self) -> Dataset:
        """Write the index of the copy, with sizes and digests of its files, and open it."""
        for trial, row in self._rows.items():
            paths = self.paths(trial)
            for column in FILES:
                path: Path = getattr(paths, column)
                if pd.isna(row[f"{column}_sha256"]) or not path.is_file():
                    continue
                content = path.read_bytes()
                row[column] = path.relative_to(self.folder).as_posix()
                row[f"{column}_bytes"] = len(content)
                row[f"{column}_sha256"] = digest_of(content)
        write_index(self.folder, as_table([*self._fit, *self._rows.values()]))
        return Dataset(self.folder)

    @property
    def tested(self) -> list[str]:
        """Names of the tested trials in the copy, in the order of the original names."""
        return list(self.names.values())

    def row(self, trial: str) -> dict[Any, Any]:
        """Return the row of the index of a tested trial, which may be changed."""
        return self._rows[trial]

    def longest_to_fit(self, scenario: str) -> int:
        """Return the frames of the longest trial of a scenario that fits a readout."""
        return max((int(r["frames"]) for r in self._fit if r["scenario"] == scenario), default=0)

    def paths(self, trial: str) -> TrialPaths:
        """Return the paths of a tested trial."""
        row = self.row(trial)
        return TrialPaths(self.folder, row["split"], row["scenario"], trial)

    def by_scenario(self) -> dict[str, list[str]]:
        """Return the tested trials of every scenario, sorted by name."""
        groups: dict[str, list[str]] = {}
        for trial in sorted(self._rows):
            groups.setdefault(self.row(trial)["scenario"], []).append(trial)
        return groups

    def write(self, path: Path, content: bytes) -> None:
        """Replace a file, which keeps its time of change; the file that it was a link to stays."""
        status = path.stat()
        path.unlink()
        path.write_bytes(content)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))

    def change_movies(
        self, trial: str, columns: Sequence[str], change: Callable[[Path], Pictures], **how: int
    ) -> None:
        """Replace movies by what ``change`` returns for the path of each."""
        rate = round(self.row(trial)["frames"] / self.row(trial)["playback_seconds"])
        for column in columns:
            path: Path = getattr(self.paths(trial), column)
            if path.is_file():
                self.write(path, encode_movie(change(path), rate=rate, **how))

    def change_file(
        self,
        trial: str,
        /,
        *,
        motion: Callable[[Trajectory], Trajectory] | None = None,
        labels: Callable[[Labels], Labels] | None = None,
        name: str = "",
        compatible: bool = False,
        no_ids: bool = False,
        **metadata: Any,
    ) -> None:
        """Write a trial file anew with what is given; nothing if the trial has none."""
        path = self.paths(trial).trial_file
        if not path.is_file():
            return
        known = Trial.open(path)
        moved = known.trajectory if motion is None else motion(known.trajectory)
        # A trial of a movie only has the digest of the movie.
        digest = known.metadata.digest if motion is None else moved.digest()
        metadata |= {"frames": len(moved), "completed": moved.completed, "digest": digest}
        scene = dataclasses.replace(known.scene, name=name) if name else known.scene
        writer = TrialWriter(
            dataclasses.replace(known.metadata, **metadata),
            scene,
            moved,
            labels(known.labels) if labels and known.labels else known.labels,
            np.zeros_like(known.ids) if no_ids else known.ids,
            compatible=compatible,
        )
        self.write(path, writer.finish())
        self.row(trial).update(completed=moved.completed, digest=metadata["digest"])

    def rename(self, names: Mapping[str, str]) -> None:
        """Give all tested trials the names to which ``names`` leads; they are numbered by name."""
        numbers: dict[str, int] = {}
        for group in self.by_scenario().values():
            places = sorted(int(self.row(trial)["index"]) for trial in group)
            numbers |= zip(sorted(names[trial] for trial in group), places, strict=True)
        moves: list[tuple[Path, Path]] = []
        for old, new in names.items():
            self.change_file(old, name=new, trial=new, index=numbers[new])
            before, after = self.paths(old), dataclasses.replace(self.paths(old), trial=new)
            for column in FILES:
                path: Path = getattr(before, column)
                if path.is_file():
                    aside = path.with_name(f"{path.name}.moved")
                    path.rename(aside)
                    moves.append((aside, getattr(after, column)))
        for aside, path in moves:
            aside.rename(path)
        self._rows = {
            new: {**self._rows[old], "trial": new, "index": numbers[new]}
            for old, new in names.items()
        }
        self.names = {first: names[now] for first, now in self.names.items()}


# What is changed.


def _exchange_futures(trials: ChangedTrials, *, shorten: bool) -> None:
    """Replace what follows the observed part by noise, with ``shorten`` of another length."""
    for scenario, group in trials.by_scenario().items():
        frames = {trial: int(trials.row(trial)["frames"]) for trial in group}
        # The longest trial says how far models imagine, which they may know.
        longest = max(group, key=lambda trial: frames[trial])
        fixed = longest if frames[longest] > trials.longest_to_fit(scenario) else ""
        for trial, count in frames.items():
            seen = int(trials.row(trial)["observed_frames"])
            if shorten and trial != fixed and count > seen + 1:
                count = int(trials.rng.integers(seen + 1, count))
            _replace_future(trials, trial, seen, count)


def _replace_future(trials: ChangedTrials, trial: str, seen: int, count: int) -> None:
    """Replace all frames of a trial from ``seen`` on by noise, up to ``count`` frames."""
    rng, row = trials.rng, trials.row(trial)
    last = trials.last.get(row["scenario"], seen)
    hidden = seen - min(seen, last + 1)
    seen -= hidden

    def noisy(path: Path) -> Pictures:
        first = read_frames(path, count=seen)
        return np.concatenate([first, _noise(rng, (count - seen, *first.shape[1:]))])

    for column in _OBSERVED if hidden else ():
        path: Path = getattr(trials.paths(trial), column)
        if path.is_file():
            size = read_frames(path, count=1).shape[1:]
            trials.write(path, replace_end(path, _noise(rng, (hidden, *size))))

    def moved(trajectory: Trajectory) -> Trajectory:
        arrays: dict[str, Any] = {}
        for name in _MOTION:
            values = getattr(trajectory, name)
            later = rng.normal(size=(count - seen, *values.shape[1:])).astype(values.dtype)
            if name == "cloth_distance" and np.isnan(values).all():
                later[:] = np.nan
            arrays[name] = np.concatenate([values[:seen], later])
        contacts = trajectory.contacts
        arrays["contacts"] = _select(contacts, contacts.frame < seen)
        return dataclasses.replace(trajectory, completed=not trajectory.completed, **arrays)

    frames = int(row["frames"])
    trials.change_movies(trial, _WHOLE, noisy)
    trials.change_file(trial, motion=moved)
    row["frames"] = count
    row["playback_seconds"] *= count / frames
    row["physics_seconds"] *= (count - 1) / max(frames - 1, 1)


def _noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Pictures:
    """Return frames of random squares (frames, height, width, 3)."""
    count, height, width, _ = shape
    frames = np.empty(shape, np.uint8)
    cells = (-(-height // _CELL), -(-width // _CELL), 3)
    for start in range(0, count, _STILL):
        noise = rng.integers(0, 256, cells, np.uint8)
        picture = noise.repeat(_CELL, axis=0).repeat(_CELL, axis=1)[:height, :width]
        frames[start : start + _STILL] = picture
    return frames


def _select(contacts: Contacts, rows: NDArray[Any]) -> Contacts:
    fields = {f.name: getattr(contacts, f.name)[rows] for f in dataclasses.fields(Contacts)}
    return Contacts(**fields)


def _again(trials: ChangedTrials) -> None:
    """Change nothing."""


def _future(trials: ChangedTrials) -> None:
    """Replace what follows the observed part by noise."""
    _exchange_futures(trials, shorten=False)


def _length(trials: ChangedTrials) -> None:
    """Replace it by noise of another length."""
    _exchange_futures(trials, shorten=True)


def _labels(trials: ChangedTrials) -> None:
    """Invert all outcomes of the more frequent kind and half of the others."""
    kinds: dict[bool, list[str]] = {True: [], False: []}
    for trial in trials.tested:
        kinds[bool(trials.row(trial)["contact"])].append(trial)
    frequent = len(kinds[True]) >= len(kinds[False])
    # So that the mean of all outcomes changes, too.
    others = trials.rng.permutation(kinds[not frequent])[: len(kinds[not frequent]) // 2].tolist()
    for trial in [*kinds[frequent], *others]:
        row = trials.row(trial)
        seen, count = int(row["observed_frames"]), int(row["frames"])
        touch, known = not row["contact"], row["recorded_contact"]
        first = int(trials.rng.integers(seen, count)) if touch and count > seen else None
        recorded = None if pd.isna(known) else not known
        row.update(
            contact=touch, observed_contact=False, first_frame=first, recorded_contact=recorded
        )
        inverted = functools.partial(
            dataclasses.replace, contact=touch, first_frame=first, observed=False
        )
        trials.change_file(trial, labels=inverted, recorded_contact=recorded)


def _fresh_names(trials: ChangedTrials, *, shuffle: bool) -> dict[str, str]:
    """Return new names in the order of the old ones, or in any with ``shuffle``."""
    names = {}
    for scenario, group in trials.by_scenario().items():
        places = trials.rng.permutation(len(group)) if shuffle else range(len(group))
        for place, trial in zip(places, group, strict=True):
            names[trial] = f"{scenario}_{place:04d}_{trials.rng.integers(2**32):08x}"
    return names


def _names(trials: ChangedTrials) -> None:
    """Give trials and files new names, whose order is the same."""
    trials.rename(_fresh_names(trials, shuffle=False))


def _order(trials: ChangedTrials) -> None:
    """Exchange the names of the trials of a scenario, and with them their order and batches."""
    names: dict[str, str] = {}
    for group in trials.by_scenario().values():
        names |= zip(group, trials.rng.permutation(group).tolist(), strict=True)
    trials.rename(names)


def _files(trials: ChangedTrials) -> None:
    """Change dates, sizes and attributes of files, the map, and columns that nobody needs."""
    before = {trial: dict(trials.row(trial)) for trial in trials.tested}
    for group in trials.by_scenario().values():
        others = np.roll(group, 1 + int(trials.rng.integers(max(len(group) - 1, 1)))).tolist()
        for trial, other in zip(group, others, strict=True):
            row = trials.row(trial)
            row.update({name: before[other][name] for name in _FACTS})
            origin: dict[str, Any] = {
                name: None if pd.isna(row[name]) else row[name]
                for name in ("preset", "seed", "attempt", "renderer", "package", "scene_digest")
            }
            trials.change_file(trial, compatible=True, no_ids=True, **origin)
            paths = trials.paths(trial)
            for column in (*_WHOLE, *_OBSERVED):
                path: Path = getattr(paths, column)
                if path.is_file():
                    trials.write(path, repack_movie(path) + _padding(trials.rng))
            if paths.map.is_file():
                picture = np.zeros((int(row["height"]), int(row["width"]), 4), np.uint8)
                trials.write(paths.map, encode_png(picture))
            for column in FILES:
                path = getattr(paths, column)
                if path.is_file():  # which is not a link any more: the first file keeps its time
                    os.utime(path, (then := int(trials.rng.integers(10**9, 17 * 10**8)), then))


def _padding(rng: np.random.Generator) -> bytes:
    """Return a box of an MP4 file that players skip, of random size."""
    size = int(rng.integers(16, 4096))
    return size.to_bytes(4, "big") + b"free" + bytes(size - 8)


def _everything(trials: ChangedTrials) -> None:
    """Make all these changes together, which no memory of earlier answers survives."""
    _length(trials)
    _labels(trials)
    _files(trials)
    trials.rename(_fresh_names(trials, shuffle=True))


def _reorder(trials: ChangedTrials, order: Callable[[int], NDArray[Any]], sign: int) -> None:
    """Show the observed frames in another order; velocities are multiplied by ``sign``."""
    for trial in trials.tested:
        seen = int(trials.row(trial)["observed_frames"])
        places = order(seen)

        def moved(
            trajectory: Trajectory, seen: int = seen, places: NDArray[Any] = places
        ) -> Trajectory:
            arrays: dict[str, Any] = {}
            for name in _MOTION:
                values = getattr(trajectory, name).copy()
                values[:seen] = values[places]
                if "velocities" in name:
                    values[:seen] *= sign
                arrays[name] = values
            contacts, frame = trajectory.contacts, trajectory.contacts.frame.copy()
            frame[frame < seen] = np.argsort(places)[frame[frame < seen]]
            changed = dataclasses.replace(contacts, frame=frame)
            by_frame = _select(changed, np.argsort(frame, kind="stable"))
            return dataclasses.replace(trajectory, **arrays, contacts=by_frame)

        trials.change_movies(trial, _OBSERVED, functools.partial(_in_order, places=places))
        trials.change_file(trial, motion=moved)


def _in_order(path: Path, places: NDArray[Any]) -> Pictures:
    """Return frames ``places`` of a movie."""
    return np.asarray(read_frames(path)[places])


def _shuffled(trials: ChangedTrials) -> None:
    """Shuffle the observed frames."""
    _reorder(trials, trials.rng.permutation, 1)


def _reversed(trials: ChangedTrials) -> None:
    """Let the observed part run backwards."""
    _reorder(trials, lambda count: np.arange(count)[::-1], -1)


def _encoded(trials: ChangedTrials) -> None:
    """Encode the observed movies again, at a lower quality."""
    for trial in trials.tested:
        trials.change_movies(trial, _OBSERVED, read_frames, crf=28)


def _colours(trials: ChangedTrials) -> None:
    """Make all that is neither red nor yellow darker, and exchange its red and blue."""

    def recoloured(path: Path) -> Pictures:
        frames = read_frames(path)
        red, yellow = color_masks(frames)
        darker = (frames[..., ::-1] * np.float32(0.8)).astype(np.uint8)
        return np.where((red | yellow)[..., None], frames, darker)

    for trial in trials.tested:
        trials.change_movies(trial, _OBSERVED, recoloured)


@dataclass(frozen=True)
class Change:
    """A change of tested trials.

    - ``name``: its name. ``apply``: makes it; its docstring says what is changed.
    - ``must_hold``: whether every prediction must stay; otherwise it is shown how much it moves.
    - ``later``: whether what *full* may see is changed.
    - ``renames``: whether trials change their names, and so their places in batches.
    - ``pictures``: whether only movies are changed.
    """

    name: str
    apply: Callable[[ChangedTrials], None]
    must_hold: bool = True
    later: bool = False
    renames: bool = False
    pictures: bool = False

    @property
    def what(self) -> str:
        """What is changed, as a sentence."""
        return " ".join((self.apply.__doc__ or "").split()).rstrip(".")


CHANGES: Mapping[str, Change] = {
    change.name: change
    for change in (
        Change("again", _again),
        Change("future", _future, later=True),
        Change("length", _length, later=True),
        Change("labels", _labels),
        Change("names", _names, renames=True),
        Change("order", _order, renames=True),
        Change("files", _files),
        Change("everything", _everything, later=True, renames=True),
        Change("encoded", _encoded, must_hold=False, pictures=True),
        Change("colours", _colours, must_hold=False, pictures=True),
        Change("shuffled", _shuffled, must_hold=False),
        Change("reversed", _reversed, must_hold=False),
    )
}
"""All changes by name; the first must not move a prediction."""
