"""Content of the experimenter's pages, with no session, one, and hundreds."""

from __future__ import annotations

import html
import io
import os
import re
import signal
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Iterator
from multiprocessing import active_children
from pathlib import Path

import pandas as pd
import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

import httpx2
import sqlalchemy as sa

from physion.analysis.people.exclusions import PREREGISTERED, RULES, flag_sessions
from physion.analysis.people.responses import clean
from physion.experiment.export.answer_tables import read_tables
from physion.experiment.export.export_study import export_study
from physion.experiment.server_process import ServerProcess
from physion.experiment.store.database import ANSWERS, EVENTS, RAW_IDS, SESSIONS
from physion.experiment.study.settings import Condition
from support.experiment.experimenter_client import BASE, TWO, Lab, Visitor, lab
from support.experiment.experimenter_rows import insert_sessions
from support.experiment.tiny_study import PASSWORD, make_tiny_study

HOSTILE = (
    "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>'; DROP TABLE answers; --{{7*7}}"
)
PEOPLE, SIMULATED, PREVIEWS = 300, 12, 3


@pytest.fixture(scope="module")
def busy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Lab, Visitor]]:
    """Serve a study with 300 people, some simulated participants and previews."""
    with lab(tmp_path_factory.mktemp("study"), participants=80) as found:
        engine = found.store.engine
        insert_sessions(engine, found.study, found.secrets, PEOPLE)
        insert_sessions(engine, found.study, found.secrets, SIMULATED, kind="simulated", seed=1)
        insert_sessions(engine, found.study, found.secrets, PREVIEWS, kind="preview", seed=2)
        yield found, found.experimenter()


def table_after(text: str, heading: str) -> list[list[str]]:
    """Return the texts of the cells, by row, of the first table after a heading."""
    part = text[text.index(f"<h2>{heading}</h2>") :]
    part = part[: part.index("</table>")]
    rows = re.findall(r"<tr.*?</tr>", part, re.S)
    return [
        [words_of(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.S)]
        for row in rows
    ]


def words_of(markup: str) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", markup)).split())


def references(text: str) -> list[str]:
    return re.findall(r'<th scope="row"><a href="/experimenter/sessions/[0-9a-f]+">([^<]+)', text)


def rows_of(found: Lab, kind: str = "person") -> list[sa.Row]:
    with found.store.engine.connect() as connection:
        return list(connection.execute(sa.select(SESSIONS).where(SESSIONS.c.kind == kind)))


# --- overview ------------------------------------------------------------------------------------


