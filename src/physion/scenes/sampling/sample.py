"""Sampling of a scene from the name of its scenario, a seed, and a preset or parameters."""

from __future__ import annotations

import numpy as np

from physion.errors import BadInputError
from physion.scenes.sampling.parameters import check_params
from physion.scenes.sampling.preset import get_preset
from physion.scenes.sampling.registry import scenarios
from physion.scenes.scene import Scene
from physion.seeds import named_seed


def sample_scene(
    scenario: str,
    seed: int | np.random.SeedSequence = 0,
    params: object | None = None,
    *,
    preset: str | None = None,
) -> Scene:
    """Sample a scene; equal arguments give equal scenes on every machine.

    Parameters
    ----------
    scenario
        Name of a scenario (``physion ls scenarios``).
    seed
        Number of the scene, or the seed of a trial from `physion.seeds.trial_seed`.
    params
        Parameters of the scenario; by default those of ``preset``, or else the scenario's own.
    preset
        Name of a preset (``physion ls presets SCENARIO``), or ``FILE.toml:NAME``.

    Returns
    -------
    scene
        Bodies, cloths, roles, camera, room, pushes and ending; metres, kilograms, seconds, z up.

    Raises
    ------
    UnknownNameError
        For an unknown scenario or preset; the message names the closest ones.
    BadInputError
        For parameters that are not allowed, or parameters and a preset.
    BadSceneError
        If no scene fits the parameters.

    Examples
    --------
    >>> scene = sample_scene("collide", 3)
    >>> scene.roles.agent, scene.roles.patient
    ('target', 'zone')
    """
    chosen = scenarios.get(scenario)
    if params is not None and preset is not None:
        raise BadInputError(f"scenario {scenario!r}: give parameters or a preset, not both")
    if preset is not None:
        params = get_preset(scenario, preset).params
    if params is None:
        params = chosen.params()
    elif not isinstance(params, chosen.params):
        raise BadInputError(
            f"scenario {scenario!r} takes {chosen.params.__module__}.{chosen.params.__name__}, "
            f"not {type(params).__name__}"
        )
    else:
        check_params(params, f"parameters of {scenario}")
    if isinstance(seed, int):
        seed = named_seed("scene", scenario, seed)
    return chosen.sample(params, seed)
