"""List, add, change and remove the accounts of experimenters; a running server follows at once.

Roles: owner (everything), recruiter (progress, pause, payments), analyst (progress, sessions and
answers, export), viewer (progress, sessions and answers). Passwords are typed at the terminal or
read from a file.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment accounts``; without any the accounts are listed."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    add: str | None = None
    """Name of a new account, with --role."""
    change: str | None = None
    """Name of an account that gets another --role or a --new-password."""
    remove: str | None = None
    """Name of an account to remove; its logins end."""
    role: Literal["owner", "recruiter", "analyst", "viewer"] | None = None
    """Role of the account."""
    new_password: bool = False
    """Ask for a new password of the account of --change."""
    password_file: Path | None = None
    """File with the password in its first line. Default: ask at the terminal."""
    json: bool = False
    """Print one JSON list of the accounts."""


def main(options: Options) -> int:
    """Change the accounts as asked; list them."""
    from physion.cli.experiment.experiment import require_extra
    from physion.core.errors import BadInputError

    require_extra()
    from physion.experiment.experimenter.access.accounts import remove_account
    from physion.experiment.study.identity import Secrets

    if [options.add, options.change, options.remove].count(None) < 2:
        raise BadInputError("give one of --add, --change and --remove")
    Secrets.load(options.study)  # report errors of the folder before asking
    if options.add is not None:
        _add(options, options.add)
    elif options.change is not None:
        _change(options, options.change)
    elif options.role or options.new_password or options.password_file:
        raise BadInputError("--role, --new-password and --password-file need --add or --change")
    elif options.remove is not None:
        remove_account(options.study, options.remove)
    accounts = [(one.name, one.role) for one in Secrets.load(options.study).accounts]
    if options.json:
        print(json_module.dumps([{"name": name, "role": role} for name, role in accounts]))
        return 0
    for name, role in accounts:
        print(f"{name:40} {role}")
    return 0


def _add(options: Options, name: str) -> None:
    from physion.cli.experiment.typed_password import read_password
    from physion.core.errors import BadInputError
    from physion.experiment.experimenter.access.accounts import add_account

    if options.role is None:
        raise BadInputError("--add needs the role of the new account: --role viewer, for example")
    add_account(options.study, name, options.role, read_password(options.password_file))


def _change(options: Options, name: str) -> None:
    from physion.cli.experiment.typed_password import read_password
    from physion.core.errors import BadInputError
    from physion.experiment.experimenter.access.accounts import change_account

    asked = options.new_password or options.password_file is not None
    if not asked and options.role is None:
        raise BadInputError("--change needs --role, --new-password or --password-file")
    password = read_password(options.password_file) if asked else None
    change_account(options.study, name, options.role, password)
