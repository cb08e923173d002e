"""Selection of a study's stimuli from a generated dataset.

For each scenario, testing and familiarization trials are drawn, half of them with contact, and of
all presets about equally many, as far as there are so many: presets differ in the number of
elements, distractors and occluders, which are so balanced too. The order of the familiarization
trials is fixed here and the same for all participants.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import read_plain
from physion.core.names import (
    FOLDERS,
    OFFICIAL_SCENARIOS,
    SCENARIOS,
    canonical_name,
    plain_name,
    scenario_of,
)
from physion.core.seeds import generator, stable_hash
from physion.core.settings import parse_json
from physion.core.tables import Column, check_table, must, read_csv
from physion.experiment.study.make import StimulusSource
from physion.experiment.study.stimuli import MAX_FRAMES, is_name
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.rendering.renderer import Renderer
from physion.scenes.scene import OBSERVED_FRAMES
from physion.scenes.tdw.read_logs import ImportedTrial
from physion.trials.dataset import Dataset, read_unusable
from physion.trials.files import TrialPaths
from physion.trials.making.plan import TrialTask, check_names, plan_scenes
from physion.trials.state import outside_picture

Look = Literal["free", "redyellow"]
SPLITS = {"familiarization": "familiarization", "test": "testing"}
"""Split of the dataset from which the trials of each phase are drawn."""
TEST, PRACTICE = 150, 10
"""Test and familiarization trials per session, as in the official study."""
NAMED = 5
"""Largest number of trials that a note names."""


@dataclass(frozen=True)
class StimulusSelection:
    """Selected stimuli; ``notes`` report where fewer were available than requested."""

    sources: tuple[StimulusSource, ...]
    notes: tuple[str, ...] = ()

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Scenarios of the stimuli, in the order of the paper, then any others by name."""
        names = {source.scenario for source in self.sources}
        return tuple(in_paper_order(names))


def choose_trials(
    dataset: Path,
    *,
    scenarios: Sequence[str] = (),
    test: int = TEST,
    practice: int = PRACTICE,
    look: Look = "free",
    seed: int = 0,
) -> StimulusSelection:
    """Select testing and familiarization trials of a dataset.

    Parameters
    ----------
    dataset
        Folder of the dataset.
    scenarios
        Scenarios to use; by default all that have testing trials.
    test, practice
        Number of test and familiarization trials per scenario; even, half of them with contact.
    look
        Colours of the movies.
    seed
        Seed of the draw. The same dataset and seed give the same selection.

    Raises
    ------
    BadInputError
        A scenario has no trial with (or without) contact, or trials have no movies in this look.
    """
    opened = Dataset(dataset)
    unusable = read_unusable(opened)
    tested = set(opened.index["scenario"][opened.index["split"] == SPLITS["test"]])
    if not tested:
        raise BadInputError(f"{dataset} has no testing trials; physion generate makes them")
    for name in scenarios:
        if name not in tested:
            raise UnknownNameError(f"scenario of the testing trials of {dataset}:", name, tested)
    counts = {"familiarization": practice, "test": test}
    sources, notes = [], []
    for name in scenarios or in_paper_order(tested):
        for phase, count in counts.items():
            rows, more = _draw(opened, name, phase, count, seed, unusable)
            sources += [_source(opened, row, phase, i, look) for i, row in enumerate(rows)]
            notes += more
    return StimulusSelection(tuple(sources), tuple(notes))


def choose_familiarization(
    dataset: Path, scenario: str, *, count: int = PRACTICE, look: Look = "free", seed: int = 0
) -> StimulusSelection:
    """Select the familiarization trials of one scenario only, as `choose_trials` does."""
    opened = Dataset(dataset)
    rows, notes = _draw(opened, scenario, "familiarization", count, seed, read_unusable(opened))
    sources = [_source(opened, row, "familiarization", i, look) for i, row in enumerate(rows)]
    return StimulusSelection(tuple(sources), tuple(notes))


def in_paper_order(scenarios: set[str]) -> Iterator[str]:
    """Known scenarios in the order of the paper, then others in alphabetical order."""
    yield from (name for name in SCENARIOS if name in scenarios)
    yield from sorted(scenarios - set(SCENARIOS))


def check_even(count: int, option: str) -> None:
    """Check that ``count`` is even and positive, so that half of the trials can have contact."""
    if count < 2 or count % 2:
        raise BadInputError(
            f"{option} must be even and 2 or more, half with contact and half without, not {count}"
        )


