"""The verbs of the command line: what they do, their modules, and the examples of their help.

Modules are imported when a verb is used, so that ``physion --help`` answers at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from types import ModuleType

VERBS = {
    "run": "run the whole pipeline: scenes, trials, models, readout, comparison, report",
    "generate": "sample scenes and write trials",
    "replay": "simulate official command logs and compare with the recorded outcomes",
    "train": "train models on trials",
    "evaluate": "train models and readouts on trials and write their predictions",
    "check": "test whether predictions depend on what follows, names, order or outcomes",
    "compare": "compare predictions with people",
    "judge": "judge generated movies: contact, paths, permanence, against truth and people",
    "experiment": "run the experiment with people: init, serve, export",
    "view": "write a page that shows a dataset: movies, passes, motion in 3D",
    "export": "write the official layout, formats of others, or a dataset card",
    "import": "convert official HDF5 files, movies, or a checkout of the original study",
    "verify": "check every byte, label and motion of a dataset",
    "ls": "list scenarios, presets, shapes, props, materials, models, decisions, rooms, engines",
    "doctor": "check this machine and print what to install, or measure it",
}

MODULES = {
    "import": "import_trials",
    "experiment": "experiment.experiment",
}
"""Modules of verbs that are Python keywords, have sub-verbs or stand in a folder."""

EXAMPLES: dict[str, tuple[str, ...]] = {
    "run": (
        "physion run --limit 4 --models constant-motion,gns",
        "physion run --sampled --limit 2 --out runs/try",
    ),
    "generate": (
        "physion generate trials --scenario collide --split readout --count 20",
        "physion generate trials --split all --full --workers 16",
    ),
    "judge": (
        "physion judge movies trials",
        "physion judge movies trials --scenario collide --out runs/collide --json",
    ),
    "replay": (
        "physion replay --scenario drop --limit 20",
        "physion replay --engines physion,mujoco --json replay.json",
    ),
    "train": (
        "physion train gns trials --option steps=1000",
        "physion train gns,dpi trials --protocols all,all-but,only --seeds 3 --dry-run",
    ),
    "evaluate": (
        "physion evaluate gns,constant-motion trials --out runs/models",
        "physion evaluate my_model.py:MyEncoder trials",
    ),
    "check": (
        "physion check my_model.py:MyEncoder",
        "physion check gns trials --trials 40 --changes future,names",
    ),
    "compare": (
        "physion compare runs/models/predictions/*.csv --humans official",
        "physion compare --responses study/export/trials.csv",
        "physion compare --check predictions.csv --humans official",
        "physion compare --published --out runs/published",
    ),
    "experiment": ("physion experiment init study --trials trials --contact ada@example.org",),
    "experiment init": (
        "physion experiment init study --trials trials --contact ada@example.org --test 80",
        "physion experiment init study --scenes official --contact ada@example.org",
        "physion experiment init study --trials trials --contact ada@example.org --preset paper",
    ),
    "experiment serve": ("physion experiment serve study --port 8080",),
    "experiment links": ("physion experiment links study --source prolific",),
    "experiment simulate": ("physion experiment simulate study --participants 50",),
    "experiment export": ("physion experiment export study --no-simulated",),
    "experiment describe": ("physion experiment describe study",),
    "experiment backup": ("physion experiment backup study --out backups",),
    "experiment forget": ("physion experiment forget study --participant 5f0c1e",),
    "view": (
        "physion view trials --scenario collide",
        "physion view trials --predictions gns",
        'physion view trials --mark "drop_testing_0003=a block flickers"',
    ),
    "export": (
        "physion export trials official-files --layout official",
        "physion export trials --layout card --creator 'A. Author' --license CC-BY-4.0",
    ),
    "import": (
        "physion import official-files trials --split testing",
        "physion import CHECKOUT study",
    ),
    "verify": (
        "physion verify trials --again 20",
        "physion verify trials --against trials-of-another-machine",
    ),
    "ls": ("physion ls models", "physion ls presets"),
    "doctor": (
        "physion doctor --reproduce",
        "physion doctor --bench --scenario drop --count 10 --json",
    ),
}
"""Command lines that ``--help`` prints, by verb, or verb and sub-verb; tests parse each."""


def module_of(verb: str) -> ModuleType:
    """Return the module of a verb; it has ``Options`` and ``main(options)``."""
    return import_module(f"physion.cli.{MODULES.get(verb, verb)}")


def find_module(args: Sequence[str]) -> tuple[ModuleType, int]:
    """Return the module of the verb that ``args`` start with, and 1, or 2 for a sub-verb."""
    module = module_of(args[0])
    if args[1:2] and args[1] in getattr(module, "SUBVERBS", {}):
        return import_module(module.SUBVERBS[args[1]]), 2
    return module, 1


def describe(text: str | None, names: Sequence[str]) -> str:
    """Return the description of a verb, which is ``text``, followed by its examples."""
    examples = EXAMPLES.get(" ".join(names), ())
    lines = "\n".join(f"  {example}" for example in examples)
    return f"{(text or '').strip()}\n\nExamples:\n{lines}" if lines else text or ""
