"""Contacts of one step: MuJoCo finds the pairs of bodies, `manifold` their points and the floor."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from physion.physics.rigid.manifold import Candidates, Geoms, ManifoldOptions, collect_contacts
from physion.physics.rigid.model import RigidModel
from physion.physics.rigid.settings import RigidSettings
from physion.physics.rigid.solver_records import ContactSet

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

PARALLEL_COSINE = 0.9
"""Cosine between a face and the contact normal above which faces are clipped."""


class ContactFinder:
    """Contact search of one model: call `find` with poses.

    ``floor`` is the height of the floor in metres.
    """

    def __init__(self, model: RigidModel, settings: RigidSettings, floor: float) -> None:
        self.model = model
        self.physics = model.mujoco_model
        self.data = mujoco.MjData(self.physics)
        # MuJoCo numbers geoms body by body; ours are in the order of the scene.
        names = [self.physics.geom(i).name for i in range(self.physics.ngeom)]
        self.geom_of = np.array([int(name.removeprefix("geom")) for name in names], np.int64)
        self.qpos = self.data.qpos.reshape(-1, 7)
        moving = model.actor_of[model.geom_body] < model.actors
        self.geoms = Geoms(
            model.geom_body,
            model.actor_of,
            np.flatnonzero(moving).astype(np.int64),
            model.material,
        )
        # Both surfaces have the offset.
        self.options = ManifoldOptions(2.0 * settings.contact_offset, PARALLEL_COSINE, floor)

    def find(self, x: F64, q: F64) -> tuple[ContactSet, I64]:
        """Find the contacts with actors at ``x`` (A + 1, 3), ``q`` (A + 1, 4).

        Returns them with the two scene bodies (C, 2) of each; -1 is the floor.
        """
        self.qpos[:, :3] = x[:-1]
        self.qpos[:, 3:] = q[:-1]
        mujoco.mj_kinematics(self.physics, self.data)
        mujoco.mj_comPos(self.physics, self.data)
        mujoco.mj_collision(self.physics, self.data)
        contact = self.data.contact
        candidates = Candidates(
            self.geom_of[contact.geom] if self.data.ncon else np.zeros((0, 2), np.int64),
            np.asarray(contact.dist).reshape(-1),
            np.asarray(contact.pos).reshape(-1, 3),
            np.asarray(contact.frame).reshape(-1, 9),
        )
        arrays, bodies = collect_contacts(
            candidates, self.geoms, self.model.hulls, x, q, self.options
        )
        return ContactSet(*arrays), bodies
