"""Whole sessions in three browsers, and the timing of the paper."""

from __future__ import annotations

import json
import re
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from physion.experiment.study.settings import Timing
from physion.experiment.study.study import Study
from support.experiment.browser import SHORT, Visit, answers_to_test, rows_of, served
from support.experiment.webkit import WebKit, wait_for, webkit

__all__ = ["webkit"]
pytestmark = pytest.mark.slow


def test_a_session_by_mouse(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "mouse") as visit:
        visit.go("?participant=Mouse&language=en")
        visit.heading("Taking part in this study")
        assert "Ada Lab" in visit.page.inner_text("main")
        visit.picture("consent")
        visit.main_button().click()
        for title in ("What you will do", "What you will see", "How you answer"):
            visit.heading(title)
            visit.picture("instructions")
            visit.main_button().click()
        visit.page.locator(".trial:not(.has-verdict)").wait_for()
        visit.picture("cue")
        # The full movie is requested only after the answer.
        assert not any("-full-" in address for address in visit.requests)
        visit.answer("yes")
        visit.page.locator(".verdict-correct, .verdict-incorrect").wait_for()
        visit.picture("feedback")
        assert visit.see_feedback() == "Correct!"  # the first trial has contact
        assert sum("-full-" in address for address in visit.requests) == 1
        visit.begin_test()
        for trial, response in enumerate(("yes", "no", "yes")):
            visit.page.get_by_text(f"Trial {trial + 1} of 3").wait_for()
            visit.answer(response)
        visit.heading("About you")
        visit.picture("demographics")
        visit.finish()
        visit.picture("result")
        assert visit.page.inner_text("#code") == "TINY-CODE"
        assert visit.page.get_attribute("#go", "href") == "https://lab.example/done"
        result = visit.page.inner_text("main")
        assert visit.unexpected() == []
        assert visit.hosts() == {url.removeprefix("http://")}
        assert "participant" not in visit.page.url
    session, answers, _ = rows_of(study, "Mouse")
    assert session.finished_at is not None
    assert (session.age, session.gender, session.education) == (33, "female", "master")
    assert (session.difficulty, session.technical_problems) == (4, False)
    assert session.feedback == "<img src=x onerror=alert(1)> 'ok'"
    assert (session.language, session.consent_version) == ("en", study.consent_version)
    assert [row.response for row in answers] == ["yes", "yes", "no", "yes"]
    assert {row.input for row in answers} == {"mouse"}
    assert not any(row.resumed for row in answers)
    labels = {stimulus.stimulus: stimulus.label for stimulus in study.stimuli}
    right = sum((row.response == "yes") == labels[row.stimulus] for row in answers[1:])
    assert f"{right} of 3 movies" in result


