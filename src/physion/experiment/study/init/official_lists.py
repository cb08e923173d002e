"""Selection of a study's stimuli from stimulus lists in the official format, with their movies.

A list is a JSON file as published by the official study (one object per column, keyed by row) or a
CSV file. Its columns are ``stim_ID``, ``target_hit_zone_label`` (whether the agent touches the
patient) and optionally ``map_url`` (name of the map, if it does not follow from the stimulus),
``scenario`` (any name, the same in all rows) and ``observed_frames`` (number of frames before the
answer, 45 in the official study). Movies are called ``STIM_ID.mp4`` and contain all frames; they
are cut to the observed frames later.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physion.core.errors import BadInputError
from physion.core.files import read_plain
from physion.core.names import (
    FOLDERS,
    OFFICIAL_SCENARIOS,
    SCENARIOS,
    canonical_name,
    plain_name,
    scenario_of,
)
from physion.core.seeds import generator
from physion.experiment.study.csv_rows import csv_rows
from physion.experiment.study.init.generated_trials import StimulusSelection, check_even
from physion.experiment.study.init.media import StimulusSource
from physion.experiment.study.stimuli import MAX_FRAMES, is_name
from physion.scenes.scene import OBSERVED_FRAMES

MAX_LIST_BYTES = 50_000_000
ID, LABEL, MAP = "stim_ID", "target_hit_zone_label", "map_url"
SCENARIO, FRAMES = "scenario", "observed_frames"
OPTIONAL = (MAP, SCENARIO, FRAMES)
_REDYELLOW = "-redyellow"
_LABELS = {"true": True, "false": False, "1": True, "0": False}


@dataclass(frozen=True)
class ListedStimulus:
    """One row of a stimulus list: name, contact label, file name of the map and scenario (either
    may be empty), and number of observed frames.
    """

    stim_id: str
    contact: bool
    map_name: str
    scenario: str = ""
    frames: int = OBSERVED_FRAMES

    @property
    def stimulus(self) -> str:
        """Stimulus name as the analysis uses it, without the endings of the movie file."""
        return self.stim_id.removesuffix(".mp4").removesuffix("_img")

    @property
    def look(self) -> str:
        """Colours of the movie (``free`` or ``redyellow``), derived from its name."""
        return "redyellow" if _REDYELLOW in self.stim_id else "free"


def choose_listed(
    lists: Sequence[Path],
    familiarization: Sequence[Path],
    movies: Path,
    maps: Path | None = None,
    *,
    test: int | None = None,
    seed: int = 0,
) -> StimulusSelection:
    """Select the stimuli of a study from official lists, one list per scenario and phase.

    Parameters
    ----------
    lists
        Lists of test stimuli. The scenario of a list follows from its stimuli or its file name.
    familiarization
        Lists of familiarization stimuli, which are shown in the order of the list.
    movies
        Folder with the movies, flat or laid out as PhysionTest-Core.
    maps
        Folder with the maps; by default they are searched for next to the movies.
    test
        Number of test stimuli to draw from each list, half of them with contact. None: all.
    seed
        Seed of the draw.

    Raises
    ------
    BadInputError
        A list is invalid; the message names the list and the row.
    """
    sources: list[StimulusSource] = []
    for phase, paths in (("familiarization", familiarization), ("test", lists)):
        seen: dict[str, Path] = {}
        for path in paths:
            rows = read_list(path)
            scenario = list_scenario(path, rows)
            if scenario in seen:
                raise BadInputError(f"{path} and {seen[scenario]} are both lists of {scenario}")
            seen[scenario] = path
            if phase == "test":
                rows = _select(path, rows, scenario, test, seed)
            files = _MediaFinder(movies, maps, scenario)
            sources += [_source(row, scenario, phase, i, files) for i, row in enumerate(rows)]
    return StimulusSelection(tuple(sources))


def read_list(path: Path) -> list[ListedStimulus]:
    """Read and check the rows of a list; `BadInputError` names an invalid row and column.

    Rows of JSON files count from 1, rows of CSV files as a spreadsheet shows them.
    """
    content = read_plain(path, MAX_LIST_BYTES)
    rows: Iterable[tuple[int, dict[str, Any]]]
    if path.suffix.lower() == ".csv":
        rows = csv_rows(path, content, (ID, LABEL))
    else:
        rows = enumerate(_json_rows(path, content), start=1)
    by_name: dict[str, ListedStimulus] = {}
    for number, row in rows:
        name = str(row[ID]).strip()
        label = _LABELS.get(str(row[LABEL]).strip().lower())
        if not is_name(name):
            raise BadInputError(
                f"{path}, row {number}: {ID} must be letters, digits and ._+- alone, not "
                f"{name[:100]!r}"
            )
        if label is None:
            raise BadInputError(
                f"{path}, row {number}: {LABEL} must be true or false, not {row[LABEL]!r}"
            )
        # URLs are never opened; only their last part is used, as a name in a local folder.
        map_name = str(row.get(MAP) or "").strip().rpartition("/")[2]
        listed = ListedStimulus(
            name,
            label,
            map_name if is_name(map_name) else "",
            _scenario(path, number, row),
            _frames(path, number, row),
        )
        if listed.stimulus in by_name:
            raise BadInputError(f"{path}, row {number}: {name} is there already")
        by_name[listed.stimulus] = listed
    if not by_name:
        raise BadInputError(f"{path} lists no stimulus")
    return list(by_name.values())


def _scenario(path: Path, number: int, row: Mapping[str, Any]) -> str:
    """Return the scenario of a row, or an empty text if the list does not name it."""
    given = str(row.get(SCENARIO) or "").strip()
    if given and not is_name(given):
        raise BadInputError(
            f"{path}, row {number}: {SCENARIO} must be letters, digits and ._+- alone, not "
            f"{given[:100]!r}"
        )
    return given


def _frames(path: Path, number: int, row: Mapping[str, Any]) -> int:
    """Return the number of observed frames of a row; that of the official study if not given."""
    given = str(row.get(FRAMES) or "").strip()
    if not given:
        return OBSERVED_FRAMES
    if not re.fullmatch(r"[0-9]{1,6}(\.0)?", given) or not 1 <= float(given) <= MAX_FRAMES:
        raise BadInputError(
            f"{path}, row {number}: {FRAMES} must be from 1 to {MAX_FRAMES}, not {given[:100]!r}"
        )
    return int(float(given))


def list_scenario(path: Path, rows: Iterable[ListedStimulus]) -> str:
    """Return the scenario of a list: that of its rows, else of its stimulus names or file name."""
    rows = list(rows)
    named = {row.scenario for row in rows}
    if len(named) > 1:
        raise BadInputError(
            f"{path}: a list is of one scenario, not of {' and '.join(sorted(named)[:5])}"
        )
    if named != {""}:
        return named.pop()
    from_stimuli = {scenario_of(canonical_name(row.stim_id)) for row in rows}
    if len(from_stimuli) == 1 and None not in from_stimuli:
        return str(from_stimuli.pop())
    parts = path.stem.lower().replace("_", "-").split("-")
    from_name = {OFFICIAL_SCENARIOS.get(part, part) for part in parts}
    from_name &= set(SCENARIOS)
    if len(from_name) != 1:
        raise BadInputError(
            f"{path}: which scenario is it? Give a column {SCENARIO}, or put one of "
            f"{', '.join(SCENARIOS)} into the file's name"
        )
    return from_name.pop()


def _json_rows(path: Path, content: bytes) -> list[dict[str, Any]]:
    """Return the rows of a JSON list, with the columns that are used here."""
    try:
        columns = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{path} is not JSON: {error}") from error
    if not isinstance(columns, dict) or not all(isinstance(c, dict) for c in columns.values()):
        raise BadInputError(f'{path} is not one object per column, {{"{ID}": {{"0": ...}}, ...}}')
    for name in (ID, LABEL):
        if name not in columns:
            raise BadInputError(
                f"{path} lacks the column {name}; it has {', '.join(columns)[:200]}"
            )
    keys = list(columns[ID])
    optional = [name for name in OPTIONAL if name in columns]
    for name in (LABEL, *optional):
        if list(columns[name]) != keys:
            raise BadInputError(f"{path}: the columns {ID} and {name} have different rows")
    return [{name: columns[name][key] for name in (ID, LABEL, *optional)} for key in keys]


def _select(
    path: Path, rows: list[ListedStimulus], scenario: str, count: int | None, seed: int
) -> list[ListedStimulus]:
    """Return all rows, or ``count`` random ones, half with contact, in the order of the list."""
    if count is None or count == len(rows):
        return rows
    check_even(count, "--test")
    by_label = [[row for row in rows if row.contact == contact] for contact in (True, False)]
    if count // 2 > min(map(len, by_label)):
        raise BadInputError(
            f"{path} has {len(by_label[0])} stimuli with and {len(by_label[1])} without contact, "
            f"not {count // 2} of each"
        )
    rng = generator("study list", seed, scenario)
    kept = {row for group in by_label for row in _sample(group, count // 2, rng)}
    return [row for row in rows if row in kept]


def _sample(
    rows: list[ListedStimulus], count: int, rng: np.random.Generator
) -> list[ListedStimulus]:
    return [rows[i] for i in rng.permutation(len(rows))[:count]]


class _MediaFinder:
    """Search paths for the movies and maps of one scenario."""

    def __init__(self, movies: Path, maps: Path | None, scenario: str) -> None:
        for folder in filter(None, (movies, maps)):
            if not folder.is_dir():
                raise BadInputError(f"there is no folder {folder}")
        title = FOLDERS.get(scenario, scenario)
        roots = [movies, movies / title, movies / title.lower()]
        self.movies = [root / sub for root in roots for sub in ("", "mp4s", "mp4s-redyellow")]
        map_folders = [root / "maps" for root in (*roots, movies.parent)]
        self.maps = [maps, maps / title, maps / "maps"] if maps else [*self.movies, *map_folders]

    def movie(self, row: ListedStimulus) -> Path:
        """Return the path of the movie of a stimulus; if there is none, its expected path."""
        return _first_existing(self.movies, [f"{row.stim_id.removesuffix('.mp4')}.mp4"])

    def map(self, row: ListedStimulus) -> Path:
        """Return the path of the map of a stimulus, which both looks may share."""
        names = [row.map_name] if row.map_name else []
        names += [f"{row.stimulus}_map.png", f"{plain_name(row.stim_id)}_map.png"]
        return _first_existing(self.maps, names)


def _first_existing(folders: Sequence[Path], names: Sequence[str]) -> Path:
    """Return the first existing file with one of these names; if none exists, the first path."""
    paths = [folder / name for folder in folders for name in names]
    return next((path for path in paths if path.is_file()), paths[0])


def _source(
    row: ListedStimulus, scenario: str, phase: str, place: int, files: _MediaFinder
) -> StimulusSource:
    """Return the source files of one row of a list."""
    return StimulusSource(
        stimulus=row.stimulus,
        scenario=scenario,
        phase=phase,
        place=place,
        label=row.contact,
        look=row.look,
        movie=files.movie(row),
        map=files.map(row),
        frames=row.frames,
    )
