"""physion experiment init: balanced selection, cut movies, a complete folder or none."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.analysis.tables import read_humans
from physion.cli.experiment.experiment import SUBVERBS
from physion.cli.main import main
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import canonical_name
from physion.data.official import official
from physion.experiment.study import make as study_folder
from physion.experiment.study.choose import (
    HIDDEN,
    OfficialSelection,
    choose_familiarization,
    choose_official,
    choose_trials,
    find_fault,
)
from physion.experiment.study.identity import Secrets, check_password
from physion.experiment.study.make import StimulusSource, import_stimulus, make_study
from physion.experiment.study.settings import MENTAL_ROTATION
from physion.experiment.study.study import Study, load_study
from physion.physics.replay import ReplayTask, replay_trial
from physion.scenes.tdw.read_logs import ImportedTrial
from physion.trials.dataset import Dataset, mark_unusable
from physion.trials.index import read_index, write_index
from physion.trials.video import read_frames
from support.experiment.tiny_dataset import is_marked, make_tiny_dataset
from support.experiment.tiny_study import CONTACT, OBSERVED, read_number
from support.paths import ROOT


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six testing and four familiarization trials of two scenarios."""
    folder = tmp_path_factory.mktemp("dataset")
    make_tiny_dataset(folder, scenarios=("roll", "collide"))
    return folder


# --- which trials --------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_choice_is_balanced_and_always_the_same(dataset: Path) -> None:
    chosen = choose_trials(dataset, test=4, practice=4)
    assert chosen == choose_trials(dataset, test=4, practice=4)
    assert chosen.scenarios == ("collide", "roll") and not chosen.notes
    for scenario in chosen.scenarios:
        for phase in ("familiarization", "test"):
            part = [s for s in chosen.sources if (s.scenario, s.phase) == (scenario, phase)]
            assert [s.place for s in part] == [0, 1, 2, 3]
            assert Counter(s.label for s in part) == {True: 2, False: 2}
            assert all(("testing" in s.stimulus) == (phase == "test") for s in part)
            assert all(s.label == (int(s.stimulus[-1]) % 2 == 0) for s in part)


@pytest.mark.nightly
@pytest.mark.slow
def test_another_seed_chooses_otherwise(dataset: Path) -> None:
    """Which trials, and their places; drawn apart for trials with and without contact."""
    few = [choose_trials(dataset, test=2, scenarios=["roll"], seed=seed) for seed in range(12)]
    pairs = {
        tuple(sorted(s.stimulus for s in chosen.sources if s.phase == "test")) for chosen in few
    }
    # Of three trials with contact (even numbers) and three without; nine pairs.
    assert len(pairs) >= 5
    assert {(int(b[-1]) - int(a[-1])) % 6 for a, b in pairs} > {1}
    whole = [choose_trials(dataset, test=6, seed=seed).sources for seed in range(10)]
    all_of_them = [tuple(s.stimulus for s in sources) for sources in whole]
    # Which places have contact is drawn too: 20 patterns of the six test trials of a scenario.
    patterns = {
        tuple(s.label for s in sources if (s.scenario, s.phase) == ("roll", "test"))
        for sources in whole
    }
    assert len(patterns) >= 4
    assert len(set(all_of_them)) == 10 and len({frozenset(names) for names in all_of_them}) == 1


def draw_of_roll(folder: Path, test: int) -> list[str]:
    """Return the names of the test trials that are chosen, in order."""
    chosen = choose_trials(folder, scenarios=["roll"], test=test, practice=2)
    return [source.stimulus for source in chosen.sources if source.phase == "test"]


