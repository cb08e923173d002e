"""Plans on the command line: a table of tasks with their estimated time, or JSON."""

from __future__ import annotations

import json as json_module
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from physion.cli.output import console, text_table
from physion.readout.plans.estimates import DONE, MEASURED, duration

if TYPE_CHECKING:
    from physion.readout.plans.estimates import Estimate
    from physion.readout.plans.evaluation_plan import EvaluationPlan

Row = dict[str, Any]
"""Columns of a task; ``seconds`` is None where the time is not known, ``from`` what it is from."""


def estimates_table(estimates: Sequence[Estimate]) -> list[Row]:
    """Return a row for each training of a plan."""
    return [
        {
            "model": each.task.choice.name,
            "protocol": each.task.protocol.value,
            "trained on": each.task.planned.name,
            "seed": each.task.seed,
            "fold": each.task.planned.fold if each.task.planned.fold >= 0 else None,
            "trials": len(each.task.planned.trials),
            "steps": each.steps,
            "seconds": each.seconds,
            "from": each.source,
        }
        for each in estimates
    ]


def evaluations_table(plan: EvaluationPlan) -> list[Row]:
    """Return a row for each evaluation of a plan."""
    rows = []
    for task in plan.tasks:
        seconds = 0.0 if task.key in plan.done else plan.expected_seconds(task)
        source = "earlier evaluations" if seconds is not None else "not known"
        rows.append(
            {
                "model": task.choice.name,
                "protocol": task.protocol.value if task.set_name else None,
                "trained on": task.set_name or None,
                "seed": task.seed,
                "seconds": seconds,
                "from": DONE if task.key in plan.done else source,
            }
        )
    return rows


def print_estimates(rows: Sequence[Row], what: str, json: bool) -> None:
    """Print the tasks of a plan, and below them how many are to be done, in what time."""
    left = [row for row in rows if row["from"] != DONE]
    known = [row["seconds"] for row in left if row["seconds"] is not None]
    whole = sum(known) if len(known) == len(left) else None
    if json:
        print(json_module.dumps({"plan": list(rows), "seconds": whole}))
        return
    import pandas as pd

    shown = pd.DataFrame([{**row, "seconds": _time(row)} for row in rows], dtype=object).rename(
        columns={"seconds": "time", "from": "estimated from"}
    )
    _line(text_table(shown.dropna(axis="columns", how="all")))
    total = "" if whole is None else f", about {duration(whole)}"
    missing = len(left) - len(known)
    total = (
        total if not missing else f", about {duration(sum(known))} and {missing} of unknown time"
    )
    _line(f"{len(left)} of {len(rows)} {what} to do{total}")
    if any(row["from"] == MEASURED for row in rows):
        _line(
            f"{MEASURED}: without validation, checkpoints and what follows the last step; on one "
            "device"
        )


def _time(row: Row) -> str:
    if row["from"] == DONE:
        return "-"
    return "?" if row["seconds"] is None else duration(row["seconds"])


def _line(text: str) -> None:
    console.print(text, markup=False, soft_wrap=True)
