"""Sampling of a scene from the name of its scenario, a seed, and a preset or parameters.

A preset names parameters of a scenario, among them the published configurations. Presets are kept
in TOML files:

- ``scenario``: the scenario of all presets in the file.
- ``[shared]``: parameters that all presets of the file have.
- ``[presets.NAME]``: a preset. ``params`` are its parameters, ``about`` a description, ``based_on``
  the preset that it changes (an earlier one of the file, or one that comes with the scenario).
  Published configurations also have ``official`` (name), ``seed`` and ``published`` (results).

Keys and units of parameters as in the scenario's parameters; ``physion ls presets SCENARIO
PRESET`` prints them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.seeds import named_seed
from physion.core.settings import parse_toml, read_settings
from physion.scenes.sampling.build import scenarios
from physion.scenes.sampling.parameters import check_params, check_together, read_params
from physion.scenes.scene import Scene

DEFAULT, FAMILIARIZATION = "default", "familiarization"
"""Names of presets that every scenario of this package has besides the published ones."""


@dataclass(frozen=True)
class Published:
    """What the original study reports about a configuration (docs/official-system.md, section 3).

    - ``trials``, ``contact``: number of trials generated for testing, and of those with contact.
    - ``frames``: mean length. ``tested``: number of trials among the published 150.
    - ``readout_trials``, ``readout_contact``: the same for the readout set.
    """

    trials: int
    contact: int
    frames: float
    tested: int = 0
    readout_trials: int = 0
    readout_contact: int = 0


@dataclass(frozen=True)
class Preset:
    """Named parameters of a scenario.

    ``official`` is the name of the published configuration that the preset reproduces, and ``seed``
    the seed it was generated with.
    """

    name: str
    scenario: str
    params: Any
    about: str = ""
    official: str | None = None
    seed: int | None = None
    published: Published | None = None


@cache
def load_presets(scenario: str) -> Mapping[str, Preset]:
    """Return the presets that come with a scenario, in the order of their file.

    A scenario from outside this package has one preset, ``default``, with its default parameters.
    """
    kind = scenarios.get(scenario).params
    file = resources.files("physion.scenes.scenarios").joinpath("presets", f"{scenario}.toml")
    if not file.is_file():
        return {DEFAULT: Preset(DEFAULT, scenario, kind())}
    return parse_presets(file.read_text(encoding="utf-8"), f"presets/{scenario}.toml", own=False)


def get_preset(scenario: str, name: str) -> Preset:
    """Return a preset of ``scenario`` by its name, or from a file by ``FILE.toml:NAME``.

    ``NAME`` may be left out if the file holds one preset. Raises `UnknownNameError` with the
    closest names, and `BadInputError` for a bad file.
    """
    path, _, chosen = name.partition(".toml")
    if path != name:
        return _from_file(Path(path + ".toml"), chosen.removeprefix(":"), scenario)
    known = load_presets(scenario)
    if name not in known:
        raise UnknownNameError(f"preset of {scenario}", name, known)
    return known[name]


def default_presets(scenario: str, split: str) -> tuple[str, ...]:
    """Return the presets that the trials of a split use one after the other.

    The familiarization split has its own preset. Every other split uses the published
    configurations with trials in the test. (The others were used for practice, or are a copy of
    another configuration under a second name.)
    """
    known = load_presets(scenario)
    if split == FAMILIARIZATION and FAMILIARIZATION in known:
        return (FAMILIARIZATION,)
    tested = [preset for preset in known.values() if preset.published and preset.published.tested]
    chosen = [
        p.name for i, p in enumerate(tested) if p.params not in [q.params for q in tested[:i]]
    ]
    return tuple(chosen) or (DEFAULT,)


def read_preset_file(path: Path) -> Mapping[str, Preset]:
    """Read a preset file; `BadInputError` names file, preset, key and what is allowed."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(f"preset file {path} cannot be read: {error}") from error
    return parse_presets(text, str(path))


