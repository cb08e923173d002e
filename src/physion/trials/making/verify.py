"""Verification of a dataset: files against the index, trials against themselves, some remade."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError
from physion.core.files import file_sha256
from physion.core.seeds import stable_hash
from physion.core.settings import read_json
from physion.physics.labels import label_contact
from physion.scenes.sampling.sample import load_presets
from physion.trials.files import FILES, MOVIE_ALONE, SETTINGS, TrialPaths, find_trials
from physion.trials.index import COLUMNS, has_drawn, index_row, read_index, same_value
from physion.trials.making.choose import BALANCED, robustness, split_of, wanted_contact
from physion.trials.making.plan import TrialTask
from physion.trials.trial_file import Trial, geometry_arrays
from physion.trials.video import count_frames

SAMPLE = 4
"""Number of trials that are made again by default."""


@dataclass
class Verification:
    """Result of a verification, one line per finding.

    ``faults`` is empty if the dataset is intact. ``other_versions`` lists what cannot be reproduced
    because another version of engine, renderer or encoder made it, which is not a fault.
    ``notes`` lists what is not a fault either: pictures that are only compressed differently, and
    trials whose scene was not drawn again because their preset is unknown. ``damaged`` names the
    trials with faults.
    """

    faults: list[str] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)
    other_versions: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, findings: list[str], stored: str = "", here: str = "") -> None:
        """Add findings about a part that version ``stored`` made; this machine has ``here``."""
        if stored == here:
            self.faults += findings
        else:
            note = f"made by another version, {stored}; this is {here}"
            self.other_versions += [f"{line}: {note}" for line in findings]


def verify_dataset(
    folder: Path, *, again: int = SAMPLE, repair: bool = False, progress: Progress | None = None
) -> Verification:
    """Check a dataset against its index and for consistency, and make some trials again.

    Checked are: every file against its SHA-256 in the index, the index against the trial files,
    labels against contacts, lengths of movies against lengths of trials, a few frames of each movie
    against the rendered state, trajectories against their digests, and that no two sampled trials
    have the same physics.

    Parameters
    ----------
    folder
        Folder of the dataset.
    again
        Number of trials (-1: all) that are also sampled, simulated and rendered again. Scene,
        motion, map and movies must be identical under the same versions of engine and renderer.
        Which trials depends on their names only.
    repair
        Delete the trial files of trials with faults, so that the command that made the dataset
        makes these trials again.
    progress
        Shows the progress.

    Raises
    ------
    BadInputError
        If there is no valid index.
    """
    table = read_index(folder)
    listed = set(table["trial"])
    result = Verification()
    for paths in find_trials(folder):
        if paths.trial not in listed:
            result.faults.append(f"{paths.trial_file} is not in the index")
    result.faults += _check_folder(folder, table)
    result.faults += _duplicates(table)
    settings = _settings(folder)
    remade = _choose_trials(table, again)
    rows = table.to_dict("records")
    for row in tracked(rows, "verifying", len(rows), progress):
        paths = TrialPaths(folder, row["split"], row["scenario"], row["trial"])
        before = len(result.faults)
        try:
            trial = Trial.open(paths.trial_file)
            result.faults += _compare(row, paths, trial)
            result.faults += _check_trial(paths, trial)
            _check_movies(paths, trial, result)
            result.faults += _check_split(row, settings)
            if row["trial"] in remade:
                _make_again(paths, trial, settings, result)
        except BadInputError as error:
            result.faults.append(str(error))
        if len(result.faults) > before:
            result.damaged.append(paths.trial)
            if repair:
                paths.trial_file.unlink(missing_ok=True)
    return result


def _settings(folder: Path) -> Mapping[str, Any]:
    """Return the settings of `generate`; empty for imported datasets, which have none."""
    try:
        return dict(read_json(folder / SETTINGS, dict[str, Any])["settings"])
    except (BadInputError, KeyError, TypeError, ValueError):
        return {}


def _check_folder(folder: Path, table: pd.DataFrame) -> list[str]:
    """Return faults for files that no trial of the index has."""
    listed = {folder / str(name) for file in FILES for name in table[file].dropna()}
    unknown = {path for path in folder.glob("*/*/*") if path.is_file()} - listed
    return [
        f"{path} is not a file of a trial in the index"
        for path in sorted(unknown)
        if path.suffix != ".h5"  # trial files are compared with the index by the caller
    ]


def _check_split(row: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Return the conditions of its split that a sampled trial violates."""
    if pd.isna(row["seed"]) or not settings:
        return []
    faults = []
    if (belongs := split_of(row["scene_digest"])) != row["split"]:
        faults.append(f"{row['trial']}: field 'scene_digest': its physics belongs to {belongs}")
    task = TrialTask(row["dataset"], row["scenario"], row["split"], int(row["index"]))
    if pd.isna(row["contact"]):
        return faults
    if wanted_contact(task) not in (None, row["contact"]):
        faults.append(
            f"{row['trial']}: field 'contact': the balance of its split requires the opposite"
        )
    if task.split in BALANCED and row["observed_contact"] and not settings.get("observed_contact"):
        faults.append(f"{row['trial']}: field 'observed_contact': nothing is left to predict")
    return faults


