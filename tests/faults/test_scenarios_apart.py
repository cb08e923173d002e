"""A change of one scenario changes no trial of another."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from physion.core.seeds import trial_seed
from physion.scenes.sampling.build import scenarios
from physion.scenes.sampling.sample import sample_scene


@pytest.mark.parametrize("changed", ["drop", "roll"])
def test_scenes_stay_when_another_scenario_draws_more(
    changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def scenes() -> dict[str, str]:
        seeds = {name: trial_seed("tests", name, "testing", 0) for name in scenarios.names()}
        return {name: sample_scene(name, seed).to_json() for name, seed in seeds.items()}

    before = scenes()
    registered, get = scenarios.get(changed), scenarios.get
    other = next(name for name in scenarios.names() if name != changed)

    def draws_more(params: Any, seed: Any) -> Any:
        sample_scene(other, trial_seed("tests", other, "testing", 1))
        return registered.sample(params, trial_seed("tests", changed, "testing", 99))

    replaced = dataclasses.replace(registered, sample=draws_more)
    monkeypatch.setattr(scenarios, "get", lambda name: replaced if name == changed else get(name))
    after = scenes()
    assert {name for name in after if after[name] != before[name]} == {changed}
