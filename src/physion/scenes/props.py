"""Which prop stands for which library model of the official scenes, and how large it is."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physion.errors import BadInputError
from physion.scenes.scene import Vec3

PREFIX = "prop:"
FALLBACK = "prop:crate"

_STANDS_FOR = {
    "basket": "basket box",
    "boat": "canoe boat kayak",
    "chair": "chair armchair",
    "coffee_maker": "coffee-maker microwave toaster",
    "crate": "crate dog-house suitcase radiator bread money soap cookie-sheet toy",
    "dog": "dog cat horse rodent animal",
    "globe": "globe ball fruit orange apple",
    "jug": "jug pitcher teapot kettle cup mug coffee-cup",
    "lamp": "table-lamp floor-lamp lamp",
    "person": "person man woman",
    "pillow": "throw-pillow pillow cushion",
    "plant": "garden-plant houseplant plant flower tree",
    "rod": "baseball-bat knife kitchen-utensil snake pen spoon fork bottle-cork",
    "sculpture": "sculpture statue",
    "slab": "coin shirt-button plate tray",
    "stool": "stool bench ottoman",
    "table": "table desk coffee-table",
    "vase": "vase bottle pot urn",
    "wineglass": "wineglass glass beer",
}
_PROP_OF = {
    category.replace("-", " "): PREFIX + prop
    for prop, categories in _STANDS_FOR.items()
    for category in categories.split()
}


@dataclass(frozen=True)
class ModelBounds:
    """Where a library model lies about its pivot at scale 1, in our axes.

    ``bottom`` is the centre of the bottom face and ``size`` the extent, metres.
    """

    bottom: Vec3
    size: Vec3
    category: str = ""


def prop_for(category: str) -> str:
    """The shape that stands for library models of ``category``; a crate for unknown ones."""
    return _PROP_OF.get(category.lower().replace("_", " "), FALLBACK)


def read_model_bounds(path: Path) -> dict[str, ModelBounds]:
    """Read ``model_bounds.json`` (official axes, y up) into our axes, by model name.

    The six face centres of each record span its box; records may be turned inside out, and flat
    ones get a millimetre. `BadInputError` names the model and the field that is missing.
    """
    try:
        models = json.loads(path.read_text(encoding="utf-8"))["models"]
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise BadInputError(
            f"{path} is no record of model bounds ({type(error).__name__}: {error}); "
            "it needs an object 'models' of name -> bounds"
        ) from error
    if not isinstance(models, dict):
        raise BadInputError(f"{path}: 'models' must be an object of name -> bounds")
    return {
        name: _read_bounds(record, f"{path}: model {name!r}") for name, record in models.items()
    }


def _read_bounds(record: object, where: str) -> ModelBounds:
    try:
        faces = record["bounds"]  # type: ignore[index]
        corners = np.array(
            [
                [float(faces[side][axis]) for axis in ("x", "z", "y")]
                for side in ("left", "right", "front", "back", "top", "bottom")
            ]
        )
        category = str(record.get("category", ""))  # type: ignore[attr-defined]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BadInputError(f"{where} lacks {error} in its bounds") from error
    if not np.isfinite(corners).all():
        raise BadInputError(f"{where}: its bounds are not finite")
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    x, y = (low + high)[:2] / 2
    return ModelBounds(
        (float(x), float(y), float(low[2])),
        (float(size[0]), float(size[1]), float(size[2])),
        category,
    )
