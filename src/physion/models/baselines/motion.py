"""Baselines that see the true motion: `already-touched`, `constant-motion`, `state-classifier`.

Also what all baselines have in common: `Baseline`, and how they read the observed part of a motion.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import sklearn
from numpy.typing import NDArray
from sklearn.ensemble import ExtraTreesClassifier

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
from physion.core.version import __version__
from physion.models.interface import Model, ModelSettings
from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import apply, multiply, norm
from physion.numerics.rotations import axis_angle_matrix, rotate_vectors, rotation_matrices
from physion.physics.cloth.contacts import smallest_distance
from physion.physics.cloth.simulate import ClothSettings
from physion.physics.cloth.solids import surface_particles
from physion.physics.cloth.solver import CLOTH_CONTACT_GAP
from physion.physics.labels import label_contact
from physion.physics.rigid.bodies import body_mass, collision_hulls
from physion.physics.rigid.collision.closest_points import (
    CLOSE,
    OVERLAPPING,
    Simplex,
    closest_points,
    new_simplex,
)
from physion.physics.trajectory import State
from physion.scenes.scene import FRAME_TIME, Body, Scene
from physion.scenes.shapes.primitives import shape

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


def touched(motion: Motion) -> bool:
    """Return whether agent and patient touch in a motion."""
    return label_contact(motion.scene, motion.trajectory).contact


# Smallest gap of agent and patient if both go on with the velocities that they have.
#
# With c the centre of mass, v and w the velocities, R the rotation and p a point of a body
# relative to its centre of mass, all at the start, the point is at time t at
#
#     c + v t + T(w t) R p
#
# where T(w t) rotates by the angle |w| t about w. No point moves faster than |v| + |w| max|p|, so
# the gap of two bodies changes by at most the sum s of both bounds a second. Over an interval of
# length h with the gaps g0 and g1 at its ends it is at least (g0 + g1 - s h) / 2: intervals in
# which this is not below the smallest gap so far need no closer look (Shubert 1972).
#
# References
# ----------
# B. O. Shubert, A sequential method seeking the global maximum of a function, SIAM Journal on
# Numerical Analysis 9, 1972.

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

FAR = 10.0
"""Largest gap that is reported, metres; also that of a thing that is absent."""
TOLERANCE = 1e-3
"""Metres by which the reported gap may exceed the smallest one."""


@dataclass(frozen=True, eq=False)
class FlyingBody:
    """Points of a body that keeps its velocity and its angular velocity.

    - ``points`` (P, 3): metres, in the body's frame, from its centre of mass.
    - ``center`` (3,): of mass; ``rotation`` (3, 3); both at the start.
    - ``velocity``, ``angular_velocity`` (3,): m/s and rad/s, world axes.
    """

    points: F64
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
        reach = float(np.max(norm(self.points), initial=0.0))
        return float(norm(self.velocity)) + float(norm(self.angular_velocity)) * reach


def gap_in_constant_motion(scene: Scene, state: State, frames: int) -> float:
    """Return the smallest gap of agent and patient in metres, 0 where they touch.

    Both go on from ``state`` for ``frames`` frames with constant velocity and angular velocity,
    through everything: there is no gravity and no contact, and joints do not hold. The vertices of
    a cloth go on one by one. Bodies are compared by their convex hulls; a cloth and a body by the
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


def minimise(gap: Callable[[float], float], top_speed: float, frames: int) -> float:
    """Return the minimum of a function of time over ``frames`` frames, to `TOLERANCE`.

    The search ends at the first value that is not above 0.

    Parameters
    ----------
    gap
        Function of the time in seconds, metres.
    top_speed
        Metres a second that its slope does not exceed.
    frames
        Length in frames; each is an interval at the start.
    """
    values = [gap(frame * FRAME_TIME) for frame in range(frames + 1)]
    best = min(values)
    intervals = [
        (frame * FRAME_TIME, FRAME_TIME, *values[frame : frame + 2]) for frame in range(frames)
    ]
    while intervals and best > 0:
        start, length, first, last = intervals.pop()
        if (first + last - top_speed * length) / 2 >= best - TOLERANCE:
            continue
        half = length / 2
        middle = gap(start + half)
        best = min(best, middle)
        intervals += [(start, half, first, middle), (start + half, half, middle, last)]
    return best


