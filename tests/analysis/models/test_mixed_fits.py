"""Mixed models of a report: known parameters of response times are found again; random slopes."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from physion.analysis.intervals import Bootstrap
from physion.analysis.model_tests import MixedTable, fits_of_people
from physion.analysis.people.results import PeopleResults, analyse_people
from support.simulated_people import as_responses, simulate_study

KNOWN = {"correct": -0.12, "yes": 0.05, "hundred": -0.4, "scenario[T.roll]": 0.25}
SPREAD = {"participant": 0.25, "stimulus": 0.15, "residual": 0.3}


def timed_study(people: int, stimuli: int) -> PeopleResults:
    """People whose log response times are a linear function of their answers, plus noise."""
    trials, _ = simulate_study(people, stimuli, seed=1)
    draw = np.random.default_rng(2)

    def effect(column: str, sd: float) -> np.ndarray:
        codes, names = pd.factorize(trials[column])
        return draw.normal(0, sd, len(names))[codes]

    log_rt = (
        6.4
        + KNOWN["correct"] * trials["correct"]
        + KNOWN["yes"] * (trials["response"] == "yes")
        + KNOWN["hundred"] * trials["trial"] / 100
        + KNOWN["scenario[T.roll]"] * (trials["scenario"] == "roll")
        + effect("participant", SPREAD["participant"])
        + effect("stimulus", SPREAD["stimulus"])
        + draw.normal(0, SPREAD["residual"], len(trials))
    )
    responses = as_responses(trials.assign(rt_ms=np.exp(log_rt)))
    return analyse_people(responses, bootstrap=Bootstrap(resamples=50))


@pytest.fixture(scope="module")
def fits() -> dict[str, MixedTable]:
    return {one.name: one for one in fits_of_people(timed_study(30, 60))}


def test_the_parameters_of_log_normal_response_times_are_found_again(
    fits: dict[str, MixedTable],
) -> None:
    fit = fits["response_times"].fit
    assert fit is not None and fit.converged and not fit.singular
    rows = fit.table.set_index("term").loc[list(KNOWN)]
    assert (np.abs(rows["b"] - pd.Series(KNOWN)) < 3 * rows["se"]).all()
    # The standard errors are small enough for the test to mean something.
    assert rows.loc["correct", "se"] < 0.03 and rows.loc["hundred", "se"] < 0.06
    sd = fit.random.set_index("group")["sd"]
    assert dict(sd) == pytest.approx(SPREAD, rel=0.2)
    # exp(b) is the factor of the median response time.
    assert np.exp(rows.loc["scenario[T.roll]", "b"]) == pytest.approx(np.exp(0.25), rel=0.25)


def test_each_hypothesis_has_a_model_with_slopes_of_people(fits: dict[str, MixedTable]) -> None:
    own = fits["h4_slopes"]
    assert "(1 + accuracy|participant)" in own.formula
    assert own.fit is not None and len(own.fit.correlations) == 1
    terms = list(own.table()["term"])
    assert {"sd of participant", "sd of participant: accuracy"} <= set(terms)
    assert "r of participant: Intercept, accuracy" in terms
    # The number of elements of these stimuli is not known: the reason stands in its place.
    assert fits["h1_slopes"].fit is None and "elements" in fits["h1_slopes"].reason
