"""Functions of tasks for tests of executors, importable by any worker process."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from physion.core.errors import BadInputError


def square(number: int) -> int:
    print(f"squaring {number}")
    return number * number


def fail_on_three(number: int) -> int:
    if number == 3:
        raise BadInputError("three is\nnot liked")
    return number


def die_on_two(number: int) -> int:
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die_once(marker: str) -> str:
    path = Path(marker)
    if not path.exists():
        path.write_text("was here")
        os.kill(os.getpid(), signal.SIGKILL)
    return "second try"


def process_of(number: int) -> int:
    return os.getpid()
