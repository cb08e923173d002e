"""Every table of the page holds the numbers of its table, in the column of their name."""

from __future__ import annotations

import base64
import dataclasses
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.analysis.tables import MEAN, POOLED
from physion.report.build import report_numbers
from physion.report.compare import CompareResult
from physion.report.html import Picture
from physion.report.inputs import ReportInputs
from physion.report.page import render_page
from support.small_study import compare_small


@dataclass
class PageTable:
    """A table of a page as text; ``place``: headings above it and its caption."""

    place: str
    header: list[str]
    rows: list[list[str]]

    def column(self, heading: str, number: int = 0) -> list[str]:
        """Return the cells below a heading, the ``number``-th of this name."""
        at = [k for k, name in enumerate(self.header) if name == heading][number]
        return [row[at] for row in self.rows]


def text_of(html: str) -> str:
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", html)).split())


def tables_of(page: str) -> Iterator[PageTable]:
    """Yield the tables of a page, without rows that are headings of groups."""
    for match in re.finditer(r"<table>.*?</table>", page, re.S):
        above = re.findall(r"<(?:h2|h3|summary)>(.*?)</(?:h2|h3|summary)>", page[: match.start()])
        caption = re.findall(r"<caption>(.*?)</caption>", match[0], re.S)
        lines = [
            re.findall(r"<t[hd](?: [^>]*)?>(.*?)</t[hd]>", row, re.S)
            for row in re.findall(r"<tr>(.*?)</tr>", match[0], re.S)
        ]
        header, *rows = ([text_of(cell) for cell in line] for line in lines)
        place = " / ".join(text_of(part) for part in [*above[-1:], *caption])
        yield PageTable(place, header, [row for row in rows if len(row) == len(header)])


def find(page: str, place: str) -> PageTable:
    """Return the table with this place, or the only one whose place contains it."""
    tables = list(tables_of(page))
    (found,) = [table for table in tables if table.place == place] or [
        table for table in tables if place in table.place
    ]
    return found


# --- numbers as text, written out once more -----------------------------------------------------


def fixed(digits: int) -> Any:
    def write(x: float) -> str:
        if pd.isna(x):
            return "–"
        text = f"{x:.{digits}f}"
        return text.removeprefix("-") if float(text) == 0 else text.replace("-", "−")

    return write


def count(x: float) -> str:
    return "–" if pd.isna(x) else str(int(x))


def p(x: float) -> str:
    return "–" if pd.isna(x) else "< 0.001" if x < 0.001 else f"{x:.3f}"


def spread(name: str, low: str, high: str, digits: int) -> Any:
    """Return a function from a row to a value with its interval."""

    def write(row: pd.Series) -> str:
        value, *ends = (fixed(digits)(row[key]) for key in (name, low, high))
        if value == "–":
            return value
        return f"{value} no interval" if "–" in ends else f"{value} {ends[0]} to {ends[1]}"

    return write


def own(name: str, digits: int = 2) -> Any:
    return spread(name, f"{name}_low", f"{name}_high", digits)


def check(table: PageTable, rows: pd.DataFrame, columns: Mapping[str, Any]) -> None:
    """Compare columns by their headings; a value is (column, text of it) or a text of the row."""
    assert len(rows) == len(table.rows) > 0, table.place
    seen: dict[str, int] = {}
    for name, value in columns.items():
        heading = name.split("#")[0]
        number = seen.get(heading, 0)
        seen[heading] = number + 1
        if isinstance(value, tuple):
            expected = [value[1](x) for x in rows[value[0]]]
        elif callable(value):
            expected = [value(row) for _, row in rows.iterrows()]
        else:
            expected = rows[value].astype(str).tolist()
        assert table.column(heading, number) == expected, (table.place, name)


