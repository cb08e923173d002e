"""Tests of models against each other, and calibration, on the stimuli of all scenarios together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.models.comparison import Comparison
from physion.analysis.models.model_people import Models
from physion.analysis.people.answers import ScenarioAnswers
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.statistics.calibration import calibration_table
from physion.analysis.statistics.kappa import correctness
from physion.analysis.statistics.paired import compare_models

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
        wide = rows.pivot(index="agent", columns="stimulus", values=column)
        return np.asarray(wide.loc[comparison.agents], dtype=np.float64)

    by_stimulus = rows.drop_duplicates("stimulus").set_index("stimulus").sort_index()
    return PooledStimuli(
        names=tuple(comparison.agents),
        p_contact=by_model("p_contact"),
        correct=by_model("correct"),
        label=by_stimulus["label"].to_numpy(dtype=np.float64),
        p_yes=by_stimulus["p_yes"].to_numpy(dtype=np.float64),
        scenario=tuple(by_stimulus["scenario"]),
    )


def paired_tests(
    pooled: PooledStimuli, bootstrap: Bootstrap, permutations: int | None = None
) -> pd.DataFrame:
    """Test every two models with `paired.compare_models`; empty for one model alone."""
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
    """Return `calibration.calibration_table` of every model against the official outcomes."""
    return calibration_table(list(pooled.names), pooled.p_contact, pooled.label)
