"""The rigid engine against mechanics that can be worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physion.numerics.rotations import axis_angle_quaternion, rotate_vectors
from physion.physics.labels import label_contact
from physion.physics.rigid.bodies import RigidSettings
from physion.physics.rigid.engine import RigidEngine
from physion.physics.rigid.step import RigidRun
from physion.physics.trajectory import ENVIRONMENT, Trajectory
from physion.scenes.scene import Body, BodyEvent, Joint, Push, Roles, Scene, SurfaceMaterial
from support.rigid_scenes import DT, ICE, ROUGH, ZONE, G, run, scene_of, way_of_steps


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


def test_joined_bodies_are_one_actor_and_keep_their_materials() -> None:
    base = Body("base", "cube", (0, 0, 0), (0.4, 0.4, 0.2), mass=3.0, contact=ROUGH)
    ice = SurfaceMaterial(0, 0, 0)
    pole = Body("pole", "cylinder", (0, 0, 0.2), (0.1, 0.1, 0.6), mass=1.0, contact=ice)
    model = RigidRun(scene_of(base, pole, joints=(Joint("base", "pole"),)), RigidSettings()).model
    assert model.actors.count == 1 and model.inv_mass[0] == pytest.approx(1 / 4.0)
    assert model.material[:2].tolist() == [[0.5, 0.5, 0.0], [0.0, 0.0, 0.0]]


def test_contact_impulse_is_the_momentum_that_was_lost() -> None:
    block = Body("a", "cube", (0, 0, 0.5), (0.3, 0.3, 0.3), mass=2.0)
    path = run(scene_of(block), frames=120)
    on_floor = (path.contacts.bodies == [ENVIRONMENT, 0]).all(axis=1)
    until = int(path.contacts.frame.max())
    total = float(path.contacts.impulse[on_floor].sum())
    assert total == pytest.approx(2.0 * G * 0.01 * until, rel=0.02)


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


def test_higher_floor_carries_bodies() -> None:
    scene = replace(scene_of(Body("a", "cube", (0, 0, 0.5), (0.2, 0.2, 0.2))), floor=0.25)
    path = run(scene, frames=60)
    assert path.positions[-1, 0, 2] == pytest.approx(0.25, abs=2e-3)


DOUBLING = pytest.mark.parametrize(("doubling", "factor"), [(True, 2.0), (False, 1.0)])
"""With doubling, both anchors of a face bear the whole limit: twice Coulomb's friction."""


def on_slope(slope: float, friction: SurfaceMaterial) -> Scene:
    """A flat box on a fixed board that falls by ``slope`` metres for each metre along x."""
    angle = math.atan(slope)
    c, s = math.cos(angle / 2), math.sin(angle / 2)
    up = np.array([math.sin(angle), 0, math.cos(angle)])
    board = Body(
        "board", "cube", (0, 0, 4.0), (12, 1, 0.1), (c, 0, s, 0), contact=friction, kinematic=True
    )
    foot = tuple((np.array([0, 0, 4.0]) + 0.1 * up).tolist())
    box = Body("a", "cube", foot, (0.4, 0.4, 0.1), (c, 0, s, 0), contact=friction)
    return scene_of(box, board)


def way(path: Trajectory, first: int, last: int) -> float:
    """Metres that the box went between two frames."""
    return float(np.linalg.norm(path.positions[last, 0] - path.positions[first, 0]))


@DOUBLING
@pytest.mark.parametrize("slope", [0.2, 0.6])
def test_a_box_rests_just_below_the_friction_angle_and_slides_just_above(
    slope: float, doubling: bool, factor: float
) -> None:
    """The angle's tangent is the coefficient: 3 % more friction holds, 5 % less does not."""
    results = {}
    for part in (1.03, 0.95):
        friction = SurfaceMaterial(part * slope / factor, part * slope / factor, 0.0)
        path = run(on_slope(slope, friction), frames=100, friction_doubling=doubling)
        results[part] = way(path, 50, 99)
    assert results[1.03] < 1e-5
    # Between frames 50 and 99 it goes a (t1² - t0²) / 2 with a = g cos (slope - coefficient).
    acceleration = G * math.cos(math.atan(slope)) * 0.05 * slope
    expected = way_of_steps(acceleration, 100) - way_of_steps(acceleration, 51)
    assert results[0.95] == pytest.approx(expected, rel=0.3)


