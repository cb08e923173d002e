"""Check a model, and the page of a check: how much predictions moved when trials were changed.

`physion.readout.check` does the work.
The page stands here, since `readout` may not import `report`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError
from physion.core.files import write_atomic
from physion.core.html import Markup, joined
from physion.models.interface import Model
from physion.readout.check import (
    NOT_CHECKED,
    PASSED,
    REFUSED,
    SHOWN,
    CheckedModel,
    check_model,
)
from physion.readout.settings import EvaluationSettings, choose_models
from physion.readout.tables import file_name
from physion.report.html import MACROS, notes, paragraph, render_document
from physion.trials.dataset import Dataset


@dataclass(frozen=True)
class CheckResult(CheckedModel):
    """Result of `check`.

    - ``model``: its name. ``table``: a row for every change and readout, with the columns
      `physion.readout.check.COLUMNS`.
    - ``warnings``: why the check could say less than it should, in sentences.
    """

    def report(self, folder: Path | str) -> Path:
        """Write the page of the check, ``MODEL.html``, and return its path."""
        path = Path(folder) / f"{file_name(self.model)}.html"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, _page(self).encode())
        return path


def check(
    model: str | Path | Model,
    dataset: Dataset | Path | str | None = None,
    out: Path | str = "runs/check",
    settings: EvaluationSettings | None = None,
    *,
    options: Mapping[str, Any] | None = None,
    trials: int = 80,
    changes: Sequence[str] = (),
    executor: Executor | None = None,
    progress: Progress | None = None,
    **fields: Any,
) -> CheckResult:
    """Test whether predictions of a model depend on what they must not depend on.

    The model is evaluated on some trials and on changed copies of them; it is not trained.

    Parameters
    ----------
    model
        Name of a model (``physion ls models``), ``FILE.py:Class``, or a model.
    dataset
        Labelled trials, or the path of their folder. Without it, trials of Collide and Drop are
        made in ``out/trials``.
    out
        Folder for these trials and for the copies, which are deleted.
    settings
        Settings of the evaluations, as of `physion.evaluate`. Without readouts, all that the model
        supports are checked but *full*, which is checked if there is no other.
    options
        Options of the model.
    trials
        About how many trials are taken, half of them to fit the readout: rounded down for each
        scenario, but at least 2 of either half.
    changes
        Names of the changes to make (`physion.readout.changes.CHANGES`); by default all, and
        evaluations of two other models.
    executor, progress
        As of `physion.evaluate`.
    **fields
        Fields of `EvaluationSettings` to replace in ``settings``.

    Returns
    -------
    CheckResult
        A table with a verdict for every change, and whether the model passed.

    Raises
    ------
    UnknownNameError
        For an unknown model, option or change.
    BadInputError
        If the model cannot be built or evaluated, or there are too few trials.
    """
    chosen = choose_models(model, options)
    if len(chosen) != 1:
        raise BadInputError("one model is checked at a time")
    settings = dataclasses.replace(settings or EvaluationSettings(), **fields)
    done = check_model(
        chosen[0],
        dataset,
        Path(out),
        settings,
        trials=trials,
        changes=changes,
        executor=executor,
        progress=progress,
    )
    return CheckResult(done.model, done.table, done.warnings)


def described(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table of a check (`physion.readout.check.COLUMNS`) as texts."""
    shown = pd.DataFrame({"change": table["change"], "readout": table["readout"]})
    counts = zip(table["moved"], table["trials"], strict=True)
    shown["moved"] = ["" if pd.isna(moved) else f"{moved:.0f} of {of}" for moved, of in counts]
    none = table["accuracy"].isna()  # nothing was predicted anew
    for name, title in (("largest", "by at most"), ("mean", "on average")):
        shown[title] = [f"{value:.2g}" for value in table[name]]
    both = zip(table["accuracy"], table["accuracy_changed"], strict=True)
    shown["accuracy"] = [f"{before:.3f} -> {after:.3f}" for before, after in both]
    shown.loc[none, ["by at most", "on average", "accuracy"]] = ""
    shown["verdict"] = table["verdict"]
    return shown


def _page(done: CheckedModel) -> str:
    """Return the page of a check: the verdict, and one line for every change and readout."""
    table = done.table
    shown = described(table)
    rows = [
        [str(what), *(str(cell) for cell in cells)]
        for what, cells in zip(table["what"], shown.to_numpy(), strict=True)
    ]
    kinds = {
        "must not move a prediction": table["verdict"].isin([PASSED, REFUSED]),
        "may move predictions": table["verdict"] == SHOWN,
        "not possible for a table of features": table["verdict"] == NOT_CHECKED,
    }
    groups = [
        (name, [row for row, yes in zip(rows, chosen, strict=True) if yes])
        for name, chosen in kinds.items()
        if chosen.any()
    ]
    changes = Markup(MACROS.table(["what was changed", *shown.columns], groups))
    explained = paragraph(
        "Moved: tested trials whose P(contact) is not the same as before; then the largest and the "
        "mean absolute change, and the accuracy before and after. Only tested trials were changed."
    )
    because = [f"{r.change}, {r.readout}: {r.note}" for r in table.itertuples() if r.note]
    lead = joined([paragraph(done.verdict, "lead"), changes, explained, notes(because)])
    return render_document(f"Check of {done.model}", lead, [])
