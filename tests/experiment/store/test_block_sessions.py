"""Sessions that run through several scenarios, one block each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from physion.core.errors import BadInputError
from physion.experiment.protocol import PageDone
from physion.experiment.store.database import SESSIONS
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media import read_media_path
from physion.experiment.study.orders import block_scenarios, order_number, trial_order
from physion.experiment.study.recruitment import links
from physion.experiment.study.settings import ALL_SCENARIOS, Blocks
from physion.experiment.study.study import Study, load_study, write_settings
from support.experiment.store_walk import (
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
from support.experiment.tiny_study import make_tiny_study

SEVERAL = Blocks(all_scenarios=True, trials=2)


@pytest.fixture(scope="module")
def blocks_study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """A study whose sessions have two blocks of 1 familiarization and 2 of 4 test trials."""
    folder = tmp_path_factory.mktemp("blocks") / "study"
    return make_tiny_study(
        folder, test=4, familiarization=1, scenarios=("collide", "drop"), size=32,
        participants=8, percentile_from=1, blocks=SEVERAL,
    )  # fmt: skip


@pytest.fixture
def blocks_store(blocks_study: Study, database: Path) -> Iterator[Store]:
    opened = open_store(blocks_study, Secrets.load(blocks_study.folder), database)
    yield opened
    opened.close()


def test_a_session_has_practice_and_test_of_each_block(blocks_store: Store) -> None:
    store = blocks_store
    token = enter(store, "ada")
    state = run(store.state(token))
    seen = [(state.stage, state.trial, state.block, state.scenario)]
    page(store, token, "consent")
    row = rows(store, SESSIONS)[0]
    assert row.scenario == ALL_SCENARIOS
    first, second = block_scenarios(store.study, ALL_SCENARIOS, row.order_seed)
    while (state := run(store.state(token))).stage != "done":
        seen.append((state.stage, state.trial, state.block, state.scenario))
        if state.trial is None:
            page(store, token, state.stage)
        else:
            give(store, token, state.trial, state.stage)
    assert seen == [
        ("consent", None, 0, first), ("instructions", None, 0, first),
        ("familiarization", 0, 0, first), ("ready", None, 0, first),
        ("test", 0, 0, first), ("test", 1, 0, first), ("block", None, 0, first),
        ("familiarization", 1, 1, second), ("ready", None, 1, second),
        ("test", 2, 1, second), ("test", 3, 1, second),
        ("demographics", None, 1, second), ("feedback", None, 1, second),
    ]  # fmt: skip
    assert state.trials == {"familiarization": 2, "test": 4}
    order = trial_order(store.study, ALL_SCENARIOS, row.order_seed)
    answers = {(answer.phase, answer.trial): answer.stimulus for answer in rows(store)}
    assert answers == {
        (phase, trial): stimulus.stimulus
        for phase in order for trial, stimulus in enumerate(order[phase])
    }  # fmt: skip
    result = store.result(token)
    assert (result.trials, result.correct) == (4, sum(s.label for s in order["test"]))


def test_the_media_of_all_blocks_match_the_order(blocks_store: Store) -> None:
    store = blocks_store
    token = walk(store, enter(store, "ada"), "familiarization")
    order = trial_order(store.study, ALL_SCENARIOS, rows(store, SESSIONS)[0].order_seed)
    for phase in ("familiarization", "test"):
        listed = store.trials(token, phase).trials  # type: ignore[arg-type]
        shown = [read_media_path(store.study, store.secrets, trial.movie) for trial in listed]
        assert shown == [store.study.folder / stimulus.movie for stimulus in order[phase]]


def test_answers_beyond_the_block_are_refused_until_the_page_between(blocks_store: Store) -> None:
    store = blocks_store
    token = walk(store, enter(store, "ada"), "block")
    early = refusal(store.answer(token, answer(2)))
    assert early.code == "wrong_stage" and early.state and early.state.stage == "block"
    assert page(store, token, "block", block=0).stage == "familiarization"
    # Sent again, a page of an earlier block changes nothing.
    assert page(store, token, "block", block=0).stage == "familiarization"
    give(store, token, 1, "familiarization")
    assert page(store, token, "ready", block=0).stage == "ready"
    assert page(store, token, "ready", block=1).stage == "test"
    again = refusal(store.page(token, PageDone(page="block", data={"block": 1})))
    assert again.code == "wrong_stage"


def test_orders_of_blocks_are_counterbalanced_and_given_back(blocks_store: Store) -> None:
    store = blocks_store

    def numbers() -> Counter[int]:
        counted = (r for r in rows(store, SESSIONS) if r.withdrawn_at is None)
        return Counter(order_number(store.study, r.order_seed) for r in counted)

    tokens = [begin(store, f"person {index}") for index in range(6)]
    assert sorted(numbers().values()) == [3, 3]
    kept = order_number(store.study, rows(store, SESSIONS)[0].order_seed)
    others = [
        token for token, row in zip(tokens, rows(store, SESSIONS), strict=True)
        if order_number(store.study, row.order_seed) != kept
    ]  # fmt: skip
    for token in others[:2]:
        page(store, walk(store, token, "instructions"), "withdraw")
    begin(store, "a new person")
    begin(store, "another one")
    assert sorted(numbers().values()) == [3, 3], "places of those who stopped are filled again"


def test_prepared_orders_take_the_orders_of_blocks_in_turn(
    blocks_study: Study, tmp_path: object
) -> None:
    study = replace(blocks_study, orders=4)
    store = open_store(study, Secrets.load(study.folder), tmp_path / "a")
    for index in range(8):
        begin(store, f"person {index}")
    found = [(r.order_number, order_number(study, r.order_seed)) for r in rows(store, SESSIONS)]
    store.close()
    assert found == [(1, 0), (2, 1), (3, 0), (4, 1)] * 2


def test_places_are_counted_by_session(blocks_study: Study, tmp_path: object) -> None:
    study = replace(blocks_study, participants=2)
    store = open_store(study, Secrets.load(study.folder), tmp_path / "a")
    for person in ("ada", "bob"):
        walk(store, enter(store, person), "done")
    assert refusal(store.enter(request("cleo"))).code == "study_full"
    assert refusal(store.enter(request("ada"))).code == "already_took_part"
    assert refusal(store.enter(request("dora", scenario="drop"))).code == "bad_link"
    store.close()


def test_links_name_no_scenario(blocks_study: Study) -> None:
    secrets = Secrets.load(blocks_study.folder)
    found = links(blocks_study, secrets, "https://lab.example.org")
    assert {link.scenario for link in found} == {ALL_SCENARIOS}
    assert not [link for link in found if "scenario=" in link.address]
    assert next(link.address for link in found if link.name == "link") == "https://lab.example.org/"


def test_a_study_with_sessions_keeps_its_blocks(blocks_study: Study, tmp_path: object) -> None:
    url = tmp_path / "a"
    secrets = Secrets.load(blocks_study.folder)
    store = open_store(blocks_study, secrets, url)
    begin(store, "ada")
    store.close()
    try:
        write_settings(replace(blocks_study, blocks=replace(SEVERAL, trials=3)))
        with pytest.raises(BadInputError, match="other blocks"):
            open_store(load_study(blocks_study.folder), secrets, url)
    finally:
        write_settings(blocks_study)


def test_only_the_first_block_may_have_practice(blocks_study: Study, tmp_path: object) -> None:
    study = replace(blocks_study, blocks=replace(SEVERAL, familiarization="first"))
    store = open_store(study, Secrets.load(study.folder), tmp_path / "a")
    token = walk(store, enter(store, "ada"), "block")
    state = page(store, token, "block", block=0)
    assert (state.stage, state.trial, state.block) == ("test", 2, 1)
    assert run(store.state(walk(store, token, "done"))).trials == {"familiarization": 1, "test": 4}
    store.close()
