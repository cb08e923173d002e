"""Pictures, boxes, masks and slots of imagined trials: the right frames, few bytes."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
from typing import Any

import numpy as np
import pytest
from PIL import Image

from physion.clips.batch import ImaginedTrial
from physion.core.errors import BadInputError
from physion.report.viewer.imagined import ROWS, SIDE, SLOTS, pack_imagined
from support.viewer_dataset import PLANS, make_scene

SCENE = make_scene(PLANS[0])
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
    one = imagined(
        shown={"boxes": shown},
        seen={"rgb": greys(SEEN), "boxes": seen},
    )
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
        (
            "rgb",
            greys(LATER).astype(np.float32),
            r"rgb must be .* of 4 frames, not float",
        ),
        ("rgb", greys(SEEN), r"of 4 frames, not uint8 \(3, 16, 16, 3\)"),
        ("boxes", np.zeros((4, 2, 3)), r"boxes must be \(frames, objects, 4\)"),
        ("masks", np.zeros((4, 16, 16)), r"masks must be \(frames, slots, height, width\)"),
        ("slots", np.zeros((4, 16)), r"slots must be \(frames, slots, values\)"),
    ],
)
def test_wrong_arrays_are_refused(name: str, values: np.ndarray, message: str) -> None:
    with pytest.raises(BadInputError, match=f"model 'painter', trial 'drop_0': .*{message}"):
        packed(imagined(shown={name: values}))
