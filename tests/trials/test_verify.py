"""Verification finds every change of a dataset, and comparison every difference of two."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import physion.trials.making.verify as verify_module
from physion.cli.main import main as cli
from physion.compute.local import SerialExecutor
from physion.trials.dataset import Dataset
from physion.trials.files import TrialPaths, encode_png
from physion.trials.index import build_index, read_index, write_index
from physion.trials.making.generate import make_trials
from physion.trials.making.make import make_trial
from physion.trials.making.plan import (
    GenerateJob,
    GenerateSettings,
    TrialTask,
    plan_dataset,
    plan_scenes,
)
from physion.trials.making.verify import compare_datasets, verify_dataset
from physion.trials.video import encode_movie, read_frames
from support.hand_made import FRAMES, SIZE, make_by_hand, make_parts, make_scene, tree_digest


def make_set(folder: Path, names: tuple[str, ...] = ("a", "b", "c")) -> Path:
    tasks = plan_scenes("tests", [make_scene(name) for name in names])
    assert not make_trials(folder, tasks, make=make_by_hand, executor=SerialExecutor()).failed
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make_set(tmp_path / "s", ("a", "b"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["trial_file", "movie", "observed_movie", "map"])
def test_one_changed_byte_in_any_file_is_found(name: str, folder: Path) -> None:
    path = Dataset(folder).paths("b").all()[name]
    data = bytearray(path.read_bytes())
    data[-20] ^= 1
    path.write_bytes(data)
    faults = verify_dataset(folder, again=0).faults
    assert faults and all("b" in fault for fault in faults)
    if name != "trial_file":
        assert any(f"b: {name}_sha256 is" in fault for fault in faults)


@pytest.mark.slow
def test_damaged_trials_are_deleted_and_made_again(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = Dataset(folder).paths("b")
    whole = tree_digest(folder)
    for path in (paths.movie, paths.trial_file):
        data = bytearray(path.read_bytes())
        data[-20] ^= 1
        path.write_bytes(data)
        tasks = plan_scenes("tests", [make_scene("a"), make_scene("b")])
        report = make_trials(folder, tasks, make=make_by_hand, executor=SerialExecutor())
        assert report.made == [], "a file of the right size is not read"
        assert cli(["verify", str(folder), "--again", "0"]) == 1
        assert "--repair deletes the 1 damaged trial" in capsys.readouterr().out
        assert cli(["verify", str(folder), "--again", "0", "--repair"]) == 1
        report = make_trials(folder, tasks, make=make_by_hand, executor=SerialExecutor())
        assert report.made == ["b"] and tree_digest(folder) == whole


@pytest.mark.slow
def test_missing_unlisted_and_relabelled_trials_are_found(folder: Path) -> None:
    Dataset(folder).paths("a").map.unlink()
    extra = TrialPaths(folder, "testing", "drop", "c")
    extra.trial_file.write_bytes(make_parts("c").pack())
    table = Dataset(folder).index
    table.loc[table["trial"] == "b", "contact"] = False
    write_index(folder, table)
    faults = "\n".join(verify_dataset(folder, again=0).faults)
    assert "c.h5 is not in the index" in faults
    assert "a_map.png is missing" in faults
    assert "b: contact is True, the index says False" in faults


def test_movies_of_a_wrong_length_are_found(folder: Path) -> None:
    assert verify_dataset(folder, again=0).faults == []
    paths = Dataset(folder).paths("a")
    paths.observed_movie.write_bytes(encode_movie(read_frames(paths.movie, count=50)))
    assert any("has 50 frames, not 45" in fault for fault in verify_dataset(folder, again=0).faults)


@pytest.mark.slow
def test_simulating_again_finds_another_motion(folder: Path, tmp_path: Path) -> None:
    scene = make_scene("real", cloth=False)
    job = GenerateJob(
        TrialTask("t", "drop", "testing", 0, scene=scene), tmp_path / "r", GenerateSettings(64, 64)
    )
    make_trial(job)
    write_index(tmp_path / "r", build_index(tmp_path / "r")[0])
    assert verify_dataset(tmp_path / "r", again=-1).faults == []
    parts = make_parts("a")
    lie = dataclasses.replace(parts.metadata, digest="0" * 64)
    paths = Dataset(folder).paths("a")
    paths.trial_file.write_bytes(parts._replace(metadata=lie).pack())
    assert any(
        "does not match its digest" in fault for fault in verify_dataset(folder, again=0).faults
    )


def test_a_label_that_the_contacts_contradict_is_found(folder: Path) -> None:
    """A whole trial file with a wrong label, and an index that repeats it."""
    paths = Dataset(folder).paths("b")
    parts = make_parts("b")
    wrong = dataclasses.replace(parts.labels, contact=not parts.labels.contact, first_frame=None)
    paths.trial_file.write_bytes(parts._replace(labels=wrong).pack())
    table, _ = build_index(folder)
    write_index(folder, table)
    assert any("labels/contact" in fault for fault in verify_dataset(folder, again=0).faults)


SAMPLED = plan_dataset("verify", ["collide"], {"testing": 2}, {"collide": ["default"]})
SAMPLED_SETTINGS = GenerateSettings(width=64, height=64, jitters=2, passes=("depth", "flow"))


@pytest.fixture(scope="module")
def sampled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sampled trials with movies, robustness and stored passes."""
    folder = tmp_path_factory.mktemp("sampled") / "d"
    assert not make_trials(folder, SAMPLED, SAMPLED_SETTINGS, executor=SerialExecutor()).failed
    return folder


