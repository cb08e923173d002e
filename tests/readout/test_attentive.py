"""The attentive probe: a logistic regression of one token, and what only attention can read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.models import build_model
from physion.readout.attentive import COMPONENTS, HEADS, AttentiveDecision
from physion.readout.evaluate import evaluate
from physion.readout.logistic import LogisticSettings, fit_readout
from physion.readout.predictor import build_decision
from physion.readout.settings import EvaluationSettings
from support.moving_dots import make_dots
from support.tiny_models import TINY


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
    assert (
        build_decision(
            build_model("frozen-encoder", **TINY), "attentive", LogisticSettings()
        ).tokens
        == 1
    )


@pytest.mark.nightly
@pytest.mark.slow
def test_an_encoder_with_attentive_pooling_finds_where_the_dot_ends(tmp_path: Path) -> None:
    dots = make_dots(tmp_path / "dots", {"readout": 24, "testing": 20}, ("drop",))
    options = {**TINY, "pooling": "attentive"}
    settings = EvaluationSettings(accelerator="cpu", readouts=("full",), untrained=True)
    table = evaluate("frozen-encoder", dots, tmp_path, settings, options=options).predictions
    assert set(table["decision"]) == {"attentive"}
    assert ((table["p_contact"] > 0.5) == table["outcome"]).mean() > 0.8
