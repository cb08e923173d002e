"""physion train and evaluate: resumed after a kill, on two processes as on one, bad input."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import timm
import torch
from safetensors.torch import save_file

from physion.cli.main import main
from physion.trials.dataset import Dataset
from physion.trials.index import write_index
from physion.trials.video import encode_movie
from support import cell_models, trained_models
from support.moving_dots import FRAMES, OBSERVED, SIZE, make_dots

MODEL = f"{trained_models.__file__}:NextBrightness"
SLOW = f"{trained_models.__file__}:SlowBrightness"
TESTS = Path(__file__).parents[1]
CPU = ["--accelerator", "cpu"]


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    counts = {"training": 4, "readout": 4, "testing": 2}
    return make_dots(tmp_path_factory.mktemp("dots"), counts, ("collide", "drop"))


def files_of(out: Path) -> dict[str, bytes]:
    paths = [path for path in out.rglob("*") if path.is_file() and path.parent.name != "events"]
    return {str(path.relative_to(out)): path.read_bytes() for path in paths}


def trained(out: Path) -> set[Path]:
    """Return the folders of trainings that have ended: their weights have a digest file."""
    return {path.parent for path in out.rglob("model.safetensors.sha256")}


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "physion.cli.main", "train", *arguments, *CPU]


def heed_interrupts() -> None:
    """Undo what a shell sets for programs in the background, which ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def environment() -> dict[str, str]:
    paths = [str(TESTS), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}


