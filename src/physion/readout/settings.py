"""What is evaluated or trained: settings, models with their options, and all cells of these.

A cell is a model under one training protocol with one seed. Settings of a model and of its training
are options of the model: ``options={"steps": 500}``.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast

import tyro

from physion.compute.local import LocalExecutor, SerialExecutor
from physion.compute.run_tasks import run_tasks
from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError, PhysionError
from physion.core.settings import OPTION_ONLY, field_types, parse_pairs, read_settings, split_names
from physion.models.build import build_model, build_untrained, option_names
from physion.models.feature_table import FeatureTable
from physion.models.interface import RANDOM, Model, TrainingSettings, ask, can
from physion.models.user_files import is_file_name
from physion.readout.folds import Protocol
from physion.readout.logistic import LogisticSettings
from physion.readout.model_calls import is_network
from physion.readout.shipped import find_readouts
from physion.trials.dataset import Dataset
from physion.trials.making.pairs import without_pairs


@dataclass(frozen=True, kw_only=True)
class HarnessSettings:
    """Settings that evaluations and trainings have in common."""

    protocols: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--protocol",))] = ("all",)
    """Which scenarios train a model: all; all-but, all except the tested one; only, the tested one;
    or one, each by itself, tested on all. Several with commas. Weights that ship were trained on
    all: under another protocol such a model is trained from random weights. A model that is not
    trained is evaluated once."""
    scenario: str = ""
    """Test only this scenario; default: all. For physion train only under all-but, only or one."""
    seeds: int = 1
    """Number of seeds: --seed and the ones after it."""
    seed: int = 0
    """First seed: of initial weights, folds and training."""
    folds: Annotated[int, OPTION_ONLY] = 5
    """Folds of the cross-validation of a dataset without a readout split."""
    encoder_batch: Annotated[int, OPTION_ONLY] = 4
    """Clips that a network encodes at a time; lower it when memory runs out."""
    rendered: bool = False
    """Render the pictures from the stored motions instead of reading the movies."""
    accelerator: str = "auto"
    """Device of the networks, by Lightning's name: auto, cpu, cuda, ..."""

    def __post_init__(self) -> None:
        if self.encoder_batch < 1 or self.folds < 2 or self.seeds < 1:
            raise BadInputError(
                "encoder_batch and seeds must be at least 1 and folds at least 2, not "
                f"{self.encoder_batch}, {self.seeds} and {self.folds}"
            )

    def chosen_protocols(self) -> list[Protocol]:
        """Return the protocols, each once; raise `UnknownNameError` for one that is unknown."""
        return [Protocol.named(name) for name in split_names(self.protocols, "training protocol")]


@dataclass(frozen=True, kw_only=True)
class TrainSettings(HarnessSettings):
    """Settings of trainings."""

    devices: int = 1
    """Devices of each node, among which every batch is divided."""
    nodes: int = 1
    """Nodes; the same command is started on each, as Lightning describes."""


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings(HarnessSettings):
    """Settings of evaluations."""

    benchmark: Annotated[str, OPTION_ONLY] = ""
    """Rules of the evaluation: v1, of the paper, or v1.5, of physion_evaluator (seven scenarios,
    Collide cut at frame 15, one readout of all scenarios, detection around the contact). Default:
    v1, but v1.5 for files of features that physion_evaluator wrote."""
    readouts: tuple[str, ...] = ()
    """Kinds of readout: observed, observed+simulated, full. Default: all that the model has."""
    decision: str = ""
    """What turns features or rollouts into P(contact) (physion ls decisions); default: the model's
    own."""
    readout_from: Literal["shipped", "fit"] = "shipped"
    """shipped: take a readout of the package where it has one for the model, if trials are red and
    yellow, the dataset has fewer trials to fit one, and its twin, if asked for, has one too. fit:
    fit all readouts on the dataset."""
    untrained: Annotated[bool, OPTION_ONLY] = False
    """Train no model, and take its weights as they are; the table says untrained."""
    twin: bool = False
    """Also evaluate a random twin of each model that has weights: the same network with
    weights=random; if it is an encoder with dynamics, the dynamics are trained."""
    rollout_errors: Annotated[bool, OPTION_ONLY] = False
    """Also write, for particle models, how far imagined motion is from the true one over time."""
    logistic: Annotated[LogisticSettings, OPTION_ONLY] = field(default_factory=LogisticSettings)
    """Settings of the logistic regression."""


R = TypeVar("R")

