"""Colours and textures of bodies: random ones, or red agent and yellow patient."""

from __future__ import annotations

import colorsys
import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.seeds import child_generator, named_seed
from physion.scenes.scene import Body, Cloth, Look, Scene, Vec3

MATERIALS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "wood": ("wood_ash", "wood_cedar", "wood_oak", "wood_pine", "wood_walnut"),
        "metal": ("metal", "metal_brushed", "metal_cast", "metal_hammered", "metal_polished"),
        "plastic": ("plastic", "plastic_glossy", "plastic_matte", "plastic_speckled"),
        "stone": ("stone_granite", "stone_marble", "stone_sandstone", "stone_slate"),
        "fabric": ("fabric_canvas", "fabric_denim", "fabric_linen", "fabric_wool"),
    }
)
"""Names of materials by family. The official material library has the same families."""
TEXTURES = (
    *(name for names in MATERIALS.values() for name in names),
    *("plain", "cloth", "carpet", "plaster", "tiles", "wicker", "fur", "moon"),
)
"""All texture names that the renderer knows; a texture is multiplied by the colour of the look."""
LOOKS = ("redyellow", "free")
"""Colours of a trial: agent red and patient yellow, or the sampled colours of the scene."""
RED: Vec3 = (1.0, 0.0, 0.0)
YELLOW: Vec3 = (1.0, 1.0, 0.0)
MARGIN = 0.25
"""Two colours are too similar if no channel differs by more (docs/official-system.md, 2.3)."""
ROLE_MARGIN = 0.33
"""The same for colours that may be mistaken for red or yellow: the middle official margin."""
ROLE_HUES: dict[Vec3, tuple[float, float]] = {
    RED: (-35 / 360, 15 / 360),
    YELLOW: (45 / 360, 80 / 360),
}
"""Ranges of hue (0..1) in which a saturated colour is mistaken for red or yellow, for example
crimson or lime. An addition to the official rule. Browns of furniture and dogs lie in between."""
STRONG_SATURATION, STRONG_VALUE = 0.6, 0.3

_PALETTES: dict[str, tuple[Vec3, ...]] = {
    "wood": ((0.72, 0.56, 0.4), (0.85, 0.72, 0.55), (0.5, 0.37, 0.27), (0.6, 0.42, 0.3)),
    "glaze": ((0.9, 0.89, 0.86), (0.62, 0.72, 0.74), (0.3, 0.42, 0.5), (0.5, 0.55, 0.48)),
    "clay": ((0.72, 0.47, 0.35), (0.6, 0.45, 0.36), (0.8, 0.64, 0.5)),
    "fur": ((0.5, 0.34, 0.22), (0.3, 0.2, 0.14), (0.7, 0.56, 0.4)),
    "leaf": ((0.22, 0.42, 0.18), (0.32, 0.5, 0.24), (0.2, 0.36, 0.22)),
    "dark": ((0.1, 0.1, 0.11), (0.2, 0.2, 0.22), (0.32, 0.33, 0.35)),
    "grey": ((0.2, 0.2, 0.22), (0.55, 0.55, 0.57), (0.82, 0.82, 0.82)),
    "bright": ((0.9, 0.9, 0.9), (0.25, 0.38, 0.55), (0.3, 0.5, 0.42), (0.16, 0.16, 0.18)),
    "steel": ((0.75, 0.76, 0.78), (0.66, 0.67, 0.7)),
    "fabric": ((0.35, 0.42, 0.55), (0.66, 0.6, 0.52), (0.34, 0.45, 0.37), (0.5, 0.42, 0.5)),
    "card": ((0.7, 0.55, 0.4), (0.63, 0.5, 0.38)),
    "moon": ((0.72, 0.72, 0.7),),
}
_WOODS = ("wood_ash", "wood_oak", "wood_pine", "wood_walnut")
_PROP_STYLES: dict[tuple[str, tuple[str, ...]], str] = {
    ("wood", _WOODS): "chair stool table coffee_table side_table desk globe rod",
    ("wood", ("wood_pine", "wood_oak")): "crate",
    ("wood", ("wicker",)): "basket",
    ("glaze", ("plastic_glossy", "stone_marble", "plastic_speckled")): "vase vase_bottle lamp",
    ("glaze", ("plastic_glossy", "plain")): "vase_beaker jug bowl",
    ("clay", ("plain", "stone_sandstone")): "vase_amphora",
    ("bright", ("plastic_glossy",)): "mug boat",
    ("bright", ("metal_cast", "plastic_glossy")): "cafe_chair desk_lamp",
    ("fur", ("fur",)): "dog dog_sitting",
    ("leaf", ("plain",)): "plant houseplant cactus",
    ("dark", ("plastic_matte", "plastic_glossy", "metal_brushed")): "coffee_maker",
    ("dark", ("metal_cast",)): "floor_lamp",
    ("steel", ("metal_polished", "metal_brushed")): "moka_pot slab",
    ("glaze", ("plastic_glossy",)): "wineglass",
    ("grey", ("stone_granite", "stone_sandstone", "metal_cast")): "sculpture",
    ("fabric", ("fabric_linen", "fabric_wool")): "armchair bar_stool pillow person",
    ("card", ("plain",)): "carton",
    ("moon", ("moon",)): "moon_globe",
}
_STYLE_OF = {prop: style for style, props in _PROP_STYLES.items() for prop in props.split()}
COLORS_OF = "colors_of"
"""Key of ``Scene.parameters`` of scenes that look alike though they move differently: digest from
which replaced colours are drawn, in place of the digest of the physics."""


