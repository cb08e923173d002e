"""Interface of engines, their registry, and `simulate`, which runs the default one."""

from __future__ import annotations

from typing import Protocol

from physion.physics.trajectory import State, Trajectory
from physion.registry import Registry
from physion.scenes.scene import Scene


class Engine(Protocol):
    """Simulator of scenes.

    The same scene gives the same bytes in every process and with any number of threads.
    """

    @property
    def name(self) -> str:
        """Return name and version of the engine and its settings, as stored with every trial."""
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
            Bodies, cloths, joints, pushes and ending.
        start : State, optional
            Continue from this instant: it is frame 0 of the result, and pushes at later frames of
            the trial still take place.
        frames : int, optional
            Number of frames, frame 0 included, in place of the scene's own ending.
        until_contact : bool
            Allow the engine to stop after the first frame in which agent and patient touch: the
            label is then known.
        """
        ...


engines: Registry[type] = Registry("engine", {"mujoco": "physion.physics.rigid.engine:RigidEngine"})


def simulate(
    scene: Scene,
    *,
    engine: Engine | None = None,
    start: State | None = None,
    frames: int | None = None,
    until_contact: bool = False,
) -> Trajectory:
    """Simulate a scene with ``engine``, by default `RigidEngine` with its default settings.

    See `Engine.simulate` for the other parameters.
    """
    chosen = engine if engine is not None else engines.get("mujoco")()
    return chosen.simulate(  # type: ignore[no-any-return]
        scene, start=start, frames=frames, until_contact=until_contact
    )
