"""Training of models on a dataset, by themselves or as a part of an evaluation."""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from physion.clips.clips import whole_source
from physion.clips.source import WholeSource
from physion.compute.tasks import Executor, Progress
from physion.core.errors import MissingExtraError
from physion.models.interface import TrainingSettings
from physion.readout.cells import Cell, Cells, Models, choose_models, open_dataset
from physion.readout.features import FeatureStore
from physion.readout.folds import Fold, select_scenario, training_folds
from physion.readout.settings import HarnessSettings
from physion.trials.dataset import Dataset

if TYPE_CHECKING:
    from lightning_fabric import Fabric

    from physion.training.train import TrainedModel


@dataclass(frozen=True)
class PlannedTraining:
    """Training of a cell: what is trained, and its folder, which is there if it is ``done``."""

    model: str
    name: str
    seed: int
    folder: Path
    done: bool


@dataclass(frozen=True)
class Trainings:
    """What `train` did.

    - ``trained``: one entry for every model, seed and set of trials.
    - ``planned``: the same before anything is trained, of a dry run.
    - ``failed``: reasons of cells that failed, by model, protocol and seed.
    """

    trained: Sequence[TrainedModel]
    planned: Sequence[PlannedTraining]
    failed: Mapping[str, str]


class Trainer:
    """One model with its initial weights, which is trained on one set of trials after the other.

    Parameters
    ----------
    model
        `Learns` and a torch ``Module``.
    source
        Source of clips with the model's ``spec``.
    store
        Store of the features that models are trained on.
    settings
        Optimiser and schedule.
    folder
        Folder of all trainings; None keeps nothing.
    fabric
        Devices.
    progress
        Called after every step.
    """

    def __init__(
        self,
        model: Any,
        source: WholeSource,
        store: FeatureStore,
        settings: TrainingSettings,
        folder: Path | None,
        fabric: Fabric,
        progress: Progress | None = None,
    ) -> None:
        self.model, self.settings, self._folder = model, settings, folder
        self._source, self._store, self._fabric = source, store, fabric
        self._progress = progress if fabric.is_global_zero else None
        self._initial = copy.deepcopy(model.state_dict())

    def train(self, fold: Fold, seed: int) -> TrainedModel:
        """Train the model from its initial weights on the training trials of a fold, in place."""
        from physion.training.train import train_model

        self.restore()
        return train_model(
            self.model,
            self._source,
            fold.train,
            seed=seed,
            name=fold.training.name,
            folder=self._folder,
            settings=self.settings,
            features=self._features,
            fabric=self._fabric,
            progress=self._progress,
        )

    def plan(self, fold: Fold, seed: int) -> PlannedTraining:
        """Return name and folder of a training, and whether it is done."""
        from physion.models.checkpoint import WEIGHTS
        from physion.training.train import training_inputs, training_path

        assert self._folder is not None, "what is planned is kept"
        inputs = training_inputs(self.model, self._source, fold.train, self.settings, seed)
        path = training_path(self._folder, self.model, fold.training.name, inputs)
        model = self.model.provenance().model
        done = (path / WEIGHTS).is_file()
        return PlannedTraining(model, fold.training.name, seed, path, done)

    def restore(self) -> None:
        """Give the model its initial weights again."""
        self.model.load_state_dict(self._initial)

    def _features(self, trials: Sequence[str]) -> NDArray[np.float32]:
        stored = self._store.encoded(self.model, self._source, trials, "whole", self._progress)
        return stored.array()


