"""Friction anchors: the points at which a pair of hulls is held by friction.

The contacts of a pair of hulls form a patch: they have one normal. A patch is held at up to two
anchors, which are kept from step to step in the manifold of the pair; second and last phase of the
contact solver (`physion.physics.rigid.solver`).
"""

from __future__ import annotations

import numpy as np

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.manifold import Manifolds
from physion.physics.rigid.collision.search import ContactList
from physion.physics.rigid.solver_records import F64, Bodies, Flags, SolverOptions

MAX_ANCHORS = 2
"""Friction anchors of a patch (PhysX's ``FrictionPatch`` has room for two)."""
MIN_ANCHOR_SPREAD = 4.0
"""Two anchors are kept while the diagonal of the patch is at most twice their distance: its square
is at most this many times theirs."""


@in_place_kernel
def to_world(bodies: Bodies, a: int, local: F64, out: F64) -> None:
    """Fill ``out`` (3,) with x + R local of actor ``a``."""
    rot, x = bodies.rot, bodies.x
    for i in range(3):
        out[i] = (
            x[a, i] + rot[a, i, 0] * local[0] + rot[a, i, 1] * local[1] + rot[a, i, 2] * local[2]
        )


@in_place_kernel
def _to_local(bodies: Bodies, a: int, world: F64, out: F64) -> None:
    """Fill ``out`` (3,) with R^T (world - x) of actor ``a``."""
    rot, x = bodies.rot, bodies.x
    dx, dy, dz = world[0] - x[a, 0], world[1] - x[a, 1], world[2] - x[a, 2]
    for i in range(3):
        out[i] = rot[a, 0, i] * dx + rot[a, 1, i] * dy + rot[a, 2, i] * dz


@in_place_kernel
def _copy(point: F64, out: F64) -> None:
    """Fill ``out`` (3,) with a point (3,)."""
    for i in range(3):
        out[i] = point[i]


