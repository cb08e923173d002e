"""Verification finds whatever was changed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from hand_made import make_by_hand, make_parts, make_scene

from physion.compute.local import SerialExecutor
from physion.errors import BadInputError
from physion.trials.dataset import Dataset
from physion.trials.generate import generate
from physion.trials.index import build_index, write_index
from physion.trials.layout import TrialPaths
from physion.trials.make import make_trial
from physion.trials.plan import Job, Settings, Task, plan_scenes
from physion.trials.verify import verify_dataset
from physion.trials.video import encode_movie, read_frames


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    tasks = plan_scenes("tests", [make_scene("a"), make_scene("b")])
    generate(tmp_path / "s", tasks, make=make_by_hand, executor=SerialExecutor())
    return tmp_path / "s"


def test_an_untouched_dataset_has_no_fault(folder: Path) -> None:
    assert verify_dataset(folder, again=0) == []


@pytest.mark.parametrize("name", ["trial_file", "movie", "observed_movie", "map"])
def test_one_changed_byte_in_any_file_is_found(name: str, folder: Path) -> None:
    path = Dataset(folder).paths("b").all()[name]
    data = bytearray(path.read_bytes())
    data[-20] ^= 1
    path.write_bytes(data)
    faults = verify_dataset(folder, again=0)
    assert faults and all("b" in fault for fault in faults)
    if name != "trial_file":
        assert any(f"b: {name}_sha256 is" in fault for fault in faults)


def test_missing_unlisted_and_relabelled_trials_are_found(folder: Path) -> None:
    Dataset(folder).paths("a").map.unlink()
    extra = TrialPaths(folder, "testing", "drop", "c")
    extra.trial_file.write_bytes(make_parts("c").pack())
    table = Dataset(folder).index
    table.loc[table["trial"] == "b", "contact"] = False
    write_index(folder, table)
    faults = "\n".join(verify_dataset(folder, again=0))
    assert "c.h5 is not in the index" in faults
    assert "a_map.png cannot be read" in faults
    assert "b: contact is True, the index says False" in faults


def test_movies_of_a_wrong_length_are_found(folder: Path) -> None:
    paths = Dataset(folder).paths("a")
    paths.observed_movie.write_bytes(encode_movie(read_frames(paths.movie, count=50)))
    assert any("has 50 frames, not 45" in fault for fault in verify_dataset(folder, again=0))


def test_simulating_again_finds_another_motion(folder: Path, tmp_path: Path) -> None:
    scene = make_scene("real", cloth=False)
    job = Job(Task("t", "drop", "testing", 0, scene=scene), tmp_path / "r", Settings(64, 64))
    make_trial(job)
    from physion.trials.index import build_index

    write_index(tmp_path / "r", build_index(tmp_path / "r")[0])
    assert verify_dataset(tmp_path / "r", again=-1) == []
    parts = make_parts("a")
    lie = dataclasses.replace(parts.metadata, digest="0" * 64)
    paths = Dataset(folder).paths("a")
    paths.trial_file.write_bytes(parts._replace(metadata=lie).pack())
    assert any("does not fit its digest" in fault for fault in verify_dataset(folder, again=0))


def test_a_folder_without_index_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="has no index"):
        verify_dataset(tmp_path)


def test_a_label_that_the_contacts_contradict_is_found(folder: Path) -> None:
    """A whole trial file with a wrong label, and an index that repeats it."""
    paths = Dataset(folder).paths("b")
    parts = make_parts("b")
    wrong = dataclasses.replace(parts.labels, contact=not parts.labels.contact, first_frame=None)
    paths.trial_file.write_bytes(parts._replace(labels=wrong).pack())
    table, _ = build_index(folder)
    write_index(folder, table)
    assert any("labels/contact" in fault for fault in verify_dataset(folder, again=0))
