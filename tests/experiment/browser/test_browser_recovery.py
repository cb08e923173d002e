"""Recovery: reload, lost connection, two tabs, a killed server, refusals by proxies."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from physion.experiment.store.database import TOKENS, open_database
from physion.experiment.study.identity import SECRET_FILE
from physion.experiment.study.orders import trial_order
from physion.experiment.study.study import Study
from support.experiment.browser import Visit, answers_to_test, rows_of, served, signed_query

pytestmark = pytest.mark.slow


def check_complete(study: Study, name: str, responses: list[str]) -> list[Any]:
    """Check that every test trial has one answer, in the session's order."""
    session, answers, _ = rows_of(study, name)
    assert session.finished_at is not None
    test = [row for row in answers if row.phase == "test"]
    order = trial_order(study, session.scenario, session.order_seed)["test"]
    assert [row.stimulus for row in test] == [stimulus.stimulus for stimulus in order]
    assert [row.response for row in test] == responses
    return test


def test_a_reload_continues_at_the_same_trial(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url) as visit:
        visit.to_the_test("?participant=Reload")
        sides = visit.left()
        visit.answer("yes")
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        before = [path for path in visit.requests if "/t-1-movie-" in path]
        visit.requests.clear()
        visit.page.reload()
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        assert [path for path in visit.requests if "/t-1-movie-" in path] == before
        assert not any("/t-0-" in path for path in visit.requests)
        assert visit.left() == sides
        visit.answer("no")
        visit.page.get_by_text("Trial 3 of 3").wait_for()
    # The next day, in another browser: the id is not enough, but a signed link is.
    with Visit(chromium, url) as visit:
        visit.go("?participant=Reload")
        visit.page.get_by_text("Your session began in another browser").wait_for()
    with Visit(chromium, url) as visit:
        visit.go(signed_query(study, "Reload"))
        visit.page.get_by_text("Trial 3 of 3").wait_for()
        assert visit.left() == sides
        visit.answer("yes")
        visit.finish()
        assert visit.unexpected() == []
        # A person who has finished finds the result again in this browser ...
        for query in ("", signed_query(study, "Reload")):
            visit.go(query)
            visit.heading("Thank you!")
            assert visit.page.inner_text("#code") == "TINY-CODE"
    test = check_complete(study, "Reload", ["yes", "no", "yes"])
    assert [row.resumed for row in test] == [False, True, True]
    # ... and elsewhere reads that one can take part only once.
    with Visit(chromium, url, "twice") as visit:
        visit.go("?participant=Reload")
        visit.page.get_by_text("You have already taken part").wait_for()
        assert visit.page.locator("#code").count() == 0


def test_a_reload_without_browser_storage(chromium: Any, site: tuple[Study, str]) -> None:
    """The URL still identifies the participant, so that no second session begins."""
    study, url = site
    with Visit(chromium, url) as visit:
        visit.context.add_init_script(
            "Object.defineProperty(window, 'localStorage',"
            " { get() { throw new DOMException('forbidden', 'SecurityError'); } });"
        )
        visit.to_the_test("?participant=Forbidden")
        assert visit.page.url.endswith("?participant=Forbidden")
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        while len(rows_of(study, "Forbidden")[1]) < 2:
            visit.page.wait_for_timeout(50)
        visit.page.reload()
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        assert visit.unexpected() == []


WATCH_STATUS = """() => {
  window.statusSeen = new Set();
  const look = () => {
    const status = document.getElementById("status");
    const trial = document.querySelector(".trial:not(.has-verdict)");
    if (status.textContent && trial) {
      const part = trial.querySelector(".answer:disabled") ? "movie" : "answer";
      window.statusSeen.add(`${part} ${getComputedStyle(status).visibility}`);
    }
    requestAnimationFrame(look);
  };
  look();
}"""
"""Records in which part of a trial the message about the connection can be seen."""


