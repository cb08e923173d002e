"""Questions of the lab and of the comprehension check, and the item of mental rotation."""

from __future__ import annotations

import importlib.util
import tomllib
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from physion.core.errors import BadInputError
from physion.experiment.study.identity import Secrets
from physion.experiment.study.settings import (
    MENTAL_ROTATION,
    Question,
    check_answers,
    check_attempt,
    columns_of,
    parse_settings,
)
from physion.experiment.study.study import load_study
from physion.experiment.study.texts import shipped_languages, shipped_question
from physion.experiment.web.api import public_study
from physion.trials.files import encode_png
from support.experiment.own_questions import (
    COMPREHENSION,
    COMPREHENSION_TEXTS,
    OWN_ANSWERS,
    OWN_QUESTIONS,
    OWN_TEXTS,
    RIGHT,
    WRONG,
)
from support.experiment.tiny_study import make_tiny_study
from support.paths import ROOT

NEEDED: dict[str, Any] = {
    "name": "n", "version": "1", "title": "t", "contact": "c", "scenarios": ["collide"],
}  # fmt: skip
"""The settings that a study must have."""


def test_questions_are_written_and_read_back(tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path, test=1, familiarization=1, questions=OWN_QUESTIONS,
        comprehension_questions=COMPREHENSION, more_texts=OWN_TEXTS + COMPREHENSION_TEXTS,
    )  # fmt: skip
    assert study.questions == OWN_QUESTIONS == load_study(tmp_path).questions
    assert study.texts["de"]["question.games.options.never"] == "Never"
    assert load_study(tmp_path).comprehension_questions == COMPREHENSION
    assert study.texts["en"]["comprehension_question.task.text"] == "What do you predict?"
    path = tmp_path / "texts" / "de.toml"
    whole = path.read_text()
    for line, lacking in (
        ('high = "Very"\n', r"question\.confidence\.high"),
        ('fall = "What falls"\n', r"comprehension_question\.task.*fall"),
    ):
        path.write_text(whole.replace(line, ""))
        with pytest.raises(BadInputError, match=rf"de\.toml lacks the text {lacking}"):
            load_study(tmp_path)


@pytest.mark.parametrize(
    ("question", "told"),
    [
        ({"name": "Games", "kind": "text"}, "name .* a word of small letters"),
        ({"name": "games"}, "missing 'kind'"),
        ({"name": "games", "kind": "text", "step": 3}, "unknown key"),
        ({"name": "games", "kind": "choice", "options": ["one"]}, "games needs options"),
        ({"name": "games", "kind": "scale", "options": ["a", "b"]}, "games has options"),
        ({"name": "games", "kind": "scale", "steps": 1}, "greater than or equal to 2"),
        ({"name": "games", "kind": "text", "right": "a"}, "not an option of it as a choice"),
        ({"name": "games", "kind": "choice", "options": ["a", "b"], "right": "c"},
         "right answer c, which is not an option"),
        ({"name": "games", "kind": "text", "picture": "../a.png"}, "the name of a PNG"),
        ({"name": "session", "kind": "text"}, "a second column session"),
        ({"name": "a_b", "kind": "text"}, "a second column a_b"),
    ],
)  # fmt: skip
def test_what_is_no_question_is_refused(question: dict[str, Any], told: str) -> None:
    first = {"name": "a", "kind": "choices", "options": ["b", "c"]}
    with pytest.raises(BadInputError, match=told):
        parse_settings(NEEDED | {"questions": [first, question]}, Path("study.toml"))


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"right": "blue"}, "right answer blue, which is not an option"),
        ({"options": ["red"]}, "must hold 2 values"),
        ({"name": "task"}, "task exists twice"),
        ({"correct": "red"}, "unknown key"),
    ],
)
def test_what_is_no_check_is_refused(changed: dict[str, Any], told: str) -> None:
    first = {"name": "task", "options": ["a", "b"], "right": "a"}
    second = {"name": "colour", "options": ["red", "green"], "right": "red"} | changed
    with pytest.raises(BadInputError, match=told):
        parse_settings(NEEDED | {"comprehension_questions": [first, second]}, Path("study.toml"))


def test_a_study_has_at_most_nine_questions() -> None:
    texts = [{"name": f"q{number}", "kind": "text"} for number in range(10)]
    with pytest.raises(BadInputError, match="at most 9"):
        parse_settings(NEEDED | {"questions": texts}, Path("study.toml"))


