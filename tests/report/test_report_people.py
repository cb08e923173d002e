"""The report with single participants: sections, counts, flags, with and without, bad input."""

from __future__ import annotations

import json
import re
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.analysis.people.responses import PERSON, REHEARSAL
from physion.analysis.statistics.agreement import cross_kappa
from physion.analysis.tables import attributes_from_table
from physion.cli.main import main
from physion.core.errors import BadInputError, UnknownNameError
from physion.report.build import report_numbers
from physion.report.compare import compare
from physion.report.figures.theme import make_plots
from physion.report.inputs import ReportInputs
from physion.report.page import render_page
from support.small_study import STEMS, STIMULI, compare_small, predictions, responses

pytestmark = pytest.mark.slow

OF_MODELS = ("mixed_models", "mixed_readouts")


def page_text(folder: Path, **options: Any) -> str:
    """Return the text of the page without figures, which are slow to draw."""
    inputs = compare_small(folder, **options).inputs
    assert isinstance(inputs, ReportInputs)
    return plain(render_page(inputs, []))


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("people")
    return compare_small(folder).report(folder / "out")


def plain(page: str) -> str:
    whole = re.sub(r"<(style|figure)>.*?</\1>", " ", page, flags=re.S)
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", whole)).split())


def text_of(page: Path) -> str:
    return plain(page.read_text(encoding="utf-8"))


@pytest.mark.nightly
def test_every_figure_has_its_files(report: Path) -> None:
    stems = {path.stem for path in (report.parent / "figures").iterdir()}
    assert stems == {
        *("overview", "accuracy", "r", "kappa", "effects", "people_and_models", "scatter"),
        *("right_answers", "thirds", "difficulty", "response_time"),
    }
    for stem in stems:
        for kind in ("svg", "pdf", "png", "csv"):
            assert (report.parent / "figures" / f"{stem}.{kind}").stat().st_size > 100


@pytest.mark.nightly
def test_kappa_of_the_figure_is_the_mean_over_people(report: Path) -> None:
    table = pd.read_csv(report.parent / "figures" / "kappa.csv").set_index(["panel", "model"])
    answers = responses()
    model = predictions().iloc[STIMULI : 2 * STIMULI]["Predicted Outcome"].to_numpy(float)
    people = answers[answers["scenario"] == "drop"].groupby("session")["response"]
    kappas = [cross_kappa((own == "yes").to_numpy(float), model).item() for _, own in people]
    row = table.loc[("drop", "one · observed")]
    assert row["value"] == pytest.approx(np.mean(kappas))
    assert row["low"] < row["value"] < row["high"] and row["zone_low"] < row["zone_high"]
    assert row["zone"] == "95 % of participants"


@pytest.mark.nightly
def test_band_of_the_paper_bears_its_name(report: Path) -> None:
    table = pd.read_csv(report.parent / "figures" / "r.csv")
    zones = pd.read_csv(report.parent / "tables" / "zones.csv")
    halves = zones[(zones["measure"] == "r") & (zones["of"] == "halves")]
    mean = table[table["panel"] == "mean"]
    assert set(mean["zone"]) == {"paper's band: r of halves, mean over scenarios"}
    assert mean["zone_high"].iloc[0] == pytest.approx(halves["high"].mean())


@pytest.mark.nightly
def test_the_page_says_what_was_fitted_and_from_what(report: Path) -> None:
    text, tables = text_of(report), report.parent / "tables"
    for words in (
        "Flagged and left out: 1 of 16 sessions", "session is flagged 1 16", "test of McNemar",
        "Holm", "correct ~ scenario + (1|participant) + (1|stimulus)", "tables/people_items.csv",
        "log_rt ~ accuracy + scenario", "accuracy ~ model + (1|scenario)",
        "Attributes: of 32 stimuli 0 by the table that was given, 32 by their official",
        "H1, preregistered: Stimuli with more elements are harder (logistic): not fitted",
    ):  # fmt: skip
        assert words in text, words
    values = json.loads((report.parent / "report.json").read_text())
    assert len(values["paired_tests"]) == 3
    fitted = {row["term"] for row in values["mixed_flagged"]}
    assert {"flagged", "sd of participant", "sd of stimulus"} <= fitted
    first = next(row for row in values["people_hypotheses"] if row["hypothesis"] == "H1")
    assert first["b"] is None and "predictor" in first["reason"]
    items = pd.read_csv(tables / "people_items.csv")
    assert set(items["stimulus"]) == {
        f"{s}_{i:04d}" for s in STEMS.values() for i in range(STIMULI)
    }


@pytest.mark.nightly
def test_bytes_repeat(report: Path, tmp_path: Path) -> None:
    again = compare_small(tmp_path).report(tmp_path / "another name")
    for path in sorted(report.parent.rglob("*")):
        if path.is_file():
            assert (
                again.parent / path.relative_to(report.parent)
            ).read_bytes() == path.read_bytes()


# --- what is refused ----------------------------------------------------------------------------


def test_bad_combinations_are_refused(tmp_path: Path) -> None:
    predictions().to_csv(tmp_path / "p.csv", index=False)
    responses().to_csv(tmp_path / "r.csv", index=False)
    own = {"responses": tmp_path / "r.csv"}
    labels = {responses()["stimulus"].iloc[0]: False}
    for given, options, words in (
        (tmp_path / "p.csv", {**own, "humans": tmp_path}, "not both"),
        (tmp_path / "p.csv", {**own, "labels": labels}, "ends otherwise"),
        ((), {}, "no predictions"),
    ):
        with pytest.raises(BadInputError, match=words):
            compare(given, **options)
    with pytest.raises(BadInputError, match="about predictions"):
        compare(**own).report(tmp_path / "out", movie_count=3)
    assert not (tmp_path / "out").exists()
    with pytest.raises(UnknownNameError, match="preregistered"):
        compare_small(tmp_path, rules="preregistred")
    with pytest.raises(BadInputError, match="all 16 sessions are flagged"):
        compare_small(tmp_path, responses().assign(response="yes"))


