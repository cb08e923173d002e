"""Index of a dataset, a table with one row per trial: building, reading and writing."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from physion.core.errors import BadInputError
from physion.core.files import check_digest, digest_of, read_plain, write_with_digest
from physion.scenes.scene import Scene
from physion.trials.files import FILES, INDEX, MAX_FILE_BYTES, SAFE_NAME, TrialPaths, find_trials
from physion.trials.state import DRAWN, drawn_values
from physion.trials.trial_file import Trial

# Columns of the index of a dataset: name, type and meaning of each, in their stored order.


class IndexColumn(NamedTuple):
    """One column: its pandas type, and what its values are."""

    dtype: str
    meaning: str


_FACTS: Mapping[str, IndexColumn] = {
    name: IndexColumn(dtype, meaning)
    for name, dtype, meaning in (
        ("trial", "string", "name of the trial, unique in the dataset"),
        ("dataset", "string", "name of the dataset, from which the seeds are derived"),
        ("scenario", "string", "scenario of the scene"),
        ("split", "string", "purpose of the trial"),
        ("index", "int64", "position of the trial in its split and scenario, from 0"),
        ("preset", "string", "parameter set of the scenario; missing for an imported scene"),
        ("seed", "string", "entropy of the random numbers, hexadecimal; missing if imported"),
        ("attempt", "Int64", "sampled scenes rejected before this one; missing if imported"),
        (
            "scene_digest",
            "string",
            "SHA-256 of everything that determines the motion; of the movie if imported from it "
            "only",
        ),
        (
            "contact",
            "boolean",
            "the label: agent and patient touch at some time of the trial; missing if it is not "
            "stored",
        ),
        ("first_frame", "Int64", "first frame in which they touch; missing if not known"),
        (
            "observed_contact",
            "boolean",
            "they touch already in the observed part; missing without labels, and where it is not "
            "known",
        ),
        ("min_distance", "Float64", "smallest gap between cloth and object, m; missing without"),
        ("robust", "Float64", "fraction of jittered simulations with the same outcome"),
        ("recorded_contact", "boolean", "outcome recorded with an imported scene, else missing"),
        ("frames", "int64", "frames of the whole trial"),
        ("observed_frames", "int64", "frames that may be shown to models and participants"),
        ("completed", "bool", "everything came to rest before the time limit"),
        ("physics_seconds", "float64", "duration in the simulated world, s"),
        ("playback_seconds", "float64", "duration of the full movie, s"),
        ("elements", "int64", "bodies and cloths that take part, without the patient"),
        ("distractors", "Int64", "props behind the scene; missing for an imported scene"),
        ("occluders", "Int64", "props between camera and scene; missing for an imported scene"),
        ("agent_fraction", "float64", "fraction of the first frame's pixels that show the agent"),
        (
            "patient_fraction",
            "float64",
            "fraction of the first frame's pixels that show the patient",
        ),
        ("look", "string", "redyellow (agent red, patient yellow) or free (scene's own colours)"),
        ("width", "int64", "width of the pictures, pixels"),
        ("height", "int64", "height of the pictures, pixels"),
        ("engine", "string", "physics engine and its version"),
        ("renderer", "string", "renderer and its version"),
        ("package", "string", "package and its version"),
        (
            "digest",
            "string",
            "SHA-256 of the motion; of the movie if imported from it only",
        ),
    )
}

INDEX_COLUMNS: Mapping[str, IndexColumn] = {
    **_FACTS,
    **{name: IndexColumn(*column) for name, column in DRAWN.items()},
    **{
        f"{file}{suffix}": IndexColumn(dtype, meaning)
        for file, content in FILES.items()
        for suffix, dtype, meaning in (
            ("", "string", f"path of the file with {content}"),
            ("_bytes", "Int64", f"size in bytes of the file named in {file}"),
            ("_sha256", "string", f"SHA-256 of the file named in {file}"),
        )
    },
}
"""All columns. ``trial`` is unique. Paths are relative to the dataset's folder, with forward
slashes; path, size and SHA-256 are missing if the trial has no such file."""


COLUMNS = {name: column.dtype for name, column in INDEX_COLUMNS.items()}
"""Pandas types by column, in the stored order."""
MAX_BYTES = 1 << 30
"""Largest index that is read; an index of a million trials has about 300 MB."""
_AGAIN = "run the command that made the dataset again, which makes its index again"
_KINDS: dict[str, tuple[str, tuple[Callable[[Any], bool], ...]]] = {
    "string": ("text", (pa.types.is_string, pa.types.is_large_string)),
    "int64": ("whole numbers", (pa.types.is_integer,)),
    "float64": ("numbers", (pa.types.is_floating, pa.types.is_integer)),
    "bool": ("true or false", (pa.types.is_boolean,)),
}
"""What columns of a pandas type hold, and the tests of their Arrow type."""
_KINDS |= {"Int64": _KINDS["int64"], "Float64": _KINDS["float64"], "boolean": _KINDS["bool"]}


def index_row(paths: TrialPaths, opened: Trial | None = None) -> dict[str, Any]:
    """Return the index row of one trial; `BadInputError` if a file is missing or damaged.

    ``opened``: the trial, if its file was read already.
    """
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    trial = opened or Trial.open(paths.trial_file)
    meta, labels, scene = trial.metadata, trial.labels, trial.scene
    if (meta.trial, meta.scenario, meta.split) != (paths.trial, paths.scenario, paths.split):
        raise BadInputError(
            f"{paths.trial_file} is trial {meta.trial!r} of {meta.split}/{meta.scenario}: "
            "it was moved or renamed"
        )
    for name, path in paths.all(meta.movies, meta.free_movies, labels is not None).items():
        content = read_plain(path, MAX_FILE_BYTES, follow_links=True)
        row[name] = path.relative_to(paths.folder).as_posix()
        row[f"{name}_bytes"] = len(content)
        row[f"{name}_sha256"] = digest_of(content)
    row |= {name: getattr(meta, name) for name in COLUMNS if hasattr(meta, name)}
    row |= {**_elements(scene, imported=meta.seed is None), **drawn_values(scene)}
    if labels is not None:
        shown = {
            role: float(trial.pixel_fractions[scene.index(getattr(scene.roles, role))])
            for role in ("agent", "patient")
        }
        row |= {
            "contact": labels.contact,
            "first_frame": labels.first_frame,
            "observed_contact": labels.observed,
            "min_distance": labels.min_distance,
            "robust": labels.robust,
            **{f"{role}_fraction": part for role, part in shown.items()},
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
    folder: Path, known: Iterable[Mapping[Any, Any]] = ()
) -> tuple[pd.DataFrame, dict[str, str]]:
    """Return the index of all readable trials under ``folder``, and the problems of the others.

    Parameters
    ----------
    folder
        Folder of the dataset.
    known
        Rows of an older index. A row is taken over if all files of the trial still have the
        stored sizes, so that adding a trial does not require reading the whole dataset again.

    Returns
    -------
    table, problems
        The index, and messages by name of the trial.
    """
    old = {row["trial"]: row for row in known if has_drawn(row)}
    rows: dict[str, Mapping[Any, Any]] = {}
    problems = {}
    for paths in find_trials(folder):
        try:
            if (
                paths.trial in old
                and paths.trial not in rows
                and has_sizes(old[paths.trial], paths)
            ):
                rows[paths.trial] = old[paths.trial]
                continue
            if paths.trial in rows:
                raise BadInputError(f"{rows[paths.trial]['trial_file']} has the same trial name")
            rows[paths.trial] = index_row(paths)
        except BadInputError as error:
            problems[paths.trial] = f"{error}; delete {paths.trial_file} to have it made again"
    return as_table(list(rows.values())), problems


def has_sizes(row: Mapping[Any, Any], paths: TrialPaths) -> bool:
    """Return whether a row of an index describes these files, and they have its sizes."""
    if (row["split"], row["scenario"]) != (paths.split, paths.scenario):
        return False
    sizes = {name: row[f"{name}_bytes"] for name in FILES if not pd.isna(row[name])}
    files = paths.all(free=True)
    try:
        return all(files[name].stat().st_size == size for name, size in sizes.items())
    except OSError:
        return False


def has_drawn(row: Mapping[Any, Any]) -> bool:
    """Return whether a row has the values of `DRAWN`, which older indexes lack."""
    return not pd.isna(row["drawn_room"])


def same_value(one: Any, other: Any) -> bool:
    """Return whether two cells of an index are equal, or both missing."""
    if pd.isna(one) or pd.isna(other):
        return bool(pd.isna(one) and pd.isna(other))
    return bool(one == other)


def as_table(rows: Sequence[Mapping[Any, Any]]) -> pd.DataFrame:
    """Return rows as a table with the columns and types of `COLUMNS`, sorted by split and trial."""
    table = _plain(pd.DataFrame(rows, columns=list(COLUMNS)).astype(COLUMNS))
    return table.sort_values(["split", "scenario", "trial"], ignore_index=True)


def _plain(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose labels are plain bools, if none of them is missing."""
    complete = [name for name in ("contact", "observed_contact") if table[name].notna().all()]
    return table.astype({name: "bool" for name in complete if table[name].dtype != bool})


