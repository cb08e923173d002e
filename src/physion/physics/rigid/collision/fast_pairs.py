"""Pairs of bodies that move so fast in a step that their hulls could pass through each other.

Each hull has a threshold, `THRESHOLD_FRACTION` of the radius of a ball inside it. A pair of hulls
is swept (`physion.physics.rigid.collision.sweep`) where the motion of one body relative to the
other in the step is longer than the sum of their thresholds. The motion of a body is that of its
origin; hulls are swept with their rotation at the end of the step. A hit counts only if the motion
along its normal is at least as long as the thresholds. After PhysX 4 (``PxsCCD.cpp``,
``computeBoundsWithCCDThreshold``). The floor is not swept against: no hull passes a half-space.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.faces import Hulls
from physion.physics.rigid.collision.pairs import PairSpace
from physion.physics.rigid.collision.search import SearchScene
from physion.physics.rigid.collision.sweep import time_of_impact

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Flags = NDArray[np.bool_]

THRESHOLD_FRACTION = 0.75
"""Part of the inscribed radius that a hull may move in a step without being swept (PhysX)."""


class SweepScene(NamedTuple):
    """What sweeps have to know of a scene; N bodies, G geoms.

    - ``threshold`` (G,): metres of motion in a step. ``least`` (N,): the least of each body's.
    - ``origin`` (N, 3): origin of each body in its actor's frame, metres.
    """

    threshold: F64
    least: F64
    origin: F64


class Sweeps(NamedTuple):
    """State of the sweeps of one step; N bodies, G geoms, A actors and the world.

    - ``start_x`` (A + 1, 3), ``start_q`` (A + 1, 4): poses at the start of the step.
    - ``motion`` (N, 3): way of each body's origin in the step, metres; 0 once it is stopped.
      ``origin`` (N, 3): where it ends.
    - ``stopped`` (A + 1,): actors that a hit has stopped. ``stop_time`` (A + 1,): when, as a part
      of the step; 0 for others.
    - ``box`` (G, 6), ``body_box`` (N, 6): boxes at the end of the step.
    - ``relative`` (3,), ``local`` (3,): motion of the pair at hand, world axes and frame of B.
    - ``hit`` (8,): normal from B to A, point of B, both in world axes; depth, and the way left to
      the pair along the normal, metres. ``geoms``, ``bodies`` (2,): those of A and B.
    - ``contact`` (A, 8), ``contact_bodies`` (A, 2): answered hits: point, normal from the first
      body to the second, impulse in N s, gap in metres.
    """

    start_x: F64
    start_q: F64
    motion: F64
    origin: F64
    stopped: Flags
    stop_time: F64
    box: F64
    body_box: F64
    relative: F64
    local: F64
    hit: F64
    geoms: I64
    bodies: I64
    contact: F64
    contact_bodies: I64


DEPTH, ALONG = 6, 7
"""Columns of ``Sweeps.hit`` after normal and point."""


def new_sweeps(geoms: int, bodies: int, actors: int) -> Sweeps:
    """Return the space for the sweeps of a scene."""
    return Sweeps(
        np.zeros((actors + 1, 3)),
        np.zeros((actors + 1, 4)),
        np.zeros((bodies, 3)),
        np.zeros((bodies, 3)),
        np.zeros(actors + 1, np.bool_),
        np.zeros(actors + 1),
        np.zeros((geoms, 6)),
        np.zeros((bodies, 6)),
        np.zeros(3),
        np.zeros(3),
        np.zeros(8),
        np.zeros(2, np.int64),
        np.zeros(2, np.int64),
        np.zeros((actors, 8)),
        np.zeros((actors, 2), np.int64),
    )


def sweep_scene(inradius: F64, first_geom: I64, origin: F64) -> SweepScene:
    """Return the record for hulls with these radii (G,) of a ball inside them."""
    threshold = THRESHOLD_FRACTION * inradius
    least = [
        threshold[start:stop].min() if stop > start else np.inf
        for start, stop in pairwise(first_geom.tolist())
    ]
    return SweepScene(threshold, np.array(least), origin)


@in_place_kernel
def is_fast(scene: SearchScene, swept: SweepScene, i: int, j: int, sweeps: Sweeps) -> bool:
    """Return whether bodies ``i`` and ``j`` of two actors move farther than their thresholds."""
    if scene.actor[i] == scene.actor[j]:
        return False
    way = 0.0
    for k in range(3):
        way += (sweeps.motion[i, k] - sweeps.motion[j, k]) ** 2
    return bool(way > (swept.least[i] + swept.least[j]) ** 2)


@in_place_kernel
def any_fast(scene: SearchScene, swept: SweepScene, sweeps: Sweeps) -> bool:
    """Return whether any pair of bodies `is_fast`."""
    for i in range(len(scene.actor)):
        for j in range(i + 1, len(scene.actor)):
            if is_fast(scene, swept, i, j, sweeps):
                return True
    return False


@in_place_kernel
def _paths_meet(boxes: F64, i: int, j: int, motion: F64) -> bool:
    """Return whether box ``i`` on its way by ``motion`` to where it is meets box ``j``."""
    for k in range(3):
        back = motion[k]
        if boxes[i, k] - max(back, 0.0) > boxes[j, 3 + k]:
            return False
        if boxes[j, k] > boxes[i, 3 + k] - min(back, 0.0):
            return False
    return True


@in_place_kernel
def _start_pair(a: int, b: int, x: F64, rot: F64, sweeps: Sweeps, pair: PairSpace) -> None:
    """Set the pose of actor ``a`` in the frame of ``b`` where the motion ``relative`` starts."""
    relative = sweeps.relative
    for m in range(3):
        sweeps.local[m] = 0.0
        pair.shift[m] = 0.0
        for n in range(3):
            sweeps.local[m] += rot[b, n, m] * relative[n]
            pair.shift[m] += rot[b, n, m] * (x[a, n] - x[b, n] - relative[n])
            pair.rot[m, n] = (
                rot[b, 0, m] * rot[a, 0, n]
                + rot[b, 1, m] * rot[a, 1, n]
                + rot[b, 2, m] * rot[a, 2, n]
            )


@in_place_kernel
def _keep_hit(
    b: int,
    left: F64,
    way: float,
    x: F64,
    rot: F64,
    sweeps: Sweeps,
    closest: F64,
) -> None:
    """Store the hit of ``closest`` in world axes.

    Actor ``b`` has the part ``way`` of its motion ``left`` (3,) before it at the hit.
    """
    hit = sweeps.hit
    for m in range(3):
        hit[m] = 0.0
        hit[3 + m] = x[b, m] - way * left[m]
        for n in range(3):
            hit[m] += rot[b, m, n] * closest[n]
            hit[3 + m] += rot[b, m, n] * closest[6 + n]
    hit[DEPTH] = max(closest[9], 0.0)


@in_place_kernel
def first_hit(
    hulls: Hulls,
    scene: SearchScene,
    swept: SweepScene,
    x: F64,
    rot: F64,
    sweeps: Sweeps,
    pair: PairSpace,
) -> float:
    """Find the first hit of all fast pairs with an actor that is not stopped.

    ``x`` (A + 1, 3), ``rot`` (A + 1, 3, 3): poses at the end of the step, of stopped actors where
    they stopped. Returns the time of the hit as a part of the step, infinity without one; it is
    described in ``sweeps``.
    """
    first = np.inf
    bodies, world = len(scene.actor), len(x) - 1
    relative, stop_time = sweeps.relative, sweeps.stop_time
    for i in range(bodies):
        a = scene.actor[i]
        for j in range(i + 1, bodies):
            b = scene.actor[j]
            done_a, done_b = a == world or sweeps.stopped[a], b == world or sweeps.stopped[b]
            if (done_a and done_b) or not is_fast(scene, swept, i, j, sweeps):
                continue
            # After one of the pair has stopped, the rest of the other's way is swept.
            begin = max(stop_time[a], stop_time[b])
            way = 0.0
            for k in range(3):
                relative[k] = (1.0 - begin) * (sweeps.motion[i, k] - sweeps.motion[j, k])
                way += relative[k] * relative[k]
            if not _paths_meet(sweeps.body_box, i, j, relative):
                continue
            for g in range(scene.first_geom[i], scene.first_geom[i + 1]):
                for h in range(scene.first_geom[j], scene.first_geom[j + 1]):
                    limit = swept.threshold[g] + swept.threshold[h]
                    if way <= limit * limit or not _paths_meet(sweeps.box, g, h, relative):
                        continue
                    _start_pair(a, b, x, rot, sweeps, pair)
                    latest = min((first - begin) / (1.0 - begin), 1.0)
                    time = time_of_impact(hulls, g, h, sweeps.local, latest, pair)
                    if time >= latest:
                        continue
                    along = 0.0
                    for k in range(3):
                        along -= pair.closest[k] * sweeps.local[k]
                    if along < limit:
                        continue
                    first = begin + (1.0 - begin) * time
                    _keep_hit(b, sweeps.motion[j], 1.0 - first, x, rot, sweeps, pair.closest)
                    sweeps.hit[ALONG] = along
                    sweeps.geoms[0], sweeps.geoms[1] = g, h
                    sweeps.bodies[0], sweeps.bodies[1] = i, j
    return first
