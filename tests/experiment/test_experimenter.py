"""The experimenter's pages with no session, a few, and hundreds; their forms and access."""

from __future__ import annotations

import csv
import html
import io
import re
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from threading import Event
from time import gmtime, strftime
from types import SimpleNamespace

import pandas as pd
import pytest
import sqlalchemy as sa

from physion.analysis.people.exclusions import PREREGISTERED, flag_sessions
from physion.analysis.people.responses import clean
from physion.experiment.experimenter import access, progress
from physion.experiment.experimenter.access import COOKIE, IDLE_TIMEOUT, MAX_DURATION
from physion.experiment.experimenter.pages import minutes, visible
from physion.experiment.experimenter.payments import COLUMNS, bonus_of
from physion.experiment.experimenter.progress import STATES, session_state
from physion.experiment.export.export_study import export_study
from physion.experiment.export.tables import read_tables
from physion.experiment.protocol import Enter, PageDone
from physion.experiment.store.database import ANSWERS, EVENTS, PAUSES, RAW_IDS, SESSIONS
from physion.experiment.store.lab import set_voided
from physion.experiment.study.orders import trial_order
from physion.experiment.study.recruitment import session_code
from physion.experiment.study.settings import Bonus, Condition
from support.experiment.experimenter_client import BASE, TWO, Lab, Visitor, lab
from support.experiment.experimenter_rows import insert_sessions
from support.experiment.store_walk import begin, enter, give, refusal, rows, run, walk
from support.experiment.tiny_study import PASSWORD

HOSTILE = (
    "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>'; DROP TABLE answers; --{{7*7}}"
)
PEOPLE, SIMULATED, PREVIEWS = 300, 12, 3
ONE = {"participants": 1, "scenarios": ("drop",), "test": 2, "familiarization": 1}


@pytest.fixture(scope="module")
def busy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Lab, Visitor]]:
    """Serve a study with 300 people, some simulated participants and previews."""
    with lab(tmp_path_factory.mktemp("study"), participants=80) as found:
        engine = found.store.engine
        insert_sessions(engine, found.study, found.secrets, PEOPLE)
        insert_sessions(engine, found.study, found.secrets, SIMULATED, kind="simulated", seed=1)
        insert_sessions(engine, found.study, found.secrets, PREVIEWS, kind="preview", seed=2)
        yield found, found.experimenter()


@pytest.fixture
def small(tmp_path: Path) -> Iterator[tuple[Lab, Visitor]]:
    """Serve a study for one participant."""
    with lab(tmp_path, **ONE) as found:
        yield found, found.experimenter()


def table_of(text: str, number: int = 0) -> list[list[str]]:
    """Return the texts of the cells, by row, of a table of a page."""
    part = re.findall(r"<table.*?</table>", text, re.S)[number]
    return [
        [words_of(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.S)]
        for row in re.findall(r"<tr.*?</tr>", part, re.S)
    ]


def words_of(markup: str) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", markup)).split())


def references(text: str) -> list[str]:
    return re.findall(r'<th scope="row"><a href="/experimenter/sessions/[0-9a-f]+">([^<]+)', text)


def sessions_of(found: Lab, kind: str = "person") -> list[sa.Row]:
    return [row for row in rows(found.store, SESSIONS) if row.kind == kind]


def session_of(found: Lab, token: str) -> sa.Row:
    reference = run(found.store.state(token)).reference
    return next(row for row in rows(found.store, SESSIONS) if row.reference == reference)


# --- progress ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_progress_counts_people_and_their_answers(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    labels = {stimulus.stimulus: stimulus.label for stimulus in found.study.stimuli}
    answers: dict[str, list[bool]] = {}
    for each in rows(found.store):
        if each.phase == "test":
            right = (each.response == "yes") == labels[each.stimulus]
            answers.setdefault(each.session, []).append(right)
    head, *shown = table_of(visitor.see().text)
    for row, scenario in zip(shown, found.study.scenarios, strict=False):
        own = [person for person in sessions_of(found) if person.scenario == scenario]
        ended = Counter(session_state(person, time.time()) for person in own)
        cells = dict(zip(head, row, strict=True))
        assert row[0] == scenario and cells["Finished"] == f"{ended['finished']} of 80"
        for name, state in (("In progress", "going"), ("Dropped out", "left"),
                            ("Withdrawn", "withdrawn"), ("Void", "void")):  # fmt: skip
            assert cells[name] == str(ended[state])
        finished = [fmean(answers[p.session]) for p in own if p.finished_at]
        assert cells["Mean accuracy"] == f"{100 * fmean(finished):.1f} %"
        assert sum(ended.values()) == len(own) and min(ended[s] for s in ("going", "left")) > 0
    assert shown[-1][0] == "All" and len(shown) == 3