def test_a_question_may_have_a_picture_and_a_right_answer(tmp_path: Path) -> None:
    turned = Question("turned", "choice", options=("a", "b"), picture="turned.png", right="b")
    texts = """
[question.turned]
text = "Which one?"
alt = "Two figures"
options = {a = "A", b = "B"}
"""
    with pytest.raises(BadInputError, match=r"turned\.png is missing"):
        make_tiny_study(tmp_path, test=1, familiarization=1, questions=(turned,), more_texts=texts)
    picture = tmp_path / "texts" / "turned.png"
    picture.write_bytes(b"GIF89a")
    with pytest.raises(BadInputError, match="is no PNG file"):
        load_study(tmp_path)
    picture.write_bytes(encode_png(np.zeros((2, 2, 3), np.uint8)))
    study = load_study(tmp_path)
    assert columns_of(turned) == ("turned", "turned_right")
    picture.write_bytes(encode_png(np.ones((2, 2, 3), np.uint8)))
    assert load_study(tmp_path).digest != study.digest  # participants saw another study
    public = public_study(study, Secrets.load(tmp_path)).model_dump_json()
    assert '"picture":"turned.png"' in public and "right" not in public
    path = tmp_path / "texts" / "de.toml"
    path.write_text(path.read_text().replace('alt = "Two figures"\n', ""))
    with pytest.raises(BadInputError, match=r"lacks the text question\.turned\.alt"):
        load_study(tmp_path)


def test_valid_answers_are_kept() -> None:
    found = check_answers(OWN_QUESTIONS, OWN_ANSWERS)
    assert found == OWN_ANSWERS | {"devices": ["phone", "console"]}
    for sure in (1, 5):
        kept = check_answers(OWN_QUESTIONS, OWN_ANSWERS | {"confidence": sure})
        assert kept["confidence"] == sure
    left_open = {**OWN_ANSWERS, "strategy": "  ", "devices": []}
    found = check_answers(OWN_QUESTIONS, left_open)
    assert found["strategy"] is None and found["devices"] == []
    assert columns_of(OWN_QUESTIONS[2]) == ("devices_phone", "devices_console", "devices_computer")


BAD = {
    "games": [None, "daily", 1, ["never"]],
    "confidence": [None, 0, 6, 2.5, True, "3"],
    "strategy": [3, "x" * 2001],
    "devices": [None, "phone", ["phone", "phone"], ["tablet"], [["phone"]]],
}


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, values in BAD.items() for v in values])
def test_invalid_answers_are_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        check_answers(OWN_QUESTIONS, OWN_ANSWERS | {name: value})


def test_each_question_is_answered_and_no_other() -> None:
    for name in OWN_ANSWERS:
        with pytest.raises(ValueError, match=f"{name} is missing"):
            check_answers(OWN_QUESTIONS, {k: v for k, v in OWN_ANSWERS.items() if k != name})
    with pytest.raises(ValueError, match="'other' is not a question"):
        check_answers(OWN_QUESTIONS, OWN_ANSWERS | {"other": "x"})
    needed = replace(OWN_QUESTIONS[2], required=True)
    with pytest.raises(ValueError, match="an answer is required"):
        check_answers([needed], {"devices": []})
    assert check_answers([Question("a", "scale")], {"a": None}) == {"a": None}


def test_an_attempt_answers_every_question() -> None:
    assert check_attempt(COMPREHENSION, WRONG) == WRONG
    for bad in ({"task": "touch"}, RIGHT | {"colour": "blue"}, RIGHT | {"colour": None}):
        with pytest.raises(ValueError, match="colour: one of red, green, yellow"):
            check_attempt(COMPREHENSION, bad)
    with pytest.raises(ValueError, match="'other' is not a question"):
        check_attempt(COMPREHENSION, RIGHT | {"other": "red"})


# --- mental rotation ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drawing() -> ModuleType:
    """The script that drew the picture."""
    spec = importlib.util.spec_from_file_location("drawing", ROOT / "docs/mental_rotation.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_one_option_is_the_figure_and_no_turn_makes_it_of_its_mirror_image(
    drawing: ModuleType,
) -> None:
    assert drawing.RIGHT == MENTAL_ROTATION.right == "c"
    assert [mirrored for mirrored, _ in drawing.OPTIONS.values()].count(False) == 1
    assert drawing.is_chiral(drawing.CUBES)
    assert not drawing.is_chiral(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.0]]))


def test_every_cube_is_seen_in_every_figure(drawing: ModuleType) -> None:
    for mirrored, turn in [(False, drawing.VIEW), *drawing.OPTIONS.values()]:
        ids = drawing.render_figure(mirrored, turn, 96).ids
        assert np.bincount(ids.ravel(), minlength=11)[1:].min() > 50
        border = np.concatenate([ids[0], ids[-1], ids[:, 0], ids[:, -1]])
        assert not border.any()  # no figure is cut


@pytest.mark.slow
def test_the_picture_is_the_one_that_the_script_draws(drawing: ModuleType) -> None:
    shipped = np.asarray(Image.open(drawing.PICTURE).convert("RGB")).astype(int)
    drawn = np.asarray(drawing.draw()).astype(int)
    assert np.abs(shipped - drawn).mean() < 0.5


def test_it_has_texts_in_every_language() -> None:
    for language in shipped_languages():
        text = shipped_question("mental_rotation", f"{language}.toml").decode()
        own = tomllib.loads(text)["question"]["mental_rotation"]
        assert set(own) == {"text", "alt", "options"} and len(own["options"]) == 4
