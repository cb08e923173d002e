"""Scenes of the original study can be rendered."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from physion.rendering.renderer import Renderer
from physion.scenes.tdw.read_logs import read_scenes
from support.rendered_scenes import resting


def test_first_trial_of_every_scenario_shows_agent_and_patient(official: Path) -> None:
    trials = read_scenes(official / "scenes", limit=1).trials
    assert len({trial.scene.scenario for trial in trials}) == 8
    for trial in trials:
        scene = trial.scene
        frame = Renderer(scene, resting(scene), 96, 96).render(0, ("color", "depth", "ids"))
        assert frame.color is not None and frame.depth is not None and frame.ids is not None
        assert np.isfinite(frame.depth).all(), scene.name
        assert 30 < frame.color.mean() < 190, scene.name
        assert (frame.color.min(-1) >= 253).mean() < 0.02, scene.name
        for role in (scene.roles.agent, scene.roles.patient):
            assert (frame.ids == scene.index(role) + 1).any(), (scene.name, role)
