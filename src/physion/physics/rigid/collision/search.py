"""Contact search of one step: which hulls are near each other, and where they touch.

1. `find_candidates`: pairs of bodies, then of geoms, whose boxes overlap (each geom has a box in
   its actor's frame; the box round it in world axes is tested). Pairs are visited in a fixed order.
2. `update_candidates`: the manifold of each pair with a body that is awake is brought up to date.
3. `list_contacts`: the points of all manifolds in world coordinates, pair after pair.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.faces import Hulls
from physion.physics.rigid.collision.manifold import Manifolds, clear_manifold
from physion.physics.rigid.collision.pairs import (
    PairSpace,
    keep_pair,
    still_apart,
    update_floor,
    update_pair,
)

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
Flags = NDArray[np.bool_]

FULL = -1
"""Result of `find_candidates` if there is no room for a new pair."""


class SearchScene(NamedTuple):
    """What the search has to know of a scene besides its hulls; N bodies, G geoms, A actors.

    - ``first_geom`` (N + 1,): first geom of each body, and at the end G.
    - ``actor`` (N,): actor of each body; A for what does not move.
    - ``material`` (N + 1, 3): static and dynamic friction, restitution; the last row is the floor.
    """

    first_geom: I64
    actor: I64
    material: F64


class SearchSpace(NamedTuple):
    """State and work space of the search.

    - ``slot`` (G, G + 1): row in the manifolds of every pair of geoms, -1 without; column G is the
      floor. ``counters`` (2,): manifolds in use, steps so far.
    - ``box`` (G, 6), ``body_box`` (N, 6): lower and upper corners in world axes, metres.
    - ``candidate`` (S,): manifolds whose boxes overlap. ``bodies`` (S, 2): the scene bodies of each
      manifold, N for the floor. ``updated`` (S,): manifolds that were brought up to date.
    """

    slot: I32
    counters: I64
    box: F64
    body_box: F64
    candidate: I64
    bodies: I64
    updated: Flags


class ContactList(NamedTuple):
    """Contacts of one step: P pairs of geoms with C points.

    - ``manifold`` (P,): its row. ``actors``, ``bodies`` (P, 2): rows of `Bodies`, and scene
      bodies, the floor N. ``normal`` (P, 3): unit, from the first to the second, world axes.
      ``material`` (P, 3): means of both. ``first`` (P + 1,): first point of each, at the end C.
    - ``point`` (C, 3): metres, world, on the second body. ``gap`` (C,): metres, negative where the
      hulls overlap.
    """

    manifold: I64
    actors: I64
    bodies: I64
    normal: F64
    material: F64
    first: I64
    point: F64
    gap: F64


def new_search_space(geoms: int, bodies: int, capacity: int) -> SearchSpace:
    """Return the space for a search with room for ``capacity`` pairs."""
    return SearchSpace(
        np.full((geoms, geoms + 1), -1, np.int32),
        np.zeros(2, np.int64),
        np.zeros((geoms, 6)),
        np.zeros((bodies, 6)),
        np.zeros(capacity, np.int64),
        np.zeros((capacity, 2), np.int64),
        np.zeros(capacity, np.bool_),
    )


def grown_search_space(space: SearchSpace, capacity: int) -> SearchSpace:
    """Return the same space with room for more pairs."""
    bodies = np.zeros((capacity, 2), np.int64)
    bodies[: len(space.bodies)] = space.bodies
    return space._replace(
        candidate=np.zeros(capacity, np.int64),
        bodies=bodies,
        updated=np.zeros(capacity, np.bool_),
    )


def new_contact_list(capacity: int) -> ContactList:
    """Return room for the contacts of ``capacity`` pairs."""
    return ContactList(
        np.zeros(capacity, np.int64),
        np.zeros((capacity, 2), np.int64),
        np.zeros((capacity, 2), np.int64),
        np.zeros((capacity, 3)),
        np.zeros((capacity, 3)),
        np.zeros(capacity + 1, np.int64),
        np.zeros((4 * capacity, 3)),
        np.zeros(4 * capacity),
    )


# A box with centre c and half extents e, rotated by R and moved by x, fits into the box of centre
# R c + x and half extents |R| e, with |R| the absolute values. Boxes are grown by half the reach.


@in_place_kernel
def update_boxes(
    hulls: Hulls,
    scene: SearchScene,
    x: F64,
    rot: F64,
    reach: float,
    box: F64,
    body_box: F64,
    first: bool,
) -> None:
    """Compute the boxes of all geoms and bodies that can move; with ``first`` of all.

    They are the lower and upper corners in ``box`` (G, 6) and ``body_box`` (N, 6), world axes.
    ``x`` (A + 1, 3), ``rot`` (A + 1, 3, 3) are the poses of the actors, the world last.
    """
    margin = 0.5 * reach
    for body in range(len(scene.actor)):
        a = scene.actor[body]
        if not first and a == len(x) - 1:
            continue
        for i in range(3):
            body_box[body, i] = np.inf
            body_box[body, 3 + i] = -np.inf
        for g in range(scene.first_geom[body], scene.first_geom[body + 1]):
            for i in range(3):
                center = x[a, i]
                half = margin
                for j in range(3):
                    center += rot[a, i, j] * hulls.box[g, j]
                    half += abs(rot[a, i, j]) * hulls.box[g, 3 + j]
                box[g, i] = center - half
                box[g, 3 + i] = center + half
                body_box[body, i] = min(body_box[body, i], center - half)
                body_box[body, 3 + i] = max(body_box[body, 3 + i], center + half)


@in_place_kernel
def _overlap(boxes: F64, i: int, j: int) -> bool:
    """Return whether two boxes share a point."""
    for k in range(3):
        if boxes[i, k] > boxes[j, 3 + k] or boxes[j, k] > boxes[i, 3 + k]:
            return False
    return True


@in_place_kernel
def _enter(space: SearchSpace, manifolds: Manifolds, g: int, h: int, i: int, j: int) -> int:
    """Return the manifold of geoms ``g``, ``h`` of bodies ``i``, ``j``, or `FULL`.

    A pair that was apart in the last step starts without points.
    """
    step = space.counters[1]
    s = int(space.slot[g, h])
    if s < 0:
        s = int(space.counters[0])
        if s == len(manifolds.size):
            return FULL
        space.counters[0] = s + 1
        space.slot[g, h] = s
        manifolds.geoms[s, 0], manifolds.geoms[s, 1] = g, h
        space.bodies[s, 0], space.bodies[s, 1] = i, j
    if manifolds.step[s] < step - 1:
        clear_manifold(manifolds, s)
    manifolds.step[s] = step
    return s


@in_place_kernel
def find_candidates(
    scene: SearchScene,
    manifolds: Manifolds,
    space: SearchSpace,
    actors: int,
    floor: float,
    reach: float,
) -> int:
    """List the manifolds of all pairs whose boxes overlap; return how many, or `FULL`.

    After `FULL` the call can be repeated with more room. ``actors`` is A, ``floor`` and ``reach``
    are metres. The boxes are those of `update_boxes`.
    """
    used = 0
    bodies = len(scene.actor)
    for i in range(bodies):
        for j in range(i + 1, bodies):
            if scene.actor[i] == scene.actor[j]:
                continue
            if not _overlap(space.body_box, i, j):
                continue
            for g in range(scene.first_geom[i], scene.first_geom[i + 1]):
                for h in range(scene.first_geom[j], scene.first_geom[j + 1]):
                    if _overlap(space.box, g, h):
                        s = _enter(space, manifolds, g, h, i, j)
                        if s == FULL:
                            return FULL
                        space.candidate[used] = s
                        used += 1
    for i in range(bodies):
        if scene.actor[i] == actors:
            continue
        for g in range(scene.first_geom[i], scene.first_geom[i + 1]):
            # The box is grown by half of the reach; the other half is the floor's.
            if space.box[g, 2] <= floor + 0.5 * reach:
                s = _enter(space, manifolds, g, len(space.box), i, bodies)
                if s == FULL:
                    return FULL
                space.candidate[used] = s
                used += 1
    return used


@in_place_kernel
def update_candidates(
    hulls: Hulls,
    scene: SearchScene,
    manifolds: Manifolds,
    space: SearchSpace,
    candidates: int,
    x: F64,
    q: F64,
    rot: F64,
    asleep: Flags,
    reach: float,
    floor: float,
    persistent: bool,
    pair: PairSpace,
    again: bool,
) -> None:
    """Bring the manifolds of candidates up to date where a body of the pair is awake.

    Parameters
    ----------
    hulls, scene, manifolds, space, candidates
        The scene, and the first ``candidates`` of ``space.candidate``.
    x, q, rot : (A + 1, 3), (A + 1, 4), (A + 1, 3, 3)
        Poses of the actors, the world last.
    asleep : (A,)
        Actors that are not simulated.
    reach, floor : float
        Metres: distance below which points are contacts; height of the floor.
    persistent : bool
        See `update_pair`.
    pair : PairSpace
        Work space.
    again : bool
        Second call of a step, after bodies were woken: what was updated is left out.
    """
    actors = len(asleep)
    bodies = len(scene.actor)
    for c in range(candidates):
        s = space.candidate[c]
        i, j = space.bodies[s, 0], space.bodies[s, 1]
        a = scene.actor[i]
        b = scene.actor[j] if j < bodies else np.int64(actors)
        still = (a == actors or asleep[a]) and (b == actors or asleep[b])
        if not again:
            space.updated[s] = not still
        elif space.updated[s] or still:
            continue
        else:
            space.updated[s] = True
        if still:
            continue
        # B to the world is (rot_b, x_b): rot = rot_b^T rot_a, shift = rot_b^T (x_a - x_b).
        dx, dy, dz = x[a, 0] - x[b, 0], x[a, 1] - x[b, 1], x[a, 2] - x[b, 2]
        for m in range(3):
            pair.shift[m] = rot[b, 0, m] * dx + rot[b, 1, m] * dy + rot[b, 2, m] * dz
            for n in range(3):
                pair.rot[m, n] = (
                    rot[b, 0, m] * rot[a, 0, n]
                    + rot[b, 1, m] * rot[a, 1, n]
                    + rot[b, 2, m] * rot[a, 2, n]
                )
        if j == bodies:
            count = update_floor(hulls, manifolds, s, q[a], reach, floor, persistent, pair)
        else:
            before = int(manifolds.size[s])
            if before == 0 and still_apart(
                manifolds, s, pair.rot, pair.shift, hulls.extent[manifolds.geoms[s, 0]], reach
            ):
                continue
            if persistent and keep_pair(hulls, manifolds, s, pair.rot, pair.shift, q[a], q[b]):
                count = manifolds.size[s]
            else:
                before = before if persistent else -1
                count = update_pair(hulls, manifolds, s, q[a], q[b], before, reach, pair)
        touching = 0
        for k in range(count):
            if manifolds.gap[s, k] <= reach:
                touching = 1
        manifolds.touching[s] = touching
        if touching == 0:
            manifolds.anchor_count[s] = 0


@in_place_kernel
def list_contacts(
    scene: SearchScene,
    manifolds: Manifolds,
    space: SearchSpace,
    candidates: int,
    x: F64,
    rot: F64,
    reach: float,
    contacts: ContactList,
) -> int:
    """Fill ``contacts`` with the points of all updated manifolds; return the number of pairs."""
    actors = len(x) - 1
    bodies = len(scene.actor)
    pairs = 0
    used = 0
    for c in range(candidates):
        s = space.candidate[c]
        if not space.updated[s] or manifolds.touching[s] == 0:
            continue
        i, j = space.bodies[s, 0], space.bodies[s, 1]
        a = scene.actor[i]
        b = scene.actor[j] if j < bodies else np.int64(actors)
        contacts.first[pairs] = used
        for k in range(manifolds.size[s]):
            if manifolds.gap[s, k] > reach:
                continue
            for m in range(3):
                contacts.point[used, m] = (
                    x[b, m]
                    + rot[b, m, 0] * manifolds.point_b[s, k, 0]
                    + rot[b, m, 1] * manifolds.point_b[s, k, 1]
                    + rot[b, m, 2] * manifolds.point_b[s, k, 2]
                )
            contacts.gap[used] = manifolds.gap[s, k]
            used += 1
        for m in range(3):
            # Directions of manifolds point from B to A, normals of contacts from A to B.
            contacts.normal[pairs, m] = -(
                rot[b, m, 0] * manifolds.direction[s, 0]
                + rot[b, m, 1] * manifolds.direction[s, 1]
                + rot[b, m, 2] * manifolds.direction[s, 2]
            )
            contacts.material[pairs, m] = 0.5 * (scene.material[i, m] + scene.material[j, m])
        contacts.manifold[pairs] = s
        contacts.actors[pairs, 0], contacts.actors[pairs, 1] = a, b
        contacts.bodies[pairs, 0], contacts.bodies[pairs, 1] = i, j
        pairs += 1
    contacts.first[pairs] = used
    return pairs
