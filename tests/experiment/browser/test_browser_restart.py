"""A server that is restarted with other settings, in a real browser."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.identity import SECRET_FILE
from support.experiment.browser import Visit, chromium, rows_of, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow


def test_movies_with_changed_urls(chromium: Any, tmp_path: Path) -> None:
    """The media URLs of the page have become invalid: it requests new ones."""
    with (
        served(tmp_path, test=3, familiarization=1, preload=1) as (study, server),
        Visit(chromium, server.url) as visit,
    ):
        visit.begin("?participant=Restart")
        visit.wait_for_answer()
        change_addresses(study.folder, server)
        # The full movie of practice has its own URL, which becomes invalid meanwhile.
        spoilt: list[str] = []

        def spoil(route: Any) -> None:
            answer = route.fetch().json()
            if answer["feedback"] and not spoilt:
                answer["feedback"]["movie"] = re.sub(
                    r"-\w+$", "-" + "0" * 32, answer["feedback"]["movie"]
                )
                spoilt.append(answer["feedback"]["movie"])
            route.fulfill(json=answer)

        visit.context.route("**/api/answers", spoil)
        visit.practise(1)
        assert len(spoilt) == 1
        visit.begin_test()
        visit.wait_for_answer()
        change_addresses(study.folder, server)
        lists = len([url for url in visit.requests if url.endswith("/api/trials/test")])
        visit.answer("no")
        visit.answer("yes")
        visit.answer("no")
        visit.heading("About you")
        asked = [url for url in visit.requests if url.endswith("/api/trials/test")]
        assert (lists, len(asked)) == (1, 2)
    answers = [row for row in rows_of(study, "Restart")[1] if row.phase == "test"]
    assert [row.response for row in answers] == ["no", "yes", "no"]
    assert [json.loads(row.details)["attempts"] for row in answers] == [1, 1, 1]


def change_addresses(folder: Path, server: Any) -> None:
    """Restart the server with another key for media URLs."""
    server.kill()
    path = folder / SECRET_FILE
    content = json.loads(path.read_text())
    content["link_key"] = content["link_key"][::-1]
    path.write_text(json.dumps(content))
    server.start()


def test_the_language_of_the_session_decides(chromium: Any, tmp_path: Path) -> None:
    with (
        served(tmp_path, test=1, familiarization=1) as (_, server),
        Visit(chromium, server.url) as visit,
    ):
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
