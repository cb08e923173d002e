"""Changed copies of a dataset that show whether predictions use what they must not.

- With poisoned futures, everything after the observed part is noise, by the change ``future`` of
  `physion.check`. Predictions under *observed* and *observed+simulated* must stay the same to the
  byte.
- With exchanged futures, every movie ends like that of another trial; with ``motions=True`` the
  motions do, too. Predictions under *full* must fall to what the observed part tells.
- With permuted labels, nothing that is fitted can be better than chance.

A copy must be evaluated in a folder of its own: stored features and rollouts of the observed part
have the same names for the copy and the original.
"""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.core.seeds import generator
from physion.physics.trajectory import Contacts, Trajectory
from physion.readout.changes import CHANGES, ChangedTrials
from physion.scenes.scene import OBSERVED_FRAMES
from physion.trials.dataset import Dataset
from physion.trials.index import write_index
from physion.trials.trial_file import Trial
from physion.trials.video import encode_movie, read_frames
from support.hand_made import write_trial

Pictures = NDArray[np.uint8]
_MOTION = ("positions", "rotations", "velocities", "angular_velocities", "cloth_vertices")


def with_poisoned_futures(
    dataset: Dataset, folder: Path, splits: Sequence[str] = ("readout", "testing"), seed: int = 0
) -> Dataset:
    """Return a copy whose movies and motions are noise after the observed part.

    Parameters
    ----------
    dataset
        The dataset, which stays as it is.
    folder
        New folder of the copy.
    splits
        Splits whose trials are changed. Trials that train a model must not be among them.
    seed
        Of the noise.

    Raises
    ------
    BadInputError
        If the folder exists.
    """

    if folder.exists():
        raise BadInputError(f"{folder} exists; name a new folder for the changed copy")
    copy = ChangedTrials(dataset, folder, generator("poison", seed), splits)
    CHANGES["future"].apply(copy)
    return copy.finish()


def with_exchanged_futures(
    dataset: Dataset,
    folder: Path,
    splits: Sequence[str] = ("testing",),
    seed: int = 0,
    *,
    motions: bool = False,
) -> Dataset:
    """Return a copy in which every movie continues like that of another trial of its scenario.

    Parameters
    ----------
    dataset, folder, splits, seed
        As for `with_poisoned_futures`.
    motions
        Exchange the motions too, and with them the boxes of objects. The other trial is then one
        with as many bodies, whose motion the bodies continue in the order of the scene; shapes,
        camera and label stay. A trial with cloth is an error, so that no set with Drape works.

    Raises
    ------
    BadInputError
        If the folder exists, no other trial of the scenario has as many bodies, or a trial has
        cloth whose motion is to be exchanged.
    """
    copy = _copy(dataset, folder)
    groups: dict[tuple[str, str], list[str]] = {}
    for scenario in sorted(set(copy.index["scenario"])):
        for trial in [t for split in splits for t in copy.trials(split, scenario)]:
            kind = _bodies(dataset, trial) if motions else ""
            groups.setdefault((scenario, kind), []).append(trial)
    for (scenario, kind), trials in groups.items():
        if len(trials) < 2:
            among = f"{scenario} with {kind}" if kind else scenario
            raise BadInputError(
                f"trial {trials[0]!r} is the only one of {among}: no other one has a future for it"
            )
        rng = generator("exchange", seed, scenario, *([kind] if kind else []))
        order = [trials[i] for i in rng.permutation(len(trials))]
        for trial, other in zip(order, order[1:] + order[:1], strict=True):
            if motions:
                _exchange_motion(copy, trial, dataset.trial(other).trajectory)
            ending = dataset.frames(other)[OBSERVED_FRAMES:]
            _change_movie(
                copy,
                trial,
                lambda _, frames, ending=ending: np.concatenate(  # type: ignore[misc]
                    [frames[:OBSERVED_FRAMES], ending]
                ),
            )
    return _written(copy)


