"""Failures of single tasks of a plan, and those that every later task would meet too."""

from __future__ import annotations

import errno
import traceback
from pathlib import Path
from typing import TypeVar

from physion.compute.executor import TaskOutcome
from physion.compute.run_tasks import FATAL_ERRNOS
from physion.errors import PhysionError

R = TypeVar("R")

_NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}


def describe_failure(error: Exception) -> str:
    """Return one line about an error, with the line of code if it is no `PhysionError`."""
    text = " ".join(str(error).split())
    if isinstance(error, PhysionError):
        return text
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {text} ({Path(last.filename).name}, line {last.lineno})"


def stop_if_fatal(error: BaseException, folder: Path, done: int, total: int) -> None:
    """Raise `PhysionError` for an error after which nothing more can be written, as a full disk."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in _NO_SPACE:
            raise PhysionError(
                f"cannot write into {folder}: {cause.strerror}; {done} of {total} are done, and "
                "the same command continues from there"
            ) from error
        cause = cause.__cause__


def read_outcome(outcome: TaskOutcome[R], folder: Path, done: int, total: int) -> R | None:
    """Return the result of a task that an executor ran, or None if it failed.

    Raises
    ------
    PhysionError
        If nothing more can be written, or the plan has no other task.
    """
    if outcome.error is None:
        return outcome.value
    if outcome.errno in FATAL_ERRNOS:
        raise PhysionError(
            f"cannot write into {folder}: {outcome.error}; {done} of {total} are done, and the "
            "same command continues from there"
        )
    if total == 1:
        raise PhysionError(outcome.error)
    return None
