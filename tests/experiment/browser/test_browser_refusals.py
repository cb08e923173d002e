"""Refused visitors, and problems with movies and windows, in a real browser."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

import sqlalchemy as sa

from physion.experiment.store.database import RAW_IDS, SESSIONS, open_database
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import Recruitment
from physion.experiment.study.study import Study
from support.experiment.browser import HIDE, SHORT, Visit, chromium, rows_of, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
SMALL = {"width": 900, "height": 560}
LARGE = {"width": 1280, "height": 800}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    folder = tmp_path_factory.mktemp("study")
    decided = Recruitment(id_needed=True, prolific_code="PROLIFIC7", link_code="TINY-CODE")
    with served(folder, test=2, familiarization=1, recruitment=decided) as (study, server):
        yield study, server.url


def stored(study: Study, table: sa.Table) -> list[Any]:
    engine = open_database(study.folder)
    try:
        with engine.connect() as connection:
            return list(connection.execute(sa.select(table)).all())
    finally:
        engine.dispose()


PHONE = {
    "viewport": {"width": 1100, "height": 700},
    "screen": {"width": 1100, "height": 700},
    "has_touch": True,
    "is_mobile": True,
}


TABLET = {"viewport": SMALL, "screen": SMALL, "has_touch": True}


@pytest.mark.parametrize(
    ("query", "context", "script", "told"),
    [
        ("?participant=Phone", PHONE, "", "does not work on phones and tablets"),
        ("?participant=Screen", TABLET, "matchMedia = () => ({matches: true})", "screen of this"),
        (
            "?participant=Old",
            {},
            "delete HTMLVideoElement.prototype.requestVideoFrameCallback",
            "browser is too old",
        ),
        (
            "?participant=Codec",
            {},
            "HTMLVideoElement.prototype.canPlayType = () => ''",
            "cannot play our movies",
        ),
        ("", {}, "", "your number is missing"),
        ("?participant=Word&pass=preview-0000", {}, "", "no longer valid"),
        ("?participant=Part&scenario=nothing", {}, "", "no longer valid"),
        ("?workerId=W&assignmentId=ASSIGNMENT_ID_NOT_AVAILABLE", {}, "", "Accept it to begin"),
        ("?language=de", {}, "", "Ihre Nummer fehlt"),
    ],
)
def test_refused_visitors(
    chromium: Any, site: tuple[Study, str], query: str, context: Any, script: str, told: str
) -> None:
    study, url = site
    before = len(stored(study, SESSIONS))
    with Visit(chromium, url, "refused", **context) as visit:
        if script:
            visit.context.add_init_script(script)
        visit.go(query)
        visit.page.get_by_text(told).wait_for()
        visit.picture(query[1:8].replace("=", "-") or "nobody")
        assert visit.page.locator(".button:not(.quiet)").count() == 0
        complaints = [line for line in visit.unexpected() if "status of 403" not in line]
        assert complaints == []
    assert len(stored(study, SESSIONS)) == before


def test_without_script_the_page_says_so(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, java_script_enabled=False) as visit:
        visit.go()
        said = visit.page.inner_text("main")
        for language in study.languages:
            assert study.texts[language]["refusal.no_script"] in said


def test_old_browsers_get_a_message_without_modules(chromium: Any, site: tuple[Study, str]) -> None:
    """A browser without modules only runs the script marked nomodule."""
    study, url = site
    with Visit(chromium, url) as visit:
        visit.context.route("**/static/main.js", lambda route: route.abort())
        visit.go()
        assert not visit.page.locator("#too-old").is_visible()
        visit.page.evaluate(
            "const old = document.createElement('script');"
            "old.src = document.querySelector('script[nomodule]').src; document.body.append(old);"
        )
        for language in study.languages:
            visit.page.get_by_text(study.texts[language]["refusal.browser"]).wait_for()


def test_trials_wait_while_the_window_is_too_small(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    # As on a laptop with scaling or zoom: everything but the trials is possible.
    with Visit(chromium, url, "window", viewport=SMALL, screen=SMALL) as visit:
        visit.begin("?participant=Window")
        visit.heading("Please make the window larger")
        visit.picture("small")
        visit.page.set_viewport_size(LARGE)
        visit.wait_for_answer()
        # In the middle of a session, before the next trial.
        visit.page.set_viewport_size(SMALL)
        visit.answer("yes")
        visit.see_feedback()
        visit.begin_test()
        visit.heading("Please make the window larger")
        visit.page.set_viewport_size(LARGE)
        visit.answer("yes")
        visit.answer("yes")
        visit.heading("About you")
        visit.finish()
        assert visit.unexpected() == []
    _, answers, events = rows_of(study, "Window")
    assert {(row.window_width, row.window_height) for row in answers[1:]} == {(1280, 800)}
    assert "too_small" in {event.kind for event in events}


def test_movies_that_fail_are_shown_again(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "movie") as visit:
        asked: list[str] = []

        def spoil(route: Any) -> None:
            asked.append(route.request.url)
            times = asked.count(route.request.url)
            if "/t-0-movie-" in route.request.url and times == 1:
                route.fulfill(body=b"no movie", content_type="video/mp4")
            elif "/t-1-map-" in route.request.url and times <= 2:
                refusal = {"error": "not_found", "message": "no such movie or picture"}
                route.fulfill(status=404, json=refusal)
            else:
                route.continue_()

        visit.context.route("**/media/*", spoil)
        visit.begin("?participant=Movie")
        visit.practise(1)
        visit.begin_test()
        visit.page.get_by_text("The movies could not be loaded.").wait_for()
        visit.picture("not-loaded")
        visit.main_button().click()
        visit.page.get_by_text("The movie could not be played.").wait_for()
        visit.picture("not-played")
        visit.answer("yes")
        visit.answer("no")
        visit.heading("About you")
        visit.finish()
    _, answers, events = rows_of(study, "Movie")
    assert [json.loads(row.details)["attempts"] for row in answers] == [1, 2, 1]
    assert [row.response for row in answers[1:]] == ["yes", "no"]
    assert "movie_failed" in {event.kind for event in events}


def test_hiding_the_page_is_recorded(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url) as visit:
        visit.begin("?participant=Hidden")
        visit.page.locator(".trial").wait_for()
        visit.page.evaluate(HIDE, True)
        visit.page.wait_for_timeout(200)
        visit.page.evaluate(HIDE, False)
        visit.practise(1)
        visit.begin_test()
        visit.answer("yes")
        visit.answer("yes")
        visit.heading("About you")
    _, answers, events = rows_of(study, "Hidden")
    assert [row.visibility_changes for row in answers] == [2, 0, 0]
    changes = json.loads(answers[0].details)["visibility"]
    assert [state for _, state in changes] == ["hidden", "visible"]
    assert {"hidden", "visible"} <= {event.kind for event in events}


HIDE_AT = f"""
const hide = {HIDE};
window.hideAt = [];
let last = null;
new MutationObserver(() => {{
  const place = window.hideAt.length > 0 ? document.querySelector(window.hideAt[0]) : null;
  if (!place || place === last || document.hidden) return;
  last = place;
  window.hideAt.shift();
  hide(true);
  setTimeout(hide, 300, false);
}}).observe(document, {{ subtree: true, childList: true, attributes: true }});"""
"""Script that hides the page for a moment as soon as the first element of `hideAt` appears."""


def test_a_trial_that_was_hidden_is_shown_again(chromium: Any, site: tuple[Study, str]) -> None:
    """It restarts at the fixation cross, unless the page was hidden after the movie."""
    study, url = site
    with Visit(chromium, url) as visit:
        visit.context.add_init_script(HIDE_AT)
        visit.begin("?participant=Again")
        visit.practise(1)
        visit.heading("You are ready")
        # The cross lasts too short a time to find it from here; then the cue.
        visit.page.evaluate("window.hideAt = ['.fixation', '.screen-cover[hidden]']")
        visit.begin_test()
        visit.wait_for_answer()
        visit.page.evaluate(HIDE, True)
        visit.page.evaluate(HIDE, False)
        visit.page.evaluate("window.hideAt = Array(6).fill('.fixation')")
        visit.answer("yes")
        visit.answer("no")  # the last time the trial continued
        assert visit.page.evaluate("window.hideAt") == []
        visit.heading("About you")
        assert visit.unexpected() == []
    answers = [row for row in rows_of(study, "Again")[1] if row.phase == "test"]
    details = [json.loads(row.details) for row in answers]
    assert [(one["attempts"], one["hidden"]) for one in details] == [(3, 2), (6, 6)]
    assert [row.visibility_changes for row in answers] == [6, 12]
    assert [row.void for row in answers] == [None, "hidden"]
    for row, one in zip(answers, details, strict=True):
        assert row.cue_ms >= 440
        assert [on for _, on in one["flashes"]] == [True, False]
        assert row.frames_shown > 0


WATCH_PRESSES = """
new MutationObserver((changes) => {
  if (changes.some(({ target }) => target.matches?.(".answer:enabled")))
    window.enabledAt = performance.now();
}).observe(document, { subtree: true, attributes: true, attributeFilter: ["disabled"] });
document.addEventListener("pointerdown", (event) => (window.pressedAt = event.timeStamp), true);
"""
"""Script that notes when the buttons of a trial were enabled and when the mouse was pressed."""


def test_a_press_that_began_earlier_is_not_an_answer(chromium: Any, tmp_path: Path) -> None:
    # Long enough to press the button before the trial can be answered.
    timing = replace(SHORT, fixation_ms=(4000, 4000), fixation_in_familiarization=False)
    with (
        served(tmp_path, test=2, familiarization=1, timing=timing) as (study, server),
        Visit(chromium, server.url) as visit,
    ):
        visit.context.add_init_script(WATCH_PRESSES)
        visit.begin("?participant=Press")
        visit.practise(1)
        visit.begin_test()
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
        visit.answer("no")
        visit.heading("About you")
        assert visit.unexpected() == []
    first = next(row for row in rows_of(study, "Press")[1] if row.phase == "test")
    assert first.input == "mouse" and first.rt_ms >= 300
    # The release came at least 1500 ms after the press.
    assert first.rt_ms == pytest.approx(pressed - enabled, abs=500)


def test_stopping_for_good(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "stop") as visit:
        visit.begin("?participant=Stop")
        visit.page.locator(".answer").first.wait_for()
        visit.page.get_by_text("Stop taking part").click()
        visit.heading("Do you want to stop?")
        visit.picture("asked")
        visit.page.get_by_text("Go on with the study").click()
        visit.practise(1)
        visit.begin_test()
        visit.page.get_by_text("Stop taking part").click()
        visit.page.get_by_text("Stop for good").click()
        visit.heading("You have stopped")
        visit.picture("stopped")
        assert rows_of(study, "Stop")[0].reference in visit.page.inner_text("main")
        visit.page.reload()
        visit.heading("You have stopped")
        assert visit.unexpected() == []
    session, answers, _ = rows_of(study, "Stop")
    assert session.withdrawn_at is not None and session.finished_at is None
    assert len(answers) == 1


def test_recruiters(chromium: Any, site: tuple[Study, str]) -> None:
    """Prolific's ids are stored apart and removed from the URL; the result links back."""
    study, url = site
    with Visit(chromium, url, "prolific") as visit:
        visit.go("?PROLIFIC_PID=5f00&STUDY_ID=s1&SESSION_ID=v1&language=de")
        visit.page.select_option("#language", "en")
        visit.heading("Taking part in this study")
        visit.main_button().click()
        visit.heading("What you will do")
        assert visit.page.url == f"{url}/"
        assert "5f00" not in visit.page.evaluate("JSON.stringify(localStorage)")
        for _ in range(3):
            visit.heading()
            visit.main_button().click()
        visit.practise(1)
        visit.begin_test()
        visit.answer("yes")
        visit.answer("no")
        visit.heading("About you")
        visit.finish()
        visit.picture("result")
        address = "https://app.prolific.com/submissions/complete?cc=PROLIFIC7"
        assert visit.page.get_attribute("#go", "href") == address
        assert visit.unexpected() == []
    (raw,) = [row for row in stored(study, RAW_IDS) if row.source == "prolific"]
    assert (raw.raw_id, raw.recruiter) == ("5f00", {"STUDY_ID": "s1", "SESSION_ID": "v1"})
    (session,) = [row for row in stored(study, SESSIONS) if row.source == "prolific"]
    assert session.language == "en"


def test_previews_need_no_id(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    word = make_pass(Secrets.load(study.folder), "preview")
    with Visit(chromium, url) as visit:
        visit.go(f"?pass={word}")
        visit.heading("Taking part in this study")
        visit.main_button().click()
        visit.heading("What you will do")
        visit.page.reload()
        visit.heading("What you will do")
    assert [row.kind for row in stored(study, SESSIONS)].count("preview") == 1
