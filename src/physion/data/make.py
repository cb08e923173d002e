"""Making of a folder of official data from a checkout of the original study's files.

Files are found by their names, wherever they lie in the checkout, so that the public repository,
the archive of command logs next to it, and folders arranged by hand are all read.
"""

from __future__ import annotations

import gzip
import io
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError
from physion.core.files import folder_for_writing, write_with_digest
from physion.core.names import canonical_name
from physion.core.settings import parse_json
from physion.data.official import (
    HUMANS,
    LABELS,
    RESULTS,
    SCENES,
    label_rows,
    official,
    trial_line,
)
from physion.scenes.tdw.read_logs import ImportedTrial, read_scenes

RESULT_FILES = (
    "human_accuracy_by_scenario.csv",
    "human_pairwiseCohensKs_by_scenario.csv",
    "human_pairwiseCorrs_by_scenario.csv",
    "model_human_CohensK.csv",
    "model_human_accuracies.csv",
)
"""Published tables that `physion compare --published` reads."""
_LISTS = "*experimental_stims.json"
_PEOPLE = "human_accuracy-*_testing.csv"
_BOUNDS = "model_bounds.json"
_LICENSES = ("LICENSE.official.txt", "LICENSE", "LICENSE.md", "LICENSE.txt")
_LICENSE = "LICENSE.official.txt"
_SOURCE = """# Source
Facts of the study *Physion: Evaluating Physical Prediction from Vision in Humans and Machines*
(Bear, Wang, Mrowca, Binder, Tung, Pramod, Holdaway, Tao, Smith, Sun, Li, Fei-Fei, Kanwisher,
Tenenbaum, Yamins, Fan; 2021), converted by `physion import`.

- `scenes.jsonl.gz`: scenes of the command logs of the stimuli, with the outcome, first frame of
  contact, length and final position that the original simulator recorded.
- `labels.csv`: labels of the lists of stimuli. `humans/`: fraction of correct answers and number
  of people for every stimulus. `results/`: released tables of results. All under the MIT licence
  of the study (`LICENSE.official.txt`).
- `model_bounds.json`: bounds of library models, from the records of the ThreeDWorld simulator
  (BSD 2-clause licence, Copyright Massachusetts Institute of Technology).
"""


@dataclass(frozen=True)
class MadeData:
    """Folder that was made, and what is worth knowing about it."""

    folder: Path
    trials: int
    stimuli: int
    answered: int
    notes: tuple[str, ...]


def is_checkout(folder: Path) -> bool:
    """Return whether a folder holds answers of people as a checkout of the original study does."""
    return next(folder.rglob(_PEOPLE), None) is not None


def make_official(checkout: Path, folder: Path) -> MadeData:
    """Write the official data found in ``checkout`` to ``folder``.

    Raises `BadInputError` if ``checkout`` holds no command logs or no answers of people, if a
    configuration or a stimulus occurs twice with other content, or if a file is damaged.
    """
    if not checkout.is_dir():
        raise BadInputError(f"{checkout} is not a folder; give a checkout of the original study")
    found = _find(checkout)
    people = {path.name: path for path in _distinct(found(_PEOPLE), checkout)}
    if not people:
        raise BadInputError(
            f"{checkout} holds no {_PEOPLE}: it is not a checkout of the original study; "
            "only command logs are read with: physion run --scenes DIR"
        )
    trials, notes = _trials(checkout)
    labels = _labels(_distinct(found(_LISTS), checkout))
    answered = {canonical_name(name) for path in people.values() for name in _stimuli(path)}
    known = {canonical_name(trial.scene.name) for trial in trials}
    if without := sorted(answered - known):
        notes += (f"{len(without)} stimuli with answers have no scene there, such as {without[0]}",)
    contents: dict[str, bytes] = {
        SCENES: _compress("".join(f"{trial_line(trial)}\n" for trial in trials)),
        LABELS: label_rows(labels),
        "SOURCE.md": _SOURCE.encode(),
        **{f"{HUMANS}/{name}": path.read_bytes() for name, path in sorted(people.items())},
    }
    for name in RESULT_FILES:
        for path in _distinct(found(name), checkout)[:1]:
            contents[f"{RESULTS}/{name}"] = path.read_bytes()
    bounds = _distinct(found(_BOUNDS), checkout)
    contents[_BOUNDS] = bounds[0].read_bytes() if bounds else official().read(_BOUNDS)
    licenses = [path for name in _LICENSES for path in (checkout / name,) if path.is_file()]
    contents[_LICENSE] = licenses[0].read_bytes() if licenses else official().read(_LICENSE)
    _write(folder, contents)
    return MadeData(folder, len(trials), len(labels), len(answered), notes)


