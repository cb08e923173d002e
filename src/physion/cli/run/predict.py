"""Models of a run, and their predictions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physion.cli.output import Stages

if TYPE_CHECKING:
    from physion.cli.run.options import Options

OFFICIAL_MODELS = (
    "pEffNetLite0-mlp",
    "noisy-simulation",
    "gns",
    "gns-ransac",
    "dpi",
    "state-classifier",
    "constant-motion",
    "already-touched",
    "chance",
)
"""Models of a run on official scenes, in the order of the report."""
SIMULATIONS = ("noisy-simulation", "noisy-simulation-outcomes", "noisy-simulation-people")
TRAINED_MODELS = ("gns", "gns-ransac", "dpi", "svg", "op3", "cswm", "rpin")
"""Models whose weights come with the package."""
SAMPLED_MODELS = ("frozen-encoder", "noisy-simulation")


def chosen_models(options: Options) -> dict[str, dict[str, Any]]:
    """Return the models of a run and the options of each."""
    default = SAMPLED_MODELS if options.sampled else OFFICIAL_MODELS
    names = [name for text in options.models for name in text.split(",") if name] or list(default)
    known: Mapping[str, dict[str, Any]] = {
        "frozen-encoder": {
            "encoder": options.encoder,
            "weights": options.weights,
            "dynamics": options.dynamics,
        },
        # Frames of the size of the movies: enlarging them would only take time.
        "pEffNetLite0-mlp": {"image_size": options.size},
        "pEffNetLite0-lstm": {"image_size": options.size},
        **{name: {"weights": "shipped"} for name in TRAINED_MODELS},
        **{name: {"samples": options.samples, "engine": options.engine} for name in SIMULATIONS},
    }
    return {name: known.get(name, {}) for name in dict.fromkeys(names)}


def check_models(options: Options) -> None:
    """Build every model once, so that a wrong name or a missing library fails early."""
    from physion.models.build import build_model

    for model, settings in chosen_models(options).items():
        build_model(model, **settings)


def predict(options: Options, folder: Path) -> tuple[list[Path], list[str]]:
    """Write the predictions of every model; return their paths and the failures."""
    from physion.compute.local import LocalExecutor
    from physion.readout.evaluate import evaluate
    from physion.readout.settings import EvaluationConfig
    from physion.trials.dataset import Dataset

    dataset = Dataset(folder / "trials")
    paths: list[Path] = []
    problems: list[str] = []
    for model, settings in chosen_models(options).items():
        with Stages() as stages:
            evaluation = evaluate(
                dataset,
                model,
                folder / "models",
                options=settings,
                config=EvaluationConfig(steps=options.steps, encoder_batch=options.encoder_batch),
                executor=LocalExecutor(workers=options.workers),
                progress=stages,
            )
        paths.append(evaluation.path)
        problems += [f"{model}: {name}: {why}" for name, why in evaluation.problems.items()]
    return paths, problems
