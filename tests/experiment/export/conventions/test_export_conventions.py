"""The exports follow Psych-DS and BIDS, checked by rules and, if installed, by a validator."""

from __future__ import annotations

import csv
import json
import re
import subprocess
from pathlib import Path

import pandas as pd
import pytest

from physion.experiment.export.answer_tables import read_tables
from physion.experiment.export.conventions.bids import BEH_COLUMNS
from physion.experiment.export.conventions.column_labels import unique_file_labels
from physion.experiment.export.export_study import export_study
from physion.experiment.export.spreadsheet import restore_cell
from physion.experiment.store.database import PARTICIPANTS, SESSIONS, create_database
from physion.experiment.study.identity import Secrets
from support.experiment.experimenter_rows import insert_sessions
from support.experiment.tiny_study import make_tiny_study
from support.programs import find_program

NASTY = '=1+1\t"tab"\n-2;@SUM(1) \\ \r n/a'

Exported = tuple[Path, pd.DataFrame, pd.DataFrame]


def make_export(folder: Path, scenarios: tuple[str, ...]) -> Exported:
    """An export with one participant in all scenarios, and one who is old and writes strangely."""
    study = make_tiny_study(folder, scenarios=scenarios, size=64)
    engine = create_database(folder)
    secrets = Secrets.load(folder)
    insert_sessions(engine, study, secrets, 12)
    insert_sessions(engine, study, secrets, 4, kind="simulated", seed=1, ends=("finished",))
    insert_sessions(engine, study, secrets, 1, seed=2, ends=("finished",), age=99,
                    gender="n/a", education="=other", feedback=NASTY)  # fmt: skip
    whole = insert_sessions(engine, study, secrets, len(scenarios), seed=3, ends=("finished",))
    with engine.begin() as connection:
        one = connection.execute(
            SESSIONS.select().where(SESSIONS.c.session == whole[0])
        ).mappings().one()["participant"]  # fmt: skip
        connection.execute(
            SESSIONS.update().where(SESSIONS.c.session.in_(whole)).values(participant=one)
        )
        assert connection.scalar(PARTICIPANTS.select().where(PARTICIPANTS.c.participant == one))
    export_study(engine, study, folder / "out")
    return (folder / "out", *read_tables(engine, study))


@pytest.fixture(scope="module", params=[("collide",), ("a-b", "a.b", "drop")], ids=["one", "three"])
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return make_export(tmp_path_factory.mktemp("study"), request.param)


def test_psych_ds_has_the_files_and_metadata_that_it_asks_for(exported: Exported) -> None:
    folder = exported[0] / "psych-ds"
    metadata = json.loads((folder / "dataset_description.json").read_bytes())
    assert metadata["@type"] == "Dataset" and "schema.org" in metadata["@context"]
    assert all(metadata[key] for key in ("name", "description", "variableMeasured"))
    assert all(entry["@type"] == "PropertyValue" for entry in metadata["variableMeasured"])
    names = [entry["name"] for entry in metadata["variableMeasured"]]
    assert len(set(names)) == len(names)
    assert "Keyed hash" in metadata["variableMeasured"][0]["description"]
    files = list((folder / "data").iterdir())
    assert len(files) == 3
    for path in files:
        assert re.fullmatch(r"([a-z]+-[a-zA-Z0-9]+)(_[a-z]+-[a-zA-Z0-9]+)*_data\.csv", path.name)
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file, strict=True)
        assert rows and all(len(row) == len(header) for row in rows)
        assert set(header) <= set(names)
    # Only what schema.org knows of a PropertyValue, or validators complain.
    known = {"@type", "name", "description", "unitText", "minValue", "maxValue", "valueReference"}
    assert all(set(entry) <= known for entry in metadata["variableMeasured"])
    begin, _, end = metadata["temporalCoverage"].partition("/")
    assert pd.Timestamp(begin) < pd.Timestamp(end)
    assert (folder / "README.md").read_text().startswith("# A tiny study")


