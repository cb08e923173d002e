"""Tar shards: layout, equal bytes each time, completeness, size limit, resuming."""

from __future__ import annotations

import dataclasses
import functools
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import physion.trials.share.shards as shards_module
from physion.cli.main import main as cli
from physion.compute.local import LocalExecutor, SerialExecutor
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import is_whole
from physion.trials.files import TrialPaths, encode_png, write_files
from physion.trials.index import build_index, write_index
from physion.trials.share.shards import SEEN_PARTS, SHARD_BYTES
from physion.trials.trial_file import Trial
from physion.trials.video import encode_movie
from support.hand_made import FRAMES, SIZE, images, make_parts, tree_digest

OBSERVED = 45

export_shards = functools.partial(shards_module.export_shards, executor=SerialExecutor())
"""Export in this process, which is faster for few small shards."""


def _make(folder: Path, split: str, trial: str, contact: bool, free: bool = False) -> TrialPaths:
    """One hand-made trial with its files."""
    parts = make_parts(trial, cloth=False, contact_frame=50 if contact else None)
    meta = dataclasses.replace(parts.metadata, split=split, free_movies=free)
    color = np.stack([images(frame)["color"] for frame in range(FRAMES)])
    files = {
        "movie": encode_movie(color),
        "observed_movie": encode_movie(color[:OBSERVED]),
        "map": encode_png(np.zeros((SIZE, SIZE, 4), np.uint8)),
        "trial_file": parts._replace(metadata=meta).pack(),
    }
    if free:
        files |= {
            "free_movie": encode_movie(color[:, ::-1]),
            "free_observed_movie": encode_movie(color[:OBSERVED, ::-1]),
        }
    paths = TrialPaths(folder, split, "drop", trial)
    write_files(paths, files)
    return paths