def _gap_of_bodies(
    scene: Scene, state: State, a: int, b: int
) -> tuple[Callable[[float], float], float]:
    """Return the gap of two bodies as a function of time, and the bound of its slope."""
    hulls = [
        collision_hulls(scene.bodies[index].shape, scene.bodies[index].scale) for index in (a, b)
    ]
    corners = [[hull.corners for hull in pieces] for pieces in hulls]
    first, second = (
        _flying(scene.bodies[index], state, index, np.concatenate([*parts, np.zeros((0, 3))]))
        for index, parts in zip((a, b), corners, strict=True)
    )
    vertices = np.concatenate([first.points, second.points])
    counts = [len(part) for parts in corners for part in parts]
    ends = np.cumsum([0, *counts]).astype(np.int64)
    pieces, simplex = len(corners[0]), new_simplex()

    def gap(seconds: float) -> float:
        (at, turned), (origin, axes) = first.pose(seconds), second.pose(seconds)
        to_second = np.ascontiguousarray(axes.T)
        rotation, shift = multiply(to_second, turned), apply(to_second, at - origin)
        return min(_gap_of_hulls(vertices, ends, pieces, rotation, shift, simplex), FAR)

    return gap, first.top_speed + second.top_speed


@kernel
def _gap_of_hulls(
    vertices: F64, ends: I64, pieces: int, rotation: F64, shift: F64, simplex: Simplex
) -> float:
    """Return the smallest distance of the convex pieces of two bodies, 0 if some overlap.

    Parameters
    ----------
    vertices : (V, 3)
        Corners of the pieces of A, then of B, each in the frame of its body, metres.
    ends : (K + 1,)
        Rows at which the pieces begin, and V. ``pieces``: how many of the K belong to A.
    rotation, shift : (3, 3), (3,)
        From the frame of A to that of B.
    simplex : Simplex
        Work space.
    """
    smallest = np.inf
    span = np.empty(4, np.int64)
    for i in range(pieces):
        for j in range(pieces, len(ends) - 1):
            span[0], span[1], span[2], span[3] = ends[i], ends[i + 1], ends[j], ends[j + 1]
            result, _, distance = closest_points(
                vertices, span, rotation, shift, smallest, simplex, 0
            )
            if result == OVERLAPPING:
                return 0.0
            if result == CLOSE:
                smallest = min(smallest, distance)
    return smallest


def _gap_of_cloth(
    scene: Scene, state: State, cloth: int, body: int
) -> tuple[Callable[[float], float], float]:
    """Return the gap of a cloth and a body as a function of time, and the bound of its slope."""
    settings = ClothSettings()
    particles = surface_particles(scene.bodies[body], settings.particle_spacing)
    flying = _flying(scene.bodies[body], state, body, particles)
    number = cloth - len(scene.bodies)
    counts = [sheet.resolution**2 for sheet in scene.cloths]
    rows = slice(sum(counts[:number]), sum(counts[: number + 1]))
    vertices, velocities = state.cloth_vertices[rows].T, state.cloth_velocities[rows].T
    touching = settings.rest_distance + CLOTH_CONTACT_GAP

    def gap(seconds: float) -> float:
        points = np.ascontiguousarray(vertices + seconds * velocities)
        distance = smallest_distance(points, flying.points, *flying.pose(seconds))
        return min(distance - touching, FAR)

    return gap, flying.top_speed + float(np.max(norm(velocities.T)))


def _flying(body: Body, state: State, index: int, points: F64) -> FlyingBody:
    """Return a body whose points (P, 3) are given in its own frame, from its pivot."""
    rotation = rotation_matrices(state.rotations[index])
    center = body_mass(body).center
    return FlyingBody(
        points=points - center,
        center=state.positions[index] + apply(rotation, center),
        rotation=rotation,
        velocity=state.velocities[index],
        angular_velocity=state.angular_velocities[index],
    )


# State of agent, patient and probe at the last observed frame, as a row of numbers.

ROLES = ("agent", "patient", "probe")
PAIRS = (("agent", "patient"), ("probe", "agent"), ("probe", "patient"))
"""Pairs whose relative position and velocity are features."""
BLOCK: tuple[str, ...] = (
    "present",
    "cloth",
    "x",
    "y",
    "z",
    "qw",
    "qx",
    "qy",
    "qz",
    "vx",
    "vy",
    "vz",
)
BLOCK += ("wx", "wy", "wz", "length", "width", "height")
BETWEEN = ("dx", "dy", "dz", "dvx", "dvy", "dvz", "distance")
NAMES = tuple(f"{role} {name}" for role in ROLES for name in BLOCK) + tuple(
    f"{a} to {b} {name}" for a, b in PAIRS for name in BETWEEN
)
"""Names of the features; metres, seconds and radians."""


