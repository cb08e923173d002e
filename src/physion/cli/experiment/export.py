"""Export the data of a study: CSV and parquet for the analysis, Psych-DS.

The server may be running; the export is a consistent snapshot.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment export``."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    out: Path | None = None
    """Folder to write; an existing export is replaced. Default: STUDY/export."""
    scenario: str | None = None
    """Export only this scenario."""
    simulated: bool = True
    """Include simulated participants, marked as such."""
    json: bool = False
    """Print the counts as one JSON object."""


def main(options: Options) -> int:
    """Export; print the number of sessions and what was left out."""
    from physion.experiment.export.descriptions import count_lines
    from physion.experiment.export.export_study import export_study
    from physion.experiment.store.database import open_database
    from physion.experiment.study.study import load_study

    study = load_study(options.study)
    engine = open_database(options.study)
    try:
        report = export_study(
            engine,
            study,
            options.out or options.study / "export",
            simulated=options.simulated,
            scenario=options.scenario,
        )
    finally:
        engine.dispose()
    if options.json:
        print(json_module.dumps({"out": str(report.out), **report.facts()}))
        return 0
    print("\n".join([*count_lines(report.facts()), f"export: {report.out}"]))
    return 0
