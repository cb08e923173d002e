"""Options of models on the command line, as NAME=VALUE."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from physion.core.errors import BadInputError


def parse_options(pairs: tuple[str, ...], given: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Parse NAME=VALUE pairs; a value that is not JSON is taken as text.

    ``given``: values of options that have an argument of their own.
    """
    values: dict[str, Any] = dict(given or {})
    for pair in pairs:
        name, sign, text = pair.partition("=")
        if not sign or not name:
            raise BadInputError(f"--option takes NAME=VALUE, not {pair!r}")
        if name in values:
            raise BadInputError(f"{name} is given twice")
        try:
            values[name] = json.loads(text)
        except (json.JSONDecodeError, RecursionError):
            values[name] = text
    return values
