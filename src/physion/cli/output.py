"""Output of the verbs: results, text tables, progress bars, files that are written atomically.

Text tables are not cut to the width of the terminal, so that they can be searched; the table of
results leaves out columns there.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from physion.core.files import write_atomic

if TYPE_CHECKING:
    import pandas as pd

    from physion.compute.run_tasks import RunReport
    from physion.readout.evaluation import EvaluatedModel
    from physion.report.compare import CompareResult


class OutputConsole(Console):
    """Console that leaves a closed standard output to `physion.cli.main`."""

    def on_broken_pipe(self) -> None:
        """Raise again the `BrokenPipeError` that rich is handling; it would exit with code 1."""
        raise


console = OutputConsole(highlight=False)
"""Console for results; progress goes to standard error, so that output can be piped."""


def _columns() -> tuple[ProgressColumn, ...]:
    return (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )


_LINE_EVERY = 30.0
"""Seconds between lines of progress where there is no terminal."""
_NAMED_AFTER = 2.0
"""Seconds after a line from which on a stage that begins is named at once."""
_KNOWN_AFTER = 5
"""Items after which such a line says how long the rest takes."""


class Stages:
    """Progress bars, one per stage, of work that reports to a `physion.compute.tasks.Progress`.

    If standard error is not a terminal, print progress lines instead of bars; with ``at_once`` also
    when a stage begins.
    """

    def __init__(self, *, at_once: bool = False) -> None:
        self._at_once = at_once
        self._compiling = False

    def __enter__(self) -> Stages:
        self._begun: dict[str, tuple[float, int]] = {}
        self._printed = time.monotonic()
        self._progress = Progress(*_columns(), console=Console(file=sys.stderr), transient=True)
        self._tasks: dict[str, TaskID] = {}
        return self

    def __exit__(self, *_: object) -> None:
        if self._tasks:
            self._progress.stop()

    def note(self, text: str) -> None:
        """Show a line above the bars, which stays, on standard error."""
        self._progress.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def note_evaluated(self, one: EvaluatedModel) -> None:
        """Show the accuracies of a model that has just predicted, one line per readout."""
        if not one.done:
            for name, accuracy in one.accuracies().items():
                self.note(f"{name}: accuracy {accuracy:.3f}")

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` items of a stage are finished."""
        if what == "generating" and not (done or self._compiling or _is_compiled()):
            self._compiling = True
            self.note("compiling machine code, which takes some minutes the first time")
        if not self._progress.console.is_terminal:
            self._print_line(what, done, total)
            return
        # Not started earlier: bars without a stage would still print an empty line when they stop.
        self._progress.start()
        if what not in self._tasks:
            for task in self._progress.tasks:
                self._progress.update(task.id, visible=not task.finished)
            self._tasks[what] = self._progress.add_task(what, total=total)
        self._progress.update(self._tasks[what], completed=done, total=total)

    def _print_line(self, what: str, done: int, total: int) -> None:
        """Print how far a stage is, and how long the rest takes at the speed so far."""
        now = time.monotonic()
        # Of stages that follow each other quickly, only the first is named.
        new = self._at_once and what not in self._begun
        named = new and (not self._begun or now - self._printed >= _NAMED_AFTER)
        since, first = self._begun.setdefault(what, (now, done))
        if now - self._printed < _LINE_EVERY and not named:
            return
        self._printed = now
        made = done - first
        # The first items take longer: code is compiled, workers start.
        known = made >= _KNOWN_AFTER
        left = f", {(now - since) * (total - done) / made:.0f} s left" if known else ""
        self.note(f"{what}: {done} of {total}{left}")


def _is_compiled() -> bool:
    """Return whether the renderer was compiled before, with or without changes since."""
    return any((Path(__file__).parents[1] / "rendering" / "__pycache__").glob("*.nbi"))


def print_line(text: str) -> None:
    """Print a line of results as it is: no markup, not broken at the width of the terminal."""
    console.print(text, markup=False, soft_wrap=True)


def print_warnings(warnings: Iterable[str]) -> None:
    """Print each warning as a line on standard error."""
    for warning in warnings:
        print(f"physion: warning: {warning}", file=sys.stderr)


