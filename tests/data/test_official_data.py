"""The official data of the package, and its making from a checkout."""

from __future__ import annotations

import gzip
import json
import shutil
from pathlib import Path

import pytest

from physion.analysis.published.claims import published_results
from physion.analysis.tables import read_humans
from physion.core.errors import BadInputError
from physion.core.names import SCENARIOS, canonical_name
from physion.data import OfficialData, official
from physion.data.make import make_official
from physion.data.official import SCENES, trial_line
from physion.scenes.tdw.read_logs import read_scenes
from support.official import official_folder

OFFICIAL = official_folder() or Path("absent")


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a copy of the package's data that a test may change."""
    folder = tmp_path / "data"
    shutil.copytree(official().folder, folder)
    return folder


def test_the_package_has_scenes_of_all_scenarios_with_outcomes_and_people() -> None:
    data = official()
    names = [canonical_name(trial.scene.name) for trial in data.trials]
    assert len(names) == len(set(names)) == 874
    assert {trial.scene.scenario for trial in data.trials} == set(SCENARIOS)
    humans = read_humans(data.humans)
    assert len(humans) == 1144 and humans["accuracy"].mean() == pytest.approx(0.747, abs=0.01)
    seen = set(humans["stimulus"]) & set(names)
    counts = dict.fromkeys(SCENARIOS, 0)
    for trial in data.trials:
        counts[trial.scene.scenario] += canonical_name(trial.scene.name) in seen
    assert sum(counts.values()) == 590 and min(counts.values()) == 56
    known = dict(zip(names, data.trials, strict=True))
    both = set(known) & set(data.labels)
    assert len(both) > 600
    assert all(data.labels[name] == known[name].outcome.contact for name in both)


def test_the_data_takes_at_most_four_megabytes() -> None:
    files = [path for path in official().folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 4 * 2**20
    assert {"SOURCE.md", "LICENSE.official.txt"} <= {path.name for path in files}


def test_published_tables_are_read_from_the_package() -> None:
    assert set(published_results(official().results.parent).tables) >= {"accuracies", "panel_a"}


@pytest.mark.parametrize("name", ["scenes.jsonl.gz", "labels.csv", "model_bounds.json"])
def test_a_changed_file_is_one_clear_line(copy: Path, name: str) -> None:
    content = bytearray((copy / name).read_bytes())
    content[len(content) // 2] ^= 1
    (copy / name).write_bytes(content)
    with pytest.raises(BadInputError, match=f"{name} was changed since it was made"):
        OfficialData(copy).read(name)


def test_a_changed_answer_of_people_is_found(copy: Path) -> None:
    path = next((copy / "humans").iterdir())
    path.write_text(path.read_text().replace("0.7", "0.9", 1))
    with pytest.raises(BadInputError, match="was changed"):
        _ = OfficialData(copy).humans


def test_other_versions_and_folders_are_refused(copy: Path, tmp_path: Path) -> None:
    manifest = json.loads((copy / "manifest.json").read_text())
    (copy / "manifest.json").write_text(json.dumps({**manifest, "version": 99}))
    with pytest.raises(BadInputError, match="version 99"):
        _ = OfficialData(copy).trials
    with pytest.raises(BadInputError, match="holds no official data"):
        _ = OfficialData(tmp_path).manifest
    with pytest.raises(BadInputError, match="holds no human_accuracy"):
        make_official(tmp_path / "data" / "results", tmp_path / "out")
    with pytest.raises(BadInputError, match="not a folder"):
        make_official(tmp_path / "nowhere", tmp_path / "out")


@pytest.mark.slow
@pytest.mark.skipif(not OFFICIAL.is_dir(), reason="the official data is not here")
def test_the_package_is_what_the_official_files_give(tmp_path: Path) -> None:
    made = make_official(OFFICIAL, tmp_path / "made")
    assert made.trials == 874 and made.answered == 1144
    assert any("have no scene" in note for note in made.notes)
    packaged = official()
    for name in packaged.manifest["sha256"]:
        content = (made.folder / name).read_bytes()
        if name == SCENES:
            # Other versions of zlib compress differently.
            assert gzip.decompress(content) == gzip.decompress(packaged.read(name))
        else:
            assert content == packaged.read(name), name
    read = {trial.scene.name: trial for trial in read_scenes(OFFICIAL / "scenes").trials}
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
