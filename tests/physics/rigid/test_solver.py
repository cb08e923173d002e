"""The contact solver against impulses that can be worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physion.physics.rigid.constraint_rows import build_constraints, first_tangent, solving_order
from physion.physics.rigid.motion import move_freely, move_poses
from physion.physics.rigid.patches import drop_patches_without_contact, find_patches, grow_anchors
from physion.physics.rigid.settings import RigidSettings
from physion.physics.rigid.solver import solve_step, sweep
from physion.physics.rigid.solver_records import (
    AnchorMemory,
    Bodies,
    ContactSet,
    SolverBodies,
    SolverOptions,
    no_anchors,
)

DEFAULTS = RigidSettings()
OPTIONS = SolverOptions(
    DEFAULTS.dt,
    DEFAULTS.position_iterations,
    DEFAULTS.velocity_iterations,
    DEFAULTS.friction_sweeps,
    False,
    DEFAULTS.bias,
    DEFAULTS.max_depenetration_speed,
    DEFAULTS.bounce_threshold,
    DEFAULTS.friction_gain,
    DEFAULTS.patch_cosine,
    DEFAULTS.anchor_distance,
    DEFAULTS.anchor_gap,
)
DT = DEFAULTS.dt


def bodies_of(*rows: tuple[list[float], list[float], float, float]) -> Bodies:
    """Balls (x, v, mass, moment of inertia; infinity never turns) and the world."""
    count = len(rows) + 1
    x, v, w = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    inv_mass, inv_inertia = np.zeros(count), np.zeros((count, 3, 3))
    for i, (position, velocity, mass, inertia) in enumerate(rows):
        x[i], v[i], inv_mass[i] = position, velocity, 1 / mass
        inv_inertia[i] = np.eye(3) / inertia
    return Bodies(x, np.tile([1.0, 0, 0, 0], (count, 1)), v, w, inv_mass, inv_inertia)


def contacts_of(
    pair: tuple[int, int],
    normal: tuple[float, float, float],
    points: list[list[float]],
    separation: float = 0.0,
    material: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ContactSet:
    """Contacts of one pair of geoms."""
    count = len(points)
    return ContactSet(
        np.full(count, 7, np.int64),
        np.tile(np.array(pair, np.int64), (count, 1)),
        np.tile(np.array(normal, float), (count, 1)),
        np.array(points, float),
        np.full(count, separation),
        np.tile(np.array(material, float), (count, 1)),
    )


def on_floor(speed: float, mass: float = 2.0) -> Bodies:
    """A body that slides along x and falls at 0.1 m/s, and cannot turn."""
    return bodies_of(([0, 0, 0.5], [speed, 0, -0.1], mass, math.inf))


def floor_contacts(points: list[list[float]], material: tuple[float, float, float]) -> ContactSet:
    return contacts_of((0, 1), (0, 0, -1), points, material=material)


def test_head_on_impulse_is_the_effective_mass_times_the_approach() -> None:
    bodies = bodies_of(([0, 0, 0], [3, 0, 0], 1.0, 0.1), ([1, 0, 0], [0, 0, 0], 2.0, 0.2))
    contacts = contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]])
    result = solve_step(bodies, contacts, no_anchors(), OPTIONS)
    # lambda = 3 / (1 / 1 + 1 / 2): both go on with the speed of their centre of mass.
    assert result.normal_impulse[0] == pytest.approx(2.0, rel=1e-12)
    assert bodies.v[:2, 0].tolist() == pytest.approx([1.0, 1.0], rel=1e-12)
    assert np.abs(bodies.w).max() == 0.0


def test_lever_arms_lower_the_effective_mass_and_give_spin() -> None:
    bodies = bodies_of(([0, 0, 0], [3, 0, 0], 1.0, 0.1), ([1, 0, 0], [0, 0, 0], 2.0, 0.2))
    contacts = contacts_of((0, 1), (1, 0, 0), [[0.5, 0.2, 0]])
    result = solve_step(bodies, contacts, no_anchors(), OPTIONS)
    # r x d = (0, 0, -0.2) for both: J M^-1 J^T = 1 + 1/2 + 0.04 / 0.1 + 0.04 / 0.2.
    impulse = 3.0 / 2.1
    assert result.normal_impulse[0] == pytest.approx(impulse, rel=1e-12)
    assert bodies.v[:2, 0].tolist() == pytest.approx([3 - impulse, impulse / 2], rel=1e-12)
    assert bodies.w[:2, 2].tolist() == pytest.approx([2 * impulse, -impulse], rel=1e-12)


def test_a_fast_contact_bounces_and_a_slow_one_does_not() -> None:
    for speed, expected in ((3.0, 1.5), (1.9, 0.0)):
        bodies = bodies_of(([0, 0, 0], [speed, 0, 0], 1.0, 0.1))
        contacts = contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]], material=(0, 0, 0.5))
        solve_step(bodies, contacts, no_anchors(), OPTIONS)
        assert bodies.v[0, 0] == pytest.approx(-expected, abs=1e-12)


def test_a_gap_leaves_the_approach_that_closes_its_biased_part() -> None:
    bodies = bodies_of(([0, 0, 0], [3, 0, 0], 1.0, 0.1))
    solve_step(bodies, contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]], 0.01), no_anchors(), OPTIONS)
    assert bodies.v[0, 0] == pytest.approx(0.8 * 0.01 / DT, rel=1e-12)


def test_overlap_is_pushed_out_without_leaving_speed() -> None:
    bodies = bodies_of(([0, 0, 0], [3, 0, 0], 1.0, 0.1))
    contacts = contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]], -0.01)
    result = solve_step(bodies, contacts, no_anchors(), OPTIONS)
    assert result.move_v[0, 0] == pytest.approx(-0.8 * 0.01 / DT, rel=1e-12)
    assert bodies.v[0, 0] == pytest.approx(0.0, abs=1e-12)
    deep = contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]], -1.0)
    result = solve_step(bodies, deep, no_anchors(), OPTIONS)
    assert result.move_v[0, 0] == pytest.approx(-10.0, rel=1e-12)


def test_a_parting_contact_gets_no_impulse() -> None:
    bodies = bodies_of(([0, 0, 0], [-1, 0, 0], 1.0, 0.1))
    contacts = contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]])
    assert solve_step(bodies, contacts, no_anchors(), OPTIONS).normal_impulse[0] == 0.0
    assert bodies.v[0].tolist() == [-1.0, 0.0, 0.0]


def test_friction_slides_with_the_dynamic_coefficient() -> None:
    bodies = on_floor(speed=1.0)
    contacts = floor_contacts([[0, 0, 0]], (0.5, 0.3, 0))
    result = solve_step(bodies, contacts, no_anchors(), OPTIONS)
    # Normal impulse 2 kg * 0.1 m/s; friction 0.3 of it.
    assert result.normal_impulse[0] == pytest.approx(0.2, rel=1e-12)
    assert bodies.v[0, 0] == pytest.approx(1.0 - 0.3 * 0.2 / 2.0, rel=1e-12)
    assert len(result.anchors.key) == 0


def test_friction_holds_below_the_static_limit_and_keeps_its_anchor() -> None:
    bodies = on_floor(speed=0.04)
    contacts = floor_contacts([[0, 0, 0]], (0.5, 0.3, 0))
    result = solve_step(bodies, contacts, no_anchors(), OPTIONS)
    # 2 kg * 0.04 m/s = 0.08 N s is needed, 0.5 * 0.2 N s allowed, and 0.3 * 0.2 would not do.
    assert bodies.v[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert result.anchors.anchor_count.tolist() == [1]
    assert result.anchors.point[0, 0, 0].tolist() == [0.0, 0.0, -0.5]
    assert result.anchors.point[0, 1, 0].tolist() == [0.0, 0.0, 0.0]


def test_an_anchor_pulls_back_what_it_slipped() -> None:
    bodies = on_floor(speed=0.0)
    contacts = floor_contacts([[0, 0, 0]], (2.0, 2.0, 0))
    memory = solve_step(bodies, contacts, no_anchors(), OPTIONS).anchors
    bodies.x[0, 0] += 0.001
    bodies.v[0] = [0, 0, -0.1]
    result = solve_step(bodies, contacts, memory, OPTIONS)
    assert result.move_v[0, 0] == pytest.approx(-0.001 / DT, rel=1e-9)
    # The one velocity sweep takes back the part `friction_gain` of that speed.
    assert bodies.v[0, 0] == pytest.approx(-0.2 * 0.001 / DT, rel=1e-9)


@pytest.mark.parametrize(("divide", "anchors"), [(False, 2), (True, 1)])
def test_two_anchors_bear_the_limit_twice_or_divide_it(divide: bool, anchors: int) -> None:
    bodies = on_floor(speed=1.0)
    contacts = floor_contacts([[-0.2, 0, 0], [0.2, 0, 0]], (0.5, 0.3, 0))
    options = OPTIONS._replace(divide_friction=divide)
    result = solve_step(bodies, contacts, no_anchors(), options)
    assert result.normal_impulse.sum() == pytest.approx(0.2, rel=1e-12)
    assert bodies.v[0, 0] == pytest.approx(1.0 - anchors * 0.3 * 0.2 / 2.0, rel=1e-12)


def test_anchors_are_the_points_farthest_apart() -> None:
    bodies = on_floor(speed=0.0)
    points = [[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0], [-0.2, 0, 0]]
    result = solve_step(bodies, floor_contacts(points, (1, 1, 0)), no_anchors(), OPTIONS)
    assert sorted(result.anchors.point[0, 1, :, 0].tolist()) == [-0.2, 0.3]


def test_anchors_too_close_together_in_a_grown_patch_are_chosen_anew() -> None:
    bodies = on_floor(speed=0.0)
    near = floor_contacts([[0.0, 0, 0], [0.1, 0, 0]], (1, 1, 0))
    memory = solve_step(bodies, near, no_anchors(), OPTIONS).anchors
    for reach, kept in ((0.2, [0.0, 0.1]), (0.21, [0.0, 0.21])):
        bodies.v[0] = [0, 0, -0.1]
        grown = floor_contacts([[0.0, 0, 0], [0.1, 0, 0], [reach, 0, 0]], (1, 1, 0))
        result = solve_step(bodies, grown, memory, OPTIONS)
        assert sorted(result.anchors.point[0, 1, :, 0].tolist()) == pytest.approx(kept)


def test_contacts_form_patches_by_normal() -> None:
    bodies = on_floor(speed=0.0)
    contacts = floor_contacts([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], (1, 1, 0))
    contacts.normal[1] = [math.sin(0.1), 0, -math.cos(0.1)]
    _, patch_of = find_patches(contacts, no_anchors(), in_world(bodies), OPTIONS)
    assert patch_of.tolist() == [0, 1, 0]


def in_world(bodies: Bodies) -> SolverBodies:
    """Bodies whose axes are those of the world."""
    rot = np.tile(np.eye(3), (len(bodies.x), 1, 1))
    return SolverBodies(bodies.x, rot, bodies.v, bodies.w, bodies.inv_mass, bodies.inv_inertia)


@settings(max_examples=40, deadline=None)
@given(
    velocity=st.tuples(*[st.floats(-3, 3)] * 3),
    spin=st.tuples(*[st.floats(-5, 5)] * 3),
    static=st.floats(0, 1.5),
    ratio=st.floats(0, 1),
)
def test_friction_never_passes_its_limit(
    velocity: tuple[float, ...], spin: tuple[float, ...], static: float, ratio: float
) -> None:
    bodies = bodies_of(([0, 0, 0.5], list(velocity), 2.0, 0.3))
    bodies.w[0] = spin
    corners = [[x, y, 0.0] for x in (-0.4, 0.4) for y in (-0.3, 0.3)]
    contacts = floor_contacts(corners, (static, static * ratio, 0))
    solver = in_world(bodies)
    candidates, patch_of = find_patches(contacts, no_anchors(), solver, OPTIONS)
    patches = drop_patches_without_contact(candidates, patch_of)
    grow_anchors(contacts, patch_of, patches, 0, solver, OPTIONS)
    assert patches.anchor_count.tolist() == [2]
    constraints = build_constraints(contacts, patches, patch_of, solver, OPTIONS)
    for _ in range(8):
        sweep(constraints, patches, solver, True, True, False)
        limit = static * constraints.normal_impulse.sum()
        assert constraints.normal_impulse.min() >= 0
        assert np.abs(constraints.friction_impulse).max() <= limit + 1e-12


@settings(max_examples=50, deadline=None)
@given(
    normal=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda n: np.linalg.norm(n) > 0.1),
    relative=st.tuples(*[st.floats(-2, 2)] * 3),
)
def test_tangents_are_unit_vectors_across_the_normal(
    normal: tuple[float, ...], relative: tuple[float, ...]
) -> None:
    n, v, out = np.array(normal) / np.linalg.norm(normal), np.array(relative), np.zeros(3)
    first_tangent(n, v, out)
    assert np.linalg.norm(out) == pytest.approx(1.0)
    assert out @ n == pytest.approx(0.0, abs=1e-9)
    across = v - (v @ n) * n
    if across @ across > 0.11:
        assert out @ across == pytest.approx(np.linalg.norm(across))


def test_pairs_with_the_world_are_solved_last() -> None:
    # Bodies 0, 1, 2 in a row; 3 is the world.
    pairs = np.array([[0, 3], [0, 1], [1, 2], [2, 3]], np.int64)
    order = solving_order(np.arange(4, dtype=np.int64), pairs, 3).tolist()
    assert order == [1, 0, 2, 3]
    # 0-1 first; 0-world and 1-2 share the second partition; 2-world comes after 1-2.


def test_more_neighbours_than_partitions_share_the_last_one() -> None:
    count = 70
    pairs = np.array([[0, i + 1] for i in range(count)], np.int64)
    order = solving_order(np.arange(count, dtype=np.int64), pairs, count + 1)
    assert order.tolist() == list(range(count))


def test_free_motion_has_gravity_drag_and_a_cap() -> None:
    v = np.array([[1.0, 2.0, 3.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    w = np.array([[0.0, 30.0, 40.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    drag = np.array([[0.0, 0.0], [2.0, 4.0]])
    move_freely(v, w, np.array([True, False]), drag, 9.81, 7.0, 0.01)
    assert v[0].tolist() == pytest.approx([1.0, 2.0, 3.0 - 0.0981])
    assert w[0].tolist() == pytest.approx([0.0, 7 * 0.6, 7 * 0.8])
    assert v[1].tolist() == pytest.approx([0.98, 0.0, 0.0])
    assert w[1].tolist() == pytest.approx([0.48, 0.0, 0.0])
    assert not v[2].any()


def test_drag_never_reverses_a_velocity() -> None:
    v, w = np.ones((2, 3)), np.ones((2, 3))
    move_freely(v, w, np.array([False]), np.array([[200.0, 200.0]]), 9.81, 7.0, 0.01)
    assert not v[0].any()
    assert not w[0].any()


def test_poses_make_a_whole_rotation_about_an_axis() -> None:
    axis = np.array([1.0, 2.0, 2.0]) / 3.0
    x, q = np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1))
    v, w = np.array([[1.0, 0, -2.0], [9.0, 9, 9]]), np.zeros((2, 3))
    w[0] = 2 * math.pi * axis
    for _ in range(25):
        move_poses(x, q, v, w, 0.01)
    quarter = [math.cos(math.pi / 4), *(math.sin(math.pi / 4) * axis)]
    assert q[0].tolist() == pytest.approx(quarter, abs=1e-12)
    for _ in range(75):
        move_poses(x, q, v, w, 0.01)
    assert q[0].tolist() == pytest.approx([-1.0, 0, 0, 0], abs=1e-12)
    assert x[0].tolist() == pytest.approx([1.0, 0.0, -2.0])
    assert not x[1].any()


def test_an_anchor_memory_of_another_pair_is_forgotten() -> None:
    bodies = on_floor(speed=0.0)
    memory = solve_step(
        bodies, floor_contacts([[0, 0, 0]], (1, 1, 0)), no_anchors(), OPTIONS
    ).anchors
    other = AnchorMemory(memory.key + 1, memory.anchor_count, memory.normal, memory.point)
    contacts = floor_contacts([[0.3, 0, 0]], (1, 1, 0))
    bodies.v[0] = [0, 0, -0.1]
    result = solve_step(bodies, contacts, other, OPTIONS)
    assert result.anchors.point[0, 1, 0].tolist() == [0.3, 0.0, 0.0]
