"""Index of a dataset, a table with one row per trial: building, reading and writing."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import pyarrow as pa

from physion.atomic import write_atomic
from physion.errors import BadInputError
from physion.trials.columns import FILES, INDEX_COLUMNS
from physion.trials.layout import INDEX, SAFE_NAME, TrialPaths, find_trials

if TYPE_CHECKING:
    from physion.scenes.scene import Scene

COLUMNS = {name: column.dtype for name, column in INDEX_COLUMNS.items()}
"""Pandas types by column, in the stored order."""


def index_row(paths: TrialPaths) -> dict[str, Any]:
    """Return the index row of one trial; `BadInputError` if a file is missing or damaged."""
    # Imported late: an index is read without what reads trial files.
    from physion.trials.trial_file import Trial

    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    trial = Trial.open(paths.trial_file)
    meta, labels, scene = trial.metadata, trial.labels, trial.scene
    if (meta.trial, meta.scenario, meta.split) != (paths.trial, paths.scenario, paths.split):
        raise BadInputError(
            f"{paths.trial_file} is trial {meta.trial!r} of {meta.split}/{meta.scenario}: "
            "it was moved or renamed"
        )
    for name, path in paths.all(meta.movies, meta.free_movies).items():
        try:
            content = path.read_bytes()
        except OSError as error:
            raise BadInputError(f"{path} cannot be read: {error.strerror}") from error
        row[name] = path.relative_to(paths.folder).as_posix()
        row[f"{name}_bytes"] = len(content)
        row[f"{name}_sha256"] = hashlib.sha256(content).hexdigest()
    row |= {name: getattr(meta, name) for name in COLUMNS if hasattr(meta, name)}
    row |= {
        "contact": labels.contact,
        "first_frame": labels.first_frame,
        "observed_contact": labels.observed,
        "min_distance": labels.min_distance,
        "robust": labels.robust,
        **_elements(scene, imported=meta.seed is None),
        "agent_share": float(trial.pixel_fractions[scene.index(scene.roles.agent)]),
        "patient_share": float(trial.pixel_fractions[scene.index(scene.roles.patient)]),
    }
    return row


def _elements(scene: Scene, imported: bool) -> dict[str, int | None]:
    """Count the objects that take part, without the patient, and the scenery of each kind.

    The kind of scenery (distractor or occluder) is known for sampled scenes only.
    """
    part = [b for b in scene.bodies if not b.scenery and b.name != scene.roles.patient]
    counts: dict[str, int | None] = {"elements": len(part) + len(scene.cloths)}
    for kind in ("distractor", "occluder"):
        found = sum(b.scenery and b.name.startswith(f"{kind}_") for b in scene.bodies)
        counts[f"{kind}s"] = None if imported else found
    return counts


def build_index(
    folder: Path, known: pd.DataFrame | None = None
) -> tuple[pd.DataFrame, dict[str, str]]:
    """Return the index of all readable trials under ``folder``, and the problems of the others.

    Parameters
    ----------
    folder
        Folder of the dataset.
    known
        Older index. A row is copied from it if all files of the trial still have the stored
        sizes, so that adding a trial does not require reading the whole dataset again.

    Returns
    -------
    table, problems
        The index, and messages by name of the trial.
    """
    old = {} if known is None else {row["trial"]: row for row in known.to_dict("records")}
    rows: dict[str, dict[str, Any]] = {}
    problems = {}
    for paths in find_trials(folder):
        try:
            if (
                paths.trial in old
                and paths.trial not in rows
                and _is_unchanged(old[paths.trial], paths)
            ):
                rows[paths.trial] = old[paths.trial]
                continue
            if paths.trial in rows:
                raise BadInputError(f"{rows[paths.trial]['trial_file']} has the same trial name")
            rows[paths.trial] = index_row(paths)
        except BadInputError as error:
            problems[paths.trial] = f"{error}; delete {paths.trial_file} to have it made again"
    return as_table(list(rows.values())), problems


def _is_unchanged(row: dict[str, Any], paths: TrialPaths) -> bool:
    """Return whether a row describes the files of ``paths`` and they have the stored sizes."""
    if (row["split"], row["scenario"]) != (paths.split, paths.scenario):
        return False
    sizes = {name: row[f"{name}_bytes"] for name in FILES if not pd.isna(row[name])}
    files = paths.all(free=True)
    try:
        return all(files[name].stat().st_size == size for name, size in sizes.items())
    except OSError:
        return False


def as_table(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """Return rows as a table with the columns and types of `COLUMNS`, sorted by split and trial."""
    table = pd.DataFrame(rows, columns=list(COLUMNS)).astype(COLUMNS)
    return table.sort_values(["split", "scenario", "trial"], ignore_index=True)


def write_index(folder: Path, table: pd.DataFrame) -> Path:
    """Write the index of ``folder`` atomically; equal tables give equal bytes."""
    path = folder / INDEX
    write_atomic(path, index_bytes(table))
    return path


def index_bytes(table: pd.DataFrame) -> bytes:
    """Return the bytes of the parquet file of an index."""
    buffer = io.BytesIO()
    table.to_parquet(buffer, engine="pyarrow", compression="zstd", index=False)
    return buffer.getvalue()


def read_index(folder: Path) -> pd.DataFrame:
    """Read and check the index of the dataset in ``folder``; `BadInputError` if it is not valid."""
    path = folder / INDEX
    if not folder.is_dir():
        raise BadInputError(f"dataset folder {folder} does not exist")
    if not path.is_file():
        raise BadInputError(f"{folder} has no {INDEX}: it is not a dataset, or is not finished")
    try:
        table = pd.read_parquet(path, engine="pyarrow")
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError) as error:
        raise BadInputError(f"{path} cannot be read: {' '.join(str(error).split())}") from error
    missing = [name for name in COLUMNS if name not in table.columns]
    if missing:
        raise BadInputError(f"{path} lacks the columns {missing}")
    for name in ("trial", "split", "scenario"):
        safe = table[name].astype("string").str.fullmatch(SAFE_NAME).fillna(False)
        if not safe.all():
            raise BadInputError(f"{path}: column {name!r} has {table[name][~safe].iloc[0]!r}")
    if table["trial"].duplicated().any():
        raise BadInputError(f"{path}: column 'trial' has duplicate names")
    return table
