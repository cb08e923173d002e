"""The official data of the package, and its making from a checkout."""

from __future__ import annotations

import gzip
import json
import shutil
from pathlib import Path

import pytest

from physion.analysis.published.claims import results_of
from physion.analysis.published.tables import read_published
from physion.analysis.tables import read_humans
from physion.cli.main import main as cli
from physion.core.errors import BadInputError
from physion.core.names import SCENARIOS, canonical_name
from physion.data.make import make_official
from physion.data.official import (
    SCENES,
    OfficialData,
    humans_folder,
    official,
    read_official_trials,
    trial_line,
)
from physion.scenes.tdw.read_logs import read_scenes
from support.official import official_folder

OFFICIAL = official_folder() or Path("absent")
MORE = OFFICIAL.parent / "official_more"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return a folder with all files of the study that the package was made from."""
    if not OFFICIAL.is_dir() or not MORE.is_dir():
        pytest.skip("the official data is not here")
    folder = tmp_path / "checkout"
    for part in (OFFICIAL, MORE):
        shutil.copytree(part, folder, dirs_exist_ok=True, copy_function=shutil.copyfile)
    return folder


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a copy of the package's data that a test may change."""
    folder = tmp_path / "data"
    shutil.copytree(official().folder, folder)
    return folder


def test_the_package_has_scenes_of_all_scenarios_with_outcomes_and_people() -> None:
    data = official()
    names = [canonical_name(trial.scene.name) for trial in data.trials]
    assert len(names) == len(set(names)) == 1629
    assert {trial.scene.scenario for trial in data.trials} == set(SCENARIOS)
    humans = read_humans(data.humans)
    assert len(humans) == 1144 and humans["accuracy"].mean() == pytest.approx(0.747, abs=0.01)
    seen = set(humans["stimulus"]) & set(names)
    counts = dict.fromkeys(SCENARIOS, 0)
    for trial in data.trials:
        counts[trial.scene.scenario] += canonical_name(trial.scene.name) in seen
    assert sum(counts.values()) == 1056 and min(counts.values()) == 94
    known = dict(zip(names, data.trials, strict=True))
    both = set(known) & set(data.labels)
    assert len(data.labels) == 1200 and len(both) == 1104
    assert all(data.labels[name] == known[name].outcome.contact for name in both)


def test_the_data_takes_at_most_four_megabytes() -> None:
    files = [path for path in official().folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 4 * 2**20
    assert {"SOURCE.md", "LICENSE.official.txt"} <= {path.name for path in files}


@pytest.mark.slow
def test_published_tables_are_read_from_the_package() -> None:
    released = read_published(official().results.parent)
    assert set(results_of(released).tables) >= {"accuracies", "panel_a"}


@pytest.mark.parametrize("name", ["scenes.jsonl.gz", "labels.csv", "model_bounds.json"])
def test_a_changed_file_is_one_clear_line(copy: Path, name: str) -> None:
    content = bytearray((copy / name).read_bytes())
    content[len(content) // 2] ^= 1
    (copy / name).write_bytes(content)
    with pytest.raises(BadInputError, match=f"{name} was changed since it was written"):
        OfficialData(copy).read(name)


def test_a_changed_answer_of_people_is_found(copy: Path) -> None:
    path = next((copy / "humans").glob("*.csv"))
    path.write_text(path.read_text().replace("0.7", "0.9", 1))
    with pytest.raises(BadInputError, match="was changed"):
        _ = OfficialData(copy).humans


def test_other_folders_are_refused(copy: Path, tmp_path: Path) -> None:
    (copy / "scenes.jsonl.gz").unlink()
    with pytest.raises(BadInputError, match=r"holds no official data .*physion import CHECKOUT"):
        official(copy)
    with pytest.raises(BadInputError, match="holds no human_accuracy"):
        make_official(tmp_path / "data" / "results", tmp_path / "out")
    with pytest.raises(BadInputError, match="not a folder"):
        make_official(tmp_path / "nowhere", tmp_path / "out")


@pytest.mark.nightly
@pytest.mark.slow
def test_the_package_is_what_the_official_files_give(checkout: Path, tmp_path: Path) -> None:
    made = make_official(checkout, tmp_path / "made")
    assert made.trials == 1629 and made.answered == 1144
    assert any("have no scene" in note for note in made.notes)
    packaged = official()
    names = {str(p.relative_to(made.folder)) for p in made.folder.rglob("*") if p.is_file()}
    there = packaged.folder.rglob("*")
    assert names == {str(p.relative_to(packaged.folder)) for p in there if p.is_file()}
    for name in sorted(name for name in names if not name.endswith(".sha256")):
        content = (made.folder / name).read_bytes()
        if name == SCENES:
            # Other versions of zlib compress differently.
            assert gzip.decompress(content) == gzip.decompress(packaged.read(name))
        else:
            assert content == packaged.read(name), name
    read = {trial.scene.name: trial for trial in read_scenes(checkout / "scenes").trials}
    assert all(read[trial.scene.name] == trial for trial in packaged.trials)


@pytest.mark.skipif(not OFFICIAL.is_dir(), reason="the official data is not here")
def test_a_configuration_given_twice_is_named_or_refused(tmp_path: Path) -> None:
    name = "pilot_it2_collision_simple_box"
    for part in ("a", "b"):
        shutil.copytree(OFFICIAL / "scenes" / "collide" / name, tmp_path / part / name)
    shutil.copytree(OFFICIAL / "humans", tmp_path / "humans")
    first = make_official(tmp_path, tmp_path / "out" / "first")
    (note,) = (note for note in first.notes if "twice with the same content" in note)
    assert note.startswith(f"{first.trials} trials ")
    shutil.rmtree(tmp_path / "out")
    path = tmp_path / "b" / name / "tdw_commands.json.gz"
    text = gzip.decompress(path.read_bytes()).decode()
    path.write_bytes(gzip.compress(text.replace('"mass": 2', '"mass": 3').encode()))
    with pytest.raises(BadInputError, match="given twice"):
        make_official(tmp_path, tmp_path / "out" / "second")


def test_a_line_of_a_trial_comes_back_whole() -> None:
    trial = official().trials[0]
    assert json.loads(trial_line(trial))["scene"]["name"] == trial.scene.name


@pytest.mark.nightly
@pytest.mark.slow
def test_a_checkout_is_converted_and_read_in_place_of_the_package(
    checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli(["import", str(checkout), str(tmp_path / "made"), "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["trials"] == 1629 and made["answered"] == 1144
    assert read_official_trials(tmp_path / "made").trials == list(official().trials)
    assert humans_folder(tmp_path / "made") == tmp_path / "made" / "humans"


def test_official_means_the_package_unless_a_folder_that_is_no_dataset_has_this_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert humans_folder(Path("official")) == official().humans
    (tmp_path / "official").mkdir()
    assert humans_folder(Path("official")) == Path("official")
    # A dataset of trials is no such folder.
    (tmp_path / "official" / "dataset.json").write_text("{}")
    assert humans_folder(Path("official")) == official().humans


def test_trials_are_chosen_by_scenario_and_limit() -> None:
    chosen = read_official_trials(Path("official"), "link", 3).trials
    assert [trial.scene.scenario for trial in chosen] == ["link"] * 3


def test_another_layout_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli(["import", str(tmp_path), str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "checkout of the original study" in error and error.count("\n") == 1
