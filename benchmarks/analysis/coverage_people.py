"""Intervals of numbers about people alone, for `interval_coverage.py`."""

from __future__ import annotations

import numpy as np
import pandas as pd

from coverage_studies import Coverage, Size, Study, logistic
from physion.analysis.intervals import Bootstrap
from physion.analysis.mixed import fit_linear, fit_logistic
from physion.analysis.people.effects import (
    HYPOTHESES,
    regress_hypotheses,
    side_bias,
    yes_bias,
)
from physion.analysis.people.measures import accuracy_by_scenario, agreement_by_scenario
from physion.core.seeds import generator


def of_people(coverage: Coverage, size: Size, repeats: int) -> None:
    """Accuracy, agreement and biases."""
    named = ("accuracy", "kappa of pairs", "correlation of pairs", "bias", "d_prime", "criterion",
             "left presses")  # fmt: skip
    if not coverage.wants(*(f"people: {name}" for name in named)):
        return
    draws = Bootstrap()
    rng = generator("orders of trials", *size)
    for study in coverage.studies("people", size, repeats):
        test = study.test(rng)
        tables = [(accuracy_by_scenario(test, draws), "people: accuracy", _bounds("accuracy"))]
        agreement = agreement_by_scenario(test, draws, halves=2)
        for measure in ("kappa", "correlation"):
            rows = agreement[agreement["measure"] == measure]
            tables.append((rows, f"people: {measure} of pairs", _bounds("mean")))
        bias = yes_bias(test, draws)
        tables += [(bias, f"people: {name}", _bounds(name))
                   for name in ("bias", "d_prime", "criterion")]  # fmt: skip
        tables.append((side_bias(test, draws), "people: left presses", _bounds("left")))
        for rows, what, columns in tables:
            value, low, high = rows.iloc[0][list(columns)].astype(float)
            coverage.add(what, "people", size, value, low, high)


def _bounds(name: str) -> tuple[str, str, str]:
    return name, f"{name}_low", f"{name}_high"


def hypotheses(coverage: Coverage, size: Size, repeats: int) -> None:
    """Effects of attributes on the accuracy of stimuli, in one scenario and over two."""
    what = [
        f"{name}, {where}" for name in HYPOTHESES for where in ("one scenario", "two scenarios")
    ]
    if not coverage.wants(*what):
        return
    rng = generator("attributes", *size)
    drawn = coverage.studies("stimuli", size, 2 * repeats)
    for _ in range(repeats):
        stimuli = pd.concat(
            [_stimuli(next(drawn), name, rng) for name in ("drop", "roll")], ignore_index=True
        )
        table = regress_hypotheses(stimuli).set_index(["hypothesis", "scenario"])
        for name in HYPOTHESES:
            for scenario, where in (("drop", "one scenario"), ("all", "two scenarios")):
                row = table.loc[(name, scenario)]
                coverage.add(f"{name}, {where}", "stimuli", size, row["b"], row["low"],
                             row["high"])  # fmt: skip


def _stimuli(study: Study, scenario: str, rng: np.random.Generator) -> pd.DataFrame:
    """Return stimuli of which hard ones have more elements, distractors and occluders."""
    hard, n = 1 - study.easiness, len(study.label)
    return pd.DataFrame(
        {
            "stimulus": [f"{scenario} {k}" for k in range(n)],
            "scenario": scenario,
            "accuracy": study.right,
            "mean_log_rt": 7 + 0.15 * hard + 0.05 * (1 + np.abs(hard)) * rng.normal(size=n),
            "elements": np.clip(np.round(2 + 0.5 * hard + rng.normal(size=n)), 1, 6),
            "distractors": rng.binomial(2, logistic(0.3 * hard - 1)),
            "occluders": rng.binomial(1, logistic(0.5 * hard - 1)),
        }
    )


def mixed_models(coverage: Coverage, size: Size, repeats: int) -> None:
    """Fixed effects of mixed models of single answers, with people and stimuli crossed.

    Response times are those of the model: linear in the accuracy of the stimulus, with normal
    effects of people and stimuli.
    """
    names = {name: f"mixed model of {name}" for name in ("H1", "H3", "H4")}
    if not coverage.wants(*names.values()):
        return
    rng = generator("mixed models", *size)
    people, stimuli = size
    for study in coverage.studies("both", size, repeats):
        table = _stimuli(study, "drop", rng)
        log_rt = (
            7.5
            - 0.5 * study.right
            + 0.1 * rng.normal(size=stimuli)
            + 0.2 * rng.normal(size=(people, 1))
            + 0.4 * rng.normal(size=(people, stimuli))
        )
        rows = table.loc[np.tile(np.arange(stimuli), people)].assign(
            participant=np.repeat(np.arange(people).astype(str), stimuli),
            correct=(study.yes == study.label).ravel(),
            log_rt=log_rt.ravel(),
        )
        for name, what in names.items():
            hypothesis = HYPOTHESES[name]
            if not coverage.wants(what):
                continue
            fit = fit_logistic if hypothesis.family == "logistic" else fit_linear
            effects = fit(hypothesis.formula.replace("scenario + ", ""), rows).table
            row = effects.set_index("term").loc[hypothesis.predictor]
            coverage.add(what, "both", size, row["b"], row["low"], row["high"])
