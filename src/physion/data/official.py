"""Reading of the official data: scenes with recorded outcomes, answers of people, and results.

A folder of official data has these files. `physion.data.make` writes it; one is in the package.

- ``scenes.jsonl.gz``: one JSON object a line: ``scene``, ``outcome`` and ``notes`` of a trial.
- ``labels.csv``: the label of every stimulus of the study's lists.
- ``humans/``: fraction of correct answers and number of people for every stimulus.
- ``results/``: published tables of models and people.
- ``model_bounds.json``: bounds of the models of the simulator's library.
- ``SOURCE.md``, ``LICENSE.official.txt``.

Next to each is its digest file (`physion.core.files`).
"""

from __future__ import annotations

import dataclasses
import gzip
import io
import json
import zlib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.resources import files
from pathlib import Path

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import check_digest, read_plain
from physion.core.names import SCENARIOS, canonical_name
from physion.core.settings import parse_json, read_settings
from physion.scenes.scene import Scene
from physion.scenes.tdw.read_logs import ImportedTrial, RecordedOutcome, TrialSet, read_scenes

PACKAGED = "official"
"""What the command line takes in place of a folder for the data of the package."""
SCENES, LABELS, HUMANS, RESULTS = "scenes.jsonl.gz", "labels.csv", "humans", "results"
_MAX_BYTES = 2**28
"""Largest size of the scenes, uncompressed; all configurations of the study take a tenth of it."""


@dataclass(frozen=True)
class OfficialData:
    """Official data in a folder; files are read, and compared with their digests, on first use."""

    folder: Path

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
        """Return the trials as `physion.scenes.tdw.read_logs.read_scenes` does for logs."""
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
        from physion.core.tables import check_table, must, parse_csv

        columns = (must("stimulus", "text", "Canonical name"), must("contact", "flag", "Outcome"))
        where = str(self.folder / LABELS)
        rows = check_table(parse_csv(self.read(LABELS), where), columns, where)
        return dict(zip(rows["stimulus"], rows["contact"].tolist(), strict=True))

    @property
    def humans(self) -> Path:
        """Folder with the answers of people."""
        return self._checked_folder(HUMANS)

    @property
    def results(self) -> Path:
        """Folder with the published tables."""
        return self._checked_folder(RESULTS)

    def read(self, name: str) -> bytes:
        """Return the content of a file; raise `BadInputError` if it is missing or was changed."""
        path = self.folder / name
        content = read_plain(path, _MAX_BYTES, follow_links=True)
        check_digest(path, content, "install the package again, or make the folder again")
        return content

    def _checked_folder(self, name: str) -> Path:
        members = sorted((self.folder / name).glob("*.csv"))
        if not members:
            raise BadInputError(f"{self.folder} has no {name}/")
        for member in members:
            self.read(f"{name}/{member.name}")
        return self.folder / name


def official(folder: Path | str | None = None) -> OfficialData:
    """Return the official data of the package, or of a folder that `physion import` made.

    Parameters
    ----------
    folder
        By default the folder of the package. ``official`` means the package, too, unless a folder
        has this name; a dataset of this name does not count.

    Returns
    -------
    data
        Scenes with recorded outcomes (``trials``), labels, and folders of people and results.

    Raises
    ------
    BadInputError
        If the folder holds no official data.
    """
    data = _packaged() if folder is None else find_official(folder)
    if data is None:
        raise BadInputError(
            f"{folder} holds no official data (there is no {SCENES}); make it from a checkout of "
            "the original study with: physion import CHECKOUT FOLDER"
        )
    return data


def find_official(folder: Path | str) -> OfficialData | None:
    """Return the official data of a folder or, for ``official``, of the package; else None.

    A dataset of the name ``official`` holds trials, and no data of the study.
    """
    path = Path(folder)
    if (path / SCENES).is_file():
        return _opened(path)
    # A dataset has this file (physion.trials.files, which is above this package).
    dataset = (path / "dataset.json").is_file()
    if path == Path(PACKAGED) and (dataset or not path.exists()):
        return _packaged()
    return None


def _packaged() -> OfficialData:
    """Return the official data of the package."""
    return _opened(Path(str(files("physion.data") / "official_study")))


@lru_cache(maxsize=4)
def _opened(folder: Path) -> OfficialData:
    return OfficialData(folder)


def read_official_trials(
    folder: Path, scenario: str | None = None, limit: int | None = None
) -> TrialSet:
    """Return the trials of official data (see `find_official`), or of a folder of command logs."""
    data = find_official(folder)
    if data is None:
        return read_scenes(folder, scenario, limit)
    if scenario is not None and scenario not in SCENARIOS:
        raise UnknownNameError("scenario", scenario, SCENARIOS)
    return data.trial_set(scenario, limit)


def humans_folder(folder: Path) -> Path:
    """Return the folder with ``human_accuracy-*.csv`` of official data, or ``folder`` itself."""
    data = find_official(folder)
    return folder if data is None else data.humans


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
        Scene.from_values(values["scene"]),
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