def test_answers_wait_while_the_browser_is_offline(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "offline") as visit:
        visit.to_the_test("?participant=Offline")
        visit.page.evaluate(WATCH_STATUS)
        visit.wait_for_answer()
        visit.context.set_offline(True)
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        visit.answer("no")
        visit.page.get_by_text("No connection.").wait_for()
        assert visit.page.locator("#status").bounding_box()["height"] < 45, "one line"
        visit.picture("lost")
        visit.page.get_by_text("Trial 3 of 3").wait_for()
        visit.wait_for_answer()
        assert answers_to_test(study, "Offline") == []
        kept = visit.page.evaluate("JSON.parse(localStorage.getItem('physion:answers')).length")
        assert kept == 2
        visit.context.set_offline(False)
        visit.page.get_by_text("The connection is back.").wait_for()
        visit.answer("yes")
        seen = set(visit.page.evaluate("[...window.statusSeen]"))
        assert {"movie hidden", "answer visible"} <= seen and "movie visible" not in seen
        visit.heading("About you")
        assert visit.page.evaluate("localStorage.getItem('physion:answers')") is None
        visit.finish()
        assert visit.unexpected() == []
    check_complete(study, "Offline", ["no", "no", "yes"])
    kinds = {event.kind for event in rows_of(study, "Offline")[2]}
    assert {"offline", "online"} <= kinds


@pytest.mark.nightly
def test_a_browser_that_is_closed_offline(chromium: Any, site: tuple[Study, str]) -> None:
    """Answers are sent when the page is opened again; a form stays until it is stored."""
    study, url = site
    with Visit(chromium, url, "form") as visit:
        visit.to_the_test("?participant=Closed")
        visit.wait_for_answer()
        visit.context.set_offline(True)
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        visit.answer("yes")
        visit.page.get_by_text("Trial 3 of 3").wait_for()
        visit.page.close()
        visit.context.set_offline(False)
        visit.page = visit.open_tab()
        visit.go()
        visit.page.get_by_text("Trial 3 of 3").wait_for()
        visit.answer("yes")
        visit.heading("About you")
        visit.page.fill("#age", "47")
        server = "busy"
        requests: list[str] = []

        def disturbed(route: Any) -> None:
            requests.append(server)
            if server == "busy":
                route.fulfill(status=503, body="busy")
            elif server == "lost":
                route.abort()
            else:
                route.continue_()

        visit.context.route("**/api/page", disturbed)
        visit.main_button().click()
        # Each trouble lasts until the page shows it, however slow the browser is.
        visit.page.get_by_text("The server is busy.").wait_for()
        visit.page.get_by_text("Your answers are being sent").wait_for()
        server = "lost"
        visit.page.get_by_text("No connection.").wait_for()
        assert visit.page.input_value("#age") == "47"
        assert visit.main_button().count() == 0
        server = "back"
        visit.heading("How was it?")
        assert set(requests) == {"busy", "lost", "back"} and requests.count("back") == 1
    assert rows_of(study, "Closed")[0].age == 47
    test = answers_to_test(study, "Closed")
    assert [row.response for row in test] == ["no", "yes", "yes"]
    assert [row.resumed for row in test] == [False, False, True]


@pytest.mark.nightly
def test_the_second_tab_takes_over(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "tabs") as visit:
        visit.to_the_test("?participant=Tabs")
        visit.answer("yes")
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        first, visit.page = visit.page, visit.open_tab()
        visit.go()
        visit.page.bring_to_front()  # a page that is hidden waits
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        first.get_by_text("The study continues in another tab").wait_for()
        assert first.locator(".answer").count() == 0
        visit.answer("no")
        visit.page.get_by_text("Trial 3 of 3").wait_for()
        second, visit.page = visit.page, first
        visit.page.bring_to_front()
        visit.picture("first")
        visit.main_button().click()  # continue here
        second.get_by_text("The study continues in another tab").wait_for()
        visit.page.get_by_text("Trial 3 of 3").wait_for()
        visit.answer("no")
        visit.heading("About you")
        visit.finish()
        assert visit.unexpected() == []
    check_complete(study, "Tabs", ["yes", "no", "no"])


