"""Noisy simulation: noise of the state, and levels that were fitted."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import replace
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.seeds import child_generator, trial_seed
from physion.data.official import official
from physion.models import Batch, Motion
from physion.models.build import build_model
from physion.models.noisy_simulation import (
    FITTED,
    NoiseLevels,
    NoisySimulation,
    NoisySimulationSettings,
    ObservedTrial,
    add_noise,
    believed_scene,
    configuration_half,
    cut_trial,
    fitted_levels,
    simulate_contacts,
)
from physion.numerics.elementary import exp_of, standard_normal
from physion.physics.engine import make_engine, simulate
from physion.physics.trajectory import Contacts, State, Trajectory
from physion.scenes.scene import (
    Body,
    BodyEvent,
    Camera,
    Cloth,
    Joint,
    Push,
    Roles,
    Scene,
    SurfaceMaterial,
)
from support.paths import ROOT

FRAMES = 120


def scene(offset: float = 0.0, name: str = "pair", **more: Any) -> Scene:
    """Return a scene with a ball that passes a box at a lateral distance of ``offset`` metres."""
    bodies = (
        Body("ball", "sphere", (0.0, offset, 0.0)),
        Body("box", "cube", (2.0, 0.0, 0.0), mass=3.0),
        Body("wall", "cube", (9.0, 9.0, 0.0), kinematic=True),
    )
    return Scene(name, "collide", bodies, Roles("ball", "box"), Camera((3.0, 0.0, 1.0)), **more)


class StraightEngine:
    """Engine of straight motion, in which ball and box touch when closer than 0.5 m."""

    name = "straight 1"

    def __init__(self) -> None:
        self.starts: list[State] = []
        self.scenes: list[Scene] = []

    def simulate(
        self,
        scene: Scene,
        *,
        start: State | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> Trajectory:
        count = len(scene.bodies)
        if start is None:
            velocities = np.zeros((count, 3))
            velocities[0, 0] = 2.0
            places = np.array([body.position for body in scene.bodies])
        else:
            self.starts.append(start)
            self.scenes.append(scene)
            places, velocities = start.positions, start.velocities
        length = FRAMES if start is None else FRAMES - start.frame
        times = np.arange(length)[:, None, None] * 0.01
        positions = (places + times * velocities).astype(np.float32)
        near = np.linalg.norm(positions[:, 0] - positions[:, 1], axis=1) < 0.5
        touched = np.flatnonzero(near).astype(np.int32)
        n = len(touched)
        return Trajectory(
            positions,
            np.tile(np.array([1, 0, 0, 0], np.float32), (length, count, 1)),
            np.tile(velocities.astype(np.float32), (length, 1, 1)),
            np.zeros((length, count, 3), np.float32),
            np.zeros((length, 0, 3), np.float32),
            np.full(length, np.nan, np.float32),
            replace(
                Contacts.empty(),
                frame=touched,
                bodies=np.tile(np.array([[0, 1]], np.int32), (n, 1)),
                point=np.zeros((n, 3), np.float32),
                normal=np.zeros((n, 3), np.float32),
                impulse=np.ones(n, np.float32),
            ),
            False,
            self.name,
        )


def model(**options: Any) -> NoisySimulation:
    return NoisySimulation(NoisySimulationSettings(**options), StraightEngine())


def context(trial: Scene, truth: Trajectory) -> Batch:
    """Return the trial as the model receives it."""
    frames = np.array([[44]], np.int64)
    return Batch((trial.name,), frames, np.ones((1, 1), np.bool_), state=(Motion(trial, truth),))


def observed(trial: Scene, engine: StraightEngine | None = None) -> ObservedTrial:
    """Return the observed part of a trial in which everything moves straight on."""
    return cut_trial(trial, (engine or StraightEngine()).simulate(trial))


def fraction(simulation: NoisySimulation, trial: Scene, truth: Trajectory) -> float:
    """Return the fraction of simulations with a contact, at the scale of the settings."""
    found = simulation.imagine(context(trial, truth), simulation.samples, simulation.seed)
    return float(found.contact.mean())


@pytest.mark.slow
def test_the_fraction_of_contacts_has_a_closed_form_for_straight_lines() -> None:
    """Ball and box touch if they pass each other closer than 0.5 m. With noise of their places
    only, the lateral distance d has the standard deviation 0.1 sqrt(2), and

        P(contact) = P(|d| < 0.5),

    with the trial's own answer where nothing is added."""
    counts = 400
    for offset in (0.0, 0.4, 0.5, 0.6, 3.0):
        trial = scene(offset)
        truth = StraightEngine().simulate(trial)
        assert fraction(model(scale=0.0), trial, truth) == (offset < 0.5)
        found = fraction(model(position=0.1, velocity=0.0, samples=counts), trial, truth)
        low, high = (NormalDist(offset, 0.1 * 2**0.5).cdf(edge) for edge in (-0.5, 0.5))
        expected = high - low
        # The sampled positions lie 2 cm apart, so that a path may pass between two of them.
        spread = 4 * (expected * (1 - expected) / counts) ** 0.5 + 0.01
        assert found == pytest.approx(expected, abs=spread)


