"""Metrics: lines are appended, cut at the step of a checkpoint, and readable by TensorBoard."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import pytest

from physion.training.loop import EVENTS, METRICS, MetricsLog, read_metrics


def write(folder: Path, start: int, steps: list[int]) -> None:
    with MetricsLog(folder, start) as log:
        for step in steps:
            log.write(step, {"train/loss": step / 10, "learning_rate": 1e-3})


def events(folder: Path) -> list[tuple[int, str, float]]:
    """Return step, name and value of all scalars, read as TensorBoard reads them."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    from tensorboardX.record_writer import masked_crc32c

    found = []
    for path in sorted((folder / EVENTS).iterdir()):
        content, position = path.read_bytes(), 0
        while position < len(content):
            (length,) = struct.unpack_from("<Q", content, position)
            header, data = content[position : position + 8], content[position + 12 :][:length]
            assert struct.unpack_from("<I", content, position + 8)[0] == masked_crc32c(header)
            assert struct.unpack_from("<I", content, position + 12 + length)[0] == masked_crc32c(
                data
            )
            event = event_pb2.Event.FromString(data)
            found += [(event.step, v.tag, v.simple_value) for v in event.summary.value]
            position += 16 + length
    return found


def test_lines_are_appended_and_not_written_again(tmp_path: Path) -> None:
    write(tmp_path, 0, [10, 20])
    inode = (tmp_path / METRICS).stat().st_ino
    write(tmp_path, 20, [30])
    assert (tmp_path / METRICS).stat().st_ino == inode
    assert [line["step"] for line in read_metrics(tmp_path)] == [10, 20, 30]
    assert read_metrics(tmp_path)[0] == {"step": 10, "train/loss": 1.0, "learning_rate": 1e-3}


@pytest.mark.parametrize("rest", ["", '{"step": 40, "train/lo', "\0\0\0", '{"step": "x"}\n'])
def test_lines_after_the_checkpoint_are_cut(tmp_path: Path, rest: str) -> None:
    write(tmp_path, 0, [10, 20, 25, 30])
    with (tmp_path / METRICS).open("a") as file:
        file.write(rest)
    write(tmp_path, 20, [25, 30, 40])
    assert [line["step"] for line in read_metrics(tmp_path)] == [10, 20, 25, 30, 40]


def test_a_new_training_starts_with_an_empty_file(tmp_path: Path) -> None:
    write(tmp_path, 0, [10])
    write(tmp_path, 0, [5])
    assert [line["step"] for line in read_metrics(tmp_path)] == [5]


def test_values_that_are_not_finite_are_null(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, 0) as log:
        log.write(1, {"train/part": float("nan"), "train/loss": 0.5})
    assert read_metrics(tmp_path) == [{"step": 1, "train/part": None, "train/loss": 0.5}]


def test_tensorboard_reads_the_same_numbers_once_each(tmp_path: Path) -> None:
    write(tmp_path, 0, [10, 20, 25])
    write(tmp_path, 20, [30])
    found = events(tmp_path)
    expected = [
        (line["step"], name, pytest.approx(value))
        for line in read_metrics(tmp_path)
        for name, value in line.items()
        if name != "step"
    ]
    assert found == expected and len(found) == 6


def test_without_the_extra_there_are_no_event_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    write(tmp_path, 0, [10])
    assert [path.name for path in tmp_path.iterdir()] == [METRICS]
