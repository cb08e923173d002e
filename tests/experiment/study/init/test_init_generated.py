"""A study from generated trials: the served movie is the beginning of the full one."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from physion.cli.main import main
from physion.experiment.study.study import load_study
from physion.trials.dataset import Dataset
from physion.trials.files import TrialPaths
from physion.trials.video import read_frames
from support.experiment.tiny_study import CONTACT

pytestmark = [pytest.mark.slow, pytest.mark.nightly]
OBSERVED = 45


def test_served_movies_are_the_first_45_frames_of_the_whole_ones(tmp_path: Path) -> None:
    data, folder = tmp_path / "dataset", tmp_path / "study"
    for split in ("testing", "familiarization"):
        words = ["--scenario", "drop", "--split", split, "--count", "2", "--jitters", "0"]
        words += ["--width", "64", "--height", "64", "--workers", "1"]
        assert main(["generate", str(data), *words]) == 0
    words = ["--trials", str(data), "--test", "2", "--practice", "2"]
    assert main(["experiment", "init", *CONTACT, str(folder), *words]) == 0
    dataset, study = Dataset(data), load_study(folder)
    assert Counter((s.phase, s.label) for s in study.stimuli) == {
        (phase, label): 1 for phase in ("test", "familiarization") for label in (True, False)
    }
    for stimulus in study.stimuli:
        paths: TrialPaths = dataset.paths(stimulus.stimulus)
        whole = read_frames(paths.free_movie)
        shown = read_frames(folder / stimulus.movie)
        assert len(shown) == OBSERVED == stimulus.frames
        # Within the codec's error, which is less than the error of a cut at any other frame.
        assert _difference(shown, whole[:OBSERVED]) < 2
        assert _difference(shown, whole[:OBSERVED]) < _difference(shown, whole[1 : OBSERVED + 1])
        assert _difference(shown[1:], whole[1:OBSERVED]) < _difference(
            shown[1:], whole[: OBSERVED - 1]
        )
        row = dataset.index.set_index("trial").loc[stimulus.stimulus]
        assert bool(row["contact"]) == stimulus.label
        if stimulus.full:
            assert len(read_frames(folder / stimulus.full)) == stimulus.full_frames == len(whole)


def _difference(some: NDArray[np.uint8], others: NDArray[np.uint8]) -> float:
    return float(np.abs(some.astype(int) - others).mean())