@pytest.mark.nightly
def test_a_rehearsal_with_simulated_participants_is_marked_on_every_page(
    report: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = responses().assign(simulated=True)
    with pytest.raises(BadInputError, match=r"only simulated participants .* --simulated"):
        compare_small(tmp_path, answers)
    person = answers.tail(STIMULI * 2).assign(simulated=False, participant="p", session="p")
    person = person.drop_duplicates("stimulus")
    both = pd.concat([answers, person.assign(scenario="drop")])
    result = compare_small(tmp_path, both, simulated=True)
    page = result.report(tmp_path / "out")
    text = page.read_text(encoding="utf-8")
    assert f"<title>{REHEARSAL}: " in text and f'<p class="mark">{REHEARSAL}</p>' in text
    assert "16 sessions" in text_of(page) and f"{PERSON} 1 16" in text_of(page)
    assert json.loads((page.parent / "report.json").read_text())["warnings"] == [REHEARSAL]
    assert "Rehearsal" not in report.read_text(encoding="utf-8")
    files = [*(page.parent / "tables").glob("*.csv"), *(page.parent / "figures").glob("*.csv")]
    assert len(files) > 20
    for path in files:
        assert set(pd.read_csv(path, dtype=str)["rehearsal"]) <= {"simulated participants"}, path
        original = report.parent / path.relative_to(page.parent)
        assert "rehearsal" not in pd.read_csv(original).columns if original.exists() else True


@pytest.mark.nightly
def test_warnings_stand_above_everything(tmp_path: Path) -> None:
    answers = responses()
    stray = answers.tail(1).assign(stimulus="drop_elsewhere", trial=99)
    result = compare_small(tmp_path, pd.concat([answers, stray]))
    assert isinstance(result.inputs, ReportInputs)
    text = plain(render_page(result.inputs, []))
    assert text.index("Warnings drop: answers to stimuli") < text.index("2 models")
    assert "Flagged and left out: 1 of 16 sessions" in text
    (warning,) = report_numbers(result.inputs)["warnings"]
    assert "drop_elsewhere" in warning


@pytest.mark.nightly
def test_the_source_of_attributes_is_the_one_used(tmp_path: Path) -> None:
    answers = responses()
    own = answers[["stimulus", "scenario"]].drop_duplicates().assign(elements=range(2 * STIMULI))
    text = page_text(tmp_path, attributes=attributes_from_table(own))
    assert "Attributes: of 32 stimuli 32 by the table that was given, 0 by their official" in text


@pytest.mark.nightly
def test_answers_without_times_say_so(tmp_path: Path) -> None:
    result = compare_small(tmp_path, responses().assign(rt_ms=np.nan))
    assert isinstance(result.inputs, ReportInputs)
    assert "response_time" not in {plot.name for plot in make_plots(result.inputs)}
    assert "no answer has one above 0" in plain(render_page(result.inputs, []))


@pytest.mark.nightly
def test_only_people(report: Path, tmp_path: Path) -> None:
    responses().to_csv(tmp_path / "responses.csv", index=False)
    page = compare(responses=tmp_path / "responses.csv", resamples=60).report(tmp_path / "one")
    text = text_of(page)
    assert "15 participants on 32 stimuli of 2 scenarios (collide, drop)" in text
    assert "Flagged and left out: 1 of 16 sessions" in text
    assert "60 resamples, seed 0" in text
    assert "model" not in text.lower().partition(" mixed models ")[0].replace("mixed models", "")
    # The same numbers as beside models, with the preregistered mixed models of single answers.
    of_people = [
        path
        for path in (report.parent / "tables").iterdir()
        if path.stem.startswith(("people_", "mixed_")) and path.stem not in OF_MODELS
    ]
    names = {"scenarios", "h1", "h2", "h3", "h4", "response_times", "flagged"}
    assert {f"mixed_{name}" for name in names} <= {path.stem for path in of_people}
    for table in of_people:
        assert (tmp_path / "one" / "tables" / table.name).read_bytes() == table.read_bytes()
    assert "Do people differ between scenarios?" in text
    figures = {path.name for path in (tmp_path / "one" / "figures").iterdir()}
    assert figures == {f"{name}.{kind}" for name in ("difficulty", "response_time")
                       for kind in ("svg", "pdf", "png", "csv")}  # fmt: skip
    numbers = json.loads((tmp_path / "one" / "report.json").read_text())
    assert numbers["people_by_scenario"] and "comparison" not in numbers


@pytest.mark.nightly
def test_a_rehearsal_with_only_people_is_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "responses.csv"
    responses().assign(simulated=True).to_csv(path, index=False)
    command = ["compare", "--responses", str(path), "--simulated", "--resamples", "20"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    assert f"physion: warning: {REHEARSAL}" in capsys.readouterr().err
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert f'<p class="mark">{REHEARSAL}</p>' in text and "Warnings" not in text
    (tmp_path / "exclude.txt").write_text(f"{STEMS['drop']}_00001\n")
    assert main([*command, "--exclude", str(tmp_path / "exclude.txt")]) == 2
    error = capsys.readouterr().err
    assert f"closest: {STEMS['drop']}_00" in error and error.count("\n") == 1
