"""A scene as triangles: the meshes of its bodies, and all of them in one order.

First comes the room, then the bodies that never move, then those that move. The order lets the
renderer draw and shade the first two once for all frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import arccos, cos
from physion.numerics.kernel import in_place_kernel
from physion.numerics.linear_algebra import cross, dot, norm, unit
from physion.numerics.rotations import rotation_matrices
from physion.physics.trajectory import Trajectory
from physion.rendering.light import to_linear
from physion.rendering.rasterizer import MATERIAL, Records
from physion.rendering.rooms import Panel, Room
from physion.rendering.textures.atlas import Finish, finish
from physion.scenes.scene import Look, Scene
from physion.scenes.shapes.primitives import Shape, shape
from physion.scenes.shapes.prop_shapes import PropShape

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I32 = NDArray[np.int32]

ROOM = -1
"""Object index of the room."""
FLAT = np.radians(1.0)
"""Angle in radians below which triangles that meet at an edge lie in one flat face."""
UV_MARGIN = 0.002
"""Distance in texture coordinates that a bounding box keeps from the seam of its texture."""
UV_SPAN = 0.996
"""Part of the texture that it therefore spans: 1 - 2 `UV_MARGIN`."""


# Meshes ready to be drawn: corner normals, texture coordinates, smooth surfaces.


@dataclass(frozen=True)
class MeshPart:
    """One mesh in the axes of its body. V vertices, T triangles.

    - ``vertices`` (V, 3): metres. ``faces`` (T, 3): counter-clockwise seen from outside.
    - ``normals`` (T, 3, 3): unit normal of each corner.
    - ``uv`` (T, 3, 2): texture coordinates of each corner; the texture repeats every unit.
    - ``tangents`` (T, 2, 3): world directions of growing u and v; zero without a normal map.
    - ``groups`` (T,): triangles of one number make one smooth surface, so that a pixel that shows
      several of them is shaded once.
    - ``materials`` (T,): index of the material.
    - ``two_sided``: whether the back of the triangles is drawn too.
    """

    vertices: F64
    faces: I32
    normals: F32
    uv: F32
    tangents: F32
    groups: I32
    materials: I32
    two_sided: bool = False


def face_normals(vertices: F64, faces: I32) -> F64:
    """Return the unit normals (T, 3); zero for a triangle without area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = norm(cross)[:, None]
    return np.asarray(np.divide(cross, length, out=np.zeros_like(cross), where=length > 0))


@dataclass(frozen=True)
class Surface:
    """Mesh of a shape at unit scale, with what does not depend on the scale.

    - ``vertices`` (V, 3), ``faces`` (T, 3), ``groups`` (T,), ``uv`` (T, 3, 2): as in `MeshPart`.
    - ``corners`` (3 T,): corners of one number belong to one vertex of one smooth surface.
    """

    vertices: F64
    faces: I32
    groups: I32
    uv: F32
    corners: NDArray[np.intp]


def surface(vertices: F64, faces: I32, crease: float) -> Surface:
    """Return the surface of a mesh (V, 3), (T, 3).

    ``crease``: angle in radians below which triangles that meet at an edge form one smooth surface.
    """
    unit, faces = _merge(np.asarray(vertices, np.float64), np.asarray(faces, np.int32))
    groups = _smooth_groups(faces, face_normals(unit, faces), cos(max(crease, FLAT)))
    key = faces.astype(np.int64) + len(unit) * groups[:, None].astype(np.int64)
    _, corners = np.unique(key.ravel(), return_inverse=True)
    return Surface(unit, faces, groups, _box_uv(unit, faces), corners)


