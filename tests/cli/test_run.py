"""The verb run: sampled scenes, and the official ones compared with real people."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from physion.cli import output
from physion.cli.main import main
from physion.core.errors import BadInputError
from physion.data.official import humans_folder, official
from physion.models.build import build_model
from physion.pipeline import (
    OFFICIAL_MODELS,
    RunSettings,
    _learns,
    _once,
    balanced_trials,
    decided_models,
    methods,
    model_options,
    plan_official,
    plan_sampled,
)
from physion.scenes.tdw.read_logs import TrialSet
from physion.trials.making.plan import GenerateSettings

SMALL = ["--limit", "2", "--size", "64", "--workers", "2"]
FEW = ["--option", "steps=10", "noisy-simulation:samples=2"]


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file by its path in the folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }


@pytest.mark.nightly
@pytest.mark.slow
def test_sampled_scenes_to_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["run", "--sampled", "--out", str(tmp_path), *SMALL, *FEW, "--json"]
    assert main(command) == 0
    answer = json.loads(capsys.readouterr().out)
    page = Path(answer["report"])
    assert page.is_file() and "<html" in page.read_text()
    models = {row["base_model"] for row in answer["scores"] if row["kind"] == "model"}
    assert models == {"random-resnet18-mlp", "noisy-simulation"}
    index = pd.read_parquet(tmp_path / "trials" / "index.parquet")
    splits = {"readout": 12, "testing": 6, "training": 12}
    assert dict(index.groupby("split").size()) == splits


@pytest.mark.nightly
@pytest.mark.slow
def test_the_first_command_compares_models_with_people(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ["--models", "noisy-simulation,state-trees,chance"]
    command = ["run", "--out", str(tmp_path), *SMALL, *FEW, *few, "--json"]
    assert main(command) == 0
    answer = json.loads(capsys.readouterr().out)
    scores = pd.DataFrame(answer["scores"])
    assert {"noisy-simulation", "state-trees", "chance"} <= set(scores["base_model"])
    rows = scores[(scores["scenario"] == "pooled") & (scores["base_model"] == "noisy-simulation")]
    assert rows["stimuli"].item() >= 14  # two a scenario; Roll trials with a ledge may be left out
    assert 0.5 < rows["human_accuracy"].item() < 1
    stimuli = pd.read_csv(Path(answer["report"]).parent / "tables" / "stimuli.csv")
    page = Path(answer["report"]).read_text()
    assert page.count("<video") >= 8 and "Will the red object touch the yellow one?" in page
    assert "noisy-simulation and state-trees: the true state of the scene" in page
    assert "chance: nothing of the trial" in page
    index = pd.read_parquet(tmp_path / "trials" / "index.parquet").set_index("trial")
    for row in stimuli.itertuples():
        assert row.label == index.loc[row.stimulus, "recorded_contact"]
    tested = index[index["split"] == "testing"]
    assert (tested.groupby("scenario")["recorded_contact"].sum() == 1).all(), "balanced"
    first = digests(tmp_path)
    (tmp_path / "report" / "report.html").write_text("changed")
    # No progress on a slow machine but the first line.
    monkeypatch.setattr(output, "_LINE_EVERY", math.inf)
    monkeypatch.setattr(output, "_NAMED_AFTER", math.inf)
    assert main(command) == 0
    again = capsys.readouterr()
    assert json.loads(again.out) == answer and again.err == "building models: 0 of 3\n"
    assert digests(tmp_path) == first, "what was changed is made again, nothing else changes"


@pytest.mark.nightly
@pytest.mark.slow
def test_command_logs_against_people(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", "--scenes", str(official / "scenes"), "--humans", str(official / "humans")]
    command += [*SMALL, "--limit", "1", "--models", "chance,noisy-simulation-people"]
    command += ["--option", "noisy-simulation-people:samples=4", "--decision", "touch"]
    command += ["--out", str(tmp_path)]
    assert main(command) == 0
    shown = capsys.readouterr()
    *table, last = shown.out.splitlines()
    assert re.match(r"report, made in \d+ min \d+ s: ", last) and len(table) <= 25
    shown_early = re.search(r"^chance · observed: accuracy [01]\.\d{3}$", shown.err, re.MULTILINE)
    assert shown_early, "rows appear as models finish"
    assert shown.err.startswith("building models: 0 of 2\n"), "something is said at once"
    (header,) = (line for line in table if line.startswith("model "))
    assert "accuracy" in header and "r with people" in header
    assert any(line.startswith("chance") for line in table)
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    scores, methods = pd.DataFrame(report["comparison"]), report["methods"]
    assert scores["human_accuracy"].notna().any()
    assert "noisy-simulation-people-touch" in set(scores["base_model"])
    assert methods["Decision"] == "touch in place of the own one: noisy-simulation-people"


@pytest.mark.slow
def test_a_larger_limit_adds_to_the_trials_of_a_smaller_one() -> None:
    trials = official().trials
    few, more = (balanced_trials(trials, limit) for limit in (3, 7))
    assert {t.scene.name for t in few} < {t.scene.name for t in more}
    counts = pd.Series([t.outcome.contact for t in more]).groupby([t.scene.scenario for t in more])
    assert (counts.size() == 7).all() and counts.sum().isin((3, 4)).all()
    assert len(balanced_trials(trials, None)) == len(trials)


@pytest.mark.slow
@pytest.mark.parametrize("limit", [3, 4])
def test_tested_and_fitted_trials_together_have_either_outcome_as_often(limit: int) -> None:
    """Else what says the more frequent outcome of the fit is right more often than by chance."""
    plan = plan_official(Path("official"), humans_folder(Path("official")), limit)
    rows = [(task.scenario, task.split, plan.recorded[task.scene.name])
            for task in plan.tasks if task.scene]  # fmt: skip
    table = pd.DataFrame(rows, columns=["scenario", "split", "contact"])
    assert (table.groupby("scenario")["contact"].mean() == 0.5).all()
    assert (table.groupby(["scenario", "split"]).size() == limit).all()


@pytest.mark.slow
def test_scenarios_begin_with_either_outcome_in_turn() -> None:
    ones = balanced_trials(official().trials, 1)
    scenarios = sorted({trial.scene.scenario for trial in ones})
    first = {trial.scene.scenario: trial.outcome.contact for trial in ones}
    assert [first[name] for name in scenarios] == [k % 2 == 0 for k in range(len(scenarios))]


def test_sampled_trials_are_twice_as_many_for_the_readout() -> None:
    tasks = plan_sampled(3).tasks
    counts = Counter((task.scenario, task.split) for task in tasks)
    assert set(counts.values()) == {3, 6} and len(counts) == 6
    assert all(counts[scenario, "readout"] == 6 for scenario, _ in counts)


@pytest.mark.slow
def test_what_learns_is_trained_on_trials_that_show_no_roles() -> None:
    """As many as fit the readout, of another split, whose movies have the free colours."""
    tasks = plan_sampled(3, learn=True).tasks
    counts = Counter((task.scenario, task.split) for task in tasks)
    assert set(counts.values()) == {3, 6} and len(counts) == 9
    assert all(counts[s, "training"] == counts[s, "readout"] for s, _ in counts)
    plans = [plan_official(Path("official"), None, 2, learn=learn).tasks for learn in (False, True)]
    added = plans[1][: len(plans[0])] and [t for t in plans[1] if t.split == "training"]
    assert [t for t in plans[1] if t.split != "training"] == plans[0]
    readout = Counter(task.scenario for task in plans[0] if task.split == "readout")
    assert Counter(task.scenario for task in added) == readout
    assert all(task.scene is None and task.presets for task in added)
    assert GenerateSettings(look="split").looks("training") == ("free",)
    assert GenerateSettings(look="split").looks("readout") == ("redyellow",)
    learn = [name for name in OFFICIAL_MODELS if _learns(build_model(name))]
    assert learn == ["pEffNetLite0-mlp"], "the weights of the others ship, or they have none"


def test_two_different_trials_of_one_name_are_refused_with_their_files(tmp_path: Path) -> None:
    trials = official().trial_set("drop", 2).trials
    other = replace(trials[1], scene=replace(trials[1].scene, name=trials[0].scene.name))
    logs = TrialSet([trials[0], trials[0]])
    assert _once(logs) == [trials[0]], "a copy is left out"
    name = trials[0].scene.name
    logs = TrialSet([trials[0], other], {name: [tmp_path / "a.json", tmp_path / "b.json"]})
    with pytest.raises(BadInputError, match=r"two trials are called .*a\.json and .*b\.json"):
        _once(logs)


def test_nobody_has_seen_sampled_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["run", "--sampled", "--humans", "official", "--out", str(tmp_path / "out")]
    assert main(command) == 2
    assert "nobody has seen" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_unknown_name_is_refused_before_anything_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for option, name, message in (
        ("--models", "chanse", "chance"),
        ("--models", "", "names no model"),
        ("--decision", "tuch", "touch"),
    ):
        assert main(["run", option, name, "--out", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_decision_is_of_the_models_that_it_fits() -> None:
    built = {name: build_model(name) for name in ("state-trees", "constant-motion", "chance")}
    expected = {"": [], "touch": ["constant-motion"], "trees": ["state-trees"]}
    assert {name: decided_models(built, name) for name in expected} == expected
    with pytest.raises(BadInputError, match="has no method imagine"):
        decided_models({"chance": built["chance"]}, "touch")


def test_the_report_states_the_settings_of_the_models_that_ran() -> None:
    index = pd.DataFrame({"split": ["testing"], "engine": ["e"], "renderer": ["r"]})
    for names, options, noise in (
        ("noisy-simulation,chance", {"noisy-simulation": {"samples": 5}}, "noisy-simulation 5,"),
        ("chance", {}, "no model of this run simulates with noise"),
    ):
        settings = RunSettings(models=names)
        built = {name: build_model(name) for name in names.split(",")}
        texts = methods(settings, index, options, built, model_options(settings, options), [], [])
        assert noise in texts["Noise of the simulation"] and "Training" not in texts
    settings, options = RunSettings(models="frozen-encoder"), {"frozen-encoder": {"steps": 7}}
    built = {"frozen-encoder": build_model("frozen-encoder", weights="random")}
    given = model_options(settings, options)
    texts = methods(settings, index, options, built, given, [], [])
    assert texts["Training"].startswith("frozen-encoder 7 steps,")
    texts = methods(settings, index, options, built, given, [], ["frozen-encoder"])
    assert "Training" not in texts, "only a readout that ships"
