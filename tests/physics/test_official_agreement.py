"""The engine against the outcomes that the official simulator recorded."""

from __future__ import annotations

from pathlib import Path

import pytest

from physion.physics.labels import label_contact
from physion.physics.rigid.engine import MujocoEngine
from physion.scenes.tdw.read_logs import read_scenes


def agreement(official: Path, folder: str, limit: int) -> float:
    """Share of the first trials of a scenario whose outcome is the recorded one."""
    trials, _ = read_scenes(official / "scenes" / folder, limit=limit).unique()
    engine = MujocoEngine()
    same = [
        label_contact(t.scene, engine.simulate(t.scene)).contact == t.outcome.contact
        for t in trials
    ]
    assert len(same) >= limit // 2
    return sum(same) / len(same)


# Floors lie two or more trials below what was measured on these slices, above what chance gives.
@pytest.mark.parametrize(
    ("folder", "limit", "floor"), [("dominoes", 40, 0.95), ("collide", 40, 0.85)]
)
def test_outcomes_agree_with_the_recorded_ones(
    official: Path, folder: str, limit: int, floor: float
) -> None:
    assert agreement(official, folder, limit) >= floor


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "limit", "floor"),
    [
        ("drop", 200, 0.84),
        ("roll", 100, 0.78),
        ("support", 240, 0.75),
        ("contain", 205, 0.66),
        ("link", 100, 0.62),
    ],
)
def test_outcomes_agree_in_whole_scenarios(
    official: Path, folder: str, limit: int, floor: float
) -> None:
    assert agreement(official, folder, limit) >= floor
