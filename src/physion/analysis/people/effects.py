"""What moves the answers of people: biases, background, difficulty, the hypotheses.

- response bias and side bias, accuracy by background;
- difficulty of stimuli: below chance, hard, at chance, easy;
- `regress_hypotheses`: the four preregistered hypotheses about attributes of stimuli, and
  `regress_attributes`: accuracy by any attributes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.intervals import LEVEL, Bootstrap, distribution
from physion.analysis.people.measures import (
    accuracy_by_participant,
    all_answers,
    draws_of_people,
    mean_over_people,
    split_halves,
)
from physion.analysis.people.responses import is_number
from physion.analysis.statistics.agreement import correlate_rows, pearson, z_rates
from physion.analysis.statistics.paired import corrected_p
from physion.analysis.tables import RESERVED, attribute_names, in_order
from physion.core.errors import BadInputError
from physion.core.tables import require_columns

Array = npt.NDArray[np.float64]

BACKGROUND = ("condition", "age", "gender", "education", "difficulty", "technical_problems")
"""Columns of the sessions about the condition, the participant and problems."""


# --- yes or no ----------------------------------------------------------------------------------


def yes_bias(test: pd.DataFrame, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Test whether people say yes too often; one row per scenario.

    Columns: ``scenario``, ``people``, ``base_rate`` (fraction of stimuli with contact, weighted by
    answers), ``yes`` (fraction of yes), ``bias`` (yes - base_rate) with ``_low``, ``_high``,
    ``d_prime`` and ``criterion`` (means over people; below 0: bias towards yes) with intervals,
    ``reason``. Intervals draw people. Hit and false-alarm rates use the log-linear correction (half
    an answer added to each side), so that d' is finite for people who are always right.
    """
    draws = bootstrap or Bootstrap()
    records = []
    for answers in all_answers(test):
        weights = draws_of_people(answers, draws)
        given = ~np.isnan(answers.yes)
        own_base = np.array([answers.label[row].mean() for row in given])
        own_yes = np.nanmean(answers.yes, axis=1)
        once = np.ones((1, len(answers.stimuli)))
        hits, alarms = (z[0] for z in z_rates(answers.yes, answers.label, once))
        record: dict[str, Any] = {
            "scenario": answers.scenario,
            "people": len(own_yes),
            "base_rate": float(np.mean(own_base)),
            "yes": float(np.mean(own_yes)),
        }
        d_prime = hits - alarms
        values = {"bias": own_yes - own_base, "d_prime": d_prime, "criterion": -(hits + alarms) / 2}
        reason = "d' and criterion: stimuli of only one outcome" if np.isnan(d_prime).any() else ""
        for name, by_person in values.items():
            record |= _mean_with_interval(name, by_person, weights, draws)
        records.append({**record, "reason": reason})
    return pd.DataFrame(records)


def _mean_with_interval(
    name: str, by_person: Array, weights: Array, draws: Bootstrap
) -> dict[str, float]:
    known = np.isfinite(by_person)
    drawn = mean_over_people(by_person[:, None], weights)[:, 0]
    low, high = draws.interval(drawn) if known.sum() > 1 else (np.nan, np.nan)
    mean = float(np.mean(by_person[known])) if known.any() else np.nan
    return {name: mean, f"{name}_low": low, f"{name}_high": high}


# --- left or right ------------------------------------------------------------------------------


