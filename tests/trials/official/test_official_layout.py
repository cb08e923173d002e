"""Official names, and encodings of pictures."""

from __future__ import annotations

import colorsys
import csv
import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from physion.core.errors import BadInputError
from physion.core.names import CONTROLLERS, guess_scenario, plain_name
from physion.rendering.camera import axes
from physion.scenes.scene import Camera
from physion.trials.files import encode_png
from physion.trials.official.names import (
    decode_depth,
    decode_picture,
    encode_depth,
    encode_flow,
    encode_normals,
    redyellow_name,
    segmentation_colors,
    split_name,
)


def test_no_two_objects_share_a_channel() -> None:
    colors = segmentation_colors(255)
    assert colors.min() > 0
    for channel in colors.T:
        assert len(set(channel.tolist())) == 255
    with pytest.raises(BadInputError, match="256 objects"):
        segmentation_colors(256)


@given(st.floats(0, 99.8))
def test_depth_by_the_official_formula(metres: float) -> None:
    packed = encode_depth(np.array([[metres], [1.0]])).astype(float)
    # Bottom row first.
    red, green, blue = packed[1, 0]
    value = (red + green / 256 + blue / 65536) * (100 - 0.1) / 256
    assert value == pytest.approx(metres, abs=6e-6)
    assert decode_depth(encode_depth(np.array([[metres]])))[0, 0] == pytest.approx(value)


def test_depth_of_nothing_is_far() -> None:
    far = decode_depth(encode_depth(np.array([[np.inf, np.nan, 500.0]])))
    np.testing.assert_allclose(far, 99.9, atol=1e-4)


def test_pictures_are_lossless_and_jpeg_is_read() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    assert (decode_picture(np.frombuffer(encode_png(picture), np.uint8)) == picture).all()
    buffer = io.BytesIO()
    Image.new("RGB", (8, 6), (200, 30, 30)).save(buffer, "jpeg")
    jpeg = decode_picture(np.frombuffer(buffer.getvalue(), np.uint8))
    assert jpeg.shape == (6, 8, 3) and abs(int(jpeg[3, 3, 0]) - 200) < 5


@pytest.mark.parametrize("data", [b"", b"\x89PNG\r\n\x1a\n", b"GIF89a" + bytes(50)])
def test_what_is_no_picture_is_refused(data: bytes) -> None:
    with pytest.raises(BadInputError):
        decode_picture(np.frombuffer(data, np.uint8))


def test_a_huge_picture_is_refused_before_it_takes_memory() -> None:
    buffer = io.BytesIO()
    Image.new("1", (5000, 5000)).save(buffer, "png")
    with pytest.raises(BadInputError, match="too large"):
        decode_picture(np.frombuffer(buffer.getvalue(), np.uint8))


def test_normals_are_relative_to_the_camera() -> None:
    view = axes(Camera((0.0, -3.0, 0.0), (0.0, 0.0, 0.0)))
    normals = np.array([[[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]])
    assert encode_normals(normals, view)[0].tolist() == [
        [255, 128, 128],
        [128, 255, 128],
        [128, 128, 255],
    ]


@given(st.floats(0, 1), st.floats(0, 2))
def test_flow_is_a_colour_wheel(turn: float, size: float) -> None:
    width = 50  # So that full brightness is one pixel a frame.
    flow = np.zeros((1, width, 2))
    flow[0, 0] = size * np.cos(2 * np.pi * turn), size * np.sin(2 * np.pi * turn)
    color = encode_flow(flow)[0]
    expected = np.array(colorsys.hsv_to_rgb(turn % 1.0, 1, min(size, 1))) * 255
    np.testing.assert_allclose(color[0], expected, atol=1.01)
    assert not color[1:].any()


def test_names() -> None:
    assert split_name("pilot_a_b_0007") == ("pilot_a_b", "0007")
    assert split_name("tiny") == ("tiny", "0000")
    assert redyellow_name("pilot_a_0007") == "pilot_a-redyellow_0007"
    assert plain_name("pilot_a-redyellow_0007_img.mp4") == "pilot_a_0007"


def test_every_published_stimulus_betrays_its_scenario(official: Path) -> None:
    rows = csv.DictReader((official / "stimuli/stimulus_names_and_labels.csv").open())
    count = 0
    for row in rows:
        assert guess_scenario(row["stim_ID"], "", ()) == row["scenario"]
        assert redyellow_name(row["stim_ID"]).startswith(split_name(row["stim_ID"])[0])
        count += 1
    assert count == 1200


def test_controllers_and_folders_tell_what_a_name_does_not() -> None:
    for scenario, controller in CONTROLLERS.items():
        assert guess_scenario("a_0001", controller, ()) == scenario
    assert guess_scenario("a_0001", "", ("hdf5s", "Drape")) == "drape"
    assert guess_scenario("a_0001", "None", ("dropbox", "controls")) is None
