"""Safe reading of files that somebody else may have put there: regular files of limited size."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from physion.errors import BadInputError

MAX_IDS_BYTES = 10_000_000


def read_plain(path: Path, limit: int, *, follow_links: bool = False) -> bytes:
    """Read a regular file of at most ``limit`` bytes.

    Raises `BadInputError` if the file is missing, is larger, or is a folder or a pipe, or a link
    unless ``follow_links`` is set.
    """
    no_links = 0 if follow_links else getattr(os, "O_NOFOLLOW", 0)
    try:
        # Non-blocking, so that a pipe does not hang; the type is checked on the open descriptor,
        # so that the file cannot be replaced between check and read.
        flags = os.O_RDONLY | no_links | getattr(os, "O_NONBLOCK", 0)
        descriptor = os.open(path, flags | getattr(os, "O_BINARY", 0))
    except FileNotFoundError:
        raise BadInputError(f"{path} is missing") from None
    except OSError as error:
        raise BadInputError(_describe_error(path, error, follow_links)) from error
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise BadInputError(f"{path} is not a regular file")
        if status.st_size > limit:
            raise BadInputError(f"{path} has {status.st_size} bytes, more than {limit}")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            # Memory for as many bytes as are asked for is allocated before they are read.
            content = file.read(status.st_size + 1)
    except OSError as error:
        raise BadInputError(_describe_error(path, error, follow_links)) from error
    finally:
        os.close(descriptor)
    if len(content) > status.st_size:
        raise BadInputError(f"{path} grew while it was read; try again when it is complete")
    return content


def check_plain(path: Path) -> None:
    """Raise `BadInputError` unless ``path`` is a regular file and not a link."""
    try:
        status = path.lstat()
    except OSError as error:
        raise BadInputError(_describe_error(path, error, False)) from error
    if not stat.S_ISREG(status.st_mode):
        raise BadInputError(f"{path} is not a regular file; links are not followed")


def _describe_error(path: Path, error: OSError, follow_links: bool) -> str:
    """Return the message for a file that cannot be opened."""
    if path.is_symlink() and not follow_links:
        return f"{path} is a link; links are not followed, replace it by the file itself"
    if isinstance(error, FileNotFoundError):
        return f"{path} is missing"
    return f"{path} cannot be read: {error.strerror}"


def read_ids(path: Path) -> frozenset[str]:
    """Read a text file with one id a line; `BadInputError` if it has none or cannot be read."""
    try:
        lines = read_plain(path, MAX_IDS_BYTES).decode().splitlines()
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path}: not a text file in UTF-8") from error
    ids = frozenset(filter(None, (line.strip() for line in lines)))
    if not ids:
        raise BadInputError(f"{path} has no id; write one a line")
    return ids
