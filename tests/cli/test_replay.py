"""The verb replay on a small hand-made command log."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from physion.cli.main import main


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A folder with one trial: a cube that falls on the zone."""

    def cube(id_: int, y: float, scale: tuple[float, float, float]) -> list[dict[str, Any]]:
        x_y_z = {"x": 0.0, "y": y, "z": 0.0}
        still = {"x": 0.0, "y": 0.0, "z": 0.0}
        factor = dict(zip("xyz", scale, strict=True))
        create = {"$type": "add_object", "id": id_, "name": "cube", "category": "flex_primitive"}
        return [
            {**create, "position": x_y_z, "rotation": still},
            {"$type": "scale_object", "id": id_, "scale_factor": factor},
            {"$type": "set_mass", "id": id_, "mass": 2.0},
        ]

    kinematic = {"$type": "set_kinematic_state", "id": 1, "is_kinematic": True}
    start = [*cube(1, 0.0, (2, 0.01, 2)), kinematic, *cube(2, 0.5, (0.2, 0.2, 0.2))]
    record = {
        "stimulus_name": "fall_0000",
        "controller_name": "Drop",
        "does_target_contact_zone": True,
        "first_target_contact_zone_frame": 31,
        "num_frames": 151,
        "final_target_displacement": {"x": 0.0, "y": 0.11, "z": 0.0},
    }
    (tmp_path / "tdw_commands.json").write_text(f"[] trial None\n{json.dumps(start)} trial 0\n")
    (tmp_path / "metadata.json").write_text(json.dumps([record]))
    return tmp_path


@pytest.mark.nightly
@pytest.mark.slow
def test_every_engine_has_a_row_and_every_column_a_legend(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "replay.json"
    options = ["--engines", "physion,mujoco", "--repeats", "2", "--workers", "1"]
    assert main(["replay", str(log), *options, "--json", str(out)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for column in ("jittered", "ceiling", "Brier", "log", "frames", "final"):
        assert f"{column}: " in text
    assert "AUC" not in text  # there is no cloth
    content = json.loads(out.read_text())
    assert [(row["engine"], row["trials"]) for row in content["scenarios"]] == [
        ("physion", 1),
        ("mujoco", 1),
    ]
    for row in content["scenarios"]:
        assert row["agreement"] == row["jittered_agreement"] == row["ceiling"] == 1.0
        # The cube rests on the zone, .01 m high; .11 m were recorded.
        assert row["final_error"] == pytest.approx(0.1, abs=2e-3)
        assert row["frame_difference"] <= 2 and row["auc"] is None
    assert [trial["jittered"] for trial in content["trials"]] == [[True, True]] * 2


def test_an_unknown_engine_is_refused_with_the_closest_names(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(log), "--engine", "mujocco"]) == 2
    assert "mujoco" in capsys.readouterr().err
