"""Regressions of the paper's Results section: as printed, as they were run, as they read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from physion.analysis.mixed.linear import fit_linear
from physion.analysis.published.claims import CLAIMS, PEOPLE, Claim, Contrast, Rows
from physion.analysis.published.tables import PARTICLES, PublishedTables
from physion.core.errors import BadInputError

SINGLE_FILE = "_seed_0_1_2"
"""In the name of the file of SVG's runs that the earlier state of the table held once."""

CHANCE = 0.5

ESTIMATES = ("b", "se", "t", "df", "p", "rows")
"""Slope (share of correct answers), its standard error, t = b / se, Satterthwaite's degrees of
freedom, two-sided p, rows fitted."""

FITS = ("run", "once", "asked")
"""What was run for the paper; the same with each row once; what the sentence asks for, each row
once."""


def published_regressions(tables: PublishedTables) -> pd.DataFrame:
    """Return one row for each number of the paper.

    Columns: ``claim``, ``sentence``; ``printed_b``, ``printed_t``, ``printed_p`` (as printed, else
    empty); ``compared`` (what the number compares) and ``state`` (rows twice or once); for each of
    `FITS` its `ESTIMATES`, as ``run_b`` and so on; ``asked`` (what the sentence would compare);
    ``met`` (printed figures that ``run`` reproduces after rounding, and those it does not),
    ``differs`` (the difference, as text).
    """
    records = [_record(claim, tables) for claim in CLAIMS]
    columns = ["claim", "sentence", "printed_b", "printed_t", "printed_p", "compared", "state"]
    columns += [f"{fit}_{name}" for fit in FITS for name in ESTIMATES]
    return pd.DataFrame(records).reindex(columns=[*columns, "asked", "met", "differs"])


def released_state(runs: pd.DataFrame, rows: Rows) -> pd.DataFrame:
    """Return the rows of readouts A, B, C: each once, or as often as in the earlier state."""
    kept = runs[runs["readout"].isin(("full", "observed+simulated", "observed"))]
    if rows == "once":
        return kept
    single = kept["model"].isin(PARTICLES) | kept["file"].str.contains(SINGLE_FILE, regex=False)
    return kept.loc[kept.index.repeat(np.where(single, 1, 2))].reset_index(drop=True)


def _record(claim: Claim, tables: PublishedTables) -> dict[str, Any]:
    asked = claim.asked or claim.run
    run = fit_contrast(claim.run, tables, claim.rows)
    once = run if claim.rows == "once" else fit_contrast(claim.run, tables, "once")
    same = claim.asked is None
    found = {
        "run": run,
        "once": once,
        "asked": once if same else fit_contrast(asked, tables, "once"),
    }
    record: dict[str, Any] = {"claim": claim.name, "sentence": claim.sentence}
    record |= {f"printed_{key}": claim.printed.get(key, "") for key in ("b", "t", "p")}
    record |= {"compared": claim.run.words, "state": f"rows {claim.rows}"}
    for fit, values in found.items():
        record |= {f"{fit}_{name}": values[name] for name in ESTIMATES}
    met = _met(claim, found["run"])
    return {**record, "asked": asked.words, "met": met, "differs": claim.differs}


def contrast_rows(contrast: Contrast, tables: PublishedTables, rows: Rows) -> pd.DataFrame:
    """Return the rows that a contrast compares, with ``x`` and one column ``beside_…`` a further
    term.
    """
    people = tables.people[["scenario", "accuracy"]].assign(model=PEOPLE)
    table = pd.concat([released_state(tables.runs, rows), people], ignore_index=True)
    table = table[table["model"].isin(contrast.models)]
    for column, wanted in (("readout", contrast.readouts), ("training", contrast.trainings)):
        if wanted:
            table = table[table[column].isin(wanted)]
    table = table.assign(x=table[contrast.column].isin(contrast.high).astype(np.float64))
    for at, value in enumerate(contrast.beside):
        table[f"beside_{at}"] = (table[contrast.column] == value).astype(np.float64)
    if table.empty or (contrast.high and table["x"].nunique() < 2):
        raise BadInputError(f"the released tables hold nothing to compare: {contrast.words}")
    return table.reset_index(drop=True)


def fit_contrast(contrast: Contrast, tables: PublishedTables, rows: Rows) -> dict[str, float]:
    """Return the `ESTIMATES` of one contrast on one state of the table."""
    table = contrast_rows(contrast, tables, rows)
    if not contrast.groups:
        return _test_against_half(table["accuracy"])
    terms = ["x", *(name for name in table.columns if str(name).startswith("beside_"))]
    groups = [f"(1|{name})" for name in contrast.groups]
    fit = fit_linear(" ".join(["accuracy ~", " + ".join([*terms, *groups])]), table)
    row = fit.table.set_index("term").loc["Intercept" if contrast.intercept else "x"]
    return {**{name: float(row[name]) for name in ESTIMATES[:-1]}, "rows": float(fit.rows)}


def _test_against_half(values: pd.Series) -> dict[str, float]:
    test = stats.ttest_1samp(values, CHANCE)
    mean = float(values.mean())
    return {"b": mean, "se": float(values.sem()), "t": float(test.statistic),
            "df": float(len(values) - 1), "p": float(test.pvalue), "rows": len(values)}  # fmt: skip


def _met(claim: Claim, fit: dict[str, float]) -> str:
    """Return which printed figures the fit reproduces after rounding, as text; empty without a
    number.
    """
    met: list[str] = []
    missed: list[str] = []
    for name in ("b", "t", "p"):
        text = claim.printed.get(name, "")
        if text:
            (met if _meets(abs(fit[name]), text) else missed).append(name)
    words = [f"{', '.join(met)} met"] if met else []
    return "; ".join(words + ([f"{', '.join(missed)} not met"] if missed else []))


def _meets(value: float, printed: str) -> bool:
    """Return whether a value rounds to what is printed, or is less than a printed bound."""
    if printed.startswith("<"):
        return value < float(printed[1:])
    number = printed.removeprefix("=")
    decimals = len(number.partition(".")[2])
    return round(value, decimals) == float(number)
