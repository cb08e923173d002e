"""Reading of the official data: scenes with recorded outcomes, answers of people, and results.

A folder of official data has these files. `physion.data.make` writes it; one is in the package.

- ``scenes.jsonl.gz``: one JSON object a line: ``scene``, ``outcome`` and ``notes`` of a trial.
- ``labels.csv``: the label of every stimulus of the study's lists.
- ``humans/``: fraction of correct answers and number of people for every stimulus.
- ``results/``: published tables of models and people.
- ``model_bounds.json``: bounds of the models of the simulator's library.
- ``SOURCE.md``, ``LICENSE.official.txt``, and ``manifest.json`` with version and checksums.
"""

from __future__ import annotations

import csv
import dataclasses
import gzip
import hashlib
import io
import json
import zlib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError
from physion.core.names import canonical_name
from physion.core.settings import parse_json, read_settings
from physion.scenes.scene import Scene
from physion.scenes.tdw.read_logs import ImportedTrial, RecordedOutcome, TrialSet

PACKAGED = "official"
"""What the command line takes in place of a folder for the data of the package."""
VERSION = 1
"""Version of the format; to be raised with every change of the files."""
SCENES, LABELS, HUMANS, RESULTS, MANIFEST = (
    "scenes.jsonl.gz", "labels.csv", "humans", "results", "manifest.json",
)  # fmt: skip
_MAX_BYTES = 2**28
"""Largest size of the scenes, uncompressed; all configurations of the study take a tenth of it."""


@dataclass(frozen=True)
class OfficialData:
    """Official data in a folder; files are read, and their checksums tested, on first use."""

    folder: Path

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """Version, source and checksums. `BadInputError` if the folder is none of this kind."""
        path = self.folder / MANIFEST
        try:
            content = parse_json(path.read_text(encoding="utf-8"), str(path))
        except (OSError, UnicodeDecodeError) as error:
            raise BadInputError(
                f"{self.folder} holds no official data (there is no {MANIFEST}); make it with: "
                "physion import-official CHECKOUT DIR"
            ) from error
        if not isinstance(content, dict) or not isinstance(content.get("sha256"), dict):
            raise BadInputError(f"{path} holds no checksums; make the folder again")
        if content.get("version") != VERSION:
            raise BadInputError(
                f"{path} has version {content.get('version')!r}, this package reads {VERSION}; "
                "make the folder again with: physion import-official CHECKOUT DIR"
            )
        return content

    @cached_property
    def trials(self) -> tuple[ImportedTrial, ...]:
        """All scenes with their recorded outcomes, sorted by scenario and name."""
        where = f"{self.folder / SCENES}"
        text = _decompress(self.read(SCENES), where)
        return tuple(
            _trial(line, f"{where} line {number}")
            for number, line in enumerate(text.splitlines(), start=1)
        )

    def trial_set(self, scenario: str | None = None, limit: int | None = None) -> TrialSet:
        """Return the trials as `physion.scenes.tdw.read_logs.read_scenes` returns those of logs."""
        chosen = [t for t in self.trials if scenario in (None, t.scene.scenario)]
        if limit is not None:
            counts: dict[str, int] = {}
            kept = []
            for trial in chosen:
                counts[trial.scene.scenario] = counts.get(trial.scene.scenario, 0) + 1
                if counts[trial.scene.scenario] <= limit:
                    kept.append(trial)
            chosen = kept
        return TrialSet(trials=list(chosen))

    @cached_property
    def labels(self) -> dict[str, bool]:
        """Official label of every stimulus that people saw, by canonical name."""
        rows = csv.DictReader(io.StringIO(self.read(LABELS).decode()))
        return {row["stimulus"]: row["contact"] == "1" for row in rows}

    @property
    def humans(self) -> Path:
        """Folder with the answers of people, after its checksums were tested."""
        return self._checked_folder(HUMANS)

    @property
    def results(self) -> Path:
        """Folder with the published tables, after its checksums were tested."""
        return self._checked_folder(RESULTS)

    def read(self, name: str) -> bytes:
        """Return the content of a file; raise `BadInputError` if it is missing or was changed."""
        path = self.folder / name
        try:
            content = path.read_bytes()
        except OSError as error:
            raise BadInputError(f"{path} cannot be read: {error.strerror}") from error
        if hashlib.sha256(content).hexdigest() != self.manifest["sha256"].get(name):
            raise BadInputError(
                f"{path} was changed since it was made (its checksum differs); "
                "install the package again, or make the folder again"
            )
        return content

    def _checked_folder(self, name: str) -> Path:
        members = [key for key in self.manifest["sha256"] if key.startswith(f"{name}/")]
        if not members:
            raise BadInputError(f"{self.folder} has no {name}/")
        for member in members:
            self.read(member)
        return self.folder / name


@lru_cache(maxsize=4)
def official(folder: Path | None = None) -> OfficialData:
    """Return the official data of a folder, by default that of the package."""
    if folder is None:
        return OfficialData(Path(str(files("physion.data") / "official_study")))
    return OfficialData(folder)


def trial_line(trial: ImportedTrial) -> str:
    """Return a trial as one line of JSON; `OfficialData.trials` reads it again without loss."""
    values = {
        "scene": json.loads(trial.scene.to_json()),
        "outcome": dataclasses.asdict(trial.outcome),
        "notes": list(trial.notes),
    }
    return json.dumps(values, sort_keys=True, separators=(",", ":"))


def label_rows(labels: dict[str, bool]) -> bytes:
    """Return the content of `LABELS`, sorted by stimulus."""
    lines = [f"{canonical_name(name)},{int(contact)}\n" for name, contact in labels.items()]
    return ("stimulus,contact\n" + "".join(sorted(lines))).encode()


def _trial(line: str, where: str) -> ImportedTrial:
    values = parse_json(line, where)
    if not isinstance(values, dict) or set(values) != {"scene", "outcome", "notes"}:
        raise BadInputError(f"{where} holds no trial")
    return ImportedTrial(
        Scene.from_json(json.dumps(values["scene"])),
        read_settings(RecordedOutcome, values["outcome"], f"{where}: outcome"),
        tuple(str(note) for note in values["notes"]),
    )


def _decompress(content: bytes, where: str) -> str:
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as stream:
            text = stream.read(_MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise BadInputError(f"{where} cannot be decompressed: {error}") from error
    if len(text) > _MAX_BYTES:
        raise BadInputError(f"{where} has more than {_MAX_BYTES} bytes uncompressed")
    return text.decode()
