"""A study: its settings, stimuli and texts, loaded from a folder of files that a lab can edit.

::

    STUDY/
      study.toml            settings: this module
      texts/en.toml, ...    texts of all pages, one file per language
      stimuli.csv           stimuli and their outcomes; never served
      media/                movies and maps, named by the hash of their content
      secret.json           keys and the experimenter's password hash (mode 600)
      responses.sqlite      the data, unless another database is given
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from physion.atomic import write_atomic
from physion.errors import BadInputError
from physion.experiment.study.stimuli import MAX_BYTES as MAX_STIMULI_BYTES
from physion.experiment.study.stimuli import PHASES, STIMULI_FILE, Stimulus, parse_stimuli
from physion.experiment.study.study_file import check_tables, format_tables, parse_toml
from physion.experiment.study.texts import TEXTS_FOLDER, read_consent_file, read_texts
from physion.plain_files import check_plain, read_ids, read_plain

STUDY_FILE = "study.toml"
MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class Timing:
    """Durations within a trial.

    Attributes
    ----------
    fixation_ms
        Shortest and longest duration of the fixation cross; drawn uniformly for each trial.
    fixation_in_familiarization
        Whether familiarization trials have a fixation cross too.
    cue_ms
        Duration of the cue on the first frame.
    flash_hz
        Full cycles (on and off) of the cue per second; 1 in the official study.
    break_every
        Number of test trials after which people can rest for as long as they like; 0: no breaks.
    """

    fixation_ms: tuple[int, int] = (500, 1500)
    fixation_in_familiarization: bool = True
    cue_ms: int = 2000
    flash_hz: float = 2.0
    break_every: int = 25


@dataclass(frozen=True)
class Screen:
    """Smallest browser window in which participants may take part, in CSS pixels.

    ``fullscreen``: whether full screen is offered before the trials, and again after it was left.
    """

    min_width: int = 1024
    min_height: int = 600
    fullscreen: bool = False


@dataclass(frozen=True)
class Plausibility:
    """What a session must keep to, to be one of a person, and what interrupts a trial.

    Attributes
    ----------
    server_checks
        Whether answers are checked against the server's clock and the media that it sent: they are
        refused before fixation cross, cue and movie can have been shown.
    fast_ms, fast_answers
        Response time under which an answer is too fast, and the number of such answers from which a
        session is implausible (a person may press by anticipation now and then).
    reading_s
        Shortest time in seconds for all pages together; less, with all movies, is implausible.
    max_showings
        How often a trial may be shown, over all loads of the page; sessions with more are flagged.
    interrupted
        What happens when, during cue or movie, the page is hidden, the window too small, or the
        question whether to stop open: ``repeat`` shows the trial again (five times at most),
        ``void`` goes on and marks the answer, which the analysis leaves out.
    simulated_speed
        How many times faster than people simulated participants may be.
    """

    server_checks: bool = True
    fast_ms: int = 100
    fast_answers: int = 3
    reading_s: float = 10.0
    max_showings: int = 2
    interrupted: str = "repeat"
    simulated_speed: float = 1.0


@dataclass(frozen=True)
class Recruitment:
    """Settings of recruitment and completion credit.

    Attributes
    ----------
    id_needed
        Whether participants without an id are refused.
    prolific_id, sona_id, mturk_id, link_id
        Regular expression that ids from this recruiter must match completely; empty: any id.
    allow_list
        Name of a text file in the study folder with all ids that may take part; empty: any.
    signed_links
        ``no``: anyone who has the address may enter; ``study``: only by a link that
        `recruitment.links` signed for a recruiter; ``person``: only by a link signed for the id.
    hold_minutes
        Time without an answer or page after which the place of an unfinished session is given to
        somebody else.
    prolific_code
        Prolific's completion code, also part of the completion URL.
    sona_address
        SONA's completion URL with ``experiment_id`` and ``credit_token``; the survey code is
        appended.
    mturk_code
        ``session``: each session gets its own code. Any other value is the code of all sessions.
    link_code, link_address
        Completion code and URL for participants who came by a plain link.
    """

    id_needed: bool = False
    prolific_id: str = "[0-9a-fA-F]{24}"
    sona_id: str = ""
    mturk_id: str = ""
    link_id: str = ""
    allow_list: str = ""
    signed_links: str = "no"
    hold_minutes: int = 15
    prolific_code: str = ""
    sona_address: str = ""
    mturk_code: str = "session"
    link_code: str = ""
    link_address: str = ""


@dataclass(frozen=True)
class EarlyEnd:
    """How participants who end without finishing report back to the recruiter.

    Attributes
    ----------
    prolific_code
        Prolific's code for this case, also part of the completion URL.
    code, address
        Code and URL for participants from elsewhere.
    """

    prolific_code: str = ""
    code: str = ""
    address: str = ""


@dataclass(frozen=True)
class Bonus:
    """Bonus of finished sessions: ``per_correct`` for each right test answer beyond a fraction.

    Attributes
    ----------
    per_correct
        Amount in the lab's currency for each counted answer; 0: no bonus.
    above
        Fraction of the test trials whose right answers do not count, such as 0.5 for guessing.
    most
        Largest bonus; 0: no limit.
    """

    per_correct: float = 0.0
    above: float = 0.5
    most: float = 0.0


@dataclass(frozen=True)
class Limits:
    """Rate limits (token buckets).

    Attributes
    ----------
    requests_per_second, burst
        Sustained rate and burst size of the requests of one session.
    sessions_per_minute, sessions_at_once
        Sustained rate and burst size of new sessions from one IP address, which a whole class may
        share.
    """

    requests_per_second: float = 20.0
    burst: int = 100
    sessions_per_minute: float = 60.0
    sessions_at_once: int = 200


@dataclass(frozen=True)
class Study:
    """Settings of ``study.toml`` with the stimuli and texts of the study.

    Attributes
    ----------
    folder
        The study folder.
    name, version, title, contact
        Identification of the study; ``title`` and ``contact`` are shown to participants.
    scenarios
        Scenarios in which people can take part.
    languages
        Languages of the texts; the first is the default.
    consent_version
        Version of the consent text, stored with each consent.
    participants
        Complete sessions wanted for each scenario; later participants are told that it is full.
    seed
        Seed of all trial orders.
    orders
        0: each participant gets an individual order. Otherwise the number of prepared orders, used
        least often first (the official study had 125).
    exclusions
        Rule set by which sessions are flagged, a name in
        `physion.analysis.people.exclusions.RULE_SETS`.
    percentile_from
        Number of other finished participants needed before a percentile is shown.
    preload
        Number of trials loaded ahead of the current one.
    embed_from
        Sites that may show the pages in a frame (MTurk); none by default.
    timing, screen, plausibility, recruitment, limits
        The tables of ``study.toml``.
    declined, stopped, device_refused, full
        Codes and URLs of participants who gave no consent, who stopped, whose device cannot show
        the movies, and who came when the study was full.
    bonus
        The rule of the bonus in the table of payments.
    allowed_ids
        Ids of the allow list; None if the study has none.
    stimuli
        Rows of ``stimuli.csv`` of the study's scenarios.
    texts
        Texts by language and key.
    consent_files
        SHA-256 of the consent forms that are files, by language.
    digest
        SHA-256 of study.toml, texts, consent forms and stimuli.csv.
    stimuli_digest
        SHA-256 of stimuli.csv.
    """

    folder: Path
    name: str
    version: str
    title: str
    contact: str
    scenarios: tuple[str, ...]
    languages: tuple[str, ...] = ("en", "de")
    consent_version: str = "1"
    participants: int = 100
    seed: int = 0
    orders: int = 0
    exclusions: str = "preregistered"
    percentile_from: int = 10
    preload: int = 8
    embed_from: tuple[str, ...] = ()
    timing: Timing = Timing()
    screen: Screen = Screen()
    plausibility: Plausibility = Plausibility()
    recruitment: Recruitment = Recruitment()
    declined: EarlyEnd = EarlyEnd()
    stopped: EarlyEnd = EarlyEnd()
    device_refused: EarlyEnd = EarlyEnd()
    full: EarlyEnd = EarlyEnd()
    bonus: Bonus = Bonus()
    limits: Limits = Limits()
    stimuli: tuple[Stimulus, ...] = ()
    allowed_ids: frozenset[str] | None = field(default=None, repr=False)
    texts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    consent_files: Mapping[str, str] = field(default_factory=dict)
    digest: str = ""
    stimuli_digest: str = ""

    def phase(self, scenario: str, phase: str) -> tuple[Stimulus, ...]:
        """Return the stimuli of one phase of a scenario, sorted by place."""
        chosen = [s for s in self.stimuli if (s.scenario, s.phase) == (scenario, phase)]
        return tuple(sorted(chosen, key=lambda stimulus: stimulus.place))


EARLY_ENDS = ("declined", "stopped", "device_refused", "full")
"""The tables of ``study.toml`` that are an `EarlyEnd`."""
_PARTS: dict[str, type[Any]] = {
    "timing": Timing,
    "screen": Screen,
    "plausibility": Plausibility,
    "recruitment": Recruitment,
    **dict.fromkeys(EARLY_ENDS, EarlyEnd),
    "bonus": Bonus,
    "limits": Limits,
}


def load_study(folder: Path | str) -> Study:
    """Load and check the study in a folder: ``study.toml``, texts and stimuli.

    Raises
    ------
    BadInputError
        A value is not allowed, a key is unknown, a text is missing in some language, or a media
        file is missing or a link. The message names the file, the key and the allowed values.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInputError(
            f"there is no study folder {folder}; create one with physion experiment init"
        )
    path = folder / STUDY_FILE
    if not os.path.lexists(path):
        raise BadInputError(
            f"{path} is missing: this is no study folder; create one with physion experiment init"
        )
    content = read_plain(path, MAX_BYTES)
    study = replace(parse_settings(parse_toml(path, content), path), folder=folder)
    texts, files, written = {}, {}, []
    for language in study.languages:
        texts[language], text_file = read_texts(folder / TEXTS_FOLDER, language, study.scenarios)
        written.append(text_file)
        consent = read_consent_file(folder / TEXTS_FOLDER, language)
        if consent is not None:
            files[language] = hashlib.sha256(consent).hexdigest()
            written.append(consent)
    allow_list = study.recruitment.allow_list
    listed = folder / STIMULI_FILE
    rows = read_plain(listed, MAX_STIMULI_BYTES)
    stimuli = tuple(s for s in parse_stimuli(listed, rows) if s.scenario in study.scenarios)
    _check_stimuli(study, stimuli, listed)
    return replace(
        study,
        stimuli=stimuli,
        allowed_ids=read_ids(folder / allow_list) if allow_list else None,
        texts=texts,
        consent_files=files,
        digest=_digest(content, *written, rows),
        stimuli_digest=_digest(rows),
    )


