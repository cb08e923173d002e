"""Recovery in a real browser: reload, lost connection, two tabs, killed server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.orders import trial_order
from physion.experiment.study.settings import Recruitment
from physion.experiment.study.study import Study
from support.experiment.browser import Visit, chromium, rows_of, served, signed_query

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
TEST = 4


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    folder = tmp_path_factory.mktemp("study")
    code = Recruitment(link_code="TINY-CODE")
    with served(folder, test=TEST, familiarization=1, recruitment=code) as (study, server):
        yield study, server.url


def to_the_test(visit: Visit, name: str) -> None:
    """Go to the first test trial."""
    visit.begin(f"?participant={name}")
    visit.practise(1)
    visit.begin_test()
    visit.page.locator(".answer").first.wait_for()


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
        to_the_test(visit, "Reload")
        sides = visit.left()
        visit.answer("yes")
        visit.page.get_by_text("Trial 2 of 4").wait_for()
        before = [path for path in visit.requests if "/t-1-movie-" in path]
        visit.requests.clear()
        visit.page.reload()
        visit.page.get_by_text("Trial 2 of 4").wait_for()
        assert [path for path in visit.requests if "/t-1-movie-" in path] == before
        assert not any("/t-0-" in path for path in visit.requests)
        assert visit.left() == sides
        visit.answer("no")
        visit.page.get_by_text("Trial 3 of 4").wait_for()
    # The next day, in another browser: the id alone is not enough, but a signed link is.
    with Visit(chromium, url) as visit:
        visit.go("?participant=Reload")
        visit.page.get_by_text("Your session began in another browser").wait_for()
    with Visit(chromium, url) as visit:
        visit.go(signed_query(study, "Reload"))
        visit.page.get_by_text("Trial 3 of 4").wait_for()
        assert visit.left() == sides
        visit.answer("yes")
        visit.answer("no")
        visit.finish()
        assert visit.unexpected() == []
        # A person who has finished finds the result again in this browser ...
        for query in ("", signed_query(study, "Reload")):
            visit.go(query)
            visit.heading("Thank you!")
            assert visit.page.inner_text("#code") == "TINY-CODE"
    test = check_complete(study, "Reload", ["yes", "no", "yes", "no"])
    assert [row.resumed for row in test] == [False, True, True, False]
    # ... and elsewhere reads that one can take part only once.
    with Visit(chromium, url, "twice") as visit:
        visit.go("?participant=Reload")
        visit.page.get_by_text("You have already taken part").wait_for()
        visit.picture("told")
        assert visit.page.locator("#code").count() == 0


def test_a_reload_without_browser_storage(chromium: Any, site: tuple[Study, str]) -> None:
    """The URL still identifies the participant, so that no second session begins."""
    study, url = site
    with Visit(chromium, url) as visit:
        visit.context.add_init_script(
            "Object.defineProperty(window, 'localStorage',"
            " { get() { throw new DOMException('forbidden', 'SecurityError'); } });"
        )
        to_the_test(visit, "Forbidden")
        assert visit.page.url.endswith("?participant=Forbidden")
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 4").wait_for()
        while len(rows_of(study, "Forbidden")[1]) < 2:
            visit.page.wait_for_timeout(50)
        visit.page.reload()
        visit.page.get_by_text("Trial 2 of 4").wait_for()
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


def test_twenty_seconds_offline(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "offline") as visit:
        to_the_test(visit, "Offline")
        visit.wait_for_answer()
        visit.page.evaluate(WATCH_STATUS)
        visit.context.set_offline(True)
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 4").wait_for()
        visit.answer("no")
        visit.page.get_by_text("No connection.").wait_for()
        assert visit.page.locator("#status").bounding_box()["height"] < 45, "one line"
        visit.picture("lost")
        visit.page.get_by_text("Trial 3 of 4").wait_for()
        visit.page.wait_for_timeout(15_000)
        assert len([row for row in rows_of(study, "Offline")[1] if row.phase == "test"]) == 0
        kept = visit.page.evaluate("JSON.parse(localStorage.getItem('physion:answers')).length")
        assert kept == 2
        visit.context.set_offline(False)
        visit.page.get_by_text("The connection is back.").wait_for()
        visit.answer("yes")
        visit.answer("yes")
        seen = set(visit.page.evaluate("[...window.statusSeen]"))
        assert {"movie hidden", "answer visible"} <= seen and "movie visible" not in seen
        visit.heading("About you")
        assert visit.page.evaluate("localStorage.getItem('physion:answers')") is None
        visit.finish()
        assert visit.unexpected() == []
    check_complete(study, "Offline", ["no", "no", "yes", "yes"])
    kinds = {event.kind for event in rows_of(study, "Offline")[2]}
    assert {"offline", "online"} <= kinds


def test_a_form_stays_until_it_is_stored(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "form") as visit:
        to_the_test(visit, "Form")
        for _ in range(TEST):
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
        visit.picture("busy")
        server = "lost"
        visit.page.get_by_text("No connection.").wait_for()
        assert visit.page.input_value("#age") == "47"
        assert visit.main_button().count() == 0
        server = "back"
        visit.heading("How was it?")
        assert set(requests) == {"busy", "lost", "back"} and requests.count("back") == 1
    assert rows_of(study, "Form")[0].age == 47


def test_a_browser_that_is_closed_offline(chromium: Any, site: tuple[Study, str]) -> None:
    """The answers are sent when the page is opened again, before it requests the state."""
    study, url = site
    with Visit(chromium, url) as visit:
        to_the_test(visit, "Closed")
        visit.wait_for_answer()
        visit.context.set_offline(True)
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 4").wait_for()
        visit.answer("yes")
        visit.page.get_by_text("Trial 3 of 4").wait_for()
        visit.page.close()
        visit.context.set_offline(False)
        visit.page = visit.open_tab()
        visit.go()
        visit.page.get_by_text("Trial 3 of 4").wait_for()
        visit.answer("yes")
        visit.answer("yes")
        visit.heading("About you")
        visit.finish()
        assert visit.unexpected() == []
    test = check_complete(study, "Closed", ["no", "yes", "yes", "yes"])
    assert [row.resumed for row in test] == [False, False, True, False]


def test_the_second_tab_takes_over(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "tabs") as visit:
        to_the_test(visit, "Tabs")
        visit.answer("yes")
        visit.page.get_by_text("Trial 2 of 4").wait_for()
        first, visit.page = visit.page, visit.open_tab()
        visit.go()
        visit.page.get_by_text("Trial 2 of 4").wait_for()
        first.get_by_text("The study continues in another tab").wait_for()
        assert first.locator(".answer").count() == 0
        visit.answer("no")
        visit.page.get_by_text("Trial 3 of 4").wait_for()
        second, visit.page = visit.page, first
        visit.page.bring_to_front()
        visit.picture("first")
        visit.main_button().click()  # continue here
        second.get_by_text("The study continues in another tab").wait_for()
        visit.page.get_by_text("Trial 3 of 4").wait_for()
        visit.answer("no")
        visit.answer("yes")
        visit.heading("About you")
        visit.finish()
        assert visit.unexpected() == []
    check_complete(study, "Tabs", ["yes", "no", "no", "yes"])


def test_another_device_answers_meanwhile(chromium: Any, site: tuple[Study, str]) -> None:
    """The page learns of the other device by the server's refusal, and continues."""
    study, url = site
    with Visit(chromium, url) as here, Visit(chromium, url) as there:
        to_the_test(here, "Devices")
        there.go(signed_query(study, "Devices"))
        there.answer("yes")
        there.page.get_by_text("Trial 2 of 4").wait_for()
        there.answer("yes")
        there.page.get_by_text("Trial 3 of 4").wait_for()
        there.page.close()
        here.answer("no")
        here.page.get_by_text("Trial 3 of 4").wait_for()
        here.answer("no")
        here.page.get_by_text("Trial 4 of 4").wait_for()
        here.answer("no")
        here.heading("About you")
        here.finish()
        assert here.unexpected() == []
    check_complete(study, "Devices", ["yes", "yes", "no", "no"])
    refused = [event for event in rows_of(study, "Devices")[2] if event.kind == "answer_refused"]
    assert [event.data["code"] for event in refused] == ["already_answered"]


def test_the_server_is_killed(chromium: Any, tmp_path: Path) -> None:
    code = Recruitment(link_code="TINY-CODE")
    with (
        served(tmp_path, test=TEST, familiarization=1, recruitment=code) as (study, server),
        Visit(chromium, server.url) as visit,
    ):
        to_the_test(visit, "Killed")
        visit.answer("yes")
        visit.page.get_by_text("Trial 2 of 4").wait_for()
        server.kill()
        visit.answer("yes")
        visit.page.get_by_text("No connection.").wait_for()
        visit.answer("no")
        server.start()
        visit.answer("no")
        visit.heading("About you")
        visit.finish()
        assert visit.unexpected() == []
        check_complete(study, "Killed", ["yes", "yes", "no", "no"])
