"""Camera matrices and meshes of a trial, as stored in its file for readers without this package.

A shape is stored once, however many objects have it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.physics.cloth.sheet import sheet_triangles, sheet_vertices
from physion.rendering.camera import intrinsics, view_matrix
from physion.scenes.scene import Body, Cloth, Scene
from physion.scenes.shapes.primitives import shape
from physion.trials.schema import GEOMETRY


def mesh_of(thing: Body | Cloth) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return vertices (V, 3) in metres and triangles (T, 3) of the surface of an object.

    Vertices of a body are those of its shape at unit scale, of a cloth those of the undeformed
    sheet about its centre. Triangles are counter-clockwise as seen from outside.
    """
    if isinstance(thing, Cloth):
        flat = sheet_vertices(thing) - np.asarray(thing.position)
        return flat, sheet_triangles(thing.resolution)
    mesh = shape(thing.shape).mesh
    return mesh.vertices, mesh.faces


def geometry_arrays(scene: Scene, width: int, height: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of `physion.trials.schema.GEOMETRY` by their path, in the declared types.

    ``width`` and ``height`` are the size of the pictures in pixels.
    """
    stored: dict[str, tuple[int, int, int, int]] = {}
    vertices: list[NDArray[Any]] = [np.zeros((0, 3))]
    faces: list[NDArray[Any]] = [np.zeros((0, 3), np.int32)]
    corners = triangles = 0
    ranges, scales = [], []
    things: tuple[Body | Cloth, ...] = (*scene.bodies, *scene.cloths)
    for thing in things:
        # Sheets differ in size: each is a shape of its own.
        key = f"shape {thing.shape}" if isinstance(thing, Body) else f"cloth {thing.name}"
        if key not in stored:
            points, corner_rows = mesh_of(thing)
            vertices.append(points)
            faces.append(corner_rows + corners)
            ends = corners + len(points), triangles + len(corner_rows)
            stored[key] = (corners, ends[0], triangles, ends[1])
            corners, triangles = ends
        ranges.append(stored[key])
        scales.append(thing.scale if isinstance(thing, Body) else (1.0, 1.0, 1.0))
    arrays = {
        "camera/intrinsics": intrinsics(scene.camera, width, height),
        "camera/extrinsics": view_matrix(scene.camera),
        "meshes/vertices": np.concatenate(vertices),
        "meshes/faces": np.concatenate(faces),
        "meshes/ranges": np.array(ranges).reshape(-1, 4),
        "meshes/scale": np.array(scales).reshape(-1, 3),
    }
    return {path: array.astype(GEOMETRY[path].dtype) for path, array in arrays.items()}