def expand_materials(names: Sequence[str]) -> tuple[str, ...]:
    """Replace families of materials by their members; return each name once, in order.

    Raises `UnknownNameError`, with the closest names, for a name that is neither.
    """
    expanded: list[str] = []
    for name in names:
        # A family takes precedence over a material of the same name: "metal" is any metal.
        family = MATERIALS.get(name.lower())
        if family is None and name not in TEXTURES:
            raise UnknownNameError("material or family of materials", name, (*TEXTURES, *MATERIALS))
        expanded += family or (name,)
    return tuple(dict.fromkeys(expanded))


def pick_material(rng: np.random.Generator, names: Sequence[str]) -> str:
    """Draw one of the materials that ``names`` (materials and families) include, uniformly."""
    choice = expand_materials(names)
    if not choice:
        raise BadInputError("no material to pick from: name at least one material or family")
    return choice[int(rng.integers(len(choice)))]


def colors_are_similar(color: Vec3, other: Vec3, margin: float = MARGIN) -> bool:
    """Return whether no channel of two colours differs by more than ``margin``."""
    return all(abs(a - b) <= margin for a, b in zip(color, other, strict=True))


def is_mistakable(color: Vec3, role: Vec3) -> bool:
    """Return whether people may take ``color`` for the colour of a role (red or yellow)."""
    hue, saturation, value = colorsys.rgb_to_hsv(*color)
    low, high = ROLE_HUES[role]
    same_hue = low <= hue <= high or low <= hue - 1 <= high
    strong = saturation >= STRONG_SATURATION and value >= STRONG_VALUE
    return colors_are_similar(color, role, ROLE_MARGIN) or (same_hue and strong)


def random_color(rng: np.random.Generator, avoid: Sequence[Vec3] = ()) -> Vec3:
    """Draw a uniform random colour that is not too similar to any of ``avoid``."""
    while True:
        red, green, blue = (float(channel) for channel in rng.random(3))
        if not any(colors_are_similar((red, green, blue), other, MARGIN) for other in avoid):
            return red, green, blue


def prop_look(rng: np.random.Generator, shape: str) -> Look:
    """Draw a natural, muted colour and a texture for a prop, given its shape (``prop:vase``)."""
    palette, textures = _STYLE_OF.get(shape.removeprefix("prop:"), ("grey", ("plain",)))
    colors = _PALETTES[palette]
    color, texture = int(rng.integers(len(colors))), int(rng.integers(len(textures)))
    return Look(colors[color], textures[texture])


def in_look(scene: Scene, look: str) -> Scene:
    """Return ``scene`` in the colours of ``look``; `BadInputError` if it is not one of `LOOKS`."""
    if look not in LOOKS:
        raise BadInputError(f"unknown look {look!r}; known: {', '.join(LOOKS)}")
    return with_role_colors(scene) if look == "redyellow" else scene


def with_role_colors(scene: Scene) -> Scene:
    """Return the scene with a red agent and a yellow patient; similar colours are replaced.

    Only colours change. The random replacements are seeded by the physics digest, or by
    `COLORS_OF`, so that the same trial always looks the same.
    """
    drawn_from = str(scene.parameters.get(COLORS_OF, "")) or scene.physics_digest()
    rng = child_generator(named_seed(drawn_from), "role colors")

    def color_of(thing: Body | Cloth) -> Vec3:
        if thing.name == scene.roles.agent:
            return RED
        if thing.name == scene.roles.patient:
            return YELLOW
        color = thing.look.color
        while any(is_mistakable(color, role) for role in (RED, YELLOW)):
            color = random_color(rng)
        return color

    bodies = tuple(_set_color(body, color_of(body)) for body in scene.bodies)
    cloths = tuple(
        dataclasses.replace(cloth, look=dataclasses.replace(cloth.look, color=color_of(cloth)))
        for cloth in scene.cloths
    )
    return dataclasses.replace(scene, bodies=bodies, cloths=cloths)


def _set_color(body: Body, color: Vec3) -> Body:
    return dataclasses.replace(body, look=dataclasses.replace(body.look, color=color))
