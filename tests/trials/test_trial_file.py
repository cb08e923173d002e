"""Trial files: round trips, geometry for other programs, damaged and hostile files."""

from __future__ import annotations

import dataclasses
import io
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

import physion
from physion.core.errors import BadInputError
from physion.physics.trajectory import Trajectory
from physion.trials.files import TrialPaths
from physion.trials.making.verify import _check_trial
from physion.trials.state import world_vertices
from physion.trials.trial_file import FIELDS, GEOMETRY, SEAL_BYTES, Trial, TrialWriter, seal
from support.hand_made import FRAMES, Parts, images, make_parts, write_trial


def sealed_with(change: Callable[[h5py.File], None], data: bytes) -> bytes:
    """A trial file changed by someone who also repairs the seal."""
    buffer = io.BytesIO(data)
    with h5py.File(buffer, "r+") as file:
        change(file)
    return seal(buffer.getvalue())


def read_all(data: bytes) -> None:
    """Touch every part of a trial."""
    trial = Trial(data, "trial file evil.h5")
    assert trial.scene and trial.labels and trial.metadata
    assert len(trial.trajectory) == FRAMES and trial.ids.size and trial.pixel_fractions.size
    for frame in range(FRAMES):
        trial.passes(frame)


@pytest.mark.parametrize("cloth", [True, False])
@pytest.mark.parametrize("contact", [50, 10, None])
@pytest.mark.parametrize("compatible", [True, False])
def test_round_trip(cloth: bool, contact: int | None, compatible: bool, tmp_path: Path) -> None:
    parts = make_parts("round", cloth=cloth, contact_frame=contact)
    path = tmp_path / "t.h5"
    write_trial(path, *parts, compatible=compatible)
    trial = Trial.open(path)
    assert (trial.metadata, trial.scene, trial.labels) == (
        parts.metadata,
        parts.scene,
        parts.labels,
    )
    assert trial.labels.first_frame == contact and trial.labels.observed == (contact == 10)
    assert trial.trajectory.digest() == parts.trajectory.digest()
    for field in dataclasses.fields(Trajectory):
        got, put = getattr(trial.trajectory, field.name), getattr(parts.trajectory, field.name)
        if isinstance(put, np.ndarray):
            assert got.dtype == put.dtype
            np.testing.assert_array_equal(got, put)
        elif field.name != "contacts":
            assert got == put
    np.testing.assert_array_equal(trial.ids, parts.ids)
    assert trial.pixel_fractions[:2].tolist() == [8 * 8 / 32**2, 16 * 32 / 32**2]
    assert trial.pass_names == () and trial.passes(0) == {}
    assert [p.name for p in tmp_path.iterdir()] == ["t.h5"]


def test_passes_come_back_frame_by_frame(parts: Parts) -> None:
    trial = Trial(parts.pack(full=True), "t")
    assert set(trial.pass_names) == set(images(0))
    for frame in (0, 17, FRAMES - 1):
        for name, image in images(frame).items():
            np.testing.assert_array_equal(trial.passes(frame)[name], image)
    for frame in (-1, FRAMES):
        with pytest.raises(BadInputError, match="has no frame"):
            trial.passes(frame)


def test_same_trial_same_bytes(parts: Parts) -> None:
    assert parts.pack(full=True) == parts.pack(full=True)


