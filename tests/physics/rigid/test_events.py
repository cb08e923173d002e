"""Bodies that appear, vanish and move, and simulations that go on from a state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from physion.numerics.rotations import axis_angle_quaternion
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.physics.rigid.engine import RigidEngine
from physion.scenes.scene import Body, BodyEvent, Joint, Push, Roles
from support.rigid_scenes import DT, ROUGH, ZONE, G, run, scene_of, way_of_steps

CUBE = (0.4, 0.4, 0.4)


def test_a_body_rests_at_its_pose_until_it_appears_and_then_falls() -> None:
    scene = scene_of(Body("a", "cube", (0, 0, 3.0), CUBE), events=(BodyEvent(20, "a", "appear"),))
    path = run(scene, frames=60)
    assert path.positions[:20, 0].tolist() == [[0, 0, 3.0]] * 20
    assert not path.velocities[:20, 0].any()
    # The step that leads to frame 20 is its first.
    for frame in (20, 21, 59):
        steps = frame - 19
        assert path.velocities[frame, 0, 2] == pytest.approx(-G * DT * steps, rel=1e-5)
        assert path.positions[frame, 0, 2] == pytest.approx(3 - way_of_steps(G, steps), abs=1e-5)


def test_a_body_appears_at_the_pose_of_the_event() -> None:
    q = tuple(axis_angle_quaternion([0, 0, 1], 0.5).tolist())
    event = BodyEvent(10, "a", "appear", (1.0, 2.0, 4.0), q)
    path = run(scene_of(Body("a", "cube", (0, 0, 3.0), CUBE), events=(event,)), frames=20)
    assert path.positions[9, 0].tolist() == [0, 0, 3.0]
    assert path.positions[10, 0].tolist() == pytest.approx([1, 2, 4 - way_of_steps(G, 1)])
    assert path.rotations[10:, 0].tolist() == [pytest.approx(q, abs=1e-6)] * 10


def test_what_stood_on_a_vanished_body_falls() -> None:
    table = Body("table", "cube", (0, 0, 0), (1, 1, 1), kinematic=True)
    box = Body("a", "cube", (0, 0, 1.0), CUBE)
    # By then the box sleeps.
    path = run(scene_of(box, table, events=(BodyEvent(60, "table", "vanish"),)), frames=90)
    assert path.positions[59, 0, 2] == pytest.approx(1.0, abs=1e-3)
    for frame in (60, 75, 89):
        fallen = path.positions[59, 0, 2] - path.positions[frame, 0, 2]
        assert fallen == pytest.approx(way_of_steps(G, frame - 59), abs=1e-5)
    assert path.contacts.frames_of(0, 1).max() < 60
    assert path.positions[:, 1].tolist() == [[0, 0, 0]] * 90


def test_a_vanished_body_stops_where_it_was() -> None:
    path = run(
        scene_of(Body("a", "cube", (0, 0, 3.0), CUBE), events=(BodyEvent(10, "a", "vanish"),)),
        frames=20,
    )
    assert path.positions[9, 0, 2] == pytest.approx(3 - way_of_steps(G, 10), abs=1e-5)
    assert path.positions[10:, 0].tolist() == [path.positions[9, 0].tolist()] * 10
    assert not path.velocities[10:, 0].any()


def test_a_moved_body_starts_from_rest_at_its_new_pose() -> None:
    scene = scene_of(
        Body("a", "cube", (0, 0, 3.0), CUBE),
        pushes=(Push("a", (1.0, 0, 0)),),
        events=(BodyEvent(10, "a", "move", (0.5, -1.0, 6.0)),),
    )
    path = run(scene, frames=30)
    assert path.velocities[9, 0, 0] == pytest.approx(1.0)
    assert path.positions[10, 0].tolist() == pytest.approx([0.5, -1, 6 - way_of_steps(G, 1)])
    assert path.velocities[29, 0].tolist() == pytest.approx([0, 0, -G * DT * 20], rel=1e-5)


def test_events_come_before_the_pushes_of_their_frame() -> None:
    scene = scene_of(
        Body("a", "cube", (0, 0, 3.0), CUBE),
        pushes=(Push("a", (1.0, 0, 0), None, 5),),
        events=(BodyEvent(5, "a", "appear"),),
    )
    path = run(scene, frames=10)
    assert path.velocities[5, 0, 0] == pytest.approx(1.0)


def test_a_moved_obstacle_is_met_at_its_new_place() -> None:
    """A shelf slides under a falling box, which would else reach the floor."""
    shelf = Body("shelf", "cube", (5.0, 0, 1.0), (1, 1, 0.1), kinematic=True)
    box = Body("a", "cube", (0, 0, 2.0), CUBE)
    path = run(
        scene_of(box, shelf, events=(BodyEvent(10, "shelf", "move", (0, 0, 1.0)),)), frames=150
    )
    assert path.positions[-1, 0, 2] == pytest.approx(1.1, abs=2e-3)
    assert path.positions[9:11, 1].tolist() == [[5, 0, 1], [0, 0, 1]]


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


def test_a_scene_does_not_end_before_its_last_event() -> None:
    box = Body("a", "cube", (0, 0, 0), CUBE)
    late = Body("b", "cube", (2.0, 0, 0), CUBE)
    scene = scene_of(box, late, events=(BodyEvent(250, "b", "appear"),))
    path = simulate(scene)
    assert len(path) > 250
    assert path.completed


def test_going_on_from_a_state_follows_the_same_path() -> None:
    # The state holds no memory of contacts, so the comparison is made while nothing slides.
    body = Body("a", "cube", (0, 0, 3.0), (0.3, 0.2, 0.5), (0.8, 0.6, 0, 0), angular_drag=0.3)
    scene = scene_of(
        body, pushes=(Push("a", (1, 0.2, 0), (0.1, 0, 3.3)), Push("a", (0, 1, 0), None, 30))
    )
    whole = run(scene, frames=60)
    rest = RigidEngine().simulate(scene, start=whole.state(20), frames=40)
    assert np.array_equal(rest.positions[0], whole.positions[20])
    for name in ("positions", "velocities", "rotations", "angular_velocities"):
        assert np.abs(getattr(rest, name) - getattr(whole, name)[20:]).max() < 1e-4


@pytest.mark.parametrize("frame", [5, 40, 70])
def test_going_on_from_a_sliding_box_stays_close(frame: int) -> None:
    box = Body("a", "cube", (0, 0, 0), (0.4, 0.4, 0.1), contact=ROUGH)
    scene = scene_of(box, pushes=(Push("a", (4.0, 0, 0)),))
    whole = run(scene, frames=100)
    rest = RigidEngine().simulate(scene, start=whole.state(frame), frames=100 - frame)
    assert np.abs(rest.positions - whole.positions[frame:]).max() < 2e-3


@pytest.mark.parametrize("frame", [5, 10, 19, 20, 25, 45])
def test_going_on_before_and_after_events_follows_the_same_path(frame: int) -> None:
    """What was moved or has vanished is where the state says, not where the scene starts."""
    shelf = Body("shelf", "cube", (5.0, 0, 2.0), (1, 1, 0.1), kinematic=True)
    box = Body("a", "cube", (0, 0, 3.0), CUBE)
    ghost = Body("ghost", "cube", (-3.0, 0, 4.0), CUBE)
    scene = scene_of(
        box,
        shelf,
        ghost,
        events=(
            BodyEvent(10, "shelf", "move", (0, 0, 2.0)),
            BodyEvent(20, "ghost", "vanish"),
        ),
    )
    whole = run(scene, frames=80)
    assert whole.positions[-1, 0, 2] == pytest.approx(2.1, abs=2e-3)
    rest = RigidEngine().simulate(scene, start=whole.state(frame), frames=80 - frame)
    assert len(rest) == 80 - frame
    assert np.abs(rest.positions - whole.positions[frame:]).max() < 1e-3
