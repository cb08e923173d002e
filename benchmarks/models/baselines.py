"""Accuracy of the baselines on the official scenes.

    python benchmarks/models/baselines.py OFFICIAL/scenes

Simulates the observed part of every official scene and predicts the recorded outcome, one scenario
at a time, fitted on the other trials of the scenario: those of other configurations
(leave-one-configuration-out), and those of the other four of five random folds. A logistic
regression decides from blob centroids of seven frames rendered at 64 px in red and yellow, under
*observed*; the threshold of constant motion is fitted to the gap. Nothing is cached: simulating
takes a quarter of a minute. ``--write`` puts the table into benchmarks/results/baselines.md.
"""

from __future__ import annotations

import argparse
import datetime
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import LAST_OBSERVED, Batch, Motion
from physion.clips.rendered import RenderedSource
from physion.compute.tasks import processor_and_cores
from physion.core.names import SCENARIOS
from physion.models import build_model
from physion.physics.engine import DEFAULT_ENGINE, make_engine
from physion.readout.decisions import GapDecision, LogisticDecision
from physion.readout.features import Outcomes
from physion.scenes.scene import OBSERVED_FRAMES
from physion.scenes.tdw.read_logs import ImportedTrial, read_scenes

FOLDS, SEED = 5, 0
RESULTS = Path(__file__).parents[1] / "results"
REFERENCE = {"state-classifier": "before this package: .698 and .719"}
"""Figures known from earlier measurements: configurations held out, then random folds."""
Labels = NDArray[np.bool_]
Predict = Callable[[Sequence[int], Sequence[int]], NDArray[np.float64]]
"""Function from the rows of fit and test trials to P(contact) of the test trials."""


def main() -> None:
    """Measure every baseline on every scenario and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    trials, _ = read_scenes(options.scenes).unique()
    started = time.process_time()
    motions = simulate(trials)
    spent = {"simulation": time.process_time() - started}
    accuracies: dict[str, dict[str, tuple[float, float]]] = {}
    for name, prepare in ANCHORS.items():
        started = time.process_time()
        accuracies[name] = {}
        for scenario in SCENARIOS:
            rows = [r for r, trial in enumerate(trials) if trial.scene.scenario == scenario]
            if rows:
                own = [motions[row] for row in rows]
                labels = np.array([trials[row].outcome.contact for row in rows], np.bool_)
                accuracies[name][scenario] = measure(prepare(own, labels), own, labels)
        spent[name] = time.process_time() - started
    text = "\n".join(lines(trials, accuracies, spent)) + "\n"
    print(text)
    if options.write:
        (RESULTS / "baselines.md").write_text(text)


def simulate(trials: Sequence[ImportedTrial]) -> list[Motion]:
    """Return the observed part of every trial; its length does not tell the outcome."""
    engine = make_engine(DEFAULT_ENGINE)
    return [
        Motion(trial.scene, engine.simulate(trial.scene, frames=OBSERVED_FRAMES))
        for trial in trials
    ]


def measure(predict: Predict, motions: Sequence[Motion], labels: Labels) -> tuple[float, float]:
    """Return the accuracy with whole configurations held out, and with random folds."""
    groups = [str(motion.scene.parameters["configuration"]) for motion in motions]
    numbers = np.random.default_rng(SEED).permutation(len(motions)) % FOLDS
    known = (np.array(groups), numbers)
    return tuple(  # type: ignore[return-value]
        sum(
            np.count_nonzero((predict(fit, test) > 0.5) == labels[test])
            for fit, test in splits(group)
        )
        / len(labels)
        for group in known
    )


def splits(groups: NDArray[Any]) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield the rows of all other groups and of one group, for every group."""
    for group in np.unique(groups):
        yield np.flatnonzero(groups != group), np.flatnonzero(groups == group)


def batch_of(motions: Sequence[Motion]) -> Batch:
    """Return motions as a batch of the last observed frame."""
    frames = np.full((len(motions), 1), LAST_OBSERVED, np.int64)
    names = tuple(motion.scene.name for motion in motions)
    return Batch(names, frames, np.ones(frames.shape, np.bool_), state=tuple(motions))


