"""Claims of the paper's Results section, tested on models of this package.

Two kinds of models: those with the weights of the package, whose scores stand in ``results``
(official_all.csv, small.txt) and which saw all scenarios; and those that `paper_table` trains under
every protocol. Their accuracies become tables like the released ones, so that the contrasts of
`physion.analysis.published` and the figures of `physion.report` take all of them. A contrast is

    accuracy = b x + a random intercept for each of scenario, readout and training,

as the paper has it: b with Satterthwaite's t. A pretrained encoder of the paper is replaced by the
one whose ImageNet weights are here. `paper_page` shows the result.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physion.analysis.comparison import ANOTHER, Comparison, compare_scores
from physion.analysis.figure_tables import MEASURE_COLUMNS, generalization_table, r_table
from physion.analysis.model_tests import accuracy_rows
from physion.analysis.published.claims import (
    CLAIMS,
    PEOPLE,
    VISION,
    Claim,
    Contrast,
    contrast_rows,
    fit_contrast,
)
from physion.analysis.published.tables import (
    END_TO_END,
    PARTICLES,
    PRETRAINED,
    PublishedTables,
    accuracy_and_kappa,
)
from physion.analysis.tables import ALL_BUT, MEAN, ONLY, name_models
from physion.core.errors import PhysionError
from physion.core.names import SCENARIOS
from physion.data.official import PACKAGED
from physion.report.compare import read_averages

RESULTS = Path(__file__).parents[1] / "results"
SMALL = RESULTS / "small.txt"
NAMES = {
    "cswm": "CSWM", "dpi": "DPI", "rpin": "RPIN", "svg": "SVG", "op3": "OP3", "gns": "GNS",
    "pEffNetLite0-mlp": "pEffNetLite0-mlp", "pEffNetLite0-lstm": "pEffNetLite0-lstm",
    "gns-ransac": "GNS-R",
}  # fmt: skip
"""Models that can be trained here, and their names in the released tables."""
STORED = {f"{verb}-small": name for verb, name in NAMES.items()}
STORED |= {f"{verb}-small (ImageNet)": name for verb, name in NAMES.items()}
"""Names in the stored scores of weights that ship."""
IMAGENET = ("pEffNetLite0-mlp", "pEffNetLite0-lstm")
"""Encoders with ImageNet weights here, in the place of the paper's."""
GENERALISED = ("cswm", "rpin", "dpi")
"""Models that are tested on other scenarios than the one of their training."""
TESTED = ("official", "own")
"""Sets that are tested: the stimuli that people saw, and own trials."""
SIMULATED = "observed+simulated"
LEVEL = 0.05
NOT_COMPUTED = "not computed"
NEITHER = "neither"
"""Verdict where the difference is significant neither there nor here."""
ACROSS = "trained on another scenario"
MORE = (
    *(
        Claim(
            f"particle models, {training}",
            f"Particle models are above guessing when trained under *{training}*",
            {},
            Contrast("particle models, against 0.5", PARTICLES, groups=(), trainings=(training,),
                     intercept=True),
        )
        for training in ("all", ALL_BUT, ONLY)
    ),
    Claim(
        "CSWM and SVG, OP3",
        "C-SWM is more accurate than SVG and OP3",
        {},
        Contrast("C-SWM against SVG and OP3", ("SVG", "OP3", "CSWM"), high=("CSWM",)),
    ),
    Claim(
        "particle and vision models",
        "Models that are given particles are right more often than vision models, on average",
        {},
        Contrast("particle against vision models", (*VISION, *PARTICLES), high=PARTICLES,
                 groups=("scenario", "training"), readouts=(SIMULATED,)),
    ),
    Claim(
        "DPI-Net and people",
        "DPI-Net is as accurate as people over all scenarios",
        {},
        Contrast("DPI-Net, all trainings, against people", ("DPI", PEOPLE), high=("DPI",),
                 groups=("scenario",)),
    ),
    Claim(
        "full, ImageNet encoders",
        "Encoders of ImageNet gain most from the whole movie: gain of these",
        {},
        Contrast("full against observed", PRETRAINED, column="readout", high=("full",),
                 groups=("scenario", "training"), readouts=("observed", "full")),
    ),
    Claim(
        "full, trained end to end",
        "Encoders of ImageNet gain most from the whole movie: gain of models without them",
        {},
        Contrast("full against observed", END_TO_END, column="readout", high=("full",),
                 groups=("scenario", "training"), readouts=("observed", "full")),
    ),
    Claim(
        "only and all, particle models",
        "Protocols differ more for particle models: *only* against *all*",
        {},
        Contrast("only against all", PARTICLES, column="training", high=(ONLY,), further=(ALL_BUT,),
                 groups=("scenario",)),
    ),
    Claim(
        ACROSS,
        "Models trained on one scenario do not carry over to most others",
        {},
        Contrast("tested on another scenario against their own",
                 tuple(NAMES[name] for name in GENERALISED), column="training", high=(ANOTHER,),
                 groups=("scenario", "model"), readouts=(SIMULATED,)),
    ),
)  # fmt: skip
"""Further claims, in our words, of which the paper prints no number."""


