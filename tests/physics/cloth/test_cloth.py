"""Cloth: falls, drapes, rests, keeps its area, obeys its stiffness, and is deterministic."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from physion.core.errors import BadInputError, BadSceneError
from physion.numerics.linear_algebra import unit
from physion.numerics.rotations import rotate_vectors, rotation_matrix
from physion.physics.cloth.contacts import (
    SLACK,
    BodyPoses,
    find_neighbours,
    new_neighbours,
    smallest_distance,
    world_bounds,
)
from physion.physics.cloth.simulate import ClothMotion, ClothSettings, settle_solids, simulate_cloth
from physion.physics.cloth.solids import fill_bodies, fill_shape, particles_of, surface_particles
from physion.physics.cloth.solver import CLOTH_CONTACT_GAP
from physion.physics.cloth.springs import (
    correct_springs,
    sheet_springs,
    sheet_triangles,
    sheet_vertices,
)
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.physics.replay import area_under_curve
from physion.physics.trajectory import ENVIRONMENT, Contacts, Trajectory
from physion.scenes.scene import Body, Camera, Cloth, Roles, Scene
from physion.scenes.tdw.read_logs import read_scenes
from support.paths import FIND_TESTS

REST = ClothSettings().rest_distance
SPACING = ClothSettings().particle_spacing


def draped(
    *bodies: Body, height: float = 1.0, resolution: int = 21, size: float = 1.0, **cloth: float
) -> Scene:
    """A square cloth above bodies; the question is between it and the first body."""
    sheet = Cloth("cloth", (0.0, 0.0, height), (size, size, 0.0), resolution=resolution, **cloth)
    return Scene(
        "test", "drape", bodies, Roles("cloth", bodies[0].name), Camera((3, 0, 2)), (sheet,)
    )


def still(scene: Scene, frames: int, settings: ClothSettings | None = None) -> ClothMotion:
    """Let the cloth fall on bodies that keep their poses."""
    positions = np.array([body.position for body in scene.bodies])
    rotations = np.array([body.rotation for body in scene.bodies])
    return simulate_cloth(
        scene, np.tile(positions, (frames, 1, 1)), np.tile(rotations, (frames, 1, 1)), settings
    )


def far_away() -> Body:
    return Body("patient", "cube", (50.0, 0.0, 0.0))


def ball() -> Body:
    return Body("patient", "sphere", (0.0, 0.0, 0.2), (0.5, 0.5, 0.5))


def area(vertices: np.ndarray, resolution: int) -> float:
    a, b, c = (vertices[corner] for corner in sheet_triangles(resolution).T)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def strain(vertices: np.ndarray, scene: Scene) -> np.ndarray:
    springs = sheet_springs(scene.cloths[0])
    family, a = np.nonzero(springs.half_stiffness)
    apart = np.linalg.norm(vertices[a] - vertices[a + springs.offsets[family]], axis=1)
    return np.asarray(apart / springs.lengths[family] - 1)


def test_free_fall_matches_a_point_and_keeps_the_sheet_flat() -> None:
    settings = ClothSettings(damping=0.0)
    scene = draped(far_away(), height=2.0)
    motion = still(scene, 41, settings)
    step = 0.01 / settings.substeps
    # Frame 40 follows 41 steps.
    steps = 41 * settings.substeps
    # Symplectic Euler: after n steps a point has fallen g dt^2 n (n + 1) / 2.
    fallen = 9.81 * step**2 * steps * (steps + 1) / 2
    assert motion.vertices[40, :, 2] == pytest.approx(2.0 - fallen, abs=1e-5)
    assert np.abs(strain(motion.vertices[40].astype(float), scene)).max() < 1e-5


def test_damping_slows_the_fall_as_the_law_says() -> None:
    motion = still(draped(far_away(), height=2.0), 51)
    time = 0.51
    fallen = 9.81 * (time - 1 + np.exp(-time))
    assert 2.0 - motion.vertices[50, 0, 2] == pytest.approx(fallen, rel=0.01)


def test_drapes_over_a_ball_without_going_through() -> None:
    motion = still(draped(ball(), resolution=31, stretch=1.0), 151)
    gaps = np.linalg.norm(motion.vertices - [0.0, 0.0, 0.45], axis=2).min(axis=1) - 0.25
    # The cushion is soft for some frames at the impact, but nothing gets through to the ball.
    assert gaps.min() > 0.03
    last = motion.vertices[-1]
    assert last[:, 2].max() > 0.7 + REST / 2
    assert last[:, 2].min() < 0.5


def test_area_is_roughly_kept() -> None:
    scene = draped(ball(), resolution=21, stretch=1.0)
    vertices = still(scene, 151).vertices[-1].astype(float)
    assert area(vertices, 21) == pytest.approx(1.0, abs=0.15)


def test_rests_on_the_floor() -> None:
    motion = still(draped(far_away(), height=0.3), 151)
    gap = ClothSettings().floor_gap
    assert motion.vertices[-1, :, 2] == pytest.approx(gap, abs=2e-3)
    assert np.abs(motion.vertices[-1] - motion.vertices[-2]).max() < 1e-4
    floor = motion.contacts.frames_of(ENVIRONMENT, 1)
    fallen = int(np.flatnonzero(motion.vertices[:, 0, 2] <= gap + 1e-3)[0])
    assert abs(int(floor[0]) - fallen) <= 1


def test_the_floor_carries_the_weight_of_the_cloth() -> None:
    motion = still(draped(far_away(), height=0.1, mass=0.5), 101)
    contacts = motion.contacts
    late = (contacts.frame > 50) & (contacts.bodies[:, 0] == ENVIRONMENT)
    assert contacts.impulse[late].mean() == pytest.approx(0.5 * 9.81 * 0.01, rel=0.05)


def test_energy_does_not_blow_up() -> None:
    motion = still(draped(ball(), resolution=21, stretch=1.0, bend=1.0), 201)
    vertices = motion.vertices.astype(float)
    speed = np.diff(vertices, axis=0) / 0.01
    energy = 0.5 * (speed**2).sum(axis=2) + 9.81 * vertices[1:, :, 2]
    assert (energy.mean(axis=1) <= 9.81 * 1.0 + 1e-6).all()
    assert energy.mean(axis=1)[-1] < 0.65 * energy.mean(axis=1)[0]
    assert np.sqrt((speed**2).sum(axis=2)).max() < 10.0


def test_stiffer_cloth_stretches_less() -> None:
    worst = [
        float(np.quantile(strain(still(scene, 101).vertices[-1].astype(float), scene), 0.9))
        for scene in (draped(ball(), resolution=31, stretch=k, bend=0.0) for k in (0.1, 0.4, 1.0))
    ]
    assert worst[0] > worst[1] > worst[2]


def test_stiffer_bending_lifts_an_overhanging_sheet() -> None:
    post = Body("patient", "cube", (0.0, 0.0, 0.0), (0.3, 0.3, 0.6))
    rims = []
    for bend in (0.0, 1.0):
        scene = draped(post, height=0.9, resolution=21, stretch=1.0, bend=bend)
        rims.append(float(still(scene, 81).vertices[-1, :, 2].mean()))
    assert rims[1] > rims[0] + 0.01


def test_friction_holds_a_sheet_that_hangs_over_to_one_side() -> None:
    post = Body("patient", "cube", (0.25, 0.0, 0.0), (0.4, 1.2, 0.6))
    scene = draped(post, height=0.75, resolution=21, stretch=1.0)
    slid = [
        float(still(scene, 61, ClothSettings(particle_friction=mu)).vertices[-1, :, 0].mean())
        for mu in (0.0, 1.0)
    ]
    assert slid[0] < slid[1] - 0.005


def test_a_moving_body_takes_the_cloth_along() -> None:
    scene = draped(Body("patient", "cube", (0.0, 0.0, 0.0), (0.8, 0.8, 0.3)), height=0.45)
    frames = 121
    positions = np.zeros((frames, 1, 3))
    positions[60:, 0, 0] = np.linspace(0, 0.3, 61)
    rotations = np.tile([1.0, 0, 0, 0], (frames, 1, 1))
    moved = simulate_cloth(scene, positions, rotations).vertices
    assert moved[-1, :, 0].mean() > moved[60, :, 0].mean() + 0.15


def test_distance_equals_brute_force() -> None:
    rng = np.random.default_rng(0)
    body = Body("b", "cone", (0.3, -0.2, 0.1), (0.4, 0.5, 0.6), (0.8, 0.3, -0.4, 0.2))
    w, x, y, z = np.asarray(body.rotation) / np.linalg.norm(body.rotation)
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    world = particles_of(body, SPACING) @ turn.T + body.position
    points = rng.uniform([-1.0, -1.0, 0.6], [1.0, 1.0, 2.6], (40, 3))
    brute = np.linalg.norm(points[:, None] - world[None], axis=2).min()
    found = smallest_distance(
        points.T.copy(), surface_particles(body, SPACING), np.array(body.position), turn
    )
    assert found == pytest.approx(brute, abs=1e-12)


def rotation_of(body: Body) -> np.ndarray:
    """Return the matrix whose columns are the rotated axes."""
    return np.array([rotate_vectors(unit(body.rotation), axis) for axis in np.eye(3)]).T


def test_neighbours_equal_brute_force_and_are_kept_while_particles_stay() -> None:
    rng = np.random.default_rng(1)
    bodies = (
        Body("a", "cone", (0.3, -0.2, 0.1), (0.4, 0.5, 0.6), (0.8, 0.3, -0.4, 0.2)),
        Body("b", "cube", (0.1, 0.2, 0.0), (0.2, 0.2, 0.3)),
    )
    solids = fill_bodies(bodies, SPACING)
    x = np.array([body.position for body in bodies])
    poses = BodyPoses(x, np.array([rotation_of(body) for body in bodies]))
    before = BodyPoses(x - [[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]], poses.rot)
    points, reach, room = rng.uniform(-0.5, 1.0, (3, 200)), 0.06, 100
    near = new_neighbours(200, room, solids, reach, 0.0)
    bounds = (np.empty((2, 3)), np.empty((2, 3)))
    world_bounds(solids, poses, reach, *bounds)
    find_neighbours(points, -1.0, solids, poses, before, bounds, near)
    world = [
        rotate_vectors(unit(body.rotation), particles_of(body, SPACING)) + body.position
        for body in bodies
    ]
    assert near.counts.sum() > 50
    for v in range(200):
        found = near.position[v, : near.counts[v]]
        of = near.body[v, : near.counts[v]]
        for number, cloud in enumerate(world):
            close = cloud[np.linalg.norm(cloud - points[:, v], axis=1) < reach]
            assert np.sort(found[of == number], axis=0) == pytest.approx(np.sort(close, axis=0))
        moved = near.displacement[v, : near.counts[v]]
        assert moved == pytest.approx(np.where(of[:, None] == 1, [0.01, 0.0, 0.0], 0.0), abs=1e-12)
    counts = near.counts.copy()
    points[2] += 0.005
    find_neighbours(points, 0.006, solids, poses, poses, bounds, near)
    assert (near.counts == counts).all()
    find_neighbours(points, 0.004, solids, poses, poses, bounds, near)
    assert (near.counts != counts).any()


def test_neighbours_among_candidates_equal_a_search_anew() -> None:
    """Particles and bodies move by steps below, near and above the slack of the candidates."""
    rng = np.random.default_rng(2)
    bodies = (
        Body("a", "cone", (0.0, 0.0, 0.0), (0.4, 0.5, 0.6), (0.8, 0.3, -0.4, 0.2)),
        Body("b", "prop:bowl", (0.3, 0.2, 0.1), (0.5, 0.5, 0.5)),
    )
    solids, reach = fill_bodies(bodies, SPACING), 0.145
    x, turns = (np.array([getattr(b, n) for b in bodies]) for n in ("position", "rotation"))
    old = BodyPoses(x, np.array([rotation_matrix(unit(q)) for q in turns]))
    points = rng.uniform(-0.4, 0.7, (3, 300))
    kept, changed = new_neighbours(300, 100, solids, reach, SLACK), []
    bounds = (np.empty((2, 3)), np.empty((2, 3)))
    for scale in (0.002, 0.005, 0.01, 0.02, 0.05):
        for _ in range(4):
            points += rng.uniform(-scale, scale, points.shape)
            x, turns = (a + rng.uniform(-scale, scale, a.shape) / 2 for a in (x, turns))
            poses = BodyPoses(x, np.array([rotation_matrix(unit(q)) for q in turns]))
            world_bounds(solids, poses, reach, *bounds)
            fresh = new_neighbours(300, 100, solids, reach, 0.0)
            before = kept.scanned_at.copy()
            for near in (kept, fresh):
                find_neighbours(points, -1.0, solids, poses, old, bounds, near)
            assert (kept.counts == fresh.counts).all() and kept.counts.sum() > 1000
            for v, count in enumerate(kept.counts):
                for name in ("body", "position", "displacement"):
                    a, b = getattr(kept, name)[v, :count], getattr(fresh, name)[v, :count]
                    assert (a == b).all()
            known = np.isfinite(before).all(axis=2)
            changed += (
                [(kept.scanned_at != before).any(axis=2)[known].mean()] if known.any() else []
            )
            old = poses
    # Candidates are kept in small steps, and hardly ever in large ones.
    assert max(changed[:7]) < 0.3 and min(changed[-4:]) > 0.5


def test_room_for_candidates_is_enough_in_a_dense_body() -> None:
    solids = fill_bodies((Body("a", "cube", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),), 0.02)
    poses = BodyPoses(np.zeros((1, 3)), np.eye(3)[None])
    points = np.random.default_rng(3).uniform(0.4, 0.6, (3, 200))
    for radius in (0.02, 0.03, 0.05, 0.08):
        near = new_neighbours(200, 1000, solids, radius, 1e-6)
        bounds = (np.full((1, 3), -1.0), np.full((1, 3), 2.0))
        find_neighbours(points, -1.0, solids, poses, poses, bounds, near)
        assert 0 < near.candidate_counts.max() <= near.candidates.shape[2]
        assert near.candidate_counts.max() > near.candidates.shape[2] / 4


def test_a_body_with_too_many_particles_is_refused() -> None:
    rod = Body("a", "cube", (0.0, 0.0, 0.0), (0.1, 0.1, 40000 * SPACING))
    with pytest.raises(BadSceneError, match="more than 32767"):
        fill_bodies((rod,), SPACING)


def test_springs_join_the_edges_of_the_triangles_and_the_corners_across_them() -> None:
    rows = 5
    springs = sheet_springs(Cloth("c", (0.0, 0.0, 0.0), resolution=rows))
    family, a = np.nonzero(springs.half_stiffness)
    found = list(zip(a.tolist(), (a + springs.offsets[family]).tolist(), strict=True))
    corners = [set(triangle) for triangle in sheet_triangles(rows).tolist()]
    edges = {frozenset(pair) for t in corners for pair in combinations(t, 2)}
    across = {t ^ u for t, u in combinations(map(frozenset, corners), 2) if len(t & u) == 2}
    assert len(found) == len(edges) + len(across)
    assert set(map(frozenset, found)) == edges | across
    degree = np.bincount(np.array(found).ravel(), minlength=rows**2)
    assert springs.degree.tolist() == degree.tolist()


def test_a_spring_takes_back_its_fraction_of_its_error() -> None:
    springs = sheet_springs(
        Cloth("c", (0.0, 0.0, 0.0), (1.0, 1.0, 0.0), resolution=2, stretch=0.6, bend=0.0)
    )
    points = np.array([[0.0, 0.0, 1.5, 1.0], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
    shift = np.empty((3, 4))
    correct_springs(points, springs, shift, np.empty((3, 4)))
    # Particle 2 is 1.5 m from particle 0, half a metre too far: 0.6 / 2 of that along x. Its other
    # spring, to particle 3, is the diagonal of a rectangle of 0.5 m by 1 m.
    long = np.sqrt(1.25)
    pull = 0.3 * (long - 1) / long * np.array([-0.5, 1.0])
    assert shift[:2, 2] == pytest.approx(np.array([-0.15, 0.0]) + pull)
    assert shift.sum(axis=1) == pytest.approx(0.0, abs=1e-15)


def test_corrections_of_springs_are_added_one_family_after_the_other() -> None:
    """The sums equal, to the byte, those of two passes over each family, first to one end."""
    rng = np.random.default_rng(4)
    for rows in (2, 3, 12):
        springs = sheet_springs(Cloth("c", (0.0, 0.0, 0.0), (1.0, 1.0, 0.0), resolution=rows))
        points = rng.normal(size=(3, rows**2))
        shift = np.empty_like(points)
        correct_springs(points, springs, shift, np.empty_like(points))
        expected = np.zeros_like(points)
        for g, offset in enumerate(springs.offsets):
            a, b = points[:, :-offset], points[:, offset:]
            d = b - a
            found = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
            half = springs.half_stiffness[g, : len(found)]
            factor = half * (found - springs.lengths[g]) / found
            expected[:, :-offset] += factor * (b - a)
            expected[:, offset:] += factor * (a - b)
        assert shift.tobytes() == expected.tobytes()


def test_recorded_distance_matches_the_recorded_vertices() -> None:
    motion = still(draped(ball()), 81)
    world = particles_of(ball(), SPACING) + ball().position
    for frame in (0, 30, 60, 80):
        apart = np.linalg.norm(motion.vertices[frame][:, None] - world[None], axis=2).min()
        assert motion.distance[frame] == pytest.approx(apart - REST, abs=1e-6)


def test_contacts_name_the_cloth_and_the_body_that_meet() -> None:
    motion = still(draped(ball(), far_away_named("other")), 81)
    assert len(motion.contacts.frames_of(0, 2)) > 10
    assert not len(motion.contacts.frames_of(1, 2))
    rows = (motion.contacts.bodies == [0, 2]).all(axis=1)
    normals = motion.contacts.normal[rows]
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert np.median(normals[:, 2]) > 0.9
    assert motion.contacts.impulse[rows].max() > 0
    pressed = np.flatnonzero(motion.distance < 0)
    assert set(pressed) <= set(motion.contacts.frames_of(0, 2).tolist())


def far_away_named(name: str) -> Body:
    return replace(far_away(), name=name)


@pytest.mark.parametrize("name", ["cube", "cylinder", "sphere", "cone", "pyramid"])
def test_particles_fill_a_shape_evenly(name: str) -> None:
    spacing, scale = 0.02, (0.5, 0.6, 0.7)
    _, filled = fill_shape(name, scale, spacing)
    particles = particles_of(Body("b", name, (0, 0, 0), scale), spacing)
    fill = {"cube": 1, "cylinder": np.pi / 4, "sphere": np.pi / 6, "cone": np.pi / 12}
    volume = {**fill, "pyramid": 0.75**2 * 2 / 3}[name] * np.prod(scale)
    assert filled.sum() * spacing**3 == pytest.approx(volume, rel=0.1)
    assert particles[:, 2].min() > 0 and particles[:, 2].max() < scale[2]
    assert np.abs(particles[:, :2].mean(axis=0)).max() < 1e-9


def test_solids_settle_on_the_floor_whatever_way_they_are_turned() -> None:
    tilted = replace(ball(), shape="cube", kinematic=True, rotation=(0.92, 0.38, 0.0, 0.0))
    scene = replace(draped(tilted), settle_frames=100, floor=-0.2)
    settled = settle_solids(scene)
    motion = still(settled, 1)
    assert motion.vertices.shape[0] == 1
    assert -0.2 < settled.bodies[0].position[2] < scene.bodies[0].position[2]
    unsettled = replace(scene, settle_frames=0)
    assert settle_solids(unsettled) is unsettled


def test_a_simulation_continues_from_a_state() -> None:
    scene = draped(far_away(), height=2.0)
    whole = still(scene, 31).vertices
    speed = (whole[20] - whole[19]) / 0.01
    positions = np.tile(scene.bodies[0].position, (11, 1, 1))
    rotations = np.tile(scene.bodies[0].rotation, (11, 1, 1))
    rest = simulate_cloth(scene, positions, rotations, vertices=whole[20], velocities=speed)
    assert np.abs(rest.vertices[10] - whole[30]).max() < 0.01
    with pytest.raises(BadInputError, match="vertices"):
        simulate_cloth(scene, positions, rotations, vertices=whole[20][:-1])
    with pytest.raises(BadInputError, match="positions"):
        simulate_cloth(scene, positions[:, 0], rotations)


def test_triangles_face_up() -> None:
    vertices = sheet_vertices(Cloth("c", (0.0, 0.0, 0.0), resolution=4))
    a, b, c = (vertices[corner] for corner in sheet_triangles(4).T)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_rows_run_along_x_then_y() -> None:
    vertices = sheet_vertices(Cloth("c", (1.0, 2.0, 3.0), (2.0, 4.0, 0.0), resolution=3))
    assert vertices[0].tolist() == [0, 0, 3]
    assert vertices[1].tolist() == [0, 2, 3]
    assert vertices[3].tolist() == [1, 0, 3]
    with pytest.raises(BadInputError, match="2 vertices a side"):
        sheet_vertices(Cloth("c", (0, 0, 0), resolution=1))


SCRIPT = """
import numpy as np, hashlib
from tests.physics.cloth.test_cloth import ball, draped, still
print(hashlib.sha256(still(draped(ball()), 61).vertices.tobytes()).hexdigest())
"""


@pytest.mark.nightly
@pytest.mark.slow
def test_same_bytes_in_another_process() -> None:
    here = hashlib.sha256(still(draped(ball()), 61).vertices.tobytes()).hexdigest()
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=FIND_TESTS, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == here


def test_label_asks_for_pressure_not_for_a_touch() -> None:
    scene = draped(ball())
    frames = 3
    gaps = np.array([0.2, CLOTH_CONTACT_GAP + 1e-4, 0.1], np.float32)
    zeros = np.zeros((frames, 1, 3), np.float32)
    rotations = np.tile(np.float32([1, 0, 0, 0]), (frames, 1, 1))
    vertices = np.zeros((frames, 4, 3), np.float32)
    moved = Trajectory(
        zeros, rotations, zeros, zeros, vertices, gaps, Contacts.empty(), False, "test"
    )
    assert not label_contact(scene, moved).contact
    gaps[1] = CLOTH_CONTACT_GAP - 1e-4
    labels = label_contact(scene, moved)
    assert labels.contact and labels.first_frame == 1


@pytest.mark.nightly
@pytest.mark.slow
def test_official_trials_are_distinguished_above_chance(official: Path) -> None:
    """A quarter of the official cloth trials: enough to see skill, too few to measure it well."""
    trials = read_scenes(official / "scenes", "drape").unique()[0][::4]
    distances, contacts = [], []
    for trial in trials:
        scene = settle_solids(trial.scene)
        distances.append(float(still(scene, 151).distance.min()))
        contacts.append(trial.outcome.contact)
    assert area_under_curve(-np.array(distances), np.array(contacts)) > 0.6


def test_the_engine_lays_cloth_over_bodies_and_continues_from_a_state() -> None:
    solid = replace(ball(), kinematic=True)
    scene = replace(draped(solid), settle_frames=100)
    whole = simulate(scene, frames=61)
    assert whole.cloth_vertices.shape == (61, 21 * 21, 3)
    # A ball of radius 0.25 stands so that its lowest particle is the floor gap above the floor.
    assert 0.0 <= whole.positions[0, 0, 2] < ClothSettings().floor_gap
    assert len(whole.contacts.frames_of(0, 1))
    state, vertices = whole.state(40), whole.cloth_vertices.astype(np.float64)
    assert np.array_equal(state.cloth_velocities, (vertices[40] - vertices[39]) / 0.01)
    assert not whole.state(0).cloth_velocities.any(), "it starts from rest"
    later = simulate(scene, start=state, frames=21)
    assert np.abs(later.cloth_vertices[0] - whole.cloth_vertices[40]).max() < 1e-6
    assert np.abs(later.cloth_vertices[20] - whole.cloth_vertices[60]).max() < 0.05


def test_a_run_until_contact_is_the_beginning_of_the_whole_run() -> None:
    solid = replace(ball(), kinematic=True)
    scene = replace(draped(solid, stretch=1.0), settle_frames=100)
    whole = simulate(scene, frames=101)
    short = simulate(scene, frames=101, until_contact=True)
    first = label_contact(scene, whole).first_frame
    assert first is not None and len(short) == first + 1 < len(whole)
    assert label_contact(scene, short).first_frame == first
    assert short.cloth_vertices.tobytes() == whole.cloth_vertices[: first + 1].tobytes()
    assert short.contacts.frame.max() <= first
    kept = whole.contacts.frame <= first
    assert short.contacts.impulse.tolist() == whole.contacts.impulse[kept].tolist()
    missed = replace(draped(replace(far_away(), kinematic=True)), settle_frames=100)
    assert len(simulate(missed, frames=31, until_contact=True)) == 31


def test_a_sheet_that_nothing_touches_stays_as_it_is() -> None:
    scene = draped(far_away(), height=2.0)
    vertices = still(scene, 31).vertices.astype(np.float64)
    sunk = (vertices[30] - vertices[0])[:, 2]
    assert sunk == pytest.approx(vertices[30, 0, 2] - vertices[0, 0, 2], abs=1e-6)
    # A stretched sheet is not undeformed: it contracts while it falls.
    wide = vertices[0] * [1.1, 1.1, 1.0]
    positions, rotations = (
        np.tile(far_away().position, (11, 1, 1)),
        np.tile([1.0, 0, 0, 0], (11, 1, 1)),
    )
    moved = simulate_cloth(scene, positions, rotations, vertices=wide).vertices
    assert np.ptp(moved[10, :, 0]) < np.ptp(wide[:, 0]) - 0.01
