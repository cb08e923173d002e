"""Exports are read by the logic of published loaders, transcribed from their sources.

Sources, at the commits that were read:

- htung0101/Physion-particles 5ac002a: ``preprocessing_tdw_cheap.py``, ``get_label_txt.py``;
- neuroailab/physics-models 4bc5816: ``physion/data/pydata.py``, ``physion/objective/RPIN.py``,
  ``physion/data_space/data_space.py``, ``configs/pDEIT_MLP/physion.yaml``;
- neuroailab/physion_evaluator 03924d4: ``dataloader_mp4s.py``, ``extract_features.py``;
- cogtoolslab/physics-benchmarking-neurips2021 fd02f3f: ``stimuli/generate_metadata.ipynb``;
- pairlab/SlotFormer: ``slotformer/video_prediction/datasets/physion.py``;
- object_centric_bench: ``datum/physion.py``.

Asserts inside the loaders are theirs. Paths of folders and the transforms of pictures by torch are
arguments or left out.
"""

# The transcribed loaders use paths as their sources do.
# ruff: noqa: PTH118, PTH119, PTH120, PTH123, PTH207, PTH208

from __future__ import annotations

import dataclasses
import glob
import io
import json
import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from physion.cli import export as export_verb
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import evaluator_name
from physion.trials.dataset import Dataset
from physion.trials.files import TrialPaths, write_files
from physion.trials.index import build_index, write_index
from physion.trials.official.export_folder import LAYOUTS, export_official
from physion.trials.official.names import split_name
from physion.trials.trial_file import TrialWriter
from physion.trials.video import count_frames, read_frames
from support.official_hand_made import CLOTH, FRAMES, RIGID, TOUCH

SCENARIOS = ["Collide", "Contain", "Dominoes", "Drape", "Drop", "Link", "Roll", "Support"]


def export(dataset: Path, out: Path, layout: str, **options: Any) -> Path:
    report = export_official(dataset, out, layout=layout, executor=SerialExecutor(), **options)
    assert not report.failed
    return out


def particles_preprocess(data_source_root: str, scenario: str) -> dict[str, dict[str, Any]]:
    """``preprocessing_tdw_cheap.py``, without the voxels of binvox: what it takes from files."""
    scene_path = os.path.join(data_source_root, scenario)
    trial_names = [file for file in os.listdir(scene_path) if file.endswith("hdf5")]
    trial_names.sort()
    flex_engine = "Drape" in scenario
    found = {}
    for trial_name in trial_names:
        f = h5py.File(os.path.join(scene_path, trial_name), "r")
        object_ids = f["static"]["object_ids"][:].tolist()
        scales = f["static"]["scale"][:]
        object_names = f["static"]["model_names"][:]
        if b"ramp_with_platform_30" in object_names:
            assert object_names[1] == b"ramp_with_platform_30"
            assert np.linalg.norm(scales[1] - np.array([0.2, 1, 0.5])) < 0.000001
        obj_points, material = [], []
        for idx, object_id in enumerate(object_ids):
            if flex_engine:
                obj_points.append(f["frames"]["0000"]["particles"][str(object_id)][:])
            else:
                vertices = f["static"]["mesh"][f"vertices_{idx}"][:]
                assert f["static"]["mesh"][f"faces_{idx}"][:].shape[1] == 3
                assert vertices.shape[0] > 0
                obj_points.append(vertices * scales[idx])
            cloth = f["static"]["model_names"][:][idx] == b"cloth_square"
            material.append("cloth" if cloth else "rigid")
        nsteps = len(f["frames"])
        yellow_id, red_id = f["static"]["zone_id"][()], f["static"]["target_id"][()]
        yellow_id_order = [i for i, id_ in enumerate(object_ids) if id_ == yellow_id]
        assert len(yellow_id_order) == 1
        red_id_order = [i for i, id_ in enumerate(object_ids) if id_ == red_id]
        assert len(red_id_order) == 1
        assert yellow_id_order[0] == 0
        steps = []
        for step in range(nsteps):
            frame = f["frames"][f"{step:04}"]
            if flex_engine:
                both = [
                    np.concatenate([frame[key][str(id_)][:][:, :3] for id_ in object_ids], axis=0)
                    for key in ("particles", "velocities")
                ]
            else:
                both = [frame["objects"]["positions"][:], frame["objects"]["rotations"][:]]
                assert len(both[0]) == len(obj_points)
            steps.append(both)
        is_hit = False  # get_label_txt.py
        for step in range(nsteps):
            if f["frames"][f"{step:04}"]["labels"]["target_contacting_zone"][()]:
                is_hit = True
                break
        found[trial_name] = {
            "steps": steps,
            "is_hit": is_hit,
            "red_id": red_id_order[0],
            "material": material,
            "points": obj_points,
        }
    return found