@pytest.mark.nightly
@pytest.mark.slow
def test_presets_alternate_in_the_draw(tmp_path: Path) -> None:
    """Of 24 trials, 12 with contact, 8 of each outcome have preset a, 3 b and 1 c."""
    make_tiny_dataset(tmp_path, scenarios=("roll",), test=24)
    table = read_index(tmp_path)
    preset = {name: "aaaaaaaabbbc"[int(name[-2:]) // 2] for name in table["trial"]}
    table["preset"] = table["trial"].map(preset)
    write_index(tmp_path, table)
    drawn = draw_of_roll(tmp_path, 12)
    for outcome in (0, 1):
        found = Counter(preset[name] for name in drawn if int(name[-2:]) % 2 == outcome)
        assert found["c"] == 1 and {found["a"], found["b"]} == {2, 3}
    names = [{s.stimulus for s in choose_trials(tmp_path, test=2, practice=2, seed=seed).sources}
             for seed in range(8)]  # fmt: skip
    first = {preset[name] for chosen in names for name in chosen if "testing" in name}
    assert len(first) > 1, "which preset begins is drawn too"


@pytest.mark.slow
def test_an_unusable_trial_is_replaced_by_the_next_of_its_preset_and_outcome(
    tmp_path: Path,
) -> None:
    """Of twelve trials, of which even numbers have contact, two of one kind share a preset."""
    dataset = make_tiny_dataset(tmp_path, scenarios=("roll",), test=12)
    before = draw_of_roll(tmp_path, 4)
    bad = next(name for name in before if int(name[-2:]) % 2 == 0)
    others = [f"roll_testing_{number:04d}" for number in range(10, -1, -2)]
    wanted = next(name for name in others if name not in before)
    table = read_index(tmp_path)
    table.loc[table["trial"].isin([bad, wanted]), "preset"] = "other"
    write_index(tmp_path, table)
    before = draw_of_roll(tmp_path, 4)
    assert bad in before and wanted not in before
    mark_unusable(dataset, {bad: "a block flickers"})
    chosen = choose_trials(tmp_path, scenarios=["roll"], test=4, practice=2)
    after = [source.stimulus for source in chosen.sources if source.phase == "test"]
    # It stands in the place of the other one: nothing else changes.
    assert [wanted if name == bad else name for name in before] == after
    assert f"{bad} is unusable (a block flickers); {wanted} replaces it" in chosen.notes


def test_without_another_of_the_preset_any_replaces_it_and_it_is_said(tmp_path: Path) -> None:
    dataset = make_tiny_dataset(tmp_path, scenarios=("roll",), test=6)
    table = read_index(tmp_path)
    before = draw_of_roll(tmp_path, 4)
    bad = next(name for name in before if int(name[-2:]) % 2 == 0)
    table.loc[table["trial"] == bad, "preset"] = "rare"
    write_index(tmp_path, table)
    mark_unusable(dataset, {bad: "clips"})
    chosen = choose_trials(tmp_path, scenarios=["roll"], test=4, practice=2)
    assert any("of preset none, as rare has no more" in note for note in chosen.notes)
    chosen = choose_trials(tmp_path, scenarios=["roll"], test=6, practice=2)
    test = [source for source in chosen.sources if source.phase == "test"]
    # Of three with contact one is unusable, so two of either outcome are left.
    assert bad not in {source.stimulus for source in test}
    assert Counter(source.label for source in test) == {True: 2, False: 2}


def test_where_fewer_are_there_it_says_so(dataset: Path, tmp_path: Path) -> None:
    chosen = choose_trials(dataset, scenarios=["roll"])
    assert Counter(s.phase for s in chosen.sources) == {"test": 6, "familiarization": 4}
    assert chosen.notes == (
        "roll: 4 familiarization trials instead of 10, since half must have contact and no more "
        "are available",
        "roll: 6 testing trials instead of 150, since half must have contact and no more "
        "are available",
    )
    # Fewer of one kind means fewer of both.
    change_index(dataset, tmp_path, lambda table: table[table["trial"] != "roll_testing_0002"])
    chosen = choose_trials(tmp_path, scenarios=["roll"])
    test = [source for source in chosen.sources if source.phase == "test"]
    assert Counter(s.label for s in test) == {True: 2, False: 2}


def change_index(dataset: Path, folder: Path, change: Callable[[Any], pd.DataFrame]) -> None:
    """Copy a dataset and change the table of its trials."""
    shutil.copytree(dataset, folder, dirs_exist_ok=True)
    write_index(folder, change(read_index(folder)).reset_index(drop=True))


def without_maps(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(map=None, map_sha256=None)


def imported_without_practice(table: pd.DataFrame) -> pd.DataFrame:
    kept = table[table["split"] != "familiarization"]
    return kept.assign(recorded_contact=kept["contact"])


@pytest.mark.parametrize(
    ("changed", "words", "message"),
    [
        (lambda t: t[t["contact"] | (t["split"] != "familiarization")], {},
         r"no familiarization trial of collide without.*physion generate.*--split familiarization"),
        (imported_without_practice, {}, "give --scenes official in place of --trials"),
        (lambda t: t[t["split"] == "familiarization"], {}, "no testing trials"),
        (without_maps, {}, "no map file"),
        (None, {"test": 3, "practice": 4}, "must be even"),
        (None, {"test": 0, "practice": 4}, "must be even"),
        (None, {"test": 4, "practice": 5}, "must be even"),
        (None, {"scenarios": ["colide"]}, "closest: collide"),
    ],
)  # fmt: skip
def test_what_cannot_be_chosen_is_named(
    dataset: Path, tmp_path: Path, changed: Any, words: dict[str, Any], message: str
) -> None:
    if changed is not None:
        change_index(dataset, tmp_path, changed)
    with pytest.raises((BadInputError, UnknownNameError), match=message):
        choose_trials(dataset if changed is None else tmp_path, **words)


def test_familiarization_may_be_chosen_by_itself(dataset: Path) -> None:
    assert len(choose_familiarization(dataset, "roll").sources) == 4


@pytest.mark.slow
def test_looks_are_free_unless_asked_otherwise(dataset: Path, tmp_path: Path) -> None:
    for look in ("free", "redyellow"):
        chosen = choose_trials(dataset, test=2, practice=2, scenarios=["roll"], look=look)
        study = make_study(empty_study(tmp_path / look, ("roll",)), chosen.sources, "a password")
        for stimulus in study.stimuli:
            assert stimulus.look == look
            frame = read_frames(study.folder / stimulus.movie, count=1)[0]
            assert is_marked(frame) == (look == "redyellow")


def test_a_look_that_was_not_made_is_refused(tmp_path: Path) -> None:
    make_tiny_dataset(tmp_path, free=False)
    with pytest.raises(BadInputError, match="--look redyellow"):
        choose_trials(tmp_path, test=2, practice=2)
    assert choose_trials(tmp_path, test=2, practice=2, look="redyellow").sources


# --- the folder ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_study_shows_what_the_trials_show(dataset: Path, tmp_path: Path) -> None:
    chosen = choose_trials(dataset)
    study = make_study(empty_study(tmp_path / "study"), chosen.sources, "a password")
    assert study == load_study(tmp_path / "study")
    assert {(s.stimulus, s.label, s.place) for s in study.stimuli} == {
        (s.stimulus, s.label, s.place) for s in chosen.sources
    }
    by_name = {source.stimulus: source for source in chosen.sources}
    for stimulus in study.stimuli:
        frames = read_frames(study.folder / stimulus.movie)
        assert [read_number(frame) for frame in frames] == list(range(OBSERVED))
        whole = read_frames(by_name[stimulus.stimulus].movie)
        assert np.abs(frames.astype(int) - whole[:OBSERVED]).mean() < 1
        assert bool(stimulus.full) == (stimulus.phase == "familiarization")
    assert check_password(Secrets.load(study.folder), "a password")
    assert {path.name for path in study.folder.iterdir()} == {
        "study.toml", "stimuli.csv", "texts", "media", "secret.json"}  # fmt: skip
    # No file names a stimulus, and none is there that no stimulus has.
    used = {Path(n).name for s in study.stimuli for n in (s.movie, s.map, s.full) if n}
    assert {path.name for path in (study.folder / "media").iterdir()} == used


def test_an_interrupted_making_leaves_nothing(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[str] = []

    def take(source: StimulusSource, folder: Path) -> Any:
        if len(taken) == 5:
            raise KeyboardInterrupt
        taken.append(source.stimulus)
        return import_stimulus(source, folder)

    monkeypatch.setattr(study_folder, "import_stimulus", take)
    sources = choose_trials(dataset).sources
    with pytest.raises(KeyboardInterrupt):
        make_study(empty_study(tmp_path / "study"), sources, "a password")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["notes.txt", "responses.sqlite", "study.toml"])
def test_folders_with_something_in_them_are_refused(
    dataset: Path, tmp_path: Path, name: str
) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(BadInputError, match=r"already|not empty"):
        make_study(empty_study(tmp_path), choose_trials(dataset).sources, "a password")
    assert [path.name for path in tmp_path.iterdir()] == [name]


# --- the command ---------------------------------------------------------------------------------


def test_the_command_makes_a_study(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "pilot-1"
    assert main(["experiment", "init", *CONTACT, str(folder), "--trials", str(dataset)]) == 0
    out = capsys.readouterr().out
    study = load_study(folder)
    assert study.name == "pilot-1" and study.scenarios == ("collide", "roll")
    (password,) = (line.split()[-1] for line in out.splitlines() if "password" in line)
    assert check_password(Secrets.load(folder), password)
    assert f"physion experiment serve {folder}" in out
    assert "roll: 6 testing trials instead of 150" in out
    assert "collide: 6 test and 4 familiarization trials" in out


@pytest.mark.slow
def test_the_preset_of_the_paper(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "study"
    words = ["--trials", str(dataset), "--preset", "paper"]
    assert main(["experiment", "init", *CONTACT, str(folder), *words]) == 0
    study = load_study(folder)
    assert study.timing.break_every == 0 and not study.timing.fixation_in_familiarization
    assert study.exclusions == "preregistered-only"
    assert (study.payment.amount, study.payment.currency, study.payment.per_hour) == (4, "USD", 12)
    assert study.questions == (MENTAL_ROTATION,)
    for language in ("en", "de"):
        assert study.texts[language]["question.mental_rotation.text"]
    assert (folder / "texts/mental_rotation.png").read_bytes().startswith(b"\x89PNG")
    plan = (folder / "preregistration.md").read_text()
    assert "`mental_rotation` (right or wrong)" in plan and (folder / "trial.svg").is_file()
    capsys.readouterr()
    plain = ["--trials", str(dataset), "--mental-rotation"]
    assert main(["experiment", "init", *CONTACT, str(tmp_path / "b"), *plain]) == 0
    study = load_study(tmp_path / "b")
    assert study.questions == (MENTAL_ROTATION,) and study.timing.break_every == 25


def test_the_command_takes_a_password_and_prints_json(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = tmp_path / "secret"
    secret.write_text("correct horse battery\n")
    words = ["--trials", str(dataset), "--password-file", str(secret), "--scenario", "roll"]
    words += ["--test", "4", "--practice", "2", "--participants", "7", "--json"]
    assert main(["experiment", "init", *CONTACT, str(tmp_path / "study"), *words]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["password"] is None and "correct horse" not in json.dumps(printed)
    assert printed["stimuli"] == {"roll": {"familiarization": 2, "test": 4}}
    study = load_study(tmp_path / "study")
    assert printed["digest"] == study.digest and study.participants == 7
    assert check_password(Secrets.load(study.folder), "correct horse battery")


BAD_COMMANDS = {
    "nothing": "give either --trials DATASET, --scenes official",
    "--trials DATA --stimuli a.json": "give either",
    "--scenes official --trials .": "give either --trials DATASET, --scenes",
    "--trials DATA --movies .": "--movies needs --stimuli",
    "--scenes official --movies .": "--movies needs --stimuli",
    "--stimuli a.json": "--stimuli needs --movies",
    "--stimuli a.json --movies .": "--familiarization LISTS",
    "--trials . --rendered x": "--rendered goes with --scenes",
    "--trials nowhere": "does not exist",
    "--scenes nowhere": "nowhere",
    "--trials DATA --test 7": "--test must be even",
    "--scenes official --test 3": "--test must be even",
    "--scenes official --scenario colide": "'colide'",
    "--trials DATA --name a/b": "name is 'a/b': must be letters",
    "--trials DATA --languages en fr": "unknown language 'fr'",
    "--trials DATA --password-file SHORT": "8 characters or more",
    "--trials DATA --password-file nowhere": "nowhere is missing",
}


@pytest.mark.parametrize("words", BAD_COMMANDS)
def test_bad_commands_are_one_line_and_leave_nothing(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str
) -> None:
    (tmp_path / "short").write_text("short\n")
    names = {"DATA": str(dataset), "SHORT": str(tmp_path / "short")}
    given = [names.get(word, word) for word in words.split() if word != "nothing"]
    assert main(["experiment", "init", *CONTACT, str(tmp_path / "study"), *given]) == 2
    error = capsys.readouterr().err
    assert BAD_COMMANDS[words] in error and error.count("\n") == 1
    assert not (tmp_path / "study").exists()


@pytest.mark.parametrize("word", SUBVERBS)
def test_verbs_are_listed_and_a_missing_extra_is_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    assert main(["experiment"]) == 2
    assert f"\n  {word} " in capsys.readouterr().out
    assert main(["experiment", word[:-1]]) == 2
    assert f"did you mean {word}?" in capsys.readouterr().err
    monkeypatch.setattr("physion.cli.experiment.experiment.NEEDED", ("no_such_module",))
    more = ["--all"] if word == "forget" else []
    assert main(["experiment", word, str(tmp_path / "s"), *more]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    # The tutorial's first command has the same form, for more extras.
    tutorial = (ROOT / "docs" / "tutorials" / "study.md").read_text(encoding="utf-8")
    found = re.search(r"(\S*pip install) -q (-e '\.\[)[a-z,]+(\]' -c \S+)", tutorial)
    assert found is not None
    assert said.endswith(f" {found[1]} {found[2]}experiment{found[3]}\n")


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kills a process")
def test_a_killed_command_can_be_repeated(tmp_path: Path) -> None:
    data, folder = tmp_path / "dataset", tmp_path / "study"
    make_tiny_dataset(data, test=30, familiarization=10, size=128)
    words = ["experiment", "init", *CONTACT, str(folder), "--trials", str(data)]
    command = [sys.executable, "-m", "physion.cli.main", *words]
    first = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    part = tmp_path / ".study.part"
    while first.poll() is None and len(list(part.glob("media/*.mp4"))) < 8:
        pass
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert part.exists() and not folder.exists(), "it was done before it could be killed"
    # Left from choosing other trials: not in the study.
    (part / "media" / "other.mp4").write_bytes(b"other")
    assert main(words) == 0
    study = load_study(folder)
    assert len(study.stimuli) == 40
    used = {Path(n).name for s in study.stimuli for n in (s.movie, s.map, s.full) if n}
    assert {path.name for path in (folder / "media").iterdir()} == used
    assert {path.name for path in tmp_path.iterdir()} == {"dataset", "study"}


def empty_study(folder: Path, scenarios: tuple[str, ...] = ("collide", "roll")) -> Study:
    return Study(
        folder=folder,
        name="tiny",
        version="1",
        title="A title",
        contact="Ada, ada@example.org",
        scenarios=scenarios,
    )


# --- official scenes, rendered for a study --------------------------------------------------------


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
    # Familiarization trials of the original study come first.
    drape = [trial for trial in official().trials if trial.scene.scenario == "drape"]
    chosen = choose(drape, seen, test=2).tasks
    practice = [task.trial for task in chosen if task.split == "familiarization"]
    assert practice and all("familiarization" in name for name in practice)


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


def test_a_larger_study_adds_trials_to_a_smaller_one(seen: set[str]) -> None:
    few, many = choose(collide(), seen, test=2), choose(collide(), seen, test=6)
    assert {task.trial for task in few.tasks} < {task.trial for task in many.tasks}


def test_scenes_with_a_hidden_agent_or_patient_are_left_out(seen: set[str]) -> None:
    hidden = "pilot_it2_collision_simple_box_2_dis_2_occ_0008"
    faults = {
        t.scene.name: find_fault(t) for t in collide() if t.scene.name.startswith(hidden[:-1])
    }
    assert faults[hidden] == HIDDEN and "" in faults.values()


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
