"""Rates, funnels, histograms and summaries of the overview, without a server."""

from __future__ import annotations

from pathlib import Path

import pytest
import sqlalchemy as sa

pytest.importorskip("sqlalchemy", reason="the extra 'experiment' is not installed")

from physion.experiment.experimenter.figures import HEIGHT, WIDTH, accuracy_histogram, rt_histogram
from physion.experiment.experimenter.overview import (
    browser_label,
    expected_end,
    funnel,
    refresh_rate_label,
)
from physion.experiment.experimenter.statistics.flagging import Flags
from physion.experiment.experimenter.statistics.summaries import (
    AnswerCounts,
    SessionSummary,
    SummaryCache,
    session_state,
)
from physion.experiment.experimenter.statistics.worker import StatisticsWorker
from physion.experiment.experimenter.templating import minutes

from physion.experiment.protocol import Stage
from physion.experiment.store.database import ANSWERS, SESSIONS, open_database, upgrade
from physion.experiment.study.identity import Secrets
from support.experiment.experimenter_rows import BROWSERS, insert_sessions
from support.experiment.store_walk import STAGES
from support.experiment.tiny_study import make_tiny_study


def test_the_expected_end_follows_the_rate_of_late() -> None:
    every_minute = [60.0 * number for number in range(10)]
    assert expected_end(every_minute, 20, 600.0) == pytest.approx(600 + 10 * 600 / 9)
    assert expected_end(every_minute, 20, 1200.0) == pytest.approx(1200 + 10 * 1200 / 9)
    faster = [*every_minute, *(600.0 + number for number in range(25))]
    end = expected_end(faster, 40, 625.0)
    assert end is not None and end - 625 == pytest.approx(5 * 20 / 19)


def test_there_is_no_expected_end_without_a_rate() -> None:
    assert expected_end([], 10, 0.0) is None
    assert expected_end([1.0, 2.0], 10, 3.0) is None
    assert expected_end([1.0, 2.0, 3.0], 10, 90_000.0) is None, "nobody came today"
    assert expected_end([1.0, 2.0, 3.0], 3, 4.0) is None, "it is complete"
    assert expected_end([4.0, 4.0, 4.0], 10, 4.0) is None, "no time has passed"


def test_everybody_is_in_the_funnel_once() -> None:
    stages: list[tuple[Stage, str]] = [("done", "finished")] * 5
    stages += [("test", "left"), ("test", "left"), ("test", "going")]
    stages += [("consent", "declined"), ("demographics", "withdrawn")]
    part = [SessionSummary({}, state, stage, AnswerCounts()) for stage, state in stages]
    steps = funnel(part, STAGES)
    assert [step.reached for step in steps] == [10, 9, 9, 9, 9, 6, 5, 5]
    assert [step.left for step in steps] == [0, 0, 0, 0, 2, 0, 0, 0]
    assert [step.withdrawn for step in steps] == [1, 0, 0, 0, 0, 1, 0, 0]
    assert steps[4].going == 1 and steps[-1].percent == 50.0


def test_histograms_hold_everybody() -> None:
    shares = [0.0, 0.05, 0.5, 0.55, 0.999, 1.0, 0.15, 0.3, 29 / 100]
    drawn = accuracy_histogram(shares)
    counts = {bar.label.split(":")[0]: int(bar.label.split(": ")[1]) for bar in drawn.bars}
    assert sum(counts.values()) == len(shares)
    assert counts["95–100 %"] == 2 and counts["15–20 %"] == 1 and counts["30–35 %"] == 1
    assert counts["50–55 %"] == 1 and counts["25–30 %"] == 1
    times = rt_histogram([0.0, 1e-9, 50.0, 100.0, 800.0, 19_999.0, 1e9])
    assert sum(int(bar.label.split(": ")[1]) for bar in times.bars) == 7
    for figure in (drawn, times):
        for bar in figure.bars:
            assert bar.x >= 0 and bar.x + bar.width <= WIDTH and bar.y >= 0
            assert bar.y + bar.height <= HEIGHT - figure.base + 0.01
    assert accuracy_histogram([]).bars == () and "none yet" in rt_histogram([]).label