@pytest.mark.slow
def test_protocols_and_settings_make_trainings_of_their_own(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["train", MODEL, str(dots.folder), "--out", str(tmp_path), *CPU]
    few = ["--option", "steps=3", "batch=2", "betas=[0.8,0.9]", "schedule=cosine"]
    assert main([*arguments, *few, "--protocol", "all-but"]) == 0
    assert main([*arguments, *few, "--protocol", "only", "--scenario", "drop"]) == 0
    assert main([*arguments, *few, "--seed", "1"]) == 0
    assert main([*arguments, *few, "hidden=9"]) == 0
    names = sorted(path.name.rpartition("-")[0] for path in (tmp_path / "training").iterdir())
    expected = ["all", "all", "drop", "no_collide", "no_drop"]
    assert names == [f"NextBrightness-{name}" for name in expected]
    assert capsys.readouterr().out.count("trained for 3 steps") == 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["noisy-simulation"], "nothing to train"),
        ([MODEL, "--option", "size=paper"], "size"),
        ([MODEL, "--scenario", "drop"], "needs the protocol"),
        ([MODEL, "--protocol", "only", "--scenario", "dorp"], "'drop'|drop"),
        ([MODEL, "--option", "steps=0"], "steps must be at least 1"),
        ([MODEL, "--devices", "3", "--option", "batch=8", "--accelerator", "abacus"], "abacus"),
        (["pVGG-lmp"], "pVGG-mlp"),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], message: str, dots: Dataset, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    model, *rest = arguments
    device = [] if "--accelerator" in rest else CPU
    assert main(["train", model, str(dots.folder), "--out", str(tmp_path), *rest, *device]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert any(part in error for part in message.split("|"))
    assert not list(tmp_path.iterdir())


@pytest.mark.nightly
@pytest.mark.slow
def test_a_training_that_is_killed_ends_with_the_same_bytes(dots: Dataset, tmp_path: Path) -> None:
    arguments = [str(dots.folder), "--option", "steps=60", "checkpoint_every=7", "dropout=0.2"]
    arguments += ["--out"]
    parts = [*arguments, str(tmp_path / "parts")]
    running = subprocess.Popen(
        command(SLOW, *parts), env=environment(), stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    end = time.monotonic() + 120
    while running.poll() is None and time.monotonic() < end:
        if list((tmp_path / "parts").rglob("checkpoint.safetensors")):
            break
        time.sleep(0.01)
    running.send_signal(signal.SIGKILL)
    assert running.wait() == -signal.SIGKILL
    assert not list((tmp_path / "parts").rglob("model.safetensors"))
    resumed = subprocess.run(
        command(SLOW, *parts), env=environment(), check=False, capture_output=True, text=True
    )
    assert resumed.returncode == 0, resumed.stderr
    assert "trained for 60 steps" in resumed.stdout
    assert main(["train", SLOW, *arguments, str(tmp_path / "whole"), *CPU]) == 0
    one, other = (files_of(tmp_path / name / "training") for name in ("parts", "whole"))
    assert one == other


@pytest.mark.nightly
@pytest.mark.slow
def test_two_processes_train_as_one_that_accumulates(dots: Dataset, tmp_path: Path) -> None:
    """Each process gets its part of the clips of a step; the gradients are averaged."""
    arguments = [MODEL, str(dots.folder), "--option", "log_every=1", "validate_every=10"]
    arguments += ["clip=0.5", "dropout=0.2"]
    one = [*arguments, "batch=4", "accumulate=2", "--out", str(tmp_path / "one")]
    two = [*arguments, "batch=8", "--out", str(tmp_path / "two"), "--devices", "2"]
    assert main(["train", *one, *CPU]) == 0
    done = subprocess.run(
        command(*two), env=environment(), check=False, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("trained for 40 steps") == 1
    lines = []
    for name in ("one", "two"):
        (path,) = (tmp_path / name).rglob("metrics.jsonl")
        lines.append([json.loads(line) for line in path.read_text().splitlines()])
    assert [line.keys() for line in lines[0]] == [line.keys() for line in lines[1]]
    for first, second in zip(*lines, strict=True):
        assert second == pytest.approx(first, rel=1e-4, abs=1e-6)
    losses = [line["train/loss"] for line in lines[1] if "train/loss" in line]
    assert len(losses) == 40 and losses[-1] < 0.5 * losses[0]


@pytest.mark.nightly
@pytest.mark.slow
def test_models_protocols_and_seeds(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One of two models fails: the other is trained, and a second run trains nothing again."""
    fails = f"{cell_models.__file__}:FailsOnDrop"
    imagining = f"{cell_models.__file__}:Imagining"
    cells = ["--protocols", "all-but,only", "--seeds", "2", "--seed", "5"]
    cells += ["--option", f"{fails}:hidden=3", "--out", str(tmp_path), *CPU]
    arguments = ["train", f"{imagining},{fails}", str(dots.folder), *cells]
    assert main([*arguments, "--dry-run"]) == 0
    assert "16 of 16 trainings to do" in capsys.readouterr().out and not list(tmp_path.iterdir())
    assert main(arguments) == 1
    shown = capsys.readouterr().out
    assert shown.count("trained for 6 steps") == 8
    assert shown.count("failed: ") == 4 and f"failed: {fails}, only, seed 6: " in shown
    assert main([*arguments, "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert len(result["trained"]) == 8 and all(row["loaded"] for row in result["trained"])
    assert len(result["failed"]) == 4


@pytest.mark.slow
def test_evaluate_prints_a_table(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = f"{cell_models.__file__}:Imagining"
    cells = ["--protocols", "all,only", "--seeds", "2", "--out", str(tmp_path), *CPU]
    assert main(["train", model, str(dots.folder), *cells]) == 0
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "training").rglob("*")}
    capsys.readouterr()
    arguments = ["evaluate", model, str(dots.folder), *cells, "--option", "logistic.grid=[0.1,1]"]
    assert main([*arguments, "--dry-run"]) == 0
    assert "4 of 4 evaluations to do" in capsys.readouterr().out
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert shown.count("predictions: ") == 4 and "observed+simulated" in shown
    (header,) = (line.split() for line in shown.splitlines() if line.split()[0] == "model")
    assert header == ["model", "given", "frames", "accuracy"]
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "training").rglob("*")} == before
    assert main([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert len(result["evaluations"]) == 4 and all(one["done"] for one in result["evaluations"])
    assert len(result["scores"]) == 2 * 3 * 3
    assert main([*arguments, "--dry-run"]) == 0
    assert "0 of 4 evaluations to do" in capsys.readouterr().out


def test_predictions_without_a_trial_to_fit_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A readout that had nothing to be fitted on gives every trial the same number."""
    few = make_dots(tmp_path / "dots", {"testing": 1}, ("drop",))
    arguments = ["evaluate", f"{cell_models.__file__}:NothingToTrain", str(few.folder)]
    assert main([*arguments, "--out", str(tmp_path / "out"), *CPU]) == 0
    assert "are the same number, since the readout had no trial to fit" in capsys.readouterr().err


@pytest.mark.nightly
@pytest.mark.slow
def test_what_is_interrupted_continues_and_a_second_run_trains_nothing(
    dots: Dataset, tmp_path: Path
) -> None:
    model = f"{cell_models.__file__}:Slow"
    cells = [str(dots.folder), "--protocols", "all,only", "--option", "steps=40",
             "checkpoint_every=5"]  # fmt: skip
    parts = [*cells, "--out", str(tmp_path / "parts")]
    running = subprocess.Popen(
        command(model, *parts), env=environment(), stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, preexec_fn=heed_interrupts,
    )  # fmt: skip
    end = time.monotonic() + 600
    while running.poll() is None and time.monotonic() < end:
        # Without their digest file, weights do not count: their training goes on.
        checkpoints = {path.parent for path in tmp_path.rglob("checkpoint.safetensors")}
        if (done := trained(tmp_path)) and checkpoints - done:
            break
        time.sleep(0.01)
    running.send_signal(signal.SIGINT)
    assert running.wait() == 130
    already = len(trained(tmp_path))
    assert 1 <= already < 3
    for before in (already, 3):
        again = subprocess.run(
            command(model, *parts), env=environment(), check=False, capture_output=True, text=True
        )
        assert again.returncode == 0, again.stderr
        assert again.stdout.count("was trained before") == before
    assert main(["train", model, *cells, "--out", str(tmp_path / "whole"), *CPU]) == 0
    one, other = (files_of(tmp_path / name / "training") for name in ("parts", "whole"))
    assert one == other


# --- movies, weights and memory that do not suffice ---------------------------------------------


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


def refused(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """The one line that a command prints, which ends with exit code 2."""
    capsys.readouterr()
    assert main(list(command)) == 2
    error = capsys.readouterr().err.strip()  # of the end of the line that shows progress
    assert error.count("\n") == 0 and error.startswith("physion: ")
    return error


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "column", "change", "known"),
    [
        ("evaluate", "observed_movie", "cut", True),
        ("train", "movie", "cut", True),
        ("evaluate", "movie", (-5, SIZE, 30), True),
        ("train", "movie", (-5, SIZE, 30), True),
        ("evaluate", "observed_movie", (0, 32, 30), True),
        ("train", "movie", (0, SIZE, 25), True),
        ("evaluate", "movie", (0, SIZE, 25), False),
    ],
)
def test_a_movie_that_does_not_fit_is_named(
    verb: str, column: str, change: Any, known: bool, dots: Dataset, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """A change: frames more than there should be, pixels of a side, frames a second.

    ``known``: the index holds the SHA-256 of the movie as it is.
    """
    copy = Dataset(shutil.copytree(dots.folder, tmp_path / "dots"))
    trial = copy.trials("testing" if verb == "evaluate" else "training")[0]
    path = getattr(copy.paths(trial), column)
    frames = OBSERVED if column == "observed_movie" else FRAMES
    if change == "cut":
        message = "cannot be read|is damaged|is cut short"
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        more, size, rate = change
        pictures = np.full((frames + more, size, size, 3), 90, np.uint8)
        path.write_bytes(encode_movie(pictures, rate=rate))
        message = (
            f"has {frames + more} frames of {size} x {size} pixels at {rate} a second, not {frames}"
        )
    if known:
        row = copy.index["trial"] == trial
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        copy.index.loc[row, f"{column}_sha256"] = sha256
        write_index(copy.folder, copy.index)
    options = ["--option", "untrained=true"] if verb == "evaluate" else []
    error = refused(capsys, verb, MODEL, str(copy.folder), "--out", str(tmp_path / "out"), *CPU,
                    *options)  # fmt: skip
    assert str(path) in error
    expected = message if known else "was changed since it was made"
    assert any(part in error for part in expected.split("|"))


def test_memory_that_is_used_up_names_what_to_lower(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "huge.py"
    file.write_text(HUGE)
    train = ["train", "", str(dots.folder), "--accelerator", "cpu", "--out", str(tmp_path)]
    messages = {
        "HugeLoss": "lower the batch and accumulate more, such as batch 2 and accumulate 2",
        "HugeStatistics": "use a smaller image_size or size of the model",
        "HugeWeights": "use a smaller size of the model, or accelerator cpu",
    }
    for name, message in messages.items():
        train[1] = f"{file}:{name}"
        assert message in refused(capsys, *train, "--option", "batch=4")
    evaluate = ["evaluate", f"{file}:HugeFeatures", str(dots.folder), "--out", str(tmp_path)]
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
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "w.safetensors"
    with torch.random.fork_rng(devices=[]):
        save_file(timm.create_model("test_resnet", pretrained=False).state_dict(), path)
    options = ["--option", "encoder=test_vit", "image_size=64", "hidden=4", f"weights={path}"]
    out = ["--out", str(tmp_path / "out")]
    command = ["evaluate", "frozen-encoder", str(dots.folder), *out, *ENCODE, *options[1:]]
    error = refused(capsys, *command)
    assert "does not fit encoder 'test_vit'" in error
    assert "patch_embed.proj.weight is missing" in error
