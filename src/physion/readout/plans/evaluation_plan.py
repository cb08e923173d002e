"""Plan of evaluations: every model, training protocol, scenario and seed, and all readouts."""

from __future__ import annotations

import dataclasses
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeGuard

from physion.compute.tasks import Executor, Progress
from physion.core.files import is_whole
from physion.readout.folds import plan_folds, select_scenario
from physion.readout.plans.cells import find_task, run_cells
from physion.readout.plans.failures import describe_failure, stop_if_fatal
from physion.readout.plans.keys import code_key, dataset_key, key_of
from physion.readout.plans.model_facts import KnownModels, ModelFacts
from physion.readout.plans.records import Records
from physion.readout.plans.results import StoredEvaluation
from physion.readout.plans.selection import ModelChoice, Selection
from physion.readout.plans.tasks import EvaluationTask
from physion.readout.protocols import Readout
from physion.readout.settings import EvaluationConfig, EvaluationSettings
from physion.training.protocols import Training
from physion.trials.dataset import Dataset

OnTask = Callable[[EvaluationTask, str, Sequence[EvaluationTask]], None]
_RUN_ON = ("accelerator", "encoder_batch")
"""Settings that choose where and how an evaluation runs."""


@dataclass(frozen=True)
class EvaluationResults:
    """What a plan has evaluated.

    - ``evaluated``: tasks and their evaluations, in the order of the plan.
    - ``tables``: one evaluation for each model, protocol and seed; those of single scenarios where
      a task failed.
    - ``failed``: task and reason.
    """

    evaluated: Sequence[tuple[EvaluationTask, StoredEvaluation]]
    tables: Sequence[tuple[EvaluationTask, StoredEvaluation]]
    failed: Sequence[tuple[EvaluationTask, str]]

    @property
    def problems(self) -> Mapping[str, str]:
        """Reasons of the trials without a prediction, by task and trial."""
        return {
            f"{task.label}: {trial}": reason
            for task, evaluation in self.evaluated
            for trial, reason in evaluation.problems.items()
        }


