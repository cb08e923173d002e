"""Official scenes that people saw, and simulations of them with levels of noise.

Part of `benchmarks/models/noise.py`. A scene whose contact is in the observed part is not
simulated: its fraction is 1, as in the model.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physion.analysis.tables import read_humans
from physion.core.names import canonical_name
from physion.core.seeds import stable_hash
from physion.data.official import official
from physion.models.noisy_simulation import (
    NoiseLevels,
    ObservedTrial,
    configuration_half,
    cut_trial,
    simulate_contacts,
)
from physion.physics.engine import make_engine, simulate
from physion.physics.rigid.bodies import collision_hulls, hull_moments
from physion.scenes.scene import OBSERVED_FRAMES, Body, Scene

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Prior:
    """Normal distributions of the logarithms of density (kg/m³) and friction of movable bodies."""

    density: float
    density_sd: float
    friction: float
    friction_sd: float


@dataclass(frozen=True)
class Answers:
    """Answers to N scenes: P(yes) of people and their number, the recorded outcome, and the half
    and the name of the configuration."""

    people: F64
    count: F64
    outcome: F64
    half: NDArray[np.int64]
    configuration: NDArray[np.str_]
    scenario: NDArray[np.str_]

    def at(self, places: NDArray[np.int64]) -> Answers:
        """Return the answers to some scenes."""
        fields = dataclasses.fields(self)
        return Answers(*(getattr(self, field.name)[places] for field in fields))


class Simulations:
    """Scenes, and the fractions of their simulations in which agent and patient touch.

    ``cache`` is a file of JSON lines to which all fractions are written, and from which an
    interrupted search continues.
    """

    def __init__(self, cache: Path | None) -> None:
        humans = read_humans(official().humans).set_index("stimulus")
        trials = {trial.scene.name: trial for trial in official().trials}
        seen = [name for name in trials if canonical_name(name) in humans.index]
        seen.sort(key=lambda name: stable_hash("noise", name))
        self.scenes = [trials[name].scene for name in seen]
        self.prior = fit_prior([t.scene for name, t in trials.items() if name not in set(seen)])
        rows = humans.loc[[canonical_name(name) for name in seen]]
        outcome = np.array([float(trials[name].outcome.contact) for name in seen])
        accuracy = rows["accuracy"].to_numpy(float)
        names = [str(scene.parameters["configuration"]) for scene in self.scenes]
        self.answers = Answers(
            people=np.where(outcome == 1, accuracy, 1 - accuracy),
            count=rows["count"].to_numpy(float),
            outcome=outcome,
            half=np.array([configuration_half(scene) for scene in self.scenes]),
            configuration=np.array(names),
            scenario=np.array([scene.scenario for scene in self.scenes]),
        )
        self.made = 0
        self._used: dict[str, int] = {}
        self._engine = make_engine()
        self._trials: dict[tuple[int, bool], ObservedTrial] = {}
        self._cache = cache
        self._known: dict[str, float] = {}
        if cache is not None and cache.exists():
            self._known = dict(json.loads(line) for line in cache.read_text().splitlines())

    @property
    def number(self) -> int:
        """Number of simulations behind all fractions so far, those of the cache included."""
        return sum(self._used.values())

    def subset(self, size: int) -> NDArray[np.int64]:
        """Return the positions of ``size`` scenes, as many of each half, scenario and outcome.

        They are the first by the hash of their names; a larger subset includes a smaller one.
        Scenes with cloth are left out: they would take most of the time.
        """
        groups: dict[tuple[int, str, float], int] = {}
        ranks = []
        for place, scene in enumerate(self.scenes):
            if scene.cloths:
                continue
            key = (int(self.answers.half[place]), scene.scenario, self.answers.outcome[place])
            groups[key] = groups.get(key, 0) + 1
            ranks.append((groups[key], place))
        return np.array(sorted(place for _, place in sorted(ranks)[:size]))

    def fractions(
        self, places: NDArray[np.int64], levels: NoiseLevels, samples: int, *, prior: bool = False
    ) -> F64:
        """Return the fraction of ``samples`` simulations with a contact for scenes (n,).

        With ``prior`` masses and frictions are drawn from the prior, not known.
        """
        if prior:
            levels = replace(levels, mass=self.prior.density_sd, friction=self.prior.friction_sd)
        return np.array([self._fraction(int(p), levels, samples, prior) for p in places])

    def _fraction(self, place: int, levels: NoiseLevels, samples: int, prior: bool) -> float:
        values = list(dataclasses.astuple(levels))
        key = json.dumps([self.scenes[place].name, values, samples, prior])
        trial = self._observed(place, prior)
        self._used[key] = 0 if trial.observed_contact else samples
        if key not in self._known:
            found = simulate_contacts(trial, levels, 1.0, samples, 0, self._engine)
            self.made += self._used[key]
            self._known[key] = float(np.mean(found))
            if self._cache is not None:
                with self._cache.open("a") as file:
                    file.write(json.dumps([key, self._known[key]]) + "\n")
        return self._known[key]

    def _observed(self, place: int, prior: bool) -> ObservedTrial:
        """Return the state at the last observed frame; with ``prior``, of a body of mean mass."""
        if (place, False) not in self._trials:
            scene = self.scenes[place]
            motion = simulate(scene, engine=self._engine, frames=OBSERVED_FRAMES)
            self._trials[place, False] = cut_trial(scene, motion)
        if prior and (place, True) not in self._trials:
            trial = self._trials[place, False]
            bodies = tuple(self._with_means(body) for body in trial.scene.bodies)
            changed = replace(trial, scene=replace(trial.scene, bodies=bodies))
            self._trials[place, True] = changed
        return self._trials[place, prior]

    def _with_means(self, body: Body) -> Body:
        if not movable(body):
            return body
        friction = float(np.exp(self.prior.friction))
        return replace(
            body,
            mass=float(np.exp(self.prior.density)) * volume(body),
            contact=replace(body.contact, static_friction=friction, dynamic_friction=friction),
        )


def movable(body: Body) -> bool:
    """Return whether a body can move, and has a volume."""
    return not (body.kinematic or body.scenery) and volume(body) > 0


def volume(body: Body) -> float:
    """Return the volume of a body in m³, that of its collision hulls."""
    return _unit_volume(body.shape) * abs(float(np.prod(body.scale)))


@cache
def _unit_volume(shape: str) -> float:
    hulls = collision_hulls(shape, (1.0, 1.0, 1.0))
    return float(sum(hull_moments(hull.corners)[0] for hull in hulls))


def fit_prior(scenes: Sequence[Scene]) -> Prior:
    """Return mean and standard deviation of log density and log friction over movable bodies."""
    bodies = [body for scene in scenes for body in scene.bodies if movable(body)]
    density = np.log([body.mass / volume(body) for body in bodies])
    friction = np.log([max(body.contact.dynamic_friction, 0.01) for body in bodies])
    values = (density.mean(), density.std(), friction.mean(), friction.std())
    return Prior(*(float(value) for value in values))
