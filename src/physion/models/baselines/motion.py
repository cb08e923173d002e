"""Baselines that see the true motion: `already-touched` and `constant-motion`.

Also `chance`, which sees nothing, and what all baselines have in common: `Baseline`, and how they
read the observed part of a motion.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import (
    LAST_OBSERVED,
    Batch,
    Motion,
    Provenance,
    Rollout,
    Spec,
    cut_to_observed,
)
from physion.core.errors import BadInputError
from physion.core.files import json_digest
from physion.core.version import __version__
from physion.models.gaps import FAR, gap_of_bodies, minimise
from physion.models.interface import Model, ModelSettings
from physion.numerics.linear_algebra import apply, multiply, norm
from physion.numerics.rotations import axis_angle_matrix, rotation_matrices
from physion.physics.cloth.contacts import smallest_distance
from physion.physics.cloth.simulate import ClothSettings
from physion.physics.cloth.solids import surface_particles
from physion.physics.cloth.solver import CLOTH_CONTACT_GAP
from physion.physics.labels import label_contact
from physion.physics.rigid.bodies import body_mass
from physion.physics.trajectory import State
from physion.scenes.scene import FRAME_TIME, Body, Scene

# What baselines read from a motion: its observed part, and nothing after it.


def motions(batch: Batch, model: str) -> tuple[Motion, ...]:
    """Return the motions of a batch; raise `BadInputError` for a batch without any."""
    if batch.state is None:
        raise BadInputError(f"{model} needs motions, but the batch holds none (input state)")
    return batch.state


def require_motion(motion: Motion, trial: str) -> None:
    """Raise `BadInputError` for a trial that was imported as a movie, without motion."""
    if not np.isfinite(motion.trajectory.positions).all():
        raise BadInputError(
            f"trial {trial!r} was imported without motion ({motion.trajectory.engine}): use a "
            "model that sees pictures"
        )


def observed_motion(motion: Motion, trial: str) -> Motion:
    """Return the part of a motion up to the last observed frame.

    Raises `BadInputError` for a trial that is shorter or has no motion.
    """
    seen = Motion(motion.scene, cut_to_observed(motion.scene, motion.trajectory))
    require_motion(seen, trial)
    return seen


def bodies_present(scene: Scene, *frames: int) -> NDArray[np.bool_]:
    """Return which bodies (N,) are there in all ``frames`` and are not scenery."""
    there = np.all([scene.present(frame) for frame in frames], axis=0)[: len(scene.bodies)]
    return np.asarray(there & np.array([not body.scenery for body in scene.bodies]))


def touched(motion: Motion) -> bool:
    """Return whether agent and patient touch in a motion."""
    return label_contact(motion.scene, motion.trajectory).contact


# Smallest gap of agent and patient if both keep the velocities that they have (`models.gaps`).
#
# With c the centre of mass, v and w the velocities, R the rotation and p a point of a body
# relative to its centre of mass, all at the start, the point is at time t at
#
#     c + v t + T(w t) R p
#
# where T(w t) rotates by the angle |w| t about w. No point moves faster than |v| + |w| max|p|.

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FlyingBody:
    """Body that keeps its velocity and its angular velocity.

    - ``reach``: metres, largest distance of its points from its centre of mass.
    - ``center`` (3,): of mass; ``rotation`` (3, 3); both at the start.
    - ``velocity``, ``angular_velocity`` (3,): m/s and rad/s, world axes.
    """

    reach: float
    center: F64
    rotation: F64
    velocity: F64
    angular_velocity: F64

    def pose(self, seconds: float) -> tuple[F64, F64]:
        """Return centre of mass (3,) and rotation (3, 3) after some seconds."""
        rate = float(norm(self.angular_velocity))
        rotation = self.rotation
        if rate > 0:
            step = axis_angle_matrix(self.angular_velocity / rate, rate * seconds)
            rotation = multiply(step, rotation)
        return self.center + seconds * self.velocity, rotation

    @property
    def top_speed(self) -> float:
        """Metres per second that no point exceeds."""
        return float(norm(self.velocity)) + float(norm(self.angular_velocity)) * self.reach


def gap_in_constant_motion(scene: Scene, state: State, frames: int) -> float:
    """Return the smallest gap of agent and patient in metres, 0 where they touch.

    Both move from ``state`` for ``frames`` frames with constant velocity and angular velocity,
    through everything: there is no gravity and no contact, and joints do not hold. Each vertex of a
    cloth keeps its velocity. Bodies are compared by their convex hulls; a cloth and a body by the
    rule of the label, so that 0 is the distance at which they count as touching.

    The gap is at most `FAR`, also if agent or patient is absent or both are cloths, and at most
    `TOLERANCE` too large.
    """
    names = (scene.roles.agent, scene.roles.patient)
    indices = [scene.index(name) for name in names]
    present = scene.present(state.frame)
    if not all(present[index] for index in indices):
        return FAR
    bodies = [index for index in indices if index < len(scene.bodies)]
    if not bodies:
        return FAR
    if len(bodies) == 2:
        gap, top_speed = _gap_of_bodies(scene, state, bodies[0], bodies[1])
    else:
        gap, top_speed = _gap_of_cloth(scene, state, max(indices), bodies[0])
    return min(max(minimise(gap, top_speed, frames), 0.0), FAR)


def _gap_of_bodies(
    scene: Scene, state: State, a: int, b: int
) -> tuple[Callable[[float], float], float]:
    """Return the gap of two bodies as a function of time, and the bound of its slope."""
    bodies = [scene.bodies[index] for index in (a, b)]
    relative, reaches = gap_of_bodies(bodies, [body_mass(body).center for body in bodies])
    first, second = (
        _flying(body, state, index, reach)
        for body, index, reach in zip(bodies, (a, b), reaches, strict=True)
    )

    def gap(seconds: float) -> float:
        (at, turned), (origin, axes) = first.pose(seconds), second.pose(seconds)
        to_second = np.ascontiguousarray(axes.T)
        return min(relative(multiply(to_second, turned), apply(to_second, at - origin)), FAR)

    return gap, first.top_speed + second.top_speed


def _gap_of_cloth(
    scene: Scene, state: State, cloth: int, body: int
) -> tuple[Callable[[float], float], float]:
    """Return the gap of a cloth and a body as a function of time, and the bound of its slope."""
    settings = ClothSettings()
    particles = surface_particles(scene.bodies[body], settings.particle_spacing)
    particles = particles - body_mass(scene.bodies[body]).center
    flying = _flying(scene.bodies[body], state, body, float(np.max(norm(particles))))
    number = cloth - len(scene.bodies)
    counts = [sheet.resolution**2 for sheet in scene.cloths]
    rows = slice(sum(counts[:number]), sum(counts[: number + 1]))
    vertices, velocities = state.cloth_vertices[rows].T, state.cloth_velocities[rows].T
    touching = settings.rest_distance + CLOTH_CONTACT_GAP

    def gap(seconds: float) -> float:
        points = np.ascontiguousarray(vertices + seconds * velocities)
        distance = smallest_distance(points, particles, *flying.pose(seconds))
        return min(distance - touching, FAR)

    return gap, flying.top_speed + float(np.max(norm(velocities.T)))


def _flying(body: Body, state: State, index: int, reach: float) -> FlyingBody:
    """Return a body as it moves in a state."""
    rotation = rotation_matrices(state.rotations[index])
    center = body_mass(body).center
    return FlyingBody(
        reach=reach,
        center=state.positions[index] + apply(rotation, center),
        rotation=rotation,
        velocity=state.velocities[index],
        angular_velocity=state.angular_velocities[index],
    )


# What all baselines have in common.


class Baseline(Model):
    """Model that sees too little to predict; its score shows what another model's score is worth.

    ``version`` is to be raised with every change of the code that can alter a prediction.
    """

    name: ClassVar[str]
    version: ClassVar[int] = 1
    sees: ClassVar[str] = ""
    """What it looks at, for the column *Encoder Type*."""

    def __init__(self, settings: ModelSettings) -> None:
        self.settings = settings

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        versions = f"physion {__version__}"
        return Provenance(self.name, "none", encoder_type=self.sees, versions=versions)

    def digest(self) -> str:
        """Return the SHA-256 of code version and settings."""
        return self.digest_of(dataclasses.asdict(self.settings))

    @classmethod
    def digest_of(cls, settings: Any, fitted: Iterable[NDArray[Any]] = ()) -> str:
        """Return the SHA-256 of name and version, of settings, and of arrays that were fitted."""
        arrays = (f"{a.shape} {a.dtype.str}".encode() + a.tobytes() for a in fitted)
        return json_digest([cls.name, cls.version, settings], arrays)


# Baseline `chance`: the base rate of the fitted trials, whatever the trial.


@dataclass(frozen=True, kw_only=True)
class BaseRateSettings(ModelSettings):
    """`BaseRate` has no settings."""


class BaseRate(Baseline):
    """Model that gives every trial of a scenario the same probability.

    P(contact) is (k + 1) / (n + 2) with k contacts among the n fitted trials (Laplace's rule of
    succession), so that its yes or no is the more frequent outcome.
    """

    name = "chance"
    answers = "observed"

    def __init__(self, settings: BaseRateSettings) -> None:
        super().__init__(settings)
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0, context_at="end")

    def fit(self, batch: Batch, labels: NDArray[np.bool_], seed: int) -> FittedBaseRate:
        """Return the model with the base rate of the outcomes (B,); trials and seed are unused."""
        return FittedBaseRate((int(np.count_nonzero(labels)) + 1) / (len(labels) + 2))

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return dataclasses.replace(super().provenance(), inputs="base rate")


@dataclass(frozen=True, slots=True)
class FittedBaseRate:
    """`BaseRate` of some trials, in 0..1."""

    base_rate: float
    answers: str = "observed"

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return the base rate for every trial (B,)."""
        return np.full(len(batch), self.base_rate)


