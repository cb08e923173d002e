"""Entering, consent, pages, states, results and the ends of sessions."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import update

from physion.core.errors import BadInputError, PhysionError
from physion.experiment.protocol import (
    Completion,
    Device,
    Enter,
    Event,
    Events,
    PageDone,
    SessionEnd,
)
from physion.experiment.store.database import (
    EVENTS,
    METADATA,
    PARTICIPANTS,
    RAW_IDS,
    SESSIONS,
    STUDIES,
    TOKENS,
)
from physion.experiment.store.judging import percentile
from physion.experiment.store.lab import set_paused
from physion.experiment.store.sessions import ACTIVE_WITHIN
from physion.experiment.store.store import Refused, Store
from physion.experiment.study.identity import Secrets, participant_hash
from physion.experiment.study.media import read_media_path
from physion.experiment.study.orders import individual_order_seed, trial_order
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import EarlyEnd, Recruitment
from physion.experiment.study.study import Study
from support.experiment.store_walk import (
    PAGES,
    STAGES,
    answer,
    begin,
    enter,
    give,
    open_store,
    page,
    refusal,
    request,
    rows,
    run,
    walk,
)

AGREED = PageDone(page="consent", data={"agreed": True})
VISIT_KEY = "3f6c1d2e-0000-4000-8000-abcdefABCDEF"


def code_of(ask: Callable[[], object]) -> str:
    """Return the code with which a request is refused."""
    with pytest.raises(Refused) as caught:
        ask()
    return caught.value.code


DEVICE = Device(user_agent="TellingBrowser 7", screen_width=1917)
TELLING = (b"did-not-agree", b"TellingBrowser", b"1917", b"telling-visit", b"TellingEvent")
ENDS = {
    "declined": EarlyEnd("NOCONSENT", "no-consent", "https://lab.example/declined"),
    "stopped": EarlyEnd("STOPPED", "", "https://lab.example/stopped"),
    "full": EarlyEnd("FULL", "full", ""),
}


def come(person: str) -> Enter:
    return request(
        person, source="prolific", scenario="drop", device=DEVICE,
        recruiter={"STUDY_ID": "telling-visit"},
    )  # fmt: skip


def stored(store: Store, folder: Path) -> bytes:
    """Return all bytes of the database and its logs; assert that no table has a row of a person."""
    for table in METADATA.sorted_tables:
        assert table is STUDIES or rows(store, table) == [], table.name
    return b"".join(path.read_bytes() for path in folder.glob("*.sqlite*"))


@pytest.mark.parametrize("leaves", ["declining", "withdrawing", "closing the page"])
def test_nothing_of_a_person_is_stored_before_the_consent(
    store: Store, database: Path, leaves: str
) -> None:
    entered = run(store.enter(come("did-not-agree")))
    assert entered.state.stage == "consent"
    assert run(store.state(entered.token, load=True)).stage == "consent"
    telling = Events(events=[Event(kind="hidden", at_ms=1.0, data={"a": "TellingEvent"})])
    assert run(store.events(entered.token, telling)).stored == 0
    before = stored(store, database)
    if leaves == "declining":
        assert page(store, entered.token, "consent", agreed=False).stage == "declined"
    elif leaves == "withdrawing":
        assert page(store, entered.token, "withdraw").stage == "declined"
    after = stored(store, database)
    store.close()
    closed = b"".join(path.read_bytes() for path in database.glob("*.sqlite*"))
    assert len(before) > 4096
    for found in (before, after, closed):
        for word in (*TELLING, entered.state.reference.encode()):
            assert word not in found


def test_who_agrees_is_stored_with_id_browser_and_screen(store: Store, database: Path) -> None:
    entered = run(store.enter(come("Ada")))
    first = page(store, entered.token, "consent")
    assert (first.stage, first.reference) == ("instructions", entered.state.reference)
    # The same page, sent once more since its response was lost, begins nothing else.
    assert page(store, entered.token, "consent") == first
    (session,) = rows(store, SESSIONS)
    assert session.device == DEVICE.model_dump() and session.consented_at >= session.started_at
    assert [row.raw_id for row in rows(store, RAW_IDS)] == ["Ada"]
    walk(store, entered.token, "done")


def test_who_declined_may_open_the_link_again(store: Store) -> None:
    first = run(store.enter(come("Ada")))
    page(store, first.token, "consent", agreed=False)
    assert run(store.state(first.token)).stage == "declined"
    assert page(store, first.token, "withdraw").stage == "declined"
    assert refusal(store.page(first.token, AGREED)).code == "wrong_stage"
    walk(store, run(store.enter(come("Ada"))).token, "done")
    assert len(rows(store, SESSIONS)) == 1


def test_a_study_that_was_paused_meanwhile_takes_in_nobody(store: Store) -> None:
    token = enter(store, "Ada")
    run(store.write(lambda connection: set_paused(connection, True, 1.0)))
    assert refusal(store.page(token, AGREED)).code == "paused"
    run(store.write(lambda connection: set_paused(connection, False, 2.0)))
    assert page(store, token, "consent").stage == "instructions"


def test_the_memory_of_visitors_is_bounded(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("physion.experiment.store.store.MAX_VISITS", 3)
    tokens = [enter(store, f"person {number}") for number in range(4)]
    assert refusal(store.state(tokens[0])).code == "unknown_token"
    assert [run(store.state(token)).stage for token in tokens[1:]] == ["consent"] * 3


def test_each_way_to_end_has_its_own_code(
    small_study: Study, small_secrets: Secrets, database: Path
) -> None:
    store = open_store(replace(small_study, participants=1, **ENDS), small_secrets, database)
    site = "https://app.prolific.com/submissions/complete?cc="
    declined = enter(store, "a", source="prolific", scenario="drop")
    page(store, declined, "consent", agreed=False)
    stopped = walk(store, begin(store, "b", scenario="drop"), "familiarization")
    assert code_of(lambda: store.ending(stopped)) == "wrong_stage"
    page(store, stopped, "withdraw")
    assert store.ending(declined) == SessionEnd(
        completion=Completion(code="NOCONSENT", url=site + "NOCONSENT")
    )
    assert store.ending(stopped) == SessionEnd(
        completion=Completion(code=None, url="https://lab.example/stopped")
    )
    late = enter(store, "d", source="prolific", scenario="drop")
    walk(store, begin(store, "c", scenario="drop"), "done")
    for ask in (store.enter(come("e")), store.page(late, AGREED)):
        full = refusal(ask)
        assert full.code == "study_full"
        assert full.completion == Completion(code="FULL", url=site + "FULL")
    store.close()


# --- entering -------------------------------------------------------------------------------------


def test_a_whole_session(store: Store, small_study: Study) -> None:
    token = enter(store, "Ada", source="prolific", scenario="drop")
    seen = []
    for stage in STAGES:
        walk(store, token, stage)
        state = run(store.state(token))
        seen.append((state.stage, state.trial))
    in_phase = {"familiarization", "test"}
    assert seen == [(stage, 0 if stage in in_phase else None) for stage in STAGES]
    result = store.result(token)
    # Half of the four test trials end with contact; the walk answers "yes" to all.
    assert (result.correct, result.trials, result.accuracy, result.percentile) == (2, 4, 0.5, None)
    (session,) = rows(store, SESSIONS)
    assert (session.age, session.gender, session.education) == (31, "woman", "master")
    assert (session.difficulty, session.technical_problems, session.feedback) == (2, False, "fine")
    assert session.consent_version == small_study.consent_version
    assert session.started_at < session.consented_at < session.instructed_at < session.ready_at
    assert session.ready_at < session.demographics_at < session.finished_at == session.last_seen
    assert session.kind == "person" and session.study == small_study.digest


def test_ids_are_stored_apart_from_the_data(store: Store, small_secrets: Secrets) -> None:
    recruiter = {"STUDY_ID": "s1", "SESSION_ID": "v1"}
    begin(store, "Ada Smith", source="prolific", recruiter=recruiter)
    begin(store, "Ada Smith", source="prolific", recruiter={"STUDY_ID": "s2"})
    hashed = participant_hash(small_secrets, "prolific", "Ada Smith")
    (raw,) = rows(store, RAW_IDS)
    assert (raw.participant, raw.source, raw.raw_id) == (hashed, "prolific", "Ada Smith")
    assert raw.recruiter == {"STUDY_ID": "s2"}
    assert [row.participant for row in rows(store, PARTICIPANTS)] == [hashed]
    for table in (SESSIONS, TOKENS, EVENTS, PARTICIPANTS, STUDIES):
        assert "Smith" not in repr(rows(store, table))


def test_tokens_are_stored_as_hashes_and_both_open_the_session(store: Store) -> None:
    one, two = begin(store, "Ada"), begin(store, "Ada")
    assert one != two and len(rows(store, SESSIONS)) == 1
    assert one not in repr(rows(store, TOKENS))
    walk(store, one, "test")
    assert run(store.state(two)).stage == "test"


def test_finished_and_withdrawn_people_may_not_begin_again(store: Store) -> None:
    walk(store, begin(store, "Ada", scenario="drop"), "done")
    assert refusal(store.enter(request("Ada", scenario="drop"))).code == "already_took_part"
    token = walk(store, begin(store, "Bob", scenario="drop"), "test")
    page(store, token, "withdraw")
    assert run(store.enter(request("Bob", scenario="drop"))).state.stage == "withdrawn"
    for person in ("Ada", "Bob"):
        # They may still take part in the other scenario, requested or not.
        assert run(store.state(begin(store, person))).scenario == "collide"
    walk(store, enter(store, "Ada"), "done")
    assert refusal(store.enter(request("Ada"))).code == "already_took_part"
    assert len(rows(store, SESSIONS)) == 4


def test_an_unfinished_session_continues_before_another_begins(store: Store) -> None:
    walk(store, enter(store, "Ada", scenario="drop"), "test")
    state = run(store.enter(request("Ada"))).state
    assert (state.scenario, state.stage) == ("drop", "test")
    other = run(store.enter(request("Ada", scenario="collide"))).state
    assert (other.stage, other.buttons) == ("consent", state.buttons)


def test_the_scenario_with_fewest_sessions_comes_first_until_the_study_is_full(
    store: Store,
) -> None:
    # participants=3: one of drop has finished, one of collide withdrew, one left a while ago.
    walk(store, enter(store, "done", scenario="drop"), "done")
    page(store, begin(store, "gone", scenario="collide"), "withdraw")
    begin(store, "asleep", scenario="collide")
    own = SESSIONS.c.participant == participant_hash(store.secrets, "link", "asleep")
    names = ("last_seen", "progressed_at")
    earlier = {name: SESSIONS.c[name] - (ACTIVE_WITHIN + 1) for name in names}
    with store.engine.begin() as connection:
        connection.execute(update(SESSIONS).where(own).values(earlier))
    tokens = [enter(store, f"p{i}") for i in range(5)]
    given = [run(store.state(token)).scenario for token in tokens]
    assert given == ["collide", "collide", "drop", "collide", "drop"]
    # A session that has not come through the practice does not count as a participant.
    early = begin(store, "early", scenario="drop")
    for token in tokens:
        walk(store, token, "test")
    for scenario in (None, "drop"):
        held = refusal(store.enter(request("late", scenario=scenario)))
        assert (held.code, held.completion) == ("held", None)
        assert "come back in 15 minutes" in str(held)
    # A person who has begun may finish, even if the scenario is full by then.
    assert run(store.enter(request("asleep"))).state.scenario == "collide"
    assert run(store.enter(request("early"))).state.stage == "instructions"
    for token in (early, *tokens, enter(store, "asleep")):
        walk(store, token, "done")
    assert refusal(store.enter(request("late"))).code == "study_full"
    finished = Counter(row.scenario for row in rows(store, SESSIONS) if row.finished_at)
    assert finished == {"drop": 4, "collide": 4}


def test_previews_and_simulations_do_not_count_as_participants(
    store: Store, small_secrets: Secrets
) -> None:
    for kind in ("preview", "simulated"):
        word = make_pass(small_secrets, kind)
        for number in range(4):
            token = begin(store, f"p{number}", scenario="drop", **{"pass": word})
            assert run(store.state(token)).kind == kind
    people = [begin(store, f"p{i}", scenario="drop") for i in range(3)]
    assert [run(store.state(token)).kind for token in people] == ["person"] * 3
    kinds = Counter(row.kind for row in rows(store, SESSIONS))
    assert kinds == {"preview": 4, "simulated": 4, "person": 3}
    assert len(rows(store, RAW_IDS)) == 3


@pytest.mark.parametrize(
    "value",
    [
        "{{%PROLIFIC_PID%}}", "%7B%7B%25PROLIFIC_PID%25%7D%7D", "{{%25PROLIFIC_PID%25}}",
        "%SURVEY_CODE%", "%25SURVEY_CODE%25", "%2525SURVEY_CODE%2525", " {{id}} ", "${workerId}",
    ],
)  # fmt: skip
def test_unfilled_placeholders_are_not_ids(store: Store, value: str) -> None:
    for asked in (
        Enter(source="prolific", id=value),
        Enter(source="prolific", id="5f1e", recruiter={"SESSION_ID": value}),
    ):
        refused = refusal(store.enter(asked))
        assert refused.code == "bad_link" and "did not fill in your id" in refused.message
    assert rows(store, SESSIONS) == []
    for name in ("100%", "%41da", "{0}", "a%20b"):
        begin(store, name, source="sona")
    assert len(rows(store, SESSIONS)) == 4


def test_a_visit_key_gives_the_same_session_again(
    store: Store, small_study: Study, small_secrets: Secrets, tmp_path: Path
) -> None:
    tokens = [begin(store, visit=VISIT_KEY) for _ in range(3)]
    assert len(set(tokens)) == 3
    assert len(rows(store, SESSIONS)) == 1
    walk(store, tokens[0], "test")
    assert {run(store.state(token)).stage for token in tokens} == {"test"}
    # Another key, an additional id and another source are different people.
    simulated = {"pass": make_pass(small_secrets, "simulated")}
    preview = {"pass": make_pass(small_secrets, "preview")}
    for _ in range(2):
        begin(store, visit=VISIT_KEY[:-1])
        begin(store, "Ada", visit=VISIT_KEY)
        begin(store, visit=VISIT_KEY, **simulated)
        begin(store, visit=VISIT_KEY, **preview)
    begin(store, VISIT_KEY)
    found = rows(store, SESSIONS)
    assert len(found) == 6 == len({row.participant for row in found})
    # The key is not stored and is not an id.
    assert {row.raw_id for row in rows(store, RAW_IDS)} == {"Ada", VISIT_KEY}
    for table in (SESSIONS, TOKENS, EVENTS, PARTICIPANTS):
        assert VISIT_KEY not in repr(rows(store, table))
    assert refusal(store.enter(Enter(source="sona", visit=VISIT_KEY))).code == "id_needed"
    # Without either, each request is another person, unless the study needs an id.
    begin(store)
    begin(store)
    assert len(rows(store, SESSIONS)) == 8
    needed = replace(small_study, recruitment=Recruitment(id_needed=True))
    strict = open_store(needed, small_secrets, tmp_path / "strict")
    assert refusal(strict.enter(Enter(visit=VISIT_KEY))).code == "id_needed"
    assert run(strict.enter(Enter.model_validate(preview))).state.kind == "preview"
    strict.close()


def test_a_removed_language_locks_nobody_out(
    small_study: Study, small_secrets: Secrets, database: Path
) -> None:
    store = open_store(small_study, small_secrets, database)
    token = walk(store, enter(store, "Ada", language="de", scenario="drop"), "test")
    store.close()
    store = open_store(replace(small_study, languages=("en",)), small_secrets, database)
    states = [
        run(store.state(token)),
        run(store.state(token, True)),
        give(store, token, 0).state,
        page(store, token, "ready"),
        run(store.enter(request("Ada"))).state,
        refusal(store.answer(token, answer(3))).state,
    ]
    assert [state.language for state in states if state is not None] == ["en"] * 6
    (session,) = rows(store, SESSIONS)
    assert session.language == "de"  # the language in which it began is kept
    store.close()


@pytest.mark.parametrize(
    ("wanted", "given"),
    [("de", "de"), ("de-AT", "de"), ("DE", "de"), ("", "en"), ("fr", "en"), ("en_US", "en")],
)
def test_languages(store: Store, wanted: str, given: str) -> None:
    assert run(store.enter(Enter(language=wanted))).state.language == given


def test_prepared_orders_are_used_evenly(
    small_study: Study, small_secrets: Secrets, database: Path
) -> None:
    study = replace(small_study, orders=3, participants=100)
    store = open_store(study, small_secrets, database)
    for number in range(6):
        begin(store, f"p{number}", scenario="drop")
    begin(store, "other", scenario="collide")
    page(store, begin(store, "p1", scenario="drop"), "withdraw")
    begin(store, "p6", scenario="drop")
    found = {row.participant: row for row in rows(store, SESSIONS)}
    people = [participant_hash(small_secrets, "link", f"p{number}") for number in range(7)]
    # The order of a withdrawn session is available again.
    assert [found[person].order_number for person in people] == [1, 2, 3, 1, 2, 3, 2]
    seeds = {(row.scenario, row.order_number, row.order_seed) for row in found.values()}
    assert len(seeds) == 4
    store.close()


def test_concurrent_visitors_get_one_session_each(store: Store) -> None:
    async def all_at_once() -> list[Any]:
        visits = [request(f"p{number % 3}", scenario="drop") for number in range(30)]
        entered = await asyncio.gather(*(store.enter(visit) for visit in visits))
        states = await asyncio.gather(*(store.page(each.token, AGREED) for each in entered))
        assert [each.state.reference for each in entered] == [one.reference for one in states]
        return entered

    entered = run(all_at_once())
    assert len({each.token for each in entered}) == 30
    assert len(rows(store, SESSIONS)) == 3 and len(rows(store, TOKENS)) == 30
    assert len({each.state.reference for each in entered}) == 3


def test_pages_are_accepted_in_order_and_stored_once(store: Store) -> None:
    token = enter(store, "Ada")
    for stage in STAGES[:-1]:
        walk(store, token, stage)
        assert stage == "consent" or code_of(lambda: store.result(token)) == "not_yet"
        late = [name for name in PAGES if STAGES.index(name) > STAGES.index(stage)]
        for name in late:
            refused = refusal(store.page(token, PageDone(page=name, data=PAGES[name])))
            assert refused.code == "wrong_stage"
            assert refused.state is not None and refused.state.stage == stage
        before = rows(store, SESSIONS)
        for name in PAGES:
            if name not in late and name != stage:
                assert page(store, token, name).stage == stage
        assert rows(store, SESSIONS) == before
    walk(store, token, "done")
    page(store, token, "feedback", difficulty=5, technical_problems=True, text="other")
    assert refusal(store.page(token, PageDone(page="withdraw"))).code == "wrong_stage"
    (session,) = rows(store, SESSIONS)
    assert (session.difficulty, session.feedback) == (2, "fine")


@pytest.mark.parametrize(
    ("stage", "how"), [("instructions", "withdraw"), ("test", "consent"), ("feedback", "withdraw")]
)
def test_a_withdrawn_session_stays_withdrawn(store: Store, stage: str, how: str) -> None:
    token = walk(store, enter(store, "Ada"), stage)
    data = {} if how == "withdraw" else {"agreed": False}
    for _ in range(2):
        assert page(store, token, how, **data).stage == "withdrawn"
    before = (rows(store, SESSIONS), rows(store))
    event = Events(events=[Event(kind="hidden", at_ms=1)])
    for asked in (
        *(store.page(token, PageDone(page=name, data=PAGES[name])) for name in PAGES),
        store.answer(token, answer(9)),
        store.events(token, event),
    ):
        refused = refusal(asked)
        assert refused.code == "wrong_stage"
        assert refused.state is not None and refused.state.stage == "withdrawn"
    for ask in (lambda: store.trials(token, "test"), lambda: store.result(token)):
        assert code_of(ask) == "wrong_stage"
    assert run(store.state(token, True)).stage == "withdrawn"
    assert (rows(store, SESSIONS), rows(store)) == before


BAD_PAGES: list[tuple[str, dict[str, Any], str]] = [
    ("consent", {}, "agreed: Field required"),
    ("consent", {"agreed": 1}, "agreed: Input should be a valid boolean"),
    ("instructions", {"a'b\n": 1}, "Extra inputs are not permitted"),
    *(("demographics", {"age": age, "gender": None, "education": None}, "age: Input should be")
      for age in (17, 131, -1, 20.5, "30", True, 1e300)),
    ("demographics", {"age": 30, "gender": "x" * 201, "education": None}, "gender: String should"),
    ("demographics", {"age": 30, "gender": None, "education": 5}, "education: Input should be"),
    ("demographics", {"age": 30, "gender": None}, "education: Field required"),
    ("demographics", {"age": 30, "gender": None, "education": None, "kind": "preview"}, "kind: "),
    *(("feedback", {"difficulty": value, "technical_problems": False, "text": ""}, "difficulty: ")
      for value in (0, 6, None, 2.5, "2", True)),
    ("feedback", {"difficulty": 2, "technical_problems": None, "text": ""}, "technical_problems: "),
    ("feedback", {"difficulty": 2, "technical_problems": False, "text": None}, "text: Input"),
    ("feedback", {"difficulty": 2, "technical_problems": False}, "text: Field required"),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("name", "data", "said"), BAD_PAGES)
def test_bad_pages_name_the_field(store: Store, name: Any, data: dict[str, Any], said: str) -> None:
    token = walk(store, enter(store), name)
    refused = refusal(store.page(token, PageDone(page=name, data=data)))
    assert refused.code == "bad_request" and said in refused.message
    assert run(store.state(token)).stage == name


def test_all_demographics_are_optional(store: Store) -> None:
    token = walk(store, enter(store), "demographics")
    page(store, token, "demographics", age=None, gender=None, education=" ")
    page(store, token, "feedback", difficulty=5, technical_problems=True, text="")
    (session,) = rows(store, SESSIONS)
    assert (session.age, session.gender, session.education) == (None, None, None)
    assert (session.difficulty, session.technical_problems) == (5, True)


def test_trials_come_after_the_consent_in_the_sessions_order(store: Store) -> None:
    token = enter(store, "Ada", scenario="drop")
    assert code_of(lambda: store.trials(token, "familiarization")) == "not_yet"
    walk(store, token, "instructions")
    listed = store.trials(token, "test")
    assert [each.trial for each in listed.trials] == [0, 1, 2, 3]
    assert all(each.frames == 45 and 500 <= each.fixation_ms <= 1500 for each in listed.trials)
    assert listed == store.trials(token, "test")
    walk(store, token, "demographics")
    answered = [row.stimulus for row in rows(store) if row.phase == "test"]
    movies = {s.stimulus: store.study.folder / s.movie for s in store.study.phase("drop", "test")}
    listed_movies = [
        read_media_path(store.study, store.secrets, each.movie) for each in listed.trials
    ]
    assert listed_movies == [movies[stimulus] for stimulus in answered]


def test_percentiles_are_among_finished_people_of_the_scenario(
    small_study: Study, small_secrets: Secrets, database: Path
) -> None:
    store = open_store(replace(small_study, participants=9), small_secrets, database)

    def finish(person: str, right: int, scenario: str = "drop", **more: Any) -> str:
        token = walk(store, enter(store, person, scenario=scenario, **more), "test")
        participant = participant_hash(small_secrets, "simulated link" if more else "link", person)
        seed = individual_order_seed(store.study, scenario, participant)
        for trial, stimulus in enumerate(trial_order(store.study, scenario, seed)["test"]):
            yes = stimulus.label if trial < right else not stimulus.label
            give(store, token, trial, response="yes" if yes else "no")
        return walk(store, token, "done")

    first = finish("a", 1)
    assert store.result(first).percentile is None  # percentile_from=2
    finish("s", 4, **{"pass": make_pass(small_secrets, "simulated")})
    finish("other", 4, "collide")
    walk(store, enter(store, "unfinished", scenario="drop"), "feedback")
    assert store.result(first).percentile is None
    second = finish("b", 3)
    assert store.result(first).percentile is store.result(second).percentile is None  # one other
    third = finish("c", 3)
    best = finish("d", 4)
    found = [store.result(token) for token in (first, second, third, best)]
    assert [each.correct for each in found] == [1, 3, 3, 4]
    # Among three others: none has fewer; one has fewer and one equally many; all have fewer.
    assert [each.percentile for each in found] == pytest.approx([0, 50, 50, 100])
    assert percentile(2, [1, 2, 3, 3]) == 37.5
    store.close()


def test_previews_of_other_stimuli_are_in_no_result(
    small_study: Study, small_secrets: Secrets, database: Path
) -> None:
    word = {"pass": make_pass(small_secrets, "preview"), "scenario": "drop"}
    store = open_store(small_study, small_secrets, database)
    old = [walk(store, enter(store, f"old{number}", **word), "done") for number in range(3)]
    assert store.result(old[0]).percentile == 50
    store.close()
    gone = small_study.phase("drop", "test")[1]
    stimuli = tuple(
        replace(each, stimulus="drop_other_name") if each is gone else each
        for each in small_study.stimuli
    )
    changed = replace(small_study, stimuli=stimuli, stimuli_digest="0" * 64, digest="1" * 64)
    store = open_store(changed, small_secrets, database)
    new = walk(store, enter(store, "new", **word), "done")
    result = store.result(new)
    assert (result.correct, result.trials, result.percentile) == (2, 4, None)
    for token in old:
        assert run(store.state(token)).stage == "done"
        with pytest.raises(Refused, match="stimuli have changed") as caught:
            store.result(token)
        assert caught.value.code == "unknown_token"
    store.close()


def test_page_loads_are_counted_with_their_trial(store: Store) -> None:
    token = begin(store, "Ada")
    run(store.state(token, True))
    (session,) = rows(store, SESSIONS)
    assert (session.loads, session.loaded_at_phase) == (1, None)
    walk(store, token, "test")
    give(store, token, 0)
    run(store.state(token))
    run(store.state(token, True))
    (session,) = rows(store, SESSIONS)
    assert (session.loads, session.loaded_at_phase, session.loaded_at_trial) == (2, "test", 1)
    give(store, token, 1)
    give(store, token, 2)
    begin(store, "Ada")  # another browser
    give(store, token, 3)
    assert [row.resumed for row in rows(store) if row.phase == "test"] == [
        False, True, False, True,
    ]  # fmt: skip
    (event,) = rows(store, EVENTS)
    assert event.kind == "entered_again"


def test_events_are_kept_up_to_a_limit(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("physion.experiment.store.store.MAX_EVENTS", 7)
    token = begin(store)
    some = Events(events=[Event(kind="hidden", at_ms=number) for number in range(5)])
    assert [run(store.events(token, some)).stored for _ in range(3)] == [5, 2, 0]
    assert [row.at_ms for row in rows(store, EVENTS)] == [0, 1, 2, 3, 4, 0, 1]


def test_a_batch_of_events_is_stored_once(store: Store) -> None:
    token, other = begin(store, "Ada"), begin(store, "Bob")
    some = [Event(kind="hidden", at_ms=number) for number in range(3)]

    def send(token: str, key: str | None) -> int:
        return run(store.events(token, Events(key=key, events=some))).stored

    assert [send(token, "batch-01") for _ in range(3)] == [3, 0, 0]
    assert [send(token, "batch-02"), send(other, "batch-01")] == [3, 3]
    assert [send(token, None) for _ in range(2)] == [3, 3]
    assert len(rows(store, EVENTS)) == 15
    assert {row.batch for row in rows(store, EVENTS)} == {"batch-01", "batch-02", None}


@pytest.mark.parametrize(
    ("value", "said"), [(10**5000, "plain JSON"), ("é" * 4000, "at most")], ids=["number", "text"]
)
def test_events_too_large_are_refused(store: Store, value: Any, said: str) -> None:
    token = begin(store)
    events = Events(events=[Event(kind="error", at_ms=0, data={"a": value})])
    refused = refusal(store.events(token, events))
    assert refused.code == "bad_request" and said in refused.message
    assert rows(store, EVENTS) == []


def test_one_store_at_a_time_keeps_everything_for_the_next(
    small_study: Study, small_secrets: Secrets, database: Path
) -> None:
    store = open_store(small_study, small_secrets, database)
    token = walk(store, enter(store, "Ada"), "test")
    give(store, token, 0)
    listed = store.trials(token, "test")
    with pytest.raises(PhysionError, match="another"):
        open_store(small_study, small_secrets, database)
    assert store.healthy()
    store.close()
    again = open_store(small_study, small_secrets, database)
    assert refusal(store.enter(Enter())).code == "unavailable"
    state = run(again.state(token))
    assert (state.stage, state.trial) == ("test", 1)
    assert again.trials(token, "test") == listed
    assert give(again, token, 0).duplicate
    assert len(rows(again, STUDIES)) == 1
    again.close()


def test_other_stimuli_are_refused_where_sessions_exist(
    small_study: Study, small_secrets: Secrets, database: Path
) -> None:
    other = replace(small_study, stimuli_digest="0" * 64, digest="1" * 64)
    store = open_store(small_study, small_secrets, database)
    preview = begin(store, **{"pass": make_pass(small_secrets, "preview")})
    store.close()
    store = open_store(other, small_secrets, database)  # previews are not data
    assert run(store.state(preview)).stage == "withdrawn"
    begin(store, "Ada")
    store.close()
    with pytest.raises(BadInputError, match=r"1 sessions.*new study folder"):
        open_store(small_study, small_secrets, database)
    # Texts and settings may change.
    store = open_store(replace(other, digest="2" * 64, participants=50), small_secrets, database)
    settings = [row.settings for row in rows(store, STUDIES)]
    assert [each["participants"] for each in settings] == [3, 3, 50]
    assert "label" not in repr(settings)
    store.close()


def test_a_scenario_with_sessions_cannot_be_removed(
    small_study: Study, small_secrets: Secrets, database: Path
) -> None:
    def reopen(study: Study) -> Store:
        return open_store(study, small_secrets, database)

    fewer = replace(
        small_study,
        scenarios=("collide",),
        stimuli=tuple(s for s in small_study.stimuli if s.scenario == "collide"),
        digest="3" * 64,
    )
    preview = {"pass": make_pass(small_secrets, "preview"), "scenario": "drop"}
    store = reopen(small_study)
    going = walk(store, enter(store, "P1", **preview), "test")
    done = walk(store, enter(store, "P2", **preview), "done")
    store.close()
    store = reopen(fewer)  # previews are not data, and are ended
    for token in (going, done):
        for asked in (store.state(token), store.state(token, True), store.answer(token, answer(0))):
            assert refusal(asked).code == "unknown_token"
        with pytest.raises(Refused, match="no longer"):
            store.result(token)
    marks = {(row.finished_at is None, row.withdrawn_at is None) for row in rows(store, SESSIONS)}
    assert marks == {(True, False), (False, True)}
    assert run(store.enter(Enter.model_validate(preview | {"id": "P1", "scenario": None})))
    store.close()
    store = reopen(small_study)
    token = walk(store, enter(store, "Ada", scenario="drop"), "test")
    give(store, token, 0)
    store.close()
    with pytest.raises(BadInputError, match=r"1 sessions are of the scenario drop.*put drop back"):
        reopen(fewer)
    store = reopen(small_study)
    assert run(store.state(token)).trial == 1
    # A simulated session is data, too; a scenario without sessions may be removed.
    store.close()
    with pytest.raises(BadInputError, match="scenario drop"):
        reopen(replace(fewer, digest="4" * 64))
    others = tuple(s for s in small_study.stimuli if s.scenario == "drop")
    store = reopen(replace(small_study, scenarios=("drop",), stimuli=others, digest="5" * 64))
    assert run(store.state(token)).trial == 1
    store.close()
