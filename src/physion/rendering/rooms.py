"""Rooms in which trials are shown: their surfaces and their light.

A room is a handful of large rectangles that face inwards, its floor at z = 0. It is drawn only:
nothing collides with its walls.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from physion.registry import Registry
from physion.scenes.scene import Vec3

Rect = tuple[float, float, float, float]


@dataclass(frozen=True)
class Panel:
    """A rectangle from ``corner`` along ``u`` and ``v`` (metres); it faces ``u`` x ``v``.

    ``tile`` is how many metres one texture spans; ``glow`` is light of its own, as a multiple of
    its colour.
    """

    corner: Vec3
    u: Vec3
    v: Vec3
    color: Vec3
    texture: str = "smooth_plaster"
    tile: float = 2.0
    glow: float = 0.0
    shaded: bool = True


@dataclass(frozen=True)
class Room:
    """Panels and light; see `physion.rendering.shading.Light` for the terms of the light."""

    panels: tuple[Panel, ...]
    low: Vec3
    high: Vec3
    lamp_direction: Vec3
    lamp: Vec3
    around: tuple[Vec3, Vec3, Vec3, Vec3]
    mirrored: tuple[Vec3, Vec3, Vec3]
    exposure: float
    background: Vec3 = (0.8, 0.85, 0.9)
    shadow: float = 0.8
    contact: float = 0.6


rooms: Registry[Room] = Registry("room")


def _wall(
    corner: Vec3, u: Vec3, v: Vec3, openings: Sequence[Rect], **look: object
) -> Iterator[Panel]:
    """A wall with rectangular openings (u from, u to, v from, v to), in metres along u and v."""
    start, du, dv = (np.asarray(x, np.float64) for x in (corner, u, v))
    width, height = np.linalg.norm(du), np.linalg.norm(dv)
    du, dv = du / width, dv / height
    across = sorted({0.0, float(width), *(x for o in openings for x in o[:2])})
    upward = sorted({0.0, float(height), *(y for o in openings for y in o[2:])})
    for a, b in zip(across, across[1:], strict=False):
        for c, d in zip(upward, upward[1:], strict=False):
            if any(o[0] <= a and b <= o[1] and o[2] <= c and d <= o[3] for o in openings):
                continue
            yield Panel(
                _vec(start + a * du + c * dv), _vec((b - a) * du), _vec((d - c) * dv), **look  # type: ignore[arg-type]
            )


def _vec(value: np.ndarray) -> Vec3:
    return (float(value[0]), float(value[1]), float(value[2]))


def _reveal(
    corner: Vec3, u: Vec3, v: Vec3, opening: Rect, depth: float, **look: object
) -> Iterator[Panel]:
    """The four sides of an opening through a wall ``depth`` metres thick."""
    start, du, dv = (np.asarray(x, np.float64) for x in (corner, u, v))
    du, dv = du / np.linalg.norm(du), dv / np.linalg.norm(dv)
    back = -depth * np.cross(du, dv)
    a, b, c, d = opening
    p = [start + x * du + y * dv for x, y in ((a, c), (b, c), (b, d), (a, d))]
    for i in range(4):
        side = p[(i + 1) % 4] - p[i]
        yield Panel(_vec(p[i]), _vec(side), _vec(back), **look)  # type: ignore[arg-type]


def _slab(low: Vec3, high: Vec3, **look: object) -> Iterator[Panel]:
    """A box that faces outwards: a beam, a post, a step."""
    a, b = np.asarray(low, np.float64), np.asarray(high, np.float64)
    x, y, z = np.diag(b - a)
    for corner, u, v in (
        (a, y, x), (a, x, z), (a, z, y), (b, -x, -y), (b, -z, -x), (b, -y, -z),
    ):  # fmt: skip
        yield Panel(_vec(corner), _vec(u), _vec(v), **look)  # type: ignore[arg-type]


def _four_walls(half_x: float, half_y: float, height: float) -> list[tuple[Vec3, Vec3, Vec3]]:
    """Corner, u and v of the walls at -x, +x, -y and +y; u x v points into the room."""
    x, y, h = half_x, half_y, (0.0, 0.0, height)
    return [
        ((-x, -y, 0.0), (0.0, 2 * y, 0.0), h),
        ((x, y, 0.0), (0.0, -2 * y, 0.0), h),
        ((x, -y, 0.0), (-2 * x, 0.0, 0.0), h),
        ((-x, y, 0.0), (2 * x, 0.0, 0.0), h),
    ]


def _box_room() -> Room:
    """Grey plaster, dark blue carpet, small high windows; a coffered ceiling."""
    half, height = 6.5, 4.6
    plaster = {"color": (0.69, 0.69, 0.735), "texture": "plaster", "tile": 3.0}
    panels: list[Panel] = [
        Panel((-half, -half, 0), (2 * half, 0, 0), (0, 2 * half, 0), (0.235, 0.30, 0.44), "carpet", 1.3),
    ]
    windows = {0: [(3.0, 4.3), (5.6, 6.9)], 2: [(6.2, 7.5), (8.8, 10.1)], 1: [], 3: [(2.9, 4.2)]}
    for index, (corner, u, v) in enumerate(_four_walls(half, half, height)):
        openings = [(a, b, 2.75, 3.65) for a, b in windows[index]]
        panels += _wall(corner, u, v, openings, **plaster)
        for opening in openings:
            panels += _reveal(corner, u, v, opening, 0.35, color=(0.66, 0.66, 0.68))
            panels.append(_pane(corner, u, v, opening, 0.35, (0.88, 0.89, 0.93), 0.85))
    beam = {"color": (0.42, 0.41, 0.40), "texture": "smooth_plaster"}
    inner, rise = half - 1.1, 0.35
    ceiling = height + rise
    panels.append(
        Panel((-inner, inner, ceiling), (2 * inner, 0, 0), (0, -2 * inner, 0), (0.75, 0.75, 0.74))
    )
    for corner, u, v in _four_walls(inner, inner, rise):
        panels.append(Panel((corner[0], corner[1], height), u, v, (0.72, 0.72, 0.71)))
    panels += _wall((-half, half, height), (2 * half, 0, 0), (0, -2 * half, 0),
                    [(1.1, 2 * half - 1.1, 1.1, 2 * half - 1.1)], **beam)  # fmt: skip
    for y in (-1.9, 1.9):
        panels += _slab((-inner, y - 0.18, height), (inner, y + 0.18, ceiling), **beam)
    return Room(
        panels=tuple(panels),
        low=(-half, -half, 0.0),
        high=(half, half, height),
        lamp_direction=(0.30, 0.22, 0.93),
        lamp=(0.42, 0.42, 0.42),
        around=((0.62, 0.62, 0.64), (0.10, 0.10, 0.10), (-0.07, -0.07, -0.07), (0.16, 0.16, 0.15)),
        mirrored=((0.06, 0.07, 0.10), (0.42, 0.42, 0.45), (0.55, 0.55, 0.56)),
        exposure=0.80,
        shadow=0.75,
    )


def _pane(
    corner: Vec3, u: Vec3, v: Vec3, opening: Rect, depth: float, color: Vec3, glow: float
) -> Panel:
    """What is seen through an opening: a plane of light behind it."""
    start, du, dv = (np.asarray(x, np.float64) for x in (corner, u, v))
    du, dv = du / np.linalg.norm(du), dv / np.linalg.norm(dv)
    a, b, c, d = opening
    at = start + a * du + c * dv - depth * np.cross(du, dv)
    return Panel(_vec(at), _vec((b - a) * du), _vec((d - c) * dv), color, "glow", 2.0, glow, False)


def _bright_room() -> Room:
    """Reddish stone tiles, white walls, glass doors on a yard."""
    half_x, half_y, height = 6.5, 5.5, 3.3
    white = {"color": (0.86, 0.86, 0.88), "texture": "smooth_plaster", "tile": 3.0}
    panels: list[Panel] = [
        Panel((-half_x, -half_y, 0), (2 * half_x, 0, 0), (0, 2 * half_y, 0), (1, 1, 1), "tiles", 2.4),
        Panel((-half_x, half_y, height), (2 * half_x, 0, 0), (0, -2 * half_y, 0), (0.84, 0.84, 0.85)),
    ]
    doors: dict[int, list[Rect]] = {
        0: [(2.2, 8.0, 0.0, 2.25), (9.0, 9.9, 0.5, 2.1)],
        1: [],
        2: [(2.5, 3.5, 0.0, 2.1), (8.6, 10.4, 0.9, 2.1)],
        3: [(8.0, 9.0, 0.0, 2.1)],
    }
    walls = _four_walls(half_x, half_y, height)
    for index, (corner, u, v) in enumerate(walls):
        panels += _wall(corner, u, v, doors[index], **white)
        for opening in doors[index]:
            panels += _reveal(corner, u, v, opening, 0.25, color=(0.8, 0.8, 0.8))
    for index, opening in ((2, doors[2][0]), (3, doors[3][0])):
        panels.append(_pane(*walls[index], opening, 0.2, (0.66, 0.66, 0.68), 0.35))
    panels.append(_pane(*walls[2], doors[2][1], 0.25, (0.80, 0.86, 0.90), 0.75))
    x = -half_x - 0.25
    frame = {"color": (0.82, 0.83, 0.84), "texture": "smooth_plaster", "shaded": False}
    for y in (-3.3, -1.85, -0.4, 1.05, 2.42):
        panels += _slab((x + 0.05, y - 0.05, 0.0), (x + 0.13, y + 0.05, 2.25), **frame)
    panels += _slab((x + 0.05, -3.3, 2.15), (x + 0.13, 2.5, 2.25), **frame)
    panels += _slab((x + 0.05, -3.3, 0.0), (x + 0.13, 2.5, 0.06), **frame)
    panels += _yard(x)
    panels += _slab((-half_x, -half_y, 2.75), (half_x, -half_y + 1.2, height), **white)
    panels += _slab((2.6, half_y - 0.5, 0.0), (3.6, half_y, height), **white)
    panels += _slab((half_x - 0.4, -1.2, 0.0), (half_x, 0.3, height), **white)
    for x0 in (-3.0, 0.0, 3.0):
        for y0 in (-2.0, 2.0):
            panels.append(Panel((x0, y0 + 0.22, height - 0.005), (0.22, 0, 0), (0, -0.22, 0),
                                (1, 0.97, 0.92), "glow", 2.0, 1.4, False))  # fmt: skip
    return Room(
        panels=tuple(panels),
        low=(-half_x, -half_y, 0.0),
        high=(half_x, half_y, height),
        lamp_direction=(-0.42, -0.10, 0.90),
        lamp=(0.50, 0.49, 0.47),
        around=((0.74, 0.74, 0.75), (-0.10, -0.10, -0.11), (-0.04, -0.04, -0.04), (0.10, 0.11, 0.12)),
        mirrored=((0.12, 0.08, 0.07), (0.62, 0.62, 0.64), (0.75, 0.75, 0.76)),
        exposure=0.84,
        shadow=0.7,
    )


def _yard(x: float) -> list[Panel]:
    """Paving, a low wall, a house front and the sky outside the glass doors."""
    yard = {"glow": 0.75, "shaded": False}
    panels = [
        Panel((x - 7, -12, -0.02), (7, 0, 0), (0, 24, 0), (0.78, 0.77, 0.75), "paving", 2.5, **yard),  # type: ignore[arg-type]
        Panel((x - 7, -12, -0.02), (0, 24, 0), (0, 0, 1.1), (0.62, 0.52, 0.46), "paving", 1.6, **yard),  # type: ignore[arg-type]
        Panel((x - 9, -4, 0.5), (0, 9, 0), (0, 0, 2.2), (0.80, 0.74, 0.55), "plaster", 4.0, **yard),  # type: ignore[arg-type]
        Panel((x - 9.1, -40, -1), (0, 80, 0), (0, 0, 20), (0.78, 0.83, 0.88), "glow", 2.0, 0.95, False),
    ]
    return panels


def _empty_room() -> Room:
    """A plain grey floor and nothing else, under even light."""
    floor = Panel((-50, -50, 0), (100, 0, 0), (0, 100, 0), (0.62, 0.62, 0.62), "plaster", 3.0, 0.0, False)
    return Room(
        panels=(floor,),
        low=(-50.0, -50.0, 0.0),
        high=(50.0, 50.0, 100.0),
        lamp_direction=(0.35, 0.25, 0.9),
        lamp=(0.45, 0.45, 0.45),
        around=((0.6, 0.6, 0.6), (0.05, 0.05, 0.05), (-0.05, -0.05, -0.05), (0.15, 0.15, 0.15)),
        mirrored=((0.2, 0.2, 0.2), (0.5, 0.5, 0.5), (0.6, 0.6, 0.6)),
        exposure=0.85,
        background=(0.62, 0.66, 0.72),
    )


for _name, _room in (("box", _box_room()), ("bright", _bright_room()), ("empty", _empty_room())):
    rooms.register(_name)(_room)
