"""Noisy simulation: the physics engine, started from the true state with noise added.

At the last observed frame, normal noise is added to the state (`add_noise`), and the engine
simulates the rest of the trial. P(contact) comes from the number of such simulations in which agent
and patient touch, which is all of them if the contact was already observed. The model has no
weights and needs no torch.

All noise levels use the same normal random numbers, multiplied by the level and by one scale.
Bodies that are connected by joints move together, a cloth moves as a whole, and nothing that cannot
move gets noise. Noise and fit of the scale compute with `physion.numerics`, so that predictions are
the same on every machine.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

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
from physion.core.seeds import child_generator, stable_hash, trial_seed
from physion.core.version import __version__
from physion.models.baselines.motion import bodies_present
from physion.models.interface import Model, ModelSettings
from physion.numerics.elementary import cos, exp, sin, standard_normal
from physion.numerics.linear_algebra import norm
from physion.numerics.rotations import multiply_quaternions
from physion.physics.engine import DEFAULT_ENGINE, Engine, make_engine, simulate_many
from physion.physics.labels import contact_frames, label_contact
from physion.physics.trajectory import State, Trajectory
from physion.scenes.scene import OBSERVED_FRAMES, Body, Roles, Scene, SurfaceMaterial

F64 = NDArray[np.float64]

CONTACT_ROUNDS = 3
"""Contacts of one simulation that get noise, the earliest ones."""
WIDTH = 0.02
"""Metres by which a simulation may miss a body before it counts as improbable (`surprise`)."""
MOVING = 1e-3
"""Speed in metres per second above which a body moves."""
Properties = Literal["given", "default", "inferred"]
MASSES, FRICTIONS = (1.0, 0.25, 0.5, 2.0, 4.0), (0.5, 0.0, 0.25, 0.75, 1.0)
"""Masses (kg) and frictions of the agent among which the inferred ones are; the first are the
default ones."""


@dataclass(frozen=True)
class NoiseLevels:
    """Standard deviations of the noise.

    - ``position``: metres, along x and y. ``vertical``: metres, along z, of bodies in the air
      only: it would push others into what they rest on.
    - ``velocity``: metres per second. ``angular_velocity``: radians per second.
    - ``rotation``: radians, about any axis for bodies in the air, about the vertical for others.
    - ``mass``, ``friction``: of the logarithm, so that 0.1 is about 10 %.
    - ``contact``: of the velocity after a new contact, as a fraction of the relative speed of the
      two bodies before it.
    - ``lapse``: probability of an answer at random.
    """

    position: float = 0.01
    velocity: float = 0.1
    mass: float = 0.1
    vertical: float = 0.0
    rotation: float = 0.0
    angular_velocity: float = 0.0
    friction: float = 0.0
    contact: float = 0.0
    lapse: float = 0.0

    def check(self, where: str) -> None:
        """Raise `BadInputError` for a negative level or a lapse above 1."""
        levels = (
            self.position, self.velocity, self.mass, self.vertical, self.rotation,
            self.angular_velocity, self.friction, self.contact, self.lapse,
        )  # fmt: skip
        if min(levels) < 0 or self.lapse > 1:
            raise BadInputError(f"{where}: noise levels must not be negative, nor lapse above 1")


@dataclass(frozen=True)
class ObservedTrial:
    """Trial as the model receives it: the scene and its state at the last observed frame.

    ``touching``: indices of the bodies with a contact in that frame.
    """

    scene: Scene
    state: State
    observed_contact: bool
    touching: frozenset[int] = frozenset()


def believed_scene(motion: Motion, properties: Properties, engine: Engine) -> Scene:
    """Return a scene whose agent has the true, the default or the inferred mass and friction.

    Inferred are the values from `MASSES` and `FRICTIONS` with which a simulation without noise from
    frame 0 to `LAST_OBSERVED` comes nearest to the observed positions p of the agent: the least sum
    of |p - q|^2 over frames; of equals, the first. A cloth, or an agent that cannot move, stays as
    it is.
    """
    scene = motion.scene
    row = scene.index(scene.roles.agent)
    if properties == "given" or row >= len(scene.bodies) or scene.bodies[row].kinematic:
        return scene
    pairs = list(itertools.product(MASSES, FRICTIONS))
    scenes = [
        replace(scene, bodies=(*scene.bodies[:row], one, *scene.bodies[row + 1 :]))
        for one in (_with_properties(scene.bodies[row], *pair) for pair in pairs)
    ]
    if properties == "default":
        return scenes[0]
    seen = cut_to_observed(scene, motion.trajectory).positions[:, row].astype(np.float64)
    paths = simulate_many(scenes, engine=engine, frames=OBSERVED_FRAMES)
    errors = [float((norm(path.positions[:, row] - seen) ** 2).sum()) for path in paths]
    return scenes[int(np.argmin(errors))]


def _with_properties(body: Body, mass: float, friction: float) -> Body:
    surface = replace(body.contact, static_friction=friction, dynamic_friction=friction)
    return replace(body, mass=mass, contact=surface)


def add_noise(
    trial: ObservedTrial, levels: NoiseLevels, scale: float, sample: int, seed: int
) -> tuple[Scene, State]:
    """Return scene and state with noise added.

    The noise is a function of ``seed``, the scene's name and ``sample``. All scales use the same
    normal random numbers.
    """
    scene, state = trial.scene, trial.state
    rng = _generator(scene, seed, sample, "noise")
    count = len(scene.bodies)
    cloths = len(scene.cloths)
    shift = np.zeros((count + cloths, 3))
    shift[:, :2] = standard_normal(rng, (count + cloths, 2)) * levels.position * scale
    kick = standard_normal(rng, (count + cloths, 3)) * levels.velocity * scale
    factors = exp(standard_normal(rng, count) * levels.mass * scale)
    # Numbers of their own, so that the ones above do not depend on these levels.
    more = _generator(scene, seed, sample, "noise of the pose")
    rise = standard_normal(more, count + cloths) * levels.vertical * scale
    rotations = standard_normal(more, (count, 3)) * levels.rotation * scale
    spins = standard_normal(more, (count, 3)) * levels.angular_velocity * scale
    grips = exp(standard_normal(more, count) * levels.friction * scale)
    roots = joint_roots(scene)
    airborne = _airborne(trial, roots)
    shift[:, 2] = rise
    shift, kick = shift[roots], kick[roots]
    shift[~airborne, 2] = 0.0
    still = fixed_bodies(scene)[roots]
    shift[still] = kick[still] = 0.0
    rotations[~airborne[:count], :2] = 0.0
    fixed = still[:count] | _jointed(roots)[:count]
    rotations[fixed] = spins[fixed] = 0.0
    owner = np.repeat(np.arange(cloths), [cloth.resolution**2 for cloth in scene.cloths])
    bodies = tuple(
        body
        if still[i]
        else replace(
            body,
            mass=body.mass * float(factors[i]),
            contact=body.contact if grips[i] == 1.0 else _rougher(body.contact, float(grips[i])),
        )
        for i, body in enumerate(scene.bodies)
    )
    noisy = replace(
        state,
        positions=state.positions + shift[: len(state.positions)],
        velocities=state.velocities + kick[: len(state.velocities)],
        rotations=_rotated(state.rotations, rotations),
        angular_velocities=state.angular_velocities + spins,
        cloth_vertices=state.cloth_vertices + shift[count:][owner],
        cloth_velocities=state.cloth_velocities + kick[count:][owner],
    )
    return replace(scene, bodies=bodies), noisy


def simulate_contacts(
    trial: ObservedTrial,
    levels: NoiseLevels,
    scale: float,
    samples: int,
    seed: int,
    engine: Engine,
) -> list[bool]:
    """Return for each of ``samples`` noisy simulations whether agent and patient touch."""
    found = [True] * samples
    if not trial.observed_contact:
        starts = [add_noise(trial, levels, scale, sample, seed) for sample in range(samples)]
        scenes = [scene for scene, _ in starts]
        states = [state for _, state in starts]
        paths = _simulate(scenes, states, engine)
        if levels.contact > 0:
            level = levels.contact * scale
            paths, states = _with_contact_noise(scenes, states, paths, level, seed, engine)
        found = [
            len(contact_frames(scene, path, state.frame)) > 0
            for scene, path, state in zip(scenes, paths, states, strict=True)
        ]
    if levels.lapse > 0:
        for sample in range(samples):
            rng = _generator(trial.scene, seed, sample, "lapse")
            if rng.random() < levels.lapse:
                found[sample] = bool(rng.random() < 0.5)
    return found


def joint_roots(scene: Scene) -> NDArray[np.int64]:
    """Return for each body and cloth the index of the root of its chain of joints, or its own."""
    parents = {joint.child: joint.parent for joint in scene.joints}
    roots = []
    for name in scene.names():
        seen = {name}
        while name in parents and parents[name] not in seen:
            name = parents[name]
            seen.add(name)
        roots.append(scene.index(name))
    return np.array(roots, dtype=np.int64)


def fixed_bodies(scene: Scene) -> NDArray[np.bool_]:
    """Return which bodies and cloths cannot move."""
    return np.array([b.kinematic or b.scenery for b in scene.bodies] + [False] * len(scene.cloths))


def _generator(scene: Scene, seed: int, sample: int, what: str) -> np.random.Generator:
    return child_generator(trial_seed(seed, scene.scenario, scene.name, sample), what)


def _airborne(trial: ObservedTrial, roots: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which bodies and cloths move and touch nothing, nor does what they are joined to."""
    count = len(trial.scene.bodies)
    speed = norm(trial.state.velocities)
    free = np.zeros(len(roots), np.bool_)
    free[:count] = [i not in trial.touching and speed[i] > MOVING for i in range(count)]
    return np.array([free[roots == root].all() for root in roots], np.bool_)


