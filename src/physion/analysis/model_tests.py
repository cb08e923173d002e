"""Tests of models against each other, calibration, and mixed models of answers and accuracies.

Pairs of models are compared on the stimuli of all scenarios together: McNemar's test of accuracy
and permutations of r (`paired_tests`), differences of every measure with intervals
(`paired_measures`). `fits_of_people` and `fits_of_models` are the mixed models of the report.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.comparison import Comparison
from physion.analysis.intervals import Bootstrap
from physion.analysis.mixed.fit import fit_linear, fit_logistic
from physion.analysis.mixed.result import MixedFit, effect_name
from physion.analysis.people.effects import HYPOTHESES, answer_rows, with_attributes
from physion.analysis.people.results import PeopleResults
from physion.analysis.statistics.paired import (
    MEASURES,
    Difference,
    corrected_p,
    mcnemar_exact,
    paired_difference,
)
from physion.analysis.tables import MEAN, POOLED, in_order
from physion.core.errors import PhysionError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PooledStimuli:
    """Predictions of m models for the s stimuli of all scenarios.

    - ``names``: of the models;
    - ``p_contact``, ``correct`` (m, s): NaN if a model does not predict the stimulus;
    - ``label``, ``p_yes`` (s,): official outcome, and fraction of people who say yes;
    - ``scenario``: of each stimulus, length s.
    """

    names: tuple[str, ...]
    p_contact: Array
    correct: Array
    label: Array
    p_yes: Array
    scenario: tuple[str, ...]


def permutations_of(pairs: int) -> int:
    """Return the number of permutations for so many pairs of models.

    The smallest possible p is one over that number, and Holm's correction multiplies it by the
    number of pairs, so more pairs need more permutations.
    """
    return min(20_000, max(2_000, 40 * pairs))


def pool_comparison(comparison: Comparison) -> PooledStimuli:
    """Pool the stimuli of a comparison with people's averages, or without people."""
    rows = comparison.stimuli.assign(
        correct=comparison.stimuli["predicted"] == comparison.stimuli["label"]
    )

    def by_model(column: str) -> Array:
        wide = rows.pivot(index="model", columns="stimulus", values=column)
        return np.asarray(wide.loc[comparison.names], dtype=np.float64)

    by_stimulus = rows.drop_duplicates("stimulus").set_index("stimulus").sort_index()
    return PooledStimuli(
        names=tuple(comparison.names),
        p_contact=by_model("p_contact"),
        correct=by_model("correct"),
        label=by_stimulus["label"].to_numpy(dtype=np.float64),
        p_yes=by_stimulus["p_yes"].to_numpy(dtype=np.float64),
        scenario=tuple(by_stimulus["scenario"]),
    )


def paired_tests(
    pooled: PooledStimuli, bootstrap: Bootstrap | None = None, permutations: int | None = None
) -> pd.DataFrame:
    """Test accuracy and r of every two models on the stimuli that both predict; one row per pair.

    Parameters
    ----------
    pooled
        Models and people on the stimuli of all scenarios.
    bootstrap
        Level of the intervals, and the seed of the permutations.
    permutations
        Permutations of the test of differences in r; None: `permutations_of` the pairs.

    Returns
    -------
    ``first``, ``second``, ``stimuli``, ``accuracy_difference`` (first - second), ``only_first``,
    ``only_second``, ``p_accuracy`` (McNemar, exact), ``r_difference`` with ``_low``, ``_high``
    (jackknife over stimuli) and ``p_r`` (permutations), from `paired_difference`; ``reason``; and
    of both p the corrected ``_holm`` and ``_bh`` over all pairs of this table.
    """
    draws = bootstrap or Bootstrap()
    pairs = list(combinations(range(len(pooled.names)), 2))
    count = permutations_of(len(pairs)) if permutations is None else permutations
    records = []
    for i, j in pairs:
        first, second = pooled.correct[i], pooled.correct[j]
        shared = np.isfinite(first) & np.isfinite(second)
        counts = mcnemar_exact(first, second)
        r = _difference(pooled, (i, j), shared & np.isfinite(pooled.p_yes), "r", draws, count)
        why = "" if np.isfinite(r.value) else "r: undefined for one of the two"
        records.append(
            {
                "first": pooled.names[i],
                "second": pooled.names[j],
                "stimuli": int(shared.sum()),
                "accuracy_difference": float(np.mean(first[shared] - second[shared]))
                if shared.any()
                else np.nan,
                "only_first": counts.only_first,
                "only_second": counts.only_second,
                "p_accuracy": counts.p if shared.any() else np.nan,
                "r_difference": r.value,
                "r_difference_low": r.low,
                "r_difference_high": r.high,
                "p_r": r.p,
                "reason": why if shared.any() else "no stimulus that both predict",
            }
        )
    columns = ["first", "second", "stimuli", "accuracy_difference", "only_first", "only_second"]
    columns += ["p_accuracy", "r_difference", "r_difference_low", "r_difference_high", "p_r"]
    table = pd.DataFrame(records, columns=[*columns, "reason"])
    for p in ("p_accuracy", "p_r"):
        table[f"{p}_holm"] = corrected_p(table[p], "holm")
        table[f"{p}_bh"] = corrected_p(table[p], "fdr_bh")
    return table


