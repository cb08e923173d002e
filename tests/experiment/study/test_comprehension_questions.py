"""The questions of the comprehension check: settings, texts and valid attempts."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from physion.core.errors import BadInputError
from physion.experiment.study.settings import check_attempt, format_settings, parse_settings
from physion.experiment.study.study import load_study
from support.experiment.own_questions import COMPREHENSION, COMPREHENSION_TEXTS, RIGHT, WRONG
from support.experiment.tiny_study import make_tiny_study


def test_the_check_is_read_back_and_needs_its_texts(tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path, test=1, familiarization=1, comprehension_questions=COMPREHENSION,
        more_texts=COMPREHENSION_TEXTS,
    )  # fmt: skip
    assert load_study(tmp_path).comprehension_questions == COMPREHENSION
    assert study.texts["en"]["comprehension_question.task.text"] == "What do you predict?"
    path = tmp_path / "texts" / "en.toml"
    path.write_text(path.read_text().replace('fall = "What falls"\n', ""))
    with pytest.raises(BadInputError, match=r"lacks the text comprehension_question\.task.*fall"):
        load_study(tmp_path)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"right": "blue"}, "right answer blue, which is no option"),
        ({"options": ["red"]}, "must hold 2 values"),
        ({"name": "task"}, "task exists twice"),
        ({"correct": "red"}, "unknown key"),
    ],
)
def test_what_is_no_check_is_refused(tmp_path: Path, changed: dict[str, Any], told: str) -> None:
    tables = tomllib.loads(
        format_settings(make_tiny_study(tmp_path, test=1, familiarization=1), Path())
    )
    first = {"name": "task", "options": ["a", "b"], "right": "a"}
    second = {"name": "colour", "options": ["red", "green"], "right": "red"} | changed
    with pytest.raises(BadInputError, match=told):
        parse_settings(tables | {"comprehension_questions": [first, second]}, tmp_path / "s.toml")


def test_an_attempt_answers_every_question() -> None:
    assert check_attempt(COMPREHENSION, WRONG) == WRONG
    for bad in ({"task": "touch"}, RIGHT | {"colour": "blue"}, RIGHT | {"colour": None}):
        with pytest.raises(ValueError, match="colour: one of red, green, yellow"):
            check_attempt(COMPREHENSION, bad)
    with pytest.raises(ValueError, match="'other' is no question"):
        check_attempt(COMPREHENSION, RIGHT | {"other": "red"})
