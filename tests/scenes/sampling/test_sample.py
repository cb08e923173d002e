"""`physion.sample_scene`: a scene from a number, a seed, a preset or parameters."""

from __future__ import annotations

import pytest

import physion
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.seeds import named_seed
from physion.scenes.sampling.build import scenarios
from physion.scenes.sampling.sample import get_preset


def test_a_number_gives_the_same_scene_and_another_gives_another() -> None:
    first = physion.sample_scene("collide", 3)
    assert physion.sample_scene("collide", 3) == first != physion.sample_scene("collide", 4)
    assert physion.sample_scene("collide", named_seed("scene", "collide", 3)) == first
    assert physion.sample_scene("collide") == physion.sample_scene("collide", 0)


def test_a_preset_stands_for_its_parameters() -> None:
    name = "familiarization"
    scene = physion.sample_scene("collide", 1, preset=name)
    assert scene == physion.sample_scene("collide", 1, get_preset("collide", name).params)
    assert scene != physion.sample_scene("collide", 1)
    with pytest.raises(BadInputError, match="a preset, not both"):
        physion.sample_scene("collide", 1, scenarios.get("collide").params(), preset=name)
    with pytest.raises(UnknownNameError, match="closest: familiarization"):
        physion.sample_scene("collide", 1, preset="familiarisation")


def test_an_engine_can_be_named() -> None:
    scene = physion.sample_scene("collide", 1)
    own = physion.simulate(scene, frames=5)
    assert own.engine.startswith("physion-")
    assert physion.simulate(scene, frames=5, engine="mujoco").engine.startswith("mujoco-")
    with pytest.raises(UnknownNameError, match="unknown engine 'bullet'"):
        physion.simulate(scene, engine="bullet")
