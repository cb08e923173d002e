"""What a plan consists of: models, training protocols, seeds, and a scenario."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from physion.core.errors import BadInputError
from physion.training.protocols import Training


@dataclass(frozen=True)
class ModelChoice:
    """Model by its name, or ``FILE.py:Class``, with the fields of its config that a user sets."""

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Selection:
    """Every model is combined with every protocol and seed.

    ``scenario``: that all-but leaves out, or the one of only; empty for one training each.
    """

    models: tuple[ModelChoice, ...]
    protocols: tuple[Training, ...] = (Training.ALL,)
    seeds: tuple[int, ...] = (0,)
    scenario: str = ""


def split_names(text: str, what: str) -> tuple[str, ...]:
    """Return the names in a list with commas, each once; `BadInputError` if there is none."""
    names = tuple(dict.fromkeys(name for part in text.split(",") if (name := part.strip())))
    if not names:
        raise BadInputError(f"{text!r} names no {what}")
    return names


def parse_protocols(text: str) -> tuple[Training, ...]:
    """Return the training protocols in a list with commas; `UnknownNameError` for another name."""
    return tuple(Training.named(name) for name in split_names(text, "training protocol"))


def count_seeds(first: int, count: int) -> tuple[int, ...]:
    """Return ``count`` seeds from ``first`` on; raise `BadInputError` for none."""
    if count < 1:
        raise BadInputError(f"seeds must be at least 1, not {count}")
    return tuple(range(first, first + count))
