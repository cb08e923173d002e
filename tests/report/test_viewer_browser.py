"""The viewer's page in a real browser."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from physion.clips.batch import ImaginedTrial
from physion.readout.imagined import imagine_with
from physion.report.viewer.build import ViewerOptions, build_viewer
from physion.trials.dataset import Dataset
from physion.trials.video import read_frames
from support.browser import Browser
from support.viewer_dataset import EVIL, FRAMES, Plan, make_dataset

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of the dataset made by hand, drop_1 without details."""
    folder = tmp_path_factory.mktemp("viewer")
    make_dataset(folder / "set")
    options = ViewerOptions(details=2, card_size=64, pass_size=64, stride=2)
    return build_viewer(folder / "set", folder / "view.html", options).page


def shown(browser: Browser) -> list[str]:
    """Names on the cards that can be seen."""
    found = browser.ask(
        "[...document.querySelectorAll('.card')].filter(c => c.checkVisibility())"
        ".map(c => c.querySelector('b').textContent)"
    )
    return list(found)


def choose(browser: Browser, name: str, value: str) -> None:
    browser.ask(
        f"document.getElementById('{name}').value = {json.dumps(value)};"
        f"document.getElementById('{name}').dispatchEvent(new Event('input', {{bubbles: true}}))"
    )


def click(browser: Browser, name: str) -> None:
    browser.ask(f"document.getElementById('{name}').click()")


def seek(browser: Browser, frame: int) -> None:
    """Move the time line, and wait until the movie stands there."""
    choose(browser, "frame-slider", str(frame))
    browser.until(f"document.getElementById('now').textContent.startsWith('frame {frame} of')")
    browser.until("![...document.querySelectorAll('video')].some(video => video.seeking)")
    browser.ask("new Promise(done => setTimeout(done, 300))")


def canvas(browser: Browser, name: str) -> np.ndarray:
    """What a pass shows, pixel by pixel."""
    uri = browser.ask(f"document.querySelector('[aria-label=\"{name} pass\"]').toDataURL()")
    image = Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1])))
    return np.asarray(image.convert("RGB")).astype(int)


def test_grid_plays_and_asks_for_nothing_else(browser: Browser, page: Path) -> None:
    browser.open(page)
    browser.until(
        "[...document.querySelectorAll('video')].filter(v => v.currentTime > 0.1).length >= 3"
    )
    assert shown(browser) == ["drape_0", "drop_0", "drop_1", "drop_2"]
    assert browser.picture(".card video").mean() > 30
    click(browser, "movies")
    assert browser.ask("[...document.querySelectorAll('video')].every(v => v.paused)")
    assert browser.complaints() == []
    assert browser.requests() == [page.resolve().as_uri()]


def test_filters_and_search(browser: Browser, page: Path) -> None:
    browser.open(page)
    for name, value, expected in (
        ("search", "DROP plate", ["drop_0", "drop_1", "drop_2"]),
        ("search", "no such thing", []),
        ("scenario", "drape", ["drape_0"]),
        ("split", "training", ["drop_2"]),
        ("preset", "other", ["drop_1"]),
        ("contact", "no", ["drop_1"]),
        ("observed", "yes", ["drop_2"]),
        ("observed", "no", ["drape_0", "drop_0", "drop_1"]),
        ("robust", "0.5", ["drape_0", "drop_0", "drop_1"]),
        ("robust", "0.625", ["drape_0", "drop_0"]),
    ):
        choose(browser, name, value)
        assert shown(browser) == expected, (name, value)
        assert browser.ask("document.getElementById('count').textContent").startswith(
            f"{len(expected)} of 4 trials shown"
        )
        browser.ask("document.querySelector('[type=reset]').click()")
        browser.until("document.getElementById('count').textContent.startsWith('4 of 4')")


def test_hidden_labels_tell_nothing(browser: Browser, page: Path) -> None:
    browser.open(page)
    assert "contact at 50" in browser.ask("document.body.innerText")
    click(browser, "labels")
    assert "contact" not in browser.ask("document.body.innerText").lower()
    browser.ask("document.querySelectorAll('.card')[1].click()")
    text = browser.ask("document.getElementById('detail').innerText").lower()
    assert "contact" not in text and "touch in" not in text and "seed" in text
    assert not browser.ask("document.querySelector('#track .first-contact').checkVisibility()")
    click(browser, "play")
    browser.key("End", 35)
    words = browser.ask("document.getElementById('now').textContent")
    assert words == "frame 44 of 60, observed0.44 s physics, 1.47 s movie"
    latest = browser.ask(
        "Math.max(...[...document.querySelectorAll('.card video')].map(v => v.currentTime))"
    )
    assert latest <= 45 / 30


