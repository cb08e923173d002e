"""Rooms: those of this package, and one that another package adds and a preset uses."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from physion.core.errors import BadInputError
from physion.rendering.rooms import rooms
from physion.scenes.sampling.sample import parse_presets
from physion.scenes.scene import FLOORS

PRESET = """
scenario = "collide"
[presets.mine]
about = "In a room of another package."
params = {room = "red"}
"""
PLUG_IN = """
from dataclasses import replace
from physion.rendering.rooms import rooms
empty = rooms.get("empty")
RED = replace(empty, panels=tuple(replace(p, color=(1.0, 0.0, 0.0)) for p in empty.panels))
"""
SHOW = """
import numpy as np, sys
from physion.physics.engine import simulate
from physion.rendering.renderer import PASSES, Renderer
from physion.scenes.sampling.sample import sample_scene
scene = sample_scene("collide", 3, preset=f"{sys.argv[1]}:mine")
frame = Renderer(scene, simulate(scene, frames=2), 32, 32).render(0, PASSES)
room = frame.color[frame.ids == 0].astype(float)
print(scene.room, scene.floor, room[:, 0].mean() > 3 * room[:, 1].mean())
"""


def test_the_rooms_of_presets_match_the_renderer() -> None:
    assert set(FLOORS) == set(rooms.names())


def test_an_unknown_room_is_refused_when_the_preset_is_read() -> None:
    with pytest.raises(BadInputError, match="'red'"):
        parse_presets(PRESET, "my.toml")


def test_a_preset_may_use_a_room_of_another_package(tmp_path: Path) -> None:
    (tmp_path / "own_room.py").write_text(PLUG_IN)
    (tmp_path / "own-1.0.dist-info").mkdir()
    (tmp_path / "own-1.0.dist-info" / "METADATA").write_text("Name: own\nVersion: 1.0\n")
    points = "[physion.rooms]\nred = own_room:RED\n"
    (tmp_path / "own-1.0.dist-info" / "entry_points.txt").write_text(points)
    (tmp_path / "mine.toml").write_text(PRESET)
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-c", SHOW, str(tmp_path / "mine.toml")],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == ["red", "0.0", "True"], done.stderr
