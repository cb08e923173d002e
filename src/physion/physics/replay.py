"""Simulate official scenes again and compare the outcomes with the recorded ones."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass
from statistics import fmean

import numpy as np
from scipy.stats import rankdata

from physion.core.seeds import child_generator, trial_seed
from physion.numerics.elementary import log_of
from physion.numerics.linear_algebra import norm
from physion.physics.engine import DEFAULT_ENGINE, Engine, make_engine, simulate_many
from physion.physics.labels import jitter_scene, label_contact, pair_agreement
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import FRAME_TIME
from physion.scenes.tdw.read_logs import ImportedTrial

SMOOTHING = 0.5
"""Added to the runs of either outcome before the logarithm: P = (k + .5) / (n + 1) for k of n runs,
so that no probability is 0."""

RECORDED_OUTCOMES = {
    "physion": {"rigid": 0.862, "drape": 0.874},
    "mujoco": {"rigid": 0.836},
}
"""How often an engine finds the recorded outcome of an official scene: mean over the seven rigid
scenarios, and of Drape (`benchmarks/physics/replay.py`, whose results a test compares)."""


@dataclass(frozen=True)
class ReplayTask:
    """One trial to replay with the engine called ``engine``.

    Then ``repeats`` more runs, with ``jitter`` metres of horizontal noise.
    """

    trial: ImportedTrial
    jitter: float = 0.0
    repeats: int = 0
    engine: str = DEFAULT_ENGINE


@dataclass(frozen=True)
class Replay:
    """Result of one replayed trial. Frames count from 0.

    ``distance`` is the smallest gap between cloth and body in metres, None without cloth.
    ``final_error`` is the distance in metres between simulated and recorded final position of the
    agent, None where it is cloth or the position was not recorded.

    ``cpu_seconds`` is the processor time of one simulation, ``physics_seconds`` what it covers.
    ``jittered`` holds the outcomes of the runs with jitter.
    """

    name: str
    scenario: str
    engine: str
    recorded: bool
    simulated: bool
    recorded_frame: int | None
    simulated_frame: int | None
    frames: int
    distance: float | None
    final_error: float | None
    cpu_seconds: float
    physics_seconds: float
    jittered: tuple[bool, ...] = ()

    @property
    def agrees(self) -> bool:
        """Return whether our outcome is the recorded one."""
        return self.recorded == self.simulated

    @property
    def agreeing_runs(self) -> int:
        """Return the number of jittered runs with the recorded outcome."""
        return self.jittered.count(self.recorded)

    @property
    def brier(self) -> float:
        """Return (1 - k / n)² for k of n jittered runs with the recorded outcome."""
        miss = 1 - self.agreeing_runs / len(self.jittered)
        return miss * miss

    @property
    def log_score(self) -> float:
        """Return log((k + .5) / (n + 1)) for k of n jittered runs with the recorded outcome."""
        return float(log_of((self.agreeing_runs + SMOOTHING) / (len(self.jittered) + 1)))


def replay_trial(task: ReplayTask) -> Replay:
    """Simulate one imported trial, and return the outcome with the recorded one."""
    scene, outcome = task.trial.scene, task.trial.outcome
    engine = make_engine(task.engine)
    # Compiled code is loaded outside the measured time.
    engine.simulate(scene, frames=2)
    started = time.process_time()
    trajectory = engine.simulate(scene)
    spent = time.process_time() - started
    labels = label_contact(scene, trajectory)
    return Replay(
        name=scene.name,
        scenario=scene.scenario,
        engine=task.engine,
        recorded=outcome.contact,
        simulated=labels.contact,
        recorded_frame=outcome.first_frame,
        simulated_frame=labels.first_frame,
        frames=len(trajectory),
        distance=labels.min_distance,
        final_error=_final_error(task.trial, trajectory),
        cpu_seconds=spent,
        physics_seconds=(len(trajectory) - 1) * FRAME_TIME,
        jittered=_jittered_outcomes(task, engine),
    )


def _jittered_outcomes(task: ReplayTask, engine: Engine) -> tuple[bool, ...]:
    """Return the outcomes of the runs with jitter, which are given to the engine in one call."""
    scene = task.trial.scene
    seed = trial_seed("jitter", scene.scenario, scene.name, 0)
    moved = [
        jitter_scene(scene, task.jitter, child_generator(seed, f"repeat {repeat}"))
        for repeat in range(task.repeats)
    ]
    paths = simulate_many(moved, engine=engine, until_contact=True)
    return tuple(label_contact(*pair).contact for pair in zip(moved, paths, strict=True))


def _final_error(trial: ImportedTrial, trajectory: Trajectory) -> float | None:
    """Return the distance in metres of the agent's last position from the recorded one."""
    scene, recorded = trial.scene, trial.outcome.final_position
    agent = scene.index(scene.roles.agent)
    if recorded is None or agent >= len(scene.bodies):
        return None
    return float(norm(trajectory.positions[-1, agent].astype(np.float64) - np.asarray(recorded)))


