"""Entering and ending: refusals, recruiters, several people; declining, stopping, the result."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import pytest
import sqlalchemy as sa

from physion.experiment.store.database import PARTICIPANTS, RAW_IDS, SESSIONS, open_database
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import EarlyEnd, Recruitment
from physion.experiment.study.study import Study
from support.experiment.browser import (
    FAST,
    MTURK,
    Visit,
    answers_to_test,
    rows_of,
    served,
    signed_query,
)

pytestmark = pytest.mark.slow
SMALL = {"width": 900, "height": 560}
PHONE = {
    "viewport": {"width": 1100, "height": 700},
    "screen": {"width": 1100, "height": 700},
    "has_touch": True,
    "is_mobile": True,
}
TABLET = {"viewport": SMALL, "screen": SMALL, "has_touch": True}
NEXT = "Another person takes part on this computer"


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    """A study of one participant who needs an id, with codes for those whom it refuses."""
    settings: dict[str, Any] = {
        "recruitment": Recruitment(id_needed=True, link_code="TINY-CODE"),
        "participants": 1,
        "device_refused": EarlyEnd("PHONE", "phone"),
        "full": EarlyEnd("FULL", "full"),
    }
    with served(tmp_path_factory.mktemp("study"), test=1, **settings) as (study, server):
        yield study, server.url


def stored(study: Study, table: sa.Table) -> list[Any]:
    engine = open_database(study.folder)
    try:
        with engine.connect() as connection:
            return list(connection.execute(sa.select(table)).all())
    finally:
        engine.dispose()


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
    chromium: Any, single: tuple[Study, str], query: str, context: Any, script: str, told: str
) -> None:
    study, url = single
    before = len(stored(study, SESSIONS))
    with Visit(chromium, url, "refused", **context) as visit:
        if script:
            visit.context.add_init_script(script)
        visit.go(query)
        visit.page.get_by_text(told).wait_for()
        visit.picture(query[1:8].replace("=", "-") or "nobody")
        # Refused devices have a way back to the recruiter, with the code of their table.
        device = any(name in query for name in ("Phone", "Screen", "Old", "Codec"))
        assert visit.page.locator("#code").all_inner_texts() == (["phone"] if device else [])
        if not device:
            assert visit.page.locator(".button:not(.quiet)").count() == 0
        complaints = [line for line in visit.unexpected() if "status of 403" not in line]
        assert complaints == []
    assert len(stored(study, SESSIONS)) == before


def test_refused_devices_and_full_studies_have_their_codes(
    chromium: Any, single: tuple[Study, str]
) -> None:
    _, url = single
    with Visit(chromium, url, "phone", **PHONE) as visit:
        visit.go("?PROLIFIC_PID=5f0000000000000000000000")
        visit.page.get_by_text("does not work on phones").wait_for()
        visit.picture("refused")
        address = "https://app.prolific.com/submissions/complete?cc=PHONE"
        assert visit.page.get_attribute("#go", "href") == address
    with Visit(chromium, url) as visit:
        visit.take_part("?participant=First", "yes")
    with Visit(chromium, url, "full") as visit:
        visit.go("?participant=Late")
        visit.page.get_by_text("Enough people have taken part").wait_for()
        assert visit.page.inner_text("#code") == "full"


def test_pages_without_script_or_modules_say_so(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, java_script_enabled=False) as visit:
        visit.go()
        said = visit.page.inner_text("main")
        for language in study.languages:
            assert study.texts[language]["refusal.no_script"] in said
    with Visit(chromium, url) as visit:
        # A browser without modules runs only the script marked nomodule.
        visit.context.route("**/static/main.js", lambda route: route.abort())
        visit.go()
        assert not visit.page.locator("#too-old").is_visible()
        visit.page.evaluate(
            "const old = document.createElement('script');"
            "old.src = document.querySelector('script[nomodule]').src; document.body.append(old);"
        )
        for language in study.languages:
            visit.page.get_by_text(study.texts[language]["refusal.browser"]).wait_for()


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
        for response in ("yes", "no", "no"):
            visit.answer(response)
        visit.heading("About you")
        visit.finish()
        address = "https://app.prolific.com/submissions/complete?cc=PROLIFIC7"
        assert visit.page.get_attribute("#go", "href") == address
        assert visit.unexpected() == []
    (raw,) = [row for row in stored(study, RAW_IDS) if row.source == "prolific"]
    assert (raw.raw_id, raw.recruiter) == ("5f00", {"STUDY_ID": "s1", "SESSION_ID": "v1"})
    (session,) = [row for row in stored(study, SESSIONS) if row.source == "prolific"]
    assert session.language == "en"


def test_previews_need_no_id(chromium: Any, single: tuple[Study, str]) -> None:
    study, url = single
    word = make_pass(Secrets.load(study.folder), "preview")
    with Visit(chromium, url) as visit:
        visit.go(f"?pass={word}")
        visit.heading("Taking part in this study")
        visit.main_button().click()
        visit.heading("What you will do")
        visit.page.reload()
        visit.heading("What you will do")
    assert [row.kind for row in stored(study, SESSIONS)].count("preview") == 1


# --- several people at one computer --------------------------------------------------------------


def references(study: Study) -> list[str]:
    """Return the references of all sessions, of as many people in these tests."""
    assert len(stored(study, PARTICIPANTS)) == len(stored(study, SESSIONS))
    return [row.reference for row in stored(study, SESSIONS)]


def test_nobody_gets_the_result_of_another(chromium: Any, site: tuple[Study, str]) -> None:
    """A took part elsewhere, B here: A's link shows no more here than anywhere else.

    Here the browser has no cryptography, as without HTTPS: ids are distinguished by a plain hash.
    """
    study, url = site
    a, b = "Plain-A", "Plain-B"
    digits = "JSON.parse(localStorage.getItem('physion:session')).who.length"
    with Visit(chromium, url) as elsewhere:
        elsewhere.take_part(f"?participant={a}", "yes", "yes", "yes")
        assert elsewhere.page.evaluate(digits) == 64
    with Visit(chromium, url) as visit:
        visit.context.add_init_script("Object.defineProperty(crypto, 'subtle', {value: null})")
        visit.take_part(f"?participant={b}", "no", "no", "no")
        assert visit.page.evaluate(digits) == 16
        reference = rows_of(study, b)[0].reference
        assert reference in visit.page.inner_text("main")
        visit.go(f"?participant={a}")
        visit.page.get_by_text("You have already taken part").wait_for()
        assert visit.page.locator("#code").count() == 0
        assert reference not in visit.page.inner_text("main")
        assert visit.page.get_by_text(NEXT).count() == 0
        # B still finds their own result, also after a reload.
        for query in (f"?participant={b}", ""):
            visit.go(query)
            visit.page.get_by_text(reference).wait_for()
        assert visit.page.get_by_text(NEXT).count() == 0
        # A third person begins; B, who opens their link meanwhile, continues as B.
        visit.go(f"?participant={a}-third")
        visit.heading("Taking part in this study")
        visit.go()
        visit.heading("Taking part in this study")


def test_entering_twice_begins_one_session(chromium: Any, site: tuple[Study, str]) -> None:
    """The response to the first request is lost, and the page retries."""
    study, url = site
    before = references(study)
    with Visit(chromium, url) as visit:
        words: list[str] = []

        def lose_the_answer(route: Any) -> None:
            words.append(route.request.post_data_json["visit"])
            if len(words) == 1:
                assert route.fetch().status == 200
                route.abort()
            else:
                route.continue_()

        visit.context.route("**/api/enter", lose_the_answer)
        visit.go()
        visit.heading("Taking part in this study")
        assert len(words) == 2 and len(set(words)) == 1
        assert len(references(study)) == len(before), "nothing is stored before the consent"
        # Not even a browser that lost the token begins a second one.
        visit.page.evaluate("localStorage.removeItem('physion:session')")
        visit.go()
        visit.heading("Taking part in this study")
        assert len(set(words)) == 1 and len(words) == 3
        visit.main_button().click()
        visit.page.locator("#language").wait_for(state="detached")
    assert len(references(study)) == len(before) + 1


@pytest.mark.nightly
def test_the_next_person_at_this_computer(chromium: Any, site: tuple[Study, str]) -> None:
    """Also where the token of a finished session was lost."""
    study, url = site
    before = len(references(study))
    with Visit(chromium, url, "shared") as visit:
        visit.take_part("?scenario=collide&language=en", "yes", "no", "no")
        visit.page.reload()
        visit.page.locator("#code").wait_for()
        visit.page.get_by_text(NEXT).click()
        visit.heading("Taking part in this study")
        assert visit.page.get_by_text(NEXT).count() == 0
        # The parameters of the link are kept.
        link = f"{url}/?scenario=collide&language=en"
        assert visit.requests.count(link) == 2
        visit.page.get_by_text("I do not want to take part").click()
        visit.page.get_by_role("button", name="I do not take part").click()
        visit.heading("You do not take part")
        visit.page.get_by_text(NEXT).click()
        visit.heading("Taking part in this study")
        assert visit.unexpected() == []
        assert len(references(study)) == before + 1, "who does not agree leaves nothing"
        visit.take_part("", "yes", "no", "no")
        visit.page.evaluate("localStorage.removeItem('physion:session')")
        visit.go()
        visit.page.get_by_text("You have already taken part").wait_for()
        visit.page.get_by_text(NEXT).click()
        visit.heading("Taking part in this study")


# --- the end of a session -------------------------------------------------------------------------


SCREEN = """
Object.defineProperty(screen, "width", {value: 1280});
Object.defineProperty(screen, "height", {value: 800});
"""
"""What Playwright tells pages of the screen does not reach frames of other sites."""
COUNT_PLAYS = """
window.plays = 0;
const original = HTMLVideoElement.prototype.play;
HTMLVideoElement.prototype.play = function () { window.plays += 1; return original.call(this); };
"""


@pytest.fixture(scope="module")
def strict(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    """A study whose sessions are implausible unless they take an hour; declining has a code."""
    rules = replace(FAST, reading_s=3600.0)
    declined = EarlyEnd("NOCONSENT", "no-consent", "https://lab.example/declined")
    folder = tmp_path_factory.mktemp("study")
    with served(folder, test=2, plausibility=rules, declined=declined) as (study, server):
        yield study, server.url


def count_rows(study: Study) -> dict[str, int]:
    """Return the number of rows in those tables that know of persons."""
    with sqlite3.connect(study.folder / "responses.sqlite") as database:
        return {
            name: database.execute(f"SELECT count(*) FROM {name}").fetchone()[0]
            for name in ("sessions", "raw_ids", "events", "participants")
        }


def decline(visit: Visit) -> None:
    visit.page.get_by_text("I do not want to take part").click()
    visit.heading("Do you really not want to take part?")
    visit.page.get_by_role("button", name="I do not take part").click()
    visit.heading("You do not take part")


def test_declining_is_asked_once_more_and_leaves_nothing(
    chromium: Any, strict: tuple[Study, str]
) -> None:
    study, url = strict
    before = count_rows(study)
    with Visit(chromium, url, "decline") as visit:
        visit.go("?participant=Ada")
        visit.page.get_by_text("I do not want to take part").click()
        visit.page.get_by_role("button", name="Back to the consent form").click()
        visit.page.locator("dialog").wait_for(state="detached")
        assert visit.heading() == "Taking part in this study"
        decline(visit)
        visit.picture("declined")
        assert visit.page.inner_text("#code") == "no-consent"
        assert visit.page.get_attribute("#go", "href") == "https://lab.example/declined"
        assert count_rows(study) == before
        visit.page.reload()
        visit.heading("Taking part in this study")
        decline(visit)
        visit.page.get_by_text("Take part after all").click()
        visit.heading("Taking part in this study")
        assert "participant=Ada" in visit.page.url
        visit.main_button().click()
        visit.heading("What you will do")
        assert "participant" not in visit.page.url
        visit.page.get_by_text("Stop taking part").click()
        visit.page.get_by_text("Stop for good").click()
        visit.heading("You have stopped")
        visit.page.get_by_text("please return the task there").wait_for()
        assert visit.page.get_by_text("Take part after all").count() == 0
        assert visit.unexpected() == []
    session, _, _ = rows_of(study, "Ada")
    assert (
        session.withdrawn_at is not None and count_rows(study)["sessions"] == before["sessions"] + 1
    )


@pytest.mark.nightly
def test_an_implausible_session_gets_neither_code_nor_link(
    chromium: Any, strict: tuple[Study, str]
) -> None:
    """The page says whom to ask instead, also when the participant comes back to it."""
    study, url = strict
    with Visit(chromium, url, "withheld") as visit:
        visit.to_the_test("?participant=Bo&language=en")
        visit.answer("yes")
        visit.answer("yes")
        visit.heading("About you")
        visit.send_forms()
        secrets = (study.recruitment.link_code, study.recruitment.link_address)

        def check_page() -> None:
            said_why = visit.page.locator("#withheld").inner_text()
            assert "before your participation is credited" in said_why
            assert study.contact in said_why
            said = visit.page.inner_text("main")
            assert "You were right in 1 of 2 movies" in said
            assert rows_of(study, "Bo")[0].reference in said
            assert visit.page.locator("#code, #go, main form, main a").count() == 0
            assert not [secret for secret in secrets if secret in visit.page.content()]

        check_page()
        visit.page.reload()
        check_page()
        visit.go("?participant=Bo&language=en")
        check_page()
        assert visit.unexpected() == []
        with Visit(chromium, url) as elsewhere:
            elsewhere.go(f"{signed_query(study, 'Bo')}&language=en")
            elsewhere.page.get_by_text("You have already taken part").wait_for()
            assert elsewhere.page.locator("#code, #go, main form, main a").count() == 0
            assert not [secret for secret in secrets if secret in elsewhere.page.content()]
    assert all(secrets)
    assert rows_of(study, "Bo")[0].implausible == "short"


# --- stopping ------------------------------------------------------------------------------------


@pytest.mark.nightly
def test_the_trial_continues_behind_the_question(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "question") as visit:
        visit.context.add_init_script(COUNT_PLAYS)
        visit.to_the_test("?participant=Question")
        visit.wait_for_answer()
        plays = visit.page.evaluate("plays")
        for close in ("button", "Escape"):
            visit.page.get_by_text("Stop taking part").click()
            visit.heading("Do you want to stop?")
            visit.page.wait_for_timeout(400)
            visit.picture("asked")
            # Keys are not answers while the question is open.
            visit.press("f", "j")
            if close == "Escape":
                visit.press("Escape")
            else:
                visit.page.get_by_text("Continue with the study").click()
            visit.page.locator("dialog").wait_for(state="detached")
            assert visit.page.locator(".answer:enabled").count() == 2
        visit.answer("no", by="keyboard")
        assert visit.page.evaluate("plays") == plays
        visit.answer("yes")
        visit.answer("yes")
        visit.heading("About you")
        visit.page.wait_for_timeout(100)
        visit.page.reload()  # sends the events
        visit.heading("About you")
        assert visit.unexpected() == []
    asked, other, _ = answers_to_test(study, "Question")
    assert (asked.response, asked.resumed, asked.input) == ("no", False, "keyboard")
    details = json.loads(asked.details)
    assert (details["attempts"], details["stop_asked"]) == (1, 2)
    assert asked.rt_ms > 800
    assert json.loads(other.details)["stop_asked"] == 0
    events = rows_of(study, "Question")[2]
    noted = [(event.kind, event.data) for event in events if event.kind.startswith("stop_")]
    place = {"stage": "test", "phase": "test", "trial": 0}
    assert noted == [("stop_asked", place), ("stop_answered", {**place, "stop": False})] * 2


def test_stopping_sends_what_was_answered_and_is_final(
    chromium: Any, site: tuple[Study, str]
) -> None:
    study, url = site
    with Visit(chromium, url, "stop") as visit:
        visit.to_the_test("?participant=Leaving")
        visit.wait_for_answer()
        visit.context.set_offline(True)
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        visit.page.get_by_text("Stop taking part").click()
        visit.page.get_by_text("Stop for good").click()
        visit.heading("One moment")
        # What was noted is stored before the session ends, also by a slow network.
        visit.page.route("**/api/events", lambda route: (time.sleep(0.5), route.continue_())[1])
        visit.context.set_offline(False)
        visit.heading("You have stopped")
        session, _, events = rows_of(study, "Leaving")
        visit.picture("stopped")
        assert session.reference in visit.page.inner_text("main")
        visit.page.reload()
        visit.heading("You have stopped")
        assert visit.unexpected() == []
    assert session.withdrawn_at is not None and session.finished_at is None
    assert [row.response for row in answers_to_test(study, "Leaving")] == ["no"]
    (stopped,) = [event.data for event in events if event.kind == "stop_answered"]
    assert stopped == {"stage": "test", "phase": "test", "trial": 1, "stop": True}


# --- the result ----------------------------------------------------------------------------------


@pytest.mark.nightly
def test_accuracy_and_percentile_of_the_result(chromium: Any, tmp_path: Path) -> None:
    with served(tmp_path, percentile_from=1) as (_, server):
        for name in ("First", "Second"):
            with Visit(chromium, server.url) as visit:
                said = visit.take_part(f"?participant={name}", "yes", "yes", "yes")
            assert "You were right in 2 of 3 movies" in said
            # The second had as many right ones as the one other person.
            assert ("you are at percentile 50" in said) == (name == "Second")


@pytest.mark.nightly
def test_the_form_of_mturk_stays_in_its_frame(chromium: Any, site: tuple[Study, str]) -> None:
    """The whole session runs in a frame of MTurk's page, and is submitted there."""
    _, url = site
    task = f"{MTURK}/projects/task"
    submit = f"{MTURK}/mturk/externalSubmit"
    handed_in: list[tuple[dict[str, list[str]], bool]] = []

    def amazon(route: Any) -> None:
        request = route.request
        if request.url == task:
            page = '<title>Tasks</title><iframe id="task" width="1240" height="760"></iframe>'
            route.fulfill(content_type="text/html", body=page)
        elif request.url == submit:
            handed_in.append((parse_qs(request.post_data), request.frame != top.main_frame))
            route.fulfill(content_type="text/html", body="<p>Thank you, worker</p>")
        else:
            route.abort()

    with Visit(chromium, url) as visit:
        visit.context.route(f"{MTURK}/**", amazon)
        visit.context.add_init_script(SCREEN)
        top = visit.page
        top.goto(task)
        # All steps happen within the frame.
        visit.page = top.main_frame.child_frames[0]
        query = f"?workerId=W1&assignmentId=A1&hitId=H1&turkSubmitTo={MTURK}"
        visit.take_part(query, "yes", "yes", "yes")
        form = visit.page.locator("form")
        assert (form.get_attribute("action"), form.get_attribute("target")) == (submit, None)
        visit.page.locator("#go").click()
        visit.page.get_by_text("Thank you, worker").wait_for()
        assert top.url == task and top.title() == "Tasks"
    assert handed_in == [({"assignmentId": ["A1"], "code": ["TURK-CODE"]}, True)]


