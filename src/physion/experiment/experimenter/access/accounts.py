"""Making, changing and removing accounts of experimenters in the secrets file of a study."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from physion.core.errors import BadInputError, UnknownNameError
from physion.experiment.study.identity import (
    FIRST_ACCOUNT,
    MAX_ACCOUNTS,
    ROLES,
    Account,
    Secrets,
    hash_password,
    is_account_name,
    write_secrets,
)


def add_account(folder: Path, name: str, role: str, password: str) -> None:
    """Add an account; raise `BadInputError` if there is one, or for a bad name or password."""
    secrets = Secrets.load(folder)
    _check_role(role)
    if not is_account_name(name):
        raise BadInputError(
            f"{name[:50]!r} is no name of an account: 1 to 40 letters, digits, . - _ and @"
        )
    if secrets.account(name) is not None:
        raise BadInputError(f"there is an account {name!r} already; change it with --change")
    if len(secrets.accounts) >= MAX_ACCOUNTS:
        raise BadInputError(f"a study has at most {MAX_ACCOUNTS} accounts; remove one first")
    hashed = hash_password(password)
    if name == FIRST_ACCOUNT:  # It was removed before, and is always an owner.
        if role != "owner":
            raise BadInputError(f"the account {FIRST_ACCOUNT!r} is always an owner")
        write_secrets(folder, replace(secrets, password_hash=hashed))
        return
    account = Account(name, role, hashed)
    write_secrets(folder, replace(secrets, others=(*secrets.others, account)))


def change_account(
    folder: Path, name: str, role: str | None = None, password: str | None = None
) -> None:
    """Change role or password of an account; its logins end with a new password.

    Raises `UnknownNameError` for an unknown name or role, and `BadInputError` if no owner would be
    left.
    """
    secrets = Secrets.load(folder)
    account = _known(secrets, name)
    if role is not None:
        _check_role(role)
    changed = replace(
        account,
        role=role or account.role,
        password_hash=account.password_hash if password is None else hash_password(password),
    )
    if name == FIRST_ACCOUNT:
        if changed.role != "owner":
            raise BadInputError(f"the account {FIRST_ACCOUNT!r} is always an owner; remove it")
        result = replace(secrets, password_hash=changed.password_hash)
    else:
        others = (changed if one.name == name else one for one in secrets.others)
        result = replace(secrets, others=tuple(others))
    _write_with_owner(folder, result)


def remove_account(folder: Path, name: str) -> None:
    """Remove an account; its logins end.

    Raises `UnknownNameError` for an unknown name, and `BadInputError` if no owner would be left.
    """
    secrets = Secrets.load(folder)
    _known(secrets, name)
    if name == FIRST_ACCOUNT:
        result = replace(secrets, password_hash="")
    else:
        result = replace(secrets, others=tuple(o for o in secrets.others if o.name != name))
    _write_with_owner(folder, result)


def _known(secrets: Secrets, name: str) -> Account:
    account = secrets.account(name)
    if account is None:
        raise UnknownNameError("account", name, [one.name for one in secrets.accounts])
    return account


def _check_role(role: str) -> None:
    if role not in ROLES:
        raise UnknownNameError("role", role, ROLES)


def _write_with_owner(folder: Path, secrets: Secrets) -> None:
    if not any(account.role == "owner" for account in secrets.accounts):
        raise BadInputError("a study needs an owner: make another account one first")
    write_secrets(folder, secrets)
