"""What an engine is: something that turns a scene into a trajectory."""

from __future__ import annotations

from typing import Protocol

from physion.physics.trajectory import State, Trajectory
from physion.registry import Registry
from physion.scenes.scene import Scene


class Engine(Protocol):
    """Simulates scenes. The same scene gives the same bytes in any process and thread count."""

    @property
    def name(self) -> str:
        """Name and version of the engine and of its settings, as stored with every trial."""
        ...

    def simulate(
        self,
        scene: Scene,
        *,
        start: State | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> Trajectory:
        """Move ``scene`` until it ends.

        With ``start`` the motion goes on from that instant: frame 0 of the result is ``start``,
        and pushes at later frames of the trial still come. ``frames`` replaces the scene's own
        ending by a fixed number of frames, frame 0 counted. ``until_contact`` lets the engine
        stop after the first frame in which agent and patient touch: the label is then known.
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
    """Simulate with ``engine``, or with MuJoCo in its default settings."""
    chosen = engine if engine is not None else engines.get("mujoco")()
    return chosen.simulate(  # type: ignore[no-any-return]
        scene, start=start, frames=frames, until_contact=until_contact
    )
