"""Registry of shapes, and the primitives: their meshes and collision pieces.

Sizes follow the official model records (docs/official-system.md, section 1.2), with their
axes (x, y up, z) converted to ours (x, z, y up). The pivot is the centre of the bottom face, so
that a shape stands on z = 0. A record gives bounds and a "volume", which is not the volume of the
solid but, as far as can be checked, the sum of the volumes of the bounding boxes of the convex
colliders: for convex shapes it equals the volume of the bounding box, and for a torus of 16
colliders it gives an inner radius of 0.429, where a published picture shows 0.430. What bounds and
volume leave open is a named constant here, with its reason.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.registry import Registry
from physion.numerics.elementary import arctan2, cos, sin
from physion.scenes.scene import Vec3, vec3
from physion.scenes.shapes.meshes import Mesh, Points, box, extrude, hull, revolve, solid_properties

# Names and categories of props, and the prop that replaces each official library model.

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
"""Models of the published trials that resemble a prop of another category more."""
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
    except (KeyError, TypeError, ValueError) as error:
        raise BadInputError(f"{where} lacks {error} in its bounds") from error
    if not np.isfinite(corners).all():
        raise BadInputError(f"{where}: its bounds are not finite")
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    x, y = (low + high)[:2] / 2
    return ModelBounds(
        (float(x), float(y), float(low[2])),
        vec3(size),
    )


CURVED = math.radians(40.0)
"""Crease angle of round shapes: walls are shaded smoothly, rims are sharp."""
ROUND_SEGMENTS = 32
CONE_SEGMENTS = 22
"""The record is 0.9898 wide and 1 deep, as for a 22-sided cone with corners on one axis."""
RING_SEGMENTS = 16
"""Sides of the torus, counted in a published picture."""
TORUS_INNER = 0.429
"""Inner radius of the torus: 0.688 (sd 0.004) of the outer 0.625, measured on 8 corners of a
torus-shaped zone in a published picture; 0.429 from the boxes of 16 colliders (0.2618)."""
TORUS_PIECE_INNER, TORUS_SECTORS = 0.429, 16
"""Inner radius at the corners of the torus's collision pieces, and their number."""
TORUS_BEVEL = 0.06
"""The cross-section of the torus is a rectangle with corners cut by this length (from pictures)."""
PIPE_INNER = 0.389
"""Inner radius of the pipe: the boxes of 16 to 32 colliders have the recorded volume of 0.5146 for
radii of 0.386 to 0.391."""
PIPE_PIECE_INNER = 0.389
"""Inner radius at the corners of the pipe's collision pieces."""
BOWL_RADIUS, BOWL_HEIGHT = 0.4904, 0.3789
BOWL_FLAT = 0.2
"""Radius of the bowl's flat bottom: of 0.12, 0.2 and 0.28 it predicts the official final positions
of contained objects best."""
BOWL_WALL = 0.045
"""Thickness of the bowl's wall. The recorded volume of 0.1715 allows 0.03 to 0.055, depending on
the number of colliders; the rim in pictures is not thicker."""
BOWL_PIECE_WALL = 0.035
"""Thickness of the bowl's collision pieces at their corners. A convex sector is thicker in its
middle than at its corners; with this value the pieces have the volume of the drawn wall."""
DUMBBELL_HEAD, DUMBBELL_BAR = 0.375, 0.1206
"""Half sizes of a dumbbell's two cubes and of the square bar between them; each is a third of its
length. Official dumbbells come to rest on four sides and on their ends, so the heads are cubes;
boxes of these sizes have the recorded volume of 0.8873."""
RAMP_FOOT, RAMP_DEPTH = 1.629, 2.0
"""Distance of a ramp's pivot from its foot, and its width. The recorded lengths belong to slopes
of 30 and 60 per cent and a platform of 1.61. In the records the foot is at +x, but objects that
come to rest in front of official ramps show that it is at -x."""
BOWL_SEGMENTS = 24
PIPE_SECTORS, BOWL_SECTORS, BOWL_BANDS = 16, 12, 3
"""Number of convex sectors that a hollow shape is divided into, and of bands of the bowl's wall."""


