"""Trial files: round trips, and errors for damaged and hostile files."""

from __future__ import annotations

import dataclasses
import io
import json
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
from physion.trials.trial_file import FIELDS, GEOMETRY, SEAL_BYTES, Trial, TrialWriter, seal
from support.hand_made import FRAMES, Parts, images, make_parts, write_trial
from support.paths import FIND_TESTS


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


def huge_chunk(file: h5py.File) -> None:
    del file["contacts/impulse"]
    file.create_dataset("contacts/impulse", (2**28,), "f4", chunks=(2**28,), fletcher32=True)


def external_link(file: h5py.File) -> None:
    del file["scene"]
    file["scene"] = h5py.ExternalLink("/etc/hostname", "/x")


def soft_link(file: h5py.File) -> None:
    del file["contacts/point"]
    file["contacts/point"] = h5py.SoftLink("/contacts/normal")


def external_storage(file: h5py.File) -> None:
    del file["contacts/impulse"]
    file.create_dataset("contacts/impulse", (10,), "f4", external=[("/etc/passwd", 0, 40)])


def external_storage_of_nothing(file: h5py.File) -> None:
    del file["contacts/impulse"]
    file.create_dataset("contacts/impulse", (0,), "f4", external=[("/etc/passwd", 0, 40)])


def virtual(file: h5py.File) -> None:
    del file["contacts/impulse"]
    layout = h5py.VirtualLayout((10,), "f4")
    layout[:] = h5py.VirtualSource("/tmp/other.h5", "x", (10,))
    file.create_virtual_dataset("contacts/impulse", layout)


def group_for_array(file: h5py.File) -> None:
    del file["scene"]
    file.create_group("scene")


def array_for_group(file: h5py.File) -> None:
    del file["contacts"]
    file["contacts"] = np.zeros(3)


CHUNKED = {"chunks": True}


def json_with(path: str, **values: Any) -> Callable[[h5py.File], None]:
    """Change values of a field that holds JSON."""

    def change(file: h5py.File) -> None:
        content = json.loads(bytes(file[path][0])) | values
        replace_with(path, np.array([json.dumps(content).encode()]), **CHUNKED)(file)

    return change


def array_with(path: str, value: float) -> Callable[[h5py.File], None]:
    """Change one value of an array."""

    def change(file: h5py.File) -> None:
        values = file[path][()]
        values.reshape(-1)[7] = value
        replace_with(path, values, **CHUNKED)(file)

    return change


def nested(path: str) -> Callable[[h5py.File], None]:
    """JSON that is nested without end."""
    return replace_with(path, np.array([b'{"a": ' + b"[" * 100_000]), **CHUNKED)


LISTS = np.empty(1, object)
LISTS[0] = np.zeros(3, np.float32)
EVIL: dict[str, tuple[str, Callable[[h5py.File], None]]] = {
    "missing": (
        "trajectory/rotations.*is missing",
        lambda f: f.__delitem__("trajectory/rotations"),
    ),
    "group gone": ("contacts/frame.*is missing", lambda f: f.__delitem__("contacts")),
    "group for array": ("scene.*is not an array", group_for_array),
    "array for group": ("contacts/frame.*not a group", array_for_group),
    "external link": ("scene.*is a ExternalLink", external_link),
    "soft link": ("contacts/point.*is a SoftLink", soft_link),
    "external storage": ("contacts/impulse.*not stored in chunks", external_storage),
    "external nothing": ("contacts/impulse.*another file", external_storage_of_nothing),
    "virtual": ("contacts/impulse.*not stored in chunks", virtual),
    "huge": ("first_frame/ids.*too large", huge),
    "huge chunk": ("contacts/impulse.*too large", huge_chunk),
    "object": (
        "scene.*not text of fixed length",
        replace_with("scene", ["{}"], dtype=h5py.string_dtype(), **CHUNKED),
    ),
    "variable arrays": (
        "contacts/impulse.*has type object",
        replace_with("contacts/impulse", LISTS, dtype=h5py.vlen_dtype(np.float32), **CHUNKED),
    ),
    "reference": (
        "contacts/impulse.*has type object",
        lambda f: replace_with("contacts/impulse", [f.ref], dtype=h5py.ref_dtype, **CHUNKED)(f),
    ),
    "type": ("contacts/impulse.*float64", replace_with("contacts/impulse", [1.0], **CHUNKED)),
    "endian": (
        "contacts/impulse.*has type >f4",
        replace_with("contacts/impulse", np.zeros(10, ">f4"), **CHUNKED),
    ),
    "axes": (
        "first_frame/ids.*has shape",
        replace_with("first_frame/ids", np.zeros((2, 3, 4), np.int16), **CHUNKED),
    ),
    "lengths": (
        "contacts/impulse.*has 3 entries along axis 'contact', not 10",
        replace_with("contacts/impulse", np.zeros(3, np.float32), **CHUNKED),
    ),
    "filter": (
        "contacts/impulse.*unknown filters",
        replace_with("contacts/impulse", np.zeros(10, np.float32), compression="lzf"),
    ),
    "scene no JSON": ("scene.*not JSON", replace_with("scene", np.array([b"{x"]), **CHUNKED)),
    "scene no UTF-8": (
        "scene.*cannot be read",
        replace_with("scene", np.array([b"\xff"]), **CHUNKED),
    ),
    "labels": (
        "unknown key 'a'",
        replace_with("labels", np.array([b'{"a": 1}']), **CHUNKED),
    ),
    "labels type": (
        r"labels\.contact must be true or false, not 'yes'",
        replace_with("labels", np.array([b'{"contact": "yes"}']), **CHUNKED),
    ),
    "labels part": (
        "labels.*missing",
        replace_with("labels", np.array([b'{"contact": true}']), **CHUNKED),
    ),
    "contact of nobody": (
        "contacts/bodies.*leaves -1..2",
        replace_with("contacts/bodies", np.full((10, 2), 3, np.int32), **CHUNKED),
    ),
    "deep scene": ("scene.*nested deeper than 100 levels", nested("scene")),
    "deep metadata": ("metadata.*nested deeper than 100 levels", nested("metadata")),
    "wide": (
        "metadata: width must be 1 to 4096, not 1000000",
        json_with("metadata", width=10**6),
    ),
    "no rate": (
        "metadata: playback_rate must be 1 to 1000, not 0",
        json_with("metadata", playback_rate=0),
    ),
    "long": ("metadata: frames must be 1 to 10000", json_with("metadata", frames=10**9)),
    "nothing after": (
        "metadata: observed_frames must be 1 to 60, not 61",
        json_with("metadata", observed_frames=61),
    ),
    "no time": ("metadata: index .* frame_time", json_with("metadata", frame_time=0)),
    "unknown position": (
        "trajectory/positions' has values that are not finite",
        array_with("trajectory/positions", np.nan),
    ),
    "infinite rotation": (
        "trajectory/rotations' has values that are not finite",
        array_with("trajectory/rotations", np.inf),
    ),
    "ids of nothing": ("first_frame/ids' leaves 0..3", array_with("first_frame/ids", 4)),
    "contact after the end": (
        "contacts/frame.*leaves 0..59",
        replace_with("contacts/frame", np.full(10, 60, np.int32), **CHUNKED),
    ),
}