def solid(surface: Surface, scale: F64, material: int) -> MeshPart:
    """Return the mesh of a body in metres.

    Parameters
    ----------
    surface
        Of its shape.
    scale
        (3,) factors along the axes of the body.
    material
        Index of the material of all triangles.

    Notes
    -----
    The normal of a corner is the mean of the normals of the triangles of its surface that meet
    there, weighted by their angles (Thurmer and Wuthrich 1998). Texture coordinates are taken
    before scaling, from the side of the unit box that a triangle faces. A texture therefore
    stretches with its body, as in the original stimuli.

    References
    ----------
    Thurmer, G. and Wuthrich, C. (1998). Computing vertex normals from polygonal facets. Journal of
        Graphics Tools 3(1).
    """
    faces, corner_index = surface.faces, surface.corners
    scaled = surface.vertices * scale
    normals = face_normals(scaled, faces)
    angles = _corner_angles(scaled, faces).reshape(-1, 1)
    weighted = np.repeat(normals, 3, axis=0) * angles
    total = np.zeros((int(corner_index.max()) + 1, 3))
    np.add.at(total, corner_index, weighted)
    corner = total[corner_index]
    length = norm(corner)[:, None]
    flat = np.repeat(normals, 3, axis=0)
    corner = np.where(length > 1e-12, corner / np.maximum(length, 1e-12), flat)
    count = len(faces)
    return MeshPart(
        vertices=scaled,
        faces=faces,
        normals=corner.reshape(count, 3, 3).astype(np.float32),
        uv=surface.uv,
        tangents=np.zeros((count, 2, 3), np.float32),
        groups=surface.groups,
        materials=np.full(count, material, np.int32),
    )


def sheet(resolution: int, material: int) -> MeshPart:
    """Return a cloth of ``resolution`` x ``resolution`` vertices, which each frame fills in."""
    index = np.arange(resolution * resolution, dtype=np.int32).reshape(resolution, resolution)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    u, v = np.divmod(faces, resolution)
    count = len(faces)
    return MeshPart(
        vertices=np.zeros((resolution * resolution, 3)),
        faces=faces,
        normals=np.zeros((count, 3, 3), np.float32),
        uv=(np.stack([u, v], -1) / (resolution - 1)).astype(np.float32),
        tangents=np.zeros((count, 2, 3), np.float32),
        groups=np.zeros(count, np.int32),
        materials=np.full(count, material, np.int32),
        two_sided=True,
    )


def _merge(vertices: F64, faces: I32) -> tuple[F64, I32]:
    """Join vertices at the same position (to a micrometre); drop triangles that become lines."""
    _, first, inverse = np.unique(
        np.round(vertices, 6), axis=0, return_index=True, return_inverse=True
    )
    merged = inverse.reshape(-1)[faces].astype(np.int32)
    kept = (
        (merged[:, 0] != merged[:, 1])
        & (merged[:, 1] != merged[:, 2])
        & (merged[:, 2] != merged[:, 0])
    )
    return vertices[first], np.ascontiguousarray(merged[kept])


def _smooth_groups(faces: I32, normals: F64, threshold: float) -> I32:
    """Return the smooth surface (T,) of each triangle.

    Two triangles with a common edge belong together if the cosine of the angle between their
    ``normals`` exceeds ``threshold``.
    """
    count = len(faces)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(count), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    a, b = owner[:-1][same], owner[1:][same]
    soft = dot(normals[a], normals[b]) > threshold
    return _components(count, a[soft], b[soft])


def _components(count: int, a: NDArray[np.intp], b: NDArray[np.intp]) -> I32:
    """Return the connected component of each of ``count`` nodes joined by the pairs (a, b).

    Every node takes the smallest label among its neighbours, then its label's label, until
    nothing changes.
    """
    label = np.arange(count)
    while True:
        before = label.copy()
        smaller = np.minimum(label[a], label[b])
        np.minimum.at(label, label[a], smaller)
        np.minimum.at(label, label[b], smaller)
        label = label[label]
        if (label == before).all():
            return np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int32)


def _corner_angles(vertices: F64, faces: I32) -> F64:
    """Return the angle in radians of each corner of each triangle, (T, 3)."""
    corners = vertices[faces]
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    scale = norm(ahead) * norm(behind)
    cosine = dot(ahead, behind) / np.maximum(scale, 1e-300)
    return arccos(np.clip(cosine, -1.0, 1.0))


def _box_uv(unit: F64, faces: I32) -> F32:
    """Return texture coordinates (T, 3, 2) in 0..1 on the side of the bounding box they face."""
    low, size = unit.min(axis=0), np.ptp(unit, axis=0)
    relative = (unit - low) / np.where(size > 0, size, 1.0)
    relative = UV_MARGIN + UV_SPAN * relative
    axis = np.abs(face_normals(unit, faces)).argmax(axis=1)
    # v, the direction of the grain, is z on the sides and x on top, as on an upright plank.
    pairs = np.array([[1, 2], [0, 2], [1, 0]])[axis]
    corners = relative[faces]
    return np.take_along_axis(corners, pairs[:, None, :].repeat(3, 1), axis=2).astype(np.float32)