def test_a_session_by_keyboard_in_german(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    small = {"width": 1024, "height": 600}
    with Visit(chromium, url, "tasten", locale="de-DE", viewport=small, screen=small) as visit:
        page = visit.page
        visit.go("?participant=Tasten")
        visit.heading("Teilnahme an dieser Studie")
        assert page.get_attribute("html", "lang") == "de"
        # The focus is on the heading: the two buttons follow, and nothing else does.
        visit.press("Tab", "Tab", "Enter")
        for step, title in enumerate(("Was Sie tun", "Was Sie sehen", "Wie Sie antworten")):
            visit.heading(title)
            page.wait_for_timeout(200)
            visit.picture("instructions")
            visit.press(*["Tab"] * (1, 3, 2)[step], "Enter")
        for trial in range(4):
            if trial == 1:
                visit.heading("Es kann losgehen")
                visit.press("Tab", "Enter")
            # Keys pressed too early are not answers.
            page.locator(".trial:not(.has-verdict)").wait_for()
            visit.press("f", "j")
            visit.wait_for_answer()
            assert visit.page.evaluate("document.documentElement.scrollHeight") <= 600
            visit.answer("no", by="keyboard")
            if trial == 0:
                visit.main_button().wait_for()
                visit.press("Enter")  # the button has the focus
        visit.heading("Über Sie")
        visit.press("Tab", "4", "1", "Tab", "ArrowDown", "Tab", "ArrowDown")
        visit.press("Tab", "Enter")
        visit.heading("Wie war es?")
        visit.press("Tab", "Space", "Tab", "Tab", "Tab")
        visit.press("Enter")
        page.get_by_text("Bitte beantworten Sie diese Frage.").wait_for()
        page.locator("#technical-yes").focus()
        visit.press("Space", "Tab", "g", "u", "t", "Tab", "Enter")
        page.locator("#code").wait_for()
        visit.picture("result")
        assert visit.unexpected() == []
    session, answers, _ = rows_of(study, "Tasten")
    assert (session.language, session.age, session.gender) == ("de", 41, "female")
    assert (session.difficulty, session.technical_problems) == (1, True)
    assert session.feedback == "gut"
    assert [row.response for row in answers] == ["no"] * 4
    assert {row.input for row in answers} == {"keyboard"}
    assert {(row.window_width, row.window_height) for row in answers} == {(1024, 600)}


def test_a_session_in_firefox(firefox: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(firefox, url, "firefox") as visit:
        visit.to_the_test("?participant=Fox")
        for trial, (response, by) in enumerate(
            (("yes", "mouse"), ("no", "keyboard"), ("yes", "mouse"))
        ):
            visit.page.get_by_text(f"Trial {trial + 1} of 3").wait_for()
            visit.answer(response, by=by)
        visit.heading("About you")
        visit.finish()
        assert visit.page.inner_text("#code") == "TINY-CODE"
        assert visit.unexpected() == []
        assert visit.hosts() == {url.removeprefix("http://")}
    session, answers, _ = rows_of(study, "Fox")
    assert session.finished_at is not None and "Firefox/" in session.device["user_agent"]
    check_answers(session, answers)


def test_a_session_in_webkit(webkit: WebKit, site: tuple[Study, str]) -> None:
    study, url = site
    button = "main .button:not(.quiet):enabled"

    def answer(response: str, by: str = "mouse") -> None:
        enabled = f".answer[data-response={response}]:enabled"
        webkit.find(enabled)
        if by == "keyboard":
            left = webkit.run("return document.querySelector('.answer').dataset.response")
            webkit.press("f" if left == response else "j")
        else:
            webkit.click(enabled)
        webkit.gone(".answer:enabled")

    webkit.go(f"{url}/?participant=Kit&language=en")
    for title in ("Taking part", "What you will do", "What you will see", "How you answer"):
        webkit.find("h1", title)
        webkit.click(button)
    answer("yes")
    webkit.find(button)
    assert webkit.text(".verdict") == "Correct!"
    webkit.click(button)
    webkit.find("h1", "You are ready")
    webkit.click(button)
    for trial, (response, by) in enumerate(
        (("yes", "mouse"), ("no", "keyboard"), ("yes", "mouse"))
    ):
        webkit.find("#progress", f"Trial {trial + 1} of 3")
        answer(response, by)
    webkit.find("h1", "About you")
    webkit.type("#age", "33")
    for field, value in (("gender", "female"), ("education", "master")):
        webkit.click(f"#{field} option[value={value}]")
    webkit.click(button)
    webkit.click("label[for=difficulty-4]")
    webkit.click("label[for=technical-no]")
    webkit.type("#text", "<img src=x onerror=alert(1)> 'ok'")
    webkit.click(button)
    assert webkit.text("#code") == "TINY-CODE"
    webkit.go("about:blank")  # a page that is left sends its events
    wait_for(lambda: rows_of(study, "Kit")[2], "events")
    session, answers, events = rows_of(study, "Kit")
    assert session.finished_at is not None
    agent = session.device["user_agent"]
    assert "AppleWebKit/" in agent and "Chrome/" not in agent
    check_answers(session, answers)
    # No error, no movie that failed, no trial that was interrupted.
    assert [event.kind for event in events] == ["hidden"]


def check_answers(session: Any, answers: list[Any]) -> None:
    """Check what a browser other than Chromium stored of a session."""
    assert (session.age, session.gender, session.education) == (33, "female", "master")
    assert session.feedback == "<img src=x onerror=alert(1)> 'ok'"
    assert [row.response for row in answers] == ["yes", "yes", "no", "yes"]
    assert [row.input for row in answers] == ["mouse", "mouse", "keyboard", "mouse"]
    for row in answers:
        assert row.cue_ms > 400 and row.rt_ms > 0 and row.showings == 1
        # All say which frames they presented; a busy machine drops some.
        assert 0 < row.frames_shown <= row.frames_expected == 45
        frames = [frame for _, frame, _ in json.loads(row.details)["frames"]]
        assert frames[0] == 0 and max(frames) < row.frames_expected


SESSIONS = 4
"""Something may wake up even on an idle machine: one of so many sessions without it is enough."""
READ_FRAMES = """
window.framesRead = [];
window.readFrames = true;
const original = HTMLVideoElement.prototype.play;
HTMLVideoElement.prototype.play = function () {
  if (!window.readFrames) return original.call(this);
  const canvas = document.createElement("canvas");
  canvas.width = 6; canvas.height = 1;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const frames = [];
  window.framesRead.push(frames);
  const read = () => {
    const { videoWidth: w, videoHeight: h } = this;
    context.drawImage(this, 0, h * 15 / 16, w, 1, 0, 0, 6, 1);
    const pixels = context.getImageData(0, 0, 6, 1).data;
    frames.push([0, 1, 2, 3, 4, 5].reduce((n, i) => 2 * n + (pixels[4 * i] > 127 ? 1 : 0), 0));
    this.requestVideoFrameCallback(read);
  };
  read();
  return original.call(this);
};
"""
"""Script that reads the numbers of presented frames from the pixels of each movie."""


@pytest.mark.alone
def test_timing_of_the_paper(chromium: Any, tmp_path: Path) -> None:
    """Fixation, 2 s of flashing at 2 Hz, and all of 45 frames and no later one.

    Frames are read from the pixels in the first test trial, which may drop some.
    """
    found = []
    with served(tmp_path, size=256, preload=2, timing=Timing()) as (study, server):
        for number in range(SESSIONS):
            with Visit(chromium, server.url) as visit:
                visit.context.add_init_script(READ_FRAMES)
                visit.to_the_test(f"?participant=Timed{number}")
                for trial in range(3):
                    visit.page.get_by_text(f"Trial {trial + 1} of 3").wait_for()
                    # Exactly two trials are loaded ahead.
                    ahead = set(range(min(trial + 2, 3)))
                    assert loaded_of_test(visit, ahead) == ahead
                    visit.wait_for_answer()
                    visit.page.evaluate("window.readFrames = false")
                    visit.answer("yes")
                visit.heading("About you")
                seen = visit.page.evaluate("window.framesRead")[-1]
            found.append(check_timing(answers_to_test(study, f"Timed{number}"), seen))
            if found[-1] is None:
                return
    pytest.fail(f"what was late or lost, by session: {found}")


def check_timing(answers: list[Any], seen: list[int]) -> Any:
    """Check what holds on a busy machine too; return what was late or lost, None if nothing."""
    assert max(seen) == 44 and seen[0] == 0
    assert len(set(seen)) <= answers[0].frames_shown
    late = []
    for row in answers:
        details = json.loads(row.details)
        # A busy machine may drop frames, but none may be invented.
        assert row.frames_shown <= row.frames_expected == 45
        assert row.frames_shown + row.frames_dropped >= 44
        assert details["frames"][-1][1] == 44 or row.frames_dropped > 0
        assert row.fixation_ms >= 500
        assert row.cue_ms > 1940
        # A movie that starts late is watched for less time, but not played for less.
        assert row.movie_ms + details["play_ms"] > 1440
        flashes = details["flashes"]
        assert [on for _, on in flashes] == [True, False] * 4
        delays = [at - 250 * i for i, (at, _) in enumerate(flashes)]
        assert min(delays) > -60
        assert details["enabled_ms"] >= details["ended_ms"]
        late.append((row.cue_ms - 2000, max(delays), details["enabled_ms"] - details["ended_ms"]))
    cue, flash, enabled = (median(times) for times in zip(*late, strict=True))
    shown = [row.frames_shown for row in answers]
    fixation, movie = (median(getattr(r, n) for r in answers) for n in ("fixation_ms", "movie_ms"))
    good = shown[1:] == [45, 45] and shown[0] >= 38 and cue < 60 and flash < 60 and enabled < 100
    good = good and fixation <= 1700 and 1440 < movie < 1600
    return None if good else (shown, cue, flash, enabled, fixation, movie)


def loaded_of_test(visit: Visit, wanted: set[int]) -> set[int]:
    """Return the test trials whose movies were requested, shortly after those ``wanted`` were."""
    loaded: set[int] = set()
    for _ in range(100):
        visit.page.wait_for_timeout(300)
        found = (re.search(r"/t-(\d+)-movie-", address) for address in visit.requests)
        loaded = {int(match[1]) for match in found if match}
        if loaded >= wanted:
            break
    return loaded


COUNT = """async (cases) => {
  const loaded = performance.getEntriesByType("resource").map((entry) => entry.name);
  const { FrameCount } = await import(loaded.find((name) => name.endsWith("/screen.js")));
  return cases.map((reports) => {
    const frames = new FrameCount(30);
    for (const [frame, presentedFrames] of reports)
      frames.add(0, { mediaTime: frame / 30, presentedFrames });
    return frames.shown;
  });
}"""
EVERY = [(frame, frame + 1) for frame in range(45)]
CASES = {
    "no report": ([], 0),
    "every frame": (EVERY, 45),
    "the first frame twice": ([(0, 1), *((frame, count + 1) for frame, count in EVERY)], 45),
    "missed reports": ([(0, 1), (3, 4), (44, 45)], 45),
    "dropped frames": ([(0, 1), (3, 2), (44, 23)], 23),
    "missed reports and dropped frames": ([(0, 1), (10, 6)], 6),
    "more presented than there are frames between": ([(0, 1), (2, 9)], 3),
    # Once counted 52 of 45 frames.
    "a report too early": ([(0, 1), (8, 2), *((f, f + 2) for f in range(1, 45))], 45),
    "a counter that stands still": ([(0, 1), (1, 1), (2, 1)], 3),
}


def test_each_presented_frame_counts_once(chromium: Any, site: tuple[Study, str]) -> None:
    with Visit(chromium, site[1]) as visit:
        visit.go("?participant=Count")
        visit.heading()
        counts = visit.page.evaluate(COUNT, [reports for reports, _ in CASES.values()])
    expected = {name: count for name, (_, count) in CASES.items()}
    assert dict(zip(CASES, counts, strict=True)) == expected


def test_times_are_measured_from_the_event_they_name(chromium: Any, tmp_path: Path) -> None:
    """A response time counts from the enabled buttons to the press of the mouse."""
    # Long enough to press the button before the trial can be answered.
    timing = Timing(fixation_ms=(3000, 3000), fixation_in_familiarization=False,
                    cue_ms=SHORT.cue_ms)  # fmt: skip
    with (
        served(tmp_path, test=2, timing=timing) as (study, server),
        Visit(chromium, server.url) as visit,
    ):
        visit.context.add_init_script(WATCH_PRESSES)
        visit.to_the_test("?participant=Press")
        box = visit.page.locator(".answer").first.bounding_box()
        visit.page.mouse.move(box["x"] + 20, box["y"] + 20)
        visit.page.mouse.down()
        visit.wait_for_answer()
        visit.page.mouse.up()
        visit.page.wait_for_timeout(300)
        assert visit.page.locator(".answer:enabled").count() == 2
        # The time of the press counts, not that of the release.
        visit.page.mouse.down()
        enabled, pressed = visit.page.evaluate("[window.enabledAt, window.pressedAt]")
        visit.page.wait_for_timeout(1500)
        visit.page.mouse.up()
        visit.page.get_by_text("Trial 2 of 2").wait_for()
        visit.answer("no", by="keyboard")
        visit.heading("About you")
        enabled_again, key = visit.page.evaluate("[window.enabledAt, window.keyAt]")
        assert visit.unexpected() == []
    first, second = answers_to_test(study, "Press")
    assert (first.input, second.input) == ("mouse", "keyboard")
    # Ten times less than the time until the release, and than the time of the trial.
    assert first.rt_ms >= 300 and first.rt_ms == pytest.approx(pressed - enabled, abs=150)
    assert second.rt_ms == pytest.approx(key - enabled_again, abs=150)
    assert all(row.fixation_ms >= 3000 - 20 and row.fixation_ms < 4500 for row in (first, second))


WATCH_PRESSES = """
new MutationObserver((changes) => {
  if (changes.some(({ target }) => target.matches?.(".answer:enabled")))
    window.enabledAt = performance.now();
}).observe(document, { subtree: true, attributes: true, attributeFilter: ["disabled"] });
document.addEventListener("pointerdown", (event) => (window.pressedAt = event.timeStamp), true);
document.addEventListener("keydown", (event) => (window.keyAt = event.timeStamp), true);
"""
"""Script that notes when the buttons were enabled, the mouse was pressed and a key was pressed."""