def write_index(folder: Path, table: pd.DataFrame) -> Path:
    """Write the index of ``folder`` and its SHA-256; equal tables give equal bytes."""
    path = folder / INDEX
    write_with_digest(path, index_bytes(table))
    return path


def index_bytes(table: pd.DataFrame) -> bytes:
    """Return the bytes of the parquet file of an index."""
    buffer = io.BytesIO()
    table.to_parquet(buffer, engine="pyarrow", compression="zstd", index=False)
    return buffer.getvalue()


def read_index(folder: Path) -> pd.DataFrame:
    """Read and check the index of the dataset in ``folder``.

    Raises `BadInputError` if there is none, it was changed since it was written, or it has wrong
    columns, types or names.
    """
    path = folder / INDEX
    if folder.is_file():
        raise BadInputError(f"{folder} is a file; give the folder of the dataset: {folder.parent}")
    if not folder.is_dir():
        raise BadInputError(f"dataset folder {folder} does not exist")
    if not path.is_file():
        raise BadInputError(f"{folder} has no {INDEX}: it is not a dataset, or is not finished")
    content = read_plain(path, MAX_BYTES, follow_links=True)
    check_digest(path, content, _AGAIN)
    table = _read_columns(path, content)
    for name in ("trial", "split", "scenario"):
        safe = table[name].astype("string").str.fullmatch(SAFE_NAME).fillna(False)
        if not safe.all():
            raise BadInputError(f"{path}: column {name!r} has {table[name][~safe].iloc[0]!r}")
    if table["trial"].duplicated().any():
        raise BadInputError(f"{path}: column 'trial' has duplicate names")
    return table


