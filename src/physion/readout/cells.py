"""Cells of an evaluation or training: every model, training protocol and seed.

Settings of a model and of its training are options of the model: ``options={"steps": 500}``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from physion.compute.local import SerialExecutor
from physion.compute.run_tasks import run_tasks
from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError, PhysionError
from physion.core.settings import field_types, read_settings
from physion.models.build import build_model, build_untrained, option_names
from physion.models.interface import Model, TrainingSettings, ask, can
from physion.models.user_files import is_file_name
from physion.readout.folds import Protocol
from physion.readout.model_calls import is_network
from physion.trials.dataset import Dataset

R = TypeVar("R")

Models = str | Model | Sequence[str | Model] | Mapping[str, Mapping[str, Any]]
"""Models by name, ``FILE.py:Class``, or built: one or several; or names with options of their own.
"""


SEED, WEIGHTS = "seed", "weights"
"""Options of models: seed of the initial weights, and trained weights."""


@dataclass(frozen=True, eq=False)
class ChosenModel:
    """Model of an evaluation or training, and the options that a user sets.

    - ``model``: its name, or the model itself. ``options``: fields of its settings.
    - ``training``: fields of `TrainingSettings` that replace the model's.
    """

    model: str | Model
    options: Mapping[str, Any]
    training: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name in messages."""
        return self.model if isinstance(self.model, str) else self.model.provenance().model

    def build(self, seed: int, *, untrained: bool = False) -> Any:
        """Return the model; ``seed``: of its initial weights if it has one.

        With ``untrained``, a model whose weights ship starts from random ones.
        """
        if not isinstance(self.model, str):
            return self.model
        options = dict(self.options)
        if SEED in option_names(self.model):
            options.setdefault(SEED, seed)
        return (build_untrained if untrained else build_model)(self.model, **options)

    def comes_trained(self, model: Any) -> bool:
        """Return whether a built model has trained weights that the user did not ask for."""
        named = isinstance(self.model, str) and WEIGHTS not in self.options
        return named and can(model, "loss") and bool(ask(model, "trained"))

    def settings_of(self, model: Any) -> TrainingSettings | None:
        """Return the settings of the training of a built model; None if it does not learn."""
        if not (is_network(model) and can(model, "loss")):
            return None
        own: TrainingSettings = ask(model, "training_settings")
        return dataclasses.replace(own, **self.training)


def choose_models(models: Models, options: Mapping[str, Any] | None = None) -> list[ChosenModel]:
    """Return the models of an evaluation or training, each with its options.

    Parameters
    ----------
    models
        Models, or names with options of their own.
    options
        Options of every model: fields of its settings, or of `TrainingSettings`.

    Raises
    ------
    BadInputError
        If there is no model, an option has a wrong type, or a model that is built gets options that
        do not belong to a training.
    """
    own: Mapping[Any, Mapping[str, Any]] = models if isinstance(models, Mapping) else {}
    listed = [models] if isinstance(models, str) or hasattr(models, "provenance") else list(models)
    if not listed:
        raise BadInputError("no model is named")
    given = {**(options or {})}
    return [_choose(model, {**given, **(own[model] if own else {})}) for model in listed]


def _choose(model: Any, options: Mapping[str, Any]) -> ChosenModel:
    kinds = field_types(TrainingSettings)
    # An argument of a user's class may have the name of a setting of the training.
    own = option_names(model) if isinstance(model, str) and is_file_name(model) else ()
    training = {
        name: read_settings(kinds[name], v, f"option {name} of the training")
        for name, v in options.items()
        if name in kinds and name not in own
    }
    TrainingSettings(**training)  # which refuses values out of range
    rest = {name: value for name, value in options.items() if name not in training}
    if rest and not isinstance(model, str):
        raise BadInputError("options are for a model that is given by its name; this one is built")
    return ChosenModel(model, rest, training)


def open_dataset(dataset: Dataset | Path | str) -> Dataset:
    """Return the dataset, which may be given as the path of its folder."""
    return Dataset(Path(dataset)) if isinstance(dataset, str | Path) else dataset


@dataclass(frozen=True, eq=False)
class Cell:
    """A model with a training protocol and a seed.

    ``protocol`` is None if the model is not trained. ``untrained``: its weights ship, but the
    training starts from random ones.
    """

    chosen: ChosenModel
    protocol: Protocol | None
    seed: int
    untrained: bool = False

    @property
    def label(self) -> str:
        """Model, protocol and seed, as text."""
        protocol = f", {self.protocol.value}" if self.protocol is not None else ""
        return f"{self.chosen.name}{protocol}, seed {self.seed}"


