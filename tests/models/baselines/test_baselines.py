"""What holds for all baselines: settings, no torch, no leak, no dependence on the batch."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from physion.clips.batch import Batch
from physion.core.errors import BadInputError, UnknownNameError
from physion.models import build_model
from physion.models.interface import Model, can
from support.crossing_bodies import batch_of, crossing, replace_future, some_crossings

PEOPLE = {f"crossing_1_{row:04d}": row / 60 for row in range(60)}
OTHERS: dict[str, dict[str, Any]] = {
    "outcome": {"outcomes": {"a": True}},
    "majority-of-people": {"humans": {"a": 0.3}},
    "state-classifier": {"trees": 7},
    "already-touched": {"margin": 0.02},
    "constant-motion": {"frames": 20},
    "blob-centroids": {"image_size": 48},
    "copy-last-frame": {"image_size": 16},
}
"""Every baseline, with options that are not the default."""


def fitted(name: str, fit: Batch, labels: np.ndarray) -> Any:
    """Return the baseline, fitted if it can be."""
    options = {"majority-of-people": {"humans": PEOPLE}, "state-classifier": {"trees": 20}}
    model = build_model(name, **options.get(name, {}))
    return model.fit(fit, labels, 3) if can(model, "fit") else model


def answers(model: Any, batch: Batch) -> np.ndarray:
    """Return what the model says about a batch, by its method."""
    if can(model, "imagine"):
        return np.asarray(model.imagine(batch, 2, 0).gap)
    return np.asarray(model.predict(batch))


def seen_by(name: str) -> tuple[Any, Batch]:
    """Return a fitted baseline and motions that it was not fitted to; some have touched."""
    fit, labels = some_crossings(60, 0)
    test, _ = some_crossings(59, 1)
    touching = crossing(name="crossing_1_0059", touch=(30,), agent=(1.0, 2.0, 0.0))
    return fitted(name, fit, labels), batch_of([*(test.state or ()), touching])


@pytest.mark.parametrize("name", OTHERS)
def test_digest_and_provenance_follow_the_settings(name: str) -> None:
    model, other = build_model(name), build_model(name, **OTHERS[name])
    assert isinstance(model, Model)
    assert model.digest() == build_model(name).digest() != other.digest()
    assert int(model.digest(), 16) >= 0 and len(model.digest()) == 64
    assert model.provenance().model == name and model.provenance().init == "none"
    with pytest.raises(UnknownNameError, match=f"option of model {name}"):
        build_model(name, sampels=1)


def test_digests_of_different_baselines_differ() -> None:
    assert len({build_model(name).digest() for name in OTHERS}) == len(OTHERS)


def test_baselines_that_look_at_no_trial_say_so() -> None:
    stated = {name: build_model(name).provenance().inputs for name in [*OTHERS, "chance"]}
    assert {name: words for name, words in stated.items() if words} == {
        "outcome": "outcomes", "majority-of-people": "answers of people", "chance": "base rate",
    }  # fmt: skip


def test_only_the_outcome_is_shown_outcomes() -> None:
    assert [name for name in OTHERS if can(build_model(name), "with_outcomes")] == ["outcome"]


@pytest.mark.parametrize(
    ("name", "protocol"),
    [("outcome", "full"), ("majority-of-people", "observed"),
     ("state-classifier", "observed"), ("already-touched", "observed")],
)  # fmt: skip
def test_answers_are_given_under_their_protocol(name: str, protocol: str) -> None:
    model = build_model(name)
    assert any(can(model, what) for what in ("predict", "fit")) and model.answers == protocol


@pytest.mark.parametrize("name", [n for n in OTHERS if not can(build_model(n), "encode")])
def test_an_answer_depends_on_its_own_trial_alone(name: str) -> None:
    model, batch = seen_by(name)
    together = answers(model, batch)
    assert len(np.unique(together)) > 1 or name == "outcome"
    order = np.random.default_rng(2).permutation(len(batch))
    assert answers(model, batch.select(order)).tobytes() == together[order].tobytes()
    alone = np.concatenate([answers(model, batch.select([row])) for row in range(len(batch))])
    assert alone.tobytes() == together.tobytes()


@pytest.mark.parametrize(
    "name", ["majority-of-people", "state-classifier", "already-touched", "constant-motion"]
)
def test_noise_after_the_observed_part_changes_no_answer(name: str) -> None:
    fit, labels = some_crossings(60, 0)
    model, batch = seen_by(name)
    noisy = batch_of([replace_future(motion) for motion in batch.state or ()])
    assert answers(model, noisy).tobytes() == answers(model, batch).tobytes()
    # Nor does noise in the trials of the fit.
    refit = fitted(name, batch_of([replace_future(m, 1) for m in fit.state or ()]), labels)
    assert answers(refit, batch).tobytes() == answers(model, batch).tobytes()


def test_the_noise_of_these_tests_would_be_noticed() -> None:
    _, batch = seen_by("outcome")
    noisy = batch_of([replace_future(motion) for motion in batch.state or ()])
    assert answers(build_model("outcome"), noisy).mean() == 1
    assert answers(build_model("outcome"), batch).mean() < 0.1


@pytest.mark.parametrize(
    "name", ["outcome", "state-classifier", "already-touched", "constant-motion"]
)
def test_trials_without_motion_are_named(name: str) -> None:
    model, batch = seen_by(name)
    movie = crossing(name="movie_0001", agent=(float("nan"), 0.0, 0.0))
    with pytest.raises(BadInputError, match="'movie_0001' was imported without motion"):
        answers(model, batch_of([crossing(name="crossing_1_0000"), movie]))
    with pytest.raises(BadInputError, match=f"{name} needs motions"):
        answers(model, Batch(("a",), batch.frames[:1], batch.valid[:1]))


@pytest.mark.parametrize("name", ["state-classifier", "already-touched", "constant-motion"])
def test_trials_that_end_in_the_observed_part_are_refused(name: str) -> None:
    model, _ = seen_by(name)
    with pytest.raises(BadInputError, match="'short' has 44 frames, fewer than"):
        answers(model, batch_of([crossing(name="short", frames=44)]))


def test_baselines_run_without_torch() -> None:
    code = f"""
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "timm", "lightning_fabric", "av", "hdf5plugin"):
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
from physion.models import build_model
for name in {list(OTHERS)}:
    build_model(name)
print("built")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "built\n", done.stderr