def test_it_simulates_from_frame_44_with_the_noise_of_seed_and_scale_of_the_call() -> None:
    trial, engine = scene(0.5), StraightEngine()
    simulation = NoisySimulation(NoisySimulationSettings(samples=2), engine)
    batch = context(trial, engine.simulate(trial))
    for seed, scale in ((0, 1.0), (1, 1.0), (0, 9.0)):
        engine.starts.clear()
        simulation.imagine(batch, 2, seed, scale=scale)
        question = observed(trial)
        for sample, start in enumerate(engine.starts):
            _, expected = add_noise(question, simulation.settings, scale, sample, seed)
            assert start.frame == 44 and question.state.positions[0, 0] == pytest.approx(0.88)
            assert np.array_equal(start.velocities, expected.velocities)
            assert np.array_equal(start.positions, expected.positions)
        assert len(engine.starts) == 2
    ending = engine.scenes[0].ending
    assert (ending.min_frames, ending.max_frames) == (151 - 44, 302 - 44)


def test_contact_that_was_seen_needs_no_simulation() -> None:
    trial = replace(scene(), bodies=(*scene().bodies[:1], Body("box", "cube", (0.7, 0.0, 0.0))))
    engine = StraightEngine()
    truth = engine.simulate(trial)
    assert truth.contacts.frame[0] < 45
    # It flies out on the other side, so simulating on from frame 44 could find nothing.
    truth = replace(truth, velocities=truth.velocities * -1)
    assert fraction(NoisySimulation(NoisySimulationSettings(), engine), trial, truth) == 1.0
    assert engine.starts == []


def test_nothing_after_the_observed_part_can_change_the_answer() -> None:
    trial = scene(0.5)
    truth = StraightEngine().simulate(trial)
    rng = np.random.default_rng(0)
    changed = {}
    for name in ("positions", "velocities", "angular_velocities", "rotations"):
        array = getattr(truth, name).copy()
        array[45:] = rng.normal(size=array[45:].shape)
        changed[name] = array
    forged = replace(truth, **changed, contacts=Contacts.empty(), completed=True)
    names = (*changed, "cloth_vertices", "cloth_distance")
    shorter = replace(forged, **{name: getattr(forged, name)[:45] for name in names})
    expected = fraction(model(), trial, truth)
    assert 0 < expected < 1
    assert fraction(model(), trial, forged) == expected
    assert fraction(model(), trial, shorter) == expected


def test_noise_has_the_stated_size_and_spares_what_cannot_move() -> None:
    trial = scene()
    question = observed(trial)
    config = NoisySimulationSettings(position=0.1, velocity=0.3, mass=0.2)
    pairs = [add_noise(question, config, 2.0, sample, 0) for sample in range(400)]
    places = np.array([state.positions for _, state in pairs]) - question.state.positions
    speeds = np.array([state.velocities for _, state in pairs]) - question.state.velocities
    masses = np.log([[body.mass for body in noisy.bodies] for noisy, _ in pairs])
    assert places[:, :2, :2].std(0) == pytest.approx(np.full((2, 2), 0.2), rel=0.15)
    assert speeds[:, :2].std(0) == pytest.approx(np.full((2, 3), 0.6), rel=0.15)
    assert masses[:, :2].std(0) == pytest.approx(np.full(2, 0.4), rel=0.15)
    assert not places[:, :, 2].any() and not places[:, 2].any() and not speeds[:, 2].any()
    assert (masses[:, 2] == 0).all()
    first, second = places[:, 0, 0], places[:, 1, 0]
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.2


