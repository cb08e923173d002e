"""Training examples: successive states of the objects of each clip, rotated and disturbed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from physion.errors import BadInputError
from physion.models.batch import Batch
from physion.models.particles.bodies import (
    RIGID,
    ParticleSettings,
    poses_of,
    put_by_events,
    scene_particles,
)
from physion.models.particles.graph import drift_of
from physion.models.particles.layout import (
    ObjectState,
    SceneLayout,
    join_poses,
    join_scenes,
    rotate_scenes,
)
from physion.models.particles.rigid_motion import rotation_from_vector


@dataclass(frozen=True, eq=False)
class Window:
    """Objects of several clips, and their states: the first two are known, ``later`` follows."""

    layout: SceneLayout
    before: ObjectState
    now: ObjectState
    later: tuple[ObjectState, ...]


def read_window(batch: Batch, settings: ParticleSettings, device: torch.device) -> Window:
    """Return the objects of the clips that are there in all frames, and their states."""
    if batch.state is None or batch.frames.shape[1] < 3:
        raise BadInputError("a particle model is trained on motions in windows of 3 or more frames")
    frames = torch.as_tensor(batch.frames).cpu().numpy()
    particles, poses = [], []
    for motion, shown in zip(batch.state, frames, strict=True):
        present = np.all([motion.scene.present(int(frame)) for frame in shown], axis=0)
        present[put_by_events(motion.scene, int(shown[0]), int(shown[-1]))] = False
        own = scene_particles(motion.scene, settings, present.tolist())
        particles.append(own)
        poses.append(poses_of(own, motion, shown))
    layout = join_scenes(particles, device)
    before, now, *later = (join_poses(poses, row, device) for row in range(frames.shape[1]))
    return Window(layout, before, now, tuple(later))


def rotated(window: Window) -> Window:
    """Return a window whose scenes are rotated about the vertical by random angles.

    Gravity and floor do not change under such a rotation, so it gives other examples of the same
    laws.
    """
    layout = window.layout
    angle = 2 * math.pi * torch.rand(layout.scenes, dtype=torch.float64, device=layout.shape.device)
    zero = torch.zeros_like(angle)
    rotations = rotation_from_vector(torch.stack([zero, zero, angle], -1))
    states = (window.before, window.now, *window.later)
    before, now, *later = (rotate_scenes(state, layout, rotations) for state in states)
    return Window(layout, before, now, tuple(later))


def disturbed(window: Window, velocity_noise: float, relative_noise: float) -> Window:
    """Return a window with noise, so that a network learns to correct its own errors.

    The first state alone is moved: the last velocity is wrong, and the states that are to be
    predicted are not (Sanchez-Gonzalez et al. 2020, section 3.3). The noise of a rotation moves the
    rim of a body as far as that of its centre moves the centre.

    Parameters
    ----------
    window
        The window.
    velocity_noise, relative_noise : float
        Standard deviations by axis: metres a step, and a fraction of the speed of the centre and
        rim of a body or of a particle of a cloth. They are independent.
    """
    layout, first = window.layout, window.before
    drift = drift_of(layout, first, window.now)
    rim = drift.spin.norm(dim=-1, keepdim=True) * layout.size[:, None]
    speed = drift.velocity.norm(dim=-1, keepdim=True) + rim
    loose_speed = drift.moves[layout.loose].norm(dim=-1, keepdim=True)

    def noise(speed: Tensor) -> Tensor:
        scale = (velocity_noise**2 + (relative_noise * speed) ** 2).sqrt()
        return scale * torch.randn(len(speed), 3, dtype=speed.dtype, device=speed.device)

    free = (layout.kinds == RIGID).to(speed.dtype)[:, None]
    turn = rotation_from_vector(noise(speed) * free / layout.size[:, None])
    before = ObjectState(
        first.centers + noise(speed) * free,
        turn @ first.rotations,
        first.loose + noise(loose_speed),
    )
    return Window(layout, before, window.now, window.later)
