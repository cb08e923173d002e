"""A cue clip that shows the agent's mass or friction, then a test clip that depends on it.

After Physion++, whose movies have a period in which properties show and one that asks about them.
A movie has two clips, with a cut at frame `CUT`, before the end of the observed part:

- **Cue.** The probe rolls against the agent. How far and how long the agent slides shows its mass
  (`cue-mass`) or its friction (`cue-friction`).
- **Test.** Agent and probe are put elsewhere, at rest, and the probe rolls towards the agent again;
  it arrives after the observed part. From `CUT` to the end of the observed part the states of all
  bodies are the same whatever the property.

Each trial of a dataset gives four trials of a kind, two tests with two values:

============================  ===================  ================
test                          light, or slippery   heavy, or rough
============================  ===================  ================
far: the patient rests ahead  contact              no contact
near: it crosses the way      no contact           contact
============================  ===================  ================

So neither the cue nor the test tells the outcome by itself: a model without one of them has half of
the trials right, and of no test both. The trials are called ``TRIAL+KIND.TEST.VALUE``, numbers 0
and 1 in an order that tells nothing. ``parameters`` of their scenes hold ``whatif``, as
``cue-mass.far.light``, and ``base``, the trial, whose room they have.

References
----------
H.-Y. Tung and others, Physion++: Evaluating physical scene understanding that requires online
inference of different physical properties, NeurIPS 2023.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from physion.core.errors import BadInputError, BadSceneError, PhysionError
from physion.core.seeds import child_generator, named_seed, stable_hash
from physion.numerics.linear_algebra import norm
from physion.physics.engine import Engine, make_engine
from physion.physics.labels import label_contact
from physion.physics.trajectory import Trajectory
from physion.scenes.looks import COLORS_OF
from physion.scenes.sampling.build import Palette
from physion.scenes.sampling.parameters import pick, uniform
from physion.scenes.sampling.placement import CameraRule, place_camera
from physion.scenes.scene import (
    FRAME_TIME,
    OBSERVED_FRAMES,
    Body,
    BodyEvent,
    Ending,
    Look,
    Push,
    Roles,
    Scene,
    SurfaceMaterial,
)
from physion.trials.dataset import Dataset
from physion.trials.making.plan import WHATIF, TrialTask
from physion.trials.making.whatif import AFTER, MARK

CUT = 32
"""First frame of the test clip."""
FRAMES = 151
"""Frames of a movie; all have the same, since a length may tell the outcome."""
IMPACT = 47
"""Frame in which the probe reaches the agent in the test, about."""
TESTS = ("far", "near")
VALUES = {"cue-mass": ("light", "heavy"), "cue-friction": ("slippery", "rough")}
"""Values of a property: with the first the agent slides farther."""
MASSES = (0.25, 4.0)
"""Kilograms of a light and a heavy agent; all other bodies have 1."""
FRICTIONS = (0.0, 1.0)
"""Static and dynamic friction of a slippery and a rough agent, otherwise 0.5."""
RESTITUTION = 0.8
SIDES, HEIGHTS, RADIUS = (0.36, 0.42), (0.20, 0.22), 0.11
"""Metres: width and height of the agent, so flat that it slides and does not tip over, and radius
of probe and patient."""
CUE_SPEEDS, TEST_SPEEDS, CROSSING_SPEEDS = (2.6, 3.2), (4.2, 5.2), (2.6, 3.0)
"""Metres per second with which the probe starts in cue and test, and the patient that crosses."""
START, LANE, SIDEWAYS = -0.5, 0.7, 1.1
"""Metres: x of the agent in the test, distance of the cue from the test, and of the patient that
crosses from the agent's way."""
FARTHER = 0.4
"""Metres by which the agent slides farther with the first value, at least."""
CLEARANCE = 0.05
"""Metres between the circles around agent and patient where they do not touch, at least."""
LEAD, FAR_AWAY = 0.06, 50.0
"""Metres from probe to agent at the start, and of a patient that is in nobody's way."""
HALFWAY = (0.4, 0.6)
"""Where the agent meets a resting patient, as a fraction of the way between its two stops."""
SHAPES = ("cube", "cylinder")
CAMERA, AIM_HEIGHT = CameraRule((1.7, 1.9), (10.0, 80.0), (1.2, 1.9)), 0.1
"""Views from one side of the agent's way, so that no body hides another for long; metres. In half
of the draws it is the other side."""
TRIES = 60
"""Draws for a trial, after which it fails."""


