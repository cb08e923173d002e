"""Evaluation of simulators: fitted on readout trials, stored, and blind to the future."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

import physion.clips.states
from physion.core.errors import BadInputError
from physion.models import Batch, Provenance, Spec
from physion.models.noisy_simulation import NoisySimulation, NoisySimulationSettings
from physion.physics.trajectory import Contacts, State, Trajectory
from physion.readout.evaluate import evaluate
from physion.readout.folds import Protocol, plan_folds
from physion.readout.predictor import Predictor, choose_readouts
from physion.readout.settings import EvaluationSettings
from physion.scenes.scene import Body, Camera, Roles, Scene
from physion.trials.trial_file import Trial

FRAMES = 100
CONFIG = NoisySimulationSettings(
    position=0.05, velocity=0.0, mass=0.0, scales=(0.0, 1.0, 40.0), samples=20
)


class Flight:
    """Engine in which the ball flies along x and touches the box within 0.5 m of it."""

    name = "flight 1"

    def __init__(self, fail: str = "") -> None:
        self.calls, self.fail = 0, fail

    def simulate(
        self,
        scene: Scene,
        *,
        start: State | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> Trajectory:
        self.calls += 1
        if scene.name == self.fail:
            raise ValueError("the solver diverged")
        given = start.positions if start else np.array([b.position for b in scene.bodies])
        length = FRAMES - (start.frame if start else 0)
        positions = np.tile(given.astype(np.float32), (length, 1, 1))
        positions[:, 0, 0] += 0.02 * np.arange(length)
        near = np.linalg.norm(positions[:, 0] - positions[:, 1], axis=1) < 0.5
        touched = np.flatnonzero(near).astype(np.int32)
        zeros = np.zeros((length, 2, 3), np.float32)
        contacts = replace(
            Contacts.empty(),
            frame=touched,
            bodies=np.tile(np.array([[0, 1]], np.int32), (len(touched), 1)),
            point=np.zeros((len(touched), 3), np.float32),
            normal=np.zeros((len(touched), 3), np.float32),
            impulse=np.ones(len(touched), np.float32),
        )
        turned = np.tile(np.array([1, 0, 0, 0], np.float32), (length, 2, 1))
        return Trajectory(
            positions, turned, zeros, zeros, np.zeros((length, 0, 3), np.float32),
            np.full(length, np.nan, np.float32), contacts, False, self.name,
        )  # fmt: skip


class Shelf:
    """Minimal `Dataset`: an index, and trials with scene and trajectory."""

    def __init__(self, readout: int = 12, testing: int = 10) -> None:
        rng = np.random.default_rng(0)
        rows, self.trials = [], {}
        for split, count in (("readout", readout), ("testing", testing)):
            for i in range(count):
                name = f"collide_{split}_{i}"
                lateral = float(rng.uniform(0.2, 0.8))
                bodies = (
                    Body("ball", "sphere", (0.0, lateral, 0.0)),
                    Body("box", "cube", (1.8, 0.0, 0.0)),
                )
                scene = Scene(
                    name, "collide", bodies, Roles("ball", "box"), Camera((3.0, 0.0, 1.0))
                )
                path = Flight().simulate(scene)
                self.trials[name] = SimpleNamespace(scene=scene, trajectory=path)
                rows.append(
                    {
                        "trial": name, "scenario": "collide", "split": split, "digest": name,
                        "contact": len(path.contacts.frame) > 0, "recorded_contact": i % 2 == 0,
                        "movie_sha256": "", "observed_movie_sha256": "",
                        "frames": FRAMES, "playback_seconds": FRAMES / 30, "observed_frames": 45,
                        "observed_contact": False, "look": "redyellow", "engine": "flight",
                        "trial_file_sha256": name,
                    }
                )  # fmt: skip
        self.index = pd.DataFrame(rows)

        SHELVED.update({name.encode(): trial for name, trial in self.trials.items()})

    def known_trials(self) -> set[str]:
        return set(self.trials)

    def files(self, column: str) -> dict[str, Any]:
        assert column == "trial_file"
        return {
            name: SimpleNamespace(
                read=lambda name=name: name.encode(), check=lambda: None, path=Path(name),
                sha256=trial.scene.to_json() + trial.trajectory.digest(),
            )
            for name, trial in self.trials.items()
        }  # fmt: skip


SHELVED: dict[bytes, Any] = {}
"""Trials of all shelves by their names, which stand for the bytes of their files."""


@pytest.fixture(autouse=True)
def shelves_in_place_of_files(monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(content: bytes, where: str) -> Any:
        return SHELVED[content] if content in SHELVED else Trial(content, where)

    monkeypatch.setattr(physion.clips.states, "Trial", opened)


def fitted_scale(shelf: Any, model: Any, folder: Path) -> tuple[float, np.ndarray]:
    """Return the fitted scale and the probabilities of the tested trials."""
    ways = choose_readouts(model, ())
    predictor = Predictor(shelf, model, ways, EvaluationSettings(), folder=folder)
    (fold,) = plan_folds(shelf.index, Protocol.ALL, 5, 0)
    (answers,) = predictor.predict(fold)
    return answers.decided.fitted["scale"], answers.decided.probability


@pytest.mark.slow
@pytest.mark.parametrize("column", ["contact", "recorded_contact"])
def test_the_noise_is_fitted_only_on_readout_trials(tmp_path: Path, column: str) -> None:
    """The fit uses recorded outcomes, or simulated ones where there is no record."""
    shelf: Any = Shelf()
    shelf.index["recorded_contact"] = pd.array([pd.NA] * len(shelf.index), "boolean")

    def fitted(labels: pd.Series) -> tuple[float, np.ndarray]:
        shelf.index[column] = labels.astype(bool)
        return fitted_scale(shelf, NoisySimulation(CONFIG, Flight()), tmp_path)

    truth = shelf.index["contact"].copy()
    tested = shelf.index["split"] == "testing"
    scale, probability = fitted(truth)
    assert scale == 0.0
    assert fitted(truth ^ tested)[0] == scale, "labels of tested trials must not matter"
    assert (fitted(truth ^ tested)[1] == probability).all()
    assert fitted(truth ^ ~tested)[0] != scale, "labels of readout trials must matter"


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(("known", "expected"), [(12, "recorded"), (0, "simulated"), (5, "mixed")])
def test_the_table_names_the_outcomes_that_were_fitted(
    tmp_path: Path, known: int, expected: str
) -> None:
    """Outcomes of tested trials do not count."""
    shelf: Any = Shelf()
    outcomes = shelf.index["recorded_contact"].astype("boolean")
    outcomes[(shelf.index["split"] == "readout") & (np.arange(len(outcomes)) >= known)] = pd.NA
    shelf.index["recorded_contact"] = outcomes
    model = NoisySimulation(CONFIG, Flight())
    table = evaluate(model, shelf, tmp_path).predictions
    assert set(table["fit_labels"]) == {expected}


def test_predictions_count_futures_and_state_their_scale(tmp_path: Path) -> None:
    shelf: Any = Shelf()
    model = NoisySimulation(replace(CONFIG, scales=(1.0,)), Flight())
    evaluation = evaluate(model, shelf, tmp_path)
    table = evaluation.predictions
    assert len(table) == 10 and evaluation.problems == {}
    counts = table["p_contact"].to_numpy() * 21 - 0.5
    assert np.allclose(counts, counts.round()) and (counts.round() % 20 != 0).sum() > 0
    assert (table["noise_scale"] == 1.0).all() and set(table["readout"]) == {"observed+simulated"}
    said = table["p_contact"] > 0.5
    assert (said == table["outcome"]).mean() > 0.7
    recorded = table["recorded_outcome"] == "True"  # of every second trial here
    assert (table["test_accuracy"] == (said == recorded).mean()).all()
    assert set(table["recorded_outcome"]) == {"True", "False"}
    assert (table["init"] == "none").all()


def test_simulations_are_stored_and_not_made_again(tmp_path: Path) -> None:
    shelf: Any = Shelf(4, 3)
    engines = [Flight(), Flight(), Flight()]
    found, stored = [], []
    for engine, config in zip(engines, (CONFIG, CONFIG, replace(CONFIG, seed=1)), strict=True):
        found.append(fitted_scale(shelf, NoisySimulation(config, engine), tmp_path)[1])
        stored.append(sorted(tmp_path.rglob("*.safetensors")))
    assert engines[0].calls > 0 and engines[1].calls == 0
    assert engines[2].calls == engines[0].calls
    assert (found[0] == found[1]).all()
    assert len(stored[0]) == 7 * 3 and len(stored[2]) == 2 * 7 * 3
    whole = stored[0][0].read_bytes()
    stored[0][0].write_bytes(whole[:-5])
    engines[1].calls = 0
    again = fitted_scale(shelf, NoisySimulation(CONFIG, engines[1]), tmp_path)[1]
    assert engines[1].calls == 20 and (again == found[0]).all()
    assert stored[0][0].read_bytes() == whole


def test_a_trial_that_fails_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    shelf: Any = Shelf(4, 3)
    broken = NoisySimulation(CONFIG, Flight(fail="collide_testing_1"))
    evaluation = evaluate(broken, shelf, tmp_path)
    assert set(evaluation.predictions["stimulus"]) == {"collide_testing_0", "collide_testing_2"}
    assert "diverged" in evaluation.evaluated[0].problems["collide_testing_1"]
    assert evaluation.paths[0].name.endswith(".partial.csv")
    whole = NoisySimulation(CONFIG, Flight())
    again = evaluate(whole, shelf, tmp_path)
    assert len(again.predictions) == 3 and not again.problems
    left = sorted(path.name for path in (tmp_path / "predictions").iterdir())
    assert left == [again.paths[0].name, f"{again.paths[0].name}.sha256"], "the complete table only"


@pytest.mark.parametrize("split", ["readout", "testing"])
def test_a_missing_label_is_no_label(split: str, tmp_path: Path) -> None:
    shelf: Any = Shelf(4, 3)
    shelf.index["contact"] = shelf.index["contact"].astype("boolean")
    shelf.index.loc[shelf.index["trial"] == f"collide_{split}_1", "contact"] = pd.NA
    model = NoisySimulation(CONFIG, Flight())
    with pytest.raises(BadInputError, match=f"1 trials .* without labels.*collide_{split}_1"):
        evaluate(model, shelf, tmp_path)
    shelf.index.loc[shelf.index["contact"].isna(), "split"] = "training"
    assert len(evaluate(model, shelf, tmp_path).predictions) == 3 - (split == "testing")


def test_without_readout_trials_the_tested_ones_are_cross_fitted(tmp_path: Path) -> None:
    shelf: Any = Shelf(0, 10)
    model = NoisySimulation(CONFIG, Flight())
    table = evaluate(model, shelf, tmp_path).predictions
    assert len(table) == 10 and set(table["fold"]) == {0, 1, 2, 3, 4}
    assert (table["fit_trials"] == 8).all()


class Oracle:
    """State model of another package that reports the contacts it receives."""

    spec = Spec(inputs=("state",), context_at="end", stride=1, context=1, future=0)
    answers = "observed"

    def __init__(self, answer: float | None = None) -> None:
        self.answer, self.shown = answer, []  # type: ignore[var-annotated]

    def provenance(self) -> Provenance:
        return Provenance("oracle", "none")

    def digest(self) -> str:
        return "0" * 64

    def predict(self, batch: Batch) -> Any:
        paths = [motion.trajectory for motion in batch.state or ()]
        self.shown += [(len(path), len(path.contacts.frame)) for path in paths]
        found = [float(len(path.contacts.frame) > 0) for path in paths]
        return np.array(found if self.answer is None else [self.answer] * len(found))


def test_other_state_models_are_shown_only_the_observed_part(tmp_path: Path) -> None:
    shelf: Any = Shelf()
    assert shelf.index["contact"].any()
    oracle = Oracle()
    table = evaluate(oracle, shelf, tmp_path).predictions
    assert set(oracle.shown) == {(45, 0)}, "neither later frames nor later contacts"
    assert len(table) == 10 and (table["p_contact"] == 0).all()
    assert set(table["fit_labels"]) == {""}, "nothing is fitted"
    assert set(table["readout"]) == {"observed"}
    assert set(table["inputs"]) == {"state"}, "what its Spec asks for"
    with pytest.raises(BadInputError, match="not a probability"):
        evaluate(Oracle(1.5), shelf, tmp_path / "b")


class Labelled(Oracle):
    """State model that keeps the labels that it is fitted on."""

    def fit(self, batch: Batch, labels: Any, seed: int) -> Any:
        self.labels = dict(zip(batch.trials, labels.tolist(), strict=True))
        return self


def test_a_model_is_fitted_on_recorded_outcomes(tmp_path: Path) -> None:
    shelf: Any = Shelf()
    model = Labelled()
    table = evaluate(model, shelf, tmp_path).predictions
    assert model.labels == {f"collide_readout_{i}": i % 2 == 0 for i in range(12)}
    simulated = shelf.index.set_index("trial")["contact"]
    assert any(simulated[trial] != label for trial, label in model.labels.items())
    assert set(table["fit_labels"]) == {"recorded"} and set(table["fit_trials"]) == {12}
