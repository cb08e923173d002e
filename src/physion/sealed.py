"""JSON files that contain a SHA-256 of their content, so that any change is detected."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from physion.atomic import write_atomic
from physion.dataclass_json import parse_json
from physion.errors import BadInputError
from physion.plain_files import read_plain

MAX_BYTES = 1 << 28
"""Largest file that is read; the scenes chosen for 2000 trials take less than a thousandth."""
_SEAL = "sha256"


def write_sealed(path: Path, values: Mapping[str, Any]) -> None:
    """Write ``values`` and their SHA-256 atomically; equal values give equal bytes.

    ``values`` must not have a key ``sha256``.
    """
    write_atomic(path, _text(values).encode())


def read_sealed(path: Path) -> dict[str, Any]:
    """Read a file of `write_sealed`; `BadInputError` if it was changed since it was written."""
    content = read_plain(path, MAX_BYTES, follow_links=True)
    try:
        text = content.decode()
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path} cannot be read: {error}") from error
    values = parse_json(text, str(path))
    if not isinstance(values, dict) or _SEAL not in values:
        raise BadInputError(f"{path} is damaged: field 'sha256' is missing")
    del values[_SEAL]
    if _text(values) != text:
        raise BadInputError(f"{path} was changed: its content does not match its field 'sha256'")
    return values


def _text(values: Mapping[str, Any]) -> str:
    content = json.dumps(values, sort_keys=True, separators=(",", ":"))
    seal = hashlib.sha256(content.encode()).hexdigest()
    return json.dumps({**values, _SEAL: seal}, indent=1, sort_keys=True) + "\n"
