"""Options of models on the command line, as NAME=VALUE."""

from __future__ import annotations

import json
from typing import Any

from physion.errors import BadInputError


def parse_options(pairs: tuple[str, ...]) -> dict[str, Any]:
    """Parse NAME=VALUE pairs; a value that is not JSON is taken as text."""
    values: dict[str, Any] = {}
    for pair in pairs:
        name, sign, text = pair.partition("=")
        if not sign or not name:
            raise BadInputError(f"--option takes NAME=VALUE, not {pair!r}")
        try:
            values[name] = json.loads(text)
        except json.JSONDecodeError:
            values[name] = text
    return values
