"""Writing of many small arrays into an HDF5 file.

A frame of an official file has about 30 arrays of some 100 bytes. `h5py.Group.create_dataset`
takes three times as long for each as HDF5 itself, so they are created with h5py's lower layer here.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import h5py
import numpy as np
from h5py import h5d, h5g, h5o, h5p, h5s, h5t
from numpy.typing import NDArray

_SMALL = 1024
"""Size in bytes up to which arrays are not compressed, because they would become larger."""
GZIP_LEVEL = 1
"""Level of gzip; on motion and particles, 4 takes a third more time for 2 % fewer bytes."""


def new_group(parent: Any, name: str) -> Any:
    """Create a group below a group of h5py's lower layer (``h5py.Group.id``), and return it."""
    return h5g.create(parent, name.encode())


def link(parent: Any, name: str, target: Any) -> None:
    """Enter an existing array into another group too (hard link).

    Readers find an equal array there. What frames have in common is stored once so.
    """
    h5o.link(target, parent, name.encode())


def put(group: Any, name: str, values: Any) -> Any:
    """Write an array or a scalar into a group of h5py's lower layer, and return the new array.

    Larger arrays are compressed.
    """
    array = np.asarray(values, order="C")
    space = _space(array.shape)
    large = array.ndim and array.nbytes > _SMALL
    # The values of small arrays stand in their headers.
    layout = _compressed(array.shape) if large else _compact()
    kind = _type(array.dtype)
    made = h5d.create(group, name.encode(), kind, space, layout)
    if array.size:
        made.write(h5s.ALL, h5s.ALL, array, mtype=kind)
    return made


def put_bytes(group: Any, name: str, data: bytes) -> None:
    """Write bytes as an array of uint8 without compression."""
    array = np.frombuffer(data, np.uint8)
    made = h5d.create(group, name.encode(), _type(array.dtype), _space(array.shape), _plain())
    made.write(h5s.ALL, h5s.ALL, array)


def put_picture(group: Any, name: str, picture: NDArray[Any], *, shuffle: bool = False) -> None:
    """Write a picture as one compressed chunk."""
    array = np.ascontiguousarray(picture)
    layout = _compressed(array.shape, shuffle)
    made = h5d.create(group, name.encode(), _type(array.dtype), _space(array.shape), layout)
    made.write(h5s.ALL, h5s.ALL, array)


@cache
def _type(dtype: np.dtype[Any]) -> Any:
    return h5t.py_create(dtype, logical=True)


@cache
def _space(shape: tuple[int, ...]) -> Any:
    return h5s.create_simple(shape) if shape else h5s.create(h5s.SCALAR)


@cache
def _plain() -> Any:
    layout = h5p.create(h5p.DATASET_CREATE)
    # Equal trials give equal bytes at any time.
    layout.set_obj_track_times(False)
    return layout


@cache
def _compact() -> Any:
    layout = _plain().copy()
    layout.set_layout(h5d.COMPACT)
    return layout


@cache
def _compressed(shape: tuple[int, ...], shuffle: bool = True) -> Any:
    layout = _plain().copy()
    layout.set_chunk(shape)
    layout.set_fill_time(h5d.FILL_TIME_NEVER)
    if shuffle:
        layout.set_shuffle()
    layout.set_deflate(GZIP_LEVEL)
    return layout


def in_memory_file() -> h5py.File:
    """Return a new HDF5 file in memory, because a full disk would crash the HDF5 library."""
    return h5py.File("official", "w", driver="core", backing_store=False, block_size=2**22)
