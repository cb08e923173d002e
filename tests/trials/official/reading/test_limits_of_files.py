"""Official HDF5 files whose arrays take more memory together than a file may are refused."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from physion.core.errors import BadInputError
from physion.trials.official.read_file import OfficialFile


def test_many_small_arrays_are_bounded_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "0000.hdf5"
    with h5py.File(path, "w") as file:
        for frame in range(4):
            # Zeros take almost no room in the file.
            file.create_dataset(
                f"frames/{frame:04}/objects/positions",
                data=np.zeros((1000, 3)), chunks=(1000, 3), compression="gzip",
            )  # fmt: skip
    monkeypatch.setattr("physion.trials.official.read_file.MAX_FILE_BYTES", 80_000)
    with OfficialFile.open(path) as official:
        for _ in range(5):  # the same array counts once
            official.numbers("frames/0000/objects/positions", (None, 3))
        for frame in (1, 2):
            official.numbers(f"frames/{frame:04}/objects/positions", (None, 3))
        with pytest.raises(BadInputError, match=r"frames/0003/objects/positions.*80000 bytes"):
            official.numbers("frames/0003/objects/positions", (None, 3))