def parse_settings(table: Mapping[str, Any], path: Path) -> Study:
    """Check the parsed content of a ``study.toml`` and return its settings as a study.

    Stimuli and texts are left empty. ``path`` is the path of the file, which need not exist yet.
    Raises the errors of `load_study`.
    """
    values = check_tables(table, path)
    parts = {name: part(**values[name]) for name, part in _PARTS.items()}
    return Study(folder=path.parent, **values[""], **parts)


def format_settings(study: Study) -> str:
    """Return the content of ``study.toml``: all keys with comments, as `parse_settings` reads it.

    Raises `BadInputError`, naming the key, if a value is not allowed in the file.
    """
    values = {name: vars(getattr(study, name)) for name in _PARTS}
    return format_tables({"": vars(study), **values}, study.folder / STUDY_FILE)


def write_settings(study: Study) -> Path:
    """Write ``study.toml`` into the study's folder atomically; return its path."""
    path = study.folder / STUDY_FILE
    write_atomic(path, format_settings(study).encode())
    return path


def _check_stimuli(study: Study, stimuli: tuple[Stimulus, ...], path: Path) -> None:
    """Check that each scenario has stimuli in both phases, and that all media files exist."""
    present = {(s.scenario, s.phase) for s in stimuli}
    for scenario in study.scenarios:
        for phase in PHASES:
            if (scenario, phase) not in present:
                raise BadInputError(
                    f"{path} has no stimulus of {scenario} for {phase}; add some, or remove "
                    f"{scenario} from scenarios in {STUDY_FILE}"
                )
    for stimulus in stimuli:
        for name in filter(None, (stimulus.movie, stimulus.map, stimulus.full)):
            check_plain(study.folder / name)


def _digest(*parts: bytes) -> str:
    """Return the SHA-256 of a list of byte strings, each preceded by its length."""
    hashed = hashlib.sha256()
    for part in parts:
        hashed.update(len(part).to_bytes(8, "big") + part)
    return hashed.hexdigest()