@DOUBLING
def test_a_sliding_box_speeds_up_by_what_friction_leaves(doubling: bool, factor: float) -> None:
    slope, friction = 0.6, SurfaceMaterial(0.3 / factor, 0.3 / factor, 0.0)
    path = run(on_slope(slope, friction), frames=60, friction_doubling=doubling)
    gained = np.linalg.norm(path.velocities[59, 0]) - np.linalg.norm(path.velocities[19, 0])
    angle = math.atan(slope)
    expected = G * (math.sin(angle) - 0.3 * math.cos(angle)) * DT * 40
    assert gained == pytest.approx(expected, rel=0.02)


def test_static_friction_holds_where_dynamic_friction_would_not() -> None:
    # Friction in all sweeps: with few, the impulses of the four corners are still uneven, and a
    # box close to its limit may slip once.
    settings = {"friction_doubling": False, "friction_sweeps": 0}
    held = run(on_slope(0.6, SurfaceMaterial(0.7, 0.1, 0)), frames=60, **settings)
    assert way(held, 0, 59) < 1e-5
    slid = run(on_slope(0.6, SurfaceMaterial(0.5, 0.1, 0)), frames=60, **settings)
    angle = math.atan(0.6)
    acceleration = G * (math.sin(angle) - 0.1 * math.cos(angle))
    expected = way_of_steps(acceleration, 60) - way_of_steps(acceleration, 1)
    assert way(slid, 0, 59) == pytest.approx(expected, rel=0.02)


@DOUBLING
def test_a_sliding_box_stops_where_coulomb_says(doubling: bool, factor: float) -> None:
    box = Body("a", "cube", (0, 0, 0), (0.4, 0.4, 0.1), mass=2.0, contact=ROUGH)
    path = run(
        scene_of(box, pushes=(Push("a", (4.0, 0, 0)),)),
        frames=120,
        friction_doubling=doubling,
        floor=ROUGH,
    )
    # One step of motion, 2 cm, lies between the two sums that bracket v²/(2 mu g).
    assert path.positions[-1, 0, 0] == pytest.approx(2.0**2 / (2 * 0.5 * factor * G), abs=0.02)
    assert np.abs(path.velocities[-1, 0]).max() < 1e-3


def test_friction_is_the_mean_of_both_materials() -> None:
    """0.2 and 0.6 make 0.4: the box loses 0.4 g of its speed in every second."""
    box = Body("a", "cube", (0, 0, 0), (0.4, 0.4, 0.1), contact=SurfaceMaterial(0.2, 0.2, 0.0))
    floor = SurfaceMaterial(0.6, 0.6, 0.0)
    scene = scene_of(box, pushes=(Push("a", (3.0, 0, 0)),))
    path = run(scene, frames=50, friction_doubling=False, floor=floor)
    lost = path.velocities[9, 0, 0] - path.velocities[49, 0, 0]
    assert lost == pytest.approx(0.4 * G * 0.4, rel=0.02)


SIDE = 0.4


def stack(count: int, gap: float, aside: float, material: SurfaceMaterial) -> list[Body]:
    """Cubes over each other, ``gap`` metres apart and up to ``aside`` metres off the axis."""
    rng = np.random.default_rng(count)
    return [
        Body(
            f"cube {k}",
            "cube",
            (*rng.uniform(-aside, aside, 2).tolist(), gap + (SIDE + gap) * k),
            (SIDE,) * 3,
            mass=float(rng.uniform(0.5, 2.0)),
            contact=material,
            angular_drag=0.0,
        )
        for k in range(count)
    ]