MACOS = "Mozilla/5.0 (Macintosh; Intel Mac OS X 10_15_7) "
IPHONE = "Mozilla/5.0 (iPhone; CPU iPhone OS 18_5 like Mac OS X) "
LINUX = "Mozilla/5.0 (X11; Linux x86_64) "
WEBKIT = "AppleWebKit/605.1.15 (KHTML, like Gecko) "
BLINK = "AppleWebKit/537.36 (KHTML, like Gecko) "


@pytest.mark.parametrize(
    ("agent", "name"),
    [
        *zip(BROWSERS, ("Chrome 150", "Firefox 140", "Safari 18"), strict=True),
        (f"{LINUX}{BLINK}HeadlessChrome/150.0.0.0 Safari/537.36", "Chrome 150"),
        (f"{IPHONE}{WEBKIT}CriOS/150.0.7151.79 Mobile/15E148 Safari/604.1", "Chrome 150"),
        (BROWSERS[0] + " Edg/150.0.0.0", "Edge 150"),
        (f"{IPHONE}{WEBKIT}Version/18.0 EdgiOS/149.0 Mobile/15E148 Safari/605.1.15", "Edge 149"),
        (BROWSERS[0] + " OPR/120.0.0.0", "Opera 120"),
        (f"{LINUX.replace(')', '; rv:128.0)')}Gecko/20100101 Firefox/128.0", "Firefox 128"),
        (f"{IPHONE}{WEBKIT}FxiOS/140.0 Mobile/15E148 Safari/605.1.15", "Firefox 140"),
        (f"{MACOS}{WEBKIT}Version/17.6 Safari/605.1.15", "Safari 17"),
        (f"{IPHONE}{WEBKIT}Version/18.5 Mobile/15E148 Safari/604.1", "Safari 18"),
        (f"{LINUX}{WEBKIT}Version/60.5 Safari/605.1.15", "WebKitGTK"),
        (f"{LINUX}{WEBKIT}Version/18.0 Safari/605.1.15 Epiphany/605.1.15", "WebKitGTK"),
        (f"Mozilla/5.0 (X11; Ubuntu; Linux x86_64) {WEBKIT}Version/60.5 Safari/605.1.15",
         "WebKitGTK"),
        (f"Mozilla/5.0 (Linux; Android 10; K) {BLINK}SamsungBrowser/28.0 Chrome/130.0.0.0 "
         "Mobile Safari/537.36", "Samsung Internet 28"),
        (f"Mozilla/5.0 (Linux; Android 14; Pixel; wv) {BLINK}Version/4.0 Chrome/150.0.0.0 "
         "Mobile Safari/537.36", "Chrome 150"),
        ("", "browser not known"),
        ("curl/8", "other"),
        ("Mozilla/5.0 (compatible; Konqueror/4.5; Linux) KHTML/4.5.4 (like Gecko)", "other"),
        ("Version/" * 100_000, "other"),
        ("(X11; " * 100_000, "other"),
    ],
)  # fmt: skip
def test_browsers_by_their_own_words(agent: str, name: str) -> None:
    assert browser_label(agent) == name


def test_refresh_rates_are_the_usual_ones() -> None:
    given = (59.94, 60.3, 144.1, 119.9, 83.0, None, 0, "60", True, float("nan"))
    names = ["60 Hz", "60 Hz", "144 Hz", "120 Hz", "about 85 Hz"]
    assert [refresh_rate_label(hz) for hz in given[:5]] == names
    assert [refresh_rate_label(hz) for hz in given[5:8]] == ["screen not known"] * 3
    assert refresh_rate_label(given[9]) == "screen not known"


def test_spans_of_time_in_words() -> None:
    assert [minutes(m) for m in (0.2, 59.4, 60, 125, 1440, 3000)] == [
        "0 min", "59 min", "1 h 00", "2 h 05", "1 d 0 h", "2 d 2 h"]  # fmt: skip


