"""Give the experimenter's pages a new password, asked for at the terminal or read from a file.

A server that runs takes it at once: whoever is logged in has to give the new one.
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
    """Of which study."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    password_file: Path | None = None
    """Its first line is the password; asked for if not given. (Other people on a machine can see
    the words of a command, so that the password is none of them.)"""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Set the password."""
    from physion.cli.experiment.experiment import require_extra

    require_extra()
    from physion.experiment.study.identity import Secrets, set_password

    Secrets.load(options.study)  # what is wrong with the folder comes before the question
    set_password(options.study, read_password(options.password_file))
    if options.json:
        print(json_module.dumps({"password": "set"}))
    else:
        print("the new password holds from now on; whoever was logged in has to give it")
    return 0


def read_password(path: Path | None) -> str:
    """The first line of a file, or what is typed twice at the terminal."""
    from getpass import getpass

    from physion.errors import BadInputError

    if path is not None:
        return password_in(path)
    if not sys.stdin.isatty():
        raise BadInputError("there is no terminal to ask at: give --password-file FILE")
    password = getpass("new password: ")
    if password != getpass("once more: "):
        raise BadInputError("the two passwords differ; nothing was changed")
    return password


def password_in(path: Path) -> str:
    """The first line of a file, without blanks around it."""
    from physion.errors import BadInputError
    from physion.experiment.study.plain_files import read_plain

    try:
        return read_plain(path, MAX_BYTES).decode().splitlines()[0].strip()
    except (UnicodeDecodeError, IndexError) as error:
        raise BadInputError(f"{path} has no password in its first line") from error
