"""Interface of engines, their registry, and functions that run one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Protocol, runtime_checkable

from physion.core.errors import BadInputError
from physion.core.files import json_digest
from physion.core.registry import Registry
from physion.physics.trajectory import State, Trajectory
from physion.scenes.scene import Scene


class Engine(Protocol):
    """Simulator of scenes.

    The same scene gives the same bytes in every process and with any number of threads.
    """

    @property
    def name(self) -> str:
        """Return name and version of the engine and its settings, as stored with every trial.

        It starts with the engine's name in `engines` and a hyphen.
        """
        ...

    def simulate(
        self,
        scene: Scene,
        *,
        start: State | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> Trajectory:
        """Simulate ``scene`` until it ends.

        Parameters
        ----------
        scene : Scene
            Bodies, cloths, joints, pushes, events and ending.
        start : State, optional
            Continue from this instant: it is frame 0 of the result, and pushes and events at later
            frames of the trial still take place.
        frames : int, optional
            Number of frames, frame 0 included, in place of the scene's own ending.
        until_contact : bool
            Allow the engine to stop after the first frame in which agent and patient touch: the
            label is then known.
        """
        ...


@runtime_checkable
class SimulatesMany(Protocol):
    """Engine that can simulate several scenes in one call, which may be faster than one by one."""

    def simulate_many(
        self,
        scenes: Sequence[Scene],
        *,
        starts: Sequence[State] | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> list[Trajectory]:
        """Return for each scene what `Engine.simulate` gives, to the byte.

        See `physion.physics.engine.simulate_many` for the parameters.
        """
        ...


DEFAULT_ENGINE = "physion"
engines: Registry[type] = Registry(
    "engine",
    {
        "mujoco": "physion.physics.mujoco:MujocoEngine",
        "physion": "physion.physics.rigid.engine:RigidEngine",
    },
)
"""Engines by name: ours, after the official simulator, and MuJoCo's solver for rigid scenes."""


def make_engine(name: str = DEFAULT_ENGINE) -> Engine:
    """Return the engine called ``name`` with its default settings."""
    engine: Engine = engines.get(name)()
    return engine


def engine_of(stored: str) -> Engine:
    """Return the engine whose `Engine.name` was ``stored``, whatever its version.

    The default engine for a name that starts like none of `engines`.
    """
    name = stored.partition("-")[0]
    return make_engine(name if name in engines else DEFAULT_ENGINE)


def can_simulate(name: str, scene: Scene) -> bool:
    """Return whether the engine called ``name`` simulates what is in ``scene``.

    An engine without cloth says so with the class attribute ``simulates_cloth = False``.
    """
    return not scene.cloths or bool(getattr(engines.get(name), "simulates_cloth", True))


def simulate(
    scene: Scene,
    *,
    engine: Engine | str = DEFAULT_ENGINE,
    start: State | None = None,
    frames: int | None = None,
    until_contact: bool = False,
) -> Trajectory:
    """Simulate a scene.

    Parameters
    ----------
    scene
        Bodies, cloths, joints, pushes, events and ending.
    engine
        Engine, or its name (``physion ls engines``).
    start
        Continue from this instant, which is frame 0 of the result; by default all start at rest.
    frames
        Number of frames of 0.01 s, frame 0 included, in place of the scene's own ending.
    until_contact
        Allow the engine to stop after the first frame in which agent and patient touch.

    Returns
    -------
    trajectory
        Positions (F, N, 3) in metres, rotations (F, N, 4) as (w, x, y, z), velocities, vertices of
        cloths, and contacts of all F frames and N bodies.

    Raises
    ------
    UnknownNameError
        For an unknown engine.
    BadSceneError
        For a scene that the engine cannot simulate, such as cloth with MuJoCo.

    Examples
    --------
    >>> from physion import sample_scene
    >>> simulate(sample_scene("collide", 3), frames=20).positions.shape
    (20, 3, 3)
    """
    chosen = make_engine(engine) if isinstance(engine, str) else engine
    return chosen.simulate(scene, start=start, frames=frames, until_contact=until_contact)


def simulate_many(
    scenes: Sequence[Scene],
    *,
    engine: Engine | None = None,
    starts: Sequence[State] | None = None,
    frames: int | None = None,
    until_contact: bool = False,
) -> list[Trajectory]:
    """Simulate several scenes, in one call where the engine has one (`SimulatesMany`).

    Parameters
    ----------
    scenes
        For instance one scene with different noise; any scenes will do.
    engine
        By default the one called `DEFAULT_ENGINE`.
    starts
        The instant of each scene from which to continue; by default all start at rest.
    frames, until_contact
        As in `Engine.simulate`, for all scenes.
    """
    if starts is not None and len(starts) != len(scenes):
        raise BadInputError(f"{len(scenes)} scenes need as many starts, not {len(starts)}")
    chosen = engine if engine is not None else make_engine()
    if isinstance(chosen, SimulatesMany):
        return chosen.simulate_many(
            scenes, starts=starts, frames=frames, until_contact=until_contact
        )
    return [
        chosen.simulate(
            scene,
            start=None if starts is None else starts[index],
            frames=frames,
            until_contact=until_contact,
        )
        for index, scene in enumerate(scenes)
    ]


# Tag that distinguishes the settings of engines in the names of their results.


def settings_tag(settings: Any) -> str:
    """Return eight hexadecimal digits that change whenever a field of a dataclass does."""
    return json_digest(asdict(settings))[:8]
