"""Motion for the 3D view: meshes once for each shape, poses and cloth in few bytes.

Arrays go into the page as base64 of little-endian numbers; `pack` and its counterpart in the page's
script use the same format.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.physics.labels import contact_frames
from physion.physics.trajectory import Trajectory
from physion.rendering.triangles import solid
from physion.scenes.scene import Scene
from physion.scenes.shapes.primitives import shape

CLOTH_SIDE = 26
"""Largest number of vertices of a cloth along a side: every second of the usual 51."""
CLOTH_INSTANTS = 76
"""Largest number of frames of a cloth; the page interpolates linearly between them."""
STEPS = 65535
"""Steps of the grid on which coordinates are stored: a thirtieth of a millimetre over 2 m."""


def pack(values: NDArray[Any], kind: str) -> str:
    """Return ``values`` as base64 of numbers of the numpy type ``kind`` (``<f4``, ``<i2``, ...)."""
    return base64.b64encode(np.ascontiguousarray(values, np.dtype(kind)).tobytes()).decode("ascii")


def pack_grid(values: NDArray[np.floating]) -> dict[str, Any]:
    """Quantise points (..., 3) to a grid of `STEPS` over their bounds: ``low``, ``size`` and
    ``data``.
    """
    points = np.nan_to_num(np.asarray(values, np.float64)).reshape(-1, 3)
    low = points.min(axis=0) if len(points) else np.zeros(3)
    size = np.ptp(points, axis=0) if len(points) else np.zeros(3)
    steps = np.rint((points - low) / np.where(size > 0, size, 1.0) * STEPS)
    return {
        "low": [float(v) for v in low],
        "size": [float(v) for v in size],
        "data": pack(steps, "<u2"),
    }


def pack_shapes(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return meshes by the name of their shape, at unit scale, for the 3D view.

    ``points`` and ``normals`` (signed bytes, -127..127) of the corners, ``faces`` as triples of
    them; corners on a crease occur once for each side.
    """
    packed = {}
    for name in sorted(set(names)):
        mesh = shape(name).mesh
        part = solid(
            np.asarray(mesh.vertices, np.float64),
            np.asarray(mesh.faces, np.int32),
            np.ones(3),
            mesh.smooth,
            0,
        )
        normals = np.rint(part.normals.reshape(-1, 3) * 127).astype(np.int64)
        corners = np.concatenate([part.faces.reshape(-1, 1), normals], axis=1)
        unique, index = np.unique(corners, axis=0, return_inverse=True)
        packed[name] = {
            "points": pack_grid(part.vertices[unique[:, 0]]),
            "normals": pack(unique[:, 1:], "<i1"),
            "faces": pack(index, "<u2"),
        }
    return packed


def pack_motion(scene: Scene, trajectory: Trajectory) -> dict[str, Any]:
    """Return everything that the 3D view draws of a trial; ``scene`` has the colours to show."""
    positions, rotations = trajectory.positions, trajectory.rotations
    moves = np.any(positions != positions[:1], axis=(0, 2)) | np.any(
        rotations != rotations[:1], axis=(0, 2)
    )
    moving = np.flatnonzero(moves)
    return {
        "frames": len(trajectory),
        "bodies": [_body(scene, i) for i in range(len(scene.bodies))],
        "start": {
            "positions": pack(positions[0], "<f4"),
            "rotations": _pack_rotations(rotations[0]),
        },
        "moving": [int(i) for i in moving],
        "positions": pack(positions[:, moving], "<f4"),
        "rotations": _pack_rotations(rotations[:, moving]),
        "cloths": _cloths(scene, trajectory),
        "camera": {
            "position": list(scene.camera.position),
            "target": list(scene.camera.target),
            "fov": scene.camera.fov,
        },
        "floor": scene.floor,
        "contactPoints": _contact_points(scene, trajectory),
    }


def role_of(scene: Scene, name: str) -> str | None:
    """Return ``agent``, ``patient``, ``probe``, or None for all other bodies."""
    roles = {scene.roles.probe: "probe", scene.roles.patient: "patient", scene.roles.agent: "agent"}
    return roles.get(name)


def _body(scene: Scene, index: int) -> dict[str, Any]:
    body = scene.bodies[index]
    return {
        "shape": body.shape,
        "scale": list(body.scale),
        "color": list(body.look.color),
        "role": role_of(scene, body.name),
        "scenery": body.scenery,
    }


def _pack_rotations(rotations: NDArray[np.floating]) -> str:
    """Pack quaternions as signed 16-bit numbers; the script makes them unit length again."""
    return pack(np.rint(np.clip(np.nan_to_num(rotations), -1.0, 1.0) * 32767), "<i2")


def _cloths(scene: Scene, trajectory: Trajectory) -> list[dict[str, Any]]:
    """Return each cloth with fewer vertices and frames than the trajectory has."""
    count = min(len(trajectory), CLOTH_INSTANTS)
    instants = np.unique(np.rint(np.linspace(0, len(trajectory) - 1, count)).astype(int))
    packed, first = [], 0
    for cloth in scene.cloths:
        side = cloth.resolution
        kept = np.unique(np.rint(np.linspace(0, side - 1, min(side, CLOTH_SIDE))).astype(int))
        sheet = trajectory.cloth_vertices[:, first : first + side * side]
        if sheet.shape[1] != side * side:
            raise BadInputError(f"scene {scene.name!r}: cloth {cloth.name!r} lacks vertices")
        first += side * side
        grid = sheet.reshape(len(trajectory), side, side, 3)[instants][:, kept][:, :, kept]
        packed.append(
            {
                "side": len(kept),
                "instants": [int(i) for i in instants],
                "points": pack_grid(grid),
                "color": list(cloth.look.color),
                "role": role_of(scene, cloth.name),
            }
        )
    return packed


def _contact_points(scene: Scene, trajectory: Trajectory) -> list[list[float]]:
    """Return the contact points of agent and patient: rows of frame, x, y, z."""
    agent, patient = (scene.index(name) for name in (scene.roles.agent, scene.roles.patient))
    contacts = trajectory.contacts
    pair = (contacts.bodies == sorted((agent, patient))).all(axis=1)
    counted = np.isin(contacts.frame, contact_frames(scene, trajectory))
    rows = np.flatnonzero(pair & counted)
    points = np.round(np.nan_to_num(contacts.point[rows].astype(np.float64)), 4)
    found: list[list[float]] = [
        [int(contacts.frame[row]), *(float(v) for v in point)]
        for row, point in zip(rows, points, strict=True)
    ]
    # The page counts those up to a frame, and a file may hold them in any order.
    return sorted(found)