@in_place_kernel
def _squared_distance(a: F64, b: F64) -> float:
    """Return |a - b|^2 of points (3,)."""
    return float((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


# Old anchors are kept while both bodies still agree about the patch, and it is that of the present
# contacts:
#     (R_a n_a) . (R_b n_b) > patch_cosine,   |(p_a - p_b) . n| < anchor_distance for each anchor,
#     (R_a n_a) . n >= patch_cosine,
# where n_a, n_b and p_a, p_b are its normal and anchors as each body carries them along, and n is
# the normal of the present contacts.
# PhysX: `getFrictionPatches` (what is kept) and `correlatePatches` (PXC_SAME_NORMAL is our
# patch_cosine). Deviation: PhysX merges the contacts of all hulls of two bodies where normals
# agree; here a pair of hulls is a patch.


@in_place_kernel
def keep_anchors(
    contacts: ContactList, p: int, manifolds: Manifolds, bodies: Bodies, options: SolverOptions
) -> None:
    """Forget the anchors of pair ``p`` where the bodies no longer agree about them."""
    s = contacts.manifold[p]
    a, b = contacts.actors[p, 0], contacts.actors[p, 1]
    count = manifolds.anchor_count[s]
    if count == 0:
        return
    rot, x = bodies.rot, bodies.x
    local = manifolds.anchor_normal
    between = along = 0.0
    n0 = n1 = n2 = 0.0
    for i in range(3):
        na = nb = 0.0
        for j in range(3):
            na += rot[a, i, j] * local[s, 0, j]
            nb += rot[b, i, j] * local[s, 1, j]
        between += na * nb
        along += na * contacts.normal[p, i]
        if i == 0:
            n0 = na
        elif i == 1:
            n1 = na
        else:
            n2 = na
    keep = between > options.patch_cosine and along >= options.patch_cosine
    for k in range(count):
        gap = 0.0
        for i in range(3):
            pa, pb = x[a, i], x[b, i]
            for j in range(3):
                pa += rot[a, i, j] * manifolds.anchor[s, 0, k, j]
                pb += rot[b, i, j] * manifolds.anchor[s, 1, k, j]
            gap += (pa - pb) * (n0 if i == 0 else (n1 if i == 1 else n2))
        keep = keep and abs(gap) < options.anchor_distance
    if not keep:
        manifolds.anchor_count[s] = 0


# A patch is held at up to two contact points that lie far apart: the first candidate, then whatever
# lies farther than anchor_distance from it, then each further point replaces the nearer of the two
# where that lengthens their distance. Two old anchors stay, unless the patch has grown to more than
# twice their distance: huddled in a corner they would hold it badly, so both are chosen anew.
# PhysX: `growPatches`, with frictionOffsetThreshold as our anchor_gap. No deviation is known.


@in_place_kernel
def grow_anchors(
    contacts: ContactList,
    p: int,
    manifolds: Manifolds,
    bodies: Bodies,
    options: SolverOptions,
    world: F64,
) -> None:
    """Give pair ``p`` up to two anchors, chosen from its contact points; old ones stay if they fit.

    Contacts farther apart than ``options.anchor_gap`` metres hold no anchor. ``world`` (2, 3) is
    work space.
    """
    s = contacts.manifold[p]
    a, b = contacts.actors[p, 0], contacts.actors[p, 1]
    start, stop = contacts.first[p], contacts.first[p + 1]
    count, anchor = manifolds.anchor_count, manifolds.anchor
    if count[s] == MAX_ANCHORS:
        diagonal = 0.0
        for i in range(3):
            low, high = np.inf, -np.inf
            for c in range(start, stop):
                low = min(low, contacts.point[c, i])
                high = max(high, contacts.point[c, i])
            diagonal += (high - low) ** 2
        spread = _squared_distance(anchor[s, 0, 0], anchor[s, 0, 1])
        if MIN_ANCHOR_SPREAD * spread >= diagonal:
            return
        count[s] = 0
    old = count[s]
    have = old
    if old == 1:
        to_world(bodies, a, anchor[s, 0, 0], world[0])
    between = 0.0
    for c in range(start, stop):
        if contacts.gap[c] >= options.anchor_gap:
            continue
        point = contacts.point[c]
        if have == 0:
            _copy(point, world[0])
            have = 1
        elif have == 1:
            between = _squared_distance(point, world[0])
            if between > options.anchor_distance**2:
                _copy(point, world[1])
                have = 2
        else:
            d0 = _squared_distance(point, world[0])
            d1 = _squared_distance(point, world[1])
            if d0 > d1:
                if d0 > between:
                    _copy(point, world[1])
                    between = d0
            elif d1 > between:
                _copy(point, world[0])
                between = d1
    for k in range(old, have):
        _to_local(bodies, a, world[k], anchor[s, 0, k])
        _to_local(bodies, b, world[k], anchor[s, 1, k])
    count[s] = have


# Patches that did not slip in the last sweep keep their anchors and normal in the frames of both
# bodies; the next step's BIAS then pulls the two images of an anchor together again, which is what
# makes static friction hold a position and not only a velocity.
# PhysX: the ``broken`` flag that `solveContact` sets and `writeBackContact` stores with the patch.


@in_place_kernel
def remember_anchors(
    contacts: ContactList, pairs: int, slipped: Flags, manifolds: Manifolds, bodies: Bodies
) -> None:
    """Keep the anchors of the pairs that did not slip, and forget those of the others.

    ``slipped`` (P,) is that of `Constraints`; ``bodies`` have the poses at which contacts were
    found.
    """
    for p in range(pairs):
        s = contacts.manifold[p]
        if slipped[p]:
            manifolds.anchor_count[s] = 0
            continue
        for side in range(2):
            a = contacts.actors[p, side]
            for j in range(3):
                total = 0.0
                for k in range(3):
                    total += bodies.rot[a, k, j] * contacts.normal[p, k]
                manifolds.anchor_normal[s, side, j] = total
