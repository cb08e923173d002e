"""The published particle models, trained and rolled out as the published code does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from physion.clips.batch import LAST_OBSERVED, Batch, Motion
from physion.core.errors import BadInputError
from physion.models.particles.bodies import (
    CLOTH,
    FREE,
    Poses,
    particle_positions,
    poses_of,
    scene_particles,
)
from physion.models.particles.config import ParticleOptions
from physion.models.particles.graph import ObjectState, SceneLayout, with_loose
from physion.models.particles.neighbours import radius_edges, radius_edges_on_device
from physion.models.particles.released.config import ReleasedConfig
from physion.models.particles.released.contact import (
    CLOTH_SCALE,
    contact_distance,
    particle_distance,
    rollout_steps,
)
from physion.models.particles.released.dpi import ReleasedDPI
from physion.models.particles.released.gns import ReleasedGNS
from physion.models.particles.released.graph import released_graph
from physion.models.particles.released.layers import Widths
from physion.models.particles.rigid_motion import fit_rigid
from physion.models.particles.rollout import Start
from physion.models.particles.simulator import Futures, ParticleSimulator
from physion.models.torch_model import digest_of
from physion.scenes.scene import FRAME_TIME

RELEASED_VERSION = 1
"""To be raised with every change of what equal weights predict, or of the training."""
PARTICLES_AT_ONCE = 30_000
"""Particles of the scenes that are rolled out in one graph, so that it fits in memory."""
MAX_EDGES = 4_000_000
"""Largest number of neighbours in one graph; each takes about 1 kB."""


class ReleasedSimulator(ParticleSimulator):
    """Simulator with networks, inputs, noise and decision of the published code.

    With positions x0, x1, x2 of a particle in three frames, h apart (0.03 s), and noise e, one
    vector for all particles of a window, the training (data.py, train.py) is

        v = (x1 - x0) / h + e,    x = x0 + h v,    loss = mean |f(x, v) - (x2 - x1) / h|^2

    with e normal with standard deviation 3e-4 / sqrt(2) m/s by axis. A rollout (eval.py) repeats
    x <- x + h f(x, v), v <- f(x, v). With ``keep_rigid`` (GNS-RANSAC), x is replaced by the rigid
    motion of each body that fits best, and v by what it moved in the step.

    As published, and on purpose:

    - All objects are particles that are predicted, kinematic bodies and the patient too, which
      therefore can move. Nothing keeps bodies rigid in GNS.
    - GNS-RANSAC fits to all particles: there is no RANSAC in the published code.
    - Noise is a drift of the whole scene, which no network can recognise as noise.
    - Neighbours are those at the beginning of a step, in which fast bodies move farther than the
      radius.
    - A scene with cloth is enlarged by 0.05 / 0.035, but not its gravity.
    - Contact is decided at the steps, not between them, by a distance that is not fitted
      (`contact_distance`), and the rollout has a length of its own (`rollout_steps`).

    Other than published: frames 41 and 44 start a rollout, not 42 and 45, since frame 45 is not
    observed; a scene in which all rests is over; windows begin at any frame of a trial, not from 42
    on; scenery is left out, but no other large body; the order of axes is (x, y, z) with z up.
    """

    config: ReleasedConfig
    calibration_trials = 1

    def __init__(self, name: str, config: ReleasedConfig, options: ParticleOptions) -> None:
        super().__init__(name, config, options)
        self.seconds = options.stride * FRAME_TIME

    @property
    def decision(self) -> str:
        """Name of the decision: the published distances, nothing is fitted."""
        return "touch"

    def digest(self) -> str:
        """Return the SHA-256 of settings and weights; the number of futures is no part."""
        return digest_of([RELEASED_VERSION, super().digest()])

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the mean squared error of velocities, m^2/s^2, of windows of three frames."""
        layout, before, velocities, target = self._velocities_of(batch)
        scale = self.config.velocity_noise / math.sqrt(2)
        noise = scale * torch.randn(layout.scenes, 3, dtype=before.dtype, device=before.device)
        velocities = velocities + noise[layout.scene[layout.owners]]
        positions = before + velocities * self.seconds
        predicted = self._predict(layout, positions, velocities)
        return {"loss": (predicted - target.float()).pow(2).mean()}

    def baseline(self, batch: Batch) -> Tensor:
        """Return the loss if all velocities stay as they are."""
        _, _, velocities, target = self._velocities_of(batch)
        return (velocities - target).pow(2).mean().float()

    def calibrate(self, whole: Batch) -> None:
        """Do nothing: the published distances of contact are not fitted."""

    def step(self, layout: SceneLayout, before: ObjectState, now: ObjectState) -> ObjectState:
        """Return the state after the next step."""
        last, positions = (_published(layout, state.loose) for state in (before, now))
        velocities = self._predict(layout, positions, (positions - last) / self.seconds)
        moved = velocities.double() * self.seconds / _scale(layout)
        after = now.loose + moved
        if self.config.keep_rigid:
            owners = layout.owners
            rotations, shifts = fit_rigid(now.loose, after, owners, layout.objects)
            fitted = (rotations[owners] @ now.loose[..., None])[..., 0] + shifts[owners]
            after = torch.where((layout.kinds == FREE)[owners, None], fitted, after)
        return with_loose(layout, now.centers, now.rotations, after)

    def _make_network(self) -> nn.Module:
        config = self.config
        widths = Widths(config.width, config.width * 3 // 2, config.width)
        kind = ReleasedGNS if config.network == "messages" else ReleasedDPI
        return kind(widths=widths, steps=config.rounds)

    def _start(self, motion: Motion, frames: range) -> Start:
        limit = self.config.rollout_limit
        settings = self.config.particles
        settings = replace(
            settings,
            limit=min(limit, settings.limit),
            still_limit=min(limit, settings.still_limit),
        )
        scene = motion.scene
        own = scene_particles(scene, settings, scene.present(LAST_OBSERVED))
        steps = rollout_steps(scene) * 3 // self.options.stride
        return Start(own, poses_of(own, motion, frames), steps)

    def _prepared(self, starts: Sequence[Start]) -> Sequence[Start]:
        return [_freed(start) for start in starts]

    def _roll_out(self, starts: Sequence[Start]) -> list[Poses]:
        imagined: list[Poses] = []
        for part in _parts(starts, PARTICLES_AT_ONCE):
            imagined += super()._roll_out(part)
        return imagined

    def gaps(self, motions: Sequence[Motion], futures: Sequence[Futures]) -> NDArray[np.float64]:
        """Return the smallest distances (B, S) of particles, less the published distance."""
        return np.array(
            [
                [particle_distance(*future) - contact_distance(motion.scene) for future in own]
                for motion, own in zip(motions, futures, strict=True)
            ]
        )

    def _velocities_of(self, batch: Batch) -> tuple[SceneLayout, Tensor, Tensor, Tensor]:
        """Return the layout, first positions, and velocities in the first and second step."""
        window = self._read(batch)
        layout = window.layout
        first, second, third = (
            _published(layout, state.positions(layout))
            for state in (window.before, window.now, window.later[0])
        )
        return layout, first, (second - first) / self.seconds, (third - second) / self.seconds

    def _predict(self, layout: SceneLayout, positions: Tensor, velocities: Tensor) -> Tensor:
        """Return the velocities (P, 3) after the step, float32, m/s."""
        receivers, senders = self._neighbours(positions, layout.scene[layout.owners])
        graph = released_graph(
            positions.float(), velocities.float(), layout.owners, layout.kinds != CLOTH,
            receivers, senders,
        )  # fmt: skip
        predicted: Tensor = self.network(graph)
        return predicted

    def _neighbours(self, positions: Tensor, scene: Tensor) -> tuple[Tensor, Tensor]:
        """Return receivers and senders (E,) of the particles within the radius."""
        radius = self.config.radius
        if positions.device.type == "cpu":
            found = radius_edges(positions.numpy(), scene.numpy(), radius)
            receivers, senders = (torch.from_numpy(rows) for rows in found)
        else:
            receivers, senders = radius_edges_on_device(positions, scene, radius)
        if len(receivers) > MAX_EDGES:
            raise BadInputError(
                f"{self.name}: {len(positions)} particles have {len(receivers)} neighbours, at "
                f"most {MAX_EDGES}: they fell together; train longer, or lower the batch"
            )
        return receivers, senders


def _scale(layout: SceneLayout) -> Tensor:
    """Return the factor (P, 1) of the coordinates of each particle."""
    cloths = layout.scene[layout.kinds == CLOTH]
    enlarged = torch.zeros(layout.scenes, dtype=torch.bool, device=cloths.device)
    enlarged[cloths] = True
    scale = torch.where(enlarged, CLOTH_SCALE, 1.0).double()
    return scale[layout.scene[layout.owners], None]


def _published(layout: SceneLayout, positions: Tensor) -> Tensor:
    """Return positions (P, 3) with the floor at z = 0, and scenes with cloth enlarged."""
    height = torch.zeros_like(positions)
    height[:, 2] = layout.floor[layout.owners]
    return (positions - height) * _scale(layout)


def _freed(start: Start) -> Start:
    """Return a scene in which the particles of all bodies move on their own."""
    particles, poses = start.particles, start.poses
    kinds = np.where(particles.kinds == CLOTH, CLOTH, FREE)
    upright = np.broadcast_to(np.eye(3), poses.rotations.shape).copy()
    loose = particle_positions(particles, poses)
    return Start(replace(particles, kinds=kinds), Poses(poses.centers, upright, loose), start.steps)


def _parts(starts: Sequence[Start], particles: int) -> list[list[Start]]:
    """Return scenes in parts of at most so many particles, or of one scene."""
    parts: list[list[Start]] = []
    total = 0
    for start in starts:
        count = len(start.particles.owners)
        if not parts or total + count > particles:
            parts.append([])
            total = 0
        parts[-1].append(start)
        total += count
    return parts
