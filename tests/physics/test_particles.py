"""Particles: they fill the solid, leave its holes, and move with the bodies."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from physion.core.errors import BadInputError, UnknownNameError
from physion.physics.particles import (
    LIMIT,
    REACH,
    default_spacing,
    inside_cells,
    particles_over_time,
    sample_particles,
)
from physion.physics.trajectory import Contacts, Trajectory
from physion.scenes.scene import Body, Camera, Cloth, Roles, Scene
from physion.scenes.shapes.meshes import box, merge
from physion.scenes.shapes.primitives import PIPE_INNER, TORUS_INNER, shape, shapes

SPACING = 0.05
PRIMITIVES = [name for name in shapes.names() if ":" not in name]


@pytest.mark.slow
@pytest.mark.parametrize("name", PRIMITIVES)
def test_particles_have_the_volume_of_the_solid(name: str) -> None:
    points = sample_particles(name, (1.0, 1.0, 1.0), SPACING, limit=None)
    low, high = shape(name).bounds
    assert points.dtype == np.float32 and points.shape[1] == 3
    assert len(points) * SPACING**3 == pytest.approx(shape(name).volume, rel=0.07)
    assert (points >= low - 1e-6).all() and (points <= high + 1e-6).all()


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", shapes.names())
@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_no_matter_is_far_from_every_particle(name: str, scale: float) -> None:
    """Every corner of the solid has a particle near, so that thin walls are closed."""
    points = sample_particles(name, (scale,) * 3, SPACING, limit=None)
    mesh = shape(name).mesh.moved(scale)
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    distance, _ = cKDTree(points).query(np.concatenate([mesh.vertices, middles]))
    # Beyond the reach lies what a cell's centre is away from its corner, and what a lattice of
    # whole spacings leaves of the bounds.
    assert distance.max() <= SPACING * (REACH + np.sqrt(3) / 8 + np.sqrt(3) / 4)


@pytest.mark.parametrize(("name", "inner"), [("torus", TORUS_INNER), ("pipe", PIPE_INNER)])
def test_holes_stay_open(name: str, inner: float) -> None:
    points = sample_particles(name, (1.0, 1.0, 1.0), SPACING)
    assert np.hypot(points[:, 0], points[:, 1]).min() > inner - SPACING


def test_a_bowl_holds_nothing() -> None:
    points = sample_particles("bowl", (1.0, 1.0, 1.0), SPACING)
    inside = (np.hypot(points[:, 0], points[:, 1]) < 0.25) & (points[:, 2] > 0.15)
    assert not inside.any() and (points[:, 2] < 0.05).any()


@pytest.mark.parametrize("scale", [(1.0, 1.0, 0.01), (0.01, 0.01, 1.0), (0.01, 0.01, 0.01)])
def test_thin_bodies_have_one_layer(scale: tuple[float, float, float]) -> None:
    points = sample_particles("cube", scale, SPACING)
    assert len(points) == np.prod([max(round(side / SPACING), 1) for side in scale])
    middle = np.array([0, 0, scale[2] / 2])
    thin = np.array(scale) < SPACING
    np.testing.assert_allclose(points[:, thin], np.tile(middle[thin], (len(points), 1)), atol=1e-7)


def test_large_bodies_are_thinned_evenly_and_alike() -> None:
    everything = sample_particles("cube", (2.0, 2.0, 2.0), SPACING, limit=None)
    some = sample_particles("cube", (2.0, 2.0, 2.0), SPACING)
    assert len(everything) == 64_000 and len(some) == LIMIT
    assert {tuple(p) for p in some.tolist()} <= {tuple(p) for p in everything.tolist()}
    assert len(np.unique(some, axis=0)) == LIMIT
    np.testing.assert_allclose(some.mean(axis=0), everything.mean(axis=0), atol=0.05)
    np.testing.assert_array_equal(some, sample_particles("cube", (2.0, 2.0, 2.0), SPACING))
    some[:] = 0
    assert sample_particles("cube", (2.0, 2.0, 2.0), SPACING).any(), "callers share one array"


def test_parts_that_overlap_are_solid_where_they_do() -> None:
    """An even-odd count of crossings would leave a hole in the overlap."""
    mesh = merge([box((0.0, 0, 0), (0.5, 0.5, 0.5)), box((0.4, 0, 0), (0.5, 0.5, 0.5))])
    cells = inside_cells(mesh, np.array([-1.0, -1.0, -1.0]), (20, 20, 20), 0.1)
    assert cells.sum() == 14 * 10 * 10 and cells[5:19, 5:15, 5:15].all()


def test_bad_arguments_say_so() -> None:
    with pytest.raises(UnknownNameError, match="cube"):
        sample_particles("cubes", (1.0, 1.0, 1.0))
    with pytest.raises(BadInputError, match="above 0"):
        sample_particles("cube", (1.0, 1.0, 1.0), 0.0)
    with pytest.raises(BadInputError, match="use a larger one"):
        sample_particles("cube", (1.0, 1.0, 1.0), 0.001)


def _turning_scene() -> tuple[Scene, Trajectory]:
    """A long box that is moved up and then turned by a right angle about z, under a cloth."""
    scene = Scene(
        name="turn",
        scenario="drape",
        bodies=(
            Body("plank", "cube", (0.0, 0.0, 0.0), scale=(0.4, 0.1, 0.1)),
            Body("vase", "prop:vase", (3.0, 0.0, 0.0), scenery=True),
            Body("ball", "sphere", (2.0, 0.0, 0.0), scale=(0.3, 0.3, 0.3)),
        ),
        cloths=(Cloth("sheet", (0.0, 0.0, 2.0), resolution=3),),
        roles=Roles("sheet", "plank"),
        camera=Camera((3.0, 0.0, 1.0)),
    )
    positions = np.zeros((3, 3, 3), np.float32)
    positions[1:, 0, 2] = 1.0
    rotations = np.tile(np.array([1.0, 0, 0, 0], np.float32), (3, 3, 1))
    rotations[2, 0] = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    still = np.zeros((3, 3, 3), np.float32)
    cloth = np.arange(3 * 9 * 3, dtype=np.float32).reshape(3, 9, 3)
    none = np.full(3, np.nan, np.float32)
    moved = Trajectory(
        positions, rotations, still, still, cloth, none, Contacts.empty(), True, "by hand"
    )
    return scene, moved


def test_particles_move_with_their_bodies() -> None:
    scene, trajectory = _turning_scene()
    cloud = particles_over_time(scene, trajectory)
    plank = sample_particles("cube", (0.4, 0.1, 0.1), default_spacing(scene))
    mine = cloud.positions[:, cloud.things == 0]
    np.testing.assert_allclose(mine[0], plank, atol=1e-6)
    np.testing.assert_allclose(mine[1], plank + np.array([0, 0, 1]), atol=1e-6)
    turned = np.stack([-plank[:, 1], plank[:, 0], plank[:, 2] + 1], axis=1)
    np.testing.assert_allclose(mine[2], turned, atol=1e-6)
    np.testing.assert_array_equal(cloud.positions[:, cloud.things == 3], trajectory.cloth_vertices)
    assert sorted(set(cloud.things.tolist())) == [0, 2, 3], "scenery takes no part"


def test_spacing_is_finer_with_cloth() -> None:
    scene, _ = _turning_scene()
    assert default_spacing(scene) == 0.035
    assert (
        default_spacing(dataclasses.replace(scene, cloths=(), roles=Roles("ball", "plank"))) == 0.05
    )


def test_frames_can_be_chosen() -> None:
    scene, trajectory = _turning_scene()
    some = particles_over_time(scene, trajectory, frames=[2, 0])
    every = particles_over_time(scene, trajectory)
    np.testing.assert_array_equal(some.positions, every.positions[[2, 0]])
    assert some.frames.tolist() == [2, 0]
    with pytest.raises(BadInputError, match=r"0\.\.2"):
        particles_over_time(scene, trajectory, frames=[3])
