"""List scenarios, presets, shapes, props, materials, models, decisions and engines."""

from __future__ import annotations

import json as json_module
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from physion.cli.output import print_line
from physion.compute.tasks import executors
from physion.core.errors import BadInputError
from physion.core.registry import Registry
from physion.core.settings import flatten
from physion.models.build import models
from physion.physics.engine import engines
from physion.rendering.rooms import rooms
from physion.scenes.looks import MATERIALS
from physion.scenes.sampling.build import as_record, scenarios
from physion.scenes.sampling.parameters import describe_limits
from physion.scenes.sampling.sample import Preset, get_preset, load_presets
from physion.scenes.shapes.primitives import shapes
from physion.scenes.shapes.props import NATURAL_SIZES

Names = list[str] | dict[str, list[str]]
LISTS: Mapping[str, Callable[[], Names]] = {
    "scenarios": scenarios.names,
    "presets": lambda: {name: list(load_presets(name)) for name in scenarios.names()},
    "shapes": shapes.names,
    "props": lambda: sorted(NATURAL_SIZES),
    "materials": lambda: {family: list(names) for family, names in MATERIALS.items()},
    "models": models.names,
    "decisions": lambda: _decisions().names(),
    "rooms": rooms.names,
    "engines": engines.names,
    "executors": executors.names,
}


DESCRIBED: Mapping[str, Callable[[], Registry[Any]]] = {
    "models": lambda: models,
    "decisions": lambda: _decisions(),
    "engines": lambda: engines,
    "executors": lambda: executors,
}
"""Lists that are printed with a line for each name, when only they are asked for."""


def _decisions() -> Registry[Any]:
    # Imported late: it takes time.
    from physion.readout.decisions import decisions

    return decisions


@dataclass(frozen=True)
class Options:
    """Options of ``physion ls``."""

    what: Annotated[
        Literal[
            "all",
            "scenarios",
            "presets",
            "shapes",
            "props",
            "materials",
            "models",
            "decisions",
            "rooms",
            "engines",
            "executors",
        ],
        tyro.conf.Positional,
    ] = "all"
    """Name of a list, or all."""
    scenario: Annotated[str | None, tyro.conf.Positional] = None
    """With presets: the scenario whose presets are described."""
    preset: Annotated[str | None, tyro.conf.Positional] = None
    """With presets and a scenario: the preset whose values are printed with their limits."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Print lists of names, the presets of a scenario, or the values of a preset."""
    if options.scenario is not None:
        if options.what != "presets":
            raise BadInputError("a scenario can be named after 'presets' only")
        if options.preset is not None:
            return _print_preset(get_preset(options.scenario, options.preset), options.json)
        return _print_presets(options.scenario, options.json)
    chosen = LISTS if options.what == "all" else {options.what: LISTS[options.what]}
    names = {kind: listed() for kind, listed in chosen.items()}
    if options.json:
        print(json_module.dumps(names))
        return 0
    if options.what in DESCRIBED:
        _print_described(DESCRIBED[options.what]())
        return 0
    for kind, members in names.items():
        if isinstance(members, list):
            print(f"{kind}: {', '.join(members)}")
        elif options.what == "all":
            print(f"{kind}: {sum(map(len, members.values()))} (physion ls {kind})")
        else:
            for group, entries in members.items():
                print(f"{group} ({len(entries)}): {', '.join(entries)}")
    return 0


def _print_described(registry: Registry[Any]) -> None:
    """Print a line for every name of a registry: what it is, from its docstring."""
    for name in registry.names():
        text = registry.describe(name).removeprefix("Build ").removeprefix("Return ")
        line = f"{name}: {text}" if text else name
        print_line(line)


def _print_presets(scenario: str, as_json: bool) -> int:
    presets = load_presets(scenario).values()
    if as_json:
        print(json_module.dumps([_facts(preset) for preset in presets]))
        return 0
    for preset in presets:
        text = preset.about or preset.official or ""
        if preset.published:
            text += f" (published: {preset.published.contact} of {preset.published.trials} contact)"
        print_line(f"{preset.name}: {text}")
    return 0


def _print_preset(preset: Preset, as_json: bool) -> int:
    if as_json:
        print(json_module.dumps(_facts(preset)))
        return 0
    limits = describe_limits(preset.params)
    for key, value in flatten(as_record(preset.params)).items():
        line = f"{key} = {json_module.dumps(value)}   # {limits.get(key, '')}"
        print_line(line)
    return 0


def _facts(preset: Preset) -> dict[str, Any]:
    published = preset.published
    return {
        "name": preset.name,
        "scenario": preset.scenario,
        "about": preset.about,
        "official": preset.official,
        "seed": preset.seed,
        "published": None if published is None else vars(published),
        "params": as_record(preset.params),
    }
