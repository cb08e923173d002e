"""The rigid engine against mechanics that can be worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physion.core.errors import BadInputError, BadSceneError
from physion.core.seeds import trial_seed
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.physics.rigid.bodies import RigidSettings
from physion.physics.rigid.engine import RigidEngine
from physion.physics.rigid.step import RigidRun
from physion.physics.trajectory import ENVIRONMENT
from physion.scenes.sampling.sample import sample_scene
from physion.scenes.scene import Body, Ending, Joint, Push, SurfaceMaterial
from support.rigid_scenes import DT, ICE, ROUGH, ZONE, G, run, scene_of, way_of_steps


def test_free_fall_is_a_parabola_of_whole_steps() -> None:
    path = run(scene_of(Body("a", "cube", (0, 0, 5.0))), frames=41)
    # Frame 0 follows the first step.
    for frame in (0, 40):
        fallen = way_of_steps(G, frame + 1)
        assert path.positions[frame, 0, 2] == pytest.approx(5 - fallen, abs=1e-5)
        assert path.velocities[frame, 0, 2] == pytest.approx(-G * DT * (frame + 1), rel=1e-5)
    assert len(path.contacts.frames_of(ENVIRONMENT, 0)) == 0


def test_ball_rolls_on() -> None:
    # A push 0.4 radii above the centre makes a ball roll at once: no slip to rub away. The hull's
    # facets cost a little speed; a sliding ball would have lost 2.4 m/s.
    radius, speed = 0.5, 1.5
    ball = Body("a", "sphere", (0, 0, 0), contact=ROUGH, angular_drag=0.0)
    push = Push("a", (speed, 0, 0), (0, 0, radius * 1.4))
    path = run(scene_of(ball, pushes=(push,)), frames=50)
    final = float(path.velocities[-1, 0, 0])
    assert 0.8 * speed < final < 1.02 * speed
    assert path.angular_velocities[-1, 0, 1] == pytest.approx(final / radius, rel=0.05)


@pytest.mark.parametrize("bounce", [0.0, 0.5, 0.9])
def test_bounce_returns_the_coefficient_of_the_speed(bounce: float) -> None:
    block = Body(
        "a", "cube", (0, 0, 1.0), (0.3, 0.3, 0.3), contact=SurfaceMaterial(0.5, 0.5, bounce)
    )
    path = run(scene_of(block), frames=100, floor=SurfaceMaterial(0.5, 0.5, bounce))
    height = path.positions[:, 0, 2]
    ground = int(np.argmin(height))
    assert height[ground:].max() == pytest.approx(bounce**2, abs=0.06)


def test_impulse_at_a_point_turns_and_moves_and_spin_is_capped() -> None:
    block = Body("a", "cube", (0, 0, 5.0), mass=2.0, angular_drag=0.0)
    push = Push("a", (0.6, 0, 0), (0, 0, 5.9), frame=3)
    path = run(scene_of(block, pushes=(push,)), frames=6)
    assert np.abs(path.velocities[2, 0, 0]) < 1e-9
    assert path.velocities[3, 0, 0] == pytest.approx(0.3, rel=1e-5)
    drop = 5.5 - path.positions[2, 0, 2] - 0.5
    inertia = 2.0 / 6.0
    assert path.angular_velocities[3, 0, 1] == pytest.approx(0.6 * (0.4 + drop) / inertia, rel=1e-3)
    hard = replace(push, impulse=(60.0, 0.0, 0.0))
    capped = run(scene_of(block, pushes=(hard,)), frames=6)
    assert np.linalg.norm(capped.angular_velocities[3, 0]) == pytest.approx(7.0, rel=1e-5)
    # The cap is about the centre of mass and leaves the velocity alone.
    assert capped.velocities[3, 0, 0] == pytest.approx(30.0, rel=1e-5)


def test_drag_takes_its_share() -> None:
    block = Body("a", "cube", (0, 0, 5.0), drag=1.0, angular_drag=2.0)
    path = run(scene_of(block, pushes=(Push("a", (1.0, 0, 0), (0, 0, 6.0)),)), frames=11)
    assert path.velocities[10, 0, 0] == pytest.approx(0.99**11, rel=1e-5)
    spin = path.angular_velocities[:, 0, 1]
    assert spin[10] / spin[5] == pytest.approx(0.98**5, rel=1e-4)


def test_joined_bodies_move_as_one_and_keep_their_materials() -> None:
    base = Body("base", "cube", (0, 0, 0), (0.4, 0.4, 0.2), mass=3.0, contact=ROUGH)
    pole = Body(
        "pole", "cylinder", (0, 0, 0.2), (0.1, 0.1, 0.6), mass=1.0, contact=SurfaceMaterial(0, 0, 0)
    )
    held = scene_of(
        base,
        pole,
        pushes=(Push("pole", (3.0, 0, 0), (0, 0, 0.7)),),
        joints=(Joint("base", "pole"),),
    )
    path = run(held, frames=80)
    gap = np.linalg.norm(path.positions[:, 0] - path.positions[:, 1], axis=1)
    assert np.abs(gap - 0.2).max() < 1e-5
    assert np.allclose(path.rotations[:, 0], path.rotations[:, 1], atol=1e-6)
    run_ = RigidRun(held, RigidSettings())
    assert run_.model.actors.count == 1
    assert run_.model.inv_mass[0] == pytest.approx(1 / 4.0)
    assert run_.model.material[0].tolist() == [0.5, 0.5, 0.0]
    assert run_.model.material[1].tolist() == [0.0, 0.0, 0.0]
    loose = run(replace(held, joints=()), frames=80)
    assert (
        np.abs(np.linalg.norm(loose.positions[:, 0] - loose.positions[:, 1], axis=1) - 0.2).max()
        > 0.05
    )


def test_a_joint_to_something_fixed_is_refused() -> None:
    scene = scene_of(Body("a", "cube", (0, 0, 0)), joints=(Joint("zone", "a"),))
    with pytest.raises(BadSceneError, match="make both kinematic or neither"):
        RigidEngine().simulate(scene)


def test_kinematic_bodies_stay_and_are_touched() -> None:
    board = Body("board", "cube", (0, 0, 0), (1, 1, 0.1), kinematic=True)
    block = Body("a", "cube", (0, 0, 0.3), (0.2, 0.2, 0.2))
    path = run(scene_of(block, board), frames=60)
    assert np.abs(path.positions[:, 1]).max() == 0.0
    assert path.positions[-1, 0, 2] == pytest.approx(0.1, abs=2e-3)
    first = path.contacts.frames_of(0, 1)[0]
    assert first == pytest.approx(math.sqrt(2 * 0.2 / G) / 0.01, abs=2)
    row = int(np.flatnonzero((path.contacts.bodies == [0, 1]).all(axis=1))[0])
    assert path.contacts.normal[row].tolist() == pytest.approx([0, 0, -1], abs=1e-4)
    assert path.contacts.point[row, 2] == pytest.approx(0.1, abs=0.03)
    assert path.contacts.impulse.min() >= 0


def test_contact_impulse_is_the_momentum_that_was_lost() -> None:
    block = Body("a", "cube", (0, 0, 0.5), (0.3, 0.3, 0.3), mass=2.0)
    path = run(scene_of(block), frames=120)
    on_floor = (path.contacts.bodies == [ENVIRONMENT, 0]).all(axis=1)
    until = int(path.contacts.frame.max())
    total = float(path.contacts.impulse[on_floor].sum())
    assert total == pytest.approx(2.0 * G * 0.01 * until, rel=0.02)


def test_scenery_touches_nothing() -> None:
    block = Body("a", "cube", (0, 0, 0.5), (0.2, 0.2, 0.2))
    path = run(scene_of(block, Body("tree", "cube", (0, 0, 0), scenery=True)), frames=60)
    assert path.positions[-1, 0, 2] == pytest.approx(0.0, abs=2e-3)


def test_a_trial_ends_when_all_sleep_but_not_before_its_least_frames() -> None:
    block = Body("a", "cube", (0, 0, 0), (0.2, 0.2, 0.2))
    scene = replace(scene_of(block), ending=Ending(80, 200))
    resting = RigidEngine().simulate(scene)
    assert (len(resting), resting.completed) == (80, True)
    falling = replace(scene, bodies=(replace(block, position=(0, 0, 50.0)), ZONE))
    path = RigidEngine().simulate(falling)
    assert (len(path), path.completed) == (200, False)
    late = replace(scene, pushes=(Push("a", (1.0, 0, 0), frame=79),))
    assert RigidEngine().simulate(late, frames=100).positions[-1, 0, 0] > 0.02


def test_a_sleeping_body_is_hit_with_its_whole_mass() -> None:
    still = Body("a", "cube", (0, 0, 0), (0.2, 0.2, 0.2), contact=ICE, drag=0)
    hammer = Body("b", "cube", (-1.5, 0, 0), (0.2, 0.2, 0.2), contact=ICE, drag=0)
    push = Push("b", (2.0, 0, 0), frame=60)
    path = run(scene_of(still, hammer, pushes=(push,)), frames=160, floor=ICE)
    assert path.velocities[60, 0].max() == 0.0
    assert path.velocities[-1, 0, 0] == pytest.approx(1.0, rel=0.03)
    assert path.velocities[-1, 1, 0] == pytest.approx(1.0, rel=0.03)


@settings(max_examples=15, deadline=None)
@given(
    speed=st.floats(0.5, 6.0),
    mass=st.floats(0.2, 5.0),
    offset=st.floats(-0.15, 0.15),
    bounce=st.floats(0.0, 1.0),
)
def test_momentum_is_conserved_and_energy_never_grows(
    speed: float, mass: float, offset: float, bounce: float
) -> None:
    material = SurfaceMaterial(0.4, 0.3, bounce)
    a = Body("a", "cube", (0, 0, 9), (0.3, 0.3, 0.3), contact=material, angular_drag=0)
    b = Body("b", "cylinder", (-0.6, offset, 9), (0.3, 0.3, 0.3), mass=mass, contact=material)
    b = replace(b, angular_drag=0)
    path = run(scene_of(a, b, pushes=(Push("b", (speed * mass, 0, 0)),)), frames=60, gravity=0.0)
    assert len(path.contacts.frames_of(0, 1)) > 0 or speed * 0.59 < 0.3
    momentum = path.velocities[:, 0] + mass * path.velocities[:, 1]
    assert np.abs(momentum[1:] - [speed * mass, 0, 0]).max() < 1e-3 * speed * max(mass, 1)
    linear = (path.velocities[:, 0] ** 2).sum(1) + mass * (path.velocities[:, 1] ** 2).sum(1)
    assert linear[1:].max() <= speed**2 * mass * 1.02


def test_settings_change_the_name_and_frames_must_be_positive() -> None:
    assert RigidEngine().name != RigidEngine(RigidSettings(gravity=1.0)).name
    with pytest.raises(BadInputError, match="at least 1"):
        RigidEngine().simulate(scene_of(Body("a", "cube", (0, 0, 0))), frames=0)


def test_higher_floor_carries_bodies() -> None:
    scene = replace(scene_of(Body("a", "cube", (0, 0, 0.5), (0.2, 0.2, 0.2))), floor=0.25)
    path = run(scene, frames=60)
    assert path.positions[-1, 0, 2] == pytest.approx(0.25, abs=2e-3)


def test_stopping_at_contact_gives_the_same_label_and_the_same_start() -> None:
    outcomes = set()
    for index in range(6):
        scene = sample_scene("collide", trial_seed("until", "collide", "x", index))
        whole, cut = simulate(scene), simulate(scene, until_contact=True)
        label = label_contact(scene, whole)
        outcomes.add(label.contact)
        assert label_contact(scene, cut) == label
        assert np.array_equal(cut.positions, whole.positions[: len(cut)])
        assert len(cut) == (label.first_frame + 1 if label.first_frame is not None else len(whole))
    assert outcomes == {True, False}