@pytest.mark.parametrize("name", sorted(EVIL))
def test_evil_files_with_a_right_seal_are_refused_with_their_field(name: str, parts: Parts) -> None:
    message, change = EVIL[name]
    data = sealed_with(change, parts.pack())
    with pytest.raises(BadInputError, match=f"evil.*{message}"):
        read_all(data)


FUZZ = """
import sys
import numpy as np
from physion.core.errors import BadInputError
from physion.trials.trial_file import seal, SEAL_BYTES
from tests.trials.test_trial_file import read_all
data = open(sys.argv[1], "rb").read()
rng = np.random.default_rng(int(sys.argv[2]))
refused = read = 0
for _ in range(int(sys.argv[3])):
    broken = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        place = int(rng.integers(SEAL_BYTES, len(data)))
        kind = rng.integers(3)
        if kind == 0:
            broken[place] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            broken[place : place + 8] = rng.bytes(len(broken[place : place + 8]))
        else:
            source = int(rng.integers(SEAL_BYTES, len(data)))
            broken[place : place + 64] = broken[source : source + len(broken[place : place + 64])]
    try:
        read_all(seal(bytes(broken)))
        read += 1
    except BadInputError:
        refused += 1
print(refused, read)
"""


def without_checksums(data: bytes) -> bytes:
    """The same trial in HDF5's oldest format, whose library then trusts every byte."""
    buffer = io.BytesIO()
    with (
        h5py.File(io.BytesIO(data)) as source,
        h5py.File(buffer, "w", libver="earliest", userblock_size=SEAL_BYTES) as target,
    ):
        for path in (*FIELDS, *GEOMETRY):
            array = source[path]
            packed = {"chunks": array.chunks, "compression": "gzip"} if array.size else {}
            target.create_dataset(path, data=array[()], **packed)
    read_all(seal(buffer.getvalue()))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        ("state", 150),
        ("passes", 20),
        pytest.param("unchecked", 150, marks=pytest.mark.slow),
        pytest.param("unchecked", 500, marks=[pytest.mark.slow, pytest.mark.nightly]),
    ],
)
def test_mutations_with_a_right_seal_never_crash(
    kind: str, count: int, parts: Parts, tmp_path: Path
) -> None:
    data = parts.pack(full=kind == "passes")
    data = without_checksums(data) if kind == "unchecked" else data
    (tmp_path / "t.h5").write_bytes(data)
    done = subprocess.run(
        [sys.executable, "-c", FUZZ, str(tmp_path / "t.h5"), "1", str(count)],
        capture_output=True,
        text=True,
        env=FIND_TESTS,
        timeout=240,
    )
    assert done.returncode == 0, f"{done.returncode}: {done.stderr[-2000:]}"
    refused, read = map(int, done.stdout.split())
    assert refused + read == count
    # Without checksums a changed number is just another number; with them it is never read.
    assert refused > count / 2 if kind == "unchecked" else refused >= count - 3


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