class TDWDataset:
    """``TDWDatasetBase`` of pydata.py with the boxes of RPIN.py; pictures stay arrays."""

    def __init__(self, data_root: list[str], seq_len: int, subsample_factor: int = 1) -> None:
        self.seq_len, self.subsample_factor = seq_len, subsample_factor
        self.hdf5_files: list[str] = []
        for path in data_root:
            assert "*.hdf5" in path
            files = sorted(glob.glob(path))
            files = [fn for fn in files if "tfrecords" not in fn]
            self.hdf5_files.extend(files)
        self.N = len(self.hdf5_files)

    def __getitem__(self, index: int) -> dict[str, Any]:
        with h5py.File(self.hdf5_files[index], "r") as f:
            colors = self.get_colors(f)
            frames = list(f["frames"])
            target_contacted_zone = False
            for frame in reversed(frames):
                if f["frames"][frame]["labels"]["target_contacting_zone"][()]:
                    target_contacted_zone = True
                    break
            assert len(frames) // self.subsample_factor >= self.seq_len
            end_idx = self.seq_len * self.subsample_factor
            images, masks = [], []
            for frame in frames[0 : end_idx : self.subsample_factor]:
                img = f["frames"][frame]["images"]["_img"][()]
                images.append(np.array(Image.open(io.BytesIO(img))))
                id_img = np.array(Image.open(io.BytesIO(f["frames"][frame]["images"]["_id"][()])))
                masks.append([(id_img == color).all(-1) for color in colors])
            stimulus_name = f["static"]["stimulus_name"][()]
        return {
            "images": np.stack(images),
            "masks": np.array(masks),
            "binary_labels": target_contacted_zone,
            "stimulus_name": stimulus_name,
        }

    @staticmethod
    def get_colors(f: Any) -> np.ndarray:
        id_img = np.array(Image.open(io.BytesIO(f["frames"]["0000"]["images"]["_id"][()])))
        return np.unique(id_img.reshape(-1, id_img.shape[2]), axis=0)


