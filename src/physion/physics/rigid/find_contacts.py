"""Contacts of one step: MuJoCo's between bodies, our own between bodies and the floor."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from physion.numerics.rotations import rotation_matrices
from physion.physics.rigid.manifold import collect_contacts
from physion.physics.rigid.model import RigidModel
from physion.physics.rigid.settings import Settings
from physion.physics.rigid.solver import ContactSet

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
        arrays, pairs = collect_contacts(
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
            rotation_matrices(q),
            self.reach,
            self.floor,
            PARALLEL,
        )
        return ContactSet(*arrays), pairs
