"""The consent with boxes to tick, links and a file, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

import httpx2

from physion.experiment.server_process import ServerProcess
from physion.experiment.study.study import load_study
from physion.experiment.study.texts import TEXTS_FOLDER
from support.experiment.browser import SHORT, Visit, chromium
from support.experiment.tiny_study import make_tiny_study

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
BOXES = """[consent]
check_1 = "I am 18 or older."
check_2 = "I have read this form."
"""
FORM = b"%PDF-1.7 a form"


def test_all_boxes_are_ticked_before_one_agrees(chromium: Any, tmp_path: Path) -> None:
    study = make_tiny_study(tmp_path, test=1, familiarization=1, timing=SHORT)
    before = study.digest
    english = study.folder / TEXTS_FOLDER / "en.toml"
    text = english.read_text().replace("[consent]\n", BOXES)
    english.write_text(
        text.replace("\nQuestions?", "\nSee https://lab.example/data.\n\nQuestions?", 1)
    )
    (study.folder / TEXTS_FOLDER / "consent-en.pdf").write_bytes(FORM)
    assert load_study(study.folder).digest != before
    with ServerProcess(study.folder) as server, Visit(chromium, server.url, "consent") as visit:
        visit.go("?participant=Ada")
        visit.heading("Taking part in this study")
        link = visit.page.get_by_role("link", name="https://lab.example/data")
        assert link.get_attribute("href") == "https://lab.example/data"
        assert link.get_attribute("rel") == "noopener noreferrer"
        form = visit.page.get_by_role("link", name="This form as a file")
        assert form.get_attribute("href") == "/consent/en.pdf"
        visit.main_button().click()
        visit.page.get_by_text("Please tick every box").wait_for()
        visit.picture("boxes")
        visit.page.get_by_label("I am 18 or older.").check()
        visit.main_button().click()
        assert visit.heading() == "Taking part in this study"
        visit.page.get_by_label("I have read this form.").check()
        assert visit.page.get_by_text("Please tick every box").count() == 0
        visit.main_button().click()
        visit.heading("What you will do")
        assert visit.unexpected() == []
        sent = httpx2.get(f"{server.url}/consent/en.pdf", timeout=60)
        assert (sent.content, sent.headers["content-type"]) == (FORM, "application/pdf")
        for name in ("de.pdf", "en.toml", "..%2fen.toml"):
            assert httpx2.get(f"{server.url}/consent/{name}", timeout=60).status_code == 404
