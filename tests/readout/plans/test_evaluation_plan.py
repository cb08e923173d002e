"""Plans of evaluations: three readouts, every protocol and seed, and one table of results."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.analysis.tables import read_predictions
from physion.readout.evaluate import evaluate
from physion.readout.plans.evaluation_plan import EvaluationPlan
from physion.readout.plans.results import MEAN, StoredEvaluation, summarise_accuracy
from physion.readout.plans.selection import Selection
from physion.readout.plans.tasks import EvaluationTask
from physion.readout.plans.training_plan import TrainingPlan
from physion.readout.settings import EvaluationConfig
from physion.readout.tables import Evaluation
from physion.readout.trainings import SharedTrainConfig
from physion.training.loop import TrainingOverrides
from physion.training.protocols import Training
from physion.trials.dataset import Dataset
from support.plans.make_plans import (
    EVERY,
    FAILS,
    IMAGINING,
    QUICK,
    SETS,
    UNTRAINED,
    make_evaluation_plan,
)

READOUTS = {"observed", "observed+simulated", "full"}


def test_a_plan_predicts_all_readouts_and_a_second_run_only_reads(
    dots: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = make_evaluation_plan(dots, tmp_path, [UNTRAINED, IMAGINING])
    assert [(t.set_name, t.seed) for t in plan.tasks if t.choice == IMAGINING] == [
        (name, seed) for seed in (0, 1) for name in SETS
    ]
    # Nothing of it is trained, so that protocols and seeds would give the same rows again.
    assert [t.set_name for t in plan.tasks if t.choice == UNTRAINED] == [""]
    results = plan.run()
    assert not results.failed and not results.problems
    assert len(results.evaluated) == 11 and len(results.tables) == 1 + 2 * 3
    for task, evaluation in results.tables:
        table = evaluation.predictions
        wanted = READOUTS if task.choice == IMAGINING else {"observed", "full"}
        assert set(table["Protocol"]) == wanted
        assert len(table) == len(wanted) * 2 * 4
        if task.protocol is Training.ONLY:
            assert (table["Dynamics Training Dataset"] == table["Readout Test Data"]).all()
    # The comparison reads all tables together: no model predicts a stimulus twice.
    read = read_predictions([evaluation.path for _, evaluation in results.tables])
    assert read["agent"].nunique() == 2 + 2 * 3 * 3

    def build(*_: Any, **__: Any) -> None:
        raise AssertionError("a plan that is done builds no model")

    def read_tables(*_: Any) -> None:
        raise AssertionError("a plan that is done reads its records, not its tables")

    monkeypatch.setattr("physion.readout.plans.model_facts.build_model", build)
    again = make_evaluation_plan(dots, tmp_path, [UNTRAINED, IMAGINING])
    assert not again.pending
    with monkeypatch.context() as patched:
        patched.setattr("physion.readout.plans.results.read_table", read_tables)
        stored = again.run()
        pd.testing.assert_frame_equal(
            summarise_accuracy(stored.evaluated), summarise_accuracy(results.evaluated)
        )
    for (_, one), (_, other) in zip(stored.tables, results.tables, strict=True):
        assert (one.path, one.count, one.scores) == (other.path, other.count, other.scores)
        assert one.count == len(one.predictions) > 0


def test_a_table_that_was_changed_in_place_is_made_again(dots: Dataset, tmp_path: Path) -> None:
    def plan() -> EvaluationPlan:
        return make_evaluation_plan(dots, tmp_path, [UNTRAINED], [Training.ALL], (0,))

    ((_, done),) = plan().run().tables
    content, stamp = done.path.read_bytes(), done.path.stat()
    done.path.write_bytes(content.replace(b"True", b"Trve", 1))
    os.utime(done.path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    again = plan()
    assert len(again.pending) == 1
    again.run()
    assert done.path.read_bytes() == content and not plan().pending


def test_the_tables_are_those_of_single_evaluations_and_trainings_are_found(
    dots: Dataset, tmp_path: Path
) -> None:
    selection = Selection((IMAGINING,), (Training.ALL_BUT,), (0,))
    shared = SharedTrainConfig(accelerator="cpu")
    TrainingPlan(dots, tmp_path, selection, TrainingOverrides(), shared).run()
    trained = {p: p.stat().st_mtime_ns for p in (tmp_path / "training").rglob("*")}
    results = make_evaluation_plan(dots, tmp_path, protocols=[Training.ALL_BUT], seeds=(0,)).run()
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "training").rglob("*")} == trained
    ((_, evaluation),) = results.tables
    parts = [part.predictions for _, part in results.evaluated]
    assert [part["Readout Test Data"].unique().tolist() for part in parts] == [
        ["collide"],
        ["drop"],
    ]
    steps: list[str] = []
    alone = evaluate(
        dots, IMAGINING.name, tmp_path, config=EvaluationConfig(training="all-but", **QUICK),
        progress=lambda what, done, total: steps.append(what),
    )  # fmt: skip
    assert alone.path == evaluation.path and steps == []
    apart = evaluate(
        dots, IMAGINING.name, tmp_path / "other",
        config=EvaluationConfig(training="all-but", **QUICK),
    )  # fmt: skip
    assert apart.path.read_bytes() == evaluation.path.read_bytes()


def test_an_evaluation_that_fails_is_reported_and_the_rest_goes_on(
    dots: Dataset, tmp_path: Path
) -> None:
    seen: list[tuple[str, bool, int]] = []

    def show(task: EvaluationTask, reason: str, left: Sequence[EvaluationTask]) -> None:
        seen.append((task.set_name, bool(reason), len(left)))

    results = make_evaluation_plan(dots, tmp_path, [FAILS], seeds=(0,)).run(on_task=show)
    assert [task.set_name for task, _ in results.failed] == ["all", "no_collide", "drop"]
    assert all("no drop, please" in reason for _, reason in results.failed)
    assert [task.set_name for task, _ in results.tables] == ["no_drop", "collide"]
    assert seen == [
        ("all", True, 4), ("no_collide", True, 3), ("no_drop", False, 2), ("collide", False, 1),
        ("drop", True, 0),
    ]  # fmt: skip
    summary = summarise_accuracy(results.evaluated)
    assert set(zip(summary["protocol"], summary["scenario"], strict=True)) == {
        ("all-but", "drop"), ("only", "collide"),
    }  # fmt: skip
    again = make_evaluation_plan(dots, tmp_path, [FAILS], seeds=(0,))
    assert [task.set_name for task in again.pending] == ["all", "no_collide", "drop"]


def test_a_scenario_and_readouts_can_be_chosen(dots: Dataset, tmp_path: Path) -> None:
    plan = make_evaluation_plan(dots, tmp_path, protocols=EVERY[1:], seeds=(0,), scenario="drop",
                     readouts=("observed",))  # fmt: skip
    assert [task.set_name for task in plan.tasks] == ["no_drop", "drop"]
    results = plan.run()
    assert [len(evaluation.predictions) for _, evaluation in results.tables] == [4, 4]
    assert all(set(e.predictions["Protocol"]) == {"observed"} for _, e in results.tables)


def evaluation_of(hits: dict[str, list[bool]], init: str = "random") -> StoredEvaluation:
    """Return an evaluation whose predictions of a scenario are right or not as ``hits`` says."""
    rows = [
        {
            "Model": "m", "Init": init, "Protocol": "full", "Readout Test Data": scenario,
            "Predicted Outcome": hit, "Actual Outcome": True, "Stimulus Name": f"{scenario}{k}",
        }
        for scenario, values in hits.items()
        for k, hit in enumerate(values)
    ]  # fmt: skip
    return StoredEvaluation.of(Evaluation(pd.DataFrame(rows), Path("t.csv"), {}))


def test_results_are_means_and_deviations_over_seeds() -> None:
    def task(seed: int, name: str = "all") -> EvaluationTask:
        return EvaluationTask(IMAGINING, Training.ALL, name, "", seed, str(seed))

    first = evaluation_of({"collide": [True, True, False, False], "drop": [True, True]})
    second = evaluation_of({"collide": [True, True, True, False], "drop": [True, False]})
    summary = summarise_accuracy([(task(0), first), (task(1), second)])
    assert list(summary["scenario"]) == ["collide", "drop", MEAN]
    assert list(summary["seeds"]) == [2, 2, 2] and list(summary["trials"]) == [4, 2, 6]
    assert summary["accuracy"].tolist() == pytest.approx([0.625, 0.75, 0.6875])
    expected = [np.std(pair, ddof=1) for pair in ([0.5, 0.75], [1.0, 0.5], [0.75, 0.625])]
    assert summary["spread"].tolist() == pytest.approx(expected)
    alone = summarise_accuracy([(task(0, ""), first)])
    assert alone["spread"].isna().all() and set(alone["protocol"]) == {""}
    other = evaluation_of({"collide": [True]}, init="imagenet")
    both = summarise_accuracy([(task(0), first), (task(0), other)])
    assert set(both["init"]) == {"random", "imagenet"}, "whose rows are not averaged"
    assert both["seeds"].tolist() == [1] * len(both)
    assert len(summarise_accuracy([])) == 0
