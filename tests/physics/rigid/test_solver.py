"""The contact solver against impulses that can be worked out by hand."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from physion.numerics.rotations import axis_angle_quaternion, rotation_matrices
from physion.physics.rigid.bodies import RigidSettings
from physion.physics.rigid.collision.manifold import Manifolds, new_manifolds
from physion.physics.rigid.collision.search import ContactList
from physion.physics.rigid.solver import (
    Bodies,
    Constraints,
    SolverOptions,
    build_constraints,
    correct_positions,
    correct_velocities,
    first_tangent,
    new_constraints,
    remember_anchors,
    set_order,
    sweep,
)
from physion.physics.rigid.step import fill_rotations, move_freely, move_poses

F64 = NDArray[np.float64]
DEFAULTS = RigidSettings()
# Friction in all sweeps, so that what holds has converged; shared by the anchors of a patch.
OPTIONS = SolverOptions(
    DEFAULTS.dt,
    DEFAULTS.position_iterations,
    1,
    0,
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
    x, v = np.zeros((count, 3)), np.zeros((count, 3))
    inertia, inv_mass, inv_inertia = (
        np.zeros((count, 3, 3)),
        np.zeros(count),
        np.zeros((count, 3, 3)),
    )
    for i, (position, velocity, mass, moment) in enumerate(rows):
        x[i], v[i], inv_mass[i] = position, velocity, 1 / mass
        inertia[i], inv_inertia[i] = np.diag([moment] * 3), np.eye(3) / moment
    rot = np.tile(np.eye(3), (count, 1, 1))
    return Bodies(
        x=x,
        q=np.tile([1.0, 0, 0, 0], (count, 1)),
        rot=rot,
        v=v,
        w=np.zeros((count, 3)),
        inertia=inertia,
        inv_mass=inv_mass,
        inv_inertia=inv_inertia,
        free_mass=inv_mass.copy(),
        free_inertia=inv_inertia.copy(),
    )


def contacts_of(
    pair: tuple[int, int],
    normal: tuple[float, float, float],
    points: list[list[float]],
    gap: float = 0.0,
    material: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ContactList:
    """Contacts of one pair of hulls."""
    count = len(points)
    return ContactList(
        manifold=np.zeros(1, np.int64),
        actors=np.array([pair], np.int64),
        bodies=np.array([pair], np.int64),
        normal=np.array([normal], float),
        material=np.array([material], float),
        first=np.array([0, count], np.int64),
        point=np.array(points, float),
        gap=np.full(count, gap),
    )


class Solved(NamedTuple):
    """Result of a step of the solver."""

    normal_impulse: F64
    move_v: F64
    manifolds: Manifolds
    rows: Constraints


def solve_step(
    bodies: Bodies,
    contacts: ContactList,
    manifolds: Manifolds | None = None,
    options: SolverOptions = OPTIONS,
) -> Solved:
    """Solve all contacts once, as in a step; velocities of ``bodies`` change, poses do not."""
    manifolds = new_manifolds(1) if manifolds is None else manifolds
    rows = new_constraints(2, len(bodies.x) - 1)
    build_constraints(contacts, 1, manifolds, bodies, options, rows)
    correct_positions(rows, contacts, 1, manifolds, bodies, options)
    move_v = bodies.v.copy()
    correct_velocities(rows, contacts, 1, manifolds, bodies, options)
    remember_anchors(contacts, 1, rows.slipped, manifolds, bodies)
    return Solved(rows.normal_impulse[: len(contacts.gap)].copy(), move_v, manifolds, rows)


def anchors_in_world(result: Solved) -> F64:
    """Anchors (K, 3) in the frame of the second body, which is the world."""
    return result.manifolds.anchor[0, 1, : result.manifolds.anchor_count[0]]


def on_floor(speed: float, mass: float = 2.0) -> Bodies:
    """A body that slides along x and falls at 0.1 m/s, and cannot turn."""
    return bodies_of(([0, 0, 0.5], [speed, 0, -0.1], mass, math.inf))


def floor_contacts(points: list[list[float]], material: tuple[float, float, float]) -> ContactList:
    return contacts_of((0, 1), (0, 0, -1), points, material=material)


def test_head_on_impulse_is_the_effective_mass_times_the_approach() -> None:
    bodies = bodies_of(([0, 0, 0], [3, 0, 0], 1.0, 0.1), ([1, 0, 0], [0, 0, 0], 2.0, 0.2))
    contacts = contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]])
    result = solve_step(bodies, contacts)
    # lambda = 3 / (1 / 1 + 1 / 2): both go on with the speed of their centre of mass.
    assert result.normal_impulse[0] == pytest.approx(2.0, rel=1e-12)
    assert bodies.v[:2, 0].tolist() == pytest.approx([1.0, 1.0], rel=1e-12)
    assert np.abs(bodies.w).max() == 0.0


def test_lever_arms_lower_the_effective_mass_and_give_spin() -> None:
    bodies = bodies_of(([0, 0, 0], [3, 0, 0], 1.0, 0.1), ([1, 0, 0], [0, 0, 0], 2.0, 0.2))
    contacts = contacts_of((0, 1), (1, 0, 0), [[0.5, 0.2, 0]])
    result = solve_step(bodies, contacts)
    # r x d = (0, 0, -0.2) for both: J M^-1 J^T = 1 + 1/2 + 0.04 / 0.1 + 0.04 / 0.2.
    impulse = 3.0 / 2.1
    assert result.normal_impulse[0] == pytest.approx(impulse, rel=1e-12)
    assert bodies.v[:2, 0].tolist() == pytest.approx([3 - impulse, impulse / 2], rel=1e-12)
    assert bodies.w[:2, 2].tolist() == pytest.approx([2 * impulse, -impulse], rel=1e-12)


def test_a_fast_contact_bounces_and_a_slow_one_does_not() -> None:
    for speed, expected in ((3.0, 1.5), (1.9, 0.0)):
        bodies = bodies_of(([0, 0, 0], [speed, 0, 0], 1.0, 0.1))
        contacts = contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]], material=(0, 0, 0.5))
        solve_step(bodies, contacts)
        assert bodies.v[0, 0] == pytest.approx(-expected, abs=1e-12)


def test_a_gap_leaves_the_approach_that_closes_its_biased_part() -> None:
    bodies = bodies_of(([0, 0, 0], [3, 0, 0], 1.0, 0.1))
    solve_step(bodies, contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]], 0.01))
    assert bodies.v[0, 0] == pytest.approx(0.8 * 0.01 / DT, rel=1e-12)


def test_overlap_is_pushed_out_without_leaving_speed() -> None:
    bodies = bodies_of(([0, 0, 0], [3, 0, 0], 1.0, 0.1))
    contacts = contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]], -0.01)
    result = solve_step(bodies, contacts)
    assert result.move_v[0, 0] == pytest.approx(-0.8 * 0.01 / DT, rel=1e-12)
    assert bodies.v[0, 0] == pytest.approx(0.0, abs=1e-12)
    deep = contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]], -1.0)
    result = solve_step(bodies, deep)
    assert result.move_v[0, 0] == pytest.approx(-10.0, rel=1e-12)


def test_a_parting_contact_gets_no_impulse() -> None:
    bodies = bodies_of(([0, 0, 0], [-1, 0, 0], 1.0, 0.1))
    contacts = contacts_of((0, 1), (1, 0, 0), [[0.5, 0, 0]])
    assert solve_step(bodies, contacts).normal_impulse[0] == 0.0
    assert bodies.v[0].tolist() == [-1.0, 0.0, 0.0]


def test_friction_slides_with_the_dynamic_coefficient() -> None:
    bodies = on_floor(speed=1.0)
    contacts = floor_contacts([[0, 0, 0]], (0.5, 0.3, 0))
    result = solve_step(bodies, contacts)
    # Normal impulse 2 kg * 0.1 m/s; friction 0.3 of it.
    assert result.normal_impulse[0] == pytest.approx(0.2, rel=1e-12)
    assert bodies.v[0, 0] == pytest.approx(1.0 - 0.3 * 0.2 / 2.0, rel=1e-12)
    assert len(anchors_in_world(result)) == 0


def test_friction_holds_below_the_static_limit_and_keeps_its_anchor() -> None:
    bodies = on_floor(speed=0.04)
    contacts = floor_contacts([[0, 0, 0]], (0.5, 0.3, 0))
    result = solve_step(bodies, contacts)
    # 2 kg * 0.04 m/s = 0.08 N s is needed, 0.5 * 0.2 N s allowed, and 0.3 * 0.2 would not do.
    assert bodies.v[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert result.manifolds.anchor[0, 0, 0].tolist() == [0.0, 0.0, -0.5]
    assert anchors_in_world(result).tolist() == [[0.0, 0.0, 0.0]]


def test_an_anchor_pulls_back_what_it_slipped() -> None:
    bodies = on_floor(speed=0.0)
    contacts = floor_contacts([[0, 0, 0]], (2.0, 2.0, 0))
    memory = solve_step(bodies, contacts).manifolds
    bodies.x[0, 0] += 0.001
    bodies.v[0] = [0, 0, -0.1]
    result = solve_step(bodies, contacts, memory)
    assert result.move_v[0, 0] == pytest.approx(-0.001 / DT, rel=1e-9)
    # The one velocity sweep takes back the part `friction_gain` of that speed.
    assert bodies.v[0, 0] == pytest.approx(-0.2 * 0.001 / DT, rel=1e-9)


@pytest.mark.parametrize(("divide", "anchors"), [(False, 2), (True, 1)])
def test_two_anchors_bear_the_limit_twice_or_divide_it(divide: bool, anchors: int) -> None:
    bodies = on_floor(speed=1.0)
    contacts = floor_contacts([[-0.2, 0, 0], [0.2, 0, 0]], (0.5, 0.3, 0))
    options = OPTIONS._replace(divide_friction=divide)
    result = solve_step(bodies, contacts, options=options)
    assert result.normal_impulse.sum() == pytest.approx(0.2, rel=1e-12)
    assert bodies.v[0, 0] == pytest.approx(1.0 - anchors * 0.3 * 0.2 / 2.0, rel=1e-12)


def test_anchors_are_the_points_farthest_apart() -> None:
    bodies = on_floor(speed=0.0)
    points = [[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0], [-0.2, 0, 0]]
    result = solve_step(bodies, floor_contacts(points, (1, 1, 0)))
    assert sorted(anchors_in_world(result)[:, 0].tolist()) == [-0.2, 0.3]


def test_anchors_too_close_together_in_a_grown_patch_are_chosen_anew() -> None:
    bodies = on_floor(speed=0.0)
    near = floor_contacts([[0.0, 0, 0], [0.1, 0, 0]], (1, 1, 0))
    for reach, kept in ((0.2, [0.0, 0.1]), (0.21, [0.0, 0.21])):
        bodies.v[0] = [0, 0, -0.1]
        memory = solve_step(bodies, near).manifolds
        bodies.v[0] = [0, 0, -0.1]
        grown = floor_contacts([[0.0, 0, 0], [0.1, 0, 0], [reach, 0, 0]], (1, 1, 0))
        result = solve_step(bodies, grown, memory)
        assert sorted(anchors_in_world(result)[:, 0].tolist()) == pytest.approx(kept)


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
    manifolds, rows = new_manifolds(1), new_constraints(1, 1)
    build_constraints(contacts, 1, manifolds, bodies, OPTIONS, rows)
    assert manifolds.anchor_count.tolist() == [2]
    for _ in range(8):
        sweep(rows, contacts, 1, manifolds, bodies, True, True, False)
        limit = static * rows.normal_impulse.sum()
        assert rows.normal_impulse.min() >= 0
        assert np.abs(rows.friction_impulse).max() <= limit + 1e-12


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


def order_of(pairs: list[list[int]], world: int) -> list[int]:
    rows = new_constraints(len(pairs), world)
    contacts = contacts_of((0, 1), (1, 0, 0), [[0, 0, 0]])
    contacts = contacts._replace(actors=np.array(pairs, np.int64))
    set_order(contacts, len(pairs), world, rows)
    return rows.order.tolist()


def test_pairs_with_the_world_are_solved_last() -> None:
    # Bodies 0, 1, 2 in a row; 3 is the world.
    # 0-1 first; 0-world and 1-2 share the second partition; 2-world comes after 1-2.
    assert order_of([[0, 3], [0, 1], [1, 2], [2, 3]], 3) == [1, 0, 2, 3]


def test_more_neighbours_than_partitions_share_the_last_one() -> None:
    count = 70
    pairs = [[0, i + 1] for i in range(count)]
    assert order_of(pairs, count + 1) == list(range(count))


def test_free_motion_has_gravity_drag_and_a_cap() -> None:
    v = np.array([[1.0, 2.0, 3.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    w = np.array([[0.0, 30.0, 40.0], [0.5, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    drag = np.array([[0.0, 0.0], [2.0, 4.0], [1.0, 1.0]])
    move_freely(v, w, np.array([False, False, True]), drag, 9.81, 7.0, 0.01)
    assert v[0].tolist() == pytest.approx([1.0, 2.0, 3.0 - 0.0981])
    assert w[0].tolist() == pytest.approx([0.0, 7 * 0.6, 7 * 0.8])
    assert v[1].tolist() == pytest.approx([0.98, 0.0, -0.0981 * 0.98])
    assert w[1].tolist() == pytest.approx([0.48, 0.0, 0.0])
    # What sleeps stays as it is, and so does the world.
    assert [v[2, 0], w[2, 0]] == [1.0, 9.0]
    assert not v[3].any()


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
    awake = np.array([False])
    for _ in range(25):
        move_poses(x, q, v, w, awake, 0.01)
    quarter = [math.cos(math.pi / 4), *(math.sin(math.pi / 4) * axis)]
    assert q[0].tolist() == pytest.approx(quarter, abs=1e-12)
    for _ in range(75):
        move_poses(x, q, v, w, awake, 0.01)
    assert q[0].tolist() == pytest.approx([-1.0, 0, 0, 0], abs=1e-12)
    assert x[0].tolist() == pytest.approx([1.0, 0.0, -2.0])
    assert not x[1].any()


def held_on_floor() -> tuple[Bodies, ContactList, Manifolds]:
    """A body with two anchors 0.4 m apart that holds."""
    bodies = on_floor(speed=0.0)
    contacts = floor_contacts([[-0.2, 0, 0], [0.2, 0, 0]], (1, 1, 0))
    return bodies, contacts, solve_step(bodies, contacts).manifolds


def new_places(contacts: ContactList) -> ContactList:
    """The same contacts 0.1 m along y, so that old and new anchors can be told apart."""
    return contacts._replace(point=contacts.point + np.array([0.0, 0.1, 0.0]))


@pytest.mark.parametrize(("part", "kept"), [(0.99, True), (1.01, False)])
def test_anchors_far_apart_along_the_normal_are_forgotten(part: float, kept: bool) -> None:
    bodies, contacts, memory = held_on_floor()
    bodies.x[0, 2] += part * OPTIONS.anchor_distance
    bodies.v[0] = [0, 0, -0.1]
    result = solve_step(bodies, new_places(contacts), memory)
    assert anchors_in_world(result)[:, 1].tolist() == [0.0 if kept else 0.1] * 2


@pytest.mark.parametrize(("part", "kept"), [(0.99, True), (1.01, False)])
def test_anchors_are_forgotten_where_the_bodies_disagree_about_the_normal(
    part: float, kept: bool
) -> None:
    bodies, contacts, memory = held_on_floor()
    # About x through the floor below the body, which leaves the anchors where they are.
    angle = part * math.acos(OPTIONS.patch_cosine)
    rot = rotation_matrices(axis_angle_quaternion([1.0, 0, 0], angle))
    bodies.rot[0], bodies.x[0] = rot, rot @ bodies.x[0]
    bodies.v[0] = [0, 0, -0.1]
    result = solve_step(bodies, new_places(contacts), memory)
    assert (anchors_in_world(result)[:, 1] < 0.05).all() == kept


def test_contacts_with_a_wide_gap_hold_no_anchor() -> None:
    for gap, anchors in ((0.99 * OPTIONS.anchor_gap, 1), (1.01 * OPTIONS.anchor_gap, 0)):
        bodies = bodies_of(([0, 0, 0.5], [0, 0, -9.0], 1.0, math.inf))
        contacts = contacts_of((0, 1), (0, 0, -1), [[0, 0, 0]], gap, (1, 1, 0))
        assert len(anchors_in_world(solve_step(bodies, contacts))) == anchors


def test_points_close_together_have_one_anchor() -> None:
    for distance, anchors in (
        (0.99 * OPTIONS.anchor_distance, 1),
        (1.01 * OPTIONS.anchor_distance, 2),
    ):
        contacts = floor_contacts([[0, 0, 0], [distance, 0, 0]], (1, 1, 0))
        assert len(anchors_in_world(solve_step(on_floor(0.0), contacts))) == anchors


@pytest.mark.parametrize("sweeps", [1, 3, 32])
def test_friction_acts_in_the_last_position_sweeps_and_the_velocity_sweep(sweeps: int) -> None:
    """One anchor takes the part g of what is left in each sweep, so that (1 - g)^sweeps remains."""
    bodies = on_floor(speed=0.01)
    contacts = floor_contacts([[0, 0, 0]], (5.0, 5.0, 0))
    options = OPTIONS._replace(friction_sweeps=sweeps)
    result = solve_step(bodies, contacts, options=options)
    left = 1 - OPTIONS.friction_gain
    assert result.move_v[0, 0] == pytest.approx(0.01 * left**sweeps, abs=1e-15)
    assert bodies.v[0, 0] == pytest.approx(0.01 * left ** (sweeps + 1), abs=1e-15)


def test_rotations_match_the_quaternions() -> None:
    q = np.array([axis_angle_quaternion([1.0, 2, 3], a) for a in (0.0, 0.7, 3.0)])
    rot = np.zeros((3, 3, 3))
    fill_rotations(q, rot, 1, 3)
    assert not rot[0].any()
    assert np.allclose(rot[1:], rotation_matrices(q[1:]), atol=1e-15)