def with_permuted_labels(dataset: Dataset, seed: int = 0) -> Dataset:
    """Return the dataset with outcomes permuted within every scenario and split, in memory."""
    copy = Dataset(dataset.folder)
    columns = ["contact", "recorded_contact"]
    for (scenario, split), rows in copy.index.groupby(["scenario", "split"]).groups.items():
        order = generator("permute labels", seed, str(scenario), str(split)).permutation(len(rows))
        copy.index.loc[rows, columns] = copy.index.loc[rows[order], columns].to_numpy()
    return copy


def _copy(dataset: Dataset, folder: Path) -> Dataset:
    if folder.exists():
        raise BadInputError(f"{folder} exists; name a new folder for the changed copy")
    shutil.copytree(dataset.folder, folder)
    return Dataset(folder)


def _trials(dataset: Dataset, splits: Sequence[str]) -> list[str]:
    return [trial for split in splits for trial in dataset.trials(split)]


def _change_movie(
    dataset: Dataset, trial: str, change: Callable[[str, Pictures], Pictures]
) -> None:
    """Write a trial's movie anew and put its new size, checksum and length into the index."""
    path = dataset.paths(trial).movie
    before = read_frames(path)
    frames = change(trial, before)
    content = encode_movie(frames)
    path.write_bytes(content)
    _index_again(dataset, trial, "movie", content)
    row = dataset.index["trial"] == trial
    dataset.index.loc[row, "frames"] = len(frames)
    dataset.index.loc[row, "playback_seconds"] *= len(frames) / len(before)


def _index_again(dataset: Dataset, trial: str, column: str, content: bytes) -> None:
    """Put size and SHA-256 of a file that was written anew into the index."""
    row = dataset.index["trial"] == trial
    dataset.index.loc[row, f"{column}_bytes"] = len(content)
    dataset.index.loc[row, f"{column}_sha256"] = hashlib.sha256(content).hexdigest()


def _written(dataset: Dataset) -> Dataset:
    write_index(dataset.folder, dataset.index)
    return Dataset(dataset.folder)


def _bodies(dataset: Dataset, name: str) -> str:
    """Return the number of bodies as text, which trials with exchanged motions share."""
    scene = dataset.trial(name).scene
    if scene.cloths:
        raise BadInputError(f"trial {name!r} has cloth, whose motion fits no other trial")
    return f"{len(scene.bodies)} bodies"


def _exchange_motion(dataset: Dataset, name: str, other: Trajectory) -> None:
    """Let the motion of a trial continue like another one, with its contacts."""
    own = Trial.open(dataset.paths(name).trial_file).trajectory

    def joined(first: Any, second: Any, field: str, kept: Any, taken: Any) -> Any:
        return np.concatenate([getattr(first, field)[kept], getattr(second, field)[taken]])

    seen, later = slice(OBSERVED_FRAMES), slice(OBSERVED_FRAMES, None)
    arrays = {
        field: joined(own, other, field, seen, later) for field in (*_MOTION, "cloth_distance")
    }
    touching = [motion.contacts.frame < OBSERVED_FRAMES for motion in (own, other)]
    contacts = {
        field.name: joined(own.contacts, other.contacts, field.name, touching[0], ~touching[1])
        for field in dataclasses.fields(Contacts)
    }
    _change_motion(dataset, name, arrays, Contacts(**contacts), other.completed)


def _change_motion(
    dataset: Dataset, name: str, arrays: dict[str, Any], contacts: Contacts, completed: bool
) -> None:
    """Write a trial file anew with arrays and contacts of a changed motion."""
    path = dataset.paths(name).trial_file
    trial = Trial.open(path)
    changed: Trajectory = dataclasses.replace(
        trial.trajectory, **arrays, contacts=contacts, completed=completed
    )
    metadata = dataclasses.replace(
        trial.metadata, frames=len(changed), completed=completed, digest=changed.digest()
    )
    write_trial(path, metadata, trial.scene, changed, trial.labels, trial.ids)
    _index_again(dataset, name, "trial_file", path.read_bytes())
    for column in ("completed", "digest", "physics_seconds"):
        row = dataset.index["trial"] == name
        dataset.index.loc[row, column] = getattr(metadata, column)
