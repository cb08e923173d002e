"""Decorator that compiles the numerical loops of this package."""

# Numba's classes have no annotations of types.
# mypy: allow-untyped-calls

from __future__ import annotations

import contextlib
import hashlib
import pickle
import re
import sys
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

Function = TypeVar("Function", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
"""No kernel needs the wrapper for calls from C, which takes long to compile."""
IN_PLACE_OPTIONS: dict[str, Any] = {**OPTIONS, "_nrt": False}


def kernel(function: Function) -> Function:
    """Compile ``function`` with numba on its first call and cache the machine code on disk.

    One thread, no ``fastmath``: the order of all operations is that of the source, so equal input
    gives equal bytes on every processor. ``error_model="numpy"`` lets a division by zero give
    infinity or NaN. The cached machine code is discarded when the file of the kernel, of any
    kernel that it calls, or of any module of this package that it imports has changed.
    """
    return _compiled(function, OPTIONS)


def in_place_kernel(function: Function) -> Function:
    """Compile a function that makes no arrays, and calls only such kernels; see `kernel`.

    It works on arrays of its caller. Numba counts references to every array that a function
    touches, with atomic operations that cost more than short loops; here it does not. A function
    that makes an array does not compile.
    """
    return _compiled(function, IN_PLACE_OPTIONS)


def _compiled(function: Function, options: dict[str, Any]) -> Function:
    """Return the compiled function with a cache on disk."""
    dispatcher: Any = numba.njit(**options)(function)
    if not isinstance(dispatcher, Dispatcher):
        return function  # NUMBA_DISABLE_JIT is set: nothing is compiled
    compiled: Any = dispatcher
    compiled._cache = _KernelCache(function)
    compiled.get_call_template = partial(_call_template, compiled)
    return cast("Function", dispatcher)


def _call_template(dispatcher: Any, args: Any, kwargs: Any) -> Any:
    """Return how another kernel calls ``dispatcher``, the same for all values of an argument.

    Numba would compile a kernel again for each constant in a call: six times for six numbers.
    """
    args = tuple(types.unliteral(arg) for arg in args)
    kwargs = {name: types.unliteral(arg) for name, arg in kwargs.items()}
    return type(dispatcher).get_call_template(dispatcher, args, kwargs)


class _KernelCache(FunctionCache):
    """Cache of a kernel whose files are named after all sources of its machine code."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        # Numba looks only at time and size of the kernel's own file. Here it is the content that
        # counts, also that of the kernels that it calls, and of the constants and records that it
        # imports.
        own = function.__code__.co_filename
        files = {own, *_files_called(function)} | _files_imported(own)
        sources = (numba.__version__, *sorted(_digest(file) for file in files))
        self._cache_file = _StampedFiles(self._cache_path, self._impl.filename_base, sources)


class _StampedFiles(IndexDataCacheFile):
    """Index and data files of one kernel, with a digest of its sources in their names.

    Numba numbers the data files from 1 and writes the index first. After a kill between the two,
    or with two workers, its new index can name a data file that holds machine code of an older
    source or of other argument types. Here names contain the digests of sources and of the data,
    and the index comes last, so an index can name nothing but the data that it was written for.
    """

    def __init__(self, folder: str, base: str, sources: tuple[object, ...]) -> None:
        self._stamp = hashlib.sha256(repr(sources).encode()).hexdigest()[:16]
        self._base = base
        super().__init__(folder, f"{base}.{self._stamp}", self._stamp)

    def save(self, key: Any, data: Any) -> None:
        """Write ``data`` and then the index, and delete the files of other sources."""
        digest = hashlib.sha256(self._dump((key, data))).hexdigest()[:16]
        name = f"{self._base}.{self._stamp}.{digest}.nbc"
        self._save_data(name, data)
        self._save_index({**self._load_index(), key: name})
        self._delete_outdated()

    def _load_index(self) -> dict[Any, str]:
        # An index refers to the classes of arguments; one that was renamed since cannot be read.
        try:
            return cast("dict[Any, str]", super()._load_index())
        except (AttributeError, ImportError, EOFError, pickle.UnpicklingError):
            return {}

    def _delete_outdated(self) -> None:
        """Delete the files of this kernel that are not of these sources, at whatever line."""
        kernel_name, _, rest = self._base.rpartition("-")
        python = rest.partition(".")[2]
        own = re.compile(rf"{re.escape(kernel_name)}-\w+\.{re.escape(python)}(\.\w+)*\.nb[ic]")
        for path in Path(self._cache_path).iterdir():
            if own.fullmatch(path.name) and f".{self._stamp}." not in path.name:
                # Another worker may have deleted it, or on Windows have it open.
                with contextlib.suppress(OSError):
                    path.unlink()


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
