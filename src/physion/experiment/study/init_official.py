"""A study from lists of stimuli in the official form, and the movies that they name.

A list is a JSON file as the study published them (one object a column, keyed by row) or a CSV file,
with the columns ``stim_ID`` and ``target_hit_zone_label`` (does the agent touch the patient?) and,
if it is called otherwise, the map's ``map_url``. Movies are ``STIM_ID.mp4``, all frames, cut here.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physion.analysis.tables.stimuli import (
    OFFICIAL_SCENARIOS,
    SCENARIOS,
    canonical_name,
    scenario_of,
)
from physion.errors import BadInputError
from physion.experiment.study.csv_rows import csv_rows
from physion.experiment.study.init_trials import Choice, check_even
from physion.experiment.study.media import Source
from physion.experiment.study.plain_files import read_plain
from physion.experiment.study.stimuli import is_name
from physion.seeds import generator
from physion.trials.official.names import FOLDERS, plain_name

MAX_LIST_BYTES = 50_000_000
ID, LABEL, MAP = "stim_ID", "target_hit_zone_label", "map_url"
_REDYELLOW = "-redyellow"
_LABELS = {"true": True, "false": False, "1": True, "0": False}


@dataclass(frozen=True)
class Listed:
    """One row of a list: the stimulus, whether there is contact, what its map is called."""

    stim_id: str
    contact: bool
    map_name: str

    @property
    def stimulus(self) -> str:
        """The name that the analysis knows it by, without what only names the file."""
        return self.stim_id.removesuffix(".mp4").removesuffix("_img")

    @property
    def look(self) -> str:
        """Colours of the movie, which the name tells."""
        return "redyellow" if _REDYELLOW in self.stim_id else "free"


def choose_listed(
    lists: Sequence[Path],
    familiarization: Sequence[Path],
    movies: Path,
    maps: Path | None = None,
    *,
    test: int | None = None,
    seed: int = 0,
) -> Choice:
    """The stimuli of one list a scenario, all or ``test`` of them, balanced.

    ``familiarization`` lists, in their own order, those to practise on; which scenario a list
    belongs to is told by its stimuli or its name. ``movies`` (and ``maps``) is a folder, as laid
    out by PhysionTest-Core or flat. `BadInputError` names list and row of what is wrong.
    """
    sources: list[Source] = []
    for phase, paths in (("familiarization", familiarization), ("test", lists)):
        seen: dict[str, Path] = {}
        for path in paths:
            rows = read_list(path)
            scenario = list_scenario(path, rows)
            if scenario in seen:
                raise BadInputError(f"{path} and {seen[scenario]} are both lists of {scenario}")
            seen[scenario] = path
            if phase == "test":
                rows = _chosen(path, rows, scenario, test, seed)
            files = _Files(movies, maps, scenario)
            sources += [_source(row, scenario, phase, i, files) for i, row in enumerate(rows)]
    return Choice(tuple(sources))


def read_list(path: Path) -> list[Listed]:
    """The rows of a list in their order; `BadInputError` names a bad row and column.

    Rows of JSON count from 1, those of CSV as a spreadsheet shows them.
    """
    content = read_plain(path, MAX_LIST_BYTES)
    rows: Iterable[tuple[int, dict[str, Any]]]
    if path.suffix.lower() == ".csv":
        rows = csv_rows(path, content, (ID, LABEL))
    else:
        rows = enumerate(_json_rows(path, content), start=1)
    found: dict[str, Listed] = {}
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
        # Addresses are never opened; the last word of one is a file name in our folder.
        map_name = str(row.get(MAP) or "").strip().rpartition("/")[2]
        listed = Listed(name, label, map_name if is_name(map_name) else "")
        if listed.stimulus in found:
            raise BadInputError(f"{path}, row {number}: {name} is there already")
        found[listed.stimulus] = listed
    if not found:
        raise BadInputError(f"{path} lists no stimulus")
    return list(found.values())


def list_scenario(path: Path, rows: Iterable[Listed]) -> str:
    """The scenario that the names in a list betray, or else the name of the list."""
    betrayed = {scenario_of(canonical_name(row.stim_id)) for row in rows}
    if len(betrayed) == 1 and None not in betrayed:
        return str(betrayed.pop())
    words = path.stem.lower().replace("_", "-").split("-")
    named = {OFFICIAL_SCENARIOS.get(word, word) for word in words}
    named &= set(SCENARIOS)
    if len(named) != 1:
        raise BadInputError(
            f"{path}: which scenario is it? Put one of {', '.join(SCENARIOS)} into the file's name"
        )
    return named.pop()


def _json_rows(path: Path, content: bytes) -> list[dict[str, Any]]:
    try:
        columns = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{path} is not JSON: {error}") from error
    if not isinstance(columns, dict) or not all(isinstance(c, dict) for c in columns.values()):
        raise BadInputError(f'{path} is not one object a column, {{"{ID}": {{"0": ...}}, ...}}')
    for name in (ID, LABEL):
        if name not in columns:
            raise BadInputError(
                f"{path} lacks the column {name}; it has {', '.join(columns)[:200]}"
            )
    keys = list(columns[ID])
    for name in (LABEL, *({MAP} & set(columns))):
        if list(columns[name]) != keys:
            raise BadInputError(f"{path}: the columns {ID} and {name} have different rows")
    wanted = [name for name in (ID, LABEL, MAP) if name in columns]
    return [{name: columns[name][key] for name in wanted} for key in keys]


def _chosen(
    path: Path, rows: list[Listed], scenario: str, count: int | None, seed: int
) -> list[Listed]:
    """All rows, or so many, half of them with contact, in the order of the list."""
    if count is None or count == len(rows):
        return rows
    check_even(count, "--test")
    kinds = [[row for row in rows if row.contact == contact] for contact in (True, False)]
    if count // 2 > min(map(len, kinds)):
        raise BadInputError(
            f"{path} has {len(kinds[0])} stimuli with and {len(kinds[1])} without contact, not "
            f"{count // 2} of each"
        )
    draws = generator("study list", seed, scenario)
    kept = {row for kind in kinds for row in _some(kind, count // 2, draws)}
    return [row for row in rows if row in kept]


def _some(kind: list[Listed], count: int, draws: np.random.Generator) -> list[Listed]:
    return [kind[i] for i in draws.permutation(len(kind))[:count]]


class _Files:
    """Where the movies and maps of a scenario are looked for."""

    def __init__(self, movies: Path, maps: Path | None, scenario: str) -> None:
        for folder in filter(None, (movies, maps)):
            if not folder.is_dir():
                raise BadInputError(f"there is no folder {folder}")
        title = FOLDERS[scenario]
        roots = [movies, movies / title, movies / title.lower()]
        self.movies = [root / sub for root in roots for sub in ("", "mp4s", "mp4s-redyellow")]
        beside = [root / "maps" for root in (*roots, movies.parent)]
        self.maps = [maps, maps / title, maps / "maps"] if maps else [*self.movies, *beside]

    def movie(self, row: Listed) -> Path:
        """The movie of a stimulus, or where it should be."""
        return _first(self.movies, [f"{row.stim_id.removesuffix('.mp4')}.mp4"])

    def map(self, row: Listed) -> Path:
        """The map of a stimulus, which may lie there for both looks."""
        names = [row.map_name] if row.map_name else []
        names += [f"{row.stimulus}_map.png", f"{plain_name(row.stim_id)}_map.png"]
        return _first(self.maps, names)


def _first(folders: Sequence[Path], names: Sequence[str]) -> Path:
    """The first file that is there, else the first place."""
    return next(_there(folders, names), folders[0] / names[0])


def _there(folders: Sequence[Path], names: Sequence[str]) -> Iterator[Path]:
    for folder in folders:
        for name in names:
            if (folder / name).is_file():
                yield folder / name


def _source(row: Listed, scenario: str, phase: str, place: int, files: _Files) -> Source:
    return Source(
        stimulus=row.stimulus,
        scenario=scenario,
        phase=phase,
        place=place,
        label=row.contact,
        look=row.look,
        movie=files.movie(row),
        map=files.map(row),
    )
