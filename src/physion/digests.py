"""SHA-256 of files: how it is computed, stored in a digest file, and checked.

Formats of this package hold their SHA-256 inside: trial files (`trials.schema`), JSON
(`physion.sealed`), features and checkpoints. For formats that other programs define (CSV, parquet)
it stands in a digest file ``NAME.sha256``, a line that ``sha256sum --check`` reads too.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from physion.atomic import write_atomic
from physion.errors import BadInputError

SUFFIX = ".sha256"
"""Ending of a digest file, after the whole name of its file."""


def file_sha256(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file; `OSError` if it cannot be read."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_with_digest(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path``, and its digest file, each atomically.

    A process that is killed in between leaves a file without digest file, never one with that
    of another content.
    """
    digest = digest_path(path)
    digest.unlink(missing_ok=True)
    write_atomic(path, content)
    line = f"{hashlib.sha256(content).hexdigest()}  {path.name}\n"
    write_atomic(digest, line.encode())


def digest_path(path: Path) -> Path:
    """Return the path of the digest file of ``path``."""
    return path.with_name(path.name + SUFFIX)


def has_digest(path: Path) -> bool:
    """Return whether a file has a digest file, right or wrong."""
    return digest_path(path).is_file()


def is_whole(path: Path) -> bool:
    """Return whether a file exists with exactly the bytes that `write_with_digest` wrote."""
    try:
        return _stored(path) == file_sha256(path)
    except (OSError, UnicodeDecodeError):
        return False


def check_digest(path: Path, content: bytes, advice: str) -> None:
    """Raise `BadInputError` if ``path`` has a digest file that is not of ``content``.

    A file without digest file is accepted: it was written by an earlier version or another program.
    ``advice`` says what to do.
    """
    if not has_digest(path):
        return
    try:
        stored = _stored(path)
    except (OSError, UnicodeDecodeError):
        stored = ""
    if stored != hashlib.sha256(content).hexdigest():
        raise BadInputError(
            f"{path} was changed since it was written: its SHA-256 is not the one in "
            f"{digest_path(path).name}; {advice}"
        )


def _stored(path: Path) -> str:
    return digest_path(path).read_text(encoding="utf-8").partition(" ")[0]
