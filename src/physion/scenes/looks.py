"""Colours and textures: free random ones, and red agent with yellow patient."""

from __future__ import annotations

import colorsys
import dataclasses
from collections.abc import Sequence

import numpy as np

from physion.errors import UnknownNameError
from physion.scenes.scene import Body, Cloth, Look, Scene, Vec3
from physion.seeds import child_generator, stable_hash

TEXTURES = (
    "plain",
    "wood_cedar",
    "wood_ash",
    "carpet",
    "plaster",
    "tiles",
    "metal",
    "plastic",
    "cloth",
)
"""Names that a renderer knows; it tints them by the look's colour."""
RED: Vec3 = (1.0, 0.0, 0.0)
YELLOW: Vec3 = (1.0, 1.0, 0.0)
MARGIN = 0.25
"""Two colours are too near if no channel differs by more (official-system.md, section 2.3)."""
ROLE_MARGIN = 0.33
"""The middle one of the official margins, for what may pass for red or yellow."""
ROLE_HUE = 15 / 360
"""Beyond the official rule: a strong colour of this hue or nearer passes for red or yellow, however
dark it is. The browns of furniture and dogs are further off."""
STRONG_SATURATION, STRONG_VALUE = 0.6, 0.3

_PALETTES: dict[str, tuple[Vec3, ...]] = {
    "wood": ((0.45, 0.3, 0.18), (0.62, 0.46, 0.3), (0.3, 0.2, 0.13)),
    "glaze": ((0.85, 0.84, 0.8), (0.65, 0.42, 0.3), (0.3, 0.42, 0.5), (0.5, 0.52, 0.48)),
    "fur": ((0.35, 0.22, 0.13), (0.12, 0.1, 0.09), (0.7, 0.6, 0.48)),
    "leaf": ((0.16, 0.32, 0.14), (0.24, 0.4, 0.2)),
    "grey": ((0.2, 0.2, 0.22), (0.55, 0.55, 0.57), (0.82, 0.82, 0.82)),
    "fabric": ((0.35, 0.4, 0.5), (0.6, 0.55, 0.5), (0.3, 0.4, 0.33)),
}
_PROP_PALETTE = {
    **dict.fromkeys(["chair", "stool", "table", "crate", "rod", "boat"], ("wood", "wood_ash")),
    **dict.fromkeys(["vase", "jug", "sculpture"], ("glaze", "plain")),
    **dict.fromkeys(["dog", "person"], ("fur", "plain")),
    **dict.fromkeys(["coffee_maker", "wineglass", "slab"], ("grey", "plastic")),
    "lamp": ("grey", "metal"),
    "plant": ("leaf", "plain"),
    "globe": ("glaze", "plastic"),
    "pillow": ("fabric", "cloth"),
    "basket": ("wood", "plain"),
}


MATERIALS: dict[str, tuple[str, ...]] = {
    "wood": ("wood_cedar", "wood_ash"),
    "metal": ("metal",),
    "plastic": ("plastic",),
}
"""Materials by family."""


def expand_materials(names: Sequence[str]) -> tuple[str, ...]:
    """Material names, with each family name replaced by its members."""
    found: list[str] = []
    for name in names:
        if name not in MATERIALS and name not in TEXTURES:
            raise UnknownNameError("material", name, (*MATERIALS, *TEXTURES))
        found += MATERIALS.get(name, (name,))
    return tuple(dict.fromkeys(found))


def pick_material(rng: np.random.Generator, names: Sequence[str]) -> str:
    """One of the materials, each as likely; a family counts as its members."""
    known = expand_materials(names)
    return known[int(rng.integers(len(known)))]


def too_near(color: Vec3, other: Vec3, margin: float = MARGIN) -> bool:
    """Whether every channel of two colours is within ``margin``."""
    return all(abs(a - b) <= margin for a, b in zip(color, other, strict=True))


def mistakable(color: Vec3, role: Vec3) -> bool:
    """Whether people may take ``color`` for the colour of a role."""
    hue, saturation, value = colorsys.rgb_to_hsv(*color)
    away = abs(hue - colorsys.rgb_to_hsv(*role)[0])
    same_hue = min(away, 1 - away) <= ROLE_HUE
    strong = saturation >= STRONG_SATURATION and value >= STRONG_VALUE
    return too_near(color, role, ROLE_MARGIN) or (same_hue and strong)


def random_color(
    rng: np.random.Generator, avoid: Sequence[Vec3] = (), margin: float = MARGIN
) -> Vec3:
    """An even random colour that is not too near any of ``avoid``.

    The margin must leave some colour over: with a few colours to avoid it is at most 0.5.
    """
    while True:
        red, green, blue = (float(channel) for channel in rng.random(3))
        if not any(too_near((red, green, blue), other, margin) for other in avoid):
            return red, green, blue


def prop_look(rng: np.random.Generator, shape: str) -> Look:
    """A natural, dull colour and texture for a prop (``prop:vase``)."""
    palette, texture = _PROP_PALETTE.get(shape.removeprefix("prop:"), ("grey", "plain"))
    colors = _PALETTES[palette]
    return Look(colors[int(rng.integers(len(colors)))], texture)


def with_role_colors(scene: Scene) -> Scene:
    """The scene with a red agent and a yellow patient; all that looked like them is recoloured.

    Nothing but colours changes. New colours depend on the physics of the scene alone, so that
    the same trial always looks the same.
    """
    rng = child_generator(
        np.random.SeedSequence(stable_hash(scene.physics_digest())), "role colors"
    )

    def color_of(thing: Body | Cloth) -> Vec3:
        if thing.name == scene.roles.agent:
            return RED
        if thing.name == scene.roles.patient:
            return YELLOW
        color = thing.look.color
        while any(mistakable(color, role) for role in (RED, YELLOW)):
            color = random_color(rng)
        return color

    bodies = tuple(_colored(body, color_of(body)) for body in scene.bodies)
    cloths = tuple(
        dataclasses.replace(cloth, look=dataclasses.replace(cloth.look, color=color_of(cloth)))
        for cloth in scene.cloths
    )
    return dataclasses.replace(scene, bodies=bodies, cloths=cloths)


def _colored(body: Body, color: Vec3) -> Body:
    return dataclasses.replace(body, look=dataclasses.replace(body.look, color=color))