def _index(folder: Path) -> None:
    table, problems = build_index(folder)
    assert not problems
    write_index(folder, table)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two testing trials with free movies, three training trials, one of a name with dots."""
    folder = tmp_path_factory.mktemp("dataset")
    _make(folder, "testing", "test_a", True, free=True)
    _make(folder, "testing", "test_b", False, free=True)
    for trial, contact in (("train_a", False), ("train_b.v1.5", True), ("train_c", True)):
        _make(folder, "training", trial, contact)
    _index(folder)
    return folder


def read_tar(path: Path) -> Iterator[tuple[str, bytes, bytes]]:
    """Name, data and header of the members of a tar file: a reader of its own, for short names."""
    data, at = path.read_bytes(), 0
    while data[at : at + 512].strip(b"\0"):
        header = data[at : at + 512]
        assert header[156:157] == b"0", "not a plain file"
        blank = header[:148] + b" " * 8 + header[156:]
        assert sum(blank) == int(header[148:156].rstrip(b"\0 "), 8), "wrong checksum"
        size = int(header[124:136].rstrip(b"\0 "), 8)
        yield header[:100].rstrip(b"\0").decode(), data[at + 512 : at + 512 + size], header
        at += 512 + -(-size // 512) * 512


def read_samples(path: Path) -> dict[str, dict[str, bytes]]:
    """Files by key, then by all that follows the first dot, as webdataset groups them."""
    samples: dict[str, dict[str, bytes]] = {}
    last = None
    for name, data, _ in read_tar(path):
        key, _, ending = name.partition(".")
        assert key == last or key not in samples, "the files of a sample lie apart"
        samples.setdefault(key, {})[ending] = data
        last = key
    return samples


def test_samples_hold_the_files_of_their_trial(dataset: Path, tmp_path: Path) -> None:
    shards = export_shards(dataset, tmp_path / "out")
    assert [s.name for s in shards] == [
        "physion-testing-000000.tar",
        "physion-training-000000.tar",
    ]
    testing = read_samples(tmp_path / "out" / shards[0].name)
    training = read_samples(tmp_path / "out" / shards[1].name)
    assert list(testing) == ["test_a", "test_b"]
    assert list(training) == ["train_a", "train_b_v1_5", "train_c"]
    everything = {"full.mp4", "json", "map.png", "observed.mp4", "outcome.json", "trial.hdf5"}
    assert set(training["train_a"]) == everything
    assert set(testing["test_a"]) == everything | {"free_full.mp4", "free_observed.mp4"}
    paths = TrialPaths(dataset, "testing", "drop", "test_a")
    for ending, path in {
        "full.mp4": paths.movie,
        "observed.mp4": paths.observed_movie,
        "free_full.mp4": paths.free_movie,
        "free_observed.mp4": paths.free_observed_movie,
        "map.png": paths.map,
        "trial.hdf5": paths.trial_file,
    }.items():
        assert testing["test_a"][ending] == path.read_bytes(), ending
    assert Trial(training["train_a"]["trial.hdf5"], "a sample").metadata.trial == "train_a"


def test_what_may_be_seen_says_nothing_of_the_future(dataset: Path, tmp_path: Path) -> None:
    shards = export_shards(dataset, tmp_path, parts=SEEN_PARTS)
    seen = {}
    for shard in shards:
        seen |= read_samples(tmp_path / shard.name)
    for sample in seen.values():
        assert set(sample) <= set(SEEN_PARTS)
        told = json.loads(sample["json"])
        assert set(told) == {
            "trial", "dataset", "scenario", "split", "look", "width", "height", "observed_frames",
        }  # fmt: skip
    # Trials with and without contact differ in their names alone.
    told = [json.loads(seen[key]["json"]) for key in ("train_a", "train_c")]
    assert [t.pop("trial") for t in told] == ["train_a", "train_c"] and told[0] == told[1]


def test_the_answer_is_in_a_file_of_its_own(dataset: Path, tmp_path: Path) -> None:
    export_shards(dataset, tmp_path, split="training")
    samples = read_samples(tmp_path / "physion-training-000000.tar")
    answers = {key: json.loads(sample["outcome.json"]) for key, sample in samples.items()}
    assert [a["contact"] for a in answers.values()] == [False, True, True]
    assert answers["train_c"]["first_frame"] == 50 and answers["train_a"]["first_frame"] is None
    assert answers["train_b_v1_5"]["trial"] == "train_b.v1.5"


def test_same_dataset_same_bytes(dataset: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        export_shards(dataset, tmp_path / name, shard_bytes=60_000)
    assert tree_digest(tmp_path / "one") == tree_digest(tmp_path / "two")
    headers = [h for p in (tmp_path / "one").glob("*.tar") for _, _, h in read_tar(p)]
    assert len({header[100:124] for header in headers}) == 1, "mode, owner, group"
    assert {header[136:148] for header in headers} == {b"00000000000\0"}, "time"


def test_shards_stay_below_their_size(dataset: Path, tmp_path: Path) -> None:
    whole = export_shards(dataset, tmp_path / "whole", split="training")
    largest = max(shard.bytes for shard in export_shards(dataset, tmp_path / "each", shard_bytes=1))
    for limit in (largest, 2 * largest, SHARD_BYTES):
        shards = export_shards(dataset, tmp_path / str(limit), split="training", shard_bytes=limit)
        assert all(shard.bytes <= limit for shard in shards)
        assert sum(shard.samples for shard in shards) == 3
    assert len(whole) == 1
    each = export_shards(dataset, tmp_path / "each", shard_bytes=1)
    assert [shard.samples for shard in each] == [1] * 5
    assert [s.name for s in each][:3] == [
        "physion-testing-000000.tar",
        "physion-testing-000001.tar",
        "physion-training-000000.tar",
    ]


def test_the_manifest_counts_and_each_shard_has_its_digest(dataset: Path, tmp_path: Path) -> None:
    export_shards(dataset, tmp_path)
    manifest = json.loads((tmp_path / "shards.json").read_text())
    assert manifest["splits"]["training"]["samples"] == 3
    assert sum(s["samples"] for s in manifest["splits"].values()) == 5
    for shard in manifest["shards"]:
        path = tmp_path / shard["name"]
        assert shard["bytes"] == path.stat().st_size and is_whole(path)
        assert shard["samples"] == len(read_samples(path))


def test_a_damaged_or_interrupted_export_is_made_again(dataset: Path, tmp_path: Path) -> None:
    shards = export_shards(dataset, tmp_path)
    before = tree_digest(tmp_path)
    (tmp_path / shards[0].name).write_bytes(b"damaged")
    (tmp_path / shards[1].name).unlink()
    export_shards(dataset, tmp_path)
    (tmp_path / "shards.json").unlink()
    export_shards(dataset, tmp_path)
    assert tree_digest(tmp_path) == before


def test_shards_follow_a_dataset_that_grows_and_shrinks(tmp_path: Path) -> None:
    folder, out = tmp_path / "dataset", tmp_path / "out"
    paths = [_make(folder, "training", f"t{i}", i == 1) for i in range(2)]
    _index(folder)
    export_shards(folder, out, shard_bytes=1)
    _make(folder, "training", "t2", True)
    _index(folder)
    assert len(export_shards(folder, out, shard_bytes=1)) == 3
    for path in paths[0].all().values():
        path.unlink()
    _index(folder)
    shards = export_shards(folder, out, shard_bytes=1)
    assert sorted(p.name for p in out.glob("*.tar")) == [s.name for s in shards]
    assert len(list(out.iterdir())) == 5 and len(shards) == 2


def test_files_that_do_not_match_the_index_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    paths = _make(folder, "training", "t0", True)
    _index(folder)
    paths.map.write_bytes(encode_png(np.ones((SIZE, SIZE, 4), np.uint8)))
    with pytest.raises(BadInputError, match=r"t0_map\.png was changed since it was made"):
        export_shards(folder, tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.tar"))


def test_a_bad_file_does_not_stop_the_other_shards(tmp_path: Path) -> None:
    folder, out = tmp_path / "dataset", tmp_path / "out"
    paths = [_make(folder, "training", f"t{i}", True) for i in range(3)]
    _index(folder)
    good = paths[1].map.read_bytes()
    for index in (0, 1):
        paths[index].map.write_bytes(encode_png(np.ones((SIZE, SIZE, 4), np.uint8)))
    with pytest.raises(BadInputError, match=r"t0_map\.png was changed.*1 more shards failed"):
        export_shards(folder, out, shard_bytes=1)
    assert [path.name for path in out.glob("*.tar")] == ["physion-training-000002.tar"]
    assert not (out / "shards.json").exists()
    for index in (0, 1):
        paths[index].map.write_bytes(good)
    assert len(export_shards(folder, out, shard_bytes=1)) == 3


@pytest.mark.slow
def test_several_processes_write_the_same_shards(dataset: Path, tmp_path: Path) -> None:
    steps: list[tuple[str, int, int]] = []
    serial = export_shards(dataset, tmp_path / "serial", shard_bytes=1)
    parallel = shards_module.export_shards(
        dataset,
        tmp_path / "parallel",
        shard_bytes=1,
        executor=LocalExecutor(2),
        progress=lambda *step: steps.append(step),
    )
    assert parallel == serial
    assert tree_digest(tmp_path / "parallel") == tree_digest(tmp_path / "serial")
    assert steps == [("shards", done, 5) for done in range(6)]


def test_names_with_dots_may_not_meet(tmp_path: Path) -> None:
    for trial in ("a.b", "a_b"):
        _make(tmp_path / "dataset", "training", trial, True)
    _index(tmp_path / "dataset")
    with pytest.raises(BadInputError, match="dots"):
        export_shards(tmp_path / "dataset", tmp_path / "out")


def test_long_names_are_kept(tmp_path: Path) -> None:
    import tarfile

    name = "n" * 190
    _make(tmp_path / "dataset", "training", name, True)
    _index(tmp_path / "dataset")
    shards = export_shards(tmp_path / "dataset", tmp_path / "out")
    with tarfile.open(tmp_path / "out" / shards[0].name) as archive:
        assert f"{name}.trial.hdf5" in archive.getnames()


def test_bad_arguments_say_so(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="training"):
        export_shards(dataset, tmp_path, split="trainin")
    with pytest.raises(UnknownNameError, match="drop"):
        export_shards(dataset, tmp_path, scenario="dropp")
    with pytest.raises(UnknownNameError, match=r"observed\.mp4"):
        export_shards(dataset, tmp_path, parts=("observe.mp4",))
    with pytest.raises(BadInputError, match="size above 0"):
        export_shards(dataset, tmp_path, shard_bytes=0)


def test_folders_of_something_else_are_not_changed(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(BadInputError, match=r"thesis\.tex"):
        export_shards(dataset, tmp_path)
    export_shards(dataset, tmp_path / "out", split="testing")
    before = tree_digest(tmp_path / "out")
    with pytest.raises(BadInputError, match="other options"):
        export_shards(dataset, tmp_path / "out", split="training")
    assert tree_digest(tmp_path / "out") == before


def test_the_verb_writes_what_may_be_seen(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("physion.cli.export.LocalExecutor", lambda workers: SerialExecutor())
    words = ["export", str(dataset), str(tmp_path / "out"), "--layout", "webdataset"]
    assert cli([*words, "--parts", "seen"]) == 0
    names = set()
    for path in (tmp_path / "out").glob("*.tar"):
        with tarfile.open(path) as shard:
            names |= {name.partition(".")[2] for name in shard.getnames()}
    assert {"json", "observed.mp4"} <= names <= set(SEEN_PARTS)


IMAGE_EXTENSIONS = (
    "blp bmp dib bufr cur pcx dcx dds ps eps fit fits fli flc ftc ftu gbr gif grib h5 hdf png apng "
    "jp2 j2k jpc jpf jpx j2c icns ico im iim tif tiff jfif jpe jpg jpeg mpg mpeg msp pcd pxr pbm "
    "pgm ppm pnm psd bw rgb rgba sgi ras tga icb vda vst webp wmf emf xbm xpm"
)
"""Extensions that webdataset 1.0.2 takes for pictures (its ``autodecode.py``)."""


def test_only_pictures_are_decoded_as_pictures() -> None:
    """The part of a key after its last dot decides, as in ``ImageHandler`` of webdataset."""
    pictures = IMAGE_EXTENSIONS.split()
    taken = [part for part in shards_module.PARTS if part.split(".")[-1] in pictures]
    assert taken == ["map.png"]