def test_bids_holds_every_answer_in_its_own_file(exported: Exported) -> None:
    out, trials, sessions = exported
    folder, several = out / "bids", sessions["scenario"].nunique() > 1
    labels = unique_file_labels(sorted(sessions["scenario"].unique()))
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*_beh.tsv")}
    for _, session in sessions.iterrows():
        subject, label = f"sub-{session['participant']}", labels[session["scenario"]]
        inside, name = ("", "") if not several else (f"/ses-{label}", f"_ses-{label}")
        path = f"{subject}{inside}/beh/{subject}{name}_task-{label}_beh.tsv"
        rows = trials[trials["session"] == session["session"]]
        assert (path in files) == bool(len(rows))
        if not len(rows):
            continue
        files.remove(path)
        found = pd.read_csv(folder / path, sep="\t", keep_default_na=False, dtype=str, quoting=3)
        assert list(found.columns) == [column.name for column in BEH_COLUMNS]
        for column in ("stimulus", "response", "buttons", "answered_at"):
            assert found[column].tolist() == rows[column].tolist()
        assert found["trial_type"].tolist() == rows["phase"].tolist()
        times = found["response_time"].astype(float) * 1000
        assert times.tolist() == pytest.approx(rows["rt_ms"].tolist(), rel=1e-14)
        assert (
            found["correct"] == rows["correct"].map({True: "true", False: "false"}).values
        ).all()
    assert not files


def test_bids_describes_every_column(exported: Exported) -> None:
    folder = exported[0] / "bids"
    sidecars = list(folder.glob("task-*_beh.json"))
    assert len(sidecars) == exported[1]["scenario"].nunique()
    for path in sidecars:
        found = json.loads(path.read_bytes())
        assert path.name == f"task-{found['TaskName']}_beh.json"
        assert all(found[column.name]["Description"] for column in BEH_COLUMNS)
        assert found["response_time"]["Units"] == "s" and found["cue_ms"]["Units"] == "ms"
        assert set(found["response"]["Levels"]) == {"yes", "no"}
    for table in (folder / "participants.tsv", *folder.glob("sub-*/*_sessions.tsv")):
        described = "participants" if table.name.startswith("participants") else "sessions"
        header = table.read_text().partition("\n")[0].split("\t")
        assert set(header) == set(json.loads((folder / f"{described}.json").read_bytes()))


def test_bids_lists_each_participant_once_with_texts_that_come_back(exported: Exported) -> None:
    out, trials, sessions = exported
    lines = (out / "bids" / "participants.tsv").read_text(encoding="utf-8").split("\n")
    assert lines.pop() == ""
    header, *rows = [line.split("\t") for line in lines]
    assert all(len(row) == len(header) for row in rows)
    people = [row[0].removeprefix("sub-") for row in rows]
    assert sorted(people) == sorted(trials["participant"].unique())
    assert {path.name for path in (out / "bids").glob("sub-*")} == {row[0] for row in rows}
    strange = next(row for row in rows if "99" in row)
    found = dict(zip(header, strange, strict=True))
    assert read_text(found["gender"]) == "n/a" and read_text(found["education"]) == "=other"
    assert found["education"] == "'=other"
    if "feedback" not in found:
        name = strange[0]
        table = (out / "bids" / name / f"{name}_sessions.tsv").read_text(encoding="utf-8")
        found = dict(zip(*[line.split("\t") for line in table.splitlines()], strict=True))
    assert read_text(found["feedback"]) == NASTY
    unfinished = set(sessions.loc[sessions["finished_at"] == "", "participant"]) & set(people)
    assert unfinished
    for row in rows:
        if row[0].removeprefix("sub-") in unfinished:
            assert row[header.index("age")] == "n/a"


def read_text(cell: str) -> str:
    """Return the text of a cell, read as the README describes."""
    return str(json.loads(f'"{restore_cell(cell)}"'))


def test_labels_are_never_alike() -> None:
    assert unique_file_labels(["a-b", "a.b", "AB", "--", "drop"]) == {
        "a-b": "ab", "a.b": "ab2", "AB": "AB3", "--": "x", "drop": "drop",
    }  # fmt: skip


def test_the_bids_validator_finds_no_error(exported: Exported) -> None:
    names, what = ("bids-validator-deno", "bids-validator"), "the BIDS validator"
    validator = find_program(*names, variable="BIDS_VALIDATOR", what=what)
    done = subprocess.run(
        [validator, str(exported[0] / "bids"), "--json"],
        stdin=subprocess.DEVNULL, capture_output=True, timeout=120, check=False,
    )  # fmt: skip
    issues = json.loads(done.stdout)["issues"]["issues"]
    errors = [issue for issue in issues if issue["severity"] == "error"]
    assert done.returncode == 0 and not errors, errors
    recommended = {"TOO_FEW_AUTHORS", "NO_AUTHORS", "JSON_KEY_RECOMMENDED",
                   "SIDECAR_KEY_RECOMMENDED"}  # fmt: skip
    assert {issue["code"] for issue in issues} <= recommended
