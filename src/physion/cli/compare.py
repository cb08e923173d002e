"""Compare predictions with people and write the report: tables, figures, one page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physion.cli.output import console
from physion.report.build import compare_files


@dataclass(frozen=True)
class Options:
    """Whom to compare."""

    predictions: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Prediction files with the official column names."""
    humans: Path | None = None
    """Folder with human_accuracy-*.csv."""
    labels: Path | None = None
    """Official outcomes (stim_ID, label); looked for beside the people when not given."""
    exclude: Path | None = None
    """File of stimuli to leave out, one a line."""
    ledge: bool = False
    """Keep the Roll stimuli with a ledge, which the study left out."""
    out: Path = Path("runs/report")
    """Folder for the report."""


def main(options: Options) -> int:
    """Write the report and print where it is."""
    page = compare_files(
        list(options.predictions),
        options.humans,
        options.labels,
        options.out,
        exclude=options.exclude,
        exclude_ledge=not options.ledge,
    )
    console.print(f"report: {page}", markup=False, soft_wrap=True)
    return 0