# Colours of a prop's own parts: shades, flower pots, the sea of a globe.
#
# Agent and patient are never painted: their one colour tells which they are.


def painted(part: MeshPart, shape: Shape, add: Callable[[Look], int]) -> MeshPart:
    """Return a mesh with the materials of the prop's own parts; other shapes stay as they are.

    Parameters
    ----------
    part
        The mesh of ``shape``, all of one material.
    shape
        The shape of the body.
    add
        Takes a look and returns the index of its material.

    Notes
    -----
    Triangles of two materials become two surfaces. A pixel that shows both is then shaded for
    each, and the edge between them is anti-aliased.
    """
    if not (isinstance(shape, PropShape) and shape.own_looks):
        return part
    assert len(shape.paint) == len(part.faces), "a prop has no triangle without area"
    rows = np.array([part.materials[0], *(add(look) for look in shape.own_looks)], np.int32)
    pairs = part.groups.astype(np.int64) * len(rows) + shape.paint
    groups = np.unique(pairs, return_inverse=True)[1].reshape(-1).astype(np.int32)
    return replace(part, materials=rows[shape.paint], groups=groups)


# The scene as a whole: all meshes in one order, posed in every frame.


@dataclass(frozen=True)
class MeshInstance:
    """One body, one cloth or the room in the arrays of an `Assembly`.

    ``vertices`` and ``triangles`` are its ranges; ``index`` is its index in `Scene.names`, or
    `ROOM`.
    """

    part: MeshPart
    vertices: slice
    triangles: slice
    index: int


@dataclass(frozen=True)
class Assembly:
    """All triangles of a scene. T triangles.

    - ``instances``: the meshes, in the order of the arrays.
    - ``faces`` (T, 3), ``two_sided`` (T,), ``uv`` (T, 3, 2), ``tangents`` (T, 2, 3), ``groups``
      (T,), ``material`` (T,): as in `MeshPart`, with indices into all vertices, all surfaces and
      ``materials``.
    - ``object_ids`` (T,): 0 is the room, i + 1 the i-th of `Scene.names`.
    - ``materials``, ``textures``: surface materials, and the names of their textures.
    - ``first_vertex``, ``first_triangle``: where the moving ones begin.
    - ``vertex_count``: all vertices. ``room_triangles``: triangles of the room, the first ones.
    """

    instances: tuple[MeshInstance, ...]
    faces: I32
    two_sided: NDArray[np.bool_]
    object_ids: I32
    groups: I32
    uv: F32
    tangents: F32
    material: I32
    materials: Records
    textures: tuple[str, ...]
    first_vertex: int
    first_triangle: int
    vertex_count: int
    room_triangles: int


class _MaterialTable:
    """Different surface materials in the order in which they were added, and their textures."""

    def __init__(self) -> None:
        self._rows: dict[tuple[Look, float, bool], int] = {}
        self._colors: list[tuple[float, float, float]] = []
        self._finishes: list[Finish] = []
        self._emission: list[float] = []
        self._occluded: list[bool] = []
        self.textures: list[str] = []

    def add(self, look: Look, emission: float = 0.0, occluded: bool = False) -> int:
        """Add the material of a look, unless it is there, and return its index."""
        key = (look, emission, occluded)
        if key in self._rows:
            return self._rows[key]
        self._rows[key] = len(self._rows)
        kind = finish(look.texture)
        if kind.texture not in self.textures:
            self.textures.append(kind.texture)
        self._colors.append(look.color)
        self._finishes.append(kind)
        self._emission.append(emission)
        self._occluded.append(occluded)
        return self._rows[key]

    def materials(self) -> Records:
        """Return all materials (M,) of `physion.rendering.rasterizer.MATERIAL`."""
        table = np.zeros(len(self._colors), MATERIAL)
        table["color"] = to_linear(self._colors)
        table["emission"], table["occluded"] = self._emission, self._occluded
        for row, kind in enumerate(self._finishes):
            table["texture"][row] = self.textures.index(kind.texture)
            for name in ("specular", "exponent", "reflectance", "metalness", "normal_scale"):
                table[name][row] = getattr(kind, name)
        return table


