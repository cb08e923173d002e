"""Expected time of the trainings of a plan."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from physion.compute.tasks import Progress, tracked
from physion.core.errors import PhysionError
from physion.readout.plans.failures import describe_failure
from physion.readout.plans.speed import Speed, measure_speed
from physion.readout.plans.tasks import TrainingTask
from physion.readout.plans.training_plan import TrainingPlan

DONE, EARLIER, MEASURED = "done", "earlier trainings", "measured steps"
"""What an estimate comes from."""


@dataclass(frozen=True)
class Estimate:
    """Expected seconds of a task: 0 if it is done, None if they are not known.

    ``source`` is one of the constants of this module, or why the time is not known.
    """

    task: TrainingTask
    steps: int
    seconds: float | None
    source: str


def estimate_plan(plan: TrainingPlan, progress: Progress | None = None) -> list[Estimate]:
    """Return the expected time of every task; models without earlier trainings make a few steps.

    Nothing is written.
    """
    done = [task for task in plan.tasks if task.key in plan.done]
    new = dict(
        zip((t.key for t in plan.pending), _new_trials(plan, plan.pending, done), strict=True)
    )
    measured: dict[str, tuple[Speed | None, str]] = {}
    estimates = []
    for task in tracked(plan.tasks, "estimates", len(plan.tasks), progress):
        if task.key in plan.done:
            steps = int(plan.done[task.key]["trained"]["steps"])
            estimates.append(Estimate(task, steps, 0.0, DONE))
            continue
        speed, source = plan.earlier_speed(task), EARLIER
        if speed is None:
            name = task.choice.name
            if name not in measured:
                measured[name] = _measure(plan, task)
            speed, source = measured[name]
        steps = plan.steps(task)
        seconds = speed.seconds(steps, new[task.key]) if speed is not None else None
        estimates.append(Estimate(task, steps, seconds, source))
    return estimates


def time_left(plan: TrainingPlan, tasks: Sequence[TrainingTask]) -> str:
    """Return how long ``tasks`` take, as ", about 2 h left"; "" if nothing is known or left.

    A model of which nothing was trained yet is taken to need the mean time of the others.
    """
    finished = [task for task in plan.tasks if task not in tasks]
    speeds = [plan.earlier_speed(task) for task in tasks]
    known = [
        speed.seconds(plan.steps(task), new)
        for task, new, speed in zip(tasks, _new_trials(plan, tasks, finished), speeds, strict=True)
        if speed is not None
    ]
    if not known:
        return ""
    return f", about {duration(len(tasks) * sum(known) / len(known))} left"


def duration(seconds: float) -> str:
    """Return a time as text, with the two largest units: ``2 h 10 min``, ``3 min``, ``12 s``."""
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"


def _measure(plan: TrainingPlan, task: TrainingTask) -> tuple[Speed | None, str]:
    try:
        model = plan.models.build(task.choice, task.seed)
        speed = measure_speed(
            plan.dataset, model, plan.overrides, plan.shared, task.planned, task.seed
        )
    except PhysionError as error:
        return None, f"not known: {describe_failure(error)}"
    return speed, MEASURED


def _new_trials(
    plan: TrainingPlan, tasks: Sequence[TrainingTask], before: Sequence[TrainingTask]
) -> list[int]:
    """Return of how many trials each task computes features that no task before it has stored.

    The features of a random encoder depend on the seed, those of a trained one do not.
    """
    known: dict[tuple[str, int], set[str]] = defaultdict(set)

    def stored(task: TrainingTask) -> set[str]:
        facts = plan.models.facts(task.choice)
        own = facts.seeded and facts.init == "random"
        return known[task.choice.name, task.seed if own else -1]

    counts = []
    for task in before:
        stored(task).update(task.planned.trials)
    for task in tasks:
        if plan.models.facts(task.choice).diet != "features":
            counts.append(0)
            continue
        trials = stored(task)
        counts.append(len(set(task.planned.trials) - trials))
        trials.update(task.planned.trials)
    return counts
