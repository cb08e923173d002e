"""Set a new password of the experimenter's pages, typed at the terminal or read from a file.

A running server uses it at once; all logins with the old one end.
"""

from __future__ import annotations

import json as json_module
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

MAX_BYTES = 10_000


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment password``."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    password_file: Path | None = None
    """File with the password in its first line. Default: ask at the terminal. (There is no option
    for the password itself, since other users of the machine can see command lines.)"""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Set the password."""
    from physion.cli.experiment.experiment import require_extra

    require_extra()
    from physion.experiment.study.identity import Secrets, set_password

    Secrets.load(options.study)  # report errors of the folder before asking
    set_password(options.study, read_password(options.password_file))
    if options.json:
        print(json_module.dumps({"password": "set"}))
    else:
        print("the new password is set; logins with the old one have ended")
    return 0


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
