"""What vision models saw and imagined, in a real browser: every model, beside the true frames."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from physion.clips.batch import ImaginedTrial
from physion.readout.imagined import imagine_with
from physion.report.viewer.build import ViewerOptions, build_viewer
from physion.trials.dataset import Dataset
from support.browser import Browser
from support.viewer_dataset import FRAMES, Plan, make_dataset

pytestmark = pytest.mark.slow

TILES = {
    "svg": ["true", "imagined"],
    "op3": ["true", "imagined", "masks"],
    "rpin": ["true"],
    "cswm": ["true", "masks", "changes"],
}
RED = np.array([230, 40, 40])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Trials whose movies are of one grey, 40 plus three times the frame."""
    return make_dataset(tmp_path_factory.mktemp("data") / "set", (Plan("drop_0"), Plan("drop_1")))


def seek(browser: Browser, frame: int) -> None:
    browser.ask(
        "(slider => { slider.value = " + str(frame) + "; slider.oninput(); })"
        "(document.getElementById('frame-slider'))"
    )


def canvas(browser: Browser, name: str) -> np.ndarray:
    """The pixels of a tile (H, W, 4)."""
    uri = browser.ask(f"document.querySelector('[data-prediction={name}]').toDataURL()")
    image = Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1])))
    return np.asarray(image.convert("RGBA")).astype(int)


def text(browser: Browser, name: str) -> str:
    found = browser.ask(f"document.querySelector('[data-prediction={name}]').ariaLabel")
    return str(found)


def painted(browser: Browser, name: str) -> None:
    """Wait until the pictures are decoded and drawn."""
    browser.until(
        f"document.querySelector('[data-prediction={name}]').getContext('2d')"
        ".getImageData(0, 0, 400, 400).data.some(v => v)"
    )


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "cswm" else pytest.mark.nightly) for name in TILES],
)
def test_every_vision_model_is_shown(
    browser: Browser, folder: Path, tmp_path: Path, name: str
) -> None:
    found: dict[str, Sequence[ImaginedTrial]] = {}

    def imagine(trials: Sequence[str]) -> dict[str, Sequence[ImaginedTrial]]:
        found.update(imagine_with(Dataset(folder), [name], {"weights": "random"})(trials))
        return found

    options = ViewerOptions(details=1, card_size=32, pass_size=32, stride=6)
    page = build_viewer(folder, tmp_path / "v.html", options, imagine=imagine).page
    (one,) = found["drop_0"]
    # The second imagined step, or the first where the movie ends before the second.
    step = sum(frame < FRAMES for frame in one.frames[:2]) - 1
    first, later = int(one.frames[0]), int(one.frames[step])
    assert page.stat().st_size < 1_500_000
    for dark in (False, True) if name == "op3" else (False,):
        browser.open(page, "#trial=drop_0", dark=dark, reduced_motion=True)
        words = browser.ask("document.getElementById('prediction').textContent")
        assert f"{name}-small (untrained, weights random)" in words
        tiles = browser.ask("[...document.querySelectorAll('[data-prediction]')]"
                            ".map(c => c.dataset.prediction)")  # fmt: skip
        assert tiles == TILES[name]
        seek(browser, 20)
        at = max(int(frame) for frame in one.seen_frames if frame <= 20)
        painted(browser, "true")
        # A corner of the picture, which no box covers.
        assert canvas(browser, "true")[-8:, :8, :3].mean() == pytest.approx(40 + 3 * at, abs=5)
        assert "een" in text(browser, "true") and f"frame {at}" in text(browser, "true")
        seek(browser, later + 1)
        assert canvas(browser, "true")[-8:, :8, :3].mean() == pytest.approx(40 + 3 * later, abs=5)
        assert f"frame {later}" in text(browser, "true")
        assert "not seen" in text(browser, "true")
        check_kind(browser, name, one, first, step)
    assert browser.complaints() == []
    assert browser.requests() == [page.resolve().as_uri()]
    assert browser.ask("document.images.length") == 0