def assemble(scene: Scene, room: Room) -> Assembly:
    """Return the triangles of a scene in a room."""
    table = _MaterialTable()
    parts: list[tuple[MeshPart, int]] = [(_room_part(room.panels, table), ROOM)]
    changing = {event.body for event in scene.events}
    static = [
        i
        for i, body in enumerate(scene.bodies)
        if (body.kinematic or body.scenery) and body.name not in changing
    ]
    moving = [i for i in range(len(scene.bodies)) if i not in set(static)]
    for i in static + moving:
        body = scene.bodies[i]
        bare = _bare_mesh(body.shape, tuple(body.scale))
        part = replace(bare, materials=np.full(len(bare.faces), table.add(body.look), np.int32))
        if body.name not in (scene.roles.agent, scene.roles.patient):
            part = painted(part, shape(body.shape), table.add)
        parts.append((part, i))
    for i, cloth in enumerate(scene.cloths):
        parts.append((sheet(cloth.resolution, table.add(cloth.look)), len(scene.bodies) + i))
    return _concatenate(parts, 1 + len(static), table)


@lru_cache(maxsize=64)
def _bare_mesh(name: str, scale: tuple[float, ...]) -> MeshPart:
    """Return the mesh of a shape, of the first material; scenes share it, so it is not changed."""
    return solid(surface_of(name), np.asarray(scale), 0)


@lru_cache(maxsize=256)
def surface_of(name: str) -> Surface:
    """Return the surface of a shape, which all its sizes share."""
    mesh = shape(name).mesh
    return surface(mesh.vertices, mesh.faces, mesh.smooth)


def _concatenate(
    parts: list[tuple[MeshPart, int]], first_moving: int, table: _MaterialTable
) -> Assembly:
    """Return the parts (mesh, object index) as one assembly; those from ``first_moving`` move."""
    instances, vertex, triangle, group = [], 0, 0, 0
    groups = []
    for part, index in parts:
        vertices = slice(vertex, vertex + len(part.vertices))
        triangles = slice(triangle, triangle + len(part.faces))
        instances.append(MeshInstance(part, vertices, triangles, index))
        groups.append(part.groups + group)
        group += int(part.groups.max(initial=-1)) + 1
        vertex, triangle = vertices.stop, triangles.stop
    counts = [len(part.faces) for part, _ in parts]
    last_static = instances[first_moving - 1]
    return Assembly(
        instances=tuple(instances),
        faces=np.concatenate([i.part.faces + np.int32(i.vertices.start) for i in instances]),
        two_sided=np.repeat([part.two_sided for part, _ in parts], counts),
        object_ids=np.repeat(np.array([i + 1 for _, i in parts], np.int32), counts),
        groups=np.concatenate(groups).astype(np.int32),
        uv=np.concatenate([part.uv for part, _ in parts]),
        tangents=np.concatenate([part.tangents for part, _ in parts]),
        material=np.concatenate([part.materials for part, _ in parts]),
        materials=table.materials(),
        textures=tuple(table.textures),
        first_vertex=last_static.vertices.stop,
        first_triangle=last_static.triangles.stop,
        vertex_count=vertex,
        room_triangles=len(parts[0][0].faces),
    )


def _room_part(panels: tuple[Panel, ...], table: _MaterialTable) -> MeshPart:
    """Return the room as one mesh in the world, two triangles for each panel."""
    materials = [table.add(Look(p.color, p.texture), p.emission, p.occluded) for p in panels]
    return replace(_bare_room(panels), materials=np.repeat(np.array(materials, np.int32), 2))


@lru_cache(maxsize=16)
def _bare_room(panels: tuple[Panel, ...]) -> MeshPart:
    """Return the mesh of a room, of the first material; scenes share it, so it is not changed."""
    corner, u, v = (np.array([getattr(p, name) for p in panels]) for name in ("corner", "u", "v"))
    count = len(panels)
    quad = np.stack([corner, corner + u, corner + u + v, corner + v], axis=1)
    axes = np.stack([unit(u), unit(v)], axis=1)
    tile = np.array([p.tile for p in panels])
    uv = dot(quad[:, :, None], axes[:, None]) / tile[:, None, None]
    index = np.array([0, 1, 2, 0, 2, 3])
    normal = np.cross(axes[:, 0], axes[:, 1]).astype(np.float32)
    return MeshPart(
        vertices=quad.reshape(-1, 3),
        faces=(4 * np.arange(count)[:, None] + index).reshape(-1, 3).astype(np.int32),
        normals=np.broadcast_to(np.repeat(normal, 2, axis=0)[:, None], (2 * count, 3, 3)),
        uv=uv[:, index].reshape(2 * count, 3, 2).astype(np.float32),
        tangents=np.repeat(axes, 2, axis=0).astype(np.float32),
        groups=np.repeat(np.arange(count, dtype=np.int32), 2),
        materials=np.zeros(2 * count, np.int32),
    )


