"""Page of a check: what was changed in trials, and how much the predictions of a model moved."""

from __future__ import annotations

import pandas as pd

from physion.core.html import Markup, joined
from physion.report.html import MACROS, notes, paragraph, render_document


def described(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table of a check (`physion.readout.check.COLUMNS`) as texts."""
    shown = pd.DataFrame({"change": table["change"], "readout": table["readout"]})
    shown["moved"] = [f"{m} of {n}" for m, n in zip(table["moved"], table["trials"], strict=True)]
    for name, title in (("largest", "by at most"), ("mean", "on average")):
        shown[title] = [f"{value:.2g}" for value in table[name]]
    both = zip(table["accuracy"], table["accuracy_changed"], strict=True)
    shown["accuracy"] = [f"{before:.3f} -> {after:.3f}" for before, after in both]
    shown["verdict"] = table["verdict"]
    return shown


def check_page(model: str, verdict: str, table: pd.DataFrame) -> str:
    """Return the page of a check: the verdict, and one line for every change and readout.

    - ``model``: its name. ``verdict``: the result in one line.
    - ``table``: of `physion.readout.check.check`.
    """
    shown = described(table)
    rows = [
        [str(what), *(str(cell) for cell in cells)]
        for what, cells in zip(table["what"], shown.to_numpy(), strict=True)
    ]
    judged = table["verdict"].isin(["passed", "refused"])
    groups = [
        ("must not move a prediction", [row for row, yes in zip(rows, judged, strict=True) if yes]),
        ("may move predictions", [row for row, yes in zip(rows, judged, strict=True) if not yes]),
    ]
    changes = Markup(MACROS.table(["what was changed", *shown.columns], groups))
    explained = paragraph(
        "Moved: tested trials whose P(contact) is not the same as before; then the largest and the "
        "mean absolute change, and the accuracy before and after. Only tested trials were changed."
    )
    because = [f"{r.change}, {r.readout}: {r.note}" for r in table.itertuples() if r.note]
    lead = joined([paragraph(verdict, "lead"), changes, explained, notes(because)])
    return render_document(f"Check of {model}", lead, [])