def print_plan(cells: Sequence[Any], columns: Sequence[str], what: str) -> None:
    """Print fields of what is to be done as a table, and how many of them are not done."""
    import pandas as pd

    rows = [[getattr(cell, name) for name in columns] for cell in cells]
    table = pd.DataFrame(rows, columns=list(columns), dtype=object)
    table["done"] = table["done"].map({True: "yes", False: "no"})
    print_line(text_table(table))
    print_line(f"{sum(not cell.done for cell in cells)} of {len(cells)} {what} to do")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, text.encode())


def counted(number: int, singular: str, plural: str = "") -> str:
    """Return a number with its noun: ``1 fault``, ``2 faults``."""
    return f"{number} {singular if number == 1 else plural or singular + 's'}"


MOST_ROWS = 20
"""Rows of the table of results on the terminal, which with all else has at most 25 lines."""


def print_scores(result: CompareResult, page: Path | None = None, made: str = "") -> None:
    """Print notes and the table of results, in at most 25 lines, then the path of the report."""
    from physion.analysis.results import MARKED, fewest_rows, fitted_elsewhere

    rows = result.results
    # Of notes and lines about readouts, one has room below the most rows.
    more = len(result.notes) + len(fitted_elsewhere(rows)) - 1
    shown = fewest_rows(rows, max(MOST_ROWS - max(more, 0), 1))
    for note in result.notes:
        print_line(f"note: {note}")
    print_line(_results_table(shown, f"People and models: {result.heading}"))
    if (shown["source"] != "").any():
        print_line(MARKED)
    for line in fitted_elsewhere(shown):
        print_line(line)
    if len(rows) > len(shown):
        where = "" if page is None else f": {page.parent / 'tables' / 'results.csv'}"
        print_line(f"{len(rows) - len(shown)} more rows{where}")
    if page is not None:
        print_line(f"report{made}: {page}")


def _results_table(rows: pd.DataFrame, title: str) -> str:
    """Return a table of results as text.

    On a terminal where it is too wide it is without frames or, if need be, without intervals too.
    """
    from physion.report.compare import INTERVALS, as_text

    whole, plain = as_text(rows), as_text(rows, intervals=False)
    text = text_table(whole, title)
    for table, head in ((whole, title), (plain, title.removesuffix(INTERVALS))):
        widest = max(map(len, text.splitlines()[1:]))
        if console.is_terminal and widest > console.width:
            text = text_table(table.drop(columns="frames", errors="ignore"), head)
    return text


def text_table(table: pd.DataFrame, title: str = "") -> str:
    """Return a table as text: a header and one line per row, columns separated by two spaces.

    Numbers have three decimals and are aligned to the right; NaN is an empty cell.
    """
    import pandas as pd

    columns = [[str(name), *map(_cell, table[name])] for name in table.columns]
    widths = [max(map(len, cells)) for cells in columns]
    right = [pd.api.types.is_numeric_dtype(table[name]) for name in table.columns]
    lines = [
        "  ".join(
            cell.rjust(width) if number else cell.ljust(width)
            for cell, width, number in zip(cells, widths, right, strict=True)
        ).rstrip()
        for cells in zip(*columns, strict=True)
    ]
    return "\n".join([*([title] if title else []), *lines])


def _cell(value: object) -> str:
    import pandas as pd

    if value is None or value is pd.NA:
        return ""
    if not isinstance(value, float):
        return str(value)
    if pd.isna(value):
        return ""
    return f"{value:.0f}" if value.is_integer() and abs(value) > 1 else f"{value:.3f}"


SHOWN_NOTES = 5


def print_report(report: RunReport, as_json: bool) -> int:
    """Print which trials were made, kept and failed, as text or JSON; return the exit code."""
    if as_json:
        values = {"made": report.made, "kept": report.kept, "failed": dict(report.failed)}
        values |= {"notes": dict(report.notes), "index": str(report.index)}
        print(json.dumps(values))
        return report.exit_code
    for name, reason in report.failed.items():
        print_line(f"failed: {name}: {reason}")
    notes = [f"{name}: {note}" for name, texts in report.notes.items() for note in texts]
    for note in notes[:SHOWN_NOTES]:
        print_line(f"note: {note}")
    if len(notes) > SHOWN_NOTES:
        more = len(notes) - SHOWN_NOTES
        console.print(f"... and {more} more notes (--json lists all)", markup=False)
    done = f"{len(report.made)} made, {len(report.kept)} kept, {len(report.failed)} failed"
    print_line(f"{done}: {report.index}")
    return report.exit_code