def test_forms_go_to_no_other_host(chromium: Any, site: tuple[Study, str]) -> None:
    """Forms are not sent to other hosts, even if the server's result names one."""
    _, url = site
    with Visit(chromium, url) as visit:
        visit.go()  # without an id: a session belongs to the browser in which it began
        visit.heading("Taking part in this study")

        def finished(route: Any) -> None:
            state = route.fetch().json()
            route.fulfill(json={**state, "stage": "done", "trial": None})

        address = ""

        def result(route: Any) -> None:
            completion = {"code": "C", "url": address, "post": {"assignmentId": "A"}}
            scores = {"correct": 1, "trials": 2, "accuracy": 0.5, "percentile": None}
            route.fulfill(json={**scores, "completion": completion})

        visit.context.route("**/api/session**", finished)
        visit.context.route("**/api/result", result)
        for address in (
            "https://www.mturk.com.example.org/mturk/externalSubmit",
            "http://www.mturk.com/mturk/externalSubmit",
            "https://www.mturk.com@example.org/mturk/externalSubmit",
            "https://www.mturk.com/other",
            f"{MTURK}/mturk/externalSubmit",
        ):
            visit.go()
            visit.page.locator("#code").wait_for()
            allowed = address.startswith(MTURK)
            assert visit.page.locator("form").count() == int(allowed)
            if not allowed:
                visit.page.get_by_text("You can close this window now.").wait_for()
