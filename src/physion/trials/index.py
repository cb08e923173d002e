"""Index of a dataset, a table with one row per trial: building, reading and writing."""

from __future__ import annotations

import hashlib
import io
import stat
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image

from physion.core.errors import BadInputError
from physion.core.files import (
    check_digest,
    file_sha256,
    read_plain,
    write_atomic,
    write_with_digest,
)

if TYPE_CHECKING:
    from physion.scenes.scene import Scene
    from physion.trials.trial_file import Trial


# Files of trials, each checked against its SHA-256 in the index before it is used.

MAX_FILE_BYTES = 1 << 33
"""Largest file of a trial that is read: all passes of 600 frames of 512 pixels take 2 GB."""


@dataclass(frozen=True, slots=True)
class IndexedFile:
    """File of a trial with its SHA-256 according to the index.

    Without ``verify`` its content is not compared with the SHA-256.
    """

    trial: str
    path: Path
    sha256: str
    verify: bool = True

    def check(self) -> None:
        """Raise `BadInputError` unless the file has its SHA-256.

        A file of one size and time of change is read once in a process.
        """
        try:
            status = self.path.stat()
            if not stat.S_ISREG(status.st_mode):
                raise BadInputError(f"trial {self.trial!r}: {self.path} is not a regular file")
            if self.verify:
                _check_once(self, status.st_size, status.st_mtime_ns)
        except OSError as error:
            raise BadInputError(
                f"trial {self.trial!r}: {self.path} is missing or cannot be read: {error.strerror}"
            ) from error

    def read(self) -> bytes:
        """Return the content; raise `BadInputError` as `check` does."""
        try:
            content = read_plain(self.path, MAX_FILE_BYTES, follow_links=True)
        except BadInputError as error:
            raise BadInputError(f"trial {self.trial!r}: {error}") from error
        if self.verify and hashlib.sha256(content).hexdigest() != self.sha256:
            raise self._changed()
        return content

    def _changed(self) -> BadInputError:
        return BadInputError(
            f"trial {self.trial!r}: {self.path} was changed since it was made: it does not have "
            "the SHA-256 of the index; make the trial again, or check the dataset with physion "
            "verify"
        )


@cache
def _check_once(file: IndexedFile, size: int, modified: int) -> None:
    """Check a file of this size and time of change; errors are not remembered."""
    if file_sha256(file.path) != file.sha256:
        raise file._changed()


# Columns of the index of a dataset: name, type and meaning of each, in their stored order.


class IndexColumn(NamedTuple):
    """One column: its pandas type, and what its values are."""

    dtype: str
    meaning: str


FILES: Mapping[str, str] = {
    "trial_file": "scene, motion, contacts, label, first-frame ids (HDF5); contains the future",
    "movie": "all frames (MP4); contains the future",
    "observed_movie": "the observed frames alone (MP4)",
    "map": "agent in red and patient in yellow in the first frame (PNG)",
    "free_movie": "all frames in free colours (MP4); contains the future",
    "free_observed_movie": "the observed frames alone in free colours (MP4)",
}
"""Files that a trial can have, by the names of their columns, with their content."""

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
        ("scene_digest", "string", "SHA-256 of everything that determines the motion"),
        ("contact", "bool", "the label: agent and patient touch at some time of the trial"),
        ("first_frame", "Int64", "first frame in which they touch; missing without contact"),
        ("observed_contact", "bool", "they touch already in the observed part"),
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
        ("agent_share", "float64", "fraction of the first frame's pixels that show the agent"),
        ("patient_share", "float64", "fraction of the first frame's pixels that show the patient"),
        ("look", "string", "redyellow (agent red, patient yellow) or free (scene's own colours)"),
        ("width", "int64", "width of the pictures, pixels"),
        ("height", "int64", "height of the pictures, pixels"),
        ("engine", "string", "physics engine and its version"),
        ("renderer", "string", "renderer and its version"),
        ("package", "string", "package and its version"),
        ("digest", "string", "SHA-256 of the motion"),
    )
}

