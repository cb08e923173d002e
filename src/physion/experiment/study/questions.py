"""Questions of the lab: their settings in ``study.toml``, the keys of their texts, valid answers.

``study.toml`` has one table ``[[questions]]`` for each question. Its texts are in the file of each
language, in ``[question.NAME]``: ``text``; ``low`` and ``high``, the ends of a scale; and a table
``[question.NAME.options]`` with a label for each option.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError
from physion.experiment.study.study_checks import Key, flag, listed, one_of, pattern, whole

KINDS = ("text", "choice", "choices", "scale")
MAX_LENGTH = 2000
"""Characters of an answer that is a text."""
MAX_TEXTS = 9
"""Questions for a text, so that all answers fit into one request."""
MOST_STEPS = 11
RESERVED = ("participant", "participant_id", "session", "session_id", "scenario", "simulated",
            "phase", "trial", "number", "stimulus", "kind")  # fmt: skip
"""Names of columns of the export, which no question may have."""

Answer = str | int | list[str] | None
"""An answer to a question of the lab; None: none was given."""


@dataclass(frozen=True)
class Question:
    """One question of the lab at the end of a session.

    Attributes
    ----------
    name
        Name in the data and in the keys of its texts.
    kind
        ``text``; ``choice`` of one option; ``choices``, any number of options; ``scale``.
    required
        Whether an answer must be given.
    options
        Names of the options of a choice.
    steps
        Number of steps of a scale, whose ends have labels.
    """

    name: str
    kind: str
    required: bool = False
    options: tuple[str, ...] = ()
    steps: int = 7

    @property
    def text_keys(self) -> tuple[str, ...]:
        """Keys of its texts."""
        ends = ("low", "high") if self.kind == "scale" else ()
        options = (f"options.{option}" for option in self.options)
        return tuple(f"question.{self.name}.{key}" for key in ("text", *ends, *options))


NAME = pattern("[a-z][a-z0-9_]{0,39}", "a word of small letters, digits and _, at most 40")
KEYS = (
    Key("questions", "name", NAME,
        "A word of small letters, digits and _: the name of its column in the data.",
        required=True),
    Key("questions", "kind", one_of(*KINDS),
        "\"text\", \"choice\" (of one option), \"choices\" (of any number) or \"scale\".",
        required=True),
    Key("questions", "required", flag, "Whether it must be answered."),
    Key("questions", "options", listed(NAME, 0, 50),
        "Names of the options of a choice, such as [\"never\", \"often\"]."),
    Key("questions", "steps", whole(2, MOST_STEPS), f"Steps of a scale, 2 to {MOST_STEPS}."),
)  # fmt: skip
ABOUT = """\
Your own questions at the end: one table [[questions]] for each, with the keys below. Their texts
are in texts/: [question.NAME] with text and, for a scale, low and high, the labels of its ends;
[question.NAME.options] with a label for each option."""


def parse_questions(entries: Sequence[Mapping[str, Any]], path: Path) -> tuple[Question, ...]:
    """Return the questions of ``study.toml`` from the checked values of their tables.

    Raises `BadInputError`, naming the question, if its keys do not fit together.
    """
    questions = tuple(Question(**entry) for entry in entries)
    taken: set[str] = set(RESERVED)
    for question in questions:
        for fault in _faults(question):
            raise BadInputError(f"{path}: the question {question.name} {fault}")
        for column in columns_of(question):
            if column in taken:
                raise BadInputError(
                    f"{path}: the question {question.name} would make a second column {column} "
                    "in the data; choose another name"
                )
            taken.add(column)
    if sum(question.kind == "text" for question in questions) > MAX_TEXTS:
        raise BadInputError(f"{path}: at most {MAX_TEXTS} questions can be of the kind text")
    return questions


def _faults(question: Question) -> Iterator[str]:
    chosen = question.kind in ("choice", "choices")
    if chosen and len(question.options) < 2:
        yield f"needs options, at least two, as it is of the kind {question.kind}"
    if not chosen and question.options:
        yield f"has options; only choice and choices have some, not {question.kind}"


def columns_of(question: Question) -> tuple[str, ...]:
    """Return the columns of a question in the exported data: of ``choices``, one per option."""
    if question.kind != "choices":
        return (question.name,)
    return tuple(f"{question.name}_{option}" for option in question.options)


def check_answers(questions: Sequence[Question], given: Mapping[str, Any]) -> dict[str, Answer]:
    """Return the valid answers to all questions.

    Raises ``ValueError`` with the name of the first question whose answer is missing or invalid,
    or that does not exist.
    """
    names = {question.name for question in questions}
    for name in given:
        if name not in names:
            raise ValueError(f"{name[:40]!a} is no question")
    answers: dict[str, Answer] = {}
    for question in questions:
        if question.name not in given:
            raise ValueError(f"{question.name} is missing")
        try:
            answer = _CHECKS[question.kind](question, given[question.name])
        except ValueError as error:
            raise ValueError(f"{question.name}: {error}") from None
        if question.required and answer in (None, []):
            raise ValueError(f"{question.name}: an answer is required")
        answers[question.name] = answer
    return answers


def _check_text(question: Question, value: Any) -> str | None:
    if value is not None and (not isinstance(value, str) or len(value) > MAX_LENGTH):
        raise ValueError(f"text of at most {MAX_LENGTH} characters, or null")
    return (value or "").strip() or None


def _check_choice(question: Question, value: Any) -> str | None:
    if value is not None and value not in question.options:
        raise ValueError(f"one of {', '.join(question.options)}, or null")
    return None if value is None else str(value)


def _check_choices(question: Question, value: Any) -> list[str]:
    known = isinstance(value, list) and all(one in question.options for one in value)
    if not known or len(set(value)) != len(value):
        raise ValueError(f"a list with any of {', '.join(question.options)}")
    return [option for option in question.options if option in value]


def _check_scale(question: Question, value: Any) -> int | None:
    if value is None:
        return None
    if type(value) is not int or not 1 <= value <= question.steps:
        raise ValueError(f"a whole number from 1 to {question.steps}, or null")
    return value


_CHECKS = {
    "text": _check_text,
    "choice": _check_choice,
    "choices": _check_choices,
    "scale": _check_scale,
}