def side_bias(test: pd.DataFrame, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Test whether people press the left button too often; one row per scenario.

    A person keeps one order of buttons, so side and answer are confounded within people but not
    between people. Columns: ``scenario``, ``yes_left``, ``yes_right`` (people with either order),
    ``left`` (fraction of left presses, mean of the two groups, so that a bias towards yes cancels)
    with ``_low``, ``_high`` (people drawn within each group) and ``p`` (Welch's test of the
    fraction of yes in the two groups), ``unknown`` (people whose order is unknown), ``reason``.
    """
    draws = bootstrap or Bootstrap()
    records = []
    for scenario in in_order(test["scenario"]):
        rows = test[test["scenario"] == scenario]
        order = rows["buttons"] if "buttons" in rows else pd.Series("", index=rows.index)
        by_person = rows.assign(order=order).groupby("session")[["yes", "order"]].agg(
            {"yes": "mean", "order": "first"}
        )  # fmt: skip
        groups = {name: by_person.loc[by_person["order"] == name, "yes"].to_numpy(dtype=np.float64)
                  for name in ("yes-no", "no-yes")}  # fmt: skip
        record = {"scenario": scenario} | _side_record(groups, scenario, draws)
        known = len(groups["yes-no"]) + len(groups["no-yes"])
        records.append({**record, "unknown": len(by_person) - known})
    return pd.DataFrame(records)


def _side_record(groups: dict[str, Array], scenario: str, draws: Bootstrap) -> dict[str, Any]:
    first, second = groups["yes-no"], groups["no-yes"]
    record: dict[str, Any] = {"yes_left": len(first), "yes_right": len(second)}
    nothing = dict.fromkeys(("left", "left_low", "left_high", "p"), np.nan)
    if min(len(first), len(second)) < 2:
        return {**record, **nothing, "reason": "fewer than two people of one order of buttons"}
    # Left presses are the yes of one group and the no of the other.
    drawn = [
        draws.weights(f"{name} of {scenario}", len(by_person)) @ by_person / len(by_person)
        for name, by_person in groups.items()
    ]
    low, high = draws.interval((drawn[0] + 1 - drawn[1]) / 2)
    constant = np.std(first) == 0 and np.std(second) == 0
    p = np.nan if constant else float(stats.ttest_ind(first, second, equal_var=False).pvalue)
    left = float((np.mean(first) + 1 - np.mean(second)) / 2)
    return {**record, "left": left, "left_low": low, "left_high": high, "p": p,
            "reason": "p: nobody differs within the groups" if constant else ""}  # fmt: skip


# --- people -------------------------------------------------------------------------------------


def background(sessions: pd.DataFrame, own: Sequence[str] = ()) -> pd.DataFrame:
    """Count the answers to the questionnaire: one row per question and answer.

    ``own``: columns with answers to the lab's own questions. Columns: ``question``, ``answer``
    (``(none)`` if not answered), ``sessions``, ``fraction``.
    """
    parts = []
    for column in _asked(sessions, own):
        values = sessions[column].astype(object)
        named = values.where(values.notna() & (values != ""), "(none)")
        counts = named.value_counts(sort=False)
        counts = counts.sort_index(key=lambda index: index.map(str))
        parts.append(
            pd.DataFrame(
                {
                    "question": column,
                    "answer": [str(value) for value in counts.index],
                    "sessions": counts.to_numpy(),
                    "fraction": counts.to_numpy() / max(len(sessions), 1),
                }
            )
        )
    columns = ["question", "answer", "sessions", "fraction"]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def accuracy_by_background(
    test: pd.DataFrame, sessions: pd.DataFrame, own: Sequence[str] = ()
) -> pd.DataFrame:
    """Test whether accuracy depends on age, gender, education, reported difficulty or answers to
    the lab's own questions, such as mental rotation (columns ``own`` of the sessions).

    Accuracies are taken relative to the mean of their scenario, since scenarios differ. One row per
    question: ``question``, ``sessions``, ``test`` (``spearman`` for numbers, ``kruskal-wallis`` for
    groups of at least two sessions), ``statistic``, ``df``, ``p``, ``reason``. Exploratory: as many
    tests as questions, p not corrected.
    """
    require_columns(sessions, ["session"], "the table of sessions")
    by_person = accuracy_by_participant(test)
    by_person["relative"] = by_person["accuracy"] - by_person.groupby("scenario")[
        "accuracy"
    ].transform("mean")
    about = sessions.drop(columns=["participant", "scenario"], errors="ignore")
    joined = by_person[["session", "relative"]].merge(about, on="session", how="left")
    return pd.DataFrame([_association(joined, column) for column in _asked(joined, own)])


def _asked(table: pd.DataFrame, own: Sequence[str]) -> list[str]:
    """Return the columns of `BACKGROUND` that a table has, no condition if all cells are empty, and
    ``own``."""
    known = "condition" in table and (table["condition"].fillna("") != "").any()
    found = [name for name in BACKGROUND if name in table and (name != "condition" or known)]
    return [*found, *own]


def _association(joined: pd.DataFrame, column: str) -> dict[str, Any]:
    values = joined[column].astype(object)
    rows = joined[values.notna() & (values != "")]
    record: dict[str, Any] = {"question": column, "sessions": len(rows), "test": "", "df": np.nan}
    record |= {"statistic": np.nan, "p": np.nan, "reason": ""}
    if column in ("age", "difficulty") or is_number(joined[column]):
        record["test"] = "spearman"
        numbers = rows[column].astype(np.float64)
        if len(rows) < 3 or numbers.nunique() < 2 or rows["relative"].nunique() < 2:
            return {**record, "reason": "too few answers, or all alike"}
        test_result = stats.spearmanr(numbers, rows["relative"])
        return {**record, "statistic": float(test_result.statistic), "p": float(test_result.pvalue)}
    record["test"] = "kruskal-wallis"
    groups = [part["relative"] for _, part in rows.groupby(column) if len(part) >= 2]
    if len(groups) < 2 or rows["relative"].nunique() < 2:
        return {**record, "reason": "fewer than two groups of two, or all accuracies alike"}
    test_result = stats.kruskal(*groups)
    return {**record, "df": len(groups) - 1, "statistic": float(test_result.statistic),
            "p": float(test_result.pvalue)}  # fmt: skip


# Difficulty of stimuli for people: below chance, hard, at chance, easy.

THIRDS = ("hard", "chance", "easy")
EDGES = (1 / 3, 2 / 3)
"""Accuracies that separate the three; 33 and 67 % in the paper."""


def below_chance_level_released(
    accuracy: npt.ArrayLike, count: npt.ArrayLike
) -> npt.NDArray[np.bool_]:
    """Return whether accuracy + 1.96 standard errors is below 0.5: the study's rule.

    The standard error is the normal approximation at the observed fraction, which is 0 for
    a fraction of 0; there is no correction for testing 150 stimuli.
    """
    p, n = _fractions(accuracy, count)
    return np.asarray(p + 1.96 * np.sqrt(p * (1 - p) / n) < 0.5)


def below_chance_level_p(accuracy: npt.ArrayLike, count: npt.ArrayLike) -> Array:
    """Return the exact binomial p of at most so many right answers of ``count`` by guessing."""
    p, n = _fractions(accuracy, count)
    return np.asarray(stats.binom.cdf(np.rint(p * n), n, 0.5), dtype=np.float64)


def below_chance_level(by_stimulus: pd.DataFrame, level: float = 0.05) -> pd.DataFrame:
    """Find the stimuli that people get wrong more often than by guessing, by two rules.

    ``by_stimulus`` has ``stimulus``, ``scenario``, ``accuracy`` and ``count``, from
    `accuracy_by_stimulus` or `read_humans`. Added columns: ``released``
    (`below_chance_level_released`), ``p`` (`below_chance_level_p`), ``p_adjusted`` (Benjamini and
    Hochberg over all rows given), ``exact`` (p_adjusted < ``level``).
    """
    p = below_chance_level_p(by_stimulus["accuracy"], by_stimulus["count"])
    adjusted = corrected_p(p, "fdr_bh")
    return by_stimulus[["scenario", "stimulus", "accuracy", "count"]].assign(
        released=below_chance_level_released(by_stimulus["accuracy"], by_stimulus["count"]),
        p=p,
        p_adjusted=adjusted,
        exact=adjusted < level,
    )


def difficulty_third(accuracy: npt.ArrayLike) -> pd.Series:
    """Return ``hard`` up to the first edge, ``easy`` from the second, ``chance`` between; NaN stays
    NaN.
    """
    values = np.asarray(accuracy, dtype=np.float64)
    names = np.select([values <= EDGES[0], values >= EDGES[1]], ["hard", "easy"], "chance")
    return pd.Series(names, dtype=object).where(np.isfinite(values), np.nan)


HALVES_OF_THIRDS = 200
"""Number of random splits of the people in `r_by_third`."""


def r_by_third(p_contact: npt.ArrayLike, yes: npt.ArrayLike, label: npt.ArrayLike) -> pd.DataFrame:
    """Return r of models with the average person within hard, chance and easy stimuli of one
    scenario.

    Parameters
    ----------
    p_contact
        (m, s), NaN if a model does not predict a stimulus.
    yes
        (n, s): answers of people.
    label
        (s,): official outcomes.

    Returns
    -------
    ``third``, ``stimuli``, ``model`` (row index; -1: the two halves of the people, whose ``low``
    and ``high`` are the 2.5th and 97.5th percentile of r), ``r`` (halves: mean), ``low``, ``high``;
    NaN if r is undefined.

    Notes
    -----
    The thirds depend on the same answers as r: within a third accuracy hardly varies, so r there
    mostly tells whether P(contact) follows the outcome (easy) or its opposite (hard).
    """
    answers, truth = np.asarray(yes, np.float64), np.asarray(label, np.float64)
    models = np.atleast_2d(np.asarray(p_contact, np.float64))
    p_yes = mean_over_people(answers)
    third = difficulty_third(np.where(truth == 1, p_yes, 1 - p_yes)).to_numpy()
    rows: list[tuple[str, int, int, float, float, float]] = []
    for name in THIRDS:
        members = np.flatnonzero(third == name)
        r = correlate_rows(
            models[:, members], np.broadcast_to(p_yes[members], (len(models), len(members)))
        )
        rows += [(name, len(members), k, float(value), np.nan, np.nan) for k, value in enumerate(r)]
        among = split_halves(answers[:, members], HALVES_OF_THIRDS) if len(members) else np.empty(0)
        found = distribution(among)
        rows.append((name, len(members), -1, found["mean"], found["low"], found["high"]))
    return pd.DataFrame(rows, columns=["third", "stimuli", "model", "r", "low", "high"])


def _fractions(accuracy: npt.ArrayLike, count: npt.ArrayLike) -> tuple[Array, Array]:
    p, n = np.asarray(accuracy, dtype=np.float64), np.asarray(count, dtype=np.float64)
    if not ((p >= 0) & (p <= 1)).all() or not (n >= 1).all():
        raise BadInputError("accuracies must lie in 0..1, with at least one person a stimulus")
    return p, n


# The four preregistered hypotheses: attributes that make stimuli hard, and slower answers to them.
#
# By stimulus, which needs only the table of `accuracy_by_stimulus` or of the official
# files: regression of a stimulus' accuracy (or log response time) on the attribute, with an
# intercept for each scenario. By single answers: ``HYPOTHESES[...].formula`` on `answer_rows`, for
# the mixed models.


@dataclass(frozen=True)
class Hypothesis:
    """A hypothesis: ``predictor`` changes ``outcome`` in the direction of ``sign``.

    ``formula`` is its mixed model of single answers, with scenario fixed and participants and
    stimuli random; ``family``: whether that model is ``logistic`` or ``linear``.
    """

    name: str
    about: str
    predictor: str
    outcome: str
    sign: int
    formula: str
    family: str


def _harder(name: str, predictor: str, about: str) -> Hypothesis:
    formula = f"correct ~ {predictor} + scenario + (1|participant) + (1|stimulus)"
    return Hypothesis(name, about, predictor, "accuracy", -1, formula, "logistic")


HYPOTHESES: Mapping[str, Hypothesis] = {
    hypothesis.name: hypothesis
    for hypothesis in (
        _harder("H1", "elements", "Stimuli with more elements are harder"),
        _harder("H2", "distractors", "Stimuli with distractors are harder"),
        _harder("H3", "occluders", "Stimuli with occluders are harder"),
        Hypothesis(
            "H4",
            "People take longer to answer stimuli that they get wrong more often",
            "accuracy",
            "mean_log_rt",
            -1,
            "log_rt ~ accuracy + scenario + (1|participant) + (1|stimulus)",
            "linear",
        ),
    )
}
"""The preregistered hypotheses by name."""

COLUMNS = (
    "hypothesis", "scenario", "predictor", "outcome", "stimuli", "left_out", "b", "se", "t", "df",
    "p", "low", "high", "r", "spearman", "as_predicted", "reason",
)  # fmt: skip


def with_attributes(by_stimulus: pd.DataFrame, attributes: pd.DataFrame) -> pd.DataFrame:
    """Return ``by_stimulus`` with the attributes, NaN if unknown."""
    require_columns(by_stimulus, ["stimulus", "scenario", "accuracy"], "the table by stimulus")
    columns = ["stimulus", *attribute_names(attributes)]
    return by_stimulus.merge(attributes[columns], on="stimulus", how="left", validate="one_to_one")


def answer_rows(test: pd.DataFrame, stimuli: pd.DataFrame) -> pd.DataFrame:
    """Return single answers with the attributes of their stimuli, for mixed models.

    ``stimuli``: from `with_attributes`. Columns: ``participant``, ``scenario``, ``stimulus``,
    ``correct``, ``log_rt``, ``accuracy`` (of the stimulus, over all people), and the attributes.
    """
    columns = ["participant", "scenario", "stimulus", "correct", "log_rt"]
    known = RESERVED - {"accuracy"} | {"scenario"}
    own = stimuli[[name for name in stimuli if name not in known]]
    return test[columns].merge(own, on="stimulus", how="left", validate="many_to_one")


def regress_hypotheses(stimuli: pd.DataFrame) -> pd.DataFrame:
    """Test each hypothesis in each scenario and, in row ``all``, over all with an intercept for
    each.

    ``stimuli``: from `with_attributes`, with ``mean_log_rt`` for H4. Columns: ``b`` (change of the
    outcome per unit of the predictor), ``se`` (HC3, valid for unequal variances), ``t``, ``df``,
    ``p`` (two-sided), ``low``, ``high``, ``r`` (Pearson's, within scenarios) and ``spearman`` (in
    ``all`` of values less their scenario's mean), ``as_predicted`` (for p < 1 - `LEVEL` *yes* if
    b has the predicted sign, else *opposite*; for a larger p *not shown*), ``left_out`` (stimuli
    without predictor or outcome), ``reason``. The reason also reports if distractors and occluders
    always occur together: then their effects cannot be separated.
    """
    records = []
    for hypothesis in HYPOTHESES.values():
        parts = [(name, stimuli[stimuli["scenario"] == name]) for name in
                 in_order(stimuli["scenario"])]  # fmt: skip
        if len(parts) > 1:
            parts.append(("all", stimuli))
        records += [_record(hypothesis, name, rows) for name, rows in parts]
    return pd.DataFrame(records, columns=list(COLUMNS))


def _record(hypothesis: Hypothesis, name: str, rows: pd.DataFrame) -> dict[str, Any]:
    record: dict[str, Any] = dict.fromkeys(COLUMNS, np.nan)
    record |= {"hypothesis": hypothesis.name, "scenario": name, "reason": "",
               "predictor": hypothesis.predictor, "outcome": hypothesis.outcome}  # fmt: skip
    missing = [c for c in (hypothesis.predictor, hypothesis.outcome) if c not in rows]
    if missing:
        return {**record, "stimuli": 0, "left_out": len(rows),
                "reason": f"no column {missing[0]}"}  # fmt: skip
    known = rows[[hypothesis.predictor, hypothesis.outcome]].notna().all(axis=1)
    used = rows[known]
    # A scenario with one stimulus, or one value, does not determine a slope within scenarios.
    varied = used.groupby("scenario")[hypothesis.predictor].transform("nunique") > 1
    used = used[varied]
    record |= {"stimuli": len(used), "left_out": len(rows) - len(used), "as_predicted": ""}
    if len(used) < 5:
        why = "the predictor is not known" if not known.any() else "the predictor does not vary"
        return {**record, "reason": f"{why}, or fewer than 5 stimuli"}
    x, y = (_within(used, c) for c in (hypothesis.predictor, hypothesis.outcome))
    if np.allclose(y, 0):
        return {**record, "reason": "the outcome does not vary"}
    record |= within_scenarios(used, {"x": x[:, None]}, hypothesis.outcome)[0].iloc[0]
    record["r"] = pearson(x, y)
    record["spearman"] = float(stats.spearmanr(x, y).statistic)
    record["as_predicted"] = _verdict(record, hypothesis.sign)
    record["reason"] = _confounded(hypothesis, used)
    return record


def _verdict(record: Mapping[str, Any], sign: int) -> str:
    """Return whether the test shows an effect in the direction of ``sign``, or in the other."""
    if not record["p"] < 1 - LEVEL:
        return "not shown"
    return "yes" if np.sign(record["b"]) == sign else "opposite"


def _within(rows: pd.DataFrame, column: str) -> Array:
    """Subtract the mean of its scenario from a column: equivalent to an intercept for each
    scenario.
    """
    return _centred(rows[column].to_numpy(np.float64), rows["scenario"])


def _centred(values: Array, scenario: pd.Series) -> Array:
    column = pd.Series(values, index=scenario.index)
    return np.asarray(column - column.groupby(scenario).transform("mean"))


def within_scenarios(
    rows: pd.DataFrame, terms: Mapping[str, Array], outcome: str
) -> tuple[pd.DataFrame, dict[str, float]]:
    """Fit least squares with an intercept for each scenario, and HC3 standard errors.

    Parameters
    ----------
    rows
        Stimuli with ``scenario`` and the ``outcome``.
    terms
        Columns (n, k) by the name of their term, without missing values.
    outcome
        Column to explain.

    Returns
    -------
    table, fit
        One row per column: ``b``, ``se``, ``t``, ``df``, ``p``, ``low``, ``high`` and ``p_term``
        (F test of all columns of the term); and ``r2``, ``r2_adjusted`` (of the differences within
        scenarios) and ``p_fit`` (F test of all terms).
    """
    from statsmodels.regression.linear_model import OLS  # half a second to import

    x = np.hstack(list(terms.values()))
    intercepts = pd.get_dummies(rows["scenario"]).to_numpy(np.float64)
    y = rows[outcome].to_numpy(np.float64)
    fit = OLS(y, np.hstack([x, intercepts])).fit(cov_type="HC3", use_t=True)
    k, all_columns = x.shape[1], np.eye(x.shape[1] + intercepts.shape[1])
    low, high = fit.conf_int(1 - LEVEL)[:k].T
    table = pd.DataFrame(
        {"b": fit.params[:k], "se": fit.bse[:k], "t": fit.tvalues[:k], "df": fit.df_resid,
         "p": fit.pvalues[:k], "low": low, "high": high}
    )  # fmt: skip
    ends = np.cumsum([columns.shape[1] for columns in terms.values()])
    tests = [fit.f_test(all_columns[end - columns.shape[1] : end]).pvalue
             for end, columns in zip(ends, terms.values(), strict=True)]  # fmt: skip
    table["p_term"] = np.repeat(tests, [columns.shape[1] for columns in terms.values()])
    unexplained = float(fit.ssr) / float(np.sum(_within(rows, outcome) ** 2))
    adjusted = unexplained * (fit.df_resid + k) / fit.df_resid
    p_fit = float(fit.f_test(all_columns[:k]).pvalue)
    return table, {"r2": 1 - unexplained, "r2_adjusted": 1 - adjusted, "p_fit": p_fit}


# Accuracy by every attribute of stimuli, exploratory: each by itself, and all of them together.

ATTRIBUTE_COLUMNS = (
    "scenario", "fit", "attribute", "level", "stimuli", "left_out", "b", "b_sd", "se", "t", "df",
    "p", "low", "high", "p_term", "p_holm", "r2", "r2_adjusted", "p_fit", "reason",
)  # fmt: skip


def regress_attributes(stimuli: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Regress people's accuracy on each attribute, and on all together, by scenario and over all.

    Parameters
    ----------
    stimuli
        From `with_attributes`.
    names
        Columns with attributes: numbers, or text, whose values are categories.

    Returns
    -------
    `ATTRIBUTE_COLUMNS`. ``fit``: *single*, or *together*: the linear combination of all attributes
    that vary among the stimuli for which they are all known, without the ``configuration``, which
    stands for all of them. A category has a row for each ``level`` but the first, its base. ``b``:
    change of accuracy by one unit, and ``b_sd`` by one standard deviation within scenarios;
    ``p_term``: test of all levels; ``p_holm``: corrected over the attributes of the same scenario
    and fit; ``r2``, ``r2_adjusted``, ``p_fit``: of the whole fit, see `within_scenarios`;
    ``reason``: why there is no number, such as an attribute that follows from the others.
    """
    scenarios = in_order(stimuli["scenario"])
    parts = [(name, stimuli[stimuli["scenario"] == name]) for name in scenarios]
    parts += [("all", stimuli)] if len(scenarios) > 1 else []
    found = []
    for scenario, rows in parts:
        fits = [("single", [name]) for name in names]
        fits.append(("together", [name for name in names if name != "configuration"]))
        tables = [_attribute_fit(rows, chosen).assign(fit=fit) for fit, chosen in fits]
        for own in (pd.concat(tables[:-1]), tables[-1]) if names else ():
            each = own.drop_duplicates("attribute").set_index("attribute")["p_term"]
            holm = pd.Series(corrected_p(each, "holm"), index=each.index)
            found.append(own.assign(scenario=scenario, p_holm=own["attribute"].map(holm)))
    table = pd.concat(found, ignore_index=True) if found else pd.DataFrame()
    return table.reindex(columns=list(ATTRIBUTE_COLUMNS))


def _attribute_fit(rows: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Return one row per column of the attributes, or one with the reason why there is none."""
    reasons: dict[str, str] = {}
    values = rows[list(names)]
    values = values.mask(values == "")
    for name in names:
        if values[name].isna().all():
            reasons[name] = "not known"
        elif values[name].groupby(rows["scenario"]).nunique().max() < 2:
            reasons[name] = "does not vary"
    used = rows[values.drop(columns=list(reasons)).notna().all(axis=1)]
    levels: list[tuple[str, str]] = []
    terms: dict[str, Array] = {}
    basis = pd.get_dummies(used["scenario"]).to_numpy(np.float64)
    for name in [name for name in names if name not in reasons]:
        columns = _columns(used[name])
        own = columns.to_numpy(np.float64)
        apart = np.column_stack([_centred(column, used["scenario"]) for column in own.T])
        size = np.std(apart, axis=0)
        wider = np.hstack([basis, apart / np.where(size > 0, size, 1.0)])
        if len(used) < 2 * wider.shape[1] + 1:
            reasons[name] = "too few stimuli for it"
        elif np.linalg.matrix_rank(wider) < wider.shape[1]:
            reasons[name] = "follows from other attributes, or does not vary, where all are known"
        else:
            basis, terms[name] = wider, own
            levels += [(name, str(column)) for column in columns]
    if terms and np.allclose(_within(used, "accuracy"), 0):
        reasons, terms = dict.fromkeys(names, "accuracy does not vary"), {}
    records = [{"attribute": name, "stimuli": len(used), "left_out": len(rows) - len(used),
                "reason": reason} for name, reason in reasons.items()]  # fmt: skip
    missing = pd.DataFrame(records).assign(p_term=np.nan)
    if not terms:
        return missing
    table, fit = within_scenarios(used, terms, "accuracy")
    spread = [
        float(np.std(_centred(column, used["scenario"]), ddof=used["scenario"].nunique()))
        for columns in terms.values()
        for column in columns.T
    ]
    table = table.assign(
        attribute=[name for name, _ in levels],
        level=[value for _, value in levels],
        stimuli=len(used),
        left_out=len(rows) - len(used),
        b_sd=table["b"] * spread,
        reason=np.where(np.isfinite(table["se"]), "", "a stimulus has a value of its own"),
        **fit,
    )
    return pd.concat([table, missing], ignore_index=True)


def _columns(values: pd.Series) -> pd.DataFrame:
    """Return a number as one column, and a category as one column for each value but the first."""
    if pd.api.types.is_numeric_dtype(values):
        return pd.DataFrame({"": values.astype(np.float64)})
    return pd.get_dummies(values.astype(str)).iloc[:, 1:]


def _confounded(hypothesis: Hypothesis, rows: pd.DataFrame) -> str:
    pair = ("distractors", "occluders")
    if hypothesis.predictor not in pair or not set(pair) <= set(rows.columns):
        return ""
    both = rows[list(pair)].dropna()
    if len(both) and (both["distractors"] == both["occluders"]).all():
        return "as many occluders as distractors in every stimulus: cannot be distinguished"
    return ""
