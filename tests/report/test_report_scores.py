"""The page's tables of scores: baselines below the models, beyond the outcome, later contacts."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from html import unescape

import numpy as np
import pandas as pd
import pytest

from physion.analysis import Bootstrap, Comparison, compare_scores
from physion.analysis.metrics import score_metrics
from physion.analysis.scores import COMPUTED, MAJORITY, OUTCOME, TWO_PEOPLE
from physion.analysis.tables import MEAN, POOLED
from physion.report import ReportInputs, scores
from physion.report.html import BASELINES

Maker = Callable[..., Comparison]


def groups(table: str) -> list[list[list[str]]]:
    """The cells of each group of rows of a table as text."""
    bodies = re.findall(r"<tbody>(.*?)</tbody>", table, flags=re.S)
    return [
        [
            [unescape(re.sub(r"<[^>]+>", " ", cell)).strip() for cell in cells]
            for line in re.findall(r"<tr>(.*?)</tr>", body, flags=re.S)
            if (cells := re.findall(r"<t[hd][ >].*?</t[hd]>|<td>.*?</td>", line, flags=re.S))
        ]
        for body in bodies
    ]


@pytest.fixture
def with_baseline(make_comparison: Maker) -> Comparison:
    """A comparison whose first model is a baseline of the package."""
    return make_comparison(model="constant-motion")


def test_baselines_are_a_group_of_their_own(with_baseline: Comparison) -> None:
    plain = scores.shown_metrics(with_baseline, beyond=False)
    models, baselines = groups(scores.scores_table(with_baseline.all_scores, MEAN, plain))
    assert [line[0] for line in models] == ["encoder"]
    assert [line[0] for line in baselines] == [BASELINES, "constant-motion", *COMPUTED]
    for key in ("accuracy", "r", "kappa_within_outcomes"):
        models, baselines = groups(scores.matrix(with_baseline, key))
        assert models[-1][0] == "encoder · observed+simulated"
        assert [line[0] for line in baselines][:4] == [
            BASELINES, "constant-motion · observed", OUTCOME, MAJORITY,
        ]  # fmt: skip


def test_the_cells_are_the_scores_and_empty_where_two_people_have_none(
    with_baseline: Comparison,
) -> None:
    metrics = score_metrics()
    _, baselines = groups(scores.scores_table(with_baseline.all_scores, POOLED, metrics))
    names = ["", "readout", "stimuli"]
    for metric in metrics:
        names += [metric.name, "ceiling"] if metric.name == "r" else [metric.name]
    two = dict(zip(names, baselines[-1], strict=True))
    table = with_baseline.baselines.set_index(["model", "scenario"])
    row = table.loc[(TWO_PEOPLE, POOLED)]
    assert two["kappa_from_averages"].split()[0] == f"{row['kappa_from_averages']:.2f}"
    assert two["accuracy"].split()[0] == f"{row['accuracy']:.2f}"
    assert two["r"].split()[0] == f"{row['r']:.2f}"
    assert two["rmsd"] == two["r_beyond_outcome"] == two["difference"] == ""
    outcome = dict(zip(names, baselines[-3], strict=True))
    assert outcome["r_beyond_outcome"] == "–" and outcome["r"] != "–"


def test_reasons_stand_below_the_table_that_they_are_about(with_baseline: Comparison) -> None:
    text = {
        beyond: scores.scores_table(
            with_baseline.all_scores, MEAN, scores.shown_metrics(with_baseline, beyond=beyond)
        )
        for beyond in (False, True)
    }
    why = f"{OUTCOME}: r beyond the outcome: undefined in collide, drop"
    assert why in text[True] and "r beyond" not in text[False]


def test_the_page_has_both_tables_and_says_why_one_is_missing(
    with_baseline: Comparison, make_comparison: Maker
) -> None:
    text = scores.scores(with_baseline)
    assert "Beyond the outcome" in text
    assert "Not known: the predictions have no column observed_contact" in text
    alone = scores.scores(make_comparison(with_people=False))
    assert "Beyond the outcome" not in alone and BASELINES not in alone
    assert OUTCOME not in alone.lower()


def test_later_contacts_have_a_table_and_a_file() -> None:
    names = [f"pilot_it2_drop_simple_box_{i:04d}" for i in range(12)]
    p = np.random.default_rng(0).random(12)
    given = pd.DataFrame(
        {"Model": "m", "Readout Type": "C", "Predicted Prob_true": p, "Predicted Outcome": p > 0.5,
         "Actual Outcome": np.arange(12) % 2 == 0, "Stimulus Name": names,
         "Observed Contact": np.arange(12) % 4 == 0}
    )  # fmt: skip
    people = pd.DataFrame(
        {"stimulus": names, "scenario": "drop", "accuracy": np.arange(8, 20) / 20, "count": 20.0}
    )
    labels = {name: i % 2 == 0 for i, name in enumerate(names)}
    comparison = compare_scores(given, people, labels, bootstrap=Bootstrap(50))
    text = scores.scores(comparison)
    assert "Left out: 3 of 12 stimuli (drop 3 of 12)" in text
    later = ReportInputs(comparison).tables()["comparison_later"]
    assert set(later["stimuli"]) == {9} and set(later["kind"]) == {"model", "baseline"}
    without = dataclasses.replace(comparison, later=comparison.later.iloc[:0])
    assert "comparison_later" not in ReportInputs(without).tables()