def _find(checkout: Path) -> Callable[[str], list[Path]]:
    """Return a function that finds files by a pattern of their names; links are not followed."""
    files = [
        Path(parent) / name
        for parent, _, names in os.walk(checkout, followlinks=False)
        for name in names
    ]
    return lambda pattern: sorted(
        path for path in files if path.match(pattern) and not path.is_symlink()
    )


def _distinct(paths: Sequence[Path], checkout: Path) -> list[Path]:
    """Return one path for each name; raise `BadInputError` for two files of other content."""
    kept: dict[str, Path] = {}
    for path in paths:
        first = kept.setdefault(path.name, path)
        if first.read_bytes() != path.read_bytes():
            raise BadInputError(
                f"{path.relative_to(checkout)} and {first.relative_to(checkout)} have one name and "
                "other content; keep one of them"
            )
    return list(kept.values())


def _trials(checkout: Path) -> tuple[list[ImportedTrial], tuple[str, ...]]:
    """Return all recorded trials sorted by scenario and name, and notes on what was left out."""
    logs = read_scenes(checkout)
    logs.require_trials()
    kept: dict[str, ImportedTrial] = {}
    twice: list[str] = []
    for trial in logs.trials:
        first = kept.setdefault(trial.scene.name, trial)
        if first is not trial:
            twice.append(trial.scene.name)
        if trial_line(first) != trial_line(trial):
            raise BadInputError(
                f"trial {trial.scene.name!r} is given twice: the logs of its configuration are in "
                "two folders, with other content or under other names; keep one of them"
            )
    notes = tuple(f"left out: {failure}" for failure in logs.failures)
    if twice:
        notes += (
            f"{len(twice)} trials are there twice with the same content, such as {twice[0]}; each "
            "was taken once",
        )
    ordered = sorted(kept.values(), key=lambda trial: (trial.scene.scenario, trial.scene.name))
    return ordered, notes


def _labels(paths: Sequence[Path]) -> dict[str, bool]:
    labels: dict[str, bool] = {}
    for path in paths:
        content: Any = parse_json(path.read_text(encoding="utf-8"), str(path))
        try:
            names, values = content["stim_ID"], content["target_hit_zone_label"]
            pairs = {canonical_name(names[key]): bool(values[key]) for key in names}
        except (KeyError, TypeError, AttributeError) as error:
            raise BadInputError(
                f"{path} is not a stimulus list: it needs stim_ID and target_hit_zone_label"
            ) from error
        for name, contact in pairs.items():
            if labels.setdefault(name, contact) != contact:
                raise BadInputError(f"{path}: stimulus {name!r} has another label in another list")
    return labels


def _stimuli(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    if not lines or lines[0].split(",")[0] != "stim_ID":
        raise BadInputError(f"{path} has no column stim_ID")
    return [line.split(",")[0] for line in lines[1:] if line]


def _compress(text: str) -> bytes:
    buffer = io.BytesIO()
    # Without name and time, so that equal scenes give equal bytes.
    with gzip.GzipFile(filename="", fileobj=buffer, mode="wb", compresslevel=9, mtime=0) as stream:
        stream.write(text.encode())
    return buffer.getvalue()


def _write(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write the files with their digests; the scenes, by which the folder is known, come last."""
    with folder_for_writing(folder):
        for name in sorted(contents, key=lambda name: name == SCENES):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_with_digest(path, contents[name])
