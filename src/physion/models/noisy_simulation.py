"""A model that knows the physics, but neither the exact state nor the exact masses.

From the true state at the end of the observed part it adds normal noise to positions, velocities
and masses, simulates on, and does so several times: P(contact) is the share of simulations in
which agent and patient touch. It has no weights and needs no torch.

- noise of positions (bodies, 2): metres, along x and y; vertical noise would only sink what lies
  on the floor into it, or drop it. Bodies that a joint holds move together; a cloth moves whole.
- noise of velocities (bodies, 3): metres per second.
- noise of masses (bodies,): the logarithm of the factor, so 0.1 is about 10 %.
- P(contact): in 0..1, a multiple of 1 / samples. It is 1 if the contact was already observed.

The same normal numbers are used at every noise level, so that levels differ by the level alone.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import physion
from physion.errors import BadInputError
from physion.models.interface import Provenance, Spec, make_config
from physion.models.observed import cut_to_observed
from physion.physics.engine import Engine, engines
from physion.physics.labels import label_contact
from physion.physics.trajectory import State, Trajectory
from physion.scenes.scene import OBSERVED_FRAMES, Scene
from physion.seeds import child_generator, trial_seed

LAST_OBSERVED = OBSERVED_FRAMES - 1


@dataclass(frozen=True, slots=True)
class Config:
    """Levels of noise (standard deviations), and how often to simulate.

    - ``position`` metres, ``velocity`` metres per second, ``mass`` relative; ``scale`` multiplies
      all three. ``scales`` are the values of it to choose from by `fit_scale`; one value: no fit.
    - ``samples``: simulations a trial. ``engine``: by name. ``seed``: of the noise.
    """

    position: float = 0.01
    velocity: float = 0.1
    mass: float = 0.1
    scale: float = 1.0
    scales: tuple[float, ...] = (0.5, 1.0, 2.0)
    samples: int = 20
    engine: str = "mujoco"
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.position, self.velocity, self.mass, self.scale, *self.scales) < 0:
            raise BadInputError("noise levels and scales must not be below zero")
        if self.samples < 1 or not self.scales:
            raise BadInputError("noisy-simulation needs at least one sample and one scale")


@dataclass(frozen=True)
class Question:
    """A trial as the model gets it: nothing of it lies after the last observed frame."""

    scene: Scene
    state: State
    observed_contact: bool


@dataclass(frozen=True)
class Task:
    """Some simulations of one trial, for an executor: a value that travels to another process.

    ``built`` is an engine to use in this process; None has the one named by the config built.
    """

    question: Question
    config: Config
    scale: float
    samples: tuple[int, ...]
    built: Engine | None = field(default=None, compare=False)

    def digest(self) -> str:
        """Hexadecimal SHA-256 of all that decides the answers."""
        state = self.question.state
        settings = dataclasses.asdict(replace(self.config, scale=self.scale, scales=(1.0,)))
        words: list[Any] = [
            self.question.scene.physics_digest(),
            self.question.scene.name,
            settings,
        ]
        words += [self.samples, self.question.observed_contact, state.frame, self._engine().name]
        sha = hashlib.sha256(json.dumps(words, sort_keys=True).encode())
        for item in dataclasses.fields(state)[1:]:
            sha.update(np.ascontiguousarray(getattr(state, item.name)).tobytes())
        return sha.hexdigest()

    def _engine(self) -> Engine:
        engine: Engine = self.built or engines.get(self.config.engine)()
        return engine


def ask(scene: Scene, trajectory: Trajectory) -> Question:
    """Cut a trial off after its last observed frame.

    `BadInputError` if it does not get there, or was imported as a movie alone, without motion.
    """
    seen = cut_to_observed(scene, trajectory)
    if not np.isfinite(seen.positions).all():
        raise BadInputError(
            f"trial {scene.name!r} has movies alone ({trajectory.engine}): no motion to go on from"
        )
    return Question(scene, seen.state(LAST_OBSERVED), label_contact(scene, seen).contact)


def run_task(task: Task) -> tuple[bool, ...]:
    """Did agent and patient touch in each of the simulations of ``task``?"""
    if task.question.observed_contact:
        return (True,) * len(task.samples)
    engine = task._engine()
    return tuple(_touches(task, engine, sample) for sample in task.samples)


def add_noise(question: Question, config: Config, scale: float, sample: int) -> tuple[Scene, State]:
    """The trial as one noisy observer takes it to be; sample and trial name decide the noise."""
    scene, state = question.scene, question.state
    rng = child_generator(trial_seed(config.seed, scene.scenario, scene.name, sample), "noise")
    count = len(scene.bodies)
    cloths = len(scene.cloths)
    shift = np.zeros((count + cloths, 3))
    shift[:, :2] = rng.normal(size=(count + cloths, 2)) * config.position * scale
    kick = rng.normal(size=(count + cloths, 3)) * config.velocity * scale
    factors = np.exp(rng.normal(size=count) * config.mass * scale)
    leaders = _leaders(scene)
    still = np.array([b.kinematic or b.scenery for b in scene.bodies] + [False] * cloths)
    shift, kick, still = shift[leaders], kick[leaders], still[leaders]
    shift[still] = kick[still] = 0.0
    owner = np.repeat(np.arange(cloths), [cloth.resolution**2 for cloth in scene.cloths])
    bodies = tuple(
        body if still[i] else replace(body, mass=body.mass * float(factors[i]))
        for i, body in enumerate(scene.bodies)
    )
    noisy = replace(
        state,
        positions=state.positions + shift[: len(state.positions)],
        velocities=state.velocities + kick[: len(state.velocities)],
        cloth_vertices=state.cloth_vertices + shift[count:][owner],
        cloth_velocities=state.cloth_velocities + kick[count:][owner],
    )
    return replace(scene, bodies=bodies), noisy


def log_likelihood(shares: NDArray[Any], samples: int, outcomes: NDArray[Any]) -> float:
    """Mean log-probability of ``outcomes`` (n,) given ``shares`` (n,) of contacts in ``samples``.

    Half a contact and half a miss are added, so that no share is a certainty. NaN for n = 0.
    """
    if len(shares) == 0:
        return float("nan")
    p = (np.asarray(shares, float) * samples + 0.5) / (samples + 1)
    return float(np.mean(np.where(np.asarray(outcomes, bool), np.log(p), np.log1p(-p))))


def fit_scale(
    shares: Mapping[float, NDArray[Any]], samples: int, outcomes: NDArray[Any], default: float
) -> float:
    """The scale under which ``outcomes`` are likeliest; the smallest of equals.

    ``shares[scale]`` (n,) and ``outcomes`` (n,) are of readout trials, never of tested ones.
    Without a trial, or with one scale only, there is nothing to choose: the only scale, or
    ``default``.
    """
    scales = sorted(shares)
    if len(scales) == 1:
        return scales[0]
    if len(outcomes) == 0:
        return default
    return max(scales, key=lambda s: (log_likelihood(shares[s], samples, outcomes), -s))


class NoisySimulation:
    """See the module."""

    def __init__(self, config: Config, engine: Engine | None = None) -> None:
        self.config = config
        self.spec = Spec(modalities=("state",))
        self._built = engine
        self._engine: Engine = engine if engine is not None else engines.get(config.engine)()

    def predict_contact(self, scene: Scene, trajectory: Trajectory) -> float:
        """P(agent touches patient), from the observed part of ``trajectory`` alone."""
        return float(np.mean(run_task(self.task(ask(scene, trajectory), self.config.scale))))

    def task(self, question: Question, scale: float) -> Task:
        """All simulations of a trial at one noise level."""
        return Task(question, self.config, scale, tuple(range(self.config.samples)), self._built)

    def provenance(self) -> Provenance:
        """Name and versions, for the tables."""
        return Provenance(
            model="noisy-simulation",
            init="none",
            encoder_type="true state",
            dynamics_type="physics engine",
            versions=f"{self._engine.name}, physion {physion.__version__}",
        )


def noisy_simulation(**options: Any) -> NoisySimulation:
    """The model; options are the fields of `Config`, and ``engine`` a name of an engine."""
    return NoisySimulation(make_config(Config, "noisy-simulation", options))


def _touches(task: Task, engine: Engine, sample: int) -> bool:
    scene, state = add_noise(task.question, task.config, task.scale, sample)
    # The trial's own rules of ending, counted on from the frame where the simulation starts.
    ending = replace(
        scene.ending,
        min_frames=max(1, scene.ending.min_frames - state.frame),
        max_frames=max(2, scene.ending.max_frames - state.frame),
    )
    scene = replace(scene, ending=ending)
    return label_contact(scene, engine.simulate(scene, start=state, until_contact=True)).contact


def _leaders(scene: Scene) -> NDArray[np.int64]:
    """For each body and cloth the one that it is joined to, through all joints, or itself."""
    parents = {joint.child: joint.parent for joint in scene.joints}
    leaders = []
    for name in scene.names():
        seen = {name}
        while name in parents and parents[name] not in seen:
            name = parents[name]
            seen.add(name)
        leaders.append(scene.index(name))
    return np.array(leaders, dtype=np.int64)
