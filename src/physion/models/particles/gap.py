"""Smallest distance of agent and patient over a motion, between its steps too.

Between two rows of a motion a body goes from one pose to the next with constant velocity and
angular velocity. Bodies are compared by their convex pieces; a cloth and a body by the particles of
the cloth and points on the surface of the body, which go along straight lines.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from physion.models.baselines.motion import FAR, TOLERANCE, minimise
from physion.models.particles.bodies import CLOTH, Poses, SceneParticles, surface_points
from physion.models.particles.neighbours import gap_over_time
from physion.models.particles.rigid_motion import rotation_from_vector, vector_from_rotation
from physion.numerics.kernel import kernel
from physion.physics.rigid.bodies import collision_hulls
from physion.physics.rigid.collision.closest_points import (
    CLOSE,
    OVERLAPPING,
    Simplex,
    closest_points,
    new_simplex,
)
from physion.physics.rigid.collision.penetration import Polytope, new_polytope, penetration
from physion.scenes.scene import FRAME_TIME, Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def smallest_distance(
    scene: Scene, particles: SceneParticles, poses: Poses, spacing: float, limit: int
) -> float:
    """Return the smallest distance of agent and patient, metres; minus the depth of an overlap.

    Learned bodies can overlap, and the deeper they do, the surer is the contact. The distance is
    at most `FAR`, also if one of them is absent, and at most `TOLERANCE` too large; depths are
    those at the rows of the motion alone.

    Parameters
    ----------
    scene, particles
        The scene and its particles.
    poses
        Motion over T rows.
    spacing, limit
        Of the points on the surface of a body that is compared with a cloth. They may be finer
        than the particles that move, since the pose of a body gives the place of each of its
        points.
    """
    rows = (particles.agent, particles.patient)
    if min(rows) < 0 or not len(poses.centers):
        return FAR
    if CLOTH in particles.kinds[list(rows)]:
        first, second = (_points(scene, particles, poses, row, spacing, limit) for row in rows)
        return min(gap_over_time(first, second), FAR)
    return min(_distance_of_bodies(scene, particles, poses, rows), FAR)


def _distance_of_bodies(
    scene: Scene, particles: SceneParticles, poses: Poses, rows: tuple[int, int]
) -> float:
    """Return the smallest distance of two bodies, or minus their deepest overlap.

    In a step their distance changes by at most the sum of what any point of each moves, s, so with
    the distances g0 and g1 at its ends it is at least (g0 + g1 - s) / 2. Steps in which this is not
    below the smallest distance so far are not searched.
    """
    centers = poses.centers[:, rows]
    rotations = poses.rotations[:, rows]
    steps = np.diff(centers, axis=0)
    rotation = vector_from_rotation(
        torch.from_numpy(rotations[1:] @ rotations[:-1].swapaxes(-1, -2))
    ).numpy()
    between, reach = _pair(scene, particles, rows)
    gaps = [between(centers[row], rotations[row]) for row in range(len(centers))]
    best = min(gaps)
    lengths = np.linalg.norm(steps, axis=-1) + np.linalg.norm(rotation, axis=-1) * reach
    moved = lengths.sum(axis=1)
    for row in range(len(steps)):
        if best <= 0 or (gaps[row] + gaps[row + 1] - moved[row]) / 2 >= best - TOLERANCE:
            continue

        def during(seconds: float, row: int = row) -> float:
            part = seconds / FRAME_TIME
            rotated = rotation_from_vector(torch.from_numpy(part * rotation[row])).numpy()
            return between(centers[row] + part * steps[row], rotated @ rotations[row])

        best = min(best, minimise(during, float(moved[row]) / FRAME_TIME, 1))
    return best


def _pair(
    scene: Scene, particles: SceneParticles, rows: tuple[int, int]
) -> tuple[Callable[[F64, F64], float], F64]:
    """Return the distance as a function of centres (2, 3) and rotations (2, 3, 3), and reaches.

    The reach (2,) of a body is the largest distance of its points from its centre.
    """
    corners = []
    for row in rows:
        body = scene.bodies[int(particles.things[row])]
        hulls = collision_hulls(body.shape, body.scale)
        corners.append([hull.corners - particles.pivots[row] for hull in hulls])
    parts = [part for own in corners for part in own]
    vertices = np.ascontiguousarray(np.concatenate(parts), np.float64)
    ends = np.cumsum([0, *(len(part) for part in parts)]).astype(np.int64)
    pieces, simplex, polytope = len(corners[0]), new_simplex(), new_polytope()

    def between(centers: F64, rotations: F64) -> float:
        to_second = np.ascontiguousarray(rotations[1].T)
        shift = to_second @ (centers[0] - centers[1])
        rotation = to_second @ rotations[0]
        return float(_signed_gap(vertices, ends, pieces, rotation, shift, simplex, polytope))

    reach = [max(float(np.linalg.norm(part, axis=1).max()) for part in own) for own in corners]
    return between, np.array(reach)


@kernel
def _signed_gap(
    vertices: F64,
    ends: I64,
    pieces: int,
    rotation: F64,
    shift: F64,
    simplex: Simplex,
    polytope: Polytope,
) -> float:
    """Return the smallest distance of the convex pieces of two bodies, or minus the depth.

    Parameters
    ----------
    vertices : (V, 3)
        Corners of the pieces of A, then of B, each in the frame of its body, metres.
    ends : (K + 1,)
        Rows at which the pieces begin, and V. ``pieces``: how many of the K belong to A.
    rotation, shift : (3, 3), (3,)
        From the frame of A to that of B.
    simplex, polytope : Simplex, Polytope
        Work space.
    """
    smallest = np.inf
    span = np.empty(4, np.int64)
    found = np.empty(10)
    for i in range(pieces):
        for j in range(pieces, len(ends) - 1):
            span[0], span[1], span[2], span[3] = ends[i], ends[i + 1], ends[j], ends[j + 1]
            reach = max(smallest, 0.0)
            result, size, distance = closest_points(
                vertices, span, rotation, shift, reach, simplex, 0
            )
            if result == OVERLAPPING:
                depth = 0.0
                if penetration(vertices, span, rotation, shift, simplex, size, polytope, found):
                    depth = found[9]
                smallest = min(smallest, -depth)
            elif result == CLOSE:
                smallest = min(smallest, distance)
    return smallest


def _points(
    scene: Scene, particles: SceneParticles, poses: Poses, row: int, spacing: float, limit: int
) -> F64:
    """Return the points (T, P, 3) of an object."""
    if particles.kinds[row] == CLOTH:
        owners = particles.owners[particles.loose]
        return np.ascontiguousarray(poses.loose[:, owners == row])
    body = scene.bodies[int(particles.things[row])]
    points, _ = surface_points(body.shape, body.scale, spacing, limit)
    rotated = (points - particles.pivots[row])[None] @ poses.rotations[:, row].transpose(0, 2, 1)
    return np.ascontiguousarray(rotated + poses.centers[:, row, None])
