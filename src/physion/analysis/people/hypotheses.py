"""The four preregistered hypotheses: attributes that make stimuli hard, and slower answers to them.

By stimulus, which needs only the table of `people.accuracy_by_stimulus` or of the official files:
regression of a stimulus' accuracy (or log response time) on the attribute, with an intercept for
each scenario. By single answers: ``HYPOTHESES[...].formula`` on `answer_rows`, for the mixed
models.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.tables.attributes import ATTRIBUTES
from physion.analysis.tables.csv_table import require_columns
from physion.analysis.tables.stimuli import in_order

Array = npt.NDArray[np.float64]


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
    """Return ``by_stimulus`` with the columns of `attributes.ATTRIBUTES`, NaN if unknown."""
    require_columns(by_stimulus, ["stimulus", "scenario", "accuracy"], "the table by stimulus")
    columns = ["stimulus", *ATTRIBUTES]
    return by_stimulus.merge(attributes[columns], on="stimulus", how="left", validate="one_to_one")


def answer_rows(test: pd.DataFrame, stimuli: pd.DataFrame) -> pd.DataFrame:
    """Return single answers with the attributes of their stimuli, for mixed models.

    ``stimuli``: from `with_attributes`. Columns: ``participant``, ``scenario``, ``stimulus``,
    ``correct``, ``log_rt``, ``accuracy`` (of the stimulus, over all people), `ATTRIBUTES`.
    """
    columns = ["participant", "scenario", "stimulus", "correct", "log_rt"]
    own = stimuli[["stimulus", "accuracy", *ATTRIBUTES]]
    return test[columns].merge(own, on="stimulus", how="left", validate="many_to_one")


def regress_hypotheses(stimuli: pd.DataFrame, level: float = 0.95) -> pd.DataFrame:
    """Test each hypothesis in each scenario and, in row ``all``, over all with an intercept for
    each.

    ``stimuli``: from `with_attributes`, with ``mean_log_rt`` for H4. Columns: ``b`` (change of the
    outcome per unit of the predictor), ``se`` (HC3, valid for unequal variances), ``t``, ``df``,
    ``p`` (two-sided), ``low``, ``high``, ``r`` (Pearson's, within scenarios) and ``spearman`` (in
    ``all`` of values less their scenario's mean), ``as_predicted`` (for p < 1 - ``level`` *yes* if
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
        records += [_record(hypothesis, name, rows, level) for name, rows in parts]
    return pd.DataFrame(records, columns=list(COLUMNS))


def _record(hypothesis: Hypothesis, name: str, rows: pd.DataFrame, level: float) -> dict[str, Any]:
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
    of_scenario = used.groupby("scenario")["scenario"].transform("size").to_numpy(dtype=np.float64)
    record |= _slope(x, y, of_scenario, level)
    record["r"] = float(np.corrcoef(x, y)[0, 1])
    record["spearman"] = float(stats.spearmanr(x, y).statistic)
    record["as_predicted"] = _verdict(record, hypothesis.sign, level)
    record["reason"] = _confounded(hypothesis, used)
    return record


def _verdict(record: Mapping[str, Any], sign: int, level: float) -> str:
    """Return whether the test shows an effect in the direction of ``sign``, or in the other."""
    if not record["p"] < 1 - level:
        return "not shown"
    return "yes" if np.sign(record["b"]) == sign else "opposite"


def _within(rows: pd.DataFrame, column: str) -> Array:
    """Subtract the mean of its scenario from a column: equivalent to an intercept for each
    scenario.
    """
    values = rows[column].astype(np.float64)
    return np.asarray(values - values.groupby(rows["scenario"]).transform("mean"))


def _slope(x: Array, y: Array, of_scenario: Array, level: float) -> dict[str, float]:
    """Fit least squares through the origin of centred values, with the HC3 standard error.

    ``of_scenario``: number of stimuli of each stimulus' scenario, whose subtracted mean adds 1 /
    of_scenario to the leverage.
    """
    squares = float(np.sum(x * x))
    b = float(np.sum(x * y)) / squares
    residuals = y - b * x
    leverage = x * x / squares + 1 / of_scenario
    meat = float(np.sum((x * residuals / (1 - leverage)) ** 2))
    se, df = np.sqrt(meat) / squares, len(x) - round(float(np.sum(1 / of_scenario))) - 1
    t = b / se if se > 0 else np.nan
    half = float(stats.t.ppf(0.5 + level / 2, df)) * se
    return {"b": b, "se": float(se), "t": float(t), "df": df, "low": b - half, "high": b + half,
            "p": float(2 * stats.t.sf(abs(t), df))}  # fmt: skip


def _confounded(hypothesis: Hypothesis, rows: pd.DataFrame) -> str:
    pair = ("distractors", "occluders")
    if hypothesis.predictor not in pair or not set(pair) <= set(rows.columns):
        return ""
    both = rows[list(pair)].dropna()
    if len(both) and (both["distractors"] == both["occluders"]).all():
        return "as many occluders as distractors in every stimulus: not to be told apart"
    return ""