def energy(path: Trajectory, cubes: list[Body]) -> np.ndarray:
    """Kinetic and potential energy (F,) in joules of all cubes together."""
    count, mass = len(cubes), np.array([cube.mass for cube in cubes])
    rotations = path.rotations[:, :count].astype(float)
    middle = path.positions[:, :count] + rotate_vectors(rotations, np.array([0, 0, SIDE / 2]))
    speed = (path.velocities[:, :count].astype(float) ** 2).sum(2)
    spin = (path.angular_velocities[:, :count].astype(float) ** 2).sum(2)
    moment = mass * SIDE**2 / 6
    return np.asarray((mass * (speed / 2 + G * middle[..., 2]) + moment * spin / 2).sum(1))


@pytest.mark.parametrize(
    ("count", "gap", "aside"), [(6, 0.0, 0.05), (4, 0.005, 0.05), (4, 0.02, 0.0)]
)
def test_energy_never_rises_in_a_frictionless_inelastic_stack(
    count: int, gap: float, aside: float
) -> None:
    cubes = stack(count, gap, aside, ICE)
    path = run(scene_of(*cubes), frames=200, floor=ICE)
    total = energy(path, cubes)
    # Overlaps that the sweeps leave are pushed out later, which lifts bodies without a speed. They
    # are small: what rises is less than the work of lifting the whole stack by 0.2 mm. (Without
    # the sweep that takes the speed of the correction away, it would be 30 mm.)
    weight = G * sum(cube.mass for cube in cubes)
    assert (total - np.minimum.accumulate(total)).max() < 2e-4 * weight
    # The stack stands, and has lost what it fell: cube k by k + 1 gaps.
    lost = G * gap * sum(cube.mass * (k + 1) for k, cube in enumerate(cubes))
    assert total[0] - total[-1] == pytest.approx(lost, abs=1e-3 * weight)


def test_a_tower_of_ten_boxes_stands_for_five_seconds() -> None:
    boxes = stack(10, 0.0, 0.01, SurfaceMaterial(0.6, 0.6, 0.0))
    path = run(scene_of(*boxes), frames=500)
    start = np.array([box.position for box in boxes])
    moved = np.abs(path.positions[:, :10] - start).max(axis=(0, 1))
    assert (moved < SIDE / 20).all()
    assert not path.velocities[-1].any()


def test_a_slender_tower_stands_too() -> None:
    boxes = [
        Body(str(k), "cube", (0, 0, 0.3 * k), (0.1, 0.1, 0.3), contact=ROUGH) for k in range(4)
    ]
    path = run(scene_of(*boxes), frames=300)
    assert np.abs(path.positions[-1, :4, :2]).max() < 5e-3
    assert path.positions[-1, 3, 2] == pytest.approx(0.9, abs=5e-3)


def test_a_box_over_the_edge_falls_and_one_within_it_does_not() -> None:
    """Its centre of mass is 4 cm inside the edge of the box below, or outside."""
    for inside, falls in ((0.04, False), (-0.04, True)):
        base = Body("base", "cube", (0, 0, 0), (SIDE,) * 3, mass=50.0, contact=ROUGH)
        top = Body("top", "cube", (SIDE / 2 - inside, 0, SIDE), (SIDE,) * 3, contact=ROUGH)
        path = run(scene_of(top, base), frames=200)
        assert (path.positions[-1, 0, 2] < SIDE - 0.1) == falls


@pytest.mark.parametrize(("speed", "bounces"), [(1.9, False), (2.1, True)])
def test_bodies_bounce_above_two_metres_a_second(speed: float, bounces: bool) -> None:
    rubber = SurfaceMaterial(0.0, 0.0, 0.6)
    box = Body("a", "cube", (0, 0, 5.0), (0.3,) * 3, contact=rubber)
    wall = Body("wall", "cube", (1.0, 0, 4.0), (0.3, 2, 2), contact=rubber, kinematic=True)
    push = Push("a", (speed, 0, 0))
    path = run(scene_of(box, wall, pushes=(push,)), frames=60)
    assert path.velocities[20, 0, 0] == pytest.approx(speed)
    assert path.velocities[-1, 0, 0] == pytest.approx(-0.6 * speed if bounces else 0.0, abs=1e-4)


