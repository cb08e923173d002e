"""Tests of models against each other, and mixed models of answers and accuracies.

Pairs of models are compared on the stimuli of all scenarios together: McNemar's test of accuracy
and permutations of r (`paired_tests`). `fits_of_people` and `fits_of_models` are the mixed models
of the report; `group_contrasts` compares groups of models by such models.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.comparison import Comparison, with_training
from physion.analysis.intervals import Bootstrap
from physion.analysis.mixed import MixedFit, fit_linear, fit_logistic
from physion.analysis.people.effects import HYPOTHESES, answer_rows, with_attributes
from physion.analysis.people.results import PeopleResults
from physion.analysis.statistics.paired import (
    Difference,
    corrected_p,
    mcnemar_exact,
    paired_difference,
)
from physion.analysis.tables import DETECTION, MEAN, POOLED
from physion.core.errors import BadInputError, PhysionError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PooledStimuli:
    """Predictions of m models for the s stimuli of all scenarios.

    - ``names``: of the models;
    - ``p_contact``, ``correct`` (m, s): NaN if a model does not predict the stimulus;
    - ``label``, ``p_yes`` (s,): official outcome, and fraction of people who say yes;
    - ``scenario``: of each stimulus, length s;
    - ``detecting``: names of models that are not compared with people, see `DETECTION`.
    """

    names: tuple[str, ...]
    p_contact: Array
    correct: Array
    label: Array
    p_yes: Array
    scenario: tuple[str, ...]
    detecting: frozenset[str] = frozenset()


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
        detecting=frozenset(rows.loc[rows["readout"] == DETECTION, "model"].astype(str)),
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
        r = _difference(pooled, (i, j), shared & np.isfinite(pooled.p_yes), draws, count)
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


def _difference(
    pooled: PooledStimuli,
    pair: tuple[int, int],
    shared: npt.NDArray[np.bool_],
    draws: Bootstrap,
    permutations: int,
) -> Difference:
    both = list(pair)
    shared = shared & (not pooled.detecting & {pooled.names[one] for one in both})
    return paired_difference(
        pooled.p_contact[both][:, shared],
        pooled.p_yes[shared],
        np.unique(pooled.scenario, return_inverse=True)[1][shared],
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
        """Return fixed effects, then standard deviations of the random ones."""
        if self.fit is None:
            return pd.DataFrame({"term": ["(none)"], "reason": [self.reason]})
        spreads = self.fit.random.assign(term="sd of " + self.fit.random["group"])
        return pd.concat([self.fit.table, spreads[["term", "levels", "sd"]]], ignore_index=True)


Fitter = Callable[[str, pd.DataFrame], MixedFit]


def _fitted(
    name: str, about: str, formula: str, fitter: Fitter, rows: pd.DataFrame, term: str = ""
) -> MixedTable:
    """Fit a model; if the fitter refuses, keep its reason."""
    try:
        return MixedTable(name, about, formula, fitter(formula, rows), term=term)
    except PhysionError as error:
        return MixedTable(name, about, formula, None, str(error))


def fits_of_people(
    people: PeopleResults, progress: Callable[[str, int, int], None] | None = None
) -> list[MixedTable]:
    """Fit the preregistered models of single answers, response times, and the effect of flags (on
    all complete sessions).

    A logistic model of 15,000 answers takes about 14 s; ``progress`` is called after each model.
    """
    fits: list[MixedTable] = []
    count = len(HYPOTHESES) + 4

    def add(fit: MixedTable) -> None:
        fits.append(fit)
        if progress is not None:
            progress("fitting mixed models", len(fits), count)

    if progress is not None:
        progress("fitting mixed models", 0, count)
    stimuli = with_attributes(people.tables["by_stimulus"], people.tables["attributes"])
    rows = answer_rows(people.kept.test, stimuli)
    scenario = "scenario + " if rows["scenario"].nunique() > 1 else ""
    add(
        _fitted(
            "scenarios",
            "Do people differ between scenarios? Log odds of being right, logistic",
            f"correct ~ {scenario or '1 + '}{CROSSED}",
            fit_logistic,
            rows,
            "scenario" if scenario else "",
        )
    )
    for key, hypothesis in HYPOTHESES.items():
        fitter = fit_logistic if hypothesis.family == "logistic" else fit_linear
        formula = hypothesis.formula if scenario else hypothesis.formula.replace("scenario + ", "")
        about = f"{key}, preregistered: {hypothesis.about} ({hypothesis.family})"
        add(_fitted(key.lower(), about, formula, fitter, rows))
    add(_attributes(people, rows, scenario))
    add(_response_times(people, scenario))
    flagged = people.tables["flags"].set_index("session")["flagged"]
    whole = people.whole.test
    whole = whole.assign(flagged=whole["session"].map(flagged).astype(float))
    about = (
        "Effect of a session's flag on being right, all complete sessions, logistic; low accuracy "
        "is one of the flags, so a part of the effect holds by construction"
    )
    add(_fitted("flagged", about, f"correct ~ flagged + {scenario}{CROSSED}", fit_logistic, whole))
    return fits


def _attributes(people: PeopleResults, rows: pd.DataFrame, scenario: str) -> MixedTable:
    """Fit the linear combination of attributes that `regress_attributes` found by stimulus.

    ``rows``: single answers, from `answer_rows`; ``scenario``: its term in the formula. Numbers are
    in standard deviations over stimuli.
    """
    effects = people.tables["attribute_effects"]
    together = effects[(effects["fit"] == "together") & effects["b"].notna()]
    if scenario:
        together = together[together["scenario"] == "all"]
    about = "Attributes of stimuli together, exploratory, in standard deviations (logistic)"
    names = list(dict.fromkeys(together["attribute"]))
    plain: dict[str, str] = {}
    for name in names:
        word = re.sub(r"\W", "_", name)
        while word in plain.values():  # two names may differ in signs only
            word += "_"
        plain[name] = word
    formula = " + ".join([f"correct ~ {' + '.join(plain.values()) or '1'}", f"{scenario}{CROSSED}"])
    if not names:
        return MixedTable("attributes", about, formula, None, "no attribute is known and varies")
    by_stimulus = rows.drop_duplicates("stimulus")[names].select_dtypes("number")
    scaled = {name: (rows[name] - by_stimulus[name].mean()) / by_stimulus[name].std()
              for name in by_stimulus}  # fmt: skip
    used = rows.assign(**scaled).rename(columns=plain)
    return _fitted("attributes", about, formula, fit_logistic, used)


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


def accuracy_rows(comparison: Comparison, predictions: pd.DataFrame | None) -> pd.DataFrame:
    """Return the accuracy of each model in each scenario, for mixed models.

    Columns: ``model``, ``base_model``, ``readout``, ``scenario``, ``accuracy``, and ``training``
    from `with_training` (NaN for what was not trained, or without ``predictions``).
    """
    scores = comparison.scores
    rows = scores[~scores["scenario"].isin([MEAN, POOLED])]
    rows = rows[["model", "base_model", "readout", "scenario", "accuracy"]]
    if predictions is None:
        return rows.assign(training=np.nan)
    trained = with_training(comparison, predictions)[["model", "scenario", "training"]]
    trained = trained.drop_duplicates(["model", "scenario"]).replace({"training": {"": np.nan}})
    return rows.merge(trained, on=["model", "scenario"], how="left")


def fits_of_models(
    comparison: Comparison, predictions: pd.DataFrame | None = None
) -> list[MixedTable]:
    """Fit linear models of accuracy by model and scenario, as the study compared models.

    Coefficients are differences to the model, readout and training that comes first in the files.
    Each row is the accuracy of one model in one scenario. As in the study, the readout and the
    training that are not tested have random intercepts. ``predictions``: from `name_models`, for
    the training.
    """
    rows = accuracy_rows(comparison, predictions)
    if len(comparison.names) < 2 or rows["scenario"].nunique() < 2:
        return []
    # The first in the files, not in the alphabet, is the base level.
    for column in ("model", "readout", "training"):
        rows[column] = pd.Categorical(rows[column], categories=rows[column].dropna().unique())
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
    for name, tested, other in (
        ("readouts", "readout", "training"),
        ("trainings", "training", "readout"),
    ):
        known = rows[rows[tested].notna()]
        if known[tested].nunique() > 1 and known["base_model"].nunique() > 1:
            first = rows[tested].cat.categories[0]
            fits.append(
                _fitted(
                    name,
                    f"Does the {tested} matter? Linear, against {first}, the first in the files",
                    f"accuracy ~ {tested} + {_random(known, other, 'base_model')}",
                    fit_linear,
                    known,
                    tested,
                )
            )
    return fits


def _random(rows: pd.DataFrame, *columns: str) -> str:
    """Return random intercepts of the scenario, and of the columns with several values."""
    several = [name for name in columns if rows[name].notna().all() and rows[name].nunique() > 1]
    return " + ".join(f"(1|{name})" for name in ("scenario", *several))


CONTRAST_COLUMNS = ("column", "first", "second", "models_first", "models_second", "b", "se", "t",
                    "df", "p", "p_holm", "low", "high", "formula", "reason")  # fmt: skip


def group_contrasts(
    comparison: Comparison, predictions: pd.DataFrame, columns: Sequence[str]
) -> pd.DataFrame:
    """Compare groups of models in accuracy, as the Results section of the study does.

    Parameters
    ----------
    comparison, predictions
        Scores of models, and the rows that they are of, from `name_models`.
    columns
        Columns of ``predictions`` by whose values the models are grouped. Models with an empty
        value, and baselines, are left out.

    Returns
    -------
    `CONTRAST_COLUMNS`, one row for every two groups, twice: with the formula of the study, and, if
    a group has several models, with a random intercept for each model, so that the test is about
    other models of such groups. ``b`` is the difference in accuracy, ``first`` less ``second``;
    ``t``, ``df`` and ``p`` by Satterthwaite; ``p_holm`` corrected over the pairs of one formula.

    Raises
    ------
    BadInputError
        If a column has two values for one model.
    """
    rows = accuracy_rows(comparison, predictions)
    rows = rows[rows["model"].isin(comparison.models)]
    parts = []
    for column in columns:
        by_model = predictions.groupby("model")[column].agg(["nunique", "first"])
        several = by_model.index[by_model["nunique"] > 1]
        if len(several):
            raise BadInputError(f"{column}: {several[0]} has several values; give it one group")
        group = rows["model"].map(by_model["first"]).replace("", np.nan)
        known = rows.assign(group=group).dropna(subset=["group"])
        names = list(known["group"].unique())
        if len(names) < 2:
            raise BadInputError(f"{column} has the same value for all models: nothing to compare")
        known["group"] = pd.Categorical(known["group"], categories=names)
        models = known.groupby("group", observed=True)["base_model"].nunique()
        tested = {"readout": ("training",), "protocol": ("readout",)}
        random = _random(known, *tested.get(column, ("readout", "training")))
        formulas = [f"accuracy ~ group + {random}"]
        formulas += [f"{formulas[0]} + (1|base_model)"] if (models > 1).any() else []
        for formula in formulas:
            fit = _fitted(column, "", formula, fit_linear, known)
            table = pd.DataFrame([_pair(fit, names, i, j) for i, j in _pairs(len(names))])
            table = table.reindex(columns=list(CONTRAST_COLUMNS))
            for end in ("first", "second"):
                table[f"models_{end}"] = table[end].map(models)
            table["p_holm"] = corrected_p(table["p"], "holm")
            parts.append(table.assign(column=column, formula=formula, reason=fit.reason))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=CONTRAST_COLUMNS)


def _pairs(count: int) -> list[tuple[int, int]]:
    return list(combinations(range(count), 2))


def _pair(model: MixedTable, names: Sequence[str], first: int, second: int) -> dict[str, object]:
    """Return the difference of two levels of the term ``group``, the first of which is the base."""
    pair: dict[str, object] = {"first": names[first], "second": names[second]}
    if model.fit is None:
        return pair
    weights = np.zeros(len(names))
    weights[[first, second]] = 1, -1
    weights[0] = 0  # the intercept is the first group, to which the other terms are differences
    return {**pair, **model.fit.contrast(weights)}
