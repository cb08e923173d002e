"""Friction patches: contacts of one pair of geoms with one normal, and the points held by friction.

First, second and last phase of the contact solver; see `physion.physics.rigid.solver`.
"""

from __future__ import annotations

import numpy as np

from physion.numerics.kernel import kernel
from physion.physics.rigid.solver_records import (
    F64,
    I64,
    AnchorMemory,
    ContactSet,
    Flags,
    Patches,
    SolverBodies,
    SolverOptions,
)

MAX_ANCHORS = 2
"""Friction anchors of a patch (PhysX's ``FrictionPatch`` has room for two)."""
MIN_ANCHOR_SPREAD = 4.0
"""Two anchors are kept while the diagonal of the patch is at most twice their distance: its square
is at most this many times theirs."""


@kernel
def to_world(rot: F64, x: F64, local: F64, out: F64) -> None:
    """Fill ``out`` (3,) with x + R local."""
    for i in range(3):
        out[i] = x[i] + rot[i, 0] * local[0] + rot[i, 1] * local[1] + rot[i, 2] * local[2]


@kernel
def to_local(rot: F64, x: F64, world: F64, out: F64) -> None:
    """Fill ``out`` (3,) with R^T (world - x)."""
    a, b, c = world[0] - x[0], world[1] - x[1], world[2] - x[2]
    for i in range(3):
        out[i] = rot[0, i] * a + rot[1, i] * b + rot[2, i] * c