@dataclass(frozen=True)
class Thing:
    """Body or cloth at one instant: centre (3,), rotation (4,), velocities (3,), extents (3,)."""

    cloth: bool
    center: F64
    rotation: F64
    velocity: F64
    angular_velocity: F64
    size: F64


def state_features(motion: Motion) -> F64:
    """Return the features called `NAMES` of the last observed frame of a motion.

    Agent, patient and probe (the body that is pushed) give whether they are there, whether they
    are cloth, and then the centre of their bounding box, rotation (with w not negative),
    velocities and size; pairs of them give relative position and velocity, and distance. A cloth
    counts as a point with the mean of its vertices and no rotation. What is absent gives zeros.
    """
    scene, state = motion.scene, motion.trajectory.state(LAST_OBSERVED)
    things = {role: find_thing(scene, state, getattr(scene.roles, role)) for role in ROLES}
    rows = [_block(things[role]) for role in ROLES]
    rows += [_between(things[first], things[second]) for first, second in PAIRS]
    return np.concatenate(rows)


def find_thing(scene: Scene, state: State, name: str | None) -> Thing | None:
    """Return the body or cloth called ``name``, None if the scene or the instant has none."""
    if name is None:
        return None
    index = scene.index(name)
    if not scene.present(state.frame)[index]:
        return None
    if index >= len(scene.bodies):
        return _cloth(scene, state, index - len(scene.bodies))
    body = scene.bodies[index]
    low, high = shape(body.shape).bounds * np.asarray(body.scale)
    rotation = state.rotations[index]
    return Thing(
        cloth=False,
        center=state.positions[index] + rotate_vectors(rotation, (low + high) / 2),
        rotation=-rotation if rotation[0] < 0 else rotation,
        velocity=state.velocities[index],
        angular_velocity=state.angular_velocities[index],
        size=high - low,
    )


def _cloth(scene: Scene, state: State, number: int) -> Thing:
    """Return cloth ``number`` as the mean of its vertices."""
    counts = [cloth.resolution**2 for cloth in scene.cloths]
    rows = slice(sum(counts[:number]), sum(counts[: number + 1]))
    return Thing(
        cloth=True,
        center=state.cloth_vertices[rows].mean(axis=0),
        rotation=np.array([1.0, 0.0, 0.0, 0.0]),
        velocity=state.cloth_velocities[rows].mean(axis=0),
        angular_velocity=np.zeros(3),
        size=np.asarray(scene.cloths[number].size, np.float64),
    )


def _block(thing: Thing | None) -> F64:
    """Return the features of one thing, in the order of `BLOCK`."""
    if thing is None:
        return np.zeros(len(BLOCK))
    flags = [1.0, float(thing.cloth)]
    parts = [thing.center, thing.rotation, thing.velocity, thing.angular_velocity, thing.size]
    return np.concatenate([flags, *parts])


def _between(first: Thing | None, second: Thing | None) -> F64:
    """Return the features of a pair, in the order of `BETWEEN`."""
    if first is None or second is None:
        return np.zeros(len(BETWEEN))
    apart = second.center - first.center
    speed = second.velocity - first.velocity
    return np.concatenate([apart, speed, [float(norm(apart))]])


# What all baselines have in common.


def settings_digest(
    model: str, version: int, settings: Any, weights: Iterable[NDArray[Any]] = ()
) -> str:
    """Return the hexadecimal SHA-256 of a model.

    Parameters
    ----------
    model
        Its name.
    version
        Of its code; to be increased with every change that can alter a prediction.
    settings
        JSON values, mappings with text as keys.
    weights
        Arrays that were fitted, in a fixed order.
    """
    sha = hashlib.sha256(json.dumps([model, version, settings], sort_keys=True).encode())
    for array in weights:
        sha.update(repr((array.shape, array.dtype.str)).encode())
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()


