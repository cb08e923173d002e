"""Reads official HDF5 files without trusting them.

Files of several makers differ (docs/official-system.md, sections 4 and 9): names may end in
``_cam0``, frames may be counted from 0 or 1, labels may be missing, physics arrays may be shorter
than the list of objects, pictures may be PNG or JPEG. All of that is read. Not read are links out
of the file or across it, arrays stored elsewhere, packed with unknown filters, of types that point
or run code, or of sizes that no trial has: those raise `BadInputError` with file and field.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.trials.guarded_hdf5 import GuardedHdf5, open_hdf5
from physion.trials.official.names import decode_picture

MAX_FRAMES = 10_000
MAX_BYTES = 2**27
"""Largest array of one frame or object that is read, in memory."""
MAX_TEXT = 2**20
_SUFFIXES = ("", "_cam0")
_FILTERS = {
    h5py.h5z.FILTER_DEFLATE,
    h5py.h5z.FILTER_SHUFFLE,
    h5py.h5z.FILTER_FLETCHER32,
    h5py.h5z.FILTER_LZF,
}


class OfficialFile(GuardedHdf5, AbstractContextManager["OfficialFile"]):
    """Reader of one official HDF5 file, for use in a ``with`` statement.

    Paths are those of the file, such as ``static/mass`` or ``frames/0000/objects/positions``.
    """

    def __init__(self, file: h5py.File, where: str) -> None:
        super().__init__(file, where, filters=_FILTERS, max_chunk_bytes=MAX_BYTES)

    @classmethod
    def open(cls, path: Path) -> OfficialFile:
        """Open ``path``; `BadInputError` if it is no HDF5 file."""
        where = f"official file {path}"
        if path.is_symlink() or not path.is_file():
            raise BadInputError(f"{where} is no plain file")
        return cls(open_hdf5(path, where), where)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def frames(self) -> list[str]:
        """Names of the frames, in their order, whatever they are counted from."""
        names = [name for name in self.names("frames") if name.isdecimal()]
        if not 1 <= len(names) <= MAX_FRAMES:
            raise self.bad("frames", f"holds {len(names)} frames, not 1 to {MAX_FRAMES}")
        numbers = sorted(int(name) for name in names)
        if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            raise self.bad("frames", "has gaps in its numbers")
        return sorted(names, key=int)

    def names(self, path: str) -> list[str]:
        """Names in the group at ``path``; none where there is no group."""
        group = self.find(path)
        if not isinstance(group, h5py.Group):
            return []
        if self.guard(path, lambda: len(group)) > 100 * MAX_FRAMES:
            raise self.bad(path, "has too many entries to be true")
        return list(self.guard(path, lambda: list(group)))

    def has(self, path: str) -> bool:
        """Whether there is an array at ``path``, with or without the ending of a camera."""
        return any(self.find(path + suffix) is not None for suffix in _SUFFIXES)

    def numbers(self, path: str, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
        """Finite or not, the numbers at ``path``; None in ``shape`` stands for any length."""
        dataset = self._dataset(path)
        if dataset.dtype.kind not in "fiub":
            raise self.bad(path, f"has type {dataset.dtype}, not numbers")
        found = dataset.shape
        fits = len(found) == len(shape) and all(
            wanted is None or length == wanted for length, wanted in zip(found, shape, strict=True)
        )
        if not fits:
            raise self.bad(path, f"has shape {found}, not {shape}")
        values = self.guard(path, lambda: dataset[()])
        return np.asarray(values, np.float64)

    def table(self, path: str, *row: int) -> NDArray[np.float64]:
        """The numbers at ``path`` as rows of shape ``row``, however they lie in the file."""
        dataset = self._dataset(path)
        values = self.numbers(path, tuple(None for _ in dataset.shape))
        if values.size % int(np.prod(row)):
            raise self.bad(path, f"has shape {dataset.shape}, not rows of {row}")
        return values.reshape(-1, *row)

    def number(self, path: str, default: float | None = None) -> float:
        """One number; ``default``, if any, where there is none."""
        if default is not None and not self.has(path):
            return default
        dataset = self._dataset(path)
        values = self.numbers(path, tuple(None for _ in dataset.shape)).ravel()
        if values.size != 1 or not np.isfinite(values[0]):
            raise self.bad(path, f"is {values[:3]}, not one number")
        return float(values[0])

    def text(self, path: str, default: str | None = None) -> str:
        """One text; ``default``, if any, where there is none."""
        if default is not None and not self.has(path):
            return default
        found = self.texts(path)
        if len(found) != 1:
            raise self.bad(path, f"holds {len(found)} texts, not one")
        return found[0]

    def texts(self, path: str) -> list[str]:
        """The texts of an array, or the one text of a scalar."""
        dataset = self._dataset(path)
        if h5py.check_string_dtype(dataset.dtype) is None:
            raise self.bad(path, f"has type {dataset.dtype}, not text")
        values = np.ravel(np.asarray(self.guard(path, lambda: dataset[()]), object))
        texts = [value if isinstance(value, bytes) else str(value).encode() for value in values]
        if sum(len(text) for text in texts) > 100 * MAX_TEXT:
            raise self.bad(path, "holds more text than can be true")
        return [text.rstrip(b"\0").decode("utf-8", "replace") for text in texts]

    def data(self, path: str) -> bytes:
        """The bytes at ``path``, an array of them."""
        dataset = self._dataset(path)
        if dataset.dtype != np.uint8 or len(dataset.shape) != 1:
            raise self.bad(path, f"is {dataset.dtype} {dataset.shape}, not a row of bytes")
        return bytes(self.guard(path, lambda: dataset[()]))

    def picture(self, path: str) -> NDArray[np.uint8]:
        """The PNG or JPEG picture (H, W, 3) whose bytes are at ``path``."""
        data = np.frombuffer(self.data(path), np.uint8)
        try:
            return decode_picture(data)
        except BadInputError as error:
            raise self.bad(path, f"is {error}") from error

    def _dataset(self, path: str) -> h5py.Dataset:
        for suffix in _SUFFIXES:
            found = self.find(path + suffix)
            if found is not None:
                break
        else:
            raise self.bad(path, "is missing")
        if not isinstance(found, h5py.Dataset):
            raise self.bad(path, "is not an array")
        self.guard(path, lambda: self._check(path, found))
        return found

    def _check(self, path: str, dataset: h5py.Dataset) -> None:
        if dataset.shape is None:
            raise self.bad(path, "is empty")
        kind, itemsize = dataset.dtype.kind, dataset.dtype.itemsize
        if kind not in "fiubSO" or (kind == "O" and h5py.check_string_dtype(dataset.dtype) is None):
            raise self.bad(path, f"has type {dataset.dtype}")
        self.check_size(path, dataset.shape, itemsize, MAX_BYTES)
        self.check_storage(path, dataset)
