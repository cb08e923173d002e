"""Export of sessions that run through several scenarios, and its analysis."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")


from physion.analysis.check import check_responses
from physion.analysis.people.exclusions import flag_sessions, read_expected
from physion.analysis.people.results import read_any_responses
from physion.experiment.experimenter.progress import StudyProgress
from physion.experiment.export.export_study import export_study
from physion.experiment.store.database import SESSIONS
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.orders import block_scenarios
from physion.experiment.study.settings import ALL_SCENARIOS, Attention, Blocks
from support.experiment.store_walk import enter, rows, run, walk
from support.experiment.tiny_study import make_tiny_study


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Store]:
    """The export of four finished sessions and one that ended after its first block."""
    folder = tmp_path_factory.mktemp("several")
    study = make_tiny_study(
        folder / "study", test=4, familiarization=1, scenarios=("collide", "drop"), size=32,
        blocks=Blocks(all_scenarios=True, trials=2),
    )  # fmt: skip
    store = Store.open(study, Secrets.load(study.folder))
    for person in range(4):
        walk(store, enter(store, f"person {person}"), "done")
    walk(store, enter(store, "leaves"), "block")
    export_study(store.engine, study, folder / "out")
    yield folder / "out", store
    store.close()


@pytest.mark.slow
def test_every_row_has_block_and_scenario(exported: tuple[Path, Store]) -> None:
    out, store = exported
    trials = pd.read_csv(out / "trials.csv")
    sessions = pd.read_csv(out / "sessions.csv").set_index("session")
    for row in rows(store, SESSIONS):
        order = block_scenarios(store.study, ALL_SCENARIOS, row.order_seed)
        assert sessions.loc[row.session, "scenario"] == " ".join(order)
        own = trials[trials["session"] == row.session]
        shown = list(zip(own["block"], own["scenario"], own["phase"], own["trial"], strict=True))
        wanted = [
            (0, order[0], "familiarization", 0), (0, order[0], "test", 0), (0, order[0], "test", 1),
            (1, order[1], "familiarization", 1), (1, order[1], "test", 2), (1, order[1], "test", 3),
        ]  # fmt: skip
        assert shown == (wanted if row.finished_at else wanted[:3])
    assert (trials["stimulus"].str.split("_").str[0] == trials["scenario"]).all()
    assert "one block each" in (out / "README.md").read_text()


def test_completeness_and_flags_are_judged_by_the_trials_of_each_session(
    exported: tuple[Path, Store],
) -> None:
    out, store = exported
    expected = read_expected(out / "expected.csv")
    assert {len(names) for names in expected.values()} == {4} and len(expected) == 5
    checked, responses = check_responses(
        [out / "trials.csv"], out / "sessions.csv", expected=expected
    )
    assert checked.errors == 0 and responses is not None
    flags = flag_sessions(responses, expected=expected).set_index("session")
    unfinished = [row.session for row in rows(store, SESSIONS) if row.finished_at is None]
    assert list(flags.index[flags["incomplete"]]) == unfinished
    shown = StudyProgress(store.study, store.engine).flags("person")
    assert not shown.problem
    found = [name for name, rules in shown.by_session.items() if "incomplete" in rules]
    assert found == unfinished


def test_the_progress_counts_sessions_of_several_blocks(exported: tuple[Path, Store]) -> None:
    _, store = exported
    progress = StudyProgress(store.study, store.engine)
    lines, _ = progress.sessions("person")
    ((row,), by_condition) = progress.rows(lines)
    assert (row.name, row.counted, row.accuracy, by_condition) == (ALL_SCENARIOS, 4, 0.5, [])
    assert {line.stage for line in lines} == {"Finished", "Page between blocks, block 1"}


def test_attention_checks_are_not_expected(tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path / "study", test=2, familiarization=1, scenarios=("collide", "drop"), size=32,
        blocks=Blocks(all_scenarios=True), attention=Attention(instructed=1),
    )  # fmt: skip
    store = Store.open(study, Secrets.load(study.folder))
    token = walk(store, enter(store, "ada"), "done")
    assert run(store.state(token)).trials["test"] > 4
    export_study(store.engine, study, tmp_path / "out")
    store.close()
    expected = read_expected(tmp_path / "out" / "expected.csv")
    assert [len(names) for names in expected.values()] == [4]
    responses = read_any_responses([tmp_path / "out/trials.csv"], tmp_path / "out/sessions.csv")
    assert not flag_sessions(responses, expected=expected)["incomplete"].any()
