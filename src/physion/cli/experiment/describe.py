"""Write the preregistration of a study and the figure of its trials, from settings and texts.

Both are made by init too; run it again after study.toml, texts or stimuli have changed.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment describe``."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study, into which preregistration.md and trial.svg are written."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Write the documents; print their paths."""
    from physion.cli.output import print_line
    from physion.experiment.export.documents import write_documents
    from physion.experiment.study.study import load_study

    plan, figure = write_documents(load_study(options.study))
    if options.json:
        print(json_module.dumps({"preregistration": str(plan), "figure": str(figure)}))
    else:
        print_line(f"preregistration: {plan}")
        print_line(f"figure of a trial: {figure}")
    return 0