def base_rate(motions: Sequence[Motion], labels: Labels) -> Predict:
    """Predict the more frequent outcome of the fit trials."""
    return lambda fit, test: np.full(len(test), labels[fit].mean())


def fitted(name: str) -> Callable[[Sequence[Motion], Labels], Predict]:
    """Return what fits a baseline on the fit trials."""

    def prepare(motions: Sequence[Motion], labels: Labels) -> Predict:
        model: Any = build_model(name)
        batch = batch_of(motions)

        def predict(fit: Sequence[int], test: Sequence[int]) -> NDArray[np.float64]:
            fitted_model = model.fit(batch.select(fit), labels[fit], SEED)
            return np.asarray(fitted_model.predict(batch.select(test)))

        return predict

    return prepare


def constant_motion(motions: Sequence[Motion], labels: Labels) -> Predict:
    """Fit the threshold of the gap on the fit trials."""
    model: Any = build_model("constant-motion")
    gaps = model.imagine(batch_of(motions), 1, SEED).gap

    def predict(fit: Sequence[int], test: Sequence[int]) -> NDArray[np.float64]:
        outcomes = [{(): Outcomes(None, gaps[rows])} for rows in (fit, test)]
        return GapDecision().decide(outcomes[0], labels[fit], outcomes[1]).probability

    return predict


def blob_centroids(motions: Sequence[Motion], labels: Labels) -> Predict:
    """Fit a logistic regression on rendered frames of the fit trials."""
    model: Any = build_model("blob-centroids")
    names = [motion.scene.name for motion in motions]
    source = RenderedSource(
        dict(zip(names, motions, strict=True)),
        replace(model.spec, future=0),
        look="redyellow",
        observed=True,
    )
    features = np.concatenate([model.encode(source.context([name])) for name in names])

    def predict(fit: Sequence[int], test: Sequence[int]) -> NDArray[np.float64]:
        reading = LogisticDecision().decide([features[fit]], labels[fit], [features[test]])
        return np.asarray(reading.probability)

    return predict


ANCHORS: dict[str, Callable[[Sequence[Motion], Labels], Predict]] = {
    "base rate": base_rate,
    "already-touched": fitted("already-touched"),
    "state-classifier": fitted("state-classifier"),
    "constant-motion": constant_motion,
    "blob-centroids": blob_centroids,
}


def lines(
    trials: Sequence[ImportedTrial],
    accuracies: dict[str, dict[str, tuple[float, float]]],
    spent: dict[str, float],
) -> Iterator[str]:
    """Yield the lines of the table."""
    counts = {s: sum(trial.scene.scenario == s for trial in trials) for s in SCENARIOS}
    present = [scenario for scenario in SCENARIOS if counts[scenario]]
    yield "# Baselines on the official scenes"
    yield (
        "`python benchmarks/models/baselines.py OFFICIAL/scenes --write`, "
        f"{datetime.date.today()}, {processor_and_cores()}. Accuracy for the recorded outcome of "
        f"{len(trials)} scenes without duplicates, with whole configurations held out / in {FOLDS} "
        "random folds; the standard error of a scenario is about "
        f"{math.sqrt(0.2 * len(present) / len(trials)):.2f}. Engine: "
        f"{make_engine(DEFAULT_ENGINE).name}."
    )
    yield ""
    rigid = [scenario for scenario in present if scenario != "drape"]
    yield f"| baseline | {' | '.join(f'{s} ({counts[s]})' for s in present)} | mean of rigid ones |"
    yield "|---" * (len(present) + 2) + "|"
    for name, by_scenario in accuracies.items():
        mean = np.mean([by_scenario[scenario] for scenario in rigid], axis=0)
        cells = [*(by_scenario[scenario] for scenario in present), mean]
        yield f"| {name} | {' | '.join(f'{a:.3f} / {b:.3f}' for a, b in cells)} |"
    yield ""
    yield (
        "- The base rate is that of the fit trials: where outcomes are balanced, that of the "
        "trials held out is on the other side of 0.5."
    )
    for name, text in REFERENCE.items():
        yield f"- {name}, mean of rigid ones, {text}."
    yield f"- Processor seconds: {', '.join(f'{n} {value:.0f}' for n, value in spent.items())}."


if __name__ == "__main__":
    main()
