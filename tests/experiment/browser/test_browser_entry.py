"""Entering: refused visitors and devices, recruiters, previews, computers of several people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import sqlalchemy as sa

from physion.experiment.store.database import PARTICIPANTS, RAW_IDS, SESSIONS, open_database
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import EarlyEnd, Recruitment
from physion.experiment.study.study import Study
from support.experiment.browser import Visit, rows_of, served

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
