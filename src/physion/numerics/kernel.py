"""Decorator that compiles the numerical loops of this package."""

from __future__ import annotations

import hashlib
import pickle
import re
import sys
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
    infinity or NaN. The cached machine code is discarded when the file of the kernel, of any
    kernel that it calls, or of any module of this package that it imports has changed.
    """
    dispatcher: Any = numba.njit(cache=True, **OPTIONS)(function)
    if not isinstance(dispatcher, Dispatcher):
        return function  # NUMBA_DISABLE_JIT is set: nothing is compiled
    # Numba asks only the kernel's own file whether cached code is outdated. The files of the
    # kernels that it calls, and of the constants and records that it imports, are added to the
    # stamp that numba compares.
    files = set(_files_called(function)) | _files_imported(function.__code__.co_filename)
    compiled: Any = dispatcher
    stored = compiled._cache._cache_file
    stored._source_stamp = (stored._source_stamp, tuple(_digest(file) for file in sorted(files)))
    load_index = stored._load_index

    def load_readable_index() -> Any:
        # An index refers to the classes of arguments; one that was renamed since cannot be read.
        try:
            return load_index()
        except (AttributeError, ImportError, EOFError, pickle.UnpicklingError):
            return {}

    stored._load_index = load_readable_index
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


def _files_imported(file: str) -> set[str]:
    """Return the files of this package that ``file`` imports, directly or indirectly."""
    files: set[str] = set()
    waiting = [file]
    while waiting:
        for found in _direct_imports(waiting.pop()):
            if found not in files:
                files.add(found)
                waiting.append(found)
    return files


@cache
def _direct_imports(file: str) -> tuple[str, ...]:
    """Return the files of the modules of this package that are named in imports of ``file``."""
    names = re.findall(r"^from (physion[\w.]*) import", Path(file).read_text(), re.MULTILINE)
    modules = [sys.modules.get(name) for name in names]
    return tuple(m.__file__ for m in modules if m is not None and m.__file__ is not None)


@cache
def _digest(file: str) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()
