"""A study: its settings, stimuli and texts, loaded from a folder of files that a lab can edit.

::

    STUDY/
      study.toml            settings (`settings`)
      texts/en.toml, ...    texts of all pages, one file per language
      stimuli.csv           stimuli and their outcomes; never served
      media/                movies and maps, named by the hash of their content
      secret.json           keys and the experimenter's password hash (mode 600)
      responses.sqlite      the data
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

from physion.core.errors import BadInputError
from physion.core.files import check_plain, digest_of, read_ids, read_plain, write_atomic
from physion.experiment.study.settings import (
    StudySettings,
    condition_text_keys,
    format_settings,
    parse_settings,
)
from physion.experiment.study.stimuli import PHASES, STIMULI_FILE, Stimulus, read_stimuli
from physion.experiment.study.texts import (
    TEXTS_FOLDER,
    parse_bytes,
    read_consent_file,
    read_picture,
    read_texts,
)

STUDY_FILE = "study.toml"
MAX_BYTES = 1_000_000


@dataclass(frozen=True, kw_only=True)
class Study(StudySettings):
    """The settings of ``study.toml`` with the stimuli and texts of the study.

    Attributes
    ----------
    folder
        The study folder.
    condition
        The condition whose settings these are (`under`); empty: the study's own.
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
        SHA-256 of stimuli.csv; with instructed checks, also of their number.
    """

    folder: Path
    condition: str = ""
    stimuli: tuple[Stimulus, ...] = ()
    allowed_ids: frozenset[str] | None = field(default=None, repr=False)
    texts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    consent_files: Mapping[str, str] = field(default_factory=dict)
    digest: str = ""
    stimuli_digest: str = ""

    @property
    def labels(self) -> dict[tuple[str, str], bool]:
        """Outcomes by scenario and name of the stimulus."""
        return {(each.scenario, each.stimulus): each.label for each in self.stimuli}

    def phase(self, scenario: str, phase: str) -> tuple[Stimulus, ...]:
        """Return the stimuli of one phase of a scenario, sorted by place."""
        chosen = [s for s in self.stimuli if (s.scenario, s.phase) == (scenario, phase)]
        return tuple(sorted(chosen, key=lambda stimulus: stimulus.place))


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
            f"{path} is missing: this is not a study folder; create one with physion experiment "
            "init"
        )
    content = read_plain(path, MAX_BYTES)
    settings = parse_settings(parse_bytes(path, content), path)
    study = Study(folder=folder, **vars(settings))
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
            files[language] = digest_of(consent)
            written.append(consent)
    pictures = dict.fromkeys(question.picture for question in study.questions if question.picture)
    written += [read_picture(folder / TEXTS_FOLDER, name) for name in pictures]
    allow_list = study.recruitment.allow_list
    listed = folder / STIMULI_FILE
    check_plain(listed)
    rows = listed.read_bytes()
    stimuli = tuple(s for s in read_stimuli(listed) if s.scenario in study.scenarios)
    _check_stimuli(study, stimuli, listed)
    return replace(
        study,
        stimuli=stimuli,
        allowed_ids=read_ids(folder / allow_list) if allow_list else None,
        texts=texts,
        consent_files=files,
        digest=_digest(content, *written, rows),
        stimuli_digest=_digest(rows, *_check_settings(study)),
    )


def own_text_keys(study: Study) -> tuple[str, ...]:
    """Return the keys of the texts that a study needs for its own questions and conditions."""
    asked = [key for question in study.comprehension_questions for key in question.text_keys]
    asked += [key for question in study.questions for key in question.text_keys]
    return (*asked, *condition_text_keys(study.conditions))


def write_settings(study: Study) -> Path:
    """Write ``study.toml`` into the study's folder atomically; return its path."""
    path = study.folder / STUDY_FILE
    write_atomic(path, format_settings(study, path).encode())
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


# --- conditions ----------------------------------------------------------------------------------

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