def cue_tasks(
    dataset: Dataset, trials: Sequence[str], kinds: Sequence[str], engine: str
) -> list[TrialTask]:
    """Return tasks for the four trials of each of ``trials`` and each of ``kinds``, from `CUES`.

    Raises `BadInputError` for a trial that is itself a variant, and `PhysionError` if none of
    `TRIES` draws gives the four outcomes.
    """
    run, tasks = make_engine(engine), []
    for name in trials:
        if MARK in name:
            raise BadInputError(f"trial {name!r} is a variant: give trials that were sampled")
        trial = dataset.trial(name)
        meta = trial.metadata
        for kind in dict.fromkeys(kinds):
            tasks += [
                TrialTask(meta.dataset, meta.scenario, meta.split, AFTER + meta.index, scene=scene)
                for scene in four_scenes(trial.scene, kind, run, meta.dataset)
            ]
    return tasks


def four_scenes(base: Scene, kind: str, engine: Engine, dataset: str = "") -> list[Scene]:
    """Return the scenes of both tests with both values, in the room of ``base``.

    They are a function of the names of ``dataset`` and ``base`` and of ``kind``.
    """
    for attempt in range(TRIES):
        found = _draw(base, kind, named_seed("cue", dataset, base.name, kind, attempt), engine)
        if found is not None:
            return _named(found, base, kind, dataset)
    raise PhysionError(
        f"none of {TRIES} scenes of {kind} for {base.name!r} has the four outcomes with the engine "
        f"{engine.name}: leave this kind out, or choose another engine"
    )


Scenes = dict[tuple[str, str], Scene]
"""Scenes by test and value."""


def _named(made: Scenes, base: Scene, kind: str, dataset: str) -> list[Scene]:
    """Return scenes by test and value with their names, whose numbers tell nothing."""
    colors = next(iter(made.values())).physics_digest()
    scenes = []
    for number, test in enumerate(_shuffled(TESTS, dataset, base.name, kind)):
        for place, value in enumerate(_shuffled(VALUES[kind], dataset, base.name, kind, test)):
            known = {WHATIF: f"{kind}.{test}.{value}", "base": base.name, COLORS_OF: colors}
            name = f"{base.name}{MARK}{kind}.{number}.{place}"
            scenes.append(replace(made[test, value], name=name, parameters=known))
    return scenes


def _shuffled(pair: tuple[str, ...], *names: str) -> tuple[str, ...]:
    return pair[::-1] if stable_hash("order", *names) % 2 else pair


