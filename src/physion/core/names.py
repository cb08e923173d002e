"""Names of scenarios and stimuli: the one table of our names and the official ones.

It lies below every other package, so that reading trials, importing official files, the experiment
and the analysis recognise a scenario by the same names.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple


class ScenarioNames(NamedTuple):
    """Names of one scenario in the official files.

    - ``folder``: its folder in the published archives;
    - ``controller``: its ``controller_name`` in the metadata;
    - ``experiment``: its name in the tables of people and models;
    - ``prefix``: how the names of its test stimuli begin.
    """

    folder: str
    controller: str
    experiment: str
    prefix: str


NAMES = {
    "dominoes": ScenarioNames("Dominoes", "MultiDominoes", "dominoes", "pilot_dominoes_"),
    "support": ScenarioNames("Support", "Tower", "towers", "pilot_towers_"),
    "collide": ScenarioNames("Collide", "Collision", "collision", "pilot_it2_collision_"),
    "contain": ScenarioNames("Contain", "Containment", "containment", "pilot-containment-"),
    "drop": ScenarioNames("Drop", "Drop", "drop", "pilot_it2_drop_"),
    "link": ScenarioNames("Link", "Linking", "linking", "pilot_linking_"),
    "roll": ScenarioNames("Roll", "RollingSliding", "rollingsliding", "pilot_it2_rollingSliding_"),
    "drape": ScenarioNames("Drape", "ClothSagging", "clothiness", "test"),
}
"""Official names by our name of the scenario, in the order of the paper."""

SCENARIOS = tuple(NAMES)
"""The eight scenarios in the order of the paper."""

RIGID = tuple(scenario for scenario in SCENARIOS if scenario != "drape")
"""The scenarios without cloth."""

FOLDERS = {scenario: names.folder for scenario, names in NAMES.items()}
"""Folder of the published archives by scenario."""

CONTROLLERS = {scenario: names.controller for scenario, names in NAMES.items()}
"""``controller_name`` of the official metadata by scenario."""

OFFICIAL_SCENARIOS = {names.experiment: scenario for scenario, names in NAMES.items()}
"""Our name of a scenario by its name in the official tables."""

TABLE_ENDINGS = (".mp4", ".webm", ".avi", ".mov", ".npy", ".npz", ".hdf5", "_img")
"""Endings of file names that tables of stimuli hold."""

FILE_ENDINGS = (".mp4", ".hdf5", ".png", "_img", "_map")
"""Endings of all files of an official stimulus."""

_DRAPE = re.compile(r"test\d+_\d+$")
_WORDS = {
    # Some Roll stimuli also contain the word "collision", so "roll" is tried first.
    "roll": "roll",
    "domino": "dominoes",
    "tower": "support",
    "support": "support",
    "collision": "collide",
    "collide": "collide",
    "contain": "contain",
    "link": "link",
    "drop": "drop",
    "cloth": "drape",
    "drape": "drape",
}
"""Scenario by the beginning of a word in the name of a stimulus; the first match counts."""


def canonical_name(stimulus: str, endings: Sequence[str] = TABLE_ENDINGS) -> str:
    """Return the name of a stimulus without folders, file endings and ``-redyellow``.

    ``-redyellow`` marks the version of a trial with a red agent and a yellow patient; without it,
    tables of both versions can be joined. ``endings`` are removed in their order, each at most
    once: `TABLE_ENDINGS` for names in tables, `FILE_ENDINGS` for names of files.
    """
    name = stimulus.strip().replace("\\", "/").rpartition("/")[2]
    for ending in endings:
        name = name.removesuffix(ending)
    return name.replace("-redyellow", "")


def plain_name(file: str) -> str:
    """Return the canonical name of the stimulus to which an official file of this name belongs."""
    return canonical_name(file, FILE_ENDINGS)


def scenario_of(stimulus: str) -> str | None:
    """Return the scenario of an official test stimulus, or None for any other name."""
    for scenario, names in NAMES.items():
        if scenario != "drape" and stimulus.startswith(names.prefix):
            return scenario
    return "drape" if _DRAPE.match(stimulus) else None


def evaluator_name(stimulus: str, scenario: str) -> str:
    """Return a name in which physion_evaluator finds the scenario of a stimulus, and no dot.

    Official names stay; ``collide_testing_0003`` becomes ``collision_testing_0003``.
    """
    name = canonical_name(stimulus).replace(".", "_")
    if scenario_of(name) == scenario or scenario not in NAMES:
        return name
    return f"{NAMES[scenario].experiment}_{name.removeprefix(scenario).lstrip('_')}"


def is_ledge(stimulus: str) -> bool:
    """Return whether this is a Roll stimulus with a ledge; the study excludes these."""
    return stimulus.startswith(f"{NAMES['roll'].prefix}simple_ledge_")


def guess_scenario(stimulus: str, controller: str, folders: Sequence[str]) -> str | None:
    """Return the scenario of any official trial, or None if nothing tells it.

    Unlike `scenario_of`, which knows only the test stimuli, this looks for a word in the name of
    the stimulus, then at the controller of its metadata, then at the names of its folders.
    """
    for word, scenario in _WORDS.items():
        if re.search(rf"(?:^|[_-]){word}", stimulus, re.IGNORECASE):
            return scenario
    for scenario, name in CONTROLLERS.items():
        if controller == name:
            return scenario
    if re.fullmatch(r"test\d+_\d{4}", stimulus):
        return "drape"
    titles = {title.lower(): scenario for scenario, title in FOLDERS.items()}
    return next((titles[name.lower()] for name in folders if name.lower() in titles), None)
