"""What holds for every engine: mechanics, protocol, determinism, events."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physion.core.errors import BadInputError, BadSceneError, UnknownNameError
from physion.core.seeds import trial_seed
from physion.physics.engine import (
    DEFAULT_ENGINE,
    can_simulate,
    engines,
    make_engine,
    simulate,
    simulate_many,
)
from physion.physics.labels import label_contact
from physion.physics.mujoco import MujocoEngine, MujocoSettings
from physion.physics.rigid.bodies import RigidSettings
from physion.physics.rigid.engine import RigidEngine
from physion.physics.trajectory import ENVIRONMENT, State, Trajectory
from physion.scenes.sampling.sample import sample_scene
from physion.scenes.scene import (
    Body,
    BodyEvent,
    Camera,
    Cloth,
    Ending,
    Joint,
    Push,
    Roles,
    Scene,
    SurfaceMaterial,
)
from support.rigid_scenes import way_of_steps

G = 9.81
ZONE = Body("zone", "cube", (9.0, 9.0, 0.0), (1, 1, 0.01), kinematic=True)
BOTH = pytest.mark.parametrize("name", ["physion", "mujoco"])


def scene_of(*bodies: Body, **more: object) -> Scene:
    """A scene of these bodies and a zone far away."""
    return Scene(
        "test",
        "test",
        (*bodies, ZONE),
        Roles(bodies[0].name, "zone"),
        Camera((0, -3, 1)),
        **more,  # type: ignore[arg-type]
    )


def run(name: str, scene: Scene, frames: int | None = None) -> Trajectory:
    return make_engine(name).simulate(scene, frames=frames)


@BOTH
def test_free_fall_is_a_parabola(name: str) -> None:
    path = run(name, scene_of(Body("a", "cube", (0, 0, 5.0))), 41)
    # Whatever the steps of an engine, the second difference over 0.2 s is g t².
    height = path.positions[:, 0, 2]
    assert height[40] - 2 * height[20] + height[0] == pytest.approx(-G * 0.04, abs=2e-5)
    fall = path.velocities[40, 0, 2] - path.velocities[0, 0, 2]
    assert fall == pytest.approx(-G * 0.4, rel=1e-4)
    if name == "physion":  # frame 0 follows the first step
        assert height[[0, 40]] == pytest.approx(5 - way_of_steps(G, np.array([1, 41])), abs=1e-5)
    assert 5.0 - height[0] < 2e-3
    assert len(path.contacts.frames_of(ENVIRONMENT, 0)) == 0


@BOTH
def test_a_box_at_rest_stays_and_carries_its_weight(name: str) -> None:
    box = Body("a", "cube", (0, 0, 0), (0.3, 0.3, 0.3), (0.9689124, 0, 0, 0.2474040), mass=2.0)
    path = run(name, scene_of(box), 100)
    assert np.abs(path.positions[:, 0] - path.positions[0, 0]).max() < 3e-3
    assert np.abs(path.rotations[-1, 0] - path.rotations[0, 0]).max() < 1e-3
    contacts = path.contacts
    on_floor = (contacts.bodies == [ENVIRONMENT, 0]).all(axis=1)
    last = on_floor & (contacts.frame >= 50) & (contacts.frame < 60)
    if name == "mujoco":  # our own engine puts bodies at rest to sleep
        assert contacts.impulse[last].sum() == pytest.approx(2.0 * G * 0.1, rel=0.02)
    np.testing.assert_allclose(contacts.normal[on_floor], [[0, 0, 1]] * on_floor.sum(), atol=1e-3)


@BOTH
def test_a_push_moves_and_spins_and_the_spin_is_capped(name: str) -> None:
    box = Body("a", "cube", (0, 0, 5.0), mass=2.0, angular_drag=0.0)
    push = Push("a", (0.6, 0, 0), (0, 0, 5.9), frame=3)
    path = run(name, scene_of(box, pushes=(push,)), 6)
    assert np.abs(path.velocities[2, 0, 0]) < 1e-9
    assert path.velocities[3, 0, 0] == pytest.approx(0.3, rel=1e-4)
    # J r / I with the arm from the centre of mass, which has fallen for three steps by then, and
    # I = m a² / 6.
    arm = 0.4 + G * 0.01**2 * (1 + 2 + 3)
    assert path.angular_velocities[3, 0, 1] == pytest.approx(0.6 * arm / (2.0 / 6.0), rel=5e-3)
    hard = replace(push, impulse=(60.0, 0.0, 0.0))
    capped = run(name, scene_of(box, pushes=(hard,)), 6)
    assert np.linalg.norm(capped.angular_velocities[3, 0]) == pytest.approx(7.0, rel=1e-4)
    assert capped.velocities[3, 0, 0] == pytest.approx(30.0, rel=1e-4)


@BOTH
def test_a_push_turns_a_turned_body_by_the_torque_over_its_inertia(name: str) -> None:
    """w = R I⁻¹ Rᵀ (r x J), with I of a box along its own axes."""
    turn = Rotation.from_rotvec([0.5, -0.8, 1.1])
    size, mass, impulse = np.array([0.2, 0.5, 0.9]), 2.0, np.array([0.03, -0.02, 0.04])
    center, arm = np.array([0.0, 0.0, 5.0]), np.array([0.2, 0.1, -0.3])
    x, y, z, w = turn.as_quat()
    box = Body(
        "a",
        "cube",
        tuple(center - turn.apply([0, 0, 0.45])),
        tuple(size),
        (w, x, y, z),
        mass,
        angular_drag=0.0,
    )
    push = Push("a", tuple(impulse), tuple(center + arm), 0)
    path = run(name, scene_of(box, pushes=(push,)), 1)
    squares = size**2
    own = turn.inv().apply(np.cross(arm, impulse)) / (mass / 12 * (squares.sum() - squares))
    # MuJoCo lets the spin's direction change within the step.
    np.testing.assert_allclose(path.angular_velocities[0, 0], turn.apply(own), rtol=0.01, atol=3e-4)
    np.testing.assert_allclose(
        path.velocities[0, 0], impulse / mass - [0, 0, G * 0.01], rtol=1e-3, atol=1e-5
    )


@BOTH
def test_drag_is_the_fraction_lost_per_second(name: str) -> None:
    box = Body("a", "cube", (0, 0, 9.0), drag=1.0, angular_drag=2.0)
    path = run(name, scene_of(box, pushes=(Push("a", (1.0, 0, 0), (0, 0, 10.0)),)), 16)
    speed, spin = path.velocities[:, 0, 0], path.angular_velocities[:, 0, 1]
    assert speed[15] / speed[5] == pytest.approx(0.99**10, rel=1e-4)
    assert spin[15] / spin[5] == pytest.approx(0.98**10, rel=1e-3)


@BOTH
def test_a_sliding_block_stops_after_twice_coulombs_friction(name: str) -> None:
    rough = SurfaceMaterial(0.4, 0.4, 0.0)
    block = Body("a", "cube", (0, 0, 0), (0.4, 0.4, 0.1), mass=2.0, contact=rough)
    path = run(name, scene_of(block, pushes=(Push("a", (4.0, 0, 0)),)), 120)
    # The floor has 0.6; the mean is 0.5.
    assert path.positions[-1, 0, 0] == pytest.approx(2.0**2 / (2 * 2 * 0.5 * G), rel=0.12)


@BOTH
def test_joined_bodies_move_as_one_of_their_mass(name: str) -> None:
    base = Body("base", "cube", (0, 0, 3.0), (0.4, 0.4, 0.2), mass=3.0)
    pole = Body("pole", "cylinder", (0, 0, 3.2), (0.1, 0.1, 0.6), mass=1.0)
    scene = scene_of(
        base,
        pole,
        pushes=(Push("pole", (4.0, 0, 0), (0.1, 0, 3.7)),),
        joints=(Joint("base", "pole"),),
    )
    path = run(name, scene, 60)
    gap = np.linalg.norm(path.positions[:, 0] - path.positions[:, 1], axis=1)
    assert np.abs(gap - 0.2).max() < 1e-4
    center = (3.0 * path.velocities[:, 0] + path.velocities[:, 1]) / 4.0
    assert center[5, 0] == pytest.approx(1.0, rel=1e-3)


@BOTH
def test_kinematic_bodies_stay_and_scenery_is_passed_through(name: str) -> None:
    board = Body("board", "cube", (0, 0, 0), (1, 1, 0.1), kinematic=True)
    tree = Body("tree", "cube", (0, 0, 0), scenery=True)
    path = run(name, scene_of(Body("a", "cube", (0, 0, 0.4), (0.2, 0.2, 0.2)), board, tree), 70)
    assert np.abs(path.positions[:, 1:3]).max() == 0.0
    assert path.positions[-1, 0, 2] == pytest.approx(0.1, abs=3e-3)
    frames = path.contacts.frames_of(0, 1)
    assert frames[0] == pytest.approx(np.sqrt(2 * 0.3 / G) / 0.01, abs=2)
    row = int(np.flatnonzero((path.contacts.bodies == [0, 1]).all(axis=1))[0])
    assert path.contacts.normal[row].tolist() == pytest.approx([0, 0, -1], abs=1e-2)
    assert len(path.contacts.frames_of(0, 2)) == 0


@BOTH
def test_a_trial_ends_at_rest_but_not_before_its_least_frames(name: str) -> None:
    box = Body("a", "cube", (0, 0, 0), (0.2, 0.2, 0.2))
    scene = scene_of(box, ending=Ending(80, 200))
    resting = run(name, scene)
    assert (len(resting), resting.completed) == (80, True)
    falling = run(name, replace(scene, bodies=(replace(box, position=(0, 0, 50.0)), ZONE)))
    assert (len(falling), falling.completed) == (200, False)
    late = replace(scene, pushes=(Push("a", (1.0, 0, 0), frame=79),))
    assert run(name, late, 100).positions[-1, 0, 0] > 0.02
    # What has fallen below the floor of the ending is not waited for.
    hole = replace(scene, ending=Ending(80, 200, 20.0))
    assert len(run(name, replace(hole, bodies=(replace(box, position=(0, 0, 19.0)), ZONE)))) == 80


@BOTH
def test_going_on_from_a_state_follows_the_same_path(name: str) -> None:
    a = Body("a", "cube", (0, 0, 3.0), (0.3, 0.2, 0.5), (0.8, 0.6, 0, 0), angular_drag=0.3)
    pushes = (Push("a", (1, 0.2, 0), (0.1, 0, 3.3)), Push("a", (0, 1, 0), None, 30))
    scene = scene_of(a, pushes=pushes)
    whole = run(name, scene, 60)
    rest = make_engine(name).simulate(scene, start=whole.state(20), frames=40)
    assert np.abs(rest.positions - whole.positions[20:]).max() < 1e-3
    assert np.abs(rest.velocities - whole.velocities[20:]).max() < 1e-3
    assert np.abs(rest.rotations - whole.rotations[20:]).max() < 1e-3


def heap() -> Scene:
    return scene_of(
        Body("a", "torus", (0, 0, 0.4), (0.3, 0.3, 0.3), (0.9, 0.3, 0.3, 0.1)),
        Body("b", "cone", (0.05, 0, 0), (0.3, 0.3, 0.3)),
    )


@pytest.mark.nightly
@pytest.mark.slow
@BOTH
def test_same_bytes_in_every_process(name: str) -> None:
    here = [run(name, heap(), 60).digest() for _ in range(2)]
    code = (
        "import sys; from physion.scenes.scene import Scene; "
        "from physion.physics.engine import make_engine; "
        "scene = Scene.from_json(sys.stdin.read()); "
        f"print(make_engine({name!r}).simulate(scene, frames=60).digest())"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, input=heap().to_json(), text=True, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert here == [done.stdout.strip()] * 2


@BOTH
def test_stopping_at_contact_gives_the_same_label_and_the_same_start(name: str) -> None:
    engine, outcomes = make_engine(name), set()
    for index in range(6):
        scene = sample_scene("collide", trial_seed("until", "collide", "x", index))
        whole, cut = engine.simulate(scene), engine.simulate(scene, until_contact=True)
        label = label_contact(scene, whole)
        outcomes.add(label.contact)
        assert label_contact(scene, cut) == label
        assert np.array_equal(cut.positions, whole.positions[: len(cut)])
        assert len(cut) == (label.first_frame + 1 if label.first_frame is not None else len(whole))
    assert outcomes == {True, False}


@BOTH
def test_many_scenes_are_simulated_as_each_by_itself(name: str) -> None:
    scenes = [
        heap(),
        scene_of(Body("a", "cube", (0, 0, 1.0), (0.3, 0.3, 0.3), (0.9, 0.3, 0.3, 0.1))),
    ]
    engine = make_engine(name)
    alone = [engine.simulate(scene, frames=30) for scene in scenes]
    together = simulate_many(scenes, engine=engine, frames=30)
    assert [path.digest() for path in together] == [path.digest() for path in alone]
    starts = [path.state(10) for path in alone]
    later = simulate_many(scenes, engine=engine, starts=starts, frames=5)
    for scene, start, path in zip(scenes, starts, later, strict=True):
        assert path.digest() == engine.simulate(scene, start=start, frames=5).digest()


class Counting:
    """Engine that counts its calls with many scenes."""

    name = "counting"

    def __init__(self) -> None:
        self.calls: list[int] = []

    def simulate(self, scene: Scene, **options: object) -> Trajectory:
        raise AssertionError("one by one")

    def simulate_many(
        self,
        scenes: Sequence[Scene],
        *,
        starts: Sequence[State] | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> list[Trajectory]:
        self.calls.append(len(scenes))
        return []


def test_engines_that_can_get_many_scenes_at_once() -> None:
    engine = Counting()
    simulate_many([heap()] * 3, engine=engine)
    assert engine.calls == [3]
    with pytest.raises(BadInputError, match="as many starts"):
        simulate_many([heap()] * 3, engine=engine, starts=[])


@BOTH
def test_wrong_input_is_refused_in_one_line(name: str) -> None:
    with pytest.raises(BadInputError, match="at least 1"):
        run(name, heap(), 0)
    fixed = scene_of(Body("a", "cube", (0, 0, 0)), joints=(Joint("zone", "a"),))
    with pytest.raises(BadSceneError, match="make both kinematic or neither"):
        run(name, fixed)


def test_mujoco_refuses_cloth() -> None:
    scene = replace(heap(), cloths=(Cloth("sheet", (0.0, 0.0, 2.0), resolution=5),))
    assert can_simulate("physion", scene) and not can_simulate("mujoco", scene)
    assert can_simulate("mujoco", heap())
    with pytest.raises(BadSceneError, match="use the engine 'physion'") as error:
        run("mujoco", scene)
    assert "\n" not in str(error.value)


def test_engines_are_known_by_name() -> None:
    assert {"physion", "mujoco"} <= set(engines.names())
    assert DEFAULT_ENGINE == "physion"
    assert simulate(heap(), frames=2).engine == make_engine("physion").name
    assert run("mujoco", heap(), 2).engine == make_engine("mujoco").name
    assert make_engine("mujoco").name.startswith("mujoco-4.")
    other = MujocoEngine(replace(MujocoSettings(), gravity=1.0))
    assert other.name != MujocoEngine().name
    assert RigidEngine(RigidSettings(gravity=1.0)).name != RigidEngine().name
    with pytest.raises(UnknownNameError, match="mujoco"):
        make_engine("mujocco")


@pytest.mark.slow
def test_mujoco_is_loaded_only_by_its_engine() -> None:
    code = (
        "import sys, physion.physics.engine, physion.physics.replay; print('mujoco' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize(("bounce", "of_floor"), [(0.0, 0.0), (0.5, 0.5), (0.9, 0.9), (1.0, 0.2)])
def test_mujoco_bounces_with_the_mean_restitution(bounce: float, of_floor: float) -> None:
    block = Body(
        "a", "cube", (0, 0, 1.0), (0.3, 0.3, 0.3), contact=SurfaceMaterial(0.5, 0.5, bounce)
    )
    floor = SurfaceMaterial(0.5, 0.5, of_floor)
    engine = MujocoEngine(replace(MujocoSettings(), floor=floor))
    height = engine.simulate(scene_of(block), frames=100).positions[:, 0, 2]
    ground, mean = int(np.argmin(height)), (bounce + of_floor) / 2
    assert height[ground:].max() == pytest.approx(mean**2, abs=0.12)


# Bodies that appear, vanish and move.


@BOTH
def test_a_body_appears_at_rest_and_falls(name: str) -> None:
    box = Body("a", "cube", (0, 0, 2.0), (0.2, 0.2, 0.2))
    late = Body("late", "cube", (0, 0, 1.0), (0.2, 0.2, 0.2))
    path = run(name, scene_of(box, late, events=(BodyEvent(20, "late", "appear"),)), 90)
    alone = run(name, scene_of(replace(late, name="a")), 40)
    assert np.abs(path.positions[:20, 1] - (0, 0, 1.0)).max() == 0.0
    assert np.abs(path.velocities[:20, 1]).max() == 0.0
    np.testing.assert_allclose(path.positions[20:45, 1], alone.positions[:25, 0], atol=1e-5)
    # The other one falls on as if nothing had happened, until it meets it.
    through = run(name, scene_of(box), 60)
    np.testing.assert_allclose(path.positions[:40, 0], through.positions[:40, 0], atol=1e-5)
    assert len(path.contacts.frames_of(ENVIRONMENT, 1)) > 0


@BOTH
def test_a_body_falls_through_what_has_vanished(name: str) -> None:
    box = Body("a", "cube", (0, 0, 1.0), (0.2, 0.2, 0.2))
    shelf = Body("shelf", "cube", (0, 0, 0.5), (1, 1, 0.1), kinematic=True)
    held = run(name, scene_of(box, shelf), 100)
    assert held.positions[-1, 0, 2] == pytest.approx(0.6, abs=3e-3)
    path = run(name, scene_of(box, shelf, events=(BodyEvent(50, "shelf", "vanish"),)), 100)
    assert np.array_equal(path.positions[:50], held.positions[:50])
    assert path.positions[-1, 0, 2] == pytest.approx(0.0, abs=3e-3)
    touches = path.contacts.frames_of(0, 1)
    assert len(touches) and touches.max() < 50


@BOTH
def test_a_vanished_body_rests_where_it_was(name: str) -> None:
    box = Body("a", "cube", (0, 0, 3.0), (0.2, 0.2, 0.2))
    path = run(name, scene_of(box, events=(BodyEvent(10, "a", "vanish"),)), 30)
    assert np.array_equal(path.positions[10:, 0], path.positions[[9] * 20, 0])
    assert np.abs(path.velocities[10:, 0]).max() == 0.0


@BOTH
def test_a_move_puts_a_body_elsewhere_at_rest(name: str) -> None:
    box = Body("a", "cube", (0, 0, 3.0), (0.2, 0.2, 0.2))
    spun = (0.7071067811865476, 0.0, 0.0, 0.7071067811865476)
    move = BodyEvent(10, "a", "move", (2.0, 0.0, 5.0), spun)
    path = run(name, scene_of(box, pushes=(Push("a", (1.0, 0, 0)),), events=(move,)), 30)
    np.testing.assert_allclose(path.positions[10, 0], (2.0, 0.0, 5.0), atol=2e-3)
    assert np.abs(path.velocities[10:, 0, :2]).max() < 1e-6
    np.testing.assert_allclose(path.rotations[-1, 0], spun, atol=1e-6)
    wall = Body("wall", "cube", (0, 0, 0), (1, 1, 0.5), kinematic=True)
    away = BodyEvent(5, "wall", "move", (3.0, 0.0, 0.0))
    low = replace(box, position=(0.0, 0.0, 0.5))
    path = run(name, scene_of(low, wall, events=(away,)), 60)
    assert path.positions[-1, 0, 2] == pytest.approx(0.0, abs=3e-3)
    np.testing.assert_allclose(path.positions[5:, 1], [(3.0, 0.0, 0.0)] * 55)


@BOTH
def test_a_trial_does_not_end_before_its_last_event(name: str) -> None:
    box = Body("a", "cube", (0, 0, 0), (0.2, 0.2, 0.2))
    late = BodyEvent(120, "a", "move", (0.0, 0.0, 1.0))
    scene = scene_of(box, ending=Ending(80, 400), events=(late,))
    path = run(name, scene)
    assert len(path) > 150 and path.positions[125, 0, 2] > 0.9 and path.completed


@BOTH
def test_continuing_from_a_state_takes_only_later_events(name: str) -> None:
    """What was moved or has vanished is where the state says, not where the scene starts."""
    shelf = Body("shelf", "cube", (5.0, 0, 2.0), (1, 1, 0.1), kinematic=True)
    box = Body("a", "cube", (0, 0, 3.0), (0.4, 0.4, 0.4))
    ghost = Body("ghost", "cube", (-3.0, 0, 4.0), (0.4, 0.4, 0.4))
    move, gone = BodyEvent(10, "shelf", "move", (0, 0, 2.0)), BodyEvent(20, "ghost", "vanish")
    scene = scene_of(box, shelf, ghost, events=(move, gone))
    whole = run(name, scene, 80)
    assert whole.positions[-1, 0, 2] == pytest.approx(2.1, abs=3e-3)
    for frame in (5, 10, 19, 20, 25, 45):
        rest = make_engine(name).simulate(scene, start=whole.state(frame), frames=80 - frame)
        assert len(rest) == 80 - frame
        assert np.abs(rest.positions - whole.positions[frame:]).max() < 1e-3


def test_the_engine_without_its_package_names_the_extra() -> None:
    code = (
        "import sys; sys.modules['mujoco'] = None\n"
        "from physion.core.errors import MissingExtraError\n"
        "from physion.physics.engine import make_engine\n"
        "make_engine('physion')\n"
        "try:\n"
        "    make_engine('mujoco')\n"
        "except MissingExtraError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "-e '.[mujoco]'" in done.stdout and "\n" not in done.stdout.strip()