def _draw(base: Scene, kind: str, seed: np.random.SeedSequence, engine: Engine) -> Scenes | None:
    """Return the four scenes of a seed; None if they have not the outcomes that they should have.

    The agent slides along x. Without a patient in its way it stops at a with the first value and
    at b < a with the second. A resting patient is where the agent meets it about halfway between; a
    crossing one reaches b, when the agent has passed or lies there.
    """
    rng, palette = child_generator(seed, "placement"), Palette.of(seed)
    side, height, shape = uniform(rng, SIDES), uniform(rng, HEIGHTS), pick(rng, SHAPES)
    lane = LANE if rng.random() < 0.5 else -LANE
    aside = math.copysign(SIDEWAYS, -lane)
    behind = 180.0 if rng.random() < 0.5 else 0.0
    low, high = (angle + behind for angle in CAMERA.angle_deg)
    rule = replace(CAMERA, angle_deg=(low, high))
    cue_speed, speed, crossing = (
        uniform(rng, speeds) for speeds in (CUE_SPEEDS, TEST_SPEEDS, CROSSING_SPEEDS)
    )
    cue_start = uniform(rng, (START, START + 0.4))
    gap = side / 2 + RADIUS
    away = gap + speed * FRAME_TIME * (IMPACT - CUT)

    def ball(name: str, x: float, y: float) -> Body:
        look = palette.look(("wood",))
        surface = SurfaceMaterial(0.0, 0.0, RESTITUTION)
        diameter = 2 * RADIUS
        return Body(
            name, "sphere", (x, y, base.floor), (diameter,) * 3, contact=surface, look=look
        )  # fmt: skip

    def agent(mass: float, friction: float) -> Body:
        return Body(
            "agent", shape, (cue_start, lane, base.floor), (side, side, height), mass=mass,
            contact=SurfaceMaterial(friction, friction, RESTITUTION),
            look=Look(palette.agent, "plastic"),
        )  # fmt: skip

    if kind == "cue-mass":
        agents = [agent(mass, 0.5) for mass in MASSES]
    else:
        agents = [agent(1.0, friction) for friction in FRICTIONS]
    probe = ball("probe", cue_start - gap - LEAD, lane)
    patient = ball("patient", 0.0, -FAR_AWAY)
    corners = [(START - away, 0.0), (START + 1.3, 0.0), (cue_start + 1.0, lane), (0.0, aside)]
    shown = [replace(probe, position=(x, y, base.floor)) for x, y in corners]
    try:
        camera = place_camera(child_generator(seed, "camera"), rule, AIM_HEIGHT, shown)
    except BadSceneError:
        return None

    roles = Roles("agent", "patient", "probe")

    def scene(body: Body, patient: Body, push: float = 0.0) -> Scene:
        moves = [("agent", START), ("probe", START - away)]
        pushes = [Push("probe", (cue_speed, 0.0, 0.0)), Push("probe", (speed, 0.0, 0.0), frame=CUT)]
        if push:
            pushes.append(Push("patient", (0.0, push, 0.0), frame=CUT))
        return Scene(
            "cue", base.scenario, (body, probe, patient), roles, camera,
            pushes=tuple(pushes), room=base.room, floor=base.floor, ending=Ending(FRAMES, FRAMES),
            events=tuple(
                BodyEvent(CUT, name, "move", (x, 0.0, base.floor), body.rotation)
                for name, x in moves
            ),
        )  # fmt: skip

    stops = [float(engine.simulate(scene(one, patient)).positions[-1, 0, 0]) for one in agents]
    if stops[0] - stops[1] < FARTHER:
        return None
    ahead = stops[1] + uniform(rng, HALFWAY) * (stops[0] - stops[1]) + gap
    placed = {
        "far": (replace(patient, position=(ahead, 0.0, base.floor)), 0.0),
        "near": (
            replace(patient, position=(stops[1], aside, base.floor)),
            math.copysign(crossing, lane),
        ),
    }
    found = {
        (test, value): scene(one, *placed[test])
        for test in TESTS
        for value, one in zip(VALUES[kind], agents, strict=True)
    }
    paths = {key: engine.simulate(one) for key, one in found.items()}
    touching = {(TESTS[0], VALUES[kind][0]), (TESTS[1], VALUES[kind][1])}
    for key, path in paths.items():
        labels = label_contact(found[key], path)
        if labels.observed or labels.contact != (key in touching):
            return None
        distances = norm(path.positions[:, 0, :2].astype(np.float64) - path.positions[:, 2, :2])
        if not labels.contact and distances.min() < side / math.sqrt(2) + RADIUS + CLEARANCE:
            return None
    for test in TESTS:
        if not _alike(*(paths[test, value] for value in VALUES[kind])):
            return None
    return found


def _alike(one: Trajectory, other: Trajectory) -> bool:
    """Return whether two motions are equal from `CUT` to the end of the observed part."""
    part = slice(CUT, OBSERVED_FRAMES)
    return all(
        np.array_equal(getattr(one, name)[part], getattr(other, name)[part])
        for name in ("positions", "rotations", "velocities", "angular_velocities")
    )
