"""Who is who: keys of a study, keyed hashes of ids, tokens, signatures, the password.

Everything that must stay secret is in ``secret.json`` of the study folder, readable by its owner
alone. Whoever loses the file can neither recognise a returning participant nor check a link.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import stat
from dataclasses import dataclass, field, replace
from pathlib import Path
from secrets import token_hex, token_urlsafe
from typing import Any

from physion.atomic import write_atomic
from physion.errors import BadInputError
from physion.experiment.study.plain_files import read_plain

SECRET_FILE = "secret.json"
VERSION = 1
KEY_BYTES = 32
MIN_PASSWORD = 8
MAX_PASSWORD = 1000
MAX_BYTES = 10_000
REFERENCE_LETTERS = "23456789ABCDEFGHJKLMNPQRSTUVWXYZ"
"""32 signs that nobody mistakes for one another."""


@dataclass(frozen=True)
class Secrets:
    """Keys of a study. ``hash_key`` hides ids, ``link_key`` signs links, media and forms.

    ``password_hash`` is argon2id; empty where no password was set, and then nobody logs in.
    """

    hash_key: bytes = field(repr=False)
    link_key: bytes = field(repr=False)
    password_hash: str = field(default="", repr=False)

    @classmethod
    def create(cls, folder: Path, password: str | None = None) -> Secrets:
        """New keys, written to ``folder``; refused where there are some already."""
        path = folder / SECRET_FILE
        if os.path.lexists(path):
            raise BadInputError(
                f"{path} is there already; without it no participant would be recognised again"
            )
        secrets = cls(os.urandom(KEY_BYTES), os.urandom(KEY_BYTES))
        if password is not None:
            secrets = replace(secrets, password_hash=_hash_password(password))
        _write(path, secrets)
        return secrets

    @classmethod
    def load(cls, folder: Path) -> Secrets:
        """The keys of a study folder. `BadInputError` where others may read the file."""
        path = folder / SECRET_FILE
        if not os.path.lexists(path):
            raise BadInputError(
                f"there is no {path}; physion experiment init makes one, or bring yours back"
            )
        content = read_plain(path, MAX_BYTES)
        if os.name == "posix" and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise BadInputError(f"others may read {path}; chmod 600 {path}")
        return _parse(path, content)


def _write(path: Path, secrets: Secrets) -> None:
    content = {
        "version": VERSION,
        "hash_key": secrets.hash_key.hex(),
        "link_key": secrets.link_key.hex(),
        "password_hash": secrets.password_hash,
    }
    write_atomic(path, (json.dumps(content, indent=1) + "\n").encode(), mode=0o600)


def _parse(path: Path, content: bytes) -> Secrets:
    try:
        values: Any = json.loads(content)
        if values["version"] != VERSION:
            raise BadInputError(f"{path} has version {values['version']!r}, not {VERSION}")
        keys = [bytes.fromhex(values[name]) for name in ("hash_key", "link_key")]
        password_hash = values["password_hash"]
        good = all(len(key) == KEY_BYTES for key in keys) and isinstance(password_hash, str)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise BadInputError(f"{path} is damaged; bring back a copy of it") from error
    if not good:
        raise BadInputError(f"{path} is damaged; bring back a copy of it")
    return Secrets(keys[0], keys[1], password_hash)


def participant_hash(secrets: Secrets, source: str, raw_id: str) -> str:
    """32 hexadecimal digits for an id; without the key nobody can try out ids."""
    return _mac(secrets.hash_key, source, raw_id)[:32]


def new_token() -> str:
    """What opens one session: 256 random bits, fit for a header."""
    return token_urlsafe(32)


def hash_token(token: str) -> str:
    """What is stored of a token. It is random itself, so that a plain hash hides it."""
    return hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()


def new_session() -> str:
    """The name of a new session."""
    return token_hex(16)


def new_reference() -> str:
    """A short code that a participant can read out, as ``K7QF-29XM``; random, tells nothing."""
    letters = [REFERENCE_LETTERS[byte % 32] for byte in os.urandom(8)]
    return "".join(letters[:4]) + "-" + "".join(letters[4:])


def sign(secrets: Secrets, *words: str) -> str:
    """A signature of 32 hexadecimal digits of these words in this order."""
    return _mac(secrets.link_key, *words)[:32]


def check_signature(secrets: Secrets, signature: str, *words: str) -> bool:
    """Did `sign` make this signature of these words? Takes as long for a wrong one."""
    return hmac.compare_digest(sign(secrets, *words).encode(), signature.encode("utf-8", "replace"))


def set_password(folder: Path, password: str) -> Secrets:
    """Give the experimenter a new password; keys stay."""
    secrets = replace(Secrets.load(folder), password_hash=_hash_password(password))
    _write(folder / SECRET_FILE, secrets)
    return secrets


def check_password(secrets: Secrets, password: str) -> bool:
    """Is this the experimenter's password? Takes some 50 ms on purpose."""
    from argon2 import PasswordHasher
    from argon2.exceptions import InvalidHashError, VerificationError

    if not secrets.password_hash or len(password) > MAX_PASSWORD:
        return False
    try:
        return PasswordHasher().verify(secrets.password_hash, password)
    except (VerificationError, InvalidHashError, UnicodeEncodeError):
        return False


def _hash_password(password: str) -> str:
    from argon2 import PasswordHasher

    if not MIN_PASSWORD <= len(password) <= MAX_PASSWORD:
        raise BadInputError(f"a password has {MIN_PASSWORD} to {MAX_PASSWORD} characters")
    return PasswordHasher().hash(password)


def _mac(key: bytes, *words: str) -> str:
    # Lengths in front, so that ("ab", "c") and ("a", "bc") differ.
    encoded = [word.encode("utf-8", "surrogatepass") for word in words]
    message = b"".join(len(word).to_bytes(4, "big") + word for word in encoded)
    return hmac.new(key, message, hashlib.sha256).hexdigest()
