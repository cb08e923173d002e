"""Answers of `noisy-simulation`: its noise level is fitted where others fit a readout."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physion.atomic import write_atomic
from physion.compute.executor import Executor
from physion.compute.local import SerialExecutor
from physion.errors import BadInputError
from physion.models.noisy_simulation import (
    LAST_OBSERVED,
    NoisySimulation,
    Question,
    Task,
    ask,
    fit_scale,
    run_task,
)
from physion.readout.folds import Asked, Round
from physion.readout.protocols import Readout
from physion.readout.table import Answers
from physion.trials.dataset import Dataset

Progress = Callable[[str, int, int], None]
Cell = tuple[str, float]
"""A trial at a noise level."""


@dataclass
class SimulationReadout:
    """Simulates every trial at every noise level once, then fits the level round by round.

    Finished trials are kept under ``folder/simulations`` by the hash of all that decides them, so
    a second run, or one that was killed, does not simulate them again. A trial whose simulation
    fails is left out of the answers and named in ``problems``.
    """

    dataset: Dataset
    model: NoisySimulation
    folder: Path | None
    executor: Executor | None = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        self.problems: dict[str, str] = {}
        self._shares: dict[Cell, float] = {}
        index = self.dataset.index
        # An outcome recorded elsewhere is fitted first: against its own engine's outcomes the
        # model would always do best without noise.
        truth = index["recorded_contact"].fillna(index["contact"])
        self._labels = dict(zip(index["trial"], truth.astype(bool), strict=True))

    def prepare(self, rounds: Sequence[Round]) -> None:
        """Simulate all trials of ``rounds`` at all levels that they need."""
        trials = {t: None for r in rounds for a in r.asked for t in (*a.fit, *a.test)}
        config = self.model.config
        tasks: dict[str, tuple[Cell, Task, str]] = {}
        for trial in trials:
            try:
                question = self._question(trial)
            except BadInputError as error:
                self.problems[trial] = str(error)
                continue
            for scale in config.scales:
                task = self.model.task(question, scale)
                tasks[f"{trial} x{scale:g}"] = ((trial, scale), task, task.digest())
        self._run(tasks)

    def answers(self, round_: Round) -> list[Answers]:
        """All predictions of a round; its noise levels come from its fit trials alone."""
        return [self._answer(round_, asked) for asked in round_.asked]

    def _answer(self, round_: Round, asked: Asked) -> Answers:
        config = self.model.config
        fit, test = self._usable(asked.fit), self._usable(asked.test)
        labels = np.array([self._labels[t] for t in fit], bool)
        by_scale = {s: self._of(fit, s) for s in config.scales}
        scale = fit_scale(by_scale, config.samples, labels, _middle(config.scales))
        probability = self._of(test, scale)
        accuracy = np.mean((by_scale[scale] > 0.5) == labels) if fit else float("nan")
        return Answers(
            scenario=asked.scenario,
            protocol=Readout.OBSERVED_SIMULATED,
            trials=test,
            probability=probability,
            train_accuracy=float(accuracy),
            fit_trials=len(fit),
            fold=round_.fold,
            noise_scale=scale,
        )

    def _question(self, trial: str) -> Question:
        opened = self.dataset.trial(trial)
        return ask(opened.scene, opened.trajectory)

    def _run(self, tasks: dict[str, tuple[Cell, Task, str]]) -> None:
        waiting = {}
        for key, (cell, task, digest) in tasks.items():
            stored = self._read(digest, len(task.samples))
            if stored is None:
                waiting[key] = task
            else:
                self._shares[cell] = stored
        executor = self.executor if self.executor is not None else SerialExecutor()
        for done, outcome in enumerate(executor.map(run_task, waiting), start=1):
            cell, _, digest = tasks[outcome.key]
            if outcome.error is not None:
                self.problems[cell[0]] = outcome.error
            else:
                self._write(digest, outcome.value)
                self._shares[cell] = float(np.mean(outcome.value))
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
        right = isinstance(contacts, list) and len(contacts) == samples
        return float(np.mean([c is True for c in contacts])) if right else None

    def _write(self, digest: str, contacts: Iterable[bool]) -> None:
        path = self._path(digest)
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        story = {"start_frame": LAST_OBSERVED, "contacts": [bool(c) for c in contacts]}
        write_atomic(path, json.dumps(story).encode())

    def _usable(self, trials: Sequence[str]) -> tuple[str, ...]:
        return tuple(t for t in trials if t not in self.problems)

    def _of(self, trials: Sequence[str], scale: float) -> NDArray[np.float64]:
        return np.array([self._shares[trial, scale] for trial in trials], np.float64)


def _middle(scales: Sequence[float]) -> float:
    """The scale to take where there is nothing to fit on."""
    return sorted(scales)[len(scales) // 2]