def _read_columns(path: Path, content: bytes) -> pd.DataFrame:
    """Return the table of a parquet file with the columns and types of `COLUMNS`."""
    try:
        stored = pq.read_table(io.BytesIO(content))
        # Otherwise text of invalid bytes would be an error where it is first used.
        stored.validate(full=True)
        missing = [name for name in COLUMNS if name not in stored.column_names]
        if set(missing) - set(DRAWN):
            raise BadInputError(f"{path} lacks the columns {missing}; {_AGAIN}")
        for name in missing:
            stored = stored.append_column(name, pa.nulls(len(stored)))
        stored = stored.select(list(COLUMNS)) if missing else stored
        for name, dtype in COLUMNS.items():
            _check_type(path, stored.column(name), name, dtype)
        table: pd.DataFrame = stored.to_pandas()
        # To convert all columns takes longer than to read them.
        other = {name: d for name, d in COLUMNS.items() if str(table[name].dtype) != d}
        return _plain(table.astype(other))
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise BadInputError(f"{path} cannot be read: {reason}; {_AGAIN}") from error


def _check_type(path: Path, column: Any, name: str, dtype: str) -> None:
    """Raise `BadInputError` unless a column of an Arrow table holds values of a pandas type."""
    meaning, tests = _KINDS[dtype]
    optional = dtype not in ("int64", "bool")
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    fits = any(test(kind) for test in tests) or (optional and pa.types.is_null(kind))
    if not fits:
        raise BadInputError(f"{path}: column {name!r} must hold {meaning}, not {kind}; {_AGAIN}")
    if not optional and column.null_count:
        raise BadInputError(f"{path}: column {name!r} lacks {column.null_count} values; {_AGAIN}")
