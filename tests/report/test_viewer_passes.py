"""Passes as colours: what each colour means is what the docstrings say."""

from __future__ import annotations

import numpy as np
import pytest

from physion.rendering.renderer import PASSES, Frame
from physion.report.viewer.movies import (
    AGENT,
    NOWHERE,
    OTHERS,
    PATIENT,
    ROOM,
    paint,
    paint_depth,
    paint_flow,
    paint_ids,
    paint_normals,
    ranges_of,
)
from physion.scenes.looks import RED, YELLOW, is_mistakable
from support.viewer_dataset import PLANS, make_scene


def test_near_is_bright_and_nothing_is_dark() -> None:
    depth = np.array([[0.5, 1.0, 2.0, 3.0, 4.0, np.inf, np.nan]])
    light = paint_depth(depth, 1.0, 4.0).astype(int).sum(axis=2)[0]
    assert light[0] == light[1] > light[2] > light[3] > light[4] == light[5] == light[6]


def test_normals_are_world_axes_in_red_green_blue() -> None:
    axes = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, 0, 0]]], np.float32)
    expected = [(255, 128, 128), (128, 255, 128), (128, 128, 255), (0, 128, 128), (128, 128, 128)]
    assert paint_normals(axes)[0].tolist() == [list(color) for color in expected]


def test_ids_show_the_roles_and_nothing_else_in_red_and_yellow() -> None:
    scene = make_scene(PLANS[0])
    picture = paint_ids(np.array([[0, 1, 2, 3]], np.int16), scene)
    assert picture[0].tolist() == [list(c) for c in (ROOM, AGENT, PATIENT, OTHERS[2])]
    for color in (ROOM, *OTHERS):
        share = tuple(channel / 255 for channel in color)
        assert not is_mistakable(share, RED) and not is_mistakable(share, YELLOW)
    assert len(set(OTHERS)) == len(OTHERS)


def test_flow_is_direction_as_hue_and_speed_as_light() -> None:
    nan = np.nan
    flow = np.array([[[4, 0], [-4, 0], [1, 0], [400, 0], [0, 0], [nan, 1], [0, 4]]], np.float32)
    right, left, slow, fast, rest, unknown, down = paint_flow(flow, 4.0)[0].tolist()
    assert right == fast == [255, 0, 0] and left == [0, 255, 255] and slow == [128, 0, 0]
    assert rest == [0, 0, 0] and unknown == list(NOWHERE)
    assert down[1] == 255 and down[2] == 0 and 100 < down[0] < 150


def _frame(depth: float, flow: float) -> Frame:
    shape = (8, 8)
    return Frame(
        color=np.full((*shape, 3), 7, np.uint8),
        depth=np.full(shape, depth, np.float32),
        normals=np.zeros((*shape, 3), np.float32),
        ids=np.ones(shape, np.int16),
        flow=np.full((*shape, 2), flow, np.float32),
    )


def test_scales_hold_for_all_frames() -> None:
    ranges = ranges_of([_frame(2.0, 0.0), _frame(5.0, 3.0)])
    assert (ranges.near, ranges.far) == (2.0, 5.0)
    assert ranges.flow == pytest.approx(3.0 * np.sqrt(2))


def test_scales_are_never_empty() -> None:
    for depth in (np.inf, 2.0):
        ranges = ranges_of([_frame(depth, 0.0)])
        assert ranges.far > ranges.near and ranges.flow > 0
        assert np.isfinite([ranges.near, ranges.far, ranges.flow]).all()


def test_pictures_come_in_the_order_of_the_passes() -> None:
    frame, scene = _frame(2.0, 1.0), make_scene(PLANS[0])
    pictures = dict(zip(PASSES, paint(frame, scene, ranges_of([frame])), strict=True))
    assert all(picture.shape == (8, 8, 3) for picture in pictures.values())
    assert all(picture.dtype == np.uint8 for picture in pictures.values())
    assert pictures["color"][0, 0].tolist() == [7, 7, 7]
    assert pictures["ids"][0, 0].tolist() == list(AGENT)
    assert pictures["normals"][0, 0].tolist() == [128, 128, 128]
