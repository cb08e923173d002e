"""Small scenes for tests of the rigid engine, whose motion can be worked out by hand."""

from __future__ import annotations

from dataclasses import replace

from physion.physics.rigid.bodies import RigidSettings
from physion.physics.rigid.engine import RigidEngine
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import (
    Body,
    BodyEvent,
    Camera,
    Joint,
    Push,
    Roles,
    Scene,
    SurfaceMaterial,
)

G = 9.81
DT = 0.01
ROUGH = SurfaceMaterial(0.5, 0.5, 0.0)
ICE = SurfaceMaterial(0.0, 0.0, 0.0)
ZONE = Body("zone", "cube", (9.0, 9.0, 0.0), (1, 1, 0.01), kinematic=True)


def scene_of(
    *bodies: Body,
    pushes: tuple[Push, ...] = (),
    joints: tuple[Joint, ...] = (),
    events: tuple[BodyEvent, ...] = (),
) -> Scene:
    """Return a scene of these bodies and a zone far away, which the first of them should touch."""
    return Scene(
        "test",
        "test",
        (*bodies, ZONE),
        Roles(bodies[0].name, "zone"),
        Camera((0, -3, 1)),
        pushes=pushes,
        joints=joints,
        events=events,
    )


def run(scene: Scene, frames: int | None = None, **changes: object) -> Trajectory:
    """Simulate with some settings changed."""
    return RigidEngine(replace(RigidSettings(), **changes)).simulate(scene, frames=frames)  # type: ignore[arg-type]


def way_of_steps(acceleration: float, steps: int) -> float:
    """Return the metres that a body at rest goes in ``steps``.

    The semi-implicit step moves with the velocity at its end: a dt² (1 + 2 + ... + n).
    """
    return acceleration * DT**2 * steps * (steps + 1) / 2
