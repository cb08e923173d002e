"""The result page and completion credit, in a real browser."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.settings import Recruitment
from physion.experiment.study.study import Study
from support.experiment.browser import FAST, Visit, chromium, rows_of, served, signed_query

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
MTURK = "https://workersandbox.mturk.com"
SCREEN = """
Object.defineProperty(screen, "width", {value: 1280});
Object.defineProperty(screen, "height", {value: 800});
"""
"""What Playwright tells pages of the screen does not reach frames of other sites."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    settings: dict[str, Any] = {
        "recruitment": Recruitment(link_code="TINY-CODE", mturk_code="TURK-CODE"),
        "embed_from": (MTURK,),
        "percentile_from": 1,
    }
    folder = tmp_path_factory.mktemp("study")
    with served(folder, test=2, familiarization=1, **settings) as (study, server):
        yield study, server.url


def take_part(visit: Visit, query: str) -> str:
    """Complete a session and return the text of the last page."""
    visit.begin(query)
    visit.practise(1)
    visit.begin_test()
    visit.answer("yes")
    visit.answer("yes")
    visit.finish()
    return str(visit.page.inner_text("main"))


def correct(study: Study, name: str) -> int:
    labels = {stimulus.stimulus: stimulus.label for stimulus in study.stimuli}
    answers = [row for row in rows_of(study, name)[1] if row.phase == "test"]
    return sum((row.response == "yes") == labels[row.stimulus] for row in answers)


def test_the_percentile_agrees_with_its_text(chromium: Any, site: tuple[Study, str]) -> None:
    """Of two people with equal scores, the second has the percentile 50."""
    study, url = site
    with Visit(chromium, url) as visit:
        assert "percentile" not in take_part(visit, "?participant=First")
    with Visit(chromium, url) as visit:
        told = take_part(visit, "?participant=Second")
    assert correct(study, "First") == correct(study, "Second") == 1
    assert "Compared with the other people who finished, you are at percentile 50" in told


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
        take_part(visit, f"?workerId=W1&assignmentId=A1&hitId=H1&turkSubmitTo={MTURK}")
        form = visit.page.locator("form")
        assert (form.get_attribute("action"), form.get_attribute("target")) == (submit, None)
        visit.page.locator("#go").click()
        visit.page.get_by_text("Thank you, worker").wait_for()
        assert top.url == task and top.title() == "Tasks"
    assert handed_in == [({"assignmentId": ["A1"], "code": ["TURK-CODE"]}, True)]


@pytest.mark.parametrize(
    "address",
    [
        "https://www.mturk.com.example.org/mturk/externalSubmit",
        "http://www.mturk.com/mturk/externalSubmit",
        "https://www.mturk.com@example.org/mturk/externalSubmit",
        "https://www.mturk.com/other",
    ],
)
def test_forms_go_to_no_other_host(chromium: Any, site: tuple[Study, str], address: str) -> None:
    """Forms are not sent to other hosts, even if the server's result names one."""
    _, url = site
    with Visit(chromium, url) as visit:
        visit.go()  # without an id: a session belongs to the browser in which it began
        visit.heading("Taking part in this study")

        def finished(route: Any) -> None:
            state = route.fetch().json()
            route.fulfill(json={**state, "stage": "done", "trial": None})

        completion = {"code": "C", "url": address, "post": {"assignmentId": "A"}}
        result = {"correct": 1, "trials": 2, "accuracy": 0.5, "percentile": None}
        visit.context.route("**/api/session**", finished)
        visit.context.route(
            "**/api/result", lambda route: route.fulfill(json={**result, "completion": completion})
        )
        visit.go()
        visit.page.locator("#code").wait_for()
        assert visit.page.locator("form").count() == 0
        visit.page.get_by_text("You can close this window now.").wait_for()


def test_an_implausible_session_gets_neither_code_nor_link(chromium: Any, tmp_path: Path) -> None:
    """The page says whom to ask instead, also when the participant comes back to it."""
    slow_readers = replace(FAST, reading_s=3600.0)
    with (
        served(tmp_path, test=2, familiarization=1, plausibility=slow_readers) as (study, server),
        Visit(chromium, server.url, "withheld") as visit,
    ):
        visit.begin("?participant=Ada&language=en")
        visit.practise(1)
        visit.begin_test()
        visit.answer("yes")
        visit.answer("yes")
        visit.heading("About you")
        visit.send_forms()

        secrets = (study.recruitment.link_code, study.recruitment.link_address)

        def check_page() -> None:
            told = visit.page.locator("#withheld").inner_text()
            assert "before your participation is credited" in told and study.contact in told
            said = visit.page.inner_text("main")
            assert "You were right in 1 of 2 movies" in said
            assert rows_of(study, "Ada")[0].reference in said
            assert visit.page.locator("#code, #go, main form, main a").count() == 0
            assert not [secret for secret in secrets if secret in visit.page.content()]

        check_page()
        visit.picture("result")
        visit.page.reload()
        check_page()
        visit.go("?participant=Ada&language=en")
        check_page()
        assert visit.unexpected() == []
        with Visit(chromium, server.url) as elsewhere:
            elsewhere.go(f"{signed_query(study, 'Ada')}&language=en")
            elsewhere.page.get_by_text("You have already taken part").wait_for()
            assert elsewhere.page.locator("#code, #go, main form, main a").count() == 0
            assert not [secret for secret in secrets if secret in elsewhere.page.content()]
    assert all(secrets)
    assert rows_of(study, "Ada")[0].implausible == "short"
