"""Constants of the MuJoCo engine: time step, contact, friction, rest."""

from __future__ import annotations

from dataclasses import dataclass

from physion.physics.rigid.settings import FLOOR_MATERIAL
from physion.physics.settings_tag import settings_tag
from physion.scenes.scene import GRAVITY, SurfaceMaterial


@dataclass(frozen=True, slots=True)
class MujocoSettings:
    """Constants of the MuJoCo engine, the same for all scenarios.

    - ``substeps``: steps of MuJoCo for each frame of 0.01 s.
    - ``gravity``: metres per second squared, downwards.
    - ``contact_time``: seconds in which a contact settles, `solref[0]` of MuJoCo: its contacts are
      damped springs. Shorter ones are stiffer. Of .005, .01 and .02, this one agrees best with
      the outcomes of the official scenes.
    - ``friction_factor``: factor of the mean dynamic friction of both materials. MuJoCo has one
      coefficient for sticking and sliding. 2 as in the official simulator, whose flat contacts
      have twice the friction of Coulomb's law; 1.5 agrees less with its outcomes.
    - ``torsion``: friction against rotation about the normal, metres.
    - ``max_angular_velocity``: radians per second, about the centre of mass (Unity: 7).
    - ``rest_energy``: kinetic energy by mass in m²/s² below which a body counts as still;
      ``rest_time``: seconds after which a still body is at rest.
    - ``floor``: friction and restitution of the floor (Unity's default material).
    """

    substeps: int = 4
    gravity: float = GRAVITY
    contact_time: float = 0.01
    friction_factor: float = 2.0
    torsion: float = 0.02
    max_angular_velocity: float = 7.0
    rest_energy: float = 1e-4
    rest_time: float = 0.4
    floor: SurfaceMaterial = FLOOR_MATERIAL

    def tag(self) -> str:
        """Return eight hexadecimal digits that change whenever a setting does."""
        return settings_tag(self)