def check_masks(drawn: np.ndarray, masks: np.ndarray) -> None:
    """Check that each of five slots has a cell, the more coloured the larger its mask is.

    The cells lie in rows of three, with gaps of 4 pixels; ``masks`` (5, h, w) are in 0..1.
    """
    width, height = (drawn.shape[1] - 8) // 3, (drawn.shape[0] - 4) // 2
    colored = []
    for slot in range(len(masks)):
        top, left = slot // 3 * (height + 4), slot % 3 * (width + 4)
        colored.append(np.ptp(drawn[top : top + height, left : left + width, :3], axis=2).mean())
    assert np.corrcoef(colored, masks.mean(axis=(1, 2)))[0, 1] > 0.9


def check_kind(browser: Browser, name: str, one: ImaginedTrial, first: int, step: int) -> None:
    """Check what sets a model apart; the time line is just after the imagined step ``step``."""
    if "imagined" in TILES[name]:
        painted(browser, "imagined")
        shown = canvas(browser, "imagined")
        side = one.shown["rgb"].shape[1]
        zoom = len(shown) // side
        centres = shown[zoom // 2 :: zoom, zoom // 2 :: zoom, :3]
        gaps = [np.abs(centres - picture.astype(int)).mean() for picture in one.shown["rgb"]]
        assert gaps[step] < 25 and gaps[step] <= min(gaps) + 1
        seek(browser, first - 1)
        assert not canvas(browser, "imagined").any()
        assert f"from frame {first} on" in text(browser, "imagined")
    if name == "op3":
        seek(browser, first)
        painted(browser, "masks")
        assert f"imagined at frame {first}" in text(browser, "masks")
        drawn = canvas(browser, "masks")
        check_masks(drawn, one.shown["masks"][0])
        seek(browser, int(one.seen_frames[1]))
        assert f"seen at frame {one.seen_frames[1]}" in text(browser, "masks")
        check_masks(canvas(browser, "masks"), one.seen["masks"][1])
        assert not np.array_equal(drawn, canvas(browser, "masks"))
    if name == "rpin":
        left, top, right, bottom = 256 * one.shown["boxes"][step, 0]
        near = np.abs(canvas(browser, "true")[..., :3] - RED).max(axis=2) < 40
        rows, columns = np.nonzero(near)
        edges = (columns.min(), rows.min(), columns.max(), rows.max())
        assert edges == pytest.approx((left, top, right, bottom), abs=4)
        assert near[int((top + bottom) / 2), int((left + right) / 2)] == np.False_
    if name == "cswm":
        painted(browser, "masks")
        assert f"seen at frame {one.seen_frames[-1]}" in text(browser, "masks")
        drawn = canvas(browser, "changes")
        seek(browser, first)
        assert not np.array_equal(drawn, canvas(browser, "changes")), "a line marks the frame"


def test_no_prediction_hides_the_pictures_and_so_do_hidden_labels(
    browser: Browser, folder: Path, tmp_path: Path
) -> None:
    imagined = imagine_with(Dataset(folder), ["copy-last-frame"], {})
    options = ViewerOptions(details=2, card_size=32, pass_size=32, stride=6)
    page = build_viewer(folder, tmp_path / "v.html", options, imagine=imagined).page
    browser.open(page, "#trial=drop_0", reduced_motion=True)
    count = "document.querySelectorAll('[data-prediction]').length"
    assert browser.ask(count) == 2
    seek(browser, 59)
    painted(browser, "imagined")
    # The picture of frame 44, the last one that was seen, stays.
    assert canvas(browser, "imagined")[..., :3].mean() == pytest.approx(40 + 3 * 44, abs=5)
    browser.key("i", 73, "i")
    assert browser.ask(count) == 0
    browser.key("n", 78, "n")
    assert browser.ask(count) == 0, "the choice stays for the next trial"
    browser.key("i", 73, "i")
    assert browser.ask(count) == 2
    browser.ask("document.getElementById('labels').click()")
    visible = "[...document.querySelectorAll('[data-prediction]')].some(c => c.checkVisibility())"
    assert browser.ask(visible) is False
    assert "copy-last-frame" not in browser.ask("document.getElementById('detail').innerText")
    assert browser.complaints() == []
