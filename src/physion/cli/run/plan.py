"""Trials of a run: the official scenes that people saw, or sampled ones."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

from physion.core.errors import BadInputError

if TYPE_CHECKING:
    from physion.scenes.tdw.read_logs import ImportedTrial
    from physion.trials.making.plan import TrialTask

SAMPLED_SCENARIOS = ("dominoes", "collide", "drop")
LIMIT = 10
"""Testing trials of a scenario, if no number is asked for."""


@dataclass(frozen=True)
class RunPlan:
    """Trials to make, recorded outcomes by stimulus, and failures of the import."""

    tasks: list[TrialTask]
    recorded: Mapping[str, bool]
    failures: list[str]


def plan_sampled(limit: int | None) -> RunPlan:
    """Plan a small set of sampled trials: testing, and twice as many for the readout."""
    from physion.trials.making.plan import plan_dataset

    count = LIMIT if limit is None else limit
    tasks = plan_dataset("sampled", SAMPLED_SCENARIOS, {"readout": 2 * count, "testing": count})
    return RunPlan(tasks, {}, [])


def plan_official(scenes: Path, humans: Path | None, limit: int | None) -> RunPlan:
    """Plan official scenes: those that people saw are tested, others fit models and readouts.

    ``limit`` is the number of testing trials of a scenario, balanced by recorded outcome; as many
    others are fitted. 0 takes all.
    """
    from physion.analysis.tables import read_humans
    from physion.core.names import canonical_name
    from physion.data.official import read_official_trials
    from physion.trials.making.plan import check_names, plan_scenes

    limit = LIMIT if limit is None else limit or None
    seen = set(read_humans(humans)["stimulus"]) if humans is not None else None
    logs = read_official_trials(scenes)
    logs.require_trials()
    recorded = {trial.scene.name: trial.outcome.contact for trial in logs.trials}
    parts: dict[str, list[ImportedTrial]] = {"testing": [], "readout": []}
    for trial in logs.trials:
        # Familiarization trials are neither tested nor fitted.
        if "familiarization" not in trial.scene.name:
            tested = seen is None or canonical_name(trial.scene.name) in seen
            parts["testing" if tested else "readout"].append(trial)
    # Scenes with the physics of a tested one are not fitted.
    known = {trial.scene.physics_digest() for trial in parts["testing"]}
    parts["readout"] = [t for t in parts["readout"] if t.scene.physics_digest() not in known]
    tasks: list[TrialTask] = []
    for split, trials in parts.items():
        chosen = [trial.scene for trial in balanced_trials(trials, limit)]
        tasks += plan_scenes("official", chosen, split, recorded)
    if not any(task.split == "testing" for task in tasks):
        raise BadInputError(f"none of the scenes in {scenes} is in {humans}")
    check_names(tasks)
    return RunPlan(tasks, recorded, [str(failure) for failure in logs.failures])


def balanced_trials(trials: Iterable[ImportedTrial], limit: int | None) -> list[ImportedTrial]:
    """Return at most ``limit`` trials a scenario, with and without contact alternately.

    The choice depends on names and outcomes alone; a larger limit includes the trials of a smaller
    one. Without a limit all trials are returned.
    """
    from physion.core.seeds import stable_hash

    groups: dict[str, list[ImportedTrial]] = defaultdict(list)
    for trial in sorted(trials, key=lambda trial: stable_hash("limit", trial.scene.name)):
        groups[trial.scene.scenario].append(trial)
    # Scenarios begin with either kind, so that one trial of each is balanced, too.
    ordered = sorted(groups)
    return [
        trial
        for place, scenario in enumerate(ordered)
        for trial in _alternating(groups[scenario], first=place % 2 == 0)[:limit]
    ]


def _alternating(trials: Sequence[ImportedTrial], *, first: bool) -> list[ImportedTrial]:
    """Return trials with the outcome ``first`` and with the other, alternately.

    What is left of the more frequent kind comes last.
    """
    same = [trial for trial in trials if trial.outcome.contact == first]
    others = [trial for trial in trials if trial.outcome.contact != first]
    pairs = zip_longest(same, others)
    return [trial for pair in pairs for trial in pair if trial is not None]
