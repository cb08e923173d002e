"""Contacts of one step: MuJoCo's between bodies, our own between bodies and the floor."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from physion.physics.contact_solver import ContactSet, rotation_matrix
from physion.physics.rigid_model import RigidModel
from physion.physics.settings import Settings

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MANIFOLD_SIZE = 4
"""Points that PhysX keeps of a pair of convex shapes."""


class ContactFinder:
    """Finds the contacts of a model at given poses."""

    def __init__(self, model: RigidModel, settings: Settings, floor: float) -> None:
        self.model = model
        self.reach = 2.0 * settings.contact_offset
        self.floor = floor
        self.physics = model.mujoco_model
        self.data = mujoco.MjData(self.physics)
        # MuJoCo numbers geoms body by body; ours are in the order of the scene.
        names = [self.physics.geom(i).name for i in range(self.physics.ngeom)]
        self.geom_of = np.array([int(name.removeprefix("geom")) for name in names], np.int64)
        self.qpos = self.data.qpos.reshape(-1, 7)
        moving = model.actor_of[model.geom_body] < model.actors
        self.moving_geoms = np.flatnonzero(moving).astype(np.int64)

    def find(self, x: Array, q: Array) -> tuple[ContactSet, Index]:
        """Contacts with actors at ``x``, ``q``; and the two scene bodies of each (-1: floor)."""
        model = self.model
        self.qpos[:, :3] = x[:-1]
        self.qpos[:, 3:] = q[:-1]
        mujoco.mj_kinematics(self.physics, self.data)
        mujoco.mj_comPos(self.physics, self.data)
        mujoco.mj_collision(self.physics, self.data)
        found = self.data.contact
        geoms = self.geom_of[found.geom] if self.data.ncon else np.zeros((0, 2), np.int64)
        arrays, pairs = _merge(
            geoms,
            np.asarray(found.dist).reshape(-1),
            np.asarray(found.pos).reshape(-1, 3),
            np.asarray(found.frame).reshape(-1, 9),
            self.moving_geoms,
            model.geom_body,
            model.actor_of,
            model.vertices,
            model.first_vertex,
            model.material,
            x,
            q,
            self.reach,
            self.floor,
        )
        return ContactSet(*arrays), pairs


@njit(cache=True)
def _merge(
    geoms: Any,
    distance: Any,
    position: Any,
    frame: Any,
    moving_geoms: Any,
    geom_body: Any,
    actor_of: Any,
    vertices: Any,
    first_vertex: Any,
    material: Any,
    x: Any,
    q: Any,
    reach: float,
    height: float,
) -> Any:
    """Both kinds of contact, sorted by pair of geoms; the floor counts as a last geom."""
    total = len(geom_body)
    floor = np.int64(total)
    room = len(geoms) + MANIFOLD_SIZE * len(moving_geoms)
    key = np.zeros(room, np.int64)
    pair = np.zeros((room, 2), np.int64)
    actor = np.zeros((room, 2), np.int64)
    normal, point = np.zeros((room, 3)), np.zeros((room, 3))
    separation, rubbing = np.zeros(room), np.zeros((room, 3))
    used = 0
    for c in range(len(geoms)):
        if distance[c] >= reach:
            continue
        g, h = geoms[c, 0], geoms[c, 1]
        sign = 1.0
        if g > h:
            g, h = h, g
            sign = -1.0
        a, b = geom_body[g], geom_body[h]
        key[used] = g * (total + 1) + h
        pair[used, 0], pair[used, 1] = a, b
        actor[used, 0], actor[used, 1] = actor_of[a], actor_of[b]
        for i in range(3):
            normal[used, i] = sign * frame[c, i]
            point[used, i] = position[c, i]
            rubbing[used, i] = 0.5 * (material[a, i] + material[b, i])
        separation[used] = distance[c]
        used += 1
    still = len(x) - 1
    for g in moving_geoms:
        body = geom_body[g]
        a = actor_of[body]
        corners = vertices[first_vertex[g] : first_vertex[g + 1]]
        points = touching_floor(corners, x[a], q[a], height, reach)
        for k in range(len(points)):
            key[used] = g * (total + 1) + floor
            pair[used, 0], pair[used, 1] = body, -1
            actor[used, 0], actor[used, 1] = a, still
            normal[used, 2] = -1.0
            for i in range(3):
                point[used, i] = points[k, i]
                rubbing[used, i] = 0.5 * (material[body, i] + material[-1, i])
            separation[used] = points[k, 2] - height
            used += 1
    order = np.argsort(key[:used], kind="mergesort")
    contacts = (
        key[order],
        actor[order],
        normal[order],
        point[order],
        separation[order],
        rubbing[order],
    )
    return contacts, pair[order]


@njit(cache=True)
def touching_floor(corners: Any, x: Any, q: Any, height: float, reach: float) -> Any:
    """World positions of at most four corners lower than ``reach`` above the floor."""
    rot = rotation_matrix(q)
    low = np.zeros((len(corners), 3))
    used = 0
    for c in range(len(corners)):
        z = x[2]
        for j in range(3):
            z += rot[2, j] * corners[c, j]
        if z < height + reach:
            for i in range(3):
                low[used, i] = x[i]
                for j in range(3):
                    low[used, i] += rot[i, j] * corners[c, j]
            used += 1
    if used <= MANIFOLD_SIZE:
        return low[:used]
    return low[spread_points(low[:used], low[:used, 2])]


@njit(cache=True)
def spread_points(points: Any, separation: Any) -> Any:
    """Indices of four points that represent all: the deepest, then the ones farthest apart."""
    chosen = np.zeros(4, np.int64)
    chosen[0] = np.argmin(separation)
    best = -1.0
    for i in range(len(points)):
        d = np.sum((points[i] - points[chosen[0]]) ** 2)
        if d > best:
            best = d
            chosen[1] = i
    a, b = points[chosen[0]], points[chosen[1]]
    along = b - a
    length = max(np.sum(along**2), 1e-20)
    # Third and fourth: farthest from the line through the first two, on either side.
    reference = np.zeros(3)
    best = -1.0
    for i in range(len(points)):
        p = points[i] - a
        off = p - along * (np.sum(p * along) / length)
        d = np.sum(off**2)
        if d > best:
            best = d
            chosen[2] = i
            reference = off
    best = -np.inf
    for i in range(len(points)):
        p = points[i] - a
        off = p - along * (np.sum(p * along) / length)
        d = -np.sum(off * reference)
        if d > best:
            best = d
            chosen[3] = i
    unique = np.unique(chosen)
    return unique