def test_every_pass_and_the_scene_show_the_frame_of_the_time_line(
    browser: Browser, page: Path, tmp_path: Path
) -> None:
    browser.open(page, "#trial=drop_0")
    click(browser, "play")
    strip = json.loads(browser.ask("document.getElementById('detail-1').textContent"))["passes"]
    movie = tmp_path / "strip.mp4"
    movie.write_bytes(base64.b64decode(strip["data"]))
    pictures = read_frames(movie).astype(int)
    for frame in (0, 31, 48, 59):
        seek(browser, frame)
        for place, name in enumerate(("color", "depth", "normals", "ids", "flow")):
            # Pictures differ from their neighbours where the ball moves, and hardly elsewhere.
            seen = canvas(browser, name)
            gaps = np.abs(pictures[:, :, 64 * place : 64 * place + 64] - seen).mean(axis=(1, 2, 3))
            assert gaps[frame // 2] <= gaps.min() + 0.01, (frame, name)
            if name == "color":
                assert gaps.argmin() == frame // 2, frame
    ids = canvas(browser, "ids")
    assert ((ids[..., 0] > 150) & (ids[..., 1] < 90)).sum() > 20
    assert canvas(browser, "depth").std() > 10 and canvas(browser, "normals").std() > 10
    assert browser.complaints() == []


def colored(picture: np.ndarray) -> tuple[float, float, int]:
    """Mean row and column of what is red, and how much is yellow."""
    red, green, blue = (picture[..., k].astype(int) for k in range(3))
    rows, columns = np.nonzero((red > 90) & (green < 60) & (blue < 60))
    assert len(rows) > 50
    return rows.mean(), columns.mean(), int(((red > 120) & (green > 110) & (blue < 80)).sum())


def test_scene_in_3d_moves_with_the_time_line_and_turns(browser: Browser, page: Path) -> None:
    browser.open(page, "#trial=drop_0")
    click(browser, "play")
    browser.ask("document.querySelector('#view3d input').click()")  # hides paths
    seek(browser, 0)
    first = colored(browser.picture("#scene3d"))
    assert first[2] > 500
    seek(browser, 50)
    assert colored(browser.picture("#scene3d"))[0] > first[0] + 15
    before = browser.picture("#scene3d").astype(int)
    browser.ask("document.getElementById('scene3d').focus()")
    changes = [("ArrowLeft", 37, ""), ("ArrowUp", 38, ""), ("+", 187, "+"), ("-", 189, "-")]
    for key, code, text in changes:
        browser.key(key, code, text)
        browser.ask("new Promise(done => setTimeout(done, 100))")
        now = browser.picture("#scene3d").astype(int)
        assert (np.abs(now - before).max(axis=2) > 30).sum() > 200, key
        before = now
    words = browser.ask("document.getElementById('now').textContent")
    assert words == "frame 50 of 60, unobserved0.50 s physics, 1.67 s movie"
    x, y = browser.ask(
        "(({x, y, width, height}) => [x + width / 2, y + height / 2])"
        "(document.getElementById('scene3d').getBoundingClientRect())"
    )
    mouse = {"button": "left", "buttons": 1, "clickCount": 1}
    browser.send("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **mouse)
    browser.send("Input.dispatchMouseEvent", type="mouseMoved", x=x + 80, y=y + 30, **mouse)
    browser.send("Input.dispatchMouseEvent", type="mouseReleased", x=x + 80, y=y + 30, **mouse)
    browser.ask("new Promise(done => setTimeout(done, 100))")
    assert (np.abs(browser.picture("#scene3d") - before).max(axis=2) > 30).sum() > 200


def test_cloth_falls_in_3d(browser: Browser, page: Path) -> None:
    browser.open(page, "#trial=drape_0")
    click(browser, "play")
    browser.ask("document.querySelector('#view3d input').click()")
    seek(browser, 2)
    first = colored(browser.picture("#scene3d"))
    seek(browser, 50)
    assert colored(browser.picture("#scene3d"))[0] > first[0] + 20


def test_time_line_marks_observed_part_and_every_contact(browser: Browser, page: Path) -> None:
    browser.open(page, "#trial=drop_2")
    marks = browser.ask(
        "[...document.querySelectorAll('#track i')].map(i => [i.className.split(' ')[0],"
        "parseFloat(i.style.left), parseFloat(i.style.width) || 0])"
    )
    shares = [(kind, left * 59 / 100, width * 59 / 100) for kind, left, width in marks]
    assert [kind for kind, _, _ in shares] == ["observed", "contact", "contact", "first-contact"]
    expected = [(0, 44.5), (19.5, 2), (29.5, 1), (20, 0)]
    for (_, left, width), (at, length) in zip(shares, expected, strict=True):
        assert left == pytest.approx(at, abs=1e-3) and width == pytest.approx(length, abs=1e-3)
    words = browser.ask("document.getElementById('marks').textContent")
    assert "45 observed frames" in words and "touch in: 20–21, 30." in words


def test_the_keyboard_is_enough(browser: Browser, page: Path) -> None:
    browser.open(page)
    browser.ask("document.querySelector('.card').focus()")
    browser.key("Enter", 13, "\r")
    browser.until("document.getElementById('detail').open")
    assert browser.ask("document.getElementById('detail-title').textContent") == "drape_0"
    assert browser.ask("location.hash") == "#trial=drape_0"
    browser.until("document.getElementById('play').textContent === 'Pause'")
    browser.until("!document.getElementById('now').textContent.startsWith('frame 0 ')")
    browser.ask("document.getElementById('frame-slider').focus()")
    browser.key(" ", 32, " ")
    assert browser.ask("document.getElementById('play').textContent") == "Play"
    browser.key("Home", 36)
    for key, code, modifiers, frame in (
        *(("ArrowRight", 39, 0, 1), ("ArrowRight", 39, 8, 11), ("ArrowLeft", 37, 0, 10)),
        ("End", 35, 0, 59),
    ):
        browser.key(key, code, modifiers=modifiers)
        words = browser.ask(
            "document.getElementById('frame-slider').getAttribute('aria-valuetext')"
        )
        assert words.startswith(f"frame {frame} of 60"), key
    browser.key("n", 78, "n")
    assert browser.ask("document.getElementById('detail-title').textContent") == "drop_0"
    browser.key("Escape", 27)
    # The page hears of the closing a moment after the dialog is closed.
    browser.until("location.hash === ''")
    assert not browser.ask("document.getElementById('detail').open")
    assert browser.ask("document.activeElement.querySelector('b').textContent") == "drop_0"


def test_a_telephone_shows_a_trial_without_scrolling_sideways(browser: Browser, page: Path) -> None:
    browser.open(page, "#trial=drop_0", size=(400, 900))
    browser.until("document.getElementById('scene3d')?.dataset.ready === 'yes'")
    assert browser.ask("document.getElementById('detail').scrollWidth") <= 400
    assert browser.complaints() == []


def test_small_screens_hold_everything_in_both_themes(browser: Browser, page: Path) -> None:
    for fragment, dark in (("", False), ("#trial=drop_0", True), ("#trial=drop_2", False)):
        browser.open(page, fragment, size=(1024, 600), dark=dark)
        assert browser.ask("document.documentElement.scrollWidth") <= 1024
        if fragment:
            place = browser.ask("document.getElementById('detail').scrollWidth")
            assert place <= 1024
            low = browser.ask("document.getElementById('time').getBoundingClientRect().bottom")
            assert low <= 600, "the time line is seen without scrolling"
        light = browser.picture()[-3:, :3].mean()
        assert light < 60 if dark else light > 200
    names = browser.ask(
        "[...document.querySelectorAll('button, input, select, canvas, [tabindex]')].filter("
        "e => !e.labels?.length && !e.textContent.trim() && !e.ariaLabel && e.tabIndex >= 0)"
        ".map(e => e.outerHTML)"
    )
    assert names == []


def test_hostile_text_stays_text(browser: Browser, tmp_path: Path) -> None:
    make_dataset(tmp_path / "set", (Plan("evil", foreign=EVIL),))
    options = ViewerOptions(card_size=32, pass_size=32, stride=6)
    page = build_viewer(tmp_path / "set", tmp_path / "v.html", options).page
    browser.open(page, "#trial=evil")
    browser.until("document.getElementById('detail').open")
    text = browser.ask("document.getElementById('detail').textContent")
    assert text.count(EVIL) >= 6
    assert browser.ask("document.images.length") == 0
    assert browser.ask("typeof window.harmed") == "undefined"
    assert browser.ask("document.title").count(EVIL) == 1
    assert browser.complaints() == []


def test_policy_stops_what_gets_in_all_the_same(browser: Browser, page: Path) -> None:
    browser.open(page)
    browser.ask(
        "document.body.append(Object.assign(document.createElement('script'),"
        "{textContent: 'window.harmed = 1'}))"
    )
    assert browser.ask("typeof window.harmed") == "undefined"
    assert browser.ask("fetch('http://127.0.0.1:9/').then(() => 'sent', () => 'stopped')") == (
        "stopped"
    )
    assert len([text for text in browser.complaints() if "Content Security Policy" in text]) >= 2


def resting(count: int = 6) -> ImaginedTrial:
    """A model by which the ball and the plate stay where they were at the start."""
    side = np.linspace(-0.2, 0.2, count)
    square = np.stack(np.meshgrid(side, side, [0.0], indexing="ij"), -1).reshape(-1, 3)
    ball, plate = square + np.array([0, 0, 1.2]), 3 * square + np.array([0, 0, 0.3])
    once = np.concatenate([ball, plate]).astype(np.float32)
    shown = {"particles": np.stack([once] * 5), "things": np.repeat([0, 1], count**2)}
    frames = 44 + 3 * np.arange(1, 6)
    return ImaginedTrial("standstill", "untrained", frames, shown, probability=0.0, gap=0.7)


def of_colour(picture: np.ndarray, color: tuple[float, float, float]) -> np.ndarray:
    """Rows of the pixels that have a colour of 0..1."""
    distance = np.abs(picture.astype(int) - 255 * np.array(color)).max(axis=2)
    return np.nonzero(distance < 12)[0]


@pytest.fixture(scope="module")
def imagined_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of two trials that a model imagined at rest."""
    place = tmp_path_factory.mktemp("imagined")
    folder = make_dataset(place / "set", (Plan("drop_0"), Plan("drop_1")))
    options = ViewerOptions(details=2, card_size=32, pass_size=32, stride=6)
    imagined = {"drop_0": [resting()], "drop_1": [resting()]}
    return build_viewer(folder, place / "v.html", options, imagine=lambda _: imagined).page


def test_imagined_particles_are_shown_next_to_the_true_motion(
    browser: Browser, imagined_page: Path
) -> None:
    red, yellow = (0.88, 0.08, 0.08), (0.93, 0.72, 0)
    browser.open(imagined_page, "#trial=drop_0", dark=True)
    click(browser, "play")
    browser.ask("document.querySelector('#view3d input').click()")  # hides paths
    # The true ball has the colour too, but lower, where it has fallen to; it is pale next to what
    # is imagined.
    seek(browser, 44)
    true = of_colour(browser.picture("#scene3d"), red)
    seek(browser, 45)
    rows = of_colour(browser.picture("#scene3d"), red)
    assert rows.max() < true.min()
    assert len(rows) > 100 and len(of_colour(browser.picture("#scene3d"), yellow)) > 100
    seek(browser, 59)  # the true ball has fallen on, the imagined one has not
    assert np.abs(of_colour(browser.picture("#scene3d"), red).mean() - rows.mean()) < 1
    words = browser.ask("document.querySelector('#prediction .imagined').textContent")
    assert "from frame 45 on: imagined by standstill (untrained): P(contact) 0.00" in words
    assert "smallest gap 0.700 m" in words
    low = browser.ask("document.getElementById('time').getBoundingClientRect().bottom")
    assert low <= 600, "the time line is seen without scrolling"
    browser.key("i", 73, "i")
    browser.ask("new Promise(done => setTimeout(done, 100))")
    assert of_colour(browser.picture("#scene3d"), red).min() > rows.max()
    assert browser.ask("document.querySelector('#prediction .imagined').textContent") == ""
    browser.key("n", 78, "n")  # the choice stays for the next trial
    click(browser, "play")
    assert browser.ask("document.getElementById('imagined-by').value") == "-1"
    choose(browser, "imagined-by", "0")
    browser.ask("document.getElementById('imagined-by').dispatchEvent(new Event('change'))")
    seek(browser, 59)
    assert len(of_colour(browser.picture("#scene3d"), red)) > 100
    click(browser, "labels")
    text = browser.ask("document.getElementById('detail').innerText")
    assert "standstill" not in text and "contact" not in text
    assert browser.complaints() == []


@pytest.mark.nightly
def test_trials_are_marked_and_the_file_is_offered(browser: Browser, page: Path) -> None:
    """The page keeps what is typed, and makes the file for the folder of the dataset."""
    browser.open(page, "#trial=drop_1")
    assert not browser.ask("document.getElementById('save-marks').checkVisibility()")
    click(browser, "mark")  # without a reason nothing is marked
    assert browser.ask("document.activeElement.id") == "reason"
    typed = json.dumps(' a "block",  flickers ')
    browser.ask(f"document.getElementById('reason').value = {typed}")
    click(browser, "mark")
    badges = "document.getElementById('detail-badges').textContent"
    assert 'unusable: a "block", flickers' in browser.ask(badges)
    browser.ask(
        "window.saved = null; URL.createObjectURL = (blob) => (blob.text().then("
        "(text) => (window.saved = text)), 'about:blank#'); HTMLAnchorElement.prototype.click = "
        "function () { window.savedAs = this.download }"
    )
    click(browser, "close")
    assert browser.ask("document.getElementById('save-marks').textContent") == (
        "Save unusable.csv (1)"
    )
    click(browser, "save-marks")
    browser.until("window.saved !== null")
    saved = browser.ask("window.saved")
    assert saved == 'trial,reason\n"drop_1","a ""block"", flickers"\n'
    assert browser.ask("window.savedAs") == "unusable.csv"
    browser.open(page, "#trial=drop_0")
    assert browser.ask("document.getElementById('reason').value") == ""


# --- what vision models saw and imagined --------------------------------------------------------


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


def tile(browser: Browser, name: str) -> np.ndarray:
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
        assert tile(browser, "true")[-8:, :8, :3].mean() == pytest.approx(40 + 3 * at, abs=5)
        assert "een" in text(browser, "true") and f"frame {at}" in text(browser, "true")
        seek(browser, later + 1)
        assert tile(browser, "true")[-8:, :8, :3].mean() == pytest.approx(40 + 3 * later, abs=5)
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
        shown = tile(browser, "imagined")
        side = one.shown["rgb"].shape[1]
        zoom = len(shown) // side
        centres = shown[zoom // 2 :: zoom, zoom // 2 :: zoom, :3]
        gaps = [np.abs(centres - picture.astype(int)).mean() for picture in one.shown["rgb"]]
        assert gaps[step] < 25 and gaps[step] <= min(gaps) + 1
        seek(browser, first - 1)
        assert not tile(browser, "imagined").any()
        assert f"from frame {first} on" in text(browser, "imagined")
    if name == "op3":
        seek(browser, first)
        painted(browser, "masks")
        assert f"imagined at frame {first}" in text(browser, "masks")
        drawn = tile(browser, "masks")
        check_masks(drawn, one.shown["masks"][0])
        seek(browser, int(one.seen_frames[1]))
        assert f"seen at frame {one.seen_frames[1]}" in text(browser, "masks")
        check_masks(tile(browser, "masks"), one.seen["masks"][1])
        assert not np.array_equal(drawn, tile(browser, "masks"))
    if name == "rpin":
        left, top, right, bottom = 256 * one.shown["boxes"][step, 0]
        near = np.abs(tile(browser, "true")[..., :3] - RED).max(axis=2) < 40
        rows, columns = np.nonzero(near)
        edges = (columns.min(), rows.min(), columns.max(), rows.max())
        assert edges == pytest.approx((left, top, right, bottom), abs=4)
        assert near[int((top + bottom) / 2), int((left + right) / 2)] == np.False_
    if name == "cswm":
        painted(browser, "masks")
        assert f"seen at frame {one.seen_frames[-1]}" in text(browser, "masks")
        drawn = tile(browser, "changes")
        seek(browser, first)
        assert not np.array_equal(drawn, tile(browser, "changes")), "a line marks the frame"


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
    assert tile(browser, "imagined")[..., :3].mean() == pytest.approx(40 + 3 * 44, abs=5)
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