Models = (
    str | PathLike[str] | Model | Sequence[str | PathLike[str] | Model]
    | Mapping[str, Mapping[str, Any]]
)  # fmt: skip
"""Models by name, ``FILE.py:Class``, file of features, or built: one or several; or names with
options of their own."""
SEED, WEIGHTS = "seed", "weights"
"""Options of models: seed of the initial weights, and trained weights."""


@dataclass(frozen=True, eq=False)
class ChosenModel:
    """Model of an evaluation or training, and the options that a user sets.

    - ``model``: its name, or the model itself. ``options``: fields of its settings.
    - ``training``: fields of `TrainingSettings` that replace the model's.
    - ``twin``: whether it is the random twin of another model.
    - ``fits``: whether readouts that ship are not used, since none ships for its twin, or for the
      model that it is the twin of: readouts of both are fitted on the same trials.
    """

    model: str | Model
    options: Mapping[str, Any]
    training: Mapping[str, Any]
    twin: bool = False
    fits: bool = False

    @property
    def name(self) -> str:
        """Name in messages."""
        name = self.model if isinstance(self.model, str) else self.model.provenance().model
        return f"random twin of {name}" if self.twin else name

    def random_twin(self, built: Any) -> ChosenModel | None:
        """Return the model with random weights.

        None if ``built``, as it is built, has random ones already, or no weights, or if it comes
        from a user's file, where the option may mean anything.
        """
        if not isinstance(self.model, str) or is_file_name(self.model):
            return None
        if WEIGHTS not in option_names(self.model) or built.provenance().init == RANDOM:
            return None
        return dataclasses.replace(self, options={**self.options, WEIGHTS: RANDOM}, twin=True)

    def lacks_twin(self, built: Any) -> bool:
        """Return whether no twin of a table of features or a user's class can be made."""
        own = not isinstance(self.model, str) or is_file_name(self.model)
        table = isinstance(built, FeatureTable)
        # A wrong provenance is refused where predictions are made, with a message that says it.
        init = getattr(built.provenance(), "init", "")
        return (own or table) and init != RANDOM

    def stays_random(self, model: Any) -> bool:
        """Return whether a built model is a twin that is not trained, as dynamics would be."""
        dynamics = ask(model, "learns_from") == "features" and not ask(model, "learns_outcomes")
        return self.twin and not dynamics

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
    one = isinstance(models, str | PathLike) or hasattr(models, "provenance")
    listed: list[Any] = [models] if one else [*cast("Iterable[Any]", models)]
    if not listed:
        raise BadInputError("no model is named")
    given = {**(options or {})}
    return [_choose(model, {**given, **(own[model] if own else {})}) for model in listed]


def _choose(model: Any, options: Mapping[str, Any]) -> ChosenModel:
    model = os.fspath(model) if isinstance(model, PathLike) else model
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


