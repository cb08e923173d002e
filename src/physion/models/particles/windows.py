"""Training examples: three successive states of the objects of each clip, rotated and disturbed."""

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
    """Objects of several clips, and their states in three successive steps."""

    layout: SceneLayout
    before: ObjectState
    now: ObjectState
    after: ObjectState


def read_window(batch: Batch, settings: ParticleSettings, device: torch.device) -> Window:
    """Return the objects of the clips that are there in all three frames, and their states."""
    if batch.state is None or batch.frames.shape[1] != 3:
        raise BadInputError("a particle model is trained on motions in windows of 3 frames")
    frames = torch.as_tensor(batch.frames).cpu().numpy()
    particles, poses = [], []
    for motion, shown in zip(batch.state, frames, strict=True):
        present = np.all([motion.scene.present(int(frame)) for frame in shown], axis=0)
        present[put_by_events(motion.scene, int(shown[0]), int(shown[-1]))] = False
        own = scene_particles(motion.scene, settings, present.tolist())
        particles.append(own)
        poses.append(poses_of(own, motion, shown))
    layout = join_scenes(particles, device)
    before, now, after = (join_poses(poses, row, device) for row in range(3))
    return Window(layout, before, now, after)


def rotated(window: Window) -> Window:
    """Return a window whose scenes are rotated about the vertical by random angles.

    Gravity and floor do not change under such a rotation, so it gives other examples of the same
    laws.
    """
    layout = window.layout
    angle = 2 * math.pi * torch.rand(layout.scenes, dtype=torch.float64, device=layout.shape.device)
    zero = torch.zeros_like(angle)
    rotations = rotation_from_vector(torch.stack([zero, zero, angle], -1))
    states = (window.before, window.now, window.after)
    return Window(layout, *(rotate_scenes(state, layout, rotations) for state in states))


def disturbed(
    window: Window, velocity_noise: float, relative_noise: float, position_noise: float
) -> Window:
    """Return a window with noise, so that a network learns to correct its own errors.

    The first state alone is moved by the velocity noise: the last velocity is wrong, and the third
    state, which is to be predicted, is not (Sanchez-Gonzalez et al. 2020, section 3.3). All three
    are moved by the position noise, which a network is not to correct at once. The noise of a
    rotation moves the rim of a body as far as that of its centre moves the centre.

    Parameters
    ----------
    window
        The window.
    velocity_noise, relative_noise, position_noise : float
        Standard deviations by axis: metres a step, a fraction of the speed of the centre and rim of
        a body or of a particle of a cloth, and metres. The first two are independent.
    """
    layout = window.layout
    free = (layout.kinds == RIGID).double()[:, None]

    def shift_of(scale: Tensor, loose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        angles = scale * torch.randn_like(window.now.centers) / layout.size[:, None]
        return (
            scale * torch.randn_like(window.now.centers) * free,
            rotation_from_vector(angles * free),
            loose * torch.randn_like(window.now.loose),
        )

    def moved(state: ObjectState, shift: tuple[Tensor, Tensor, Tensor]) -> ObjectState:
        center, rotation, loose = shift
        return ObjectState(state.centers + center, rotation @ state.rotations, state.loose + loose)

    def combined(speed: Tensor) -> Tensor:
        return (velocity_noise**2 + (relative_noise * speed) ** 2).sqrt()

    drift = drift_of(layout, window.before, window.now)
    rim = drift.spin.norm(dim=-1, keepdim=True) * layout.size[:, None]
    speed = drift.velocity.norm(dim=-1, keepdim=True) + rim
    loose_speed = drift.moves[layout.loose].norm(dim=-1, keepdim=True)
    place = shift_of(
        torch.full_like(speed, position_noise), torch.full_like(loose_speed, position_noise)
    )
    jolt = shift_of(combined(speed), combined(loose_speed))
    before, now, after = (
        moved(state, place) for state in (window.before, window.now, window.after)
    )
    return Window(layout, moved(before, jolt), now, after)
