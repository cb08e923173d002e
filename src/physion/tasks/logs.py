"""Predictions from logs of answers: of Inspect (``.eval``, ``.json``) and lmms-eval (``.jsonl``).

A stimulus is asked about twice or more, in both orders of the options. P(contact) is the fraction
of yes. An answer that cannot be read, a refusal, an error and a missing answer count as wrong, so
that none of them is right by accident. What is predicted is what most answers say; where they are
balanced, an answer in the order of options that the name of the stimulus draws.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from physion.core.errors import BadInputError, MissingExtraError, one_line
from physion.core.files import read_plain
from physion.core.seeds import stable_hash
from physion.core.settings import parse_json, read_settings
from physion.trials.share.questions import (
    CONTACT,
    VERSION,
    YES_NO,
    item_id,
    options_of,
    read_answer,
)

INSPECT_LOGS = (".eval", ".json")
SAMPLES = ".jsonl"
LOGS = (*INSPECT_LOGS, SAMPLES)
"""Endings of files that are logs of answers, not tables of predictions."""
MAX_BYTES = 1 << 32
"""Largest log that is read."""
_NAMED = 3
"""Missing answers that a warning names."""


@dataclass(frozen=True)
class Asked:
    """What was asked: the trial with its scenario, the question, the right answer, the order."""

    trial: str
    scenario: str
    question: str
    truth: str
    order: int


@dataclass(frozen=True)
class AnswerLog:
    """A log: predictions (columns of `physion.analysis.tables.PREDICTIONS`), and what is missing.

    ``warnings``: one sentence each.
    """

    predictions: pd.DataFrame
    warnings: tuple[str, ...]


@dataclass
class _Collected:
    """Answers by item, with the model and what it was given; each is asked ``epochs`` times."""

    model: str
    inputs: str
    asked: Mapping[str, Asked]
    answers: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    again: str = ""
    epochs: int = 1


def is_log(path: Path) -> bool:
    """Return whether a file is a log of answers by its ending."""
    return path.suffix.lower() in LOGS


def read_answers(path: Path) -> AnswerLog:
    """Return the predictions of a log, one row per stimulus.

    Raises
    ------
    BadInputError
        For a file that is not a log of the task ``physion/contact``, is damaged, or was made by
        another version of the task.
    MissingExtraError
        If a log of Inspect is read where Inspect is not installed.
    """
    if not path.is_file():
        raise BadInputError(f"{path} is not a file")
    found = _samples(path) if path.suffix.lower() == SAMPLES else _inspect_log(path)
    others = sorted({asked.question for asked in found.asked.values()} - {CONTACT})
    if others or not found.asked:
        what = f"asks about {others[0]!r}" if others else "asks nothing"
        raise BadInputError(f"{path} {what}: only answers of physion/contact are predictions")
    return _predictions(path, found)


def _inspect_log(path: Path) -> _Collected:
    try:
        from inspect_ai.log import read_eval_log
    except ImportError as error:
        content = read_plain(path, MAX_BYTES, follow_links=True)
        if path.suffix.lower() == ".json" and b'"eval"' not in content:
            raise BadInputError(
                f"{path} is not a log of Inspect; save predictions as a CSV table with the columns "
                "stimulus and p_contact"
            ) from error
        raise MissingExtraError(f"to read {path}", "inspect") from error
    try:
        log = read_eval_log(str(path), exclude_fields={"events", "messages", "attachments"})
    except Exception as error:  # whatever its readers of zip and JSON raise
        raise BadInputError(
            f"{path} cannot be read as a log of Inspect: {one_line(error)[:200]}"
        ) from error
    facts: Mapping[str, Any] = log.eval.metadata or {}
    _check_version(facts.get("physion"), path)
    rows = read_settings(
        dict[str, tuple[str, str, str, str, int]], facts.get("asked"), f"{path}: asked"
    )
    run = {str(name) for name in log.eval.dataset.sample_ids or rows}
    asked = {name: Asked(*row) for name, row in rows.items() if name in run}
    movie = facts.get("media") == "movie"
    inputs = "observed movie" if movie else f"{facts.get('frames')} pictures"
    wording = "" if facts.get("wording") == 1 else f", wording {facts.get('wording')}"
    again = f"its status is {log.status}: inspect eval-retry {path} completes it"
    again = "" if log.status == "success" else again
    epochs = log.eval.config.epochs or 1
    found = _Collected(str(log.eval.model), inputs + wording, asked, again=again, epochs=epochs)
    for sample in log.samples or []:
        if sample.id in asked and sample.error is None:
            found.answers[str(sample.id)].append(str(sample.output.completion))
    return found


def _samples(path: Path) -> _Collected:
    lines = read_plain(path, MAX_BYTES, follow_links=True).splitlines()
    asked: dict[str, Asked] = {}
    # The harness writes samples into a folder of the model, unless it has no name.
    found = _Collected(path.parent.name or path.stem, "observed movie", asked)
    for number, line in enumerate(lines, 1):
        where = f"{path}, line {number}"
        try:
            row = parse_json(line.decode(errors="replace"), where)
        except BadInputError:
            if number < len(lines):
                raise
            found.again = "its last line is cut: run lmms-eval again"
            break
        item = row.get("asked") if isinstance(row, dict) else None
        if not isinstance(item, dict):
            raise BadInputError(f"{where} is not a sample of the exported task physion_contact")
        _check_version(item.get("version"), path)
        known = {name: item.get(name) for name in Asked.__dataclass_fields__}
        one = read_settings(Asked, known, where)
        if item_id(one.trial, one.question, one.order) in found.answers:
            raise BadInputError(f"{where}: {one.trial!r} was answered before; keep one log")
        found.answers[item_id(one.trial, one.question, one.order)] = [
            str(row.get("filtered_resps", ""))
        ]
        # Both orders are asked: one that is not in the log is missing.
        for order in (0, 1):
            other = dataclasses.replace(one, order=order)
            asked.setdefault(item_id(one.trial, one.question, order), other)
    return found


def _check_version(given: object, path: Path) -> None:
    if given != VERSION:
        which = "not of a task of this package" if given is None else f"of version {given}"
        raise BadInputError(
            f"{path} is {which}; this package reads version {VERSION} of the task: run it again"
        )


def _predictions(path: Path, log: _Collected) -> AnswerLog:
    """Return one row per stimulus, and warnings of what is missing or cannot be read."""
    by_trial: dict[str, list[tuple[Asked, str]]] = defaultdict(list)
    missing, unreadable = [], 0
    for name, asked in sorted(log.asked.items()):
        options = options_of(asked.question, asked.order)
        answers = [read_answer(text, options) for text in log.answers.get(name, [])]
        unreadable += answers.count("")
        lacking = max(log.epochs - len(answers), 0)
        missing += [name] * lacking
        by_trial[asked.trial] += [(asked, answer) for answer in [*answers, *[""] * lacking]]
    warnings = []
    again = [log.again] if log.again else []
    if missing:
        named = list(dict.fromkeys(missing))
        names = ", ".join(named[:_NAMED]) + (", ..." if len(named) > _NAMED else "")
        lost = (
            f"{len(missing)} of {len(log.asked) * log.epochs} answers are missing and count as "
            f"wrong ({names})"
        )
        again = [lost, *again]
    if again:
        warnings.append(f"{path}: {'; '.join(again)}")
    if unreadable:
        warnings.append(f"{path}: {unreadable} answers name no option and count as wrong")
    rows = [_row(trial, answers) for trial, answers in sorted(by_trial.items())]
    table = pd.DataFrame(rows).assign(model=log.model, inputs=log.inputs)
    return AnswerLog(table, tuple(warnings))


def _row(trial: str, answers: list[tuple[Asked, str]]) -> dict[str, Any]:
    """Return the row of a stimulus from its answers."""
    yes, no = YES_NO
    truth = answers[0][0].truth
    wrong = no if truth == yes else yes
    given = [(asked.order, (answer or wrong) == yes) for asked, answer in answers]
    p = sum(said for _, said in given) / len(given)
    predicted = p > 0.5
    if p == 0.5:
        drawn = stable_hash("order", trial) % 2
        predicted = next((said for order, said in given if order == drawn), given[0][1])
    return {
        "stimulus": trial,
        "scenario": answers[0][0].scenario,
        "p_contact": p,
        "predicted": predicted,
        "outcome": truth == yes,
    }
