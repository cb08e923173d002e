"""physion train: resumed after a kill, found by evaluate, on two processes as on one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from physion.cli.main import main
from physion.trials.dataset import Dataset
from support import trained_models
from support.moving_dots import make_dots
from support.plans import plan_models

MODEL = f"{trained_models.__file__}:NextBrightness"
SLOW = f"{trained_models.__file__}:SlowBrightness"
TESTS = Path(__file__).parents[1]
CPU = ["--accelerator", "cpu"]
SLOW_MODULES = {
    "torch", "numba", "scipy", "av", "h5py", "physion.readout.features",
    "physion.clips.clips",
}  # fmt: skip
"""Libraries of models, movies and numerics, and what reads the trials."""


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    counts = {"training": 4, "readout": 4, "testing": 2}
    return make_dots(tmp_path_factory.mktemp("dots"), counts, ("collide", "drop"))


def files_of(out: Path) -> dict[str, bytes]:
    paths = [path for path in out.rglob("*") if path.is_file() and path.parent.name != "events"]
    return {str(path.relative_to(out)): path.read_bytes() for path in paths}


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "physion.cli.main", "train", *arguments, *CPU]


def heed_interrupts() -> None:
    """Undo what a shell sets for programs in the background, which ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def environment() -> dict[str, str]:
    paths = [str(TESTS), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}


def run_apart(*commands: list[str]) -> tuple[str, set[str]]:
    """Run commands in one new process; return what they print, and the slow modules they import."""
    code = (
        "import sys\n"
        "from physion.cli.main import main\n"
        f"assert not any([main(arguments) for arguments in {list(commands)!r}])\n"
        f"print(*{SLOW_MODULES} & set(sys.modules), sep=', ')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment(), capture_output=True, text=True, check=True
    )
    *shown, last = done.stdout.splitlines()
    return "\n".join(shown), set(filter(None, last.split(", ")))


def test_a_second_run_does_nothing_and_says_so(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["train", MODEL, str(dots.folder), "--out", str(tmp_path), *CPU]
    assert main(arguments) == 0
    (folder,) = (tmp_path / "training").iterdir()
    shown = capsys.readouterr().out
    assert "all trained for 40 steps, loss " in shown and shown.rstrip().endswith(str(folder))
    before = files_of(tmp_path)
    assert main(arguments) == 0
    assert "all was trained before, loss " in capsys.readouterr().out
    assert main([*arguments, "--json"]) == 0
    (result,) = json.loads(capsys.readouterr().out)["trained"]
    assert result["loaded"] and result["folder"] == str(folder) and result["steps"] == 40
    assert result["validation"] < 1 and files_of(tmp_path) == before


def test_protocols_and_settings_make_trainings_of_their_own(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["train", MODEL, str(dots.folder), "--out", str(tmp_path), *CPU]
    few = ["--steps", "3", "--batch", "2", "--betas", "0.8", "0.9", "--schedule", "cosine"]
    assert main([*arguments, *few, "--protocol", "all-but"]) == 0
    assert main([*arguments, *few, "--protocol", "only", "--scenario", "drop"]) == 0
    assert main([*arguments, *few, "--seed", "1"]) == 0
    assert main([*arguments, *few, "--option", "hidden=9"]) == 0
    names = sorted(path.name.rpartition("-")[0] for path in (tmp_path / "training").iterdir())
    expected = ["all", "all", "drop", "no_collide", "no_drop"]
    assert names == [f"NextBrightness-{name}" for name in expected]
    assert capsys.readouterr().out.count("trained for 3 steps") == 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["noisy-simulation"], "nothing to train"),
        ([MODEL, "--size", "paper"], "size"),
        ([MODEL, "--scenario", "drop"], "needs the protocol"),
        ([MODEL, "--protocol", "only", "--scenario", "dorp"], "'drop'|drop"),
        ([MODEL, "--steps", "0"], "steps must be at least 1"),
        ([MODEL, "--devices", "3", "--batch", "8", "--accelerator", "abacus"], "abacus"),
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


@pytest.mark.slow
def test_a_training_that_is_killed_ends_with_the_same_bytes(dots: Dataset, tmp_path: Path) -> None:
    arguments = [str(dots.folder), "--steps", "60", "--checkpoint-every", "7"]
    arguments += ["--option", "dropout=0.2", "--out"]
    parts = [*arguments, str(tmp_path / "parts")]
    running = subprocess.Popen(
        command(SLOW, *parts), env=environment(), stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    end = time.monotonic() + 120
    while running.poll() is None and time.monotonic() < end:
        if list((tmp_path / "parts").rglob("previous.safetensors")):
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


@pytest.mark.slow
def test_two_processes_train_as_one_that_accumulates(dots: Dataset, tmp_path: Path) -> None:
    """Each process gets its part of the clips of a step; the gradients are averaged."""
    arguments = [MODEL, str(dots.folder), "--log-every", "1", "--validate-every", "10"]
    arguments += ["--clip", "0.5", "--option", "dropout=0.2", "--out"]
    one = [*arguments, str(tmp_path / "one"), "--batch", "4", "--accumulate", "2"]
    two = [*arguments, str(tmp_path / "two"), "--batch", "8", "--devices", "2"]
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


def test_evaluate_finds_what_was_trained(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = ["--option", "encoder=test_vit", "image_size=64", "weights=random", "hidden=16"]
    chosen += ["--steps", "5", "--batch", "4", "--out", str(tmp_path), *CPU]
    assert main(["train", "frozen-encoder", str(dots.folder), *chosen]) == 0
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "training").rglob("*")}
    assert main(["evaluate", str(dots.folder), "frozen-encoder", *chosen]) == 0
    assert "predictions: " in capsys.readouterr().out
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "training").rglob("*")} == before