def test_restitution_is_the_mean_of_both_materials() -> None:
    box = Body("a", "cube", (0, 0, 5.0), (0.3,) * 3, contact=SurfaceMaterial(0, 0, 1.0))
    wall = Body("wall", "cube", (1.0, 0, 4.0), (0.3, 2, 2), contact=ICE, kinematic=True)
    path = run(scene_of(box, wall, pushes=(Push("a", (4.0, 0, 0)),)), frames=40)
    assert path.velocities[-1, 0, 0] == pytest.approx(-2.0, abs=1e-4)


def test_joined_bodies_turn_about_their_common_centre() -> None:
    """Two cubes of 1 m, 3 kg and 1 kg, whose centres are 1 m apart; pushed at the upper one.

    The common centre is 0.25 m above that of the lower. About it,
    I = (3 + 1) / 6 + 3 * 0.25² + 1 * 0.75² = 0.66667 + 0.75 = 1.41667 kg m² for axes across.
    """
    lower = Body("a", "cube", (0, 0, 5.0), mass=3.0, angular_drag=0.0)
    upper = Body("b", "cube", (0, 0, 6.0), mass=1.0, angular_drag=0.0)
    push = Push("b", (0.5, 0, 0), (0, 0, 6.5))
    scene = scene_of(lower, upper, pushes=(push,), joints=(Joint("a", "b"),))
    path = run(scene, frames=30)
    spin = 0.5 * 0.75 / (4 / 6 + 3 * 0.25**2 + 0.75**2)
    assert (
        path.angular_velocities[0, :2].tolist()
        == [pytest.approx([0, spin, 0], rel=1e-5, abs=1e-9)] * 2
    )
    # v = J / m + w x r, with r from the common centre to that of each cube.
    first = path.velocities[0]
    assert first[0, 0] == pytest.approx(0.5 / 4 - spin * 0.25, rel=1e-4)
    assert first[1, 0] == pytest.approx(0.5 / 4 + spin * 0.75, rel=1e-4)
    # The centre moves on evenly, and the pair has turned by w t about y.
    assert path.rotations[-1, 0, 2] == pytest.approx(math.sin(spin * 30 * DT / 2), rel=1e-4)
    middles = path.positions[:, :2] + rotate_vectors(
        path.rotations[:, :2].astype(float), np.array([0, 0, 0.5])
    )
    common = (3 * middles[:, 0] + middles[:, 1]) / 4
    assert common[-1, 0] == pytest.approx(0.125 * 30 * DT, rel=1e-4)


def test_a_pair_pushed_across_its_long_axis_turns_about_the_upright() -> None:
    """I about z of two cubes beside each other: 2 (1 / 6 + 0.5²) kg m²."""
    left, right = (Body(n, "cube", (x, 0, 5.0), angular_drag=0.0) for n, x in (("a", 0), ("b", 1)))
    push = Push("b", (0, 0.4, 0), (1.0, 0, 5.5))
    path = run(scene_of(left, right, pushes=(push,), joints=(Joint("a", "b"),)), frames=2)
    expected = 0.4 * 0.5 / (2 * (1 / 6 + 0.25))
    assert path.angular_velocities[0, 1].tolist() == pytest.approx([0, 0, expected], abs=1e-6)


CUBE = (0.4, 0.4, 0.4)


def test_a_body_appears_at_the_pose_of_the_event() -> None:
    q = tuple(axis_angle_quaternion([0, 0, 1], 0.5).tolist())
    event = BodyEvent(10, "a", "appear", (1.0, 2.0, 4.0), q)
    path = run(scene_of(Body("a", "cube", (0, 0, 3.0), CUBE), events=(event,)), frames=20)
    assert path.positions[9, 0].tolist() == [0, 0, 3.0]
    assert path.positions[10, 0].tolist() == pytest.approx([1, 2, 4 - way_of_steps(G, 1)])
    assert path.rotations[10:, 0].tolist() == [pytest.approx(q, abs=1e-6)] * 10


