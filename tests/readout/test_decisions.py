"""Decisions on rollouts: the threshold of a gap and the level of noise."""

from __future__ import annotations

import numpy as np
import pytest

from physion.core.errors import BadInputError
from physion.readout.decisions import (
    ClosestDecision,
    Decision,
    EndDecision,
    GapDecision,
    NoiseDecision,
    TouchDecision,
    best_threshold,
    decisions,
    fit_arguments,
    log_likelihood,
)
from physion.readout.features import Arguments, Outcomes, all_arguments
from physion.readout.logistic import LogisticSettings

NO_ARGUMENTS: Arguments = ()


def arguments(scale: float) -> Arguments:
    return (("scale", scale),)


def gaps(*rows: list[float]) -> dict[Arguments, Outcomes]:
    return {NO_ARGUMENTS: Outcomes(None, np.array(rows, np.float64))}


@pytest.mark.parametrize("name", decisions.names())
def test_every_decision_says_what_it_needs(name: str) -> None:
    decision = decisions.get(name)(LogisticSettings())
    assert decision.input in ("features", "rollouts") and decision.labels in (
        "simulated",
        "recorded",
    )


def test_all_combinations_of_arguments_are_tried_in_the_order_of_their_names() -> None:
    assert all_arguments({}) == [()]
    assert all_arguments({"b": (1, 2), "a": (3,)}) == [
        (("a", 3.0), ("b", 1.0)),
        (("a", 3.0), ("b", 2.0)),
    ]


def futures(*contacts: int) -> np.ndarray:
    """Return 20 futures of each trial, the first of which end in a contact."""
    return np.arange(20) < np.array(contacts, np.int64)[:, None]


def test_the_scale_is_the_one_under_which_outcomes_are_likeliest() -> None:
    outcomes = np.array([True, True, False, True])
    touches = {
        arguments(0.5): futures(20, 0, 20, 0),
        arguments(1.0): futures(18, 16, 6, 18),
        arguments(2.0): futures(10, 10, 10, 10),
    }
    assert fit_arguments(touches, outcomes) == arguments(1.0)
    only = {arguments(2.0): touches[arguments(2.0)]}
    assert fit_arguments(only, outcomes) == arguments(2.0)
    nothing = {k: v[:0] for k, v in touches.items()}
    assert fit_arguments(nothing, outcomes[:0]) == arguments(1.0), "the middle one"
    equal = {arguments(s): futures(10, 10, 10, 10) for s in (2.0, 0.5, 1.0)}
    assert fit_arguments(equal, outcomes) == arguments(0.5), "the smallest of equal ones"


def test_the_likelihood_of_certain_answers_is_finite() -> None:
    assert np.isnan(log_likelihood(futures(), np.zeros(0)))
    assert log_likelihood(np.array([[True]]), np.array([True])) == pytest.approx(np.log(0.75))
    assert log_likelihood(futures(20), np.array([False])) == pytest.approx(np.log(0.5 / 21))


def test_noise_decides_by_the_futures_of_the_chosen_level() -> None:
    sure = Outcomes(np.array([[True, True], [False, False]]), None)
    wrong = Outcomes(np.array([[False, False], [True, True]]), None)
    tested = Outcomes(np.array([[True, False], [True, True]]), None)
    fit = {arguments(1.0): sure, arguments(2.0): wrong}
    test = {arguments(1.0): tested, arguments(2.0): wrong}
    decided = NoiseDecision().decide(fit, np.array([True, False]), test)
    assert decided.probability.tolist() == [0.5, 2.5 / 3] and decided.train_accuracy == 1.0
    assert decided.fitted == {"scale": 1.0}


def test_the_threshold_separates_gaps_and_stays_near_zero() -> None:
    near = np.array([0.02, 0.05, 0.2, 0.4])
    labels = np.array([True, True, False, False])
    assert best_threshold(near, labels) == pytest.approx(0.125)
    assert best_threshold(near, ~labels) == 0.0, "none is right more often than the contact itself"
    assert best_threshold(near, labels[[0, 2, 1, 3]]) == pytest.approx(0.035), "or 0.3: as good"
    assert best_threshold(near[:0], labels[:0]) == 0.0
    assert best_threshold(np.array([np.inf, -0.1]), np.array([False, True])) == 0.0


