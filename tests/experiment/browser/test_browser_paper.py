"""A session with the settings of the paper: payment, no breaks, the item of mental rotation."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from physion.cli.main import main
from physion.experiment.server_process import ServerProcess
from physion.experiment.study.settings import MENTAL_ROTATION, PAPER, Recruitment
from physion.experiment.study.study import Study
from physion.experiment.study.texts import TEXTS_FOLDER, shipped_question
from support.experiment.browser import FAST, SHORT, Visit, rows_of
from support.experiment.tiny_study import make_tiny_study

pytestmark = pytest.mark.slow
CONSENTS = {
    "en": ("en-US", "you receive $4.00. At 20 minutes this is $12.00 per hour."),
    "de": ("de-DE", "erhalten Sie 4,00\xa0$. Bei 20 Minuten sind das 12,00\xa0$ in der Stunde."),
}
FUNDERS = {
    "en": "This study is paid for by the Abc Foundation.",
    "de": "Diese Studie wird bezahlt von: the Abc Foundation.",
}


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    """Both languages, with a picture for one question of mental rotation."""
    folder = tmp_path_factory.mktemp("study")
    (folder / TEXTS_FOLDER).mkdir()
    picture = shipped_question(MENTAL_ROTATION.name, MENTAL_ROTATION.picture)
    (folder / TEXTS_FOLDER / MENTAL_ROTATION.picture).write_bytes(picture)
    texts = {
        language: shipped_question(MENTAL_ROTATION.name, f"{language}.toml").decode()
        for language in CONSENTS
    }
    study = make_tiny_study(
        folder, test=3, familiarization=1, plausibility=FAST, more_texts=f"\n{texts['en']}",
        recruitment=Recruitment(link_code="TINY-CODE"),
        **{**PAPER, "timing": replace(SHORT, break_every=0), "funders": "the Abc Foundation"},
    )  # fmt: skip
    german = folder / TEXTS_FOLDER / "de.toml"
    german.write_text(german.read_text().replace(texts["en"], texts["de"]))
    with ServerProcess(study.folder) as server:
        yield study, server.url


@pytest.mark.parametrize("language", CONSENTS)
def test_the_consent_states_payment_and_wage(
    chromium: Any, paper: tuple[Study, str], language: str
) -> None:
    locale, words = CONSENTS[language]
    with Visit(chromium, paper[1], f"payment-{language}", locale=locale) as visit:
        visit.go(f"?participant=consent-{language}&language={language}")
        visit.main_button().wait_for()
        said = visit.page.inner_text("main")
        assert words in said
        assert FUNDERS[language] in said
        assert "20 minutes" in said or "20 Minuten" in said
        visit.picture("consent")
        assert visit.unexpected() == []


@pytest.mark.nightly
def test_mental_rotation_is_asked_at_the_end_and_judged_in_the_export(
    chromium: Any, paper: tuple[Study, str], tmp_path: Path
) -> None:
    study, url = paper
    for name, option in (("Ada", "C"), ("Bo", "A")):
        with Visit(chromium, url, f"rotation-{name}") as visit:
            page = visit.page
            visit.go(f"?participant={name}")
            visit.main_button().click()
            for title in ("What you will do", "What you will see", "How you answer"):
                visit.heading(title)
                visit.main_button().click()
            visit.answer("yes")
            visit.see_feedback()
            visit.heading("You are ready")
            assert "break" not in page.inner_text("main")
            visit.main_button().click()
            for _ in range(3):
                visit.answer("no")
            visit.heading("About you")
            visit.main_button().click()
            visit.heading("Some more questions")
            picture = page.locator(".question-picture")
            picture.wait_for()
            page.wait_for_function("document.querySelector('.question-picture').naturalWidth > 900")
            box, column = picture.bounding_box(), page.locator("main").bounding_box()
            assert box["width"] <= column["width"] and box["width"] > 400
            assert "ten cubes" in picture.get_attribute("alt")
            page.get_by_label(option, exact=True).check()
            visit.picture("question")
            visit.main_button().click()
            visit.heading("How was it?")
            page.get_by_label("Easy", exact=True).check()
            page.get_by_label("No", exact=True).check()
            visit.main_button().click()
            page.locator("#code").wait_for()
            assert visit.unexpected() == []
            sent = [line for line in visit.requests if "right" in line]
            assert not sent
    assert rows_of(study, "Ada")[0].own_answers == {"mental_rotation": "c"}
    assert main(["experiment", "export", str(study.folder), "--out", str(tmp_path / "data")]) == 0
    with (tmp_path / "data/questions.csv").open() as file:
        rows = {row["mental_rotation"]: row for row in csv.DictReader(file)}
    assert {option: row["mental_rotation_right"] for option, row in rows.items()} == {
        "c": "true",
        "a": "false",
    }
