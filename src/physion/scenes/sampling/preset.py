"""Presets: parameters of a scenario under a name, the published configurations among them.

A preset file is TOML. ``scenario`` names whose parameters it fills; ``[shared]`` holds what all
its presets have; each ``[presets.NAME]`` has its own ``params`` and may say what it is ``about``,
which preset it is ``based_on`` (one before it in the file, or one that comes with the scenario),
and, for a published configuration, its ``official`` name, its
``seed`` and what was ``published`` about its trials. Keys and units are those of the scenario's
``Params``; ``physion ls presets SCENARIO`` prints them.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from physion.dataclass_json import check_keys, shown
from physion.errors import BadInputError, UnknownNameError
from physion.scenes.sampling.parameters import Quantity, check_together, read_params
from physion.scenes.sampling.registry import scenarios

DEFAULT, FAMILIARIZATION, DEBUG = "default", "familiarization", "debug"
"""Presets that every scenario has besides the published ones."""
Trials = Annotated[int, Quantity("", 0, 1_000_000)]
_PRESET_KEYS = ("about", "based_on", "official", "seed", "published", "params")
_FILE_KEYS = ("scenario", "shared", "presets")


@dataclass(frozen=True)
class Published:
    """What the original study reports of a configuration (docs/official-system.md, section 3).

    - ``trials``, ``contact``: of those generated for the test, how many and how many with contact.
    - ``frames``: mean length. ``tested``: how many are among the published 150.
    - ``readout_trials``, ``readout_contact``: the same of the readout set.
    """

    trials: Trials
    contact: Trials
    frames: Annotated[float, Quantity("frames", 0.0, 10000.0)]
    tested: Trials = 0
    readout_trials: Trials = 0
    readout_contact: Trials = 0


@dataclass(frozen=True)
class Preset:
    """Parameters of ``scenario`` under a name.

    ``official`` is the published configuration that it is, with the ``seed`` it was made with.
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
    """All presets that come with the scenario, in the order of their file.

    A scenario of another package has none, but for ``default``: its parameters as they are.
    """
    kind = scenarios.get(scenario).params
    file = resources.files("physion.scenes.scenarios").joinpath("presets", f"{scenario}.toml")
    if not file.is_file():
        return {DEFAULT: Preset(DEFAULT, scenario, kind())}
    return parse_presets(file.read_text(encoding="utf-8"), f"presets/{scenario}.toml", own=False)


def get_preset(scenario: str, name: str) -> Preset:
    """The preset ``name`` of ``scenario``; `UnknownNameError` has the closest names.

    ``FILE.toml`` or ``FILE.toml:NAME`` reads a preset file of one's own; without ``NAME`` it must
    hold one preset.
    """
    path, _, chosen = name.partition(".toml")
    if path != name:
        return _from_file(Path(path + ".toml"), chosen.removeprefix(":"), scenario)
    known = load_presets(scenario)
    if name not in known:
        raise UnknownNameError(f"preset of {scenario}", name, known)
    return known[name]


def default_presets(scenario: str, split: str) -> tuple[str, ...]:
    """Names of the presets that the trials of a split take in turn.

    The familiarization split has its own. Every other split takes the published configurations of
    which trials were in the test, each once: those without are the ones that people practised on,
    and some repeat another under a second name.
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
    """The presets of a file; `BadInputError` names file, preset, key and what is allowed."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(f"preset file {path} cannot be read: {error}") from error
    return parse_presets(text, str(path))


def parse_presets(text: str, where: str, *, own: bool = True) -> Mapping[str, Preset]:
    """The presets of a file's ``text``; ``where`` names it in errors.

    Those of one's ``own`` may be based on presets that come with the scenario.
    """
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{where} is not TOML: {error}") from error
    check_keys(data, _FILE_KEYS, where)
    scenario = data.get("scenario")
    if not isinstance(scenario, str):
        raise BadInputError(f"{where} needs scenario = one of {scenarios.names()}")
    kind = scenarios.get(scenario).params
    common = _table(data, "shared", where)
    shared = read_params(kind, common, f"{where}: shared")
    known = load_presets(scenario) if own else {}
    presets: dict[str, Preset] = {}
    for name, entry in _table(data, "presets", where).items():
        here = f"{where}: preset {name!r}"
        if not isinstance(entry, Mapping):
            raise BadInputError(f"{here} must be a table")
        check_keys(entry, _PRESET_KEYS, here)
        base = shared
        if "based_on" in entry:
            chosen = entry["based_on"]
            if not isinstance(chosen, str):
                raise BadInputError(f"{here}: based_on must name a preset, not {shown(chosen)}")
            if chosen in presets:
                base = presets[chosen].params
            elif chosen in known:
                base = read_params(kind, common, f"{where}: shared", known[chosen].params)
            else:
                raise BadInputError(
                    f"{here}: based_on {chosen!r} is neither before it in {where} nor among the "
                    f"presets of {scenario}"
                )
        params = read_params(kind, _table(entry, "params", here), here, base)
        check_together(params, here)
        presets[name] = _preset(name, scenario, params, entry, here)
    return presets


def _preset(name: str, scenario: str, params: Any, entry: Mapping[str, Any], here: str) -> Preset:
    for key, kind in (("about", str), ("official", str), ("seed", int)):
        if key in entry and type(entry[key]) is not kind:
            wanted = "a text" if kind is str else "a whole number"
            raise BadInputError(f"{here}: {key} must be {wanted}, not {shown(entry[key])}")
    published = _published(_table(entry, "published", here), here) if "published" in entry else None
    return Preset(
        name,
        scenario,
        params,
        entry.get("about", ""),
        entry.get("official"),
        entry.get("seed"),
        published,
    )


def _published(table: Mapping[str, Any], here: str) -> Published:
    missing = [key for key in ("trials", "contact", "frames") if key not in table]
    if missing:
        raise BadInputError(f"{here}: published lacks {', '.join(missing)}")
    read = read_params(Published, table, f"{here}: published", Published(0, 0, 0.0))
    assert isinstance(read, Published)
    return read


def _from_file(path: Path, name: str, scenario: str) -> Preset:
    found = read_preset_file(path)
    if not name and len(found) != 1:
        raise BadInputError(f"{path} holds {sorted(found)}; say which as {path}:NAME")
    preset = found.get(name) if name else next(iter(found.values()))
    if preset is None:
        raise UnknownNameError(f"preset of {path}", name, found)
    if preset.scenario != scenario:
        raise BadInputError(f"{path} has presets of {preset.scenario}, not of {scenario}")
    return preset


def _table(data: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    found = data.get(key, {})
    if not isinstance(found, Mapping):
        raise BadInputError(f"{where}: {key} must be a table")
    return found
