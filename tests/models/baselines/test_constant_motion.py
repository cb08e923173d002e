"""Constant motion on scenes whose gaps are known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from physion.clips.batch import Motion
from physion.core.errors import BadInputError
from physion.models import build_model
from physion.models.baselines.motion import FAR, TOLERANCE, minimise
from physion.physics.cloth.simulate import ClothSettings
from physion.physics.cloth.solver import CLOTH_CONTACT_GAP
from physion.scenes.scene import Body, BodyEvent, Cloth, Roles, Vec3
from support.crossing_bodies import batch_of, crossing


def gap(motion: Motion, **options: Any) -> float:
    """Return the gap that the model imagines."""
    rollout = build_model("constant-motion", **options).imagine(batch_of([motion]), 1, 0)
    assert rollout.contact.tolist() == [[bool(rollout.gap[0, 0] <= 0)]]
    return float(rollout.gap[0, 0])


def test_gap_after_the_time_that_is_looked_ahead() -> None:
    # Unit cubes, centres 5 m apart, approaching at 2 m/s.
    assert gap(crossing(), frames=106) == pytest.approx(5 - 1 - 2 * 1.06, abs=TOLERANCE)
    assert gap(crossing(), frames=199) == pytest.approx(0.02, abs=TOLERANCE)
    assert gap(crossing(), frames=201) == 0


@pytest.mark.parametrize(
    ("start", "expected"),
    [((0.0, 1.5, 0.0), 0.5), ((0.0, 0.9, 0.0), 0.0), ((0.0, 1.3, 1.4), 0.5)],
)
def test_gap_when_cubes_pass_each_other(start: Vec3, expected: float) -> None:
    motion = crossing(agent=start, velocity=(8.0, 0.0, 0.0), patient=(5.0, 0.0, 0.0))
    assert gap(motion) == pytest.approx(expected, abs=TOLERANCE)


def test_balls_on_a_collision_course_touch_and_others_miss_by_the_known_gap() -> None:
    def passing(sideways: float) -> float:
        return gap(crossing(shape="sphere", agent=(0.0, sideways, 0.0), velocity=(8.0, 0.0, 0.0)))

    assert passing(0.0) == passing(0.7) == 0
    # The hull of a ball lies inside it, by at most r (1 - cos(pi / 16)) = .0096 m.
    assert 1.4 - 1 - TOLERANCE <= passing(1.4) <= 1.4 - 1 + 2 * 0.0096 + TOLERANCE


def test_bodies_that_part_have_their_gap_now() -> None:
    motion = crossing(velocity=(-2.0, 0.0, 0.0), patient=(1.75, 0.0, 0.0))
    assert gap(motion) == pytest.approx(0.75, abs=TOLERANCE)


@pytest.mark.parametrize("height", [0.0, 0.8])
def test_spinning_bodies_sweep_with_their_corners(height: float) -> None:
    # Bars of 2 x .2 x .2 m: the corners of the spinning one pass the long side of the other.
    motion = crossing(
        scale=(2.0, 0.2, 0.2), velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 3.0),
        patient=(0.0, 1.6, height),
    )  # fmt: skip
    sideways, above = 1.6 - 0.1 - math.hypot(1, 0.1), max(height - 0.2, 0.0)
    assert gap(motion) == pytest.approx(math.hypot(sideways, above), abs=TOLERANCE)


def test_bodies_spin_about_their_centre_of_mass() -> None:
    # A cube of 1 m spins about x, and stays where it is; its pivot is at its bottom.
    motion = crossing(
        velocity=(0.0, 0.0, 0.0), spin=(5.0, 0.0, 0.0), patient=(0.0, 0.0, 3.0), scale=(1, 1, 1)
    )
    assert gap(motion) == pytest.approx(3 - 0.5 - math.sqrt(0.5), abs=TOLERANCE)


def test_fast_bodies_do_not_jump_over_thin_ones() -> None:
    thin = (0.01, 1.0, 1.0)
    motion = crossing(scale=thin, velocity=(97.0, 0.0, 0.0), patient=(5.3, 0.0, 0.0))
    assert gap(motion) == 0


def test_nothing_but_the_velocity_counts() -> None:
    """A body in the air does not fall, and a wall in between stops nothing."""
    bodies = (
        Body("agent", "cube", (0, 0, 4)),
        Body("patient", "cube", (3, 0, 0)),
        Body("wall", "cube", (1.5, 0, 0), (0.1, 9.0, 9.0), kinematic=True),
    )
    still = crossing(agent=(0.0, 0.0, 4.0), velocity=(0.0, 0.0, 0.0), bodies=bodies)
    assert gap(still) == pytest.approx(math.hypot(2, 3), abs=TOLERANCE)
    moving = crossing(agent=(0.0, 0.0, 0.0), velocity=(4.0, 0.0, 0.0), bodies=bodies)
    assert gap(moving) == 0


def test_a_contact_that_was_seen_is_a_touch() -> None:
    assert gap(crossing(touch=(10,))) == 0
    assert gap(crossing(touch=(45,))) > 0


def test_gaps_are_finite_where_there_is_nothing_to_touch() -> None:
    assert gap(crossing(patient=(50.0, 0.0, 0.0))) == FAR
    events = (BodyEvent(50, "patient", "appear"),)
    assert gap(crossing(patient=(1.2, 0.0, 0.0), events=events)) == FAR
    sheets = (Cloth("one", (0, 0, 1), resolution=2), Cloth("two", (0, 0, 1), resolution=2))
    assert gap(crossing(cloths=sheets, roles=Roles("one", "two"))) == FAR


def falling_sheet(speed: float, roles: Roles) -> Motion:
    """Return a level sheet 2 m above the top of a cube, falling with ``speed`` in m/s."""
    sheet = Cloth("sheet", (5, 0, 3), resolution=21)
    motion = crossing(cloths=(sheet,), roles=roles, velocity=(0.0, 0.0, 0.0))
    steps = np.linspace(-1, 1, 21)
    x, y = np.meshgrid(steps + 5, steps, indexing="ij")
    vertices = np.zeros((60, 441, 3), np.float32)
    vertices[..., 0], vertices[..., 1] = x.ravel(), y.ravel()
    vertices[..., 2] = 3 - speed * 0.01 * (np.arange(60)[:, None] - 44)
    return Motion(motion.scene, replace(motion.trajectory, cloth_vertices=vertices))


@pytest.mark.parametrize("roles", [Roles("sheet", "patient"), Roles("patient", "sheet")])
def test_cloth_touches_by_the_rule_of_the_label(roles: Roles) -> None:
    settings = ClothSettings()
    thickness = settings.rest_distance + CLOTH_CONTACT_GAP
    # The particles of a cube end within a spacing of its top.
    inside = settings.particle_spacing
    still = gap(falling_sheet(0.0, roles))
    assert 2 - thickness <= still <= 2 - thickness + inside
    # From one sheet to the next all else is equal: a second at 1 m/s is 1 m less.
    assert still - gap(falling_sheet(1.0, roles), frames=100) == pytest.approx(1, abs=2e-3)
    assert gap(falling_sheet(2.0, roles), frames=100) == 0


def test_samples_are_equal_and_the_seed_is_not_used() -> None:
    batch = batch_of([crossing(), crossing(agent=(1.0, 0.0, 0.0))])
    rollout = build_model("constant-motion").imagine(batch, 3, 0)
    assert rollout.gap.shape == rollout.contact.shape == (2, 3)
    assert (rollout.gap == rollout.gap[:, :1]).all() and rollout.gap[0, 0] != rollout.gap[1, 0]
    assert rollout.gap.dtype == np.float64 and rollout.contact.dtype == np.bool_
    assert (build_model("constant-motion").imagine(batch, 3, 1).gap == rollout.gap).all()


def test_minimum_of_a_function_is_found_between_frames() -> None:
    assert minimise(lambda t: abs(t - 0.0237) + 0.1, 1, 10) == pytest.approx(0.1, abs=TOLERANCE)
    # As steep as the bound allows, between two frames.
    assert minimise(lambda t: abs(100 * t - 5.5), 100, 10) == pytest.approx(0, abs=TOLERANCE)
    parabola = minimise(lambda t: 3 * (t - 0.055) ** 2 + 0.2, 1, 10)
    assert parabola == pytest.approx(0.2, abs=TOLERANCE)


def test_search_ends_at_a_touch() -> None:
    times: list[float] = []

    def value(seconds: float) -> float:
        times.append(seconds)
        return 0.05 - seconds

    assert minimise(value, 1000, 10) < 0
    assert len(times) == 11


@pytest.mark.parametrize("frames", [0, -1])
def test_at_least_one_frame_is_looked_ahead(frames: int) -> None:
    with pytest.raises(BadInputError, match="frames must be at least 1"):
        build_model("constant-motion", frames=frames)
