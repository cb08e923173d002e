"""The page: whole, self-contained, the same bytes every time, and nobody's text becomes markup."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from physion.analysis.comparison import Comparison, compare_scores
from physion.analysis.figure_tables import SCENARIO_ZONE
from physion.analysis.intervals import Bootstrap
from physion.analysis.metrics import score_metrics
from physion.analysis.published.claims import results_of
from physion.analysis.published.tables import read_published
from physion.analysis.scores import COMPUTED, MAJORITY, OUTCOME, TWO_PEOPLE
from physion.analysis.tables import MEAN, POOLED
from physion.core.errors import BadInputError
from physion.report import html as blocks
from physion.report import people, scores
from physion.report.build import build_report, report_numbers
from physion.report.compare import compare
from physion.report.figures.theme import make_plots
from physion.report.html import BASELINES, Picture
from physion.report.inputs import EXPECTED_METHODS, ReportInputs
from physion.report.page import render_page
from physion.report.published import build_published_report

Maker = Callable[..., Comparison]
VOID = {"meta", "img", "source", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """Collects tags, attributes and text, and checks that every element is closed in turn."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.raw = text
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def sources(self) -> list[str]:
        """What the page loads; links are only followed."""
        names = ("src", "srcset", "poster", "data", "action")
        return [value for _, attrs in self.tags for name in names if (value := attrs.get(name))]

    def links(self) -> list[str]:
        return [str(attrs["href"]) for tag, attrs in self.tags if tag == "a"]


@pytest.fixture
def movie(tmp_path: Path) -> Path:
    path = tmp_path / "movie.mp4"
    path.write_bytes(b"\x00\x00\x00\x18ftypisom" + bytes(1000))
    return path


FIGURES = ("accuracy", "r", "scatter", "thirds", "difficulty")
BLANK = {"svg": b"<svg/>", "png": b""}


def render(inputs: ReportInputs) -> Page:
    """The page with blank figures, which are slow to draw and tested elsewhere."""
    names = ["accuracy"]
    names += ["r", "scatter", "thirds", "difficulty"] if inputs.comparison.has_people else []
    return Page(render_page(inputs, [Picture(name, BLANK, BLANK) for name in names]))