def test_another_device_answers_meanwhile(chromium: Any, site: tuple[Study, str]) -> None:
    """The page learns it by the server's refusal, also in the middle of the next trial."""
    study, url = site
    with Visit(chromium, url) as here, Visit(chromium, url) as there:
        here.to_the_test("?participant=Devices")
        there.go(signed_query(study, "Devices"))
        there.answer("yes")
        there.page.get_by_text("Trial 2 of 3").wait_for()
        there.page.close()
        held: list[Any] = []

        def hold_the_first(route: Any) -> None:
            if held:
                route.continue_()
            else:
                held.append(route)

        here.context.route("**/api/answers", hold_the_first)
        here.answer("no")
        here.page.get_by_text("Trial 2 of 3").wait_for()
        here.wait_for_answer()  # the movie of the second trial is over
        held[0].continue_()
        here.page.locator(".answer:enabled").first.wait_for(state="detached")
        here.answer("no")
        here.page.get_by_text("Trial 3 of 3").wait_for()
        here.answer("no")
        here.heading("About you")
        here.finish()
        assert here.unexpected() == []
    test = check_complete(study, "Devices", ["yes", "no", "no"])
    # What was shown twice is marked: the first trial elsewhere, the second one here.
    assert [row.resumed for row in test] == [True, True, False]
    assert json.loads(test[1].details)["attempts"] == 2
    refused = [event for event in rows_of(study, "Devices")[2] if event.kind == "answer_refused"]
    assert [event.data["code"] for event in refused] == ["already_answered"]


@pytest.mark.nightly
def test_a_server_that_is_killed_and_has_other_keys(chromium: Any, tmp_path: Path) -> None:
    """Answers wait for the server; media URLs that became invalid are requested anew."""
    with served(tmp_path, preload=1) as (study, server), Visit(chromium, server.url) as visit:

        def restart_with_other_keys() -> None:
            server.kill()
            path = study.folder / SECRET_FILE
            content = json.loads(path.read_text())
            path.write_text(json.dumps(content | {"link_key": content["link_key"][::-1]}))
            server.start()

        visit.begin("?participant=Killed")
        visit.wait_for_answer()
        restart_with_other_keys()
        # The full movie of practice has its own URL, which becomes invalid meanwhile.
        spoilt: list[str] = []

        def spoil(route: Any) -> None:
            answer = route.fetch().json()
            if answer["feedback"] and not spoilt:
                movie = re.sub(r"-\w+$", "-" + "0" * 32, answer["feedback"]["movie"])
                answer["feedback"]["movie"] = movie
                spoilt.append(movie)
            route.fulfill(json=answer)

        visit.context.route("**/api/answers", spoil)
        visit.practise(1)
        assert len(spoilt) == 1
        visit.context.unroute("**/api/answers")
        visit.begin_test()
        visit.wait_for_answer()
        lists = len([url for url in visit.requests if url.endswith("/api/trials/test")])
        server.kill()
        visit.answer("no")
        visit.page.get_by_text("No connection.").wait_for(state="attached")
        restart_with_other_keys()
        visit.answer("yes")
        visit.answer("no")
        visit.heading("About you")
        asked = [url for url in visit.requests if url.endswith("/api/trials/test")]
        assert (lists, len(asked)) == (1, 2)
        visit.finish()
    test = check_complete(study, "Killed", ["no", "yes", "no"])
    assert [json.loads(row.details)["attempts"] for row in test] == [1, 1, 1]


def test_the_language_of_the_session_decides(chromium: Any, site: tuple[Study, str]) -> None:
    _, url = site
    with Visit(chromium, url) as visit:
        visit.go("?participant=Words&language=de")
        visit.heading("Teilnahme an dieser Studie")
        # The browser remembers a language that the study no longer has.
        visit.page.evaluate("localStorage.setItem('physion:language', '\"fr\"')")
        visit.go("?participant=Words")
        visit.heading("Teilnahme an dieser Studie")

        def other_language(language: str) -> Any:
            def change(route: Any) -> None:
                route.fulfill(json={**route.fetch().json(), "language": language})

            return change

        # Meanwhile the study lost the language in which the session began ...
        visit.context.route("**/api/page", other_language("en"))
        visit.main_button().click()
        visit.heading("What you will do")
        visit.context.unroute("**/api/page")
        # ... and texts that cannot be loaded stop nobody.
        visit.context.route("**/api/session**", other_language("fr"))
        visit.page.reload()
        visit.heading("What you will do")


