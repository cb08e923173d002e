"""Evaluation of models, from movies to the table of predictions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.analysis.tables import check_predictions
from physion.core.errors import BadInputError, UnknownNameError
from physion.models import build_model, models
from physion.readout.evaluate import evaluate, evaluate_model
from physion.readout.logistic import ReadoutConfig
from physion.readout.settings import EvaluationConfig
from physion.readout.tables import (
    OFFICIAL_COLUMNS,
    OWN_COLUMNS,
    Evaluation,
    read_table,
    write_table,
)
from physion.trials.dataset import Dataset
from support.moving_dots import make_dots
from support.tiny_models import TINY

QUICK = EvaluationConfig(steps=20, accelerator="cpu", readout=ReadoutConfig(grid=(1e-4, 1e-2, 1.0)))
COUNTS = {"training": 4, "readout": 24, "testing": 20}


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_dots(tmp_path_factory.mktemp("dots"), COUNTS, ("collide", "drop"))


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def done(dots: Dataset, work: Path) -> Evaluation:
    return evaluate(dots, "frozen-encoder", work, options=TINY, config=QUICK)


def accuracy(table: pd.DataFrame, protocol: str) -> float:
    rows = table[table["Protocol"] == protocol]
    return float((rows["Predicted Outcome"] == rows["Actual Outcome"]).mean())


@pytest.mark.slow
def test_full_is_far_above_chance_and_observed_is_not(done: Evaluation) -> None:
    """The dot changes direction after the observed part, which therefore does not predict it."""
    table = done.predictions
    assert accuracy(table, "full") > 0.5 + 3 * np.sqrt(0.25 / 40)
    for protocol in ("observed", "observed+simulated"):
        assert abs(accuracy(table, protocol) - 0.5) < 3 * np.sqrt(0.25 / 40)


def test_the_table_is_the_official_one_and_says_more(done: Evaluation, dots: Dataset) -> None:
    table = done.predictions
    assert tuple(table.columns) == (*OFFICIAL_COLUMNS, *OWN_COLUMNS)
    assert len(table) == 3 * 2 * COUNTS["testing"]
    assert (table["Init"] == "random").all()
    assert (table["Inputs"] == "rgb").all()
    assert (table["Model"] == "random-test_vit-mlp").all()
    assert set(zip(table["Protocol"], table["Readout Type"], strict=True)) == {
        ("full", "A"), ("observed+simulated", "B"), ("observed", "C"),
    }  # fmt: skip
    assert np.allclose(table["Predicted Prob_true"] + table["Predicted Prob_false"], 1)
    truth = dots.index.set_index("trial")["contact"]
    assert (table["Actual Outcome"] == table["Stimulus Name"].map(truth)).all()
    cell = table[(table["Protocol"] == "full") & (table["Readout Test Data"] == "drop")]
    hits = cell["Predicted Outcome"] == cell["Actual Outcome"]
    assert cell["Test Accuracy"].unique() == pytest.approx([hits.mean()])
    assert (table["Fit Trials"] == COUNTS["readout"]).all() and (table["Fold"] == -1).all()
    assert (table["Recorded Outcome"] == "").all()
    assert (table["Fit Labels"] == "simulated").all()
    assert table["Validation Loss"].notna().all() and table["Copy-last Loss"].gt(0).all()


def test_the_comparison_reads_the_table(done: Evaluation) -> None:
    checked = check_predictions(pd.read_csv(done.path))
    assert set(checked["readout"]) == {"observed", "observed+simulated", "full"}
    assert len(checked) == len(done.predictions)


def test_a_second_run_does_nothing_and_says_the_same(
    done: Evaluation, dots: Dataset, work: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[str] = []

    def note(what: str, done: int, total: int) -> None:
        steps.append(what)

    again = evaluate(dots, "frozen-encoder", work, options=TINY, config=QUICK, progress=note)
    assert steps == [] and again.path == done.path
    pd.testing.assert_frame_equal(again.predictions, done.predictions)
    content = done.path.read_bytes()
    done.path.unlink()
    evaluate(dots, "frozen-encoder", work, options=TINY, config=QUICK, progress=note)
    assert "features" not in steps and "training all" not in steps
    assert done.path.read_bytes() == content


@pytest.mark.parametrize("damage", ["cut", "empty", "no text", "another number"])
def test_a_damaged_table_is_made_again(
    done: Evaluation, dots: Dataset, work: Path, damage: str
) -> None:
    content = done.path.read_bytes()
    changed = {
        "cut": b"\n".join(content.split(b"\n")[:3]) + b"\n",
        "empty": b"",
        "no text": b"\xff\xfe" + content,
        "another number": content.replace(b"True", b"Trve", 1),
    }[damage]
    assert changed != content
    done.path.write_bytes(changed)
    again = evaluate(dots, "frozen-encoder", work, options=TINY, config=QUICK)
    assert again.path.read_bytes() == content
    pd.testing.assert_frame_equal(again.predictions, done.predictions)


def test_other_dynamics_share_the_features(done: Evaluation, dots: Dataset, work: Path) -> None:
    steps: list[str] = []
    config = EvaluationConfig(
        readouts=("observed+simulated",), steps=5, accelerator="cpu", readout=QUICK.readout
    )
    evaluation = evaluate(
        dots, "frozen-encoder", work, options={**TINY, "dynamics": "lstm"}, config=config,
        progress=lambda what, done, total: steps.append(what),
    )  # fmt: skip
    assert "features" not in steps and steps.count("training all") >= 5
    assert set(evaluation.predictions["Model"]) == {"random-test_vit-lstm"}


@pytest.mark.parametrize("protocol", ["all-but", "only"])
def test_training_protocols_are_named_in_the_table(
    protocol: str, dots: Dataset, work: Path, done: Evaluation
) -> None:
    config = EvaluationConfig(
        readouts=("observed+simulated",),
        training=protocol,
        steps=3,
        accelerator="cpu",
        readout=QUICK.readout,
    )
    table = evaluate(dots, "frozen-encoder", work, options=TINY, config=config).predictions
    prefix = "no_" if protocol == "all-but" else ""
    assert (table["Dynamics Training Dataset"] == prefix + table["Readout Test Data"]).all()


def test_without_a_readout_split_the_tested_trials_are_cross_fitted(
    dots: Dataset, work: Path, done: Evaluation
) -> None:
    tested = Dataset(dots.folder)
    tested.index = tested.index[tested.index["split"] == "testing"].reset_index(drop=True)
    config = EvaluationConfig(
        steps=3, folds=4, accelerator="cpu", readout=QUICK.readout, readouts=("observed", "full")
    )
    table = evaluate(tested, "frozen-encoder", work, options=TINY, config=config).predictions
    assert set(table["Fold"]) == {0, 1, 2, 3} and len(table) == 2 * 2 * COUNTS["testing"]
    assert (table["Fit Trials"] < COUNTS["testing"]).all()
    assert accuracy(table, "full") > 0.7


def test_a_broken_movie_is_one_clear_error_and_leaves_no_table(tmp_path: Path) -> None:
    dots = make_dots(tmp_path / "data", {"readout": 2, "testing": 2}, ("drop",))
    path = dots.paths("drop_testing_0001").observed_movie
    path.write_bytes(path.read_bytes()[:400])
    with pytest.raises(BadInputError, match="drop_testing_0001"):
        evaluate(dots, "frozen-encoder", tmp_path / "out", options=TINY, config=QUICK)
    assert list((tmp_path / "out").rglob("*.csv")) == []
    assert list((tmp_path / "out").rglob("*.part")) == []


def test_unknown_and_impossible_readouts_are_refused(dots: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="observed"):
        evaluate(
            dots,
            "frozen-encoder",
            tmp_path,
            options=TINY,
            config=EvaluationConfig(readouts=("obs",)),
        )
    with pytest.raises(BadInputError, match="does not support the readout protocol"):
        evaluate(dots, "noisy-simulation", tmp_path, config=EvaluationConfig(readouts=("full",)))
    wrong = EvaluationConfig(training="but-all", accelerator="cpu")
    with pytest.raises(UnknownNameError, match="all-but"):
        evaluate(dots, "frozen-encoder", tmp_path, options=TINY, config=wrong)
    assert "frozen-encoder" in models


def test_an_encoder_without_dynamics_has_two_readouts(
    dots: Dataset, work: Path, done: Evaluation
) -> None:
    inner: Any = build_model("frozen-encoder", **TINY)

    class Seeing:
        spec = inner.spec
        provenance = inner.provenance
        digest = encoder_digest = inner.encoder_digest

        def encode(self, batch: Any) -> Any:
            return inner.encode(batch.to("cpu")).numpy()

    table = evaluate_model(dots, Seeing(), work, config=QUICK).predictions
    assert set(table["Protocol"]) == {"observed", "full"}
    assert (table["Dynamics Training Dataset"] == "").all()
    again = done.predictions[done.predictions["Protocol"] == "full"].reset_index(drop=True)
    same = table[table["Protocol"] == "full"].reset_index(drop=True)
    assert np.allclose(same["Predicted Prob_true"], again["Predicted Prob_true"])


def test_tables_survive_their_file(done: Evaluation, tmp_path: Path) -> None:
    write_table(done.predictions, tmp_path / "t.csv")
    read = read_table(tmp_path / "t.csv")
    pd.testing.assert_frame_equal(read, done.predictions, check_exact=True)
