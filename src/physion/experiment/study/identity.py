"""Secret keys of a study, and what is derived from them: id hashes, tokens, signatures.

All secrets are in ``secret.json`` of the study folder, which only its owner may read. Without this
file the server can neither recognise returning participants nor verify signed links.
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

from physion.core.errors import BadInputError
from physion.core.files import digest_of, read_plain, write_atomic
from physion.core.settings import parse_json, read_settings

SECRET_FILE = "secret.json"
VERSION = 1
KEY_BYTES = 32
MIN_PASSWORD = 8
MAX_PASSWORD = 1000
MAX_BYTES = 50_000
REFERENCE_LETTERS = "23456789ABCDEFGHJKLMNPQRSTUVWXYZ"
"""32 letters and digits without look-alikes (no 0, O, 1, I)."""


@dataclass(frozen=True)
class Secrets:
    """Secret keys of a study, and the password of the experimenter's pages.

    Attributes
    ----------
    hash_key
        HMAC key for hashes of participant ids.
    link_key
        HMAC key for signatures of links, media URLs and forms.
    password_hash
        argon2id hash of the password. Empty if none was set: then nobody can log in.
    """

    hash_key: bytes = field(repr=False)
    link_key: bytes = field(repr=False)
    password_hash: str = field(default="", repr=False)

    @classmethod
    def create(cls, folder: Path, password: str | None = None) -> Secrets:
        """Create random keys and write them to ``folder``, which must not have any yet."""
        path = folder / SECRET_FILE
        if os.path.lexists(path):
            raise BadInputError(
                f"{path} is there already; replacing it would make all participants unrecognisable"
            )
        secrets = cls(os.urandom(KEY_BYTES), os.urandom(KEY_BYTES))
        if password is not None:
            secrets = replace(secrets, password_hash=hash_password(password))
        write_secrets(folder, secrets)
        return secrets

    @classmethod
    def load(cls, folder: Path) -> Secrets:
        """Read the keys of a study folder; `BadInputError` if other users may read the file."""
        path = folder / SECRET_FILE
        if not os.path.lexists(path):
            raise BadInputError(
                f"there is no {path}; create a study with physion experiment init, or restore "
                "the file from a backup"
            )
        content = read_plain(path, MAX_BYTES)
        if os.name == "posix" and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise BadInputError(f"other users may read {path}; run: chmod 600 {path}")
        return _parse(path, content)


def write_secrets(folder: Path, secrets: Secrets) -> None:
    """Write the secrets file of a study folder, readable by its owner only."""
    content = {
        "version": VERSION,
        "hash_key": secrets.hash_key.hex(),
        "link_key": secrets.link_key.hex(),
        "password_hash": secrets.password_hash,
    }
    encoded = (json.dumps(content, indent=1) + "\n").encode()
    write_atomic(folder / SECRET_FILE, encoded, mode=0o600)


@dataclass(frozen=True)
class _SecretFile:
    """The content of the secrets file; keys in hexadecimal digits."""

    version: int
    hash_key: str
    link_key: str
    password_hash: str


def _parse(path: Path, content: bytes) -> Secrets:
    """Parse and check the content of the secrets file."""
    try:
        values = read_settings(_SecretFile, parse_json(content.decode(), str(path)), str(path))
        keys = [bytes.fromhex(key) for key in (values.hash_key, values.link_key)]
    except (ValueError, BadInputError) as error:
        raise BadInputError(f"{path} is damaged; restore it from a backup") from error
    if values.version != VERSION:
        raise BadInputError(f"{path} has version {values.version!r}, not {VERSION}")
    if any(len(key) != KEY_BYTES for key in keys):
        raise BadInputError(f"{path} is damaged; restore it from a backup")
    return Secrets(keys[0], keys[1], values.password_hash)


def participant_hash(secrets: Secrets, source: str, raw_id: str) -> str:
    """Return the keyed hash (32 hexadecimal digits) of a recruiter's id.

    Without the key, the hash cannot be checked against guessed ids.
    """
    return _mac(secrets.hash_key, source, raw_id)[:32]


def new_token() -> str:
    """Return a random access token for one session (256 bits, safe in an HTTP header)."""
    return token_urlsafe(32)


def hash_token(token: str) -> str:
    """Return the SHA-256 of a token, the form in which it is stored.

    Tokens are random, so no key is needed to keep them from being guessed.
    """
    return digest_of(token.encode("utf-8", "replace"))


def new_session() -> str:
    """Return a random identifier for a new session (32 hexadecimal digits)."""
    return token_hex(16)


def new_reference() -> str:
    """Return a random session reference such as ``K7QF-29XM``, short enough to be read out."""
    letters = [REFERENCE_LETTERS[byte % 32] for byte in os.urandom(8)]
    return "".join(letters[:4]) + "-" + "".join(letters[4:])


def sign(secrets: Secrets, *parts: str) -> str:
    """Return a signature (32 hexadecimal digits) of the texts ``parts`` in this order."""
    return _mac(secrets.link_key, *parts)[:32]


def check_signature(secrets: Secrets, signature: str, *parts: str) -> bool:
    """Return whether `sign` made this signature of ``parts``, comparing in constant time."""
    return hmac.compare_digest(sign(secrets, *parts).encode(), signature.encode("utf-8", "replace"))


def set_password(folder: Path, password: str) -> Secrets:
    """Set a new password; keys are kept."""
    secrets = replace(Secrets.load(folder), password_hash=hash_password(password))
    write_secrets(folder, secrets)
    return secrets


def read_password(path: Path) -> str:
    """Return the password in the first line of a file, without surrounding spaces."""
    try:
        password = read_plain(path, 10_000).decode().splitlines()[0].strip()
    except (UnicodeDecodeError, IndexError) as error:
        raise BadInputError(f"{path} has no password in its first line") from error
    if not MIN_PASSWORD <= len(password) <= MAX_PASSWORD:
        raise BadInputError(f"the password in {path} must have {MIN_PASSWORD} characters or more")
    return password


def check_password(secrets: Secrets, password: str) -> bool:
    """Return whether this is the password (deliberately slow, about 50 ms)."""
    from argon2 import PasswordHasher
    from argon2.exceptions import InvalidHashError, VerificationError

    if len(password) > MAX_PASSWORD:
        return False
    try:
        return PasswordHasher().verify(secrets.password_hash, password)
    except (VerificationError, InvalidHashError, UnicodeEncodeError):
        return False


def hash_password(password: str) -> str:
    """Return the argon2id hash of a new password."""
    from argon2 import PasswordHasher

    if not MIN_PASSWORD <= len(password) <= MAX_PASSWORD:
        raise BadInputError(f"a password has {MIN_PASSWORD} to {MAX_PASSWORD} characters")
    return PasswordHasher().hash(password)


def _mac(key: bytes, *parts: str) -> str:
    """Return the HMAC-SHA256 of a list of texts, in hexadecimal digits."""
    # Each text is preceded by its length, so that ("ab", "c") and ("a", "bc") differ.
    encoded = [part.encode("utf-8", "surrogatepass") for part in parts]
    message = b"".join(len(part).to_bytes(4, "big") + part for part in encoded)
    return hmac.new(key, message, hashlib.sha256).hexdigest()