def evaluator_items(mp4_paths: str, labels_path: str) -> dict[str, dict[str, Any]]:
    """``Physion`` of dataloader_mp4s.py for the task ocp, with its default frame gap."""
    with open(labels_path) as file:
        all_labels = json.load(file)
    found = {}
    for filename in glob.glob(mp4_paths):
        labels = all_labels[filename.split("/")[-1].split(".")[0]]
        num_frames = count_frames(Path(filename))
        max_frame = 15 if "collision" in filename and "roll" not in filename else 45
        indices = np.arange(max_frame, -1, -150 // 10).clip(0, num_frames - 1)[::-1]
        frames = read_frames(Path(filename))[indices]
        found[filename] = labels | {"indices": indices.tolist(), "video": frames}
    return found


def evaluator_scenario(fname: str) -> list[str]:
    """The scenarios that ``main`` of extract_features.py counts a file to."""
    keys = ["collision", "drop", "towers", "link", "roll", "contain", "dominoes"]
    return [
        key
        for key in keys
        if key in fname and ((key == "collision" and "roll" not in fname) or key != "collision")
    ]


def notebook_table(local_stem: str) -> pd.DataFrame:
    """``generate_metadata.ipynb`` up to the labels; files in sorted order, as S3 lists them."""
    dirnames = [d.split("/")[-1] for d in sorted(glob.glob(local_stem + "/*"))]
    data_dirs = [local_stem + d for d in dirnames]

    def list_files(paths: list[str], ext: str) -> tuple[list[str], list[str]]:
        results = [
            y
            for path in paths
            for x in os.walk(path)
            for y in sorted(glob.glob(os.path.join(x[0], f"*.{ext}")))
        ]
        names = [os.path.basename(os.path.dirname(y)) + "_" + os.path.split(y)[1] for y in results]
        return results, names

    full_stim_paths, filenames = list_files(data_dirs, "mp4")
    _, mapnames = list_files(data_dirs, "png")
    _, hdf5_names = list_files(data_dirs, "hdf5")
    assert all("_img" in p for p in full_stim_paths)
    table = pd.DataFrame(
        [[name.split(".")[0] for name in filenames], filenames, mapnames, hdf5_names]
    ).transpose()
    table.columns = pd.Index(["stim_ID", "stim_url", "map_url", "hdf5_url"])
    labels = {}
    for _dir in data_dirs:
        with open(_dir + "/metadata.json", "rb") as f:
            trial_metas = json.load(f)
        for meta in trial_metas:
            stim_name = meta["stimulus_name"]
            if stim_name[-4:] != "_img":
                stim_name += "_img"
            labels[stim_name] = meta["does_target_contact_zone"]
    gt = pd.DataFrame([list(labels.keys()), list(labels.values())]).transpose()
    gt.columns = pd.Index(["stim_ID", "target_hit_zone_label"])
    assert not set(table["stim_ID"]).symmetric_difference(gt["stim_ID"])
    return table.merge(gt, on="stim_ID")


def slotformer_items(data_root: str, subset: str, split: str) -> dict[str, int]:
    """``PhysionSlotsLabelDataset``: folders of frames (movies without ending) with their labels.

    Its lists of files are the argument ``splits``, which it keeps beside its code.
    """
    label_fn = {
        "readout": "PhysionTrainMP4s/readout_labels.csv",
        "test": "PhysionTestMP4s/labels.csv",
    }[subset]
    labels = pd.read_csv(os.path.join(data_root, label_fn))
    with open(os.path.join(data_root, f"splits/Physion/{subset}_{split}.json")) as f:
        json_file = json.load(f)
    items = {}
    for task in sorted(json_file):
        for name in json_file[task]:
            folder = os.path.join(data_root, name[:-4])
            csv_key = os.path.basename(folder)
            if subset == "readout" and csv_key.endswith("_img"):
                csv_key = csv_key[:-4]
            if subset == "test" and "-redyellow" in csv_key:
                csv_key = csv_key.replace("-redyellow", "")
            label = labels[labels["Unnamed: 0"] == csv_key]["ground truth outcome"].item()
            assert Path(folder + ".mp4").exists()
            items[folder + ".mp4"] = 1 if label else 0
    return items


def bench_labels(src_dir: Path, scene: str, kind: str, train: bool) -> dict[str, bool]:
    """``Physion.convert_dataset`` of object_centric_bench: labels of movies by their names."""
    label_file = src_dir / kind / ("readout_labels.csv" if train else "labels.csv")
    parts = [row.strip().split(",") for row in label_file.read_text().strip().split("\n")[1:]]
    label_dict = {row[0].replace("-redyellow", ""): row[1] for row in parts}
    assert len(label_dict) == len(parts)
    found = {}
    folder = f"{scene}_readout_MP4s" if train else f"{scene}/mp4s-redyellow"
    for src_file in sorted((src_dir / kind).glob(f"{folder}/*.mp4")):
        lbl_key = src_file.name[: -8 if train else -4].replace("-redyellow", "")
        assert lbl_key in label_dict
        found[src_file.name] = label_dict[lbl_key] == "True"
    return found


@pytest.mark.slow
@pytest.mark.parametrize("images", [pytest.param(True, marks=pytest.mark.nightly), False])
def test_physion_particles_reads_its_folder(dataset: Path, tmp_path: Path, images: bool) -> None:
    out = export(dataset, tmp_path / "out", "physion-particles", images=images)
    rigid = particles_preprocess(str(out / "testing"), "Collide")
    trial = Dataset(dataset).trial(RIGID)
    assert list(rigid) == [f"{RIGID}.hdf5"]
    item = rigid[f"{RIGID}.hdf5"]
    assert item["is_hit"] is trial.labels.contact and len(item["steps"]) == FRAMES
    positions = np.stack([positions for positions, _ in item["steps"]])
    ours = trial.trajectory.positions[:, trial.scene.index(trial.scene.roles.agent)]
    np.testing.assert_array_equal(positions[:, item["red_id"]], ours[:, [0, 2, 1]])
    cloth = particles_preprocess(str(out / "testing"), "Drape")[f"{CLOTH}.hdf5"]
    assert cloth["material"].count("cloth") == 1 and cloth["is_hit"]
    assert all(len(points) for points in cloth["points"])  # of the scenery too
    moved = np.stack([positions for positions, _ in cloth["steps"]])
    assert np.isfinite(moved).all() and (moved[0] != moved[-1]).any()
    with h5py.File(out / f"testing/Collide/{RIGID}.hdf5") as f:
        assert ("images" in f["frames/0000"]) is images and ("flow" in f["physion"]) is images


def test_physopt_reads_its_folders(dataset: Path, tmp_path: Path) -> None:
    basedir = export(dataset, tmp_path / "out", "physopt", scenario="collide")
    data_dir = os.path.join(basedir, "physion_data/readout_test_redyellow")
    data = TDWDataset([os.path.join(data_dir, s, "*.hdf5") for s in SCENARIOS], 25, 2)
    assert data.N == 1
    item = data[0]
    trial = Dataset(dataset).trial(RIGID)
    assert item["stimulus_name"] == b"collide_testing-redyellow_0003" and item["binary_labels"]
    for row in (0, 24):
        np.testing.assert_array_equal(
            item["images"][row], trial.render(2 * row, look="redyellow").color
        )
    assert (item["masks"].sum(axis=1) == 1).all()  # each pixel has the colour of one object


def test_training_trials_are_divided_and_in_free_colours() -> None:
    layout = LAYOUTS["physopt"]
    trials = [TrialPaths(Path(), "training", "roll", f"roll_training_{i:04d}") for i in range(500)]
    places = [next(iter(layout.files(paths, False).items())) for paths in trials]
    parts = [path.split("/")[1] for path, _ in places]
    assert set(parts) == {"pretraining_train", "pretraining_val"}
    assert 25 <= parts.count("pretraining_val") <= 75
    assert {content.look for _, content in places} == {"free"}
    assert not layout.files(TrialPaths(Path(), "familiarization", "roll", "roll_0000"), False)
    # Every scenario has a trial for validation: its first one, whatever its name.
    kept = trials[parts.index("pretraining_train")]
    assert "pretraining_val" in next(iter(layout.files(kept, True)))


def test_physion_evaluator_reads_its_movies(dataset: Path, tmp_path: Path) -> None:
    out = export(dataset, tmp_path / "out", "physion-evaluator")
    phase = out / "physion_mp4s/test"
    items = evaluator_items(str(phase / "*.mp4"), str(phase / "all_video_labels.json"))
    assert [Path(name).stem for name in items] == ["collision_testing_0003"]  # it has no Drape
    (item,) = items.values()
    assert item["label"] is True and item["contact_frame_label"] == TOUCH
    assert item["indices"] == [0, 15]
    own = read_frames(Dataset(dataset).paths(RIGID).movie)
    np.testing.assert_array_equal(item["video"], own[[0, 15]])


def test_slotformer_and_others_read_movies(dataset: Path, tmp_path: Path) -> None:
    """A test trial as it is, and copies of it as readout and training trials."""
    out = tmp_path / "out"
    export(dataset, out, "mp4s")
    for split in ("readout", "training"):
        copy = tmp_path / split
        trial = Dataset(dataset).trial(RIGID)
        meta = dataclasses.replace(trial.metadata, split=split, movies=False, free_movies=False)
        paths = TrialPaths(copy, split, "collide", RIGID)
        writer = TrialWriter(meta, trial.scene, trial.trajectory, trial.labels, trial.ids)
        write_files(paths, {"trial_file": writer.finish()})
        write_index(copy, build_index(copy)[0])
        export(copy, out, "mp4s")
    test = slotformer_items(str(out), "test", "test")
    names = ["collide_testing-redyellow_0003_img.mp4", "drape_testing-redyellow_0000_img.mp4"]
    assert [Path(name).name for name in test] == names
    assert list(test.values()) == [Dataset(dataset).trial(name).labels.contact for name in
                                   (RIGID, CLOTH)]  # fmt: skip
    own = Dataset(dataset).paths(RIGID)
    assert Path(next(iter(test))).read_bytes() == own.movie.read_bytes()
    readout = slotformer_items(str(out), "readout", "val")  # the first of a scenario
    movie = out / "PhysionTrainMP4s/Collide_readout_MP4s" / f"{RIGID}_img.mp4"
    assert readout == {str(movie): 1}
    np.testing.assert_array_equal(read_frames(movie), read_frames(own.movie))
    training = out / "PhysionTrainMP4s/Collide_training_MP4s" / f"{RIGID}_img.mp4"
    np.testing.assert_array_equal(read_frames(training), read_frames(own.free_movie))
    assert bench_labels(out, "Collide", "PhysionTrainMP4s", True) == {f"{RIGID}_img.mp4": True}
    assert bench_labels(out, "Drape", "PhysionTestMP4s", False) == {names[1]: True}


def test_hdf5_files_of_the_downloads(dataset: Path, tmp_path: Path) -> None:
    out = export(dataset, tmp_path / "out", "hdf5s", images=False)
    assert sorted(path.relative_to(out).as_posix() for path in out.rglob("*.hdf5")) == [
        f"Collide/hdf5s/{RIGID}.hdf5",
        f"Drape/hdf5s/{CLOTH}.hdf5",
    ]


@pytest.mark.parametrize(
    ("scenario", "trial", "key"),
    [
        ("collide", "collide_testing_0001", "collision"),
        ("support", "support_readout_0001", "towers"),
        ("link", "link_testing_0001", "link"),
        ("roll", "roll_testing_0001", "roll"),
        ("contain", "contain_testing_0001", "contain"),
        ("drop", "drop_testing_0001", "drop"),
        ("dominoes", "dominoes_testing_0001", "dominoes"),
        ("support", "my.own_0001", "towers"),
        ("roll", "pilot_it2_rollingSliding_simple_collision_box_0008", "roll"),
        ("collide", "pilot_it2_collision_yeet_box_2_dis_2_occ-redyellow_0008", "collision"),
    ],
)
def test_physion_evaluator_finds_scenarios(scenario: str, trial: str, key: str) -> None:
    name = evaluator_name("_".join(split_name(trial)), scenario)
    assert evaluator_scenario(f"/data/physion_mp4s/test/{name}.mp4") == [key]
    assert "." not in name and "redyellow" not in name


def test_the_notebook_reads_configurations(exported: Path) -> None:
    table = notebook_table(f"{exported}/configurations/Collide/")
    assert table.to_dict("records") == [
        {
            "stim_ID": f"{RIGID}_img",
            "stim_url": f"{RIGID}_img.mp4",
            "map_url": f"{RIGID}_map.png",
            "hdf5_url": f"{RIGID}.hdf5",
            "target_hit_zone_label": True,
        }
    ]


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["physopt", "physion-evaluator", "physion-particles"])
def test_a_second_run_keeps_what_is_whole(dataset: Path, tmp_path: Path, layout: str) -> None:
    options = {"images": False} if layout == "physion-particles" else {}
    out = export(dataset, tmp_path / "out", layout, scenario="collide", **options)
    files = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    report = export_official(
        dataset, out, layout=layout, scenario="collide", executor=SerialExecutor(), **options
    )
    assert report.kept == (RIGID,) and not report.made
    last = next(path for path in files if path.suffix in (".hdf5", ".json"))
    if last.name == "all_video_labels.json":
        last = next((out / "physion_mp4s/test/records").glob("*.json"))
    last.write_bytes(files[last][:100])
    report = export_official(
        dataset, out, layout=layout, scenario="collide", executor=SerialExecutor(), **options
    )
    assert report.made == (RIGID,)
    assert {path: path.read_bytes() for path in files} == files


