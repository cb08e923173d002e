"""Between-subject conditions: places, links, settings, export and analysis."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from sqlalchemy import update

from physion.analysis.people.effects import accuracy_by_background
from physion.analysis.people.measures import accuracy_by_condition
from physion.analysis.people.responses import keep_where
from physion.analysis.people.results import read_any_responses
from physion.cli.main import main
from physion.core.errors import BadInputError, UnknownNameError
from physion.experiment.experimenter.progress import StudyProgress
from physion.experiment.export.export_study import export_study
from physion.experiment.protocol import Enter
from physion.experiment.store.database import SESSIONS
from physion.experiment.store.lab import set_voided
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media import read_media_path
from physion.experiment.study.recruitment import links, make_pass
from physion.experiment.study.settings import Condition, Timing
from physion.experiment.study.study import Study, load_study, write_settings
from physion.experiment.study.texts import TEXTS_FOLDER
from support.experiment.store_walk import (
    begin,
    enter,
    give,
    open_store,
    opened,
    page,
    refusal,
    request,
    rows,
    run,
    walk,
)
from support.experiment.tiny_study import make_tiny_study

PLAIN = Condition("plain")
BRIEF = Condition("brief", cue_ms=100, flash_hz=1.0, break_every=2, familiarization_feedback=False)
OTHER = Condition("other", scenarios=("drop",))
OWN_TEXTS = """
[condition.brief.instructions]
answer = "{practice} and {trials} movies."
[condition.brief.ready]
text = "{trials} movies follow."
[condition.brief.trial]
prompt = "Do they meet?"
"""


@pytest.fixture(scope="module")
def groups(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """A study with two scenarios, of 1 familiarization and 2 test trials, and three conditions."""
    folder = tmp_path_factory.mktemp("groups") / "study"
    study = make_tiny_study(
        folder, test=2, familiarization=1, scenarios=("collide", "drop"), size=32,
        languages=("en",), percentile_from=1, timing=Timing(cue_ms=700),
    )  # fmt: skip
    with (folder / TEXTS_FOLDER / "en.toml").open("a") as texts:
        texts.write(OWN_TEXTS)
    write_settings(replace(study, conditions=(PLAIN, BRIEF, OTHER)))
    return load_study(folder)


@pytest.fixture
def groups_store(groups: Study, database: Path) -> Iterator[Store]:
    yield from opened(groups, database)


def conditions_of(store: Store) -> Counter[str]:
    kept = (r for r in rows(store, SESSIONS) if r.withdrawn_at is None and r.voided_at is None)
    return Counter(row.condition for row in kept)


def test_conditions_are_filled_equally_and_places_are_given_back(groups_store: Store) -> None:
    store = groups_store
    tokens = [begin(store, f"person {index}") for index in range(9)]
    assert conditions_of(store) == {"plain": 3, "brief": 3, "other": 3}
    by_condition: dict[str, list[tuple[str, str]]] = {}
    for token, row in zip(tokens, rows(store, SESSIONS), strict=True):
        by_condition.setdefault(row.condition, []).append((token, row.session))
    for token, _ in by_condition["brief"][:2]:
        page(store, walk(store, token, "instructions"), "withdraw")
    run(store.write(lambda c: set_voided(c, by_condition["other"][0][1], True, 1.0)))
    for index in range(3):
        begin(store, f"new {index}")
    assert conditions_of(store) == {"plain": 3, "brief": 3, "other": 3}
    left = by_condition["plain"][0][1]
    gone = update(SESSIONS).where(SESSIONS.c.session == left).values(last_seen=1.0)
    run(store.write(lambda c: c.execute(gone)))
    begin(store, "last")
    assert conditions_of(store)["plain"] == 4, "nobody continues the session that was left"


def test_a_person_keeps_the_condition_in_further_sessions(groups: Study, tmp_path: Path) -> None:
    study = replace(groups, conditions=(PLAIN, BRIEF))
    store = open_store(study, Secrets.load(study.folder), tmp_path / "a")
    for person in ("ada", "bob", "cleo"):
        for _ in range(2):
            walk(store, enter(store, person), "done")
    found = rows(store, SESSIONS)
    assert len(found) == 6
    for person in {row.participant for row in found}:
        assert len({row.condition for row in found if row.participant == person}) == 1
    store.close()


def link_to(store: Store, condition: str, kind: str = "study", **more: Any) -> Enter:
    signed = ("link",) if kind == "study" else ()
    key = make_pass(store.secrets, kind, *signed, "condition", condition)
    return request(more.pop("person", "ada"), condition=condition, **{"pass": key}, **more)


def test_a_signed_link_fixes_the_condition(
    groups_store: Store, groups: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    store = groups_store
    for index in range(3):
        token = run(store.enter(link_to(store, "brief", person=f"person {index}"))).token
        page(store, token, "consent")
    assert conditions_of(store) == {"brief": 3}
    unsigned = request("eve", condition="plain")
    assert refusal(store.enter(unsigned)).code == "bad_link"
    for_brief = make_pass(store.secrets, "study", "link", "condition", "brief")
    other = request("eve", condition="plain", **{"pass": for_brief})
    assert refusal(store.enter(other)).code == "bad_link"
    without = request("eve", **{"pass": for_brief})
    assert refusal(store.enter(without)).code == "bad_link"
    assert refusal(store.enter(link_to(store, "absent", person="eve"))).code == "bad_link"
    wrong = link_to(store, "other", person="eve", scenario="collide")
    assert refusal(store.enter(wrong)).code == "bad_link"
    found = links(store.study, store.secrets, "https://lab.example.org")
    fixed = [link for link in found if link.condition == "other"]
    assert {link.scenario for link in fixed} == {"drop"}
    assert all("condition=other&pass=" in link.address for link in fixed)
    folder = str(groups.folder)
    assert main(["experiment", "links", folder, "--base-url", "https://lab.example.org"]) == 0
    assert "  prolific, condition other: " in capsys.readouterr().out


def test_a_session_has_the_settings_of_its_condition(
    groups_store: Store, groups: Study, database: Path
) -> None:
    store = groups_store
    token = run(store.enter(link_to(store, "brief", scenario="drop"))).token
    state = run(store.state(walk(store, token, "familiarization")))
    assert state.condition == "brief"
    assert state.settings.model_dump() == {
        "cue_ms": 100, "flash_hz": 1.0, "break_every": 2, "familiarization_feedback": False,
    }  # fmt: skip
    assert give(store, token, 0, "familiarization").feedback is None
    listed = store.trials(token, "test").trials
    found = {read_media_path(store.study, store.secrets, trial.movie) for trial in listed}
    assert found == {store.study.folder / s.movie for s in store.study.phase("drop", "test")}
    usual = run(store.enter(link_to(store, "plain", person="bob", scenario="drop"))).token
    state = run(store.state(walk(store, usual, "familiarization")))
    assert state.settings.cue_ms == 700
    assert give(store, usual, 0, "familiarization").feedback is not None
    # Percentiles are among people of the same condition.
    for one in (token, usual):
        assert store.result(walk(store, one, "done")).percentile is None
    token = run(store.enter(link_to(store, "plain", person="cleo", scenario="drop"))).token
    assert store.result(walk(store, token, "done")).percentile == 50.0
    store.close()
    with pytest.raises(BadInputError, match="condition brief"):
        open_store(replace(groups, conditions=(PLAIN, OTHER)), store.secrets, database)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ((PLAIN,), "at least two"),
        ((PLAIN, PLAIN), "two conditions are called plain"),
        ((PLAIN, Condition("b", scenarios=("roll",))), "the scenario roll, which is not in"),
        ((BRIEF, Condition("b", familiarization_feedback=False)), "lacks the text condition.b"),
    ],
)
def test_conditions_that_cannot_be_served_are_refused(
    groups: Study, changed: tuple[Condition, ...], said: str
) -> None:
    try:
        with pytest.raises(BadInputError, match=said):
            load_study(write_settings(replace(groups, conditions=changed)).parent)
    finally:
        write_settings(groups)


# --- export, overview and analysis ----------------------------------------------------------------


CONDITIONS = (Condition("slow"), Condition("brief", cue_ms=100))


def test_the_analysis_compares_and_chooses_conditions(tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path / "study", test=4, familiarization=1, size=32, conditions=CONDITIONS
    )
    store = Store.open(study, Secrets.load(study.folder))
    for person in range(6):
        walk(store, enter(store, f"person {person}"), "done")
    page(store, walk(store, enter(store, "stops"), "test"), "withdraw")
    out = export_study(store.engine, study, tmp_path / "out").out
    progress = StudyProgress(study, store.engine)
    _, found = progress.rows(progress.sessions("person")[0])
    counts = {row.name: (row.counted, row.states["finished"]) for row in found}
    assert counts == {"slow": (3, 3), "brief": (3, 3)}
    assert sum(row.states["withdrawn"] for row in found) == 1
    assert [row.accuracy for row in found] == [0.5, 0.5]
    of_session = {row.session: row.condition for row in rows(store, SESSIONS)}
    store.close()
    for name in ("trials", "sessions"):
        table = pd.read_csv(out / f"{name}.csv")
        assert list(table["condition"]) == [of_session[name] for name in table["session"]]
        assert set(table["condition"]) == {"slow", "brief"}
    responses = read_any_responses([out / "trials.csv"], out / "sessions.csv")
    by_condition = accuracy_by_condition(responses.test).set_index(["condition", "scenario"])
    assert by_condition.loc[("brief", "collide"), "people"] == 3
    tests = accuracy_by_background(responses.test, responses.sessions).set_index("question")
    assert tests.loc["condition", "sessions"] == 6
    brief = keep_where(responses, ["condition=brief"])
    assert len(brief.sessions) == 3 and set(brief.trials["condition"]) == {"brief"}
    assert brief.dropped.iloc[-1]["reason"] == "condition is not brief"
    both = keep_where(responses, ["condition=brief", "condition=slow", "language=en"])
    assert len(both.sessions) == 6
    alone = read_any_responses([out / "trials.csv"])
    assert len(keep_where(alone, ["condition=brief"]).sessions) == 3
    for of, words, said in (
        (responses, "condition=fast", "the values of condition are: brief, slow"),
        (responses, "conditoin=fast", "condition"),
        (responses, "brief", "a column and a value"),
        (alone, "language=en", "no column language"),
    ):
        with pytest.raises((BadInputError, UnknownNameError), match=said):
            keep_where(of, [words])
