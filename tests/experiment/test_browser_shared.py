"""Several people at one computer, one after the other, in a real browser."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from browser import Visit, chromium, rows_of, served

from physion.experiment.study import Recruitment, Study

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


@pytest.mark.parametrize("script", ["", "Object.defineProperty(crypto, 'subtle', {value: null})"])
def test_nobody_gets_the_result_of_another(
    chromium: Any, site: tuple[Study, str], script: str
) -> None:
    """A took part elsewhere, B here: who comes by A's link here is told no more than anywhere."""
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
        # B still finds the own result, and so does who reloads.
        for query in (f"?participant={b}", ""):
            visit.go(query)
            visit.page.get_by_text(reference).wait_for()
        assert visit.page.get_by_text(NEXT).count() == 0
        # A third one begins, and B, in the middle of that, goes on as B.
        visit.go(f"?participant={a}-third")
        visit.heading("Taking part in this study")
        visit.go()
        visit.heading("Taking part in this study")
