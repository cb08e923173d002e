"""What surrounds the networks: rollouts, windows for training, and the smallest distance.

Several scenes are moved step by step, each until it rests or its time is over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from physion.clips.batch import Batch
from physion.core.errors import BadInputError
from physion.models.gaps import FAR, TOLERANCE, gap_of_bodies, minimise
from physion.models.particles.bodies import (
    CLOTH,
    KINEMATIC,
    RIGID,
    Poses,
    Sampling,
    SceneParticles,
    posed_positions,
    poses_of,
    put_by_events,
    rotation_from_vector,
    scene_particles,
    surface_points,
    vector_from_rotation,
)
from physion.models.particles.neighbours import gap_over_time
from physion.models.particles.networks import (
    ObjectState,
    SceneLayout,
    drift_of,
    join_poses,
    join_scenes,
    rotate_scenes,
)
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import FRAME_TIME, GRAVITY, Scene

F64 = NDArray[np.float64]
Step = Callable[[SceneLayout, ObjectState, ObjectState], ObjectState]
"""Function of the layout and the last two states that returns the next state."""

REST = 0.007
"""Metres a second below which a particle counts as resting."""
REST_TIME = 0.24
"""Seconds after which a scene in which everything rests is over."""
LIMIT = 10.0
"""Metres a step beyond which an object is lost, and its scene over."""


@dataclass(frozen=True, eq=False)
class Start:
    """Scene to be continued: its particles, its motion over the last two steps, its time.

    ``steps``: largest number of steps.
    """

    particles: SceneParticles
    poses: Poses
    steps: int


def disturbed_start(start: Start, spread: float, rng: np.random.Generator) -> Start:
    """Return a scene whose objects have other velocities; ``spread`` metres a step by axis.

    One step earlier centres, rims (by a rotation) and particles of cloths were somewhere else.
    """
    if spread == 0:
        return start
    particles, poses = start.particles, start.poses
    count = len(particles.kinds)
    free = (particles.kinds == RIGID)[:, None]
    centers, rotations, loose = (poses.centers.copy(), poses.rotations.copy(), poses.loose.copy())
    centers[-2] += spread * rng.normal(size=(count, 3)) * free
    angles = torch.from_numpy(
        spread * rng.normal(size=(count, 3)) * free / particles.sizes[:, None]
    )
    rotations[-2] = rotation_from_vector(angles).numpy() @ rotations[-2]
    # Bodies that deform start as rigid ones.
    cloth = particles.kinds[particles.owners[particles.loose]] == CLOTH
    placed = posed_positions(particles, centers[-2:-1], rotations[-2:-1])[0, particles.loose]
    loose[-2, ~cloth] = placed[~cloth]
    loose[-2, cloth] += spread * rng.normal(size=(int(cloth.sum()), 3))
    return replace(start, poses=Poses(centers, rotations, loose))


def roll_out(
    starts: Sequence[Start], step: Step, device: torch.device, seconds: float
) -> list[Poses]:
    """Return the imagined motion of every scene, from the step after its last known one.

    ``seconds`` is the length of a step.

    A scene that is over is taken out of the graph when half of its fellows are over too.
    """
    recorded: list[list[tuple[F64, F64, F64]]] = [[] for _ in starts]
    running = [row for row, start in enumerate(starts) if start.steps > 0]
    quiet = np.zeros(len(starts), np.int64)
    done = np.array([start.steps <= 0 for start in starts])
    while running:
        layout = join_scenes([starts[row].particles for row in running], device)
        poses = [_last(starts[row], recorded[row]) for row in running]
        before, now = (join_poses(poses, frame, device) for frame in (-2, -1))
        while done[running].sum() * 2 < len(running):
            after = step(layout, before, now)
            moves = _largest_moves(layout, now, after)
            # An object that is lost leaves its scene as it was before.
            lost = ~(moves <= LIMIT)
            done[running] |= lost
            before, now = now, _without(layout, now, after, lost) if lost.any() else after
            _record(layout, now, running, done, recorded)
            for place, row in enumerate(running):
                quiet[row] = quiet[row] + 1 if moves[place] < REST * seconds else 0
                rests = quiet[row] * seconds > REST_TIME - seconds / 2
                done[row] |= len(recorded[row]) >= starts[row].steps or rests
        running = [row for row in running if not done[row]]
    return [_join(records, start) for records, start in zip(recorded, starts, strict=True)]


def _last(start: Start, records: list[tuple[F64, F64, F64]]) -> Poses:
    """Return the last two rows of the motion of a scene."""
    known = [
        (start.poses.centers[row], start.poses.rotations[row], start.poses.loose[row])
        for row in (-2, -1)
    ]
    centers, rotations, loose = zip(*[*known, *records][-2:], strict=True)
    return Poses(np.stack(centers), np.stack(rotations), np.stack(loose))


def _largest_moves(layout: SceneLayout, before: ObjectState, now: ObjectState) -> F64:
    """Return the largest displacement in the last step in every scene, metres (B,)."""
    moves = (now.positions(layout) - before.positions(layout)).norm(dim=-1)
    moves = moves.masked_fill((layout.kinds == KINEMATIC)[layout.owners], 0.0)
    scene = layout.scene[layout.owners]
    largest = moves.new_zeros(layout.scenes).scatter_reduce(0, scene, moves, "amax")
    return np.asarray(largest.cpu().numpy())


def _without(
    layout: SceneLayout, now: ObjectState, after: ObjectState, lost: NDArray[np.bool_]
) -> ObjectState:
    """Return the state ``after``, but ``now`` for the scenes (B,) that are lost.

    They stay in the graph for a while, in which their numbers must not grow without limit.
    """
    old = torch.from_numpy(lost).to(layout.scene.device)[layout.scene]
    loose = old[layout.owners[layout.loose]][:, None]
    return ObjectState(
        torch.where(old[:, None], now.centers, after.centers),
        torch.where(old[:, None, None], now.rotations, after.rotations),
        torch.where(loose, now.loose, after.loose),
    )


def _record(
    layout: SceneLayout,
    now: ObjectState,
    running: Sequence[int],
    done: NDArray[np.bool_],
    recorded: list[list[tuple[F64, F64, F64]]],
) -> None:
    centers, rotations, loose = (
        value.cpu().numpy() for value in (now.centers, now.rotations, now.loose)
    )
    loose_scene = layout.scene[layout.owners[layout.loose]].cpu().numpy()
    for place, row in enumerate(running):
        if not done[row]:
            own = slice(layout.object_ends[place], layout.object_ends[place + 1])
            part = loose[loose_scene == place]
            recorded[row].append((centers[own].copy(), rotations[own].copy(), part.copy()))


def _join(records: list[tuple[F64, F64, F64]], start: Start) -> Poses:
    if not records:
        nothing = slice(0, 0)
        poses = start.poses
        return Poses(poses.centers[nothing], poses.rotations[nothing], poses.loose[nothing])
    centers, rotations, loose = zip(*records, strict=True)
    return Poses(np.stack(centers), np.stack(rotations), np.stack(loose))


# Training examples: successive states of the objects of each clip, rotated and disturbed.

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


def read_window(batch: Batch, sampling: Sampling, device: torch.device) -> Window:
    """Return the objects of the clips that are there in all frames, and their states."""
    if batch.state is None or batch.frames.shape[1] < 3:
        raise BadInputError("a particle model is trained on motions in windows of 3 or more frames")
    frames = torch.as_tensor(batch.frames).cpu().numpy()
    particles, poses = [], []
    for motion, shown in zip(batch.state, frames, strict=True):
        present = np.all([motion.scene.present(int(frame)) for frame in shown], axis=0)
        present[put_by_events(motion.scene, int(shown[0]), int(shown[-1]))] = False
        own = scene_particles(motion.scene, sampling, present.tolist())
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

    Only the first state is moved: the last velocity is wrong, and the states that are to be
    predicted are not (Sanchez-Gonzalez et al. 2020, section 3.3). The noise of a rotation moves the
    rim of a body as far as the noise of its centre moves the centre.

    Parameters
    ----------
    window
        The window.
    velocity_noise, relative_noise : float
        Standard deviations by axis: metres a step, and a fraction of the speed of the centre and
        rim of a body or of a particle that moves on its own. They are independent.
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
    centers, rotations = first.centers + noise(speed) * free, turn @ first.rotations
    # Particles of a body that deforms follow its noise, and have noise of their own.
    owners = layout.owners[layout.loose]
    rotated = (rotations[owners] @ layout.shape[layout.loose][..., None])[..., 0]
    bodies = layout.soft_bodies[owners][:, None]
    loose = torch.where(bodies, centers[owners] + rotated, first.loose) + noise(loose_speed)
    before = ObjectState(centers, rotations, loose)
    return Window(layout, before, window.now, window.later)


# Distances of agent and patient over a motion, between its steps too.
#
# Between two rows of a motion a body goes from one pose to the next with constant velocity and
# angular velocity. Rigid bodies are compared by their convex pieces; a cloth and a body by the
# particles of the cloth and points on the surface of the body, which go along straight lines.


def point_distances(
    scene: Scene, particles: SceneParticles, poses: Poses, spacing: float, limit: int
) -> tuple[float, float]:
    """Return the distances of the points of agent and patient, metres: smallest, and at the end.

    They are at most `FAR`, also if one of the objects is absent. The arguments are as in
    `smallest_distance`.
    """
    rows = (particles.agent, particles.patient)
    if min(rows) < 0 or not len(poses.centers):
        return FAR, FAR
    first, second = (_points(scene, particles, poses, row, spacing, limit) for row in rows)
    return min(gap_over_time(first, second), FAR), min(gap_over_time(first[-1:], second[-1:]), FAR)


def smallest_distance(
    scene: Scene, particles: SceneParticles, poses: Poses, spacing: float, limit: int
) -> float:
    """Return the smallest distance of agent and patient, metres; minus the depth of an overlap.

    Learned bodies can overlap, and the deeper they do, the surer is the contact. The distance is
    at most `FAR`, also if one of them is absent, and at most `TOLERANCE` too large; depths are
    those at the rows of the motion only. Bodies that deform are compared by points, as cloths are.

    Parameters
    ----------
    scene, particles
        The scene and its particles.
    poses
        Motion over T rows.
    spacing, limit
        Of the points on the surface of a body. They may be finer than the particles that move,
        since these say where each of the points is.
    """
    rows = (particles.agent, particles.patient)
    if min(rows) < 0 or not len(poses.centers):
        return FAR
    if particles.loose[np.isin(particles.owners, rows)].any():
        return point_distances(scene, particles, poses, spacing, limit)[0]
    return min(_distance_of_bodies(scene, particles, poses, rows), FAR)


def _distance_of_bodies(
    scene: Scene, particles: SceneParticles, poses: Poses, rows: tuple[int, int]
) -> float:
    """Return the smallest distance of two bodies, or minus their deepest overlap (`gaps`)."""
    centers = poses.centers[:, rows]
    rotations = poses.rotations[:, rows]
    steps = np.diff(centers, axis=0)
    rotation = vector_from_rotation(
        torch.from_numpy(rotations[1:] @ rotations[:-1].swapaxes(-1, -2))
    ).numpy()
    gap, reaches = gap_of_bodies(
        [scene.bodies[int(particles.things[row])] for row in rows],
        [particles.pivots[row] for row in rows],
    )

    def between(centers: F64, rotations: F64) -> float:
        to_second = np.ascontiguousarray(rotations[1].T)
        return gap(to_second @ rotations[0], to_second @ (centers[0] - centers[1]))

    gaps = [between(centers[row], rotations[row]) for row in range(len(centers))]
    best = min(gaps)
    lengths = np.linalg.norm(steps, axis=-1) + np.linalg.norm(rotation, axis=-1) * reaches
    moved = lengths.sum(axis=1)
    for row in range(len(steps)):
        if best <= 0 or (gaps[row] + gaps[row + 1] - moved[row]) / 2 >= best - TOLERANCE:
            continue

        def during(seconds: float, row: int = row) -> float:
            part = seconds / FRAME_TIME
            rotated = rotation_from_vector(torch.from_numpy(part * rotation[row])).numpy()
            return between(centers[row] + part * steps[row], rotated @ rotations[row])

        best = min(best, minimise(during, float(moved[row]) / FRAME_TIME, 1))
    return best


def _points(
    scene: Scene, particles: SceneParticles, poses: Poses, row: int, spacing: float, limit: int
) -> F64:
    """Return the points (T, P, 3) of an object.

    A point on the surface of a body that deforms keeps its place at the nearest particle, and turns
    with the body.
    """
    own = poses.loose[:, particles.owners[particles.loose] == row]
    if particles.kinds[row] == CLOTH:
        return np.ascontiguousarray(own)
    body = scene.bodies[int(particles.things[row])]
    points, _ = surface_points(body.shape, body.scale, spacing, limit)
    offsets, turn = points - particles.pivots[row], poses.rotations[:, row].transpose(0, 2, 1)
    if not len(own[0]):
        return np.ascontiguousarray(offsets[None] @ turn + poses.centers[:, row, None])
    shape = particles.shape[particles.owners == row]
    nearest = cKDTree(shape).query(offsets)[1]
    return np.ascontiguousarray((offsets - shape[nearest])[None] @ turn + own[:, nearest])
