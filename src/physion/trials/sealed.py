"""Small JSON files that know when one of their bytes was changed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from physion.atomic import write_atomic
from physion.errors import BadInputError

_SEAL = "sha256"


def write_sealed(path: Path, values: Mapping[str, Any]) -> None:
    """Write ``values`` with a SHA-256 of themselves, whole or not at all; same values, same bytes.

    ``values`` has no key ``sha256`` of its own.
    """
    write_atomic(path, _text(values).encode())


def read_sealed(path: Path) -> dict[str, Any]:
    """Read what `write_sealed` wrote; `BadInputError` where the file was changed since."""
    try:
        text = path.read_text(encoding="utf-8")
        values = json.loads(text)
    except (OSError, ValueError) as error:
        raise BadInputError(f"{path} cannot be read: {error}") from error
    if not isinstance(values, dict) or _SEAL not in values:
        raise BadInputError(f"{path} is damaged: field 'sha256' is missing")
    del values[_SEAL]
    if _text(values) != text:
        raise BadInputError(f"{path} was changed: its content does not fit its field 'sha256'")
    return values


def _text(values: Mapping[str, Any]) -> str:
    content = json.dumps(values, sort_keys=True, separators=(",", ":"))
    seal = hashlib.sha256(content.encode()).hexdigest()
    return json.dumps({**values, _SEAL: seal}, indent=1, sort_keys=True) + "\n"
