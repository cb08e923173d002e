"""The tasks of Inspect with the released harness and its mock model, and what is read of its logs.

Inspect lives in an environment of its own, made by `.ci/run --nightly`; PHYSION_INSPECT is the path
of its Python.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import subprocess
import sys
from statistics import NormalDist
from typing import Any

import pytest

from support.paths import ROOT
from support.programs import find_program
from support.red_and_yellow import make_dataset

pytestmark = [pytest.mark.slow, pytest.mark.nightly]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the runs of `support/inspect_runs.py` gave."""
    python = sys.executable
    if importlib.util.find_spec("inspect_ai") is None:
        python = find_program(
            variable="PHYSION_INSPECT", what="Inspect (Python with the extra inspect)"
        )
    folder = tmp_path_factory.mktemp("inspect")
    dataset = make_dataset(folder / "trials")
    done = subprocess.run(
        [python, ROOT / "tests" / "support" / "inspect_runs.py", dataset, folder / "logs"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return dict(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.parametrize(
    ("run", "accuracy", "bias", "flips"),
    [("yes", 0.5, 0.5, 0), ("no", 0.5, -0.5, 0), ("first", 0.5, 0, 1)],
)
def test_answers_are_counted_by_outcome_and_order(
    found: dict[str, Any], run: str, accuracy: float, bias: float, flips: float
) -> None:
    got = found[run]
    assert got["status"] == "success" and got["unreadable"] == 0
    assert (got["accuracy"], got["yes_bias"], got["flips"]) == (accuracy, bias, flips)
    assert got["d_prime"] == pytest.approx(0)


def test_the_truth_is_right_in_both_orders(found: dict[str, Any]) -> None:
    got = found["truth"]
    assert got["status"] == "success" and got["unreadable"] == 0
    assert (got["accuracy"], got["stderr"], got["yes_bias"], got["flips"]) == (1, 0, 0, 0)
    # Four of four contacts and none of four others: (k + 1/2) / (n + 1), z of .9 twice.
    assert got["d_prime"] == pytest.approx(2 * NormalDist().inv_cdf(0.9))
    rows = found["true"]["rows"]
    assert not found["true"]["warnings"] and len(rows) == 4
    assert all(row["p_contact"] == row["predicted"] == row["outcome"] for row in rows.values())


def test_the_standard_error_is_clustered_by_stimulus(found: dict[str, Any]) -> None:
    """Two stimuli of two right answers and two of none: sqrt(sum d^2 C / (C - 1)) / n, d = 1."""
    assert found["yes"]["stderr"] == pytest.approx(math.sqrt(4 * 4 / 3) / 8)
    assert found["first"]["stderr"] == 0


def test_what_cannot_be_read_is_wrong_and_counted(found: dict[str, Any]) -> None:
    assert found["nonsense"]["accuracy"] == 0 and found["nonsense"]["unreadable"] == 8
    assert found["slow"]["accuracy"] == 0 and found["slow"]["unreadable"] == 2
    assert found["nonsense"]["d_prime"] < -2


def test_pictures_and_the_control(found: dict[str, Any]) -> None:
    assert found["pictures"]["unreadable"] == 0, "three pictures, and a text that says so"
    assert found["questions"] == ["left", "moves", "view"]
    assert found["seen"]["grouped_left"] == 0.5


def test_logs_become_predictions(found: dict[str, Any]) -> None:
    rows = found["read"]["rows"]
    assert {name: row["outcome"] for name, row in rows.items()} == {
        f"squares_{place}": place < 2 for place in range(4)
    }
    assert all(row["p_contact"] == 1 and row["predicted"] for row in rows.values())
    assert rows["squares_0"]["model"] == "mockllm/model"
    tied = found["order"]["rows"].values()
    assert {row["p_contact"] for row in tied} == {0.5}
    assert {row["predicted"] for row in tied} == {True, False}, "drawn for each stimulus"


def test_missing_answers_are_named_and_wrong_and_can_be_made(found: dict[str, Any]) -> None:
    half = found["half"]
    assert all(row["p_contact"] == 1 for row in half["rows"].values()), "yes, or wrong where no"
    (warning,) = half["warnings"]
    assert "4 of 8 answers are missing and count as wrong (squares_2-contact-1" in warning
    assert "inspect eval-retry" in warning
    assert found["retried"] == {"task": "physion/contact", "kept": 4}


def test_answers_that_fail_in_some_epochs_are_wrong(found: dict[str, Any]) -> None:
    (warning,) = found["epochs"]["warnings"]
    assert "12 of 16 answers are missing and count as wrong" in warning


def test_other_logs_are_refused(found: dict[str, Any]) -> None:
    assert "asks about 'left'" in found["other question"]["error"]
    assert "cannot be read as a log of Inspect" in found["cut"]["error"]
    assert "of version 0; this package reads version 1" in found["older"]["error"]
