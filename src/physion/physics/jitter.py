"""Perturb the initial positions of a scene slightly, to test whether its outcome is robust."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from physion.numerics.random_normals import standard_normal
from physion.scenes.scene import Scene, Vec3


def jitter_scene(scene: Scene, distance: float, rng: np.random.Generator) -> Scene:
    """Return the scene with movable bodies and cloths shifted horizontally by normal noise.

    ``distance`` is the standard deviation in metres along x and along y. Joined bodies are shifted
    together, and the point of a push with its body.
    """
    leaders = {joint.child: joint.parent for joint in scene.joints}
    moving = [body.name for body in scene.bodies if not (body.kinematic or body.scenery)]
    moving += [cloth.name for cloth in scene.cloths]
    draws = (distance * standard_normal(rng, (len(moving), 2))).tolist()
    shifts = {name: (x, y, 0.0) for name, (x, y) in zip(moving, draws, strict=True)}

    def moved(name: str, position: Vec3) -> Vec3:
        visited = {name}
        # Joints may close a ring: stop before a body is met again.
        while name in leaders and leaders[name] not in visited:
            name = leaders[name]
            visited.add(name)
        dx, dy, dz = shifts.get(name, (0.0, 0.0, 0.0))
        return (position[0] + dx, position[1] + dy, position[2] + dz)

    return replace(
        scene,
        bodies=tuple(replace(b, position=moved(b.name, b.position)) for b in scene.bodies),
        cloths=tuple(replace(c, position=moved(c.name, c.position)) for c in scene.cloths),
        pushes=tuple(
            p if p.point is None else replace(p, point=moved(p.body, p.point)) for p in scene.pushes
        ),
    )


def pair_agreement(outcomes: np.ndarray) -> float:
    """Return the probability that two different runs of one scene have the same outcome.

    ``outcomes`` (R,) are bool, one for each run; NaN for fewer than two. With h of R runs True
    it is (h (h - 1) + (R - h) (R - h - 1)) / (R (R - 1)).
    """
    runs, hits = len(outcomes), int(np.count_nonzero(outcomes))
    if runs < 2:
        return float("nan")
    return (hits * (hits - 1) + (runs - hits) * (runs - hits - 1)) / (runs * (runs - 1))
