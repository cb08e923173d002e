"""Mixed models of a report: of people's single answers, and of the models' accuracies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from physion.analysis.mixed.linear import fit_linear
from physion.analysis.mixed.logistic import fit_logistic
from physion.analysis.mixed.result import MixedFit, effect_name
from physion.analysis.models.comparison import Comparison
from physion.analysis.people.hypotheses import HYPOTHESES, answer_rows, with_attributes
from physion.analysis.people.results import PeopleResults
from physion.analysis.tables.stimuli import MEAN, POOLED
from physion.core.errors import PhysionError

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
    if len(comparison.agents) < 2 or rows["scenario"].nunique() < 2:
        return []
    rows = rows[["agent", "model", "readout", "scenario", "accuracy"]]
    # The first in the files, not in the alphabet, is the base level.
    rows = rows.assign(
        agent=pd.Categorical(rows["agent"], categories=comparison.agents),
        readout=pd.Categorical(rows["readout"], categories=rows["readout"].unique()),
    )
    fits = [
        _fitted(
            "models",
            f"Do models differ in accuracy? Linear, each against {comparison.agents[0]}, "
            "the first in the files",
            "accuracy ~ agent + (1|scenario)",
            fit_linear,
            rows,
            "agent",
        )
    ]
    if rows["readout"].nunique() > 1 and rows["model"].nunique() > 1:
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
