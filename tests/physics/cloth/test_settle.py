"""Solids settle: they fall as points do, stand, and push each other apart by their masses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from physion.numerics.linear_algebra import norm
from physion.numerics.rotations import axis_angle_quaternion, rotate_vectors
from physion.physics.cloth.contacts import ClothOptions
from physion.physics.cloth.simulate import ClothSettings, settle, settle_solids, settled_poses
from physion.physics.cloth.solids import (
    SolidBody,
    SolidState,
    fill_lattices,
    fill_shape,
    rotate_by,
    solid_particles,
    spin_between,
)
from physion.scenes.scene import Body, Camera, Cloth, Roles, Scene, Vec3

SPACING = ClothSettings().particle_spacing
REST = ClothSettings().rest_distance
FLOOR_GAP = ClothSettings().floor_gap
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def options(**changes: Any) -> ClothOptions:
    rules = ClothSettings()
    return ClothOptions(
        frame_time=0.01,
        substeps=rules.substeps,
        iterations=rules.iterations,
        rest_distance=REST,
        search_margin=rules.search_margin,
        floor=0.0,
        floor_gap=FLOOR_GAP,
        friction=rules.particle_friction,
        floor_friction=rules.floor_friction,
        damping=rules.damping,
        gravity=rules.gravity,
    )._replace(**changes)


def box(x: float, mass: float = 25.0, height: float = 0.1, side: float = 0.3) -> SolidBody:
    return SolidBody("cube", (side, side, side), (x, 0.0, height), UPRIGHT, mass)


def state_of(*bodies: SolidBody) -> SolidState:
    solids = solid_particles(bodies, SPACING)
    count = len(bodies)
    return SolidState(
        np.array([body.position for body in bodies]) + solids.center,
        np.tile(UPRIGHT, (count, 1)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
    )


def settle_frames(frames: int, given: ClothOptions, *bodies: SolidBody) -> tuple[SolidState, int]:
    state = state_of(*bodies)
    solids = solid_particles(bodies, SPACING)
    lattices = fill_lattices([(body.shape, body.scale) for body in bodies], SPACING)
    return state, settle(state, len(bodies), solids, lattices, given, frames)


def particles(body: SolidBody, position: Vec3, rotation: tuple[float, ...]) -> np.ndarray:
    origin, filled = fill_shape(body.shape, body.scale, SPACING)
    return np.asarray(rotate_vectors(rotation, origin + SPACING * np.argwhere(filled)) + position)


def test_free_fall_matches_a_point() -> None:
    given = options(damping=0.0)
    state, frames = settle_frames(10, given, box(0.0, height=5.0))
    step, steps = 0.01 / 3, 30
    assert frames == 10
    fallen = 9.81 * step**2 * steps * (steps + 1) / 2
    assert 5.15 - state.center[0, 2] == pytest.approx(fallen, rel=1e-9)
    assert state.q[0] == pytest.approx(UPRIGHT)


def test_a_single_solid_falls_on_the_floor_and_stands_where_the_short_way_puts_it() -> None:
    state, frames = settle_frames(100, options(), box(0.0))
    ((position, rotation),) = settled_poses((box(0.0),), options(), SPACING, 100)
    assert frames < 100
    lowest = particles(box(0.0), position, rotation)[:, 2].min()
    assert lowest == pytest.approx(FLOOR_GAP, abs=1e-12)
    assert state.center[0] == pytest.approx(np.add(position, (0.0, 0.0, 0.15)), abs=1e-3)


def test_solids_farther_apart_than_the_rest_distance_only_fall() -> None:
    pair = (box(0.0), box(0.3 + REST))
    poses = settled_poses(pair, options(), SPACING, 100)
    assert [position[0] for position, _ in poses] == pytest.approx([0.0, 0.3 + REST], abs=1e-12)
    assert all(rotation == UPRIGHT for _, rotation in poses)


def test_solids_that_are_too_close_push_each_other_apart() -> None:
    first, second = box(0.0), box(0.33)
    (a, turned_a), (b, turned_b) = settled_poses((first, second), options(), SPACING, 100)
    assert a[0] < -0.005 and b[0] > 0.335
    apart = norm(particles(first, a, turned_a)[:, None] - particles(second, b, turned_b))
    assert apart.min() > REST - 0.002


def test_the_heavier_solid_gives_way_less() -> None:
    # No floor, no gravity: momentum is kept but for the averaging of corrections, so the centres
    # part as one over their masses.
    given = options(gravity=0.0, damping=0.0, floor=-100.0)
    light, heavy = box(0.33, mass=5.0, height=0.0), box(0.0, mass=20.0, height=0.0)
    before = state_of(heavy, light).center
    moved = settle_frames(1, given, heavy, light)[0].center - before
    assert moved[1, 0] > 0.01
    assert moved[0, 0] == pytest.approx(-moved[1, 0] / 4, rel=0.02)


def test_a_push_next_to_the_centre_turns_a_solid() -> None:
    given = options(gravity=0.0, damping=0.0, floor=-100.0)
    low = box(0.0, mass=1e6, height=0.0, side=0.2)
    tall = SolidBody("cube", (0.2, 0.2, 0.8), (0.22, 0.0, 0.0), UPRIGHT, 5.0)
    state, _ = settle_frames(3, given, low, tall)
    # The push at the foot, along x, turns the top backwards: about -y by the right-hand rule.
    assert state.spin[1, 1] < -0.1
    assert state.spin[1, [0, 2]] == pytest.approx(0.0, abs=1e-9)


def test_a_turn_and_thespin_between_agree_with_the_axis_and_angle() -> None:
    q, step = np.array(UPRIGHT), 0.01
    axis = np.array([0.6, 0.0, 0.8])
    for _ in range(1000):
        rotate_by(q, 0.001 * axis)
    assert q == pytest.approx(axis_angle_quaternion(axis, 1.0), abs=1e-6)
    spin = np.empty(3)
    later = q.copy()
    rotate_by(later, 0.002 * axis)
    spin_between(q, later, step, spin)
    assert spin == pytest.approx(0.2 * axis, rel=1e-5)


def test_settling_moves_the_bodies_of_a_scene_that_stand_too_close() -> None:
    near = (
        Body("patient", "cube", (0.0, 0.0, 0.1), (0.2, 0.2, 0.3), kinematic=True, mass=500.0),
        Body("anchor", "cube", (0.22, 0.0, 0.1), (0.2, 0.2, 0.8), kinematic=True, mass=25.0),
        Body("lamp", "cube", (5.0, 0.0, 0.1), (0.2, 0.2, 0.8), kinematic=True, scenery=True),
    )
    sheet = Cloth("cloth", (0.0, 0.0, 1.5))
    scene = Scene("test", "drape", near, Roles("cloth", "patient"), Camera((3, 0, 2)), (sheet,))
    assert settle_solids(scene) is scene
    settled = settle_solids(replace(scene, settle_frames=100))
    assert settled.bodies[1].position[0] > 0.25
    assert abs(settled.bodies[0].position[0]) < 0.05
    assert settled.bodies[2] == near[2]
    assert settle_solids(replace(scene, settle_frames=100)) == settled
