"""The exported push point is the point at which the engine pushes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from physion.physics.engine import simulate
from physion.scenes.scene import Body, Camera, Push, Roles, Scene
from physion.trials.official.names import swap_axes
from physion.trials.official.write_file import _push
from physion.trials.official.write_objects import OfficialObjects


@pytest.mark.parametrize("shape", ["bowl", "pipe"])
def test_a_hollow_body_pushed_at_the_exported_point_does_not_spin(shape: str) -> None:
    """Without a point the impulse acts at the centre of mass: so must the exported point."""
    body = Body("a", shape, (0.3, -0.2, 5.0), (0.4, 0.5, 0.6), (0.8, 0.6, 0, 0), mass=2.0)
    zone = Body("zone", "cube", (9.0, 9.0, 0.0), (1, 1, 0.01), kinematic=True)
    push = Push("a", (3.0, 1.0, 2.0))
    camera = Camera((0, -3, 1))
    scene = Scene("t", "collide", (body, zone), Roles("a", "zone"), camera, pushes=(push,))
    path = simulate(scene, frames=3)
    exported = _push(OfficialObjects(scene, path))["push_position"]
    x, y, z = (float(value) for value in swap_axes(exported))
    again = replace(scene, pushes=(replace(push, point=(x, y, z)),))
    pushed = simulate(again, frames=3)
    np.testing.assert_allclose(pushed.velocities, path.velocities, atol=1e-5)
    # The point is stored in single precision; the centre of the drawn bowl would give far more.
    assert np.abs(pushed.angular_velocities).max() < 1e-4