# --- delivery of answers --------------------------------------------------------------------------


KEPT = "JSON.parse(localStorage.getItem('physion:answers') ?? '[]').map(one => one.answer.trial)"


def forget_tokens(study: Study, session: str) -> None:
    """Delete all tokens, as if an older backup of the database had been restored."""
    engine = open_database(study.folder)
    try:
        with engine.begin() as connection:
            connection.execute(sa.delete(TOKENS).where(TOKENS.c.session == session))
    finally:
        engine.dispose()


FOREIGN: dict[str, dict[str, Any]] = {
    "proxy": {"status": 404, "content_type": "text/plain", "body": "404 page not found"},
    "firewall": {"status": 403, "content_type": "text/html", "body": "<h1>Blocked</h1>"},
    "gateway": {"status": 401, "content_type": "application/json", "body": '{"error": "login"}'},
    "timeout": {
        "status": 408,
        "content_type": "application/json",
        "body": '{"error": "bad_request", "message": "The body took too long."}',
    },
    "login-page": {"status": 200, "content_type": "text/html", "body": "<p>Welcome to our wifi"},
    "other-json": {"status": 200, "content_type": "application/json", "body": '{"ok": true}'},
}


@pytest.mark.nightly
def test_responses_of_others_are_not_refusals(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url) as visit:
        visit.to_the_test("?participant=Proxy")
        sent: list[tuple[int, str]] = []
        foreign = list(FOREIGN.values())

        def stand_between(route: Any) -> None:
            answer = route.request.post_data_json
            sent.append((answer["trial"], answer["key"]))
            if len(sent) <= len(foreign):
                route.fulfill(**foreign[len(sent) - 1])
            else:
                route.continue_()

        visit.context.route("**/api/answers", stand_between)
        visit.answer("yes")
        visit.page.get_by_text("No connection.").wait_for(state="attached")
        while len(sent) <= len(foreign):
            visit.page.evaluate("window.dispatchEvent(new Event('online'))")  # ends the pause
            visit.page.wait_for_timeout(50)
        visit.answer("no")
        visit.answer("yes")
        visit.heading("About you")
    # The first answer was sent again, with the same key, before the others.
    assert [trial for trial, _ in sent] == [0] * (len(FOREIGN) + 1) + [1, 2]
    assert len({key for _, key in sent}) == 3
    test = answers_to_test(study, "Proxy")
    assert [(row.response, row.resumed) for row in test] == [
        ("yes", False), ("no", False), ("yes", False)]  # fmt: skip
    assert "answer_refused" not in {event.kind for event in rows_of(study, "Proxy")[2]}


def test_a_lost_token(chromium: Any, site: tuple[Study, str]) -> None:
    """The answer waits in the browser and is sent with the token of the next entry."""
    study, url = site
    with Visit(chromium, url, "token") as visit:
        visit.to_the_test("?participant=Gone")
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        visit.wait_for_answer()
        while not answers_to_test(study, "Gone"):
            visit.page.wait_for_timeout(50)
        forget_tokens(study, rows_of(study, "Gone")[0].session)
        visit.page.click(".answer[data-response=yes]")
        visit.page.get_by_text("open the link of your invitation once more").wait_for()
        visit.picture("asked")
        assert visit.page.evaluate(KEPT) == [1]
        # Another person at this browser neither sends nor loses it.
        visit.go("?participant=Other")
        visit.heading("Taking part in this study")
        assert visit.page.evaluate(KEPT) == [1]
        visit.go("?participant=Gone")
        visit.page.get_by_text("Trial 3 of 3").wait_for()
        assert visit.page.evaluate(KEPT) == []
        visit.answer("yes")
        visit.heading("About you")
    # The first answer of the new load is the third, not the one that waited.
    assert [row.response for row in answers_to_test(study, "Gone")] == ["no", "yes", "yes"]