def _choose_trials(table: pd.DataFrame, count: int) -> set[str]:
    """Return the names of ``count`` trials, all if negative; equal indices give equal names."""
    names = sorted(table["trial"], key=lambda name: stable_hash("verify", str(name)))
    return set(names if count < 0 else names[:count])


def _duplicates(table: pd.DataFrame) -> list[str]:
    """Return faults of sampled trials with equal physics; imported sets may contain such pairs."""
    sampled = table[table["seed"].notna()]
    groups = sampled.groupby("scene_digest")["trial"].apply(list)
    return [
        f"{names[0]}: field 'scene_digest': the same physics as {', '.join(names[1:])}"
        for names in groups
        if len(names) > 1
    ]


def _compare(stored: Mapping[str, Any], paths: TrialPaths, trial: Trial) -> list[str]:
    """Return the cells of an index row that differ from the files."""
    found = index_row(paths, trial)
    return [
        f"{paths.trial}: {name} is {found[name]!s}, the index says {stored[name]!s}"
        for name in COLUMNS
        if not same_value(found[name], stored[name])
        and (has_drawn(stored) or not name.startswith("drawn_"))
    ]


def _check_trial(paths: TrialPaths, trial: Trial) -> list[str]:
    """Return contradictions between the parts of a trial."""
    meta, faults = trial.metadata, []
    lengths = {"movie": meta.frames, "observed_movie": meta.observed_frames}
    lengths |= {f"free_{name}": frames for name, frames in lengths.items()}
    for name, path in paths.all(meta.movies, meta.free_movies, trial.labels is not None).items():
        if name in lengths and (found := count_frames(path)) != lengths[name]:
            faults.append(f"{path} has {found} frames, not {lengths[name]}")
    shown = file_sha256(paths.movie) if meta.engine == MOVIE_ALONE else ""
    if (shown or trial.trajectory.digest()) != meta.digest:
        faults.append(f"{paths.trial_file}: field 'trajectory' does not match its digest")
    if (shown or trial.scene.physics_digest()) != meta.scene_digest:
        faults.append(f"{paths.trial_file}: field 'scene' does not match its digest")
    wanted = geometry_arrays(trial.scene, meta.width, meta.height)
    faults += [
        f"{paths.trial_file}: field {path!r} does not match the scene"
        for path, array in trial.geometry.items()
        if not np.array_equal(array, wanted[path])
    ]
    if meta.imported or trial.labels is None:
        return faults  # labels and movies come from another simulator, or there are no labels
    labels = label_contact(trial.scene, trial.trajectory)
    for name in ("contact", "first_frame", "observed", "min_distance"):
        computed, stored = getattr(labels, name), getattr(trial.labels, name)
        if computed != stored:
            faults.append(
                f"{paths.trial_file}: labels/{name} is {stored}, by its contacts it is {computed}"
            )
    return faults


def _check_movies(paths: TrialPaths, trial: Trial, result: Verification) -> None:
    """Add movies that do not show the state of their trial; movies of other renderers may not."""
    from physion.trials.making.make import RENDERER, foreign_movies

    if trial.metadata.renderer != "imported":
        result.add(foreign_movies(paths, trial), trial.metadata.renderer, RENDERER)


def _make_again(
    paths: TrialPaths, trial: Trial, settings: Mapping[str, Any], result: Verification
) -> None:
    """Sample, simulate and render a trial again; add the differences to ``result``."""
    from physion.physics.engine import engine_of
    from physion.trials.making.make import RENDERER
    from physion.trials.making.pairs import motion_of

    meta = trial.metadata
    if meta.imported:
        return
    motion = motion_of(trial.scene, engine_of(meta.engine))
    found: list[str] = []
    if meta.preset is not None and meta.preset not in load_presets(meta.scenario):
        result.notes.append(
            f"{paths.trial_file}: not drawn again: preset {meta.preset!r} of {meta.scenario} is "
            "not one of this package"
        )
    else:
        found += _sample_again(paths, trial, settings)
    if motion.digest() != meta.digest:
        found.append(f"{paths.trial_file}: field 'trajectory': simulated again, the motion differs")
    result.add(found, meta.engine, motion.engine)
    result.add(_render_again(paths, trial, result.notes), meta.renderer, RENDERER)