def test_states_of_sessions() -> None:
    facts = {"finished_at": None, "withdrawn_at": None, "consented_at": 1.0, "last_seen": 100.0,
             "voided_at": None, "screened_out_at": None}  # fmt: skip
    assert session_state(facts | {"screened_out_at": 5.0}, 1e9) == "screened_out"
    assert session_state(facts, 1000.0) == "going" and session_state(facts, 1001.0) == "left"
    assert session_state(facts | {"withdrawn_at": 5.0}, 1000.0) == "withdrawn"
    assert session_state(facts | {"finished_at": 5.0, "voided_at": 6.0}, 10.0) == "void"
    assert session_state(facts | {"withdrawn_at": 5.0, "consented_at": None}, 10.0) == "declined"
    assert session_state(facts | {"finished_at": 5.0}, 1e9) == "finished"


def test_flags_are_found_anew_whenever_the_rules_would_read_something_else(
    tmp_path: Path, database_url: str
) -> None:
    study = make_tiny_study(tmp_path, size=64, languages=("en",))
    engine = open_database(database_url)
    upgrade(engine)
    names = insert_sessions(engine, study, Secrets.load(tmp_path), 20)
    asked: list[object] = []

    class Listening:
        def flags(self, kind: str, state: object) -> Flags:
            asked.append(state)
            return Flags("preregistered")

    worker = StatisticsWorker(study, engine)
    worker._flagger = Listening()  # type: ignore[assignment]

    def look(**values: float | None) -> None:
        with engine.connect().execution_options(physion_writes=True) as connection:
            if values:
                own = SESSIONS.c.session == names[0]
                connection.execute(sa.update(SESSIONS).where(own).values(**values))
                connection.commit()
        worker._read_at = -1e9
        worker.overview("person")

    look(finished_at=None, withdrawn_at=None)
    look()
    look(finished_at=2.0)
    look(finished_at=None, withdrawn_at=2.0)
    assert asked[0] == asked[1] and len(set(asked)) == 3
    engine.dispose()


def test_summaries_grow_as_answers_come(tmp_path: Path, database_url: str) -> None:
    study = make_tiny_study(tmp_path, size=64, languages=("en",))
    engine = open_database(database_url)
    upgrade(engine)
    names = insert_sessions(engine, study, Secrets.load(tmp_path), 30)
    with engine.connect().execution_options(physion_writes=True) as connection:
        rows = [row._asdict() for row in connection.execute(sa.select(ANSWERS))]
        counts = {row.session: row.answered_test
                  for row in connection.execute(sa.select(SESSIONS))}  # fmt: skip
        connection.execute(sa.delete(ANSWERS).where(ANSWERS.c.phase == "test"))
        connection.execute(sa.update(SESSIONS).values(answered_test=0))
        connection.commit()
        growing = SummaryCache(study, engine)
        assert all(summary.answered.test == 0 for summary in growing.refresh(0.0))
        late = [row for row in rows if row["phase"] == "test" and row["trial"] < 3]
        later = [row for row in rows if row["phase"] == "test" and row["trial"] >= 3]
        for part, most in ((late, 3), (later, 99)):
            connection.execute(sa.insert(ANSWERS), part)
            for session, count in counts.items():
                connection.execute(
                    sa.update(SESSIONS)
                    .where(SESSIONS.c.session == session)
                    .values(answered_test=min(count, most))
                )
            connection.commit()
            growing.refresh(0.0)
    grown = growing.refresh(0.0)
    assert [summary.facts["session"] for summary in grown] == names
    for old, new in zip(grown, SummaryCache(study, engine).refresh(0.0), strict=True):
        assert sorted(old.answered.rt_ms) == sorted(new.answered.rt_ms)
        assert old.answered.correct == new.answered.correct
        assert old.answered.full == new.answered.full and old.stage == new.stage
        assert old.answered.test == counts[old.facts["session"]]
    engine.dispose()
