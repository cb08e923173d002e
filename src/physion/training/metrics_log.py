"""Metrics of a training: ``metrics.jsonl``, to which lines are appended, and TensorBoard events."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from physion.atomic import write_atomic

METRICS, EVENTS = "metrics.jsonl", "events"


class MetricsLog:
    """Log of the metrics of a training, one JSON object a line, in the order of steps.

    It is opened at a step: later lines, of a training that was stopped after its checkpoint, are
    removed, so that a resumed training neither repeats nor loses a line. If the extra
    ``tensorboard`` is installed, event files in the folder ``events`` hold the same numbers.

    Parameters
    ----------
    folder
        Folder of the training, which exists.
    step
        Number of steps of the checkpoint from which training goes on; 0 for a new training.
    """

    def __init__(self, folder: Path, step: int) -> None:
        path = folder / METRICS
        kept = _lines_until(path, step)
        text = "".join(line + "\n" for line in kept)
        if not path.is_file() or path.read_bytes() != text.encode():
            write_atomic(path, text.encode())
        # Kept open, and appended to: nothing that was written is written again.
        self._file = path.open("a", encoding="utf-8")
        self._events = _open_events(folder / EVENTS)
        for line in kept:
            self._add_events(json.loads(line))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Append the values after ``step`` steps; one that is not finite becomes null."""
        line: dict[str, Any] = {"step": step}
        line |= {name: value if math.isfinite(value) else None for name, value in values.items()}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()
        self._add_events(line)

    def sync(self) -> None:
        """Wait until all lines are on the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())
        if self._events is not None:
            self._events.flush()

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()
        if self._events is not None:
            self._events.close()

    def _add_events(self, line: Mapping[str, Any]) -> None:
        if self._events is not None:
            for name, value in line.items():
                if name != "step" and value is not None:
                    self._events.add_scalar(name, value, int(line["step"]))


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Return the lines of ``metrics.jsonl`` in the folder of a training."""
    return [json.loads(line) for line in (folder / METRICS).read_text().splitlines()]


def _lines_until(path: Path, step: int) -> list[str]:
    """Return the whole lines of a file up to ``step``; a cut or damaged line ends them."""
    kept: list[str] = []
    if not path.is_file():
        return kept
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            inside = int(json.loads(line)["step"]) <= step
        except (ValueError, KeyError, TypeError):
            break
        if not inside:
            break
        kept.append(line)
    return kept


def _open_events(folder: Path) -> Any:
    """Return a writer of new event files; None without the extra ``tensorboard``."""
    try:
        from tensorboardX import SummaryWriter
    except ModuleNotFoundError:
        return None
    # Written again from the metrics, since events of lines that were removed would stay.
    shutil.rmtree(folder, ignore_errors=True)
    return SummaryWriter(str(folder))