@in_place_kernel
def _rotate(rotation: F64, points: Any, out: Any) -> None:
    """Write the rotated points (P, 3) to ``out`` (P, 3)."""
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        for k in range(3):
            out[i, k] = (rotation[k, 0] * x + rotation[k, 1] * y) + rotation[k, 2] * z


def pose_meshes(
    assembly: Assembly,
    scene: Scene,
    trajectory: Trajectory,
    frame: int,
    moving: bool,
    vertices: F64,
    normals: F32 | None = None,
) -> None:
    """Write the vertices and normals in the world in one frame, also of absent bodies.

    Parameters
    ----------
    assembly, scene, trajectory
        The triangles, the scene they are made from, and its motion.
    frame
        Index of the frame.
    moving
        Whether the moving meshes are posed, or the others; the entries of the rest stay.
    vertices, normals
        (V, 3) metres and, where asked for, (T, 3, 3) of each corner, written.
    """
    bodies, offset = len(scene.bodies), 0
    rotations = rotation_matrices(trajectory.rotations[frame])
    for instance in assembly.instances:
        part, index = instance.part, instance.index
        wanted = (instance.vertices.start >= assembly.first_vertex) == moving
        count = len(part.vertices)
        if wanted and index == ROOM:
            vertices[instance.vertices] = part.vertices
            if normals is not None:
                normals[instance.triangles] = part.normals
        elif wanted and index < bodies:
            position = trajectory.positions[frame, index].astype(np.float64)
            placed = vertices[instance.vertices]
            _rotate(rotations[index], part.vertices, placed)
            placed += position
            if normals is not None:
                corners = normals[instance.triangles].reshape(-1, 3)
                _rotate(rotations[index], part.normals.reshape(-1, 3), corners)
        elif wanted:
            cloth = trajectory.cloth_vertices[frame, offset : offset + count].astype(np.float64)
            vertices[instance.vertices] = cloth
            if normals is not None:
                normals[instance.triangles] = _sheet_normals(cloth)
        if index >= bodies:
            offset += count
        if wanted and normals is not None:
            normals[instance.triangles] += np.float32(0.0)  # turns -0 into 0


def hide_absent(assembly: Assembly, scene: Scene, frame: int, vertices: F64) -> None:
    """Shrink bodies that are absent in a frame to a point, so that nothing of them is drawn.

    ``vertices`` (V, 3) of `pose_meshes` are changed.
    """
    if not scene.events:
        return
    present = scene.present(frame)
    for instance in assembly.instances:
        if instance.index != ROOM and not present[instance.index]:
            vertices[instance.vertices] = vertices[instance.vertices.start]


def _sheet_normals(vertices: F64) -> F32:
    """Return the corner normals (T, 3, 3) of a square sheet with these vertices (V, 3).

    The normal of a vertex is the mean of its triangles' normals, weighted by area: the sum of
    their cross products. The triangles are ordered as in `sheet`: all to the left of the diagonals,
    then all others.
    """
    side = math.isqrt(len(vertices))
    p = vertices.reshape(side, side, 3)
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    left, right = cross(b - a, c - a), cross(c - a, d - a)
    total = np.zeros_like(p)
    total[:-1, :-1] += left + right
    total[1:, :-1] += left
    total[1:, 1:] += left + right
    total[:-1, 1:] += right
    length = norm(total)[..., None]
    n = np.where(length > 0, total / np.where(length > 0, length, 1.0), (0.0, 0.0, 1.0))
    a, b, c, d = n[:-1, :-1], n[1:, :-1], n[1:, 1:], n[:-1, 1:]
    corners = [np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]
    return np.concatenate([x.reshape(-1, 3, 3) for x in corners]).astype(np.float32)
