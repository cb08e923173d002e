"""Two datasets are compared trial by trial."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from physion.cli.main import main as cli
from physion.compute.local import SerialExecutor
from physion.trials.dataset import Dataset
from physion.trials.index import build_index, write_index
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateJob, plan_scenes
from physion.trials.making.verify import compare_datasets
from physion.trials.video import encode_movie
from support.hand_made import FRAMES, SIZE, Parts, make_by_hand, make_parts, make_scene

Change = Callable[[Parts], Parts]
NAMES = ("a", "b", "c")


def make_set(folder: Path, change: Change | None = None, names: tuple[str, ...] = NAMES) -> Path:
    """Make trials; trial b is changed."""

    def make(job: GenerateJob) -> str:
        name = make_by_hand(job)
        if change is not None and name == "b":
            parts = change(make_parts(name, contact_frame=50 if job.task.index % 2 else None))
            meta = dataclasses.replace(
                parts.metadata,
                split=job.task.split,
                index=job.task.index,
                free_movies=len(job.looks) > 1,
                digest=parts.trajectory.digest(),
                engine=parts.trajectory.engine,
            )
            job.paths.trial_file.write_bytes(parts._replace(metadata=meta).pack())
        return name

    tasks = plan_scenes("tests", [make_scene(name) for name in names])
    assert not make_trials(folder, tasks, make=make, executor=SerialExecutor()).failed
    return folder


def moved(parts: Parts) -> Parts:
    """The box is 2 cm higher from frame 20 on, and 5 cm in the last one."""
    positions = parts.trajectory.positions.copy()
    positions[20:, 1, 2] += 0.02
    positions[-1, 1, 2] += 0.03
    return parts._replace(trajectory=dataclasses.replace(parts.trajectory, positions=positions))


def turned(parts: Parts) -> Parts:
    rotations = parts.trajectory.rotations.copy()
    rotations[3] += np.float32(0.1)
    return parts._replace(trajectory=dataclasses.replace(parts.trajectory, rotations=rotations))


def with_cloth_moved(parts: Parts) -> Parts:
    vertices = parts.trajectory.cloth_vertices.copy()
    vertices[7, 4, 0] -= 0.5
    changed = dataclasses.replace(parts.trajectory, cloth_vertices=vertices)
    return parts._replace(trajectory=changed)


def relabelled(parts: Parts) -> Parts:
    labels = dataclasses.replace(parts.labels, contact=not parts.labels.contact, first_frame=None)
    return parts._replace(labels=labels)


def test_equal_sets_are_equal(tmp_path: Path) -> None:
    compared = compare_datasets(make_set(tmp_path / "one"), make_set(tmp_path / "other"))
    assert compared.equal and compared.same == 3
    assert not compared.differences and not compared.versions


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (moved, r"b: other motion from frame 20 on, by up to 0\.05 m \(box; 60 and 60 frames\)"),
        (turned, r"b: other motion, with the same positions \(60 and 60 frames\)"),
        (with_cloth_moved, r"b: other motion from frame 7 on, by up to 0\.5 m \(a cloth; .*\)"),
        (relabelled, r"b: contact True against False; first_frame 50 against -"),
    ],
)
def test_each_difference_is_named(change: Change, expected: str, tmp_path: Path) -> None:
    compared = compare_datasets(make_set(tmp_path / "one"), make_set(tmp_path / "other", change))
    (line,) = compared.differences
    assert compared.same == 2 and not compared.equal
    assert re.fullmatch(expected, line), line


def test_other_versions_are_named_and_are_no_difference(tmp_path: Path) -> None:
    def renamed(parts: Parts) -> Parts:
        changed = dataclasses.replace(parts.trajectory, engine="by hand 2")
        return parts._replace(trajectory=changed)

    compared = compare_datasets(make_set(tmp_path / "one"), make_set(tmp_path / "other", renamed))
    assert compared.versions == ["engine: by hand 1; against by hand 1, by hand 2"]


def test_missing_trials_and_other_movies_are_named_on_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = make_set(tmp_path / "one"), make_set(tmp_path / "other", names=("a", "b", "d"))
    movie = Dataset(other).paths("a").movie
    movie.write_bytes(encode_movie(np.zeros((FRAMES, SIZE, SIZE, 3), np.uint8)))
    write_index(other, build_index(other)[0])
    assert cli(["verify", str(one), "--again", "0", "--against", str(other)]) == 1
    printed = capsys.readouterr().out.splitlines()
    assert f"c: only in {one}" in printed and f"d: only in {other}" in printed
    assert "a: other bytes of movie" in printed
    assert printed[-1].endswith("1 trials are the same, 1 differ, 2 are only in one of them")
    assert cli(["verify", str(one), "--again", "0", "--against", str(one)]) == 0


def test_json_holds_the_comparison(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = make_set(tmp_path / "one"), make_set(tmp_path / "other", moved)
    assert cli(["verify", str(one), "--again", "0", "--against", str(other), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["faults"] == [] and found["against"]["same"] == 2
    assert len(found["against"]["differences"]) == 1


def test_a_folder_that_is_no_dataset_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = make_set(tmp_path / "one")
    assert cli(["verify", str(one), "--again", "0", "--against", str(tmp_path / "none")]) == 2
    assert "none does not exist" in capsys.readouterr().err