def test_states_of_sessions_and_spans_in_words() -> None:
    names = ("voided_at", "finished_at", "withdrawn_at", "screened_out_at")
    states = ("void", "finished", "withdrawn", "screened_out")
    for name, state in zip(names, states, strict=True):
        row = SimpleNamespace(**dict.fromkeys(names) | {name: 1.0, "last_seen": 1.0})
        assert session_state(row, 2.0) == state
    row = SimpleNamespace(**dict.fromkeys(names), last_seen=1000.0)
    after = [session_state(row, 1000.0 + seconds) for seconds in (0, 900, 901)]
    assert after == ["going", "going", "left"]
    spans = [minutes(value) for value in (None, 12.4, 185, 3000)]
    assert spans == ["–", "12 min", "3 h 05", "2 d 2 h"]
    assert visible("ab\u202ecd\x00") == "ab\\u202ecd\\u0000"


def test_progress_counts_each_condition(tmp_path: Path) -> None:
    groups = (Condition("plain"), Condition("brief"))
    with lab(tmp_path, conditions=groups) as found:
        for seed, (name, count) in enumerate((("plain", 2), ("brief", 3))):
            insert_sessions(found.store.engine, found.study, found.secrets, count, seed=seed,
                            ends=("finished",), condition=name)  # fmt: skip
        insert_sessions(found.store.engine, found.study, found.secrets, 1, seed=9,
                        ends=("finished",), condition="brief", implausible="short")  # fmt: skip
        head, *shown = table_of(found.experimenter().see().text, 1)
        assert head[:2] == ["Condition", "Counted"]
        assert [row[:2] for row in shown] == [["plain", "2"], ["brief", "3"]]


def test_many_entries_in_a_minute_raise_an_alarm(
    small: tuple[Lab, Visitor], monkeypatch: pytest.MonkeyPatch
) -> None:
    found, visitor = small
    for number in range(progress.ALARM_ENTRIES - 1):
        enter(found.store, f"script {number}")
    assert "entered within the last minute" not in visitor.see().text
    enter(found.store, "one more")
    assert "30 people entered within the last minute" in words_of(visitor.see().text)
    later = time.time() + 61
    monkeypatch.setattr(time, "time", lambda: later)
    assert "entered within the last minute" not in visitor.see().text


def test_recruitment_is_paused_and_resumed(small: tuple[Lab, Visitor]) -> None:
    found, visitor = small
    going = begin(found.store, "Early")
    for _ in range(2):
        assert visitor.submit("/recruitment", action="pause").status_code == 303
    assert "Recruitment is paused" in visitor.see().text
    assert refusal(found.store.enter(Enter(id="Late"))).code == "paused"
    walk(found.store, going, "test")
    assert visitor.submit("/recruitment", action="resume").status_code == 303
    assert "Recruitment is paused" not in visitor.see().text
    (pause,) = rows(found.store, PAUSES)
    assert pause.paused_at < pause.resumed_at
    assert refusal(found.store.enter(Enter(id="Late"))).code == "held"
    assert visitor.submit("/recruitment", action="stop").status_code == 422


