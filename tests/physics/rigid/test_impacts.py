"""Bodies that would pass through each other in a step stop where they hit."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from physion.physics.rigid.bodies import RigidSettings
from physion.physics.rigid.engine import RigidEngine
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import Body, Push, Roles, Scene, SurfaceMaterial
from support.rigid_scenes import DT, ICE, ROUGH, scene_of

WALL = Body("wall", "cube", (1.0, 0, 1.0), (0.02, 2, 2), kinematic=True, contact=ICE)
"""2 cm thick; its near side is at x = .99."""
SIDE = 0.05
GAP = 1e-4
"""Metres: more than the gap at which hulls of this size count as touching."""
FLYING = RigidSettings(gravity=0.0, continuous=True)


def bullet(
    name: str = "bullet", x: float = 0.0, mass: float = 1.0, contact: SurfaceMaterial = ICE
) -> Body:
    """Return a small cube 2 m above the floor."""
    scale = (SIDE, SIDE, SIDE)
    return Body(name, "cube", (x, 0, 2.0), scale, mass=mass, contact=contact, angular_drag=0.0)


def fly(
    scene: Scene, frames: int = 20, changed: RigidSettings = FLYING, until: bool = False
) -> Trajectory:
    """Simulate with ``changed`` settings."""
    return RigidEngine(changed).simulate(scene, frames=frames, until_contact=until)


def shot(speed: float, *others: Body, side: float = 0.0, contact: SurfaceMaterial = ICE) -> Scene:
    """Return a scene in which the bullet starts with ``speed`` along x and ``side`` along y."""
    return scene_of(
        bullet(contact=contact), *others, pushes=(Push("bullet", (speed, side, 0.0), None, 0),)
    )


@pytest.mark.parametrize("speed", [20.0, 40.0, 300.0])
def test_a_thin_wall_is_not_passed(speed: float) -> None:
    scene = scene_of(bullet(x=-0.1), WALL, pushes=(Push("bullet", (speed, 0, 0), None, 0),))
    through = fly(scene, changed=replace(FLYING, continuous=False))
    assert through.positions[-1, 0, 0] == pytest.approx(20 * speed * DT - 0.1, rel=1e-5)
    path = fly(scene)
    touches = 0.99 - SIDE / 2
    at = path.positions[:, 0, 0]
    assert np.all(at < touches)
    hit = int((touches + 0.1) / (speed * DT))
    # Before the hit the bullet flies as ever, and then it stands at the wall.
    free = np.arange(1, hit + 1) * speed * DT - 0.1
    assert at[:hit].tolist() == pytest.approx(free.tolist())
    assert at[hit:].tolist() == pytest.approx([touches] * (len(at) - hit), abs=GAP)
    assert np.abs(path.velocities[hit:, 0, 0]).max() < 1e-6


def test_the_hit_takes_the_normal_velocity_only_and_the_rest_of_the_step() -> None:
    path = fly(shot(20.0, WALL, side=3.0, contact=ROUGH), frames=6)
    hit = 4  # after .2 m a step, from .8 to .965 m
    assert path.velocities[hit, 0].tolist() == pytest.approx([0, 3, 0], abs=1e-5)
    assert path.angular_velocities[hit, 0].tolist() == [0, 0, 0]
    part = (0.99 - SIDE / 2 - 0.8) / 0.2
    assert path.positions[hit, 0, 1] == pytest.approx((hit + part) * 3.0 * DT, abs=GAP)


def test_the_hit_is_recorded() -> None:
    scene = replace(shot(20.0, WALL), roles=Roles("bullet", "wall"))
    path = fly(scene, until=True)
    assert len(path) == 5
    contacts = path.contacts
    assert contacts.frame.tolist() == [4]
    assert contacts.bodies.tolist() == [[0, 1]]
    assert contacts.impulse.tolist() == pytest.approx([20.0], rel=1e-5)
    assert contacts.normal[0].tolist() == pytest.approx([1, 0, 0], abs=1e-6)
    assert contacts.point[0, 0] == pytest.approx(0.99, abs=GAP)


@pytest.mark.parametrize("restitution", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("mass", [0.3, 1.0, 5.0])
def test_two_bodies_keep_their_momentum_and_gain_no_energy(restitution: float, mass: float) -> None:
    bouncy = SurfaceMaterial(0.0, 0.0, restitution)
    target = bullet("target", 1.0, mass, bouncy)
    path = fly(shot(30.0, target, contact=bouncy), frames=4)
    hit = 3
    v = path.velocities[hit, :2, 0].astype(float)
    assert v[0] + mass * v[1] == pytest.approx(30.0, rel=1e-5)
    assert v[1] - v[0] == pytest.approx(restitution * 30.0, abs=1e-4)
    assert v[0] ** 2 + mass * v[1] ** 2 <= 900.0 * (1 + 1e-6)
    assert path.positions[hit, 1, 0] == pytest.approx(1.0)
    assert path.positions[hit, 0, 0] == pytest.approx(1.0 - SIDE, abs=GAP)


def test_a_sleeping_body_awakes() -> None:
    resting = Body("target", "cube", (1.0, 0, 0), (SIDE, SIDE, SIDE), contact=ICE)
    flying = Body("bullet", "cube", (0, 0, 0.001), (SIDE, SIDE, SIDE), contact=ICE)
    scene = scene_of(flying, resting, pushes=(Push("bullet", (40.0, 0, 0), None, 80),))
    path = fly(scene, 90, RigidSettings(continuous=True))
    # At rest, with a velocity of exactly 0, until it is hit in the third step from the push on.
    # The bullet is slowed a little by the floor.
    assert path.velocities[81, 1].tolist() == [0, 0, 0]
    assert path.velocities[82, 1, 0] == pytest.approx(20.0, rel=0.01)
    assert path.positions[84, 1, 0] > path.positions[82, 1, 0] + 0.35


def test_overlapping_bodies_do_not_stick() -> None:
    # .15 of a threshold of .75 x .01 m of the wall a step, then out by the usual contacts.
    start = replace(bullet(), position=(0.99 - SIDE / 2 + 0.004, 0.0, 2.0))
    scene = scene_of(start, WALL, pushes=(Push("bullet", (40.0, 0, 0), None, 0),))
    path = fly(scene, 60)
    assert np.all(path.positions[:, 0, 0] < 0.99)
    assert path.positions[-1, 0, 0] < 0.99 - SIDE / 2 + 0.001


@pytest.mark.parametrize(("speed", "swept"), [(0.5, False), (2.6, False), (2.65, True)])
def test_slow_bodies_move_as_without(speed: float, swept: bool) -> None:
    # The limit is .75 x (.025 + .01) m a step, 2.625 m/s. Contacts are found within .02 m: at 2.6
    # m/s, .023 m before the wall, neither rule sees it, and the bullet gets 3 mm into it.
    near = SIDE / 2 + 3 * speed * DT + 0.023
    scene = shot(speed, replace(WALL, position=(near + 0.01, 0, 1.0)), bullet("other", -0.4))
    off = fly(scene, 60, replace(FLYING, continuous=False))
    assert (fly(scene, 60).digest() != off.digest()) == swept


def test_only_motion_along_the_normal_counts() -> None:
    # Fast along the wall, slow towards it: left to the usual contacts.
    scene = shot(1.0, replace(WALL, position=(0.1, 0, 1.0), scale=(0.02, 9, 2)), side=30.0)
    off = fly(scene, 15, replace(FLYING, continuous=False))
    assert fly(scene, 15).digest() == off.digest()


def volley(seed: int) -> Scene:
    """Return pipes and bowls that are shot at each other and at a wall."""
    rng = np.random.default_rng(seed)
    shapes = ("pipe", "bowl", "torus", "cube", "pipe", "bowl")
    bodies = [
        Body(f"body {k}", shape, (0.3 * k, *rng.uniform(-0.1, 0.1, 1).tolist(), 0.3),
             (0.2, 0.2, 0.2), contact=ROUGH)
        for k, shape in enumerate(shapes)
    ]  # fmt: skip
    pushes = tuple(
        Push(body.name, (float(rng.uniform(8, 20)) * (-1) ** k, 1.0, 0.0), None, k)
        for k, body in enumerate(bodies)
    )
    return scene_of(*bodies, replace(WALL, position=(2.0, 0, 0)), pushes=pushes)


def test_same_bytes_in_threads_and_processes() -> None:
    scenes = [volley(seed) for seed in range(4)]
    on = RigidSettings(continuous=True)
    alone = [fly(scene, 60, on).digest() for scene in scenes]
    off = [fly(scene, 60, replace(on, continuous=False)).digest() for scene in scenes]
    assert all(a != b for a, b in zip(alone, off, strict=True))
    together = RigidEngine(on, threads=4).simulate_many(scenes, frames=60)
    assert [path.digest() for path in together] == alone
    code = (
        "import sys; from physion.scenes.scene import Scene; "
        "from physion.physics.rigid.engine import RigidEngine; "
        "from physion.physics.rigid.bodies import RigidSettings; "
        "engine = RigidEngine(RigidSettings(continuous=True)); "
        "print(engine.simulate(Scene.from_json(sys.stdin.read()), frames=60).digest())"
    )
    there = subprocess.run(
        [sys.executable, "-c", code],
        input=scenes[0].to_json(),
        text=True,
        capture_output=True,
        check=True,
    )
    assert there.stdout.strip() == alone[0]
