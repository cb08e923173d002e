"""Check of files of responses: errors that stop an analysis, and what it would leave out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from physion.analysis.people.completeness import Expected, completeness_warnings
from physion.analysis.people.exclusions import PREREGISTERED, ExclusionRules, flag_sessions
from physion.analysis.people.participants import Responses, check_labels, missing_times
from physion.analysis.people.results import read_any_responses
from physion.analysis.tables.submission import Checked, Fault
from physion.core.errors import BadInputError

FEWEST_PEOPLE = 2
"""People a stimulus, below which neither kappa of two people nor a noise ceiling is defined."""


def check_responses(
    files: Sequence[Path],
    sessions: Path | None = None,
    labels: Mapping[str, bool] | None = None,
    expected: Expected | None = None,
    rules: ExclusionRules = PREREGISTERED,
) -> tuple[Checked, Responses | None]:
    """Check the answers of single participants.

    Parameters
    ----------
    files, sessions
        As for `results.read_any_responses`.
    labels
        Official outcomes, with which the labels of the responses must agree; None: not checked.
    expected
        Stimuli that a session must have, as for `exclusions.flag_sessions`.
    rules
        Exclusion rules, whose flags are counted.

    Returns
    -------
    checked
        An error for what stops an analysis, with file, row and column where they are known; a
        warning for each kind of answers or sessions that would be left out, for answers without a
        response time and for stimuli with fewer than `FEWEST_PEOPLE` answers.
    responses
        What was read; None after an error.
    """
    name = ", ".join(map(str, files))
    try:
        responses = read_any_responses(files, sessions)
        if labels is not None:
            check_labels(responses, labels)
    except BadInputError as error:
        return Checked(name, 0, {}, (Fault("responses", str(error)),)), None
    faults = [_warning(text) for text in completeness_warnings(responses, expected)]
    for table in (responses.dropped, missing_times(responses)):
        faults += [
            _warning(f"{row['scenario']}: {row['rows']} answers of {row['sessions']} sessions: "
                     f"{row['reason']}")
            for row in table.to_dict("records")
        ]  # fmt: skip
    flags = flag_sessions(responses, rules, expected=expected)
    if flags["flagged"].any():
        faults.append(
            _warning(
                f"{int(flags['flagged'].sum())} of {len(flags)} sessions are flagged by the rules "
                f"“{rules.name}” and would be left out"
            )
        )
    faults += _few_answers(responses.test)
    counts = responses.test.groupby("scenario")["session"].nunique()
    people = {str(scenario): int(n) for scenario, n in counts.items()}
    unchecked = () if labels is not None else ("outcomes: no official outcomes were given",)
    checked = Checked(name, len(responses.trials), {}, tuple(faults), unchecked, people)
    return checked, responses


def _warning(text: str) -> Fault:
    return Fault("responses", text, level="warning")


def _few_answers(test: pd.DataFrame) -> list[Fault]:
    counts = test.groupby("stimulus").size()
    few = counts[counts < FEWEST_PEOPLE]
    if few.empty:
        return []
    text = f"{len(few)} stimuli have fewer than {FEWEST_PEOPLE} answers, such as {few.index[0]}"
    return [_warning(text)]
