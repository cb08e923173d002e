"""Checkpoints: any changed bit is noticed, what differs is named, nothing in a file is executed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from physion.core.errors import BadInputError
from physion.models.checkpoint import (
    WEIGHTS,
    DamagedFileError,
    check_same,
    load_weights,
    read_checkpoint,
    write_checkpoint,
)
from physion.models.interface import TrainingSettings
from physion.training import loop as folder_module
from physion.training.devices import Devices, make_fabric
from physion.training.loop import CHECKPOINT
from physion.training.train import TrainedModel, train_model
from support.trained_models import QUICK, MovingValues, NextBrightness, equal_weights

CPU = make_fabric(Devices("cpu"))


class Killed(Exception):
    """End of a training in the middle."""


def run(
    folder: Path, stop: int = 0, settings: TrainingSettings = QUICK
) -> tuple[TrainedModel, NextBrightness]:
    def progress(what: str, done: int, total: int) -> None:
        if done == stop:
            raise Killed

    model, source = NextBrightness(), MovingValues()
    trained = train_model(
        model, source, source.trials, seed=0, name="all", folder=folder, settings=settings,
        fabric=CPU, progress=progress,
    )  # fmt: skip
    return trained, model


def interrupted(folder: Path, step: int = 25) -> Path:
    """Train until a step; return the folder with the checkpoint of step 20."""
    with pytest.raises(Killed):
        run(folder, step)
    return next(folder.iterdir())


def change_bit(path: Path, position: float = 0.98, bit: int = 3) -> None:
    content = bytearray(path.read_bytes())
    content[int(position * len(content))] ^= 1 << bit
    path.write_bytes(bytes(content))


def test_tensors_and_metadata_come_back(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file.safetensors"
    tensors = {
        "a": torch.arange(6.0).view(2, 3).T, "b": torch.tensor(3, dtype=torch.int64),
        "c": torch.zeros(0, 4, dtype=torch.bfloat16), "d": torch.tensor([True, False]),
    }  # fmt: skip
    tensors["tied"] = tensors["a"]
    write_checkpoint(path, tensors, {"text": 'ü"\\', "number": 0.1, "list": [1, None]})
    found, metadata = read_checkpoint(path)
    assert {k: metadata[k] for k in ("text", "number", "list")} == {
        "text": "ü\"\\", "number": 0.1, "list": [1, None],
    }  # fmt: skip
    assert found.keys() == tensors.keys()
    for name, value in tensors.items():
        assert found[name].dtype == value.dtype and torch.equal(found[name], value)


def test_any_changed_bit_of_a_file_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "file.safetensors"
    tensors = {"w": torch.rand(5), "n": torch.tensor(7)}
    write_checkpoint(path, tensors, {"step": 10, "name": "all"}, kept=True)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    for position in range(len(content)):
        damaged = bytearray(content)
        damaged[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(damaged))
        with pytest.raises(DamagedFileError):
            read_checkpoint(path)
    for length in (*range(0, len(content), 37), len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(DamagedFileError):
            read_checkpoint(path)


def test_a_training_with_a_damaged_checkpoint_starts_again(tmp_path: Path) -> None:
    _, expected = run(tmp_path / "whole")
    folder = interrupted(tmp_path / "parts")
    path = folder / CHECKPOINT
    path.write_bytes(path.read_bytes()[:-7])  # as if the disk was full
    trained, model = run(tmp_path / "parts")
    assert equal_weights(model, expected)
    assert "cannot be read" in trained.notes[0] and "from the beginning" in trained.notes[0]
    whole = next((tmp_path / "whole").iterdir())
    for name in (WEIGHTS, "metrics.jsonl"):
        assert (folder / name).read_bytes() == (whole / name).read_bytes()


def test_a_damaged_trained_model_is_trained_again(tmp_path: Path) -> None:
    first, expected = run(tmp_path)
    assert first.folder is not None
    content = (first.folder / WEIGHTS).read_bytes()
    change_bit(first.folder / WEIGHTS)
    second, model = run(tmp_path)
    assert not second.loaded and "the beginning" in second.notes[-1]
    assert equal_weights(model, expected) and (first.folder / WEIGHTS).read_bytes() == content
    assert run(tmp_path)[0].loaded


def test_a_checkpoint_of_other_versions_is_refused_and_says_which(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(tmp_path)
    newer = {**folder_module.versions(), "torch": "99.0"}
    monkeypatch.setattr(folder_module, "versions", lambda: newer)
    with pytest.raises(BadInputError, match=r"another version: torch was .* and is 99\.0"):
        run(tmp_path)


def test_weights_of_another_network_are_refused_and_say_which(tmp_path: Path) -> None:
    trained, model = run(tmp_path)
    assert trained.folder is not None
    path = trained.folder / WEIGHTS
    same = NextBrightness()
    load_weights(path, same)
    assert equal_weights(same, model)
    wider = NextBrightness(hidden=9)
    with pytest.raises(
        BadInputError,
        match=r"net\.0\.weight is float32 \(8, 3\), and float32 \(9, 3\) in the model; .*2 more|"
        r"net\.0\.weight is float32 \(8, 3\), and float32 \(9, 3\) in the model",
    ):
        load_weights(path, wider)
    with pytest.raises(BadInputError, match=r"weight is missing; bias is missing; .* is unknown; "):
        load_weights(path, nn.Linear(2, 2))


def test_differences_are_named_three_at_most() -> None:
    old: dict[str, Any] = {"a": 1, "b": {"c": 2, "d": 3}, "e": "x" * 64, "same": 1}
    new: dict[str, Any] = {"b": {"c": 5, "d": 4}, "e": "y" * 64, "same": 1}
    with pytest.raises(BadInputError) as caught:
        check_same(Path("file"), "config", old, new)
    expected = "a was 1 and is not there; b.c was 2 and is 5; b.d was 3 and is 4; and 1 more"
    assert expected in str(caught.value)
    check_same(Path("file"), "config", old, json.loads(json.dumps(old)))


class Evil:
    """Object that creates a file when it is read by pickle."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("kind", ["empty", "zeros", "text", "foreign", "pickle", "deep", "long"])