@pytest.mark.nightly
def test_a_refused_answer_is_stored_as_event_before_removal(
    chromium: Any, site: tuple[Study, str]
) -> None:
    """The event about it is stored even if the browser is closed at that moment."""
    study, url = site
    with Visit(chromium, url) as visit, Visit(chromium, url) as there:
        visit.to_the_test("?participant=Noted")
        there.go(signed_query(study, "Noted"))
        there.answer("yes")
        there.page.get_by_text("Trial 2 of 3").wait_for()
        there.page.close()
        visit.context.route("**/api/events", lambda route: route.abort())
        visit.answer("no")
        visit.page.wait_for_timeout(1500)
        assert visit.page.evaluate(KEPT) == [0]
        visit.page.close()
        visit.context.unroute("**/api/events")
        visit.page = visit.open_tab()
        visit.go()
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        assert visit.page.evaluate(KEPT) == []
    assert [row.response for row in answers_to_test(study, "Noted")] == ["yes"]
    (event,) = [one for one in rows_of(study, "Noted")[2] if one.kind == "answer_refused"]
    assert event.data.pop("rt_ms") >= 0
    assert event.data == {
        "code": "already_answered", "phase": "test", "trial": 0, "response": "no",
    }  # fmt: skip


WATCH_TROUBLE = """() => {
  window.troubles = [];
  const status = document.getElementById("status");
  new MutationObserver(() => window.troubles.push(status.textContent))
    .observe(status, {childList: true, characterData: true, subtree: true});
}"""
"""Function that keeps what the page says about the connection from now on."""


@pytest.mark.nightly
def test_answers_that_are_too_early_are_sent_again(chromium: Any, site: tuple[Study, str]) -> None:
    """After the time that the server says; the participant notices nothing and continues."""
    study, url = site
    sent: dict[str, list[tuple[float, Any]]] = {}

    def refuse_once(route: Any) -> None:
        answer = route.request.post_data_json
        tries = sent.setdefault(answer["key"], [])
        tries.append((time.monotonic(), answer))
        if len(tries) > 1:
            route.continue_()
        else:
            refusal = {"error": "too_early", "message": "too early"}
            route.fulfill(status=425, headers={"retry-after": "1"}, json=refusal)

    with Visit(chromium, url, "early") as visit:
        visit.context.route("**/api/answers", refuse_once)
        visit.begin("?participant=Early&language=en")
        visit.page.evaluate(WATCH_TROUBLE)
        visit.practise(1)  # the feedback comes when the answer is stored
        visit.begin_test()
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 3").wait_for()
        assert visit.page.evaluate(KEPT) == [0]
        visit.wait_for_answer()
        while visit.page.evaluate(KEPT):
            visit.page.wait_for_timeout(50)
        assert visit.page.evaluate("window.troubles") == []
        # A reload does not lose an answer that waits.
        with visit.page.expect_response("**/api/answers"):
            visit.page.click(".answer[data-response=yes]")
        assert visit.page.evaluate(KEPT) == [1]
        visit.page.reload()
        visit.answer("yes")
        visit.heading("About you")
        assert visit.page.evaluate(KEPT) == []
        assert visit.page.locator("#status").inner_text() == ""
        assert visit.unexpected() == []
        visit.finish()
    assert len(sent) == 4
    for (refused_at, refused), (accepted_at, accepted) in sent.values():
        assert accepted == refused
        # The new load of the page sends the second test answer at once.
        assert accepted_at - refused_at >= 1 or refused["trial"] == 1
    check_complete(study, "Early", ["no", "yes", "yes"])
    session, answers, events = rows_of(study, "Early")
    assert {row.key for row in answers} == set(sent)
    assert session.implausible is None
    assert "answer_refused" not in {event.kind for event in events}