def test_files_without_pictures_are_completed(dataset: Path, tmp_path: Path) -> None:
    out = export(dataset, tmp_path / "out", "physion-particles", scenario="collide", images=False)
    options: dict[str, Any] = {"layout": "physion-particles", "scenario": "collide"}
    report = export_official(dataset, out, executor=SerialExecutor(), **options)
    assert report.made == (RIGID,)
    report = export_official(dataset, out, executor=SerialExecutor(), images=False, **options)
    assert report.kept == (RIGID,)  # pictures do no harm


def test_trials_without_a_place_are_named(dataset: Path, tmp_path: Path) -> None:
    report = export_official(
        dataset, tmp_path / "out", layout="physion-evaluator", executor=SerialExecutor()
    )
    assert report.made == (RIGID,)
    (note,) = report.notes["physion-evaluator"]
    assert "1 trials have no place" in note and "1 testing drape" in note
    with pytest.raises(BadInputError, match="no place"):
        export_official(dataset, tmp_path / "x", layout="physion-evaluator", scenario="drape")
    with pytest.raises(UnknownNameError, match="physopt"):
        export_official(dataset, tmp_path / "x", layout="physopts")


def test_pictures_are_refused_where_there_are_none(dataset: Path, tmp_path: Path) -> None:
    options = export_verb.Options(dataset, tmp_path / "x", layout="gltf", images=False)
    with pytest.raises(BadInputError, match="--no-images"):
        export_verb.main(options)
