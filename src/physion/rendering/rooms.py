"""Rooms in which trials are shown: their surfaces and their light.

A room consists of rectangles that face inwards, with the floor at z = 0. It is only drawn: nothing
collides with its walls.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.core.registry import Registry
from physion.numerics.linear_algebra import norm
from physion.scenes.scene import Vec3, vec3

F64 = NDArray[np.float64]
Rect = tuple[float, float, float, float]
"""Rectangle in the plane of a wall, in metres: u from, u to, v from, v to."""


class Wall(NamedTuple):
    """Rectangular wall from ``corner`` along ``u`` and ``v`` (metres); u x v points inwards."""

    corner: Vec3
    u: Vec3
    v: Vec3

    def arrays(self) -> tuple[F64, F64, F64, float, float]:
        """Return corner (3,), unit vectors along u and v (3,), and the two lengths in metres."""
        corner, u, v = (np.asarray(x, np.float64) for x in self)
        width, height = float(norm(u)), float(norm(v))
        return corner, u / width, v / height, width, height


@dataclass(frozen=True)
class Panel:
    """Rectangle from ``corner`` along ``u`` and ``v`` (metres); its front is at ``u`` x ``v``.

    ``color`` is sRGB; ``texture`` is the name of a finish, repeated every ``tile`` metres;
    ``emission`` is light of its own, as a multiple of its colour; ``occluded`` tells whether it is
    darker near the edges of the room.
    """

    corner: Vec3
    u: Vec3
    v: Vec3
    color: Vec3
    texture: str = "smooth_plaster"
    tile: float = 2.0
    emission: float = 0.0
    occluded: bool = True


@dataclass(frozen=True)
class Room:
    """Panels and light; colours of light are linear, see `physion.rendering.rasterizer.LIGHT`.

    - ``panels``: the first one is the floor.
    - ``low``, ``high``: corners of the box that the walls, floor and ceiling make.
    - ``light_direction``, ``light_color``: the directional light; the vector points towards it.
    - ``ambient``, ``ambient_slopes``: ambient light, and its change with each component of the
      normal.
    - ``environment``: what reflections show at the sides, below and above.
    - ``exposure``: factor of all light before the tone curve.
    - ``window``: two corners and colour of a bright rectangle in a plane of one y, which
      reflections show; by default too far away to be seen.
    - ``background``: sRGB colour where nothing is seen.
    - ``shadow_strength``: fraction of the directional light that a full shadow takes.
    - ``occlusion_strength``: fraction of all light that full occlusion under objects takes.
    """

    panels: tuple[Panel, ...]
    low: Vec3
    high: Vec3
    light_direction: Vec3
    light_color: Vec3
    ambient: Vec3
    ambient_slopes: tuple[Vec3, Vec3, Vec3]
    environment: tuple[Vec3, Vec3, Vec3]
    exposure: float
    window: tuple[Vec3, Vec3, Vec3] = ((0.0, 1e6, 0.0), (0.0, 1e6, 0.0), (0.0, 0.0, 0.0))
    background: Vec3 = (0.8, 0.85, 0.9)
    shadow_strength: float = 0.8
    occlusion_strength: float = 0.6


rooms: Registry[Room] = Registry("room")


def _wall_panels(wall: Wall, openings: Sequence[Rect], **surface: object) -> Iterator[Panel]:
    """Yield the panels of a wall with openings.

    The wall is cut along the sides of all openings into a grid; ``surface`` are the other fields of
    the panels.
    """
    corner, u, v, width, height = wall.arrays()
    across = sorted({0.0, width, *(x for o in openings for x in o[:2])})
    upward = sorted({0.0, height, *(y for o in openings for y in o[2:])})
    for a, b in pairwise(across):
        for c, d in pairwise(upward):
            if any(o[0] <= a and b <= o[1] and o[2] <= c and d <= o[3] for o in openings):
                continue
            yield Panel(
                vec3(corner + a * u + c * v),
                vec3((b - a) * u),
                vec3((d - c) * v),
                **surface,  # type: ignore[arg-type]
            )


def _reveal(wall: Wall, opening: Rect, depth: float, **surface: object) -> Iterator[Panel]:
    """Yield the four sides of an opening in a wall that is ``depth`` metres thick."""
    corner, u, v, _, _ = wall.arrays()
    back = -depth * np.cross(u, v)
    a, b, c, d = opening
    p = [corner + x * u + y * v for x, y in ((a, c), (b, c), (b, d), (a, d))]
    for i in range(4):
        side = p[(i + 1) % 4] - p[i]
        yield Panel(vec3(p[i]), vec3(side), vec3(back), **surface)  # type: ignore[arg-type]


def _slab(low: Vec3, high: Vec3, **surface: object) -> Iterator[Panel]:
    """Yield the sides of a box that is seen from outside: a beam, a post, a step."""
    a, b = np.asarray(low, np.float64), np.asarray(high, np.float64)
    x, y, z = np.diag(b - a)
    for corner, u, v in (
        (a, y, x), (a, x, z), (a, z, y), (b, -x, -y), (b, -z, -x), (b, -y, -z),
    ):  # fmt: skip
        yield Panel(vec3(corner), vec3(u), vec3(v), **surface)  # type: ignore[arg-type]


def _four_walls(half_x: float, half_y: float, height: float, floor: float = 0.0) -> list[Wall]:
    """Return the walls at -x, +x, -y and +y around a room, standing at height ``floor``."""
    x, y, h = half_x, half_y, (0.0, 0.0, height)
    return [
        Wall((-x, -y, floor), (0.0, 2 * y, 0.0), h),
        Wall((x, y, floor), (0.0, -2 * y, 0.0), h),
        Wall((x, -y, floor), (-2 * x, 0.0, 0.0), h),
        Wall((-x, y, floor), (2 * x, 0.0, 0.0), h),
    ]


def _box_room() -> Room:
    """Return a room with grey plaster, a dark blue carpet, small windows and a coffered ceiling."""
    half, height = 6.5, 4.6
    floor = Panel(
        (-half, -half, 0), (2 * half, 0, 0), (0, 2 * half, 0), (0.25, 0.33, 0.445), "carpet", 1.1
    )
    panels: list[Panel] = [floor]
    windows = {
        0: [(3.0, 4.3), (5.6, 6.9)],
        1: [(8.0, 9.3)],
        2: [(6.2, 7.5), (8.8, 10.1)],
        3: [(2.9, 4.2)],
    }
    for index, wall in enumerate(_four_walls(half, half, height)):
        openings = [(a, b, 2.75, 3.65) for a, b in windows[index]]
        panels += _wall_panels(wall, openings, **PLASTER)
        for opening in openings:
            panels += _reveal(wall, opening, 0.35, color=(0.72, 0.72, 0.74))
            panels.append(_pane(wall, opening, 0.35, (0.84, 0.85, 0.90), 0.78))
    panels += _coffers(half, height)
    return Room(
        panels=tuple(panels),
        low=(-half, -half, 0.0),
        high=(half, half, height),
        light_direction=(0.30, 0.25, 0.92),
        light_color=(0.27, 0.27, 0.27),
        ambient=(0.36, 0.36, 0.365),
        ambient_slopes=((0.03, 0.03, 0.03), (-0.03, -0.03, -0.03), (0.20, 0.20, 0.20)),
        environment=((0.26, 0.27, 0.32), (0.03, 0.04, 0.06), (0.40, 0.40, 0.42)),
        exposure=1.0,
        shadow_strength=0.85,
        occlusion_strength=0.6,
    )


PLASTER = {"color": (0.875, 0.88, 0.935), "texture": "plaster", "tile": 3.0}
WHITE = {"color": (0.955, 0.96, 0.985), "texture": "smooth_plaster", "tile": 3.0}


def _coffers(half: float, height: float) -> list[Panel]:
    """Return a ceiling of pale fields between dark beams."""
    beam = {"color": (0.36, 0.35, 0.33), "texture": "smooth_plaster", "emission": 0.14}
    pale = {"color": (0.80, 0.80, 0.79), "texture": "smooth_plaster", "emission": 0.22}
    inner, rise = half - 0.8, 0.30
    across, back = (2 * inner, 0.0, 0.0), (0.0, -2 * inner, 0.0)
    panels = [Panel((-inner, inner, height + rise), across, back, **pale)]  # type: ignore[arg-type]
    sides = _four_walls(inner, inner, rise, floor=height)
    panels += [Panel(*side, **pale) for side in sides]  # type: ignore[arg-type]
    hole = [(0.8, 2 * half - 0.8, 0.8, 2 * half - 0.8)]
    border = Wall((-half, half, height), (2 * half, 0, 0), (0, -2 * half, 0))
    panels += _wall_panels(border, hole, **beam)
    for middle in (-1.9, 1.9):
        low, high = middle - 0.2, middle + 0.2
        panels += _slab((-inner, low, height), (inner, high, height + rise), **beam)
        panels += _slab((low, -inner, height), (high, inner, height + rise), **beam)
    return panels


def _pane(wall: Wall, opening: Rect, depth: float, color: Vec3, emission: float) -> Panel:
    """Return what is seen through an opening: a glowing panel ``depth`` metres behind it."""
    corner, u, v, _, _ = wall.arrays()
    a, b, c, d = opening
    start = corner + a * u + c * v - depth * np.cross(u, v)
    across, upward = vec3((b - a) * u), vec3((d - c) * v)
    return Panel(vec3(start), across, upward, color, "glow", 2.0, emission, False)


def _bright_room() -> Room:
    """Return a room with reddish stone tiles, white walls, and glass doors to a yard at -y."""
    x, y, height = 6.5, 5.0, 3.4
    floor = Panel((-x, -y, 0), (2 * x, 0, 0), (0, 2 * y, 0), (1, 1, 1), "tiles", 1.8)
    ceiling = Panel(
        (-x, y, height), (2 * x, 0, 0), (0, -2 * y, 0), (0.90, 0.90, 0.91), emission=0.20
    )
    panels: list[Panel] = [floor, ceiling]
    doors: dict[int, list[Rect]] = {
        0: [(2.0, 3.0, 0.0, 2.15), (6.0, 7.6, 0.9, 2.1)],
        1: [(3.2, 4.2, 0.0, 2.15)],
        2: [(2.1, 3.0, 0.25, 2.2), (3.7, 9.3, 0.0, 2.3), (10.0, 10.9, 0.25, 2.2)],
        3: [(8.0, 9.0, 0.0, 2.15)],
    }
    walls = _four_walls(x, y, height)
    for index, wall in enumerate(walls):
        panels += _wall_panels(wall, doors[index], **WHITE)
        for opening in doors[index]:
            panels += _reveal(wall, opening, 0.25, color=(0.86, 0.86, 0.87))
    for index, opening in ((0, doors[0][0]), (1, doors[1][0]), (3, doors[3][0])):
        panels.append(_pane(walls[index], opening, 0.25, (0.72, 0.72, 0.74), 0.7))
    panels.append(_pane(walls[0], doors[0][1], 0.25, (0.80, 0.85, 0.88), 0.9))
    panels += _door_frames(-y - 0.12)
    panels += _yard(-y - 0.25)
    # A beam under the ceiling, and three pillars at the walls.
    panels += _slab((-x, y - 0.9, 2.75), (x, y, height), **WHITE)
    panels += _slab((-4.6, y - 0.45, 0.0), (-2.9, y, 2.75), **WHITE)
    panels += _slab((x - 0.5, -1.0, 0.0), (x, 0.6, height), **WHITE)
    panels += _slab((-x, 0.6, 0.0), (-x + 0.5, 2.2, height), **WHITE)
    for spot in ((-3.0, -2.2), (0.0, -2.2), (3.0, -2.2), (-3.0, 2.0), (0.0, 2.0), (3.0, 2.0)):
        corner = (spot[0], spot[1] + 0.2, height - 0.005)
        across, back, color = (0.2, 0.0, 0.0), (0.0, -0.2, 0.0), (1.0, 0.97, 0.92)
        panels.append(Panel(corner, across, back, color, "glow", 2.0, 1.4, False))
    return Room(
        panels=tuple(panels),
        low=(-x, -y, 0.0),
        high=(x, y, height),
        light_direction=(-0.25, -0.42, 0.87),
        light_color=(0.30, 0.295, 0.285),
        ambient=(0.53, 0.54, 0.56),
        ambient_slopes=((-0.02, -0.02, -0.02), (-0.06, -0.06, -0.06), (0.18, 0.18, 0.18)),
        environment=((0.40, 0.40, 0.41), (0.05, 0.03, 0.025), (0.5, 0.5, 0.51)),
        exposure=1.0,
        window=((-2.8, -y, 0.0), (2.8, -y, 2.3), (7.0, 6.5, 5.8)),
        shadow_strength=0.8,
        occlusion_strength=0.6,
    )


def _door_frames(y: float) -> list[Panel]:
    """Return the white posts and rails of the sliding doors and of the windows next to them."""
    frame = {"color": (0.93, 0.94, 0.95), "texture": "smooth_plaster", "occluded": False}
    bars: list[Rect] = [(a - 0.035, a + 0.035, 0.0, 2.3) for a in (-2.8, -1.4, 0.0, 1.4, 2.8)]
    bars += [(-2.8, 2.8, 2.22, 2.3), (-2.8, 2.8, 0.0, 0.06)]
    for a, b in ((-4.4, -3.5), (3.5, 4.4)):
        bars += [(a, b, 0.9, 0.96), (a, a + 0.06, 0.25, 2.2), (b - 0.06, b, 0.25, 2.2)]
    panels: list[Panel] = []
    for a, b, c, d in bars:
        panels += _slab((a, y - 0.04, c), (b, y + 0.04, d), **frame)
    return panels


def _yard(y: float) -> list[Panel]:
    """Return a terrace, paving, a low brick wall, houses and an overcast sky behind the doors."""
    outside = {"occluded": False}
    wood, stone, brick = (0.80, 0.66, 0.54), (0.62, 0.62, 0.63), (0.60, 0.52, 0.45)
    panels = [
        Panel((-12, y - 1.2, -0.02), (24, 0, 0), (0, 1.25, 0), wood, "planks", 3.0, **outside),  # type: ignore[arg-type]
        Panel((-14, y - 9, -0.10), (28, 0, 0), (0, 7.8, 0), stone, "paving", 1.6, **outside),  # type: ignore[arg-type]
        Panel((14, y - 9, -0.1), (-28, 0, 0), (0, 0, 1.3), brick, "paving", 1.3, **outside),  # type: ignore[arg-type]
        Panel(
            (40, y - 16, -1), (-80, 0, 0), (0, 0, 22), (0.80, 0.83, 0.87), "glow", 2.0, 0.75, False
        ),
    ]
    for low, high, color in (
        ((-7.5, y - 13, 0.0), (-4.5, y - 10.5, 2.9), (0.80, 0.76, 0.42)),
        ((0.5, y - 14, 0.0), (8.5, y - 11, 2.3), (0.52, 0.51, 0.50)),
    ):
        panels += _slab(low, high, color=color, texture="plaster", tile=3.0, occluded=False)
    return panels


def _empty_room() -> Room:
    """Return a room that is a plain grey floor under even light."""
    floor = Panel(
        (-50, -50, 0), (100, 0, 0), (0, 100, 0), (0.62, 0.62, 0.62), "plaster", 3.0, 0.0, False
    )
    return Room(
        panels=(floor,),
        low=(-50.0, -50.0, 0.0),
        high=(50.0, 50.0, 100.0),
        light_direction=(0.35, 0.25, 0.9),
        light_color=(0.45, 0.45, 0.45),
        ambient=(0.6, 0.6, 0.6),
        ambient_slopes=((0.05, 0.05, 0.05), (-0.05, -0.05, -0.05), (0.15, 0.15, 0.15)),
        environment=((0.5, 0.5, 0.5), (0.2, 0.2, 0.2), (0.6, 0.6, 0.6)),
        exposure=0.85,
        background=(0.62, 0.66, 0.72),
    )


for _name, _room in (("box", _box_room()), ("bright", _bright_room()), ("empty", _empty_room())):
    rooms.register(_name)(_room)
