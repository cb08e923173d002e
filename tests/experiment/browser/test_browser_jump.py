"""A preview goes to any page by the control in the header, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from support.experiment.browser import Visit, chromium, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow


def test_a_preview_jumps_and_a_person_cannot(chromium: Any, tmp_path: Path) -> None:
    with (
        served(tmp_path, test=3, familiarization=2) as (study, server),
        Visit(chromium, server.url, "jump") as visit,
    ):
        visit.go("?participant=Ada")
        visit.heading("Taking part in this study")
        assert visit.page.locator(".jump, .is-preview").count() == 0
        word = make_pass(Secrets.load(study.folder), "preview")

        def jump(stage: str, trial: int = 0) -> None:
            visit.page.select_option("#jump-stage", stage)
            if trial:
                visit.page.fill("#jump-trial", str(trial))
            assert visit.page.locator("#jump-trial").is_visible() == (trial > 0)
            visit.page.get_by_role("button", name="Go there").click()

        visit.go(f"?pass={word}")
        visit.heading("Taking part in this study")
        assert visit.page.locator("body.is-preview").count() == 1
        jump("done")
        visit.heading("Thank you!")
        jump("test", 3)
        visit.page.get_by_text("Trial 3 of 3").wait_for()
        visit.picture("trial")
        visit.answer("no")
        visit.heading("About you")
        jump("familiarization", 2)
        visit.page.get_by_text("Practice 2 of 2").wait_for()
        jump("ready")
        visit.heading("You are ready")
        assert visit.unexpected() == []