@dataclass(frozen=True)
class Tested:
    """Scores of models on a set of tested trials, as tables like the released ones.

    - ``tables``: with the protocols of the paper. ``across``: only what was tested under *one*.
    - ``r``: of *all* and *observed+simulated* (`figure_tables.MEASURE_COLUMNS`); ``matrices``: of
      generalisation; both may be empty. ``trials``: how many were tested.
    """

    tables: PublishedTables
    across: PublishedTables
    r: pd.DataFrame
    matrices: pd.DataFrame
    trials: int


def tested_of(predictions: pd.DataFrame, released: PublishedTables, *, people: bool) -> Tested:
    """Return the scores of predictions; with ``people`` also their likeness to people."""
    rows = name_models(predictions)
    humans, labels = None, None
    if people:
        humans, labels, *_ = read_averages(PACKAGED)
    comparison = compare_scores(rows, humans, labels)
    runs = accuracy_rows(comparison, rows)
    by_model = rows.drop_duplicates("model").set_index("model")
    scores = comparison.scores.set_index(["model", "scenario"])
    keys = pd.MultiIndex.from_frame(runs[["model", "scenario"]])
    kappa = scores.reindex(columns=["kappa_from_averages"]).reindex(keys)
    runs = runs.assign(
        protocol=runs["model"].map(by_model["protocol"]),
        seed=runs["model"].map(by_model["seed"]).astype(int),
        model=runs["base_model"],
        kappa=kappa["kappa_from_averages"].to_numpy(np.float64),
    )
    r, matrices = pd.DataFrame(), pd.DataFrame()
    seen = None
    if people:
        seen = comparison.people.set_index("scenario")["accuracy"]
        matrices = _matrices(comparison, rows)
        shown = (by_model["protocol"] == "all") & (by_model["readout"] == SIMULATED)
        names = by_model.loc[shown, "base_model"].to_dict()
        r = r_table(comparison)
        r = r[r["model"].isin(names)].replace({"model": names})
    one = runs["protocol"] == "one"
    tables = _like_released(released, runs[~one], seen)
    across = replace(tables, runs=_like_released(released, runs[one], seen).runs)
    return Tested(tables, across, r, matrices, rows["stimulus"].nunique())


def _like_released(
    released: PublishedTables, runs: pd.DataFrame, people: pd.Series | None
) -> PublishedTables:
    """Return runs as released tables, with people on the same stimuli (by scenario), or nobody."""
    seen = released.people
    known = {} if people is None else people.to_dict()
    seen = seen.assign(accuracy=seen["scenario"].map(known)).dropna(subset=["accuracy"])
    runs = runs.assign(kappa_low=np.nan, kappa_high=np.nan)
    return replace(released, runs=runs, people=seen)


def _matrices(comparison: Comparison, rows: pd.DataFrame) -> pd.DataFrame:
    """Return `generalization_table` of the models that are tested on other scenarios."""
    chosen = [NAMES[name] for name in GENERALISED]
    rows = rows[(rows["readout"] == SIMULATED) & rows["base_model"].isin(chosen)]
    kept = comparison.stimuli["model"].isin(rows["model"])
    if not kept.any():
        return pd.DataFrame()
    table = generalization_table(replace(comparison, stimuli=comparison.stimuli[kept]), rows)
    return table.assign(model=table["model"].str.replace(f" · {SIMULATED}", "", regex=False))


