"""The paper's claims in numbers, recomputed: regressions of the Results section, and the summary.

The printed numbers come from linear mixed models of the accuracies in the released table, fitted in
R with lmerTest. Which rows and terms each model had follows from the released notebook and from the
numbers themselves, which are reproduced to the printed digit:

- an earlier state of the table held most runs *twice* (1728 rows of readouts A, B, C; the released
  one has 1008): all but the runs of the particle models and of the second file of SVG. Some printed
  numbers were made from that state, which increases t by up to the square root of two;
- several sentences have the number of another comparison: see `Claim.differs`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy import stats

from physion.analysis.intervals import LEVEL
from physion.analysis.mixed import fit_linear
from physion.analysis.published.tables import (
    END_TO_END,
    NOT_MADE,
    PARTICLES,
    PRETRAINED,
    SELECTION,
    PublishedTables,
    accuracy_and_kappa,
    accuracy_table,
    describe_averages,
    figure_s1,
    figure_s3,
    panel_a,
    panel_c,
    panel_d,
    panel_e,
    people_by_scenario,
    people_claims,
)
from physion.core.errors import BadInputError

VISION = (*END_TO_END, *PRETRAINED)
PVGG = ("pVGG-mlp", "pVGG-lstm")
PDEIT = ("pDEIT-mlp", "pDEIT-lstm")
PEOPLE = "people"

Rows = Literal["twice", "once"]


@dataclass(frozen=True)
class Contrast:
    """Comparison of accuracies: accuracy ~ x + a random intercept for each of ``groups``.

    ``models``: whose rows. ``column``, ``high``: x is 1 if the column has one of these values and 0
    else. ``readouts``, ``trainings``: the rows to take (empty: all). ``further``: more values of
    the column that get terms of their own, so that x is compared with the rest. ``intercept``: the
    tested term is the intercept, not x. ``chance``: there is no x, the mean is tested against 0.5.
    """

    text: str
    models: tuple[str, ...]
    column: str = "model"
    high: tuple[str, ...] = ()
    groups: tuple[str, ...] = ("scenario", "readout", "training")
    readouts: tuple[str, ...] = ()
    trainings: tuple[str, ...] = ()
    further: tuple[str, ...] = ()
    intercept: bool = False


@dataclass(frozen=True)
class Claim:
    """Sentence of the paper with a number.

    ``printed``: b, t and p as printed, if they are; ``run``: the comparison that was made, on the
    state ``rows`` of the table; ``asked``: the comparison that the sentence describes (None: the
    same one); ``differs``: the difference, as text.
    """

    name: str
    sentence: str
    printed: Mapping[str, str]
    run: Contrast
    rows: Rows = "once"
    asked: Contrast | None = None
    differs: str = field(default="")


CLAIMS = (
    Claim(
        "people above chance",
        "Human performance was substantially above chance across all eight scenarios",
        {"b": "0.71", "t": "27.5", "p": "<1e-7"},
        Contrast(
            "intercept of particle models with a term for people: the mean of the particle "
            "models, against 0",
            (*PARTICLES, PEOPLE),
            high=(PEOPLE,),
            groups=("scenario",),
            intercept=True,
        ),
        asked=Contrast(
            "mean of people over scenarios, against 0.5", (PEOPLE,), groups=(), intercept=True
        ),
        differs="0.71 is the accuracy of the particle models and not of people, and its t is "
        "against 0 and not against chance; people have 0.747",
    ),
    Claim(
        "OP3 and CSWM",
        "SVG performed nearly at chance levels; OP3 performed marginally better; CSWM "
        "significantly outperformed both",
        {"b": "0.06", "t": "7.6", "p": "<1e-11"},
        Contrast("CSWM against OP3", ("CSWM", "OP3"), high=("CSWM",)),
        asked=Contrast("OP3 against SVG", ("SVG", "OP3"), high=("OP3",)),
        differs="the number stands after OP3 but is of CSWM against OP3. OP3 is far less accurate "
        "than SVG only when readout full, which sees the outcome, is pooled in (see the row below)",
    ),
    Claim(
        "OP3 and SVG, predicting",
        "OP3 performed marginally better, under the readout of the main figure",
        {},
        Contrast(
            "OP3 against SVG, readout observed+simulated",
            ("SVG", "OP3"),
            high=("OP3",),
            groups=("scenario", "training"),
            readouts=("observed+simulated",),
        ),
        differs="not in the paper: under this readout no difference is shown; in panel D, with "
        "only seed 0 of SVG, OP3 is the more accurate one under observed+simulated and observed",
    ),
    Claim(
        "RPIN and CSWM",
        "RPIN was only more accurate than CSWM when trained with the all-but and only protocols",
        {"b": "0.035", "t": "3.7", "p": "<1e-3"},
        Contrast(
            "RPIN against CSWM, all three trainings",
            ("RPIN", "CSWM"),
            high=("RPIN",),
            groups=("scenario", "training"),
        ),
        asked=Contrast(
            "RPIN against CSWM, trainings all-but and only",
            ("RPIN", "CSWM"),
            high=("RPIN",),
            trainings=("all-but", "only"),
        ),
        differs="the number is over all three trainings and without a term for the readout; t is "
        "3.75, where 3.7 is printed",
    ),
    Claim(
        "RPIN and CSWM, all",
        "but not the all protocol",
        {},
        Contrast(
            "RPIN against CSWM, training all",
            ("RPIN", "CSWM"),
            high=("RPIN",),
            groups=("scenario", "readout"),
            trainings=("all",),
        ),
        differs="no number is printed",
    ),
    Claim(
        "pVGG and CSWM, RPIN",
        "pVGG-mlp/lstm significantly outperformed the best fully TDW-trained models (CSWM, RPIN)",
        {"b": "0.015", "t": "2.9", "p": "<0.01"},
        Contrast(
            "pVGG against CSWM and RPIN",
            (*PVGG, "CSWM", "RPIN"),
            high=PVGG,
            groups=("scenario", "training"),
        ),
        rows="twice",
        asked=Contrast("pVGG against CSWM and RPIN", (*PVGG, "CSWM", "RPIN"), high=PVGG),
        differs="rows twice and no term for the readout; with readout observed+simulated only "
        "the difference has the other sign (see the row below)",
    ),
    Claim(
        "pVGG and CSWM, RPIN, predicting",
        "the same, under the readout of the main figure",
        {},
        Contrast(
            "pVGG against CSWM and RPIN, readout observed+simulated",
            (*PVGG, "CSWM", "RPIN"),
            high=PVGG,
            groups=("scenario", "training"),
            readouts=("observed+simulated",),
        ),
        differs="not in the paper: what is left of the claim where models predict",
    ),
    Claim(
        "pDEIT and pVGG",
        "pVGG were themselves outperformed by models with ImageNet-pretrained Transformer "
        "encoders (pDeIT-mlp/lstm)",
        {"b": "0.067", "t": "16.5", "p": "<1e-15"},
        Contrast(
            "models whose column “Visual encoder architecture” says Transformer (pDEIT and, by "
            "mistake, pVGG) against the models that it calls ConvNet (only SVG)",
            ("SVG", *PRETRAINED),
            column="encoder",
            high=("Transformer",),
        ),
        asked=Contrast("pDEIT against pVGG", PRETRAINED, high=PDEIT),
        differs="the released table calls pVGG a Transformer, so that the number compares pVGG "
        "and pDEIT together with SVG; pDEIT against pVGG is a third of it",
    ),
    Claim(
        "observed+simulated and observed",
        "Vision model predictions from observed+simulated were no better than from observed",
        {"p": "=0.53"},
        Contrast(
            "observed against observed+simulated, the four models trained end to end",
            END_TO_END,
            column="readout",
            high=("observed",),
            groups=("scenario", "training"),
            readouts=("observed", "observed+simulated"),
        ),
        rows="twice",
        asked=Contrast(
            "observed against observed+simulated, all eight vision models",
            VISION,
            column="readout",
            high=("observed",),
            groups=("scenario", "training"),
            readouts=("observed", "observed+simulated"),
        ),
        differs="rows twice, and without the four pretrained models",
    ),
    Claim(
        "full readout",
        "the full readout protocol yielded significantly higher accuracy for the vision models",
        {"b": "0.094", "t": "12.0", "p": "<1e-15"},
        Contrast(
            "full against observed and observed+simulated, the four models trained end to end",
            END_TO_END,
            column="readout",
            high=("full",),
            groups=("scenario", "training"),
        ),
        asked=Contrast(
            "full against observed and observed+simulated, all eight vision models",
            VISION,
            column="readout",
            high=("full",),
            groups=("scenario", "training"),
        ),
        differs="t is met without the four pretrained models, b is not: 0.064 where 0.094 is "
        "printed, perhaps a slip of a digit; no comparison that was tried gives both",
    ),
    Claim(
        "only and all",
        "vision-based models performed only slightly better when trained with the only protocol",
        {"b": "0.21", "t": "4.4", "p": "<1e-4"},
        Contrast(
            "only against all, all models",
            (*VISION, *PARTICLES),
            high=("only",),
            further=("all-but",),
            column="training",
            groups=("scenario",),
        ),
        rows="twice",
        asked=Contrast(
            "only against all, all eight vision models",
            VISION,
            high=("only",),
            further=("all-but",),
            column="training",
            groups=("scenario", "readout"),
        ),
        differs="rows twice, particle models included, no term for the readout; 0.21 is a slip "
        "for 0.021",
    ),
    Claim(
        "all-but and all",
        "and not significantly worse when trained with the all-but protocol",
        {"b": "0.009", "t": "1.9", "p": "=0.057"},
        Contrast(
            "all-but against all, all models",
            (*VISION, *PARTICLES),
            high=("all-but",),
            further=("only",),
            column="training",
            groups=("scenario",),
        ),
        rows="twice",
        asked=Contrast(
            "all-but against all, all eight vision models",
            VISION,
            high=("all-but",),
            further=("only",),
            column="training",
            groups=("scenario", "readout"),
        ),
        differs="rows twice, particle models included, no term for the readout; the printed "
        "number leaves out the sign",
    ),
)
"""In the order of the paper. Section and numbers: Bear et al. (2021), Results and Discussion."""


# Regressions of the paper's Results section: as printed, as they were run, as they read.

SINGLE_FILE = "_seed_0_1_2"
"""In the name of the file of SVG's runs that the earlier state of the table held once."""

