"""Decisions on rollouts and tokens: thresholds of gaps, levels of noise, the attentive probe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.models.build import build_model
from physion.readout.attentive import COMPONENTS, HEADS, AttentiveDecision
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
from physion.readout.evaluate import evaluate
from physion.readout.features import Arguments, Outcomes, all_arguments
from physion.readout.logistic import LogisticSettings, fit_readout
from physion.readout.predictor import build_decision
from physion.readout.settings import EvaluationSettings
from support.moving_dots import make_dots
from support.tiny_models import TINY

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


# --- the attentive probe ------------------------------------------------------------------------


def decide(
    features: NDArray[np.float32],
    labels: NDArray[np.bool_],
    fitted: int,
    tokens: int = 1,
    **more: Any,
) -> Any:
    decision = AttentiveDecision(LogisticSettings(**more), tokens=tokens)
    return decision.decide([features[:fitted]], labels[:fitted], [features[fitted:]])


@pytest.mark.parametrize("size", [5, COMPONENTS + 20])
def test_of_one_token_it_is_the_logistic_regression(size: int) -> None:
    """Equal weights of H heads give C |w|^2 / (2 H), also in the space of principal components."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(60, 1, size)).astype(np.float32)
    if size > COMPONENTS:  # so that few components hold all that varies
        features = features[..., :10] @ rng.normal(size=(10, size)).astype(np.float32)
    labels = features[:, 0, 0] + rng.normal(size=60) > 0
    found = decide(features, labels, 40, grid=(0.1,))
    expected = fit_readout(
        features[:40], labels[:40], features[40:], LogisticSettings(grid=(0.1 * HEADS,))
    )
    np.testing.assert_allclose(found.probability, expected.probability, atol=2e-4)
    assert found.train_accuracy == expected.train_accuracy and found.c == 0.1


def marked(trials: int, tokens: int, seed: int = 0) -> tuple[NDArray[np.float32], Any]:
    """Tokens of which a marked one, anywhere, tells the label, and all others tell nothing."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(trials, tokens, 4)).astype(np.float32)
    features[..., 1] = rng.choice([-2, 2], size=(trials, tokens))
    labels = rng.random(trials) < 0.5
    place = rng.integers(tokens, size=trials)
    features[..., 0] = 0
    features[np.arange(trials), place, 0] = 4
    features[np.arange(trials), place, 1] = np.where(labels, 2, -2)
    return features, labels


@pytest.mark.nightly
@pytest.mark.slow
def test_a_marked_token_is_read_wherever_it_is() -> None:
    features, labels = marked(300, 12)
    found = decide(features, labels, 200)
    linear = fit_readout(features[:200], labels[:200], features[200:])
    accuracies = [
        np.mean((p > 0.5) == labels[200:]) for p in (found.probability, linear.probability)
    ]
    assert accuracies[0] > 0.95 and accuracies[1] < 0.75
    assert found.cv_accuracy > 0.9 and found.c in (1e-3, 1e-2, 1e-1, 1.0)
    again = decide(features, labels, 200)
    assert np.array_equal(again.probability, found.probability)
    # The same tokens, three of them in each of four time steps.
    steps = decide(features.reshape(300, 4, 12), labels, 200, tokens=3)
    np.testing.assert_allclose(steps.probability, found.probability, atol=1e-6)


def test_one_outcome_parts_of_other_sizes_and_tokens_that_do_not_fit() -> None:
    features, labels = marked(20, 3)
    assert set(decide(features, np.ones(20, bool), 10).probability) == {11 / 12}
    with pytest.raises(BadInputError, match="cannot be divided into 3 tokens"):
        decide(features, labels, 10, tokens=3)
    parts = [features[:10], features[:10, :, :2]]
    with pytest.raises(BadInputError, match="differ in size"):
        AttentiveDecision().decide(parts, labels[:10], parts)


def test_models_say_how_many_tokens_they_have() -> None:
    grid = {**TINY, "image_size": 64, "pooling": "attentive"}
    model: Any = build_model("frozen-encoder", **grid)
    assert model.feature_size == 16 * 64 and model.tokens == 16 and model.decision == "attentive"
    assert model.provenance().model == "random-test_vit-attentive-mlp"
    decision = build_decision(model, "", LogisticSettings())
    assert isinstance(decision, AttentiveDecision) and decision.tokens == 16
    plain = build_model("frozen-encoder", **TINY)
    assert build_decision(plain, "attentive", LogisticSettings()).tokens == 1


@pytest.mark.nightly
@pytest.mark.slow
def test_an_encoder_with_attentive_pooling_finds_where_the_dot_ends(tmp_path: Path) -> None:
    dots = make_dots(tmp_path / "dots", {"readout": 24, "testing": 20}, ("drop",))
    options = {**TINY, "pooling": "attentive"}
    settings = EvaluationSettings(accelerator="cpu", readouts=("full",), untrained=True)
    table = evaluate("frozen-encoder", dots, tmp_path, settings, options=options).predictions
    assert set(table["decision"]) == {"attentive"}
    assert ((table["p_contact"] > 0.5) == table["outcome"]).mean() > 0.8
