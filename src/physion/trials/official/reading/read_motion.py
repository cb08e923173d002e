"""Motion of an official file (poses, contacts, cloth), read as a `Trajectory`.

In official files the number of contact points differs from that of pairs (docs/official-system.md,
section 4.2). If the numbers are equal, points are assigned in order, as this package exports them;
otherwise each pair gets the point that is nearest to both of its bounding boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from physion.physics.trajectory import ENVIRONMENT, Contacts, Trajectory
from physion.scenes.scene import Scene
from physion.scenes.shapes.primitives import shape
from physion.trials.official.axes import rotation_matrices, swap_axes
from physion.trials.official.names import CLOTH_DISTANCE
from physion.trials.official.reading.read_scene import SceneReader

Floats = NDArray[np.float64]
Row = tuple[int, int, int, Floats, Floats]
"""Frame, first and second body, point, normal from first to second."""

MAX_RESOLUTION = 101
_UNKNOWN = np.full(3, np.nan)


@dataclass
class MotionReader:
    """Reader of the scene and the trajectory of one official file."""

    reader: SceneReader

    @cached_property
    def scene(self) -> Scene:
        """Scene of the trial."""
        return self.reader.scene({index: self._resolution(index) for index in self.reader.cloths})

    @cached_property
    def labelled_contact(self) -> NDArray[np.bool_] | None:
        """Whether target and zone touch in each frame (F,) by the file's labels; None without."""
        name = "labels/target_contacting_zone"
        paths = [f"{frame}/{name}" for frame in self.reader.frames]
        if not all(self.reader.file.has(path) for path in paths):
            return None
        return np.array([self.reader.file.number(path) != 0 for path in paths])

    def trajectory(self) -> Trajectory:
        """Return the motion, with the pivots of the bodies of this package."""
        reader, motion = self.reader, self.reader.motion
        matrices = rotation_matrices(motion.rotations[:, reader.bodies])
        offsets = reader.offsets()[reader.bodies]
        positions = motion.positions[:, reader.bodies] + np.einsum(
            "fnij,nj->fni", matrices, offsets
        )
        rotations = motion.rotations[:, reader.bodies]
        rotations = rotations / np.linalg.norm(rotations, axis=-1, keepdims=True)
        complete = [f"{frame}/labels/trial_complete" for frame in reader.frames]
        commit = reader.file.text("static/git_commit", "")
        return Trajectory(
            positions=positions.astype(np.float32),
            rotations=rotations.astype(np.float32),
            velocities=motion.velocities[:, reader.bodies].astype(np.float32),
            angular_velocities=motion.angular_velocities[:, reader.bodies].astype(np.float32),
            cloth_vertices=self._cloth_vertices(),
            cloth_distance=self._cloth_distance(),
            contacts=self._contacts(positions, matrices),
            completed=any(reader.file.number(path, 0) != 0 for path in complete),
            engine=f"imported: {commit if commit.startswith('physion ') else 'TDW'}",
        )

    def _contacts(self, positions: Floats, matrices: Floats) -> Contacts:
        """Return one contact per pair and frame.

        If the labels have a contact of target and zone that is not in the contact records, it is
        added with an unknown point (NaN).
        """
        scene, reader = self.scene, self.reader
        names = scene.names()
        indices = {reader.ids[p]: names.index(reader.label(p)) for p in reader.kept}
        bounds = [shape(body.shape).bounds * np.asarray(body.scale) for body in scene.bodies]
        roles = scene.index(scene.roles.agent), scene.index(scene.roles.patient)
        asked = min(roles), max(roles)
        labelled_contact, rows = self.labelled_contact, []
        for frame in range(len(reader.frames)):
            boxes = _Boxes(positions[frame], matrices[frame], bounds)
            found = self._pairs(frame, indices, boxes)
            if (
                labelled_contact is not None
                and labelled_contact[frame]
                and not scene.cloths
                and asked not in found
            ):
                found[asked] = (_UNKNOWN, _UNKNOWN)
            rows += [(frame, *pair, *found[pair]) for pair in sorted(found)]
        count = len(rows)
        return Contacts(
            np.array([row[0] for row in rows], np.int32).reshape(count),
            np.array([row[1:3] for row in rows], np.int32).reshape(count, 2),
            np.array([row[3] for row in rows], np.float32).reshape(count, 3),
            np.array([row[4] for row in rows], np.float32).reshape(count, 3),
            # Official files have no impulses.
            np.full(count, np.nan, np.float32),
        )

    def _pairs(
        self, frame: int, indices: dict[int, int], boxes: _Boxes
    ) -> dict[tuple[int, int], tuple[Floats, Floats]]:
        """Return point and normal by pair of bodies in one frame."""
        file, at = self.reader.file, self.reader.frames[frame]
        found: dict[tuple[int, int], tuple[Floats, Floats]] = {}
        if file.has(f"{at}/collisions/object_ids"):
            pairs = file.table(f"{at}/collisions/object_ids", 2)
            contacts = file.table(f"{at}/collisions/contacts", 2, 3)
            states = file.texts(f"{at}/collisions/states") if len(pairs) else []
            if len(states) != len(pairs):
                raise file.bad(
                    f"{at}/collisions/states", f"does not have the {len(pairs)} rows of ids"
                )
            for row, (pair, state) in enumerate(zip(pairs, states, strict=True)):
                a, b = (indices.get(int(id_)) if np.isfinite(id_) else None for id_ in pair)
                if a is None or b is None or a == b or state.startswith("ex"):
                    continue
                chosen = row if len(contacts) == len(pairs) else boxes.nearest(contacts, (a, b))
                if chosen is not None:
                    normal, point = swap_axes(contacts[chosen])
                    # Official normals point from the second body to the first.
                    key, sign = ((a, b), -1.0) if a < b else ((b, a), 1.0)
                    found.setdefault(key, (point, sign * normal))
        if file.has(f"{at}/env_collisions/object_ids"):
            ids = file.table(f"{at}/env_collisions/object_ids", 1)[:, 0]
            contacts = file.table(f"{at}/env_collisions/contacts", 2, 3)
            for row, id_ in enumerate(ids):
                body = indices.get(int(id_)) if np.isfinite(id_) else None
                if body is None:
                    continue
                chosen = row if len(contacts) == len(ids) else boxes.nearest(contacts, (body,))
                if chosen is not None:
                    normal, point = swap_axes(contacts[chosen])
                    found.setdefault((ENVIRONMENT, body), (point, normal))
        return found

    def _cloth_distance(self) -> NDArray[np.float32]:
        name = "labels/minimum_distance_target_to_zone"
        gaps = [
            self.reader.file.numbers(f"{frame}/{name}", ())
            if self.reader.file.has(f"{frame}/{name}")
            else np.nan
            for frame in self.reader.frames
        ]
        return (np.array(gaps, np.float64) - CLOTH_DISTANCE).astype(np.float32)

    def _cloth_vertices(self) -> NDArray[np.float32]:
        """Return the vertices (F, V, 3) of all sheets, interpolated between particles."""
        frames = len(self.reader.frames)
        parts = [np.zeros((frames, 0, 3), np.float32)]
        for index in self.reader.cloths:
            corners, weights = self._weights(index)
            for_all = [
                np.einsum("vk,vkj->vj", weights, self.particles(index, frame)[corners])
                for frame in range(frames)
            ]
            parts.append(np.stack(for_all).astype(np.float32))
        return np.concatenate(parts, axis=1)

    def particles(self, index: int, frame: int) -> Floats:
        """Return the particle positions (P, 3) of a cloth in a frame, in axes of this package."""
        path = f"{self.reader.frames[frame]}/particles/{self.reader.ids[index]}"
        found = swap_axes(self.reader.file.numbers(path, (None, 4))[:, :3])
        if len(found) < 4 or not np.isfinite(found).all():
            raise self.reader.file.bad(path, "is not a cloth of at least 4 finite particles")
        return found

    def _resolution(self, index: int) -> int:
        """Return the vertices per side of a sheet with about as many vertices as particles."""
        count = len(self.particles(index, 0))
        return int(np.clip(round(np.sqrt(count)), 2, MAX_RESOLUTION))

    def _weights(self, index: int) -> tuple[NDArray[np.int64], Floats]:
        """Return three particles (V, 3) and their weights (V, 3) for each vertex of the sheet.

        In frame 0 the cloth is flat, so every vertex lies in a triangle of a triangulation of the
        particles, whatever their order and number. Its barycentric coordinates are the weights.
        """
        reader = self.reader
        matrix = rotation_matrices(reader.motion.rotations[0, index])
        flat = (self.particles(index, 0) - reader.motion.positions[0, index]) @ matrix
        side = self._resolution(index)
        along_x, along_y = (np.linspace(-s, s, side) for s in reader.scales[index][:2])
        grid = np.stack(np.meshgrid(along_x, along_y, indexing="ij"), axis=-1).reshape(-1, 2)
        try:
            mesh = Delaunay(flat[:, :2])
        except (QhullError, ValueError) as error:
            path = f"{reader.frames[0]}/particles/{reader.ids[index]}"
            raise reader.file.bad(path, "does not begin as a flat sheet") from error
        # By rounding, vertices on the rim may lie outside: they follow the nearest particle.
        inside = mesh.find_simplex(grid, tol=1e-6)
        nearest = np.linalg.norm(flat[:, None, :2] - grid[inside < 0], axis=-1).argmin(axis=0)
        corners = mesh.simplices[np.maximum(inside, 0)].astype(np.int64)
        frame = mesh.transform[np.maximum(inside, 0)]
        first = np.einsum("vij,vj->vi", frame[:, :2], grid - frame[:, 2])
        weights = np.clip(np.column_stack([first, 1 - first.sum(axis=1)]), 0, 1)
        weights /= weights.sum(axis=1, keepdims=True)
        corners[inside < 0] = nearest[:, None]
        weights[inside < 0] = (1.0, 0.0, 0.0)
        return corners, weights


@dataclass(frozen=True)
class _Boxes:
    """Bounding boxes of all bodies in one frame: pivots, rotation matrices, corners (2, 3)."""

    positions: Floats
    matrices: Floats
    bounds: list[Floats]

    def nearest(self, contacts: Floats, bodies: tuple[int, ...]) -> int | None:
        """Return the row of the official contacts whose point is nearest to ``bodies``.

        ``contacts`` has shape (n, 2, 3): normal and point.
        """
        if not len(contacts):
            return None
        points = swap_axes(contacts[:, 1])
        away = np.zeros(len(points))
        for body in bodies:
            if body < len(self.bounds):
                local = (points - self.positions[body]) @ self.matrices[body]
                low, high = self.bounds[body]
                away += np.linalg.norm(local - np.clip(local, low, high), axis=1)
        return int(np.nan_to_num(away, nan=np.inf).argmin())
