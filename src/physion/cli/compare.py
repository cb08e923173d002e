"""Compare predictions with people and write the report: tables, figures, one page.

`physion compare FILES... --humans DIR`: the comparison and its report (the options below).

`physion compare official DIR`: the published numbers beside those that can be recomputed.

`physion compare validate FILE...`: checks files of predictions and names each bad row.

`physion compare leaderboard FILES...`: one table of many files, sorted by any column.

A file that is called like one of these words is meant by ./official and so on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

SUBVERBS = {
    "official": "physion.cli.compare_official",
    "validate": "physion.cli.compare_validate",
    "leaderboard": "physion.cli.compare_leaderboard",
}
"""First words that stand for a verb of their own, and its module."""


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
    from physion.cli.output import console
    from physion.report.build import compare_files

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
