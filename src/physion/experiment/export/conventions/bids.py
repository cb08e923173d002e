"""Export of a study in BIDS: behaviour without recordings, one file per participant and scenario.

::

    dataset_description.json   README.md   participants.tsv   participants.json
    task-<scenario>_beh.json                          descriptions of the columns of a task's files
    sub-<participant>/beh/sub-<participant>_task-<scenario>_beh.tsv

If a study has several scenarios, each is a BIDS session: folders and names contain
``ses-<scenario>``, and ``sub-<participant>_sessions.tsv`` (with ``sessions.json``) describes the
sessions. If a session has several scenarios, its task is ``allscenarios``, and a column names the
scenario of each trial. Answers to the lab's own questions are in ``phenotype/questions.tsv``,
described in ``phenotype/questions.json``. Empty cells are ``n/a``. See
bids-specification.readthedocs.io, behavioral experiments.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from physion.analysis.people.responses import SESSION_COLUMNS, TRIAL_COLUMNS, Column
from physion.experiment.export.conventions.column_labels import column_levels, unique_file_labels
from physion.experiment.export.spreadsheet import guard_cell
from physion.experiment.export.trial_rows import TrialBatch
from physion.experiment.study.study import ALL_SCENARIOS, Study

VERSION = "1.10.0"
EMPTY = "n/a"
TASK = (
    "A movie of objects is stopped after its first part. Will the object that was shown in red "
    "touch the one that was shown in yellow?"
)
TEXT_RULE = 'Text is written as a JSON string without its quotes (newline \\n, tab \\t, quote \\")'
TRIAL_TYPE = Column(
    "trial_type", "choice", "With feedback (familiarization) or without (test)",
    choices=("familiarization", "test"),
)  # fmt: skip
RESPONSE_TIME = Column(
    "response_time", "number", "From the moment the buttons are enabled to the answer", unit="s"
)
_IN_NAMES = ("participant", "session", "scenario", "simulated", "phase", "rt_ms")
BEH_COLUMNS = (
    TRIAL_TYPE,
    RESPONSE_TIME,
    *(column for column in TRIAL_COLUMNS if column.name not in _IN_NAMES),
)
SCENARIO = next(column for column in TRIAL_COLUMNS if column.name == "scenario")
"""In the files of sessions of several scenarios."""
PERSON_COLUMNS = tuple(
    column
    for column in SESSION_COLUMNS
    if column.name in ("simulated", "age", "gender", "education")
)
_PARTICIPANT = {"Description": "sub- and the keyed hash of the participant's id"}
_SESSION = {"Description": "ses- and the scenario"}


class BidsWriter:
    """Writer of a BIDS dataset: call `write` for each batch of sessions, then `close`.

    ``sessions`` is the table of all sessions, in the order of the batches.
    """

    def __init__(self, folder: Path, study: Study, sessions: pa.Table) -> None:
        folder.mkdir(parents=True)
        self._folder, self._sessions = str(folder), sessions
        self._several = len(study.offered) > 1
        self._labels = unique_file_labels(study.offered)
        self._participants = sessions.column("participant").to_pylist()
        self._scenarios = sessions.column("scenario").to_pylist()
        self._columns = BEH_COLUMNS
        if study.blocks.all_scenarios:
            self._scenarios = [ALL_SCENARIOS] * len(self._participants)
            self._columns = (TRIAL_TYPE, RESPONSE_TIME, SCENARIO, *BEH_COLUMNS[2:])
        self._made: set[str] = set()
        self._answered: list[int] = []

    def write(self, trials: TrialBatch) -> None:
        """Write the files of a batch of sessions; sessions without answers get no file."""
        header = "\t".join(column.name for column in self._columns).encode() + b"\n"
        rows = _tsv(_beh_table(trials.table, self._columns))
        ends = np.flatnonzero(np.frombuffer(rows, np.uint8) == ord("\n")) + 1
        begin, row = 0, 0
        for at, count in zip(trials.sessions, trials.counts, strict=True):
            if not count:
                continue
            row += count
            end = int(ends[row - 1])
            with open(self._path(at), "wb") as file:  # noqa: PTH123 - faster, for 10,000 files
                file.write(header)
                file.write(rows[begin:end])
            begin = end
            self._answered.append(at)

    def write_questions(self, answers: pa.Table, columns: Sequence[Column]) -> None:
        """Write the answers to the lab's own questions of the sessions that have a file.

        ``columns`` begin with participant and session, which get their BIDS names.
        """
        session = self._sessions.column("session").to_pylist()
        labels = {session[at]: f"ses-{self._labels[self._scenarios[at]]}" for at in self._answered}
        own = columns[2:]
        keys = ["participant_id", *(["session_id"] if self._several else [])]
        lines = [_line([*keys, *(column.name for column in own)])]
        for row in answers.to_pylist():
            if row["session"] in labels:
                names = [f"sub-{row['participant']}", labels[row["session"]]][: len(keys)]
                lines.append(_line([*names, *(_cell(row[column.name]) for column in own)]))
        folder = Path(self._folder) / "phenotype"
        folder.mkdir()
        (folder / "questions.tsv").write_bytes("".join(lines).encode())
        tool = {"MeasurementToolMetadata": {"Description": "Questions of the lab at the end"}}
        described = {"participant_id": _PARTICIPANT, "session_id": _SESSION}
        _write_json(
            folder / "questions.json",
            tool | {key: described[key] for key in keys} | describe(own),
        )

    def close(self, *, name: str, readme: str, version: str) -> int:
        """Write the files of the whole dataset; return how many sessions had no answers.

        Parameters
        ----------
        name
            Title of the dataset.
        readme
            Text of README.md.
        version
            Version of this package.
        """
        folder = Path(self._folder)
        answered = self._sessions.take(pa.array(self._answered, pa.int64()))
        _write_json(folder / "dataset_description.json", {
            "Name": name, "BIDSVersion": VERSION, "DatasetType": "raw",
            "GeneratedBy": [{"Name": "physion", "Version": version}],
        })  # fmt: skip
        (folder / "README.md").write_text(readme, encoding="utf-8")
        scenarios = {self._scenarios[at] for at in self._answered}
        for scenario, label in self._labels.items():
            if scenario in scenarios:
                described = describe(self._columns)
                task = {"TaskName": label, "TaskDescription": TASK}
                _write_json(folder / f"task-{label}_beh.json", task | described)
        self._write_people(folder, answered)
        return int(self._sessions.num_rows) - len(self._answered)

    def _path(self, at: int) -> str:
        """Return the path of the answers of session ``at``; create its folders."""
        subject = f"sub-{self._participants[at]}"
        label = self._labels[self._scenarios[at]]
        folders = [subject, *([f"ses-{label}"] if self._several else []), "beh"]
        path = self._folder
        for folder in folders:
            path = f"{path}/{folder}"
            if path not in self._made:
                Path(path).mkdir()
                self._made.add(path)
        return f"{path}/{'_'.join(folders[:-1])}_task-{label}_beh.tsv"

    def _write_people(self, folder: Path, sessions: pa.Table) -> None:
        """Write ``participants.tsv`` and, if there are several scenarios, the session files."""
        rows = sessions.to_pylist()
        people: dict[str, list[dict[str, Any]]] = {}
        for row in rows:
            people.setdefault(row["participant"], []).append(row)
        columns = PERSON_COLUMNS if self._several else SESSION_COLUMNS[1:]
        lines = [_line(["participant_id", *(column.name for column in columns)])]
        for participant, own_rows in people.items():
            # The first known value of a column holds for all sessions of a person.
            values = [
                next((row[column.name] for row in own_rows if row[column.name] is not None), None)
                for column in columns
            ]
            lines.append(_line([f"sub-{participant}", *map(_cell, values)]))
            if self._several:
                self._write_sessions(folder, participant, own_rows)
        (folder / "participants.tsv").write_bytes("".join(lines).encode())
        _write_json(
            folder / "participants.json", {"participant_id": _PARTICIPANT} | describe(columns)
        )
        if self._several:
            described = {"session_id": _SESSION} | describe(SESSION_COLUMNS[1:])
            _write_json(folder / "sessions.json", described)

    def _write_sessions(
        self, folder: Path, participant: str, rows: Sequence[Mapping[str, Any]]
    ) -> None:
        """Write the ``sessions.tsv`` of one participant."""
        names = [column.name for column in SESSION_COLUMNS[1:]]
        lines = [_line(["session_id", *names])]
        for row in rows:
            label = self._labels[row["scenario"]]
            lines.append(_line([f"ses-{label}", *(_cell(row[name]) for name in names)]))
        subject = f"sub-{participant}"
        path = folder / subject / f"{subject}_sessions.tsv"
        path.write_bytes("".join(lines).encode())


def describe(columns: Sequence[Column]) -> dict[str, dict[str, Any]]:
    """Return the columns as BIDS describes them: Description, Units, Levels."""
    entries = {}
    for column in columns:
        about = column.about
        if column.kind == "text" and column.name not in _PLAIN:
            about = f"{about}. {TEXT_RULE}"
        entry: dict[str, Any] = {"Description": about}
        if column.unit:
            entry["Units"] = column.unit
        if column_levels(column):
            entry["Levels"] = {level: level for level in column_levels(column)}
        entries[column.name] = entry
    return entries


_PLAIN = ("participant", "session", "scenario", "stimulus")
"""Text columns whose values never need the rule."""


def _beh_table(trials: pa.Table, wanted: Sequence[Column]) -> pa.Table:
    """Return the answers with BIDS column names, and ``n/a`` in empty cells."""
    columns = []
    for column in wanted:
        if column is TRIAL_TYPE:
            values = trials.column("phase")
        elif column is RESPONSE_TIME:
            values = pc.divide(trials.column("rt_ms"), 1000.0)
        else:
            values = trials.column(column.name)
        if values.null_count:
            values = pc.fill_null(pc.cast(values, pa.string()), EMPTY)
        columns.append(values)
    return pa.table(columns, names=[column.name for column in wanted])


def _tsv(table: pa.Table) -> bytes:
    """Return the rows as TSV without a header.

    Nothing is quoted: the cells have no tabs or quotes (else Arrow raises ArrowInvalid).
    """
    buffer = io.BytesIO()
    options = csv.WriteOptions(include_header=False, delimiter="\t", quoting_style="none")
    csv.write_csv(table, buffer, options)
    return buffer.getvalue()


def _cell(value: Any) -> str:
    """Return a value as a TSV cell that is safe in a spreadsheet."""
    if value is None or value == "":
        return EMPTY
    if isinstance(value, bool):
        return "true" if value else "false"
    if not isinstance(value, str):
        return str(value)
    text = json.dumps(value, ensure_ascii=False)[1:-1]
    # The text "n/a" must differ from an empty cell; JSON allows the slash to be escaped.
    return guard_cell("n\\/a" if text == EMPTY else text)


def _line(cells: Sequence[str]) -> str:
    return "\t".join(cells) + "\n"


def _write_json(path: Path, values: Mapping[str, Any]) -> None:
    text = json.dumps(values, indent=2, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
