"""Where a rigid agent stands on the ground, from its outline in one picture.

The camera, the agent's shape, and the height of the patient's upper side are known. A resting agent
lies on one of its faces, rotated about the vertical axis by any angle. For each such pose there is
one place on the ground at which its picture has the same middle as the outline. It is found by a
few steps of

    pixel <- pixel + middle of the outline - middle of the picture of the pose at ground(pixel)

where ground(pixel) is the point at half the pose's height that a pixel shows. Of all poses those
count whose pictures have the extents of the outline along `DIRECTIONS` best. The agent stands on
the patient if part of its lowest face is then inside the patient's area.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.numerics.rotations import rotation_matrix
from physion.rendering.camera import View
from physion.scenes.scene import Scene
from physion.scenes.shapes.meshes import hull
from physion.scenes.shapes.primitives import shape

Floats = NDArray[np.float64]

DIRECTIONS = np.array([[1.0, 0.0], [0.0, 1.0], [0.5**0.5, 0.5**0.5], [0.5**0.5, -(0.5**0.5)]])
"""Directions in the picture (x, y) along which extents are compared."""
FACES, APART, ANGLES = 12, 0.94, 24
"""Most faces that the agent may lie on, largest cosine between two of them, and angles of each."""
STEPS = 3
FITS = (1.0, 0.03)
"""Largest error of the extents: pixels, and fraction of the outline's size."""
ALIKE = 0.01
"""Largest difference of the extents of poses that look alike, as a fraction of the largest."""
BEST = 5
"""Best poses, of which most must lie on the patient."""
LOWEST = 0.1
"""Height of the part of the agent that counts as its lowest face, as a fraction of its height."""


@dataclass(frozen=True)
class Ground:
    """Ground at the height of the patient's upper side, and the agent in all poses on it.

    - ``corners`` (P, C, 3): corners of the agent in each pose; the lowest one has z = 0, m.
    - ``center``, ``axes``, ``half``, ``hole``: the patient's area: middle (3,), axes (3, 3), half
      its size (2,), radius of a hole, m.
    """

    view: View
    height: float
    corners: Floats
    center: Floats
    axes: Floats
    half: Floats
    hole: float

    @classmethod
    def of(cls, scene: Scene, width: int, height: int) -> Ground | None:
        """Return the ground of a scene; None with a cloth, which has no fixed shape."""
        if scene.cloths:
            return None
        agent, patient = (
            scene.bodies[scene.index(name)] for name in (scene.roles.agent, scene.roles.patient)
        )
        solid, scale = shape(patient.shape), np.asarray(patient.scale)
        low, high = solid.bounds * scale
        axes = rotation_matrix(np.asarray(patient.rotation, np.float64))
        radii = np.hypot(*(solid.mesh.vertices[:, :2] * scale[:2]).T)
        return cls(
            view=View(scene.camera, width, height),
            height=float(patient.position[2] + high[2]),
            corners=_poses(shape(agent.shape).mesh.vertices * np.asarray(agent.scale)),
            center=np.asarray(patient.position) + axes @ ((low + high) / 2),
            axes=axes,
            half=(high - low)[:2] / 2,
            hole=float(radii.min()) if solid.hollow else 0.0,
        )

    def places(self, pixels: Floats, heights: Floats | float = 0.0) -> Floats:
        """Return the points (..., 3) over the ground at pixels (..., 2); NaN above the horizon."""
        rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1) @ self.view.ray_matrix.T
        camera = np.asarray(self.view.camera.position)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self.height + heights - camera[2]) / rays[..., 2]
        return np.asarray(camera + rays * np.where(depth > 0, depth, np.nan)[..., None])

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Return which points (..., 3) lie in the patient's area."""
        local = ((points - self.center) @ self.axes)[..., :2]
        within = (np.abs(local) <= self.half).all(axis=-1)
        return np.asarray(within & (np.hypot(*np.moveaxis(local, -1, 0)) >= self.hole))

    def touches(self, outline: Floats) -> bool:
        """Return whether an agent with this outline (n, 2) stands on the patient."""
        # Extents of the outline's pixels, as squares.
        margin = np.abs(DIRECTIONS).sum(axis=1) / 2
        along = (outline + 0.5) @ DIRECTIONS.T
        low, high = along.min(axis=0) - margin, along.max(axis=0) + margin
        middle, size = ((low + high) / 2)[:2], high - low
        top = self.corners[..., 2].max(axis=1)
        pixels = np.broadcast_to(middle, (len(top), 2))
        for _ in range(STEPS):
            origins = self.places(pixels, top / 2) * (1, 1, 0)
            origins[:, 2] = self.height
            shown = self.view.project(self.corners + origins[:, None])[0] @ DIRECTIONS.T
            lowest, highest = shown.min(axis=1), shown.max(axis=1)
            pixels = pixels + middle - (lowest + highest)[:, :2] / 2
        error = np.sqrt((((lowest - low) ** 2 + (highest - high) ** 2) / 2).mean(axis=1))
        error = np.where(np.isfinite(error), error, np.inf)
        best = np.argsort(error, kind="stable")[:BEST]
        if error[best[0]] > FITS[0] + FITS[1] * size.max():
            return False
        return bool(np.mean([self._stands(self.corners[k] + origins[k]) for k in best]) > 0.5)

    def _stands(self, corners: Floats) -> bool:
        up = corners[:, 2] - self.height
        foot = corners[up <= LOWEST * up.max()]
        parts = np.linspace(0, 1, 5)[:, None, None]
        return bool(self.inside(foot.mean(axis=0) + parts * (foot - foot.mean(axis=0))).any())


def _poses(points: Floats) -> Floats:
    """Return the corners of a solid on each of its largest faces, at all angles, (P, C, 3)."""
    mesh = hull(points)
    corners = mesh.vertices[mesh.faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    sizes = np.linalg.norm(areas, axis=1)
    normals = areas / sizes[:, None]
    # Triangles of one face count together.
    total = ((normals @ normals.T > 0.999) * sizes).sum(axis=1)
    chosen: list[int] = []
    for face in np.argsort(-total, kind="stable"):
        if len(chosen) < FACES and (normals[chosen] @ normals[face] < APART).all():
            chosen.append(int(face))
    poses = []
    for down in -normals[chosen]:
        side = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
        side /= np.linalg.norm(side)
        flat = mesh.vertices @ np.column_stack([side, np.cross(down, side), down])
        flat = flat - [*((flat.min(axis=0) + flat.max(axis=0)) / 2)[:2], flat[:, 2].min()]
        for angle in np.arange(ANGLES) * (2 * np.pi / ANGLES):
            cos, sin = np.cos(angle), np.sin(angle)
            poses.append(flat @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]))
    # Of poses that look alike, such as a cylinder that rolls, one is enough.
    views = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (0, 1)])
    extents = np.array([(pose @ views.T).max(axis=0) for pose in poses])
    kept: list[int] = []
    for place, extent in enumerate(extents):
        if (np.abs(extents[kept] - extent) > ALIKE * extents.max()).any(axis=1).all():
            kept.append(place)
    return np.stack([poses[place] for place in kept])
