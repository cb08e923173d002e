"""Objects in pictures: grouping, following over time, and the trained network on new scenes."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from physion.clips.batch import Motion
from physion.clips.rendered import MotionRenderer
from physion.models.baselines.pixels import color_masks
from physion.models.segmentation import (
    CLASSES,
    OFFSET,
    SIDE,
    follow,
    group,
    painted,
    roles_by_color,
    segment,
)
from physion.physics.engine import simulate
from physion.scenes.sampling.sample import sample_scene

DRAWN = np.array([0, 1, 2, 3, 3, 3], np.uint8)
"""Class of each object of `layout`."""


def layout() -> Any:
    """Agent, patient, two boxes side by side, and one below."""
    ids = np.zeros((SIDE, SIDE), np.uint8)
    ids[10:30, 10:20], ids[60:70, 50:90] = 1, 2
    ids[20:40, 40:52], ids[20:40, 52:70], ids[40:56, 45:60] = 3, 4, 5
    return ids


def outputs(ids: Any) -> tuple[Any, Any]:
    """What a network without error gives: logits, and offsets to the centres."""
    kinds = DRAWN[ids]
    logits = np.stack([(kinds == kind) * 1.0 for kind in range(len(CLASSES))])
    rows, columns = (np.indices(ids.shape) + 0.5) / SIDE
    offsets = np.zeros((2, *ids.shape))
    for number in np.unique(ids):
        mask = ids == number
        offsets[0][mask] = OFFSET * (columns[mask].mean() - columns[mask])
        offsets[1][mask] = OFFSET * (rows[mask].mean() - rows[mask])
    return logits, offsets


def same_parts(found: Any, ids: Any) -> bool:
    """Whether two pictures have the same objects, whatever their numbers."""
    pairs = set(zip(found.ravel().tolist(), ids.ravel().tolist(), strict=True))
    return len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


def test_objects_that_touch_are_separated_by_their_centres() -> None:
    ids = layout()
    found = group(*outputs(ids))
    assert same_parts(found, ids)
    assert ((found == 1) == (ids == 1)).all() and ((found == 2) == (ids == 2)).all()
    # Errors of half a cell change nothing but single pixels.
    logits, offsets = outputs(ids)
    noise = np.random.default_rng(0).normal(0, OFFSET * 0.005, offsets.shape)
    noisy = group(logits, offsets + noise)
    for number in (3, 4, 5):
        mask = ids == number
        most = np.bincount(noisy[mask]).argmax()
        assert np.mean(noisy[mask] == most) > 0.95
    nothing = np.zeros((SIDE, SIDE), np.uint8)
    assert not group(*outputs(nothing)).any()
    speck = nothing.copy()
    speck[5, 5:8] = 3
    assert not group(*outputs(speck)).any(), "three pixels are no object"


def test_objects_keep_their_numbers_over_time() -> None:
    frames = np.zeros((8, SIDE, SIDE), np.uint8)
    for time, picture in enumerate(frames):
        first, second = (3, 4) if time % 2 else (4, 3)  # numbers of single pictures mean nothing
        picture[10:18, 5 + 8 * time : 13 + 8 * time] = first
        if time not in (3, 4):  # hidden
            picture[60:80, 20:30] = second
        if time >= 6:
            picture[40:50, 80:90] = 5
        picture[90:95, 0:9] = 1
    found = follow(frames)
    moving = {int(found[t, 12, 8 + 8 * t]) for t in range(8)}
    resting = {int(found[t, 70, 25]) for t in (0, 1, 2, 5, 6, 7)}
    later = {int(found[t, 45, 85]) for t in (6, 7)}
    assert len(moving) == len(resting) == len(later) == 1
    assert len(moving | resting | later) == 3 and min(moving | resting | later) >= 3
    assert (found[:, 92, 4] == 1).all() and ((found > 0) == (frames > 0)).all()
    assert follow(np.zeros((2, 4, 4), np.uint8)).shape == (2, 4, 4)


def test_a_hidden_object_is_expected_where_its_motion_leads() -> None:
    frames = np.zeros((8, SIDE, SIDE), np.uint8)
    for time in (0, 1, 2, 5, 6, 7):  # hidden in 3 and 4
        frames[time, 10:18, 5 + 8 * time : 13 + 8 * time] = 3
    found = follow(frames)
    assert {int(found[t, 12, 8 + 8 * t]) for t in (0, 1, 2, 5, 6, 7)} == {3}


def test_an_object_that_vanishes_takes_no_other_ones_place() -> None:
    frames = np.zeros((2, SIDE, SIDE), np.uint8)
    frames[:, 10:20, 10:20] = 3
    frames[0, 70:80, 70:80] = 4
    frames[1, 10:20, 10:20] = 0
    frames[1, 10:20, 14:24], frames[1, 40:50, 40:50] = 5, 3
    found = follow(frames)
    assert found[0, 15, 15] == found[1, 15, 18] == 3
    assert found[0, 75, 75] == 4 and found[1, 45, 45] == 5


def test_equal_votes_of_neighbours_are_one_object() -> None:
    ids = np.zeros((SIDE, SIDE), np.uint8)
    ids[40:44, 40:44] = 3
    logits, offsets = outputs(ids)
    assert np.unique(group(logits, offsets)).tolist() == [0, 3]
    # Half of the pixels point to one cell, half to the next one.
    rows, columns = np.nonzero(ids)
    offsets[1][ids > 0] = OFFSET * (0.4 - (rows + 0.5) / SIDE)
    offsets[0][ids > 0] = OFFSET * ((20.5 + (columns % 2)) / 48 - (columns + 0.5) / SIDE)
    assert np.unique(group(logits, offsets)).tolist() == [0, 3]


@pytest.mark.parametrize("scenario", ["support", "drop", "collide"])
def test_the_trained_network_finds_the_objects_of_new_scenes(scenario: str) -> None:
    scene = sample_scene(scenario, 7003)
    motion = Motion(scene, simulate(scene, frames=45))
    looks, frames = {"new": "redyellow"}, np.array([2, 23, 44])
    drawn = MotionRenderer({"new": motion}, ("rgb", "ids"), SIDE, 1, looks).read("new", frames)
    found, true = segment(drawn["rgb"]), drawn["ids"]
    assert found.shape == true.shape and found.dtype == np.uint8
    for ours, theirs in ((found == 1, true == 1), (found == 2, true == 2), (found > 0, true > 0)):
        assert (ours & theirs).sum() > 0.75 * (ours | theirs).sum()
    # Other objects of the first frame are found one by one.
    numbers = [n for n in np.unique(true[0]) if n > 2 and (true[0] == n).sum() >= 30]
    own = [int(np.bincount(found[0][true[0] == n]).argmax()) for n in numbers]
    assert min(own, default=3) >= 3 and len(set(own)) >= 0.7 * len(own)


@pytest.mark.parametrize("scenario", ["dominoes", "drop", "collide"])
def test_a_cue_in_the_first_frame_is_enough_in_any_colors(scenario: str) -> None:
    scene = sample_scene(scenario, 7003)
    motion = Motion(scene, simulate(scene, frames=45))
    reader = MotionRenderer({"new": motion}, ("rgb", "ids"), SIDE, 1, {"new": "free"})
    drawn = reader.read("new", np.arange(2, 45, 3))
    true = drawn["ids"]
    found = segment(drawn["rgb"], true[0])
    for role in (1, 2):
        shared = ((found == role) & (true == role)).sum((1, 2))
        either = ((found == role) | (true == role)).sum((1, 2))
        assert shared.sum() > 0.75 * either.sum() and shared.min() > 20
    assert ((found > 2) & (true > 2)).sum() > 0.5 * (true > 2).sum()
    # A cue that says the opposite is believed, and without one nobody is agent or patient.
    exchanged = np.select([true[0] == 1, true[0] == 2], [2, 1], 0).astype(np.uint8)
    other = segment(drawn["rgb"], exchanged)
    for role in (1, 2):
        assert np.array_equal(other == 3 - role, found == role)
    assert not np.isin(segment(drawn["rgb"], np.zeros_like(true[0])), (1, 2)).any()


def test_agent_and_patient_are_what_has_their_colors_in_the_first_picture() -> None:
    rgb = np.full((2, 8, 8, 3), 120, np.uint8)
    rgb[0, 1:4, 1:4], rgb[0, 5:8, 5:8] = (20, 60, 200), (30, 160, 40)
    rgb[1, 2:5, 4:7], rgb[1, 6:8, 0:3] = (25, 66, 210), (28, 150, 38)  # moved, in other light
    rgb[:, 0, 7] = (200, 10, 10)  # red, and nothing
    cue = np.zeros((8, 8), np.uint8)
    cue[1:4, 1:4], cue[5:8, 5:8], cue[0, 0] = 1, 2, 9
    roles = roles_by_color(rgb, cue)
    assert np.array_equal(roles[0], np.where(cue < 3, cue, 0))
    assert (roles[1, 2:5, 4:7] == 1).all() and (roles[1, 6:8, 0:3] == 2).all()
    assert (roles[1] > 0).sum() == 15
    red, yellow = color_masks(painted(rgb, roles))
    assert np.array_equal(red, roles == 1) and np.array_equal(yellow, roles == 2)


def test_weights_have_a_card_and_are_small() -> None:
    folder = files("physion.data.segmentation")
    assert len(folder.joinpath("segmentation.safetensors").read_bytes()) < 1_000_000
    card = folder.joinpath("segmentation.md").read_text()
    assert "train_segmentation.py" in card and "intersection over union" in card
