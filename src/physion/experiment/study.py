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
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from physion.atomic import write_atomic
from physion.errors import BadInputError, UnknownNameError
from physion.experiment.plain_files import check_plain, read_plain
from physion.experiment.stimuli import MAX_BYTES as MAX_STIMULI_BYTES
from physion.experiment.stimuli import PHASES, STIMULI_FILE, Stimulus, parse_stimuli
from physion.experiment.study_checks import KEYS, TABLES, Key
from physion.experiment.texts import TEXTS_FOLDER, read_texts

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
    """Requests that are let through: by session a second, by address new sessions a minute."""

    requests_per_second: float = 20.0
    burst: int = 100
    sessions_per_minute: float = 60.0


@dataclass(frozen=True)
class Study:
    """``study.toml`` with the stimuli and texts that belong to it.

    ``participants``: complete sessions wanted for each scenario; who comes later is told that the
    study is full. ``orders``: 0 gives each participant an order of their own; else so many prepared
    orders, least used first (the official study had 125). ``exclusions``: the rules by which
    sessions are flagged, a name of `physion.analysis.exclusions.RULE_SETS`. ``percentile_from``:
    finished people that it takes before anyone is told a percentile. ``embed_from``: sites that may
    show the pages in a frame (MTurk), none by default.
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
_HEAD = """\
# What this study decides. Texts are in texts/, stimuli in stimuli.csv (which is never served).
# Serve it with: physion experiment serve FOLDER
"""


def load_study(folder: Path | str) -> Study:
    """The study in a folder: ``study.toml``, texts and stimuli, every value checked.

    `BadInputError` names the file, the key and what is allowed; a key that is unknown, a text that
    a language lacks, a stimulus without its files and a link in place of a file are refused.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInputError(f"there is no study folder {folder}; make one: physion experiment init")
    path = folder / STUDY_FILE
    content = read_plain(path, MAX_BYTES)
    study = replace(read_settings(path, content), folder=folder)
    texts, written = {}, []
    for language in study.languages:
        texts[language], bytes_of = read_texts(folder / TEXTS_FOLDER, language)
        written.append(bytes_of)
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


def read_settings(path: Path, content: bytes) -> Study:
    """The settings of a ``study.toml`` alone, without stimuli and texts, in its own folder."""
    try:
        table = tomllib.loads(content.decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadInputError(f"{path} is not TOML: {error}") from error
    return study_of(path, table)


def study_of(path: Path, table: Mapping[str, Any]) -> Study:
    """The settings in the tables of a ``study.toml`` that stands, or will stand, at ``path``."""
    top = {key.name for key in KEYS if not key.table} | set(TABLES)
    _refuse_unknown(path, "", table, top)
    values: dict[str, dict[str, Any]] = {name: {} for name in ("", *TABLES)}
    for name in TABLES:
        part = table.get(name, {})
        if not isinstance(part, Mapping):
            raise BadInputError(f"{path}: {name} must be a table, [{name}], not {part!r}")
        _refuse_unknown(path, name, part, {key.name for key in KEYS if key.table == name})
    for key in KEYS:
        given = table.get(key.table, {}) if key.table else table
        if key.name in given:
            values[key.table][key.name] = _checked(path, key, given[key.name])
        elif key.required:
            raise BadInputError(f"{path} lacks {key.name}: {_one_line(key.about)}")
    parts = {name: part(**values[name]) for name, part in _PARTS.items()}
    return Study(folder=path.parent, **values[""], **parts)


def study_to_toml(study: Study) -> str:
    """``study.toml`` of a study: every key with its comment; `read_settings` gives it back."""
    lines = [_HEAD]
    for name in ("", *TABLES):
        if name:
            lines.append(f"\n# {TABLES[name]}\n[{name}]\n")
        owner = getattr(study, name) if name else study
        for key in (key for key in KEYS if key.table == name):
            value = _checked(study.folder / STUDY_FILE, key, getattr(owner, key.name))
            comment = "".join(f"# {line}\n" for line in key.about.splitlines())
            lines.append(f"{comment}{key.name} = {_toml(value)}\n")
    return "".join(lines)


def write_settings(study: Study) -> Path:
    """Write ``study.toml`` into the study's folder, atomically; the path."""
    path = study.folder / STUDY_FILE
    write_atomic(path, study_to_toml(study).encode())
    return path


def _checked(path: Path, key: Key, value: Any) -> Any:
    name = f"{key.table}.{key.name}" if key.table else key.name
    try:
        return key.check(value)
    except ValueError as error:
        shown = repr(list(value) if isinstance(value, tuple) else value)
        raise BadInputError(f"{path}: {name} must be {error}, not {shown[:200]}") from error


def _refuse_unknown(path: Path, table: str, given: Mapping[str, Any], known: set[str]) -> None:
    for name in given:
        if name not in known:
            where = f"{path}, [{table}]" if table else str(path)
            raise BadInputError(f"{where}: {UnknownNameError('key', name, known)}")


def _check_stimuli(study: Study, stimuli: tuple[Stimulus, ...], path: Path) -> None:
    for scenario in study.scenarios:
        for phase in PHASES:
            if not any((s.scenario, s.phase) == (scenario, phase) for s in stimuli):
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


def _toml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(one) for one in value)}]"
    if isinstance(value, str):
        # A TOML string is escaped as a JSON string is, where nothing is left to surrogates.
        return json.dumps(value, ensure_ascii=False)
    return json.dumps(value)


def _one_line(words: str) -> str:
    return " ".join(words.split())
