"""Options of models on the command line, as NAME=VALUE."""

from __future__ import annotations

import json
from typing import Any

from physion.errors import BadInputError


def parse_options(pairs: tuple[str, ...], weights: str = "") -> dict[str, Any]:
    """Parse NAME=VALUE pairs; a value that is not JSON is taken as text.

    ``weights``: value of the option of this name, unless it is empty.
    """
    values: dict[str, Any] = {"weights": weights} if weights else {}
    for pair in pairs:
        name, sign, text = pair.partition("=")
        if not sign or not name:
            raise BadInputError(f"--option takes NAME=VALUE, not {pair!r}")
        if name in values:
            raise BadInputError(f"{name} is given twice")
        try:
            values[name] = json.loads(text)
        except json.JSONDecodeError:
            values[name] = text
    return values
