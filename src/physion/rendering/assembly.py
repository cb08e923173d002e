"""A scene as triangles: the room, what never moves, what moves, in this order.

The order lets the renderer draw and shade the first two once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.physics.trajectory import Trajectory
from physion.rendering.geometry import F32, F64, I32, Part, sheet, solid
from physion.rendering.kernel import kernel
from physion.rendering.rooms import Panel, Room
from physion.rendering.shading import to_linear
from physion.rendering.textures import Atlas, build_atlas, finish
from physion.scenes.scene import Look, Scene
from physion.scenes.shapes import shape


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
        self.rows: list[list[float]] = []
        self.textures: list[str] = []

    def add(self, look: Look, glow: float = 0.0, room: bool = False) -> int:
        kind = finish(look.texture)
        if kind.texture not in self.textures:
            self.textures.append(kind.texture)
        row = [*to_linear(look.color), self.textures.index(kind.texture), kind.gloss]
        row += [kind.sharpness, kind.mirror, kind.metal, kind.relief, glow, float(room), 0.0]
        self.rows.append([float(value) for value in row])
        return len(self.rows) - 1


def assemble(scene: Scene, room: Room) -> Assembly:
    """Collect the triangles of ``scene`` in ``room``."""
    materials = _Materials()
    parts: list[tuple[Part, int]] = [(_panels(room.panels, materials), -1)]
    still = [i for i, body in enumerate(scene.bodies) if body.kinematic or body.scenery]
    moving = [i for i in range(len(scene.bodies)) if i not in set(still)]
    for i in still + moving:
        body = scene.bodies[i]
        mesh = shape(body.shape).mesh
        parts.append(
            (
                solid(
                    np.asarray(mesh.vertices, np.float64),
                    np.asarray(mesh.faces, np.int32),
                    np.asarray(body.scale),
                    mesh.smooth,
                    materials.add(body.look),
                ),
                i,
            )
        )
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
        materials=np.array(materials.rows),
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
    along = np.stack([a / np.linalg.norm(a, axis=1, keepdims=True) for a in (u, v)], axis=1)
    tile = np.array([p.tile for p in panels])
    at = np.einsum("pqk,pak->pqa", quad, along) / tile[:, None, None]
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
    """World vertices (V, 3) and corner normals (T, 9) of one frame.

    Only the moving pieces, or only the others; the rest of the arrays is zero.
    """
    vertices = np.zeros((assembly.vertex_count, 3))
    normals = np.zeros((len(assembly.faces), 9), np.float32)
    bodies, offset = len(scene.bodies), 0
    for piece in assembly.pieces:
        part, index = piece.part, piece.index
        is_moving = piece.vertices.start >= assembly.first_vertex
        size = len(part.vertices)
        if is_moving == moving and index < 0:
            vertices[piece.vertices], normals[piece.triangles] = part.vertices, part.normals
        elif is_moving == moving and index < bodies:
            rotation = rotation_matrix(trajectory.rotations[frame, index])
            at = trajectory.positions[frame, index].astype(np.float64)
            _move(
                part.vertices,
                part.normals,
                rotation,
                at,
                vertices[piece.vertices],
                normals[piece.triangles],
            )
        elif is_moving == moving:
            cloth = trajectory.cloth_vertices[frame, offset : offset + size].astype(np.float64)
            vertices[piece.vertices] = cloth
            _sheet_normals(cloth, part.faces, normals[piece.triangles])
        if index >= bodies:
            offset += size
    return vertices, normals


def rotation_matrix(quaternion: NDArray[np.floating]) -> F64:
    """Rotation (3, 3) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = (float(q) for q in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@kernel
def _move(
    vertices: F64, normals: F32, rotation: F64, position: F64, out: F64, out_normals: F32
) -> None:
    """Rotate and move vertices (V, 3); rotate corner normals (T, 9)."""
    for i in range(vertices.shape[0]):
        for k in range(3):
            out[i, k] = (
                rotation[k, 0] * vertices[i, 0]
                + rotation[k, 1] * vertices[i, 1]
                + rotation[k, 2] * vertices[i, 2]
                + position[k]
            )
    for i in range(normals.shape[0]):
        for c in range(0, 9, 3):
            for k in range(3):
                out_normals[i, c + k] = (
                    rotation[k, 0] * normals[i, c]
                    + rotation[k, 1] * normals[i, c + 1]
                    + rotation[k, 2] * normals[i, c + 2]
                )


@kernel
def _sheet_normals(vertices: F64, faces: I32, out: F32) -> None:
    """Corner normals (T, 9) of a sheet: means over the triangles at a vertex, by area."""
    total = np.zeros((vertices.shape[0], 3))
    for t in range(faces.shape[0]):
        i, j, k = faces[t, 0], faces[t, 1], faces[t, 2]
        ax, bx = vertices[j, 0] - vertices[i, 0], vertices[k, 0] - vertices[i, 0]
        ay, by = vertices[j, 1] - vertices[i, 1], vertices[k, 1] - vertices[i, 1]
        az, bz = vertices[j, 2] - vertices[i, 2], vertices[k, 2] - vertices[i, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for c in range(3):
            total[faces[t, c], 0] += nx
            total[faces[t, c], 1] += ny
            total[faces[t, c], 2] += nz
    for t in range(faces.shape[0]):
        for c in range(3):
            i = faces[t, c]
            nx, ny, nz = total[i, 0], total[i, 1], total[i, 2]
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length == 0.0:
                nx, ny, nz, length = 0.0, 0.0, 1.0, 1.0
            out[t, 3 * c] = nx / length
            out[t, 3 * c + 1] = ny / length
            out[t, 3 * c + 2] = nz / length