def distinct(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table with another number in every cell with a number, in 0.01 to 0.99."""
    table = table.reset_index(drop=True)
    names = [name for name in table if table[name].dtype.kind in "if"]
    for k, name in enumerate(names):
        values = (np.arange(len(table)) * 89 + k * 37 + 11) % 97
        table[name] = values + 10 if table[name].dtype.kind == "i" else (values + 1) / 99
    return table.assign(reason="") if "reason" in table else table


def rendered(inputs: ReportInputs) -> str:
    """Return the page with empty figures, below which some tables stand."""
    blank = {"svg": b"<svg/>", "png": b""}
    names = ("accuracy", "r", "kappa", "difficulty")
    return render_page(inputs, [Picture(name, blank, blank) for name in names])


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> CompareResult:
    return compare_small(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def inputs(result: CompareResult) -> ReportInputs:
    assert isinstance(result.inputs, ReportInputs)
    return result.inputs


@pytest.fixture(scope="module")
def page(inputs: ReportInputs) -> str:
    return rendered(inputs)


@pytest.fixture(scope="module")
def filled(inputs: ReportInputs) -> tuple[ReportInputs, str]:
    """Inputs whose tables hold a different number in every cell, and their page."""
    assert inputs.people is not None and inputs.with_people is not None
    assert inputs.paired is not None
    kept = ("by_stimulus", "items", "flags", "flag_counts", "attributes", "left_out")
    tables = {
        name: table if name in kept or not len(table.columns) else distinct(table)
        for name, table in inputs.people.tables.items()
    }
    tables["background"] = pd.DataFrame(
        {"question": "age", "answer": ["18", "30"], "sessions": [3, 5], "fraction": [0.375, 0.625]}
    )
    tables["background_tests"] = pd.DataFrame(
        {"question": ["age"], "sessions": [8], "test": ["Spearman"], "statistic": [0.31],
         "p": [0.04], "reason": [""]}
    )  # fmt: skip
    with_people = dataclasses.replace(
        inputs.with_people,
        scores=distinct(inputs.with_people.scores),
        zones=distinct(inputs.with_people.zones),
    )
    changed = dataclasses.replace(
        inputs,
        people=dataclasses.replace(inputs.people, tables=tables),
        with_people=with_people,
        paired=distinct(inputs.paired),
    )
    return changed, rendered(changed)


# --- scores -------------------------------------------------------------------------------------

SCORES = {
    "stimuli": ("stimuli", count),
    "accuracy": own("accuracy"),
    "people": own("human_accuracy"),
    "difference": own("difference"),
    "Pearson r": own("r"),
    "ceiling of r": ("ceiling", fixed(2)),
    "RMSD": own("rmsd"),
    "d′": own("d_prime"),
    "criterion": own("criterion"),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "scenario"), [("Scores / Mean over scenarios", MEAN), ("All stimuli pooled", POOLED)]
)
def test_scores_of_models(inputs: ReportInputs, page: str, place: str, scenario: str) -> None:
    table = find(page.partition(">Beyond the outcome<")[0], place)
    scores = inputs.comparison.all_scores
    rows = scores[(scores["scenario"] == scenario)].reset_index(drop=True)
    models = (rows["kind"] == "model").sum()
    check(
        PageTable(table.place, table.header, table.rows[:models]),
        rows.iloc[:models],
        {"model": "base_model", "readout": "readout"} | SCORES | {
            "kappa": own("kappa_from_averages")
        },
    )  # fmt: skip


def test_scores_by_scenario_stand_below_their_scenario(inputs: ReportInputs, page: str) -> None:
    scores = inputs.comparison.all_scores.set_index(["model", "scenario"])
    for place, key in (
        ("Accuracy as a table", "accuracy"),
        ("Pearson r by scenario", "r"),
        ("By scenario: r beyond the outcome", "r_beyond_outcome"),
    ):
        table = find(page, place)
        assert table.header[1:] == ["collide", "drop", MEAN, POOLED]
        for line in table.rows:
            for scenario, cell in zip(table.header[1:], line[1:], strict=True):
                if (line[0], scenario) in scores.index:
                    assert cell == own(key)(scores.loc[(line[0], scenario)]), (place, line[0])
    people = inputs.comparison.people.set_index("scenario")
    first = find(page, "Accuracy as a table").rows[0]
    assert first[0] == "people"
    assert first[1:4] == [own("accuracy")(people.loc[s]) for s in ("collide", "drop", MEAN)]
    ceiling = find(page, "Pearson r by scenario").rows[0]
    assert ceiling[:2] == ["ceiling", f"{people.loc['collide', 'ceiling']:.2f}"]


def test_accuracies_over_runs(inputs: ReportInputs, page: str) -> None:
    """Of the model with two readouts only; its interval draws them."""
    table = find(page, "Accuracy over runs")
    assert table.header[1:] == ["runs", "collide", "drop", MEAN]
    (line,) = table.rows
    assert line[:2] == ["one", "2"]
    scores = inputs.comparison.scores.set_index(["base_model", "scenario"])["accuracy"]
    for scenario, cell in zip(("collide", "drop", MEAN), line[2:], strict=True):
        two = sorted(scores.loc["one", scenario])
        # A quarter of the draws has the same run twice: both values lie within 95 %.
        assert cell == f"{np.mean(two):.2f} {two[0]:.2f} to {two[1]:.2f}"


def test_the_first_sentence_names_the_best(inputs: ReportInputs, page: str) -> None:
    """The recorded scores by hand: readout full, which sees the outcome, is left out."""
    scores = inputs.comparison.all_scores
    rows = scores[
        (scores["scenario"] == MEAN) & scores["model"].isin(["one · observed", "two · observed"])
    ]
    rows = rows.set_index("model")
    accuracy, r = rows["accuracy"].idxmax(), rows["r"].idxmax()
    assert len(rows) == 2 and rows["accuracy"].nunique() == rows["r"].nunique() == 2
    people, ceiling = rows.loc[accuracy, "human_accuracy"], rows.loc[r, "ceiling"]
    text = text_of(page)
    assert (
        f"Most accurate: {accuracy} ({rows.loc[accuracy, 'accuracy']:.2f}; people {people:.2f}; "
        "mean over scenarios)." in text
    )
    value = fixed(2)(rows.loc[r, "r"])
    assert f"Most like people: {r} (r {value}; ceiling {ceiling:.2f}; mean" in text


def test_people_on_predicted_stimuli(inputs: ReportInputs, page: str) -> None:
    table = find(page, "People on the stimuli that any model predicts / People; intervals of the "
                 "accuracy by drawing stimuli, and by drawing participants")  # fmt: skip
    check(table, inputs.comparison.people, {
        "scenario": "scenario", "stimuli": ("stimuli", count), "people": ("people", fixed(0)),
        "base rate": ("base_rate", fixed(2)), "say yes": ("yes", fixed(2)),
        "accuracy": own("accuracy"), "reliability": ("reliability", fixed(3)),
        "ceiling of r": ("ceiling", fixed(3)),
    })  # fmt: skip
    drawn = table.column("participants drawn", 0)
    for cell, row in zip(drawn, inputs.comparison.people.to_dict("records"), strict=True):
        assert cell == f"{row['bootstrap_low']:.2f} to {row['bootstrap_high']:.2f}"
    assert inputs.comparison.people["yes"].ne(inputs.comparison.people["base_rate"]).all()


# --- tests of models ----------------------------------------------------------------------------


TABLES: dict[str, tuple[str, dict[str, Any]]] = {
    "Models against each other": ("paired", {
        "first": "first", "second": "second", "stimuli": ("stimuli", count),
        "accuracy, first less second": ("accuracy_difference", fixed(3)),
        "only first right": ("only_first", count), "only second right": ("only_second", count),
        "p": ("p_accuracy", p), "Holm": ("p_accuracy_holm", p), "B-H": ("p_accuracy_bh", p),
        "r, first less second": own("r_difference"),
        "p#": ("p_r", p), "Holm#": ("p_r_holm", p), "B-H#": ("p_r_bh", p),
    }),
    "What single people reach": ("zones", {
        "scenario": "scenario", "measure": "measure", "of": "of", "values": ("values", count),
        "mean": ("mean", fixed(3)), "2.5 %": ("low", fixed(3)), "97.5 %": ("high", fixed(3)),
        "undefined": ("undefined", count),
    }),
    "Accuracy of people, flagged": ("by_scenario", {
        "scenario": "scenario", "people": ("people", count), "stimuli": ("stimuli", count),
        "accuracy": own("accuracy", 3), "sd over people": ("sd", fixed(3)), "t": ("t", fixed(1)),
        "df": ("df", lambda x: str(round(x))), "p": ("p", p),
        "lowest 2.5 %": ("zone_low", fixed(3)),
        "highest 2.5 %": ("zone_high", fixed(3)), "consistency": ("consistency", fixed(3)),
    }),
    "Saying yes;": ("yes_bias", {
        "scenario": "scenario", "people": ("people", count), "contact": ("base_rate", fixed(3)),
        "say yes": ("yes", fixed(3)), "yes less contact": own("bias", 3), "d′": own("d_prime"),
        "criterion": own("criterion"),
    }),
    "Pressing the left button": ("side_bias", {
        "scenario": "scenario", "yes on the left": ("yes_left", count),
        "yes on the right": ("yes_right", count), "order unknown": ("unknown", count),
        "left presses": own("left", 3), "p": ("p", p),
    }),
    "Accuracy by who people are": ("background_tests", {
        "question": "question", "sessions": ("sessions", count), "test": "test",
        "statistic": ("statistic", fixed(2)), "p": ("p", p),
    }),
    "By scenario": ("hypotheses", {
        "hypothesis": "hypothesis", "scenario": "scenario",
        "left out": ("left_out", lambda x: str(round(x))),
        "b": spread("b", "low", "high", 3), "t": ("t", fixed(2)), "p": ("p", p),
        "r": ("r", fixed(2)),
    }),
}  # fmt: skip
"""Place of a table on the page: the table that it shows, and its columns."""


@pytest.mark.parametrize("place", TABLES)
def test_tables_hold_their_numbers(filled: tuple[ReportInputs, str], place: str) -> None:
    inputs, page = filled
    assert inputs.people is not None and inputs.with_people is not None
    name, columns = TABLES[place]
    rows = {"paired": inputs.paired, "zones": inputs.with_people.zones} | inputs.people.tables
    check(find(page, place), rows[name], columns)


def test_who_took_part_in_per_cent(filled: tuple[ReportInputs, str]) -> None:
    assert find(filled[1], "Who took part").column("fraction") == ["38 %", "62 %"]


def test_counts_of_differing_pairs(filled: tuple[ReportInputs, str]) -> None:
    inputs, page = filled
    assert inputs.paired is not None
    counts = [
        int((inputs.paired[f"p_{key}_{how}"] < 0.05).sum())
        for key in ("accuracy", "r") for how in ("holm", "bh")
    ]  # fmt: skip
    assert (
        f"Of 3 pairs, {counts[0]} differ in accuracy by Holm and {counts[1]} by Benjamini and "
        f"Hochberg (5 %); of 3, {counts[2]} and {counts[3]} in r." in text_of(page)
    )


def test_measures_with_single_people(filled: tuple[ReportInputs, str]) -> None:
    inputs, page = filled
    assert inputs.with_people is not None
    scores = inputs.with_people.scores
    whole = find(page, "Every measure as a table")
    table = PageTable(
        whole.place, whole.header, [row for row in whole.rows if row[2] == "accuracy"]
    )
    rows = scores[(scores["scenario"] == MEAN) & (scores["measure"] == "accuracy")]
    check(table, rows, {
        "model": "model", "stimuli": ("stimuli", count),
        "value (people and stimuli drawn)": spread("value", "low_both", "high_both", 3),
        "people drawn": spread("value", "low_people", "high_people", 3),
        "stimuli drawn": spread("value", "low_stimuli", "high_stimuli", 3),
        "lowest 2.5 % of people": ("zone_low", fixed(3)),
        "highest 2.5 %": ("zone_high", fixed(3)),
    })  # fmt: skip


def test_kappa_of_models_with_each_other(inputs: ReportInputs, page: str) -> None:
    assert inputs.with_people is not None
    mean = inputs.with_people.pairs.groupby(["first", "second"])["kappa"].mean()
    table = find(page, "kappa of models with each other")
    names = [row[0].partition(" ")[2] for row in table.rows]
    assert len(names) == 2, "readout full is not next to people"
    for (first, second), kappa in mean.items():
        for one, other in ((first, second), (second, first)):
            assert table.rows[names.index(one)][1 + names.index(other)] == fixed(2)(kappa)
    assert all(table.rows[k][1 + k] == "" for k in range(2))


# --- people -------------------------------------------------------------------------------------


def test_agreement_among_people(filled: tuple[ReportInputs, str]) -> None:
    inputs, page = filled
    assert inputs.people is not None
    rows = inputs.people.tables["agreement"].set_index(["scenario", "measure"])
    table = find(page, "How alike people answer")
    measures = ("kappa", "correlation", "split_half", "spearman_brown")
    headings = ("kappa, pairs", "r, pairs", "r, halves", "r, halves, Spearman-Brown")
    for scenario, *_ in table.rows:
        at = [row[0] for row in table.rows].index(scenario)
        for measure, heading in zip(measures, headings, strict=True):
            expected = spread("mean", "low", "high", 3)(rows.loc[(scenario, measure)])
            assert table.column(heading)[at] == expected
        for number, measure in enumerate(measures[:2]):
            row = rows.loc[(scenario, measure)]
            ends = f"{row['mean_low']:.3f} to {row['mean_high']:.3f}"
            assert table.column("interval of the mean", number)[at] == ends


def test_stimuli_that_mislead_people(inputs: ReportInputs) -> None:
    """Of 100 people 39 are right: below chance by one rule only, since 16 stimuli are tested."""
    assert inputs.people is not None
    by_stimulus = inputs.people.tables["by_stimulus"].assign(accuracy=0.9, count=100.0)
    names = by_stimulus["stimulus"].tolist()
    by_stimulus.loc[by_stimulus.index[:2], "accuracy"] = [0.39, 0.05]
    tables = {**inputs.people.tables, "by_stimulus": by_stimulus}
    changed = dataclasses.replace(inputs, people=dataclasses.replace(inputs.people, tables=tables))
    page = rendered(changed)
    table = find(page, "The 2 stimuli one by one")
    assert table.rows == [
        [names[1], "collide", "0.05", "100", "yes"], [names[0], "collide", "0.39", "100", "no"],
    ]  # fmt: skip
    (counts,) = [t for t in tables_of(page) if "below chance, corrected" in t.header]
    assert counts.rows == [["collide", "16", "2", "1"], ["drop", "16", "0", "0"],
                           ["all", "32", "2", "1"]]  # fmt: skip


# --- with and without flagged sessions ----------------------------------------------------------


def test_people_and_models_without_and_with_flagged_sessions(
    inputs: ReportInputs, page: str
) -> None:
    assert inputs.people is not None and inputs.comparison_all is not None
    rows = inputs.people.tables["with_and_without"].set_index(["sessions", "scenario"])
    table = find(page, "without flagged sessions and with them")
    for line in table.rows:
        for at, which in ((1, "unflagged"), (3, "complete")):
            row = rows.loc[(which, line[0])]
            assert line[at : at + 2] == [count(row["people"]), own("accuracy", 3)(row)]
    assert rows.loc[("unflagged", "collide"), "people"] == 7
    assert rows.loc[("complete", "collide"), "people"] == 8
    before = inputs.comparison_all
    moved = before.scores.assign(
        r=before.scores["r"] + 0.1, difference=-before.scores["difference"]
    )
    changed = dataclasses.replace(inputs, comparison_all=dataclasses.replace(before, scores=moved))
    table = find(rendered(changed), "accuracy less people's, and r")
    scores = [
        comparison.all_scores.set_index(["model", "scenario"])
        for comparison in (changed.comparison, changed.comparison_all)
        if comparison is not None
    ]
    for line in table.rows:
        one, other = (own_scores.loc[(line[0], MEAN)] for own_scores in scores)
        assert line[1:] == [own(key)(row) for key in ("difference", "r") for row in (one, other)]


def test_counts_of_flags(inputs: ReportInputs, page: str) -> None:
    table = find(page, "Sessions that each rule flags")
    lines = {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows}
    expected = {"collide": ("1", "7", "8"), "drop": ("0", "8", "8"), "all": ("1", "15", "16")}
    for scenario, (flagged, kept, every) in expected.items():
        line = lines[scenario]
        assert (line["flagged"], line["kept"], line["all"]) == (flagged, kept, every)
        assert line["streak"] == flagged and line["slow"] == "0"


# --- numbers for machines, and trials -----------------------------------------------------------


def test_numbers_for_machines_are_not_rounded(inputs: ReportInputs) -> None:
    values = report_numbers(inputs)["comparison"]
    scores = inputs.comparison.all_scores
    for key in ("accuracy", "r", "r_low", "rmsd_high"):
        found = [np.nan if row[key] is None else row[key] for row in values]
        np.testing.assert_allclose(found, scores[key], rtol=1e-12)


def test_who_was_right(inputs: ReportInputs, page: str) -> None:
    table = find(page, "The majority of people and each model")
    stimuli = inputs.comparison.stimuli
    for line in table.rows:
        rows = stimuli[stimuli["model"] == line[0]]
        model = (rows["p_contact"] > 0.5) == rows["label"]
        people = rows["human_accuracy"] > 0.5
        divided = rows["human_accuracy"] == 0.5
        sums = (people & model, people & ~model, ~people & ~divided & model,
                ~people & ~divided & ~model, divided)  # fmt: skip
        assert line[1:] == [str(len(rows)), *(str(int(part.sum())) for part in sums)]


def test_every_card_has_the_movie_of_its_stimulus(inputs: ReportInputs, tmp_path: Path) -> None:
    """Movies are files of different content; pictures stand in for them, which need no decoder."""
    movies = {}
    for name in dict.fromkeys(inputs.comparison.stimuli["stimulus"]):
        movies[name] = tmp_path / f"{name}.gif"
        movies[name].write_bytes(f"the movie of {name}".encode())
    changed = dataclasses.replace(inputs, movies=movies)
    cards = re.findall(r"<article.*?</article>", rendered(changed), re.S)
    assert len(cards) >= 4
    for card in cards:
        name = re.findall(r"<code>(.*?)</code>", card)[0]
        assert decoded(card) == [f"the movie of {name}"]


def decoded(html: str) -> list[str]:
    """Return the texts in the pictures of a page."""
    return [
        base64.b64decode(data).decode()
        for data in re.findall(r'src="data:image/gif;base64,([^"]+)"', html)
    ]
