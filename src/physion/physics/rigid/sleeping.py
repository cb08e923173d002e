"""When resting bodies fall asleep, as PhysX decides it."""

from __future__ import annotations

from typing import Any

import numpy as np

from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import inverse
from physion.numerics.rotations import rotate_vector


@kernel
def find_islands(bodies: Any, actors: int) -> Any:
    """(A,) for every actor the lowest actor that it touches, directly or through others.

    ``bodies`` (C, 2) are the actors of the contacts of a step; numbers from ``actors`` on stand
    for things that do not move and join nothing.
    """
    island = np.arange(actors)
    for c in range(len(bodies)):
        a, b = bodies[c, 0], bodies[c, 1]
        if a < actors and b < actors and island[a] != island[b]:
            low, high = min(island[a], island[b]), max(island[a], island[b])
            for i in range(actors):
                if island[i] == high:
                    island[i] = low
    return island


@kernel
def wake_touched(island: Any, asleep: Any, counter: Any, wake_time: float) -> None:
    """Wake every sleeping actor whose island holds one that is awake."""
    for i in range(len(island)):
        if asleep[i]:
            continue
        for j in range(len(island)):
            if asleep[j] and island[j] == island[i]:
                asleep[j] = False
                counter[j] = wake_time


@kernel
def update_sleep(
    bodies: Any,
    island: Any,
    v: Any,
    w: Any,
    q: Any,
    inv_inertia: Any,
    inv_mass: Any,
    counter: Any,
    still_v: Any,
    still_w: Any,
    asleep: Any,
    threshold: float,
    wake_time: float,
    dt: float,
) -> None:
    """Advance the sleep clocks of all actors by a step.

    ``v``, ``w`` are the velocities that moved the poses. ``counter`` (A,) counts down from
    ``wake_time``; in its second half the velocities add up in ``still_v``, ``still_w`` (A, 3), and
    a sum with more energy than ``threshold`` times one plus the number of touching neighbours
    starts it anew. An island falls asleep when all its clocks are down.
    """
    actors = len(counter)
    touching = np.zeros((actors, actors + 1), np.bool_)
    opposite = np.zeros(4)
    for c in range(len(bodies)):
        a, b = bodies[c, 0], bodies[c, 1]
        if a < actors:
            touching[a, b] = True
        if b < actors:
            touching[b, a] = True
    for i in range(actors):
        if asleep[i]:
            continue
        if counter[i] < 0.5 * wake_time or counter[i] < dt:
            energy = 0.0
            for j in range(3):
                still_v[i, j] += v[i, j]
                energy += still_v[i, j] ** 2
            # Spins add up in the body's own axes, so that a steady roll is not taken for rest.
            opposite[:] = -q[i]
            opposite[0] = q[i, 0]
            local = rotate_vector(opposite, w[i])
            for j in range(3):
                still_w[i, j] += local[j]
            inertia = inverse(inv_inertia[i])
            spin = 0.0
            for j in range(3):
                for k in range(3):
                    spin += still_w[i, j] * inertia[j, k] * still_w[i, k]
            energy += inv_mass[i] * spin
            neighbours = 0
            for j in range(actors + 1):
                neighbours += touching[i, j]
            limit = (1.0 + neighbours) * threshold
            if 0.5 * energy >= limit:
                still_v[i] = 0.0
                still_w[i] = 0.0
                factor = min(0.5 * energy / limit, 2.0) if limit > 0 else 2.0
                counter[i] = factor * 0.5 * wake_time + dt * neighbours
                continue
        counter[i] = max(counter[i] - dt, 0.0)
    for i in range(actors):
        if island[i] != i:
            continue
        ready = True
        for j in range(actors):
            if island[j] == i and counter[j] > 0.0:
                ready = False
        if not ready:
            continue
        for j in range(actors):
            if island[j] == i and not asleep[j]:
                asleep[j] = True
                still_v[j] = 0.0
                still_w[j] = 0.0
