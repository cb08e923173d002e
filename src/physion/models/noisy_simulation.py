"""Noisy simulation: the physics engine, started from the true state with noise added.

At the last observed frame, normal noise is added to positions, velocities and masses, and the
engine simulates the rest of the trial. P(contact) is the fraction of such simulations in which
agent and patient touch. The model has no weights and needs no torch.

- Noise of positions (bodies, 2): metres, along x and y only, because vertical noise would push
  objects on the floor into it or drop them. Bodies connected by joints move together, and a cloth
  moves as a whole.
- Noise of velocities (bodies, 3): metres per second.
- Noise of masses (bodies,): of the logarithm, so that 0.1 is about 10 %.
- P(contact): in 0..1, a multiple of 1 / samples; 1 if the contact was already observed.

All noise levels use the same normal random numbers, multiplied by the level. Noise and fit of the
scale compute with `physion.numerics`, so that predictions are the same on every machine.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import physion
from physion.errors import BadInputError
from physion.models.interface import Provenance, Spec, make_config
from physion.models.observed import cut_to_observed
from physion.numerics.elementary import exp, log
from physion.numerics.random_normals import standard_normal
from physion.physics.engine import DEFAULT_ENGINE, Engine, make_engine, simulate_many
from physion.physics.labels import label_contact
from physion.physics.trajectory import State, Trajectory
from physion.scenes.scene import OBSERVED_FRAMES, Scene
from physion.seeds import child_generator, trial_seed

LAST_OBSERVED = OBSERVED_FRAMES - 1

NOISE_VERSION = 2
"""Version of the random numbers; stored simulations of another version are not used."""


@dataclass(frozen=True, slots=True)
class NoisySimulationConfig:
    """Settings of `NoisySimulation`.

    - ``position`` (metres), ``velocity`` (metres per second), ``mass`` (relative): standard
      deviations of the noise. ``scale`` multiplies all three.
    - ``scales``: values of ``scale`` among which `fit_scale` chooses; with one value nothing is
      fitted.
    - ``samples``: simulations per trial. ``engine``: name of the engine. ``seed``: of the noise.
    """

    position: float = 0.01
    velocity: float = 0.1
    mass: float = 0.1
    scale: float = 1.0
    scales: tuple[float, ...] = (0.5, 1.0, 2.0)
    samples: int = 20
    engine: str = DEFAULT_ENGINE
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.position, self.velocity, self.mass, self.scale, *self.scales) < 0:
            raise BadInputError("noise levels and scales must not be negative")
        if self.samples < 1 or not self.scales:
            raise BadInputError("noisy-simulation needs at least one sample and one scale")


@dataclass(frozen=True)
class ObservedTrial:
    """Trial as the model receives it: the scene and its state at the last observed frame."""

    scene: Scene
    state: State
    observed_contact: bool


@dataclass(frozen=True)
class SimulationTask:
    """Simulations of one trial at one noise level, which an executor can send to a process.

    ``built`` is an engine object for use in this process; if None, the engine named in the config
    is built.
    """

    trial: ObservedTrial
    config: NoisySimulationConfig
    scale: float
    samples: tuple[int, ...]
    built: Engine | None = field(default=None, compare=False)

    def digest(self) -> str:
        """Return the hexadecimal SHA-256 of all inputs of the simulations."""
        state = self.trial.state
        settings = dataclasses.asdict(replace(self.config, scale=self.scale, scales=(1.0,)))
        parts: list[Any] = [
            NOISE_VERSION,
            self.trial.scene.physics_digest(),
            self.trial.scene.name,
            settings,
        ]
        parts += [self.samples, self.trial.observed_contact, state.frame, self._engine().name]
        sha = hashlib.sha256(json.dumps(parts, sort_keys=True).encode())
        for item in dataclasses.fields(state)[1:]:
            sha.update(np.ascontiguousarray(getattr(state, item.name)).tobytes())
        return sha.hexdigest()

    def _engine(self) -> Engine:
        return self.built or make_engine(self.config.engine)


def cut_trial(scene: Scene, trajectory: Trajectory) -> ObservedTrial:
    """Return the part of a trial that a model may use: the state at the last observed frame.

    Raises `BadInputError` if the trial is shorter, or was imported as a movie without motion.
    """
    seen = cut_to_observed(scene, trajectory)
    if not np.isfinite(seen.positions).all():
        raise BadInputError(
            f"trial {scene.name!r} was imported without motion ({trajectory.engine})"
        )
    return ObservedTrial(scene, seen.state(LAST_OBSERVED), label_contact(scene, seen).contact)


def run_simulations(task: SimulationTask) -> tuple[bool, ...]:
    """Return for each simulation of ``task`` whether agent and patient touch."""
    if task.trial.observed_contact:
        return (True,) * len(task.samples)
    scenes, states = zip(*(_noisy_start(task, sample) for sample in task.samples), strict=True)
    paths = simulate_many(scenes, engine=task._engine(), starts=states, until_contact=True)
    return tuple(
        label_contact(scene, path).contact for scene, path in zip(scenes, paths, strict=True)
    )


def add_noise(
    trial: ObservedTrial, config: NoisySimulationConfig, scale: float, sample: int
) -> tuple[Scene, State]:
    """Return scene and state with noise added.

    The noise is a function of the config's seed, the scene's name and ``sample``.
    """
    scene, state = trial.scene, trial.state
    rng = child_generator(trial_seed(config.seed, scene.scenario, scene.name, sample), "noise")
    count = len(scene.bodies)
    cloths = len(scene.cloths)
    shift = np.zeros((count + cloths, 3))
    shift[:, :2] = standard_normal(rng, (count + cloths, 2)) * config.position * scale
    kick = standard_normal(rng, (count + cloths, 3)) * config.velocity * scale
    factors = exp(standard_normal(rng, count) * config.mass * scale)
    roots = _joint_roots(scene)
    still = np.array([b.kinematic or b.scenery for b in scene.bodies] + [False] * cloths)
    shift, kick, still = shift[roots], kick[roots], still[roots]
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


def log_likelihood(fractions: NDArray[Any], samples: int, outcomes: NDArray[Any]) -> float:
    """Return the mean log-likelihood of ``outcomes`` (n,); NaN for n = 0.

    The probability of a contact is (k + 0.5) / (samples + 1), where k = fraction * samples is the
    number of simulations with a contact, so that it is never 0 or 1.
    """
    if len(fractions) == 0:
        return float("nan")
    p = (np.asarray(fractions, float) * samples + 0.5) / (samples + 1)
    # The exact sum: numpy's depends on the processor, and the fit compares sums.
    return math.fsum(log(np.where(np.asarray(outcomes, bool), p, 1.0 - p))) / len(p)


def fit_scale(
    fractions: Mapping[float, NDArray[Any]], samples: int, outcomes: NDArray[Any], default: float
) -> float:
    """Return the scale with the highest likelihood of ``outcomes``; among equals the smallest.

    Parameters
    ----------
    fractions
        For each scale the fractions (n,) of simulations with a contact.
    samples
        Simulations per trial.
    outcomes
        Contact or not (n,), of fit trials alone.
    default
        Scale to return if there is no trial. A single scale is always returned.
    """
    scales = sorted(fractions)
    if len(scales) == 1:
        return scales[0]
    if len(outcomes) == 0:
        return default
    return max(scales, key=lambda s: (log_likelihood(fractions[s], samples, outcomes), -s))


class NoisySimulation:
    """Model that simulates the rest of a trial several times with noise; see the module."""

    def __init__(self, config: NoisySimulationConfig, engine: Engine | None = None) -> None:
        self.config = config
        self.spec = Spec(modalities=("state",))
        self._built = engine
        self._engine: Engine = engine or make_engine(config.engine)

    def predict_contact(self, scene: Scene, trajectory: Trajectory) -> float:
        """Return P(agent touches patient), from the observed frames of ``trajectory`` alone."""
        return float(
            np.mean(run_simulations(self.task(cut_trial(scene, trajectory), self.config.scale)))
        )

    def task(self, trial: ObservedTrial, scale: float) -> SimulationTask:
        """Return the task with all simulations of a trial at one noise level."""
        return SimulationTask(
            trial, self.config, scale, tuple(range(self.config.samples)), self._built
        )

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return Provenance(
            model="noisy-simulation",
            init="none",
            encoder_type="true state",
            dynamics_type="physics engine",
            versions=f"{self._engine.name}, physion {physion.__version__}",
        )


def noisy_simulation(**options: Any) -> NoisySimulation:
    """Build the model; ``options`` are the fields of `NoisySimulationConfig`."""
    return NoisySimulation(make_config(NoisySimulationConfig, "noisy-simulation", options))


def _noisy_start(task: SimulationTask, sample: int) -> tuple[Scene, State]:
    """Return scene and state of one simulation, whose ending counts from the state on."""
    scene, state = add_noise(task.trial, task.config, task.scale, sample)
    # The scene's limits of length count from its frame 0; the simulation starts later.
    ending = replace(
        scene.ending,
        min_frames=max(1, scene.ending.min_frames - state.frame),
        max_frames=max(2, scene.ending.max_frames - state.frame),
    )
    return replace(scene, ending=ending), state


def _joint_roots(scene: Scene) -> NDArray[np.int64]:
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
