"""What the viewer shows of imagined trials: few bytes, the right frames, the right colours."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physion.clips.batch import ImaginedTrial
from physion.core.errors import BadInputError
from physion.report.viewer.build import ViewerOptions, build_viewer
from physion.report.viewer.imagined import REACH, STEPS, caption, pack_imagined
from support.viewer_dataset import PLANS, make_dataset, make_scene

SCENE = make_scene(PLANS[0])
"""Ball (agent), plate (patient, kinematic) and a vase (scenery)."""


def falling(frames: int = 6, count: int = 4, stride: int = 3, **changes: Any) -> ImaginedTrial:
    """Particles of the ball that fall 1 cm a frame, and of a plate that stays at height 0."""
    at = 44 + stride * np.arange(1, frames + 1)
    positions = np.zeros((frames, 2 * count, 3), np.float32)
    positions[:, :, 0] = np.arange(2 * count)
    positions[:, count:, 2] = 1 - 0.01 * (at[:, None] - 44)
    things = np.repeat([1, 0], count)
    shown = {"particles": positions, "things": things}
    return dataclasses.replace(ImaginedTrial("sim", "weights random", at, shown), **changes)


def unpack(packed: dict[str, Any]) -> np.ndarray:
    grid = packed["particles"]["points"]
    steps = np.frombuffer(base64.b64decode(grid["data"]), "<u2").reshape(-1, 3)
    points = np.array(grid["low"]) + steps / STEPS * np.array(grid["size"])
    return points.reshape(len(packed["particles"]["frames"]), -1, 3)


def test_particles_are_sorted_by_object_and_keep_their_positions() -> None:
    packed = pack_imagined(falling(), SCENE, 60)
    assert packed["particles"]["groups"] == [
        {"role": "agent", "first": 0, "count": 4},
        {"role": "patient", "first": 4, "count": 4},
    ]
    # The last row lies past the last frame, 59, so that frames 57 to 59 are between two.
    assert packed["particles"]["frames"] == [47, 50, 53, 56, 59]
    assert packed["particles"]["from"] == 45
    points = unpack(packed)
    assert points[:, :4, 2] == pytest.approx(
        np.repeat(1 - 0.01 * np.array([[3], [6], [9], [12], [15]]), 4, axis=1), abs=1e-4
    )
    assert np.abs(points[:, 4:, 2]).max() < 1e-4
    assert points[0, :, 0] == pytest.approx([4, 5, 6, 7, 0, 1, 2, 3], abs=1e-3)


def test_the_row_after_the_last_frame_is_kept_and_no_later_one() -> None:
    assert pack_imagined(falling(), SCENE, 55)["particles"]["frames"] == [47, 50, 53, 56]
    assert pack_imagined(falling(), SCENE, 46)["particles"]["frames"] == [47]


def test_absent_particles_and_bodies_that_cannot_move_are_left_out() -> None:
    one = falling()
    things = np.array([-1, 1, 1, 1, 0, 0, 0, 0])
    packed = pack_imagined(
        dataclasses.replace(one, shown={**one.shown, "things": things}), SCENE, 60
    )
    assert [group["count"] for group in packed["particles"]["groups"]] == [4, 3]
    bodies = tuple(dataclasses.replace(body, kinematic=True) for body in SCENE.bodies)
    fixed = dataclasses.replace(SCENE, bodies=bodies)
    things = np.array([2, 2, 1, 1, 0, 0, 0, 0])
    packed = pack_imagined(
        dataclasses.replace(one, shown={**one.shown, "things": things}), fixed, 60
    )
    assert [group["role"] for group in packed["particles"]["groups"]] == ["agent", "patient"]


def test_rows_that_are_not_finite_end_the_motion() -> None:
    one = falling()
    positions = one.shown["particles"].copy()
    positions[2, 5, 1] = np.nan
    shown = {**one.shown, "particles": positions}
    packed = pack_imagined(dataclasses.replace(one, shown=shown), SCENE, 60)
    assert packed["particles"]["frames"] == [47, 50]
    positions[0] = np.inf
    with pytest.raises(BadInputError, match="no particle with a finite position"):
        pack_imagined(dataclasses.replace(one, shown=shown), SCENE, 60)


def test_lost_objects_do_not_coarsen_the_grid() -> None:
    one = falling()
    positions = one.shown["particles"].copy()
    positions[3, 7] = 1e6
    packed = pack_imagined(
        dataclasses.replace(one, shown={**one.shown, "particles": positions}), SCENE, 60
    )
    assert unpack(packed).max() == pytest.approx(REACH)


def test_many_particles_take_less_than_a_megabyte() -> None:
    packed = pack_imagined(falling(frames=258, count=5000, stride=1), SCENE, 302)
    assert len(json.dumps(packed)) < 1_000_000
    frames, groups = packed["particles"]["frames"], packed["particles"]["groups"]
    assert frames[0] == 45 and frames[-1] == 301 and len(frames) > 60
    assert [group["count"] for group in groups] == [750, 750]
    points = unpack(packed)
    assert points[:, 0, 2] == pytest.approx(1 - 0.01 * (np.array(frames) - 44), abs=1e-3)


def test_wrong_shapes_and_unknown_arrays_are_refused() -> None:
    one = falling()
    short = {**one.shown, "things": np.zeros(3, np.int64)}
    with pytest.raises(BadInputError, match=r"here \(6, 3, 3\), not \(6, 8, 3\)"):
        pack_imagined(dataclasses.replace(one, shown=short), SCENE, 60)
    beyond = {**one.shown, "things": np.full(8, 3)}
    with pytest.raises(BadInputError, match="things objects of the scene"):
        pack_imagined(dataclasses.replace(one, shown=beyond), SCENE, 60)
    with pytest.raises(BadInputError, match="'sim' imagined nothing that the viewer shows"):
        pack_imagined(dataclasses.replace(one, shown={"smell": np.zeros(1)}), SCENE, 60)


def test_the_caption_says_what_is_known() -> None:
    assert caption(falling()) == "sim (weights random)."
    assert caption(falling(probability=1.0, gap=-0.004)) == (
        "sim (weights random): P(contact) 1.00; smallest gap -0.004 m, 0 or less is a contact."
    )
    text = caption(falling(probability=1.0, gap=-10.0), observed=True)
    assert text == "sim (weights random): P(contact) 1.00; the contact was already observed."
    text = caption(falling(probability=0.25, gap=0.5, futures=8))
    assert "P(contact) 0.25 from 8 futures; smallest gap of the one shown 0.500 m" in text


def test_only_detailed_trials_are_imagined_once(tmp_path: Path) -> None:
    folder = make_dataset(tmp_path / "set", PLANS[:3])
    asked = []

    def imagine(trials: Any) -> dict[str, list[ImaginedTrial]]:
        asked.append(list(trials))
        falls = falling(probability=1.0, gap=-10.0)
        return {trials[0]: [falls, falling(model="other", frames=3)], trials[1]: [falls]}

    options = ViewerOptions(details=2, card_size=32, pass_size=32, stride=6)
    page = build_viewer(folder, tmp_path / "v.html", options, imagine=imagine).page
    assert asked == [["drop_0", "drop_2"]]
    blocks = re.findall(r'id="detail-(\d)">(.*?)</script>', page.read_text())
    details = {int(number): json.loads(text) for number, text in blocks}
    assert [one["model"] for one in details[0]["imagined"]] == ["sim", "other"]
    assert "imagined" not in details[1]
    # They touched in frame 20 of drop_2, and in frame 50 of drop_0.
    assert "smallest gap -10.000 m" in details[0]["imagined"][0]["caption"]
    assert details[2]["imagined"][0]["caption"].endswith("the contact was already observed.")