def _draw(
    dataset: Dataset,
    scenario: str,
    phase: str,
    count: int,
    seed: int,
    unusable: Mapping[str, str],
) -> tuple[list[dict[str, Any]], list[str]]:
    """Draw ``count`` rows of the index, half of them with contact, in random order.

    Returns the rows, and notes: on trials that were replaced because someone marked them as
    unusable, on fewer trials than wanted, and on objects beyond the edges of the picture.
    """
    check_even(count, "--test" if phase == "test" else "--practice")
    split = SPLITS[phase]
    table = dataset.index
    table = table[(table["split"] == split) & (table["scenario"] == scenario)]
    by_label = [table[table["contact"] == contact] for contact in (True, False)]
    usable = [int((~rows["trial"].isin(unusable)).sum()) for rows in by_label]
    half = min(count // 2, *usable)
    if half == 0:
        lacking = "with" if usable[0] == 0 else "without"
        imported = dataset.index["recorded_contact"].notna().any()
        advice = (
            "for official scenes give --scenes official in place of --trials"
            if imported
            else f"to make some: physion generate {dataset.folder} --scenario {scenario} "
            f"--split {split} --count {count}"
        )
        raise BadInputError(
            f"{dataset.folder} has no {split} trial of {scenario} {lacking} contact"
            f"{' that is usable' if unusable else ''}; {advice}"
        )
    # Separate random streams for trials with and without contact: adding trials with one label
    # does not change which trials with the other label are drawn.
    notes: list[str] = []
    chosen = pd.concat(
        [_sample(group, half, scenario, phase, seed, unusable, notes) for group in by_label]
    )
    rng = generator("study places", seed, scenario, phase)
    rows = chosen.iloc[rng.permutation(len(chosen))].to_dict("records")
    if 2 * half < count:
        notes.append(
            f"{scenario}: {2 * half} {split} trials instead of {count}, since half must have "
            "contact and no more are available"
        )
    return rows, notes + _beyond_the_picture(dataset, scenario, split, rows)


def _sample(
    group: pd.DataFrame,
    half: int,
    scenario: str,
    phase: str,
    seed: int,
    unusable: Mapping[str, str],
    notes: list[str],
) -> pd.DataFrame:
    """Draw ``half`` rows of a table of one contact label, presets alternating.

    In place of an unusable one comes the next in the order of the draw of the same preset or, if
    there is none, of any preset, so that the other trials stay. ``notes`` get what was replaced.
    """
    contact = str(bool(group["contact"].iloc[0]))
    rng = generator("study trials", seed, scenario, phase, contact)
    order = group.iloc[rng.permutation(len(group))]
    order = order.iloc[alternating(order["preset"].fillna("").astype(str).to_list())]
    bad = order["trial"].isin(unusable).to_numpy()
    presets = order["preset"].fillna("").astype(str).to_list()
    names = order["trial"].to_list()
    spare = [place for place in range(half, len(order)) if not bad[place]]
    places = []
    for place in range(half):
        if bad[place]:
            same = [other for other in spare if presets[other] == presets[place]]
            new = (same or spare)[0]
            spare.remove(new)
            other = "" if same else f" (of preset {presets[new]}, as {presets[place]} has no more)"
            reason = unusable[names[place]]
            notes.append(f"{names[place]} is unusable ({reason}); {names[new]} replaces it{other}")
            place = new
        places.append(place)
    return order.iloc[places]


def alternating(kinds: Sequence[str]) -> list[int]:
    """Return all positions, ordered so that the kinds alternate: first of each, then second."""
    seen: Counter[str] = Counter()
    rounds = []
    for kind in kinds:
        rounds.append(seen[kind])
        seen[kind] += 1
    return sorted(range(len(kinds)), key=rounds.__getitem__)


def _beyond_the_picture(
    dataset: Dataset, scenario: str, split: str, rows: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Return a note on trials with an object that is more outside the picture than in it."""
    found = []
    names = [str(row["trial"]) for row in rows]
    for name in names:
        if not dataset.paths(name).trial_file.is_file():
            continue  # only its movies are there
        outside = outside_picture(dataset.trial(name))
        things = [thing for thing, fraction in outside.items() if fraction > 0.5]
        if things:
            found.append(f"{name} ({', '.join(things)})")
    if not found:
        return []
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    return [
        f"{scenario}: in {len(found)} {split} trials an object begins mostly outside the picture: "
        f"{', '.join(found[:NAMED])}{more}; look at them (physion view {dataset.folder}), and mark "
        "unusable ones there or with --mark TRIAL=REASON"
    ]


def _source(
    dataset: Dataset, row: dict[str, Any], phase: str, place: int, look: Look
) -> StimulusSource:
    """Return the source files of one row of the index, with movies in the given look."""
    paths = TrialPaths(dataset.folder, row["split"], row["scenario"], row["trial"])
    free = row["look"] != look
    columns = {"movie": "movie", "observed": "observed_movie", "map": "map"}
    files = {"movie": paths.movie, "observed": paths.observed_movie, "map": paths.map}
    if free:
        if look != "free" or pd.isna(row["free_movie"]):
            raise BadInputError(
                f"trial {row['trial']} of {dataset.folder} has no movie in the look {look!r}, only "
                f"{row['look']!r}; choose --look {row['look']}, or generate with --look {look}"
            )
        columns |= {"movie": "free_movie", "observed": "free_observed_movie"}
        files |= {"movie": paths.free_movie, "observed": paths.free_observed_movie}
    digests = {name: row[f"{column}_sha256"] for name, column in columns.items()}
    lacking = [name for name, digest in digests.items() if pd.isna(digest)]
    if lacking:
        raise BadInputError(
            f"trial {row['trial']} of {dataset.folder} has no {lacking[0]} file; generate trials "
            "with movies"
        )
    return StimulusSource(
        stimulus=str(row["trial"]),
        scenario=str(row["scenario"]),
        phase=phase,
        place=place,
        label=bool(row["contact"]),
        look=look,
        movie=files["movie"],
        observed=files["observed"],
        map=files["map"],
        frames=int(row["observed_frames"]),
        digests=digests,
    )


# Selection of a study's stimuli from stimulus lists in the official format, with their movies.
#
# A list is a JSON file as published by the official study (one object per column, keyed by row) or
# a CSV file, with the columns below. Movies are called ``STIM_ID.mp4`` and contain all frames; they
# are cut to the observed frames later.

MAX_LIST_BYTES = 50_000_000
LIST_COLUMNS: tuple[Column, ...] = (
    must("stim_ID", "text", "Name of the stimulus"),
    must("target_hit_zone_label", "flag", "Whether the agent touches the patient"),
    Column("map_url", "text", "Name of the map, if it does not follow from the stimulus"),
    Column("scenario", "text", "Any name, the same in all rows"),
    Column("observed_frames", "integer", "Number of frames before the answer",
           low=1, high=MAX_FRAMES),
)  # fmt: skip
"""Columns of a list that are used; others are ignored."""


@dataclass(frozen=True)
class ListedStimulus:
    """One row of a stimulus list: name, contact label, file name of the map and scenario (either
    may be empty), and number of observed frames.
    """

    stim_id: str
    contact: bool
    map_name: str = ""
    scenario: str = ""
    frames: int = OBSERVED_FRAMES

    @property
    def stimulus(self) -> str:
        """Stimulus name as the analysis uses it, without the endings of the movie file."""
        return self.stim_id.removesuffix(".mp4").removesuffix("_img")

    @property
    def look(self) -> str:
        """Colours of the movie (``free`` or ``redyellow``), derived from its name."""
        return "redyellow" if "-redyellow" in self.stim_id else "free"


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
            sources += [
                StimulusSource(
                    stimulus=row.stimulus, scenario=scenario, phase=phase, place=place,
                    label=row.contact, look=row.look, movie=files.movie(row), map=files.map(row),
                    frames=row.frames,
                )
                for place, row in enumerate(rows)
            ]  # fmt: skip
    return StimulusSelection(tuple(sources))


def read_list(path: Path) -> list[ListedStimulus]:
    """Read and check the rows of a list; `BadInputError` names an invalid row and column.

    Rows count from 1, without the header of a CSV file.
    """
    if path.suffix.lower() == ".csv":
        table = read_csv(path)
    else:
        columns = parse_json(read_plain(path, MAX_LIST_BYTES).decode(errors="replace"), str(path))
        if not isinstance(columns, dict) or not all(isinstance(c, dict) for c in columns.values()):
            raise BadInputError(
                f'{path} is not one object per column, {{"stim_ID": {{"0": ...}}, ...}}'
            )
        table = pd.DataFrame(columns)
    table = check_table(table, LIST_COLUMNS, str(path))
    by_name: dict[str, ListedStimulus] = {}
    for number, row in enumerate(table.to_dict("records"), start=1):
        for name in ("stim_ID", "scenario"):
            given = row.get(name, "")
            if not is_name(given) and (name == "stim_ID" or given):
                raise BadInputError(
                    f"{path}, row {number}: {name} must be letters, digits and ._+- only, not "
                    f"{given[:100]!r}"
                )
        # URLs are never opened; only their last part is used, as a name in a local folder.
        map_name = row.get("map_url", "").rpartition("/")[2]
        frames = row.get("observed_frames", pd.NA)
        listed = ListedStimulus(
            row["stim_ID"],
            row["target_hit_zone_label"],
            map_name if is_name(map_name) else "",
            row.get("scenario", ""),
            OBSERVED_FRAMES if pd.isna(frames) else int(frames),
        )
        if listed.stimulus in by_name:
            raise BadInputError(f"{path}, row {number}: {listed.stim_id} is there already")
        by_name[listed.stimulus] = listed
    if not by_name:
        raise BadInputError(f"{path} lists no stimulus")
    return list(by_name.values())


def list_scenario(path: Path, rows: Iterable[ListedStimulus]) -> str:
    """Return the scenario that the rows of a list name, else their stimuli or the file's name."""
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
            f"{path}: which scenario is it? Give a column scenario, or put one of "
            f"{', '.join(SCENARIOS)} into the file's name"
        )
    return from_name.pop()


def _select(
    path: Path, rows: list[ListedStimulus], scenario: str, count: int | None, seed: int
) -> list[ListedStimulus]:
    """Return all rows, or ``count`` random ones, half with contact, configurations alternating, in
    the order of the list.
    """
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
    kept: set[ListedStimulus] = set()
    for group in by_label:
        drawn = [group[index] for index in rng.permutation(len(group))]
        order = alternating([plain_name(row.stimulus).rpartition("_")[0] for row in drawn])
        kept |= {drawn[place] for place in order[: count // 2]}
    return [row for row in rows if row in kept]


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


# Selection of official scenes for a study with people, before their trials are rendered.
#
# Test trials are scenes that people of the original study saw. Familiarization trials are the ones
# of that study where the data hold any, else scenes that nobody saw and whose physics no test trial
# has. Only scenes are taken whose simulation has the recorded outcome: the movie that participants
# see ends as the original one did, and their answers can be compared with the study's.
# Agent and patient must be visible in the first frame, where the map marks them.

Group = tuple[str, str, bool]
"""Scenario, phase and recorded outcome."""
SIZE = 256
"""Pixels per side of the movies."""
OTHER_OUTCOME = "their simulation does not have the recorded outcome"
HIDDEN = "agent or patient is not visible in the first frame"


@dataclass(frozen=True)
class OfficialSelection:
    """Trials to render, and notes on scenes that were left out."""

    tasks: list[TrialTask]
    notes: tuple[str, ...]


def choose_official(
    trials: Sequence[ImportedTrial],
    seen: Collection[str] | None,
    *,
    scenarios: Sequence[str] = (),
    test: int,
    practice: int,
    executor: Executor,
    progress: Progress | None = None,
) -> OfficialSelection:
    """Select official scenes for test and familiarization, half of each with contact.

    Parameters
    ----------
    trials
        Official scenes with recorded outcomes.
    seen
        Canonical names of the stimuli that people saw; None if all are to be tested that are not
        called familiarization.
    scenarios
        Scenarios to use; by default all that have scenes for both phases.
    test, practice
        Largest number of test and familiarization trials per scenario, even.
    executor
        Where scenes are simulated to compare their outcomes.
    progress
        Shows the progress.

    Raises
    ------
    BadInputError
        A count is odd, or a scenario has no scene of a phase with (or without) contact.
    """
    counts = {"test": test, "familiarization": practice}
    for phase, count in counts.items():
        check_even(count, "--test" if phase == "test" else "--practice")
    groups = _groups(trials, seen)
    names = scenarios or list(in_paper_order({scenario for scenario, _, _ in groups}))
    for name in names:
        _check_scenario(name, groups)
    wanted = {
        (name, phase, contact): count // 2
        for name in names
        for phase, count in counts.items()
        for contact in (True, False)
    }
    chosen, lost = _usable(groups, wanted, executor, progress)
    notes = [
        f"{name}: official scenes left out because {why}: {lost[name, why]}"
        for name in names
        for why in (OTHER_OUTCOME, HIDDEN)
        if lost[name, why]
    ]
    return OfficialSelection(_tasks(chosen), tuple(notes))


def _groups(
    trials: Iterable[ImportedTrial], seen: Collection[str] | None
) -> dict[Group, list[ImportedTrial]]:
    """Return the candidates of each group, sorted by the hash of their names.

    Scenes that nobody saw come after those that are called familiarization.
    """
    tested, others = [], []
    for trial in trials:
        name = trial.scene.name
        practice = "familiarization" in name
        if not practice and (seen is None or canonical_name(name) in seen):
            tested.append(trial)
        else:
            others.append((not practice, stable_hash("practice", name), trial))
    known = {trial.scene.physics_digest() for trial in tested}
    tested.sort(key=lambda trial: stable_hash("limit", trial.scene.name))
    practiced = [trial for _, _, trial in sorted(others, key=lambda row: row[:2])]
    parts = {
        "test": tested,
        "familiarization": [t for t in practiced if t.scene.physics_digest() not in known],
    }
    groups: dict[Group, list[ImportedTrial]] = defaultdict(list)
    for phase, part in parts.items():
        for trial in part:
            groups[trial.scene.scenario, phase, trial.outcome.contact].append(trial)
    return groups


def _check_scenario(name: str, groups: dict[Group, list[ImportedTrial]]) -> None:
    """Check that a scenario has scenes of both phases, with and without contact."""
    known = {scenario for scenario, _, _ in groups}
    if name not in known:
        raise UnknownNameError("scenario of the official scenes:", name, known)
    for phase in SPLITS:
        for contact in (True, False):
            if not groups.get((name, phase, contact)):
                raise BadInputError(
                    f"there is no official scene of {name} {'with' if contact else 'without'} "
                    f"contact for {phase} trials; leave {name} out with --scenario, or import the "
                    "whole study (physion import CHECKOUT DIR) and give --scenes DIR"
                )


def find_fault(trial: ImportedTrial) -> str:
    """Return why a scene cannot be shown to participants; an empty text if it can."""
    scene = trial.scene
    motion = simulate(scene)
    if label_contact(scene, motion).contact != trial.outcome.contact:
        return OTHER_OUTCOME
    ids = np.asarray(Renderer(scene, motion, SIZE, SIZE).render(0, ("ids",)).ids)
    roles = (scene.roles.agent, scene.roles.patient)
    return "" if np.isin([scene.index(role) + 1 for role in roles], ids).all() else HIDDEN


def _usable(
    groups: dict[Group, list[ImportedTrial]],
    wanted: dict[Group, int],
    executor: Executor,
    progress: Progress | None,
) -> tuple[dict[Group, list[ImportedTrial]], Counter[tuple[str, str]]]:
    """Return the first scenes of each group that can be shown.

    Also returns how many others were met, by scenario and reason. Scenes are simulated in rounds,
    as many as are still wanted, so that a small study simulates few.
    """
    left = {group: list(groups[group]) for group in wanted}
    chosen: dict[Group, list[ImportedTrial]] = {group: [] for group in wanted}
    lost: Counter[tuple[str, str]] = Counter()
    done, total = 0, sum(min(count, len(left[group])) for group, count in wanted.items())
    while True:
        batch: dict[str, tuple[Group, ImportedTrial]] = {}
        for group, count in wanted.items():
            number = count - len(chosen[group])
            batch |= {trial.scene.name: (group, trial) for trial in left[group][:number]}
            del left[group][:number]
        if not batch:
            return chosen, lost
        faults: dict[str, str] = {}
        for outcome in executor.map(find_fault, {name: t for name, (_, t) in batch.items()}):
            faults[outcome.key] = outcome.value
            done += 1
            if progress is not None:
                progress("outcomes", done, max(total, done))
        for name, (group, trial) in batch.items():
            if faults[name]:
                lost[group[0], faults[name]] += 1
            else:
                chosen[group].append(trial)


def _tasks(chosen: dict[Group, list[ImportedTrial]]) -> list[TrialTask]:
    """Return the trials to render; as many with as without contact."""
    tasks: list[TrialTask] = []
    for phase, split in SPLITS.items():
        trials = []
        for name, part, contact in chosen:
            if part == phase and contact:
                pair = chosen[name, part, True], chosen[name, part, False]
                half = min(map(len, pair))
                trials += [trial for kind in pair for trial in kind[:half]]
        recorded = {trial.scene.name: trial.outcome.contact for trial in trials}
        tasks += plan_scenes("official", [trial.scene for trial in trials], split, recorded)
    check_names(tasks)
    return tasks
