"""The viewer's page in a real browser."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from physion.clips.batch import ImaginedTrial
from physion.report.viewer.build import ViewerOptions, build_viewer
from physion.trials.video import read_frames
from support.browser import Browser
from support.viewer_dataset import EVIL, Plan, make_dataset

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


@pytest.mark.parametrize("dark", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_small_screens_hold_everything_in_both_themes(
    browser: Browser, page: Path, dark: bool
) -> None:
    for fragment in ("", "#trial=drop_0", "#trial=drop_2"):
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


@pytest.mark.parametrize("dark", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_imagined_particles_are_shown_next_to_the_true_motion(
    browser: Browser, imagined_page: Path, dark: bool
) -> None:
    red, yellow = (0.88, 0.08, 0.08), (0.93, 0.72, 0)
    browser.open(imagined_page, "#trial=drop_0", dark=dark)
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