def test_a_broken_or_foreign_file_is_one_clear_line(kind: str, tmp_path: Path) -> None:
    path, target = tmp_path / "file.safetensors", tmp_path / "executed"
    header = b'{"__metadata__":{"physion":"' + b"[" * 100_000 + b'"}}'
    contents = {
        "empty": b"",
        "zeros": b"\0" * 64,
        "text": b"not a checkpoint" * 9,
        "deep": len(header).to_bytes(8, "little") + header,
        "long": (2**62).to_bytes(8, "little") + b"{}",
    }
    if kind == "foreign":
        save_file({"w": torch.zeros(2)}, path, {"format": "pt"})
    elif kind == "pickle":
        torch.save({"model": Evil(target)}, path)
    else:
        path.write_bytes(contents[kind])
    with pytest.raises(BadInputError) as caught:
        load_weights(path, NextBrightness())
    message = str(caught.value)
    assert "file.safetensors" in message and "\n" not in message and len(message) < 400
    assert ("not a checkpoint of physion" in message) == (kind == "foreign")
    assert not target.exists()


def test_a_file_of_a_later_format_is_refused(tmp_path: Path, monkeypatch: Any) -> None:
    from physion.models import checkpoint

    path = tmp_path / "file.safetensors"
    monkeypatch.setattr(checkpoint, "_VERSION", 2)
    write_checkpoint(path, {"w": torch.zeros(2)}, {"versions": {"physion": "9.0"}})
    monkeypatch.undo()
    with pytest.raises(BadInputError, match=r"has version 2, not 1; read it with physion 9\.0"):
        read_checkpoint(path)


def test_other_programs_can_read_the_weights(tmp_path: Path) -> None:
    trained, model = run(tmp_path)
    assert trained.folder is not None
    tensors: dict[str, Tensor] = load_file(trained.folder / WEIGHTS)
    assert set(tensors) == {f"model/{name}" for name in model.state_dict()}
    assert torch.equal(tensors["model/net.0.weight"], model.net[0].weight)
