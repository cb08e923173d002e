"""The stimuli of a study: media files, phase, position and outcome of each.

They are stored in ``stimuli.csv`` of the study folder, one row per stimulus. The server never sends
this file.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import pandas as pd

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import write_atomic
from physion.core.names import canonical_name
from physion.core.tables import Column, check_table, must, read_csv

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


COLUMNS: tuple[Column, ...] = (
    must("stimulus", "text", "Name, as in the trials"),
    must("scenario", "text", "Scenario, as in the trials"),
    must("phase", "choice", "Phase in which it is shown; attention: a check among the test trials",
         choices=STIMULUS_PHASES),
    must("place", "integer", "Position in familiarization, from 0; no order in the test", low=0),
    must("label", "flag", "Whether the agent touches the patient"),
    must("movie", "text", "Movie of the observed frames only"),
    must("map", "text", "Image that marks agent and patient"),
    Column("full", "text", "Full movie, in familiarization", required=True),
    must("frames", "integer", "Number of frames of the observed movie", low=1, high=MAX_FRAMES),
    must("full_frames", "integer", "Number of frames of the full movie", low=0, high=MAX_FRAMES),
    must("rate", "number", "Frames per second", unit="Hz", low=1, high=240),
    must("width", "integer", "Width of the movie", unit="px", low=16, high=MAX_SIDE),
    must("height", "integer", "Height of the movie", unit="px", low=16, high=MAX_SIDE),
    must("look", "choice", "Colours of the stimulus", choices=LOOKS),
)  # fmt: skip
"""Columns of ``stimuli.csv``."""


def is_right(response: str, label: bool) -> bool:
    """Return whether a response, yes or no, is the outcome ``label``."""
    return (response == "yes") == label


def is_name(name: str) -> bool:
    """Return whether ``name`` is a valid name of a stimulus or scenario."""
    return re.fullmatch(NAME, name) is not None


def read_stimuli(path: Path) -> tuple[Stimulus, ...]:
    """Read and check a stimuli file; `BadInputError` names the row and column of an error.

    Rows count from 1, without the header.
    """
    table = read_csv(path)
    if unknown := set(table.columns) - {column.name for column in COLUMNS}:
        known = [column.name for column in COLUMNS]
        raise BadInputError(f"{path}: {UnknownNameError('column', min(unknown), known)}")
    # Spreadsheets may end a file with rows of empty cells.
    table = check_table(table[(table != "").any(axis=1)], COLUMNS, str(path))
    stimuli = tuple(Stimulus(**row) for row in table.to_dict("records"))  # type: ignore[misc]
    _check_stimuli(stimuli, path)
    return stimuli


def write_stimuli(path: Path, stimuli: Iterable[Stimulus]) -> None:
    """Write ``stimuli.csv`` atomically; `read_stimuli` checks it."""
    table = pd.DataFrame(map(asdict, stimuli))
    write_atomic(path, table.to_csv(index=False, lineterminator="\n").encode())


# --- checks --------------------------------------------------------------------------------------

_MOVIE = re.compile(rf"{MEDIA_FOLDER}/[A-Za-z0-9][A-Za-z0-9_-]{{0,99}}\.mp4")
_MAP = re.compile(rf"{MEDIA_FOLDER}/[A-Za-z0-9][A-Za-z0-9_-]{{0,99}}\.png")


def _check_stimuli(stimuli: tuple[Stimulus, ...], path: Path) -> None:
    """Check each stimulus, then that names, places and movies are consistent among all rows."""
    names: dict[tuple[str, str], int] = {}
    places: dict[tuple[str, str, int], int] = {}
    whole = {s.full: row for row, s in enumerate(stimuli, start=1) if s.full}
    for row, s in enumerate(stimuli, start=1):
        for column, allowed in _faults(s):
            value = getattr(s, column)
            raise BadInputError(f"{path}, row {row}: {column} must be {allowed}, not {value!r}")
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
        if s.movie in whole:
            raise BadInputError(
                f"{path}, row {row}: movie is the full movie of row {whole[s.movie]}; it must "
                "contain the observed frames only"
            )
    check_distinct_names(((s.scenario, s.stimulus) for s in stimuli), path)


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
    if not _MOVIE.fullmatch(s.movie):
        yield "movie", f"the path of a movie, {MEDIA_FOLDER}/NAME.mp4"
    if not _MAP.fullmatch(s.map):
        yield "map", f"the path of an image, {MEDIA_FOLDER}/NAME.png"
    if practice and not _MOVIE.fullmatch(s.full):
        yield "full", f"the path of the full movie, {MEDIA_FOLDER}/NAME.mp4, in familiarization"
    if not practice and s.full:
        yield "full", "empty in the test: participants never see the outcome of a test trial"
    if practice and s.full_frames <= s.frames:
        yield "full_frames", f"more than the {s.frames} observed frames"
    if not practice and s.full_frames:
        yield "full_frames", "0 in the test"