class Baseline(Model):
    """Model that sees too little to predict; its score shows what that of another model is worth.

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
        return settings_digest(self.name, self.version, dataclasses.asdict(self.settings))


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
        return settings_digest(AlreadyTouched.name, AlreadyTouched.version, settings)


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

    Gravity, contacts and joints have no effect; a body that lies or flies goes on alike. The gap is
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

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return dataclasses.replace(super().provenance(), dynamics_type="constant velocity")

    def _gap(self, motion: Motion) -> float:
        """Return the gap of one observed motion."""
        if touched(motion):
            return 0.0
        state = motion.trajectory.state(LAST_OBSERVED)
        return gap_in_constant_motion(motion.scene, state, self.settings.frames)


# Baseline `state-classifier`: a statistical shortcut from the state at the last observed frame.


@dataclass(frozen=True, kw_only=True)
class StateClassifierSettings(ModelSettings):
    """Settings of `StateClassifier`: number of trees, and smallest number of trials of a leaf."""

    trees: int = 500
    leaf: int = 2

    def __post_init__(self) -> None:
        if min(self.trees, self.leaf) < 1:
            raise BadInputError("state-classifier: trees and leaf must be at least 1")


class StateClassifier(Baseline):
    """Extremely randomised trees on the true state of agent, patient and probe at one instant.

    It sees positions, rotations, velocities and sizes (`state_features`) and knows nothing of
    dynamics, the other bodies and what happened before. A simulator should predict better.

    References
    ----------
    P. Geurts, D. Ernst, L. Wehenkel, Extremely randomized trees, Machine Learning 63, 2006.
    """

    name = "state-classifier"
    sees = "true state"
    answers = "observed"
    settings: StateClassifierSettings

    def __init__(self, settings: StateClassifierSettings) -> None:
        super().__init__(settings)
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0, context_at="end")

    def fit(self, batch: Batch, labels: NDArray[np.bool_], seed: int) -> FittedTrees:
        """Return trees fitted on trials and their outcomes (B,); ``seed`` is that of the trees.

        The order of the trials does not matter. Raises `BadInputError` without trials.
        """
        if len(labels) != len(batch) or len(batch) == 0:
            raise BadInputError(f"{self.name}: {len(labels)} labels for {len(batch)} trials")
        order = np.argsort(np.array(batch.trials), kind="stable")
        trees = ExtraTreesClassifier(
            self.settings.trees, min_samples_leaf=self.settings.leaf, random_state=seed, n_jobs=1
        )
        trees.fit(_features(batch)[order], np.asarray(labels, np.bool_)[order])
        return FittedTrees(self.settings, trees)

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        versions = f"scikit-learn {sklearn.__version__}, physion {__version__}"
        return dataclasses.replace(super().provenance(), versions=versions)

    def digest(self) -> str:
        """Return the SHA-256 of code version and settings."""
        return settings_digest(self.name, self.version, _fit_settings(self.settings))


class FittedTrees:
    """`StateClassifier` that was fitted."""

    answers = "observed"

    def __init__(self, settings: StateClassifierSettings, trees: ExtraTreesClassifier) -> None:
        self.settings = settings
        self.trees = trees

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return the mean over trees of the fraction of contacts in a trial's leaf (B,)."""
        if len(batch) == 0:
            return np.zeros(0)
        known = list(self.trees.classes_)
        if True not in known:
            return np.zeros(len(batch))
        fractions = self.trees.predict_proba(_features(batch))[:, known.index(True)]
        return np.asarray(fractions, np.float64)

    def digest(self) -> str:
        """Return the SHA-256 of code version, settings and all trees."""
        arrays = [np.asarray(self.trees.classes_)]
        for tree in self.trees.estimators_:
            parts = tree.tree_
            arrays += [parts.children_left, parts.children_right, parts.feature]
            arrays += [parts.threshold, parts.value]
        kind = StateClassifier
        return settings_digest(kind.name, kind.version, _fit_settings(self.settings), arrays)


def _fit_settings(settings: StateClassifierSettings) -> list[Any]:
    """Return what determines the fit, as JSON values."""
    return [dataclasses.asdict(settings), NAMES, sklearn.__version__]


def _features(batch: Batch) -> NDArray[np.float64]:
    """Return the features (B, D) of all trials."""
    pairs = zip(motions(batch, StateClassifier.name), batch.trials, strict=True)
    rows = [state_features(observed_motion(motion, trial)) for motion, trial in pairs]
    return np.array(rows).reshape(len(batch), len(NAMES))