def test_a_plan_of_models_protocols_and_seeds(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One training of three fails: the others are made, and a second run makes what is missing."""
    fails = f"{plan_models.__file__}:FailsOnDrop"
    imagining = f"{plan_models.__file__}:Imagining"
    plan = ["--protocols", "all-but,only", "--seeds", "2", "--seed", "5"]
    plan += ["--option", f"{fails}:hidden=3", "--out", str(tmp_path), *CPU]
    arguments = ["train", f"{imagining},{fails}", str(dots.folder), *plan]
    assert main([*arguments, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "16 of 16 trainings to do" in shown and "measured steps" in shown
    assert "collide" in shown and not list(tmp_path.iterdir())
    assert main(arguments) == 1
    captured = capsys.readouterr()
    assert captured.out.count("trained for 6 steps") == 12
    assert captured.out.count("failed: ") == 4 and "no drop, please" in captured.out
    assert f"{fails}, no_collide, seed 6: failed" in captured.err and " left" in captured.err
    assert main([*arguments, "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert len(result["trained"]) == 12 and all(row["loaded"] for row in result["trained"])
    assert {row["seed"] for row in result["failed"]} == {5, 6}
    assert {row["protocol"] for row in result["failed"]} == {"all-but", "only"}
    assert main([*arguments, "--dry-run", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["plan"]
    assert sum(row["from"] == "done" for row in rows) == 12
    assert {row["from"] for row in rows} == {"done", "earlier trainings"}


def test_evaluate_takes_the_same_plan(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = f"{plan_models.__file__}:Imagining"
    plan = ["--protocols", "all,only", "--seeds", "2", "--out", str(tmp_path), *CPU]
    trainings = ["train", model, str(dots.folder), *plan]
    assert main(trainings) == 0
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "training").rglob("*")}
    capsys.readouterr()
    arguments = ["evaluate", str(dots.folder), model, *plan, "--readout.grid", "0.1", "1"]
    assert main([*arguments, "--dry-run"]) == 0
    assert "6 of 6 evaluations to do" in capsys.readouterr().out
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert shown.count("predictions: ") == 4 and "observed+simulated" in shown
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "training").rglob("*")} == before
    (table,) = (tmp_path / "results").iterdir()
    rows = pd.read_csv(table)
    assert list(rows.columns) == [
        "model", "init", "protocol", "readout", "scenario", "seeds", "trials", "accuracy",
        "spread",
    ]  # fmt: skip
    assert len(rows) == 2 * 3 * 3 and (rows["seeds"] == 2).all() and rows["spread"].notna().all()
    again, loaded = run_apart(trainings, arguments)
    assert "6 of 6 trainings were done before" in again
    assert "6 of 6 evaluations were done before" in again
    assert not loaded, "what is done reads no trial and needs no library of models or movies"
    assert main([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["results"] == str(table) and len(result["evaluations"]) == 4


@pytest.mark.slow
def test_a_plan_that_is_killed_goes_on_and_a_second_run_trains_nothing(
    dots: Dataset, tmp_path: Path
) -> None:
    model = f"{plan_models.__file__}:Slow"
    plan = [str(dots.folder), "--protocols", "all,only", "--steps", "40", "--checkpoint-every", "5"]
    parts = [*plan, "--out", str(tmp_path / "parts")]
    running = subprocess.Popen(
        command(model, *parts), env=environment(), stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, preexec_fn=heed_interrupts,
    )  # fmt: skip
    end = time.monotonic() + 600
    while running.poll() is None and time.monotonic() < end:
        if list(tmp_path.rglob("model.safetensors")) and list(
            tmp_path.rglob("checkpoint.safetensors")
        ):
            break
        time.sleep(0.01)
    running.send_signal(signal.SIGINT)
    assert running.wait() == 130
    done = len(list(tmp_path.rglob("model.safetensors")))
    assert 1 <= done < 3
    for before in (done, 3):
        again = subprocess.run(
            command(model, *parts), env=environment(), check=False, capture_output=True, text=True
        )
        assert again.returncode == 0, again.stderr
        assert f"{before} of 3 trainings were done before" in again.stdout
    _, loaded = run_apart(["train", model, *parts, *CPU])
    assert not loaded, "a second run needs no library of models or movies"
    assert main(["train", model, *plan, "--out", str(tmp_path / "whole"), *CPU]) == 0
    one, other = (files_of(tmp_path / name / "training") for name in ("parts", "whole"))
    assert one == other
