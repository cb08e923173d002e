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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.models.batch import Batch, Provenance, Rollout, Spec
from physion.models.build import make_config
from physion.models.observed import cut_to_observed
from physion.numerics.elementary import exp
from physion.numerics.random_normals import standard_normal
from physion.physics.engine import DEFAULT_ENGINE, Engine, make_engine, simulate_many
from physion.physics.labels import label_contact
from physion.physics.trajectory import State, Trajectory
from physion.scenes.scene import OBSERVED_FRAMES, Scene
from physion.seeds import child_generator, trial_seed
from physion.version import __version__

LAST_OBSERVED = OBSERVED_FRAMES - 1

NOISE_VERSION = 2
"""Version of the random numbers; stored simulations of another version are not used."""


@dataclass(frozen=True, slots=True)
class NoisySimulationConfig:
    """Settings of `NoisySimulation`.

    - ``position`` (metres), ``velocity`` (metres per second), ``mass`` (relative): standard
      deviations of the noise. ``scale`` multiplies all three.
    - ``scales``: values of ``scale`` among which a reader chooses; with one value nothing is
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


class NoisySimulation:
    """Model that simulates the rest of a trial several times with noise; see the module.

    ``engine`` is an engine object for use in this process; by default the one named in the config.
    """

    reader = "noise"

    def __init__(self, config: NoisySimulationConfig, engine: Engine | None = None) -> None:
        self.config = config
        self.spec = Spec(inputs=("state",), anchor="end", stride=1, context=1, future=0)
        self.samples, self.seed = config.samples, config.seed
        self.knobs = {"scale": config.scales}
        self._given = engine
        self._built: Engine | None = None

    @property
    def engine(self) -> Engine:
        """The engine that simulates."""
        if self._built is None:
            self._built = self._given or make_engine(self.config.engine)
        return self._built

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: float) -> Rollout:
        """Simulate every trial ``samples`` times; ``contact`` says whether agent and patient touch.

        ``scale`` is the only knob; by default it is that of the config. The noise of a sample is a
        function of ``seed``, the trial's name and the number of the sample.
        """
        scale = knobs.get("scale", self.config.scale)
        assert context.state is not None, "the spec asks for states"
        found = [
            self._simulate(cut_trial(motion.scene, motion.trajectory), samples, seed, scale)
            for motion in context.state
        ]
        return Rollout(contact=np.array(found, np.bool_).reshape(len(found), samples))

    def digest(self) -> str:
        """Return the SHA-256 of engine and noise; scales and number of samples are no part."""
        config = dataclasses.asdict(self.config)
        settings = {name: config[name] for name in ("position", "velocity", "mass")}
        parts = [NOISE_VERSION, self.engine.name, settings]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return Provenance(
            model="noisy-simulation",
            init="none",
            encoder_type="true state",
            dynamics_type="physics engine",
            versions=f"{self.engine.name}, physion {__version__}",
        )

    def __getstate__(self) -> dict[str, Any]:
        """Leave the engine behind that another process can build from its name."""
        return {**self.__dict__, "_built": None}

    def _simulate(self, trial: ObservedTrial, samples: int, seed: int, scale: float) -> list[bool]:
        if trial.observed_contact:
            return [True] * samples
        config = replace(self.config, seed=seed)
        starts = [_noisy_start(trial, config, scale, sample) for sample in range(samples)]
        scenes, states = zip(*starts, strict=True)
        paths = simulate_many(scenes, engine=self.engine, starts=states, until_contact=True)
        return [
            label_contact(scene, path).contact for scene, path in zip(scenes, paths, strict=True)
        ]


def noisy_simulation(**options: Any) -> NoisySimulation:
    """Build the model; ``options`` are the fields of `NoisySimulationConfig`."""
    return NoisySimulation(make_config(NoisySimulationConfig, "noisy-simulation", options))


def _noisy_start(
    trial: ObservedTrial, config: NoisySimulationConfig, scale: float, sample: int
) -> tuple[Scene, State]:
    """Return scene and state of one simulation, whose ending counts from the state on."""
    scene, state = add_noise(trial, config, scale, sample)
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
