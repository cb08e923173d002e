"""The exported task in the released lmms-eval, with its mock model.

It lives in an environment of its own, made by `.ci/run --nightly`; PHYSION_LMMS_EVAL is the path of
its Python.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

from physion.tasks.logs import read_answers
from physion.trials.share.lmms_eval import export_lmms_eval
from support.programs import find_program
from support.red_and_yellow import make_dataset


@pytest.mark.nightly
@pytest.mark.slow
def test_the_released_harness_runs_the_task(tmp_path: Path) -> None:
    python = find_program(variable="PHYSION_LMMS_EVAL", what="lmms-eval")
    task = tmp_path / "task"
    export_lmms_eval(make_dataset(tmp_path / "trials"), task)
    done = subprocess.run(
        [
            *(python, "-m", "lmms_eval", "--model", "dummy_video_reader", "--include_path", task),
            *("--model_args", "response=A,read_bytes=64", "--batch_size", "1", "--log_samples"),
            *("--tasks", "physion_contact,physion_perception", "--output_path", tmp_path / "logs"),
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
           ("accuracy", "d_prime", "yes_bias", "flips", "unreadable", "asked")}  # fmt: skip
    assert got == {"accuracy": 0.5, "d_prime": 0, "yes_bias": 0, "flips": 1, "unreadable": 0,
                   "asked": 8}, done.stderr[-2000:]  # fmt: skip
    assert results["physion_perception"]["accuracy,none"] == 0.5
    (samples,) = (tmp_path / "logs").rglob("*_samples_physion_contact.jsonl")
    log = read_answers(samples)
    assert len(log.predictions) == 4 and not log.warnings
    assert set(log.predictions["p_contact"]) == {0.5}
