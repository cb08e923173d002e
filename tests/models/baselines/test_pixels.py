"""Baselines that see pictures: coloured blobs, and a copy of the last frame."""

from __future__ import annotations

import numpy as np
import pytest

from physion.clips.batch import Batch
from physion.core.errors import BadInputError
from physion.models import build_model
from physion.models.baselines.pixels import BlobCentroids, CopyLastFrame, color_masks
from physion.rendering.renderer import Renderer
from physion.scenes.looks import in_look
from physion.scenes.scene import Body, Camera, Roles, Scene
from support.rendered_scenes import resting

RED, YELLOW = (255, 0, 0), (255, 255, 0)
SIZE = 64


def clips(rgb: np.ndarray) -> Batch:
    """Return pictures (B, T, H, W, 3) as a batch."""
    frames = np.tile(np.arange(rgb.shape[1]) * 6, (len(rgb), 1))
    names = tuple(f"trial_{row}" for row in range(len(rgb)))
    return Batch(names, frames, np.ones(frames.shape, np.bool_), rgb=rgb)


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    """Return random pictures of a shape (B, T, size, size, 3)."""
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def draw_disc(picture: np.ndarray, x: int, y: int, radius: float, color: tuple[int, ...]) -> int:
    """Draw a disc centred on a pixel; return how many pixels it has."""
    rows, columns = np.mgrid[: len(picture), : len(picture)]
    inside = (rows - y) ** 2 + (columns - x) ** 2 <= radius**2
    picture[inside] = color
    return int(inside.sum())


def test_centroids_and_areas_of_discs_are_exact() -> None:
    picture = np.full((SIZE, SIZE, 3), 120, np.uint8)
    red = draw_disc(picture, 12, 40, 6, RED)
    yellow = draw_disc(picture, 45, 20, 9.5, YELLOW)
    features = build_model("blob-centroids").encode(clips(picture[None, None]))
    expected = [12.5 / 64, 40.5 / 64, red / 64**2, 45.5 / 64, 20.5 / 64, yellow / 64**2]
    assert features.dtype == np.float32 and features.shape == (1, 1, 6)
    assert features[0, 0] == pytest.approx(expected, abs=1e-7)


def test_blobs_that_are_not_seen_are_in_the_middle_without_area() -> None:
    gray = np.full((1, 1, SIZE, SIZE, 3), 90, np.uint8)
    assert build_model("blob-centroids").encode(clips(gray)).tolist() == [
        [[0.5, 0.5, 0, 0.5, 0.5, 0]]
    ]


@pytest.mark.parametrize(
    ("color", "red", "yellow"),
    [
        ((158, 27, 29), True, False),
        ((220, 30, 100), True, False),
        ((215, 208, 15), False, True),
        ((140, 160, 20), False, True),
        ((255, 128, 0), False, False),  # orange
        ((60, 200, 40), False, False),
        ((40, 60, 220), False, False),
        ((230, 230, 230), False, False),
        ((0, 0, 0), False, False),
        ((160, 100, 90), False, False),  # pale
        ((60, 5, 5), False, False),  # dark
        ((200, 0, 220), False, False),  # magenta
    ],
)
def test_colours_that_count(color: tuple[int, int, int], red: bool, yellow: bool) -> None:
    masks = color_masks(np.array([color], np.uint8))
    assert [bool(mask[0]) for mask in masks] == [red, yellow]


def test_blobs_of_a_rendered_scene_are_agent_and_patient() -> None:
    bodies = (
        Body("agent", "sphere", (-0.6, 0.3, 0.0), (0.6, 0.6, 0.6)),
        Body("patient", "cube", (0.6, -0.4, 0.0), (0.6, 0.6, 0.6)),
        Body("other", "cone", (0.0, 0.9, 0.0), (0.4, 0.4, 0.4)),
    )
    camera = Camera((3.0, 0.5, 1.2), (0.0, 0.0, 0.3))
    scene = Scene("pair", "collide", bodies, Roles("agent", "patient"), camera)
    frame = Renderer(in_look(scene, "redyellow"), resting(scene), SIZE, SIZE).render(
        0, ("color", "ids")
    )
    assert frame.color is not None and frame.ids is not None
    features = build_model("blob-centroids").encode(clips(frame.color[None, None]))[0, 0]
    for place, number in ((0, 1), (3, 2)):
        rows, columns = np.nonzero(frame.ids == number)
        middle = [(columns.mean() + 0.5) / SIZE, (rows.mean() + 0.5) / SIZE]
        assert features[place : place + 2] == pytest.approx(middle, abs=1 / SIZE)
        assert features[place + 2] == pytest.approx(len(rows) / SIZE**2, rel=0.15)


@pytest.mark.parametrize(
    "model", [build_model("blob-centroids"), build_model("copy-last-frame")], ids=["blobs", "copy"]
)
def test_features_of_a_frame_depend_on_it_alone(model: object) -> None:
    assert isinstance(model, BlobCentroids | CopyLastFrame)
    size = model.spec.image_size
    rgb = noise(4, 9, size, size, 3)
    features = model.encode(clips(rgb))
    assert np.ptp(features) > 0 and model.spec.framewise
    # Parts of clips, other clips beside them, and noise in later frames change nothing.
    assert model.encode(clips(rgb[1:2, 3:5])).tobytes() == features[1:2, 3:5].tobytes()
    later = rgb.copy()
    later[:, 7:] = noise(4, 2, size, size, 3, seed=1)
    assert model.encode(clips(later))[:, :7].tobytes() == features[:, :7].tobytes()
    assert model.encode(clips(later)).tobytes() != features.tobytes()


def test_pixels_are_the_features_of_a_copy() -> None:
    rgb = noise(2, 7, 32, 32, 3)
    features = build_model("copy-last-frame").encode(clips(rgb))
    assert features.shape == (2, 7, 32 * 32 * 3) and features.dtype == np.float32
    assert features[1, 2] == pytest.approx(rgb[1, 2].ravel() / 255)


@pytest.mark.parametrize("stored", [False, True])
def test_the_last_context_frame_is_imagined(stored: bool) -> None:
    model, rgb = build_model("copy-last-frame"), noise(2, 7, 32, 32, 3)
    features = model.encode(clips(rgb))
    context = clips(rgb)
    if stored:
        context = Batch(context.trials, context.frames, context.valid, features=features)
    rollout = model.imagine(context, 2, 0)
    assert rollout.features.shape == (2, 2, 18, 32 * 32 * 3)
    assert (rollout.features == features[:, None, -1:]).all()
    assert ("rgb" in rollout.shown) == (not stored)
    if not stored:
        assert rollout.shown["rgb"].shape == (2, 2, 18, 32, 32, 3)
        assert (rollout.shown["rgb"] == rgb[:, None, -1:]).all()


@pytest.mark.parametrize(
    "model", [build_model("blob-centroids"), build_model("copy-last-frame")], ids=["blobs", "copy"]
)
def test_other_pictures_are_refused(model: object) -> None:
    assert isinstance(model, BlobCentroids | CopyLastFrame)
    with pytest.raises(BadInputError, match=r"pictures \(input rgb\) of .*\(48, 48, 3\)"):
        model.encode(clips(noise(1, 1, 48, 48, 3)))
    batch = clips(noise(1, 1, 48, 48, 3))
    with pytest.raises(BadInputError, match="not none"):
        model.encode(Batch(batch.trials, batch.frames, batch.valid))
