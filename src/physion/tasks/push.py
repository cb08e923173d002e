"""One push so that the agent touches the patient: an environment of Gymnasium.

    gymnasium.make("physion.tasks.push:physion/Push-v0", scenario="collide")

It needs the extra ``gymnasium``. An episode is one step. The scene is sampled from a preset of the
scenario, without its own push. The action pushes the probe, level, at its centre of mass, before
the first frame:

    impulse = mass * MAX_SPEED * (a_x, a_y, 0),        a in [-1, 1]^2

The reward is 1 if agent and patient touch in the rest of the trial, else 0. Equal seeds and actions
give equal observations and rewards on every machine.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError, MissingExtraError
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.physics.trajectory import Trajectory
from physion.rendering.renderer import Renderer
from physion.scenes.looks import in_look
from physion.scenes.sampling.sample import sample_scene
from physion.scenes.scene import Push, Scene
from physion.trials.share.lerobot import NAMES, states_of

try:
    import gymnasium
    from gymnasium import spaces
except ImportError:
    raise MissingExtraError("environments", "gymnasium") from None

SCENARIOS = ("collide", "contain", "dominoes", "link", "support")
"""Scenarios with a probe, which is pushed."""
SLOTS = 16
"""Places for objects in a state."""
MAX_SPEED = 10.0
"""Speed in m/s that the largest action gives the probe in one direction; in scenes of the presets
pushes give 0.8 to 9."""

LARGEST = 1000.0
"""Bound of the values of a state, which no trial comes near."""

Observation = NDArray[Any]


class PushEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Push the probe once so that red touches yellow.

    Parameters
    ----------
    scenario
        One of `SCENARIOS`.
    preset
        Preset that scenes are sampled from; by default, as in `sample_scene`, the default
        parameters of the scenario.
    observation
        ``states``: (16 * 13,) as in `physion.trials.share.lerobot`, agent and patient first;
        ``pixels``: (size, size, 3) in sRGB. At the start, and at the end of the trial.
    size
        Pixels per side of pictures.
    render_mode
        ``rgb_array`` for `render`, which draws what was observed last.

    Raises
    ------
    BadInputError
        For a scenario without a probe, or an unknown observation.
    """

    metadata = {  # noqa: RUF012 -- an instance variable of the base class
        "render_modes": ["rgb_array"],
        "render_fps": 30,
    }

    def __init__(
        self,
        scenario: str = "collide",
        *,
        preset: str | None = None,
        observation: Literal["states", "pixels"] = "states",
        size: int = 128,
        render_mode: str | None = None,
    ) -> None:
        if scenario not in SCENARIOS:
            raise BadInputError(
                f"nothing is pushed in scenario {scenario!r}; choose one of {', '.join(SCENARIOS)}"
            )
        if observation not in ("states", "pixels"):
            raise BadInputError(f"observation is states or pixels, not {observation!r}")
        self.scenario, self.preset, self.size = scenario, preset, size
        self.observation, self.render_mode = observation, render_mode
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space: spaces.Space[Observation] = (
            spaces.Box(-LARGEST, LARGEST, (SLOTS * len(NAMES),), np.float32)
            if observation == "states"
            else spaces.Box(0, 255, (size, size, 3), np.uint8)
        )
        self._shown: tuple[Scene, Trajectory] | None = None
        self._pushed = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Sample a scene; return what is observed, and its name (``info["scene"]``)."""
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(2**31))
        scene = sample_scene(self.scenario, drawn, preset=self.preset)
        scene = in_look(replace(scene, pushes=()), "redyellow")
        self._shown, self._pushed = (scene, simulate(scene, frames=1)), False
        return self._observe(), {"scene": scene.name}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Push the probe and simulate the trial to its end.

        ``info``: ``contact``, and ``first_contact_frame`` (-1 for none).
        """
        if self._shown is None or self._pushed:
            raise gymnasium.error.ResetNeeded("an episode is one push: call reset before the next")
        scene = self._shown[0]
        probe = scene.bodies[scene.index(str(scene.roles.probe))]
        level = np.clip(np.asarray(action, np.float64), -1.0, 1.0) * MAX_SPEED
        x, y = (float(value) * probe.mass for value in level)
        pushed = replace(scene, pushes=(Push(probe.name, (x, y, 0.0)),))
        path = simulate(pushed)
        labels = label_contact(pushed, path)
        self._shown, self._pushed = (pushed, path), True
        first = -1 if labels.first_frame is None else labels.first_frame
        info = {"contact": labels.contact, "first_contact_frame": first}
        return self._observe(), float(labels.contact), True, False, info

    def render(self) -> Any:
        """Return the picture (size, size, 3) of what was observed last; None without a mode."""
        return self._picture() if self.render_mode == "rgb_array" else None

    def _observe(self) -> Observation:
        assert self._shown is not None
        if self.observation == "pixels":
            return self._picture()
        scene, path = self._shown
        return np.asarray(states_of(scene, path, SLOTS)[-1].clip(-LARGEST, LARGEST))

    def _picture(self) -> NDArray[np.uint8]:
        if self._shown is None:
            raise gymnasium.error.ResetNeeded("there is no scene yet: call reset")
        scene, path = self._shown
        renderer = Renderer(scene, path, self.size, self.size)
        return np.asarray(renderer.render(len(path) - 1, ("color",)).color)


gymnasium.register(id="physion/Push-v0", entry_point="physion.tasks.push:PushEnv")
