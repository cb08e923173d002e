"""The export folder: tables, atomic replacement, and no secrets in it."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sqlalchemy as sa
from pandas.testing import assert_frame_equal
from PIL import Image

from physion.analysis.people.exclusions import flag_sessions, read_expected
from physion.analysis.people.responses import read_responses
from physion.cli.experiment import export as experiment_export
from physion.cli.help import EXAMPLES
from physion.cli.main import main
from physion.core.errors import BadInputError, PhysionError
from physion.core.tables import check_table, read_table
from physion.experiment.export import export_study as export
from physion.experiment.export.documents import preregistration, trial_figure, write_documents
from physion.experiment.export.export_study import GONE, TABLES, export_study
from physion.experiment.export.tables import PREVIEW, WITHDRAWN, read_tables
from physion.experiment.store.database import (
    ANSWERS,
    EVENTS,
    RAW_IDS,
    SESSIONS,
    STUDIES,
    create_database,
)
from physion.experiment.study.identity import Secrets
from physion.experiment.study.settings import PaymentRule, Recruitment, Timing
from physion.experiment.study.study import Study, load_study, write_settings
from support.experiment import experimenter_rows
from support.experiment.experimenter_rows import insert_sessions
from support.experiment.own_questions import OWN_QUESTIONS, OWN_TEXTS
from support.experiment.tiny_study import FULL, OBSERVED, RATE, make_tiny_study, read_number

NOW = 1_790_000_000.0
NASTY = '=HYPERLINK("http://evil","x")\n-2;@SUM(1)\t+3, "quoted"\rend'
CODE = "COMPLETION-CODE-17"
SONA = f"https://lab.sona-systems.com/webstudy_credit.aspx?experiment_id=1&credit_token={CODE}"


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    codes = Recruitment(prolific_code=CODE, sona_address=SONA)
    folder = tmp_path_factory.mktemp("study")
    return make_tiny_study(folder, scenarios=("collide", "drop"), size=64, recruitment=codes)


Fill = Callable[[Path], sa.Engine]


@pytest.fixture
def fill(study: Study, monkeypatch: pytest.MonkeyPatch) -> Fill:
    """Fill a database with people, simulated participants and previews; always the same rows."""

    def filled(folder: Path) -> sa.Engine:
        folder.mkdir(exist_ok=True)
        numbers = iter(range(1000))
        monkeypatch.setattr(experimenter_rows, "new_session", lambda: f"{next(numbers):032x}")
        engine = create_database(folder)
        secrets = Secrets.load(study.folder)
        insert_sessions(engine, study, secrets, 30, now=NOW)
        insert_sessions(engine, study, secrets, 4, ends=("finished",), seed=3, now=NOW,
                        feedback=NASTY, gender="=woman", age=None)  # fmt: skip
        insert_sessions(engine, study, secrets, 8, kind="simulated", seed=1, now=NOW)
        insert_sessions(engine, study, secrets, 3, kind="preview", seed=2, now=NOW)
        settings = vars(study) | {"folder": str(study.folder), "stimuli": [], "texts": {}}
        settings = json.loads(json.dumps(settings, default=vars))
        with engine.begin() as connection:
            connection.execute(sa.update(STUDIES).values(settings=settings))
        return engine

    return filled


@pytest.fixture
def engine(fill: Fill, database: Path) -> sa.Engine:
    return fill(database)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


# --- what is in it ------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_analysis_reads_what_is_exported(
    engine: sa.Engine, study: Study, tmp_path: Path
) -> None:
    report = export_study(engine, study, tmp_path / "out")
    trials, sessions = read_tables(engine, study)
    assert report.rows["trials"] == len(trials) and report.rows["sessions"] == len(sessions)
    out = tmp_path / "out"
    found = read_responses(out / "trials.csv", out / "sessions.csv", participants="all")
    assert len(found.trials) == len(trials) and found.dropped.empty
    assert found.sessions["session"].tolist() == sessions["session"].tolist()
    joined = found.trials.merge(trials, on=["session", "phase", "trial"], suffixes=("", "_stored"))
    for name in ("stimulus", "participant", "label", "correct", "rt_ms", "answered_at", "resumed"):
        assert (joined[name] == joined[f"{name}_stored"]).all(), name
    people = read_responses(out / "trials.csv", out / "sessions.csv")
    assert people.dropped["sessions"].sum() > 0 and not people.sessions["simulated"].any()
    flags = flag_sessions(people, expected=read_expected(out / "expected.csv"))
    assert set(flags["expected"]) == {6}
    unfinished = sessions.loc[~sessions["simulated"] & (sessions["finished_at"] == ""), "session"]
    assert set(flags.loc[flags["incomplete"], "session"]) == set(unfinished)


def test_csv_and_parquet_hold_the_same(engine: sa.Engine, study: Study, tmp_path: Path) -> None:
    out = export_study(engine, study, tmp_path / "out").out
    tables = dict(zip(("trials", "sessions"), read_tables(engine, study), strict=True))
    for name in ("trials", "sessions", "events"):
        typed = check_table(read_table(out / f"{name}.parquet", ()), TABLES[name], name)
        text = check_table(read_table(out / f"{name}.csv", ()), TABLES[name], name)
        for column in TABLES[name]:
            if column.kind == "text":
                text[column.name] = text[column.name].str.strip().str.removeprefix("'")
        assert list(text.columns) == [column.name for column in TABLES[name]]
        assert_frame_equal(text, typed)
        if name in tables:
            assert_frame_equal(typed, check_table(tables[name], TABLES[name], name))
    nasty = pd.read_parquet(out / "sessions.parquet")["feedback"]
    assert (nasty == NASTY).sum() == 4
    shown = pd.read_csv(out / "sessions.csv")
    assert (shown["feedback"] == f"'{NASTY}").sum() == 4 and "'=woman" in set(shown["gender"])


def test_details_and_events_are_there(engine: sa.Engine, study: Study, tmp_path: Path) -> None:
    with engine.begin() as connection:
        connection.execute(
            sa.update(ANSWERS).where(ANSWERS.c.trial == 2).values(details='{"flashes":[1.5]}')
        )
        first = connection.execute(sa.select(EVENTS).order_by(EVENTS.c.event)).first()
        assert first is not None
        more = {"kind": "visible", "at_ms": 2345.5, "stored_at": first.stored_at + 1.25}
        connection.execute(sa.insert(EVENTS).values(session=first.session, data={}, **more))
    out = export_study(engine, study, tmp_path / "out").out
    details = pd.read_parquet(out / "trial_details.parquet")
    trials = pd.read_parquet(out / "trials.parquet")
    keys = ["session", "phase", "trial"]
    assert_frame_equal(details[keys], trials[keys])
    third = details["trial"] == 2
    assert (details.loc[third, "details"] == '{"flashes":[1.5]}').all() and third.sum() > 40
    assert (details.loc[~third, "details"] == "{}").all()
    events = pd.read_parquet(out / "events.parquet")
    sessions = pd.read_parquet(out / "sessions.parquet")
    assert events["session"].drop_duplicates().tolist() == sessions["session"].tolist()
    assert json.loads(events["data"][0]) == {"trial": 3}
    assert (events["number"] == events["session"].duplicated()).all()
    own = events.set_index("session").loc[first.session]
    assert own[["number", "kind", "at_ms"]].values.tolist() == [
        [0, "hidden", 1234.5], [1, "visible", 2345.5]]  # fmt: skip
    times = [pd.Timestamp(text).timestamp() for text in own["stored_at"]]
    assert times == pytest.approx([first.stored_at, first.stored_at + 1.25], abs=0.001)
    words = json.loads((out / "data_dictionary.json").read_bytes())
    for name in ("trials", "sessions", "events"):
        header = (out / f"{name}.csv").read_text().partition("\n")[0].split(",")
        assert [entry["name"] for entry in words[name]] == header
    assert [entry["name"] for entry in words["trial_details"]] == list(details.columns)


def test_the_same_data_give_the_same_bytes(fill: Fill, study: Study, tmp_path: Path) -> None:
    exports = []
    for number, name in enumerate(("one", "two")):
        export_study(fill(tmp_path / name), study, tmp_path / str(number))
        exports.append(contents(tmp_path / str(number)))
    assert len(exports[0]) > 15
    assert exports[1] == exports[0]


def test_what_was_left_out_is_said(engine: sa.Engine, study: Study, tmp_path: Path) -> None:
    finished = sa.select(SESSIONS.c.session).where(
        SESSIONS.c.kind == "person", SESSIONS.c.finished_at.is_not(None)
    )
    with engine.begin() as connection:
        changed, emptied, *_ = connection.execute(finished).scalars()
        answer = sa.update(ANSWERS).where(ANSWERS.c.session == changed, ANSWERS.c.trial == 1)
        connection.execute(answer.values(stimulus="gone"))
        unanswered = dict.fromkeys(("answered_test", "answered_familiarization"), 0)
        connection.execute(sa.delete(ANSWERS).where(ANSWERS.c.session == emptied))
        connection.execute(
            sa.update(SESSIONS).where(SESSIONS.c.session == emptied).values(**unanswered)
        )
        rows = connection.execute(sa.select(SESSIONS)).fetchall()
    report = export_study(engine, study, tmp_path / "out")
    counts = {(e["what"], e["kind"], e["reason"]): e["count"] for e in report.left_out}
    assert counts["answer", "any", GONE] == 2
    assert counts["session", "preview", PREVIEW] == 3
    for kind in ("person", "simulated"):
        agreed = [r for r in rows if r.kind == kind and r.consented_at is not None]
        withdrew = sum(r.withdrawn_at is not None for r in agreed)
        assert counts.get(("session", kind, WITHDRAWN), 0) == withdrew
        assert sum(report.sessions[kind].values()) == len(agreed) - withdrew
        ended = sum(r.finished_at is not None and r.withdrawn_at is None for r in agreed)
        assert report.sessions[kind]["finished"] == ended
        if kind == "person":
            line = f"left out: {withdrew} sessions (person): the participant withdrew"
            assert withdrew > 0 and line in (tmp_path / "out" / "README.md").read_text()
    trials, sessions = (
        pd.read_parquet(tmp_path / "out" / f"{name}.parquet") for name in ("trials", "sessions")
    )
    latest = [trials["answered_at"].max(), sessions["finished_at"].dropna().max()]
    assert report.until == max(latest)
    report = export_study(engine, study, tmp_path / "out", simulated=False, scenario="drop")
    assert set(report.sessions) == {"person"}
    reasons = {entry["reason"] for entry in report.left_out}
    assert "simulated, which was not requested" in reasons


def test_nothing_secret_is_exported(engine: sa.Engine, study: Study, tmp_path: Path) -> None:
    out = export_study(engine, study, tmp_path / "out").out
    assert out.stat().st_mode & 0o077 == 0, "others on the machine cannot read it"
    with engine.connect() as connection:
        raw = list(connection.execute(sa.select(RAW_IDS.c.raw_id)).scalars())
        absent = connection.execute(
            sa.select(SESSIONS.c.session, SESSIONS.c.participant).where(
                (SESSIONS.c.kind == "preview")
                | SESSIONS.c.withdrawn_at.is_not(None)
                | SESSIONS.c.consented_at.is_(None)
            )
        ).fetchall()
    assert len(raw) == 45 and len(absent) > 8
    secret = [
        line for line in (study.folder / "secret.json").read_text().split('"') if len(line) > 15
    ]
    assert secret
    words = [*raw, CODE, *secret, str(study.folder), *(word for row in absent for word in row)]
    for path in sorted(out.rglob("*")):
        content = path.name.encode()
        if path.suffix == ".parquet":
            content += pd.read_parquet(path).to_csv().encode()
        elif path.is_file():
            content += path.read_bytes()
        found = [word for word in words if word.encode() in content]
        assert not found, (path, found)
    settings = json.loads((out / "study.json").read_bytes())["states"]
    assert settings[0]["settings"]["title"] == study.title


def test_a_study_without_data_is_exported_all_the_same(study: Study, tmp_path: Path) -> None:
    engine = create_database(tmp_path)
    report = export_study(engine, study, tmp_path / "out")
    assert report.rows == {"trials": 0, "sessions": 0, "events": 0, "trial_details": 0}
    assert report.until is None and report.sessions == {}
    assert len((tmp_path / "out" / "trials.csv").read_text().splitlines()) == 1
    # The examples of the help name files that are written.
    words = [word for lines in EXAMPLES.values() for line in lines for word in line.split()]
    named = {Path(word).name for word in words if word.startswith("study/export/")}
    assert named and named <= {path.name for path in (tmp_path / "out").iterdir()}


# --- whole or not at all ------------------------------------------------------------------------


def test_a_failure_leaves_nothing_and_the_old_export(
    engine: sa.Engine, study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"

    def fails(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(export, "write_psych_ds", fails)
        with pytest.raises(OSError, match="No space"):
            export_study(engine, study, out)
    assert not list(tmp_path.glob("*out*"))
    export_study(engine, study, out)
    before = contents(out)
    for name in ("readme", "read_trials", "detail_table"):  # the last is written behind
        with monkeypatch.context() as broken:
            broken.setattr(export, name, fails)
            with pytest.raises(OSError, match="No space"):
                export_study(engine, study, out)
        assert contents(out) == before
        assert [path.name for path in tmp_path.glob("*out*")] == ["out"]


def test_an_export_is_replaced_and_nothing_else(
    engine: sa.Engine, study: Study, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    export_study(engine, study, out, simulated=False)
    export_study(engine, study, out)
    both = contents(out)
    (out / "psych-ds" / "notes.txt").write_text("mine")
    with pytest.raises(BadInputError, match=r"psych-ds/notes\.txt was added"):
        export_study(engine, study, out)
    (out / "psych-ds" / "notes.txt").unlink()
    export_study(engine, study, out)
    assert contents(out) == both
    (out / "study.json").unlink()
    with pytest.raises(BadInputError, match="something else"):
        export_study(engine, study, out)
    own = tmp_path / "own"
    own.mkdir()
    export_study(engine, study, own)  # an empty folder is nobody's
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("mine")
    (tmp_path / "link").symlink_to(other)
    (tmp_path / "file").write_text("mine")
    for path in (other, tmp_path / "link", tmp_path / "file"):
        with pytest.raises(BadInputError, match="choose another"):
            export_study(engine, study, path)
    assert (other / "thesis.tex").read_text() == "mine"


def test_what_a_killed_export_left_is_cleared_away(
    engine: sa.Engine, study: Study, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    export_study(engine, study, out)
    whole = contents(out)
    out.rename(tmp_path / ".out.old")  # killed between the two renamings
    (tmp_path / ".out.part" / "psych-ds").mkdir(parents=True)
    (tmp_path / ".out.part" / "trials.csv").write_text("half a")
    export_study(engine, study, out)
    assert contents(out) == whole
    assert [path.name for path in tmp_path.glob("*out*")] == ["out"]


def test_two_exports_do_not_meet(
    engine: sa.Engine, study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner: list[Exception] = []
    original = export.read_sessions

    def once_more(*words: object) -> object:
        monkeypatch.setattr(export, "read_sessions", original)
        with pytest.raises(PhysionError, match="another process") as refused:
            export_study(engine, study, tmp_path / "out")
        inner.append(refused.value)
        return original(*words)  # type: ignore[arg-type]

    monkeypatch.setattr(export, "read_sessions", once_more)
    export_study(engine, study, tmp_path / "out")
    assert inner and (tmp_path / "out" / "README.md").exists()


# --- the verb -----------------------------------------------------------------------------------


def test_the_verb_exports_and_says_what(
    study: Study, fill: Fill, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    served = tmp_path / "served"
    shutil.copytree(study.folder, served)
    with pytest.raises(BadInputError, match="has the study been served"):
        experiment_export.main(experiment_export.Options(served))
    fill(served).dispose()
    options = experiment_export.Options(served, out=tmp_path / "out", json=True)
    assert experiment_export.main(options) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["out"] == str(tmp_path / "out") and said["rows"]["trials"] > 300
    assert experiment_export.main(experiment_export.Options(served)) == 0
    text = capsys.readouterr().out
    assert f"rows: {said['rows']['trials']} trials, " in text
    assert contents(served / "export") == contents(tmp_path / "out")


# --- the preregistration and the figure of the trials ---------------------------------------------


TEMPLATE = [
    *("Study information", "Title", "Research questions", "Hypotheses"),
    *("Design plan", "Study design", "Manipulated variables", "Evaluation protocol"),
    *("Measured variables", "Sampling plan", "Data collection procedure", "Sampling procedure"),
    *("Analysis plan", "Data exclusion criteria", "Missing data", "Planned analyses"),
    "Exploratory analyses",
]
"""Headings in the order of the template."""


def test_the_plan_follows_the_template_and_the_settings(tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path, test=6, familiarization=4, questions=OWN_QUESTIONS, more_texts=OWN_TEXTS,
        title="Red & yellow", participants=37, exclusions="preregistered-only",
        timing=Timing(fixation_in_familiarization=False, cue_ms=1234, break_every=0),
        payment=PaymentRule(4.0, "EUR", 20), funders="the Abc Foundation",
    )  # fmt: skip
    text = preregistration(study)
    assert re.findall("^##+ (.*)$", text, re.MULTILINE) == TEMPLATE
    for words in (
        "# Preregistration: Red & yellow",
        "| collide | 6 | 3 |",
        "4 familiarization trials",
        "6 test trials in an order of their own, without feedback, without breaks",
        "500 to 1500 ms (not in familiarization)",
        "for 1234 ms",
        "flashing at 2 Hz",
        f"for {OBSERVED / RATE:g} s at {RATE} frames per second",
        "Will the red object touch the yellow object?",
        "4 EUR",
        "paid for by the Abc Foundation",
        "12.00 EUR per hour",
        "when 37 participants have finished each scenario",
        "more than 6 equal answers in a row",  # 2 of 64 sequences of 6 tosses have 6 in a row
        "24 or more answers in a row alternate",
        "30 % or fewer",
        "`confidence`: How sure were you?",
    ):
        assert words in text, words
    assert "no person can have made it" not in text
    other = preregistration(
        replace(study, exclusions="preregistered", payment=PaymentRule(), demographics=False)
    )
    assert "no person can have made it" in other and "age, gender" not in other
    assert "[What do participants receive?]" in other
    assert "paid for" not in preregistration(replace(study, funders=""))


def pictures_of(svg: str) -> list[np.ndarray]:
    found = re.findall(r'href="data:image/jpeg;base64,([^"]+)"', svg)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))) for data in found]


def test_the_figure_shows_frames_texts_and_durations(tmp_path: Path) -> None:
    study = make_tiny_study(tmp_path, test=6, familiarization=2, size=192)
    svg = trial_figure(study)
    texts = [element.text or "" for element in ET.fromstring(svg).iter() if element.text]
    words = " ".join(" ".join(texts).split())
    assert "Practice trial, 2 in a session" in words and "Test trial, 6 in a session" in words
    assert "2000 ms, flashing at 2 Hz" in words and "500 to 1500 ms" in words
    assert f"{1000 * OBSERVED / RATE:.0f} ms" in words
    assert f"{1000 * FULL / RATE:.0f} ms, then at will" in words
    assert "Will the red object touch the yellow object?" in words and "YES" in words
    # The last practice trial has no contact.
    assert "does not touch" in words
    pictures = pictures_of(svg)
    assert [read_number(picture) for picture in pictures] == [0, 44, 59, 0, 44]
    cued = pictures[0][96, int(0.2 * 192)].astype(int)
    assert cued[0] > 200 and cued[1:].max() < 60  # the agent is red
    no_cross = replace(study, timing=Timing(fixation_in_familiarization=False))
    assert svg.count("Fixation") == 2 and trial_figure(no_cross).count("Fixation") == 1
    shorter = trial_figure(replace(study, familiarization_feedback=False))
    assert len(pictures_of(shorter)) == 4 and "Feedback, full movie" not in shorter


def test_the_verb_writes_both_again(tmp_path: Path) -> None:
    study = make_tiny_study(tmp_path, test=2, familiarization=1)
    plan, figure = write_documents(study)
    before = figure.read_text()
    write_settings(replace(study, title="Another title"))
    assert main(["experiment", "describe", str(tmp_path)]) == 0
    assert "Another title" in plan.read_text() and figure.read_text() != before
    assert load_study(tmp_path).digest  # they are no part of the study
