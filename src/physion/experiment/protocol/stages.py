"""Stages of a session: the one list of pages and phases, from which all others are derived.

To add a page: add its stage to `Stage` and its row to `PAGES`, in the order of a session; its
column to `store.tables` with a migration, and to `store.sessions.Session`; its fields to
`store.sent_pages.FIELDS`; its rendering to ``PAGES`` in ``static/session.js``; and its label to the
table ``preview`` of the texts. `store.sessions.stages_of` says which studies have it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

Phase = Literal["familiarization", "test"]
Stage = Literal[
    "consent",
    "instructions",
    "comprehension",
    "familiarization",
    "ready",
    "test",
    "block",
    "demographics",
    "questions",
    "feedback",
    "done",
    "declined",
    "withdrawn",
    "screened_out",
]
"""Stages of a session, in this order; the `ENDED` ones can follow any other but ``done``. After
``block``, the page between blocks, the next block begins with ``familiarization`` or ``test``."""
STAGES: tuple[Stage, ...] = get_args(Stage)
ENDED: tuple[Stage, ...] = ("declined", "withdrawn", "screened_out")
"""Stages of sessions that ended before they were complete: no consent, stopped, or ended by the
study since the participant failed the comprehension check."""


OF_BLOCK: tuple[Stage, ...] = ("familiarization", "ready", "test", "block")
"""Stages that each block of a session has."""


@dataclass(frozen=True)
class Page:
    """A page that is submitted: the column of SESSIONS with the time of it, and a label."""

    column: str
    label: str


PAGES: Mapping[Stage, Page] = {
    "consent": Page("consented_at", "Consent"),
    "instructions": Page("instructed_at", "Instructions"),
    "comprehension": Page("comprehended_at", "Comprehension check"),
    "ready": Page("ready_at", "Start page"),
    "block": Page("block_at", "Page between blocks"),
    "demographics": Page("demographics_at", "Demographics"),
    "questions": Page("questions_at", "Own questions"),
    "feedback": Page("finished_at", "Feedback"),
}
"""The pages by stage; the last one finishes the session."""


@dataclass(frozen=True)
class Block:
    """A block of a session.

    Attributes
    ----------
    scenario
        The scenario of its trials.
    familiarization, test
        Indices of its trials in each phase, counted over the whole session.
    """

    scenario: str
    familiarization: range
    test: range

    def of(self, phase: str) -> range:
        """Return the indices of the trials of a phase."""
        return self.test if phase == "test" else self.familiarization


@dataclass(frozen=True)
class SessionTrials(Mapping[str, int]):
    """Numbers of trials of a session by phase, and its blocks."""

    blocks: tuple[Block, ...]

    def __getitem__(self, phase: str) -> int:
        if phase not in get_args(Phase):
            raise KeyError(phase)
        return self.blocks[-1].of(phase).stop

    def __iter__(self) -> Iterator[str]:
        return iter(get_args(Phase))

    def __len__(self) -> int:
        return len(get_args(Phase))


@dataclass(frozen=True)
class Course:
    """What a session consists of.

    Attributes
    ----------
    stages
        Its pages and phases in order, ``done`` last.
    trials
        Number of trials in each phase, and blocks.
    settings
        Settings of the study that may differ between sessions: the fields of
        `messages.SessionSettings`.
    """

    stages: tuple[Stage, ...]
    trials: SessionTrials
    settings: Mapping[str, float] = field(default_factory=dict)


def label(stage: str) -> str:
    """Return the name of a stage on the experimenter's pages.

    The stage may be followed by the number of a block: ``test 2``.
    """
    name, _, number = stage.partition(" ")
    known: dict[str, str] = {page: about.label for page, about in PAGES.items()}
    known["done"] = "Finished"
    words = known.get(name, name.capitalize())
    return f"{words}, block {number}" if number else words
