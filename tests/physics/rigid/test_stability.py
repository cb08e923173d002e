"""Stacks, bounces and joined bodies: energy, rest, and impulses that can be worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from physion.numerics.rotations import rotate_vectors
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import Body, Joint, Push, SurfaceMaterial
from support.rigid_scenes import DT, ICE, ROUGH, G, run, scene_of

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