def test_joined_bodies_move_together_and_a_cloth_moves_whole() -> None:
    trial = scene(joints=(Joint("ball", "box"),), cloths=(Cloth("sheet", (0, 0, 2), resolution=3),))
    base = StraightEngine().simulate(replace(trial, cloths=()))
    truth = replace(base, cloth_vertices=np.zeros((FRAMES, 9, 3), np.float32))
    question = cut_trial(trial, truth)
    _, state = add_noise(question, NoisySimulationSettings(), 1.0, 0, 0)
    moved = state.positions - question.state.positions
    assert moved[0] == pytest.approx(moved[1]) and moved[0].any()
    cloth = state.cloth_vertices - question.state.cloth_vertices
    assert cloth == pytest.approx(np.tile(cloth[0], (9, 1))) and cloth[0, :2].any()
    assert not np.isclose(cloth[0, :2], moved[0, :2]).any()


def test_noise_of_the_pose_matches_bodies_in_the_air() -> None:
    trial = scene()
    question = observed(trial)
    config = NoisySimulationSettings(
        vertical=0.1, rotation=0.2, angular_velocity=0.5, friction=0.3, position=0.0
    )
    pairs = [add_noise(question, config, 2.0, sample, 0) for sample in range(400)]
    rise = np.array([state.positions[:, 2] for _, state in pairs]) - question.state.positions[:, 2]
    assert rise[:, 0].std() == pytest.approx(0.2, rel=0.15), "the ball flies"
    assert not rise[:, 1:].any(), "box and wall stand"
    turned = np.array([state.rotations for _, state in pairs])
    angles = 2 * np.arccos(np.clip(turned[..., 0], -1, 1))
    assert (angles[:, 0] ** 2).mean() == pytest.approx(3 * 0.4**2, rel=0.2), "about any axis"
    assert (angles[:, 1] ** 2).mean() == pytest.approx(0.4**2, rel=0.2), "about the vertical"
    assert turned[:, 0, 1:3].any() and not turned[:, 1, 1:3].any() and not angles[:, 2].any()
    spins = np.array([state.angular_velocities for _, state in pairs])
    assert spins[:, :2].std(0) == pytest.approx(np.full((2, 3), 1.0), rel=0.15)
    assert not spins[:, 2].any()
    grip = np.log([noisy.bodies[1].contact.static_friction / 0.5 for noisy, _ in pairs])
    assert grip.std() == pytest.approx(0.6, rel=0.15)
    assert np.linalg.norm(turned, axis=-1) == pytest.approx(np.ones((400, 3)))
    # A body that touches something is not lifted, and turns about the vertical only.
    resting = replace(question, touching=frozenset({0}))
    _, state = add_noise(resting, config, 1.0, 0, 0)
    assert (state.positions[:, 2] == question.state.positions[:, 2]).all()
    assert not state.rotations[0, 1:3].any() and state.rotations[0, 3] != 0
    # These levels have random numbers of their own.
    _, base = add_noise(question, replace(config, vertical=0.0, friction=0.0), 1.0, 3, 0)
    _, more = add_noise(question, config, 1.0, 3, 0)
    assert np.array_equal(base.velocities, more.velocities)
    assert np.array_equal(base.positions[:, :2], more.positions[:, :2])


