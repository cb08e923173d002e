"""Tests of models against each other, calibration, and mixed models of answers and accuracies.

Pairs of models are compared on the stimuli of all scenarios together: McNemar's test of accuracy
and permutations of r (`paired_tests`), differences of every measure with intervals
(`paired_measures`). `fits_of_people` and `fits_of_models` are the mixed models of the report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.comparison import Comparison
from physion.analysis.intervals import Bootstrap, jackknife
from physion.analysis.mixed.fit import fit_linear, fit_logistic
from physion.analysis.mixed.result import MixedFit, effect_name
from physion.analysis.people.effects import HYPOTHESES, answer_rows, with_attributes
from physion.analysis.people.measures import ScenarioAnswers
from physion.analysis.people.results import PeopleResults
from physion.analysis.scores import Models
from physion.analysis.statistics.agreement import correctness, correlation_from_sums
from physion.analysis.statistics.paired import compare_models, corrected_p, swap_coins
from physion.analysis.statistics.regression import calibration_table
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


def pool_scenarios(scored: Sequence[tuple[Models, ScenarioAnswers]]) -> PooledStimuli:
    """Pool the stimuli of several scenarios that single participants answered.

    ``scored`` holds the same models with the answers of people for each scenario.
    """
    return PooledStimuli(
        names=scored[0][0].names,
        p_contact=np.concatenate([models.p_contact for models, _ in scored], axis=1),
        correct=np.concatenate(
            [correctness(models.predicted, answers.label) for models, answers in scored], axis=1
        ),
        label=np.concatenate([answers.label for _, answers in scored]),
        p_yes=np.concatenate([answers.p_yes() for _, answers in scored]),
        scenario=tuple(answers.scenario for _, answers in scored for _ in answers.stimuli),
    )


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
    pooled: PooledStimuli, bootstrap: Bootstrap, permutations: int | None = None
) -> pd.DataFrame:
    """Test every two models with `compare_models`; empty for one model only."""
    pairs = len(pooled.names) * (len(pooled.names) - 1) // 2
    return compare_models(
        list(pooled.names),
        pooled.correct,
        pooled.p_contact,
        pooled.p_yes,
        bootstrap,
        strata=list(pooled.scenario),
        permutations=permutations_of(pairs) if permutations is None else permutations,
    )


def calibration_scores(pooled: PooledStimuli) -> pd.DataFrame:
    """Return `calibration_table` of every model against the official outcomes."""
    return calibration_table(list(pooled.names), pooled.p_contact, pooled.label)


# Paired tests of RMSD, kappa and r of every two models, in each scenario and over all of them.

COLUMNS = ("scenario", "measure", "first", "second", "stimuli", "difference", "low", "high", "p",
           "p_holm", "p_bh")  # fmt: skip


@dataclass(frozen=True)
class SumMeasure:
    """A measure that is a function of sums over stimuli.

    - ``columns``: from P(contact), answers (1 or 0) and P(yes), each (n,), to what is summed
      (n, k);
    - ``value``: from sums (..., k) to the measure (...).
    """

    columns: Callable[[Array, Array, Array], Array]
    value: Callable[[Array], Array]


def _squares(p: Array, answer: Array, people: Array) -> Array:
    return np.stack([np.ones_like(p), (p - people) ** 2], axis=-1)


def _root_mean(sums: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(sums[..., 1], 0.0) / sums[..., 0]))


def _agreements(p: Array, answer: Array, people: Array) -> Array:
    return np.stack([np.ones_like(p), answer, people, answer * people], axis=-1)


def _kappa(sums: Array) -> Array:
    """Return (A - C) / (1 - C), as `metrics.average_person.kappa_from_averages`."""
    answer, people, both = (sums[..., k] / sums[..., 0] for k in (1, 2, 3))
    expected = answer * people + (1 - answer) * (1 - people)
    with np.errstate(divide="ignore", invalid="ignore"):
        kappa = (1 - answer - people + 2 * both - expected) / (1 - expected)
    return np.where(1 - expected > 1e-12, kappa, np.nan)


def _products(p: Array, answer: Array, people: Array) -> Array:
    # Standardised, so that two models whose values spread differently can be swapped.
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (p - p.mean()) / p.std()
    y = people - people.mean()
    return np.stack([np.ones_like(p), x, y, x * x, y * y, x * y], axis=-1)


def _pearson(sums: Array) -> Array:
    return correlation_from_sums(*(sums[..., k] for k in range(6)))


MEASURES: Mapping[str, SumMeasure] = {
    "rmsd": SumMeasure(_squares, _root_mean),
    "kappa_from_averages": SumMeasure(_agreements, _kappa),
    "r": SumMeasure(_products, _pearson),
}
"""What is compared, by the name of its metric."""


def paired_measures(
    pooled: PooledStimuli, level: float = 0.95, permutations: int = 2000, seed: int = 0
) -> pd.DataFrame:
    """Test the differences of every two models in `MEASURES`.

    Parameters
    ----------
    pooled
        Models and people on the stimuli of all scenarios.
    level
        Level of the intervals.
    permutations, seed
        Number of permutations, and the seed of the coins that decide who is swapped.

    Returns
    -------
    table
        `COLUMNS`: one row per scenario (and `POOLED`), measure and pair on the stimuli that both
        predict: ``difference`` (first less second) with its jackknife interval over stimuli, the
        two-sided ``p`` of the permutation test, and ``p`` corrected over the pairs of the same
        scenario and measure. Empty without people or with one model.

    Notes
    -----
    Under the null hypothesis the two models are exchangeable, so for every stimulus they are
    swapped with probability 1/2. p = (1 + count of |difference| as large) / (1 + permutations).
    """
    scenarios = in_order(set(pooled.scenario))
    groups = [*scenarios, POOLED] if len(scenarios) > 1 else scenarios
    strata = np.array([scenarios.index(name) for name in pooled.scenario])
    parts = []
    for group in groups:
        members = np.ones(len(strata), bool)
        if group != POOLED:
            members = strata == scenarios.index(group)
        members &= np.isfinite(pooled.p_yes)
        for measure in MEASURES:
            rows = [
                _pair(pooled, i, j, members, strata, measure, level, permutations, seed)
                for i, j in combinations(range(len(pooled.names)), 2)
            ]
            table = pd.DataFrame(rows, columns=list(COLUMNS[2:9]))
            table = table.assign(
                p_holm=corrected_p(table["p"], "holm"), p_bh=corrected_p(table["p"], "fdr_bh")
            )
            parts.append(table.assign(scenario=group, measure=measure))
    table = pd.concat(parts, ignore_index=True)[list(COLUMNS)]
    return table[table["difference"].notna()].reset_index(drop=True)


def _pair(
    pooled: PooledStimuli,
    i: int,
    j: int,
    members: npt.NDArray[np.bool_],
    strata: npt.NDArray[np.int_],
    name: str,
    level: float,
    permutations: int,
    seed: int,
) -> tuple[str, str, int, float, float, float, float]:
    shared = members & np.isfinite(pooled.p_contact[i]) & np.isfinite(pooled.p_contact[j])
    n, nan = int(shared.sum()), float("nan")
    names = pooled.names[i], pooled.names[j]
    if n < 3:
        return *names, n, nan, nan, nan, nan
    measure, label, people = MEASURES[name], pooled.label[shared], pooled.p_yes[shared]
    first, second = (
        measure.columns(
            pooled.p_contact[k, shared],
            np.where(pooled.correct[k, shared] == 1, label, 1 - label),
            people,
        )
        for k in (i, j)
    )
    totals = first.sum(axis=0), second.sum(axis=0)
    difference = float(measure.value(totals[0]) - measure.value(totals[1]))
    if not np.isfinite(difference):
        return *names, n, nan, nan, nan, nan
    without = measure.value(totals[0] - first) - measure.value(totals[1] - second)
    low, high = jackknife(without, strata[shared]).interval(difference, level)
    change = swap_coins(permutations, n, seed) @ (second - first)
    swapped = measure.value(totals[0] + change) - measure.value(totals[1] - change)
    as_large = np.sum(np.abs(swapped) >= abs(difference) - 1e-12)
    return *names, n, difference, low, high, float((1 + as_large) / (1 + permutations))


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