def test_gaps_of_several_samples_give_probabilities() -> None:
    fit = gaps([0.02, 0.03], [0.04, 0.05], [0.5, 0.6], [0.7, 0.8])
    labels = np.array([True, True, False, False])
    decided = GapDecision().decide(fit, labels, gaps([0.0, 0.9], [0.0, 0.0]))
    assert decided.probability == pytest.approx([0.5, 2.5 / 3]) and decided.train_accuracy == 1.0
    one = GapDecision().decide(gaps([0.1], [0.6]), np.array([True, False]), gaps([0.2], [0.5]))
    assert one.probability.tolist() == [1.0, 0.0]
    assert one.fitted["gap"] == pytest.approx(0.35)
    # Medians 0.1 and 0.3, neither the smallest gap nor the mean, of three futures each.
    three = gaps([0.0, 0.1, 0.9], [0.2, 0.3, 0.35])
    assert GapDecision().decide(three, np.array([True, False]), three).fitted == {
        "gap": pytest.approx(0.2)
    }


@pytest.mark.parametrize("decision", [EndDecision, ClosestDecision, GapDecision, TouchDecision])
def test_only_noise_chooses_among_arguments(decision: type[Decision]) -> None:
    outcomes = Outcomes(None, np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 2)))
    several = {arguments(0.5): outcomes, arguments(1.0): outcomes}
    with pytest.raises(BadInputError, match=r"offers scale=0.5; scale=1: .* 'noise'"):
        decision().decide(several, np.array([True]), several)


def test_only_contacts_have_no_threshold() -> None:
    contacts = {NO_ARGUMENTS: Outcomes(np.array([[True]]), None)}
    with pytest.raises(BadInputError, match="use the decision 'noise'"):
        GapDecision().decide(contacts, np.array([True]), contacts)


def test_the_fixed_distance_counts_at_the_end_or_at_any_time() -> None:
    end, closest = np.array([[0.2, 0.0], [0.1, 0.3]]), np.array([[-0.1, -0.2], [0.1, 0.0]])
    tested = {NO_ARGUMENTS: Outcomes(None, np.ones((2, 2)), end, closest)}
    for decision, expected in (
        (EndDecision(), [1.5 / 3, 0.5 / 3]),
        (ClosestDecision(), [2.5 / 3, 1.5 / 3]),
    ):
        decided = decision.decide({}, np.zeros(0, np.bool_), tested)
        assert decided.probability == pytest.approx(expected) and not decision.fits
        with pytest.raises(BadInputError, match="which particle models give"):
            decision.decide({}, np.zeros(0, np.bool_), gaps([0.1]))


def test_touching_needs_no_fit_and_counts_futures() -> None:
    """P = (k + 1/2) / (S + 1) for k of S futures; a gap of 0 touches."""
    decide = TouchDecision().decide
    near = gaps([0.0, -0.1, 0.2], [0.1, 0.2, 0.3], [0.0, 0.0, 0.0])
    decided = decide({}, np.zeros(0, np.bool_), near)
    assert decided.probability == pytest.approx([2.5 / 4, 0.5 / 4, 3.5 / 4])
    assert np.isnan(decided.train_accuracy) and decided.fitted == {}
    seen = {NO_ARGUMENTS: Outcomes(np.array([[True], [False]]), np.array([[0.3], [-0.3]]))}
    assert decide(seen, np.array([True, False]), seen).probability.tolist() == [1.0, 0.0]
    nothing = {NO_ARGUMENTS: Outcomes(None, np.zeros((0, 3)))}
    none = decide(nothing, np.zeros(0, bool), near)
    assert np.isnan(none.train_accuracy)
