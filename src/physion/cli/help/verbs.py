"""Verbs of the command line and their modules, which are imported when a verb is used."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from types import ModuleType

VERBS = {
    "run": "run the whole pipeline: scenes, trials, models, readout, comparison, report",
    "generate": "sample scenes and write trials",
    "replay": "simulate official command logs and compare with the recorded outcomes",
    "train": "train models on trials, without labels",
    "evaluate": "train models and readouts on trials and write their predictions",
    "compare": "compare predictions with people",
    "experiment": "run the experiment with people: init, serve, export",
    "view": "write a page that shows a dataset: movies, passes, motion in 3D",
    "export": "write the official layout, webdataset shards, or a dataset card",
    "import": "convert official HDF5 files and movies to trials",
    "import-official": "convert a checkout of the original study: scenes, outcomes, people",
    "verify": "check every byte, label and motion of a dataset",
    "ls": "list scenarios, presets, shapes, props, materials, models, readers, engines",
    "doctor": "check this machine and print what to install",
    "bench": "measure this machine: simulation, rendering, trials",
    "completion": "print a script that completes verbs and options in the shell",
}

MODULES = {
    "import": "import_trials",
    "import-official": "official.import_official",
    "run": "run.run",
    "compare": "compare.compare",
    "experiment": "experiment.experiment",
    "completion": "help.completion",
    "bench": "bench.bench",
}
"""Modules of verbs that are Python keywords, have sub-verbs or stand in a folder."""


def module_of(verb: str) -> ModuleType:
    """Return the module of a verb; it has ``Options`` and ``main(options)``."""
    return import_module(f"physion.cli.{MODULES.get(verb, verb)}")


def find_module(args: Sequence[str]) -> tuple[ModuleType, int]:
    """Return the module of the verb that ``args`` start with, and 1, or 2 for a sub-verb."""
    module = module_of(args[0])
    if args[1:2] and args[1] in getattr(module, "SUBVERBS", {}):
        return import_module(module.SUBVERBS[args[1]]), 2
    return module, 1
