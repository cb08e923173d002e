"""Simulate official scenes again and compare the outcomes with the recorded ones."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass
from statistics import fmean

import numpy as np
from scipy.stats import rankdata

from physion.physics.engine import simulate
from physion.physics.jitter import jitter_scene, pair_agreement
from physion.physics.labels import label_contact
from physion.scenes.scene import FRAME_TIME
from physion.scenes.tdw.read_logs import ImportedTrial
from physion.seeds import child_generator, trial_seed


@dataclass(frozen=True)
class ReplayTask:
    """One trial to replay, and ``repeats`` runs with ``jitter`` metres of horizontal noise."""

    trial: ImportedTrial
    jitter: float = 0.0
    repeats: int = 0


@dataclass(frozen=True)
class Replay:
    """Result of one replayed trial. Frames count from 0.

    ``distance`` is the smallest gap between cloth and body in metres, None without cloth.

    ``cpu_seconds`` is the processor time of one simulation, ``physics_seconds`` what it covers.
    ``jittered`` holds the outcomes of the runs with jitter.
    """

    name: str
    scenario: str
    recorded: bool
    simulated: bool
    recorded_frame: int | None
    simulated_frame: int | None
    frames: int
    distance: float | None
    cpu_seconds: float
    physics_seconds: float
    jittered: tuple[bool, ...] = ()

    @property
    def agrees(self) -> bool:
        """Return whether our outcome is the recorded one."""
        return self.recorded == self.simulated


def replay_trial(task: ReplayTask) -> Replay:
    """Simulate one imported trial, and return the outcome with the recorded one."""
    scene, outcome = task.trial.scene, task.trial.outcome
    # Compiled code is loaded outside the measured time.
    simulate(scene, frames=2)
    started = time.process_time()
    trajectory = simulate(scene)
    spent = time.process_time() - started
    labels = label_contact(scene, trajectory)
    seed = trial_seed("jitter", scene.scenario, scene.name, 0)
    outcomes = []
    for repeat in range(task.repeats):
        moved = jitter_scene(scene, task.jitter, child_generator(seed, f"repeat {repeat}"))
        outcomes.append(label_contact(moved, simulate(moved)).contact)
    return Replay(
        name=scene.name,
        scenario=scene.scenario,
        recorded=outcome.contact,
        simulated=labels.contact,
        recorded_frame=outcome.first_frame,
        simulated_frame=labels.first_frame,
        frames=len(trajectory),
        distance=labels.min_distance,
        cpu_seconds=spent,
        physics_seconds=(len(trajectory) - 1) * FRAME_TIME,
        jittered=tuple(outcomes),
    )


@dataclass(frozen=True)
class ReplayRow:
    """One line of the replay table: a scenario, or the mean over scenarios.

    - ``base_rate``: fraction of the more frequent recorded outcome.
    - ``agreement``: fraction of trials whose simulated outcome is the recorded one.
    - ``frame_difference``: median of |simulated - recorded| first contact frame over the trials
      with contact in both; NaN without any.
    - ``auc``: area under the curve of the smallest cloth gap against the recorded outcome, 1 if
      every contact is closer than every miss; NaN without cloth.
    - ``milliseconds``: mean processor time of a trial; ``real_time``: physics time over it.
    - ``ceiling``: probability that two jittered runs of a trial agree; NaN without jitter.
    """

    scenario: str
    trials: int
    base_rate: float
    agreement: float
    frame_difference: float
    auc: float
    milliseconds: float
    real_time: float
    ceiling: float


def summarise(replays: Iterable[Replay]) -> list[ReplayRow]:
    """Return one row for each scenario, in the order of first appearance."""
    groups: dict[str, list[Replay]] = {}
    for replay in replays:
        groups.setdefault(replay.scenario, []).append(replay)
    return [_row(name, group) for name, group in groups.items()]


def _row(scenario: str, group: list[Replay]) -> ReplayRow:
    """Return the row of one scenario."""
    recorded = np.array([replay.recorded for replay in group])
    rate = fmean(recorded.tolist())
    both = [
        abs(replay.simulated_frame - replay.recorded_frame)
        for replay in group
        if replay.simulated_frame is not None and replay.recorded_frame is not None
    ]
    distances = [replay.distance for replay in group if replay.distance is not None]
    ceilings = [pair_agreement(np.array(replay.jittered)) for replay in group]
    spent = math.fsum(replay.cpu_seconds for replay in group)
    return ReplayRow(
        scenario=scenario,
        trials=len(group),
        base_rate=max(rate, 1 - rate),
        agreement=fmean(replay.agrees for replay in group),
        frame_difference=float(np.median(both)) if both else float("nan"),
        auc=area_under_curve(-np.array(distances), recorded)
        if len(distances) == len(group)
        else float("nan"),
        milliseconds=1000 * spent / len(group),
        real_time=math.fsum(replay.physics_seconds for replay in group) / max(spent, 1e-9),
        ceiling=fmean(ceilings) if group[0].jittered else float("nan"),
    )


def area_under_curve(scores: np.ndarray, truth: np.ndarray) -> float:
    """Return the probability that a random positive scores above a random negative.


    ``scores`` (n,) are real, ``truth`` (n,) bool; ties count half. NaN without both classes.
    """
    positives = np.count_nonzero(truth)
    negatives = len(truth) - positives
    if not (positives and negatives):
        return float("nan")
    ranks = rankdata(scores)
    above = math.fsum(ranks[truth]) - positives * (positives + 1) / 2
    return above / (positives * negatives)