def options_by_model(models: Sequence[str], pairs: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the options of every model from pairs of the command line.

    A pair is ``NAME=VALUE`` for all models, or ``MODEL:NAME=VALUE`` for one. Raises `BadInputError`
    for what is not a pair, or is given twice.
    """
    own: dict[str, list[str]] = {name: [] for name in models}
    for pair in pairs:
        named = [name for name in models if pair.startswith(f"{name}:")]
        for name in named or models:
            own[name].append(pair.removeprefix(f"{name}:"))
    return {name: parse_pairs(own[name], "--option") for name in models}


def open_dataset(dataset: Dataset | Path | str, executor: Executor | None) -> Dataset:
    """Return the dataset, with an absolute path for processes of ``executor``.

    Movies of pairs, half of which are impossible, have no outcome to predict and are left out.
    """
    opened = Dataset(Path(dataset)) if isinstance(dataset, str | Path) else dataset
    if executor is not None:
        opened = Dataset(opened.folder.absolute(), verify=opened.verify)
    return without_pairs(opened)


def runner_of_cells(executor: Executor | None) -> Executor | None:
    """Return the executor whose tasks are cells, or None if cells run one by one in this process.

    An executor of this machine is for the simulations within a cell, which share its processes.
    """
    return None if isinstance(executor, LocalExecutor | SerialExecutor) else executor


@dataclass(eq=False)
class Cell:
    """A model with a training protocol and a seed.

    ``protocol`` is None if the model is not trained. ``untrained``: its weights ship, but the
    training starts from random ones.
    """

    chosen: ChosenModel
    protocol: Protocol | None
    seed: int
    untrained: Annotated[bool, OPTION_ONLY] = False
    built: Any = field(default=None, repr=False)

    @property
    def label(self) -> str:
        """Model, protocol and seed, as text."""
        protocol = f", {self.protocol.value}" if self.protocol is not None else ""
        return f"{self.chosen.name}{protocol}, seed {self.seed}"

    def take_model(self) -> Any:
        """Return the model. The cell does not keep it, so that not all are in memory."""
        model, self.built = self.built, None
        return model or self.chosen.build(self.seed, untrained=self.untrained)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "built": None}


def plan_cells(
    models: Sequence[ChosenModel],
    settings: HarnessSettings,
    trains: Callable[[Any], bool],
    *,
    every_seed: bool = False,
    untrained: bool = False,
    twins: bool = False,
) -> list[Cell]:
    """Return the cells of all models, protocols and seeds.

    Parameters
    ----------
    models
        Models. Each is built once now, so that mistakes are found before anything is done.
    settings
        Protocols and seeds.
    trains
        Whether a built model is trained; one that is not has a single cell.
    every_seed
        Whether also a model that is not trained has a cell for each seed.
    untrained
        Whether models whose weights ship start from random ones.
    twins
        Whether the random twin of each model is added, once for each name.

    Raises
    ------
    UnknownNameError
        For an unknown protocol, model or option.
    BadInputError
        If a model cannot be built, or two cells have the same name.
    """
    protocols, first = settings.chosen_protocols(), settings.seed
    built = [(model, model.build(first, untrained=untrained)) for model in models]
    if twins:
        built = _with_twins(built, first)
    cells: list[Cell] = []
    for seed in range(first, first + settings.seeds):
        for model, example in built:
            ready = example if seed == first else None
            if trains(example) and not model.stays_random(example):
                cells += [Cell(model, p, seed, untrained) for p in protocols]
                cells[-len(protocols)].built = ready
                continue
            # Weights that ship were trained on all scenarios.
            anew = protocols if model.comes_trained(example) and not every_seed else []
            once = Protocol.ALL in protocols or not anew
            network = can(example, "loss") and not ask(example, "trained")
            if once and (seed == first or (every_seed and network)):
                cells.append(Cell(model, None, seed, built=ready))
            cells += [Cell(model, p, seed, untrained=True) for p in anew if p is not Protocol.ALL]
    labels = [cell.label for cell in cells]
    twice = [label for label in labels if labels.count(label) > 1]
    if twice:
        raise BadInputError(f"{twice[0]} is asked for twice; models need names of their own")
    return cells


def _with_twins(
    built: Sequence[tuple[ChosenModel, Any]], seed: int
) -> list[tuple[ChosenModel, Any]]:
    """Return built models, each with its random twin, unless another model's has the same name."""
    found: list[tuple[ChosenModel, Any]] = []
    names: set[str] = set()
    for model, example in built:
        twin = model.random_twin(example)
        if twin is None:
            found.append((model, example))
            continue
        made = twin.build(seed)
        fits = not (find_readouts(example) and find_readouts(made))
        found.append((dataclasses.replace(model, fits=fits), example))
        if (name := made.provenance().model) not in names:
            names.add(name)
            found.append((dataclasses.replace(twin, fits=fits), made))
    return found


def run_cells(
    cells: Sequence[Cell],
    function: Callable[[Cell], R],
    folder: Path,
    what: str,
    executor: Executor | None,
    progress: Progress | None,
    on_done: Callable[[R], None] | None = None,
) -> tuple[list[R], dict[str, str]]:
    """Do all cells; one that fails does not stop the others.

    Parameters
    ----------
    cells, function
        Cells, and the function that does one.
    folder, what
        Output folder and label of the progress.
    executor
        Does the cells; this process without one.
    progress
        Called after each.
    on_done
        Called with each result.

    Returns
    -------
    results, failed
        Results in the order of the cells, and the reasons of failures by label.

    Raises
    ------
    PhysionError
        If the only cell fails, or nothing more can be written.
    """
    if executor is None and len(cells) == 1:
        result = function(cells[0])
        if on_done is not None:
            on_done(result)
        return [result], {}
    results, failed = run_tasks(
        function,
        {cell.label: cell for cell in cells},
        folder=folder,
        what=what,
        executor=executor or SerialExecutor(),
        progress=progress,
        on_outcome=None
        if on_done is None
        else lambda outcome: on_done(outcome.value) if outcome.error is None else None,
    )
    if failed and len(cells) == 1:
        raise PhysionError(next(iter(failed.values())))
    return list(results.values()), failed
