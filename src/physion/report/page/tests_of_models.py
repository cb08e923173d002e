"""Parts of the page with tests: models against each other, mixed models, calibration."""

from __future__ import annotations

from html import escape

import numpy as np
import pandas as pd

from physion.analysis.mixed.result import effect_name
from physion.analysis.models.mixed_fits import MixedTable
from physion.analysis.models.model_tests import permutations_of
from physion.report.inputs import ReportInputs
from physion.report.page.blocks import PageColumn, details, paragraph, rows_table
from physion.report.words import number


def tests(inputs: ReportInputs) -> str:
    """Return paired tests of models, then mixed models."""
    parts = []
    if inputs.paired is not None:
        parts += ["<h3>Models against each other</h3>", _paired(inputs.paired)]
    if inputs.paired_measures is not None and len(inputs.paired_measures):
        parts.append(_paired_measures(inputs.paired_measures))
    if inputs.mixed:
        parts.append("<h3>Mixed models</h3>")
        parts.append(paragraph(_MIXED))
        parts += [_mixed(model) for model in inputs.mixed]
    return "\n".join(parts)


_MIXED = (
    "Random intercepts and slopes as the formula says. Logistic models: maximum likelihood by "
    "Laplace approximation, Wald z. Linear models: restricted maximum likelihood, t with degrees "
    "of freedom by Satterthwaite. b of a logistic model is in log odds. Rows of one model and "
    "scenario that differ in readout or training share their stimuli, which the models of "
    "accuracies do not know: their p are too small; the paired tests above do without that."
)