# --- sessions ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_sessions_are_chosen(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    people = sorted(sessions_of(found), key=lambda row: -row.started_at)
    assert references(visitor.see("/sessions").text) == [row.reference for row in people]
    left = [
        row.reference
        for row in people
        if row.scenario == "drop" and session_state(row, time.time()) == "left"
    ]
    assert references(visitor.see("/sessions?scenario=drop&state=left").text) == left != []
    assert "No matching session." in visitor.see("/sessions?state=none").text
    counts = re.findall(r'<span class="count">(\d+)', visitor.see("/sessions").text)
    assert counts == [str(PEOPLE), str(SIMULATED), str(PREVIEWS)]
    for kind, count in (("simulated", SIMULATED), ("preview", PREVIEWS)):
        text = visitor.see(f"/sessions?kind={kind}").text
        assert len(references(text)) == count and visitor.see(f"?kind={kind}").status_code == 200


def test_the_list_of_sessions_has_their_numbers(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    labels = {stimulus.stimulus: stimulus.label for stimulus in found.study.stimuli}
    people = sorted(sessions_of(found), key=lambda row: -row.started_at)
    by_session: dict[str, list[sa.Row]] = {}
    for answer in rows(found.store):
        by_session.setdefault(answer.session, []).append(answer)
    head, *shown = table_of(visitor.see("/sessions").text)
    stages = Counter[str]()
    for person, line in zip(people, shown, strict=True):
        cells, own = dict(zip(head, line, strict=True)), by_session.get(person.session, [])
        test = [answer for answer in own if answer.phase == "test"]
        right = sum((answer.response == "yes") == labels[answer.stimulus] for answer in test)
        accuracy = f"{100 * right / len(test):.0f} %" if test else "–"
        lost = sum(answer.frames_shown != 45 for answer in own)
        end = person.finished_at or person.withdrawn_at or person.last_seen
        assert cells["Reference"] == person.reference and cells["Trials"] == str(len(test))
        assert (cells["Accuracy"], cells["Frames"]) == (accuracy, str(lost))
        assert cells["Duration"] == minutes((end - person.started_at) / 60)
        assert cells["Started"] == strftime("%Y-%m-%d %H:%M", gmtime(person.started_at))
        state = STATES[session_state(person, time.time())]
        practice = len(own) < 10
        stage = "" if person.finished_at else " Familiarization" if practice else " Test"
        assert cells["State"] == state + stage
        stages[stage] += 1
    assert len(stages) == 3 and min(stages.values()) > 10


def test_flags_match_the_analysis(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    trials, sessions = (
        table[~table["simulated"]] for table in read_tables(found.store.engine, found.study)
    )
    expected = {
        name: frozenset(each.stimulus for each in found.study.phase(name, "test")) for name in TWO
    }
    table = flag_sessions(clean(trials, sessions), PREREGISTERED, expected=expected)
    finished = {row.session: row for row in sessions_of(found) if row.finished_at}
    flagged = set(table.loc[table["flagged"] & table["session"].isin(finished), "session"])
    assert flagged, "else this shows nothing"
    shown = references(visitor.see("/sessions?state=finished&flag=any").text)
    assert set(shown) == {finished[name].reference for name in flagged}
    head, *_, total = table_of(visitor.see().text)
    assert total[head.index("Flagged")] == str(len(flagged))
    assert "No matching session." in visitor.see("/sessions?state=going&flag=any").text
    assert "previews are never analysed" in visitor.see("/sessions?kind=preview").text
    assert '<span class="flag">' in visitor.see(f"/sessions/{flagged.pop()}").text


def test_flags_are_found_anew_only_when_a_session_has_ended(
    small: tuple[Lab, Visitor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "FLAGS_SECONDS", 0.0)
    found, _ = small
    walk(found.store, begin(found.store, "First"), "done")
    (done,) = rows(found.store, SESSIONS)
    run(found.store.write(lambda connection: set_voided(connection, done.session, True, 1.0)))
    numbers = progress.StudyProgress(found.study, found.store.engine)
    first = numbers.flags("person")
    token = walk(found.store, begin(found.store, "Ada"), "feedback")
    assert numbers.flags("person") is first
    walk(found.store, token, "done")
    again = numbers.flags("person")
    assert again is not first and again is numbers.flags("person")
    assert first.at is not None and again.at is not None and again.at > first.at


def test_a_session_shows_its_answers_in_order_and_no_id(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    lost = {each.session for each in rows(found.store) if each.frames_shown != 45}
    row = next(row for row in sessions_of(found) if row.finished_at and row.session in lost)
    text = visitor.see(f"/sessions/{row.session}").text
    answers = table_of(text)[1:]
    assert [line[0] for line in answers] == ["practice"] * 10 + ["test"] * 6
    assert [int(line[1]) for line in answers] == [*range(1, 11), *range(1, 7)]
    labels = {stimulus.stimulus: stimulus.label for stimulus in found.study.stimuli}
    stored = sorted(
        (each for each in rows(found.store) if each.session == row.session),
        key=lambda each: (each.phase, each.trial),
    )
    for line, answer in zip(answers, stored, strict=True):
        right = (answer.response == "yes") == labels[answer.stimulus]
        outcome = "yes" if labels[answer.stimulus] else "no"
        assert line[2:5] == [answer.stimulus, answer.response, outcome]
        assert line[5:7] == ["right" if right else "wrong", f"{answer.rt_ms / 1000:.2f}"]
        complete = answer.frames_shown == 45
        assert line[7] == ("45" if complete else f"{answer.frames_shown} of 45")
        assert line[10] == strftime("%Y-%m-%d %H:%M", gmtime(answer.answered_at))
    facts = words_of(text)
    right = sum((a.response == "yes") == labels[a.stimulus] for a in stored if a.phase == "test")
    assert f"Test right {right} of 6 ({100 * right / 6:.1f} %)" in facts
    lost = sum(answer.frames_shown != 45 for answer in stored)
    assert f"Trials without all frames {lost} " in facts
    for name, at in (("Started", row.started_at), ("Finished", row.finished_at)):
        assert f"{name} {strftime('%Y-%m-%d %H:%M', gmtime(at))}" in facts
    ids = {each.participant: each.raw_id for each in rows(found.store, RAW_IDS)}
    assert ids[row.participant] not in text and row.participant not in text
    assert "It was fun." in text and visitor.see("/sessions/none").status_code == 404


def test_a_void_session_does_not_count(small: tuple[Lab, Visitor]) -> None:
    found, visitor = small
    row = session_of(found, walk(found.store, enter(found.store, "Fake"), "done"))
    assert refusal(found.store.enter(Enter(id="Next"))).code == "study_full"
    page = f"/sessions/{row.session}"
    begin_at = time.time()
    assert visitor.submit(f"{page}/void", action="void").status_code == 303
    assert "This session is void" in visitor.see(page).text
    assert len(read_tables(found.store.engine, found.study)[1]) == 0
    later = begin(found.store, "Next")
    # Only the chosen session became void.
    voided = {each.session: each.voided_at for each in sessions_of(found)}
    assert begin_at <= voided.pop(row.session) <= time.time()
    assert list(voided.values()) == [None]
    head, *_, total = table_of(visitor.see().text)
    cells = dict(zip(head, total, strict=True))
    assert (cells["Finished"], cells["Void"]) == ("0 of 1", "1")
    assert refusal(found.store.enter(Enter(id="Fake"))).code == "already_took_part"
    assert visitor.submit(f"{page}/void", action="count").status_code == 303
    assert session_of(found, later) and len(read_tables(found.store.engine, found.study)[1]) == 2
    # A void session that is not finished cannot be continued.
    other = session_of(found, later)
    visitor.submit(f"/sessions/{other.session}/void", action="void")
    assert run(found.store.state(later)).stage == "withdrawn"
    assert refusal(found.store.enter(Enter(id="Next"))).code == "already_took_part"
    assert visitor.submit("/sessions/none/void", action="void").status_code == 404


def test_one_session_is_deleted_while_others_answer(small: tuple[Lab, Visitor]) -> None:
    found, visitor = small
    other, token = begin(found.store, "Other"), begin(found.store, "Gone")
    for each in (other, token):
        walk(found.store, each, "test")
    give(found.store, token, 0)
    row = session_of(found, token)
    page = f"/sessions/{row.session}"
    before = len(rows(found.store))
    assert visitor.submit(f"{page}/forget", word="yes").status_code == 422
    assert len(rows(found.store)) == before
    assert visitor.submit(f"{page}/forget", word=" Delete").status_code == 303
    assert not give(found.store, other, 0).duplicate
    for table in (ANSWERS, EVENTS):
        assert row.session not in {each.session for each in rows(found.store, table)}
    assert [each.raw_id for each in rows(found.store, RAW_IDS)] == ["Other"]
    assert "No answer yet." in visitor.see(page).text
    content = b"".join(path.read_bytes() for path in found.study.folder.glob("*.sqlite*"))
    assert b"Gone" not in content and b"Other" in content


# --- payments ------------------------------------------------------------------------------------


def line(correct: int, trials: int = 8, state: str = "finished") -> progress.SessionLine:
    return progress.SessionLine(None, state, "", trials, correct, 0, ())


def test_a_bonus_is_for_answers_beyond_guessing_in_finished_sessions() -> None:
    rule = Bonus(per_correct=0.25, above=0.5, most=1.0)
    assert [bonus_of(rule, line(n)) for n in (0, 4, 5, 7, 8)] == [0.0, 0.0, 0.25, 0.75, 1.0]
    assert bonus_of(rule, line(100, 100)) == 1.0
    assert bonus_of(Bonus(per_correct=0.25), line(100, 100)) == 12.5
    assert bonus_of(Bonus(), line(100, 100)) == 0.0
    for state in ("left", "withdrawn", "void", "going"):
        assert bonus_of(rule, line(100, 100, state)) == 0.0


def test_ids_are_only_on_the_page_of_payments(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    ids = [row.raw_id for row in rows(found.store, RAW_IDS)]
    for page in ("", "/sessions", "/export"):
        text = visitor.see(page).text
        assert not any(raw in text for raw in ids)
    finished = [row for row in sessions_of(found) if row.finished_at]
    text = visitor.see("/payments").text
    copied = re.search(r'<pre class="ids">(.*?)</pre>', text, re.S)
    assert copied is not None and len(copied[1].split()) == len(finished)
    assert all(name.startswith("person-") for name in copied[1].split()), "only people"
    assert f"All {PEOPLE} ids" in words_of(visitor.see("/payments?who=all").text)


def finish(found: Lab, person: str, right: int) -> sa.Row:
    """Take part with so many right test answers, the first ones; return the row of the session."""
    given = {"source": "mturk", "recruiter": {"hitId": "h1"}}
    token = walk(found.store, begin(found.store, person, **given), "test")
    row = session_of(found, token)
    order = trial_order(found.study, row.scenario, row.order_seed)["test"]
    for trial, stimulus in enumerate(order):
        answer = stimulus.label if trial < right else not stimulus.label
        give(found.store, token, trial, response="yes" if answer else "no")
    walk(found.store, token, "done")
    return session_of(found, token)


def test_each_person_is_paid_for_the_own_session(tmp_path: Path) -> None:
    settings = {"bonus": Bonus(per_correct=0.25, above=0.5), "participants": 9, "test": 4}
    with lab(tmp_path, **ONE | settings) as found:
        done = {person: finish(found, person, right) for person, right in
                (("w-ada", 4), ("=w-bo", 3), ("w-cy", 1), ("w-di", 4))}  # fmt: skip
        walk(found.store, begin(found.store, "w-late", source="mturk"), "feedback")
        gone = walk(found.store, begin(found.store, "w-gone", source="mturk"), "test")
        run(found.store.page(gone, PageDone(page="withdraw")))
        visitor = found.experimenter()
        visitor.submit(f"/sessions/{done['w-di'].session}/void", action="void")
        page = visitor.see("/payments").text
        assert "75 %" in page and "0.25" in page and "Download as CSV" in page
        sent = visitor.see("/payments.csv")
        assert sent.headers["content-type"] == "text/csv; charset=utf-8"
        assert sent.headers["content-disposition"].endswith('-payments.csv"')
        assert "'=w-bo" in sent.text, "no formula for a spreadsheet"
        cells = {row["id"].lstrip("'"): row for row in csv.DictReader(io.StringIO(sent.text))}
        bonus = {"w-ada": "0.50", "=w-bo": "0.25", "w-cy": "0.00", "w-di": "0.00"}
        right = {"w-ada": 4, "=w-bo": 3, "w-cy": 1, "w-di": 4}
        assert set(cells) == set(done)
        for person, row in done.items():
            paid = cells[person]
            assert tuple(paid) == COLUMNS and paid["recruiter"] == '{"hitId": "h1"}'
            assert (paid["reference"], paid["source"]) == (row.reference, "mturk")
            assert (paid["test_trials"], paid["correct"]) == ("4", str(right[person]))
            assert (paid["accuracy"], paid["bonus"]) == (f"{right[person] / 4:.4f}", bonus[person])
            assert paid["completion_code"] == session_code(found.secrets, row.session)
            at = strftime("%Y-%m-%dT%H:%M:%S+00:00", gmtime(row.finished_at))
            assert paid["finished_at"] == at
            assert paid["state"] == ("void" if person == "w-di" else "finished")
        everybody = list(csv.DictReader(io.StringIO(visitor.see("/payments.csv?who=all").text)))
        states = {row["id"]: (row["state"], row["completion_code"]) for row in everybody}
        assert states["w-late"] == ("going", "") and states["w-gone"] == ("withdrawn", "")
        assert len(everybody) == 6


def test_deleting_ids_needs_the_word_and_leaves_answers(tmp_path: Path) -> None:
    with lab(tmp_path) as own:
        insert_sessions(own.store.engine, own.study, own.secrets, 20)
        visitor = own.experimenter()
        assert "the 20 stored ids should be deleted" in visitor.see("/payments").text
        before = table_of(visitor.see().text)
        for word in ("", "yes", "delete all"):
            answer = visitor.submit("/payments/forget", word=word)
            assert answer.status_code == 422 and "Nothing was deleted" in answer.text
        answer = visitor.submit("/payments/forget", word="Delete")
        assert "20 ids were deleted" in answer.text and "Delete raw ids" not in answer.text
        assert rows(own.store, RAW_IDS) == []
        assert table_of(visitor.see().text) == before
        stored = b"".join(path.read_bytes() for path in tmp_path.glob("*.sqlite*"))
        assert b"person-0-000" not in stored


# --- nothing, and strange things -----------------------------------------------------------------


def test_pages_of_an_empty_study(tmp_path: Path) -> None:
    with lab(tmp_path) as empty:
        visitor = empty.experimenter()
        for page in ("", "?kind=simulated", "?kind=preview", "/sessions", "/export"):
            assert visitor.see(page).status_code == 200, page
        assert "No matching session" in visitor.see("/sessions").text
        assert "No ids are stored" in visitor.see("/payments").text
        assert table_of(visitor.see().text)[1][2] == "0 of 100"


def test_implausible_sessions_stand_out_on_every_page(tmp_path: Path) -> None:
    reason = "fast answers, no media"
    with lab(tmp_path) as found:
        for seed, facts in ((1, {}), (2, {"implausible": reason})):
            (session,) = insert_sessions(
                found.store.engine, found.study, found.secrets, 1, ends=("finished",), seed=seed,
                **facts,
            )  # fmt: skip
        visitor = found.experimenter()
        assert "and 1 implausible" in words_of(visitor.see().text)
        implausible = [row.reference for row in sessions_of(found) if row.implausible]
        assert references(visitor.see("/sessions?flag=implausible").text) == implausible
        assert reason in words_of(visitor.see(f"/sessions/{session}").text)
        payments = words_of(visitor.see("/payments").text)
        assert payments.count(f"withheld: {reason}") == 1 and "The id to copy" in payments


def test_pages_of_one_hostile_session(tmp_path: Path) -> None:
    """Script and SQL in every text that a browser or recruiter can give."""
    device = {"user_agent": HOSTILE, "refresh_hz": None, HOSTILE: HOSTILE, "touch": True}
    with lab(tmp_path) as one:
        engine = one.store.engine
        (name,) = insert_sessions(
            engine, one.study, one.secrets, 1, ends=("finished",), gender=HOSTILE,
            education=HOSTILE, feedback=HOSTILE * 40, language=HOSTILE[:20], device=device,
        )  # fmt: skip
        hostile = {"raw_id": HOSTILE, "recruiter": {HOSTILE: HOSTILE}}
        run(one.store.write(lambda c: c.execute(sa.update(RAW_IDS).values(**hostile))))
        visitor = one.experimenter()
        pages = [
            visitor.see(page).text for page in ("", "/sessions", f"/sessions/{name}", "/payments")
        ]
        for text in pages:
            assert "<script>alert" not in text and "<img" not in text
            assert not re.search(r"<[^>]*onerror", text)
        for text in pages[2:]:
            assert html.escape("<script>alert(1)</script>") in text
        assert "{{7*7}}" in html.unescape(pages[2]), "shown as it was written"
        address = HOSTILE.replace("/", "%2F").replace("#", "%23").replace("?", "%3F")
        assert "<script>" not in visitor.see(f"/sessions/{address}").text
        words = "&".join(f"{key}={address}" for key in ("kind", "scenario", "state", "flag"))
        for page in (f"/sessions?{words}", f"/payments?who={address}"):
            assert "<script>alert" not in visitor.see(page).text
        assert len(sessions_of(one)) == 1, "the tables are still there"


# --- export --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_export_matches_the_command(
    busy: tuple[Lab, Visitor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, visitor = busy
    workplace = tmp_path / "workplace"
    workplace.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(workplace))
    answer = visitor.submit("/export", simulated="yes")
    assert answer.status_code == 200 and answer.headers["content-type"] == "application/zip"
    assert re.fullmatch(
        r'attachment; filename="tiny-1-\d{4}-\d\d-\d\d\.zip"', answer.headers["content-disposition"]
    )
    packed = zipfile.ZipFile(io.BytesIO(answer.content))
    export_study(found.store.engine, found.study, tmp_path / "tiny-1")
    written = {
        path.relative_to(tmp_path).as_posix(): path.read_bytes()
        for path in tmp_path.rglob("*")
        if path.is_file()
    }
    assert {name: packed.read(name) for name in packed.namelist()} == written
    people = zipfile.ZipFile(io.BytesIO(visitor.submit("/export").content))
    table = pd.read_csv(io.BytesIO(people.read("tiny-1/sessions.csv")))
    assert set(table["simulated"]) == {False}
    assert list(workplace.iterdir()) == [], "nothing is left in the temporary folder"


# --- access ---------------------------------------------------------------------------------------


PAGES = ("", "/", "/sessions", "/sessions/abc", "/payments", "/payments.csv", "/export", "?auto=1")
ACTIONS = ("/logout", "/recruitment", "/sessions/abc/void", "/sessions/abc/forget",
           "/payments/forget", "/export")  # fmt: skip


@pytest.fixture(scope="module")
def lab_of_one(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with lab(tmp_path_factory.mktemp("study")) as found:
        begin(found.store, "5f1e")
        yield found


@pytest.mark.parametrize("page", PAGES)
def test_nothing_is_shown_without_login(lab_of_one: Lab, page: str) -> None:
    for cookie in (None, "wrong", "x" * 5000):
        visitor = lab_of_one.visitor()
        headers = {} if cookie is None else {"cookie": f"{COOKIE}={cookie}"}
        answer = visitor.get(f"{BASE}{page}", headers=headers, follow_redirects=False)
        assert answer.status_code == 303 and answer.headers["location"] == f"{BASE}/login"
        assert answer.content == b""


@pytest.mark.parametrize("action", ACTIONS)
def test_nothing_is_done_without_login_or_by_a_form_of_another_site(
    lab_of_one: Lab, action: str
) -> None:
    fields = {"word": "delete", "action": "pause"}
    answer = lab_of_one.visitor().submit(action, **fields)
    assert answer.status_code == 303 and answer.headers["location"] == f"{BASE}/login"
    visitor = lab_of_one.experimenter()
    for origin in ("null", "https://evil.example", "http://testserver.evil", "http://testserver:1"):
        answer = visitor.submit(action, origin, **fields)
        assert answer.status_code == 403 and "no longer valid" in answer.text
    assert visitor.post(f"{BASE}{action}", data=fields).status_code == 403, "no origin"
    assert visitor.submit(action, **fields, more="x" * 9000).status_code == 403, "too large"
    origin = {"origin": "http://testserver"}
    assert visitor.post(f"{BASE}{action}", json=fields, headers=origin).status_code == 403
    assert visitor.see().status_code == 200, "still logged in"
    assert rows(lab_of_one.store, PAUSES) == [] and len(rows(lab_of_one.store, RAW_IDS)) == 1


def test_only_the_password_logs_in(lab_of_one: Lab) -> None:
    visitor = lab_of_one.visitor()
    assert visitor.submit("/login", "https://evil.example", password=PASSWORD).status_code == 403
    for password in ("wrong", "", PASSWORD + " ", PASSWORD.upper(), "\0", "x" * 2000):
        assert visitor.log_in(password).status_code == 403
        assert visitor.see().status_code == 303
    assert visitor.log_in().status_code == 303 and visitor.see().status_code == 200


def test_passwords_are_checked_one_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checks that wait are limited, so that guesses delay nobody for long."""
    go_on = Event()
    monkeypatch.setattr(access, "check_password", lambda *_: go_on.wait(30) and False)
    monkeypatch.setattr(access, "CHECKS_WAITING", 0)
    with lab(tmp_path) as own:
        refused = own.visitor().log_in()
        assert refused.status_code == 429 and "Too many attempts" in refused.text


def test_the_cookie_goes_nowhere_else_and_ends_with_the_login(lab_of_one: Lab) -> None:
    for base_url, secure in (("http://testserver", False), ("https://testserver", True)):
        visitor = lab_of_one.visitor(base_url=base_url)
        tokens = []
        for _ in range(2):
            cookie = visitor.log_in().headers["set-cookie"]
            words = {word.strip().lower() for word in cookie.split(";")[1:]}
            assert {"httponly", "samesite=strict", f"path={BASE}"} <= words
            assert ("secure" in words) == secure and "domain" not in cookie.lower()
            assert PASSWORD not in cookie
            tokens.append(cookie.partition(";")[0])
        assert len(set(tokens)) == 2, "a new token with each login"
    visitor = lab_of_one.experimenter()
    cookie = visitor.cookies[COOKIE]
    assert visitor.submit("/logout").status_code == 303
    assert COOKIE not in visitor.cookies
    again = visitor.get(BASE, headers={"cookie": f"{COOKIE}={cookie}"}, follow_redirects=False)
    assert again.status_code == 303


def test_a_login_ends_when_idle_and_in_any_case(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    now = [1000.0]
    make = access.Access.__init__
    monkeypatch.setattr(access.Access, "__init__", lambda s, keys: make(s, keys, lambda: now[0]))
    with lab(tmp_path) as own:
        visitor = own.experimenter()
        now[0] += IDLE_TIMEOUT
        assert visitor.see("/export").status_code == 200
        now[0] += IDLE_TIMEOUT
        assert visitor.see("?auto=1").status_code == 200
        now[0] += 1
        assert visitor.see("/export").status_code == 303, "pages that refresh do not keep it open"
        visitor.log_in()
        for _ in range(int(MAX_DURATION / IDLE_TIMEOUT)):
            assert visitor.see("/export").status_code == 200
            now[0] += IDLE_TIMEOUT
        now[0] += 1
        assert visitor.see("/export").status_code == 303


def test_every_page_has_a_strict_policy_and_is_not_kept(lab_of_one: Lab) -> None:
    visitor = lab_of_one.experimenter()
    for page in ("/login", "", "/sessions", "/sessions/none", "/payments", "/export"):
        answer = visitor.see(page)
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["x-frame-options"] == "DENY"
        assert not re.search(r"<style|\sstyle=|\son\w+=|<script", answer.text)


def test_only_files_of_the_package_are_static(lab_of_one: Lab) -> None:
    visitor = lab_of_one.visitor()
    good = visitor.see("/static/experimenter.css")
    assert good.status_code == 200 and good.headers["content-type"].startswith("text/css")
    for name in ("../pages.py", "..%2fpages.py", "pages.py", "%2e%2e/access.py", ""):
        assert visitor.see(f"/static/{name}").status_code in (303, 404)
