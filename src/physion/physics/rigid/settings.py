"""Constants of the rigid-body engine: time step, solver, friction, sleep."""

from __future__ import annotations

from dataclasses import dataclass

from physion.physics.settings_tag import settings_tag
from physion.scenes.scene import FRAME_TIME, GRAVITY, SurfaceMaterial

FLOOR_MATERIAL = SurfaceMaterial(static_friction=0.6, dynamic_friction=0.6, restitution=0.0)
"""Unity's default material; the official scenes never set one for the floor."""


@dataclass(frozen=True, slots=True)
class RigidSettings:
    """Constants of the rigid-body engine. The defaults are those of the official simulator.

    "Unity" means a default of Unity 2019's physics (PhysX 4), "official" a value that the official
    command logs set, "PhysX" a constant of its patch-friction Gauss-Seidel solver.

    - ``dt``: seconds of a step; one step is one frame (official, measured from free falls).
    - ``gravity``: metres per second squared, downwards (official).
    - ``position_iterations``: Gauss-Seidel sweeps with penetration bias (official: 32).
    - ``velocity_iterations``: sweeps without bias, after the poses have moved (Unity: 1).
    - ``friction_sweeps``: number of the last position sweeps that solve friction; 0 means all
      (PhysX: 3).
    - ``persistent_manifolds``: contact points are kept from step to step (Unity 2019).
    - ``continuous``: bodies that could pass through each other in a step are swept, and stop where
      they hit (`physion.physics.rigid.collision.impacts`; Unity's mode ``continuous_dynamic``).
      Off, because the recorded scenes are not predicted better with it.
    - ``friction_doubling``: each of a patch's two anchors may bear the whole friction force, so
      that flat contacts have twice the friction of Coulomb's law. The official simulator behaves
      so (Unity's "improved patch friction" is off); with False the anchors divide the force.
    - ``contact_offset``: metres around every surface in which contacts are found (Unity: .01).
    - ``bias``: fraction of a penetration or gap that one step closes (PhysX: .8).
    - ``max_depenetration_speed``: metres per second (Unity: 10).
    - ``bounce_threshold``: approach speed in m/s above which restitution acts (Unity: 2).
    - ``friction_gain``: fraction of the tangential velocity that one sweep removes (PhysX: .8).
    - ``patch_cosine``: contacts whose normals agree by this cosine form one patch (PhysX: .999).
    - ``anchor_distance``: metres; a second friction anchor must be this far from the first, and
      anchors this far apart along the normal are forgotten (PhysX: .025).
    - ``anchor_gap``: metres; only contacts closer than this hold an anchor (PhysX: .04).
    - ``max_angular_velocity``: radians per second, about the centre of mass (Unity: 7).
    - ``sleep_threshold``: kinetic energy by mass in m²/s² (official: .01).
    - ``wake_time``: seconds of stillness before a body may sleep (PhysX: .4).
    - ``floor``: friction and restitution of the floor (Unity's default material).
    """

    dt: float = FRAME_TIME
    gravity: float = GRAVITY
    position_iterations: int = 32
    velocity_iterations: int = 1
    friction_sweeps: int = 3
    persistent_manifolds: bool = True
    continuous: bool = False
    friction_doubling: bool = True
    contact_offset: float = 0.01
    bias: float = 0.8
    max_depenetration_speed: float = 10.0
    bounce_threshold: float = 2.0
    friction_gain: float = 0.8
    patch_cosine: float = 0.999
    anchor_distance: float = 0.025
    anchor_gap: float = 0.04
    max_angular_velocity: float = 7.0
    sleep_threshold: float = 0.01
    wake_time: float = 0.4
    floor: SurfaceMaterial = FLOOR_MATERIAL

    def tag(self) -> str:
        """Return eight hexadecimal digits that change whenever a setting does."""
        return settings_tag(self)