def stored_official(released: PublishedTables) -> Tested:
    """Return the scores of shipped weights on official stimuli (``official_all.csv``).

    The file is ``tables/comparison.csv`` of `physion compare`.
    """
    scores = pd.read_csv(RESULTS / "official_all.csv").drop(columns="kind")
    scores = scores.assign(model=scores["base_model"].map(STORED)).dropna(subset=["model"])
    rows = scores[scores["scenario"].isin(SCENARIOS)]
    runs = rows[["model", "scenario", "readout", "accuracy"]].assign(
        training="all", seed=0, kappa=rows["kappa_from_averages"]
    )
    people = rows.drop_duplicates("scenario").set_index("scenario")
    shown = scores[(scores["readout"] == SIMULATED) & scores["scenario"].isin([*SCENARIOS, MEAN])]
    names = {"scenario": "panel", "readout": "kind", "r": "value", "r_low": "low",
             "r_high": "high", "ceiling": "people"}  # fmt: skip
    none = {"people_is": "ceiling", "zone_low": np.nan, "zone_high": np.nan, "zone": ""}
    r = shown.rename(columns=names).assign(**none)[list(MEASURE_COLUMNS)]
    tables = _like_released(released, runs, people["human_accuracy"])
    trials = int(people["stimuli"].sum())
    return Tested(tables, replace(tables, runs=runs.iloc[:0]), r, pd.DataFrame(), trials)


def stored_own(released: PublishedTables) -> Tested:
    """Return the accuracies of shipped weights on own trials (``small.txt``)."""
    cells = r"(.+?)\s{2,}.*\s(observed|observed\+simulated|full)\s+(\w+)\s+\d+\s+(\d+)\s+(\d\.\d+)"
    found = [m.groups() for m in map(re.compile(cells).match, SMALL.read_text().split("\n")) if m]
    columns = ["model", "readout", "scenario", "trials", "accuracy"]
    rows = pd.DataFrame(found, columns=columns).astype({"trials": int, "accuracy": float})
    rows = rows.assign(model=rows["model"].map(STORED)).dropna(subset=["model"])
    runs = rows[rows["scenario"].isin(SCENARIOS)].assign(training="all", seed=0, kappa=np.nan)
    tables = _like_released(released, runs.drop(columns="trials"), None)
    trials = int(runs.drop_duplicates("scenario")["trials"].sum())
    none = pd.DataFrame()
    return Tested(tables, replace(tables, runs=runs.iloc[:0]), none, none, trials)


def here(contrast: Contrast) -> Contrast:
    """Return a contrast with the encoders of ImageNet that are here in place of the paper's."""

    def renamed(names: tuple[str, ...]) -> tuple[str, ...]:
        ours = [IMAGENET if name in PRETRAINED else (name,) for name in names]
        return tuple(dict.fromkeys(name for part in ours for name in part))

    return replace(contrast, models=renamed(contrast.models), high=renamed(contrast.high))


def fitted(contrast: Contrast, tables: PublishedTables) -> dict[str, Any]:
    """Return the estimates of a contrast and its ``models``, or ``reason`` why there are none.

    Readouts and trainings are compared in the models that have all of those that any has. A random
    intercept for what has one value only is left out.
    """
    try:
        if contrast.column in ("readout", "training"):
            rows = contrast_rows(contrast, tables, "once")
            counts = rows.groupby("model")[contrast.column].nunique()
            complete = tuple(m for m in contrast.models if counts.get(m, 0) == counts.max())
            contrast = replace(contrast, models=complete)
        rows = contrast_rows(contrast, tables, "once")
        known = set(rows[contrast.column]) if contrast.further else set()
        contrast = replace(contrast, further=tuple(v for v in contrast.further if v in known))
        groups = tuple(name for name in contrast.groups if rows[name].nunique() > 1)
        if contrast.groups and not groups:
            return {"reason": "one scenario only"}
        found = fit_contrast(replace(contrast, groups=groups), tables, "once")
    except PhysionError as error:
        return {"reason": str(error)}
    if not np.isfinite(found["p"]):
        return {"reason": "no test possible with these rows"}
    return {**found, "models": [name for name in contrast.models if name in set(rows["model"])]}


