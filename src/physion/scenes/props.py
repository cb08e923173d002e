"""Stand-ins for the library models of the official scenes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from physion.errors import BadInputError
from physion.scenes.scene import Vec3


@dataclass(frozen=True, slots=True)
class ModelBounds:
    """Box of a library model in our axes: ``bottom`` is the centre of its lowest face, metres."""

    bottom: Vec3
    size: Vec3


def read_model_bounds(path: Path) -> dict[str, ModelBounds]:
    """Bounds by model name from a record file; `BadInputError` if it is not one."""
    try:
        models = json.loads(path.read_text(encoding="utf-8"))["models"]
        return {name: _bounds(record["bounds"]) for name, record in models.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadInputError(f"{path} is not a file of model bounds: {error!r}") from error


def _bounds(record: dict[str, dict[str, float]]) -> ModelBounds:
    # Some records were measured on a turned model: left lies right of right.
    sides = (("left", "right", "x"), ("back", "front", "z"), ("bottom", "top", "y"))
    ends = [sorted((record[a][axis], record[b][axis])) for a, b, axis in sides]
    low, high = ([end[i] for end in ends] for i in (0, 1))
    size = tuple(b - a for a, b in zip(low, high, strict=True))
    bottom = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2])
    return ModelBounds(bottom, size)  # type: ignore[arg-type]


def prop_for(category: str) -> str:
    """The stand-in shape of a library category."""
    return "prop:box"
