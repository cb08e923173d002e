"""What anyone who opens the page may know of a study, sent before a session begins."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from physion.experiment.protocol.messages import Completion, Message, Source, TrialMedia


class Recruiter(Message):
    """Names of the URL parameters by which one recruiter identifies participants.

    A URL belongs to the first recruiter whose ``id`` parameter or one of whose ``preview``
    parameters it has, else it is a plain link. Parameters named in ``others`` go into
    ``Enter.recruiter`` if present. ``preview``: a URL with one of these values only shows
    information, and no session may begin (MTurk). Any URL may have ``scenario``, ``language`` and
    ``pass``, which are copied into `Enter`.
    """

    source: Source
    id: str
    others: list[str]
    preview: dict[str, str] = Field(default_factory=dict)


class AskedQuestion(Message):
    """A question of the lab; its text has the key ``question.NAME.text``."""

    name: str
    kind: Literal["text", "choice", "choices", "scale"]
    required: bool
    options: list[str]
    steps: int


class CheckedQuestion(Message):
    """A question of the comprehension check, without its right answer; its text has the key
    ``comprehension_question.NAME.text``."""

    name: str
    options: list[str]


class PublicStudy(Message):
    """Settings of the study that anyone who opens the page may see."""

    title: str
    contact: str
    languages: list[str]
    consent_version: str
    consent_files: list[str]
    """Languages in which the consent form can be read as a file, ``/consent/LANGUAGE.pdf``."""
    scenarios: list[str]
    id_needed: bool
    min_width: int
    min_height: int
    fullscreen: bool
    cue_ms: int
    flash_hz: float
    break_every: int
    """Number of test trials between two breaks; 0: no breaks."""
    familiarization_feedback: bool
    preload: int
    """Number of trials whose media are loaded ahead."""
    interrupted: Literal["repeat", "void"]  # see `Plausibility`
    comprehension_questions: list[CheckedQuestion]
    comprehension_limit: int
    """How often the comprehension check can be answered."""
    practice_min_correct: int
    """Right answers needed in the practice; 0: no criterion."""
    questions: list[AskedQuestion]
    """The lab's own questions at the end."""
    example: dict[str, TrialMedia]
    """Media of the animated example in the instructions, by scenario."""
    recruiters: list[Recruiter]
    """In the order in which they are matched against the URL."""
    device_refused: dict[Source, Completion]
    """Completion of participants whose device or browser cannot show the movies."""
