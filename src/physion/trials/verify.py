"""Is a dataset still what its index says?"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physion.errors import BadInputError
from physion.physics.labels import label_contact
from physion.seeds import stable_hash
from physion.trials.index import COLUMNS, as_table, index_row, read_index
from physion.trials.layout import TrialPaths, find_trials
from physion.trials.trial_file import Trial
from physion.trials.video import count_frames

SAMPLE = 4
"""Trials that are made again by default."""

Track = Callable[[Iterable[Any], str, int], Iterator[Any]]


def verify_dataset(folder: Path, *, again: int = SAMPLE, track: Track | None = None) -> list[str]:
    """What is wrong with the dataset in ``folder``, one line each; empty where all is right.

    Every file is compared with the index byte for byte (by SHA-256), the index with the trial
    files, the labels with the contacts, the movies' lengths with the trials', the trajectories
    with their digests, and all physics with one another. ``again`` trials, chosen by the index
    itself, are also simulated and rendered anew from their scenes: motion, map and movies must
    come out the same to the bit under the same version of engine and renderer; -1 takes all.
    `BadInputError` where there is no index.
    """
    table = read_index(folder)
    listed = set(table["trial"])
    faults = [
        f"{paths.trial_file} is not in the index"
        for paths in find_trials(folder)
        if paths.trial not in listed
    ]
    faults += _copies(table)
    remade = _sample(table, again)
    rows = [row for _, row in table.iterrows()]
    for row in track(rows, "verifying", len(rows)) if track else rows:
        paths = TrialPaths(folder, row["split"], row["scenario"], row["trial"])
        try:
            faults += _compare(row, paths)
            faults += _check_trial(paths)
            if row["trial"] in remade:
                faults += _make_again(paths)
        except BadInputError as error:
            faults.append(str(error))
    return faults


def _sample(table: pd.DataFrame, count: int) -> set[str]:
    """Names of ``count`` trials, or all for a negative count; the same index, the same names."""
    names = sorted(table["trial"], key=lambda name: stable_hash("verify", str(name)))
    return set(names if count < 0 else names[:count])


def _copies(table: pd.DataFrame) -> list[str]:
    """Sampled trials with the physics of another trial. Imported sets may hold such pairs."""
    sampled = table[table["seed"].notna()]
    groups = sampled.groupby("scene_digest")["trial"].apply(list)
    return [
        f"{names[0]}: field 'scene_digest': the same physics as {', '.join(names[1:])}"
        for names in groups
        if len(names) > 1
    ]


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


def _check_trial(paths: TrialPaths) -> list[str]:
    """What a trial says of itself that is not so."""
    trial = Trial.open(paths.trial_file)
    meta, faults = trial.metadata, []
    lengths = {"movie": meta.frames, "observed_movie": meta.observed_frames}
    lengths |= {f"free_{name}": frames for name, frames in lengths.items()}
    for name, path in paths.all(meta.movies, meta.free_movies).items():
        if name in lengths and (found := count_frames(path)) != lengths[name]:
            faults.append(f"{path} has {found} frames, not {lengths[name]}")
    if trial.trajectory.digest() != meta.digest:
        faults.append(f"{paths.trial_file}: field 'trajectory' does not fit its digest")
    if trial.scene.physics_digest() != meta.scene_digest:
        faults.append(f"{paths.trial_file}: field 'scene' does not fit its digest")
    if meta.engine.startswith("imported"):
        return faults  # labels and movies of other simulators are theirs
    labels = label_contact(trial.scene, trial.trajectory)
    for field in ("contact", "first_frame", "observed", "min_distance"):
        is_now, stored = getattr(labels, field), getattr(trial.labels, field)
        if is_now != stored:
            faults.append(
                f"{paths.trial_file}: labels/{field} is {stored}, the contacts say {is_now}"
            )
    return faults


def _make_again(paths: TrialPaths) -> list[str]:
    """What comes out differently when the trial is simulated and rendered from its scene."""
    from physion.physics.engine import simulate
    from physion.rendering.renderer import role_map
    from physion.trials.files import encode_png
    from physion.trials.make import RENDERER, make_movies

    trial = Trial.open(paths.trial_file)
    meta, faults = trial.metadata, []
    if meta.engine.startswith("imported"):
        return []
    motion = simulate(trial.scene)
    if motion.digest() != meta.digest:
        faults.append(
            f"{paths.trial_file}: field 'trajectory': {motion.engine} moves the scene differently "
            f"from the stored {meta.engine}"
        )
    ids = trial.render(0, ("ids",)).ids
    assert ids is not None, "ids were asked for"
    if not np.array_equal(ids, trial.ids):
        faults.append(f"{paths.trial_file}: field 'first_frame/ids': {RENDERER} renders others")
    if not meta.movies:
        return faults
    made = {"map": encode_png(role_map(ids, trial.scene))}
    for look, prefix in ((meta.look, ""), *((("free", "free_"),) if meta.free_movies else ())):
        both = make_movies(trial.renderer(look=look), meta.playback_rate)
        made |= zip((f"{prefix}movie", f"{prefix}observed_movie"), both, strict=True)
    files = paths.all(meta.movies, meta.free_movies)
    faults += [
        f"{files[name]}: {RENDERER} renders other bytes than the stored {meta.renderer}"
        for name, content in made.items()
        if files[name].read_bytes() != content
    ]
    return faults
