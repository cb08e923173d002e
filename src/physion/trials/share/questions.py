"""Questions for language models, how their answers are read, and measures of the answers.

This file imports nothing but the standard library: `physion.trials.share.lmms_eval` copies its text
into the task that it writes, so that every harness asks, reads and counts in one way.

Measures of n answers, of which a model gives two for each stimulus, one for each order of the
options. An answer that cannot be read, a refusal, or no answer at all counts as wrong.

- accuracy: fraction of right answers.
- d': z(H) - z(F), where H is the rate of yes at contacts and F the rate at no contacts, each
  (k + 1/2) / (n + 1) (log-linear correction). What cannot be read counts as the wrong answer.
- yes bias: rate of yes less the rate of contacts, over the answers that can be read.
- flips: fraction of stimuli whose answer changes with the order of the options, of those with
  two answers that can be read.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from statistics import NormalDist
from typing import NamedTuple

VERSION = 1
"""Raised with every change of a question, of what is shown, or of how answers are read."""
CONTACT = "contact"
"""Name of the question whose answer is a prediction."""
YES_NO = ("yes", "no")
WORDINGS = (
    "Will the red object touch the yellow object?",
    "Is the red object going to hit the yellow object?",
    "Do the red object and the yellow object come into contact at any time of the video?",
)
"""Wordings of the question, of which the first is the one that people are asked."""
PERCEPTION = {
    "left": ("At the start, which object is further to the left?", ("red", "yellow")),
    "view": ("Is a yellow object in view?", YES_NO),
    "moves": ("Does anything move in what is shown?", YES_NO),
}
"""Questions about what is shown, with their options: a control that needs no prediction."""
LETTERS = "AB"


def item_id(trial: str, question: str, order: int) -> str:
    """Return the name of a question about a trial with its options in an order, 0 or 1."""
    return f"{trial}-{question}-{order + 1}"


def options_of(question: str, order: int) -> tuple[str, str]:
    """Return the options of a question in their first (0) or second (1) order."""
    first, second = YES_NO if question == CONTACT else PERCEPTION[question][1]
    return (second, first) if order else (first, second)


def prompt(question: str, order: int, wording: int = 1, shown: str = "This video shows") -> str:
    """Return the text that is asked.

    ``wording``: from 1, of the question `CONTACT`. ``shown``: what goes with the text.
    """
    about = PERCEPTION[question][0] if question != CONTACT else WORDINGS[wording - 1]
    options = zip(LETTERS, options_of(question, order), strict=True)
    more = " The scene continues after it." if question == CONTACT else ""
    lines = [f"{shown} the beginning of a simulated scene in slow motion.{more}", about]
    lines += [f"{letter}) {option}" for letter, option in options]
    return "\n".join([*lines, "Answer with the letter of one option only."])


def read_answer(text: str, options: Sequence[str]) -> str:
    """Return the option that a text names, or an empty text if it names none or several.

    What follows the last "answer" counts or, without such a word, the first and the last line. In
    it an option is named by its letter (``B``, ``(B)``, ``B) no``) or by a word at its start.
    """
    parts = re.split(r"(?i)\banswer(?:\s+is)?\b\W*", text)
    lines = [line for line in parts[-1].splitlines() if line.strip(" \t*_\"'`.:")]
    places = lines[:1] if len(parts) > 1 else [*lines[:1], *lines[-1:]]
    named = set()
    for line in places:
        found = _named(line.strip(" \t*_\"'`"), options)
        if len(found) > 1:
            return ""
        named |= found
    return named.pop() if len(named) == 1 else ""


def _named(line: str, options: Sequence[str]) -> set[str]:
    """Return the options that a line names."""
    by_letter = dict(zip(LETTERS, options, strict=True))
    # "A yellow object" begins with a word: a letter counts at the end or before a mark, or, and.
    letters = re.findall(rf"(?<![\w'])([{LETTERS}])(?=[).:,;*]|\W*$|\s+(?:or|and)\b)", line)
    words = {word for word in options if re.search(rf"(?i)\b{word}\b", line)}
    starts = {word for word in words if re.match(rf"(?i)\W*(?:[{LETTERS}]\W+)?{word}\b", line)}
    # A word elsewhere in the line counts only against the others.
    return {by_letter[letter] for letter in letters} | (words if starts else set())


class JudgedAnswer(NamedTuple):
    """Answer to a question, or the mean of several answers to it; each value lies in 0..1.

    - ``stimulus``, ``truth``: what was asked about, and the right option;
    - ``first``: 1 for the option that the question lists first in its first order (yes, red);
    - ``readable``, ``right``: 1 or 0.
    """

    stimulus: str
    truth: str
    first: float
    readable: float
    right: float


def judged(stimulus: str, question: str, truth: str, answer: str) -> JudgedAnswer:
    """Return an answer, an option or an empty text, with what is right about it."""
    first = float(answer == options_of(question, 0)[0])
    return JudgedAnswer(stimulus, truth, first, float(bool(answer)), float(answer == truth))


def measures(answers: Iterable[JudgedAnswer]) -> dict[str, float]:
    """Return accuracy, d_prime, yes_bias, flips, and the number of unreadable answers.

    NaN where there is nothing to measure.
    """
    rows = list(answers)
    z = {truth: _z_of_yes([row for row in rows if row.truth == truth], truth) for truth in YES_NO}
    readable = sum(row.readable for row in rows)
    contacts = sum(row.readable for row in rows if row.truth == YES_NO[0])
    by_stimulus = defaultdict(list)
    for row in rows:
        if row.readable:
            by_stimulus[row.stimulus].append(row.first / row.readable)
    several = [abs(rates[0] - rates[1]) for rates in by_stimulus.values() if len(rates) == 2]
    return {
        "accuracy": _ratio(sum(row.right for row in rows), len(rows)),
        "d_prime": z["yes"] - z["no"],
        "yes_bias": _ratio(sum(row.first for row in rows) - contacts, readable),
        "flips": _ratio(sum(several), len(several)),
        "unreadable": len(rows) - readable,
    }


def _z_of_yes(rows: Sequence[JudgedAnswer], truth: str) -> float:
    """Return z of the rate of yes at stimuli of one outcome; wrong is what cannot be read."""
    right = sum(row.right for row in rows)
    yes = right if truth == YES_NO[0] else len(rows) - right
    return NormalDist().inv_cdf((yes + 0.5) / (len(rows) + 1)) if rows else float("nan")


def _ratio(number: float, count: float) -> float:
    return number / count if count else float("nan")