def _render_again(paths: TrialPaths, trial: Trial, notes: list[str]) -> list[str]:
    """Return the differences between stored and newly rendered ids, passes, map and movies.

    A map with the same pixels in another compression is added to ``notes``.
    """
    from physion.rendering.renderer import role_map
    from physion.trials.files import encode_png, same_picture
    from physion.trials.making.make import make_movies

    meta, faults = trial.metadata, []
    ids = trial.render(0, ("ids",)).ids
    assert ids is not None, "ids were asked for"
    if not np.array_equal(ids, trial.ids):
        faults.append(f"{paths.trial_file}: field 'first_frame/ids' is rendered differently")
    counts = np.bincount(ids.ravel(), minlength=len(trial.scene.names()) + 1)[1:]
    if not np.array_equal((counts / ids.size).astype(np.float32), trial.pixel_fractions):
        faults.append(f"{paths.trial_file}: field 'first_frame/fractions' does not match the ids")
    for name in trial.pass_names:
        for frame in (0, meta.frames // 2, meta.frames - 1):
            stored = trial.passes(frame)[name]
            again = np.asarray(getattr(trial.render(frame, (name,)), name))
            if not np.array_equal(again.astype(stored.dtype), stored, equal_nan=stored.ndim != 2):
                faults.append(f"{paths.trial_file}: field 'passes/{name}': frame {frame} differs")
    if not meta.movies:
        return faults
    labelled = trial.labels is not None
    made = {"map": encode_png(role_map(ids, trial.scene))} if labelled else {}
    for look, prefix in ((meta.look, ""), *((("free", "free_"),) if meta.free_movies else ())):
        both = make_movies(trial.renderer(look=look), meta.playback_rate)
        made |= zip((f"{prefix}movie", f"{prefix}observed_movie"), both, strict=True)
    files = paths.all(meta.movies, meta.free_movies, labelled)
    for name, content in made.items():
        stored_bytes = files[name].read_bytes()
        if name == "map" and stored_bytes != content and same_picture(stored_bytes, content):
            # Another build of zlib compresses equal pixels to other bytes.
            notes.append(f"{files[name]}: same picture, other compression")
        elif stored_bytes != content:
            faults.append(f"{files[name]}: other bytes are rendered than the stored ones")
    return faults


def _sample_again(paths: TrialPaths, trial: Trial, settings: Mapping[str, Any]) -> list[str]:
    """Return the differences when a scene is sampled again from its preset and seed."""
    from physion.physics.engine import engine_of
    from physion.trials.making.make import scene_of

    meta = trial.metadata
    if meta.seed is None or meta.preset is None:
        return []
    if meta.attempt is None:
        return [f"{paths.trial_file}: field 'metadata' has a seed but no attempt"]
    task = TrialTask(
        meta.dataset,
        meta.scenario,
        meta.split,
        meta.index,
        preset=meta.preset,
        attempt=meta.attempt,
    )
    faults = []
    if scene_of(task) != trial.scene:
        faults.append(f"{paths.trial_file}: field 'scene' is not the one that preset and seed give")
    labels = trial.labels
    if labels is not None and labels.robust is not None and settings:
        runs, engine = settings.get("jitters", 0), engine_of(meta.engine)
        found = robustness(trial.scene, labels.contact, task.seed(), runs, engine)
        if found != labels.robust:
            faults.append(
                f"{paths.trial_file}: labels/robust is {labels.robust}, again it is {found}"
            )
    return faults


# Comparison of two datasets that should be equal, such as from two machines or versions.

_COMPARED = ("scene_digest", "digest", "contact", "first_frame", "observed_contact", "min_distance",
             "robust", *(f"{name}_sha256" for name in FILES if name != "trial_file"))  # fmt: skip


def compare_datasets(first: Path, second: Path) -> list[str]:
    """Return one line per difference between two datasets, whose trials are compared by name.

    Scenes, motions, labels, movies and maps are compared by both indices; `verify_dataset` compares
    the files with the index. Trial files hold the version of the package and are not compared.
    Raises `BadInputError` if a folder has no valid index.
    """
    tables = [read_index(folder).set_index("trial", drop=False) for folder in (first, second)]
    names = [set(table.index) for table in tables]
    places = (first, names[0] - names[1]), (second, names[1] - names[0])
    found = [f"{name}: only in {folder}" for folder, only in places for name in sorted(only)]
    for name in sorted(names[0] & names[1]):
        one, other = (table.loc[name] for table in tables)
        differs = [c for c in _COMPARED if not same_value(one[c], other[c])]
        if differs:
            by = (
                "" if one["engine"] == other["engine"] else f" ({one['engine']}; {other['engine']})"
            )
            found.append(f"{name}: other {', '.join(differs)}{by}")
    return found
