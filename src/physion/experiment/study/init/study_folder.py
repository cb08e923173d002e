"""Creation of a study folder from selected stimuli; an interrupted run can be resumed.

During creation the folder contains a journal with one line for each stimulus whose media have been
written. Running the same command again skips these stimuli. The journal is deleted last.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError
from physion.core.files import folder_lock, remove_leftovers, write_atomic
from physion.experiment.study.identity import SECRET_FILE, Secrets, set_password
from physion.experiment.study.init.media import StimulusSource, import_stimulus
from physion.experiment.study.stimuli import (
    MEDIA_FOLDER,
    STIMULI_FILE,
    Stimulus,
    check_distinct_names,
    write_stimuli,
)
from physion.experiment.study.study import (
    STUDY_FILE,
    Study,
    format_settings,
    load_study,
    write_settings,
)
from physion.experiment.study.texts import TEXTS_FOLDER, shipped_file

JOURNAL = "init.journal"
SHOWN = 3
"""Maximum number of missing files named in an error message."""


def make_study(
    study: Study,
    sources: Sequence[StimulusSource],
    password: str,
    *,
    progress: Progress | None = None,
) -> Study:
    """Create the folder of a study, with its stimuli and the texts of this package, and load it.

    Parameters
    ----------
    study
        The settings, with the folder to create. The folder must be missing, empty, or left by an
        interrupted run.
    sources
        The stimuli and their source files.
    password
        Password of the experimenter's pages.
    progress
        Displays progress.

    Raises
    ------
    BadInputError
        Files are missing (the message names several) or something else is invalid. Media written
        so far are kept for the next run.
    """
    check_sources(sources)
    check_distinct_names(((s.scenario, s.stimulus) for s in sources), study.folder / STIMULI_FILE)
    format_settings(study)
    texts = {language: shipped_file(language) for language in study.languages}
    folder = study.folder
    _check_folder(folder)
    (folder / MEDIA_FOLDER).mkdir(parents=True, exist_ok=True)
    with folder_lock(folder):
        journal = _Journal(folder)
        stimuli = journal.take(sources)
        rows = list(tracked(stimuli, "movies", len(sources), progress))
        write_stimuli(folder / STIMULI_FILE, rows)
        (folder / TEXTS_FOLDER).mkdir(exist_ok=True)
        for language, content in texts.items():
            write_atomic(folder / TEXTS_FOLDER / f"{language}.toml", content)
        write_settings(study)
        _set_secrets(folder, password)
        made = load_study(folder)
        _remove_others(folder, made)
        journal.remove()
    return made


def check_sources(sources: Sequence[StimulusSource]) -> None:
    """Check that all source files are regular files; the error names the first missing ones."""
    files = [path for source in sources for path in source.files.values()]
    missing = [path for path in dict.fromkeys(files) if path.is_symlink() or not path.is_file()]
    if missing:
        names = ", ".join(str(path) for path in missing[:SHOWN])
        more = f", and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
        raise BadInputError(
            f"{len(missing)} of {len(set(files))} files are missing, or are links: {names}{more}"
        )


def _check_folder(folder: Path) -> None:
    """Check that the folder is missing, empty, or left by an interrupted run."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise BadInputError(f"{folder} already exists and is a link or not a folder")
    if not folder.exists():
        return
    names = {path.name for path in folder.iterdir()} - {".lock"}
    if JOURNAL in names:
        # Other files may be keys or answers from serving the folder; they must not be lost.
        strange = names - {JOURNAL, MEDIA_FOLDER, TEXTS_FOLDER, STIMULI_FILE, STUDY_FILE,
                           SECRET_FILE}  # fmt: skip
        strange = {name for name in strange if not name.endswith(".part")}
        if strange:
            raise BadInputError(
                f"{folder} was left unfinished but contains {min(strange)}; choose another folder"
            )
    elif STUDY_FILE in names:
        raise BadInputError(
            f"there is a study in {folder} already: physion experiment serve {folder}; "
            "choose another folder for a new one"
        )
    elif names - {MEDIA_FOLDER} or any((folder / MEDIA_FOLDER).glob("*")):
        raise BadInputError(
            f"{folder} is not empty (it contains {min(names)}); choose a new folder"
        )


def _set_secrets(folder: Path, password: str) -> None:
    if (folder / SECRET_FILE).exists():
        set_password(folder, password)
    else:
        Secrets.create(folder, password)


def _remove_others(folder: Path, study: Study) -> None:
    """Delete media of an earlier run with other stimuli, which the study does not use."""
    remove_leftovers(folder)
    used = {name for s in study.stimuli for name in (s.movie, s.map, s.full)}
    for path in (folder / MEDIA_FOLDER).iterdir():
        if f"{MEDIA_FOLDER}/{path.name}" not in used:
            path.unlink()


class _Journal:
    """Record of the stimuli already written: one JSON line each, with a key of its source files."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._path = folder, folder / JOURNAL
        self._known: dict[str, Stimulus] = {}
        if self._path.is_file() and not self._path.is_symlink():
            for line in self._path.read_text(encoding="utf-8", errors="replace").splitlines():
                self._read(line)

    def take(self, sources: Sequence[StimulusSource]) -> Iterator[Stimulus]:
        """Yield the stimulus of each source, writing its media unless they exist."""
        with self._path.open("a", encoding="utf-8") as file:
            # The last line may be incomplete after a crash; start a new one.
            file.write("\n")
            for source in sources:
                key = _key(source)
                stimulus = self._known.get(key)
                if stimulus is None or not self._holds(stimulus):
                    stimulus = import_stimulus(source, self._folder)
                    row = dataclasses.asdict(stimulus)
                    file.write(json.dumps({"key": key, "row": row}) + "\n")
                    file.flush()
                yield stimulus

    def remove(self) -> None:
        """Delete the journal."""
        self._path.unlink()

    def _read(self, line: str) -> None:
        """Parse one line; ignore it if it is damaged."""
        try:
            entry = json.loads(line)
            self._known[entry["key"]] = Stimulus(**entry["row"])
        except (ValueError, TypeError, KeyError):
            return

    def _holds(self, stimulus: Stimulus) -> bool:
        """Return whether all media files of a stimulus exist."""
        files = [self._folder / n for n in (stimulus.movie, stimulus.map, stimulus.full) if n]
        return all(path.is_file() and not path.is_symlink() for path in files)


def _key(source: StimulusSource) -> str:
    """Return a key of all that a stimulus is made from, with size and time of its files."""
    values: dict[str, Any] = dataclasses.asdict(source)
    stats = [path.stat() for path in source.files.values()]
    values["stats"] = [(status.st_size, status.st_mtime_ns) for status in stats]
    return json.dumps(values, default=str, sort_keys=True)
