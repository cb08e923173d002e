"""Friction of boxes against Coulomb's law."""

from __future__ import annotations

import math

import numpy as np
import pytest

from physion.physics.trajectory import Trajectory
from physion.scenes.scene import Body, Push, Scene, SurfaceMaterial
from support.rigid_scenes import DT, ROUGH, G, run, scene_of, way_of_steps

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
