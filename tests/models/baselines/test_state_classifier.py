"""Features of the state at frame 44, and trees that are fitted on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from physion.clips.batch import Motion
from physion.core.errors import BadInputError
from physion.models import build_model
from physion.models.baselines.motion import BLOCK, NAMES, state_features
from physion.scenes.scene import Body, BodyEvent, Cloth, Roles
from support.crossing_bodies import batch_of, crossing, some_crossings


def named(motion: Motion) -> dict[str, float]:
    """Return the features of a motion by name."""
    return dict(zip(NAMES, state_features(motion).tolist(), strict=True))


def block(role: str, values: dict[str, float]) -> list[float]:
    """Return the features of one role."""
    return [values[f"{role} {name}"] for name in BLOCK]


def test_features_are_those_of_frame_44() -> None:
    motion = crossing(
        agent=(1.0, 2.0, 3.0), velocity=(4.0, 0.0, -1.0), spin=(0.1, 0.2, 0.3),
        patient=(5.0, 2.0, 0.0), scale=(0.5, 1.0, 2.0),
    )  # fmt: skip
    values = named(motion)
    # Centres lie half a height above the pivots.
    expected = [1, 0, 1, 2, 4, 1, 0, 0, 0, 4, 0, -1, 0.1, 0.2, 0.3, 0.5, 1, 2]
    assert block("agent", values) == pytest.approx(expected)
    assert block("patient", values)[2:5] == pytest.approx([5, 2, 1])
    assert block("probe", values) == [0] * len(BLOCK), "this scene has no probe"
    between = [values[f"agent to patient {n}"] for n in ("dx", "dy", "dz", "dvx", "dvy", "dvz")]
    assert between == pytest.approx([4, 0, -3, -4, 0, 1])
    assert values["agent to patient distance"] == pytest.approx(5)


def test_equal_rotations_have_equal_features_and_move_the_centre() -> None:
    motion = crossing(agent=(0.0, 0.0, 0.0), scale=(1.0, 1.0, 2.0))
    rotations = np.array(motion.trajectory.rotations)
    rotations[:, 0] = (np.sqrt(0.5), np.sqrt(0.5), 0, 0)  # about x: up becomes -y
    turned = Motion(motion.scene, replace(motion.trajectory, rotations=rotations))
    other = Motion(motion.scene, replace(motion.trajectory, rotations=-rotations))
    assert state_features(turned).tolist() == state_features(other).tolist()
    values = named(turned)
    assert [values[f"agent {axis}"] for axis in "xyz"] == pytest.approx([0, -1, 0], abs=1e-6)
    assert values["agent qw"] == pytest.approx(np.sqrt(0.5))


def test_probe_is_a_body_of_its_own() -> None:
    bodies = (Body("agent", "cube", (0, 0, 0)), Body("patient", "cube", (2, 0, 0)))
    motion = crossing(
        bodies=(*bodies, Body("ball", "sphere", (0, -3, 0))),
        roles=Roles("agent", "patient", "ball"),
    )
    values = named(motion)
    assert block("probe", values)[:5] == pytest.approx([1, 0, 0, -3, 0.5])
    assert values["probe to patient distance"] == pytest.approx(np.sqrt(13))


def test_absent_bodies_give_zeros() -> None:
    events = (BodyEvent(50, "patient", "appear"),)
    values = named(crossing(events=events))
    assert block("patient", values) == [0] * len(BLOCK)
    assert values["agent to patient distance"] == 0 and values["agent present"] == 1
    vanished = named(crossing(events=(BodyEvent(44, "agent", "vanish"),)))
    assert vanished["agent present"] == 0 and vanished["patient present"] == 1
    later = named(crossing(events=(BodyEvent(45, "agent", "vanish"),)))
    assert later["agent present"] == 1


def test_a_cloth_is_the_mean_of_its_vertices() -> None:
    sheets = (Cloth("first", (0, 0, 2), resolution=3), Cloth("sheet", (0, 0, 2), resolution=2))
    motion = crossing(cloths=sheets, roles=Roles("sheet", "patient"))
    vertices = np.zeros((60, 13, 3), np.float32)
    vertices[:, 9:, 0] = (0, 1, 2, 5)
    vertices[:, 9:, 2] = 2 - 0.03 * np.arange(60)[:, None]
    vertices[:, :9] = 77
    values = named(Motion(motion.scene, replace(motion.trajectory, cloth_vertices=vertices)))
    expected = [1, 1, 2, 0, 2 - 0.03 * 44, 1, 0, 0, 0, 0, 0, -3, 0, 0, 0, 2, 2, 0]
    assert block("agent", values) == pytest.approx(expected, abs=1e-4)


def accuracy(fit_labels: np.ndarray, test_labels: np.ndarray) -> float:
    """Return the accuracy on 200 trials after a fit on 200 others with given labels."""
    fit, _ = some_crossings(200, 10)
    test, _ = some_crossings(200, 11)
    predicted = build_model("state-classifier", trees=50).fit(fit, fit_labels, 0).predict(test)
    assert ((predicted >= 0) & (predicted <= 1)).all()
    return float(np.mean((predicted > 0.5) == test_labels))


def test_trees_learn_what_the_state_tells_and_nothing_from_permuted_outcomes() -> None:
    fit_labels, test_labels = some_crossings(200, 10)[1], some_crossings(200, 11)[1]
    assert accuracy(fit_labels, test_labels) > 0.9
    # With all outcomes permuted, the right answers of 10 x 200 trials are Binomial(2000, 1/2).
    rng = np.random.default_rng(5)
    means = [accuracy(rng.permutation(fit_labels), rng.permutation(test_labels)) for _ in range(10)]
    assert abs(np.mean(means) - 0.5) < 4 * np.sqrt(0.25 / 2000)
    assert all(abs(mean - 0.5) < 4 * np.sqrt(0.25 / 200) for mean in means)


def test_order_of_the_fitted_trials_does_not_matter_and_the_seed_does() -> None:
    fit, labels = some_crossings(50, 12)
    order = np.random.default_rng(0).permutation(50)
    model = build_model("state-classifier", trees=10)
    first = model.fit(fit, labels, 1)
    same = model.fit(fit.select(order), labels[order], 1)
    other = model.fit(fit, labels, 2)
    assert first.digest() == same.digest() != other.digest()
    assert first.predict(fit).tobytes() == same.predict(fit).tobytes()


@pytest.mark.parametrize("only", [False, True])
def test_one_outcome_alone_is_predicted_again(only: bool) -> None:
    fit, _ = some_crossings(10, 13)
    model = build_model("state-classifier", trees=3).fit(fit, np.full(10, only), 0)
    assert model.predict(fit).tolist() == [float(only)] * 10
    assert model.predict(fit.select([])).shape == (0,)


def test_wrong_input_is_refused() -> None:
    fit, labels = some_crossings(10, 13)
    with pytest.raises(BadInputError, match="9 labels for 10 trials"):
        build_model("state-classifier").fit(fit, labels[:9], 0)
    with pytest.raises(BadInputError, match="0 labels for 0 trials"):
        build_model("state-classifier").fit(fit.select([]), labels[:0], 0)
    with pytest.raises(BadInputError, match="trees and leaf"):
        build_model("state-classifier", trees=0)


def test_a_batch_of_one_motion_is_a_batch() -> None:
    fit, labels = some_crossings(20, 14)
    model = build_model("state-classifier", trees=5).fit(fit, labels, 0)
    assert model.predict(batch_of([crossing()])).shape == (1,)