def _paired(rows: pd.DataFrame) -> str:
    """Return a summary as text, and the table of all pairs."""
    counts = {
        key: (
            int((rows[f"{key}_holm"] < 0.05).sum()),
            int((rows[f"{key}_bh"] < 0.05).sum()),
            int(rows[key].notna().sum()),
        )
        for key in ("p_accuracy", "p_r")
    }
    words = (
        "Every two models on the stimuli that both answered, all scenarios together. Accuracy: "
        "exact test of McNemar. r with the average person: permutation test that swaps the two "
        f"models stimulus by stimulus ({permutations_of(len(rows))} permutations), jackknife "
        "interval over stimuli. Correction over all pairs: by "
        "Holm (chance of any false alarm) and by Benjamini and Hochberg (share of false alarms). "
        f"Of {counts['p_accuracy'][2]} pairs, {counts['p_accuracy'][0]} differ in accuracy by "
        f"Holm and {counts['p_accuracy'][1]} by Benjamini and Hochberg (5 %); of "
        f"{counts['p_r'][2]}, {counts['p_r'][0]} and {counts['p_r'][1]} in r."
    )
    columns = [
        PageColumn("first", "first", "text"),
        PageColumn("second", "second", "text"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn("accuracy, first less second", "accuracy_difference", digits=3),
        PageColumn("only first right", "only_first", "count"),
        PageColumn("only second right", "only_second", "count"),
        PageColumn("p", "p_accuracy", "p"),
        PageColumn("Holm", "p_accuracy_holm", "p"),
        PageColumn("B-H", "p_accuracy_bh", "p"),
        PageColumn("r, first less second", "r_difference", "interval"),
        PageColumn("p", "p_r", "p"),
        PageColumn("Holm", "p_r_holm", "p"),
        PageColumn("B-H", "p_r_bh", "p"),
    ]
    if rows["r_difference"].isna().all():
        columns = columns[:9]
    listing = rows_table(rows, columns)
    if len(rows) > 10:
        listing = details(f"All {len(rows)} pairs", listing)
    return paragraph(words) + listing


def _paired_measures(rows: pd.DataFrame) -> str:
    """Return a summary by scenario and measure, and the table of all pairs over all scenarios."""
    counts = rows.assign(
        holm=rows["p_holm"] < 0.05, pairs=1, measure=rows["measure"].map(_MEASURES)
    )
    summary = counts.groupby(["scenario", "measure"], sort=False)[["pairs", "holm"]].sum()
    columns = [
        PageColumn("scenario", "scenario", "text"),
        PageColumn("measure", "measure", "text"),
        PageColumn("pairs", "pairs", "count"),
        PageColumn("differ (Holm, 5 %)", "holm", "count"),
    ]
    words = (
        "Permutation tests that swap two models stimulus by stimulus, in each scenario and over "
        "all of them; every pair with its interval is in tables/paired_measures.csv"
    )
    last = counts[counts["scenario"] == counts["scenario"].iloc[-1]]
    pair = [
        PageColumn("first", "first", "text"),
        PageColumn("second", "second", "text"),
        PageColumn("measure", "measure", "text"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn("first less second", "difference", "interval", 3, "low", "high"),
        PageColumn("p", "p", "p"),
        PageColumn("Holm", "p_holm", "p"),
        PageColumn("B-H", "p_bh", "p"),
    ]
    name = str(last["scenario"].iloc[0])
    return details("RMSD, kappa and r by scenario", rows_table(
        summary.reset_index(), columns, words
    ) + rows_table(last, pair, f"Every pair: {name}"))  # fmt: skip


_MEASURES = {"rmsd": "RMSD", "kappa_from_averages": "kappa, from averages", "r": "r"}


def _mixed(model: MixedTable) -> str:
    formula = f"<p><code>{escape(model.formula)}</code></p>"
    if model.fit is None:
        return details(f"{model.about}: not fitted", formula + paragraph(model.reason))
    fit = model.fit
    rows = fit.table.assign(
        term=fit.table["term"].str.replace(r"(\w+)\[T\.(.*)\]", r"\1: \2", regex=True)
    )
    columns = [
        PageColumn("term", "term", "text"),
        PageColumn("b", "b", "interval", 3, "low", "high"),
        PageColumn("SE", "se", digits=3),
        PageColumn("z", "z"),
        PageColumn("t", "t"),
        PageColumn("df", "df", digits=1),
        PageColumn("p", "p", "p"),
    ]
    logistic = "z" in rows
    known = [c for c in columns if c.key in rows and not (logistic and c.key == "df")]
    spreads = ", ".join(
        f"{effect_name(row['group'], row['effect'])} {number(row['sd'], 3)} ({int(row['levels'])})"
        for _, row in fit.random.iterrows()
    )
    note = f"{fit.rows} rows, {fit.left_out} left out; standard deviations (levels): {spreads}"
    for _, row in fit.correlations.iterrows():
        note += f"; correlation of {row['first']} and {row['second']} by {row['group']}: "
        note += number(row["r"])
    note = ". ".join([note, *fit.warnings]) + "."
    listing = rows_table(rows, known) + f'<p class="note">{escape(note)}</p>'
    return details(f"{model.about}{_together(model)}", formula + listing)


def _together(model: MixedTable) -> str:
    """Return the test that all coefficients of the model's term are zero, as text."""
    if model.fit is None or not model.term:
        return ""
    test = model.fit.joint_test(model.term)
    p = "p < 0.001" if test.p < 0.001 else f"p = {number(test.p, 3)}"
    if np.isinf(test.df2):
        return f". All together: χ²({test.df1}) = {number(test.statistic * test.df1, 1)}, {p}"
    return f". All together: F({test.df1}, {number(test.df2, 1)}) = {number(test.statistic)}, {p}"


def calibration(inputs: ReportInputs) -> str:
    """Brier score and its parts, a row a model."""
    rows = inputs.calibration
    if rows is None:
        return ""
    columns = [
        PageColumn("model", "model", "text"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn("Brier", "brier", digits=3),
        PageColumn("reliability", "reliability", digits=3),
        PageColumn("resolution", "resolution", digits=3),
        PageColumn("uncertainty", "uncertainty", digits=3),
        PageColumn("within bins", "within", digits=3),
        PageColumn("skill", "skill", digits=3),
        PageColumn("calibration error", "calibration_error", digits=3),
    ]
    words = (
        "Brier score = reliability − resolution + uncertainty + within bins (ten of equal width); "
        "skill is 1 − Brier / uncertainty, above 0 where a model beats the base rate"
    )
    known = rows.replace([np.inf, -np.inf], np.nan)
    return details("Brier score and its parts", rows_table(known, columns, words))