def verdict(paper: Mapping[str, Any], ours: Mapping[str, Any], null: float) -> str:
    """Return how our estimate differs from that of the released tables, in one or two words.

    ``null``: the value that is tested, 0 for a difference.
    """
    if "reason" in ours:
        return NOT_COMPUTED
    if "reason" in paper:
        return "no released value"
    known, shown = paper["p"] < LEVEL, ours["p"] < LEVEL
    if known and shown:
        same = (paper["b"] > null) == (ours["b"] > null)
        return "same" if same else "opposite"
    if known != shown:
        return "not shown here" if known else "shown only here"
    return NEITHER


def words(fit: Mapping[str, Any], *, models: bool) -> str:
    """Return the estimates of a contrast as text."""
    if "reason" in fit:
        return NOT_COMPUTED
    p = "< .001" if fit["p"] < 0.001 else f"= {fit['p']:.3f}".replace("0.", ".")
    b, t = (round(fit[name], digits) + 0.0 for name, digits in (("b", 3), ("t", 1)))  # no -0
    text = f"b {b:.3f}, t({fit['df']:.0f}) = {t:.1f}, p {p}"
    return f"{text}; {', '.join(fit['models'])}" if models else text


def claims(released: PublishedTables, tested: Mapping[str, Tested]) -> pd.DataFrame:
    """Return one row per claim: as published, from the released tables, from own models."""
    records = []
    for claim in (*CLAIMS, *MORE):
        contrast = claim.asked or claim.run
        if contrast.models == (PEOPLE,):
            continue  # no claim about models
        null = 0.5 if not contrast.groups else 0.0
        paper = fitted(contrast, released)
        row = {
            "claim": claim.name,
            "sentence": claim.sentence,
            "compared": here(contrast).text,
            "published": ", ".join(f"{k} {v}" for k, v in claim.printed.items()) or "no number",
            "released": words(paper, models=False),
        }
        for name, of in tested.items():
            ours = fitted(here(contrast), of.across if claim.name == ACROSS else of.tables)
            row |= {name: words(ours, models=True), f"{name}_verdict": verdict(paper, ours, null)}
        records.append(row)
    likeness = {
        "claim": "accuracy and kappa",
        "sentence": "Models that are right more often are more like people",
        "compared": "Pearson's r of kappa with accuracy",
        "published": "no number",
        "released": likeness_of(released),
    }
    for name, of in tested.items():
        likeness |= {name: likeness_of(of.tables), f"{name}_verdict": "see the numbers"}
        if likeness[name] == NOT_COMPUTED:
            likeness[f"{name}_verdict"] = NOT_COMPUTED
    return pd.DataFrame([*records, likeness])


def likeness_of(tables: PublishedTables) -> str:
    """Return how kappa with people follows accuracy, as text."""
    rows = panel_rows(tables)
    if rows["model"].nunique() < 3 or rows["kappa"].isna().any():
        return NOT_COMPUTED
    found = accuracy_and_kappa(averaged(tables))["r"]
    within = f"{found.iloc[-1]:.3f}" if np.isfinite(found.iloc[-1]) else "undefined"
    return f"r {found.iloc[0]:.3f} over models, {within} within a scenario"


def averaged(tables: PublishedTables) -> PublishedTables:
    """Return tables with one run per model, scenario, readout and training: the mean of seeds."""
    keys = ["model", "scenario", "readout", "training"]
    values = ["accuracy", "kappa", "kappa_low", "kappa_high"]
    runs = tables.distinct.groupby(keys, sort=False)[values].mean().reset_index()
    return replace(tables, runs=runs.assign(seed=0))


def panel_rows(tables: PublishedTables) -> pd.DataFrame:
    """Return the runs that the paper's panels A to C show."""
    runs = tables.runs
    return runs[(runs["training"] == "all") & (runs["readout"] == SIMULATED)]
