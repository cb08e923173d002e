"""The verb compare and its sub-verbs."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from physion.cli import output
from physion.cli.evaluate import _print_scores as print_evaluation
from physion.cli.main import main
from physion.cli.output import OutputConsole, print_scores
from physion.data.official import official as physion_official
from physion.readout.evaluation import EvaluatedModel, Evaluation
from physion.report.compare import compare
from physion.report.inputs import ReportInputs
from physion.report.scores import scores
from physion.trials.files import TrialPaths
from physion.trials.index import COLUMNS


def predictions(official: Path, path: Path, model: str = "m", skill: float = 0.8) -> Path:
    """Write predictions that are right for the fraction ``skill`` of the official stimuli."""
    names = pd.read_csv(official / "stimuli" / "stimulus_names_and_labels.csv")
    right = np.random.default_rng(0).random(len(names)) < skill
    said = names["label"].to_numpy() == right
    p = np.where(said, 0.9, 0.1)
    pd.DataFrame(
        {"Model": model, "Readout Type": "B", "Predicted Prob_false": 1 - p,
         "Predicted Prob_true": p, "Predicted Outcome": said, "Actual Outcome": names["label"],
         "Stimulus Name": names["stim_ID"], "Versions": "made up 1"}
    ).to_csv(path, index=False)  # fmt: skip
    return path


@pytest.mark.slow
def test_two_columns_are_enough_and_the_terminal_shows_the_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = physion_official().labels
    names = [name for name in labels if name.startswith(("pilot_it2_drop", "pilot_it2_coll"))]
    p = [0.9 if labels[name] else 0.2 for name in names]
    for name, columns in (("good", ["stimulus", "p_contact"]), ("same", ["stimulus", "p"])):
        table = pd.DataFrame({columns[0]: names, columns[1]: p})
        table["fit_on"] = "mine 1b2c" if name == "good" else ""
        table.to_csv(tmp_path / f"{name}.csv", index=False)
    files = [str(tmp_path / f"{name}.csv") for name in ("good", "same")]
    command = ["compare", *files, "--out", str(tmp_path / "out")]
    assert main([*command, "--humans", "official"]) == 0
    out = capsys.readouterr().out
    for more in ((), ("--labels", "official")):
        assert main([*command, *more]) == 0
        assert capsys.readouterr().out == out, "known by the stimuli's names"
    lines = out.splitlines()
    assert len(lines) <= 26, "25 lines, then the path"
    assert lines[1].split() == ["model", "given", "accuracy", "r", "with", "people", "kappa"]
    rows = [re.split(r"\s{2,}", line) for line in lines[2:-3]]
    names = [row[0] for row in rows]
    assert names[:3] == ["one person with another", "majority of people", "people of the study *"]
    assert set(names[3:6]) == {"good", "same", "recorded outcome"}
    own = {row[0]: row[-3:] for row in rows}
    assert own["good"][0] == "1.000 [1.000, 1.000]" and own["good"] == own["same"]
    assert {"DPI-Net *", "pDeIT-lstm *"} < set(names[6:]) and "V-JEPA 2 ViT-L *" not in names
    assert lines[-3].startswith("* published, not run here")
    assert lines[-2] == "Readouts fitted on mine 1b2c: good"
    assert "Readouts fitted on mine 1b2c: good." in (tmp_path / "out/report.html").read_text()
    assert lines[-1] == f"report: {tmp_path / 'out' / 'report.html'}"


@pytest.mark.nightly
@pytest.mark.slow
def test_the_recorded_outcome_decides_and_differences_are_listed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Movies and a simulation of the same stimuli, of which seven end otherwise in the latter."""
    labels = physion_official().labels
    names = sorted(name for name in labels if name.startswith("pilot_it2_drop"))
    other = set(names[::20][:7])
    for name, differ in (("movies", set()), ("simulated", other)):
        rows = [f"{one},{0.9 if labels[one] else 0.2},{labels[one] != (one in differ)}\n"
                for one in names]  # fmt: skip
        (tmp_path / f"{name}.csv").write_text("stimulus,probability,outcome\n" + "".join(rows))
    files = [str(tmp_path / f"{name}.csv") for name in ("movies", "simulated")]
    assert main(["compare", *files, "--population", "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    shown = [line.split() for line in out.splitlines() if line.startswith(("movies", "simulated"))]
    assert [row[1] for row in shown] == ["1.000", "1.000"], "both are right about what was recorded"
    (note,) = (line for line in out.splitlines() if line.startswith("note: "))
    assert f"7 of {len(names)} stimuli" in note and "and 2 more" in note
    assert set(re.findall(r"pilot_it2_drop\w+", note)) < other
    listed = pd.read_csv(tmp_path / "out" / "tables" / "changed_outcomes.csv")
    assert set(listed["stimulus"]) == other and set(listed["models"]) == {"simulated"}
    # Both as one population, which agrees.
    (row,) = (line.split() for line in out.splitlines() if re.match(r"models +2 ", line))
    assert row[4] == "1.000"
    assert {"kappa of majorities", "Accuracy less people's"} <= set(re.split(r"\s{2,}|\n", out))
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Populations" in page and "kappa of members" in page
    written = pd.read_csv(tmp_path / "out" / "tables" / "population_consensus.csv")
    assert set(written["population"]) == {"people", "models"}


@pytest.mark.slow
def test_own_stimuli_need_scenario_and_outcome(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "own.csv"
    command = ["compare", str(file), "--out", str(tmp_path / "out")]
    for more, cells, advice in (("", "", "column scenario"), (",scenario", ",drop", "--labels")):
        file.write_text(f"stimulus,p{more}\nmine_1,0.3{cells}\nmine_2,0.7{cells}\n")
        assert main(command) == 2
        error = capsys.readouterr().err
        assert "'mine_1'" in error and advice in error
    file.write_text("stimulus,p\npilot_it2_drop_x,0.3\npilot_it2_drop_y,0.7\n")
    assert main(command) == 2
    assert "are no stimuli of the study" in (error := capsys.readouterr().err)
    assert "(closest: 'pilot_it2_drop_" in error
    file.write_text("stimulus,p,scenario,outcome\nmine_1,0.3,drop,0\nmine_2,0.7,drop,0\n")
    assert main(command) == 0
    (row,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("own"))
    assert row.split()[1] == "0.500", "p > 0.5 for one of two that never touch"


@pytest.mark.slow
def test_page_and_terminal_show_the_same_average(capsys: pytest.CaptureFixture[str]) -> None:
    """Two stimuli of each scenario leave no r by scenario, so that only the pooled one is known."""
    labels = physion_official().labels
    stems = ("pilot_it2_drop", "pilot_it2_collision", "pilot_it2_rollingSliding_simple_box")
    names = [name for stem in stems for name in [n for n in labels if n.startswith(stem)][:2]]
    few = {name: 0.3 + 0.1 * k for k, name in enumerate(names)}
    for given, first, other in (
        (few, "All stimuli pooled", "Mean over scenarios"),
        ({name: 0.2 + 0.5 * labels[name] for name in labels}, "Mean over scenarios",
         "All stimuli pooled"),
    ):  # fmt: skip
        result = compare({"m": given}, humans="official")
        assert isinstance(result.inputs, ReportInputs)
        print_scores(result)
        out = capsys.readouterr().out
        assert first.lower() in out
        assert re.search(r"^\* published.*, mean over scenarios$", out, re.MULTILINE)
        page = str(scores(result.inputs.comparison))
        assert page.index(first) < page.index(other)
        stimuli = result.inputs.comparison.stimuli
        if given is few:
            r = np.corrcoef(stimuli["p_contact"], stimuli["p_yes"])[0, 1]
            shown = result.summary.set_index("model")["r with people"]
            assert shown["m"].startswith(f"{r:.3f}")


def test_stimuli_that_people_did_not_see_are_counted_over_all_scenarios() -> None:
    labels = physion_official().labels
    p = {name: 0.9 if labels[name] else 0.2 for name in labels if "drop" in name or "link" in name}
    unseen = [f"{stem}new_{k}" for stem in ("pilot_it2_drop_", "pilot_linking_") for k in range(3)]
    for names, shown in ((unseen, "6 stimuli"), (unseen[:1], "1 stimulus")):
        models = {"all": p | dict.fromkeys(names, 0.5), "fewer": p | {names[0]: 0.5}}
        result = compare(models)
        assert result.notes == (f"{shown} left out: people did not see it",)
        counted = f"{len(names)} of {len(p) + len(names)} predicted names"
        (warning,) = (words for words in result.warnings if counted in words)
        assert names[0] in warning and "closest: 'pilot_it2_drop_" in warning


def test_the_table_fits_its_lines_and_the_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    labels = physion_official().labels
    names = [name for name in labels if "drop" in name]
    tables = [
        pd.DataFrame(
            {"stimulus": [*names, "nonsense"], "p_contact": 0.4, "model": f"model {k}",
             "fit_on": f"set {k % 4}", "frames": "2 to 44, 5/s", "benchmark": "v1"}
        )
        for k in range(12)
    ]  # fmt: skip
    result = compare(tables)
    for width, frames, intervals in (
        (None, True, True), (200, True, True), (110, False, True), (80, False, False)
    ):  # fmt: skip
        terminal = OutputConsole(highlight=False, force_terminal=width is not None, width=width)
        monkeypatch.setattr(output, "console", terminal)
        print_scores(result)
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) == 25 and lines[0].startswith("note: ")
        assert sum(line.startswith("Readouts fitted on") for line in lines) == 4
        assert ("frames" in lines[2], "intervals" in lines[1], "[" in lines[3]) == (
            frames, intervals, intervals
        )  # fmt: skip
        rows = [line for line in lines[2:] if line.startswith("model ")]
        assert width is None or max(map(len, rows)) <= width


def test_evaluations_print_what_the_comparison_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [name for name in physion_official().labels if "drop" in name][:3]
    file = tmp_path / "m.csv"
    file.write_text("stimulus,p\n" + "".join(f"{name},0.4\n" for name in [*names, "test99_0001"]))
    print_evaluation(Evaluation([EvaluatedModel("m", "", 0, file, None, True, {})], {}))
    shown = capsys.readouterr()
    assert shown.out.startswith("note: 1 stimulus left out")
    assert shown.err.startswith("physion: warning: compared on only 3 stimuli")


def test_folders_and_endings_of_files_are_no_part_of_a_name() -> None:
    names = [name for name in physion_official().labels if "drop" in name][:20]
    files = [f"m/{names[0]}", f"C:\\m\\{names[1]}_img.webm", f"{names[2]}.npy", *names[3:]]
    result = compare({"files": dict.fromkeys(files, 0.4), "names": dict.fromkeys(names, 0.4)})
    assert not result.notes
    assert set(result.scores.query("base_model.notna()")["stimuli"]) == {20}


def test_without_files_it_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in (([], "no predictions"), (["--check"], "nothing to check")):
        assert main(["compare", *words]) == 2
        assert said in capsys.readouterr().err


@dataclass(frozen=True)
class Own:
    """Write a study of new stimuli: predictions, responses, dataset, expected stimuli."""

    predictions: Path
    responses: Path
    dataset: Path
    expected: Path


def own_study(folder: Path) -> Own:
    """Return eight people per scenario; the first of Drop saw 12 of the 16 stimuli."""
    generator = np.random.default_rng(1)
    stimuli = [(scenario, f"{scenario}_{k:03d}") for scenario in ("collide", "drop")
               for k in range(16)]  # fmt: skip
    rows = [
        {"participant": f"{scenario}-p{person}", "session": f"{scenario}-p{person}",
         "scenario": scenario, "stimulus": name, "phase": "test", "trial": k % 16,
         "simulated": False, "label": k % 2 == 0, "rt_ms": 900 + 100 * generator.random(),
         "response": "yes" if (generator.random() < 0.7) == (k % 2 == 0) else "no"}
        for k, (scenario, name) in enumerate(stimuli)
        for person in range(8)
        if (scenario, person) != ("drop", 0) or k % 16 < 12
    ]  # fmt: skip
    answers = pd.DataFrame(rows)
    answers.to_csv(folder / "trials.csv", index=False)
    expected = answers[["scenario", "stimulus"]].drop_duplicates()
    expected.to_csv(folder / "lists.csv", index=False)
    p = generator.random(32).round(3)
    pd.DataFrame(
        {"Model": "m", "Readout Type": "B", "Readout Test Data": [s for s, _ in stimuli],
         "Predicted Prob_true": p, "Predicted Outcome": p > 0.5,
         "Actual Outcome": np.arange(32) % 2 == 0, "Stimulus Name": [name for _, name in stimuli]}
    ).to_csv(folder / "m.csv", index=False)  # fmt: skip
    dataset = folder / "dataset"
    index = pd.DataFrame(index=range(32), columns=list(COLUMNS)).assign(
        trial=[name for _, name in stimuli], scenario=[scenario for scenario, _ in stimuli],
        split="testing", elements=np.arange(32) % 3 + 1,
        distractors=pd.array(np.arange(32) % 4, dtype="Int64"), occluders=0,
        movie_sha256=hashlib.sha256(b"not a movie").hexdigest(),
    )  # fmt: skip
    for name, dtype in COLUMNS.items():
        if dtype in ("bool", "int64", "float64") and index[name].isna().any():
            index[name] = pd.Series(0, index.index).astype(dtype)
    for scenario, name in stimuli:
        movie = TrialPaths(dataset, "testing", scenario, name).movie
        movie.parent.mkdir(parents=True, exist_ok=True)
        movie.write_bytes(b"not a movie")
    index.to_parquet(dataset / "index.parquet")
    return Own(folder / "m.csv", folder / "trials.csv", dataset, folder / "lists.csv")


@pytest.mark.nightly
@pytest.mark.slow
def test_every_option_of_a_comparison_reaches_the_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = own_study(tmp_path)
    plain = compare(own.predictions, responses=own.responses, resamples=60)
    assert plain.people is not None
    tables, methods = plain.people.tables, plain.inputs.methods
    assert tables["flags"].query("incomplete")["session"].tolist() == ["drop-p0"]
    words = "sessions answered: collide 16, drop 16; 1 session lacked some"
    assert words in methods["Trials of a whole session"]
    assert tables["hypotheses"].query("hypothesis == 'H1'")["reason"].ne("").all()
    command = ["compare", str(own.predictions), "--responses", str(own.responses), "--json"]
    command += ["--resamples", "60", "--out", str(tmp_path / "report")]
    command += ["--expected", str(own.expected), "--attributes", str(own.dataset)]
    command += ["--dataset", str(own.dataset), "--rules", "official-code", "--seed", "5"]
    assert main(command) == 0
    found = json.loads(capsys.readouterr().out)
    flagged = [row["session"] for row in found["people_flags"] if row["incomplete"]]
    assert flagged == ["drop-p0"]
    assert "study's list: collide 16, drop 16" in found["methods"]["Trials of a whole session"]
    assert "official-code" in found["methods"]["People"]
    intervals = found["methods"]["Intervals of people's accuracy and agreement"]
    assert "60 resamples, seed 5" in intervals
    slopes = {row["hypothesis"]: row for row in found["people_hypotheses"]
              if row["scenario"] == "all"}  # fmt: skip
    assert slopes["H1"]["b"] is not None and slopes["H2"]["b"] is not None
    assert slopes["H1"]["stimuli"] == 32 and "vary" in slopes["H3"]["reason"]
    assert {row["elements"] for row in found["people_attributes"]} == {1, 2, 3}
    page = Path(found["report"]).read_text(encoding="utf-8")
    assert "<video" in page
    assert "32 by the table that was given" in page


@pytest.mark.nightly
@pytest.mark.slow
def test_the_python_of_the_documentation_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own = own_study(tmp_path)
    # The folders of the page: predictions of evaluate, an export of the study, the trials.
    predictions, data = tmp_path / "models" / "predictions", tmp_path / "data"
    predictions.mkdir(parents=True)
    data.mkdir()
    own.predictions.rename(predictions / "model-1234.csv")
    own.responses.rename(data / own.responses.name)
    own.expected.rename(data / "expected.csv")
    (tmp_path / "dataset").rename(tmp_path / "trials")
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "compare.md").read_text(
        encoding="utf-8"
    )
    code = page.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "analysis.md", "exec"), {})
    assert (tmp_path / "report" / "report.html").is_file()
    out = capsys.readouterr().out
    assert "elements" in out and "accuracy" in out


