"""Predictions of `noisy-simulation`, whose noise level is fitted in place of a readout.

Unlike other models it is fitted on the outcomes that the official recording has, where it has
them; the column *Fit Labels* of the predictions says which outcomes were used.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physion.atomic import write_atomic
from physion.compute.executor import Executor
from physion.compute.local import SerialExecutor
from physion.compute.progress import Progress
from physion.errors import BadInputError
from physion.models.noisy_simulation import (
    LAST_OBSERVED,
    NoisySimulation,
    ObservedTrial,
    SimulationTask,
    cut_trial,
    fit_scale,
    run_simulations,
)
from physion.readout.folds import Fold, ScenarioSplit
from physion.readout.protocols import Readout
from physion.readout.table import ScenarioPredictions, describe_labels
from physion.trials.dataset import Dataset

Cell = tuple[str, float]
"""Name of a trial and noise scale."""


@dataclass
class SimulationReadout:
    """Predictor that simulates every trial at every noise level, then fits the level per fold.

    Results are stored in ``folder/simulations`` under a hash of their inputs, so that a later run
    does not simulate them again. Trials that fail have no prediction; ``problems`` maps their
    names to the reasons.
    """

    dataset: Dataset
    model: NoisySimulation
    folder: Path | None
    executor: Executor | None = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        self.problems: dict[str, str] = {}
        self._contact_fractions: dict[Cell, float] = {}
        index = self.dataset.index
        # Recorded outcomes take precedence: compared with the outcomes of its own engine, the
        # model would always fit best without noise.
        outcomes = index["recorded_contact"].fillna(index["contact"])
        self._labels = dict(zip(index["trial"], outcomes.astype(bool), strict=True))
        self._recorded = dict(zip(index["trial"], index["recorded_contact"].notna(), strict=True))

    def prepare(self, folds: Sequence[Fold]) -> None:
        """Simulate all trials of ``folds`` at all noise levels."""
        trials = {t: None for fold in folds for s in fold.scenarios for t in (*s.fit, *s.test)}
        config = self.model.config
        tasks: dict[str, tuple[Cell, SimulationTask, str]] = {}
        for trial in trials:
            try:
                observed = self._observe(trial)
            except BadInputError as error:
                self.problems[trial] = str(error)
                continue
            for scale in config.scales:
                task = self.model.task(observed, scale)
                tasks[f"{trial} x{scale:g}"] = ((trial, scale), task, task.digest())
        self._run(tasks)

    def predict(self, fold: Fold) -> list[ScenarioPredictions]:
        """Return the predictions of a fold; noise levels are fitted on its fit trials alone."""
        return [self._predict_scenario(fold, split) for split in fold.scenarios]

    def _predict_scenario(self, fold: Fold, split: ScenarioSplit) -> ScenarioPredictions:
        config = self.model.config
        fit, test = self._usable(split.fit), self._usable(split.test)
        labels = np.array([self._labels[t] for t in fit], bool)
        by_scale = {s: self._fractions(fit, s) for s in config.scales}
        scale = fit_scale(by_scale, config.samples, labels, _middle(config.scales))
        probability = self._fractions(test, scale)
        accuracy = np.mean((by_scale[scale] > 0.5) == labels) if fit else float("nan")
        return ScenarioPredictions(
            scenario=split.scenario,
            protocol=Readout.OBSERVED_SIMULATED,
            trials=test,
            probability=probability,
            train_accuracy=float(accuracy),
            fit_trials=len(fit),
            fold=fold.number,
            fit_labels=describe_labels([self._recorded[trial] for trial in fit]),
            noise_scale=scale,
        )

    def _observe(self, trial: str) -> ObservedTrial:
        opened = self.dataset.trial(trial)
        return cut_trial(opened.scene, opened.trajectory)

    def _run(self, tasks: dict[str, tuple[Cell, SimulationTask, str]]) -> None:
        waiting = {}
        for key, (cell, task, digest) in tasks.items():
            stored = self._read(digest, len(task.samples))
            if stored is None:
                waiting[key] = task
            else:
                self._contact_fractions[cell] = stored
        executor = self.executor if self.executor is not None else SerialExecutor()
        for done, outcome in enumerate(executor.map(run_simulations, waiting), start=1):
            cell, _, digest = tasks[outcome.key]
            if outcome.error is not None:
                self.problems[cell[0]] = outcome.error
            else:
                self._write(digest, outcome.value)
                self._contact_fractions[cell] = float(np.mean(outcome.value))
            if self.progress is not None:
                self.progress("simulations", done, len(waiting))

    def _path(self, digest: str) -> Path | None:
        if self.folder is None:
            return None
        return self.folder / "simulations" / digest[:2] / f"{digest}.json"

    def _read(self, digest: str, samples: int) -> float | None:
        path = self._path(digest)
        if path is None or not path.is_file():
            return None
        try:
            contacts = json.loads(path.read_bytes())["contacts"]
        except (ValueError, KeyError, TypeError):
            return None  # a damaged file is simulated again
        complete = isinstance(contacts, list) and len(contacts) == samples
        return float(np.mean([c is True for c in contacts])) if complete else None

    def _write(self, digest: str, contacts: Iterable[bool]) -> None:
        path = self._path(digest)
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        stored = {"start_frame": LAST_OBSERVED, "contacts": [bool(c) for c in contacts]}
        write_atomic(path, json.dumps(stored).encode())

    def _usable(self, trials: Sequence[str]) -> tuple[str, ...]:
        return tuple(t for t in trials if t not in self.problems)

    def _fractions(self, trials: Sequence[str], scale: float) -> NDArray[np.float64]:
        """Return the fractions (n,) of simulations with a contact."""
        return np.array([self._contact_fractions[trial, scale] for trial in trials], np.float64)


def _middle(scales: Sequence[float]) -> float:
    """Return the scale that is used where there is nothing to fit on."""
    return sorted(scales)[len(scales) // 2]
