"""A new study folder, made from what was chosen for it; a killed making goes on where it stopped.

While a folder is being made it has a journal with a line for every stimulus whose media are
written. The same command finds them there. The journal goes last.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from physion.atomic import folder_lock, remove_leftovers, write_atomic
from physion.errors import BadInputError
from physion.experiment.study.identity import SECRET_FILE, Secrets, set_password
from physion.experiment.study.media import Source, take_stimulus
from physion.experiment.study.stimuli import (
    MEDIA_FOLDER,
    STIMULI_FILE,
    Stimulus,
    check_apart,
    write_stimuli,
)
from physion.experiment.study.study import (
    STUDY_FILE,
    Study,
    load_study,
    study_to_toml,
    write_settings,
)
from physion.experiment.study.texts import TEXTS_FOLDER, shipped_file

JOURNAL = "init.journal"
SHOWN = 3
"""Missing files that an error names."""
Track = Callable[[Iterable[Stimulus], str, int], Iterator[Stimulus]]
"""Passes stimuli on and shows how far it is, as `physion.cli.output.track` does."""


def make_study(
    study: Study, sources: Sequence[Source], password: str, *, track: Track | None = None
) -> Study:
    """Make the folder of ``study`` with these stimuli and the shipped texts; the study, loaded.

    The folder is new or empty, or one that was left unfinished. `BadInputError` names all missing
    files at once, and otherwise the first thing that is wrong; what was made till then is kept for
    the next try.
    """
    check_sources(sources)
    check_apart(((s.scenario, s.stimulus) for s in sources), study.folder / STIMULI_FILE)
    study_to_toml(study)
    texts = {language: shipped_file(language) for language in study.languages}
    folder = study.folder
    _check_folder(folder)
    (folder / MEDIA_FOLDER).mkdir(parents=True, exist_ok=True)
    with folder_lock(folder):
        journal = _Journal(folder)
        stimuli = journal.take(sources)
        rows = list(track(stimuli, "movies", len(sources)) if track else stimuli)
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


def check_sources(sources: Sequence[Source]) -> None:
    """`BadInputError` names every file that is missing or is no plain file."""
    files = [path for source in sources for path in source.files.values()]
    missing = [path for path in dict.fromkeys(files) if path.is_symlink() or not path.is_file()]
    if missing:
        names = ", ".join(str(path) for path in missing[:SHOWN])
        more = f", and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
        raise BadInputError(
            f"{len(missing)} of {len(set(files))} files are missing, or are links: {names}{more}"
        )


def _check_folder(folder: Path) -> None:
    """New, empty, or left unfinished by a making that was killed."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise BadInputError(f"{folder} is there already and no folder of its own")
    if not folder.exists():
        return
    found = {path.name for path in folder.iterdir()} - {".lock"}
    if JOURNAL in found:
        # Whoever served it by hand has keys and perhaps answers that must not be lost.
        strange = found - {JOURNAL, MEDIA_FOLDER, TEXTS_FOLDER, STIMULI_FILE, STUDY_FILE,
                           SECRET_FILE}  # fmt: skip
        strange = {name for name in strange if not name.endswith(".part")}
        if strange:
            raise BadInputError(
                f"{folder} was left unfinished but holds {min(strange)} too; choose another folder"
            )
    elif STUDY_FILE in found:
        raise BadInputError(
            f"there is a study in {folder} already: physion experiment serve {folder}; "
            "choose another folder for a new one"
        )
    elif found - {MEDIA_FOLDER} or any((folder / MEDIA_FOLDER).glob("*")):
        raise BadInputError(f"{folder} is not empty (it has {min(found)}); choose a new folder")


def _set_secrets(folder: Path, password: str) -> None:
    if (folder / SECRET_FILE).exists():
        set_password(folder, password)
    else:
        Secrets.create(folder, password)


def _remove_others(folder: Path, study: Study) -> None:
    """Delete media of an earlier try that chose otherwise."""
    remove_leftovers(folder)
    used = {name for s in study.stimuli for name in (s.movie, s.map, s.full)}
    for path in (folder / MEDIA_FOLDER).iterdir():
        if f"{MEDIA_FOLDER}/{path.name}" not in used:
            path.unlink()


class _Journal:
    """What is written already: a JSON line for each stimulus, with all that it was made from."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._path = folder, folder / JOURNAL
        self._known: dict[str, Stimulus] = {}
        if self._path.is_file() and not self._path.is_symlink():
            for line in self._path.read_text(encoding="utf-8", errors="replace").splitlines():
                self._read(line)

    def take(self, sources: Sequence[Source]) -> Iterator[Stimulus]:
        """The stimuli of ``sources``, their media written."""
        with self._path.open("a", encoding="utf-8") as file:
            # A line that a kill cut short must not spoil the next one.
            file.write("\n")
            for source in sources:
                key = _key(source)
                stimulus = self._known.get(key)
                if stimulus is None or not self._holds(stimulus):
                    stimulus = take_stimulus(source, self._folder)
                    row = dataclasses.asdict(stimulus)
                    file.write(json.dumps({"key": key, "row": row}) + "\n")
                    file.flush()
                yield stimulus

    def remove(self) -> None:
        self._path.unlink()

    def _read(self, line: str) -> None:
        try:
            entry = json.loads(line)
            self._known[entry["key"]] = Stimulus(**entry["row"])
        except (ValueError, TypeError, KeyError):
            return

    def _holds(self, stimulus: Stimulus) -> bool:
        files = [self._folder / n for n in (stimulus.movie, stimulus.map, stimulus.full) if n]
        return all(path.is_file() and not path.is_symlink() for path in files)


def _key(source: Source) -> str:
    """All that a stimulus is made from, the state of its files included."""
    values: dict[str, Any] = dataclasses.asdict(source)
    stats = [path.stat() for path in source.files.values()]
    values["stats"] = [(found.st_size, found.st_mtime_ns) for found in stats]
    return json.dumps(values, default=str, sort_keys=True)
