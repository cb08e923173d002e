"""Training examples: successive states of the objects of each clip, rotated and disturbed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
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
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import FRAME_TIME, GRAVITY

_RIM = 0.2
"""Metres from the centre at which a spin counts as a velocity: about the size of the objects."""
_LEAST, _LARGEST = 1.4, 4.5
"""Changes of velocity in a step, in units of that by gravity, between which they count more."""


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


def start_probabilities(
    trajectory: Trajectory, stride: int, length: int, abrupt: float
) -> NDArray[np.float64]:
    """Return how often a window starts at each frame of a trial.

    Notes
    -----
    Contacts are rare and brief, but decide the outcome. In a step of s seconds gravity changes a
    velocity by g s. With the change c_k of the body that changes most in the step from frame k on,

        c_k = max_b |v_b(k + s) - v_b(k)| + r |w_b(k + s) - w_b(k)|,

    velocity v, angular velocity w and r = `_RIM`, the weight of a window with the predicted steps
    K is max_K c_k, but at most `_LARGEST` g s, and 0 below `_LEAST` g s. The fraction ``abrupt`` of
    the starts is drawn in proportion to the weights, and the others uniformly.

    Parameters
    ----------
    trajectory : Trajectory
        Motion of F frames.
    stride, length : int
        Frames in a step, and frames of a window; the first two are known.
    abrupt : float
        Fraction, 0..1.

    Returns
    -------
    probabilities : ndarray
        (starts,); one start if the trial is shorter than a window.
    """
    starts = max(len(trajectory.positions) - (length - 1) * stride, 1)
    uniform = np.full(starts, 1 / starts)
    speeds = (trajectory.velocities, trajectory.angular_velocities)
    linear, angular = (
        np.linalg.norm(np.nan_to_num(v[stride:] - v[:-stride]), axis=-1) for v in speeds
    )
    changes = (linear + _RIM * angular).astype(np.float64) / (GRAVITY * stride * FRAME_TIME)
    if starts == 1 or not changes.shape[1]:
        return uniform
    predicted = range(stride, (length - 1) * stride, stride)
    steps = np.arange(starts)[:, None] + np.array(predicted)
    weights = changes.max(axis=1)[steps].max(axis=1)
    weights = np.where(weights < _LEAST, 0.0, np.minimum(weights, _LARGEST))
    if not weights.any():
        return uniform
    mixed: NDArray[np.float64] = (1 - abrupt) * uniform + abrupt * weights / weights.sum()
    return mixed


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
