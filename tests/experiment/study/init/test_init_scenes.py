"""physion experiment init --scenes: official scenes that people saw, rendered for a study."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from physion.analysis.tables import read_humans
from physion.cli.main import main
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError
from physion.core.names import canonical_name
from physion.data.official import official
from physion.experiment.study.choose import HIDDEN, OfficialSelection, choose_official, find_fault
from physion.experiment.study.study import load_study
from physion.physics.replay import ReplayTask, replay_trial
from physion.scenes.tdw.read_logs import ImportedTrial
from physion.trials.dataset import Dataset
from support.experiment.tiny_study import CONTACT


@pytest.fixture(scope="module")
def seen() -> set[str]:
    """Names of the stimuli that people saw."""
    return set(read_humans(official().humans)["stimulus"])


def choose(trials: list[ImportedTrial], seen: set[str] | None, test: int = 4) -> OfficialSelection:
    return choose_official(trials, seen, test=test, practice=2, executor=SerialExecutor())


def collide() -> list[ImportedTrial]:
    return [trial for trial in official().trials if trial.scene.scenario == "collide"]


@pytest.mark.nightly
@pytest.mark.slow
def test_test_trials_were_seen_by_people_and_familiarization_is_apart(seen: set[str]) -> None:
    tasks = choose(collide(), seen).tasks
    assert tasks == choose(collide(), seen).tasks
    assert Counter((task.split, task.recorded_contact) for task in tasks) == {
        ("testing", True): 2, ("testing", False): 2,
        ("familiarization", True): 1, ("familiarization", False): 1,
    }  # fmt: skip
    assert all((canonical_name(task.trial) in seen) == (task.split == "testing") for task in tasks)
    scenes = [task.scene for task in tasks if task.scene is not None]
    assert len({scene.physics_digest() for scene in scenes}) == len(tasks) == 6


def test_a_larger_study_adds_trials_to_a_smaller_one(seen: set[str]) -> None:
    few, many = choose(collide(), seen, test=2), choose(collide(), seen, test=6)
    assert {task.trial for task in few.tasks} < {task.trial for task in many.tasks}


@pytest.mark.nightly
@pytest.mark.slow
def test_scenes_whose_simulation_ends_otherwise_are_left_out_and_counted(seen: set[str]) -> None:
    trials = collide()
    chosen = choose(trials, seen, test=100)
    differ = {
        trial.scene.name
        for trial in trials
        if canonical_name(trial.scene.name) in seen and not replay_trial(ReplayTask(trial)).agrees
    }
    assert differ, "the test needs a scene that the engine predicts wrongly"
    assert not differ & {task.trial for task in chosen.tasks}
    assert f"recorded outcome: {len(differ)}" in chosen.notes[0]


def test_scenes_with_a_hidden_agent_or_patient_are_left_out(seen: set[str]) -> None:
    hidden = "pilot_it2_collision_simple_box_2_dis_2_occ_0008"
    faults = {
        t.scene.name: find_fault(t) for t in collide() if t.scene.name.startswith(hidden[:-1])
    }
    assert faults[hidden] == HIDDEN and "" in faults.values()


@pytest.mark.nightly
@pytest.mark.slow
def test_familiarization_trials_of_the_study_come_first(seen: set[str]) -> None:
    drape = [trial for trial in official().trials if trial.scene.scenario == "drape"]
    chosen = choose(drape, seen, test=2).tasks
    practice = [task.trial for task in chosen if task.split == "familiarization"]
    assert practice and all("familiarization" in name for name in practice)


def test_a_scenario_without_scenes_of_one_kind_is_refused(seen: set[str]) -> None:
    never = [trial for trial in collide() if not trial.outcome.contact]
    with pytest.raises(BadInputError, match="no official scene of collide with contact for"):
        choose(never, seen)


@pytest.mark.nightly
@pytest.mark.slow
def test_the_command_renders_official_scenes_and_makes_a_study(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], seen: set[str]
) -> None:
    folder, made = tmp_path / "study", tmp_path / "study-trials"
    words = ["--scenes", "official", "--scenario", "collide", "--test", "2", "--practice", "2"]
    assert main(["experiment", "init", *CONTACT, str(folder), *words, "--workers", "1"]) == 0
    assert "collide: 2 test and 2 familiarization trials" in capsys.readouterr().out
    recorded = {trial.scene.name: trial.outcome.contact for trial in official().trials}
    stimuli = load_study(folder).stimuli
    assert Counter((s.phase, s.label) for s in stimuli) == {
        (phase, label): 1 for phase in ("test", "familiarization") for label in (True, False)
    }
    assert all(stimulus.label == recorded[stimulus.stimulus] for stimulus in stimuli)
    assert all((canonical_name(s.stimulus) in seen) == (s.phase == "test") for s in stimuli)
    before = {path: path.stat().st_mtime_ns for path in made.rglob("*.h5")}
    assert len(before) == len(Dataset(made).index) == 4
    words += ["--rendered", str(made), "--workers", "1"]
    assert main(["experiment", "init", *CONTACT, str(tmp_path / "again"), *words]) == 0
    assert {path: path.stat().st_mtime_ns for path in made.rglob("*.h5")} == before
    assert load_study(tmp_path / "again").stimuli == stimuli


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scenes", "official", "--trials", "."], "give either --trials DATASET, --scenes"),
        (["--scenes", "official", "--movies", "."], "--movies needs --stimuli"),
        (["--trials", ".", "--rendered", "x"], "--rendered goes with --scenes"),
        (["--scenes", "official", "--test", "3"], "--test must be even"),
        (["--scenes", "official", "--scenario", "colide"], "'colide'"),
        (["--scenes", "nowhere"], "nowhere"),
    ],
)
def test_bad_commands_are_one_line_and_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert main(["experiment", "init", *CONTACT, str(tmp_path / "study"), *words]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
