"""The scenarios by name: each draws scenes from its own parameters."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from physion.errors import BadInputError
from physion.registry import Registry
from physion.scenes.sampling.parameters import check_params
from physion.scenes.scene import Scene
from physion.seeds import stable_hash

P = TypeVar("P")


@dataclass(frozen=True)
class Scenario:
    """A kind of trial.

    ``params`` is a frozen dataclass with a default for each field, not always the official one, and
    may have a method ``check_values`` (`physion.scenes.sampling.parameters.check_together`).
    ``sample(params(), seed)`` draws a scene that depends on nothing else.
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
    """Register the decorated sampler as the scenario ``name``."""

    def add(
        sample: Callable[[P, np.random.SeedSequence], Scene],
    ) -> Callable[[P, np.random.SeedSequence], Scene]:
        scenarios.register(name)(Scenario(name, params, sample))
        return sample

    return add


def sample_scene(name: str, seed: np.random.SeedSequence, params: object | None = None) -> Scene:
    """Draw a scene of the scenario ``name``, with its default parameters unless others are given.

    `UnknownNameError` has the closest names.
    """
    found = scenarios.get(name)
    if params is None:
        params = found.params()
    elif not isinstance(params, found.params):
        raise BadInputError(
            f"scenario {name!r} takes {found.params.__module__}.Params, not {type(params).__name__}"
        )
    else:
        check_params(params, f"parameters of {name}")
    return found.sample(params, seed)


def scene_name(scenario: str, seed: np.random.SeedSequence) -> str:
    """A name for a scene that nobody has named yet: the same seed, the same name."""
    return f"{scenario}_{stable_hash(str(seed.entropy)) & 0xFFFFFFFF:08x}"


def as_record(params: Any) -> dict[str, Any]:
    """A dataclass of parameters as plain JSON values, for `Scene.parameters`."""
    record: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(params)))
    return record
