"""The drift diffusion model: known parameters are found again, and what has no estimate says so."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from physion.analysis.statistics.diffusion import (
    FEWEST,
    _closed_form,
    diffusion_by_session,
    fit_diffusion,
)
from physion.cli.main import main
from physion.core.errors import BadInputError, MissingExtraError

fitted = pytest.mark.skipif(
    importlib.util.find_spec("pyddm") is None, reason="the extra 'diffusion' is not installed"
)
STEP = 0.001


def decide(drift: float, boundary: float, rest: float, n: int, seed: int = 0):  # type: ignore[no-untyped-def]
    """Random walks until they reach a boundary: right or wrong, and times in seconds."""
    rng = np.random.default_rng(seed)
    x, times = np.zeros(n), np.full(n, np.nan)
    for k in range(1, 20_000):
        going = np.isnan(times)
        if not going.any():
            break
        x[going] += drift * STEP + np.sqrt(STEP) * rng.normal(size=going.sum())
        times[going & (np.abs(x) >= boundary / 2)] = k * STEP
    return x > 0, times + rest


@fitted
@pytest.mark.parametrize(
    ("drift", "boundary", "rest"), [(1.2, 1.8, 0.4), (0.4, 2.4, 0.3), (2.5, 1.2, 0.6)]
)
def test_known_parameters_are_found_again(drift: float, boundary: float, rest: float) -> None:
    right, times = decide(drift, boundary, rest, 600)
    found = fit_diffusion(right, times)
    assert found.reason == "" and found.answers == 600
    assert found.drift == pytest.approx(drift, abs=0.2)
    # Walks in steps overshoot the boundary by about 0.58 root steps on each side.
    assert found.boundary == pytest.approx(boundary, rel=0.08)
    assert found.nondecision_s == pytest.approx(rest, abs=0.05)
    again = fit_diffusion(right, times)
    assert again == found


@fitted
def test_who_guesses_has_no_drift_and_who_is_wrong_a_negative_one() -> None:
    right, times = decide(0.0, 1.6, 0.3, 400)
    assert abs(fit_diffusion(right, times).drift) < 0.2
    right, times = decide(1.0, 1.6, 0.3, 400)
    one, other = fit_diffusion(right, times), fit_diffusion(~right, times)
    assert other.drift == pytest.approx(-one.drift, abs=0.02)


@fitted
def test_sessions_are_rows_and_the_command_prints_their_means(
    tmp_path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = []
    for k, drift in enumerate((0.6, 1.6)):
        right, times = decide(drift, 1.8, 0.4, 80, seed=k)
        label = np.random.default_rng(9).permutation(80) % 2 == 0
        parts.append(
            pd.DataFrame(
                {
                    "participant": f"p{k}", "session": f"s{k}", "scenario": "drop", "phase": "test",
                    "stimulus": [f"drop_{i:03d}" for i in range(80)], "trial": np.arange(80),
                    "label": label, "rt_ms": 1000 * times, "simulated": False,
                    "response": np.where(right == label, "yes", "no"),
                }
            )
        )  # fmt: skip
    file = tmp_path / "trials.csv"
    pd.concat(parts).to_csv(file, index=False)
    out = tmp_path / "out" / "diffusion.csv"
    assert main(["compare", "diffusion", "--responses", str(file), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "drift" in text and "nondecision" in text and "Info" not in text
    rows = pd.read_csv(out).set_index("session")
    assert list(rows["answers"]) == [80, 80] and rows["drift"]["s1"] > rows["drift"]["s0"]


def test_what_cannot_be_fitted_says_why() -> None:
    few = fit_diffusion(np.ones(FEWEST), np.r_[np.ones(FEWEST - 1), 11.0])
    assert few.left_out == 1 and np.isnan(few.drift) and "fewer than 40" in few.reason
    assert "equal" in fit_diffusion(np.ones(50), np.ones(50)).reason
    with pytest.raises(BadInputError, match="negative"):
        fit_diffusion([1], [-0.1])
    table = pd.DataFrame({"scenario": "drop", "session": "s", "participant": "p",
                          "correct": [True] * 3, "rt_ms": [900.0, 800.0, np.nan]})  # fmt: skip
    (row,) = diffusion_by_session(table).to_dict("records")
    assert (row["session"], row["answers"], row["left_out"]) == ("s", 2, 1)


def test_the_closed_form_is_that_of_its_paper() -> None:
    """P = .802, V = .112 and M = .723 give .0999, .1400 and .300 in the paper, with noise of .1."""
    n = 100_000
    right = np.arange(n) < 0.802 * n
    z = np.where(np.arange(n) % 2 == 0, 1.0, -1.0)
    start = _closed_form(right.astype(float), 0.723 + np.sqrt(0.112) * z)
    assert start["drift"] * 0.1 == pytest.approx(0.0999, abs=2e-4)
    assert start["half_boundary"] * 2 * 0.1 == pytest.approx(0.1400, abs=2e-4)
    assert start["nondecision_s"] == pytest.approx(0.300, abs=1e-3)


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    right, times = decide(1.0, 1.6, 0.3, 60)
    with pytest.raises(MissingExtraError, match="diffusion"):
        fit_diffusion(right, times)


@fitted
def test_the_library_renames_no_level_of_other_logs() -> None:
    program = (
        "import logging\n"
        "from physion.analysis.statistics.diffusion import _library\n"
        "_library()\n"
        "print(logging.getLevelName(logging.ERROR), logging.getLevelName(logging.CRITICAL))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.split() == ["ERROR", "CRITICAL"], done.stderr
