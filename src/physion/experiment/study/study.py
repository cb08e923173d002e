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
import json
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError
from physion.core.files import check_plain, read_ids, read_plain, write_atomic
from physion.core.names import canonical_name
from physion.experiment.study.settings import (
    ABOUT,
    ALL_SCENARIOS,
    COMPREHENSION_ABOUT,
    COMPREHENSION_KEYS,
    CONDITIONS_ABOUT,
    CONDITIONS_KEYS,
    EARLY_ENDS,
    QUESTIONS_KEYS,
    Attention,
    Blocks,
    Bonus,
    Comprehension,
    ComprehensionQuestion,
    Condition,
    EarlyEnd,
    Limits,
    Plausibility,
    Practice,
    Question,
    Recruitment,
    Screen,
    Timing,
    check_list,
    check_tables,
    condition_text_keys,
    format_list,
    format_tables,
    parse_comprehension,
    parse_conditions,
    parse_questions,
    parse_toml,
)
from physion.experiment.study.stimuli import MAX_BYTES as MAX_STIMULI_BYTES
from physion.experiment.study.stimuli import PHASES, STIMULI_FILE, Stimulus, parse_stimuli
from physion.experiment.study.texts import TEXTS_FOLDER, read_consent_file, read_texts

__all__ = [
    "ALL_SCENARIOS",
    "EARLY_ENDS",
    "Attention",
    "Blocks",
    "Bonus",
    "Comprehension",
    "EarlyEnd",
    "Limits",
    "Plausibility",
    "Practice",
    "Recruitment",
    "Screen",
    "Study",
    "Timing",
    "format_settings",
    "load_study",
    "parse_settings",
    "write_settings",
]
STUDY_FILE = "study.toml"
MAX_BYTES = 1_000_000


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
    familiarization_feedback
        Whether familiarization answers get feedback: the outcome and the full movie.
    demographics
        Whether age, gender and education are asked.
    embed_from
        Sites that may show the pages in a frame (MTurk); none by default.
    timing, blocks, comprehension, practice, attention, screen, plausibility, recruitment, limits
        The tables of ``study.toml``.
    declined, stopped, screened_out, device_refused, full
        Codes and URLs of participants who gave no consent, who stopped, who failed the
        comprehension check or the practice, whose device cannot show the movies, and who came when
        the study was full.
    bonus
        The rule of the bonus in the table of payments.
    questions
        The lab's own questions at the end.
    comprehension_questions
        Questions of the comprehension check; none: there is no check.
    conditions
        Between-subject conditions.
    condition
        The condition whose settings these are (`courses.variants.under`); empty: the study's own.
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
        SHA-256 of stimuli.csv; with blocks or instructed checks, also of the settings that choose
        trials from it.
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
    familiarization_feedback: bool = True
    demographics: bool = True
    embed_from: tuple[str, ...] = ()
    timing: Timing = field(default=Timing())
    blocks: Blocks = field(default=Blocks())
    comprehension: Comprehension = field(default=Comprehension())
    practice: Practice = field(default=Practice())
    attention: Attention = field(default=Attention())
    screen: Screen = field(default=Screen())
    plausibility: Plausibility = field(default=Plausibility())
    recruitment: Recruitment = field(default=Recruitment())
    declined: EarlyEnd = field(default=EarlyEnd())
    stopped: EarlyEnd = field(default=EarlyEnd())
    screened_out: EarlyEnd = field(default=EarlyEnd())
    device_refused: EarlyEnd = field(default=EarlyEnd())
    full: EarlyEnd = field(default=EarlyEnd())
    bonus: Bonus = field(default=Bonus())
    limits: Limits = field(default=Limits())
    questions: tuple[Question, ...] = ()
    comprehension_questions: tuple[ComprehensionQuestion, ...] = ()
    conditions: tuple[Condition, ...] = ()
    condition: str = ""
    stimuli: tuple[Stimulus, ...] = ()
    allowed_ids: frozenset[str] | None = field(default=None, repr=False)
    texts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    consent_files: Mapping[str, str] = field(default_factory=dict)
    digest: str = ""
    stimuli_digest: str = ""

    @property
    def offered(self) -> tuple[str, ...]:
        """What a session can be of: one of the scenarios, or `ALL_SCENARIOS`."""
        return (ALL_SCENARIOS,) if self.blocks.all_scenarios else self.scenarios

    def phase(self, scenario: str, phase: str) -> tuple[Stimulus, ...]:
        """Return the stimuli of one phase of a scenario, sorted by place."""
        chosen = [s for s in self.stimuli if (s.scenario, s.phase) == (scenario, phase)]
        return tuple(sorted(chosen, key=lambda stimulus: stimulus.place))


