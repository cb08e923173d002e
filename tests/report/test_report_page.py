"""The page: whole, self-contained, the same bytes every time, and nobody's text becomes markup."""

from __future__ import annotations

import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from physion.analysis import Comparison
from physion.analysis.tables import MEAN
from physion.core.errors import BadInputError
from physion.report import ReportInputs, build_report
from physion.report.build import report_numbers
from physion.report.compare import compare
from physion.report.figures.theme import make_plots
from physion.report.html import Picture
from physion.report.inputs import EXPECTED_METHODS
from physion.report.page import render_page

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


def test_without_a_changed_outcome_there_is_no_section_about_them(make_comparison: Maker) -> None:
    page = render(ReportInputs(make_comparison(with_people=False)))
    assert "Trials whose simulated outcome differs" not in page.text


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


def test_a_file_in_the_place_of_the_folder_is_refused(
    make_comparison: Maker, tmp_path: Path
) -> None:
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


@pytest.mark.nightly
@pytest.mark.slow
def test_the_official_people_make_a_page(official: Path, tmp_path: Path) -> None:
    names = pd.read_csv(official / "stimuli" / "stimulus_names_and_labels.csv")
    p = np.random.default_rng(0).random(len(names))
    table = pd.DataFrame({"Model": "coin", "Readout Type": "C", "Predicted Prob_true": p})
    table["Predicted Outcome"], table["Actual Outcome"] = p > 0.5, names["label"]
    table["Stimulus Name"] = names["stim_ID"]
    table.to_csv(tmp_path / "p.csv", index=False)
    result = compare(tmp_path / "p.csv", humans=official / "humans")
    path = result.report(tmp_path / "out")
    left = pd.read_csv(tmp_path / "out" / "tables" / "left_out.csv")
    assert dict(zip(left["reason"], left["stimuli"], strict=True)) == {
        "Roll stimulus with a ledge": 56
    }
    scores = pd.read_csv(tmp_path / "out" / "tables" / "comparison.csv")
    scores = scores[scores["base_model"] == "coin"].set_index("scenario")
    assert scores.loc[MEAN, "accuracy"] == pytest.approx(0.5, abs=0.06)
    assert scores.loc[MEAN, "r_low"] < 0 < scores.loc[MEAN, "r_high"]
    assert "coin" in page_of(path).text
    assert path.stat().st_size < 3_000_000
