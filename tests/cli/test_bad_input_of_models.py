"""Movies, weights and memory that do not suffice for a model: one line, exit code 2."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest
import timm
import torch
from safetensors.torch import save_file

from physion.cli.main import main
from physion.trials.dataset import Dataset
from physion.trials.index import write_index
from physion.trials.video import encode_movie
from support import trained_models
from support.moving_dots import FRAMES, OBSERVED, SIZE, make_dots

MODEL = f"{trained_models.__file__}:NextBrightness"
HUGE = """
import torch
from support.trained_models import NextBrightness

class HugeLoss(NextBrightness):
    def loss(self, batch):
        return {"loss": self.net(torch.empty(2**50)).sum()}

class HugeStatistics(NextBrightness):
    def prepare(self, sample):
        self.center.fill_(torch.empty(2**50).sum())

class HugeFeatures(NextBrightness):
    def encode(self, batch):
        return torch.empty(2**50)

class HugeWeights(NextBrightness):
    def _apply(self, function, recurse=True):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
"""
ENCODE = ["--accelerator", "cpu", "--option", "untrained=true"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    counts = {"training": 2, "readout": 4, "testing": 2}
    return make_dots(tmp_path_factory.mktemp("dots"), counts, ("collide",))


@pytest.fixture
def dots(made: Dataset, tmp_path: Path) -> Dataset:
    return Dataset(shutil.copytree(made.folder, tmp_path / "dots"))


def refused(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """The one line that a command prints, which ends with exit code 2."""
    capsys.readouterr()
    assert main(list(command)) == 2
    error = capsys.readouterr().err.strip()  # of the end of the line that shows progress
    assert error.count("\n") == 0 and error.startswith("physion: ")
    return error


CHANGES: dict[str, tuple[int, int, int]] = {
    "short": (-5, SIZE, 30), "rate": (0, SIZE, 25), "size": (0, 32, 30),
}  # fmt: skip
"""What a movie has: frames more than it should have, pixels of a side, frames a second."""
MOVIES = {
    "observed": ("evaluate", "testing", OBSERVED),
    "whole": ("evaluate", "testing", FRAMES),
    "trained": ("train", "training", FRAMES),
}
"""Verb that reads a movie, split of its trial, and frames that it should have."""


@pytest.mark.slow
@pytest.mark.parametrize("change", ["cut", *CHANGES])
@pytest.mark.parametrize("read", list(MOVIES))
@pytest.mark.parametrize(
    "known",
    [
        pytest.param(True, id="indexed"),
        pytest.param(False, id="changed", marks=pytest.mark.nightly),
    ],
)
def test_a_movie_that_does_not_fit_is_named(
    change: str, read: str, known: bool, dots: Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether or not the index holds the SHA-256 of the movie as it is."""
    verb, split, frames = MOVIES[read]
    trial = dots.trials(split)[0]
    column = "observed_movie" if read == "observed" else "movie"
    path = getattr(dots.paths(trial), column)
    message = "cannot be read|is damaged|is cut short"
    if change == "cut":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        more, size, rate = CHANGES[change]
        pictures = np.full((frames + more, size, size, 3), 90, np.uint8)
        path.write_bytes(encode_movie(pictures, rate=rate))
        message = (
            f"has {frames + more} frames of {size} x {size} pixels at {rate} a second, not {frames}"
        )
    if known:
        row = dots.index["trial"] == trial
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        dots.index.loc[row, f"{column}_sha256"] = sha256
        write_index(dots.folder, dots.index)
    out = ["--out", str(dots.folder.parent / "out"), "--accelerator", "cpu"]
    if verb == "evaluate":
        error = refused(capsys, verb, MODEL, str(dots.folder), *out, "--option", "untrained=true")
    else:
        error = refused(capsys, verb, MODEL, str(dots.folder), *out)
    assert str(path) in error
    expected = message if known else "was changed since it was made"
    assert any(part in error for part in expected.split("|"))


def test_memory_that_is_used_up_names_what_to_lower(
    made: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "huge.py"
    file.write_text(HUGE)
    train = ["train", "", str(made.folder), "--accelerator", "cpu", "--out", str(tmp_path)]
    messages = {
        "HugeLoss": "lower the batch and accumulate more, such as batch 2 and accumulate 2",
        "HugeStatistics": "use a smaller image_size or size of the model",
        "HugeWeights": "use a smaller size of the model, or accelerator cpu",
    }
    for name, message in messages.items():
        train[1] = f"{file}:{name}"
        assert message in refused(capsys, *train, "--option", "batch=4")
    evaluate = ["evaluate", f"{file}:HugeFeatures", str(made.folder), "--out", str(tmp_path)]
    assert "lower the option encoder_batch, now 4" in refused(capsys, *evaluate, *ENCODE)
    one = [*ENCODE, "encoder_batch=1"]
    assert "use a smaller image_size or size of the model" in refused(capsys, *evaluate, *one)


def test_memory_that_numpy_lacks_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def exhausted(args: list[str]) -> int:
        np.ones(2**50)
        return 0

    monkeypatch.setattr("physion.cli.main._run_verb", exhausted)
    assert "lower the options encoder_batch" in refused(capsys, "ls")


def test_weights_of_another_network_name_the_tensors(
    made: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "w.safetensors"
    with torch.random.fork_rng(devices=[]):
        save_file(timm.create_model("test_resnet", pretrained=False).state_dict(), path)
    options = ["--option", "encoder=test_vit", "image_size=64", "hidden=4", f"weights={path}"]
    out = ["--out", str(tmp_path / "out")]
    command = ["evaluate", "frozen-encoder", str(made.folder), *out, *ENCODE, *options[1:]]
    error = refused(capsys, *command)
    assert "does not fit encoder 'test_vit'" in error
    assert "patch_embed.proj.weight is missing" in error