def test_options_that_do_not_fit_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = own_study(tmp_path)
    base = ["compare", str(own.predictions), "--out", str(tmp_path / "out")]
    people = ["--responses", str(own.responses)]
    other = tmp_path / "other.csv"
    other.write_text("stimulus,scenario,elements\nelsewhere,drop,3\n")
    strangers = tmp_path / "strangers.csv"
    strangers.write_text("stimulus,scenario\ndrop_000,nobody\n")
    sessions = tmp_path / "sessions.csv"
    sessions.write_text("session\ndrop-p0\n")
    for words, told in (
        (["--attributes", str(other)], "about responses"),
        ([*people, "--attributes", str(other)], "elsewhere"),
        ([*people, "--expected", str(strangers)], "nobody"),
        ([*people, "--expected", str(sessions)], "stimulus"),
        ([*people, "--rules", "offical-code"], "official-code"),
        ([*people, "--resamples", "0"], "resamples"),
        ([*people, "--dataset", str(tmp_path)], "dataset"),
    ):
        assert main([*base, *words]) == 2, words
        message = capsys.readouterr().err
        assert told in message and message.count("\n") == 1, message
    assert not (tmp_path / "out").exists()


# --- published numbers --------------------------------------------------------------------------


@pytest.mark.nightly
@pytest.mark.slow
def test_published_prints_and_writes_the_published_numbers(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tables"
    assert main(["compare", "--published", "--humans", str(official), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    for part in ("Accuracy as published", "Panel A", "Panel C", "Panel D", "Panel E",
                 "Regressions", "168 of 168", "0.748", "800 - 112 = 688"):  # fmt: skip
        assert part in text, part
    table = pd.read_csv(out / "tables" / "accuracies.csv")
    assert len(table) == 88
    written = json.loads((out / "published.json").read_text())
    assert {path.stem for path in (out / "tables").glob("*.csv")} == set(written["tables"])
    assert "report.html" in text and "<figure" in (out / "report.html").read_text(encoding="utf-8")
    assert {path.name for path in (out / "figures").glob("*.svg")} == {
        *(f"panel_{panel}.svg" for panel in "acde"), "figure_s1.svg", "figure_s3.svg"
    }  # fmt: skip


@pytest.mark.slow
def test_published_as_json(official: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "--published", "--humans", str(official), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    dpi = [row for row in found["tables"]["accuracies"] if row["model"] == "DPI"]
    assert len(dpi) == 8 and all(0 < row["published"] < 1 for row in dpi)
    assert "detection" in found["words"]["accuracies"]


def test_published_of_another_folder_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["compare", "--published", "--humans", str(tmp_path)]
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "results" in message
    assert not (tmp_path / "out").exists()


# --- check -----------------------------------------------------------------------------------


def test_check_a_good_file_and_what_its_readout_was_fitted_on(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = predictions(official, tmp_path / "m.csv")
    assert main(["compare", "--check", str(file), "--humans", str(official / "humans")]) == 0
    out = capsys.readouterr().out
    assert "1200 rows, 1 model, 0 errors, 0 warnings" in out and "leakage" in out
    fitted = tmp_path / "fitted.txt"
    fitted.write_text(str(pd.read_csv(file)["Stimulus Name"].iloc[7]) + "\n")
    assert main(["compare", "--check", str(file), "--fitted", str(fitted)]) == 1
    assert "row 8" in capsys.readouterr().out
    people = sorted((official / "humans").glob("human_accuracy-drop*.csv"))[0]
    (tmp_path / people.name).write_bytes(people.read_bytes())
    assert main(["compare", "--check", str(file), "--humans", str(tmp_path)]) == 2
    assert "--labels" in capsys.readouterr().err


def test_check_names_the_bad_row(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = (predictions(official, tmp_path / f"{name}.csv") for name in ("good", "bad"))
    rows = pd.read_csv(bad, dtype=str)
    rows.loc[41, "Predicted Prob_true"] = "1.5"
    rows.to_csv(bad, index=False)
    assert main(["compare", "--check", str(good), str(bad)]) == 1
    line = next(line for line in capsys.readouterr().out.splitlines() if "error: " in line)
    assert "row 42" in line and rows.loc[41, "Stimulus Name"] in line and "bad.csv" in line
    assert main(["compare", "--check", str(good), str(bad), "--json"]) == 1
    first, second = json.loads(capsys.readouterr().out)
    assert (first["errors"], second["errors"]) == (0, 1)
    assert second["faults"][0]["row"] == 42 and second["faults"][0]["level"] == "error"


def test_check_takes_the_stimuli_that_compare_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of the study, of which few are enough; names that compare refuses are errors."""
    names = [name for name in physion_official().labels if "drop" in name][:10]
    file = tmp_path / "few.csv"
    for stimuli, code, words in (
        (names, 0, "0 errors"),
        ([*names, "nonsense"], 1, "row 11 (nonsense): no such stimulus"),
        (["nonsense", "more"], 1, "2 errors"),
    ):
        file.write_text(
            "stimulus,p\n" + "".join(f"{name},0.{k}\n" for k, name in enumerate(stimuli))
        )
        assert main(["compare", "--check", str(file)]) == code
        out = capsys.readouterr().out
        assert words in out and "no list of them" not in out
    file.write_text("stimulus,p,scenario,outcome\nmine,0.3,drop,0\nother,0.6,drop,1\n")
    assert main(["compare", "--check", str(file)]) == 0
    assert "no list of them" in capsys.readouterr().out, "stimuli of one's own"
