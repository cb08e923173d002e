"""Reading files of a study folder: plain ones of bounded size, and no link to anywhere else."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from physion.errors import BadInputError


def read_plain(path: Path, limit: int) -> bytes:
    """The bytes of a plain file of at most ``limit`` bytes.

    A missing file, a link, a folder, a pipe and a larger file raise `BadInputError`.
    """
    try:
        # A pipe must not make us wait, and nothing may change between looking and opening.
        flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        descriptor = os.open(path, flags | getattr(os, "O_BINARY", 0))
    except FileNotFoundError:
        raise BadInputError(f"{path} is missing") from None
    except OSError as error:
        raise BadInputError(_why_not(path, error)) from error
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise BadInputError(f"{path} is no plain file")
        if found.st_size > limit:
            raise BadInputError(f"{path} has {found.st_size} bytes, more than {limit}")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            content = file.read(limit + 1)
    finally:
        os.close(descriptor)
    if len(content) > limit:
        raise BadInputError(f"{path} has more than {limit} bytes")
    return content


def check_plain(path: Path) -> None:
    """`BadInputError` unless there is a plain file, itself and not through a link."""
    try:
        found = path.lstat()
    except OSError as error:
        raise BadInputError(_why_not(path, error)) from error
    if not stat.S_ISREG(found.st_mode):
        raise BadInputError(f"{path} is no plain file; links are not followed")


def _why_not(path: Path, error: OSError) -> str:
    if path.is_symlink():
        return f"{path} is a link; links are not followed, put the file itself there"
    if isinstance(error, FileNotFoundError):
        return f"{path} is missing"
    return f"{path} cannot be read: {error.strerror}"
