"""Trial files: round trips, and errors for damaged and hostile files."""

from __future__ import annotations

import dataclasses
import io
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from physion.core.errors import BadInputError
from physion.physics.trajectory import Trajectory
from physion.trials.trial_file import FIELDS, SEAL_BYTES, Trial, TrialWriter, seal
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