_PARTS: dict[str, type[Any]] = {
    "timing": Timing,
    "blocks": Blocks,
    "comprehension": Comprehension,
    "practice": Practice,
    "attention": Attention,
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
        texts[language], text_file = read_texts(
            folder / TEXTS_FOLDER,
            language,
            study.scenarios,
            own_text_keys(study),
            [condition.name for condition in study.conditions],
        )
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
    _check_blocks(study, stimuli, listed)
    return replace(
        study,
        stimuli=stimuli,
        allowed_ids=read_ids(folder / allow_list) if allow_list else None,
        texts=texts,
        consent_files=files,
        digest=_digest(content, *written, rows),
        stimuli_digest=_digest(rows, *_block_settings(study), *_check_settings(study)),
    )


def parse_settings(table: Mapping[str, Any], path: Path) -> Study:
    """Check the parsed content of a ``study.toml`` and return its settings as a study.

    Stimuli and texts are left empty. ``path`` is the path of the file, which need not exist yet.
    Raises the errors of `load_study`.
    """
    values = check_tables(table, path, ("questions", "comprehension_questions", "conditions"))
    parts = {name: part(**values[name]) for name, part in _PARTS.items()}
    asked = parse_questions(check_list(table, path, "questions", QUESTIONS_KEYS), path)
    entries = check_list(table, path, "comprehension_questions", COMPREHENSION_KEYS)
    checked = parse_comprehension(entries, path)
    listed = check_list(table, path, "conditions", CONDITIONS_KEYS)
    groups = parse_conditions(listed, values[""]["scenarios"], path)
    return Study(
        folder=path.parent,
        **values[""],
        **parts,
        questions=asked,
        comprehension_questions=checked,
        conditions=groups,
    )


def format_settings(study: Study) -> str:
    """Return the content of ``study.toml``: all keys with comments, as `parse_settings` reads it.

    Raises `BadInputError`, naming the key, if a value is not allowed in the file.
    """
    values = {name: vars(getattr(study, name)) for name in _PARTS}
    path = study.folder / STUDY_FILE
    text = format_tables({"": vars(study), **values}, path)
    for name, keys, about in (
        ("comprehension_questions", COMPREHENSION_KEYS, COMPREHENSION_ABOUT),
        ("questions", QUESTIONS_KEYS, ABOUT),
        ("conditions", CONDITIONS_KEYS, CONDITIONS_ABOUT),
    ):
        entries = [vars(entry) for entry in getattr(study, name)]
        text += format_list(name, keys, about, entries, path)
    return text


def own_text_keys(study: Study) -> tuple[str, ...]:
    """Return the keys of the texts that a study needs for its own questions and conditions."""
    asked: tuple[ComprehensionQuestion | Question, ...]
    asked = (*study.comprehension_questions, *study.questions)
    several = study.blocks.all_scenarios
    of_conditions = condition_text_keys(study.conditions, blocks=several)
    return (*(key for question in asked for key in question.text_keys), *of_conditions)


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


def _check_blocks(study: Study, stimuli: tuple[Stimulus, ...], path: Path) -> None:
    """Check that the blocks of a session have the trials that they need, and distinct stimuli."""
    wanted, settings = study.blocks.trials, study.folder / STUDY_FILE
    if not study.blocks.all_scenarios:
        return
    for scenarios in (study.scenarios, *(each.scenarios for each in study.conditions)):
        if scenarios is not None and len(scenarios) < 2:
            raise BadInputError(f"{settings}: blocks.all_scenarios needs at least two scenarios")
    counts = Counter(s.scenario for s in stimuli if s.phase == "test")
    for scenario in study.scenarios:
        if wanted > counts[scenario]:
            raise BadInputError(
                f"{settings}: blocks.trials is {wanted}, but {scenario} has {counts[scenario]} "
                "test stimuli"
            )
    seen: dict[str, str] = {}
    for stimulus in stimuli:
        first = seen.setdefault(canonical_name(stimulus.stimulus), stimulus.scenario)
        if first != stimulus.scenario:
            raise BadInputError(
                f"{path}: {stimulus.stimulus} is a stimulus of {first} and of {stimulus.scenario}; "
                "with blocks.all_scenarios a session has both, so give them different names"
            )


def _block_settings(study: Study) -> tuple[bytes, ...]:
    """Return the settings that choose the trials of blocks, as JSON; nothing without blocks."""
    if not study.blocks.all_scenarios:
        return ()
    own = [[each.name, each.scenarios] for each in study.conditions if each.scenarios]
    chosen = [study.scenarios, vars(study.blocks), *([own] if own else [])]
    return (json.dumps(chosen).encode(),)


def _check_settings(study: Study) -> tuple[bytes, ...]:
    """Return the number of instructed checks, which are trials too, as JSON; nothing without."""
    number = study.attention.instructed
    return (json.dumps({"instructed": number}).encode(),) if number else ()


def _digest(*parts: bytes) -> str:
    """Return the SHA-256 of a list of byte strings, each preceded by its length."""
    hashed = hashlib.sha256()
    for part in parts:
        hashed.update(len(part).to_bytes(8, "big") + part)
    return hashed.hexdigest()


# The settings of a study in one of its conditions.

_OF_TIMING = ("cue_ms", "flash_hz", "break_every")


class StudyKey:
    """Cache key of a study, compared by object identity, since studies are not hashable."""

    __slots__ = ("study",)

    def __init__(self, study: Study) -> None:
        self.study = study

    def __hash__(self) -> int:
        return id(self.study)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StudyKey) and self.study is other.study


def under(study: Study, condition: str | None) -> Study:
    """Return a study with the settings of a condition; the study itself for None.

    A preview may have a condition that the study no longer has: it keeps the study's settings.
    """
    return _under(StudyKey(study), condition) if condition else study


def variants(study: Study) -> tuple[Study, ...]:
    """Return the study under each of its conditions; the study itself if it has none."""
    return tuple(under(study, each.name) for each in study.conditions) or (study,)


# Cached because every request needs the settings of its session, whose object is a cache key too.
@lru_cache(maxsize=1024)
def _under(key: StudyKey, name: str) -> Study:
    study = key.study
    for condition in study.conditions:
        if condition.name == name:
            break
    else:
        return study
    own = {k: getattr(condition, k) for k in _OF_TIMING if getattr(condition, k) is not None}
    feedback = condition.familiarization_feedback
    return replace(
        study,
        condition=name,
        timing=replace(study.timing, **own),
        scenarios=condition.scenarios or study.scenarios,
        familiarization_feedback=study.familiarization_feedback if feedback is None else feedback,
    )