class Cells:
    """All cells of models x protocols x seeds, and their models, each built once per seed.

    Parameters
    ----------
    models
        Models.
    protocols
        Names of training protocols, or a single one.
    seeds
        Number of seeds, from ``first`` on.
    first
        First seed.
    trains
        Whether a built model is trained; one that is not has a single cell.
    every_seed
        Whether also a model that is not trained has a cell for each seed.
    untrained
        Whether models whose weights ship start from random ones.

    Raises
    ------
    UnknownNameError
        For an unknown protocol, model or option.
    BadInputError
        If a model cannot be built, or there are no seeds.
    """

    def __init__(
        self,
        models: Sequence[ChosenModel],
        protocols: Sequence[str] | str,
        seeds: int,
        first: int,
        trains: Callable[[Any], bool],
        *,
        every_seed: bool = False,
        untrained: bool = False,
    ) -> None:
        names = [protocols] if isinstance(protocols, str) else protocols
        chosen = [Protocol.named(name) for name in dict.fromkeys(names)]
        if seeds < 1 or not chosen:
            raise BadInputError("an evaluation or training needs a protocol, and 1 seed or more")
        self._built: dict[tuple[int, int, bool], Any] = {}
        self.cells: list[Cell] = []
        # Of the first seed, all are built now, so that mistakes are found before anything is done.
        built = [self.model(Cell(model, None, first, untrained=untrained)) for model in models]
        for seed in range(first, first + seeds):
            for model, example in zip(models, built, strict=True):
                if trains(example):
                    self.cells += [Cell(model, p, seed, untrained) for p in chosen]
                    continue
                # Weights that ship were trained on all scenarios.
                anew = chosen if model.comes_trained(example) and not every_seed else []
                once = Protocol.ALL in chosen or not anew
                untrained_network = can(example, "loss") and not ask(example, "trained")
                if once and (seed == first or (every_seed and untrained_network)):
                    self.cells.append(Cell(model, None, seed))
                self.cells += [
                    Cell(model, p, seed, untrained=True) for p in anew if p is not Protocol.ALL
                ]

    def model(self, cell: Cell) -> Any:
        """Return the model of a cell, which is built unless it was used just before."""
        key = self._key(cell)
        if key not in self._built:
            self._built[key] = cell.chosen.build(cell.seed, untrained=cell.untrained)
        return self._built[key]

    @staticmethod
    def _key(cell: Cell) -> tuple[int, int, bool]:
        return id(cell.chosen), cell.seed, cell.untrained

    def run(
        self,
        here: Callable[[Cell], R],
        there: Callable[[Cell], R],
        folder: Path,
        what: str,
        executor: Executor | None,
        progress: Progress | None,
    ) -> tuple[list[R], dict[str, str]]:
        """Do all cells; one that fails does not stop the others.

        Parameters
        ----------
        here, there
            Does a cell in this process, and in a process of ``executor``, to which it is pickled.
        folder, what
            Output folder and label of the progress.
        executor
            Does the cells; this process without one.
        progress
            Called after each.

        Returns
        -------
        results, failed
            Results in the order of the cells, and the reasons of failures by label.

        Raises
        ------
        PhysionError
            If the only cell fails, or nothing more can be written.
        """
        tasks = {cell.label: cell for cell in self.cells}
        if len(tasks) < len(self.cells):
            labels = [cell.label for cell in self.cells]
            twice = next(label for label in labels if labels.count(label) > 1)
            raise BadInputError(f"{twice} is asked for twice; models need names of their own")
        if executor is None:
            if len(self.cells) == 1:
                return [here(self.cells[0])], {}
            executor, there = SerialExecutor(), self._releasing(here)
        results, failed = run_tasks(
            there, tasks, folder=folder, what=what, executor=executor, progress=progress
        )
        if failed and len(tasks) == 1:
            raise PhysionError(next(iter(failed.values())))
        return list(results.values()), failed

    def _releasing(self, here: Callable[[Cell], R]) -> Callable[[Cell], R]:
        """Return a function that does a cell, and forgets its model if no later cell needs it."""
        left = [self._key(cell) for cell in self.cells]

        def do(cell: Cell) -> R:
            try:
                return here(cell)
            finally:
                left.remove(self._key(cell))
                for key in [key for key in self._built if key not in left]:
                    del self._built[key]

        return do
