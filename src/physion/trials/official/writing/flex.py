"""Static groups of Drape: parameters of the cloth simulation, under the names of Flex commands.

``container`` has one number per parameter, each group of actors one row per object of its kind
(``object_id``), all named as in the commands ``create_flex_container``,
``set_flex_solid_actor`` and ``set_flex_cloth_actor`` (docs/official-system.md, sections 3.8
and 4.1). ``soft_actors`` and ``fluid_actors`` are empty, as in the originals.

Parameters that the solver of this package does not have are left out: of the container ``radius``
(interaction distance of particles), ``max_particles``, ``max_neighbors``, drag, sleep, planes and
everything for fluids; of cloths ``mesh_tesselation``, as sheets have vertices of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from physion.physics.cloth.simulate import ClothSettings
from physion.scenes.scene import Body, Cloth
from physion.trials.official.writing.objects import OfficialObjects

EMPTY = ("soft_actors", "fluid_actors")
"""Groups for kinds of objects that no scene has."""


def flex_groups(objects: OfficialObjects) -> Mapping[str, Mapping[str, Any]]:
    """Return the arrays by group and name; empty for a scene without cloth."""
    if not objects.scene.cloths:
        return {}
    numbered = list(enumerate(objects.things, start=1))
    solids = [id_ for id_, thing in numbered if isinstance(thing, Body) and not thing.scenery]
    cloths = [(id_, thing) for id_, thing in numbered if isinstance(thing, Cloth)]
    settings = ClothSettings()
    container = {
        "solid_rest": settings.rest_distance,
        "collision_distance": settings.floor_gap,
        "static_friction": settings.floor_friction,
        "dynamic_friction": settings.floor_friction,
        "particle_friction": settings.particle_friction,
        "damping": settings.damping,
    }
    counts = {"substep_count": settings.substeps, "iteration_count": settings.iterations}
    stiffness = {
        f"{name}_stiffness": _floats([getattr(cloth, name) for _, cloth in cloths])
        for name in ("stretch", "bend", "tether")
    }
    return {
        "container": {name: np.float32(value) for name, value in container.items()}
        | {name: np.int64(value) for name, value in counts.items()},
        "solid_actors": {
            "object_id": np.array(solids, np.int64),
            "mass_scale": _floats([1.0] * len(solids)),
            "mesh_expansion": _floats([0.0] * len(solids)),
            "particle_spacing": _floats([settings.particle_spacing] * len(solids)),
        },
        "cloth_actors": {
            "object_id": np.array([id_ for id_, _ in cloths], np.int64),
            "mass_scale": _floats([1.0] * len(cloths)),
            **stiffness,
            "tether_give": _floats([0.0] * len(cloths)),
            "pressure": _floats([0.0] * len(cloths)),
        },
        **{name: {} for name in EMPTY},
    }


def _floats(values: list[float]) -> Any:
    return np.array(values, np.float32)
