"""A scene as triangles: the room, what never moves, what moves, in this order.

The order lets the renderer draw and shade the first two once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.numerics.linear_algebra import apply, dot, norm, unit
from physion.numerics.rotations import rotation_matrices
from physion.physics.trajectory import Trajectory
from physion.rendering.geometry import F32, F64, I32, Part, sheet, solid
from physion.rendering.light import to_linear
from physion.rendering.paint import painted
from physion.rendering.rooms import Panel, Room
from physion.rendering.textures.atlas import Atlas, build_atlas, finish
from physion.scenes.scene import Look, Scene
from physion.scenes.shapes.primitives import shape


@dataclass(frozen=True)
class Piece:
    """Where one body or cloth lies in the arrays: vertices and triangles from..to."""

    part: Part
    vertices: slice
    triangles: slice
    index: int
    """Index in `Scene.names`; -1 for the room."""


@dataclass(frozen=True)
class Assembly:
    """All triangles of a scene. ``first_*`` is where the moving ones begin."""

    pieces: tuple[Piece, ...]
    faces: I32
    two_sided: NDArray[np.bool_]
    objects: I32
    surface: I32
    uv: F32
    tangents: F32
    material: I32
    materials: F64
    atlas: Atlas
    first_vertex: int
    first_triangle: int
    vertex_count: int
    room_triangles: int


class _Materials:
    """Rows of the material table, and which textures they use."""

    def __init__(self) -> None:
        self._rows: list[list[float]] = []
        self.textures: list[str] = []

    def add(self, look: Look, glow: float = 0.0, room: bool = False) -> int:
        """Add a row for ``look`` and return its index."""
        kind = finish(look.texture)
        if kind.texture not in self.textures:
            self.textures.append(kind.texture)
        row = [*look.color, self.textures.index(kind.texture), kind.gloss, kind.sharpness]
        self._rows.append([*row, kind.mirror, kind.metal, kind.relief, glow, float(room), 0.0])
        return len(self._rows) - 1

    def table(self) -> F64:
        """Return the rows as `physion.rendering.shading.shade` reads them: (M, 12)."""
        table = np.array(self._rows, np.float64)
        table[:, :3] = to_linear(table[:, :3])
        return table


def assemble(scene: Scene, room: Room) -> Assembly:
    """Collect the triangles of ``scene`` in ``room``."""
    materials = _Materials()
    parts: list[tuple[Part, int]] = [(_panels(room.panels, materials), -1)]
    still = [i for i, body in enumerate(scene.bodies) if body.kinematic or body.scenery]
    moving = [i for i in range(len(scene.bodies)) if i not in set(still)]
    for i in still + moving:
        body = scene.bodies[i]
        form = shape(body.shape)
        mesh = form.mesh
        part = solid(
            np.asarray(mesh.vertices, np.float64),
            np.asarray(mesh.faces, np.int32),
            np.asarray(body.scale),
            mesh.smooth,
            materials.add(body.look),
        )
        if body.name not in (scene.roles.agent, scene.roles.patient):
            part = painted(part, form, materials.add)
        parts.append((part, i))
    for i, cloth in enumerate(scene.cloths):
        parts.append((sheet(cloth.resolution, materials.add(cloth.look)), len(scene.bodies) + i))
    return _concatenate(parts, 1 + len(still), materials)


def _concatenate(parts: list[tuple[Part, int]], first: int, materials: _Materials) -> Assembly:
    pieces, vertex, triangle, surface = [], 0, 0, 0
    surfaces = []
    for part, index in parts:
        v, t = len(part.vertices), len(part.faces)
        pieces.append(Piece(part, slice(vertex, vertex + v), slice(triangle, triangle + t), index))
        surfaces.append(part.surfaces + surface)
        surface += int(part.surfaces.max(initial=-1)) + 1
        vertex, triangle = vertex + v, triangle + t
    counts = [len(part.faces) for part, _ in parts]
    end = pieces[first - 1]
    return Assembly(
        pieces=tuple(pieces),
        faces=np.concatenate([p.part.faces + np.int32(p.vertices.start) for p in pieces]),
        two_sided=np.repeat([part.two_sided for part, _ in parts], counts),
        objects=np.repeat(np.array([i + 1 for _, i in parts], np.int32), counts),
        surface=np.concatenate(surfaces).astype(np.int32),
        uv=np.concatenate([part.uv for part, _ in parts]),
        tangents=np.concatenate([part.tangents for part, _ in parts]),
        material=np.concatenate([part.materials for part, _ in parts]),
        materials=materials.table(),
        atlas=build_atlas(tuple(materials.textures)),
        first_vertex=end.vertices.stop,
        first_triangle=end.triangles.stop,
        vertex_count=vertex,
        room_triangles=len(parts[0][0].faces),
    )


def _panels(panels: tuple[Panel, ...], materials: _Materials) -> Part:
    """The room as one part in world coordinates, two triangles for each panel."""
    corner, u, v = (np.array([getattr(p, name) for p in panels]) for name in ("corner", "u", "v"))
    count = len(panels)
    quad = np.stack([corner, corner + u, corner + u + v, corner + v], axis=1)
    along = np.stack([unit(u), unit(v)], axis=1)
    tile = np.array([p.tile for p in panels])
    at = dot(quad[:, :, None], along[:, None]) / tile[:, None, None]
    index = np.array([0, 1, 2, 0, 2, 3])
    normal = np.cross(along[:, 0], along[:, 1])
    rows = [materials.add(Look(p.color, p.texture), p.glow, p.shaded) for p in panels]
    return Part(
        vertices=quad.reshape(-1, 3),
        faces=(4 * np.arange(count)[:, None] + index).reshape(-1, 3).astype(np.int32),
        normals=np.repeat(np.tile(normal, (1, 3)), 2, axis=0).astype(np.float32),
        uv=at[:, index].reshape(2 * count, 6).astype(np.float32),
        tangents=np.repeat(along.reshape(count, 6), 2, axis=0).astype(np.float32),
        surfaces=np.repeat(np.arange(count, dtype=np.int32), 2),
        materials=np.repeat(np.array(rows, np.int32), 2),
    )


def place(
    assembly: Assembly, scene: Scene, trajectory: Trajectory, frame: int, moving: bool
) -> tuple[F64, F32]:
    """Return world vertices (V, 3) and corner normals (T, 9) of one frame.

    Only the moving pieces, or only the others; the rest of the arrays is zero.
    """
    vertices = np.zeros((assembly.vertex_count, 3))
    normals = np.zeros((len(assembly.faces), 9), np.float32)
    bodies, offset = len(scene.bodies), 0
    turns = rotation_matrices(trajectory.rotations[frame])
    for piece in assembly.pieces:
        part, index = piece.part, piece.index
        is_moving = piece.vertices.start >= assembly.first_vertex
        size = len(part.vertices)
        if is_moving == moving and index < 0:
            vertices[piece.vertices], normals[piece.triangles] = part.vertices, part.normals
        elif is_moving == moving and index < bodies:
            at = trajectory.positions[frame, index].astype(np.float64)
            vertices[piece.vertices] = apply(turns[index], part.vertices) + at
            turned = apply(turns[index], part.normals.reshape(-1, 3))
            normals[piece.triangles] = turned.reshape(-1, 9)
        elif is_moving == moving:
            cloth = trajectory.cloth_vertices[frame, offset : offset + size].astype(np.float64)
            vertices[piece.vertices] = cloth
            normals[piece.triangles] = _sheet_normals(cloth)
        if index >= bodies:
            offset += size
    return vertices, normals


def _sheet_normals(vertices: F64) -> F32:
    """Return corner normals (T, 9) of a square sheet: means by area over the triangles there.

    The triangles are those of `sheet`: all that lie left of the diagonals, then all others.
    """
    side = math.isqrt(len(vertices))
    p = vertices.reshape(side, side, 3)
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    left, right = np.cross(b - a, c - a), np.cross(c - a, d - a)
    total = np.zeros_like(p)
    total[:-1, :-1] += left + right
    total[1:, :-1] += left
    total[1:, 1:] += left + right
    total[:-1, 1:] += right
    length = norm(total)[..., None]
    n = np.where(length > 0, total / np.where(length > 0, length, 1.0), (0.0, 0.0, 1.0))
    a, b, c, d = n[:-1, :-1], n[1:, :-1], n[1:, 1:], n[:-1, 1:]
    corners = [np.concatenate([a, b, c], -1), np.concatenate([a, c, d], -1)]
    return np.concatenate([x.reshape(-1, 9) for x in corners]).astype(np.float32)
