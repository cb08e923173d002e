"""Declining, coming back and the codes of people who do not finish, in a real browser."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.settings import EarlyEnd
from physion.experiment.study.study import Study
from support.experiment.browser import Visit, chromium, rows_of, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
PHONE = {"viewport": {"width": 1100, "height": 700}, "has_touch": True, "is_mobile": True}


@pytest.fixture
def site(tmp_path: Path) -> Iterator[tuple[Study, str]]:
    """A study of one participant, of its own for each test: who takes part fills it."""
    ends = {
        "declined": EarlyEnd("NOCONSENT", "no-consent", "https://lab.example/declined"),
        "device_refused": EarlyEnd("PHONE", "phone"),
        "full": EarlyEnd("FULL", "full"),
    }
    with served(tmp_path, test=1, familiarization=1, participants=1, **ends) as (study, server):
        yield study, server.url


def decline(visit: Visit) -> None:
    visit.page.get_by_text("I do not want to take part").click()
    visit.heading("Do you really not want to take part?")
    visit.picture("question")
    visit.page.get_by_role("button", name="I do not take part").click()
    visit.heading("You do not take part")


def test_declining_is_asked_once_more_and_leaves_nothing(
    chromium: Any, site: tuple[Study, str]
) -> None:
    study, url = site
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
        assert stored(study) == {"sessions": 0, "raw_ids": 0, "events": 0, "participants": 0}
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
    assert session.withdrawn_at is not None and stored(study)["sessions"] == 1


def stored(study: Study) -> dict[str, int]:
    """Return the number of rows in those tables that know of persons."""
    with sqlite3.connect(study.folder / "responses.sqlite") as database:
        return {
            name: database.execute(f"SELECT count(*) FROM {name}").fetchone()[0]
            for name in ("sessions", "raw_ids", "events", "participants")
        }


def test_refused_devices_and_full_studies_have_their_codes(
    chromium: Any, site: tuple[Study, str]
) -> None:
    _, url = site
    with Visit(chromium, url, "phone", screen=PHONE["viewport"], **PHONE) as visit:
        visit.go("?PROLIFIC_PID=5f00")
        visit.page.get_by_text("does not work on phones").wait_for()
        visit.picture("refused")
        address = "https://app.prolific.com/submissions/complete?cc=PHONE"
        assert visit.page.get_attribute("#go", "href") == address
    with Visit(chromium, url) as visit:
        visit.begin("?participant=First")
        visit.practise(1)
        visit.begin_test()
        visit.answer("yes")
        visit.finish()
    with Visit(chromium, url, "full") as visit:
        visit.go("?participant=Late")
        visit.page.get_by_text("Enough people have taken part").wait_for()
        assert visit.page.inner_text("#code") == "full"
        visit.picture("refused")
