"""Movies, weights and memory that do not suffice for a model: one line, exit code 2."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
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
from support.moving_dots import OBSERVED, SIZE, make_dots

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
ENCODE = ["--untrained", "--accelerator", "cpu"]


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


def cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def movie(frames: int, size: int, rate: int) -> Callable[[bytes], bytes]:
    return lambda _: encode_movie(np.full((frames, size, size, 3), 90, np.uint8), rate=rate)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (cut, "cannot be read|is damaged|is cut short"),
        (movie(OBSERVED - 5, SIZE, 30), "has 40 frames of 64 x 64 pixels at 30 a second, not 45"),
        (movie(OBSERVED, SIZE, 25), "has 45 frames of 64 x 64 pixels at 25 a second, not 45"),
        (movie(OBSERVED, 32, 30), "has 45 frames of 32 x 32 pixels at 30 a second, not 45"),
    ],
    ids=["cut", "short", "rate", "size"],
)
@pytest.mark.parametrize("known", [True, False], ids=["indexed", "changed"])
def test_a_movie_that_does_not_fit_is_named(
    change: Callable[[bytes], bytes], message: str, known: bool, dots: Dataset,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Whether or not the index holds the SHA-256 of the movie as it is."""
    trial = dots.trials("testing")[0]
    path = dots.paths(trial).observed_movie
    path.write_bytes(change(path.read_bytes()))
    if known:
        row = dots.index["trial"] == trial
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        dots.index.loc[row, "observed_movie_sha256"] = sha256
        write_index(dots.folder, dots.index)
    out = ["--out", str(dots.folder.parent / "out")]
    error = refused(capsys, "evaluate", str(dots.folder), MODEL, *out, *ENCODE)
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
        assert message in refused(capsys, *train, "--batch", "4")
    evaluate = ["evaluate", str(made.folder), f"{file}:HugeFeatures", "--out", str(tmp_path)]
    assert "lower --encoder-batch, now 4" in refused(capsys, *evaluate, *ENCODE)
    one = [*ENCODE, "--encoder-batch", "1"]
    assert "use a smaller image_size or size of the model" in refused(capsys, *evaluate, *one)


def test_memory_that_numpy_lacks_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def exhausted(args: list[str]) -> int:
        np.ones(2**50)
        return 0

    monkeypatch.setattr("physion.cli.main._run_verb", exhausted)
    assert "lower --encoder-batch" in refused(capsys, "ls")


def test_weights_of_another_network_name_the_tensors(
    made: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "w.safetensors"
    with torch.random.fork_rng(devices=[]):
        save_file(timm.create_model("test_resnet", pretrained=False).state_dict(), path)
    options = ["--option", "encoder=test_vit", "image_size=64", "hidden=4"]
    weights = ["--weights", str(path), "--out", str(tmp_path / "out")]
    command = ["evaluate", str(made.folder), "frozen-encoder", *weights, *options, *ENCODE]
    error = refused(capsys, *command)
    assert "does not fit encoder 'test_vit'" in error and "missing ('" in error
    assert "unexpected ('" in error
