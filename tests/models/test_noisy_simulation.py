"""Noisy simulation: noise of the state, and levels that were fitted."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from physion.compute.local import LocalExecutor
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.seeds import child_generator, trial_seed
from physion.data.official import official
from physion.models import Batch, Motion, build_model
from physion.models.noisy_simulation import (
    FITTED,
    NoisySimulation,
    NoisySimulationSettings,
    configuration_half,
    cut_trial,
    fitted_levels,
)
from physion.models.state_noise import NoiseLevels, add_noise, simulate_contacts
from physion.numerics.elementary import exp_of, standard_normal
from physion.physics.engine import make_engine, simulate
from physion.physics.trajectory import Contacts, State, Trajectory
from physion.scenes.scene import Body, Camera, Cloth, Joint, Push, Roles, Scene
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


def fraction(simulation: NoisySimulation, trial: Scene, truth: Trajectory) -> float:
    """Return the fraction of simulations with a contact, at the scale of the config."""
    found = simulation.imagine(context(trial, truth), simulation.samples, simulation.seed)
    return float(found.contact.mean())


def test_without_noise_it_says_what_happens() -> None:
    for offset, expected in ((0.0, 1.0), (0.4, 1.0), (0.6, 0.0), (3.0, 0.0)):
        trial = scene(offset)
        truth = StraightEngine().simulate(trial)
        sure = model(scale=0.0)
        assert fraction(sure, trial, truth) == expected


def test_noise_makes_close_calls_uncertain_and_clear_ones_not() -> None:
    shares = {}
    for offset in (0.0, 0.5, 3.0):
        trial = scene(offset)
        truth = StraightEngine().simulate(trial)
        shares[offset] = fraction(model(samples=200), trial, truth)
    assert shares[0.0] == 1.0 and shares[3.0] == 0.0
    assert 0.2 < shares[0.5] < 0.8


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


def test_it_continues_from_the_last_observed_frame_under_the_trials_own_ending() -> None:
    trial = scene(0.5)
    engine = StraightEngine()
    truth = engine.simulate(trial)
    fraction(NoisySimulation(NoisySimulationSettings(samples=2), engine), trial, truth)
    assert [start.frame for start in engine.starts] == [44, 44]
    ending = engine.scenes[0].ending
    assert (ending.min_frames, ending.max_frames) == (151 - 44, 302 - 44)


def test_noise_has_the_stated_size_and_spares_what_cannot_move() -> None:
    trial = scene()
    question = cut_trial(trial, StraightEngine().simulate(trial))
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
    question = cut_trial(trial, StraightEngine().simulate(trial))
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


def test_bodies_that_touch_something_are_not_lifted() -> None:
    trial = scene()
    question = cut_trial(trial, StraightEngine().simulate(trial))
    resting = replace(question, touching=frozenset({0}))
    config = NoisySimulationSettings(vertical=0.1, rotation=0.2)
    _, state = add_noise(resting, config, 1.0, 0, 0)
    assert (state.positions[:, 2] == question.state.positions[:, 2]).all()
    assert not state.rotations[0, 1:3].any() and state.rotations[0, 3] != 0


def test_a_level_of_zero_leaves_the_random_numbers_of_the_others() -> None:
    trial = scene()
    question = cut_trial(trial, StraightEngine().simulate(trial))
    _, base = add_noise(question, NoisySimulationSettings(), 1.0, 3, 0)
    _, more = add_noise(question, NoisySimulationSettings(vertical=0.1, friction=0.2), 1.0, 3, 0)
    assert np.array_equal(base.velocities, more.velocities)
    assert np.array_equal(base.positions[:, :2], more.positions[:, :2])
    assert np.array_equal(base.rotations, question.state.rotations)


def test_lapses_are_answers_at_random() -> None:
    trial = scene(0.0)
    question = cut_trial(trial, StraightEngine().simulate(trial))
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


def relayed() -> Scene:
    """Return a scene in which a pushed ball hits another one, which then rolls into a box."""
    return Scene(
        "relayed",
        "collide",
        (
            Body("first", "sphere", (-6.5, 0.0, 0.0), (0.3, 0.3, 0.3)),
            Body("second", "sphere", (0.0, 0.0, 0.0), (0.3, 0.3, 0.3)),
            Body("box", "cube", (1.6, 0.0, 0.0), (0.3, 0.3, 0.3)),
        ),
        Roles("second", "box"),
        Camera((3.0, 0.0, 1.0)),
        pushes=(Push("first", (16.0, 0.0, 0.0)),),
    )


def test_noise_at_contacts_acts_where_bodies_meet() -> None:
    """Without a contact nothing changes; after one, the paths spread."""
    still = NoisySimulationSettings(position=0.0, velocity=0.0, mass=0.0)
    noisy = replace(still, contact=0.4)
    missed, hit = rolling(3.0), relayed()
    engine = make_engine("physion")
    for trial, changes in ((missed, False), (hit, True)):
        question = cut_trial(trial, simulate(trial))
        found = [simulate_contacts(question, c, 1.0, 24, 0, engine) for c in (still, noisy)]
        assert len(set(found[0])) == 1
        assert (found[0] != found[1]) is changes
    assert found[1] == simulate_contacts(question, noisy, 1.0, 24, 0, engine)


def test_noise_depends_only_on_seed_trial_and_sample() -> None:
    truth = StraightEngine().simulate(scene())

    def state(seed: int, name: str, sample: int) -> list[float]:
        question = cut_trial(scene(name=name), truth)
        _, noisy = add_noise(question, NoisySimulationSettings(), 1.0, sample, seed)
        return noisy.positions.ravel().tolist()

    assert state(0, "a", 0) == state(0, "a", 0)
    assert (
        len({tuple(state(*key)) for key in ((0, "a", 0), (1, "a", 0), (0, "b", 0), (0, "a", 1))})
        == 4
    )


def test_noise_matches_the_platform_independent_functions() -> None:
    trial = scene()
    question = cut_trial(trial, StraightEngine().simulate(trial))
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


def test_the_digest_follows_all_that_decides_a_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    before = model().digest()
    same = model(samples=3, scales=(1.0, 9.0), seed=4)
    assert same.digest() == before, "what the harness passes to `imagine` is no part of it"
    assert len({before, *(model(**{name: 0.7}).digest() for name in ("position", "mass"))}) == 3
    monkeypatch.setattr("physion.models.noisy_simulation.NOISE_VERSION", 1)
    assert model().digest() != before


def test_seed_and_scale_of_the_rollouts_match_the_call() -> None:
    trial = scene(0.5)
    truth = StraightEngine().simulate(trial)
    batch = context(trial, truth)

    def contacts(seed: int, **arguments: float) -> list[bool]:
        found: list[bool] = model().imagine(batch, 30, seed, **arguments).contact[0].tolist()
        return found

    assert contacts(0) == contacts(0) == contacts(0, scale=1.0)
    assert contacts(0) != contacts(1) and contacts(0) != contacts(0, scale=9.0)


@pytest.mark.parametrize(
    "wrong", [{"samples": 0}, {"position": -1.0}, {"scales": ()}, {"lapse": 1.5}, {"contact": -1.0}]
)
def test_impossible_settings_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(BadInputError):
        NoisySimulationSettings(**wrong)
    with pytest.raises(BadInputError, match="fewer than the 45"):
        cut_trial(scene(), replace_length(StraightEngine().simulate(scene()), 44))


def replace_length(trajectory: Trajectory, frames: int) -> Trajectory:
    names = ("positions", "rotations", "velocities", "angular_velocities", "cloth_vertices")
    return replace(trajectory, **{name: getattr(trajectory, name)[:frames] for name in names})


def rolling(offset: float) -> Scene:
    """Return a scene with a ball that is pushed towards a cube two metres away."""
    return Scene(
        f"rolling {offset}",
        "collide",
        (
            Body("ball", "sphere", (-1.0, offset, 0.0), (0.3, 0.3, 0.3)),
            Body("box", "cube", (1.0, 0.0, 0.0), (0.4, 0.4, 0.4)),
        ),
        Roles("ball", "box"),
        Camera((3.0, 0.0, 1.0)),
        pushes=(Push("ball", (4.0, 0.0, 0.0)),),
    )


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


@pytest.mark.slow
def test_other_processes_give_the_same_answers() -> None:
    real = build_model("noisy-simulation", samples=4)
    assert isinstance(real, NoisySimulation)
    batches = {}
    for offset in (0.25, 0.35):
        trial = rolling(offset)
        batches[trial.name] = context(trial, simulate(trial))
    imagine = partial(_imagine_four, real)
    outcomes = {o.key: o.value for o in LocalExecutor(2).map(imagine, batches)}
    assert outcomes == {key: imagine(batch) for key, batch in batches.items()}


def _imagine_four(simulation: NoisySimulation, batch: Batch) -> list[bool]:
    found: list[bool] = simulation.imagine(batch, 4, 0).contact[0].tolist()
    return found


def test_trials_without_motion_are_refused() -> None:
    motion = StraightEngine().simulate(scene())
    unknown = replace(
        motion, positions=np.full_like(motion.positions, np.nan), engine="imported: movie alone"
    )
    with pytest.raises(BadInputError, match="imported without motion"):
        cut_trial(scene(), unknown)


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


@pytest.mark.parametrize("half", [0, 1])
def test_the_model_simulates_with_these_levels(half: int) -> None:
    scene = scene_of(half)
    levels = dataclasses.asdict(FITTED["people"][1 - half])
    motion = Motion(scene, simulate(scene, frames=45))
    frames, valid = np.array([[44]]), np.ones((1, 1), np.bool_)
    batch = Batch((scene.name,), frames, valid, state=(motion,))
    fitted = build_model("noisy-simulation-people").imagine(batch, 20, 0)
    given = build_model("noisy-simulation", **levels).imagine(batch, 20, 0)
    assert np.array_equal(fitted.contact, given.contact)


def test_the_table_of_predictions_says_what_the_noise_was_fitted_to() -> None:
    names = {build_model(f"noisy-simulation-{name}").provenance() for name in FITTED}
    assert {p.model for p in names} == {"noisy-simulation-outcomes", "noisy-simulation-people"}
    assert all(p.dynamics_training_task.startswith("noise fitted to") for p in names)
    assert build_model("noisy-simulation").provenance().dynamics_training_task == ""


def test_fitted_levels_have_digests_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("noisy-simulation", *(f"noisy-simulation-{name}" for name in FITTED))
    digests = {build_model(name).digest() for name in names}
    assert len(digests) == 3
    other = {**FITTED, "people": (FITTED["people"][0], NoiseLevels(velocity=9.0))}
    monkeypatch.setattr("physion.models.noisy_simulation.FITTED", other)
    assert build_model("noisy-simulation-people").digest() not in digests


def test_nothing_is_fitted_to_the_trials_at_hand() -> None:
    assert build_model("noisy-simulation-people").arguments == {"scale": (1.0,)}
    assert build_model("noisy-simulation").arguments == {"scale": (0.5, 1.0, 2.0)}


def test_levels_are_fitted_or_given() -> None:
    with pytest.raises(BadInputError, match="is fitted: leave out velocity"):
        build_model("noisy-simulation-people", velocity=0.3)
    with pytest.raises(UnknownNameError, match="'noisy-simulation-persons'"):
        build_model("noisy-simulation-persons")


def test_a_scene_without_a_configuration_counts_by_its_name() -> None:
    scene = replace(scene_of(0), parameters={})
    halves = {configuration_half(replace(scene, name=f"scene {i}")) for i in range(20)}
    assert halves == {0, 1}


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