@dataclass(frozen=True)
class ReplayRow:
    """One line of the replay table: a scenario, simulated by one engine.

    - ``base_rate``: fraction of the more frequent recorded outcome.
    - ``agreement``: fraction of trials whose simulated outcome is the recorded one.
    - ``jittered_agreement``: mean probability of the recorded outcome, which is the fraction of a
      trial's jittered runs that have it.
    - ``ceiling``: probability that two jittered runs of a trial agree.
    - ``brier``: mean of the squares of 1 minus the probability of the recorded outcome; 0 is best,
      .25 is guessing.
    - ``log_score``: mean logarithm of the probability of the recorded outcome, where that is
      (k + .5) / (n + 1) for k of n runs; 0 is best, log(.5) = -.693 is guessing.
    - ``frame_difference``: median of |simulated - recorded| first contact frame over the trials
      with contact in both.
    - ``final_error``: median distance in metres between the simulated and the recorded final
      position of the agent.
    - ``auc``: area under the curve of the smallest cloth gap against the recorded outcome, 1 if
      every contact is closer than every miss.
    - ``milliseconds``: mean processor time of a trial; ``real_time``: physics time over it.

    NaN where there is nothing to compute it from: jittered runs, common contacts, positions, cloth.
    """

    scenario: str
    engine: str
    trials: int
    base_rate: float
    agreement: float
    jittered_agreement: float
    ceiling: float
    brier: float
    log_score: float
    frame_difference: float
    final_error: float
    auc: float
    milliseconds: float
    real_time: float


def summarise(replays: Iterable[Replay]) -> list[ReplayRow]:
    """Return one row for each scenario and engine, in the order of first appearance."""
    groups: dict[tuple[str, str], list[Replay]] = {}
    for replay in replays:
        groups.setdefault((replay.scenario, replay.engine), []).append(replay)
    return [_row(group) for group in groups.values()]


def _row(group: list[Replay]) -> ReplayRow:
    """Return the row of one scenario and engine."""
    recorded = np.array([replay.recorded for replay in group])
    rate = fmean(recorded.tolist())
    frame_differences = [
        abs(replay.simulated_frame - replay.recorded_frame)
        for replay in group
        if replay.simulated_frame is not None and replay.recorded_frame is not None
    ]
    distances = [replay.distance for replay in group if replay.distance is not None]
    errors = [replay.final_error for replay in group if replay.final_error is not None]
    jittered = [replay for replay in group if replay.jittered]
    spent = math.fsum(replay.cpu_seconds for replay in group)
    return ReplayRow(
        scenario=group[0].scenario,
        engine=group[0].engine,
        trials=len(group),
        base_rate=max(rate, 1 - rate),
        agreement=fmean(replay.agrees for replay in group),
        jittered_agreement=_mean([r.agreeing_runs / len(r.jittered) for r in jittered]),
        ceiling=_mean([pair_agreement(np.array(replay.jittered)) for replay in jittered]),
        brier=_mean([replay.brier for replay in jittered]),
        log_score=_mean([replay.log_score for replay in jittered]),
        frame_difference=float(np.median(frame_differences)) if frame_differences else math.nan,
        final_error=float(np.median(errors)) if errors else math.nan,
        auc=area_under_curve(-np.array(distances), recorded)
        if len(distances) == len(group)
        else math.nan,
        milliseconds=1000 * spent / len(group),
        real_time=math.fsum(replay.physics_seconds for replay in group) / max(spent, 1e-9),
    )


def _mean(values: list[float]) -> float:
    """Return the mean, NaN without values."""
    return fmean(values) if values else math.nan


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
