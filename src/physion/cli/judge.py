"""Judge generated movies: does red touch yellow in them, and how do they differ from the truth?

Their contacts are compared with true outcomes and with answers of people. `physion export --layout
conditioning` writes what movies are generated from. Exit code 1: a movie is missing or cannot be
judged.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physion.analysis.tables import records
from physion.cli.output import (
    Stages,
    print_line,
    print_scores,
    print_warnings,
    text_table,
)
from physion.compute.run_tasks import ExecutorSettings
from physion.judging.judge import judge
from physion.judging.result import described, verdict

SHOWN = 5


@dataclass(frozen=True)
class Options:
    """Options of ``physion judge``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with card.json and the movies SEED/TRIAL.mp4."""
    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset that the movies were generated from."""
    out: Path = Path("runs/judge")
    """Folder for page, tables, and the measures of each movie."""
    split: str = "testing"
    """Split of the trials that must be there."""
    scenario: str | None = None
    """Only the trials of this scenario."""
    workers: int = ExecutorSettings.workers
    """Number of processes."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Print the measures and the comparison with people, and write the pages."""
    with Stages() as stages:
        done = judge(
            options.folder, options.dataset, options.out, split=options.split,
            scenario=options.scenario, progress=stages,
            executor=ExecutorSettings(workers=options.workers).open(),
        )  # fmt: skip
    page, missing = done.report(options.out), done.missing
    report = page.parent / "report" / "report.html"
    print_warnings([*done.warnings, *done.compared.warnings])
    if options.json:
        values = {"complete": done.complete, "page": str(page), "report": str(report)}
        values |= {"unknown": list(done.unknown)}
        values |= {
            name: records(table) for name, table in (("movies", done.movies), ("seeds", done.seeds))
        }
        print(json_module.dumps(values))
        return 1 if len(missing) else 0
    for row in missing.head(SHOWN).itertuples():
        print_line(f"missing: {row.trial}, seed {row.seed}: {row.status}")
    if len(missing) > SHOWN:
        print_line(f"... and {len(missing) - SHOWN} more ({done.paths['movies']})")
    print_line(text_table(described(done)))
    print_scores(done.compared, report)
    print_line(verdict(done))
    print_line(f"page: {page}")
    return 1 if len(missing) else 0
