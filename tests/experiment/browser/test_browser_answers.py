"""Delivery of answers despite proxies, firewalls, lost tokens and a clock that is too early."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from physion.experiment.store.database import TOKENS, open_database
from physion.experiment.study.study import Study
from support.experiment.browser import (
    SHORT,
    Visit,
    answers_to_test,
    rows_of,
    served,
    signed_query,
)

pytestmark = pytest.mark.slow
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


class Early:
    """Makes a visit's answers too early: the server learns of each showing only with its answer.

    The first announcement of a showing is held back, and the one before the answer says that the
    showing begins now. ``responses``: those to answers, by the key of the answer.
    """

    def __init__(self, visit: Visit) -> None:
        self.responses: dict[str, list[Any]] = {}
        self._first: dict[str, Any] = {}
        self._held: list[Any] | None = None
        visit.context.route("**/api/showings", self._announce)
        visit.context.route("**/api/answers", self._answer)
        visit.context.on("response", self._note)

    def hold(self) -> None:
        """Hold back answers that are sent again."""
        self._held = []

    def release(self) -> None:
        """Send what was held back."""
        held, self._held = self._held or [], None
        for route in held:
            route.continue_()

    def _announce(self, route: Any) -> None:
        showing = route.request.post_data_json
        if showing["key"] not in self._first:
            self._first[showing["key"]] = route
            return
        route.continue_(post_data=json.dumps({**showing, "ago_ms": 0}))
        first, self._first[showing["key"]] = self._first[showing["key"]], None
        if first is not None:
            first.fulfill(json={"showings": 1})

    def _answer(self, route: Any) -> None:
        again = route.request.post_data_json["key"] in self.responses
        if again and self._held is not None:
            self._held.append(route)
        else:
            route.continue_()

    def _note(self, response: Any) -> None:
        if response.url.endswith("/api/answers"):
            key = response.request.post_data_json["key"]
            self.responses.setdefault(key, []).append(response)


WATCH_TROUBLE = """() => {
  window.troubles = [];
  const status = document.getElementById("status");
  new MutationObserver(() => window.troubles.push(status.textContent))
    .observe(status, {childList: true, characterData: true, subtree: true});
}"""
"""Function that keeps what the page says about the connection from now on."""


@pytest.mark.nightly
def test_answers_that_are_too_early_are_sent_again(chromium: Any, tmp_path: Path) -> None:
    """After the time that the server says; the participant notices nothing and continues."""
    timing = replace(SHORT, cue_ms=2000)
    with (
        served(tmp_path, test=2, timing=timing) as (study, server),
        Visit(chromium, server.url, "early") as visit,
    ):
        early = Early(visit)
        visit.begin("?participant=Early&language=en")
        visit.page.evaluate(WATCH_TROUBLE)
        visit.answer("yes")
        visit.see_feedback()  # comes when the answer is stored
        visit.begin_test()
        early.hold()
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 2").wait_for()
        assert visit.page.evaluate(KEPT) == [0]
        early.release()
        visit.wait_for_answer()
        while visit.page.evaluate(KEPT):
            visit.page.wait_for_timeout(50)
        assert visit.page.evaluate("window.troubles") == []
        # A reload does not lose an answer that waits.
        early.hold()
        with visit.page.expect_response("**/api/answers"):
            visit.page.click(".answer[data-response=yes]")
        assert visit.page.evaluate(KEPT) == [1]
        early.release()
        visit.page.reload()
        visit.heading("About you")
        assert visit.page.evaluate(KEPT) == []
        assert visit.page.locator("#status").inner_text() == ""
        statuses = [[one.status for one in sent] for sent in early.responses.values()]
        for sent in list(early.responses.values())[:2]:
            refused, accepted = (one.request for one in sent)
            wait_ms = 1000 * int(sent[0].headers["retry-after"])
            began = refused.timing["startTime"]
            assert wait_ms >= 1000 and accepted.timing["startTime"] - began >= wait_ms
            assert accepted.post_data_json == refused.post_data_json
        assert visit.unexpected() == []
        visit.finish()
    assert statuses[:2] == [[425, 200]] * 2
    # The new load of the page sends it at once, which is too early again.
    assert set(statuses[2][:-1]) == {425} and statuses[2][-1] == 200
    session, answers, events = rows_of(study, "Early")
    stored = [(row.phase, row.trial, row.response) for row in answers]
    assert stored == [("familiarization", 0, "yes"), ("test", 0, "no"), ("test", 1, "yes")]
    assert [row.key for row in answers] == list(early.responses)
    assert session.implausible is None
    assert "answer_refused" not in {event.kind for event in events}
