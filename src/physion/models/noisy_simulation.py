"""Noisy simulation: the physics engine, started from the true state with noise added.

At the last observed frame, normal noise is added to the state (`models.state_noise`), and the
engine simulates the rest of the trial. P(contact) is the fraction of such simulations in which
agent and patient touch, a multiple of 1 / samples; 1 if the contact was already observed. The model
has no weights and needs no torch.

All noise levels use the same normal random numbers, multiplied by the level. Noise and fit of the
scale compute with `physion.numerics`, so that predictions are the same on every machine.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import Batch, Provenance, Rollout, Spec, cut_to_observed
from physion.core.errors import BadInputError
from physion.core.seeds import stable_hash
from physion.core.version import __version__
from physion.models.interface import Model, ModelSettings
from physion.models.state_noise import NoiseLevels, ObservedTrial, simulate_contacts
from physion.physics.engine import DEFAULT_ENGINE, Engine, make_engine
from physion.physics.labels import label_contact
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import OBSERVED_FRAMES, Scene

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


LAST_OBSERVED = OBSERVED_FRAMES - 1

NAME = "noisy-simulation"
NOISE_VERSION = 2
"""Version of the random numbers; stored simulations of another version are not used."""


@dataclass(frozen=True, kw_only=True)
class NoisySimulationSettings(NoiseLevels, ModelSettings):
    """Settings of `NoisySimulation`: the levels of the noise (`NoiseLevels`), and others.

    ``noisy-simulation-outcomes`` and ``noisy-simulation-people`` take no levels: theirs are fitted.

    - ``scale``: factor of all standard deviations.
    - ``scales``: values of ``scale`` among which a decision chooses; with one value nothing is
      fitted.
    - ``samples``: simulations per trial. ``engine``: name of the engine. ``seed``: of the noise.
    """

    model: str = NAME
    scale: float = 1.0
    scales: tuple[float, ...] = (0.5, 1.0, 2.0)
    samples: int = 20
    engine: str = DEFAULT_ENGINE
    seed: int = 0

    @classmethod
    def defaults(cls, model: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings of simulations with fitted noise, which have one scale."""
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
    """Model that simulates the rest of a trial several times with noise; see the module.

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

    def levels_for(self, scene: Scene) -> NoiseLevels:
        """Return the levels of the noise for a scene."""
        fitted = self.settings.fitted_to
        return fitted_levels(fitted, scene) if fitted else self.settings

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Simulate every trial ``samples`` times; ``contact`` says whether agent and patient touch.

        ``scale`` is the only argument; by default as in the settings. The noise of a sample is
        a function of ``seed``, the trial's name and the number of the sample.
        """
        scale = arguments.get("scale", self.settings.scale)
        assert context.state is not None, "the spec asks for states"
        found = [
            simulate_contacts(
                cut_trial(motion.scene, motion.trajectory),
                self.levels_for(motion.scene),
                scale,
                samples,
                seed,
                self.engine,
            )
            for motion in context.state
        ]
        return Rollout(contact=np.array(found, np.bool_).reshape(len(found), samples))

    def digest(self) -> str:
        """Return the SHA-256 of engine and noise; scales and number of samples are no part."""
        settings = dataclasses.asdict(self.settings)
        levels = {field.name: settings[field.name] for field in dataclasses.fields(NoiseLevels)}
        parts: list[Any] = [NOISE_VERSION, self.engine.name, levels]
        if fitted := self.settings.fitted_to:
            parts += [dataclasses.asdict(levels) for levels in FITTED[fitted]]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions, and what noise was fitted to."""
        fitted = self.settings.fitted_to
        return Provenance(
            model=self.settings.model,
            init="none",
            encoder_type="true state",
            dynamics_type="physics engine",
            dynamics_training_task=f"noise fitted to {fitted}" if fitted else "",
            versions=f"{self.engine.name}, physion {__version__}",
        )

    def __getstate__(self) -> dict[str, Any]:
        """Leave the engine behind that another process can build from its name."""
        return {**self.__dict__, "_built": None}


def noisy_simulation(settings: NoisySimulationSettings) -> NoisySimulation:
    """Build simulations that start from the true state with noise added."""
    return NoisySimulation(settings)


def noise_of_outcomes(settings: NoisySimulationSettings) -> NoisySimulation:
    """Build simulations whose noise was fitted to outcomes of other configurations."""
    return NoisySimulation(settings)


def noise_of_people(settings: NoisySimulationSettings) -> NoisySimulation:
    """Build simulations whose noise was fitted to people's answers to other configurations."""
    return NoisySimulation(settings)


# Threshold on a distance that separates contacts from misses best.


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
