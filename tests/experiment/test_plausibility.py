"""Impossible sessions: answers before their movie, without media, too fast, or shown too often."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from physion.experiment.protocol import Showing, TrialMedia
from physion.experiment.store.database import SESSIONS, SHOWINGS
from physion.experiment.store.judging import TOLERANCE_S
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media import read_media
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import Plausibility, Recruitment
from physion.experiment.study.study import Study
from support.experiment.store_walk import (
    PAGES,
    answer,
    enter,
    give,
    open_store,
    page,
    refusal,
    request,
    rows,
    run,
)

MOVIE_S = 44 / 30
"""From the first to the last of the 45 frames of a movie."""


class Clock:
    """The server's clock, which stands until a test puts it forward."""

    def __init__(self) -> None:
        self.now = 1_800_000_000.0

    def __call__(self) -> float:
        return self.now

    def wait(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(time, "time", clock)
    return clock


@pytest.fixture
def checked(
    small_study: Study, small_secrets: Secrets, tmp_path: Path, clock: Clock
) -> Iterator[Store]:
    """A store that checks the plausibility of sessions; three participants are wanted."""
    study = replace(
        small_study, plausibility=Plausibility(), recruitment=Recruitment(link_code="C0DE")
    )
    store = open_store(study, small_secrets, tmp_path / "a")
    yield store
    store.close()


class Person:
    """A participant, whose trials take the time that they take in a browser."""

    def __init__(self, store: Store, clock: Clock, name: str, **more: Any) -> None:
        self.store, self.clock = store, clock
        self.token = enter(store, name, **{"scenario": "drop", **more})

    def announce(self, phase: Any, trial: int, **more: Any) -> int:
        showing = Showing(
            **{"key": f"{phase}-{trial}-shown", "phase": phase, "trial": trial, **more}
        )
        return run(self.store.showing(self.token, showing)).showings

    def fetch(self, media: TrialMedia) -> None:
        for path in (media.movie, media.map):
            file = read_media(self.store.study, self.store.secrets, path)
            self.store.fetched.note(file.tag, file.phase, file.trial, file.kind, time.time())

    def trial(self, phase: Any, trial: int, *, fetch: bool = True, **more: Any) -> None:
        media = self.store.trials(self.token, phase).trials[trial]
        if fetch:
            self.fetch(media)
        self.announce(phase, trial)
        self.clock.wait(lasts(media) + more.get("rt_ms", 512.5) / 1000)
        give(self.store, self.token, trial, phase, **more)
        if phase == "familiarization":
            self.clock.wait(2)  # the full movie

    def begin(self, stage: str = "familiarization", **more: Any) -> Person:
        """Go to the first trial of a phase."""
        page(self.store, self.token, "consent")
        self.clock.wait(10)
        page(self.store, self.token, "instructions")
        if stage == "test":
            for trial in range(3):
                self.trial("familiarization", trial, **more)
            page(self.store, self.token, "ready")
        return self

    def finish(self, **more: Any) -> Any:
        """Go through the whole session and return its row."""
        self.begin("test", **more)
        for trial in range(4):
            self.trial("test", trial, **more)
        for name in ("demographics", "feedback"):
            page(self.store, self.token, name, **PAGES[name])
        return self.row()

    def row(self) -> Any:
        reference = run(self.store.state(self.token)).reference
        return next(row for row in rows(self.store, SESSIONS) if row.reference == reference)


def lasts(media: TrialMedia) -> float:
    """Return the time in seconds of cross, cue (2 s) and movie."""
    return media.fixation_ms / 1000 + 2 + MOVIE_S


def test_an_answer_is_refused_until_its_movie_can_have_been_shown(
    checked: Store, clock: Clock
) -> None:
    ada = Person(checked, clock, "Ada").begin("test")
    media = checked.trials(ada.token, "test").trials[0]
    ada.fetch(media)
    unseen = refusal(checked.answer(ada.token, answer(0)))
    assert unseen.code == "not_shown" and unseen.state is not None and unseen.state.trial == 0
    assert ada.announce("test", 0) == 1
    begin, earliest = clock.now, lasts(media) - TOLERANCE_S
    for passed in (0.0, 1.5, earliest - 0.001):
        clock.now = begin + passed
        early = refusal(checked.answer(ada.token, answer(0)))
        assert early.code == "too_early"
        assert early.wait_s == pytest.approx(earliest - passed, abs=1e-5)
    assert ada.row().answered_test == 0 and len(rows(checked)) == 3
    clock.now = begin + earliest + 0.001
    assert give(checked, ada.token, 0).state.trial == 1
    # The next trial has its own time, however late the first answer came.
    clock.wait(60)
    ada.announce("test", 1)
    assert refusal(checked.answer(ada.token, answer(1))).code == "too_early"


def test_the_time_counts_from_the_moment_at_which_the_movie_was_fetched(
    checked: Store, clock: Clock
) -> None:
    ada = Person(checked, clock, "Ada").begin()
    media = checked.trials(ada.token, "familiarization").trials[0]
    ada.announce("familiarization", 0)
    clock.wait(600)
    ada.fetch(media)
    asked = answer(0, "familiarization")
    early = refusal(checked.answer(ada.token, asked))
    assert early.wait_s == pytest.approx(2 + MOVIE_S - TOLERANCE_S, abs=1e-5)
    clock.wait(early.wait_s + 0.001)
    assert not run(checked.answer(ada.token, asked)).duplicate


def test_a_trial_begins_when_its_browser_says_but_after_the_last_one(
    checked: Store, clock: Clock
) -> None:
    ada = Person(checked, clock, "Ada").begin("test")
    media = checked.trials(ada.token, "test").trials[0]
    ada.fetch(media)
    clock.wait(10)
    ada.announce("test", 0, ago_ms=4000.0)
    begin = clock.now - 4
    clock.wait(60)
    give(checked, ada.token, 0, rt_ms=812.5)
    ended = begin + lasts(media) + 0.8125
    assert ada.row().next_from == pytest.approx(ended, abs=1e-5)
    ada.announce("test", 1, ago_ms=3_600_000)
    begins = [row.began_at for row in rows(checked, SHOWINGS) if row.phase == "test"]
    assert begins == pytest.approx([begin, ended], abs=1e-5)


def test_answers_that_waited_for_a_connection_are_accepted_but_take_their_time(
    checked: Store, clock: Clock
) -> None:
    ada = Person(checked, clock, "Ada").begin("test")
    trials = checked.trials(ada.token, "test").trials
    for media in trials:
        ada.fetch(media)
    taken = [lasts(media) + 0.6 for media in trials]
    clock.wait(sum(taken[:3]))
    # Three trials were done offline, one after the other; each showing says how long ago it began.
    for trial in range(3):
        ada.announce("test", trial, ago_ms=1000 * sum(taken[trial:3]))
        give(checked, ada.token, trial)
    # Nobody can say that a trial began before the previous one had ended.
    ada.announce("test", 3, ago_ms=3_600_000)
    assert refusal(checked.answer(ada.token, answer(3))).code == "too_early"


def test_showings_are_counted_over_all_loads_of_the_page(checked: Store, clock: Clock) -> None:
    ada = Person(checked, clock, "Ada").begin("test")
    ada.fetch(checked.trials(ada.token, "test").trials[0])
    assert ada.announce("test", 0) == 1 == ada.announce("test", 0)  # the same request again
    run(checked.state(ada.token, load=True))
    assert ada.announce("test", 0, key="after-a-reload") == 2
    clock.wait(6)
    give(checked, ada.token, 0)
    # A showing that was delayed on its way changes nothing.
    assert ada.announce("test", 0, key="delayed-showing") == 2
    ada.fetch(checked.trials(ada.token, "test").trials[1])
    for number in range(60):
        ada.announce("test", 1, key=f"showing-{number}")
    clock.wait(6)
    give(checked, ada.token, 1)
    test = [row for row in rows(checked) if row.phase == "test"]
    assert [row.showings for row in test] == [2, 50]
    assert ada.row().replayed == 1  # max_showings = 2
    assert len([row for row in rows(checked, SHOWINGS) if row.phase == "test"]) == 52


def test_only_the_next_trial_can_be_shown(checked: Store, clock: Clock) -> None:
    ada = Person(checked, clock, "Ada").begin()
    for phase, trial in (("test", 0), ("familiarization", 1)):
        showing = Showing(key="another-trial", phase=phase, trial=trial)
        refused = refusal(checked.showing(ada.token, showing))
        assert refused.code in ("wrong_stage", "out_of_order") and refused.state is not None
    assert not rows(checked, SHOWINGS)


def test_sessions_without_media_fill_no_place_and_get_no_code(checked: Store, clock: Clock) -> None:
    for number in range(5):  # three participants are wanted
        fake = Person(checked, clock, f"invented-{number}")
        assert fake.finish(fetch=False).implausible == "no media"
    completion = checked.result(fake.token).completion
    assert (completion.code, completion.url, completion.withheld) == (None, None, True)
    real = Person(checked, clock, "Ada")
    row = real.finish()
    assert row.implausible is None and row.replayed == row.unfetched == row.fast_answers == 0
    result = checked.result(real.token)
    assert result.completion.code == "C0DE" and not result.completion.withheld
    assert result.percentile is None  # the invented people are not compared with


def test_a_restart_of_the_server_makes_nobody_implausible(
    checked: Store, clock: Clock, small_secrets: Secrets
) -> None:
    ada = Person(checked, clock, "Ada").begin("test")
    checked.close()
    again = Store.open(checked.study, small_secrets)
    ada.store = again
    for trial in range(4):
        ada.trial("test", trial, fetch=False)  # the browser has the media already
    assert ada.row().unfetched == 0
    again.close()


@pytest.mark.parametrize(("count", "implausible"), [(2, None), (3, "fast answers")])
def test_many_answers_under_100_ms_are_implausible(
    checked: Store, clock: Clock, count: int, implausible: str | None
) -> None:
    ada = Person(checked, clock, "Ada").begin("test")
    for trial in range(4):
        ada.trial("test", trial, rt_ms=99.0 if trial < count else 100.0)
    assert ada.row().implausible == implausible


@pytest.mark.parametrize(("more", "implausible"), [(-0.01, "short"), (0.01, None)])
def test_a_session_shorter_than_its_movies_is_implausible(
    checked: Store, clock: Clock, more: float, implausible: str | None
) -> None:
    ada, begin = Person(checked, clock, "Ada"), clock.now
    shortest = checked.study.plausibility.reading_s
    for name in ("consent", "instructions"):
        page(checked, ada.token, name)
    for phase, count in (("familiarization", 3), ("test", 4)):
        for trial in range(count):
            media = checked.trials(ada.token, phase).trials[trial]  # type: ignore[arg-type]
            ada.fetch(media)
            ada.announce(phase, trial)
            clock.wait(lasts(media) + 0.1)
            give(checked, ada.token, trial, phase, rt_ms=100.0)
            # The shortest answer takes as long as the tolerance; feedback has 60 frames.
            shortest += lasts(media) + (59 / 30 if phase == "familiarization" else 0)
        page(checked, ada.token, "ready" if phase == "familiarization" else "demographics")
    assert clock.now < begin + shortest
    clock.now = begin + shortest + more
    page(checked, ada.token, "feedback")
    assert ada.row().implausible == implausible


def test_simulated_people_are_faster_where_the_study_allows_it(
    small_study: Study, small_secrets: Secrets, tmp_path: Path, clock: Clock
) -> None:
    word = {"pass": make_pass(small_secrets, "simulated")}
    asked = answer(0, "familiarization")
    for speed in (1, 1000):
        study = replace(small_study, plausibility=Plausibility(simulated_speed=speed))
        store = open_store(study, small_secrets, tmp_path / f"{speed}")
        robot = Person(store, clock, "Ada", **word).begin()
        ada = Person(store, clock, "Ada").begin()
        for person in (robot, ada):
            person.fetch(store.trials(person.token, "familiarization").trials[0])
            person.announce("familiarization", 0)
        clock.wait(0.01)
        if speed == 1:
            assert refusal(store.answer(robot.token, asked)).code == "too_early"
        else:
            assert run(store.answer(robot.token, asked)).state.trial == 1
        assert refusal(store.answer(ada.token, asked)).code == "too_early"
        store.close()


def test_a_place_is_held_for_15_minutes_after_the_last_answer(checked: Store, clock: Clock) -> None:
    late, waiting, times = request("late", scenario="drop"), [], []
    for number in range(3):
        assert run(checked.enter(late)).state.stage == "consent"
        waiting.append(Person(checked, clock, f"p{number}").begin("test"))
        times.append(clock.now)
    assert refusal(checked.enter(late)).code == "held"
    clock.now = times[0] + 15 * 60 - 0.001
    run(checked.state(waiting[0].token, load=True))  # to load the page does not hold the place
    assert refusal(checked.enter(late)).code == "held"
    clock.wait(0.5)
    assert run(checked.enter(late)).state.stage == "consent"
    waiting[0].trial("test", 0)  # but to continue does
    assert refusal(checked.enter(late)).code == "held"
    clock.now = times[1] + 15 * 60 + 0.5
    Person(checked, clock, "late").begin("test")
    waiting[1].trial("test", 0)  # who had begun can still finish
