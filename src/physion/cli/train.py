"""Train a model on a dataset without labels; the same command resumes, and evaluate finds the
result."""

from __future__ import annotations

import dataclasses
import json as json_module
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from physion.cli.model_options import parse_options
from physion.cli.output import Stages, console
from physion.readout.trainings import TrainConfig, train
from physion.training.overrides import TrainingOverrides
from physion.trials.dataset import Dataset

if TYPE_CHECKING:
    from physion.training.train import TrainedModel


@dataclass(frozen=True)
class Options:
    """Options of ``physion train``."""

    model: Annotated[str, tyro.conf.Positional]
    """Name of a model (physion ls models lists them), or FILE.py:Class."""
    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    out: Path = Path("runs/models")
    """Folder for trainings and features, that of physion evaluate."""
    size: Literal["small", "paper", "released"] | None = None
    """Configuration of a model that has several."""
    option: tuple[str, ...] = ()
    """Fields of the model's config as NAME=VALUE, such as encoder=resnet50 weights=imagenet."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    """Scenarios, seed and devices."""
    settings: Annotated[TrainingOverrides, tyro.conf.arg(name="")] = field(
        default_factory=TrainingOverrides
    )
    """Optimiser and schedule."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Train the model once for every set of trials that the protocol needs."""
    chosen = parse_options(options.option)
    if options.size is not None:
        chosen["size"] = options.size
    with Stages() as stages:
        trained = train(
            Dataset(options.dataset),
            options.model,
            options.out,
            options=chosen,
            settings=options.settings,
            config=options.config,
            progress=stages,
        )
    from physion.training.devices import is_first_process

    if is_first_process():
        _print(trained, options.json)
    return 0


def _print(trained: list[TrainedModel], json: bool) -> None:
    if json:
        print(json_module.dumps({"trained": [_values(result) for result in trained]}))
        return
    for result in trained:
        for note in result.notes:
            console.print(note, markup=False, soft_wrap=True)
        losses = [f"loss {result.loss:.4g}"]
        if not math.isnan(result.validation):
            losses.append(f"held-out trials {result.validation:.4g}")
        if not math.isnan(result.baseline):
            losses.append(f"trivial predictor {result.baseline:.4g}")
        done = "was trained before" if result.loaded else f"trained for {result.steps} steps"
        console.print(
            f"{result.name} {done}, {', '.join(losses)}: {result.folder}",
            markup=False,
            soft_wrap=True,
        )


def _values(result: TrainedModel) -> dict[str, Any]:
    values = {**dataclasses.asdict(result), "folder": str(result.folder)}
    missing = {name for name, value in values.items() if value != value}
    return {name: None if name in missing else value for name, value in values.items()}
