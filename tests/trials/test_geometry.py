"""Camera matrices and meshes of trial files, read as a program without this package would."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

import physion
from physion.trials.files import TrialPaths
from physion.trials.making.verify import _check_trial
from physion.trials.state import world_vertices
from physion.trials.trial_file import GEOMETRY, Trial, TrialWriter, seal
from support.hand_made import make_parts

PIXELS = 128


def trial_bytes(scenario: str, seed: int) -> bytes:
    """The bytes of a short trial of a sampled scene."""
    scene = physion.sample_scene(scenario, seed)
    motion = physion.simulate(scene, frames=45)
    ids = physion.Renderer(scene, motion, PIXELS, PIXELS).render(0, ("ids",)).ids
    assert ids is not None
    meta = replace(make_parts().metadata, width=PIXELS, height=PIXELS, frames=len(motion))
    labels = physion.label_contact(scene, motion)
    return TrialWriter(meta, scene, motion, labels, ids).finish()


def arrays_of(data: bytes) -> dict[str, NDArray[Any]]:
    """Poses and geometry of a trial file, as `h5py` reads them."""
    with h5py.File(io.BytesIO(data)) as file:
        paths = (*GEOMETRY, "trajectory/positions", "trajectory/rotations")
        return {path: file[path][()] for path in paths}


def rotated(quaternion: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate vectors (V, 3) by a unit quaternion (w, x, y, z): v + 2 w (q x v) + 2 q x (q x v)."""
    w, q = quaternion[0], quaternion[1:]
    cross = np.cross(q, vectors)
    return np.asarray(vectors + 2 * w * cross + 2 * np.cross(q, cross))


def test_stored_meshes_are_where_the_objects_are() -> None:
    data = trial_bytes("collide", 3)
    arrays, expected = arrays_of(data), world_vertices(Trial(data, "t"), 19)
    for i, body in enumerate(Trial(data, "t").scene.bodies):
        first, end, first_face, end_face = arrays["meshes/ranges"][i]
        points = arrays["meshes/vertices"][first:end] * arrays["meshes/scale"][i]
        turned = rotated(arrays["trajectory/rotations"][19, i].astype(float), points)
        found = turned + arrays["trajectory/positions"][19, i]
        np.testing.assert_allclose(found, expected[body.name], atol=1e-5)
        faces = arrays["meshes/faces"][first_face:end_face] - first
        assert faces.min() == 0 and faces.max() == len(points) - 1


def test_faces_of_a_cloth_are_rows_of_its_vertices() -> None:
    parts = make_parts()
    arrays = arrays_of(parts.pack())
    first, end, first_face, end_face = arrays["meshes/ranges"][-1]
    assert end - first == parts.trajectory.cloth_vertices.shape[1] == 9
    faces = arrays["meshes/faces"][first_face:end_face]
    assert faces.shape == (8, 3) and faces.min() == first and faces.max() == end - 1
    assert arrays["meshes/scale"][-1].tolist() == [1, 1, 1]


def test_a_shape_is_stored_once() -> None:
    data = trial_bytes("dominoes", 3)
    shapes = [body.shape for body in Trial(data, "t").scene.bodies]
    assert len(set(shapes)) < len(shapes)
    ranges = arrays_of(data)["meshes/ranges"]
    for i, one in enumerate(shapes):
        for j, other in enumerate(shapes):
            assert (one == other) == bool((ranges[i] == ranges[j]).all())
    # Every row of vertices and of faces belongs to one shape.
    distinct = np.unique(ranges, axis=0)
    assert (distinct[:, 1] - distinct[:, 0]).sum() == len(arrays_of(data)["meshes/vertices"])
    assert (distinct[:, 3] - distinct[:, 2]).sum() == len(arrays_of(data)["meshes/faces"])


def test_matrices_lead_from_the_world_to_the_pixels_of_the_picture() -> None:
    data = trial_bytes("drop", 3)
    trial, arrays = Trial(data, "t"), arrays_of(data)
    i = trial.scene.index(trial.scene.roles.agent)
    rows = np.argwhere(trial.ids == i + 1)[:, ::-1]
    assert rows.min() > 0 and rows.max() < PIXELS - 1, "the object must be whole in the picture"
    first, end = arrays["meshes/ranges"][i, :2]
    points = arrays["meshes/vertices"][first:end] * arrays["meshes/scale"][i]
    points = rotated(arrays["trajectory/rotations"][0, i].astype(float), points)
    points = points + arrays["trajectory/positions"][0, i]
    camera = np.column_stack([points, np.ones(len(points))]) @ arrays["camera/extrinsics"].T
    pixels = camera[:, :3] @ arrays["camera/intrinsics"].T
    pixels = pixels[:, :2] / pixels[:, 2:]
    # The pixels that show the object fill the box around its vertices.
    assert np.abs(rows.min(axis=0) - pixels.min(axis=0)).max() < 1
    assert np.abs(rows.max(axis=0) + 1 - pixels.max(axis=0)).max() < 1


def test_verify_finds_geometry_of_another_scene(tmp_path: Path) -> None:
    parts = make_parts()
    meta = replace(parts.metadata, movies=False)
    paths = TrialPaths(tmp_path, "testing", "drop", "tiny")
    paths.trial_file.parent.mkdir(parents=True)
    paths.trial_file.write_bytes(parts._replace(metadata=meta).pack())
    assert not faults_of_geometry(paths)
    # Of another size: the camera's focal length in pixels differs.
    paths.trial_file.write_bytes(with_width(parts._replace(metadata=meta).pack(), 64))
    (fault,) = faults_of_geometry(paths)
    assert "'camera/intrinsics'" in fault


def faults_of_geometry(paths: TrialPaths) -> list[str]:
    faults = _check_trial(paths, Trial.open(paths.trial_file))
    return [fault for fault in faults if "does not match the scene" in fault]


def with_width(data: bytes, width: int) -> bytes:
    """The same file whose camera matrix is that of a picture of another width."""
    buffer = io.BytesIO(data)
    with h5py.File(buffer, "r+") as file:
        matrix = file["camera/intrinsics"][()]
        matrix[0, 2] = width / 2
        file["camera/intrinsics"][...] = matrix
    return seal(buffer.getvalue())
