"""Physion: physical scenes, people and models. Will the red object touch the yellow one?

The public names are imported when they are first used, so that ``import physion`` takes no time:

- `sample_scene`: sample a scene of a scenario. `simulate`: compute its motion. `label_contact`:
  find out whether agent and patient touch. `Renderer`: render any pass of any frame.
- `generate`: make a dataset of trials. `Dataset`: read it. `clips`: its clips, as torch takes them.
- `official`: the data of the original study: scenes, recorded outcomes, answers of people.
- `build_model`: build a model. `train`: train it. `evaluate`: predict the trials of a dataset.
- `check`: test whether predictions depend on what they must not depend on.
- `compare`: compare predictions with people. `judge`: judge generated movies.
- `run`: all of this in one call.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from physion.core.version import __version__

if TYPE_CHECKING:
    from physion.checking import check
    from physion.clips.clips import clips
    from physion.data.official import official
    from physion.judging.judge import judge
    from physion.models.build import build_model
    from physion.physics.engine import simulate
    from physion.physics.labels import label_contact
    from physion.pipeline import run
    from physion.readout.evaluate import evaluate
    from physion.readout.train import train
    from physion.rendering.renderer import Renderer
    from physion.report.compare import compare
    from physion.scenes.sampling.sample import sample_scene
    from physion.trials.dataset import Dataset
    from physion.trials.making.generate import generate

__all__ = [
    "Dataset",
    "Renderer",
    "__version__",
    "build_model",
    "check",
    "clips",
    "compare",
    "evaluate",
    "generate",
    "judge",
    "label_contact",
    "official",
    "run",
    "sample_scene",
    "simulate",
    "train",
]

_MODULES = {
    "Dataset": "physion.trials.dataset",
    "Renderer": "physion.rendering.renderer",
    "build_model": "physion.models.build",
    "check": "physion.checking",
    "clips": "physion.clips.clips",
    "compare": "physion.report.compare",
    "evaluate": "physion.readout.evaluate",
    "generate": "physion.trials.making.generate",
    "judge": "physion.judging.judge",
    "label_contact": "physion.physics.labels",
    "official": "physion.data.official",
    "run": "physion.pipeline",
    "sample_scene": "physion.scenes.sampling.sample",
    "simulate": "physion.physics.engine",
    "train": "physion.readout.train",
}
"""Module of each public name."""


def __getattr__(name: str) -> Any:
    """Import the module of a public name when it is first used (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_MODULES[name]), name)
    # The package `physion.clips`, which importing the function put there, is that function too.
    return globals().setdefault(name, value)


def __dir__() -> list[str]:
    """Return the public names, whether or not they were used."""
    return sorted(__all__)