@pytest.mark.slow
def test_strangers_and_trials_of_other_splits_are_named(sampled: Path, tmp_path: Path) -> None:
    folder = tmp_path / "d"
    shutil.copytree(sampled, folder)
    (folder / "testing" / "collide" / "stray_img.mp4").write_bytes(b"x")
    index = read_index(folder)
    index["observed_contact"] = True
    index["contact"] = ~index["contact"]
    index["scene_digest"] = "0" * 64
    write_index(folder, index)
    faults = "\n".join(verify_dataset(folder, again=0).faults)
    assert "stray_img.mp4 is not a file of a trial" in faults
    assert "its physics belongs to training" in faults
    assert "the balance of its split requires the opposite" in faults
    assert "nothing is left to predict" in faults
    assert "the same physics as" in faults


@pytest.mark.slow
def test_a_trial_made_again_is_indexed_again(sampled: Path, tmp_path: Path) -> None:
    assert verify_dataset(sampled, again=-1).faults == []
    folder = tmp_path / "d"
    shutil.copytree(sampled, folder)
    index = read_index(folder)
    index.loc[0, "frames"] = 7
    write_index(folder, index)
    paths = Dataset(folder).paths(str(index["trial"][0]))
    paths.trial_file.unlink()
    report = make_trials(folder, SAMPLED, SAMPLED_SETTINGS, executor=SerialExecutor())
    assert len(report.made) == 1 and verify_dataset(folder, again=0).faults == []


@pytest.mark.parametrize("name", ["movie", "observed_movie", "free_movie", "free_observed_movie"])
def test_swapped_movies_are_found_where_the_index_agrees(
    sampled: Path, tmp_path: Path, name: str
) -> None:
    folder = tmp_path / "d"
    shutil.copytree(sampled, folder)
    dataset = Dataset(folder)
    one, other = (getattr(dataset.paths(trial), name) for trial in dataset.trials())
    if not one.is_file():
        pytest.skip(f"these trials have no {name}")
    first, second = one.read_bytes(), other.read_bytes()
    one.write_bytes(second)
    other.write_bytes(first)
    table, problems = build_index(folder)
    assert not problems
    write_index(folder, table)
    faults = verify_dataset(folder, again=0).faults
    assert len(faults) == 2 and all("does not show its trial" in fault for fault in faults)
    assert str(one) in faults[0] and str(other) in faults[1]


def test_a_movie_with_another_end_is_found(sampled: Path, tmp_path: Path) -> None:
    folder = tmp_path / "d"
    shutil.copytree(sampled, folder)
    path = Dataset(folder).paths(Dataset(folder).trials()[0]).movie
    frames = read_frames(path)
    frames[-1] = frames[-1, :, ::-1]
    path.write_bytes(encode_movie(frames))
    write_index(folder, build_index(folder)[0])
    (fault,) = verify_dataset(folder, again=0).faults
    assert f"frame {len(frames) - 1} differs" in fault


