"""Safe reading of HDF5 files that may be damaged or made to do harm.

HDF5 can link to other files, store arrays outside the file, compress with loadable filters and
declare sizes far beyond the file's own. The readers of trial files and of official files share the
checks that refuse all of this before memory is allocated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Set
from pathlib import Path
from typing import TypeVar

import h5py

from physion.errors import BadInputError

T = TypeVar("T")

_LINKS = {h5py.h5l.TYPE_SOFT: "SoftLink", h5py.h5l.TYPE_EXTERNAL: "ExternalLink"}
HDF5_ERRORS = (OSError, KeyError, RuntimeError, ValueError, TypeError, MemoryError, AttributeError)
"""Exceptions that h5py raises on damaged files."""


def open_hdf5(source: Path | bytes, where: str) -> h5py.File:
    """Open an HDF5 file, or the bytes of one, for reading.

    Raises `BadInputError`, naming ``where``, if it is none.
    """
    try:
        if isinstance(source, bytes):
            return h5py.File(h5py.h5f.open_file_image(source))
        return h5py.File(source, "r")
    except HDF5_ERRORS as error:
        raise BadInputError(f"{where} is not HDF5: {' '.join(str(error).split())}") from error


class GuardedHdf5:
    """Access to the members of an open HDF5 file, with the checks that hold for every format.

    Parameters
    ----------
    file
        The open file.
    where
        Name of the file in error messages.
    filters
        Numbers of the HDF5 filters (compression, checksums) that arrays may use.
    max_chunk_bytes
        Largest chunk that is read, in bytes of memory.
    """

    def __init__(
        self, file: h5py.File, where: str, *, filters: Set[int], max_chunk_bytes: int
    ) -> None:
        self.where = where
        self._file = file
        self._filters = filters
        self._max_chunk_bytes = max_chunk_bytes
        self._groups: dict[str, h5py.Group] = {}

    def bad(self, path: str, what: str) -> BadInputError:
        """Return the error that says ``what`` is wrong with the field at ``path``."""
        return BadInputError(f"{self.where}: field {path!r} {what}")

    def guard(self, path: str, read: Callable[[], T]) -> T:
        """Call ``read``; raise `BadInputError` instead of any exception of h5py."""
        try:
            return read()
        except HDF5_ERRORS as error:
            raise self.bad(path, f"cannot be read: {' '.join(str(error).split())}") from error

    def find(self, path: str) -> h5py.Group | h5py.Dataset | None:
        """Return the group or array at ``path``, or None if there is none.

        Only members stored in the file itself are returned; `BadInputError` for soft and external
        links anywhere along the path.
        """
        if path in self._groups:
            return self._groups[path]
        parents, _, name = path.rpartition("/")
        parent = self.find(parents) if parents else self._file
        if not isinstance(parent, h5py.Group):
            return None
        # The lower layer of h5py takes half the time, which counts for files of 20 small arrays.
        group, member = parent.id, name.encode()
        if not self.guard(path, lambda: group.links.exists(member)):
            return None
        kind = self.guard(path, lambda: group.links.get_info(member).type)
        if kind != h5py.h5l.TYPE_HARD:
            raise self.bad(path, f"is a {_LINKS.get(kind, 'link')}, which is not followed")
        found = self.guard(path, lambda: h5py.h5o.open(group, member))
        if isinstance(found, h5py.h5d.DatasetID):
            return h5py.Dataset(found)
        if not isinstance(found, h5py.h5g.GroupID):
            return None
        self._groups[path] = h5py.Group(found)
        return self._groups[path]

    def check_size(self, path: str, shape: tuple[int, ...], itemsize: int, max_bytes: int) -> None:
        """Check that an array of ``shape`` takes at most ``max_bytes`` of memory."""
        if math.prod(shape) * max(itemsize, 1) > max_bytes:
            raise self.bad(path, f"has shape {shape}, which is too large (limit {max_bytes} bytes)")

    def check_storage(self, path: str, dataset: h5py.Dataset) -> None:
        """Check that an array lies in this file, in chunks and with filters that are allowed."""
        self.guard(path, lambda: self._check_storage(path, dataset))

    def _check_storage(self, path: str, dataset: h5py.Dataset) -> None:
        plan = dataset.id.get_create_plist()
        if plan.get_layout() == h5py.h5d.VIRTUAL or plan.get_external_count():
            raise self.bad(path, "is stored in another file")
        unknown = {plan.get_filter(k)[0] for k in range(plan.get_nfilters())} - self._filters
        if unknown:
            raise self.bad(path, f"is packed with unknown filters {sorted(unknown)}")
        chunks = plan.get_chunk() if plan.get_layout() == h5py.h5d.CHUNKED else ()
        if math.prod(chunks) * max(dataset.dtype.itemsize, 1) > self._max_chunk_bytes:
            raise self.bad(
                path,
                f"has chunks of {chunks}, which is too large (limit {self._max_chunk_bytes} bytes)",
            )
