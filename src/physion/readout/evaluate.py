"""Evaluation of models on a dataset: predictions of every testing trial.

What is done is known from the name of the table, which holds a hash of all its inputs.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from physion.clips.batch import Provenance
from physion.compute.local import LocalExecutor, SerialExecutor
from physion.compute.tasks import Executor, Progress, tracked
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import is_whole
from physion.core.version import __version__
from physion.models.interface import Model, TrainingSettings, ask, can
from physion.readout.cells import Cell, Cells, Models, choose_models, open_dataset
from physion.readout.decisions import Readout, decisions
from physion.readout.folds import Fold, Protocol, plan_folds, select_scenario
from physion.readout.model_calls import check_identity, is_network
from physion.readout.predictor import Predictor, Way, choose_readouts
from physion.readout.rollout_error import check_moves_objects, rollout_error
from physion.readout.settings import EvaluationSettings
from physion.readout.tables import (
    ScenarioPredictions,
    file_name,
    make_table,
    read_table,
    summarise_accuracy,
    write_table,
)
from physion.trials.dataset import Dataset

NOTHING_TO_FIT = "no trial to fit|one answer only"
"""Notes of `physion.readout.logistic.fit_readout` where it predicts the base rate."""
_VERSION = 6
"""To be increased with every change that can alter the table of an evaluation."""
_NOT_HASHED = ("encoder_batch", "accelerator")
"""Settings of where and how an evaluation runs."""


@dataclass(frozen=True)
class EvaluatedModel:
    """A model under one training protocol with one seed.

    - ``model``, ``protocol``, ``seed``: which; ``protocol`` is empty if it was not trained.
    - ``path``: table of predictions. ``rollout_errors``: errors of imagined motion, if asked for.
    - ``done``: whether the table was there before.
    - ``problems``: reasons of trials without a prediction, by name.
    """

    model: str
    protocol: str
    seed: int
    path: Path
    rollout_errors: Path | None
    done: bool
    problems: Mapping[str, str]


@dataclass(frozen=True)
class Evaluation:
    """What `evaluate` did.

    - ``evaluated``: one entry for every model, training protocol and seed.
    - ``failed``: reasons of those that failed, by model, protocol and seed.
    """

    evaluated: Sequence[EvaluatedModel]
    failed: Mapping[str, str]

    @property
    def paths(self) -> list[Path]:
        """Tables of predictions."""
        return [one.path for one in self.evaluated]

    @cached_property
    def predictions(self) -> pd.DataFrame:
        """All predictions, with the columns `physion.readout.tables.COLUMNS`."""
        tables = [read_table(path) for path in self.paths]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    @property
    def scores(self) -> pd.DataFrame:
        """Accuracies, as mean and spread over seeds (`summarise_accuracy`)."""
        return summarise_accuracy(self.predictions)

    @property
    def warnings(self) -> list[str]:
        """What predictions are not, in sentences: those without a trial to fit a readout on."""
        if self.predictions.empty:
            return []
        unfit = self.predictions[self.predictions["note"].str.contains(NOTHING_TO_FIT)]
        return [
            f"{model}, readout {readout}: {len(rows)} predictions are the same number, since "
            f"the readout had {reason}; add trials of the split readout with both outcomes"
            for (model, readout, reason), rows in unfit.groupby(["model", "readout", "note"])
        ]

    @property
    def problems(self) -> dict[str, str]:
        """Reasons of the trials without a prediction, by model and trial."""
        return {
            f"{one.model}: {trial}": reason
            for one in self.evaluated
            for trial, reason in one.problems.items()
        }


def evaluate(
    models: Models,
    dataset: Dataset | Path | str,
    out: Path | str = "runs/models",
    *,
    protocols: Sequence[str] | str = ("all",),
    scenario: str = "",
    seeds: int = 1,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    settings: EvaluationSettings | None = None,
    rollout_errors: bool = False,
    executor: Executor | None = None,
    progress: Progress | None = None,
    dry_run: bool = False,
) -> Evaluation:
    """Train models and their readouts, and predict every testing trial of a dataset.

    Parameters
    ----------
    models
        Name of a model (``physion ls models``), ``FILE.py:Class``, or a model; or several of them,
        or names with options of their own. Models with trained weights are not trained again.
    dataset
        Trials of the splits testing, readout and training, or the path of their folder. Without
        readout trials the testing trials are cross-validated.
    out
        Output folder. Tables go to ``predictions/<model>-<hash>.csv``, caches to ``features/`` and
        ``training/``. A table whose inputs are the same is not made again.
    protocols
        Scenarios that train a model: ``all``, ``all-but`` the tested one, or ``only`` the tested
        one. A model that is not trained is evaluated once. Weights that ship belong to ``all``;
        under the other protocols such a model is trained from random weights.
    scenario
        Tested scenario, under all-but and only; by default all of them.
    seeds, seed
        Number of seeds, and the first: of initial weights, folds and training.
    options
        Fields of the settings of the models, or of their training (`TrainingSettings`).
    settings
        Readouts, decision, cross-validation and device.
    rollout_errors
        Also write the errors of imagined motion over time (`rollout_error`) to
        ``rollout-errors/``, in a file of the same name; for models that move objects.
    executor
        A `LocalExecutor` runs the simulations of one evaluation after the other; any other runs the
        evaluations, each a task. By default all run in this process.
    progress
        Called after every finished item.
    dry_run
        Only say what would be evaluated, and what is done.

    Returns
    -------
    Evaluation
        Tables, accuracies, and what failed; one evaluation that fails does not stop the others.

    Raises
    ------
    UnknownNameError
        For an unknown model, option, protocol, readout or decision; the message names the closest.
    BadInputError
        If a model cannot be built, or the only evaluation fails: a readout does not fit the model,
        the model raises or returns something wrong, or no trial could be predicted.
    """
    opened = open_dataset(dataset)
    settings = settings if settings is not None else EvaluationSettings()
    for name in settings.readouts:
        Readout.named(name)
    if settings.decision:
        decisions.get(settings.decision)

    def trains(model: Any) -> bool:
        return _is_trained(model, settings)

    cells = Cells(
        choose_models(models, options),
        protocols,
        seeds,
        seed,
        trains,
        every_seed=settings.untrained,
    )
    elsewhere: Executor | None = None
    if executor is not None and not isinstance(executor, LocalExecutor | SerialExecutor):
        # Its processes may have another working directory.
        opened, out = Dataset(opened.folder.absolute(), verify=opened.verify), Path(out).absolute()
        elsewhere, executor = None if dry_run else executor, None
    work = _EvaluationWork(opened, Path(out), scenario, settings, rollout_errors)

    def here(cell: Cell) -> EvaluatedModel:
        job = work.job(cell, cells.model(cell), executor, progress)
        return job.planned() if dry_run else job.do()

    evaluated, failed = cells.run(here, work, Path(out), "evaluations", elsewhere, progress)
    return Evaluation(evaluated, failed)


def _is_trained(model: Any, settings: EvaluationSettings) -> bool:
    """Return whether an evaluation trains a model, so that protocol and seed matter."""
    if settings.untrained or not (is_network(model) and can(model, "loss")):
        return False
    if ask(model, "trained"):
        return False
    # What is trained on features predicts features, which the other readouts do not need.
    needed = not settings.readouts or Readout.OBSERVED_SIMULATED.value in settings.readouts
    return ask(model, "learns_from") != "features" or needed


@dataclass(frozen=True)
class _EvaluationWork:
    """Function that evaluates a cell, with all that a process needs for it."""

    dataset: Dataset
    out: Path
    scenario: str
    settings: EvaluationSettings
    rollout_errors: bool

    def __call__(self, cell: Cell) -> EvaluatedModel:
        model = cell.chosen.build(cell.seed, untrained=cell.untrained)
        return self.job(cell, model, None, None).do()

    def job(
        self,
        cell: Cell,
        model: Any,
        executor: Executor | None,
        progress: Progress | None,
    ) -> _Job:
        """Return the evaluation of a cell with its model."""
        return _Job(
            model=model,
            protocol=cell.protocol,
            seed=cell.seed,
            training=cell.chosen.settings_of(model) if cell.protocol is not None else None,
            work=self,
            executor=executor,
            progress=progress,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Job:
    """Evaluation of a built model under one protocol with one seed."""

    model: Model
    protocol: Protocol | None
    seed: int
    training: TrainingSettings | None
    work: _EvaluationWork
    executor: Executor | None
    progress: Progress | None

    @cached_property
    def ways(self) -> dict[Readout, Way]:
        """Readouts, and the way of each."""
        settings = self.work.settings
        return choose_readouts(self.model, settings.readouts, settings.decision)

    def planned(self) -> EvaluatedModel:
        """Return where the table is, or will be."""
        name = self._name  # which checks what the model says of itself
        path = self._path()
        errors = self.work.out / "rollout-errors" / path.name if self.work.rollout_errors else None
        if errors is not None:
            check_moves_objects(self.model)
        done = is_whole(path) and (errors is None or is_whole(errors))
        protocol = self.protocol.value if self.protocol is not None else ""
        return EvaluatedModel(name, protocol, self.seed, path, errors, done, {})

    def do(self) -> EvaluatedModel:
        """Predict every testing trial, unless that is done."""
        planned = self.planned()
        if planned.done:
            return planned
        settings = self.work.settings
        folds = self._folds()
        predictor = Predictor(
            self.work.dataset,
            self.model,
            self.ways,
            settings,
            training=self.training,
            protocol=self.protocol,
            seed=self.seed,
            folder=self.work.out,
            executor=self.executor,
            progress=self.progress,
        )
        predictions: list[ScenarioPredictions] = []
        errors: list[pd.DataFrame] = []
        try:
            for fold in tracked(folds, "folds", len(folds), self.progress):
                predictions += predictor.predict(fold)
                if self.work.rollout_errors:
                    # Now, since the model has the weights that were trained for this fold.
                    tested = [t for split in fold.scenarios for t in split.test]
                    known = [t for t in tested if t not in predictor.problems]
                    errors.append(
                        rollout_error(self.work.dataset, self.model, known, progress=self.progress)
                    )
        finally:
            predictor.restore()
        table = make_table(predictions, self._provenance, self.work.dataset.index)
        if table.empty:
            reason = next(iter(predictor.problems.values()), "there is no trial to predict")
            raise BadInputError(f"{self._name} predicts no trial: {reason}")
        path, of_motion = planned.path, planned.rollout_errors
        if predictor.problems:
            # Another name than a complete table has, so that the next run retries these trials.
            path = path.with_suffix(".partial.csv")
        write_table(table, path)
        if of_motion is not None:
            of_motion = of_motion.with_name(path.name)
            write_table(pd.concat(errors, ignore_index=True).round(6), of_motion)
        return dataclasses.replace(
            planned, path=path, rollout_errors=of_motion, problems=dict(predictor.problems)
        )

    def _folds(self) -> list[Fold]:
        """Return the folds; of a model that is not trained, with the chosen scenario only."""
        folds_of, scenario = self.work.settings.folds, self.work.scenario
        if self.protocol is not None:
            folds = plan_folds(self.work.dataset.index, self.protocol, folds_of, self.seed)
            return select_scenario(folds, self.protocol, scenario)
        folds = plan_folds(self.work.dataset.index, Protocol.ALL, folds_of, self.seed)
        if not scenario:
            return folds
        known = {split.scenario for fold in folds for split in fold.scenarios}
        if scenario not in known:
            raise UnknownNameError("scenario of the dataset", scenario, known)
        return [
            dataclasses.replace(
                fold, scenarios=tuple(s for s in fold.scenarios if s.scenario == scenario)
            )
            for fold in folds
        ]

    @cached_property
    def _provenance(self) -> Provenance:
        """Provenance of the model, with the inputs of its `Spec` if it names no others."""
        known = check_identity(self.model)
        return dataclasses.replace(known, inputs=known.inputs or ", ".join(self.model.spec.inputs))

    @property
    def _name(self) -> str:
        return self._provenance.model

    def _path(self) -> Path:
        """Return the table, named by a hash of trials, labels, model, settings and code."""
        settings = dataclasses.asdict(self.work.settings)
        settings |= {"readouts": [r.value for r in self.ways], "scenario": self.work.scenario}
        settings |= {"protocol": self.protocol and self.protocol.value, "seed": self.seed}
        options = dataclasses.asdict(chosen) if (chosen := ask(self.model, "settings")) else {}
        training = dataclasses.asdict(self.training) if self.training is not None else {}
        kept = {name: value for name, value in settings.items() if name not in _NOT_HASHED}
        provenance = dataclasses.asdict(self._provenance)
        return table_path(
            self.work.out,
            self._name,
            [_VERSION, __version__, kept, provenance, options, training, self.model.digest()],
            self.work.dataset.index,
        )


def table_path(out: Path, model: str, inputs: Iterable[Any], index: pd.DataFrame) -> Path:
    """Return the path of a table of predictions, whose name has a hash of all its inputs."""
    columns = ["trial", "scenario", "split", "contact", "digest", "movie_sha256"]
    columns += ["observed_movie_sha256", "recorded_contact", "observed_contact"]
    sha = hashlib.sha256(json.dumps(list(inputs), sort_keys=True, default=str).encode())
    sha.update(index[columns].to_csv(index=False).encode())
    return out / "predictions" / f"{file_name(model)}-{sha.hexdigest()[:12]}.csv"
