"""Safe reading of official HDF5 files.

Files of different origin differ (docs/official-system.md, section 4): names may end with ``_cam0``,
frames may be counted from 0 or 1, labels may be missing, physics arrays may be shorter than the
list of objects, pictures may be PNG or JPEG. All of these are read. Links, arrays stored in other
files, unknown filters, types that are neither numbers nor text, and arrays that are too large
raise `BadInputError` with file and field.
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
from physion.trials.metadata import MAX_FRAMES
from physion.trials.official.names import decode_picture

MAX_BYTES = 2**27
"""Largest array that is read, in bytes of memory."""
MAX_FILE_BYTES = 2**31
"""Most memory that the arrays of a file may take together."""
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
        self._sizes: dict[str, int] = {}
        self._total = 0

    @classmethod
    def open(cls, path: Path) -> OfficialFile:
        """Open ``path``; `BadInputError` if it is not a regular HDF5 file."""
        where = f"official file {path}"
        if path.is_symlink() or not path.is_file():
            raise BadInputError(f"{where} is not a regular file")
        return cls(open_hdf5(path, where), where)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def frames(self) -> list[str]:
        """Return the names of the frames in order, whether counted from 0 or 1."""
        names = [name for name in self.names("frames") if name.isdecimal()]
        if not 1 <= len(names) <= MAX_FRAMES:
            raise self.bad("frames", f"holds {len(names)} frames, not 1 to {MAX_FRAMES}")
        numbers = sorted(int(name) for name in names)
        if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            raise self.bad("frames", "has gaps in its numbers")
        return sorted(names, key=int)

    def names(self, path: str) -> list[str]:
        """Return the names in the group at ``path``; none if there is no group."""
        group = self.find(path)
        if not isinstance(group, h5py.Group):
            return []
        if self.guard(path, lambda: len(group)) > 100 * MAX_FRAMES:
            raise self.bad(path, "has too many entries")
        return list(self.guard(path, lambda: list(group)))

    def has(self, path: str) -> bool:
        """Return whether there is an array at ``path``, with or without a camera suffix."""
        return any(self.find(path + suffix) is not None for suffix in _SUFFIXES)

    def numbers(self, path: str, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
        """Return the numbers, finite or not, at ``path``; None in ``shape`` allows any length."""
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
        """Return the numbers at ``path`` reshaped to rows of shape ``row``."""
        dataset = self._dataset(path)
        values = self.numbers(path, tuple(None for _ in dataset.shape))
        if values.size % int(np.prod(row)):
            raise self.bad(path, f"has shape {dataset.shape}, not rows of {row}")
        return values.reshape(-1, *row)

    def number(self, path: str, default: float | None = None) -> float:
        """Return the number at ``path``, or ``default`` if it is absent and a default is given."""
        if default is not None and not self.has(path):
            return default
        dataset = self._dataset(path)
        values = self.numbers(path, tuple(None for _ in dataset.shape)).ravel()
        if values.size != 1 or not np.isfinite(values[0]):
            raise self.bad(path, f"is {values[:3]}, not one number")
        return float(values[0])

    def text(self, path: str, default: str | None = None) -> str:
        """Return the text at ``path``, or ``default`` if it is absent and a default is given."""
        if default is not None and not self.has(path):
            return default
        found = self.texts(path)
        if len(found) != 1:
            raise self.bad(path, f"holds {len(found)} texts, not one")
        return found[0]

    def texts(self, path: str) -> list[str]:
        """Return the texts of an array, or the one text of a scalar."""
        dataset = self._dataset(path)
        if h5py.check_string_dtype(dataset.dtype) is None:
            raise self.bad(path, f"has type {dataset.dtype}, not text")
        values = np.ravel(np.asarray(self.guard(path, lambda: dataset[()]), object))
        texts = [value if isinstance(value, bytes) else str(value).encode() for value in values]
        if sum(len(text) for text in texts) > 100 * MAX_TEXT:
            raise self.bad(path, "holds too much text")
        return [text.rstrip(b"\0").decode("utf-8", "replace") for text in texts]

    def data(self, path: str) -> bytes:
        """Return the bytes stored as an array at ``path``."""
        dataset = self._dataset(path)
        if dataset.dtype != np.uint8 or len(dataset.shape) != 1:
            raise self.bad(path, f"is {dataset.dtype} {dataset.shape}, not an array of bytes")
        return bytes(self.guard(path, lambda: dataset[()]))

    def picture(self, path: str) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3) whose PNG or JPEG bytes are at ``path``."""
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
        if path not in self._sizes:
            self._sizes[path] = int(np.prod(dataset.shape, dtype=object)) * itemsize
            self._total += self._sizes[path]
        if self._total > MAX_FILE_BYTES:
            limit = f"more than {MAX_FILE_BYTES} bytes of memory"
            raise self.bad(path, f"is one array too many: those of the file take {limit}")
