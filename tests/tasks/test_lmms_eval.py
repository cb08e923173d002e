"""The exported task in the released lmms-eval, with its mock model.

It lives in an environment of its own, made by `.ci/run --nightly`; PHYSION_LMMS_EVAL is the path of
its Python.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
from pathlib import Path
from statistics import NormalDist
from typing import Any

import pytest

from physion.tasks.logs import read_answers
from physion.trials.share.lmms_eval import export_lmms_eval
from support.programs import find_program
from support.red_and_yellow import make_dataset

RESPONSES = {
    # what the mock model always says: accuracy, yes bias, flips, unreadable, P(contact)
    "A": (0.5, 0, 1, 0, {0.5}),
    "yes": (0.5, 0.5, 0, 0, {1.0}),
    "no": (0.5, -0.5, 0, 0, {0.0}),
    "It depends": (0, None, None, 8, {0.0, 1.0}),
}


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("response", RESPONSES)
def test_the_released_harness_runs_the_task(tmp_path: Path, response: str) -> None:
    python = find_program(variable="PHYSION_LMMS_EVAL", what="lmms-eval")
    task = tmp_path / "task"
    export_lmms_eval(make_dataset(tmp_path / "trials"), task)
    done = subprocess.run(
        [
            *(python, "-m", "lmms_eval", "--model", "dummy_video_reader", "--include_path", task),
            *("--model_args", f"response={response},read_bytes=64", "--batch_size", "1"),
            *("--tasks", "physion_contact,physion_perception", "--output_path", tmp_path / "logs"),
            "--log_samples",
        ],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env=os.environ | {"HF_HOME": str(tmp_path / "hf"), "HF_HUB_OFFLINE": "1"},
    )
    (path,) = (tmp_path / "logs").rglob("*_results.json")
    results: dict[str, Any] = json.loads(path.read_text())["results"]
    got = {name: results["physion_contact"][f"{name},none"] for name in
           ("accuracy", "yes_bias", "flips", "unreadable", "asked")}  # fmt: skip
    accuracy, bias, flips, unreadable, predicted = RESPONSES[response]
    if unreadable:
        # With four answers to either outcome all wrong: (k + 1/2) / (n + 1), z of .1 twice.
        assert math.isnan(got.pop("yes_bias")) and math.isnan(got.pop("flips"))
        assert got == {"accuracy": 0, "unreadable": 8, "asked": 8}
        d_prime = 2 * NormalDist().inv_cdf(0.1)
    else:
        expected = {"accuracy": accuracy, "yes_bias": bias, "flips": flips, "unreadable": 0}
        assert got == expected | {"asked": 8}, done.stderr[-2000:]
        d_prime = 0
    assert results["physion_contact"]["d_prime,none"] == pytest.approx(d_prime)
    if response == "A":
        assert results["physion_perception"]["accuracy,none"] == 0.5
    (samples,) = (tmp_path / "logs").rglob("*_samples_physion_contact.jsonl")
    log = read_answers(samples)
    assert len(log.predictions) == 4 and set(log.predictions["p_contact"]) == predicted
    assert len(log.warnings) == (unreadable > 0)
    if unreadable:
        assert not (log.predictions["predicted"] == log.predictions["outcome"]).any()
        assert "8 answers name no option and count as wrong" in log.warnings[0]
