"""The comprehension check after the instructions: its questions, their texts, right answers.

``study.toml`` has one table ``[[comprehension_questions]]`` for each question. Its texts are in the
file of each language, in ``[comprehension_question.NAME]``: ``text``, and a table ``options`` with
a label for each option. Right answers are never sent to the browser.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError
from physion.experiment.study.questions import NAME
from physion.experiment.study.study_checks import Key, listed


@dataclass(frozen=True)
class ComprehensionQuestion:
    """A question with one right answer.

    Attributes
    ----------
    name
        Name in the data and in the keys of its texts.
    options
        Names of the options.
    right
        The right option.
    """

    name: str
    options: tuple[str, ...]
    right: str

    @property
    def text_keys(self) -> tuple[str, ...]:
        """Keys of its texts."""
        options = (f"options.{option}" for option in self.options)
        return tuple(f"comprehension_question.{self.name}.{key}" for key in ("text", *options))


KEYS = (
    Key("comprehension_questions", "name", NAME,
        "A word of small letters, digits and _: its name in the data.", required=True),
    Key("comprehension_questions", "options", listed(NAME, 2, 20),
        "Names of the options, such as [\"red\", \"yellow\"].", required=True),
    Key("comprehension_questions", "right", NAME,
        "The right option, which is never sent to the browser.", required=True),
)  # fmt: skip
ABOUT = """\
Questions about the instructions: one table [[comprehension_questions]] for each, with the keys
below. Their texts are in texts/: [comprehension_question.NAME] with text, and
[comprehension_question.NAME.options] with a label for each option."""


def parse_comprehension(
    entries: Sequence[Mapping[str, Any]], path: Path
) -> tuple[ComprehensionQuestion, ...]:
    """Return the questions of ``study.toml`` from the checked values of their tables.

    Raises `BadInputError`, naming the question, if its right answer is no option or its name is
    taken.
    """
    questions = tuple(ComprehensionQuestion(**entry) for entry in entries)
    names = [question.name for question in questions]
    for question in questions:
        where = f"{path}: the comprehension question {question.name}"
        if question.right not in question.options:
            raise BadInputError(
                f"{where} has the right answer {question.right}, which is no option of it"
            )
        if names.count(question.name) > 1:
            raise BadInputError(f"{where} exists twice; give one of them another name")
    return questions


def check_attempt(
    questions: Sequence[ComprehensionQuestion], given: Mapping[str, Any]
) -> dict[str, str]:
    """Return the answers of an attempt, one option for each question.

    Raises ``ValueError`` with the name of a question that is unknown, or whose answer is missing or
    no option of it.
    """
    for name in given:
        if name not in {question.name for question in questions}:
            raise ValueError(f"{name[:40]!a} is no question")
    for question in questions:
        if given.get(question.name) not in question.options:
            raise ValueError(f"{question.name}: one of {', '.join(question.options)}")
    return {question.name: str(given[question.name]) for question in questions}
