"""Is a dataset still what its index says?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from physion.errors import BadInputError
from physion.physics.labels import label_contact
from physion.trials.index import COLUMNS, as_table, index_row, read_index
from physion.trials.layout import TrialPaths, find_trials
from physion.trials.trial_file import Trial
from physion.trials.video import count_frames


def verify_dataset(folder: Path, *, simulate_again: bool = False) -> list[str]:
    """What is wrong with the dataset in ``folder``, one line each; empty where all is right.

    Every file is compared with the index byte for byte (by SHA-256), the index with the trial
    files, the movies' lengths with the trials', and the trajectories with their digests.
    ``simulate_again`` also moves every scene anew and compares the motion, which must be the
    same to the bit under the same engine version. `BadInputError` where there is no index.
    """
    table = read_index(folder)
    listed = set(table["trial"])
    faults = [
        f"{paths.trial_file} is not in the index"
        for paths in find_trials(folder)
        if paths.trial not in listed
    ]
    for _, row in table.iterrows():
        paths = TrialPaths(folder, row["split"], row["scenario"], row["trial"])
        try:
            faults += _compare(row, paths)
            faults += _check_trial(paths, simulate_again)
        except BadInputError as error:
            faults.append(str(error))
    return faults


def _compare(stored: pd.Series[Any], paths: TrialPaths) -> list[str]:
    """Columns of the index that the files contradict."""
    found = as_table([index_row(paths)]).iloc[0]
    return [
        f"{paths.trial}: {name} is {found[name]!s}, the index says {stored[name]!s}"
        for name in COLUMNS
        if not _same(found[name], stored[name])
    ]


def _same(one: Any, other: Any) -> bool:
    if pd.isna(one) or pd.isna(other):
        return bool(pd.isna(one) and pd.isna(other))
    return bool(one == other)


def _check_trial(paths: TrialPaths, simulate_again: bool) -> list[str]:
    """What a trial says of itself that is not so."""
    trial = Trial.open(paths.trial_file)
    meta, faults = trial.metadata, []
    for path, expected in (
        (paths.movie, meta.frames),
        (paths.observed_movie, meta.observed_frames),
    ):
        if count_frames(path) != expected:
            faults.append(f"{path} has {count_frames(path)} frames, not {expected}")
    if trial.trajectory.digest() != meta.digest:
        faults.append(f"{paths.trial_file}: the trajectory does not fit its digest")
    labels = label_contact(trial.scene, trial.trajectory)
    for field in ("contact", "first_frame", "observed", "min_distance"):
        found, stored = getattr(labels, field), getattr(trial.labels, field)
        if found != stored:
            faults.append(
                f"{paths.trial_file}: labels/{field} is {stored}, the contacts say {found}"
            )
    if simulate_again:
        from physion.physics.engine import simulate

        again = simulate(trial.scene)
        if again.digest() != meta.digest:
            faults.append(
                f"{paths.trial}: {again.engine} moves the scene differently from the stored "
                f"{meta.engine}"
            )
    return faults
