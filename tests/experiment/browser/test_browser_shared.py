"""Several people on one computer, one after the other, in a real browser."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

import sqlalchemy as sa

from physion.experiment.store.database import PARTICIPANTS, SESSIONS, open_database
from physion.experiment.study.settings import Recruitment
from physion.experiment.study.study import Study
from support.experiment.browser import Visit, chromium, rows_of, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
NEXT = "Another person takes part on this computer"
REMEMBERED = "JSON.parse(localStorage.getItem('physion:session'))"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    code = Recruitment(link_code="TINY-CODE")
    with served(
        tmp_path_factory.mktemp("study"), test=2, familiarization=1, recruitment=code
    ) as (study, server):  # fmt: skip
        yield study, server.url


def take_part(visit: Visit, query: str, answers: tuple[str, str]) -> None:
    visit.begin(query)
    visit.practise(1)
    visit.begin_test()
    for answer in answers:
        visit.answer(answer)
    visit.heading("About you")
    visit.finish()


def references(study: Study) -> list[str]:
    engine = open_database(study.folder)
    try:
        with engine.connect() as connection:
            people = connection.scalar(sa.select(sa.func.count()).select_from(PARTICIPANTS))
            rows = connection.scalars(sa.select(SESSIONS.c.reference)).all()
            assert people == len(rows)
            return list(rows)
    finally:
        engine.dispose()


@pytest.mark.parametrize("script", ["", "Object.defineProperty(crypto, 'subtle', {value: null})"])
def test_nobody_gets_the_result_of_another(
    chromium: Any, site: tuple[Study, str], script: str
) -> None:
    """A took part elsewhere, B here: A's link shows no more here than anywhere else."""
    study, url = site
    a, b = ("Plain-A", "Plain-B") if script else ("A", "B")
    with Visit(chromium, url) as elsewhere:
        take_part(elsewhere, f"?participant={a}", ("yes", "yes"))
    with Visit(chromium, url) as visit:
        if script:
            visit.context.add_init_script(script)
        take_part(visit, f"?participant={b}", ("no", "no"))
        reference = rows_of(study, b)[0].reference
        assert reference in visit.page.inner_text("main")
        kept = visit.page.evaluate(REMEMBERED)
        assert len(kept["who"]) == (16 if script else 64)
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


def test_the_next_person_at_this_computer(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    before = len(references(study))
    with Visit(chromium, url, "shared") as visit:
        take_part(visit, "?scenario=collide&language=en", ("yes", "no"))
        visit.picture("result")
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


def test_a_finished_session_with_a_lost_token(chromium: Any, site: tuple[Study, str]) -> None:
    _, url = site
    with Visit(chromium, url) as visit:
        take_part(visit, "", ("yes", "no"))
        visit.page.evaluate("localStorage.removeItem('physion:session')")
        visit.go()
        visit.page.get_by_text("You have already taken part").wait_for()
        visit.page.get_by_text(NEXT).click()
        visit.heading("Taking part in this study")
