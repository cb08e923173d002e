"""Failures of single tasks of a plan, and those that every later task would meet too."""

from __future__ import annotations

import errno
import traceback
from pathlib import Path

from physion.core.errors import MEMORY_SETTINGS, PhysionError
from physion.models.build import is_out_of_memory

_NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}


def describe_failure(error: Exception) -> str:
    """Return one line about an error, with the line of code if it is no `PhysionError`.

    If memory is used up it names the settings to lower.
    """
    text = " ".join(str(error).split())
    if isinstance(error, PhysionError):
        return text
    if is_out_of_memory(error):
        text += f"; {MEMORY_SETTINGS}"
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