def _jointed(roots: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which bodies and cloths are connected by a joint."""
    return np.bincount(roots, minlength=len(roots))[roots] > 1


def _rougher(material: SurfaceMaterial, factor: float) -> SurfaceMaterial:
    return replace(
        material,
        static_friction=material.static_friction * factor,
        dynamic_friction=material.dynamic_friction * factor,
    )


def _rotated(rotations: F64, vectors: F64) -> F64:
    """Return quaternions (N, 4) after rotations by rotation vectors (N, 3), in world axes.

    The quaternion of a rotation vector v is (cos(|v| / 2), sin(|v| / 2) v / |v|).
    """
    angles = norm(vectors)
    rotated: F64 = rotations.copy()
    rows = np.flatnonzero(angles > 0)
    if len(rows):
        half = angles[rows] / 2
        axes = vectors[rows] / angles[rows, None]
        change = np.column_stack([cos(half), axes * sin(half)[:, None]])
        rotated[rows] = multiply_quaternions(change, rotations[rows])
    return rotated


def _simulate(scenes: Sequence[Scene], states: Sequence[State], engine: Engine) -> list[Trajectory]:
    """Simulate every scene from its state; limits of length count from the trial's frame 0."""
    endings = [
        replace(
            scene.ending,
            min_frames=max(1, scene.ending.min_frames - state.frame),
            max_frames=max(2, scene.ending.max_frames - state.frame),
        )
        for scene, state in zip(scenes, states, strict=True)
    ]
    shortened = [
        replace(scene, ending=ending) for scene, ending in zip(scenes, endings, strict=True)
    ]
    return simulate_many(shortened, engine=engine, starts=states, until_contact=True)


def _with_contact_noise(
    scenes: Sequence[Scene],
    states: Sequence[State],
    paths: Sequence[Trajectory],
    level: float,
    seed: int,
    engine: Engine,
) -> tuple[list[Trajectory], list[State]]:
    """Simulate again from every new contact of a simulation, with noise of the velocities there.

    Returns the last simulations and the states that they start from.
    """
    results, starts = list(paths), list(states)
    known = [_pairs(path, 0) for path in results]
    rngs = [_generator(s, seed, sample, "contacts") for sample, s in enumerate(scenes)]
    active = list(range(len(scenes)))
    for _ in range(CONTACT_ROUNDS):
        again = []
        for i in active:
            new = _first_new_contact(scenes[i], results[i], known[i])
            if new is None:
                continue
            frame, pair = new
            known[i].add(pair)
            starts[i] = _perturbed(
                scenes[i], results[i], frame, pair, level, starts[i].frame + frame, rngs[i]
            )
            again.append(i)
        if not again:
            break
        paths = _simulate([scenes[i] for i in again], [starts[i] for i in again], engine)
        for i, path in zip(again, paths, strict=True):
            results[i] = path
        active = again
    return results, starts


def _pairs(path: Trajectory, frame: int) -> set[tuple[int, int]]:
    """Return the pairs of bodies that touch in a frame."""
    rows = path.contacts.bodies[path.contacts.frame == frame]
    return {(int(a), int(b)) for a, b in rows}


def _first_new_contact(
    scene: Scene, path: Trajectory, known: set[tuple[int, int]]
) -> tuple[int, tuple[int, int]] | None:
    """Return frame and pair of the first contact of two bodies that is not known.

    Contacts with the floor, in the first and in the last frame, and of cloths do not count, nor
    does what follows a contact of agent and patient, which decides the outcome.
    """
    contacts, count = path.contacts, len(scene.bodies)
    roles = {scene.index(scene.roles.agent), scene.index(scene.roles.patient)}
    for row in np.argsort(contacts.frame, kind="stable"):
        frame = int(contacts.frame[row])
        a, b = int(contacts.bodies[row, 0]), int(contacts.bodies[row, 1])
        if {a, b} == roles:
            return None
        if 0 < frame < len(path) - 1 and 0 <= a < count and b < count and (a, b) not in known:
            return frame, (a, b)
    return None


def _perturbed(
    scene: Scene,
    path: Trajectory,
    frame: int,
    pair: tuple[int, int],
    level: float,
    number: int,
    rng: np.random.Generator,
) -> State:
    """Return the state of a frame, called ``number``, with noise in the velocities of a pair."""
    state = replace(path.state(frame), frame=number)
    before = path.velocities[frame - 1].astype(np.float64)
    speed = float(norm(before[pair[0]] - before[pair[1]]))
    velocities = state.velocities.copy()
    fixed = fixed_bodies(scene)
    for body in pair:
        kick = standard_normal(rng, 3) * level * speed
        if not fixed[body]:
            velocities[body] += kick
    return replace(state, velocities=velocities)


# Levels of noise that were fitted to recorded outcomes or to people's answers.
#
# `benchmarks/models/noise.py` divided the official configurations into two halves and fitted
# the levels on each. A scene gets the levels that were fitted on the half without its
# configuration, so that no prediction of an official scene rests on its own outcome, or on
# answers to it.

FITTED: Mapping[str, tuple[NoiseLevels, NoiseLevels]] = {
    "outcomes": (NoiseLevels(lapse=0.1), NoiseLevels(vertical=0.01, contact=0.4)),
    "people": (
        NoiseLevels(
            position=0.05, velocity=0.2, vertical=0.05, rotation=0.2, contact=0.1, lapse=0.26
        ),
        NoiseLevels(vertical=0.01, contact=0.4, lapse=0.22),
    ),
}
"""By what they were fitted to: levels fitted on half 0 and on half 1, from
benchmarks/results/noise.md."""


def configuration_half(scene: Scene) -> int:
    """Return the half, 0 or 1, of a scene's configuration, by the hash of its name.

    A scene without a configuration, which is not official, counts by its own name.
    """
    return stable_hash("half", str(scene.parameters.get("configuration", scene.name))) % 2


def fitted_levels(target: str, scene: Scene) -> NoiseLevels:
    """Return the levels fitted to ``target`` on the half without the scene's configuration."""
    return FITTED[target][1 - configuration_half(scene)]


NAME = "noisy-simulation"
NOISE_VERSION = 2
"""Version of the random numbers; stored simulations of another version are not used."""


@dataclass(frozen=True, kw_only=True)
class NoisySimulationSettings(NoiseLevels, ModelSettings):
    """Settings of `NoisySimulation`: the levels of the noise (`NoiseLevels`), and others.

    ``noisy-simulation-outcomes`` and ``noisy-simulation-people`` take no levels: theirs are fitted.

    - ``scale``: factor of all standard deviations; if it is given, ``scales`` has only this value,
      unless they are given, too.
    - ``scales``: values of ``scale`` among which a decision chooses; with one value nothing is
      fitted.
    - ``samples``: simulations per trial. ``engine``: name of the engine. ``seed``: of the noise.
    - ``properties``: mass and friction of the agent: *given*, as they are; *default*, 1 kg and 0.5;
      or *inferred* from the observed part (`believed_scene`).
    """

    model: str = NAME
    scale: float = 1.0
    scales: tuple[float, ...] = (0.5, 1.0, 2.0)
    samples: int = 20
    engine: str = DEFAULT_ENGINE
    seed: int = 0
    properties: Properties = "given"

    @classmethod
    def defaults(cls, model: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return one scale where it is given, and for simulations with fitted noise."""
        if "scale" in options:
            return {"scales": (float(options["scale"]),)}
        return {} if model == NAME else {"scales": (1.0,)}

    @property
    def fitted_to(self) -> str:
        """What the levels were fitted to, a key of `FITTED`; empty for given levels."""
        return self.model.removeprefix(NAME).removeprefix("-")

    def __post_init__(self) -> None:
        self.check(self.model)
        changed = [
            field.name
            for field in dataclasses.fields(NoiseLevels)
            if getattr(self, field.name) != field.default
        ]
        if self.fitted_to and changed:
            raise BadInputError(
                f"the noise of {self.model} is fitted: leave out {changed[0]}, or use {NAME}"
            )
        if min((self.scale, *self.scales)) < 0:
            raise BadInputError(f"{self.model}: scales must not be negative")
        if self.samples < 1 or not self.scales:
            raise BadInputError(f"{self.model} needs at least one sample and one scale")


def cut_trial(scene: Scene, trajectory: Trajectory) -> ObservedTrial:
    """Return the part of a trial that a model may use: the state at the last observed frame.

    Raises `BadInputError` if the trial is shorter, or was imported as a movie without motion.
    """
    seen = cut_to_observed(scene, trajectory)
    if not np.isfinite(seen.positions).all():
        raise BadInputError(
            f"trial {scene.name!r} was imported without motion ({trajectory.engine})"
        )
    last = seen.contacts.frame == LAST_OBSERVED
    return ObservedTrial(
        scene,
        seen.state(LAST_OBSERVED),
        label_contact(scene, seen).contact,
        frozenset(int(body) for body in seen.contacts.bodies[last].ravel() if body >= 0),
    )


class NoisySimulation(Model):
    """Simulate the rest of a trial several times with noise, whose levels are given or fitted.

    ``engine`` is an engine object for use in this process; by default the settings name one.
    """

    decision = "noise"

    def __init__(self, settings: NoisySimulationSettings, engine: Engine | None = None) -> None:
        self.settings = settings
        self.spec = Spec(inputs=("state",), context_at="end", stride=1, context=1, future=0)
        self.samples, self.seed = settings.samples, settings.seed
        self.arguments = {"scale": settings.scales}
        self._given = engine
        self._built: Engine | None = None

    @property
    def engine(self) -> Engine:
        """The engine that simulates."""
        if self._built is None:
            self._built = self._given or make_engine(self.settings.engine)
        return self._built

    def believed(self, motion: Motion) -> Scene:
        """Return the scene as the model takes it to be (`believed_scene`)."""
        return believed_scene(motion, self.settings.properties, self.engine)

    def levels_for(self, scene: Scene) -> NoiseLevels:
        """Return the levels of the noise for a scene."""
        fitted = self.settings.fitted_to
        return fitted_levels(fitted, scene) if fitted else self.settings

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Simulate every trial ``samples`` times; ``contact`` says whether agent and patient touch.

        ``scale`` is the only argument; its default is in the settings. The noise of a sample is
        a function of ``seed``, the trial's name and the number of the sample.
        """
        scale = arguments.get("scale", self.settings.scale)
        assert context.state is not None, "the spec asks for states"
        found = [
            simulate_contacts(
                cut_trial(self.believed(motion), motion.trajectory),
                self.levels_for(motion.scene),
                scale,
                samples,
                seed,
                self.engine,
            )
            for motion in context.state
        ]
        return Rollout(contact=np.array(found, np.bool_).reshape(len(found), samples))

    def surprise(self, batch: Batch) -> NDArray[np.float64]:
        """Return how improbable each frame is (B, T) after the one before.

        From the state of the frame before, ``samples`` noisy simulations lead to this one. With the
        largest distance d of a body in each, and the width w = `WIDTH`, the surprise is
        -log mean exp(-d^2 / 2 w^2). Bodies that come or go do not count.
        """
        assert batch.state is not None, "the spec asks for states"
        found = np.zeros(batch.frames.shape)
        for row, (motion, frames) in enumerate(zip(batch.state, batch.frames, strict=True)):
            levels, path = self.levels_for(motion.scene), motion.trajectory
            # The noise is drawn by name, and movies of a pair, TRIAL+..., have the same noise.
            plain = replace(
                self.believed(motion), events=(), name=motion.scene.name.partition("+")[0]
            )
            for step, (before, now) in enumerate(itertools.pairwise(frames.tolist()), start=1):
                there = bodies_present(motion.scene, before, now)
                scene, state = _only(plain, path.state(before), there)
                trial = ObservedTrial(scene, state, False, _touching(path, before, there))
                starts = [
                    add_noise(trial, levels, self.settings.scale, sample, self.seed or 0)
                    for sample in range(self.samples)
                ]
                ends = simulate_many(
                    [one for one, _ in starts],
                    engine=self.engine,
                    starts=[one for _, one in starts],
                    frames=now - before + 1,
                )
                true = path.positions[now][there].astype(np.float64)
                far = [float(norm(end.positions[-1] - true).max(initial=0.0)) for end in ends]
                squares = (np.array(far) / WIDTH) ** 2 / 2
                least = float(squares.min())
                found[row, step] = least - np.log(np.exp(least - squares).mean())
        return found

    def digest(self) -> str:
        """Return the SHA-256 of engine and noise; without scales and number of samples."""
        settings = dataclasses.asdict(self.settings)
        levels = {field.name: settings[field.name] for field in dataclasses.fields(NoiseLevels)}
        parts: list[Any] = [NOISE_VERSION, self.engine.name, levels]
        if self.settings.properties != "given":
            parts.append(self.settings.properties)
        if fitted := self.settings.fitted_to:
            parts += [dataclasses.asdict(levels) for levels in FITTED[fitted]]
        return json_digest(parts)

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions, and what noise was fitted to."""
        fitted, known = self.settings.fitted_to, self.settings.properties
        return Provenance(
            model=self.settings.model,
            init="none",
            encoder_type=f"true state, {known} mass and friction"
            if known != "given"
            else "true state",
            dynamics_type="physics engine",
            dynamics_training_task=f"noise fitted to {fitted}" if fitted else "",
            versions=f"{self.engine.name}, physion {__version__}",
        )

    def __getstate__(self) -> dict[str, Any]:
        """Leave the engine behind that another process can build from its name."""
        return {**self.__dict__, "_built": None}


# Threshold on a distance that separates contacts from misses best.


def _only(scene: Scene, state: State, there: NDArray[np.bool_]) -> tuple[Scene, State]:
    """Return the bodies of a scene without cloth that are ``there`` (N,), and their state."""
    names = {body.name for body, stays in zip(scene.bodies, there, strict=True) if stays}
    roles = [name for name in (scene.roles.agent, scene.roles.patient) if name in names]
    # The question plays no part: any two names of bodies make the scene whole.
    agent, patient = (roles + sorted(names))[:2] if len(names) > 1 else (*names, *names)
    kept = replace(
        scene,
        bodies=tuple(body for body in scene.bodies if body.name in names),
        pushes=tuple(push for push in scene.pushes if push.body in names),
        joints=tuple(j for j in scene.joints if {j.parent, j.child} <= names),
        roles=Roles(agent, patient),
    )
    arrays = ("positions", "rotations", "velocities", "angular_velocities")
    return kept, replace(state, **{name: getattr(state, name)[there] for name in arrays})


def _touching(path: Trajectory, frame: int, there: NDArray[np.bool_]) -> frozenset[int]:
    """Return the bodies with a contact in a frame, as numbered among those that are ``there``."""
    rows = path.contacts.bodies[path.contacts.frame == frame].ravel()
    numbers = np.cumsum(there) - 1
    return frozenset(int(numbers[body]) for body in rows if body >= 0 and there[body])


def best_threshold(gaps: NDArray[np.float64], labels: NDArray[np.bool_]) -> float:
    """Return the threshold (m) under which ``gap <= threshold`` equals most ``labels`` (n,).

    The candidates are 0 and the middles between neighbouring gaps. Among those that are right
    equally often, the one closest to 0 is returned; without labels it is 0.
    """
    values = np.unique(gaps[np.isfinite(gaps)])
    candidates = np.concatenate([[0.0], (values[1:] + values[:-1]) / 2])
    if len(labels) == 0:
        return 0.0
    hits = (gaps[None, :] <= candidates[:, None]) == labels[None, :]
    right = hits.sum(axis=1)
    best = candidates[right == right.max()]
    return float(best[np.argmin(np.abs(best))])
