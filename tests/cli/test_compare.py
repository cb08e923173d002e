"""The verb compare and its sub-verbs."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import physion
from physion.cli.compare.compare import SUBVERBS
from physion.cli.main import main
from physion.trials.index import COLUMNS, TrialPaths


def predictions(official: Path, path: Path, model: str = "m", skill: float = 0.8) -> Path:
    """Write predictions that are right for the fraction ``skill`` of the official stimuli."""
    names = pd.read_csv(official / "stimuli" / "stimulus_names_and_labels.csv")
    right = np.random.default_rng(0).random(len(names)) < skill
    said = names["label"].to_numpy() == right
    p = np.where(said, 0.9, 0.1)
    pd.DataFrame(
        {
            "Model": model,
            "Readout Type": "B",
            "Predicted Prob_false": 1 - p,
            "Predicted Prob_true": p,
            "Predicted Outcome": said,
            "Actual Outcome": names["label"],
            "Stimulus Name": names["stim_ID"],
            "Versions": "made up 1",
        }
    ).to_csv(path, index=False)
    return path


@pytest.mark.parametrize("verb", sorted(SUBVERBS))
def test_every_verb_below_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["compare", verb, "--help"])
    assert left.value.code == 0
    assert f"physion compare {verb}" in capsys.readouterr().out


def test_help_names_the_verbs_below(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["compare", "--help"])
    out = capsys.readouterr().out
    assert all(f"physion compare {verb}" in out for verb in SUBVERBS)
    assert "physion compare FILES... --humans DIR" in out


@pytest.mark.parametrize("words", [["compare"], *(["compare", verb] for verb in sorted(SUBVERBS))])
def test_help_imports_nothing_heavy(words: list[str]) -> None:
    code = (
        "import sys\nfrom physion.cli.main import main\n"
        f"try: main({[*words, '--help']!r})\nexcept SystemExit: pass\n"
        "heavy = {'numpy', 'torch', 'scipy', 'matplotlib', 'pandas'} & set(sys.modules)\n"
        "sys.exit(' '.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_old_form_writes_the_report(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = predictions(official, tmp_path / "m.csv")
    command = ["compare", str(file), "--humans", str(official / "humans")]
    assert main([*command, "--out", str(tmp_path / "report")]) == 0
    assert "report:" in capsys.readouterr().out
    assert (tmp_path / "report" / "tables" / "comparison.csv").is_file()


def test_without_files_it_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["validate"], ["leaderboard"]):
        assert main(["compare", *words]) == 2
        assert "no file of predictions" in capsys.readouterr().err


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
    answers[["session", "stimulus"]].to_csv(folder / "lists.csv", index=False)
    p = generator.random(32).round(3)
    pd.DataFrame(
        {
            "Model": "m",
            "Readout Type": "B",
            "Readout Test Data": [scenario for scenario, _ in stimuli],
            "Predicted Prob_true": p,
            "Predicted Outcome": p > 0.5,
            "Actual Outcome": np.arange(32) % 2 == 0,
            "Stimulus Name": [name for _, name in stimuli],
        }
    ).to_csv(folder / "m.csv", index=False)
    dataset = folder / "dataset"
    index = pd.DataFrame(index=range(32), columns=list(COLUMNS)).assign(
        trial=[name for _, name in stimuli], scenario=[scenario for scenario, _ in stimuli],
        split="testing", elements=np.arange(32) % 3 + 1,
        distractors=pd.array(np.arange(32) % 4, dtype="Int64"), occluders=0,
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


@pytest.mark.slow
def test_every_option_of_a_comparison_reaches_the_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = own_study(tmp_path)
    command = ["compare", str(own.predictions), "--responses", str(own.responses), "--json"]
    command += ["--resamples", "60", "--out", str(tmp_path / "report")]
    assert main(command) == 0
    plain = json.loads(capsys.readouterr().out)
    assert Path(plain["report"]).is_file()
    flags = {row["session"]: row["incomplete"] for row in plain["people_flags"]}
    assert [session for session, flag in flags.items() if flag] == ["drop-p0"]
    intervals = plain["methods"]["Intervals of people's accuracy and agreement"]
    assert "60 resamples, seed 0" in intervals
    assert (
        "sessions answered: collide 16, drop 16; 1 session lacked some"
        in (plain["methods"]["Trials of a whole session"])
    )
    assert all(row["reason"] for row in plain["people_hypotheses"] if row["hypothesis"] == "H1")
    command += ["--expected", str(own.expected), "--attributes", str(own.dataset)]
    command += ["--movies", str(own.dataset), "--rules", "official-code", "--seed", "5"]
    command += ["--trial-pages"]
    assert main(command) == 0
    found = json.loads(capsys.readouterr().out)
    assert not any(row["incomplete"] for row in found["people_flags"])
    assert (
        "study's list: collide 16, drop 12 to 16" in (found["methods"]["Trials of a whole session"])
    )
    assert "official-code" in found["methods"]["People"]
    assert "seed 5" in found["methods"]["Intervals of people's accuracy and agreement"]
    slopes = {row["hypothesis"]: row for row in found["people_hypotheses"]
              if row["scenario"] == "all"}  # fmt: skip
    assert slopes["H1"]["b"] is not None and slopes["H2"]["b"] is not None
    assert slopes["H1"]["stimuli"] == 32 and "vary" in slopes["H3"]["reason"]
    assert {row["elements"] for row in found["people_attributes"]} == {1, 2, 3}
    page = Path(found["report"]).read_text(encoding="utf-8")
    assert "<video" in page
    pages = {path.name for path in (Path(found["report"]).parent / "trials").iterdir()}
    assert len(pages) == 1 + 32 and "index.html" in pages
    assert "32 by the table that was given" in page


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
    page = (Path(__file__).parents[2] / "docs" / "analysis.md").read_text(encoding="utf-8")
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
    strangers.write_text("stimulus,session\ndrop_000,nobody\n")
    for words, told in (
        (["--attributes", str(other)], "about responses"),
        ([*people, "--attributes", str(other)], "elsewhere"),
        ([*people, "--expected", str(strangers)], "nobody"),
        ([*people, "--expected", str(other)], "stimulus"),
        ([*people, "--rules", "offical-code"], "official-code"),
        ([*people, "--resamples", "0"], "resamples"),
        ([*people, "--movies", str(tmp_path)], "dataset"),
    ):
        if words[-1] == str(other) and "--expected" in words:
            other.write_text("session\ndrop-p0\n")
        assert main([*base, *words]) == 2, words
        message = capsys.readouterr().err
        assert told in message and message.count("\n") == 1, message
    assert not (tmp_path / "out").exists()


# --- official -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_official_prints_and_writes_the_published_numbers(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tables"
    assert main(["compare", "official", str(official), "--out", str(out)]) == 0
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


def test_official_as_json(official: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "official", str(official), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    dpi = [row for row in found["tables"]["accuracies"] if row["model"] == "DPI"]
    assert len(dpi) == 8 and all(0 < row["published"] < 1 for row in dpi)
    assert "detection" in found["words"]["accuracies"]


def test_official_of_another_folder_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", "official", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "results" in message
    assert not (tmp_path / "out").exists()


# --- validate -----------------------------------------------------------------------------------


def test_validate_a_good_file(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = predictions(official, tmp_path / "m.csv")
    assert main(["compare", "validate", str(file), "--humans", str(official / "humans")]) == 0
    out = capsys.readouterr().out
    assert "1200 rows, 1 models, 0 errors, 0 warnings" in out and "leakage" in out


def test_validate_names_the_bad_row(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = (predictions(official, tmp_path / f"{name}.csv") for name in ("good", "bad"))
    rows = pd.read_csv(bad, dtype=str)
    rows.loc[41, "Predicted Prob_true"] = "1.5"
    rows.to_csv(bad, index=False)
    assert main(["compare", "validate", str(good), str(bad)]) == 1
    line = next(line for line in capsys.readouterr().out.splitlines() if "error: " in line)
    assert "row 42" in line and rows.loc[41, "Stimulus Name"] in line and "bad.csv" in line
    assert main(["compare", "validate", str(good), str(bad), "--json"]) == 1
    first, second = json.loads(capsys.readouterr().out)
    assert (first["errors"], second["errors"]) == (0, 1)
    assert second["faults"][0]["row"] == 42 and second["faults"][0]["level"] == "error"


def test_validate_finds_what_the_readout_was_fitted_on(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = predictions(official, tmp_path / "m.csv")
    fitted = tmp_path / "fitted.txt"
    fitted.write_text(str(pd.read_csv(file)["Stimulus Name"].iloc[7]) + "\n")
    assert main(["compare", "validate", str(file), "--fitted", str(fitted)]) == 1
    assert "row 8" in capsys.readouterr().out


def test_validate_needs_the_labels_that_were_asked_for(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = predictions(official, tmp_path / "m.csv")
    assert main(["compare", "validate", str(file), "--humans", str(tmp_path)]) == 2
    assert "--labels" in capsys.readouterr().err


# --- leaderboard --------------------------------------------------------------------------------


def test_leaderboard_prints_and_writes(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [
        predictions(official, tmp_path / f"{name}.csv", name, skill)
        for name, skill in (("weak", 0.55), ("good", 0.85))
    ]
    command = ["compare", "leaderboard", *map(str, files), "--humans", str(official / "humans")]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:5] == ["1", "1", "to", "1", "good"] and "made up 1" in lines[1]
    assert "left out" in lines[-1]
    table = pd.read_csv(tmp_path / "out" / "leaderboard.csv")
    anchors = ["recorded outcome", "majority of people"]
    person = "one person with another"
    assert list(table["model"]) == ["good", "weak", person, *anchors]
    assert list(table["kind"]) == ["model", "model", "people", "anchor", "anchor"]
    assert set(table["stimuli"]) == {1144}
    below = lines[lines.index("Anchors: what a score is worth") + 2 :]
    assert [line[:18].strip() for line in below[:2]] == [name[:18].strip() for name in anchors]
    assert lines[lines.index("People") + 2].startswith(person)
    written = json.loads((tmp_path / "out" / "leaderboard.json").read_text())
    assert [row["model"] for row in written["anchors"]] == [person, *anchors]
    assert {"Made with", "Date", "Licence"} <= set(written["settings"])
    assert (tmp_path / "out" / "leaderboard.html").read_text().startswith("<!DOCTYPE html>")
    scenarios = pd.read_csv(tmp_path / "out" / "leaderboard_by_scenario.csv")
    assert scenarios.groupby("agent")["scenario"].nunique().eq(8).all()
    assert written["rows"][0]["kappa"] is None and written["rows"][0]["accuracy"] > 0.8
    assert main([*command, "--sort", "rmsd", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows[0]["rmsd"] < rows[1]["rmsd"]
    assert main([*command, "--sort", "accuracy", "--ascending", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["model"] == "weak"


def test_leaderboard_of_chosen_rows_says_licence_and_date(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [
        predictions(official, tmp_path / f"{name}.csv", name, skill)
        for name, skill in (("weak", 0.55), ("good", 0.85))
    ]
    command = ["compare", "leaderboard", *map(str, files), "--json"]
    said = ["--license", "CC BY 4.0", "--date", "2026-11-01"]
    assert main([*command, "--model", "OO", *said]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["model"] for row in found["rows"]] == ["good"]
    settings = found["settings"]
    assert (settings["Licence"], settings["Date"]) == ("CC BY 4.0", "2026-11-01")
    assert settings["Made with"] == f"physion {physion.__version__}"
    assert main([*command, "--readout", "full"]) == 2
    assert "no model passes the filters" in capsys.readouterr().err


def test_leaderboard_of_later_contacts_needs_their_column(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = predictions(official, tmp_path / "m.csv")
    command = ["compare", "leaderboard", str(file), "--later", "--json"]
    assert main(command) == 2
    assert "Observed Contact" in capsys.readouterr().err
    rows = pd.read_csv(file)
    rows["Observed Contact"] = rows["Actual Outcome"] & (np.arange(len(rows)) % 3 == 0)
    rows.to_csv(file, index=False)
    assert main(command) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    ledge = rows["Stimulus Name"].str.contains("ledge")
    assert row["stimuli"] == (~rows["Observed Contact"] & ~ledge).sum()


def test_leaderboard_goes_on_without_a_bad_file(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = predictions(official, tmp_path / "good.csv")
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    command = ["compare", "leaderboard", str(good), str(tmp_path / "bad.csv")]
    assert main(command) == 1
    told = [line for line in capsys.readouterr().out.splitlines() if "not compared" in line]
    assert len(told) == 1 and told[0].count("bad.csv") == 1
    assert main([*command, "--sort", "acuracy"]) == 2
    assert "accuracy" in capsys.readouterr().err


def test_leaderboard_with_single_participants_has_kappa(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        (f"{scenario}-p{person}", scenario, f"{scenario}_{k:03d}", "test", k, word, k % 2 == 0)
        for scenario in ("collide", "drop")
        for person in range(4)
        for k in range(12)
        for word in [("yes", "no")[(k + (k * person) % 5 // 3) % 2]]
    ]
    columns = ["participant", "scenario", "stimulus", "phase", "trial", "response", "label"]
    answers = pd.DataFrame(rows, columns=columns)
    answers = answers.assign(session=answers["participant"], rt_ms=900, simulated=False)
    answers["correct"] = (answers["response"] == "yes") == answers["label"]
    # A session that no person made: it must not count, and be told.
    robot = answers[answers["session"] == "drop-p3"].assign(simulated=True)
    answers = pd.concat([answers[answers["session"] != "drop-p3"], robot])
    answers.to_csv(tmp_path / "trials.csv", index=False)
    one = answers.drop_duplicates("stimulus")
    p = np.where(one["label"], 0.8, 0.3)
    predictions_of_all = pd.DataFrame(
        {
            "Model": "m",
            "Readout Type": "B",
            "Readout Test Data": one["scenario"],
            "Predicted Prob_true": p,
            "Predicted Outcome": p > 0.5,
            "Actual Outcome": one["label"],
            "Stimulus Name": one["stimulus"],
        }
    )
    predictions_of_all.to_csv(tmp_path / "m.csv", index=False)
    command = ["compare", "leaderboard", str(tmp_path / "m.csv")]
    assert main([*command, "--responses", str(tmp_path / "trials.csv"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    (row,) = found["rows"]
    assert [(drop["scenario"], drop["rows"]) for drop in found["dropped_answers"]] == [("drop", 12)]
    assert row["accuracy"] == 1 and row["stimuli"] == 24 and "kappa" not in row["reason"]
    assert row["kappa_low"] < row["kappa"] < row["kappa_high"] and 0 < row["kappa"] < 1


def test_leaderboard_flags_sessions_and_reads_the_raw_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = own_study(tmp_path)
    command = ["compare", "leaderboard", str(own.predictions), "--responses", str(own.responses)]
    assert main(command) == 0
    assert "1 of 16 sessions flagged by the rules “preregistered”" in capsys.readouterr().out
    assert main([*command, "--expected", str(own.expected), "--rules", "official-code"]) == 0
    assert "0 of 16 sessions flagged by the rules “official-code”" in capsys.readouterr().out
    assert main([*command[:3], "--accept-rules", "slow"]) == 2
    assert "--responses" in capsys.readouterr().err
    assert main([*command[:3], "--rules", "official-code"]) == 2
    assert "--responses" in capsys.readouterr().err
    answers = pd.read_csv(own.responses)
    raw = pd.DataFrame(
        {
            "gameID": answers["session"],
            "trialNum": answers["trial"],
            "stim_ID": answers["stimulus"],
            "response": answers["response"].str.upper(),
            "target_hit_zone_label": answers["label"],
            "rt": answers["rt_ms"] + 5000,
        }
    )
    files = []
    for scenario, study in (("collide", "collision"), ("drop", "drop")):
        files.append(tmp_path / f"human_responses-{study}_pilot.csv")
        raw[answers["scenario"] == scenario].to_csv(files[-1], index=False)
    kappas = []
    for responses in ([str(own.responses)], [str(file) for file in files]):
        assert main([*command[:3], "--responses", *responses, "--json"]) == 0
        kappas.append(json.loads(capsys.readouterr().out)["rows"][0]["kappa"])
    assert kappas[0] == kappas[1] is not None


def test_too_many_left_out_is_one_line_and_stray_answers_are_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = own_study(tmp_path)
    answers = pd.read_csv(own.responses)
    stray = answers[answers["session"] == "drop-p1"].tail(1).assign(stimulus="drop_x", trial=99)
    pd.concat([answers, stray]).to_csv(own.responses, index=False)
    command = ["compare", "leaderboard", str(own.predictions), "--responses", str(own.responses)]
    assert main(command) == 0
    told = capsys.readouterr()
    assert "1 of 16 sessions flagged" in told.out
    assert told.err.count("\n") == 1 and "warning: drop: answers" in told.err
    listed = pd.read_csv(own.expected)
    few = tmp_path / "expected.csv"
    pd.concat([listed, listed[:16].assign(stimulus="drop_y")]).to_csv(few, index=False)
    assert main(command) == 2
    told = capsys.readouterr()
    assert told.err.count("\n") == 1
    assert "'incomplete' leaves out 8 of 8 sessions of collide" in told.err
    assert main([*command, "--accept-rules", "incomplete", "--out", str(tmp_path / "out")]) == 0
    assert "8 of 16 sessions flagged" in capsys.readouterr().out
    page = (tmp_path / "out" / "leaderboard.html").read_text(encoding="utf-8")
    assert "Rules confirmed" in page and "incomplete (collide 8 of 8)" in page
