"""Conditions in the export, the overview and the analysis."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.analysis.people.effects import accuracy_by_background, background
from physion.analysis.people.measures import accuracy_by_condition
from physion.analysis.people.responses import keep_where
from physion.analysis.people.results import read_any_responses
from physion.core.errors import BadInputError, UnknownNameError
from physion.experiment.experimenter.progress import StudyProgress
from physion.experiment.export.export_study import export_study
from physion.experiment.store.database import SESSIONS
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.settings import Condition
from support.experiment.store_walk import enter, page, rows, walk
from support.experiment.tiny_study import make_tiny_study

CONDITIONS = (Condition("slow"), Condition("brief", cue_ms=100))


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Store]]:
    """The export of a study with two conditions, each with three finished sessions."""
    folder = tmp_path_factory.mktemp("conditions")
    study = make_tiny_study(
        folder / "study", test=4, familiarization=1, size=32, conditions=CONDITIONS
    )
    store = Store.open(study, Secrets.load(study.folder))
    for person in range(6):
        walk(store, enter(store, f"person {person}"), "done")
    page(store, walk(store, enter(store, "stops"), "test"), "withdraw")
    export_study(store.engine, study, folder / "out")
    yield folder / "out", store
    store.close()


@pytest.mark.slow
def test_sessions_and_trials_name_the_condition(exported: tuple[Path, Store]) -> None:
    out, store = exported
    of_session = {row.session: row.condition for row in rows(store, SESSIONS)}
    for name in ("trials", "sessions"):
        table = pd.read_csv(out / f"{name}.csv")
        assert list(table["condition"]) == [of_session[name] for name in table["session"]]
        assert set(table["condition"]) == {"slow", "brief"}


def test_a_study_without_conditions_has_an_empty_column(tmp_path: Path) -> None:
    study = make_tiny_study(tmp_path / "study", test=1, familiarization=1, size=32)
    store = Store.open(study, Secrets.load(study.folder))
    walk(store, enter(store, "ada"), "done")
    export_study(store.engine, study, tmp_path / "out")
    store.close()
    for name in ("trials", "sessions"):
        assert pd.read_csv(tmp_path / "out" / f"{name}.csv")["condition"].isna().all()
    responses = read_any_responses([tmp_path / "out/trials.csv"], tmp_path / "out/sessions.csv")
    assert accuracy_by_condition(responses.test).empty
    assert "condition" not in set(background(responses.sessions)["question"])


def test_the_progress_counts_the_sessions_of_each_condition(exported: tuple[Path, Store]) -> None:
    _, store = exported
    progress = StudyProgress(store.study, store.engine)
    _, found = progress.rows(progress.sessions("person")[0])
    counts = {row.name: (row.counted, row.states["finished"]) for row in found}
    assert counts == {"slow": (3, 3), "brief": (3, 3)}
    assert sum(row.states["withdrawn"] for row in found) == 1
    assert [row.accuracy for row in found] == [0.5, 0.5]


def test_the_analysis_compares_and_chooses_conditions(exported: tuple[Path, Store]) -> None:
    out, _ = exported
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
    with pytest.raises(BadInputError, match="the values of condition are: brief, slow"):
        keep_where(responses, ["condition=fast"])
    with pytest.raises(UnknownNameError, match="condition"):
        keep_where(responses, ["conditoin=fast"])
    with pytest.raises(BadInputError, match="a column and a value"):
        keep_where(responses, ["brief"])
    with pytest.raises(BadInputError, match="no column language"):
        keep_where(alone, ["language=en"])