@pytest.mark.nightly
@pytest.mark.slow
def test_trials_of_another_version_are_no_faults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene("real", cloth=False)
    task = TrialTask("t", "drop", "testing", 0, scene=scene)
    make_trial(GenerateJob(task, tmp_path / "r", GenerateSettings(64, 64)))
    paths = TrialPaths(tmp_path / "r", "testing", "drop", "real")
    paths.map.write_bytes(encode_png(np.zeros((64, 64, 4), np.uint8)))
    write_index(tmp_path / "r", build_index(tmp_path / "r")[0])
    same = verify_dataset(tmp_path / "r", again=-1)
    assert len(same.faults) == 1 and not same.other_versions
    monkeypatch.setattr("physion.trials.making.make.RENDERER", "physion-99")
    newer = verify_dataset(tmp_path / "r", again=-1)
    assert not newer.faults and len(newer.other_versions) == 1
    assert "made by another version" in newer.other_versions[0]


@pytest.mark.nightly
@pytest.mark.slow
def test_a_map_in_another_compression_is_the_same_picture(sampled: Path, tmp_path: Path) -> None:
    folder = tmp_path / "d"
    shutil.copytree(sampled, folder)
    path = Dataset(folder).paths(str(read_index(folder)["trial"][0])).map
    pixels = np.array(Image.open(path))
    path.write_bytes(encode_png(pixels, compress_level=0))
    write_index(folder, build_index(folder)[0])
    result = verify_dataset(folder, again=-1)
    assert result.faults == [] and result.notes == [f"{path}: same picture, other compression"]
    pixels[3, 5, 0] ^= 1
    path.write_bytes(encode_png(pixels, compress_level=0))
    write_index(folder, build_index(folder)[0])
    result = verify_dataset(folder, again=-1)
    assert result.faults == [f"{path}: other bytes are rendered than the stored ones"]
    assert result.notes == []


@pytest.mark.nightly
@pytest.mark.slow
def test_trials_of_an_unknown_preset_are_reported_as_not_drawn_again(
    sampled: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(verify_module, "load_presets", lambda scenario: {})
    result = verify_dataset(sampled, again=-1)
    assert result.faults == [] and len(result.notes) == 2
    assert all("not drawn again: preset 'default' of collide" in note for note in result.notes)
    assert len(verify_dataset(sampled, again=1).notes) == 1
    assert cli(["verify", str(sampled), "--again", "-1"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("not drawn again") == 2 and "0 faults, 2 notes" in printed
    assert cli(["verify", str(sampled), "--again", "1", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["notes"]) == 1


@pytest.mark.slow
def test_differences_of_two_datasets_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = make_set(tmp_path / "one"), make_set(tmp_path / "other", ("a", "b", "d"))
    movie = Dataset(other).paths("a").movie
    movie.write_bytes(encode_movie(np.zeros((FRAMES, SIZE, SIZE, 3), np.uint8)))
    parts = make_parts("b", contact_frame=51)
    meta = dataclasses.replace(parts.metadata, index=1, free_movies=True, engine="by hand 2")
    paths = Dataset(other).paths("b")
    paths.trial_file.write_bytes(parts._replace(metadata=meta).pack())
    write_index(other, build_index(other)[0])
    found = compare_datasets(one, other)
    assert found == [
        f"c: only in {one}",
        f"d: only in {other}",
        "a: other movie_sha256",
        "b: other digest, first_frame (by hand 1; by hand 2)",
    ]
    verb = ["verify", str(one), "--again", "0", "--against"]
    assert cli([*verb, str(other)]) == 1
    printed = capsys.readouterr().out.splitlines()
    assert printed[-5:] == [*found, f"{one} against {other}: 4 differences"]
    assert cli([*verb, str(other), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["against"] == found
    assert cli([*verb, str(one)]) == 0 and compare_datasets(one, one) == []
    assert cli([*verb, str(tmp_path / "none")]) == 2
    assert "none does not exist" in capsys.readouterr().err
