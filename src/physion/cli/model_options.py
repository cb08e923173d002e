"""Models and their options on the command line: names with commas, and NAME=VALUE pairs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from physion.core.errors import BadInputError


def split_names(text: str, what: str) -> list[str]:
    """Return the names in a list with commas, each once; `BadInputError` if there is none."""
    names = list(dict.fromkeys(name for part in text.split(",") if (name := part.strip())))
    if not names:
        raise BadInputError(f"{text!r} names no {what}")
    return names


def choose_models(
    models: Sequence[str],
    pairs: tuple[str, ...],
    presets: Mapping[str, Mapping[str, Any]] | None = None,
) -> dict[str, dict[str, Any]]:
    """Return the options of every model.

    Parameters
    ----------
    models
        Names of models.
    pairs
        Options: ``NAME=VALUE`` of every model, or ``MODEL:NAME=VALUE`` of one of them.
    presets
        Options of single models, where ``pairs`` set none.

    Raises
    ------
    BadInputError
        If an option is no pair or is given twice.
    """
    own: dict[str, list[str]] = {name: [] for name in models}
    for pair in pairs:
        named = [name for name in models if pair.startswith(f"{name}:")]
        for name in named or models:
            own[name].append(pair.removeprefix(f"{name}:"))
    known = presets or {}
    return {name: {**known.get(name, {}), **parse_options(tuple(own[name]))} for name in models}


def parse_options(pairs: tuple[str, ...]) -> dict[str, Any]:
    """Parse NAME=VALUE pairs; a value that is not JSON is taken as text."""
    values: dict[str, Any] = {}
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
