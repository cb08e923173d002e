"""Set a new password of the experimenter's pages, typed at the terminal or read from a file.

A running server uses it at once; all logins with the old one end. It is that of the account
``experimenter``; `physion experiment accounts` changes those of others.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


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
    from physion.cli.experiment.typed_password import read_password
    from physion.experiment.study.identity import Secrets, set_password

    Secrets.load(options.study)  # report errors of the folder before asking
    set_password(options.study, read_password(options.password_file))
    if options.json:
        print(json_module.dumps({"password": "set"}))
    else:
        print("the new password is set; logins with the old one have ended")
    return 0
