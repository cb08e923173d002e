"""The stimuli of a study: media files, phase, position and outcome of each.

They are stored in ``stimuli.csv`` of the study folder, one row per stimulus. The server never sends
this file.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import read_plain, write_atomic
from physion.core.names import canonical_name

# Checked reading of CSV files that users edit, with the row numbers that spreadsheets show.


def csv_rows(
    path: Path, content: bytes, columns: tuple[str, ...]
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the row number and the cells of each non-empty row of a CSV file.

    Parameters
    ----------
    path
        Where ``content`` was read from; used in error messages only.
    content
        The bytes of the file, UTF-8 with or without a byte order mark.
    columns
        Columns that the header must have. Further columns are allowed.

    Yields
    ------
    tuple of int and dict
        Row number as a spreadsheet shows it (the header is row 1), and the stripped cells by
        column name.

    Raises
    ------
    BadInputError
        The file is not UTF-8 or not CSV, the header lacks a column or has one twice, or a row has
        another number of cells than the header.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path} is not UTF-8 text; save it as CSV UTF-8") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        _check_header(path, header, columns)
        for row, cells in enumerate(reader, start=2):
            if not any(cells):
                continue
            if len(cells) != len(header):
                raise BadInputError(
                    f"{path}, row {row}: {len(cells)} cells, not {len(header)} as in the header"
                )
            yield row, dict(zip(header, map(str.strip, cells), strict=True))
    except csv.Error as error:
        raise BadInputError(f"{path}, line {reader.line_num}: not CSV: {error}") from error


def _check_header(path: Path, header: list[str], columns: tuple[str, ...]) -> None:
    """Check that the header has all ``columns`` and no duplicates."""
    duplicates = [name for name in header if header.count(name) > 1]
    if duplicates:
        raise BadInputError(f"{path} has more than one column {duplicates[0]!r}")
    for name in columns:
        if name not in header:
            raise BadInputError(f"{path} lacks the column {name!r}; it needs {', '.join(columns)}")


STIMULI_FILE = "stimuli.csv"
MEDIA_FOLDER = "media"
PHASES = ("familiarization", "test")
ATTENTION = "attention"
"""Phase of stimuli with an obvious outcome, which are attention checks among the test trials."""
STIMULUS_PHASES = (*PHASES, ATTENTION)
LOOKS = ("free", "redyellow")
NAME = r"[A-Za-z0-9][A-Za-z0-9._+-]{0,199}"
"""Pattern of stimulus and scenario names: letters, digits and ._+- only, so that they have no
special meaning in file systems, URLs or spreadsheets."""
MAX_BYTES = 50_000_000
MAX_FRAMES = 100_000
MAX_SIDE = 10_000


@dataclass(frozen=True, slots=True)
class Stimulus:
    """One row of ``stimuli.csv``.

    Attributes
    ----------
    stimulus, scenario
        Names; together they identify the stimulus.
    phase
        ``familiarization``, ``test``, or ``attention``: an obvious outcome, shown in the test as a
        check and never analysed.
    place
        Position in familiarization, from 0. In the test it has no effect on the order.
    label
        Whether the agent touches the patient.
    movie
        Movie of the observed frames only. All paths are relative to the study folder.
    map
        PNG that marks agent and patient.
    full
        Full movie, in familiarization; empty in the test.
    frames, full_frames
        Number of frames of ``movie`` and ``full`` (0 if there is no full movie).
    rate
        Frames per second.
    width, height
        Size of movies and map in pixels.
    look
        Colours: ``free`` or ``redyellow``.
    """

    stimulus: str
    scenario: str
    phase: str
    place: int
    label: bool
    movie: str
    map: str
    full: str
    frames: int
    full_frames: int
    rate: float
    width: int
    height: int
    look: str


COLUMNS = tuple(field.name for field in fields(Stimulus))


def is_name(name: str) -> bool:
    """Return whether ``name`` is a valid name of a stimulus or scenario."""
    return re.fullmatch(NAME, name) is not None


def read_stimuli(path: Path) -> tuple[Stimulus, ...]:
    """Read and check a stimuli file; `BadInputError` names the row and column of an error.

    Rows are counted as a spreadsheet shows them: the header is row 1.
    """
    return parse_stimuli(path, read_plain(path, MAX_BYTES))


def parse_stimuli(path: Path, content: bytes) -> tuple[Stimulus, ...]:
    """Parse and check the content of a stimuli file that was read from ``path``."""
    rows = []
    for row, cells in csv_rows(path, content, COLUMNS):
        if unknown := set(cells) - set(COLUMNS):
            raise BadInputError(f"{path}: {UnknownNameError('column', min(unknown), COLUMNS)}")
        rows.append((row, _parse(path, row, cells)))
    check_stimuli(rows, path)
    return tuple(stimulus for _, stimulus in rows)


def write_stimuli(path: Path, stimuli: Iterable[Stimulus]) -> None:
    """Check the stimuli as `read_stimuli` does, then write ``stimuli.csv`` atomically."""
    chosen = list(stimuli)
    check_stimuli(list(enumerate(chosen, start=2)), path)
    lines = io.StringIO(newline="")
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(COLUMNS)
    for stimulus in chosen:
        writer.writerow([getattr(stimulus, name) for name in COLUMNS])
    write_atomic(path, lines.getvalue().encode())


def _flag(cell: str) -> bool:
    # Spreadsheets write TRUE, Python writes True.
    known = {"true": True, "false": False}
    if cell.lower() not in known:
        raise ValueError("True or False")
    return known[cell.lower()]


def _whole(cell: str) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", cell):
        raise ValueError("an integer of at least 0")
    return int(cell)


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        raise ValueError("a number") from None


_READ: Mapping[str, Callable[[str], str | int | float | bool]] = {
    **dict.fromkeys(COLUMNS, str),
    **dict.fromkeys(("place", "frames", "full_frames", "width", "height"), _whole),
    "label": _flag,
    "rate": _number,
}


def _parse(path: Path, row: int, cells: dict[str, str]) -> Stimulus:
    """Convert the cells of one row; `BadInputError` names row and column of an invalid cell."""
    values: dict[str, str | int | float | bool] = {}
    for name, cell in cells.items():
        try:
            values[name] = _READ[name](cell)
        except ValueError as error:
            raise BadInputError(
                f"{path}, row {row}: {name} must be {error}, not {cell[:60]!r}"
            ) from error
    return Stimulus(**values)  # type: ignore[arg-type]


# --- checks --------------------------------------------------------------------------------------

_MOVIE = re.compile(rf"{MEDIA_FOLDER}/[A-Za-z0-9][A-Za-z0-9_-]{{0,99}}\.mp4")
_MAP = re.compile(rf"{MEDIA_FOLDER}/[A-Za-z0-9][A-Za-z0-9_-]{{0,99}}\.png")


def check_stimuli(rows: list[tuple[int, Stimulus]], path: Path) -> None:
    """Check each stimulus, then that names, places and movies are consistent among all rows.

    ``rows`` are pairs of row number and stimulus. `BadInputError` names the first invalid row.
    """
    if not rows:
        raise BadInputError(f"{path} has no stimulus")
    for row, stimulus in rows:
        for column, allowed in _faults(stimulus):
            value = getattr(stimulus, column)
            raise BadInputError(f"{path}, row {row}: {column} must be {allowed}, not {value!r}")
    names: dict[tuple[str, str], int] = {}
    places: dict[tuple[str, str, int], int] = {}
    for row, s in rows:
        first = names.setdefault((s.scenario, s.stimulus), row)
        if first != row:
            # In both phases, the outcome would be known when the test trial is answered.
            raise BadInputError(
                f"{path}, row {row}: {s.stimulus} is already in row {first}; a scenario shows "
                "each stimulus once"
            )
        first = places.setdefault((s.scenario, s.phase, s.place), row)
        if first != row:
            raise BadInputError(
                f"{path}, row {row}: place {s.place} of {s.phase} of {s.scenario} is taken by "
                f"row {first}"
            )
    check_distinct_names(((s.scenario, s.stimulus) for _, s in rows), path)
    _check_futures(rows, path)


def check_distinct_names(names: Iterable[tuple[str, str]], where: Path) -> None:
    """Check that no two (scenario, stimulus) pairs have the same name in the analysis."""
    seen: dict[tuple[str, str], str] = {}
    for scenario, name in names:
        first = seen.setdefault((scenario, canonical_name(name)), name)
        if first == name:
            continue
        raise BadInputError(
            f"{where}: {first} and {name} of {scenario} are one stimulus to the analysis, which "
            "removes -redyellow, _img, .mp4 and .hdf5; remove or rename one of them"
        )


def _faults(s: Stimulus) -> Iterable[tuple[str, str]]:
    """Yield the column and a description of its allowed values, for each error in one row."""
    practice = s.phase == "familiarization"
    letters = "letters, digits and ._+- only"
    if not is_name(s.stimulus):
        yield "stimulus", letters
    if not is_name(s.scenario):
        yield "scenario", letters
    if s.phase not in STIMULUS_PHASES:
        yield "phase", " or ".join(STIMULUS_PHASES)
    if s.look not in LOOKS:
        yield "look", " or ".join(LOOKS)
    if not _MOVIE.fullmatch(s.movie):
        yield "movie", f"the path of a movie, {MEDIA_FOLDER}/NAME.mp4"
    if not _MAP.fullmatch(s.map):
        yield "map", f"the path of an image, {MEDIA_FOLDER}/NAME.png"
    if practice and not _MOVIE.fullmatch(s.full):
        yield "full", f"the path of the full movie, {MEDIA_FOLDER}/NAME.mp4, in familiarization"
    if not practice and s.full:
        yield "full", "empty in the test: participants never see the outcome of a test trial"
    if not 1 <= s.frames <= MAX_FRAMES:
        yield "frames", f"from 1 to {MAX_FRAMES}"
    if practice and not s.frames < s.full_frames <= MAX_FRAMES:
        yield "full_frames", f"more than the {s.frames} observed frames, at most {MAX_FRAMES}"
    if not practice and s.full_frames:
        yield "full_frames", "0 in the test"
    if not (math.isfinite(s.rate) and 1 <= s.rate <= 240):
        yield "rate", "from 1 to 240 frames per second"
    for side in ("width", "height"):
        if not 16 <= getattr(s, side) <= MAX_SIDE:
            yield side, f"from 16 to {MAX_SIDE} pixels"


def _check_futures(rows: list[tuple[int, Stimulus]], path: Path) -> None:
    """Check that no movie shown before an answer is also the full movie of some stimulus."""
    whole = {s.full: row for row, s in rows if s.full}
    for row, s in rows:
        if s.movie in whole:
            raise BadInputError(
                f"{path}, row {row}: movie is the full movie of row {whole[s.movie]}; it must "
                "contain the observed frames only"
            )