def test_progress_counts_people_alone(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    rows = table_after(visitor.see().text, "Progress")[1:]
    people = rows_of(found)
    for row, scenario in zip(rows, found.study.scenarios, strict=False):
        own = [person for person in people if person.scenario == scenario]
        ended = Counter(
            "finished" if p.finished_at
            else "declined" if p.withdrawn_at and not p.consented_at
            else "withdrawn" if p.withdrawn_at
            else "going" if time.time() - p.last_seen < 900 else "left"
            for p in own
        )  # fmt: skip
        assert row[0] == scenario and row[2] == f"{ended['finished']} of 80"
        expected = [ended[state] for state in ("going", "left", "withdrawn", "declined", "void")]
        assert row[3:8] == [str(count) for count in expected]
        assert min(ended.values()) > 0 and sum(ended.values()) == len(own)
    assert rows[-1][0] == "All" and len(rows) == 3


def test_simulated_ones_and_previews_stand_apart(busy: tuple[Lab, Visitor]) -> None:
    _, visitor = busy
    for kind, count in (("simulated", SIMULATED), ("preview", PREVIEWS)):
        text = visitor.see(f"?kind={kind}").text
        funnel = table_after(text, "Where people stop")
        assert funnel[1][:3] == ["Consent", "", str(count)]
    assert table_after(visitor.see().text, "Where people stop")[1][2] == str(PEOPLE)
    strange = visitor.see("?kind=%3Cscript%3E")
    assert strange.status_code == 200 and "<script>" not in strange.text


def test_accuracy_is_that_of_the_answers(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    labels = {stimulus.stimulus: stimulus.label for stimulus in found.study.stimuli}
    rows = table_after(visitor.see().text, "Accuracy and response times")[1:]
    with found.store.engine.connect() as connection:
        for row, scenario in zip(rows, found.study.scenarios, strict=True):
            answers = connection.execute(
                sa.select(ANSWERS.c.stimulus, ANSWERS.c.response, ANSWERS.c.rt_ms)
                .join(SESSIONS)
                .where(SESSIONS.c.kind == "person", SESSIONS.c.scenario == scenario)
                .where(SESSIONS.c.answered_test == 6, ANSWERS.c.phase == "test")
            ).all()
            right = sum((a.response == "yes") == labels[a.stimulus] for a in answers)
            times = sorted(a.rt_ms for a in answers)
            middle = (times[(len(times) - 1) // 2] + times[len(times) // 2]) / 2
            assert row[0] == scenario and int(row[1]) == len(answers) // 6
            assert row[2].startswith(f"{100 * right / len(answers):.1f} %")
            assert row[4] == f"{middle / 1000:.2f} s"


def test_timing_counts_trials_with_all_frames(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    rows = table_after(visitor.see().text, "How movies were shown")
    with found.store.engine.connect() as connection:
        shown = connection.execute(
            sa.select(ANSWERS.c.frames_shown).join(SESSIONS).where(SESSIONS.c.kind == "person")
        ).scalars()
        counts = Counter(frames == 45 for frames in shown)
    share = f"{100 * counts[True] / counts.total():.1f} %"
    assert rows[1][2:5] == [str(counts.total()), share, str(counts[False])]
    names = {row[0] for row in rows[2:]}
    assert names == {"Chrome 150", "Firefox 140", "Safari 18", "60 Hz", "144 Hz"}
    assert sum(int(row[2]) for row in rows[2:5]) == counts.total()


def test_the_overview_refreshes_with_and_without_scripts(busy: tuple[Lab, Visitor]) -> None:
    _, visitor = busy
    text = visitor.see().text
    assert re.search(r'<noscript><meta http-equiv="refresh" content="30;url=[^"]*auto=1">', text)
    assert '<script type="module" src="/experimenter/static/refresh.js">' in text


# --- sessions ------------------------------------------------------------------------------------


def test_sessions_are_paged_without_loss(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    seen = [name for page in range(1, 7) for name in references(
        visitor.see(f"/sessions?page={page}").text)]  # fmt: skip
    newest = sorted(rows_of(found), key=lambda row: -row.started_at)
    assert seen == [row.reference for row in newest]
    assert references(visitor.see("/sessions?page=99999").text) == seen[250:]
    for strange in ("0", "-1", "x", "9" * 40, "%00", "1%27"):
        assert references(visitor.see(f"/sessions?page={strange}").text)


def test_sessions_are_chosen_and_sorted(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    text = visitor.see("/sessions?scenario=drop&state=withdrawn&sort=trials&down=0").text
    chosen = [row for row in rows_of(found) if row.scenario == "drop" and row.withdrawn_at
              and row.consented_at]  # fmt: skip
    assert sorted(references(text)) == sorted(row.reference for row in chosen)
    trials = {row.reference: row.answered_test for row in chosen}
    order = [trials[name] for name in references(text)]
    assert order == sorted(order) and len(set(order)) > 1
    upward = references(visitor.see("/sessions?state=finished&sort=accuracy&down=0").text)
    downward = references(visitor.see("/sessions?state=finished&sort=accuracy").text)
    assert upward and set(upward).isdisjoint(downward[:20])
    for column in ("reference", "scenario", "source", "state", "started", "minutes", "rt",
                   "flags", "frames", "nonsense", "__class__"):  # fmt: skip
        assert len(references(visitor.see(f"/sessions?sort={column}&page=2").text)) == 50


def test_conditions_are_counted_and_their_sessions_chosen(tmp_path: Path) -> None:
    conditions = (Condition("plain"), Condition("brief", cue_ms=100))
    with lab(tmp_path / "study", conditions=conditions) as found:
        for seed, (name, count) in enumerate((("plain", 5), ("brief", 8))):
            insert_sessions(found.store.engine, found.study, found.secrets, count, seed=seed,
                            ends=("finished",), condition=name)  # fmt: skip
        visitor = found.experimenter()
        table = table_after(visitor.see().text, "Conditions")
        assert [row[:3] for row in table[1:]] == [["plain", "5", "5"], ["brief", "8", "8"]]
        brief = [row.reference for row in rows_of(found) if row.condition == "brief"]
        text = visitor.see("/sessions?condition=brief&sort=reference&down=0").text
        assert references(text) == sorted(brief)
        assert "condition=brief&amp;sort=state" in text
        assert len(references(visitor.see("/sessions?condition=none").text)) == 13


def test_a_session_shows_its_answers_in_order_and_no_id(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    row = next(row for row in rows_of(found) if row.finished_at)
    text = visitor.see(f"/sessions/{row.session}").text
    answers = table_after(text, "Answers")[1:]
    assert [line[0] for line in answers] == ["practice"] * 10 + ["test"] * 6
    assert [int(line[1]) for line in answers] == [*range(1, 11), *range(1, 7)]
    labels = {stimulus.stimulus: stimulus.label for stimulus in found.study.stimuli}
    with found.store.engine.connect() as connection:
        stored = connection.execute(
            sa.select(ANSWERS).where(ANSWERS.c.session == row.session)
            .order_by(ANSWERS.c.phase, ANSWERS.c.trial)
        ).all()  # fmt: skip
        raw = connection.execute(
            sa.select(RAW_IDS.c.raw_id).where(RAW_IDS.c.participant == row.participant)
        ).scalar_one()
    for line, answer in zip(answers, stored, strict=True):
        right = (answer.response == "yes") == labels[answer.stimulus]
        assert line[2:4] == [answer.stimulus, answer.response]
        assert line[5] == ("right" if right else "wrong")
    assert raw not in text and row.participant not in text
    assert "It was fun." in text and table_after(text, "Events")[1][2] == "hidden"
    assert visitor.see("/sessions/none").status_code == 404


def test_ids_are_on_no_page_but_that_of_payments(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    with found.store.engine.connect() as connection:
        ids = connection.execute(sa.select(RAW_IDS.c.raw_id)).scalars().all()
    for page in ("", "/sessions", "/sessions?page=2", "/export", "/payments"):
        text = visitor.see(page).text
        assert not any(raw in text for raw in ids)
    text = visitor.open_payments().text
    finished = [row for row in rows_of(found) if row.finished_at]
    assert f"All {len(finished)} ids" in words_of(text)
    copied = re.search(r'<pre class="ids">(.*?)</pre>', text, re.S)
    assert copied is not None and len(copied[1].split()) == len(finished)
    assert all(name.startswith("person-") for name in copied[1].split()), "people alone"
    everybody = visitor.see("/payments?who=all&page=3").text
    assert f"All {PEOPLE} ids" in words_of(everybody)


# --- nothing, and hostile things -----------------------------------------------------------------


def test_pages_of_an_empty_study(tmp_path: Path, database_url: str) -> None:
    with lab(tmp_path, database_url) as empty:
        visitor = empty.experimenter()
        for page in ("", "?kind=simulated", "?kind=preview", "/sessions", "/export"):
            assert visitor.see(page).status_code == 200, page
        assert "No session yet" in visitor.see().text
        assert "No matching session" in visitor.see("/sessions").text
        assert "No ids are stored" in visitor.open_payments().text
        assert table_after(visitor.see().text, "Progress")[1][2] == "0 of 100"


def test_one_id_and_two(tmp_path: Path) -> None:
    with lab(tmp_path) as few:
        visitor, said = few.experimenter(), []
        for seed in (1, 2):
            insert_sessions(
                few.store.engine, few.study, few.secrets, 1, ends=("finished",), seed=seed
            )
            said.append(visitor.open_payments().text)
    assert "The id to copy" in said[0]
    assert "the stored id should be deleted. It is removed" in said[0]
    assert "All 2 ids, one per line, to copy" in said[1]
    assert "the 2 stored ids should be deleted. They are removed" in said[1]


def test_implausible_sessions_stand_out_on_every_page(tmp_path: Path) -> None:
    reason = "fast answers, no media"
    with lab(tmp_path) as found:
        for seed, facts in ((1, {}), (2, {"implausible": reason})):
            (session,) = insert_sessions(
                found.store.engine, found.study, found.secrets, 1, ends=("finished",), seed=seed,
                **facts,
            )  # fmt: skip
        visitor = found.experimenter()
        assert "and 1 implausible" in words_of(with_flags(visitor))
        implausible = [row.reference for row in rows_of(found) if row.implausible]
        assert references(visitor.see("/sessions?flag=implausible").text) == implausible
        assert reason in words_of(visitor.see(f"/sessions/{session}").text)
        payments = words_of(visitor.open_payments().text)
        assert payments.count(f"withheld: {reason}") == 1


def test_pages_of_one_hostile_session(tmp_path: Path, database_url: str) -> None:
    """Script and SQL in every text that a browser or recruiter can give."""
    device = {"user_agent": HOSTILE, "refresh_hz": None, HOSTILE: HOSTILE, "touch": True}
    with lab(tmp_path, database_url) as one:
        engine = one.store.engine
        (name,) = insert_sessions(
            engine, one.study, one.secrets, 1, ends=("finished",), gender=HOSTILE,
            education=HOSTILE, feedback=HOSTILE * 40, language=HOSTILE[:20], device=device,
        )  # fmt: skip
        with engine.execution_options(physion_writes=True).begin() as connection:
            hostile = {"raw_id": HOSTILE, "recruiter": {HOSTILE: HOSTILE}}
            connection.execute(sa.update(RAW_IDS).values(**hostile))
            connection.execute(sa.update(EVENTS).values(data={HOSTILE: HOSTILE}))
        visitor = one.experimenter()
        pages = [visitor.see(page).text for page in ("", "/sessions", f"/sessions/{name}")]
        pages.append(visitor.open_payments().text)
        for text in pages:
            assert "<script>alert" not in text and "<img" not in text
            assert not re.search(r"<[^>]*onerror", text)
        assert html.escape("<script>alert(1)</script>") in pages[2]
        assert html.escape("<script>alert(1)</script>") in pages[3]
        assert "{{7*7}}" in html.unescape(pages[2]), "shown as it was written"
        address = HOSTILE.replace("/", "%2F").replace("#", "%23").replace("?", "%3F")
        assert "<script>" not in visitor.see(f"/sessions/{address}").text
        words = "&".join(
            f"{key}={address}" for key in ("kind", "scenario", "state", "flag", "sort")
        )
        assert "<script>alert" not in visitor.see(f"/sessions?{words}").text
        assert "<script>alert" not in visitor.see(f"/payments?source={address}").text
        assert len(rows_of(one)) == 1, "the tables are still there"


# --- flags, deleting, the process that counts ----------------------------------------------------


def with_flags(visitor: Visitor) -> str:
    """Return the overview as soon as the flags are computed."""
    until = time.monotonic() + 600
    while "being computed" in (text := visitor.see().text):
        assert time.monotonic() < until
        time.sleep(0.2)
    return str(text)


def test_flags_are_those_of_the_analysis(busy: tuple[Lab, Visitor]) -> None:
    found, visitor = busy
    trials, sessions = read_tables(found.store.engine, found.study, kinds=("person",))
    expected = {
        name: frozenset(each.stimulus for each in found.study.phase(name, "test")) for name in TWO
    }
    assert all(len(names) == 6 for names in expected.values())
    table = flag_sessions(clean(trials, sessions), PREREGISTERED, expected=expected)
    finished = {row.session: row for row in rows_of(found) if row.finished_at}
    table = table[table["session"].isin(finished)]
    assert table["flagged"].any(), "else this shows nothing"
    text = with_flags(visitor)
    counts = {line[0]: line[1:] for line in table_after(text, "Exclusion rules")[1:]}
    for rule in RULES:
        own = [int(table.loc[table["scenario"] == name, rule].sum()) for name in TWO]
        assert counts[rule.replace("_", " ")] == [str(count) for count in own], rule
    flagged = set(table.loc[table["flagged"], "session"])
    shown = references(visitor.see("/sessions?state=finished&flag=any").text)
    assert set(shown) == {finished[name].reference for name in flagged}
    none = visitor.see("/sessions?state=going&flag=any").text
    assert "No matching session." in none
    unknown = visitor.see("/sessions?kind=preview&flag=any").text
    assert "Flags are not known" in unknown and "previews are never analysed" in unknown
    one = visitor.see(f"/sessions/{flagged.pop()}").text
    assert '<span class="flag">' in one


@pytest.mark.slow
def test_deleting_ids_needs_the_word_and_leaves_answers(tmp_path: Path, database_url: str) -> None:
    with lab(tmp_path, database_url) as own:
        engine = own.store.engine
        insert_sessions(engine, own.study, own.secrets, 20)
        visitor = own.experimenter()
        assert "Delete raw ids" in visitor.open_payments().text
        token = visitor.token("/payments")

        def progress() -> list[list[str]]:
            # Flagged sessions are counted in the background: known now or later.
            head, *rows = table_after(visitor.see().text, "Progress")
            flagged = head.index("Flagged")
            return [row[:flagged] + row[flagged + 1 :] for row in rows]

        before = progress()
        for word in ("", "yes", "delete all"):
            answer = visitor.submit("/payments/forget", token, word=word)
            assert answer.status_code == 422 and "Nothing was deleted" in answer.text
        answer = visitor.submit("/payments/forget", token, word="Delete")
        assert "20 ids were deleted" in answer.text and "Delete raw ids" not in answer.text
        with engine.connect() as connection:
            assert connection.scalar(sa.select(sa.func.count()).select_from(RAW_IDS)) == 0
        assert progress() == before
        assert before[0][2] != "0 of 100"
        if engine.dialect.name == "sqlite":
            stored = b"".join(path.read_bytes() for path in tmp_path.glob("*.sqlite*"))
            stored += Path(str(engine.url.database)).read_bytes()
            assert b"person-0-000" not in stored


def counting() -> set[int | None]:
    return {each.pid for each in active_children() if each.name == "physion-experimenter"}


@pytest.mark.slow
def test_the_process_that_counts_may_die(tmp_path: Path) -> None:
    others = counting()
    with lab(tmp_path) as own:
        visitor = own.experimenter()
        assert visitor.see().status_code == 200
        (first,) = counting() - others
        assert first is not None
        os.kill(first, signal.SIGKILL)
        assert visitor.see("/sessions").status_code == 200
        (second,) = counting() - others
        assert second != first
    assert counting() == others, "it ends with the server"


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="no /proc to look for processes in")
def test_no_process_is_left_by_a_killed_server(tmp_path: Path) -> None:
    study = make_tiny_study(tmp_path, size=64, languages=("en",))
    with ServerProcess(study.folder) as server:
        with httpx2.Client(
            base_url=server.url, trust_env=False, follow_redirects=True, timeout=300
        ) as client:
            form = re.search(r'name="form_token" value="(\w+)"', client.get(f"{BASE}/login").text)
            assert form is not None
            fields = {"form_token": form[1], "password": PASSWORD}
            assert "Log out" in client.post(f"{BASE}/login", data=fields).text
        children = Path(f"/proc/{server.pid}/task/{server.pid}/children")
        tasks = [path.read_text().split() for path in children.parents[1].glob("*/children")]
        left = {int(pid) for pids in tasks for pid in pids}
        assert left
        server.kill()
        until = time.monotonic() + 120
        while any(map(is_alive, left)):
            assert time.monotonic() < until, "a process outlives the server"
            time.sleep(0.1)


# --- export --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_export_is_that_of_the_command(
    busy: tuple[Lab, Visitor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, visitor = busy
    workplace = tmp_path / "workplace"
    workplace.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(workplace))
    token = visitor.token("/export")
    answer = visitor.submit("/export", token, simulated="yes")
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
    table = pd.read_csv(io.BytesIO(written["tiny-1/sessions.csv"]))
    assert set(table["simulated"]) == {True, False}
    people = visitor.submit("/export", token).content
    content = zipfile.ZipFile(io.BytesIO(people)).read("tiny-1/sessions.csv")
    table = pd.read_csv(io.BytesIO(content))
    assert set(table["simulated"]) == {False}
    assert not list(workplace.iterdir()), "nothing stays behind"
