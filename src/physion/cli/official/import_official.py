"""Convert a checkout of the original study to the folder that the package itself ships with.

The folder holds scenes with their recorded outcomes, labels, answers of people and published
tables. --scenes, --humans and replay take it in place of `official`.
"""

from __future__ import annotations

import dataclasses
import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physion.cli.output import console
from physion.data.make import make_official


@dataclass(frozen=True)
class Options:
    """Options of ``physion import-official``."""

    checkout: Annotated[Path, tyro.conf.Positional]
    """Folder with command logs and human_accuracy-*.csv of the original study, at any depth."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder to write."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Write the folder and print what it holds."""
    made = make_official(options.checkout, options.out)
    if options.json:
        print(json_module.dumps(dataclasses.asdict(made), default=str))
        return 0
    for note in made.notes:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    console.print(
        f"{made.trials} scenes, {made.stimuli} labels, {made.answered} stimuli with answers: "
        f"{made.folder}",
        markup=False,
        soft_wrap=True,
    )
    return 0
