"""Optional parts of a session: boxes, checks, breaks, conditions, questions; the paper."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx2
import pytest

from physion.cli.main import main
from physion.experiment.server_process import ServerProcess
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import (
    MENTAL_ROTATION,
    PAPER,
    Attention,
    Comprehension,
    Condition,
    EarlyEnd,
    Practice,
    Question,
    Recruitment,
    Screen,
)
from physion.experiment.study.study import Study, load_study
from physion.experiment.study.texts import TEXTS_FOLDER, shipped_question
from support.experiment.browser import FAST, SHORT, Visit, rows_of, served
from support.experiment.own_questions import (
    COMPREHENSION,
    COMPREHENSION_TEXTS,
    OWN_ANSWERS,
    OWN_QUESTIONS,
    OWN_TEXTS,
)
from support.experiment.tiny_study import make_tiny_study

pytestmark = pytest.mark.slow
BOXES = """[consent]
check_1 = "I am 18 or older."
check_2 = "I have read this form."
"""
FORM = b"%PDF-1.7 a form"
TEXTS = """
[scenario.drop.trial]
prompt = "Will the falling object be hit?"
[question.fun]
text = "Was it fun?"
low = "No"
high = "Yes"
[condition.plain.instructions]
answer = "First {practice}, then {trials} movies."
[condition.plain.ready]
text = "{trials} movies follow."
[condition.plain.trial]
prompt = "Do they meet?"
"""


@pytest.fixture(scope="module")
def rich(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    """A study with all optional parts: a practice trial, four trials, a check."""
    study = make_tiny_study(
        tmp_path_factory.mktemp("study"), test=4, familiarization=1,
        scenarios=("drop",), languages=("en",), plausibility=FAST,
        timing=replace(SHORT, break_every=2),
        attention=Attention(instructed=1), practice=Practice(min_correct=1, repeats=1),
        comprehension_questions=COMPREHENSION, comprehension=Comprehension(attempts=2),
        questions=(*OWN_QUESTIONS, Question("fun", "scale", steps=5)), demographics=False,
        conditions=(
            Condition("usual"),
            Condition("plain", cue_ms=200, familiarization_feedback=False),
        ),
        screened_out=EarlyEnd("", "OUT-CODE", "https://lab.example/out"),
        recruitment=Recruitment(link_code="TINY-CODE"),
        more_texts=COMPREHENSION_TEXTS + OWN_TEXTS + TEXTS,
    )  # fmt: skip
    english = study.folder / TEXTS_FOLDER / "en.toml"
    text = english.read_text().replace("[consent]\n", BOXES)
    text = text.replace("\nQuestions?", "\nSee https://lab.example/data.\n\nQuestions?", 1)
    english.write_text(text)
    (study.folder / TEXTS_FOLDER / "consent-en.pdf").write_bytes(FORM)
    assert load_study(study.folder).digest != study.digest
    with ServerProcess(study.folder) as server:
        yield study, server.url


def query_of(study: Study, name: str, condition: str) -> str:
    key = make_pass(Secrets.load(study.folder), "study", "link", "condition", condition)
    return f"?participant={name}&condition={condition}&pass={key}"


def agree(visit: Visit, query: str) -> None:
    """Tick the boxes of the consent, agree, and read the instructions."""
    visit.go(query)
    visit.heading("Taking part in this study")
    visit.page.get_by_label("I am 18 or older.").check()
    visit.page.get_by_label("I have read this form.").check()
    visit.main_button().click()
    visit.page.locator("#language").wait_for(state="detached")
    read(visit)


def read(visit: Visit) -> None:
    for title in ("What you will do", "What you will see", "How you answer"):
        visit.heading(title)
        visit.main_button().click()


def attempt(visit: Visit, colour: str) -> None:
    """Answer the comprehension check."""
    visit.heading("Before you begin")
    visit.page.get_by_label("What touches").check()
    visit.page.get_by_label(colour).check()
    visit.main_button().click()


def test_all_boxes_are_ticked_before_one_agrees(chromium: Any, rich: tuple[Study, str]) -> None:
    _, url = rich
    with Visit(chromium, url, "consent") as visit:
        visit.go("?participant=Box")
        visit.heading("Taking part in this study")
        link = visit.page.get_by_role("link", name="https://lab.example/data")
        assert link.get_attribute("href") == "https://lab.example/data"
        assert link.get_attribute("rel") == "noopener noreferrer"
        form = visit.page.get_by_role("link", name="This form as a file")
        assert form.get_attribute("href") == "/consent/en.pdf"
        visit.main_button().click()
        visit.page.get_by_text("Please tick every box").wait_for()
        visit.page.get_by_label("I am 18 or older.").check()
        visit.main_button().click()
        assert visit.heading() == "Taking part in this study"
        visit.page.get_by_label("I have read this form.").check()
        assert visit.page.get_by_text("Please tick every box").count() == 0
        visit.main_button().click()
        visit.heading("What you will do")
        assert visit.unexpected() == []
    sent = httpx2.get(f"{url}/consent/en.pdf", timeout=60)
    assert (sent.content, sent.headers["content-type"]) == (FORM, "application/pdf")
    for name in ("de.pdf", "en.toml", "..%2fen.toml"):
        assert httpx2.get(f"{url}/consent/{name}", timeout=60).status_code == 404


def test_a_session_with_all_optional_parts(chromium: Any, rich: tuple[Study, str]) -> None:
    study, url = rich
    with Visit(chromium, url, "rich") as visit:
        page = visit.page
        visit.go(query_of(study, "Ada", "usual"))
        visit.heading("Taking part in this study")
        assert "6 short movies" in page.inner_text("main")
        agree(visit, query_of(study, "Ada", "usual"))
        # One wrong answer to the questions about the instructions, which are shown again.
        visit.heading("Before you begin")
        visit.main_button().click()
        assert page.get_by_text("Please answer this question.").count() == 2
        attempt(visit, "The green one")
        visit.heading("What you will do")
        page.get_by_text("Attempts left: 1").wait_for()
        visit.picture("again")
        read(visit)
        attempt(visit, "The red one")
        # The practice is repeated after a wrong answer, also after a reload.
        visit.answer("no")
        assert visit.see_feedback() == "Not correct."
        visit.heading("The practice once more")
        page.reload()
        visit.heading("The practice once more")
        visit.main_button().click()
        page.get_by_text("Practice 1 of 1").wait_for()
        visit.answer("yes")
        assert visit.see_feedback() == "Correct!"
        prompts = []
        visit.heading("You are ready")
        assert "5 movies follow" in page.inner_text("main")
        assert "After every 2 movies you can take a break" in page.inner_text("main")
        visit.begin_test()
        for trial in range(5):
            if trial in (2, 4):
                take_a_break(visit, trial)
            page.get_by_text(f"Trial {trial + 1} of 5").wait_for()
            prompts.append(page.inner_text("#prompt"))
            visit.wait_for_answer()
            asked = page.inner_text("#prompt")
            if asked.startswith("A check of your attention"):
                visit.picture("check")
                visit.answer("no" if "YES" in asked else "yes")
            else:
                visit.answer("yes")
        answer_own_questions(visit)
        page.check("#difficulty-4")
        page.check("#technical-no")
        visit.main_button().click()
        page.locator("#code").wait_for()
        assert "of 4 movies" in page.inner_text("main")
        assert visit.unexpected() == []
    assert set(prompts) == {"Will the falling object be hit?"}
    session, answers, events = rows_of(study, "Ada")
    shown = [(row.phase, row.trial) for row in answers]
    (check,) = [trial for phase, trial in shown if phase == "attention"]
    assert shown.count(("familiarization", 0)) == 1 and 1 <= check <= 4
    assert (session.attention_failed, session.failed_checks) == (1, "attention")
    assert session.comprehension_attempts == 2 and session.condition == "usual"
    rests = {row.trial: row.break_ms for row in answers if row.phase != "familiarization"}
    assert [trial for trial, rest in rests.items() if rest is not None] == [2, 4]
    assert all(700 <= rests[trial] < 60_000 for trial in (2, 4))
    assert {event.data["trial"] for event in events if event.kind == "break"} == {2, 4}
    assert session.own_answers == OWN_ANSWERS | {"devices": ["phone", "console"], "fun": None}
    assert session.implausible is None and session.finished_at is not None


def take_a_break(visit: Visit, trial: int) -> None:
    for again in range(2):  # a reload shows the break again
        visit.heading("Time for a break")
        assert f"You have answered {trial} of 5 movies" in visit.page.inner_text("main")
        if again == 0:
            visit.page.reload()
    visit.page.wait_for_timeout(700)
    visit.page.get_by_role("button", name="Continue").click()


def answer_own_questions(visit: Visit) -> None:
    page = visit.page
    visit.heading("Some more questions")
    visit.main_button().click()
    assert page.get_by_text("Please answer this question.").count() == 2
    assert page.evaluate("document.activeElement.name") == "q-games"
    visit.picture("missing")
    page.fill("#q-strategy", OWN_ANSWERS["strategy"])
    page.get_by_label("Often").check()
    for device in ("Telephone", "Console"):
        page.get_by_label(device).check()
    page.get_by_role("radiogroup", name="How sure were you?").get_by_label("4").check()
    # An answer to an optional scale can be taken back.
    optional = page.get_by_role("radiogroup", name="Was it fun?")
    optional.get_by_label("2").check()
    # The choice of no answer is no part of the scale.
    ends = optional.locator(".scale-ends").bounding_box()
    none = optional.locator(".scale-ends + .radio").bounding_box()
    assert none["y"] - (ends["y"] + ends["height"]) >= 10
    optional.get_by_label("I prefer not to say").check()
    visit.main_button().click()


def test_wrong_answers_to_the_questions_end_the_session(
    chromium: Any, rich: tuple[Study, str]
) -> None:
    study, url = rich
    with Visit(chromium, url, "comprehension") as visit:
        agree(visit, "?participant=Bo")
        attempt(visit, "The green one")
        read(visit)
        attempt(visit, "The yellow one")
        visit.heading("The study ends here for you")
        visit.picture("ended")
        assert visit.page.inner_text("#code") == "OUT-CODE"
        assert visit.page.get_attribute("#go", "href") == "https://lab.example/out"
        assert visit.page.get_by_text("Stop taking part").count() == 0
        visit.go("?participant=Bo")
        visit.heading("The study ends here for you")
        assert visit.unexpected() == []
    session, answers, _ = rows_of(study, "Bo")
    assert (session.comprehension_attempts, session.screened_out_by) == (2, "comprehension")
    assert answers == []


def test_a_condition_has_its_own_settings_and_texts(chromium: Any, rich: tuple[Study, str]) -> None:
    """Without feedback, a wrong practice is repeated once."""
    study, url = rich
    with Visit(chromium, url, "condition") as visit:
        agree(visit, query_of(study, "Cy", "plain"))
        attempt(visit, "The red one")
        visit.answer("no")
        visit.heading("The practice once more")  # no feedback before
        visit.main_button().click()
        visit.page.get_by_text("Practice 1 of 1").wait_for()
        visit.answer("yes")
        visit.heading("You are ready")
        assert "5 movies follow." in visit.page.inner_text("main")
        visit.begin_test()
        assert visit.page.inner_text("#prompt") == "Do they meet?"
        visit.answer("yes")
        visit.page.get_by_text("Trial 2 of 5").wait_for()
        visit.wait_for_answer()
        assert visit.unexpected() == []
    session, answers, _ = rows_of(study, "Cy")
    assert (session.condition, session.practice_repeats) == ("plain", 1)
    assert session.screened_out_by is None
    assert [row.response for row in answers] == ["yes", "yes"]
    # The repeated practice counts anew.
    assert (answers[0].showings, answers[0].resumed) == (1, False)
    # A busy machine may prolong a cue, but not all of them by so much.
    assert 190 < min(row.cue_ms for row in answers) < 450


COUNT_FLASHES = """
window.flashes = 0;
new MutationObserver((changes) => {
  for (const { target } of changes)
    if (target.matches?.(".has-verdict .screen-map") && !target.hidden) window.flashes += 1;
}).observe(document, { subtree: true, attributes: true, attributeFilter: ["hidden"] });
"""
VERDICTS = (
    "The object that flashed red touches the object that flashed yellow.",
    "The object that flashed red does not touch the object that flashed yellow.",
)
OWN = """
[study]
title = "Was geschieht?"
[scenario.drop.study]
title = "Was fällt?"
[scenario.drop.trial]
prompt = "Trifft es?"
"""


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    """A study of two scenarios, each with two practice trials, and a screen to fill."""
    folder = tmp_path_factory.mktemp("study")
    scenarios = ("collide", "drop")
    more: dict[str, Any] = {"scenarios": scenarios, "screen": Screen(fullscreen=True)}
    with served(folder, test=2, familiarization=2, more_texts=OWN, **more) as (study, server):
        yield study, server.url


@pytest.mark.nightly
def test_full_screen_is_offered_until_it_is_declined(chromium: Any, two: tuple[Study, str]) -> None:
    study, url = two
    with Visit(chromium, url, "fullscreen") as visit:
        is_full = "document.fullscreenElement !== null"
        visit.begin("?participant=Full")
        visit.heading("Full screen")
        visit.page.get_by_role("button", name="Switch to full screen").click()
        visit.practise(2)
        assert visit.page.evaluate(is_full)
        visit.begin_test()
        visit.answer("yes")
        visit.page.evaluate("document.exitFullscreen()")
        visit.answer("no")  # the trial continues
        visit.heading("About you")
        assert not visit.page.evaluate(is_full)
        visit.page.reload()  # sends the events
        visit.heading("About you")
        assert visit.unexpected() == []
    events = [(event.kind, event.data) for event in rows_of(study, "Full")[2]]
    assert ("fullscreen", {"on": True}) in events and ("fullscreen", {"on": False}) in events


@pytest.mark.nightly
def test_feedback_shows_the_map_and_is_kept_over_a_reload(
    chromium: Any, two: tuple[Study, str]
) -> None:
    study, url = two
    with Visit(chromium, url, "feedback") as visit:
        visit.context.add_init_script(COUNT_FLASHES)
        visit.begin("?participant=Learns")
        decline_full_screen(visit)
        for verdict in VERDICTS:  # the second is of the last practice trial
            visit.answer("yes")  # full screen is not offered again
            visit.page.get_by_text(verdict).wait_for()
            visit.page.reload()
            decline_full_screen(visit)
            visit.page.get_by_text(verdict).wait_for()
            visit.main_button().wait_for()
            assert visit.page.evaluate("flashes") == 1  # 0.5 s at 2 Hz
            visit.main_button().click()
        visit.begin_test()
        visit.page.reload()
        decline_full_screen(visit)
        visit.answer("yes")
        visit.page.get_by_text("Trial 2 of 2").wait_for()
        visit.page.reload()  # sends the events
        visit.heading("Full screen")
        assert visit.unexpected() == []
    _, answers, events = rows_of(study, "Learns")
    assert [(row.phase, row.response) for row in answers] == [
        ("familiarization", "yes"), ("familiarization", "yes"), ("test", "yes"),
    ]  # fmt: skip
    assert ("no_fullscreen", {"reason": "declined"}) in [(e.kind, e.data) for e in events]


def decline_full_screen(visit: Visit) -> None:
    """Decline the full screen that each load of the page offers before its first trial."""
    visit.heading("Full screen")
    visit.page.get_by_role("button", name="Continue without").click()


def test_title_and_question_differ_by_scenario(chromium: Any, two: tuple[Study, str]) -> None:
    _, url = two
    with Visit(chromium, url) as visit:
        for scenario, title, prompt in (
            ("drop", "Was fällt?", "Trifft es?"),
            ("collide", "Was geschieht?", "Wird der rote Gegenstand den gelben berühren?"),
        ):
            visit.go(f"?participant={scenario}&scenario={scenario}&language=de")
            visit.heading("Teilnahme an dieser Studie")
            assert visit.page.inner_text("#title") == visit.page.title() == title
            visit.main_button().click()
            visit.heading("Was Sie tun")
            visit.page.get_by_text(prompt).wait_for()
        assert visit.unexpected() == []


# --- the settings of the paper --------------------------------------------------------------------


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
            visit.begin(f"?participant={name}")
            visit.practise(1)
            visit.heading("You are ready")
            assert "break" not in page.inner_text("main")
            visit.begin_test()
            for _ in range(3):
                visit.answer("no")
            visit.heading("About you")
            visit.main_button().click()
            visit.heading("Some more questions")
            picture = page.locator(".question-picture")
            picture.wait_for()
            page.wait_for_function("document.querySelector('.question-picture').naturalWidth > 900")
            box, column = picture.bounding_box(), page.locator("main").bounding_box()
            assert 400 < box["width"] <= column["width"]
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
            assert not [line for line in visit.requests if "right" in line]
    assert rows_of(study, "Ada")[0].own_answers == {"mental_rotation": "c"}
    assert main(["experiment", "export", str(study.folder), "--out", str(tmp_path / "data")]) == 0
    with (tmp_path / "data/questions.csv").open() as file:
        found = {(r["mental_rotation"], r["mental_rotation_right"]) for r in csv.DictReader(file)}
    assert found == {("c", "true"), ("a", "false")}
