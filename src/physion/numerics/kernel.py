"""Decorator that compiles the numerical loops of this package."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.dispatcher import Dispatcher

Function = TypeVar("Function", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True}


def kernel(function: Function) -> Function:
    """Compile ``function`` with numba on its first call and cache the machine code on disk.

    One thread, no ``fastmath``: the order of all operations is that of the source, so equal input
    gives equal bytes on every processor. ``error_model="numpy"`` lets a division by zero give
    infinity or NaN. The cached machine code is discarded when the file of the kernel, or of any
    kernel that it calls, has changed.
    """
    dispatcher: Any = numba.njit(cache=True, **OPTIONS)(function)
    # Numba asks only the kernel's own file whether cached code is outdated. The files of the
    # kernels that it calls are added to the stamp that numba compares.
    files = sorted(set(_files_called(function)))
    stored = dispatcher._cache._cache_file
    stored._source_stamp = (stored._source_stamp, tuple(_digest(file) for file in files))
    return cast(Function, dispatcher)


def _files_called(
    function: Callable[..., Any], seen: frozenset[str] = frozenset()
) -> Iterator[str]:
    """Yield the files of all compiled functions that ``function`` calls, directly or indirectly."""
    for name in function.__code__.co_names:
        called = function.__globals__.get(name)
        if isinstance(called, Dispatcher) and called.py_func.__qualname__ not in seen:
            inner = called.py_func
            yield inner.__code__.co_filename
            yield from _files_called(inner, seen | {inner.__qualname__})


@cache
def _digest(file: str) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()