CHANCE = 0.5

ESTIMATES = ("b", "se", "t", "df", "p", "rows")
"""Slope (fraction of correct answers), its standard error, t = b / se, Satterthwaite's degrees of
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
    record |= {"compared": claim.run.text, "state": f"rows {claim.rows}"}
    for fit, values in found.items():
        record |= {f"{fit}_{name}": values[name] for name in ESTIMATES}
    met = _met(claim, found["run"])
    return {**record, "asked": asked.text, "met": met, "differs": claim.differs}


def contrast_rows(contrast: Contrast, tables: PublishedTables, rows: Rows) -> pd.DataFrame:
    """Return the rows that a contrast compares, with ``x`` and one column ``further_…`` a further
    term.
    """
    people = tables.people[["scenario", "accuracy"]].assign(model=PEOPLE)
    table = pd.concat([released_state(tables.runs, rows), people], ignore_index=True)
    table = table[table["model"].isin(contrast.models)]
    for column, wanted in (("readout", contrast.readouts), ("training", contrast.trainings)):
        if wanted:
            table = table[table[column].isin(wanted)]
    table = table.assign(x=table[contrast.column].isin(contrast.high).astype(np.float64))
    for at, value in enumerate(contrast.further):
        table[f"further_{at}"] = (table[contrast.column] == value).astype(np.float64)
    if table.empty or (contrast.high and table["x"].nunique() < 2):
        raise BadInputError(f"the released tables hold nothing to compare: {contrast.text}")
    return table.reset_index(drop=True)


def fit_contrast(contrast: Contrast, tables: PublishedTables, rows: Rows) -> dict[str, float]:
    """Return the `ESTIMATES` of one contrast on one state of the table."""
    table = contrast_rows(contrast, tables, rows)
    if not contrast.groups:
        return _test_against_half(table["accuracy"])
    terms = ["x", *(name for name in table.columns if str(name).startswith("further_"))]
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


# Published results of the original study, recomputed from its released tables.

TITLES = {
    "accuracies": "Accuracy of models by scenario: as published, and trained on all scenarios with "
    "readout observed+simulated",
    "panel_a": "Panel A: accuracy",
    "panel_c": "Panel C: Cohen's kappa with participants",
    "panel_d": "Panel D: accuracy by readout",
    "panel_e": "Panel E: accuracy by training",
    "accuracy_kappa": "How kappa with participants follows accuracy",
    "figure_s1": "Figure S1, top: accuracy of people by stimulus",
    "figure_s3": "Figure S3: accuracy of DPI and of people by scenario",
    "not_made": "Figures that the released tables do not determine",
    "regressions": "Regressions of the Results section",
    "people": "People by scenario",
    "people_claims": "What the paper says of people",
    "left_out": "Rows left out",
}
"""The tables in the order in which a report shows them."""

REGRESSIONS = (
    "Linear mixed models of accuracy, REML, degrees of freedom by Satterthwaite, as the released "
    "notebook has them. “run” is what the printed number was computed from; “once” the same with "
    "each released row once; “asked” what the sentence says, each row once. Rows of one model and "
    "scenario that differ in readout or seed share their test stimuli and are not independent, "
    "which none of these models knows: their p are too small."
)

ACCURACY_KAPPA = (
    "The paper says that kappa is strongly correlated with accuracy, without a number. Pearson's "
    "r over the cells of panels A and C; intervals draw models with all of their scenarios. Kappa "
    "with people is bound to rise with accuracy where people are mostly right, so this r is no "
    "sign of likeness beyond the outcome."
)


@dataclass(frozen=True)
class PublishedResults:
    """Results: ``tables`` by the names of `TITLES`, and their ``descriptions``."""

    tables: Mapping[str, pd.DataFrame]
    descriptions: Mapping[str, str]


def results_of(released: PublishedTables) -> PublishedResults:
    """Recompute all results from the released tables."""
    tables = {
        "accuracies": accuracy_table(released),
        "panel_a": panel_a(released),
        "panel_c": panel_c(released),
        "panel_d": panel_d(released),
        "panel_e": panel_e(released),
        "accuracy_kappa": accuracy_and_kappa(released),
        "figure_s1": figure_s1(released),
        "figure_s3": figure_s3(released),
        "not_made": pd.DataFrame(list(NOT_MADE.items()), columns=["figure", "reason"]),
        "regressions": published_regressions(released),
        "people": people_by_scenario(released),
        "people_claims": people_claims(released),
        "left_out": released.dropped,
    }
    descriptions = {
        "accuracies": describe_averages(released)
        + f" Intervals: {LEVEL:.0%}, of a published value a bootstrap over the rows that it "
        "averages, and next to it by the paper's way, which draws the rows of the whole table, "
        "ungrouped; of the expected cell Wilson's for the stimuli tested.",
        "panels": SELECTION,
        "accuracy_kappa": ACCURACY_KAPPA,
        "regressions": REGRESSIONS,
        "people": "Accuracy, kappa and split-half r from the released tables by scenario; kappa is "
        "the median over pairs; split-half r is of halves (half_r_full: stepped up to all people). "
        "Counts and accuracy_by_stimulus are from the tables by stimulus, whose exclusion is laxer "
        "by up to eight people.",
    }
    return PublishedResults(tables, descriptions)
