"""Solids of the library as planes, their distance from rays, and the fit of one to rays.

A solid is a union of convex pieces, each of which holds the points u, in coordinates of the shape,
with n . u <= d for all its planes. Placed with position p, rotation R and scales S = diag(s), a
point is x = p + R S u, and its distance in metres from the plane, outside positive, is

    m . x - e,    m = R S^-1 n / |S^-1 n|,    e = d / |S^-1 n| + m . p.

A ball is |u| <= b about its centre. It has the volume of the drawn one, which has corners at 1/2;
with w = S^-1 u / |u| its distance is (|u| - b) / |w|, to first order.

Residual of a ray o + t v that sees the object at depth D: the distance of the observed point from
the plane through which the ray enters the first piece that it meets (point to plane). Where that is
positive, or the ray meets nothing, it is the least over pieces of the largest distance from a
plane, which is at most the true distance. Residual of a free ray: for each piece that it meets
before D - 1 mm, the depth below the nearest plane halfway between entry and exit, or D; the largest
counts.

The fit minimises the sum of q / (1 + q), q = (r / c)^2 (Geman and McClure), over position, rotation
vector and logarithms of the scales by the method of Levenberg and Marquardt with weights
1 / (1 + q)^2 and differences for derivatives, while c falls. Weak priors are further residuals,
without a limit: 4 mm times ln(sx / sy), 2 mm times ln(sz / sqrt(sx sy)), both times a weight, the
depth below the floor, the height above what the object stands on, and the distance from where its
centre is expected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from physion.models.seeing.pixels import Rays
from physion.numerics.kernel import kernel
from physion.scenes.shapes.primitives import (
    PIPE_INNER,
    ROUND_SEGMENTS,
    pipe_section,
    ring_pieces,
    shape,
)

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BALL = 0.4973
"""Radius of the ball that has the volume of the drawn one."""
CLEARANCE = 0.001
"""Metres before what is seen in which an object may still be on a free ray."""


@dataclass(frozen=True, eq=False)
class Solid:
    """Shape of the library as the fit sees it, at unit scale.

    - ``planes`` (P, 4): outward unit normal n and d of n . u <= d. ``starts`` (K + 1,): rows at
      which the pieces begin, and P; a ball has none.
    - ``corners`` (V, 3). ``low``, ``high`` (3,): bounds.
    - ``symmetry``: smallest rotation about the vertical that changes nothing, radians; 0 for any.
    """

    name: str
    planes: F64
    starts: I64
    corners: F64
    low: F64
    high: F64
    symmetry: float

    @property
    def ball(self) -> bool:
        """Whether it is a ball."""
        return len(self.starts) == 1


TURNS = {
    "cube": math.pi / 2,
    "sphere": 0.0,
    "cylinder": 0.0,
    "cone": 0.0,
    "pyramid": math.pi / 2,
    "triangular_prism": math.pi,
    "pentagon": 2 * math.pi / 5,
    "octahedron": math.pi / 2,
    "platonic": 2 * math.pi / 5,
    "dumbbell": math.pi,
    "bowl": 0.0,
    "torus": 0.0,
    "pipe": 0.0,
    "ramp_with_platform_30": 2 * math.pi,
    "ramp_with_platform_60": 2 * math.pi,
}
"""Shapes of the library, simple ones first, with `Solid.symmetry`."""


@cache
def solid(name: str) -> Solid:
    """Return a shape of the library as it is drawn.

    What is one collision piece is the convex hull of its mesh. A pipe has a piece for each of its
    drawn sides, twice as many as it has collision pieces; all others are their collision pieces.
    """
    from scipy.spatial import ConvexHull

    built = shape(name)
    corners = built.mesh.vertices
    pieces = built.pieces
    if name == "pipe":
        pieces = ring_pieces([np.array(pipe_section(PIPE_INNER))], ROUND_SEGMENTS, 1)
    parts = [corners] if len(pieces) == 1 else [p.mesh.vertices for p in pieces]
    planes, starts = [np.zeros((0, 4))], [0]
    for part in [] if name == "sphere" else parts:
        # The hull's triangles of one face have the same plane, but for rounding.
        equations = ConvexHull(part).equations
        _, rows = np.unique(np.round(equations, 6), axis=0, return_index=True)
        planes.append(equations[np.sort(rows)] * (1.0, 1.0, 1.0, -1.0))
        starts.append(starts[-1] + len(rows))
    low, high = built.bounds
    return Solid(
        name,
        np.ascontiguousarray(np.concatenate(planes)),
        np.array(starts, np.int64),
        np.ascontiguousarray(corners),
        low,
        high,
        TURNS[name],
    )


def library() -> tuple[Solid, ...]:
    """Return all shapes that are fitted, simple ones first."""
    return tuple(solid(name) for name in TURNS)


@dataclass(frozen=True, eq=False)
class Placed:
    """Solid at a pose: ``position`` (3,) of the pivot, ``rotation`` (3, 3), ``scale`` (3,).

    ``cost``: mean of q / (1 + q) over the rays of the last fit, 0 for a perfect one.
    """

    solid: Solid
    position: F64
    rotation: F64
    scale: F64
    cost: float = math.inf

    def corners(self) -> F64:
        """Return the corners (V, 3) in the world, metres."""
        return np.asarray(self.position + (self.solid.corners * self.scale) @ self.rotation.T)

    def middle(self) -> F64:
        """Return the middle (3,) of the bounds of the shape, in the world."""
        middle = (self.solid.low + self.solid.high) / 2
        return np.asarray(self.position + self.rotation @ (middle * self.scale))

    def size(self) -> F64:
        """Return the extents (3,) along the axes of the shape, metres."""
        return np.asarray((self.solid.high - self.solid.low) * self.scale)

    def extent_z(self) -> tuple[float, float]:
        """Return the lowest and the highest z in metres."""
        if self.solid.ball:
            half = 0.5 * float(np.sqrt(np.sum((self.rotation[2] * self.scale) ** 2)))
            middle = float(self.middle()[2])
            return middle - half, middle + half
        heights = self.corners()[:, 2]
        return float(heights.min()), float(heights.max())


@dataclass(frozen=True)
class Prior:
    """What is expected of a pose before it is fitted; weights are of residuals in metres.

    - ``floor``: height that nothing is below. ``rest``: height of what the object stands on, with
      ``rest_weight``. ``center``: x and y of its middle, with ``center_weight``. ``equal``: weight
      of equal scales.
    """

    floor: float = 0.0
    rest: float = 0.0
    rest_weight: float = 0.0
    center: tuple[float, float] = (0.0, 0.0)
    center_weight: float = 0.0
    equal: float = 1.0

    def values(self) -> F64:
        """Return the numbers (7,) that the kernels take."""
        center = (*self.center, self.center_weight)
        return np.array([self.floor, self.rest, self.rest_weight, *center, self.equal], np.float64)


POSE = np.eye(9)[:, :6]
"""Free parameters of a fit whose scales are given."""
FREE = np.eye(9)
ROUND = np.column_stack([*np.eye(9)[:, :6].T, (0, 0, 0, 0, 0, 0, 1, 1, 0), np.eye(9)[8]]).astype(
    np.float64
)
"""The scales along x and y are equal."""
EQUAL = np.column_stack([*np.eye(9)[:, :6].T, (0, 0, 0, 0, 0, 0, 1, 1, 1)]).astype(np.float64)
"""All scales are equal."""
NO_PRIOR = Prior(floor=-math.inf)


def fit(
    start: Placed,
    rays: Rays,
    free: F64 = FREE,
    prior: Prior = NO_PRIOR,
    *,
    widths: Sequence[float] = (0.05, 0.004),
    steps: int = 12,
) -> Placed:
    """Return the pose, and the scales, that fit rays best, near a start.

    Parameters
    ----------
    start
        Where the search begins.
    rays
        What is known of the object.
    free
        Directions (9, K) in the space of position, rotation vector and logarithms of scales.
    prior
        What is expected.
    widths
        First and last c, metres. ``steps``: largest number of steps.
    """
    s = start.solid
    position, rotation, logs = start.position.copy(), start.rotation.copy(), np.log(start.scale)
    cost = _fit(
        s.planes, s.starts, s.corners, rays.origin, rays.vectors, rays.depth, rays.on,
        position, rotation, logs, np.ascontiguousarray(free), prior.values(), (s.low + s.high) / 2,
        widths[0], widths[1], steps,
    )  # fmt: skip
    return replace(
        start, position=position, rotation=rotation, scale=np.exp(logs), cost=float(cost)
    )


def residuals(placed: Placed, rays: Rays) -> F64:
    """Return the residuals (N,) of rays in metres."""
    s, out = placed.solid, np.empty(len(rays.depth))
    _residuals(
        place(placed), s.starts, placed.position, placed.rotation, placed.scale,
        (s.low + s.high) / 2, rays.origin, rays.vectors, rays.depth, rays.on, out,
    )  # fmt: skip
    return out


def cost_of(placed: Placed, rays: Rays, width: float = 0.004) -> float:
    """Return the mean of q / (1 + q) over rays."""
    q = (residuals(placed, rays) / width) ** 2
    return float(np.mean(q / (1 + q)))


def place(placed: Placed) -> F64:
    """Return the planes (P, 4), m and e, of a placed solid."""
    world = np.empty_like(placed.solid.planes)
    _place(placed.solid.planes, placed.position, placed.rotation, placed.scale, world)
    return world


@kernel
def _place(planes: F64, position: F64, rotation: F64, scale: F64, world: F64) -> None:
    """Write the planes (P, 4), m and e, of a placed solid to ``world``."""
    for k in range(len(planes)):
        a, b, c = planes[k, 0] / scale[0], planes[k, 1] / scale[1], planes[k, 2] / scale[2]
        length = np.sqrt(a * a + b * b + c * c)
        a, b, c = a / length, b / length, c / length
        world[k, 3] = planes[k, 3] / length
        for i in range(3):
            world[k, i] = rotation[i, 0] * a + rotation[i, 1] * b + rotation[i, 2] * c
            world[k, 3] += world[k, i] * position[i]


@kernel
def _residuals(
    world: F64,
    starts: I64,
    position: F64,
    rotation: F64,
    scale: F64,
    middle: F64,
    origin: F64,
    vectors: F64,
    depth: F64,
    on: NDArray[np.bool_],
    out: F64,
) -> None:
    """Write the residuals (N,) of rays to ``out``; see the head of the module.

    Parameters
    ----------
    world : (P, 4)
        Planes in the world. ``starts`` (K + 1,): first rows of the pieces; (1,) for a ball.
    position, rotation, scale, middle : (3,), (3, 3), (3,), (3,)
        Pose, and the centre of the shape at unit scale, of which a ball makes use.
    origin, vectors, depth, on : (3,), (N, 3), (N,), (N,)
        Rays.
    """
    pieces = len(starts) - 1
    offsets = np.empty(len(world))
    for k in range(len(world)):
        offsets[k] = (
            world[k, 3]
            - world[k, 0] * origin[0]
            - world[k, 1] * origin[1]
            - world[k, 2] * origin[2]
        )
    local, ray, u, w = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        local[i] = 0.0
        for j in range(3):
            local[i] += rotation[j, i] * (origin[j] - position[j])
        local[i] = local[i] / scale[i] - middle[i]
    slopes = np.empty(len(world))
    for n in range(len(depth)):
        v0, v1, v2 = vectors[n, 0], vectors[n, 1], vectors[n, 2]
        far = depth[n]
        if pieces == 0:
            for i in range(3):
                ray[i] = (rotation[0, i] * v0 + rotation[1, i] * v1 + rotation[2, i] * v2) / scale[
                    i
                ]
            a = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
            b = ray[0] * local[0] + ray[1] * local[1] + ray[2] * local[2]
            c = local[0] * local[0] + local[1] * local[1] + local[2] * local[2] - BALL * BALL
            square = b * b - a * c
            hit = square > 0.0
            entry = leave = 0.0
            if hit:
                entry = (-b - np.sqrt(square)) / a
                leave = (-b + np.sqrt(square)) / a
                hit = leave > 0.0
            if on[n]:
                at = far
                if hit:
                    # The tangent plane where the ray enters.
                    length = slope = 0.0
                    for i in range(3):
                        w[i] = (local[i] + entry * ray[i]) / scale[i]
                        length += w[i] * w[i]
                        slope += (local[i] + entry * ray[i]) * ray[i]
                    out[n] = slope / np.sqrt(length) * (far - entry)
                    if out[n] <= 0.0:
                        continue
            else:
                out[n] = 0.0
                if not hit or entry >= far - CLEARANCE:
                    continue
                at = (max(entry, 0.0) + min(leave, far)) / 2
            size = length = 0.0
            for i in range(3):
                u[i] = local[i] + at * ray[i]
                size += u[i] * u[i]
                w[i] = u[i] / scale[i]
                length += w[i] * w[i]
            size = np.sqrt(size)
            distance = (size - BALL) * size / max(np.sqrt(length), 1e-12)
            out[n] = distance if on[n] else max(-distance, 0.0)
            continue
        for k in range(len(world)):
            slopes[k] = world[k, 0] * v0 + world[k, 1] * v1 + world[k, 2] * v2
        first, value, deepest = np.inf, 0.0, 0.0
        for piece in range(pieces):
            entry, leave, plane = -np.inf, np.inf, -1
            for k in range(starts[piece], starts[piece + 1]):
                if slopes[k] < -1e-12:
                    t = offsets[k] / slopes[k]
                    if t > entry:
                        entry, plane = t, k
                elif slopes[k] > 1e-12:
                    leave = min(leave, offsets[k] / slopes[k])
                elif offsets[k] < 0.0:
                    leave = -np.inf
                if entry >= leave:
                    break
            if entry >= leave or leave <= 0.0:
                continue
            if on[n]:
                if entry < first:
                    first, value = entry, far * slopes[plane] - offsets[plane]
            elif entry < far - CLEARANCE:
                at = (max(entry, 0.0) + min(leave, far)) / 2
                largest = -np.inf
                for k in range(starts[piece], starts[piece + 1]):
                    largest = max(largest, at * slopes[k] - offsets[k])
                deepest = max(deepest, -largest)
        if not on[n]:
            out[n] = deepest
        elif first < np.inf and value <= 0.0:
            out[n] = value
        else:
            least = np.inf
            for piece in range(pieces):
                largest = -np.inf
                for k in range(starts[piece], starts[piece + 1]):
                    largest = max(largest, far * slopes[k] - offsets[k])
                    if largest >= least:
                        break
                least = min(least, largest)
            out[n] = least


PRIORS = 6
"""Number of residuals of the prior."""


@kernel
def _priors(
    starts: I64,
    corners: F64,
    middle: F64,
    position: F64,
    rotation: F64,
    logs: F64,
    prior: F64,
    out: F64,
) -> None:
    """Write the residuals (PRIORS,) of the prior to ``out``, metres."""
    scale = np.exp(logs)
    lowest = np.inf
    if len(starts) == 1:
        half = height = 0.0
        for i in range(3):
            half += (rotation[2, i] * scale[i]) ** 2
            height += rotation[2, i] * scale[i] * middle[i]
        lowest = height - 0.5 * np.sqrt(half)
    else:
        a, b, c = rotation[2, 0] * scale[0], rotation[2, 1] * scale[1], rotation[2, 2] * scale[2]
        for k in range(len(corners)):
            lowest = min(lowest, a * corners[k, 0] + b * corners[k, 1] + c * corners[k, 2])
    lowest += position[2]
    out[0] = 0.004 * prior[6] * (logs[0] - logs[1])
    out[1] = 0.002 * prior[6] * (logs[2] - 0.5 * (logs[0] + logs[1]))
    out[2] = 3.0 * min(0.0, lowest - prior[0])
    out[3] = prior[2] * (lowest - prior[1])
    for i in range(2):
        center = position[i]
        for j in range(3):
            center += rotation[i, j] * scale[j] * middle[j]
        out[4 + i] = prior[5] * (center - prior[3 + i])


@kernel
def _rotate(vector: F64, rotation: F64, out: F64) -> None:
    """Write a rotation (3, 3), turned by a rotation vector (3,) in world axes, to ``out``."""
    angle = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    s, c = 1.0, 0.5
    if angle > 1e-8:
        s, c = np.sin(angle) / angle, (1 - np.cos(angle)) / (angle * angle)
    x, y, z = vector[0], vector[1], vector[2]
    turn = np.empty((3, 3))
    turn[0, 0], turn[0, 1], turn[0, 2] = (
        1 - c * (y * y + z * z),
        c * x * y - s * z,
        c * x * z + s * y,
    )
    turn[1, 0], turn[1, 1], turn[1, 2] = (
        c * x * y + s * z,
        1 - c * (x * x + z * z),
        c * y * z - s * x,
    )
    turn[2, 0], turn[2, 1], turn[2, 2] = (
        c * x * z - s * y,
        c * y * z + s * x,
        1 - c * (x * x + y * y),
    )
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for k in range(3):
                out[i, j] += turn[i, k] * rotation[k, j]


@kernel
def _solve(matrix: F64, right: F64, size: int, out: F64) -> bool:
    """Solve a symmetric positive system by Cholesky, in place; return whether it is positive."""
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                matrix[i, i] = np.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    for i in range(size):
        out[i] = right[i]
        for k in range(i):
            out[i] -= matrix[i, k] * out[k]
        out[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            out[i] -= matrix[k, i] * out[k]
        out[i] /= matrix[i, i]
    return True


@kernel
def _fit(
    planes: F64,
    starts: I64,
    corners: F64,
    origin: F64,
    vectors: F64,
    depth: F64,
    on: NDArray[np.bool_],
    position: F64,
    rotation: F64,
    logs: F64,
    free: F64,
    prior: F64,
    middle: F64,
    wide: float,
    narrow: float,
    steps: int,
) -> float:
    """Move a solid, in place, to where it fits rays; return the cost without priors.

    Parameters
    ----------
    planes, starts, corners, middle
        The solid; see `Solid`.
    origin, vectors, depth, on
        Rays; see `physion.models.seeing.pixels.Rays`.
    position, rotation, logs : (3,), (3, 3), (3,)
        Start, and result: pose and logarithms of the scales.
    free : (9, K)
        Directions in which parameters change together.
    prior : (7,)
        See `Prior.values`.
    wide, narrow : float
        First and last c, metres. ``steps``: largest number of steps.
    """
    rays, count = len(depth), free.shape[1]
    total = rays + PRIORS
    world = np.empty_like(planes)
    now, moved = np.empty(total), np.empty(total)
    slopes = np.empty((count, total))
    matrix, damped = np.empty((count, count)), np.empty((count, count))
    gradient, step = np.empty(count), np.empty(count)
    change = np.empty(9)
    place, turned, grown = position.copy(), rotation.copy(), logs.copy()
    damping = 1e-3
    cost = 0.0
    for number in range(steps):
        part = min(1.0, number / max(1.0, 0.6 * steps))
        width = wide * (narrow / wide) ** part
        _place(planes, position, rotation, np.exp(logs), world)
        _residuals(
            world, starts, position, rotation, np.exp(logs), middle, origin, vectors, depth, on, now
        )
        _priors(starts, corners, middle, position, rotation, logs, prior, now[rays:])
        cost = 0.0
        for n in range(total):
            q = (now[n] / width) ** 2
            cost += q / (1 + q) if n < rays else q
        for k in range(count):
            small = 1e-5
            for i in range(9):
                change[i] = free[i, k] * small
            for i in range(3):
                place[i] = position[i] + change[i]
                grown[i] = logs[i] + change[6 + i]
            _rotate(change[3:6], rotation, turned)
            _place(planes, place, turned, np.exp(grown), world)
            _residuals(
                world, starts, place, turned, np.exp(grown), middle, origin, vectors, depth, on,
                moved,
            )  # fmt: skip
            _priors(starts, corners, middle, place, turned, grown, prior, moved[rays:])
            for n in range(total):
                slopes[k, n] = (moved[n] - now[n]) / small
        for a in range(count):
            gradient[a] = 0.0
            for b in range(a + 1):
                matrix[a, b] = 0.0
        for n in range(total):
            q = (now[n] / width) ** 2
            weight = 1 / (1 + q) ** 2 if n < rays else 1.0
            for a in range(count):
                scaled = weight * slopes[a, n]
                gradient[a] -= scaled * now[n]
                for b in range(a + 1):
                    matrix[a, b] += scaled * slopes[b, n]
        better = False
        for _ in range(5):
            for a in range(count):
                for b in range(a + 1):
                    damped[a, b] = matrix[a, b]
                damped[a, a] += damping * matrix[a, a] + 1e-5
            if not _solve(damped, gradient, count, step):
                damping *= 10
                continue
            largest = 0.0
            for k in range(count):
                largest = max(largest, abs(step[k]))
            shrink = min(1.0, 0.4 / max(largest, 1e-12))
            for i in range(9):
                change[i] = 0.0
                for k in range(count):
                    change[i] += free[i, k] * step[k] * shrink
            for i in range(3):
                place[i] = position[i] + change[i]
                grown[i] = min(max(logs[i] + change[6 + i], -7.0), 5.0)
            _rotate(change[3:6], rotation, turned)
            _place(planes, place, turned, np.exp(grown), world)
            _residuals(
                world, starts, place, turned, np.exp(grown), middle, origin, vectors, depth, on,
                moved,
            )  # fmt: skip
            _priors(starts, corners, middle, place, turned, grown, prior, moved[rays:])
            trial = 0.0
            for n in range(total):
                q = (moved[n] / width) ** 2
                trial += q / (1 + q) if n < rays else q
            if trial < cost:
                better = True
                break
            damping *= 5
        if better:
            gain = cost - trial
            position[:], rotation[:], logs[:] = place, turned, grown
            now[:] = moved
            damping = max(damping / 5, 1e-6)
            if part >= 1.0 and gain < 1e-4 * rays * 1e-2:
                break
        elif part >= 1.0:
            break
        else:
            damping = 1e-3
    cost = 0.0
    for n in range(rays):
        q = (now[n] / narrow) ** 2
        cost += q / (1 + q)
    return cost / max(rays, 1)