COLUMNS = ("scenario", "measure", "first", "second", "stimuli", "difference", "low", "high", "p",
           "p_holm", "p_bh")  # fmt: skip


def paired_measures(
    pooled: PooledStimuli, bootstrap: Bootstrap | None = None, permutations: int | None = None
) -> pd.DataFrame:
    """Test the differences of every two models in `MEASURES`, by scenario and over all of them.

    Parameters
    ----------
    pooled
        Models and people on the stimuli of all scenarios.
    bootstrap
        Level of the intervals, and the seed of the permutations.
    permutations
        As in `paired_tests`.

    Returns
    -------
    table
        `COLUMNS`: one row per scenario (and `POOLED`), measure and pair on the stimuli that both
        predict: `paired_difference`, and ``p`` corrected over the pairs of the same scenario and
        measure. Empty without people or with one model.
    """
    draws = bootstrap or Bootstrap()
    pairs = list(combinations(range(len(pooled.names)), 2))
    count = permutations_of(len(pairs)) if permutations is None else permutations
    scenarios = in_order(set(pooled.scenario))
    groups = [*scenarios, POOLED] if len(scenarios) > 1 else scenarios
    known = np.isfinite(pooled.p_contact)
    parts = []
    for group in groups:
        members = np.isin(pooled.scenario, scenarios if group == POOLED else [group])
        members &= np.isfinite(pooled.p_yes)
        for measure in MEASURES:
            rows = []
            for i, j in pairs:
                shared = members & known[i] & known[j]
                found = _difference(pooled, (i, j), shared, measure, draws, count)
                rows.append((pooled.names[i], pooled.names[j], int(shared.sum()), *found))
            table = pd.DataFrame(rows, columns=list(COLUMNS[2:9]))
            table = table.assign(
                p_holm=corrected_p(table["p"], "holm"), p_bh=corrected_p(table["p"], "fdr_bh")
            )
            parts.append(table.assign(scenario=group, measure=measure))
    table = pd.concat(parts, ignore_index=True)[list(COLUMNS)]
    return table[table["difference"].notna()].reset_index(drop=True)


def _difference(
    pooled: PooledStimuli,
    pair: tuple[int, int],
    shared: npt.NDArray[np.bool_],
    measure: str,
    draws: Bootstrap,
    permutations: int,
) -> Difference:
    both, label = list(pair), pooled.label[shared]
    right = pooled.correct[both][:, shared] == 1
    return paired_difference(
        measure,
        pooled.p_contact[both][:, shared],
        np.where(right, label, 1 - label),
        pooled.p_yes[shared],
        np.unique(pooled.scenario, return_inverse=True)[1][shared],
        level=draws.level,
        permutations=permutations,
        seed=draws.seed,
    )


# Mixed models of a report: of people's single answers, and of the models' accuracies.

CROSSED = "(1|participant) + (1|stimulus)"


@dataclass(frozen=True)
class MixedTable:
    """Mixed model of the report: its question, formula and fit, or the reason why there is none.

    ``term``: the term whose coefficients are tested together, if the question is about one.
    """

    name: str
    about: str
    formula: str
    fit: MixedFit | None
    reason: str = ""
    term: str = ""

    def table(self) -> pd.DataFrame:
        """Return fixed effects, then standard deviations and correlations of the random ones."""
        if self.fit is None:
            return pd.DataFrame({"term": ["(none)"], "reason": [self.reason]})
        random, pairs = self.fit.random, self.fit.correlations
        names = [
            effect_name(group, effect)
            for group, effect in zip(random["group"], random["effect"], strict=True)
        ]
        parts = [
            self.fit.table,
            random.assign(term=["sd of " + name for name in names])[["term", "levels", "sd"]],
        ]
        if len(pairs):
            words = "r of " + pairs["group"] + ": " + pairs["first"] + ", " + pairs["second"]
            parts.append(pd.DataFrame({"term": words, "r": pairs["r"]}))
        return pd.concat(parts, ignore_index=True)


