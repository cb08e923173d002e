"""Whole sessions in a real browser on a real server."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.settings import Timing
from physion.experiment.study.study import Study
from support.experiment.browser import SHORT, Visit, chromium, rows_of, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    # Long enough to look at a trial, and to press keys, before it can be answered.
    timing = replace(SHORT, fixation_ms=(2000, 2000))
    with served(tmp_path_factory.mktemp("study"), timing=timing) as (study, server):
        yield study, server.url


def test_a_whole_session_by_mouse(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "mouse") as visit:
        visit.go("?participant=Mouse&language=en")
        visit.heading("Taking part in this study")
        assert "Ada Lab" in visit.page.inner_text("main")
        visit.picture("consent")
        visit.main_button().click()
        for title in ("What you will do", "What you will see", "How you answer"):
            visit.heading(title)
            visit.page.wait_for_timeout(300)
            visit.picture("instructions")
            visit.main_button().click()
        told = []
        for trial in range(2):
            visit.page.locator(".trial:not(.has-verdict)").wait_for()
            visit.picture("cue")
            assert visit.page.locator(".answer:enabled").count() == 0
            # The full movie is requested only after the answer.
            assert sum("-full-" in address for address in visit.requests) == trial
            visit.answer("yes")
            visit.page.locator(".verdict-correct, .verdict-incorrect").wait_for()
            visit.picture("feedback")
            told.append(visit.see_feedback())
            assert sum("-full-" in address for address in visit.requests) == trial + 1
        # Labels of the tiny study alternate, the first with contact.
        assert told == ["Correct!", "Not correct."]
        visit.picture("ready")
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
        correct = visit.page.inner_text("main")
        assert visit.unexpected() == []
        assert visit.hosts() == {url.removeprefix("http://")}
        assert "participant" not in visit.page.url
    session, answers, _ = rows_of(study, "Mouse")
    assert session.finished_at is not None
    assert (session.age, session.gender, session.education) == (33, "female", "master")
    assert (session.difficulty, session.technical_problems) == (4, False)
    assert session.feedback == "<img src=x onerror=alert(1)> 'ok'"
    assert (session.language, session.consent_version) == ("en", study.consent_version)
    assert [row.response for row in answers] == ["yes", "yes", "yes", "no", "yes"]
    assert {row.input for row in answers} == {"mouse"}
    assert not any(row.resumed for row in answers)
    labels = {stimulus.stimulus: stimulus.label for stimulus in study.stimuli}
    right = sum((row.response == "yes") == labels[row.stimulus] for row in answers[2:])
    assert f"{right} of 3 movies" in correct


def test_a_whole_session_by_keyboard_in_german(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    small = {"width": 1024, "height": 600}
    with Visit(chromium, url, "tasten", locale="de-DE", viewport=small, screen=small) as visit:
        page = visit.page
        visit.go("?participant=Tasten")
        visit.heading("Teilnahme an dieser Studie")
        assert page.get_attribute("html", "lang") == "de"
        visit.picture("consent")
        # The focus is on the heading: the two buttons follow, and nothing else does.
        visit.press("Tab", "Tab", "Enter")
        for step, title in enumerate(("Was Sie tun", "Was Sie sehen", "Wie Sie antworten")):
            visit.heading(title)
            page.wait_for_timeout(200)
            visit.picture("instructions")
            visit.press(*["Tab"] * (1, 3, 2)[step], "Enter")
        for trial in range(5):
            if trial == 2:
                visit.heading("Es kann losgehen")
                visit.picture("ready")
                visit.press("Tab", "Enter")
            # Keys pressed too early are not answers.
            page.locator(".trial:not(.has-verdict)").wait_for()
            visit.press("f", "j")
            visit.wait_for_answer()
            assert visit.page.evaluate("document.documentElement.scrollHeight") <= 600
            visit.picture("trial")
            visit.answer("no", by="keyboard")
            if trial < 2:
                visit.main_button().wait_for()
                visit.picture("feedback")
                visit.press("Enter")  # the button has the focus
        visit.heading("Über Sie")
        visit.press("Tab", "4", "1", "Tab", "ArrowDown", "Tab", "ArrowDown")
        visit.picture("demographics")
        visit.press("Tab", "Enter")
        visit.heading("Wie war es?")
        visit.press("Tab", "Space", "Tab", "Tab", "Tab")
        visit.press("Enter")
        page.get_by_text("Bitte beantworten Sie diese Frage.").wait_for()
        visit.picture("feedback-open")
        page.locator("#technical-yes").focus()
        visit.press("Space", "Tab", "g", "u", "t", "Tab", "Enter")
        page.locator("#code").wait_for()
        visit.picture("result")
        assert visit.unexpected() == []
    session, answers, _ = rows_of(study, "Tasten")
    assert (session.language, session.age, session.gender) == ("de", 41, "female")
    assert (session.difficulty, session.technical_problems) == (1, True)
    assert session.feedback == "gut"
    assert [row.response for row in answers] == ["no"] * 5
    assert {row.input for row in answers} == {"keyboard"}
    assert {(row.window_width, row.window_height) for row in answers} == {(1024, 600)}


@pytest.mark.alone
def test_timing_of_the_paper(chromium: Any, tmp_path: Path) -> None:
    """Fixation, 2 s of flashing at 2 Hz, and 45 frames and no later one, read from the pixels."""
    with (
        served(tmp_path, test=4, familiarization=1, preload=2, timing=Timing()) as (study, server),
        Visit(chromium, server.url) as visit,
    ):
        visit.context.add_init_script(READ_FRAMES)
        visit.begin("?participant=Timed")
        visit.practise(1)
        visit.begin_test()
        for trial in range(4):
            visit.page.get_by_text(f"Trial {trial + 1} of 4").wait_for()
            # Exactly two trials are loaded ahead.
            ahead = set(range(min(trial + 2, 4)))
            assert loaded_of_test(visit, ahead) == ahead
            visit.answer("yes")
        visit.heading("About you")
        seen = visit.page.evaluate("window.framesRead")
    _, answers, _ = rows_of(study, "Timed")
    answers = [row for row in answers if row.phase == "test"]
    late: list[tuple[float, float, float]] = []
    # The last movies that were played are those of the test.
    for row, frames in zip(answers, seen[-4:], strict=True):
        details = json.loads(row.details)
        assert max(frames) <= 44 and frames[0] == 0
        assert row.frames_expected == 45
        # A busy machine may drop frames, but none may be invented.
        assert row.frames_shown <= 45
        assert len(set(frames)) <= row.frames_shown
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
    # Something may hold up one trial, but not most of them.
    assert median(row.frames_shown for row in answers) >= 38
    assert max(row.frames_shown for row in answers) == 45
    assert median(row.fixation_ms for row in answers) <= 1700
    assert 1440 < median(row.movie_ms for row in answers) < 1700
    cue, flash, enabled = (median(times) for times in zip(*late, strict=True))
    assert cue < 60 and flash < 60 and enabled < 100


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


READ_FRAMES = """
window.framesRead = [];
const original = HTMLVideoElement.prototype.play;
HTMLVideoElement.prototype.play = function () {
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
