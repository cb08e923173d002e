"""One task in a worker: its result or its exception as an outcome, and its log."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from physion.compute.executor import TaskOutcome
from physion.errors import PhysionError

T = TypeVar("T")
R = TypeVar("R")

_NAME_BYTES = 80
"""Longest readable part of the name of a log."""


def run_task(
    key: str, function: Callable[[T], R], task: T, logs: Path | None = None
) -> TaskOutcome[R]:
    """Run the function; return its result, or its exception as a failed outcome.

    With ``logs``, what the task and its libraries print is appended to a file of its own in this
    folder, with the traceback of a failure.
    """
    if logs is None:
        return _run(key, function, task)
    with _printing_into(log_path(logs, key)):
        outcome = _run(key, function, task)
        print(outcome.traceback.rstrip() or f"{key}: done", flush=True)
    return outcome


def log_path(logs: Path, key: str) -> Path:
    """Return the path of the log of a task; different keys have different names."""
    readable = re.sub(r"[^A-Za-z0-9._-]+", "-", key)[:_NAME_BYTES].strip("-.") or "task"
    if readable != key:
        readable += "-" + hashlib.sha256(key.encode()).hexdigest()[:8]
    return logs / f"{readable}.log"


def _run(key: str, function: Callable[[T], R], task: T) -> TaskOutcome[R]:
    try:
        return TaskOutcome(key, function(task))
    except Exception as error:
        number = error.errno if isinstance(error, OSError) else None
        text = " ".join(str(error).split()) or "no message"
        line = text if isinstance(error, PhysionError) else f"{type(error).__name__}: {text}"
        return TaskOutcome(key, error=line, traceback=traceback.format_exc(), errno=number)


@contextlib.contextmanager
def _printing_into(path: Path) -> Iterator[None]:
    """Lead standard output and error of the process, compiled code included, into a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    with path.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    try:
        # Other objects may stand in the place of the streams, such as those of a test.
        with (
            os.fdopen(os.dup(1), "w", encoding="utf-8") as out,
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(out),
        ):
            yield
    finally:
        for number, descriptor in zip((1, 2), kept, strict=True):
            os.dup2(descriptor, number)
            os.close(descriptor)
