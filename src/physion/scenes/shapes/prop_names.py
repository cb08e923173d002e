"""Names and categories of props, and the prop that replaces each official library model."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from physion.errors import BadInputError, UnknownNameError
from physion.scenes.scene import Vec3

PREFIX = "prop:"
FALLBACK = "prop:crate"

_NAMES = """
    armchair bar_stool basket boat bowl cactus cafe_chair carton chair coffee_maker coffee_table
    crate desk desk_lamp dog dog_sitting floor_lamp globe houseplant jug lamp moka_pot moon_globe
    mug person pillow plant rod sculpture side_table slab stool table vase vase_amphora vase_beaker
    vase_bottle wineglass
"""
PROPS = tuple(_NAMES.split())
"""Names of all props. The shape of a prop is called ``prop:NAME``."""

_STANDS_FOR = {
    "armchair": "armchair sofa",
    "basket": "basket box",
    "boat": "canoe boat kayak",
    "bowl": "bowl fruit-bowl",
    "carton": "carton cardboard-box",
    "chair": "chair",
    "coffee_maker": "coffee-maker microwave toaster",
    "coffee_table": "coffee-table",
    "crate": "crate dog-house suitcase radiator bread money soap cookie-sheet toy",
    "desk": "desk",
    "dog": "dog cat horse rodent animal",
    "floor_lamp": "floor-lamp",
    "globe": "globe ball fruit orange apple",
    "houseplant": "houseplant",
    "jug": "jug pitcher teapot kettle",
    "lamp": "table-lamp lamp",
    "moka_pot": "moka-pot",
    "mug": "mug cup coffee-cup",
    "person": "person man woman",
    "pillow": "throw-pillow pillow cushion",
    "plant": "garden-plant plant flower tree",
    "rod": "baseball-bat knife kitchen-utensil snake pen spoon fork bottle-cork",
    "sculpture": "sculpture statue",
    "side_table": "side-table",
    "slab": "coin shirt-button plate tray",
    "stool": "stool bench ottoman",
    "table": "table",
    "vase": "vase bottle pot urn",
    "wineglass": "wineglass glass beer",
}
_PROP_OF = {
    category.replace("-", " "): PREFIX + prop
    for prop, categories in _STANDS_FOR.items()
    for category in categories.split()
}

_MODELS = {
    "armchair": "linbrazil_diz_armchair adirondack_chair",
    "cafe_chair": "chair_thonet_marshall",
    "carton": "box_24inx18inx12in_cherry",
    "dog_sitting": "animal_dog_rtsit_1280 animal_dog_rtsit_1282",
    "moon_globe": "lunar_globe_art_auctor",
    "vase_amphora": "amphora_jar_vase",
    "vase_beaker": "vase_02 vase_05 vase_laura_deko_vase_set",
    "vase_bottle": "vase_01 vase_03 vase_06",
}
"""Models of the published trials that resemble another prop more than that of their category."""
_PROP_OF_MODEL = {
    model: PREFIX + prop for prop, models in _MODELS.items() for model in models.split()
}

_CATEGORIES: dict[str, tuple[str, ...]] = {
    "armchair": ("armchair",),
    "bowl": ("bowl",),
    "box": ("basket", "carton", "crate"),
    "chair": ("armchair", "cafe_chair", "chair"),
    "coffee maker": ("coffee_maker", "moka_pot"),
    "dog": ("dog", "dog_sitting"),
    "garden plant": ("plant",),
    "globe": ("globe", "moon_globe"),
    "houseplant": ("cactus", "houseplant"),
    "lamp": ("desk_lamp", "floor_lamp", "lamp"),
    "mug": ("mug",),
    "plant": ("cactus", "houseplant", "plant"),
    "stool": ("bar_stool", "stool"),
    "table": ("coffee_table", "desk", "side_table", "table"),
    "vase": ("vase", "vase_amphora", "vase_beaker", "vase_bottle"),
}
_OFFICIAL = ("vase", "chair", "dog", "coffee maker", "globe", "garden plant", "stool", "box")
_FULL = tuple(dict.fromkeys(name for kind in _OFFICIAL for name in _CATEGORIES[kind]))
_PLURALS = {"box": "boxes", "coffee maker": "coffee makers"}

PROP_CATEGORIES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        **_CATEGORIES,
        **{_PLURALS.get(word, word + "s"): names for word, names in _CATEGORIES.items()},
        "full": _FULL,
    }
)
"""Props by category, in the singular or plural; ``full`` are all that occur in the published trials
(docs/official-system.md, section 1.2)."""


def expand_props(names: Sequence[str]) -> tuple[str, ...]:
    """Replace categories of props by their members; return each name once, in order.

    Underscores and spaces are equivalent. Raises `UnknownNameError` with the closest names.
    """
    expanded: list[str] = []
    for name in names:
        bare = name.removeprefix(PREFIX)
        spaced, joined = bare.lower().replace("_", " "), bare.lower().replace(" ", "_")
        # A category takes precedence: "chair" is any chair, "prop:chair" the prop of that name.
        if not name.startswith(PREFIX) and spaced in PROP_CATEGORIES:
            expanded += PROP_CATEGORIES[spaced]
        elif joined in PROPS:
            expanded.append(joined)
        else:
            raise UnknownNameError("prop or category of props", name, (*PROPS, *PROP_CATEGORIES))
    return tuple(dict.fromkeys(expanded))


@dataclass(frozen=True)
class ModelBounds:
    """Bounding box of a library model relative to its pivot at scale 1, in our axes.

    ``bottom`` is the centre of the bottom face and ``size`` the extent, metres.
    """

    bottom: Vec3
    size: Vec3
    category: str = ""


def prop_for(category: str, model: str = "") -> str:
    """Return the shape that replaces a library model; a crate for unknown categories."""
    if model in _PROP_OF_MODEL:
        return _PROP_OF_MODEL[model]
    return _PROP_OF.get(category.lower().replace("_", " "), FALLBACK)


def read_model_bounds(path: Path) -> dict[str, ModelBounds]:
    """Read ``model_bounds.json`` (official axes, y up) into our axes, by model name.

    A record gives the centres of the six faces, possibly with sides exchanged; flat models get a
    thickness of 1 mm. `BadInputError` names the model and the missing field.
    """
    try:
        models = json.loads(path.read_text(encoding="utf-8"))["models"]
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise BadInputError(
            f"{path} cannot be read as model bounds ({type(error).__name__}: {error}); "
            "it needs an object 'models' with bounds by model name"
        ) from error
    if not isinstance(models, dict):
        raise BadInputError(f"{path}: 'models' must be an object with bounds by model name")
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
