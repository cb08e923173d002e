"""Unknown quantities of the official simulator, with the values that `calibrate.py` tries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import calibration_shapes as made
from physion.physics.rigid import bodies as hulls
from physion.physics.rigid.bodies import MassProperties
from physion.scenes.scene import Scene, SurfaceMaterial
from physion.scenes.shapes import primitives
from physion.scenes.shapes.primitives import Shape


@dataclass(frozen=True)
class Quantity:
    """Something unknown: the present value first, then others.

    ``field`` names a field of `RigidSettings`, ``constant`` a constant of ``module``; ``build``
    makes the shape ``shapes[0]`` of a value, ``mass`` the mass properties of a value and the
    present ones, ``scene`` the scene. ``shapes`` are the shapes that it concerns, by default all,
    ``configurations`` a part of the names of the configurations. ``room`` is the one whose floor
    height is meant.
    """

    name: str
    values: tuple[Any, ...]
    field: str = ""
    constant: str = ""
    room: str = ""
    shapes: tuple[str, ...] = ()
    module: Any = primitives
    configurations: str = ""
    build: Callable[[Any], Shape] | None = None
    mass: Callable[[Any, MassProperties], MassProperties] | None = None
    scene: Callable[[Scene, Any], Scene] | None = None


def material(friction: float) -> SurfaceMaterial:
    """Material of the floor with equal static and dynamic friction."""
    return SurfaceMaterial(friction, friction, 0.0)


RAMP = "ramp_with_platform_30"
QUANTITIES = {
    q.name: q
    for q in (
        Quantity("friction_sweeps", (3, 0), field="friction_sweeps"),
        Quantity("persistent_manifolds", (True, False), field="persistent_manifolds"),
        Quantity(
            "floor_friction",
            tuple(material(value) for value in (0.6, 0.4, 0.8)),
            field="floor",
        ),
        Quantity("floor_height", (0.0043, 0.0, 0.002, 0.004, 0.006), room="bright"),
        Quantity("ball_segments", (16, 12, 14, 20, 24), constant="BALL_SEGMENTS", module=hulls,
                 shapes=("sphere",)),
        Quantity("pipe_inner", (0.389, 0.25, 0.3, 0.33, 0.35, 0.37, 0.42),
                 constant="PIPE_PIECE_INNER", shapes=("pipe",)),
        Quantity("pipe_sectors", (16, 8, 32), constant="PIPE_SECTORS", shapes=("pipe",)),
        Quantity("torus_inner", (0.429, 0.34, 0.355, 0.37, 0.385, 0.40, 0.45),
                 constant="TORUS_PIECE_INNER", shapes=("torus",)),
        Quantity("torus_sectors", (16, 8, 4), constant="TORUS_SECTORS", shapes=("torus",)),
        Quantity("torus_bevel", (0.06, 0.001, 0.03, 0.09, 0.12), constant="TORUS_BEVEL",
                 shapes=("torus",)),
        Quantity("bowl_flat", (0.2, 0.1, 0.15, 0.25, 0.3), constant="BOWL_FLAT", shapes=("bowl",)),
        Quantity("bowl_wall", (0.035, 0.02, 0.028, 0.045, 0.06), constant="BOWL_PIECE_WALL",
                 shapes=("bowl",)),
        Quantity("cylinder_sides", (16, 12, 20, 24, 32), constant="CYLINDER_SIDES", module=hulls,
                 shapes=("cylinder",)),
        Quantity("cone_sides", (22, 16, 32), constant="CONE_SEGMENTS", shapes=("cone",)),
        Quantity("ramp_foot", (1.629, 1.5, 1.58, 1.68), constant="RAMP_FOOT",
                 shapes=(RAMP, "ramp_with_platform_60")),
        Quantity("pentagon_bevel", (0.0, 0.01, 0.02, 0.04), build=made.pentagon,
                 shapes=("pentagon",)),
        Quantity("pentagon_corner", (-1.0, 1.0), build=made.pentagon_turned, shapes=("pentagon",)),
        Quantity("basket",
                 (None, (0.0446, 0.0446, False), (0.035, 0.035, True), (0.02, 0.02, False),
                  (0.02, 0.02, True), (0.03, 0.03, False), (0.03, 0.0446, False),
                  (0.06, 0.0446, False), (0.06, 0.06, False)),
                 build=made.basket, shapes=("prop:basket",)),
        Quantity("cone_tip", (0.0, 0.005, 0.01, 0.02, 0.05), build=made.cone, shapes=("cone",)),
        Quantity("pyramid_tip", (0.0, 0.005, 0.01, 0.02, 0.05), build=made.pyramid,
                 shapes=("pyramid",)),
        Quantity("pipe_center", (0.0, -0.1, -0.05, 0.05, 0.1), mass=made.pipe_center,
                 shapes=("pipe",)),
        Quantity("pipe_wall_and_center",
                 ((0.389, 0.0), (0.33, -0.05), (0.33, 0.0), (0.33, 0.05), (0.36, -0.05),
                  (0.36, 0.0), (0.36, 0.05), (0.42, -0.05), (0.42, 0.05)),
                 build=made.pipe_joint, mass=made.pipe_center, shapes=("pipe",)),
        Quantity("pipe_rim", (0.0, 0.01, 0.02, 0.04), build=made.pipe_rim, shapes=("pipe",)),
        Quantity("ramp_lift", (0.0, 0.00704), build=made.ramp, shapes=(RAMP,)),
        Quantity("ramp_edge", (0.0, -0.2, -0.1, 0.1, 0.2), build=made.ramp_edge, shapes=(RAMP,)),
        Quantity("ramp_end", (0.0, -0.2, 0.2), build=made.ramp_end, shapes=(RAMP,)),
        Quantity("ramp_bevel", (0.0, 0.01, 0.03), build=made.ramp_bevel, shapes=(RAMP,)),
        Quantity("ledge_shape", ("sphere", "half:cylinder", "cube"), scene=made.ledge_shape,
                 configurations="ledge"),
        Quantity("ledge_height", (0.0, -0.01, -0.005, 0.005, 0.01), scene=made.ledge_height,
                 configurations="ledge"),
    )
}  # fmt: skip