# Baseline `already-touched`: certain if the contact was seen, else the base rate.


@dataclass(frozen=True, kw_only=True)
class AlreadyTouchedSettings(ModelSettings):
    """Settings of `AlreadyTouched`.

    - ``margin``: what is left for the other outcome: probabilities lie in margin .. 1 - margin.
    """

    margin: float = 0.01

    def __post_init__(self) -> None:
        if not 0 <= self.margin < 0.5:
            raise BadInputError(
                f"already-touched: margin must be at least 0 and below 0.5, not {self.margin}"
            )


class AlreadyTouched(Baseline):
    """Model that knows one thing: whether agent and patient touched in the observed part.

    P(contact) is 1 - margin if they did, else the base rate: the fraction of contacts among the
    fitted trials that had not touched, and 0.5 without such a trial.
    """

    name = "already-touched"
    answers = "observed"
    settings: AlreadyTouchedSettings

    def __init__(self, settings: AlreadyTouchedSettings) -> None:
        super().__init__(settings)
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0, context_at="end")

    def fit(self, batch: Batch, labels: NDArray[np.bool_], seed: int) -> TouchedOrBaseRate:
        """Return the model with the base rate of some trials and outcomes (B,); no seed is used."""
        if len(labels) != len(batch):
            raise BadInputError(f"{self.name}: {len(labels)} labels for {len(batch)} trials")
        later = np.asarray(labels, np.bool_)[~_touched(batch)]
        rate = np.count_nonzero(later) / len(later) if len(later) else 0.5
        return TouchedOrBaseRate(self.settings, rate)


