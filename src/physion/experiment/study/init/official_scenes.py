"""Selection of official scenes for a study with people, before their trials are rendered.

Test trials are scenes that people of the original study saw. Familiarization trials are those of
the study where the data hold any, else scenes that nobody saw and whose physics no test trial has.
Only scenes are taken whose simulation has the recorded outcome: the movie that participants see
ends as the original one did, and their answers can be compared with those of the study. Agent and
patient must be visible in the first frame, where the map marks them.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import canonical_name
from physion.core.seeds import stable_hash
from physion.experiment.study.init.generated_trials import SPLITS, check_even, in_paper_order
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.rendering.renderer import Renderer
from physion.scenes.tdw.read_logs import ImportedTrial
from physion.trials.making.plan import TrialTask, check_names, plan_scenes

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
                    "whole study (physion import-official CHECKOUT DIR) and give --scenes DIR"
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
