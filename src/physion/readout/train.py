"""Training of models on a dataset, by themselves or as a part of an evaluation."""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from physion.clips.clips import whole_source
from physion.clips.source import Part, WholeSource
from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError, MissingExtraError
from physion.models.interface import TrainingSettings, ask
from physion.readout.features import FeatureRow, FeatureStore
from physion.readout.folds import Fold, Protocol, select_scenario, training_folds
from physion.readout.settings import (
    Cell,
    Models,
    TrainSettings,
    choose_models,
    open_dataset,
    plan_cells,
    run_cells,
    runner_of_cells,
)
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


@dataclass(eq=False)
class Trainer:
    """One model with its initial weights, which is trained on one set of trials after the other.

    - ``source``: clips with the model's `Spec`. ``store``: features that models are trained on.
      ``index``: of the dataset.
    - ``settings``: optimiser and schedule. ``folder``: of all trainings. ``fabric``: devices.
    - ``progress``: called after every step.
    """

    model: Any
    source: WholeSource
    store: FeatureStore
    index: pd.DataFrame
    settings: TrainingSettings
    folder: Path
    fabric: Fabric
    progress: Progress | None = None

    def __post_init__(self) -> None:
        self._initial = copy.deepcopy(self.model.state_dict())
        if not self.fabric.is_global_zero:
            self.progress = None

    def train(self, fold: Fold, seed: int) -> TrainedModel:
        """Train the model from its initial weights on the training trials of a fold, in place."""
        from physion.training.train import train_model

        self.restore()
        return train_model(
            self.model,
            self.source,
            fold.train,
            seed=seed,
            name=fold.training.name,
            folder=self.folder,
            settings=self.settings,
            features=self._features,
            outcomes=self._outcomes(),
            fabric=self.fabric,
            progress=self.progress,
        )

    def plan(self, fold: Fold, seed: int) -> PlannedTraining:
        """Return name and folder of a training, and whether it is done."""
        from physion.models.checkpoint import WEIGHTS
        from physion.training.train import training_inputs, training_path

        inputs = training_inputs(
            self.model, self.source, fold.train, self.settings, seed, self._outcomes()
        )
        path = training_path(self.folder, self.model, fold.training.name, inputs)
        model = self.model.provenance().model
        done = (path / WEIGHTS).is_file()
        return PlannedTraining(model, fold.training.name, seed, path, done)

    def restore(self) -> None:
        """Give the model its initial weights again."""
        self.model.load_state_dict(self._initial)

    def _features(self, trials: Sequence[str]) -> Sequence[FeatureRow]:
        part: Part = "context" if ask(self.model, "learns_outcomes") else "whole"
        stored = self.store.encoded(self.model, self.source, trials, part, self.progress)
        return stored.by_trial()

    def _outcomes(self) -> Mapping[str, bool] | None:
        """Return the outcomes that are known: recorded ones, else simulated ones."""
        if not ask(self.model, "learns_outcomes"):
            return None
        recorded = self.index["recorded_contact"]
        outcomes = recorded.where(recorded.notna(), self.index["contact"])
        pairs = zip(self.index["trial"], outcomes, strict=True)
        return {str(trial): bool(value) for trial, value in pairs if not pd.isna(value)}


def train(
    models: Models,
    dataset: Dataset | Path | str,
    out: Path | str = "runs/models",
    settings: TrainSettings | None = None,
    *,
    options: Mapping[str, Any] | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    dry_run: bool = False,
    **changes: Any,
) -> Trainings:
    """Train models as `evaluate` would, which then finds the results.

    No outcome of a trial is used, but by models that learn them (``learns_outcomes``).

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
    settings
        Protocols, seeds, folds and devices.
    options
        Fields of the settings of the models, or of their training (`TrainingSettings`).
    executor
        Runs the trainings, each a task, but on this machine one runs after the other in this
        process, as by default (`runner_of_cells`).
    progress
        Called after every step.
    dry_run
        Only say what would be trained, and what is done.
    **changes
        Fields of `TrainSettings` to replace in ``settings``, such as ``seeds=3``.

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

    def trains(model: Any) -> bool:
        check_trainable(model)
        return True

    settings = dataclasses.replace(settings or TrainSettings(), **changes)
    executor = runner_of_cells(executor)
    cells = plan_cells(choose_models(models, options), settings, trains, untrained=True)
    out = Path(out) if executor is None else Path(out).absolute()
    work = _Train(open_dataset(dataset, executor), out, settings)
    for cell in cells:
        work.folds(cell)  # which refuses a dataset without the trials that are needed
    if dry_run:
        planned = [one for cell in cells for one in work(cell, dry_run=True)]
        return Trainings([], planned, {})
    failed: dict[str, str] = {}
    if settings.devices * settings.nodes > 1:
        # A failure ends the run: the processes on other devices would wait for this one.
        lists = [work(cell, progress) for cell in cells]
    else:
        do = work if executor is not None else functools.partial(work, progress=progress)
        lists, failed = run_cells(cells, do, out, "trainings", executor, progress)
    return Trainings([one for of_cell in lists for one in of_cell], [], failed)


@functools.cache
def _open_devices(accelerator: str, devices: int, nodes: int, precision: str) -> Any:
    """Return the devices; they are opened once, since this starts the other processes."""
    from physion.training.devices import Devices, make_fabric

    return make_fabric(Devices(accelerator, devices, nodes), precision)


@dataclass(frozen=True)
class _Train:
    """Function that trains a cell, with all that a process needs for it."""

    dataset: Dataset
    out: Path
    settings: TrainSettings

    def __call__(
        self, cell: Cell, progress: Progress | None = None, *, dry_run: bool = False
    ) -> list[Any]:
        """Train a model on every fold, or only plan it; it has its initial weights afterwards."""
        model, settings = cell.take_model(), self.settings
        training = cell.chosen.settings_of(model)
        assert training is not None, "checked before"
        trainer = Trainer(
            model,
            whole_source(self.dataset, model.spec, rendered=settings.rendered),
            FeatureStore(self.out / "features", batch=settings.encoder_batch),
            self.dataset.index,
            training,
            self.out / "training",
            _open_devices(
                settings.accelerator, settings.devices, settings.nodes, training.precision
            ),
            progress,
        )
        do = trainer.plan if dry_run else trainer.train
        try:
            return [do(fold, cell.seed) for fold in self.folds(cell)]
        finally:
            trainer.restore()

    def folds(self, cell: Cell) -> list[Fold]:
        """Return the folds whose dynamics are trained."""
        assert cell.protocol is not None, "all models are trained"
        index, settings = self.dataset.index, self.settings
        if settings.scenario and cell.protocol is Protocol.ALL:
            raise BadInputError("a scenario needs the protocol all-but, only or one")
        # Of all that one trains, only the scenario itself is asked for.
        one = cell.protocol is Protocol.ONE and settings.scenario
        protocol = Protocol.ONLY if one else cell.protocol
        folds = training_folds(index, protocol, settings.folds, cell.seed)
        return select_scenario(folds, settings.scenario)
