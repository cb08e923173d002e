"""Motion of several scenes step by step, each until it rests or its time is over."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from physion.models.particles.bodies import KINEMATIC, RIGID, Poses, SceneParticles
from physion.models.particles.layout import ObjectState, SceneLayout, join_poses, join_scenes
from physion.models.particles.rigid_motion import rotation_from_vector

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
    loose[-2] += spread * rng.normal(size=loose[-2].shape)
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