def train(
    models: Models,
    dataset: Dataset | Path | str,
    out: Path | str = "runs/models",
    *,
    protocols: Sequence[str] | str = ("all",),
    scenario: str = "",
    seeds: int = 1,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    settings: HarnessSettings | None = None,
    devices: int = 1,
    nodes: int = 1,
    executor: Executor | None = None,
    progress: Progress | None = None,
    dry_run: bool = False,
) -> Trainings:
    """Train models without labels, as `evaluate` would, which then finds the results.

    Parameters
    ----------
    models
        Name of a model (``physion ls models``), ``FILE.py:Class``, or a model; or several of them,
        or names with options of their own. Models whose weights ship start from random ones.
    dataset
        Trials, or the path of their folder. The split training is used, or readout where there is
        none, but no trial with the physics of a testing trial.
    out
        Output folder of `evaluate`; each training has a folder in ``training/``, whose name has a
        hash of all that determines the weights. What was trained before is not trained again.
    protocols
        Scenarios that train a model: ``all``, ``all-but`` one, or ``only`` one.
    scenario
        Scenario that all-but leaves out, or the one of only; by default one training for each.
    seeds, seed
        Number of seeds, and the first: of initial weights, folds and batches.
    options
        Fields of the settings of the models, or of their training (`TrainingSettings`).
    settings
        Folds, batches and accelerator.
    devices, nodes
        Devices of each node among which every batch is divided, and nodes, on each of which the
        same command is started, as Lightning describes.
    executor
        Runs the cells of models, protocols and seeds; by default this process, one by one.
    progress
        Called after every step.
    dry_run
        Only say what would be trained, and what is done.

    Returns
    -------
    Trainings
        What was trained, and what failed; one cell that fails does not stop the others.

    Raises
    ------
    BadInputError
        If a model cannot be built or trained, there is no trial to train on, or the only cell
        fails.
    """
    try:
        from physion.training.train import check_trainable
    except ModuleNotFoundError as error:
        raise MissingExtraError("training", "models") from error
    opened = open_dataset(dataset)
    settings = settings if settings is not None else HarnessSettings()
    chosen = choose_models(models, options)
    cells = Cells(chosen, protocols, seeds, seed, lambda _: True, untrained=True)
    for cell in cells.cells:
        if cell.seed == seed:
            check_trainable(cells.model(cell))
            _folds(opened, cell, scenario, settings)
    if executor is not None:  # whose processes may have another working directory
        opened, out = Dataset(opened.folder.absolute(), verify=opened.verify), Path(out).absolute()
    work = _TrainingWork(opened, Path(out), scenario, settings, devices, nodes)

    def here(cell: Cell) -> list[Any]:
        return work.do(cell, cells.model(cell), progress, dry_run=dry_run)

    if devices * nodes > 1 or dry_run:
        # A failure ends the run: the processes on other devices would wait for this one.
        lists = [here(cell) for cell in cells.cells]
        failed: dict[str, str] = {}
    else:
        lists, failed = cells.run(here, work, Path(out), "trainings", executor, progress)
    made = [one for of_cell in lists for one in of_cell]
    return Trainings([], made, failed) if dry_run else Trainings(made, [], failed)


def _folds(dataset: Dataset, cell: Cell, scenario: str, settings: HarnessSettings) -> list[Fold]:
    assert cell.protocol is not None, "all models are trained"
    folds = training_folds(dataset.index, cell.protocol, settings.folds, cell.seed)
    return select_scenario(folds, cell.protocol, scenario)


@functools.cache
def _open_devices(accelerator: str, devices: int, nodes: int, precision: str) -> Any:
    """Return the devices; they are opened once, since this starts the other processes."""
    from physion.training.devices import Devices, make_fabric

    return make_fabric(Devices(accelerator, devices, nodes), precision)


@dataclass(frozen=True)
class _TrainingWork:
    """Function that trains a cell, with all that a process needs for it."""

    dataset: Dataset
    out: Path
    scenario: str
    settings: HarnessSettings
    devices: int
    nodes: int

    def __call__(self, cell: Cell) -> list[Any]:
        model = cell.chosen.build(cell.seed, untrained=True)
        return self.do(cell, model, None)

    def do(
        self,
        cell: Cell,
        model: Any,
        progress: Progress | None,
        *,
        dry_run: bool = False,
    ) -> list[Any]:
        """Train a model on every fold, or only plan it; it has its initial weights afterwards."""
        training = cell.chosen.settings_of(model)
        assert training is not None, "checked before"
        fabric = _open_devices(
            self.settings.accelerator, self.devices, self.nodes, training.precision
        )
        trainer = Trainer(
            model,
            whole_source(self.dataset, model.spec, rendered=self.settings.rendered),
            FeatureStore(self.out / "features", batch=self.settings.encoder_batch),
            training,
            self.out / "training",
            fabric,
            progress,
        )
        folds = _folds(self.dataset, cell, self.scenario, self.settings)
        if dry_run:
            return [trainer.plan(fold, cell.seed) for fold in folds]
        try:
            return [trainer.train(fold, cell.seed) for fold in folds]
        finally:
            trainer.restore()