def test_events_come_before_the_pushes_of_their_frame() -> None:
    scene = scene_of(
        Body("a", "cube", (0, 0, 3.0), CUBE),
        pushes=(Push("a", (1.0, 0, 0), None, 5),),
        events=(BodyEvent(5, "a", "appear"),),
    )
    path = run(scene, frames=10)
    assert path.velocities[5, 0, 0] == pytest.approx(1.0)


def test_joints_hold_between_those_that_are_there() -> None:
    low = Body("a", "cube", (0, 0, 3.0), CUBE, angular_drag=0.0)
    top = Body("b", "cube", (0, 0, 3.4), CUBE, angular_drag=0.0)
    scene = scene_of(
        low,
        top,
        pushes=(Push("a", (0.3, 0, 0), (0, 0, 3.2), 5), Push("a", (1.0, 0, 0), None, 15)),
        joints=(Joint("a", "b"),),
        events=(BodyEvent(15, "b", "vanish"),),
    )
    path = run(scene, frames=30)
    gap = np.linalg.norm(path.positions[:15, 0] - path.positions[:15, 1], axis=1)
    assert np.abs(gap - 0.4).max() < 1e-6
    assert path.angular_velocities[14, 0, 1] != 0.0
    # Alone, 1 kg is pushed, not 2.
    gained = path.velocities[15, 0, 0] - path.velocities[14, 0, 0]
    assert gained == pytest.approx(1.0, rel=1e-4)


def test_an_event_far_away_disturbs_nothing() -> None:
    tower = [Body(f"{k}", "cube", (0, 0, 0.4 * k), CUBE, contact=ROUGH) for k in range(4)]
    far = Body("far", "cube", (7.0, 0, 0), CUBE)
    scene = scene_of(*tower, far)
    quiet = run(scene, frames=120)
    path = run(replace(scene, events=(BodyEvent(60, "far", "vanish"),)), frames=120)
    assert np.array_equal(path.positions[:60], quiet.positions[:60])
    assert np.abs(path.positions - quiet.positions).max() < 1e-3


def test_labels_count_only_contacts_while_both_are_there() -> None:
    """The agent lands on the patient, which vanishes before, or appears after that."""
    patient = replace(ZONE, position=(0.0, 0.0, 0.0))
    falling = replace(scene_of(Body("a", "cube", (0, 0, 0.2), CUBE)), roles=Roles("a", "zone"))
    falling = replace(falling, bodies=(falling.bodies[0], patient))
    met = label_contact(falling, run(falling, frames=60)).first_frame
    # 0.19 m take sqrt(2 h / g) = 0.197 s.
    assert met in (18, 19, 20)
    gone = replace(falling, events=(BodyEvent(10, "zone", "vanish"),))
    assert not label_contact(gone, run(gone, frames=60)).contact
    late = replace(falling, events=(BodyEvent(40, "zone", "appear", (0, 0, -0.005)),))
    assert label_contact(late, run(late, frames=60)).first_frame == 40
    engine = RigidEngine()
    cut = engine.simulate(late, frames=60, until_contact=True)
    assert len(cut) == 41
    assert label_contact(late, cut) == label_contact(late, engine.simulate(late, frames=60))


@pytest.mark.parametrize("frame", [5, 40, 70])
def test_going_on_from_a_sliding_box_stays_close(frame: int) -> None:
    box = Body("a", "cube", (0, 0, 0), (0.4, 0.4, 0.1), contact=ROUGH)
    scene = scene_of(box, pushes=(Push("a", (4.0, 0, 0)),))
    whole = run(scene, frames=100)
    rest = RigidEngine().simulate(scene, start=whole.state(frame), frames=100 - frame)
    assert np.abs(rest.positions - whole.positions[frame:]).max() < 2e-3