def test_any_hdf5_reader_opens_it_and_compatible_needs_no_plugin(
    parts: Parts, tmp_path: Path
) -> None:
    write_trial(tmp_path / "t.h5", *parts, compatible=True)
    script = (
        "import sys, h5py\n"
        "f = h5py.File(sys.argv[1])\n"
        "print(f['trajectory/positions'][...].sum(), f['scene'][0][:8])\n"
        "assert 'hdf5plugin' not in sys.modules\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "t.h5")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split()[0] == str(parts.trajectory.positions.sum())


def test_large_arrays_have_a_chunk_a_frame(parts: Parts) -> None:
    data = parts.pack(full=True)
    with h5py.File(io.BytesIO(data)) as file:
        assert file["passes/depth"].chunks == (1, 32, 32)
        for path in FIELDS:
            if file[path].size:
                assert file[path].fletcher32, path


@pytest.mark.parametrize("kept", [0, 1, 400, 512, 2000, -1])
def test_cut_files_are_refused_by_name(parts: Parts, kept: int, tmp_path: Path) -> None:
    (tmp_path / "cut.h5").write_bytes(parts.pack()[:kept])
    with pytest.raises(BadInputError, match=r"cut\.h5.*(empty|cut short|not a trial)"):
        Trial.open(tmp_path / "cut.h5")


def test_every_single_flipped_bit_is_noticed(parts: Parts) -> None:
    data = parts.pack()
    rng = np.random.default_rng(0)
    unused = range(len(data[:SEAL_BYTES].rstrip(b"\0")), SEAL_BYTES)
    for place in rng.choice(len(data), 300, replace=False):
        if place in unused:
            continue
        broken = bytearray(data)
        broken[place] ^= 1 << int(rng.integers(8))
        with pytest.raises(BadInputError, match=r"seal|schema|not a trial file"):
            Trial(bytes(broken), "t")


def test_missing_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"none\.h5 is missing"):
        Trial.open(tmp_path / "none.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(BadInputError, match=r"other\.h5 is not a trial file"):
        Trial.open(tmp_path / "other.h5")
    with pytest.raises(BadInputError, match="is not a regular file"):
        Trial.open(tmp_path)


def test_newer_schema_says_so(parts: Parts) -> None:
    data = parts.pack().replace(b"PHYSION TRIAL 2", b"PHYSION TRIAL 9", 1)
    with pytest.raises(BadInputError, match="schema 9, this physion reads 2"):
        Trial(data, "t")


def replace_with(path: str, value: Any, **options: Any) -> Callable[[h5py.File], None]:
    """Put another array in the place of a field."""

    def change(file: h5py.File) -> None:
        del file[path]
        file.create_dataset(path, data=value, **options)

    return change


def huge(file: h5py.File) -> None:
    del file["first_frame/ids"]
    shape = (2**31, 2**11)
    file.create_dataset("first_frame/ids", shape, "i2", chunks=(32, 32), fletcher32=True)


def external_link(file: h5py.File) -> None:
    del file["scene"]
    file["scene"] = h5py.ExternalLink("/etc/hostname", "/x")


CHUNKED = {"chunks": True}
EVIL: dict[str, tuple[str, Callable[[h5py.File], None]]] = {
    "missing": (
        "trajectory/rotations.*is missing",
        lambda f: f.__delitem__("trajectory/rotations"),
    ),
    "external link": ("scene.*is a ExternalLink", external_link),
    "huge": ("first_frame/ids.*too large", huge),
    "type": ("contacts/impulse.*float64", replace_with("contacts/impulse", [1.0], **CHUNKED)),
}


@pytest.mark.parametrize("name", sorted(EVIL))
def test_evil_files_with_a_right_seal_are_refused_with_their_field(name: str, parts: Parts) -> None:
    message, change = EVIL[name]
    data = sealed_with(change, parts.pack())
    with pytest.raises(BadInputError, match=f"evil.*{message}"):
        read_all(data)


def test_writer_refuses_what_does_not_fit(parts: Parts) -> None:
    with pytest.raises(BadInputError, match="unknown passes"):
        TrialWriter(*parts, passes=("colour",))
    writer = TrialWriter(*parts, passes=("depth",))
    with pytest.raises(BadInputError, match=r"pass 'depth', frame 0: \(3, 3\)"):
        writer.add_frame({"depth": np.zeros((3, 3))})
    with pytest.raises(BadInputError, match="0 frames of passes, not 60"):
        writer.finish()
    with pytest.raises(BadInputError, match=r"ids of shape \(4, 4\) are not pixels in 0\.\.3"):
        TrialWriter(*parts._replace(ids=np.full((4, 4), 7, np.int16)))


# --- camera matrices and meshes, read as a program without this package would ---------------------


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