@dataclass(frozen=True, slots=True)
class TouchedOrBaseRate:
    """`AlreadyTouched` with a base rate in 0..1."""

    settings: AlreadyTouchedSettings
    base_rate: float
    answers: str = "observed"

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return P(contact) (B,)."""
        margin = self.settings.margin
        rate = min(max(self.base_rate, margin), 1 - margin)
        return np.where(_touched(batch), 1 - margin, rate)

    def digest(self) -> str:
        """Return the SHA-256 of code version, settings and base rate."""
        settings = dataclasses.asdict(self.settings) | {"base_rate": self.base_rate}
        return AlreadyTouched.digest_of(settings)


def _touched(batch: Batch) -> NDArray[np.bool_]:
    """Return which trials (B,) had a contact in the observed part."""
    pairs = zip(motions(batch, AlreadyTouched.name), batch.trials, strict=True)
    return np.array([touched(observed_motion(motion, trial)) for motion, trial in pairs], np.bool_)


# Baseline `constant-motion`: bodies keep moving as at the last observed frame.


@dataclass(frozen=True, kw_only=True)
class ConstantMotionSettings(ModelSettings):
    """Settings of `ConstantMotion`.

    - ``frames``: how far it looks ahead, in frames of 0.01 s. The default ends with frame 150, the
      last one of a trial of the usual smallest length.
    """

    frames: int = 106

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise BadInputError(f"constant-motion: frames must be at least 1, not {self.frames}")


class ConstantMotion(Baseline):
    """Simulator without forces: constant velocity and angular velocity from frame 44 on.

    Gravity, contacts and joints have no effect; bodies that lie or fly move alike. The gap is
    the smallest distance of the hulls of agent and patient on their way (`smallest_gap`), and 0 if
    they touched in the observed part. All samples are equal. A learned simulator should predict
    better.
    """

    name = "constant-motion"
    sees = "true state"
    decision = "gap"
    seed = 0
    settings: ConstantMotionSettings

    def __init__(self, settings: ConstantMotionSettings) -> None:
        super().__init__(settings)
        self.spec = Spec(
            inputs=("state",), stride=1, context=1, future=settings.frames, context_at="end"
        )

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Return gaps and contacts (B, samples); nothing is random; ``arguments`` are not used."""
        pairs = zip(motions(context, self.name), context.trials, strict=True)
        gaps = np.array([self._gap(observed_motion(motion, trial)) for motion, trial in pairs])
        repeated = np.repeat(gaps.reshape(-1, 1), samples, axis=1)
        return Rollout(gap=repeated, contact=repeated <= 0)

    def surprise(self, batch: Batch) -> NDArray[np.float64]:
        """Return how far bodies are from where they were going (B, T), metres, the farthest one.

        With the place x and the velocity v of a body, and frames f: |x(f) - x(f') - (f - f') v(f')|
        with the frame f' before. Bodies that come or go do not count.
        """
        found = np.zeros(batch.frames.shape)
        for row, (motion, frames) in enumerate(
            zip(motions(batch, self.name), batch.frames, strict=True)
        ):
            path = motion.trajectory
            for step, (before, now) in enumerate(itertools.pairwise(frames.tolist()), start=1):
                there = bodies_present(motion.scene, before, now)
                expected = path.velocities[before] * np.float32((now - before) * FRAME_TIME)
                off = norm((path.positions[now] - path.positions[before] - expected)[there])
                found[row, step] = off.max(initial=0.0)
        return found

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return dataclasses.replace(super().provenance(), dynamics_type="constant velocity")

    def _gap(self, motion: Motion) -> float:
        """Return the gap of one observed motion."""
        if touched(motion):
            return 0.0
        state = motion.trajectory.state(LAST_OBSERVED)
        return gap_in_constant_motion(motion.scene, state, self.settings.frames)
