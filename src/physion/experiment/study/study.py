"""A study: a folder with everything that a lab decides about its experiment, readable and editable.

::

    STUDY/
      study.toml            what is decided: this module
      texts/en.toml, ...    words of every page, one file a language
      stimuli.csv           what is shown and how it ends; never served
      media/                movies and maps, named by their content
      secret.json           keys and the experimenter's password hash (mode 600)
      responses.sqlite      the data, where no other database is given
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
from physion.experiment.study.plain_files import check_plain, read_plain
from physion.experiment.study.stimuli import MAX_BYTES as MAX_STIMULI_BYTES
from physion.experiment.study.stimuli import PHASES, STIMULI_FILE, Stimulus, parse_stimuli
from physion.experiment.study.study_file import check_tables, parse_toml, tables_to_toml
from physion.experiment.study.texts import TEXTS_FOLDER, read_texts

STUDY_FILE = "study.toml"
MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class Timing:
    """What is shown for how long. ``flash_hz`` counts whole cycles, one on and one off; the
    official study flashed at 1 Hz. Fixation is drawn for each trial between its two ends.
    """

    fixation_ms: tuple[int, int] = (500, 1500)
    fixation_in_familiarization: bool = True
    cue_ms: int = 2000
    flash_hz: float = 2.0


@dataclass(frozen=True)
class Screen:
    """Smallest window that the pages are made for, in CSS pixels."""

    min_width: int = 1024
    min_height: int = 600


@dataclass(frozen=True)
class Recruitment:
    """Where participants come from, and how they get their credit.

    ``prolific_code``: completion code, also put into the address of Prolific's completion page.
    ``sona_address``: address of the SONA system with ``experiment_id`` and ``credit_token``; the
    survey code is added. ``mturk_code``: "session" gives every session its own code, any other word
    is the code of all. ``link_code``, ``link_address``: for people who came by a plain link.
    ``id_needed``: refuse who comes without an id.
    """

    id_needed: bool = False
    prolific_code: str = ""
    sona_address: str = ""
    mturk_code: str = "session"
    link_code: str = ""
    link_address: str = ""


@dataclass(frozen=True)
class Limits:
    """Requests that are let through: of a session and, for new sessions, of an address; so many at
    once, then so many a second or minute. A class may sit behind one address.
    """

    requests_per_second: float = 20.0
    burst: int = 100
    sessions_per_minute: float = 60.0
    sessions_at_once: int = 200


@dataclass(frozen=True)
class Study:
    """``study.toml`` with the stimuli and texts that belong to it.

    ``participants``: complete sessions wanted for each scenario; who comes later is told that the
    study is full. ``orders``: 0 gives each participant an order of their own; else so many prepared
    orders, least used first (the official study had 125). ``exclusions``: the rules by which
    sessions are flagged, a name of `physion.analysis.people.exclusions.RULE_SETS`.
    ``percentile_from``: other finished people that it takes before anyone is told a percentile.
    ``embed_from``: sites that may show the pages in a frame (MTurk), none by default.
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
    recruitment: Recruitment = Recruitment()
    limits: Limits = Limits()
    stimuli: tuple[Stimulus, ...] = ()
    texts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    digest: str = ""
    """SHA-256 of study.toml, texts and stimuli.csv."""
    stimuli_digest: str = ""

    def phase(self, scenario: str, phase: str) -> tuple[Stimulus, ...]:
        """The stimuli of one phase of a scenario, by place."""
        found = [s for s in self.stimuli if (s.scenario, s.phase) == (scenario, phase)]
        return tuple(sorted(found, key=lambda stimulus: stimulus.place))


_PARTS = {"timing": Timing, "screen": Screen, "recruitment": Recruitment, "limits": Limits}


def load_study(folder: Path | str) -> Study:
    """The study in a folder: ``study.toml``, texts and stimuli, every value checked.

    `BadInputError` names the file, the key and what is allowed; a key that is unknown, a text that
    a language lacks, a stimulus without its files and a link in place of a file are refused.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInputError(f"there is no study folder {folder}; make one: physion experiment init")
    path = folder / STUDY_FILE
    if not os.path.lexists(path):
        raise BadInputError(
            f"{path} is missing: this is no study folder; make one with physion experiment init"
        )
    content = read_plain(path, MAX_BYTES)
    study = replace(study_of(parse_toml(path, content), path), folder=folder)
    texts, written = {}, []
    for language in study.languages:
        texts[language], text_file = read_texts(folder / TEXTS_FOLDER, language)
        written.append(text_file)
    listed = folder / STIMULI_FILE
    rows = read_plain(listed, MAX_STIMULI_BYTES)
    stimuli = tuple(s for s in parse_stimuli(listed, rows) if s.scenario in study.scenarios)
    _check_stimuli(study, stimuli, listed)
    return replace(
        study,
        stimuli=stimuli,
        texts=texts,
        digest=_digest(content, *written, rows),
        stimuli_digest=_digest(rows),
    )


def study_of(table: Mapping[str, Any], path: Path) -> Study:
    """The settings in the tables of a ``study.toml`` that stands, or will stand, at ``path``.

    Stimuli and texts are left empty. Errors as of `load_study`.
    """
    values = check_tables(table, path)
    parts = {name: part(**values[name]) for name, part in _PARTS.items()}
    return Study(folder=path.parent, **values[""], **parts)


def study_to_toml(study: Study) -> str:
    """``study.toml`` of a study: every key with its comment; `study_of` gives it back.

    `BadInputError` names the key of a value that could not be read back.
    """
    values = {name: vars(getattr(study, name)) for name in _PARTS}
    return tables_to_toml({"": vars(study), **values}, study.folder / STUDY_FILE)


def write_settings(study: Study) -> Path:
    """Write ``study.toml`` into the study's folder, atomically; the path."""
    path = study.folder / STUDY_FILE
    write_atomic(path, study_to_toml(study).encode())
    return path


def _check_stimuli(study: Study, stimuli: tuple[Stimulus, ...], path: Path) -> None:
    there = {(s.scenario, s.phase) for s in stimuli}
    for scenario in study.scenarios:
        for phase in PHASES:
            if (scenario, phase) not in there:
                raise BadInputError(
                    f"{path} has no stimulus of {scenario} for {phase}; add some, or take "
                    f"{scenario} out of scenarios in {STUDY_FILE}"
                )
    for stimulus in stimuli:
        for name in filter(None, (stimulus.movie, stimulus.map, stimulus.full)):
            check_plain(study.folder / name)


def _digest(*parts: bytes) -> str:
    """SHA-256 of parts, each with its length before it, so that no two lists are confused."""
    hashed = hashlib.sha256()
    for part in parts:
        hashed.update(len(part).to_bytes(8, "big") + part)
    return hashed.hexdigest()
