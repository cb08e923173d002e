"""Clips of a dataset as torch's DataLoader takes them."""

from __future__ import annotations

import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import physion
from physion.core.errors import BadInputError
from physion.trials.dataset import Dataset

SHORT: dict[str, Any] = {
    "context": 3, "future": 2, "stride": 4, "size": 16, "context_at": "start"
}  # fmt: skip


def test_a_clip_holds_the_frames_of_the_movie_and_the_outcome(made: Dataset) -> None:
    clips = physion.clips(made, **SHORT)
    assert len(clips) == len(made)
    for trial, clip in zip(made.trials(), clips, strict=True):
        assert set(clip) == {"trial", "label", "frames", "valid", "rgb"}
        assert clip["trial"] == trial and clip["frames"].tolist() == [0, 4, 8, 12, 16]
        assert clip["rgb"].shape == (5, 16, 16, 3) and clip["rgb"].dtype == np.uint8
        movie = made.frames(trial, stride=4, count=5, size=(16, 16))
        assert np.array_equal(clip["rgb"], movie)
        assert bool(clip["label"]) == made.trial(trial).labels.contact
    changed = Dataset(made.folder)
    changed.index["contact"] = ~changed.index["contact"]
    assert all(
        a["label"] != b["label"]
        for a, b in zip(clips, physion.clips(changed, **SHORT), strict=True)
    )
    assert [clip["trial"] for clip in clips[1:]] == made.trials()[1:]


def test_every_pass_has_its_shape_and_ids_name_the_roles(made: Dataset) -> None:
    passes = ("rgb", "ids", "depth", "boxes", "camera")
    clip = physion.clips(made, **SHORT, passes=passes, objects=2, labels=False, rendered=True)[0]
    assert "label" not in clip
    assert clip["ids"].shape == clip["depth"].shape == (5, 16, 16)
    assert clip["boxes"].shape == (5, 2, 4) and clip["camera"].shape == (2, 4, 4)
    assert {1, 2} <= set(np.unique(clip["ids"])), "agent and patient are seen"


def test_splits_and_scenarios_choose_the_trials(made: Dataset) -> None:
    row = made.index.iloc[1]
    clips = physion.clips(made, **SHORT, split=row["split"], scenario=row["scenario"])
    assert [clip["trial"] for clip in clips] == made.trials(row["split"], row["scenario"])
    with pytest.raises(BadInputError, match="no trial of split any and scenario none"):
        physion.clips(made, scenario="none")


def test_clips_longer_than_a_trial_repeat_its_last_frame_or_are_left_out(made: Dataset) -> None:
    long = {**SHORT, "future": 12}
    clip = physion.clips(made, **long)[0]
    assert clip["frames"].max() == 49 and clip["valid"].tolist() == [True] * 13 + [False] * 2
    assert np.array_equal(clip["rgb"][-1], clip["rgb"][-2])
    with pytest.raises(BadInputError, match="is long enough for a clip"):
        physion.clips(made, **long, padding=False)
    assert len(physion.clips(made, **SHORT, padding=False)) == len(made)
    usual = physion.clips(made, size=16)
    assert usual[0]["frames"].tolist() == [2, 8, 14, 20, 26, 32, 38, 44, 49]
    with pytest.raises(BadInputError, match="need the number of frames that follow"):
        physion.clips(made, size=16, padding=False)


def test_without_a_future_only_the_observed_movies_are_opened(
    made: Dataset, tmp_path: Path
) -> None:
    shutil.copytree(made.folder, tmp_path / "copy")
    copy = Dataset(tmp_path / "copy")
    for trial in copy.trials():
        copy.paths(trial).movie.unlink()
        copy.paths(trial).trial_file.unlink()
    clips = physion.clips(copy, **{**SHORT, "future": 0, "context_at": "end"})
    assert [clip["frames"].tolist() for clip in clips] == [[36, 40, 44]] * len(copy)
    with pytest.raises(BadInputError, match="missing"):
        physion.clips(copy, **SHORT)[0]
    with pytest.raises(BadInputError, match="observed"):
        physion.clips(copy, context=20, future=0)


def test_wrong_passes_and_looks_are_refused_at_once(made: Dataset) -> None:
    with pytest.raises(BadInputError, match=r"passes must be some of rgb.*\['state'\]"):
        physion.clips(made, passes=("state",))
    with pytest.raises(BadInputError, match="passes"):
        physion.clips(made, passes=())
    with pytest.raises(BadInputError, match="redyellow, free"):
        physion.clips(made, look="blue")


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_of_a_loader_give_the_same_clips(method: str, made: Dataset) -> None:
    clips = physion.clips(made, **SHORT, passes=("rgb", "depth"))
    here = list(DataLoader(clips, batch_size=2))  # type: ignore[arg-type, var-annotated]
    there = list(
        DataLoader(
            clips,  # type: ignore[arg-type]
            batch_size=2,
            num_workers=2,
            multiprocessing_context=method,
        )
    )
    assert len(here) == len(there) == 1
    assert here[0]["trial"] == there[0]["trial"] == made.trials()
    assert here[0]["label"].dtype == torch.bool and here[0]["rgb"].dtype == torch.uint8
    for name in ("rgb", "depth", "label", "valid", "frames"):
        assert torch.equal(here[0][name], there[0][name]), name


@pytest.mark.slow
@pytest.mark.parametrize("first", ["physion.clips.batch", "physion"])
def test_the_package_of_this_name_is_the_function_too(made: Dataset, first: str) -> None:
    """Whichever of both is imported first, and without torch."""
    call = f"physion.clips({str(made.folder)!r}, size=16)[0]"
    code = f"import {first}, physion; {call}; import physion.clips.states, sys; {call}"
    subprocess.run([sys.executable, "-c", f"{code}; assert 'torch' not in sys.modules"], check=True)


def test_clips_are_small_when_they_are_sent(made: Dataset) -> None:
    clips = physion.clips(made, **SHORT, passes=("rgb", "ids"))
    fresh = len(pickle.dumps(clips))
    first = clips[0]
    copy = pickle.loads(pickle.dumps(clips))
    assert len(pickle.dumps(clips)) == fresh, "what was read stays here"
    assert np.array_equal(copy[0]["ids"], first["ids"])