INDEX_COLUMNS: Mapping[str, IndexColumn] = {
    **_FACTS,
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


# Names and paths of the files of a trial and of a dataset.

INDEX = "index.parquet"
"""File with one row per trial, written last."""
SETTINGS = "dataset.json"
"""File with the settings that the trials of a folder are made with, written first."""
CHOICES = "choices"
"""Folder with the sampled scenes chosen for the trials of each split and scenario."""
FAILURES = "failures"
"""Folder with one text file per trial that could not be made."""

SAFE_NAME = r"[A-Za-z0-9][A-Za-z0-9._+-]{0,199}"
"""Regular expression of names, which become file names: no separators, no special names."""


@dataclass(frozen=True, slots=True)
class TrialPaths:
    """Paths of the files of a trial, in ``folder/split/scenario``.

    The trial file is written last: if it exists, the others exist too.
    """

    folder: Path
    split: str
    scenario: str
    trial: str

    @property
    def trial_file(self) -> Path:
        """File with scene, motion and labels (HDF5)."""
        return self._named(".h5")

    @property
    def movie(self) -> Path:
        """Movie of all frames (MP4)."""
        return self._named("_img.mp4")

    @property
    def observed_movie(self) -> Path:
        """Movie of the observed frames alone (MP4)."""
        return self._named("_observed.mp4")

    @property
    def map(self) -> Path:
        """Map of the first frame: agent red, patient yellow, the rest transparent (PNG)."""
        return self._named("_map.png")

    @property
    def free_movie(self) -> Path:
        """Movie of all frames in free colours (MP4), if the trial's own look is another."""
        return self._named("_free_img.mp4")

    @property
    def free_observed_movie(self) -> Path:
        """Movie of the observed frames alone in free colours (MP4)."""
        return self._named("_free_observed.mp4")

    def all(self, movies: bool = True, free: bool = False) -> dict[str, Path]:
        """Return the paths by column of the index, the trial file last.

        ``movies``: include movies and map. ``free``: include also the movies in free colours.
        """
        files = {}
        if movies:
            files = {
                "movie": self.movie,
                "observed_movie": self.observed_movie,
                "map": self.map,
            }
        if movies and free:
            files["free_movie"] = self.free_movie
            files["free_observed_movie"] = self.free_observed_movie
        return {**files, "trial_file": self.trial_file}

    def complete(self, movies: bool = True, free: bool = False) -> bool:
        """Return whether all these files exist."""
        return all(path.is_file() for path in self.all(movies, free).values())

    def _named(self, ending: str) -> Path:
        return self.folder / self.split / self.scenario / (self.trial + ending)


def find_trials(folder: Path) -> list[TrialPaths]:
    """Return the paths of every trial that has a trial file under ``folder``, sorted by name."""
    files = sorted(path.relative_to(folder).parts for path in folder.glob("*/*/*.h5"))
    return [
        TrialPaths(folder, split, scenario, name.removesuffix(".h5"))
        for split, scenario, name in files
    ]


COLUMNS = {name: column.dtype for name, column in INDEX_COLUMNS.items()}
"""Pandas types by column, in the stored order."""
MAX_BYTES = 1 << 30
"""Largest index that is read; that of a million trials has about 300 MB."""
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
    # Imported late: an index is read without what reads trial files.
    from physion.trials.trial_file import Trial

    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    trial = opened or Trial.open(paths.trial_file)
    meta, labels, scene = trial.metadata, trial.labels, trial.scene
    if (meta.trial, meta.scenario, meta.split) != (paths.trial, paths.scenario, paths.split):
        raise BadInputError(
            f"{paths.trial_file} is trial {meta.trial!r} of {meta.split}/{meta.scenario}: "
            "it was moved or renamed"
        )
    for name, path in paths.all(meta.movies, meta.free_movies).items():
        content = read_plain(path, MAX_FILE_BYTES, follow_links=True)
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


def describe_mixed_versions(table: pd.DataFrame) -> str:
    """Return a note on trials that several versions of the package made; "" if one made all.

    Versions that simulate or render differently are never mixed: `generate` refuses them.
    """
    counts = table["package"].dropna().value_counts().sort_index()
    if len(counts) < 2:
        return ""
    listed = ", ".join(f"{count} by {package}" for package, count in counts.items())
    return f"the trials were made by several versions: {listed}; a new folder has those of one"


def same_value(one: Any, other: Any) -> bool:
    """Return whether two cells of an index are equal, or both missing."""
    if pd.isna(one) or pd.isna(other):
        return bool(pd.isna(one) and pd.isna(other))
    return bool(one == other)


def as_table(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """Return rows as a table with the columns and types of `COLUMNS`, sorted by split and trial."""
    table = pd.DataFrame(rows, columns=list(COLUMNS)).astype(COLUMNS)
    return table.sort_values(["split", "scenario", "trial"], ignore_index=True)


def write_index(folder: Path, table: pd.DataFrame) -> Path:
    """Write the index of ``folder`` and its SHA-256; equal tables give equal bytes."""
    path = folder / INDEX
    write_with_digest(path, index_bytes(table))
    return path


def index_bytes(table: pd.DataFrame, *, checksums: bool = True) -> bytes:
    """Return the bytes of the parquet file of an index, with a checksum for every page.

    ``checksums=False`` gives the bytes that earlier versions wrote.
    """
    buffer = io.BytesIO()
    table.to_parquet(
        buffer,
        engine="pyarrow",
        compression="zstd",
        index=False,
        write_page_checksum=checksums,
    )
    return buffer.getvalue()


def read_index(folder: Path) -> pd.DataFrame:
    """Read and check the index of the dataset in ``folder``.

    Raises `BadInputError` if there is none, it was changed since it was written, or it has wrong
    columns, types or names.
    """
    path = folder / INDEX
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
        stored = pq.read_table(io.BytesIO(content), page_checksum_verification=True)
        # Otherwise text of invalid bytes would be an error where it is first used.
        stored.validate(full=True)
        missing = [name for name in COLUMNS if name not in stored.column_names]
        if missing:
            raise BadInputError(f"{path} lacks the columns {missing}; {_AGAIN}")
        for name, dtype in COLUMNS.items():
            _check_type(path, stored.column(name), name, dtype)
        table: pd.DataFrame = stored.to_pandas()
        return table.astype(COLUMNS)
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


# Encoding of pictures as PNG, and writing of the files of a trial.


def encode_png(picture: NDArray[np.uint8], compress_level: int = 6) -> bytes:
    """Return the bytes of a PNG file of ``picture`` (H, W, 3 or 4), sRGB and alpha, 0..255.

    ``compress_level`` is zlib's, from 0 (fast) to 9 (small).
    """
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="png", compress_level=compress_level)
    return buffer.getvalue()


def same_picture(one: bytes, other: bytes) -> bool:
    """Return whether two PNG files differ at most in how their pixels are compressed.

    All chunks except those of the compressed pixels must be equal, so that a file with a damaged
    header or end is another one.
    """
    first, second = _uncompressed_chunks(one), _uncompressed_chunks(other)
    if first is None or first != second:
        return False
    try:
        left, right = (np.asarray(Image.open(io.BytesIO(data))) for data in (one, other))
    except (OSError, SyntaxError, ValueError, zlib.error):
        return False
    return np.array_equal(left, right)


def _uncompressed_chunks(data: bytes) -> list[bytes] | None:
    """Return all chunks of a PNG file but those of its pixels; None if one is damaged."""
    chunks, place = [data[:8]], 8
    while place < len(data):
        end = place + 12 + int.from_bytes(data[place : place + 4], "big")
        body, checksum = data[place + 4 : end - 4], data[end - 4 : end]
        if end > len(data) or zlib.crc32(body).to_bytes(4, "big") != checksum:
            return None
        if body[:4] != b"IDAT":
            chunks.append(body)
        place = end
    return chunks


def write_files(paths: TrialPaths, files: Mapping[str, bytes]) -> None:
    """Write the files of a trial, by names as in `TrialPaths.all`, the trial file last."""
    paths.trial_file.parent.mkdir(parents=True, exist_ok=True)
    for name, path in paths.all(free=True).items():
        if name in files:
            write_atomic(path, files[name])


# Metadata of a trial: names, settings and versions.

MAX_SIDE = 4096
"""Largest width or height in pixels of pictures and movies."""
MAX_FRAMES = 10_000
"""Largest number of frames of a trial."""
MAX_RATE = 1000
"""Most frames per second of a movie."""


@dataclass(frozen=True)
class Metadata:
    """Origin and settings of a trial; nothing in it depends on the time of its making.

    Parameters
    ----------
    trial, dataset, scenario, split
        Names; that of the trial is unique in the dataset.
    index
        Position in the split of the scenario, from 0.
    preset
        Name of the scenario's parameter set; None for an imported scene.
    seed
        Entropy of the trial's `SeedSequence` in hexadecimal; None for an imported scene.
    look
        Colours of the trial's movies, one of `physion.scenes.looks.LOOKS`.
    width, height
        Size of the pictures in pixels.
    frames, observed_frames
        Number of frames of the whole trial, and of the part shown before the prediction.
    frame_time
        Seconds of physics per frame.
    playback_rate
        Frames per second of the movies.
    completed
        True if everything came to rest before the time limit.
    engine, renderer, package
        Names with versions.
    digest
        SHA-256 of the trajectory.
    scene_digest
        SHA-256 of everything that determines the motion (`Scene.physics_digest`).
    attempt
        Number of scenes sampled for this trial and rejected before; None for an imported scene.
    movies, free_movies
        Whether there are movies and a map, and further movies in free colours.
    recorded_contact
        Outcome that an imported scene was recorded with, else None.
    """

    trial: str
    dataset: str
    scenario: str
    split: str
    index: int
    preset: str | None
    seed: str | None
    look: str
    width: int
    height: int
    frames: int
    observed_frames: int
    frame_time: float
    playback_rate: int
    completed: bool
    engine: str
    renderer: str
    package: str
    digest: str
    scene_digest: str
    attempt: int | None = None
    movies: bool = True
    free_movies: bool = False
    recorded_contact: bool | None = None

    @property
    def physics_seconds(self) -> float:
        """Duration in the simulated world, in seconds."""
        return (self.frames - 1) * self.frame_time

    @property
    def playback_seconds(self) -> float:
        """Duration of the movie, in seconds."""
        return self.frames / self.playback_rate

    @property
    def imported(self) -> bool:
        """Whether the motion comes from another simulator."""
        return self.engine.startswith("imported")

    def check(self, where: str) -> None:
        """Raise `BadInputError` for numbers that no trial has; ``where`` names the file."""
        bounds = {
            "width": MAX_SIDE,
            "height": MAX_SIDE,
            "frames": MAX_FRAMES,
            "observed_frames": self.frames,
            "playback_rate": MAX_RATE,
        }
        for name, most in bounds.items():
            if not 1 <= getattr(self, name) <= most:
                raise BadInputError(
                    f"{where}: metadata: {name} must be 1 to {most}, not {getattr(self, name)}"
                )
        if not (self.index >= 0 and self.frame_time > 0):
            raise BadInputError(
                f"{where}: metadata: index must not be negative and frame_time positive, not "
                f"{self.index} and {self.frame_time}"
            )
