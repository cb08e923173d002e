"""The tables of trials and sessions, as stored in the database, and in the form of Psych-DS."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import sqlalchemy as sa
from pandas.testing import assert_frame_equal

from physion.analysis.people.responses import SESSION_COLUMNS, TRIAL_COLUMNS
from physion.core.errors import PhysionError, UnknownNameError
from physion.core.tables import check_table
from physion.experiment.experimenter.progress import StudyProgress
from physion.experiment.export import tables as trial_rows
from physion.experiment.export.export_study import export_study
from physion.experiment.export.tables import (
    GONE_SCENARIO,
    SessionSelection,
    read_sessions,
    read_tables,
    read_trials,
    snapshot,
)
from physion.experiment.store.database import ANSWERS, SESSIONS, create_database
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import Study
from support.experiment.experimenter_rows import insert_sessions
from support.experiment.tiny_study import make_tiny_study

NOW = 1_790_000_000.0


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    folder = tmp_path_factory.mktemp("study")
    return make_tiny_study(folder, scenarios=("collide", "drop"), size=64)


@pytest.fixture
def engine(study: Study, database: Path) -> sa.Engine:
    """Yield a database of people, simulated participants and previews, in every state."""
    engine = create_database(database)
    secrets = Secrets.load(study.folder)
    insert_sessions(engine, study, secrets, 40, now=NOW)
    insert_sessions(engine, study, secrets, 8, kind="simulated", seed=1, now=NOW)
    insert_sessions(engine, study, secrets, 3, kind="preview", seed=2, now=NOW)
    return engine


def test_the_tables_are_as_the_schema_types_them(engine: sa.Engine, study: Study) -> None:
    trials, sessions = read_tables(engine, study)
    assert list(trials.columns) == [column.name for column in TRIAL_COLUMNS]
    assert list(sessions.columns) == [column.name for column in SESSION_COLUMNS]
    assert len(trials) > 400 and len(sessions) > 30
    assert_frame_equal(check_table(trials, TRIAL_COLUMNS, "trials"), trials)
    assert_frame_equal(check_table(sessions, SESSION_COLUMNS, "sessions"), sessions)


def test_every_answer_is_there_once_with_all_that_was_stored(
    engine: sa.Engine, study: Study
) -> None:
    trials, sessions = read_tables(engine, study)
    labels = {(s.scenario, s.stimulus): s.label for s in study.stimuli}
    assert set(trials["look"]) == {"free"}, "the look of all stimuli of this study"
    with engine.connect() as connection:
        query = sa.select(ANSWERS).where(ANSWERS.c.session.in_(list(sessions["session"])))
        stored = {(r.session, r.phase, r.trial): r for r in connection.execute(query)}
    assert len(trials) == len(stored)
    for row in trials.itertuples():
        answer = stored.pop((row.session, row.phase, row.trial))
        for name in ("stimulus", "response", "rt_ms", "input", "fixation_ms", "cue_ms", "movie_ms",
                     "frames_expected", "frames_shown", "frames_dropped", "visibility_changes",
                     "window_width", "window_height", "resumed"):  # fmt: skip
            assert getattr(row, name) == getattr(answer, name), name
        assert row.label == labels[row.scenario, row.stimulus]
        assert row.correct == ((row.response == "yes") == row.label)
        at = pd.Timestamp(row.answered_at).timestamp()
        assert answer.answered_at - 0.001 < at <= answer.answered_at
    assert not stored


def test_each_column_is_of_its_own_answer(engine: sa.Engine, study: Study) -> None:
    """All measurements of all answers differ; each is found in its row and column."""
    keys = ("session", "phase", "trial")
    names = ("rt_ms", "fixation_ms", "cue_ms", "movie_ms", "break_ms", "frames_expected",
             "frames_shown", "frames_dropped", "visibility_changes", "window_width",
             "window_height", "showings")  # fmt: skip
    words = {
        "input": ("mouse", "touch", "keyboard"),
        "void": (None, "hidden", "dialog", "window"),
        "resumed": (False, True, True),
    }
    with engine.begin() as connection:
        columns = [ANSWERS.c[key] for key in keys]
        stored = {}
        for number, key in enumerate(connection.execute(sa.select(*columns)).all()):
            values = {name: 1000 * place + number for place, name in enumerate(names, 1)}
            values |= {name: known[number % len(known)] for name, known in words.items()}
            stored[tuple(key)] = values | {"details": f'{{"number": {number}}}'}
            of_key = [column == value for column, value in zip(columns, key, strict=True)]
            connection.execute(sa.update(ANSWERS).where(*of_key).values(stored[tuple(key)]))
    trials, _ = read_tables(engine, study)
    for row in trials.itertuples():
        values = stored[row.session, row.phase, row.trial]
        for name in (*names, "input", "resumed"):
            assert getattr(row, name) == values[name], name
        assert row.void == (values["void"] or "")
    with snapshot(engine) as connection:
        sessions = read_sessions(connection, study)
        (part,) = read_trials(connection, study, sessions.table)
    assert len(part.details) == len(trials)
    for row, details in zip(trials.itertuples(), part.details.to_pylist(), strict=True):
        assert details == stored[row.session, row.phase, row.trial]["details"]


def test_each_column_of_a_session_is_its_own(engine: sa.Engine, study: Study) -> None:
    """All numbers and times of all sessions differ; each is found in its row and column."""
    direct = [column for column in SESSION_COLUMNS if column.name in SESSIONS.c]
    numeric = [c for c in direct if c.kind in ("integer", "number", "time")]
    assert len(numeric) >= 13
    device = {"user_agent": "a", "refresh_hz": 1, "screen_width": 2, "screen_height": 3,
              "pixel_ratio": 4, "touch": True}  # fmt: skip
    with engine.begin() as connection:
        stored = {}
        for number, name in enumerate(connection.execute(sa.select(SESSIONS.c.session)).scalars()):
            values = {c.name: 1000 * place + number for place, c in enumerate(numeric, 1)}
            values |= {"withdrawn_at": None, "voided_at": None, "screened_out_by": f"by {number}",
                       "failed_checks": f"failed {number}", "source": f"source {number}",
                       "device": {k: v if k == "touch" else f"{v}{number}" if v == "a"
                                  else 10 * v + number for k, v in device.items()}}  # fmt: skip
            stored[name] = values
            connection.execute(sa.update(SESSIONS).where(SESSIONS.c.session == name).values(values))
    _, sessions = read_tables(engine, study)
    assert len(sessions) == 48
    for row in sessions.itertuples():
        values = stored[row.session]
        for column in numeric:
            found = getattr(row, column.name)
            if column.kind == "time":
                found = pd.Timestamp(found).timestamp()
            assert found == values[column.name], column.name
        assert row.screened_out == values["screened_out_by"]
        assert row.failed_checks == values["failed_checks"]
        assert row.recruited_by == values["source"]
        for name in device:
            assert getattr(row, name) == values["device"][name], name


def test_rows_are_in_the_order_of_time(engine: sa.Engine, study: Study) -> None:
    trials, sessions = read_tables(engine, study)
    assert list(sessions["started_at"]) == sorted(sessions["started_at"])
    assert list(trials["session"].unique()) == [
        session for session in sessions["session"] if session in set(trials["session"])
    ]
    for _, rows in trials.groupby("session", sort=False):
        assert list(rows["phase"]) == sorted(rows["phase"])  # f before t
        for _, phase in rows.groupby("phase"):
            assert list(phase["trial"]) == list(range(len(phase)))


def test_kinds_and_scenario_can_be_chosen(engine: sa.Engine, study: Study) -> None:
    with snapshot(engine) as connection:
        people = read_sessions(connection, study, SessionSelection(("person",)))
        assert people.table.num_rows and not any(people.table["simulated"].to_pylist())
        chosen = read_sessions(connection, study, SessionSelection(("simulated",), "drop"))
        assert set(chosen.table["scenario"].to_pylist()) == {"drop"}
        parts = list(read_trials(connection, study, chosen.table))
        for table in (chosen.table, *(part.table for part in parts)):
            assert table.num_rows and all(table["simulated"].to_pylist())
        with pytest.raises(UnknownNameError, match="kind"):
            read_sessions(connection, study, SessionSelection(("preview",)))
        with pytest.raises(UnknownNameError, match="collide"):
            read_sessions(connection, study, SessionSelection(scenario="colide"))


def test_cells_that_are_not_known_are_empty(study: Study, database: Path) -> None:
    engine = create_database(database)
    nothing = dict.fromkeys(("age", "gender", "education", "technical_problems", "feedback"))
    insert_sessions(engine, study, Secrets.load(study.folder), 1, ends=("finished",), now=NOW,
                    **nothing, device={})  # fmt: skip
    absent = ("fixation_ms", "cue_ms", "frames_shown", "frames_dropped", "movie_ms",
              "visibility_changes", "window_width", "window_height", "break_ms")  # fmt: skip
    with engine.connect() as connection, connection.begin():
        connection.execute(sa.update(ANSWERS).values(break_ms=1500.5))
        connection.execute(
            sa.update(ANSWERS).where(ANSWERS.c.trial == 2).values(**dict.fromkeys(absent))
        )
        connection.execute(sa.update(ANSWERS).where(ANSWERS.c.trial == 3).values(cue_ms=0.0))
    trials, sessions = read_tables(engine, study)
    row = sessions.iloc[0]
    assert row["feedback"] == "" and row["gender"] == "" and row["user_agent"] == ""
    assert pd.isna(row["age"]) and pd.isna(row["technical_problems"]) and pd.isna(row["refresh_hz"])
    assert (trials["trial"] == 2).sum() == 2
    assert trials.loc[trials["trial"] == 2, list(absent)].isna().all(axis=None)
    assert (trials.loc[trials["trial"] == 3, "cue_ms"] == 0).all()
    assert trials.loc[trials["trial"] != 2, list(absent)].notna().all(axis=None)
    assert_frame_equal(check_table(trials, TRIAL_COLUMNS, "trials"), trials)
    assert_frame_equal(check_table(sessions, SESSION_COLUMNS, "sessions"), sessions)


def test_sessions_of_a_scenario_that_is_gone_are_left_out_by_name(
    engine: sa.Engine, study: Study
) -> None:
    stimuli = tuple(s for s in study.stimuli if s.scenario == "collide")
    fewer = replace(study, scenarios=("collide",), stimuli=stimuli)
    _, before = read_tables(engine, study)
    trials, sessions = read_tables(engine, fewer)
    assert set(trials["scenario"]) == set(sessions["scenario"]) == {"collide"}
    assert set(sessions["session"]) == set(before["session"][before["scenario"] == "collide"])
    with snapshot(engine) as connection:
        found = read_sessions(connection, fewer)
    said = GONE_SCENARIO.format(scenario="drop")
    for kind in ("person", "simulated"):
        of_kind = before["simulated"] == (kind == "simulated")
        count = (of_kind & (before["scenario"] == "drop")).sum()
        assert found.left_out[kind, said] == count > 0
    # The experimenter's pages go on.
    lines, _ = StudyProgress(fewer, engine).sessions("person")
    stages = {line.stage for line in lines if line.row.scenario == "drop"}
    assert stages == {"Finished", "Familiarization"}


def test_what_is_written_meanwhile_is_not_seen(
    engine: sa.Engine, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial_rows, "AT_ONCE", 5)
    before, _ = read_tables(engine, study)
    seen = 0
    with snapshot(engine) as connection:
        sessions = read_sessions(connection, study)
        for number, part in enumerate(read_trials(connection, study, sessions.table)):
            seen += part.table.num_rows
            if number == 0:
                with engine.connect() as other, other.begin():
                    other.execute(sa.update(ANSWERS).values(rt_ms=7.0))
                    other.execute(sa.delete(ANSWERS).where(ANSWERS.c.trial > 2))
            else:
                assert 7.0 not in part.table.column("rt_ms").to_pylist()
    assert seen == len(before)
    after, _ = read_tables(engine, study)
    assert len(after) < len(before) and (after["rt_ms"] == 7.0).all()


def test_answers_to_stimuli_that_are_gone_are_named(engine: sa.Engine, study: Study) -> None:
    with engine.connect() as connection, connection.begin():
        gone = sa.update(ANSWERS).where(ANSWERS.c.trial == 1, ANSWERS.c.phase == "test")
        connection.execute(gone.values(stimulus="gone"))
    with pytest.raises(PhysionError, match="the first to gone"):
        read_tables(engine, study)
    with snapshot(engine) as connection:
        sessions = read_sessions(connection, study)
        parts = list(read_trials(connection, study, sessions.table))
    assert {name for part in parts for name in part.unknown} == {"gone"}
    assert sum(len(part.unknown) for part in parts) > 20


# --- Psych-DS -------------------------------------------------------------------------------------


NASTY = '=1+1\t"tab"\n-2;@SUM(1) \\ \r n/a'


@pytest.mark.slow
def test_psych_ds_has_the_files_and_metadata_that_it_asks_for(tmp_path: Path) -> None:
    """One participant is in all scenarios; one is old and writes strangely."""
    study = make_tiny_study(tmp_path, scenarios=("a-b", "a.b", "drop"), size=64)
    engine = create_database(tmp_path)
    secrets = Secrets.load(tmp_path)
    insert_sessions(engine, study, secrets, 12)
    insert_sessions(engine, study, secrets, 4, kind="simulated", seed=1, ends=("finished",))
    insert_sessions(engine, study, secrets, 1, seed=2, ends=("finished",), age=99,
                    gender="n/a", education="=other", feedback=NASTY)  # fmt: skip
    whole = insert_sessions(engine, study, secrets, 3, seed=3, ends=("finished",))
    with engine.begin() as connection:
        first = sa.select(SESSIONS.c.participant).where(SESSIONS.c.session == whole[0])
        of_whole = sa.update(SESSIONS).where(SESSIONS.c.session.in_(whole))
        connection.execute(of_whole.values(participant=connection.scalar(first)))
    folder = export_study(engine, study, tmp_path / "out").out / "psych-ds"
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
