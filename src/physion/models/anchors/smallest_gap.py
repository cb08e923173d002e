"""Smallest gap of agent and patient if both go on with the velocities that they have.

With c the centre of mass, v and w the velocities, R the rotation and p a point of a body relative
to its centre of mass, all at the start, the point is at time t at

    c + v t + T(w t) R p

where T(w t) rotates by the angle |w| t about w. No point moves faster than |v| + |w| max|p|, so the
gap of two bodies changes by at most the sum s of both bounds a second. Over an interval of length h
with the gaps g0 and g1 at its ends it is at least (g0 + g1 - s h) / 2: intervals in which this is
not below the smallest gap so far need no closer look (Shubert 1972).

References
----------
B. O. Shubert, A sequential method seeking the global maximum of a function, SIAM Journal on
Numerical Analysis 9, 1972.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import apply, multiply, norm
from physion.numerics.rotations import axis_angle_matrix, rotation_matrices
from physion.physics.cloth.contact_gap import CLOTH_CONTACT_GAP
from physion.physics.cloth.contacts import smallest_distance
from physion.physics.cloth.simulate import ClothSettings
from physion.physics.cloth.solids import surface_particles
from physion.physics.rigid.collision.closest_points import (
    CLOSE,
    OVERLAPPING,
    Simplex,
    closest_points,
    new_simplex,
)
from physion.physics.rigid.hulls import collision_hulls
from physion.physics.rigid.mass import body_mass
from physion.physics.trajectory import State
from physion.scenes.scene import FRAME_TIME, Body, Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

FAR = 10.0
"""Largest gap that is reported, metres; also that of a thing that is absent."""
TOLERANCE = 1e-3
"""Metres by which the reported gap may exceed the smallest one."""


@dataclass(frozen=True, eq=False)
class FlyingBody:
    """Points of a body that keeps its velocity and its angular velocity.

    - ``points`` (P, 3): metres, in the body's frame, from its centre of mass.
    - ``center`` (3,): of mass; ``rotation`` (3, 3); both at the start.
    - ``velocity``, ``angular_velocity`` (3,): m/s and rad/s, world axes.
    """

    points: F64
    center: F64
    rotation: F64
    velocity: F64
    angular_velocity: F64

    def pose(self, seconds: float) -> tuple[F64, F64]:
        """Return centre of mass (3,) and rotation (3, 3) after some seconds."""
        rate = float(norm(self.angular_velocity))
        rotation = self.rotation
        if rate > 0:
            step = axis_angle_matrix(self.angular_velocity / rate, rate * seconds)
            rotation = multiply(step, rotation)
        return self.center + seconds * self.velocity, rotation

    @property
    def top_speed(self) -> float:
        """Metres per second that no point exceeds."""
        reach = float(np.max(norm(self.points), initial=0.0))
        return float(norm(self.velocity)) + float(norm(self.angular_velocity)) * reach


def gap_in_constant_motion(scene: Scene, state: State, frames: int) -> float:
    """Return the smallest gap of agent and patient in metres, 0 where they touch.

    Both go on from ``state`` for ``frames`` frames with constant velocity and angular velocity,
    through everything: there is no gravity and no contact, and joints do not hold. The vertices of
    a cloth go on one by one. Bodies are compared by their convex hulls; a cloth and a body by the
    rule of the label, so that 0 is the distance at which they count as touching.

    The gap is at most `FAR`, also if agent or patient is absent or both are cloths, and at most
    `TOLERANCE` too large.
    """
    names = (scene.roles.agent, scene.roles.patient)
    indices = [scene.index(name) for name in names]
    present = scene.present(state.frame)
    if not all(present[index] for index in indices):
        return FAR
    bodies = [index for index in indices if index < len(scene.bodies)]
    if not bodies:
        return FAR
    if len(bodies) == 2:
        gap, top_speed = _gap_of_bodies(scene, state, bodies[0], bodies[1])
    else:
        gap, top_speed = _gap_of_cloth(scene, state, max(indices), bodies[0])
    return min(max(minimise(gap, top_speed, frames), 0.0), FAR)


def minimise(gap: Callable[[float], float], top_speed: float, frames: int) -> float:
    """Return the minimum of a function of time over ``frames`` frames, to `TOLERANCE`.

    The search ends at the first value that is not above 0.

    Parameters
    ----------
    gap
        Function of the time in seconds, metres.
    top_speed
        Metres a second that its slope does not exceed.
    frames
        Length in frames; each is an interval at the start.
    """
    values = [gap(frame * FRAME_TIME) for frame in range(frames + 1)]
    best = min(values)
    intervals = [
        (frame * FRAME_TIME, FRAME_TIME, *values[frame : frame + 2]) for frame in range(frames)
    ]
    while intervals and best > 0:
        start, length, first, last = intervals.pop()
        if (first + last - top_speed * length) / 2 >= best - TOLERANCE:
            continue
        half = length / 2
        middle = gap(start + half)
        best = min(best, middle)
        intervals += [(start, half, first, middle), (start + half, half, middle, last)]
    return best


def _gap_of_bodies(
    scene: Scene, state: State, a: int, b: int
) -> tuple[Callable[[float], float], float]:
    """Return the gap of two bodies as a function of time, and the bound of its slope."""
    hulls = [
        collision_hulls(scene.bodies[index].shape, scene.bodies[index].scale) for index in (a, b)
    ]
    corners = [[hull.corners for hull in pieces] for pieces in hulls]
    first, second = (
        _flying(scene.bodies[index], state, index, np.concatenate([*parts, np.zeros((0, 3))]))
        for index, parts in zip((a, b), corners, strict=True)
    )
    vertices = np.concatenate([first.points, second.points])
    counts = [len(part) for parts in corners for part in parts]
    ends = np.cumsum([0, *counts]).astype(np.int64)
    pieces, simplex = len(corners[0]), new_simplex()

    def gap(seconds: float) -> float:
        (at, turned), (origin, axes) = first.pose(seconds), second.pose(seconds)
        to_second = np.ascontiguousarray(axes.T)
        rotation, shift = multiply(to_second, turned), apply(to_second, at - origin)
        return min(_gap_of_hulls(vertices, ends, pieces, rotation, shift, simplex), FAR)

    return gap, first.top_speed + second.top_speed


@kernel
def _gap_of_hulls(
    vertices: F64, ends: I64, pieces: int, rotation: F64, shift: F64, simplex: Simplex
) -> float:
    """Return the smallest distance of the convex pieces of two bodies, 0 if some overlap.

    Parameters
    ----------
    vertices : (V, 3)
        Corners of the pieces of A, then of B, each in the frame of its body, metres.
    ends : (K + 1,)
        Rows at which the pieces begin, and V. ``pieces``: how many of the K belong to A.
    rotation, shift : (3, 3), (3,)
        From the frame of A to that of B.
    simplex : Simplex
        Work space.
    """
    smallest = np.inf
    span = np.empty(4, np.int64)
    for i in range(pieces):
        for j in range(pieces, len(ends) - 1):
            span[0], span[1], span[2], span[3] = ends[i], ends[i + 1], ends[j], ends[j + 1]
            result, _, distance = closest_points(
                vertices, span, rotation, shift, smallest, simplex, 0
            )
            if result == OVERLAPPING:
                return 0.0
            if result == CLOSE:
                smallest = min(smallest, distance)
    return smallest


def _gap_of_cloth(
    scene: Scene, state: State, cloth: int, body: int
) -> tuple[Callable[[float], float], float]:
    """Return the gap of a cloth and a body as a function of time, and the bound of its slope."""
    settings = ClothSettings()
    particles = surface_particles(scene.bodies[body], settings.particle_spacing)
    flying = _flying(scene.bodies[body], state, body, particles)
    number = cloth - len(scene.bodies)
    counts = [sheet.resolution**2 for sheet in scene.cloths]
    rows = slice(sum(counts[:number]), sum(counts[: number + 1]))
    vertices, velocities = state.cloth_vertices[rows].T, state.cloth_velocities[rows].T
    touching = settings.rest_distance + CLOTH_CONTACT_GAP

    def gap(seconds: float) -> float:
        points = np.ascontiguousarray(vertices + seconds * velocities)
        distance = smallest_distance(points, flying.points, *flying.pose(seconds))
        return min(distance - touching, FAR)

    return gap, flying.top_speed + float(np.max(norm(velocities.T)))


def _flying(body: Body, state: State, index: int, points: F64) -> FlyingBody:
    """Return a body whose points (P, 3) are given in its own frame, from its pivot."""
    rotation = rotation_matrices(state.rotations[index])
    center = body_mass(body).center
    return FlyingBody(
        points=points - center,
        center=state.positions[index] + apply(rotation, center),
        rotation=rotation,
        velocity=state.velocities[index],
        angular_velocity=state.angular_velocities[index],
    )
