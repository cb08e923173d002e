"""Report of a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from physion.cli.run.options import Options
    from physion.cli.run.plan import RunPlan


def write_report(
    options: Options, folder: Path, plan: RunPlan, predictions: list[Path]
) -> tuple[Path, list[dict[str, Any]]]:
    """Write the report; return its page and the table of scores."""
    import pandas as pd

    from physion.cli.output import print_warnings
    from physion.core.names import canonical_name
    from physion.report.build import compare_files
    from physion.report.html import movies_of
    from physion.trials.dataset import Dataset

    dataset = Dataset(folder / "trials")
    page = compare_files(
        predictions,
        options.humans,
        {canonical_name(name): contact for name, contact in plan.recorded.items()} or None,
        folder / "report",
        methods=methods(options, dataset.index),
        movies=movies_of(dataset.folder),
        question="Will the red object touch the yellow one?",
        trial_pages=options.trial_pages,
    )
    warnings = json.loads((page.parent / "report.json").read_text(encoding="utf-8"))["warnings"]
    print_warnings(warnings)
    scores = pd.read_csv(page.parent / "tables" / "comparison.csv")
    return page, json.loads(scores.to_json(orient="records"))


def methods(options: Options, index: Any) -> dict[str, str]:
    """Return the settings of a run as texts for the report."""
    splits = index.groupby("split").size()
    counts = ", ".join(f"{count} {split}" for split, count in splits.items())
    source = "sampled by this package" if options.sampled else "official scenes"
    return {
        "Scenes": f"{source}; trials: {counts}; movies of {options.size} x {options.size} pixels",
        "Readout": "one L2 logistic regression per scenario on standardised features, C from 17 "
        "values in 1e-8 to 1e8 by stratified 5-fold cross-validation on readout trials",
        "Training": f"models that learn: {options.steps} steps on the readout trials, no labels",
        "Noise of the simulation": f"{options.samples} simulations per trial from the true state "
        "at the end of the observed part; the noise scale is fitted on readout trials alone",
        "Engine": ", ".join(sorted(set(index["engine"]))),
        "Renderer": ", ".join(sorted(set(index["renderer"]))),
    }