class ScriptedEngine(StraightEngine):
    """Engine of straight motion with given contacts, by frame of the whole trial.

    The bodies of the pair lose their velocity in the frame of a contact.
    """

    def __init__(self, *contacts: tuple[int, int, int]) -> None:
        super().__init__()
        self.contacts = contacts

    def simulate(
        self,
        scene: Scene,
        *,
        start: State | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> Trajectory:
        path = super().simulate(scene, start=start)
        first = 0 if start is None else start.frame
        rows = [(frame - first, a, b) for frame, a, b in self.contacts if frame >= first]
        velocities = path.velocities.copy()
        for frame, *pair in rows:
            velocities[frame:, [body for body in pair if body >= 0]] = 0.0
        count = len(rows)
        contacts = replace(
            Contacts.empty(),
            frame=np.array([row[0] for row in rows], np.int32),
            bodies=np.array([row[1:] for row in rows], np.int32).reshape(count, 2),
            point=np.zeros((count, 3), np.float32),
            normal=np.zeros((count, 3), np.float32),
            impulse=np.ones(count, np.float32),
        )
        return replace(path, velocities=velocities, contacts=contacts)


def kicked(engine: ScriptedEngine, level: float = 0.2, samples: int = 300) -> list[State]:
    """Return the states from which bodies go on after a kick."""
    trial = scene(3.0)
    levels = NoiseLevels(position=0.0, velocity=0.0, mass=0.0, contact=level)
    simulate_contacts(observed(trial), levels, 2.0, samples, 0, engine)
    return engine.starts[samples:]


def test_bodies_are_kicked_at_a_new_contact_by_their_speed_before_it() -> None:
    """Ball and wall meet at frame 60 at 2 m/s; the noise is 0.2 x 2 of that, and none for walls."""
    starts = kicked(ScriptedEngine((60, 0, 2)))
    assert len(starts) == 300 and {start.frame for start in starts} == {60}
    kicks = np.array([start.velocities for start in starts])
    assert kicks[:, 0].std(0) == pytest.approx(np.full(3, 0.2 * 2 * 2.0), rel=0.15)
    assert abs(kicks[:, 0].mean(0)).max() < 0.2 and not kicks[:, 1:].any()
    assert [start.positions[0, 0] for start in starts[:2]] == pytest.approx([1.2, 1.2])
    both = np.array([s.velocities for s in kicked(ScriptedEngine((60, 0, 1), (70, 1, 2)))])
    assert not both.size, "after a contact of agent and patient nothing counts"


@pytest.mark.parametrize(
    ("contacts", "frames"),
    [
        ([(60, -1, 0)], []),  # the floor
        ([(44, 0, 2)], []),  # known already
        ([(119, 0, 2)], []),  # the last frame
        ([(60, -1, 0), (70, 0, 2)], [70]),
        ([(60, 0, 2), (70, 1, 2), (80, 0, 2)], [60, 70]),  # each pair once
    ],
)
def test_contacts_that_count_as_new(
    contacts: list[tuple[int, int, int]], frames: list[int]
) -> None:
    assert [start.frame for start in kicked(ScriptedEngine(*contacts), samples=1)] == frames


@pytest.mark.nightly
@pytest.mark.slow
def test_lapses_are_answers_at_random() -> None:
    trial = scene(0.0)
    question = observed(trial)
    found = {
        lapse: np.mean(
            simulate_contacts(
                question,
                NoisySimulationSettings(scale=0.0, lapse=lapse),
                0.0,
                1000,
                0,
                StraightEngine(),
            )
        )
        for lapse in (0.0, 0.4, 1.0)
    }
    assert found[0.0] == 1.0
    assert found[0.4] == pytest.approx(0.8, abs=0.04) and found[1.0] == pytest.approx(0.5, abs=0.05)


def test_noise_comes_from_the_platform_independent_functions() -> None:
    trial = scene()
    question = observed(trial)
    config = NoisySimulationSettings(position=0.1, velocity=0.3, mass=0.2)
    noisy, state = add_noise(question, config, 2.0, 7, config.seed)
    rng = child_generator(trial_seed(config.seed, trial.scenario, trial.name, 7), "noise")
    shift, kick = standard_normal(rng, (3, 2)), standard_normal(rng, (3, 3))
    mass = standard_normal(rng, 3)
    moved = question.state.positions[:2, :2] + shift[:2] * 0.1 * 2.0
    assert np.array_equal(state.positions[:2, :2], moved)
    assert np.array_equal(state.velocities[:2], question.state.velocities[:2] + kick[:2] * 0.3 * 2)
    factor = exp_of(float(mass[1]) * 0.2 * 2.0)
    assert noisy.bodies[1].mass == trial.bodies[1].mass * factor


@pytest.mark.parametrize(("mass", "friction"), [(0.25, 0.5), (4.0, 0.5), (1.0, 0.0), (1.0, 1.0)])
def test_mass_and_friction_are_inferred_from_what_was_observed(
    mass: float, friction: float
) -> None:
    surface = SurfaceMaterial(friction, friction)
    bodies = (
        Body("box", "cube", (0.0, 0.0, 0.0), (0.4, 0.4, 0.2), mass=mass, contact=surface),
        Body("ball", "sphere", (-0.4, 0.0, 0.0), (0.2, 0.2, 0.2)),
        Body("goal", "cube", (5.0, 0.0, 0.0)),
    )
    hit = Scene(
        "hit", "collide", bodies, Roles("box", "goal"), Camera((3.0, 0.0, 1.0)),
        pushes=(Push("ball", (3.0, 0.0, 0.0)),),
    )  # fmt: skip
    engine = make_engine()
    seen = Motion(hit, simulate(hit, frames=60))
    assert believed_scene(seen, "given", engine) is hit
    found = believed_scene(seen, "inferred", engine).bodies[0]
    assert found == bodies[0]
    default = replace(bodies[0], mass=1.0, contact=SurfaceMaterial(0.5, 0.5))
    assert believed_scene(seen, "default", engine).bodies == (default, *bodies[1:])
    # Without the hit there is nothing to infer from.
    untouched = replace(hit, pushes=())
    rest = Motion(untouched, simulate(untouched, frames=60))
    assert believed_scene(rest, "inferred", engine).bodies[0] == default


def test_the_digest_follows_all_that_decides_a_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    before = model().digest()
    same = model(samples=3, scales=(1.0, 9.0), seed=4)
    assert same.digest() == before, "what the harness passes to `imagine` is no part of it"
    properties = [model(properties=name).digest() for name in ("given", "default", "inferred")]
    assert properties[0] == before and len(set(properties)) == 3
    assert len({before, *(model(**{name: 0.7}).digest() for name in ("position", "mass"))}) == 3
    monkeypatch.setattr("physion.models.noisy_simulation.NOISE_VERSION", 1)
    assert model().digest() != before


@pytest.mark.parametrize(
    "wrong", [{"samples": 0}, {"position": -1.0}, {"scales": ()}, {"lapse": 1.5}, {"contact": -1.0}]
)
def test_impossible_settings_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(BadInputError):
        NoisySimulationSettings(**wrong)


def test_trials_that_are_short_or_have_no_motion_are_refused() -> None:
    whole = StraightEngine().simulate(scene())
    names = ("positions", "rotations", "velocities", "angular_velocities", "cloth_vertices")
    short = replace(whole, **{name: getattr(whole, name)[:44] for name in names})
    with pytest.raises(BadInputError, match="fewer than the 45"):
        cut_trial(scene(), short)
    unknown = replace(whole, positions=np.full_like(whole.positions, np.nan))
    with pytest.raises(BadInputError, match="imported without motion"):
        cut_trial(scene(), unknown)


def falling(offset: float) -> Scene:
    """Return a cube that falls for 0.65 s onto a low box, ``offset`` metres from its centre."""
    return Scene(
        f"falling {offset}",
        "drop",
        (
            Body("cube", "cube", (offset, 0.0, 2.3), (0.2, 0.2, 0.2)),
            Body("plate", "cube", (0.0, 0.0, 0.0), (1.6, 1.6, 0.2)),
        ),
        Roles("cube", "plate"),
        Camera((3.0, 0.0, 1.0)),
    )


def test_with_the_real_engine_hit_and_miss_differ() -> None:
    """The cube is still in the air after 0.45 s; noise of 5 cm/s does not change the outcome."""
    real = build_model("noisy-simulation", samples=8, velocity=0.05)
    answers = []
    for offset, hits in ((0.0, True), (3.0, False)):
        trial = falling(offset)
        truth = simulate(trial)
        frames = truth.contacts.frames_of(0, 1)
        assert bool(len(frames)) is hits and (not hits or frames[0] >= 45)
        assert isinstance(real, NoisySimulation)
        answers.append(fraction(real, trial, truth))
    assert answers == [1.0, 0.0]


@pytest.mark.parametrize("contact", [0.0, 0.1])
def test_a_body_that_appeared_before_the_simulation_touches(contact: float) -> None:
    late = replace(
        falling(0.0), events=(BodyEvent(40, falling(0.0).roles.agent, "appear"),), pushes=()
    )
    real = build_model(
        "noisy-simulation", samples=2, position=0.0, velocity=0.0, mass=0.0, contact=contact
    )
    assert isinstance(real, NoisySimulation)
    assert fraction(real, late, simulate(late)) == 1.0


def test_one_scale_that_is_given_is_the_scale_of_predictions() -> None:
    assert build_model("noisy-simulation", scale=3.0).arguments == {"scale": (3.0,)}
    assert build_model("noisy-simulation", scale=3.0, scales=[1, 2]).arguments["scale"] == (1, 2)


# Levels of noise that were fitted to outcomes and to people, and the models that use them.


def scene_of(half: int) -> Scene:
    """An official scene of Collide without contact in the observed part, of a half."""
    return next(
        trial.scene
        for trial in official().trials
        if trial.scene.scenario == "collide"
        and not trial.outcome.contact
        and configuration_half(trial.scene) == half
    )


def test_scenes_of_a_configuration_are_in_one_half_and_both_halves_are_used() -> None:
    halves: dict[object, set[int]] = {}
    for trial in official().trials:
        name = trial.scene.parameters["configuration"]
        halves.setdefault(name, set()).add(configuration_half(trial.scene))
    assert all(len(found) == 1 for found in halves.values())
    counts = [sum(found == {half} for found in halves.values()) for half in (0, 1)]
    assert min(counts) > len(halves) / 3


@pytest.mark.parametrize("half", [0, 1])
def test_levels_are_those_fitted_on_the_other_half(half: int) -> None:
    for target, levels in FITTED.items():
        assert fitted_levels(target, scene_of(half)) == levels[1 - half]
        simulation: Any = build_model(f"noisy-simulation-{target}")
        assert simulation.levels_for(scene_of(half)) == levels[1 - half]
        assert simulation.arguments == {"scale": (1.0,)}, "nothing is fitted to the trials at hand"


def test_the_table_of_predictions_says_what_the_noise_was_fitted_to() -> None:
    names = ("noisy-simulation", *(f"noisy-simulation-{name}" for name in FITTED))
    assert len({build_model(name).digest() for name in names}) == 3
    names = {build_model(f"noisy-simulation-{name}").provenance() for name in FITTED}
    assert {p.model for p in names} == {"noisy-simulation-outcomes", "noisy-simulation-people"}
    assert all(p.dynamics_training_task.startswith("noise fitted to") for p in names)
    assert build_model("noisy-simulation").provenance().dynamics_training_task == ""


def test_levels_are_fitted_or_given() -> None:
    with pytest.raises(BadInputError, match="is fitted: leave out velocity"):
        build_model("noisy-simulation-people", velocity=0.3)
    with pytest.raises(UnknownNameError, match="'noisy-simulation-persons'"):
        build_model("noisy-simulation-persons")


def test_levels_are_those_that_the_benchmark_printed() -> None:
    text = (ROOT / "benchmarks" / "results" / "noise.md").read_text()
    for target, fitted in FITTED.items():
        for half, levels in enumerate(fitted):
            cell = re.findall(rf"^\| {target} \| {half} \| ([^|]*) \|", text, re.MULTILINE)[-1]
            listed, _, lapse = cell.partition("; lapse ")
            values = dict(part.split() for part in listed.split(", "))
            known = {field.name: 0.0 for field in dataclasses.fields(NoiseLevels)}
            known |= {name: float(value) for name, value in values.items()}
            assert dataclasses.asdict(levels) == {**known, "lapse": float(lapse)}
