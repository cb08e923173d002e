"""Plan of trainings: every model, training protocol, scenario and seed, resumed by repeating it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError
from physion.models.interface import TrainingSettings
from physion.readout.plans.cells import find_task, run_cells
from physion.readout.plans.failures import describe_failure, stop_if_fatal
from physion.readout.plans.keys import code_key, dataset_key, key_of
from physion.readout.plans.model_facts import KnownModels
from physion.readout.plans.records import Records
from physion.readout.plans.selection import ModelChoice, Selection
from physion.readout.plans.speed import Meter, Speed, typical_speed
from physion.readout.plans.tasks import TrainingTask
from physion.readout.trainings import (
    SharedTrainConfig,
    TrainConfig,
    Trainer,
    plan_trainings,
)
from physion.training.loop import TrainingOverrides
from physion.trials.dataset import Dataset

if TYPE_CHECKING:
    from lightning_fabric import Fabric

OnTask = Callable[[TrainingTask, str, Sequence[TrainingTask]], None]
_RUN_ON = ("accelerator", "devices", "nodes", "encoder_batch")
"""Settings of which the weights are independent."""


@dataclass(frozen=True)
class TrainingResults:
    """What a plan has trained.

    - ``trained``: task and fields of its `TrainedModel`, in the order of the plan.
    - ``failed``: task and reason.
    """

    trained: Sequence[tuple[TrainingTask, dict[str, Any]]]
    failed: Sequence[tuple[TrainingTask, str]]


class TrainingPlan:
    """All trainings of a selection, of which those that are done are known from their records.

    Parameters
    ----------
    dataset
        Trials.
    folder
        Output folder of `physion.readout.evaluate.evaluate`.
    selection
        Models, protocols and seeds.
    overrides
        Optimiser and schedule, where they are not to be those of the models.
    shared
        Devices and batches.

    Raises
    ------
    BadInputError
        If there is nothing to train on.
    """

    def __init__(
        self,
        dataset: Dataset,
        folder: Path,
        selection: Selection,
        overrides: TrainingOverrides,
        shared: SharedTrainConfig,
    ) -> None:
        self.dataset, self.overrides, self.shared = dataset, overrides, shared
        self._folder, self._selection = folder, selection
        self._records, self.models = Records(folder, "trainings"), KnownModels(folder)
        overrides.apply(TrainingSettings())  # which refuses values out of range
        self._data = dataset_key(dataset)
        self._trainers: dict[tuple[str, int], Trainer] = {}
        self._fabrics: dict[str, Fabric] = {}
        self.tasks = self._list_tasks()
        read = {task.key: self._records.read(task.key) for task in self.tasks}
        self.done = {key: values for key, values in read.items() if values is not None}

    @property
    def pending(self) -> list[TrainingTask]:
        """Tasks that were not done when the plan was made or run."""
        return [task for task in self.tasks if task.key not in self.done]

    @property
    def is_first_process(self) -> bool:
        """Whether this is the process that writes and prints, of those that train together."""
        return all(fabric.is_global_zero for fabric in self._fabrics.values())

    def run(
        self,
        progress: Progress | None = None,
        on_task: OnTask | None = None,
        *,
        cells: Executor | None = None,
    ) -> TrainingResults:
        """Do the tasks that are not done; one that fails does not stop the others.

        ``on_task`` is called after each with the task, the reason if it failed, and those left.
        With ``cells`` each training is a task of this executor, otherwise they run here.

        Raises
        ------
        PhysionError
            If a model cannot be built or has nothing to train, before anything is trained; if the
            plan has one task and it fails; or if nothing more can be written. On several devices
            every failure ends the run, since the processes would wait for each other.
        """
        pending = self.pending
        for task in {self.models.key(task.choice): task for task in reversed(pending)}.values():
            self._trainer(task)
        trained = {
            key: {**values["trained"], "folder": str(self._folder / values["trained"]["folder"])}
            for key, values in self.done.items()
        }
        failed: dict[str, str] = {}
        if cells is None:
            self._run_here(trained, failed, progress, on_task)
        else:
            self._run_cells(cells, trained, failed, progress, on_task)
        return TrainingResults(
            [(task, trained[task.key]) for task in self.tasks if task.key in trained],
            [(task, failed[task.key]) for task in self.tasks if task.key in failed],
        )

    def _run_here(
        self,
        trained: dict[str, dict[str, Any]],
        failed: dict[str, str],
        progress: Progress | None,
        on_task: OnTask | None,
    ) -> None:
        """Do the pending tasks in this process; add what they gave, and reasons of failures."""
        pending = self.pending
        steps = [self.steps(task) for task in pending]
        for number, task in enumerate(pending):
            within = _within(progress, sum(steps[:number]), sum(steps))
            meter = Meter(self.shared.encoder_batch, within if len(pending) > 1 else progress)
            try:
                trained[task.key] = self._train(task, meter)
            except Exception as error:
                stop_if_fatal(error, self._folder, len(trained), len(self.tasks))
                if len(self.tasks) == 1 or self._several:
                    raise
                failed[task.key] = describe_failure(error)
            if on_task is not None:
                on_task(task, failed.get(task.key, ""), pending[number + 1 :])

    def _run_cells(
        self,
        executor: Executor,
        trained: dict[str, dict[str, Any]],
        failed: dict[str, str],
        progress: Progress | None,
        on_task: OnTask | None,
    ) -> None:
        """Do the pending tasks as tasks of an executor; add what they gave, and failures."""
        pending = self.pending
        folder = self._folder.absolute()
        cells = {
            task.key: TrainingCell(
                self.dataset.folder.absolute(), self.dataset.verify, folder, self._selection,
                self.overrides, self.shared, task.key,
            )
            for task in pending
        }  # fmt: skip
        for key, values in run_cells(
            executor, train_cell, cells, pending, failed, self._folder, len(self.tasks),
            progress, on_task,
        ):  # fmt: skip
            place = Path(values["folder"]).relative_to(folder)
            trained[key] = {**values, "folder": str(self._folder / place)}

    def do(self, key: str) -> dict[str, Any]:
        """Do one task of the plan, or find it done; return the fields of its `TrainedModel`.

        Raises
        ------
        BadInputError
            If the plan has no such task: data, model or code are not those of the plan's maker.
        """
        if key in self.done:
            values = self.done[key]["trained"]
            return {**values, "folder": str(self._folder / values["folder"])}
        task = find_task(self.tasks, key, "training")
        return self._train(task, Meter(self.shared.encoder_batch, None))

    def steps(self, task: TrainingTask) -> int:
        """Return the number of steps of a task."""
        steps = self.overrides.steps
        return steps if steps is not None else self.models.facts(task.choice).steps

    def earlier_speed(self, task: TrainingTask) -> Speed | None:
        """Return the speed of finished trainings of the same model, batch and device, if any."""
        kind = self._speed_key(task.choice)
        known = [v for v in self._earlier if v.get("kind") == kind]
        return typical_speed(v["speed"] for v in known if v.get("speed"))

    @cached_property
    def _earlier(self) -> list[dict[str, Any]]:
        return self._records.all()

    def _list_tasks(self) -> list[TrainingTask]:
        """Return the tasks, seed after seed, so that a whole table is there early."""
        chosen, shared = self._selection, dataclasses.asdict(self.shared)
        inputs = {name: value for name, value in shared.items() if name not in _RUN_ON}
        common = key_of(code_key(), self._data, dataclasses.asdict(self.overrides), inputs)
        tasks = []
        for seed in chosen.seeds:
            sets = [
                (protocol, planned, key_of(dataclasses.asdict(planned)))
                for protocol in chosen.protocols
                for planned in plan_trainings(
                    self.dataset.index,
                    TrainConfig(
                        protocol.value,  # type: ignore[arg-type]
                        chosen.scenario,
                        seed,
                        **shared,
                    ),
                )
            ]
            for choice in chosen.models:
                model = self.models.choice_key(choice)
                tasks += [
                    TrainingTask(
                        choice, protocol, planned, seed,
                        key_of("training", common, model, seed, what),
                    )
                    for protocol, planned, what in sets
                ]  # fmt: skip
        return tasks

    def _trainer(self, task: TrainingTask) -> Trainer:
        """Return the trainer of a model and seed; the last one is kept."""
        key = self.models.key(task.choice), task.seed
        if key not in self._trainers:
            self._trainers.clear()
            model = self.models.build(task.choice, task.seed)
            self._trainers[key] = Trainer(
                self.dataset, model, self._folder, self.overrides, self.shared, self._open_devices
            )
        return self._trainers[key]

    def _open_devices(self, precision: str) -> Fabric:
        """Return the devices; they are opened once, since this starts the other processes."""
        if precision not in self._fabrics:
            if self._fabrics and self._several:
                raise BadInputError("on several devices all models need one precision; set it")
            self._fabrics[precision] = self.shared.open_devices(precision)
        return self._fabrics[precision]

    @property
    def _several(self) -> bool:
        return self.shared.devices * self.shared.nodes > 1

    def _train(self, task: TrainingTask, meter: Meter) -> dict[str, Any]:
        from physion.models.checkpoint import WEIGHTS

        trainer = self._trainer(task)
        result = trainer.train(task.planned, task.seed, meter)
        assert result.folder is not None, "the plan has a folder"
        trained = {**dataclasses.asdict(result), "folder": str(result.folder)}
        trained = {name: None if value != value else value for name, value in trained.items()}
        speed = None if result.loaded else meter.speed
        values: dict[str, Any] = {
            "label": task.label,
            "kind": self._speed_key(task.choice),
            "speed": dataclasses.asdict(speed) if speed is not None else None,
        }
        if trainer.fabric.is_global_zero:
            # The output folder may be moved, or named from another working directory.
            folder = result.folder.relative_to(self._folder).as_posix()
            kept = {**trained, "folder": folder, "loaded": True, "notes": ()}
            stored = {**values, "trained": kept}
            if self.models.record(task.choice):
                self._records.write(task.key, stored, [result.folder / WEIGHTS])
        self._earlier.append(values)
        return trained

    def _speed_key(self, choice: ModelChoice) -> str:
        """Return the key of what the time of a step depends on."""
        settings = [self.overrides.batch, self.overrides.accumulate, self.overrides.precision]
        run_on = dataclasses.asdict(self.shared)
        return key_of("speed", self.models.choice_key(choice), settings, run_on, self._data)


@dataclass(frozen=True)
class TrainingCell:
    """One training of a plan as a task of an executor: arguments of the plan, and the task's key.

    Each process makes the plan again, so that only these few values travel.
    """

    dataset: Path
    verify: bool
    folder: Path
    selection: Selection
    overrides: TrainingOverrides
    shared: SharedTrainConfig
    key: str


def train_cell(cell: TrainingCell) -> dict[str, Any]:
    """Do one training of a plan; return the fields of its `TrainedModel`."""
    dataset = Dataset(cell.dataset, verify=cell.verify)
    plan = TrainingPlan(dataset, cell.folder, cell.selection, cell.overrides, cell.shared)
    return plan.do(cell.key)


def _within(progress: Progress | None, earlier: int, total: int) -> Progress | None:
    """Return the progress of a task within a plan of ``total`` steps, after ``earlier`` ones."""
    if progress is None:
        return None

    def pass_on(what: str, done: int, count: int) -> None:
        if what.startswith("training "):
            progress("plan", earlier + done, total)
            what = "this training"
        progress(what, done, count)

    return pass_on
