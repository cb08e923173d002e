"""Summary of an export to, or import from, the official layout."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from physion.cli.output import console

if TYPE_CHECKING:
    from physion.compute.run_tasks import RunReport

SHOWN_NOTES = 5


def print_report(report: RunReport, as_json: bool) -> int:
    """Print the report as one JSON object or as text, and return the exit code."""
    if as_json:
        values = {"made": report.made, "kept": report.kept, "failed": dict(report.failed)}
        values |= {"notes": dict(report.notes), "index": str(report.index)}
        print(json.dumps(values))
        return report.exit_code
    for name, reason in report.failed.items():
        console.print(f"failed: {name}: {reason}", markup=False, soft_wrap=True)
    notes = [f"{name}: {note}" for name, texts in report.notes.items() for note in texts]
    for note in notes[:SHOWN_NOTES]:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    if len(notes) > SHOWN_NOTES:
        more = len(notes) - SHOWN_NOTES
        console.print(f"... and {more} more notes (--json lists all)", markup=False)
    done = f"{len(report.made)} made, {len(report.kept)} kept, {len(report.failed)} failed"
    console.print(f"{done}: {report.index}", markup=False, soft_wrap=True)
    return report.exit_code