def page_of(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def test_page_needs_nothing_from_elsewhere(make_comparison: Maker, movie: Path) -> None:
    comparison = make_comparison()
    movies = dict.fromkeys(comparison.stimuli["stimulus"], movie)
    page = render(ReportInputs(comparison, movies=movies))
    assert len(page.sources()) >= 2 * 2 + 8
    assert all(source.startswith("data:") for source in page.sources())
    raw = page.raw
    assert not re.search(r"https?://|@import|url\(|<script|<link|<iframe", raw)
    assert "default-src 'none'" in raw and "prefers-color-scheme: dark" in raw


def test_foreign_text_stays_text(make_comparison: Maker) -> None:
    evil = "<script>alert(1)</script>\"'&amp;"
    inputs = ReportInputs(
        make_comparison(model=evil), title=evil, methods={"Engine": evil, evil: "x"}
    )
    page = render(inputs)
    assert "script" not in {tag for tag, _ in page.tags}
    assert page.text.count(evil) >= 5  # title, heading, methods and tables, as written


def test_choices_are_stated_or_said_to_be_missing(make_comparison: Maker) -> None:
    inputs = ReportInputs(make_comparison(), methods={"Engine": "mujoco 4", "Extra": "a word"})
    text = render(inputs).text
    assert "Engine mujoco 4" in text and "Extra a word" in text
    assert text.count("not stated") == len(EXPECTED_METHODS) - 1
    assert "jackknife" in text and "left out, as in the study" in text
    names = inputs.comparison.stimuli["base_model"]
    known = dataclasses.replace(inputs, model_weights=dict.fromkeys(names, "those of a file"))
    text = render(known).text
    assert "started from: " in text and "Encoder weights" not in text, "it is said once"


def test_undefined_scores_come_with_their_reason(make_comparison: Maker) -> None:
    page = render(ReportInputs(make_comparison(constant=True)))
    assert "r: undefined in collide, drop" in page.text
    dashes = [attrs for _, attrs in page.tags if attrs.get("class") == "none"]
    assert len(dashes) > 4 and any("constant" in str(one.get("title")) for one in dashes)
    assert "NaN" not in page.text


def test_without_people_there_is_a_page_too(make_comparison: Maker) -> None:
    inputs = ReportInputs(make_comparison(with_people=False))
    text = render(inputs).text
    assert "No answers of people were given" in text
    assert "Pearson r by scenario" not in text
    assert "Everything that compares with people" in text
    assert {plot.name for plot in make_plots(inputs)} == {"accuracy"}
    assert "Trials whose simulated outcome differs" not in text


def test_numbers_for_machines_say_null_where_undefined(make_comparison: Maker) -> None:
    comparison = make_comparison(constant=True)
    values = report_numbers(ReportInputs(comparison))
    assert [row["kind"] for row in values["comparison"]] == list(comparison.all_scores["kind"])
    assert values["comparison"][0]["accuracy"] == comparison.scores["accuracy"].iloc[0]
    assert values["comparison"][0]["r"] is None and "constant" in values["comparison"][0]["reason"]
    assert values["methods"]["Intervals"] == comparison.settings["Intervals"]


def test_contents_lead_to_every_section(make_comparison: Maker) -> None:
    page = render(ReportInputs(make_comparison()))
    places = [f"#{attrs['id']}" for tag, attrs in page.tags if tag == "section"]
    assert page.links() == places and len(places) > 6
    assert "#trials-whose-simulated-outcome-differs" in places


# --- movies --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_changed_trials_link_to_their_movies(make_comparison: Maker, tmp_path: Path) -> None:
    comparison = make_comparison()
    name = comparison.changed["stimulus"].iloc[0]
    (tmp_path / "trials").mkdir()
    (tmp_path / "trials" / "it's.mp4").write_bytes(b"a movie")
    inputs = ReportInputs(comparison, movies={name: tmp_path / "trials" / "it's.mp4"})
    text = render_page(inputs, [Picture(n, BLANK, BLANK) for n in FIGURES], tmp_path / "report")
    assert "../trials/it's.mp4" in Page(text).links()


def test_bad_movies_are_refused_and_no_page_is_left(make_comparison: Maker, tmp_path: Path) -> None:
    comparison = make_comparison()
    for name, message in (("none.mp4", "is not there"), ("movie.exe", "cannot be shown")):
        movies = dict.fromkeys(comparison.stimuli["stimulus"], tmp_path / name)
        with pytest.raises(BadInputError, match=message):
            build_report(ReportInputs(comparison, movies=movies), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").write_text("mine")
    with pytest.raises(BadInputError, match="is a file"):
        build_report(ReportInputs(make_comparison()), tmp_path / "out")


# --- from files ----------------------------------------------------------------------------------


def people_folder(folder: Path) -> Path:
    humans = folder / "humans"
    humans.mkdir(parents=True)
    rows = "".join(f"s_{i},{0.5 + i / 40},20\n" for i in range(12))
    name = "human_accuracy-collision_pilot-production_2_testing.csv"
    (humans / name).write_text("stim_ID,correct,c\n" + rows)
    return humans


def predictions_file(path: Path) -> Path:
    p = np.random.default_rng(0).random(12)
    table = pd.DataFrame({"Model": "m", "Readout Type": "C", "Predicted Prob_true": p})
    table["Predicted Outcome"] = p > 0.5
    table["Actual Outcome"] = [i % 2 == 0 for i in range(12)]
    table["Stimulus Name"] = [f"s_{i}" for i in range(12)]
    table.to_csv(path, index=False)
    return path


@pytest.mark.nightly
@pytest.mark.slow
def test_files_in_report_out(tmp_path: Path) -> None:
    humans = people_folder(tmp_path)
    predicted = predictions_file(tmp_path / "p.csv")
    out = tmp_path / "out"
    with pytest.raises(BadInputError, match="give the labels"):
        compare([predicted], humans=humans)
    assert not out.exists()
    labels = {f"s_{i}": i % 2 == 0 for i in range(12)}
    given = compare(predicted, humans=humans, labels=labels, resamples=50)
    assert isinstance(given.inputs, ReportInputs)
    assert "those recorded with the trials" in render(given.inputs).text
    # The official layout: labels and zone lie in the folders beside the people's.
    (tmp_path / "stimuli").mkdir()
    text = "stim_ID,label\n" + "".join(f"{name},{value}\n" for name, value in labels.items())
    (tmp_path / "stimuli" / "stimulus_names_and_labels.csv").write_text(text)
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "human_accuracy_by_scenario.csv").write_text(
        "agent,scenario,pct_2.5,pct_97.5\nhuman,collision,.6,.9\n"
    )
    path = compare([predicted], humans=humans, resamples=50).report(tmp_path / "two")
    found = pd.read_csv(tmp_path / "two" / "tables" / "comparison.csv")
    before = given.inputs.tables()["comparison"]
    np.testing.assert_array_equal(found["accuracy"], before["accuracy"])
    assert "Official outcomes stimulus_names_and_labels.csv" in page_of(path).text
    people = pd.read_csv(tmp_path / "two" / "tables" / "people.csv").set_index("scenario")
    assert people.loc["collide", "zone_high"] == 0.9


# --- tables of scores ---------------------------------------------------------------------------


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
    assert "Not known: the predictions have no values of observed_contact" in text
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


def test_columns_of_simulated_outcomes_stand_only_where_these_differ(
    make_comparison: Maker,
) -> None:
    comparison = make_comparison()
    stimuli = comparison.stimuli.assign(simulated=comparison.stimuli["label"])
    same = dataclasses.replace(comparison, changed=comparison.changed.iloc[:0], stimuli=stimuli)
    for own, there in ((comparison, True), (same, False)):
        plain = scores.shown_metrics(own, beyond=False)
        text = scores.scores_table(own.all_scores, MEAN, plain) + scores.definitions(own)
        assert ("against simulated outcome" in text) is there
        assert ("same outcome" in text) is there
        assert text.count('<th scope="row">') == len(own.names) + len(COMPUTED)
        cells = text.count("<td>") / text.count('<th scope="row">')
        assert text.count('scope="col"') - 1 == cells


def test_counts_and_gaps_are_written_in_one_way(make_comparison: Maker) -> None:
    column = blocks.PageColumn("rows", "rows", "count")
    assert column.cell(pd.Series({"rows": 120000})) == "120000"
    comparison = make_comparison()
    assert not re.search(r"\d–", people.averages(comparison) + scores.matrix(comparison, "r"))


# --- published results --------------------------------------------------------------------------


PUBLISHED = [*(f"panel_{name}" for name in "acde"), "figure_s1", "figure_s3"]


@pytest.mark.nightly
@pytest.mark.slow
def test_the_page_of_the_published_results(official: Path, tmp_path: Path) -> None:
    built = build_published_report(results_of(read_published(official)), tmp_path / "published")
    whole = re.sub(r"<(style|figure)>.*?</\1>", " ", built.read_text(encoding="utf-8"), flags=re.S)
    text = " ".join(unescape(re.sub(r"<[^>]+>", " ", whole)).split())
    table = pd.read_csv(built.parent / "tables" / "accuracies.csv")
    for column in ("published", "expected"):
        values = table.loc[table["model"] == "DPI", column]
        words = " ".join(f"{value:.3f}" for value in [*values, values.mean()])
        assert f"DPI {words}" in text
    assert "mix detection into prediction" in text
    assert "released table calls pVGG a Transformer" in text
    assert "only when readout full, which sees the outcome, is pooled in" in text
    for name in ("S2", "S4", "S5"):
        assert re.search(rf"Figures that the released tables do not determine .* {name} ", text)
    assert "interval by the paper's way" in text
    names = {path.name for path in (built.parent / "figures").iterdir()}
    assert names == {
        f"{name}.{kind}" for name in PUBLISHED for kind in ("svg", "pdf", "png", "csv")
    }
    values = json.loads((built.parent / "published.json").read_text())
    assert len(values["tables"]["accuracies"]) == 88
    panel = pd.read_csv(built.parent / "figures" / "panel_a.csv")
    assert set(panel.loc[panel["panel"] == "mean", "zone"]) == {SCENARIO_ZONE}
    assert panel["value"].notna().all() and len(panel) == 99
