"""Stages of a session: the one list of pages and phases, from which all others are derived.

To add a page: add its stage to `Stage` and its row to `PAGES`, in the order of a session; its
column to `store.tables` with a migration, and to `store.sessions.Session`; its fields to
`store.sent_pages.FIELDS`; its rendering to ``PAGES`` in ``static/session.js``; and its label to the
table ``preview`` of the texts. `store.sessions.stages_of` says which studies have it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

Phase = Literal["familiarization", "test"]
Stage = Literal[
    "consent",
    "instructions",
    "familiarization",
    "ready",
    "test",
    "demographics",
    "questions",
    "feedback",
    "done",
    "declined",
    "withdrawn",
]
"""Stages of a session, in this order; the `ENDED` ones can follow any other but ``done``."""
STAGES: tuple[Stage, ...] = get_args(Stage)
ENDED: tuple[Stage, ...] = ("declined", "withdrawn")
"""Stages of sessions that ended before they were complete: no consent, or stopped."""


@dataclass(frozen=True)
class Page:
    """A page that is submitted: the column of SESSIONS with the time of it, and a label."""

    column: str
    label: str


PAGES: Mapping[Stage, Page] = {
    "consent": Page("consented_at", "Consent"),
    "instructions": Page("instructed_at", "Instructions"),
    "ready": Page("ready_at", "Start page"),
    "demographics": Page("demographics_at", "Demographics"),
    "questions": Page("questions_at", "Own questions"),
    "feedback": Page("finished_at", "Feedback"),
}
"""The pages by stage; the last one finishes the session."""


@dataclass(frozen=True)
class Course:
    """What a session consists of.

    Attributes
    ----------
    stages
        Its pages and phases in order, ``done`` last.
    trials
        Number of trials in each phase.
    """

    stages: tuple[Stage, ...]
    trials: Mapping[str, int]


def label(stage: Stage) -> str:
    """Return the name of a stage on the experimenter's pages."""
    if stage in PAGES:
        return PAGES[stage].label
    return "Finished" if stage == "done" else stage.capitalize()
