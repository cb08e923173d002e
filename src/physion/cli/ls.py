"""List what can be named: scenarios, shapes, models, engines, executors."""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from physion.compute.executor import executors
from physion.models.interface import models
from physion.physics.engine import engines
from physion.registry import Registry
from physion.scenes.scenarios import scenarios
from physion.scenes.shapes import shapes

LISTS: dict[str, Registry] = {  # type: ignore[type-arg]
    "scenarios": scenarios,
    "shapes": shapes,
    "models": models,
    "engines": engines,
    "executors": executors,
}


@dataclass(frozen=True)
class Options:
    """Which list."""

    what: Annotated[
        Literal["all", "scenarios", "shapes", "models", "engines", "executors"],
        tyro.conf.Positional,
    ] = "all"
    """One list, or all."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Print names, one list a line."""
    chosen = LISTS if options.what == "all" else {options.what: LISTS[options.what]}
    names = {kind: registry.names() for kind, registry in chosen.items()}
    if options.json:
        print(json_module.dumps(names))
        return 0
    for kind, found in names.items():
        print(f"{kind}: {', '.join(found)}")
    return 0
