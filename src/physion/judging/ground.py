"""Where a rigid agent stands on the ground, from its outline in one picture.

The camera, the agent's shape, and the height of the patient's upper side are known. A resting agent
lies on one of its faces, rotated about the vertical axis by any angle. For each such pose there is
one place on the ground at which its picture has the same middle as the outline. It is found by a
few steps of

    pixel <- pixel + middle of the outline - middle of the picture of the pose at ground(pixel)

where ground(pixel) is the point at half the pose's height that a pixel shows. Of all poses those
count whose pictures end where the outline ends, in all of `SIDES`. The agent stands on the patient
if part of its lowest face is then inside the patient's area.

Where a body in front of both, or the picture's edge, cuts the outline off, the agent reaches at
least so far. Such an end counts only if the picture of a pose does not reach it, and the middle is
taken of the other ends.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from physion.numerics.rotations import rotation_matrix
from physion.rendering.camera import View
from physion.scenes.scene import Scene
from physion.scenes.shapes.meshes import hull
from physion.scenes.shapes.primitives import shape

Floats = NDArray[np.float64]

_HALF = 0.5**0.5
SIDES = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [_HALF, _HALF], [-_HALF, -_HALF],
                  [_HALF, -_HALF], [-_HALF, _HALF]])  # fmt: skip
"""Directions in the picture (x, y) along which the ends of outlines are compared, in pairs."""
OUTSIDE = 2.5
"""Pixels outside an outline at which it is seen what cuts it off."""
FACES, APART, ANGLES = 12, 0.94, 24
"""Most faces that the agent may lie on, largest cosine between two of them, and angles of each."""
STEPS = 3
FITS = (1.0, 0.03)
"""Largest error of the ends: pixels, and fraction of the outline's size."""
ALIKE = 0.01
"""Largest difference of the extents of poses that look alike, as a fraction of the largest."""
BEST = 5
"""Best poses that fit, of which most must lie on the patient."""
LOWEST = 0.1
"""Height of the part of the agent that counts as its lowest face, as a fraction of its height."""


