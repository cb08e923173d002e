"""What the viewer shows: the right frames and colours of passes and imagined trials, few bytes."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from physion.clips.batch import ImaginedTrial
from physion.core.errors import BadInputError
from physion.rendering.renderer import PASSES, Frame
from physion.report.viewer.build import ViewerOptions, build_viewer
from physion.report.viewer.imagined import REACH, ROWS, SIDE, SLOTS, STEPS, caption, pack_imagined
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
from support.viewer_dataset import PLANS, make_dataset, make_scene

SCENE = make_scene(PLANS[0])
"""Ball (agent), plate (patient, kinematic) and a vase (scenery)."""
SEEN, LATER = np.array([0, 6, 12]), np.array([18, 24, 30, 36])


def greys(frames: np.ndarray, side: int = 16, add: int = 0) -> np.ndarray:
    """Pictures whose grey is twice the number of their frame, plus ``add``."""
    values = (2 * frames + add).astype(np.uint8)[:, None, None, None]
    return np.broadcast_to(values, (len(frames), side, side, 3)).copy()


def imagined(**changes: Any) -> ImaginedTrial:
    one = ImaginedTrial(
        "painter",
        "untrained, weights random",
        LATER,
        shown={"rgb": greys(LATER, add=100)},
        seen_frames=SEEN,
        seen={"rgb": greys(SEEN)},
        true={"rgb": greys(LATER)},
    )
    return dataclasses.replace(one, **changes)


def packed(one: ImaginedTrial, length: int = 60) -> dict[str, Any]:
    record: dict[str, Any] = pack_imagined(one, SCENE, length)["pictures"]
    return record


def pictures(sheet: dict[str, Any]) -> np.ndarray:
    """The pictures of a sheet (rows, each, H, W, 3), as the page cuts them out."""
    image = np.asarray(Image.open(io.BytesIO(base64.b64decode(sheet["data"]))).convert("RGB"))
    width, height, columns = sheet["width"], sheet["height"], sheet["columns"]
    cut = [
        image[top * height : (top + 1) * height, left * width : (left + 1) * width]
        for top, left in (divmod(place, columns) for place in range(sheet["rows"] * sheet["each"]))
    ]
    return np.stack(cut).reshape(sheet["rows"], sheet["each"], height, width, 3).astype(int)


def test_seen_true_and_imagined_pictures_keep_their_frames() -> None:
    record = packed(imagined())
    assert record["frames"] == [0, 6, 12, 18, 24, 30, 36] and record["seen"] == 3
    assert (record["true"]["first"], record["imagined"]["first"]) == (0, 3)
    true = pictures(record["true"])[:, 0].mean(axis=(1, 2, 3))
    assert true == pytest.approx(2 * np.array(record["frames"]), abs=2)
    later = pictures(record["imagined"])[:, 0].mean(axis=(1, 2, 3))
    assert later == pytest.approx(2 * LATER + 100, abs=2)


def test_frames_after_the_trial_are_left_out() -> None:
    record = packed(imagined(), 31)
    assert record["frames"] == [0, 6, 12, 18, 24, 30]
    assert record["true"]["rows"] == 6 and record["imagined"]["rows"] == 3
    with pytest.raises(BadInputError, match="no imagined frame lies within the 18 of the trial"):
        packed(imagined(), 18)


def test_boxes_that_are_not_known_are_left_out() -> None:
    seen, shown = np.full((3, 2, 4), 0.25, np.float32), np.full((4, 2, 4), 0.5, np.float32)
    seen[1, 1, 2] = np.nan
    shown[:, 0] = np.nan
    shown[3, 1] = (-9, 0.1, 0.2, 9)
    one = imagined(shown={"boxes": shown}, seen={"rgb": greys(SEEN), "boxes": seen})
    boxes = packed(one)["boxes"]
    assert boxes[0] == [[0.25] * 4] * 2 and boxes[1] == [[0.25] * 4, None]
    assert boxes[3] == [None, [0.5] * 4] and boxes[6] == [None, [-1, 0.1, 0.2, 2]]
    assert "imagined" not in packed(one)


def test_masks_are_coloured_over_the_picture_in_grey() -> None:
    masks = np.zeros((4, 2, 16, 16), np.float32)
    masks[:, 0, :, :8] = 1
    masks[:, 1, :, 8:] = 1
    record = packed(imagined(shown={"rgb": greys(LATER, add=100), "masks": masks}))
    sheet = record["masks"]
    assert (sheet["first"], sheet["each"], sheet["rows"]) == (3, 2, 4)
    first, second = pictures(sheet)[0]
    colored = [np.ptp(half.mean(axis=(0, 1))) for half in (first[:, :6], first[:, 10:])]
    assert colored[0] > 30 and colored[1] < 8
    assert first[:, 10:].mean() == pytest.approx(0.4 * (2 * 18 + 100), abs=4)
    assert np.abs(first[:, :6].mean(axis=(0, 1)) - second[:, 10:].mean(axis=(0, 1))).max() > 20


def test_masks_of_seen_frames_may_be_smaller_and_without_others() -> None:
    masks = np.full((3, 5, 4, 4), 0.5, np.float32)
    slots = np.zeros((4, 5, 3), np.float32)
    seen = {"rgb": greys(SEEN), "masks": masks, "slots": np.zeros((3, 5, 3), np.float32)}
    sheet = packed(imagined(shown={"slots": slots}, seen=seen))["masks"]
    assert (sheet["first"], sheet["rows"], sheet["each"], sheet["width"]) == (0, 3, 5, 16)


def test_change_of_slots_counts_from_the_last_frame_that_was_seen() -> None:
    seen, shown, true = (np.zeros((n, 2, 4), np.float32) for n in (3, 4, 4))
    seen[0, 1], seen[2] = 3, 1
    shown[:] = 1
    shown[3, 0] += (3, 4, 0, 0)
    true[:] = 2
    one = imagined(
        shown={"slots": shown}, seen={"rgb": greys(SEEN), "slots": seen}, true={"slots": true}
    )
    changes = packed(one)["changes"]
    assert changes["imagined"][0] == [2, 4] and changes["imagined"][2] == [0, 0]
    assert changes["imagined"][3:] == [[0, 0]] * 3 + [[5, 0]]
    assert changes["true"][:3] == changes["imagined"][:3]
    assert changes["true"][3:] == [[2, 2]] * 4
    with pytest.raises(BadInputError, match=r"slots differ .* \(4, 3, 4\)"):
        packed(dataclasses.replace(one, shown={"slots": np.zeros((4, 3, 4))}))


@pytest.mark.nightly
@pytest.mark.slow
def test_large_pictures_take_less_than_a_megabyte() -> None:
    frames = np.arange(45, 300)
    noise = np.random.default_rng(0).integers(0, 256, (64, 40, 40, 3), np.uint8)
    row = np.arange(len(frames)) % len(noise)
    rgb = noise[row].repeat(5, axis=1).repeat(5, axis=2)
    masks = np.random.default_rng(1).random((len(frames), 20, 64, 64), np.float32)
    one = ImaginedTrial("painter", "none", frames, {"rgb": rgb, "masks": masks}, true={"rgb": rgb})
    record = packed(one, 300)
    assert len(record["frames"]) == ROWS
    assert record["frames"][0] == 45 and record["frames"][-1] == 299
    assert record["true"]["width"] == SIDE and record["masks"]["each"] == SLOTS
    assert len(json.dumps(record)) < 1_000_000


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("rgb", greys(LATER).astype(np.float32), r"rgb must be .* of 4 frames, not float"),
        ("rgb", greys(SEEN), r"of 4 frames, not uint8 \(3, 16, 16, 3\)"),
        ("boxes", np.zeros((4, 2, 3)), r"boxes must be \(frames, objects, 4\)"),
        ("masks", np.zeros((4, 16, 16)), r"masks must be \(frames, slots, height, width\)"),
        ("slots", np.zeros((4, 16)), r"slots must be \(frames, slots, values\)"),
    ],
)
def test_wrong_arrays_are_refused(name: str, values: np.ndarray, message: str) -> None:
    with pytest.raises(BadInputError, match=f"model 'painter', trial 'drop_0': .*{message}"):
        packed(imagined(shown={name: values}))


# --- particles ----------------------------------------------------------------------------------


def falling(frames: int = 6, count: int = 4, stride: int = 3, **changes: Any) -> ImaginedTrial:
    """Particles of the ball that fall 1 cm a frame, and of a plate that stays at height 0."""
    at = 44 + stride * np.arange(1, frames + 1)
    positions = np.zeros((frames, 2 * count, 3), np.float32)
    positions[:, :, 0] = np.arange(2 * count)
    positions[:, count:, 2] = 1 - 0.01 * (at[:, None] - 44)
    things = np.repeat([1, 0], count)
    shown = {"particles": positions, "things": things}
    return dataclasses.replace(ImaginedTrial("sim", "weights random", at, shown), **changes)


def unpack(packed: dict[str, Any]) -> np.ndarray:
    grid = packed["particles"]["points"]
    steps = np.frombuffer(base64.b64decode(grid["data"]), "<u2").reshape(-1, 3)
    points = np.array(grid["low"]) + steps / STEPS * np.array(grid["size"])
    return points.reshape(len(packed["particles"]["frames"]), -1, 3)


def test_particles_are_sorted_by_object_and_keep_their_positions() -> None:
    packed = pack_imagined(falling(), SCENE, 60)
    assert packed["particles"]["groups"] == [
        {"role": "agent", "first": 0, "count": 4},
        {"role": "patient", "first": 4, "count": 4},
    ]
    # The last row lies past the last frame, 59, so that frames 57 to 59 are between two.
    assert packed["particles"]["frames"] == [47, 50, 53, 56, 59]
    assert packed["particles"]["from"] == 45
    points = unpack(packed)
    assert points[:, :4, 2] == pytest.approx(
        np.repeat(1 - 0.01 * np.array([[3], [6], [9], [12], [15]]), 4, axis=1), abs=1e-4
    )
    assert np.abs(points[:, 4:, 2]).max() < 1e-4
    assert points[0, :, 0] == pytest.approx([4, 5, 6, 7, 0, 1, 2, 3], abs=1e-3)


def test_the_row_after_the_last_frame_is_kept_and_no_later_one() -> None:
    assert pack_imagined(falling(), SCENE, 55)["particles"]["frames"] == [47, 50, 53, 56]
    assert pack_imagined(falling(), SCENE, 46)["particles"]["frames"] == [47]


def showing(**arrays: np.ndarray) -> ImaginedTrial:
    """Return the falling particles with other arrays."""
    return falling(shown={**falling().shown, **arrays})


def test_absent_particles_and_bodies_that_cannot_move_are_left_out() -> None:
    one = showing(things=np.array([-1, 1, 1, 1, 0, 0, 0, 0]))
    groups = pack_imagined(one, SCENE, 60)["particles"]["groups"]
    assert [group["count"] for group in groups] == [4, 3]
    bodies = tuple(dataclasses.replace(body, kinematic=True) for body in SCENE.bodies)
    one = showing(things=np.array([2, 2, 1, 1, 0, 0, 0, 0]))
    groups = pack_imagined(one, dataclasses.replace(SCENE, bodies=bodies), 60)["particles"][
        "groups"
    ]
    assert [group["role"] for group in groups] == ["agent", "patient"]


def test_rows_that_are_not_finite_end_the_motion_and_lost_objects_do_not_coarsen_it() -> None:
    positions = falling().shown["particles"].copy()
    positions[3, 7] = 1e6
    assert unpack(pack_imagined(showing(particles=positions), SCENE, 60)).max() == (
        pytest.approx(REACH)
    )
    positions[2, 5, 1] = np.nan
    packed = pack_imagined(showing(particles=positions), SCENE, 60)
    assert packed["particles"]["frames"] == [47, 50]


def test_many_particles_take_less_than_a_megabyte() -> None:
    packed = pack_imagined(falling(frames=258, count=5000, stride=1), SCENE, 302)
    assert len(json.dumps(packed)) < 1_000_000
    frames, groups = packed["particles"]["frames"], packed["particles"]["groups"]
    assert frames[0] == 45 and frames[-1] == 301 and len(frames) > 60
    assert [group["count"] for group in groups] == [750, 750]
    points = unpack(packed)
    assert points[:, 0, 2] == pytest.approx(1 - 0.01 * (np.array(frames) - 44), abs=1e-3)


@pytest.mark.parametrize(
    ("one", "words"),
    [
        (showing(things=np.zeros(3, np.int64)), r"here \(6, 3, 3\), not \(6, 8, 3\)"),
        (showing(things=np.full(8, 3)), "things objects of the scene"),
        (falling(shown={"smell": np.zeros(1)}), "'sim' imagined nothing that the viewer shows"),
        (showing(particles=np.full((6, 8, 3), np.inf)), "no particle with a finite position"),
    ],
)
def test_wrong_particles_are_refused(one: ImaginedTrial, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        pack_imagined(one, SCENE, 60)


def test_the_caption_says_what_is_known() -> None:
    assert caption(falling()) == "sim (weights random)."
    assert caption(falling(probability=1.0, gap=-0.004)) == (
        "sim (weights random): P(contact) 1.00; smallest gap -0.004 m, 0 or less is a contact."
    )
    text = caption(falling(probability=1.0, gap=-10.0), observed=True)
    assert text == "sim (weights random): P(contact) 1.00; the contact was already observed."
    text = caption(falling(probability=0.25, gap=0.5, futures=8))
    assert "P(contact) 0.25 from 8 futures; smallest gap of the one shown 0.500 m" in text


def test_only_detailed_trials_are_imagined_once(tmp_path: Path) -> None:
    folder = make_dataset(tmp_path / "set", PLANS[:3])
    asked = []

    def imagine(trials: Any) -> dict[str, list[ImaginedTrial]]:
        asked.append(list(trials))
        falls = falling(probability=1.0, gap=-10.0)
        return {trials[0]: [falls, falling(model="other", frames=3)], trials[1]: [falls]}

    options = ViewerOptions(details=2, card_size=32, pass_size=32, stride=6)
    page = build_viewer(folder, tmp_path / "v.html", options, imagine=imagine).page
    assert asked == [["drop_0", "drop_2"]]
    blocks = re.findall(r'id="detail-(\d)">(.*?)</script>', page.read_text())
    details = {int(number): json.loads(text) for number, text in blocks}
    assert [one["model"] for one in details[0]["imagined"]] == ["sim", "other"]
    assert "imagined" not in details[1]
    # They touched in frame 20 of drop_2, and in frame 50 of drop_0.
    assert "smallest gap -10.000 m" in details[0]["imagined"][0]["caption"]
    assert details[2]["imagined"][0]["caption"].endswith("the contact was already observed.")


# --- passes of the renderer as colours ----------------------------------------------------------


def test_near_is_bright_and_nothing_is_dark() -> None:
    depth = np.array([[0.5, 1.0, 2.0, 3.0, 4.0, np.inf, np.nan]])
    light = paint_depth(depth, 1.0, 4.0).astype(int).sum(axis=2)[0]
    assert light[0] == light[1] > light[2] > light[3] > light[4] == light[5] == light[6]


def test_normals_are_world_axes_in_red_green_blue() -> None:
    axes = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, 0, 0]]], np.float32)
    expected = [(255, 128, 128), (128, 255, 128), (128, 128, 255), (0, 128, 128), (128, 128, 128)]
    assert paint_normals(axes)[0].tolist() == [list(color) for color in expected]


def test_ids_show_the_roles_and_nothing_else_in_red_and_yellow() -> None:
    picture = paint_ids(np.array([[0, 1, 2, 3]], np.int16), SCENE)
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
    frame = _frame(2.0, 1.0)
    pictures = dict(zip(PASSES, paint(frame, SCENE, ranges_of([frame])), strict=True))
    assert all(picture.shape == (8, 8, 3) for picture in pictures.values())
    assert all(picture.dtype == np.uint8 for picture in pictures.values())
    assert pictures["color"][0, 0].tolist() == [7, 7, 7]
    assert pictures["ids"][0, 0].tolist() == list(AGENT)
    assert pictures["normals"][0, 0].tolist() == [128, 128, 128]