@kernel
def _squared_distance(a: F64, b: F64) -> float:
    """Return |a - b|^2 of points (3,)."""
    return float((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


# Phase 1: patches.
#
# A remembered patch of the same pair of geoms is taken over while both bodies still agree about it:
#     (R_a n_a) . (R_b n_b) > patch_cosine   and   |(p_a - p_b) . n| < anchor_distance per anchor,
# where n_a, n_b and p_a, p_b are its normal and anchors as each body carries them along. Each
# contact then joins the first patch of its pair whose normal agrees with its own, or opens one.
# PhysX: `getFrictionPatches` (what is kept), `createContactPatches` and `correlatePatches` (which
# contact joins which patch; its PXC_SAME_NORMAL is our patch_cosine). Deviations: contacts are
# grouped by pair of convex pieces, as MuJoCo reports them, not by pair of bodies; materials are not
# compared, since a pair of geoms has one; contacts of a patch need not follow one another.


@kernel
def find_patches(
    contacts: ContactSet, memory: AnchorMemory, bodies: SolverBodies, options: SolverOptions
) -> tuple[Patches, I64]:
    """Group contacts into patches and take over the anchors that still fit.

    Parameters
    ----------
    contacts, memory, bodies, options
        Contacts of this step, anchors of the last one, poses (world axes), thresholds.

    Returns
    -------
    patches : Patches
        Those of the memory come before new ones of the same pair; some have no contact.
    patch_of : (C,)
        The patch of every contact.
    """
    x, rot = bodies.x, bodies.rot
    total = len(contacts.key)
    capacity = total + len(memory.key)
    patch_of = np.full(total, -1, np.int64)
    first = np.zeros(capacity, np.int64)
    pair = np.zeros((capacity, 2), np.int64)
    normal = np.zeros((capacity, 3))
    count = np.zeros(capacity, np.int64)
    anchor = np.zeros((capacity, 2, 2, 3))
    used = 0
    start = 0
    na, nb, pa, pb = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    zero = np.zeros(3)
    while start < total:
        stop = start
        key = contacts.key[start]
        while stop < total and contacts.key[stop] == key:
            stop += 1
        a, b = contacts.bodies[start, 0], contacts.bodies[start, 1]
        base = used
        for m in range(len(memory.key)):
            if memory.key[m] != key:
                continue
            to_world(rot[a], zero, memory.normal[m, 0], na)
            to_world(rot[b], zero, memory.normal[m, 1], nb)
            if na[0] * nb[0] + na[1] * nb[1] + na[2] * nb[2] <= options.patch_cosine:
                continue
            keep = True
            for k in range(memory.anchor_count[m]):
                to_world(rot[a], x[a], memory.point[m, 0, k], pa)
                to_world(rot[b], x[b], memory.point[m, 1, k], pb)
                gap = 0.0
                for i in range(3):
                    gap += (pa[i] - pb[i]) * na[i]
                keep = keep and abs(gap) < options.anchor_distance
            if keep:
                first[used] = -1
                pair[used, 0], pair[used, 1] = a, b
                normal[used] = na
                count[used] = memory.anchor_count[m]
                anchor[used] = memory.point[m]
                used += 1
        for c in range(start, stop):
            n = contacts.normal[c]
            patch = -1
            for p in range(base, used):
                q = normal[p]
                if n[0] * q[0] + n[1] * q[1] + n[2] * q[2] >= options.patch_cosine:
                    patch = p
                    break
            if patch < 0:
                patch = used
                first[used] = -1
                pair[used, 0], pair[used, 1] = a, b
                normal[used] = n
                used += 1
            if first[patch] < 0:
                first[patch] = c
            patch_of[c] = patch
        start = stop
    patches = Patches(first[:used], pair[:used], normal[:used], count[:used], anchor[:used])
    return patches, patch_of


@kernel
def drop_patches_without_contact(patches: Patches, patch_of: I64) -> Patches:
    """Return the patches that have a contact, and renumber ``patch_of`` (C,) to match.

    Anchors of a patch without contact in this step are forgotten.
    """
    keep = np.flatnonzero(patches.first >= 0)
    renumbered = np.full(len(patches.first), -1, np.int64)
    for i in range(len(keep)):
        renumbered[keep[i]] = i
    for c in range(len(patch_of)):
        patch_of[c] = renumbered[patch_of[c]]
    return Patches(
        patches.first[keep],
        patches.bodies[keep],
        patches.normal[keep],
        patches.anchor_count[keep],
        patches.anchor[keep],
    )


# Phase 2: anchors.
#
# A patch is held at up to two contact points that lie far apart: the first candidate, then whatever
# lies farther than anchor_distance from it, then each further point replaces the nearer of the two
# where that lengthens their distance. Two old anchors stay, unless the patch has grown to more than
# twice their distance: huddled in a corner they would hold it badly, so both are chosen anew.
# PhysX: `growPatches`, with frictionOffsetThreshold as our anchor_gap. No deviation is known.


@kernel
def grow_anchors(
    contacts: ContactSet,
    patch_of: I64,
    patches: Patches,
    patch: int,
    bodies: SolverBodies,
    options: SolverOptions,
) -> None:
    """Give one patch up to two anchors, chosen from its contact points; old ones stay if they fit.

    Parameters
    ----------
    contacts, patch_of : ContactSet, (C,)
        Contacts, and the patch of each. Those farther apart than ``options.anchor_gap`` metres
        hold no anchor.
    patches, patch : Patches, int
        ``patches.anchor_count[patch]`` and ``patches.anchor[patch]`` are changed.
    bodies, options
        Poses and thresholds.
    """
    x, rot = bodies.x, bodies.rot
    a, b = patches.bodies[patch, 0], patches.bodies[patch, 1]
    count, anchor = patches.anchor_count, patches.anchor
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for c in range(len(patch_of)):
        if patch_of[c] == patch:
            for i in range(3):
                low[i] = min(low[i], contacts.point[c, i])
                high[i] = max(high[i], contacts.point[c, i])
    if count[patch] == MAX_ANCHORS:
        spread = _squared_distance(anchor[patch, 0, 0], anchor[patch, 0, 1])
        if MIN_ANCHOR_SPREAD * spread >= _squared_distance(low, high):
            return
        count[patch] = 0
    world = np.zeros((2, 3))
    old = count[patch]
    have = old
    if old == 1:
        to_world(rot[a], x[a], anchor[patch, 0, 0], world[0])
    between = 0.0
    for c in range(len(patch_of)):
        if patch_of[c] != patch or contacts.separation[c] >= options.anchor_gap:
            continue
        point = contacts.point[c]
        if have == 0:
            world[0] = point
            have = 1
        elif have == 1:
            between = _squared_distance(point, world[0])
            if between > options.anchor_distance**2:
                world[1] = point
                have = 2
        else:
            d0 = _squared_distance(point, world[0])
            d1 = _squared_distance(point, world[1])
            if d0 > d1:
                if d0 > between:
                    world[1] = point
                    between = d0
            elif d1 > between:
                world[0] = point
                between = d1
    for k in range(old, have):
        to_local(rot[a], x[a], world[k], anchor[patch, 0, k])
        to_local(rot[b], x[b], world[k], anchor[patch, 1, k])
    count[patch] = have


# Phase 5: memory.
#
# Patches that did not slip in the last sweep keep their anchors and normal in the frames of both
# bodies; the next step's BIAS then pulls the two images of an anchor together again, which is what
# makes static friction hold a position and not only a velocity.
# PhysX: the ``broken`` flag that `solveContact` sets and `writeBackContact` stores with the patch.


@kernel
def remember_anchors(
    key: I64, patches: Patches, slipped: Flags, bodies: SolverBodies
) -> AnchorMemory:
    """Return the anchors of all patches that did not slip.

    ``key`` (P,) names each patch's pair of geoms; ``slipped`` (P,) is that of `Constraints`.
    """
    holds = np.flatnonzero(~slipped & (patches.anchor_count > 0))
    local = np.zeros((len(holds), 2, 3))
    for i in range(len(holds)):
        p = holds[i]
        for side in range(2):
            rot = bodies.rot[patches.bodies[p, side]]
            for j in range(3):
                for k in range(3):
                    local[i, side, j] += rot[k, j] * patches.normal[p, k]
    return AnchorMemory(key[holds], patches.anchor_count[holds], local, patches.anchor[holds])