@dataclass(frozen=True)
class Ground:
    """Ground at the height of the patient's upper side, and the agent in all poses on it.

    - ``corners`` (3, C, P): corners of the agent in each pose; the lowest one has z = 0, m.
      ``seen_corners``: the same, as homogeneous pixels without the camera's place.
    - ``hidden`` (H, W): pixels of bodies that stand in front of agent and patient.
    - ``center``, ``axes``, ``half``, ``hole``: the patient's area: middle (3,), axes (3, 3), half
      its size (2,), radius of a hole, m.
    - ``judged``: answers by the ends of outlines, since much rests in many frames.
    """

    view: View
    height: float
    corners: Floats
    seen_corners: Floats
    hidden: NDArray[np.bool_]
    center: Floats
    axes: Floats
    half: Floats
    hole: float
    judged: dict[tuple[float, ...], bool] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, scene: Scene, ids: NDArray[np.integer]) -> Ground | None:
        """Return the ground of a scene; None with a cloth, which has no fixed shape.

        ``ids`` (H, W): the bodies in the first frame, as a trial file has them.
        """
        if scene.cloths:
            return None
        agent, patient = (
            scene.bodies[scene.index(name)] for name in (scene.roles.agent, scene.roles.patient)
        )
        solid, scale = shape(patient.shape), np.asarray(patient.scale)
        low, high = solid.bounds * scale
        axes = rotation_matrix(np.asarray(patient.rotation, np.float64))
        radii = np.hypot(*(solid.mesh.vertices[:, :2] * scale[:2]).T)
        height, width = ids.shape
        view = View(scene.camera, width, height)
        depths = view.project([body.position for body in scene.bodies])[1]
        nearest = min(depths[scene.index(body.name)] for body in (agent, patient))
        front = [k + 1 for k, body in enumerate(scene.bodies)
                 if body.scenery and depths[k] < nearest]  # fmt: skip
        corners = _poses(shape(agent.shape).mesh.vertices * np.asarray(agent.scale))
        corners = np.ascontiguousarray(corners.transpose(2, 1, 0))
        return cls(
            view=view,
            height=float(patient.position[2] + high[2]),
            corners=corners,
            seen_corners=np.tensordot(view.to_pixels[:, :3], corners, 1),
            hidden=np.isin(ids, front),
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
        along = (outline + 0.5) @ SIDES.T
        ends = along.max(axis=0) + np.abs(SIDES).sum(axis=1) / 2
        known = ~self._cut_off(outline, along)
        key = (*ends.tolist(), *known.tolist())
        if key not in self.judged:
            self.judged[key] = self._stands_where(ends, known)
        return self.judged[key]

    def _cut_off(self, outline: Floats, along: Floats) -> NDArray[np.bool_]:
        """Return on which of `SIDES` (8,) something in front, or the edge, cuts an outline off."""
        found = np.zeros(len(SIDES), np.bool_)
        height, width = self.hidden.shape
        (left, top), (right, bottom) = (
            np.rint(end).astype(int) for end in (outline.min(axis=0) - 3, outline.max(axis=0) + 3)
        )
        free = left >= 0 and top >= 0 and right < width and bottom < height
        if free and not self.hidden[top : bottom + 1, left : right + 1].any():
            return found
        for place, side in enumerate(SIDES):
            last = outline[along[:, place] >= along[:, place].max() - 1.0]
            next_to = np.round(last + OUTSIDE * side).astype(int)
            x, y = np.clip(next_to[:, 0], 0, width - 1), np.clip(next_to[:, 1], 0, height - 1)
            out = (next_to != np.column_stack([x, y])).any(axis=1)
            found[place] = (out | self.hidden[y, x]).mean() > 0.5
        return found

    def _stands_where(self, ends: Floats, known: NDArray[np.bool_]) -> bool:
        """Return whether most poses that fit the ends of an outline (8,) are on the patient."""
        if not (known[0:2].any() and known[2:4].any()):
            return False
        size = (ends[0::2] + ends[1::2]).max()
        fixed = known.astype(np.float64)
        weights = [fixed[k : k + 2] / fixed[k : k + 2].sum() for k in (0, 2)]
        top = self.corners[2].max(axis=0)
        pixels = np.empty((len(top), 2))
        pixels[:] = (ends[[0, 2]] - ends[[1, 3]]) / 2
        for _ in range(STEPS):
            origins = self.places(pixels, top / 2)
            origins[:, 2] = self.height
            missing = ends[:, None] - self._ends_of(origins)
            for axis, weight in enumerate(weights):
                pixels[:, axis] += weight @ (missing[2 * axis : 2 * axis + 2] * [[1], [-1]])
        error = np.where(known[:, None], missing, np.maximum(missing, 0))
        error = np.sqrt((error**2).mean(axis=0))
        error = np.where(np.isfinite(error), error, np.inf)
        best = np.argsort(error, kind="stable")[:BEST]
        best = best[error[best] <= FITS[0] + FITS[1] * size]
        if not len(best):
            return False
        on = [self._stands(self.corners[:, :, k].T + origins[k]) for k in best]
        return bool(np.mean(on) > 0.5)

    def _ends_of(self, origins: Floats) -> Floats:
        """Return the ends (8, P) along `SIDES` of the pictures of the poses at origins (P, 3)."""
        matrix = self.view.to_pixels
        at = matrix[:, :3] @ origins.T + matrix[:, 3:]
        x, y, depth = (self.seen_corners[k] + at[k] for k in range(3))
        x /= depth
        y /= depth
        ends = np.empty((len(SIDES), len(origins)))
        for place, values in ((0, x), (2, y), (4, x + y), (6, x - y)):
            scale = 1.0 if place < 4 else 0.5**0.5
            ends[place] = values.max(axis=0) * scale
            ends[place + 1] = -values.min(axis=0) * scale
        return ends

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
