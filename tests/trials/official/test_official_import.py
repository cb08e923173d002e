"""Import of official files: all variants of files, damaged and hostile files."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import av
import h5py
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from physion.cli import import_trials as import_verb
from physion.compute.local import SerialExecutor
from physion.compute.run_tasks import RunReport
from physion.core.errors import BadInputError, UnknownNameError
from physion.numerics.rotations import rotation_matrix
from physion.readout.changes import take_trials
from physion.readout.evaluate import evaluate
from physion.readout.settings import EvaluationSettings
from physion.rendering.camera import View
from physion.scenes.shapes.primitives import shape
from physion.trials.dataset import Dataset
from physion.trials.files import TrialPaths, write_files
from physion.trials.index import build_index, write_index
from physion.trials.making.verify import verify_dataset
from physion.trials.official.export_folder import export_official
from physion.trials.official.import_folder import import_official
from physion.trials.official.names import decode_depth
from physion.trials.official.read_file import MotionReader, OfficialFile, SceneReader
from physion.trials.share.gltf import export_gltf
from physion.trials.share.lerobot import export_lerobot
from physion.trials.trial_file import Trial, TrialWriter
from physion.trials.video import count_frames, encode_movie, read_frames
from support.moving_dots import draw
from support.official_hand_made import (
    CLOTH,
    FRAMES,
    OBSERVED,
    PART,
    RIGID,
    SIZE,
    TOUCH,
)

Edit = Callable[[h5py.File], None]


@pytest.fixture(scope="module")
def plain(exported: Path) -> Path:
    """The export as files of others are: nothing in them but what the official layout knows."""
    folder = exported.parent / "plain"
    shutil.copytree(exported, folder)
    for path in folder.rglob("*.hdf5"):
        with h5py.File(path, "r+") as file:
            del file["physion"]
    return folder


@pytest.fixture(scope="module")
def imported(plain: Path) -> Path:
    out = plain.parent / "imported"
    report = import_official(plain, out, executor=SerialExecutor())
    assert set(report.made) == {RIGID, CLOTH} and not report.failed
    return out


def bring(folder: Path) -> RunReport:
    """Import ``folder`` into ``<folder>-in``."""
    return import_official(folder, folder.with_name(folder.name + "-in"), executor=SerialExecutor())


def trial_of(folder: Path, name: str = RIGID) -> Trial:
    return Dataset(folder.with_name(folder.name + "-in")).trial(name)


@pytest.fixture
def edited(exported: Path, tmp_path: Path) -> Callable[..., Path]:
    """A folder with one exported file that was changed."""

    def make(
        edit: Edit,
        config: str = "configurations/Collide/collide_testing",
        number: str = "0003",
    ) -> Path:
        folder = tmp_path / "edited" / config
        folder.mkdir(parents=True)
        path = folder / f"{number}.hdf5"
        shutil.copy(exported / config / path.name, path)
        with h5py.File(path, "r+") as file:
            edit(file)
            if "physion" in file:
                del file["physion"]
        return tmp_path / "edited"

    return make


def pairs(one: Trial, other: Trial) -> list[tuple[int, int]]:
    """Bodies of two trials that are the same, by their shapes, which all differ."""
    shapes = [body.shape for body in other.scene.bodies]
    return [(i, shapes.index(body.shape)) for i, body in enumerate(one.scene.bodies)]


@pytest.mark.slow
def test_motion_comes_back(dataset: Path, imported: Path) -> None:
    for name in (RIGID, CLOTH):
        ours, back = Dataset(dataset).trial(name), Dataset(imported).trial(name)
        one, other = ours.trajectory, back.trajectory
        assert len(other) == FRAMES and other.completed
        assert len(back.scene.bodies) == len(ours.scene.bodies)
        for i, j in pairs(ours, back):
            np.testing.assert_allclose(other.positions[:, j], one.positions[:, i], atol=1e-6)
            np.testing.assert_allclose(other.rotations[:, j], one.rotations[:, i], atol=1e-6)
            np.testing.assert_array_equal(other.velocities[:, j], one.velocities[:, i])
            spins = other.angular_velocities[:, j], one.angular_velocities[:, i]
            np.testing.assert_array_equal(*spins)
        np.testing.assert_allclose(other.cloth_vertices, one.cloth_vertices, atol=1e-5)
        np.testing.assert_allclose(other.cloth_distance, one.cloth_distance, atol=1e-6)


def test_contacts_come_back(dataset: Path, imported: Path) -> None:
    ours, back = Dataset(dataset).trial(RIGID), Dataset(imported).trial(RIGID)
    place = {-1: -1, **dict(pairs(ours, back))}

    def rows(trial: Trial, swap: bool) -> set[tuple[float, ...]]:
        c, found = trial.trajectory.contacts, set()
        for frame, (a, b), point, normal in zip(c.frame, c.bodies, c.point, c.normal, strict=True):
            a, b = (place[int(a)], place[int(b)]) if swap else (int(a), int(b))
            sign = 1 if a < b else -1
            values = np.round([*point, *(sign * normal)], 5) + 0.0
            found.add((int(frame), min(a, b), max(a, b), *values.tolist()))
        return found

    assert rows(ours, True) == rows(back, False)
    assert len(rows(ours, True)) == PART - TOUCH + 3
    assert np.isnan(back.trajectory.contacts.impulse).all()


def test_scene_camera_labels_and_origin_come_back(dataset: Path, imported: Path) -> None:
    for name in (RIGID, CLOTH):
        ours, back = Dataset(dataset).trial(name), Dataset(imported).trial(name)
        one, other = ours.shown("free"), back.shown()
        assert back.labels.contact == ours.labels.contact
        assert back.labels.first_frame == ours.labels.first_frame
        if name == CLOTH:
            assert back.labels.min_distance == pytest.approx(ours.labels.min_distance, abs=1e-6)
        meta = back.metadata
        assert meta.engine == "imported: physion 0.1.0" and meta.preset is None
        assert meta.recorded_contact is True and meta.look == "free"
        assert (meta.width, meta.height) == (SIZE, SIZE)
        for i, j in pairs(ours, back):
            a, b = one.bodies[i], other.bodies[j]
            assert (a.shape, a.kinematic or a.scenery, a.scenery) == (
                b.shape,
                b.kinematic or b.scenery,
                b.scenery,
            )
            np.testing.assert_allclose(b.position, a.position, atol=1e-6)
            np.testing.assert_allclose(b.scale, a.scale, atol=1e-6)
            if a.scenery:
                continue  # its friction and mass are in no official file
            friction = (a.contact.static_friction, a.contact.dynamic_friction)
            found = (b.contact.static_friction, b.contact.dynamic_friction)
            np.testing.assert_allclose(found, friction, atol=1e-6)
            np.testing.assert_allclose(b.look.color, a.look.color, atol=1e-6)
        assert [c.resolution for c in other.cloths] == [c.resolution for c in one.cloths]
        for a, b in zip(one.cloths, other.cloths, strict=True):
            soft = [(c.stretch, c.bend, c.tether) for c in (a, b)]
            np.testing.assert_allclose(*soft, atol=1e-6)
        p = np.random.default_rng(0).uniform(-1, 1, (9, 3))
        seen, depth = View(one.camera, 64, 64).project(p)
        again, depth_again = View(other.camera, 64, 64).project(p)
        np.testing.assert_allclose(again, seen, atol=1e-3)
        np.testing.assert_allclose(depth_again, depth, atol=1e-5)
        push = other.pushes[0]
        assert push.frame == 4 and push.body == other.roles.probe
        np.testing.assert_allclose(push.impulse, (2.0, 0.5, 0.1), atol=1e-6)
        agent, patient = other.index(other.roles.agent), other.index(other.roles.patient)
        for role, index in (("agent", agent), ("patient", patient)):
            before = ours.ids == one.index(getattr(one.roles, role)) + 1
            np.testing.assert_array_equal(back.ids == index + 1, before)


def test_the_dataset_is_whole(imported: Path) -> None:
    assert verify_dataset(imported).faults == []
    index = Dataset(imported).index
    assert index["recorded_contact"].all() and set(index["split"]) == {"testing"}


@pytest.mark.slow
def test_movies_are_copied_and_the_observed_part_is_cut(dataset: Path, imported: Path) -> None:
    ours, back = Dataset(dataset).paths(RIGID), Dataset(imported).paths(RIGID)
    assert back.movie.read_bytes() == ours.free_movie.read_bytes()
    assert count_frames(back.observed_movie) == OBSERVED
    seen = read_frames(back.observed_movie).astype(int)
    assert np.abs(seen - read_frames(ours.free_movie, count=OBSERVED)).mean() < 3
    assert back.map.read_bytes() == ours.map.read_bytes()


def test_a_second_run_keeps_everything(plain: Path, imported: Path) -> None:
    stamp = Dataset(imported).paths(RIGID).trial_file.stat().st_mtime_ns
    report = import_official(plain, imported, executor=SerialExecutor())
    assert not report.made and set(report.kept) == {RIGID, CLOTH}
    assert Dataset(imported).paths(RIGID).trial_file.stat().st_mtime_ns == stamp


@pytest.mark.slow
def test_name_and_split_are_chosen_or_come_from_metadata(
    dataset: Path, exported: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    import_official(exported, out, name="other", split="readout", executor=SerialExecutor())
    meta = Dataset(out).trial(RIGID).metadata
    assert (meta.dataset, meta.split, meta.seed, meta.preset) == ("other", "readout", None, None)
    folder = tmp_path / "dataset"
    trial = Dataset(dataset).trial(RIGID)
    meta = dataclasses.replace(trial.metadata, split="readout", movies=False, free_movies=False)
    paths = TrialPaths(folder, "readout", "collide", RIGID)
    writer = TrialWriter(meta, trial.scene, trial.trajectory, trial.labels, trial.ids)
    write_files(paths, {"trial_file": writer.finish()})
    write_index(folder, build_index(folder)[0])
    export_official(folder, tmp_path / "x", images=False, executor=SerialExecutor())
    assert bring(tmp_path / "x").made == (RIGID,)
    back = Dataset(tmp_path / "x-in")
    assert back.index["split"].tolist() == ["readout"]
    assert verify_dataset(tmp_path / "x-in", again=0).faults == []


# Variants of the layout.


def to_version_1_5(file: h5py.File) -> None:
    """Names with ``_cam0``, frames from 1, no labels."""
    frames = file["frames"]
    for name in sorted(frames, reverse=True):
        frame = frames[name]
        for group in ("images", "camera_matrices", "objects"):
            for key in list(frame[group]):
                if key not in ("velocities", "angular_velocities"):
                    frame[group].move(key, f"{key}_cam0")
        del frame["labels"]
        frames.move(name, f"{int(name) + 1:04d}")
    file.create_group("azimuth")


def test_version_1_5_is_read(edited: Callable[..., Path], imported: Path) -> None:
    folder = edited(to_version_1_5)
    assert not bring(folder).failed
    back, plain = trial_of(folder), Dataset(imported).trial(RIGID)
    np.testing.assert_array_equal(back.trajectory.positions, plain.trajectory.positions)
    assert (back.labels.contact, back.labels.first_frame) == (True, TOUCH)  # by the contacts
    assert back.metadata.recorded_contact is None
    # Without a movie beside it, the pictures inside the file are taken.
    assert count_frames(Dataset(folder.with_name("edited-in")).paths(RIGID).movie) == FRAMES


def test_short_arrays_of_physics_leave_out_scenery(edited: Callable[..., Path]) -> None:
    def edit(file: h5py.File) -> None:
        assert len(file["static/mass"]) == 3
        del file["static/distractors"], file["static/occluders"]

    folder = edited(edit)
    assert not bring(folder).failed
    bodies = {body.shape: body for body in trial_of(folder).scene.bodies}
    assert bodies["prop:vase"].scenery and bodies["cone"].mass == 1.0
    assert not bodies["cone"].scenery and bodies["cube"].kinematic


def test_arrays_of_physics_may_cover_scenery_and_texts_have_one_length(
    edited: Callable[..., Path],
) -> None:
    """As in exports of earlier versions, whose contacts also had points of pairs that separate."""

    def edit(file: h5py.File) -> None:
        names = file["static/model_names"][:].tolist()
        mass = [*file["static/mass"][:], 7.0]
        contacts = f"frames/{PART:04d}/collisions/contacts"
        for name in ("static/model_names", "static/mass", contacts):
            del file[name]
        file["static/model_names"], file["static/mass"] = np.array(names), np.array(mass)
        file[contacts] = np.ones((1, 2, 3), np.float32)

    folder = edited(edit)
    assert not bring(folder).failed
    trial = trial_of(folder)
    bodies = {body.shape: body for body in trial.scene.bodies}
    assert bodies["prop:vase"].scenery and bodies["prop:vase"].mass == 7.0
    assert trial.trajectory.contacts.frame.max() == PART - 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "note"),
    [
        ("upright", None),
        ("turned", "bottom row first"),
        ("metres", "bottom row first"),
        ("colours", "does not show its scene"),
        ("png", "is no depth"),
    ],
)
def test_depth_is_read_whichever_row_comes_first(
    edited: Callable[..., Path], dataset: Path, kind: str, note: str | None
) -> None:
    """The official writer stores the top row first; earlier exports of ours, the bottom row."""

    def edit(file: h5py.File) -> None:
        for frame in file["frames"].values():
            stored, colour = frame["images/_depth"][:], frame["images/_img"][:]
            changed = {
                "upright": stored,
                "turned": stored[::-1],
                "metres": decode_depth(stored)[::-1],
                "colours": 255 - stored[..., ::-1],
                "png": colour,
            }
            del frame["images/_depth"]
            frame["images/_depth"] = changed[kind]

    folder = edited(edit)
    report = bring(folder)
    notes = [text for text in report.notes.get(RIGID, ()) if "_depth" in text]
    assert not report.failed and (note in notes[0] if note else not notes)
    drawn = Dataset(dataset).trial(RIGID).render(30, ("depth",)).depth
    path = folder / "configurations/Collide/collide_testing/0003.hdf5"
    with OfficialFile.open(path) as file:
        motion = MotionReader(SceneReader(file, RIGID, "collide"))
        depth = motion.depth(motion.trajectory(), 30)
    if kind in ("colours", "png"):
        assert depth is None
    else:
        near = drawn < 99
        np.testing.assert_allclose(depth[near], drawn[near], atol=1e-5)


def test_an_unknown_model_gets_a_prop_of_its_size(edited: Callable[..., Path]) -> None:
    def edit(file: h5py.File) -> None:
        names = file["static/model_names"][:]
        del file["static/model_names"]
        names = [b"amphora_jar_vase" if name == b"cone" else name for name in names]
        file["static/model_names"] = np.array(names)
        vertices = file["static/mesh/vertices_1"][:] + np.array([0.3, 0.2, 0.1], np.float32)
        file["static/mesh/vertices_1"][:] = vertices

    folder = edited(edit)
    report = bring(folder)
    assert any("amphora_jar_vase" in note for note in report.notes[RIGID])
    trial = trial_of(folder)
    place = trial.scene.index("amphora_jar_vase_2")
    body = trial.scene.bodies[place]
    assert body.shape == "prop:vase"
    # The stand-in fills the same box in every frame.
    mesh = shape("cone").mesh.vertices + np.array([0.3, 0.1, 0.2])
    cone = mesh * (0.2, 0.3, 0.4)
    low, high = shape("prop:vase").bounds * body.scale
    np.testing.assert_allclose(high - low, np.ptp(cone, axis=0), atol=2e-2)
    with h5py.File(folder / "configurations/Collide/collide_testing/0003.hdf5") as file:
        pivot = file["frames/0030/objects/positions"][1][[0, 2, 1]]
    turn = rotation_matrix(trial.trajectory.rotations[30, place])
    wanted = pivot + turn @ np.array([*(cone.min(0) + cone.max(0))[:2] / 2, cone[:, 2].min()])
    np.testing.assert_allclose(trial.trajectory.positions[30, place], wanted, atol=1e-5)


def test_contacts_without_a_pair_go_to_the_nearest(edited: Callable[..., Path]) -> None:
    """Official files list several points a pair, in a list of their own."""

    def edit(file: h5py.File) -> None:
        group = file[f"frames/{TOUCH:04d}/collisions"]
        centers = file[f"frames/{TOUCH:04d}/objects/center"][:]
        near = [[[0, 1, 0], centers[1]], [[1, 0, 0], [9, 9, 9]], [[0, 0, 1], [-9, 9, 9]]]
        del group["contacts"]
        group["contacts"] = np.array(near, np.float32)

    folder = edited(edit)
    assert not bring(folder).failed
    trial = trial_of(folder)
    contacts, scene = trial.trajectory.contacts, trial.scene
    row = np.flatnonzero(contacts.frame == TOUCH)[0]
    assert set(contacts.bodies[row]) == {
        scene.index(scene.roles.agent),
        scene.index(scene.roles.patient),
    }
    cone = trial.trajectory.positions[TOUCH, scene.index(scene.roles.agent)]
    assert np.linalg.norm(contacts.point[row] - cone) < 0.5


def test_labels_without_contact_records_are_kept(edited: Callable[..., Path]) -> None:
    def edit(file: h5py.File) -> None:
        for frame in file["frames"].values():
            del frame["collisions"]

    folder = edited(edit)
    assert not bring(folder).failed
    trial = trial_of(folder)
    assert (trial.labels.contact, trial.labels.first_frame) == (True, TOUCH)
    roles = [trial.scene.index(n) for n in (trial.scene.roles.agent, trial.scene.roles.patient)]
    assert trial.trajectory.contacts.frames_of(*roles).tolist() == list(range(TOUCH, PART))
    assert np.isnan(trial.trajectory.contacts.point[-1]).all()


def test_cloth_particles_of_any_order_and_number(
    edited: Callable[..., Path], dataset: Path
) -> None:
    def edit(file: h5py.File) -> None:
        rng = np.random.default_rng(0)
        count = len(file["frames/0000/particles/2"])
        keep = rng.permutation(np.delete(np.arange(count), 12))  # one is missing, in the middle
        for frame in file["frames"].values():
            values = frame["particles/2"][:][keep]
            del frame["particles/2"]
            frame["particles/2"] = values

    folder = edited(edit, "configurations/Drape/drape_testing", "0000")
    assert not bring(folder).failed
    one = Dataset(dataset).trial(CLOTH).trajectory.cloth_vertices
    other = trial_of(folder, CLOTH).trajectory.cloth_vertices
    assert other.shape == one.shape
    others = np.delete(np.arange(25), 12)
    np.testing.assert_allclose(other[:, others], one[:, others], atol=1e-5)
    assert np.abs(other[:, 12] - one[:, 12]).max() < 0.15  # between its neighbours


def test_jpeg_pictures_and_destroyed_objects(edited: Callable[..., Path]) -> None:
    def edit(file: h5py.File) -> None:
        for frame in file["frames"].values():
            picture = Image.open(io.BytesIO(frame["images/_img"][:].tobytes()))
            buffer = io.BytesIO()
            picture.save(buffer, "jpeg")
            del frame["images/_img"]
            frame["images/_img"] = np.frombuffer(buffer.getvalue(), np.uint8)
            frame["objects/positions"][3] = np.nan  # the vase: its numbers were never written

    folder = edited(edit)
    report = bring(folder)
    assert not report.failed and any("left out" in note for note in report.notes[RIGID])
    assert len(trial_of(folder).scene.bodies) == 3


# Files that are broken or made to harm.


def outside(file: h5py.File, path: str) -> None:
    del file[path]
    file[path] = h5py.ExternalLink("/etc/hostname", "/static/mass")


def soft(file: h5py.File, path: str) -> None:
    del file[path]
    file[path] = h5py.SoftLink("/static/mass")


def huge(file: h5py.File, path: str) -> None:
    del file[path]
    file.create_dataset(path, (10**6, 10**6), np.float32, chunks=(100, 100))


def stored_elsewhere(file: h5py.File, path: str) -> None:
    del file[path]
    external = [("/etc/hostname", 0, h5py.h5f.UNLIMITED)]
    file.create_dataset(path, (4,), np.float32, external=external)


def virtual(file: h5py.File, path: str) -> None:
    del file[path]
    layout = h5py.VirtualLayout((4,), np.float32)
    layout[:] = h5py.VirtualSource("/etc/hostname", "x", (4,))
    file.create_virtual_dataset(path, layout)


def pointers(file: h5py.File, path: str) -> None:
    del file[path]
    file.create_dataset(path, (4,), h5py.ref_dtype)


def group(file: h5py.File, path: str) -> None:
    del file[path]
    file.create_group(path)


HARM = [outside, soft, huge, stored_elsewhere, virtual, pointers, group]


@pytest.mark.slow
@pytest.mark.parametrize("harm", HARM)
@pytest.mark.parametrize("path", ["static/mass", "frames/0020/objects/positions"])
def test_hostile_files_are_refused_by_file_and_field(
    edited: Callable[..., Path], harm: Callable[[h5py.File, str], None], path: str
) -> None:
    folder = edited(lambda file: harm(file, path))
    reason = bring(folder).failed[RIGID]
    assert "0003.hdf5" in reason and f"field '{path}'" in reason


BROKEN: dict[str, tuple[str, object]] = {
    "static/target_id": ("does not name", 77),
    "static/object_ids": ("does not list 2 to 255", np.array([1, 1, 2, 3])),
    "static/model_names": ("3 names for 4", np.array([b"cube", b"cone", b"cone"])),
    "static/scale": ("rows", np.zeros((9, 3))),
    "static/zone_id": ("not one number", np.array([1, 2])),
    "frames/0007/objects/rotations": ("has shape", np.zeros((4, 3))),
    "frames/0000/camera_matrices": ("is bad", None),
    "frames/0046/collisions/states": ("does not have the 1 rows", np.array([b"stay", b"stay"])),
    "frames/0000/images/_id": ("not a PNG", np.zeros(30, np.uint8)),
    "frames/0020": ("gaps", None),
}


@pytest.mark.slow
@pytest.mark.parametrize("path", BROKEN)
def test_broken_fields_are_named(edited: Callable[..., Path], path: str) -> None:
    what, value = BROKEN[path]

    def edit(file: h5py.File) -> None:
        if path == "frames/0020":
            del file[path]
        elif value is None:
            file[f"{path}/camera_matrix"][:] = 0
        else:
            del file[path]
            file[path] = value

    reason = bring(edited(edit)).failed[RIGID]
    assert what in reason and f"field '{'frames' if what == 'gaps' else path}'" in reason


def test_a_cut_file_fails_without_the_others(exported: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mixed"
    shutil.copytree(exported, folder)
    path = folder / "configurations/Collide/collide_testing/0003.hdf5"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    (folder / "configurations/Collide/collide_testing/0004.hdf5").write_bytes(
        b"nothing of the kind"
    )
    report = bring(folder)
    assert report.made == (CLOTH,) and report.exit_code == 1
    assert set(report.failed) == {RIGID, "collide_testing_0004"}
    assert all("hdf5" in reason for reason in report.failed.values())
    assert Dataset(folder.with_name("mixed-in")).trials() == [CLOTH]


def test_symbolic_links_are_not_followed(exported: Path, tmp_path: Path) -> None:
    folder = tmp_path / "links"
    folder.mkdir()
    (folder / "0003.hdf5").symlink_to(exported / "configurations/Collide/collide_testing/0003.hdf5")
    with pytest.raises(BadInputError, match="no official HDF5 file"):
        bring(folder)


def test_refusals(exported: Path, dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="does not exist"):
        import_official(tmp_path / "none", tmp_path / "out")
    with pytest.raises(UnknownNameError, match="drape"):
        import_official(exported, tmp_path / "out", scenario="drap")
    with pytest.raises(BadInputError, match="a dataset of this package"):
        import_official(dataset, tmp_path / "out")
    (tmp_path / "dataset.json").write_text("{}")
    with pytest.raises(BadInputError, match="generated"):
        import_official(exported, tmp_path)


def test_a_scenario_that_no_name_tells(exported: Path, tmp_path: Path) -> None:
    folder = tmp_path / "some"
    folder.mkdir()
    shutil.copy(exported / "configurations/Collide/collide_testing/0003.hdf5", folder / "0003.hdf5")
    assert "--scenario" in bring(folder).failed["0003.hdf5"]
    report = import_official(
        folder, tmp_path / "out", scenario="collide", executor=SerialExecutor()
    )
    assert report.made == ("some_0003",)


# Movies without state.


@pytest.fixture
def core(exported: Path, tmp_path: Path) -> Path:
    """PhysionTest-Core: the export without HDF5 files and configurations."""
    folder = tmp_path / "Physion"
    shutil.copytree(exported, folder)
    for path in folder.glob("configurations/*/*_testing"):
        shutil.rmtree(path)
    return folder


def test_core_folders_become_trials_without_motion(core: Path, dataset: Path) -> None:
    report = bring(core)
    assert set(report.made) == {RIGID, CLOTH} and not report.failed
    assert all("no state" in notes[0] for notes in report.notes.values())
    out = core.with_name("Physion-in")
    trial, paths, ours = trial_of(core), Dataset(out).paths(RIGID), Dataset(dataset).paths(RIGID)
    assert trial.metadata.engine == "imported: movie alone"
    assert trial.labels.contact and trial.labels.first_frame is None
    assert trial.labels.observed is None  # whether the contact is in the observed part is not known
    assert trial.metadata.recorded_contact is True
    assert np.isnan(trial.trajectory.positions).all()
    assert paths.movie.read_bytes() == ours.movie.read_bytes()
    assert paths.free_movie.read_bytes() == ours.free_movie.read_bytes()
    assert count_frames(paths.observed_movie) == OBSERVED
    assert paths.map.read_bytes() == ours.map.read_bytes()
    assert verify_dataset(out).faults == []
    assert len(Dataset(out).observed_frames(RIGID)) == OBSERVED


def test_movies_of_version_1_5_keep_outcome_contact_frame_and_split(
    dataset: Path, tmp_path: Path
) -> None:
    """As ``physion_mp4s`` of physion_evaluator has them, of which one has no label."""
    source = tmp_path / "v15"
    export_official(dataset, source, layout="physion-evaluator", executor=SerialExecutor())
    tested = source / "physion_mp4s/test"
    (movie,) = tested.glob("*.mp4")
    assert movie.stem == RIGID.replace("collide", "collision")
    shutil.copy(movie, tested / "collision_unknown_0001.mp4")
    trained = source / "physion_mp4s/train"
    trained.mkdir()
    shutil.copy(movie, trained / "pilot_linking_0001.mp4")
    rows = {"pilot_linking_0001": {"label": 0, "contact_frame_label": 75}}
    (trained / "all_video_labels.json").write_text(json.dumps(rows))
    report = bring(source)
    assert set(report.made) == {movie.stem, "pilot_linking_0001"}
    assert set(report.failed) == {"collision_unknown_0001"}
    index = Dataset(source.with_name("v15-in")).index.set_index("trial")
    row = index.loc[movie.stem]
    assert (row["scenario"], row["split"]) == ("collide", "testing")
    assert (row["contact"], row["first_frame"], row["recorded_contact"]) == (True, TOUCH, True)
    row = index.loc["pilot_linking_0001"]
    assert (row["scenario"], row["split"], row["contact"]) == ("link", "readout", False)
    assert pd.isna(row["first_frame"])


def test_movies_that_fit_a_readout_differ_from_tested_ones(tmp_path: Path) -> None:
    """They have no motion by which they differ; one of them is a tested movie again."""
    counts = {"train": 4, "test": 3}
    for part, count in counts.items():
        folder = tmp_path / "movies/physion_mp4s" / part
        folder.mkdir(parents=True)
        rows = {f"collision_{part}_{n:04d}": {"label": n % 2} for n in range(count)}
        (folder / "all_video_labels.json").write_text(json.dumps(rows))
        for number, name in enumerate(rows):
            # The first number is the seed of both parts.
            movie = encode_movie(draw(number % 2 == 1, np.random.default_rng(number * count)))
            (folder / f"{name}.mp4").write_bytes(movie)
    assert not bring(tmp_path / "movies").failed
    dataset = Dataset(tmp_path / "movies-in")
    assert dataset.index["digest"].nunique() == dataset.index["scene_digest"].nunique() == 6
    assert verify_dataset(dataset.folder).faults == []
    found = evaluate("blob-centroids", dataset, tmp_path / "out", settings=EvaluationSettings())
    assert set(found.predictions["fit_trials"]) == {3}
    taken = take_trials(dataset, tmp_path / "taken", 8)
    assert taken.trials("readout") == [f"collision_train_{n:04d}" for n in (1, 2, 3)]


def test_what_has_no_motion_is_not_exported(core: Path, tmp_path: Path) -> None:
    bring(core)
    report = export_official(
        core.with_name("Physion-in"), tmp_path / "out", executor=SerialExecutor()
    )
    assert set(report.failed) == {RIGID, CLOTH} and "motion" in report.failed[RIGID]
    assert not list((tmp_path / "out").rglob("*.hdf5"))
    for export in (export_lerobot, export_gltf):
        with pytest.raises(BadInputError, match="imported as a movie, without motion"):
            export(core.with_name("Physion-in"), tmp_path / export.__name__)


def test_a_movie_without_label_fails_without_the_others(core: Path) -> None:
    rows = list(csv.reader((core / "labels.csv").open()))
    with (core / "labels.csv").open("w") as file:
        csv.writer(file).writerows(row for row in rows if not row[0].startswith("collide"))
    report = bring(core)
    assert report.made == (CLOTH,) and "labels.csv" in report.failed[RIGID]


@pytest.mark.slow
@pytest.mark.parametrize("first", [44, 45])
@pytest.mark.parametrize("kind", ["movie", "state"])
def test_a_contact_up_to_frame_44_is_observed(
    exported: Path, tmp_path: Path, kind: str, first: int
) -> None:
    """By the metadata next to a movie, and by the labels in an HDF5 file."""
    folder = tmp_path / "configs/Collide/collide_testing"
    shutil.copytree(exported / "configurations/Collide/collide_testing", folder)
    if kind == "movie":
        (folder / "0003.hdf5").unlink()
        text = (folder / "metadata.json").read_text()
        whole = f'"first_target_contact_zone_frame": {TOUCH}'
        assert whole in text
        (folder / "metadata.json").write_text(text.replace(whole, whole.replace("46", str(first))))
    else:
        with h5py.File(folder / "0003.hdf5", "r+") as file:
            for frame in (44, 45, 46, 47):
                labels = file[f"frames/{frame:04d}/labels"]
                del labels["target_contacting_zone"]
                labels["target_contacting_zone"] = frame >= first
    assert bring(tmp_path / "configs").made == (RIGID,)
    trial = trial_of(tmp_path / "configs")
    labels = trial.labels
    assert (labels.contact, labels.first_frame, labels.observed) == (True, first, first == 44)
    assert not trial.metadata.free_movies


def test_a_published_movie_keeps_its_colours(tmp_path: Path) -> None:
    """Published movies do not name their colour matrix; players take them for BT.601."""
    folder = tmp_path / "Physion"
    (folder / "Collide/mp4s").mkdir(parents=True)
    colors = np.array([[200, 40, 30], [230, 220, 20], [30, 60, 200], [90, 160, 90]], np.uint8)
    picture = np.repeat(np.repeat(colors.reshape(2, 2, 3), 32, 0), 32, 1)
    path = folder / "Collide/mp4s/pilot_it2_collision_a_0001_img.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width = stream.height = 64
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "10"}
        for _ in range(FRAMES):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    with (folder / "labels.csv").open("w") as file:
        csv.writer(file).writerow(["pilot_it2_collision_a_0001_img", "False"])
    assert bring(folder).made == ("pilot_it2_collision_a_0001",)
    paths = Dataset(folder.with_name("Physion-in")).paths("pilot_it2_collision_a_0001")
    seen = read_frames(paths.movie)[3].astype(int)
    assert np.abs(seen[8:24, 8:24] - colors[0]).max() <= 6
    assert np.abs(seen[40:56, 8:24] - colors[2]).max() <= 6


def test_official_example_movies_are_read(official: Path, tmp_path: Path) -> None:
    """Real files, from before the names of stimuli were cleaned: ``b'example_dominoes/0003'``."""
    report = import_official(official / "example", tmp_path / "out", executor=SerialExecutor())
    assert report.made == ("example_0003", "example_0007") and not report.failed
    records = json.loads((official / "example/metadata.json").read_text())
    for name, record in (("example_0003", records[3]), ("example_0007", records[7])):
        trial = Dataset(tmp_path / "out").trial(name)
        assert trial.metadata.scenario == "dominoes"
        assert trial.metadata.frames == record["num_frames"]
        assert trial.labels.contact == record["does_target_contact_zone"]
        assert trial.labels.first_frame == record["first_target_contact_zone_frame"]
    assert verify_dataset(tmp_path / "out").faults == []


def test_broken_movies(core: Path) -> None:
    path = core / "Collide/mp4s" / f"{RIGID}_img.mp4"
    path.write_bytes(path.read_bytes()[:900])
    short = core / "Drape/mp4s" / f"{CLOTH}_img.mp4"
    short.write_bytes(encode_movie(np.zeros((OBSERVED, 32, 32, 3), np.uint8)))
    report = bring(core)
    assert not report.made and set(report.failed) == {RIGID, CLOTH}
    assert "45 frames" in report.failed[CLOTH]


def test_the_verb(
    exported: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("physion.compute.local.LocalExecutor", lambda workers: SerialExecutor())
    options = import_verb.Options(
        exported / "configurations/Drape", tmp_path / "out", workers=1, json=True
    )
    assert import_verb.main(options) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["made"] == [CLOTH] and not said["failed"]
    assert (
        import_verb.main(import_verb.Options(exported / "configurations/Drape", tmp_path / "out"))
        == 0
    )
    assert "0 made, 1 kept, 0 failed" in capsys.readouterr().out.replace("\n", " ")