@dataclass(frozen=True, eq=False)
class ConvexPiece:
    """Convex part of a shape that is used for collisions.

    - ``center``, ``half``: centre and half sizes in the shape's coordinates. For a sphere ``half``
      is three times the radius, for a cylinder (axis z) its two radii and half its height, for
      ``convex`` of the bounding box.
    - ``vertices`` (K, 3): corners in the shape's coordinates, for ``convex`` only.
    - ``rotation`` (3, 3): from the axes of the piece to the axes of the shape.
    """

    kind: Literal["box", "sphere", "cylinder", "convex"]
    center: Vec3
    half: Vec3
    vertices: Points
    rotation: Points

    @property
    def mesh(self) -> Mesh:
        """Return the piece as a closed mesh; round pieces have 32 sides."""
        if self.kind == "convex":
            return hull(self.vertices)
        if self.kind == "box":
            solid = box((0, 0, 0), self.half)
        elif self.kind == "sphere":
            solid = ball_mesh(self.half[0])
        else:
            ends = [(0.0, -1.0), (1.0, -1.0), (1.0, 1.0), (0.0, 1.0)]
            solid = revolve(ends, ROUND_SEGMENTS).moved(self.half)
        return solid.rotated(self.rotation).moved(offset=self.center)


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape at unit scale: a closed mesh for rendering and convex pieces for collisions.

    ``hollow`` shapes have a hole or a cavity.
    """

    name: str
    mesh: Mesh
    pieces: tuple[ConvexPiece, ...]
    hollow: bool = False

    @property
    def volume(self) -> float:
        """Return the volume of the mesh, cubic metres at unit scale."""
        return solid_properties(self.mesh)[0]

    @property
    def bounds(self) -> Points:
        """Return the smallest and largest coordinates (2, 3) of the mesh."""
        return self.mesh.bounds


Outline = list[tuple[float, float]]
ShapeBuilder = Callable[[], Shape]
shapes: Registry[ShapeBuilder] = Registry(
    "shape", {PREFIX + name: "physion.scenes.shapes.props:shapes" for name in PROPS}
)
"""Registry of functions that build shapes; use `shape` to get a shape."""


@cache
def shape(name: str) -> Shape:
    """Return the shape called ``name``; raise `UnknownNameError` with the closest names."""
    return shapes.get(name)()


def primitive(kind: Literal["box", "sphere", "cylinder"], center: Vec3, half: Vec3) -> ConvexPiece:
    """Return a collision piece of a kind that engines know, aligned with the axes of the shape."""
    return ConvexPiece(kind, center, half, np.zeros((0, 3)), np.eye(3))


def convex(points: NDArray[np.float64]) -> ConvexPiece:
    """Return a collision piece that is the convex hull of ``points`` (K, 3)."""
    corners = hull(points).vertices
    low, high = corners.min(axis=0), corners.max(axis=0)
    center, half = (low + high) / 2, (high - low) / 2
    return ConvexPiece("convex", vec3(center), vec3(half), corners, np.eye(3))


def ball_mesh(radius: float, segments: int = ROUND_SEGMENTS) -> Mesh:
    """Return a sphere about the origin with ``segments`` meridians and half as many bands."""
    bands = segments // 2
    angles = [-math.pi / 2 + math.pi * i / bands for i in range(bands + 1)]
    rings = [(radius * cos(t), radius * sin(t)) for t in angles[1:-1]]
    return revolve([(0.0, -radius), *rings, (0.0, radius)], segments, smooth=CURVED)


def ring_pieces(
    sections: list[NDArray[np.float64]], sectors: int, steps: int
) -> tuple[ConvexPiece, ...]:
    """Divide a ring into convex sectors.

    Parameters
    ----------
    sections
        Convex cross-sections (K, 2) of (radius, height); each is swept around the axis.
    sectors
        Number of sectors per section.
    steps
        Number of corners of the drawn circle that a sector spans.
    """
    pieces = []
    for section in sections:
        for sector in range(sectors):
            angles = 2 * math.pi * (sector + np.arange(steps + 1) / steps) / sectors
            circle = np.stack([cos(angles), sin(angles)], axis=1)
            points = [
                np.column_stack([circle * r, np.full(len(circle), z)]) for r, z in section if r > 0
            ]
            pieces.append(convex(np.concatenate(points)))
    return tuple(pieces)


@shapes.register("cube")
def _cube() -> Shape:
    center, half = (0.0, 0.0, 0.5), (0.5, 0.5, 0.5)
    return Shape("cube", box(center, half), (primitive("box", center, half),))


@shapes.register("sphere")
def _sphere() -> Shape:
    center = (0.0, 0.0, 0.5)
    mesh = ball_mesh(0.5).moved(offset=center)
    return Shape("sphere", mesh, (primitive("sphere", center, (0.5, 0.5, 0.5)),))


@shapes.register("cylinder")
def _cylinder() -> Shape:
    profile = [(0.0, 0.0), (0.5, 0.0), (0.5, 1.0), (0.0, 1.0)]
    mesh = revolve(profile, ROUND_SEGMENTS, smooth=CURVED)
    return Shape("cylinder", mesh, (primitive("cylinder", (0.0, 0.0, 0.5), (0.5, 0.5, 0.5)),))


@shapes.register("half:cylinder")
def _half_cylinder() -> Shape:
    # Not an official shape: the official ledge is a stretched ball, sunk by half into the floor.
    angles = np.linspace(0, math.pi, 9)
    points = [(cos(t) / 2, y, sin(t) / 2) for t in angles for y in (-0.5, 0.5)]
    return _solid("half:cylinder", hull(points, CURVED))


@shapes.register("cone")
def _cone() -> Shape:
    profile = [(0.0, 0.0), (0.5, 0.0), (0.0, 1.0)]
    return _solid("cone", revolve(profile, CONE_SEGMENTS, phase=math.pi / 2, smooth=CURVED))


@shapes.register("pyramid")
def _pyramid() -> Shape:
    side = 0.75 / math.sqrt(2)
    return _solid("pyramid", hull([*_square(side, 0.0), (0.0, 0.0, 1.0)]))


@shapes.register("octahedron")
def _octahedron() -> Shape:
    # Both a square with sides of 1 and one with diagonals of 1 fit the bounds; with sides of 1 the
    # eight faces are nearly regular, as the name promises.
    return _solid("octahedron", hull([*_square(0.5, 0.75), (0.0, 0.0, 0.0), (0.0, 0.0, 1.5)]))


@shapes.register("platonic")
def _platonic() -> Shape:
    angles = 2 * np.pi * np.arange(5) / 5
    radius, rise = 1 / math.sqrt(5), 0.5 / math.sqrt(5)
    upper = np.column_stack([radius * cos(angles), radius * sin(angles), np.full(5, rise)])
    poles = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, -0.5]])
    corners = np.concatenate([upper, -upper, poles])
    return _solid("platonic", hull(corners).moved(offset=(0, 0, 0.5)))


@shapes.register("pentagon")
def _pentagon() -> Shape:
    angles = -np.pi / 2 + 2 * np.pi * np.arange(5) / 5
    corners = 0.5 * np.stack([cos(angles), sin(angles)], axis=1)
    return _solid("pentagon", extrude(corners, 0.0, 1.0))


@shapes.register("triangular_prism")
def _triangular_prism() -> Shape:
    # The ridge runs along x: with it along y the official falls of prisms are missed by 0.33 m
    # (median of 20 trials), with it along x by 0.07 m.
    ends = [(x, y, 0.0) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
    ridge = [(x, 0.0, 0.5 + math.sqrt(3) / 4) for x in (-0.5, 0.5)]
    return _solid("triangular_prism", hull([*ends, *ridge]))


@shapes.register("dumbbell")
def _dumbbell() -> Shape:
    head, bar = DUMBBELL_HEAD, DUMBBELL_BAR
    # Four segments of a lathe make a square solid; it is then laid along y.
    corner, neck, end = head * math.sqrt(2), bar * math.sqrt(2), 3 * head
    half = [(0.0, -end), (corner, -end), (corner, -head), (neck, -head)]
    profile = [*half, *((r, -z) for r, z in reversed(half))]
    lay = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    mesh = revolve(profile, 4, phase=math.pi / 4).rotated(lay).moved(offset=(0, 0, head))
    heads = (primitive("box", (0.0, y, head), (head, head, head)) for y in (-2 * head, 2 * head))
    rod = primitive("box", (0.0, 0.0, head), (bar, head, bar))
    return Shape("dumbbell", mesh, (*heads, rod))


@shapes.register("torus")
def _torus() -> Shape:
    mesh = revolve(_torus_section(TORUS_INNER), RING_SEGMENTS, closed=True, smooth=CURVED)
    section = np.array(_torus_section(TORUS_PIECE_INNER))
    pieces = ring_pieces([section], TORUS_SECTORS, RING_SEGMENTS // TORUS_SECTORS)
    return Shape("torus", mesh, pieces, hollow=True)


def _torus_section(inner: float) -> Outline:
    """Return the cross-section of a torus as (radius, height)."""
    outer, cut = 0.625, min(TORUS_BEVEL, 0.45 * (0.625 - inner))
    section = [(inner + cut, 0.0), (outer - cut, 0.0), (outer, cut), (outer, 0.25 - cut)]
    return [*section, (outer - cut, 0.25), (inner + cut, 0.25), (inner, 0.25 - cut), (inner, cut)]


@shapes.register("pipe")
def _pipe() -> Shape:
    mesh = revolve(pipe_section(PIPE_INNER), ROUND_SEGMENTS, closed=True, smooth=CURVED)
    pieces = ring_pieces([np.array(pipe_section(PIPE_PIECE_INNER))], PIPE_SECTORS, 1)
    return Shape("pipe", mesh, pieces, hollow=True)


def pipe_section(inner: float) -> Outline:
    """Return the cross-section of a pipe as (radius, height)."""
    return [(inner, 0.0), (0.5, 0.0), (0.5, 1.0), (inner, 1.0)]


def bowl_outline(radius: float, height: float, flat: float, points: int) -> Outline:
    """Return a circular arc of ``points`` corners from (``flat``, 0) to (``radius``, ``height``).

    The centre of the circle is on the axis.
    """
    middle = (radius * radius + height * height - flat * flat) / (2 * height)
    size = math.sqrt(flat * flat + middle * middle)
    first, last = arctan2(-middle, flat), arctan2(height - middle, radius)
    angles = np.linspace(first, last, points)
    return [(size * cos(t), middle + size * sin(t)) for t in angles]


@shapes.register("bowl")
def _bowl() -> Shape:
    outside = bowl_outline(BOWL_RADIUS, BOWL_HEIGHT, BOWL_FLAT, 4 * BOWL_BANDS + 1)
    inside = _inside_bowl(BOWL_WALL, len(outside))
    profile = [(0.0, 0.0), *outside, *reversed(inside), (0.0, BOWL_WALL)]
    mesh = revolve(profile, BOWL_SEGMENTS, smooth=CURVED)
    corners = _inside_bowl(BOWL_PIECE_WALL, len(outside))
    sections = []
    for first in range(0, 4 * BOWL_BANDS, 4):
        outer = outside[first : first + 5]
        sections.append(np.array([*outer, corners[first], corners[first + 4]]))
    walls = ring_pieces(sections, BOWL_SECTORS, BOWL_SEGMENTS // BOWL_SECTORS)
    floor = revolve([(0, 0), outside[0], inside[0], (0, BOWL_WALL)], BOWL_SEGMENTS)
    return Shape("bowl", mesh, (*walls, convex(floor.vertices)), hollow=True)


def _inside_bowl(wall: float, points: int) -> Outline:
    """Return the inner profile of a bowl's wall, from the bottom up to the rim."""
    flat = max(BOWL_FLAT - wall / 2, 0.01)
    arc = bowl_outline(BOWL_RADIUS - wall, BOWL_HEIGHT - wall, flat, points)
    return [(r, z + wall) for r, z in arc]


@shapes.register("ramp_with_platform_30")
def _ramp_30() -> Shape:
    return _ramp("ramp_with_platform_30", 0.3, 4.9529, 1.0007)


@shapes.register("ramp_with_platform_60")
def _ramp_60() -> Shape:
    return _ramp("ramp_with_platform_60", 0.6, 3.2789, 1.0003)


def _ramp(name: str, grade: float, length: float, height: float) -> Shape:
    """Return a ramp that rises from its foot towards +x by ``grade``, then a level platform."""
    foot, top, end = -RAMP_FOOT, height / grade - RAMP_FOOT, length - RAMP_FOOT
    side = [(foot, 0.0), (top, height), (end, height), (end, 0.0)]
    corners = [(x, y, z) for x, z in side for y in (-RAMP_DEPTH / 2, RAMP_DEPTH / 2)]
    return _solid(name, hull(corners))


def _solid(name: str, mesh: Mesh) -> Shape:
    """Return a convex shape, whose mesh is also its only collision piece."""
    return Shape(name, mesh, (convex(mesh.vertices),))


def _square(half: float, height: float) -> list[Vec3]:
    return [(x, y, height) for x in (-half, half) for y in (-half, half)]
