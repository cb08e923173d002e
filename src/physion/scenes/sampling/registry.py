"""Registry of scenarios. A scenario samples scenes from its parameters and a seed."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from physion.registry import Registry
from physion.scenes.scene import Scene
from physion.seeds import stable_hash

P = TypeVar("P")


@dataclass(frozen=True)
class Scenario:
    """Kind of trial.

    - ``params``: frozen dataclass with a default for each field. It may have a method
      ``check_values`` (`physion.scenes.sampling.parameters.check_together`).
    - ``sample``: function of parameters and seed that returns a scene and depends on nothing else.
    """

    name: str
    params: type[Any]
    sample: Callable[[Any, np.random.SeedSequence], Scene]


scenarios: Registry[Scenario] = Registry(
    "scenario",
    {
        name: f"physion.scenes.scenarios.{name}:sample"
        for name in (
            "dominoes",
            "support",
            "collide",
            "contain",
            "drop",
            "link",
            "roll",
            "drape",
        )
    },
)


def scenario(
    name: str, params: type[P]
) -> Callable[
    [Callable[[P, np.random.SeedSequence], Scene]], Callable[[P, np.random.SeedSequence], Scene]
]:
    """Return a decorator that registers a sampling function as the scenario ``name``."""

    def add(
        sample: Callable[[P, np.random.SeedSequence], Scene],
    ) -> Callable[[P, np.random.SeedSequence], Scene]:
        scenarios.register(name)(Scenario(name, params, sample))
        return sample

    return add


def scene_name(scenario: str, seed: np.random.SeedSequence) -> str:
    """Return a name for a sampled scene; it depends on scenario and seed only."""
    return f"{scenario}_{stable_hash(str(seed.entropy)) & 0xFFFFFFFF:08x}"


def as_record(params: Any) -> dict[str, Any]:
    """Convert parameters to plain JSON values, for `Scene.parameters`."""
    record: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(params)))
    return record
