"""Exports read by the libraries that they are for, which live in environments of their own.

`.ci/run --nightly` makes these; PHYSION_LEROBOT and PHYSION_STABLE_WORLDMODEL are the paths of
their Pythons.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physion.core.errors import MissingExtraError
from physion.trials.dataset import Dataset
from physion.trials.share.lance import export_lance
from physion.trials.share.lerobot import export_lerobot, states_of
from support.programs import find_program
from support.viewer_dataset import FRAMES, make_dataset

SCRIPT = Path(__file__).parents[2] / "support" / "read_back.py"


def read_back(python: str, layout: str, folder: Path, home: Path) -> dict[str, Any]:
    """What the library reads of an export."""
    homes = {"HF_HOME": str(home), "HF_HUB_OFFLINE": "1", "STABLEWM_HOME": str(home)}
    done = subprocess.run(
        [python, SCRIPT, layout, folder],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | homes,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def states(folder: Path, trial: str) -> np.ndarray:
    known = Dataset(folder).trial(trial)
    return states_of(known.scene, known.trajectory, 3)


@pytest.mark.nightly
@pytest.mark.slow
def test_lerobot_reads_what_was_exported(tmp_path: Path) -> None:
    python = find_program(variable="PHYSION_LEROBOT", what="LeRobot")
    source = make_dataset(tmp_path / "trials")
    export_lerobot(source, tmp_path / "out")
    found = read_back(python, "lerobot", tmp_path / "out", tmp_path / "home")
    assert (found["episodes"], found["frames"], found["fps"]) == (4, 4 * FRAMES, 30)
    assert found["task"] == "Will the red object touch the yellow object?"
    assert found["episode"] == [0, 1, 3] and found["success"] == [False, False, True]
    for values, (trial, frame) in zip(
        found["states"], (("drape_0", 0), ("drop_0", 7), ("drop_2", FRAMES - 1)), strict=True
    ):
        assert np.array_equal(np.float32(values), states(source, trial)[frame])
    assert found["actions"][1][:2] == [3.0, 4.0] and found["actions"][1][-1] == 0
    assert found["actions"][0] == [0, 0, 0, 0, 0, 0, -1]
    movie = Dataset(source).frames("drop_2")
    assert found["picture"] == [3, *movie.shape[1:3]]
    assert found["color"][2] == pytest.approx(movie[-1].mean() / 255, abs=0.01)


@pytest.mark.nightly
@pytest.mark.slow
def test_stable_worldmodel_reads_what_was_exported(tmp_path: Path) -> None:
    python = find_program(variable="PHYSION_STABLE_WORLDMODEL", what="stable-worldmodel")
    source = make_dataset(tmp_path / "trials")
    found = read_back(python, "lance", source, tmp_path / "home")
    assert found["broken"] == [2, 0], "a damaged movie is refused, and leaves no table"
    assert found["again"] == [0, 2], "tables that are there are not replaced"
    assert found["lengths"] == [FRAMES] * 4 and found["clips"] == 4 * (FRAMES - 3)
    assert found["names"] == ["action", "done", "pixels", "state", "success"]
    for values, (trial, frame) in zip(
        found["states"], (("drape_0", 0), ("drop_0", 6), ("drop_2", FRAMES - 4)), strict=True
    ):
        assert np.array_equal(np.float32(values), states(source, trial)[frame])
    assert found["actions"][1][1][:2] == [3.0, 4.0] and found["actions"][1][0][0] == 0
    assert found["success"] == [[0] * 4, [0] * 4, [1] * 4] and found["done"] == [0, 0, 0, 1]
    assert found["picture"] == [4, 3, 64, 64]
    movie = Dataset(source).frames("drop_2")
    assert found["color"][2] == pytest.approx(movie[-4].mean(), abs=3)
    assert found["trials"][2] == {
        "episode_idx": 2, "trial": "drop_1", "scenario": "drop", "split": "testing",
        "contact": False, "first_contact_frame": -1,
    }  # fmt: skip


def test_without_pylance_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lance", None)
    with pytest.raises(MissingExtraError, match="extra 'lance'"):
        export_lance(tmp_path, tmp_path / "out")