Fitter = Callable[[str, pd.DataFrame], MixedFit]


def _fitted(
    name: str, about: str, formula: str, fitter: Fitter, rows: pd.DataFrame, term: str = ""
) -> MixedTable:
    """Fit a model; if the fitter refuses, keep its reason."""
    try:
        return MixedTable(name, about, formula, fitter(formula, rows), term=term)
    except PhysionError as error:
        return MixedTable(name, about, formula, None, str(error))


def fits_of_people(people: PeopleResults) -> list[MixedTable]:
    """Fit the preregistered models of single answers, also with random slopes of people, response
    times, and the effect of flags on all complete sessions.
    """
    stimuli = with_attributes(people.tables["by_stimulus"], people.tables["attributes"])
    rows = answer_rows(people.kept.test, stimuli)
    scenario = "scenario + " if rows["scenario"].nunique() > 1 else ""
    fits = [
        _fitted(
            "scenarios",
            "Do people differ between scenarios? Log odds of being right, logistic",
            f"correct ~ {scenario or '1 + '}{CROSSED}",
            fit_logistic,
            rows,
            "scenario" if scenario else "",
        )
    ]
    for key, hypothesis in HYPOTHESES.items():
        fitter = fit_logistic if hypothesis.family == "logistic" else fit_linear
        formula = hypothesis.formula if scenario else hypothesis.formula.replace("scenario + ", "")
        about = f"{key}, preregistered: {hypothesis.about} ({hypothesis.family})"
        fits.append(_fitted(key.lower(), about, formula, fitter, rows))
        own = formula.replace("(1|participant)", f"(1 + {hypothesis.predictor}|participant)")
        about = f"{key} with a slope of {hypothesis.predictor} for each participant"
        fits.append(_fitted(f"{key.lower()}_slopes", about, own, fitter, rows))
    fits.append(_response_times(people, scenario))
    flagged = people.tables["flags"].set_index("session")["flagged"]
    whole = people.whole.test
    whole = whole.assign(flagged=whole["session"].map(flagged).astype(float))
    about = "Effect of a session's flag on being right, all complete sessions, logistic"
    fits.append(
        _fitted("flagged", about, f"correct ~ flagged + {scenario}{CROSSED}", fit_logistic, whole)
    )
    return fits


def _response_times(people: PeopleResults, scenario: str) -> MixedTable:
    """Fit the log-normal model of response times: log milliseconds, linear with crossed intercepts.

    ``scenario``: its term in the formula. Coefficients are differences of the logarithm, so exp(b)
    is the factor by which the median response time changes: ``correct`` for right answers, ``yes``
    for yes, ``hundred`` by 100 trials.
    """
    test = people.kept.test
    rows = test.assign(
        correct=test["correct"].astype(np.float64),
        yes=test["yes"].astype(np.float64),
        hundred=test["trial"].to_numpy(dtype=np.float64) / 100,
    )
    about = "Response times, log-normal: right answers, yes, and practice by 100 trials (linear)"
    formula = f"log_rt ~ correct + yes + hundred + {scenario}{CROSSED}"
    return _fitted("response_times", about, formula, fit_linear, rows)


def fits_of_models(comparison: Comparison) -> list[MixedTable]:
    """Fit linear models of accuracy by model and scenario, as the study compared models.

    Coefficients are differences to the model, and the readout, that comes first in the files. Each
    row is the accuracy of one model in one scenario.
    """
    scores = comparison.scores
    rows = scores[~scores["scenario"].isin([MEAN, POOLED])]
    if len(comparison.names) < 2 or rows["scenario"].nunique() < 2:
        return []
    rows = rows[["model", "base_model", "readout", "scenario", "accuracy"]]
    # The first in the files, not in the alphabet, is the base level.
    rows = rows.assign(
        model=pd.Categorical(rows["model"], categories=comparison.names),
        readout=pd.Categorical(rows["readout"], categories=rows["readout"].unique()),
    )
    fits = [
        _fitted(
            "models",
            f"Do models differ in accuracy? Linear, each against {comparison.names[0]}, "
            "the first in the files",
            "accuracy ~ model + (1|scenario)",
            fit_linear,
            rows,
            "model",
        )
    ]
    if rows["readout"].nunique() > 1 and rows["base_model"].nunique() > 1:
        first = rows["readout"].cat.categories[0]
        fits.append(
            _fitted(
                "readouts",
                f"Does the readout matter? Linear, against {first}, the first in the files",
                "accuracy ~ readout + (1|scenario) + (1|model)",
                fit_linear,
                rows,
                "readout",
            )
        )
    return fits
