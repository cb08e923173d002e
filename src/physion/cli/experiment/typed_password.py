"""A password that is typed at the terminal or read from a file, never given on the command line."""

from __future__ import annotations

import sys
from pathlib import Path

MAX_BYTES = 10_000


def read_password(path: Path | None) -> str:
    """Return the first line of a file, or a password typed twice at the terminal."""
    from getpass import getpass

    from physion.core.errors import BadInputError

    if path is not None:
        return password_in(path)
    if not sys.stdin.isatty():
        raise BadInputError("there is no terminal to type the password: give --password-file FILE")
    password = getpass("new password: ")
    if password != getpass("repeat: "):
        raise BadInputError("the two passwords differ; nothing was changed")
    return password


def password_in(path: Path) -> str:
    """Return the first line of a file without surrounding spaces."""
    from physion.core.errors import BadInputError
    from physion.core.files import read_plain

    try:
        return read_plain(path, MAX_BYTES).decode().splitlines()[0].strip()
    except (UnicodeDecodeError, IndexError) as error:
        raise BadInputError(f"{path} has no password in its first line") from error