class EvaluationPlan:
    """All evaluations of a selection, of which those that are done are known from their records.

    A model that is not trained is evaluated once.

    Parameters
    ----------
    dataset
        Trials.
    folder
        Output folder.
    selection
        Models, protocols and seeds.
    settings
        Readouts, training and device.
    rollout_errors
        As for `physion.readout.evaluate.evaluate`.
    """

    def __init__(
        self,
        dataset: Dataset,
        folder: Path,
        selection: Selection,
        settings: EvaluationSettings,
        *,
        rollout_errors: bool = False,
    ) -> None:
        self.dataset, self.settings, self.rollout_errors = dataset, settings, rollout_errors
        self._folder, self._selection = folder, selection
        self._records, self.models = Records(folder, "evaluations"), KnownModels(folder)
        self._data = dataset_key(dataset)
        self._built: dict[tuple[str, int], Any] = {}
        self.tasks = self._list_tasks()
        read = {task.key: self._records.read(task.key) for task in self.tasks}
        self.done = {key: values for key, values in read.items() if self._is_valid(values)}

    @property
    def pending(self) -> list[EvaluationTask]:
        """Tasks that were not done when the plan was made."""
        return [task for task in self.tasks if task.key not in self.done]

    def run(
        self,
        executor: Executor | None = None,
        progress: Progress | None = None,
        on_task: OnTask | None = None,
        *,
        cells: Executor | None = None,
    ) -> EvaluationResults:
        """Do the tasks that are not done; one that fails does not stop the others.

        ``on_task`` is called after each with the task, the reason if it failed, and those left.
        With ``cells`` each evaluation is a task of this executor; otherwise they run here, and
        ``executor`` runs their simulations.

        Raises
        ------
        PhysionError
            If the plan has one task and it fails, or if nothing more can be written.
        """
        results = {key: self._stored(values) for key, values in self.done.items()}
        failed: dict[str, str] = {}
        if cells is None:
            self._run_here(executor, results, failed, progress, on_task)
        else:
            self._run_cells(cells, results, failed, progress, on_task)
        return EvaluationResults(
            [(task, results[task.key]) for task in self.tasks if task.key in results],
            self._whole_tables(results),
            [(task, failed[task.key]) for task in self.tasks if task.key in failed],
        )

    def _run_here(
        self,
        executor: Executor | None,
        results: dict[str, StoredEvaluation],
        failed: dict[str, str],
        progress: Progress | None,
        on_task: OnTask | None,
    ) -> None:
        """Do the pending tasks in this process; add their results and reasons of failures."""
        pending = self.pending
        if progress is not None and len(pending) > 1:
            progress("plan", 0, len(pending))
        for number, task in enumerate(pending, start=1):
            try:
                results[task.key] = self._evaluate(task, executor, progress)
            except Exception as error:
                stop_if_fatal(error, self._folder, len(results), len(self.tasks))
                if len(self.tasks) == 1:
                    raise
                failed[task.key] = describe_failure(error)
            if progress is not None and len(pending) > 1:
                progress("plan", number, len(pending))
            if on_task is not None:
                on_task(task, failed.get(task.key, ""), pending[number:])

    def _run_cells(
        self,
        executor: Executor,
        results: dict[str, StoredEvaluation],
        failed: dict[str, str],
        progress: Progress | None,
        on_task: OnTask | None,
    ) -> None:
        """Do the pending tasks as tasks of an executor; add their results and failures."""
        pending = self.pending
        cells = {
            task.key: EvaluationCell(
                self.dataset.folder.absolute(), self.dataset.verify, self._folder.absolute(),
                self._selection, self.settings, self.rollout_errors, task.key,
            )
            for task in pending
        }  # fmt: skip
        for key, values in run_cells(
            executor, evaluate_cell, cells, pending, failed, self._folder, len(self.tasks),
            progress, on_task,
        ):  # fmt: skip
            results[key] = dataclasses.replace(self._stored(values), problems=values["problems"])

    def do(self, key: str) -> dict[str, Any]:
        """Do one task of the plan, or find it done; return the values of its record, and problems.

        Raises
        ------
        BadInputError
            If the plan has no such task: data, model or code are not those of the plan's maker.
        """
        if key in self.done:
            return {**self.done[key], "problems": {}}
        made = self._evaluate(find_task(self.tasks, key, "evaluation"), None, None)
        return {**self._values(made), "problems": dict(made.problems)}

    def expected_seconds(self, task: EvaluationTask) -> float | None:
        """Return the mean time of finished evaluations of the same model; None without any."""
        model = self.models.choice_key(task.choice)
        known = [v["seconds"] for v in self._earlier if v.get("model") == model and v["seconds"]]
        return sum(known) / len(known) if known else None

    @cached_property
    def _earlier(self) -> list[dict[str, Any]]:
        return self._records.all()

    def _list_tasks(self) -> list[EvaluationTask]:
        """Return the tasks, seed after seed, so that a whole table is there early."""
        chosen = self._selection
        sets = {
            (protocol, seed): self._sets(protocol, seed)
            for protocol in chosen.protocols
            for seed in chosen.seeds
        }
        tasks = []
        for seed in chosen.seeds:
            for choice in chosen.models:
                facts = self.models.facts(choice)
                if not self._trains(facts):
                    if seed == chosen.seeds[0] or self.settings.untrained:
                        tasks.append(self._task(choice, Training.ALL, "", "", seed))
                    continue
                for protocol in chosen.protocols:
                    tasks += [
                        self._task(choice, protocol, name, scenario, seed)
                        for name, scenario in sets[protocol, seed]
                    ]
        return tasks

    def _sets(self, protocol: Training, seed: int) -> list[tuple[str, str]]:
        """Return names of the training sets, each with its tested scenario if there is one."""
        folds = plan_folds(self.dataset.index, protocol, self.settings.folds, seed)
        names = [fold.training.name for fold in folds]
        kept = select_scenario(names, protocol, self._selection.scenario)
        tested = {names[k]: folds[k].training.tested for k in kept}
        one = protocol is not Training.ALL
        return [(name, scenarios[0] if one else "") for name, scenarios in tested.items()]

    def _trains(self, facts: ModelFacts) -> bool:
        """Return whether an evaluation trains the model, so that protocol and seed matter."""
        if not facts.learns or facts.trained or self.settings.untrained:
            return False
        readouts = self.settings.readouts
        needs_dynamics = not readouts or Readout.OBSERVED_SIMULATED.value in readouts
        return facts.diet != "features" or needs_dynamics

    @cached_property
    def _inputs(self) -> str:
        """Key of what all tasks depend on: code, data and settings."""
        inputs = {
            name: value
            for name, value in dataclasses.asdict(self.settings).items()
            if name not in _RUN_ON
        }
        return key_of(code_key(), self._data, inputs, self.rollout_errors)

    def _task(
        self, choice: ModelChoice, protocol: Training, name: str, scenario: str, seed: int
    ) -> EvaluationTask:
        what = [self.models.choice_key(choice), protocol.value, name, scenario, seed]
        key = key_of("evaluation", self._inputs, what)
        return EvaluationTask(choice, protocol, name, scenario, seed, key)

    def _model(self, task: EvaluationTask) -> Any:
        """Return the model of a task with its seed; the last one is kept."""
        key = self.models.choice_key(task.choice), task.seed
        if key not in self._built:
            self._built.clear()
            self._built[key] = self.models.build(task.choice, task.seed)
        return self._built[key]

    def _evaluate(
        self, task: EvaluationTask, executor: Executor | None, progress: Progress | None
    ) -> StoredEvaluation:
        start = time.perf_counter()
        evaluation = self._ask(task, task.scenario, executor, progress)
        if not evaluation.problems and self.models.record(task.choice):
            self._record(task.key, task, evaluation, time.perf_counter() - start)
        return evaluation

    def _record(
        self, key: str, task: EvaluationTask, evaluation: StoredEvaluation, seconds: float
    ) -> None:
        known = {"label": task.label, "model": self.models.choice_key(task.choice)}
        values = {**known, "seconds": seconds, **self._values(evaluation)}
        self._records.write(key, values, [self._folder / name for name in values["files"]])

    def _values(self, evaluation: StoredEvaluation) -> dict[str, Any]:
        """Return the JSON values from which `_stored` makes an evaluation without problems."""
        paths = [path for path in (evaluation.path, evaluation.rollout_errors) if path is not None]
        return {
            "files": [path.relative_to(self._folder).as_posix() for path in paths],
            "count": evaluation.count,
            "scores": list(evaluation.scores),
        }

    def _ask(
        self,
        task: EvaluationTask,
        scenario: str,
        executor: Executor | None = None,
        progress: Progress | None = None,
    ) -> StoredEvaluation:
        config = EvaluationConfig(
            **{f.name: getattr(self.settings, f.name) for f in dataclasses.fields(self.settings)},
            training=task.protocol.value,
            scenario=scenario,
            seed=task.seed,
        )
        # Imported late: a plan that is done needs none of the libraries of models and movies.
        from physion.readout.evaluate import evaluate_model

        evaluation = evaluate_model(
            self.dataset,
            self._model(task),
            self._folder,
            config=config,
            rollout_errors=self.rollout_errors,
            executor=executor,
            progress=progress,
        )
        return StoredEvaluation.of(evaluation)

    def _is_valid(self, values: Mapping[str, Any] | None) -> TypeGuard[Mapping[str, Any]]:
        """Return whether there is a record, and its tables have their SHA-256."""
        return values is not None and all(is_whole(self._folder / n) for n in values["files"])

    def _stored(self, values: Mapping[str, Any]) -> StoredEvaluation:
        path, *errors = (self._folder / name for name in values["files"])
        of_motion = errors[0] if errors else None
        return StoredEvaluation(path, {}, of_motion, values["count"], values["scores"])

    def _whole_tables(
        self, results: Mapping[str, StoredEvaluation]
    ) -> list[tuple[EvaluationTask, StoredEvaluation]]:
        """Join the tables of single scenarios, where all of a protocol are there and complete."""
        groups: dict[tuple[str, str, int], list[EvaluationTask]] = defaultdict(list)
        for task in self.tasks:
            groups[self.models.choice_key(task.choice), task.protocol.value, task.seed].append(task)
        tables = []
        for tasks in groups.values():
            complete = all(t.key in results and not results[t.key].problems for t in tasks)
            if complete and tasks[0].scenario and not self._selection.scenario:
                tables.append((tasks[0], self._joined(tasks)))
            else:
                tables += [(task, results[task.key]) for task in tasks if task.key in results]
        return tables

    def _joined(self, tasks: Sequence[EvaluationTask]) -> StoredEvaluation:
        key = key_of("joined", [task.key for task in tasks])
        values = self._records.read(key)
        if self._is_valid(values):
            return self._stored(values)
        joined = self._ask(tasks[0], "")
        self._record(key, tasks[0], joined, 0.0)
        return joined


@dataclass(frozen=True)
class EvaluationCell:
    """One evaluation of a plan as a task of an executor: arguments of the plan, and its key."""

    dataset: Path
    verify: bool
    folder: Path
    selection: Selection
    settings: EvaluationSettings
    rollout_errors: bool
    key: str


def evaluate_cell(cell: EvaluationCell) -> dict[str, Any]:
    """Do one evaluation of a plan; return what `EvaluationPlan.do` returns."""
    dataset = Dataset(cell.dataset, verify=cell.verify)
    errors = cell.rollout_errors
    plan = EvaluationPlan(
        dataset, cell.folder, cell.selection, cell.settings, rollout_errors=errors
    )
    return plan.do(cell.key)