def parse_presets(text: str, where: str, *, own: bool = True) -> Mapping[str, Preset]:
    """Read the text of a preset file; ``where`` names the file in errors.

    With ``own`` (a file of the user) presets may be based on those that come with the scenario.
    """
    file = read_settings(_PresetFile, parse_toml(text, where), where)
    kind = scenarios.get(file.scenario).params
    shared = read_params(kind, file.shared, f"{where}: shared")
    known = load_presets(file.scenario) if own else {}
    presets: dict[str, Preset] = {}
    for name, entry in file.presets.items():
        here = f"{where}: preset {name!r}"
        base = shared
        if entry.based_on is None:
            pass
        elif entry.based_on in presets:
            base = presets[entry.based_on].params
        elif entry.based_on in known:
            params = known[entry.based_on].params
            base = read_params(kind, file.shared, f"{where}: shared", params)
        else:
            raise BadInputError(
                f"{here}: based_on {entry.based_on!r} is neither before it in {where} nor among "
                f"the presets of {file.scenario}"
            )
        params = read_params(kind, entry.params, here, base)
        check_together(params, here)
        presets[name] = Preset(
            name, file.scenario, params, entry.about, entry.official, entry.seed, entry.published
        )
    return presets


@dataclass(frozen=True)
class _PresetEntry:
    """A preset as it is written in a file."""

    about: str = ""
    based_on: str | None = None
    official: str | None = None
    seed: int | None = None
    published: Published | None = None
    params: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _PresetFile:
    """A file of presets as it is written."""

    scenario: str
    shared: Mapping[str, Any] = field(default_factory=dict)
    presets: Mapping[str, _PresetEntry] = field(default_factory=dict)


def _from_file(path: Path, name: str, scenario: str) -> Preset:
    presets = read_preset_file(path)
    if not name and len(presets) != 1:
        raise BadInputError(f"{path} holds {sorted(presets)}; choose one as {path}:NAME")
    preset = presets.get(name) if name else next(iter(presets.values()))
    if preset is None:
        raise UnknownNameError(f"preset of {path}", name, presets)
    if preset.scenario != scenario:
        raise BadInputError(f"{path} has presets of {preset.scenario}, not of {scenario}")
    return preset


def sample_scene(
    scenario: str,
    seed: int | np.random.SeedSequence = 0,
    params: object | None = None,
    *,
    preset: str | None = None,
) -> Scene:
    """Sample a scene; equal arguments give equal scenes on every machine.

    Parameters
    ----------
    scenario
        Name of a scenario (``physion ls scenarios``).
    seed
        Number of the scene, or the seed of a trial from `physion.core.seeds.trial_seed`.
    params
        Parameters of the scenario; by default as in ``preset``, or else the scenario's own.
    preset
        Name of a preset (``physion ls presets SCENARIO``), or ``FILE.toml:NAME``.

    Returns
    -------
    scene
        Bodies, cloths, roles, camera, room, pushes and ending; metres, kilograms, seconds, z up.

    Raises
    ------
    UnknownNameError
        For an unknown scenario or preset; the message names the closest ones.
    BadInputError
        For parameters that are not allowed, or parameters and a preset.
    BadSceneError
        If no scene fits the parameters.

    Examples
    --------
    >>> scene = sample_scene("collide", 3)
    >>> scene.roles.agent, scene.roles.patient
    ('target', 'zone')
    """
    chosen = scenarios.get(scenario)
    if params is not None and preset is not None:
        raise BadInputError(f"scenario {scenario!r}: give parameters or a preset, not both")
    if preset is not None:
        params = get_preset(scenario, preset).params
    if params is None:
        params = chosen.params()
    elif not isinstance(params, chosen.params):
        raise BadInputError(
            f"scenario {scenario!r} takes {chosen.params.__module__}.{chosen.params.__name__}, "
            f"not {type(params).__name__}"
        )
    else:
        check_params(params, f"parameters of {scenario}")
    if isinstance(seed, int):
        seed = named_seed("scene", scenario, seed)
    return chosen.sample(params, seed)
