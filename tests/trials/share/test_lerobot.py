"""A LeRobot dataset, read with pyarrow as its format says, holds the trials."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from physion.cli.main import main
from physion.core.errors import BadInputError
from physion.trials.dataset import Dataset
from physion.trials.share.card import about_states
from physion.trials.share.lerobot import CAMERA, export_lerobot
from support.viewer_dataset import FRAMES, PLANS, make_dataset

ORDER = ["drape_0", "drop_0", "drop_1", "drop_2"]
"""Names in the order of their splits: the last one is for training."""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_dataset(tmp_path_factory.mktemp("lerobot") / "trials")


@pytest.fixture(scope="module")
def made(source: Path) -> Path:
    out = source.parent / "out"
    assert main(["export", str(source), str(out), "--layout", "lerobot"]) == 0
    return out


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def test_episodes_are_trials_in_the_order_of_splits(source: Path, made: Path) -> None:
    info = read(made / "meta" / "info.json")
    assert info["codebase_version"] == "v3.0" and info["fps"] == 30
    assert (info["total_episodes"], info["total_frames"]) == (4, 4 * FRAMES)
    assert info["splits"] == {"testing": "0:3", "training": "3:4"}
    episodes = pq.read_table(made / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["trial"] for row in episodes] == ORDER
    assert [row["contact"] for row in episodes] == [True, True, False, True]
    assert [row["first_contact_frame"] for row in episodes] == [55, 50, -1, 20]
    tasks = pq.read_table(made / "meta/tasks.parquet").to_pandas()
    assert tasks.index.tolist() == episodes[0]["tasks"]
    for number, row in enumerate(episodes):
        assert (row["episode_index"], row["length"]) == (number, FRAMES)
        assert row["dataset_from_index"] == number * FRAMES == row["dataset_to_index"] - FRAMES
        assert row[f"videos/{CAMERA}/to_timestamp"] == pytest.approx(FRAMES / 30)
        movie = made / info["video_path"].format(
            video_key=CAMERA,
            chunk_index=row[f"videos/{CAMERA}/chunk_index"],
            file_index=row[f"videos/{CAMERA}/file_index"],
        )
        assert movie.read_bytes() == Dataset(source).paths(row["trial"]).movie.read_bytes()


def test_the_readme_says_where_states_come_from(source: Path, made: Path) -> None:
    text = (made / "README.md").read_text()
    assert text.startswith("# Physion trials as a LeRobot dataset\n")
    assert text.endswith(f"\n{about_states(Dataset(source).index['engine'])}\n")


def test_frames_hold_states_pushes_and_the_outcome(source: Path, made: Path) -> None:
    table = pq.read_table(made / "data/chunk-000/file-000.parquet")
    info = read(made / "meta" / "info.json")
    assert set(table.column_names) == set(info["features"]) - {CAMERA}
    rows = table.to_pandas()
    assert rows["index"].tolist() == list(range(4 * FRAMES))
    names = info["features"]["observation.state"]["names"]
    states = np.stack(rows["observation.state"]).reshape(4, FRAMES, 3, 13)
    assert names[13:17] == ["patient.x", "patient.y", "patient.z", "patient.qw"]
    path = Dataset(source).trial("drop_0").trajectory
    assert np.array_equal(states[1, :, 0, :3], path.positions[:, 0])
    assert np.array_equal(states[1, :, 0, 3:7], path.rotations[:, 0])
    assert np.array_equal(states[1, :, 1, :3], path.positions[:, 1])
    # The cloth falls from 1.2 m by a metre in 59 frames of a hundredth of a second.
    assert states[0, 0, 0, 2] == pytest.approx(1.2)
    assert states[0, 9, 0, 9] == pytest.approx(-1 / 0.59, rel=1e-4)
    actions = np.stack(rows["action"]).reshape(4, FRAMES, 7)
    pushed = [3.0, 4.0, 0.0, *path.positions[6, 0], 0.0]
    assert actions[1, 7] == pytest.approx(pushed)
    others = np.delete(actions[1], 7, axis=0)
    assert (others[:, :6] == 0).all() and (others[:, 6] == -1).all()
    success = rows["next.success"].to_numpy().reshape(4, FRAMES)
    assert success.sum(axis=1).tolist() == [5, 10, 0, 40]
    assert success[1].tolist() == [False] * 50 + [True] * 10
    done = rows["next.done"].to_numpy().reshape(4, FRAMES)
    assert done[:, -1].all() and done.sum() == 4
    stats = read(made / "meta" / "stats.json")
    assert stats["observation.state"]["mean"] == pytest.approx(
        states.reshape(-1, 39).mean(axis=0, dtype=np.float64)
    )
    assert stats[CAMERA]["mean"][0][0][0] == pytest.approx(40 / 255, abs=0.01)


def test_what_cannot_be_exported_is_one_line(source: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no trial of split readout"):
        export_lerobot(source, tmp_path / "out", split="readout")
    still = make_dataset(tmp_path / "still", (dataclasses.replace(PLANS[0], movies=False),))
    with pytest.raises(BadInputError, match="has no movie"):
        export_lerobot(still, tmp_path / "out")
    assert not (tmp_path / "out" / "meta").exists()
