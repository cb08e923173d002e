"""Contacts of one step: MuJoCo's between bodies, our own between bodies and the floor."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from physion.physics.contact_solver import ContactSet, rotation_matrix
from physion.physics.manifold import MANIFOLD_SIZE, WITNESS, face_contacts, spread_points
from physion.physics.rigid_model import RigidModel
from physion.physics.settings import Settings

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PARALLEL = 0.9
"""Cosine between a face and the contact normal above which faces are clipped."""


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
        arrays, pairs = _collect(
            geoms,
            np.asarray(found.dist).reshape(-1),
            np.asarray(found.pos).reshape(-1, 3),
            np.asarray(found.frame).reshape(-1, 9),
            self.moving_geoms,
            model.geom_body,
            model.actor_of,
            model.vertices,
            model.first_vertex,
            model.loops,
            model.first_loop,
            model.first_face,
            model.material,
            x,
            q,
            self.reach,
            self.floor,
            PARALLEL,
        )
        return ContactSet(*arrays), pairs


@njit(cache=True)
def _collect(
    geoms: Any,
    distance: Any,
    position: Any,
    frame: Any,
    moving_geoms: Any,
    geom_body: Any,
    actor_of: Any,
    vertices: Any,
    first_vertex: Any,
    loops: Any,
    first_loop: Any,
    first_face: Any,
    material: Any,
    x: Any,
    q: Any,
    reach: float,
    height: float,
    parallel: float,
) -> Any:
    """Contacts between geoms and with the floor, sorted by pair; the floor is the last geom."""
    total = len(geom_body)
    still = len(x) - 1
    rot = np.zeros((still + 1, 3, 3))
    for a in range(still + 1):
        rot[a] = rotation_matrix(q[a])
    room = MANIFOLD_SIZE * (len(geoms) + len(moving_geoms)) + len(geoms)
    pair = np.zeros((room, 2), np.int64)
    normal, point, separation = np.zeros((room, 3)), np.zeros((room, 3)), np.zeros(room)
    used = 0
    start = 0
    while start < len(geoms):
        g, h = geoms[start, 0], geoms[start, 1]
        stop = start
        deepest = start
        while stop < len(geoms) and geoms[stop, 0] == g and geoms[stop, 1] == h:
            if distance[stop] < distance[deepest]:
                deepest = stop
            stop += 1
        sign = 1.0 if g < h else -1.0
        low, high = min(g, h), max(g, h)
        n = sign * frame[deepest, :3]
        half = 0.5 * distance[deepest] * n
        a, b = actor_of[geom_body[low]], actor_of[geom_body[high]]
        if distance[deepest] < reach:
            along, points, gaps = face_contacts(
                vertices,
                loops,
                first_loop,
                first_face[low : low + 2],
                first_face[high : high + 2],
                rot[a],
                x[a],
                rot[b],
                x[b],
                n,
                position[deepest] - half,
                position[deepest] + half,
                reach,
                WITNESS,
                parallel,
            )
            for k in range(len(points)):
                pair[used, 0], pair[used, 1] = low, high
                normal[used], point[used], separation[used] = along, points[k], gaps[k]
                used += 1
            if len(points) == 0:
                for c in range(start, stop):
                    if distance[c] < reach:
                        pair[used, 0], pair[used, 1] = low, high
                        normal[used] = sign * frame[c, :3]
                        point[used], separation[used] = position[c], distance[c]
                        used += 1
        start = stop
    for g in moving_geoms:
        a = actor_of[geom_body[g]]
        corners = vertices[first_vertex[g] : first_vertex[g + 1]]
        points = touching_floor(corners, x[a], rot[a], height, reach)
        for k in range(len(points)):
            pair[used, 0], pair[used, 1] = g, total
            normal[used, 2] = -1.0
            point[used], separation[used] = points[k], points[k, 2] - height
            used += 1
    key = pair[:used, 0] * (total + 1) + pair[:used, 1]
    order = np.argsort(key, kind="mergesort")
    bodies, actor = np.zeros((used, 2), np.int64), np.zeros((used, 2), np.int64)
    rubbing = np.zeros((used, 3))
    for k in range(used):
        for side in range(2):
            g = pair[order[k], side]
            body = geom_body[g] if g < total else np.int64(-1)
            bodies[k, side] = body
            actor[k, side] = actor_of[body] if g < total else still
            for i in range(3):
                rubbing[k, i] += 0.5 * material[body, i]
    contacts = (key[order], actor, normal[order], point[order], separation[order], rubbing)
    return contacts, bodies


@njit(cache=True)
def touching_floor(corners: Any, x: Any, rot: Any, height: float, reach: float) -> Any:
    """World positions of at most four corners lower than ``reach`` above the floor."""
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
