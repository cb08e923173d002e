"""How the loops of this package are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


njit: Any = numba.njit
OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}


def kernel(function: Function) -> Function:
    """Compile ``function`` with numba on its first call, and keep the machine code on disk.

    One thread, and no reordering of sums (no ``fastmath``): equal input gives equal bytes.
    ``error_model="numpy"`` lets a division by zero give infinity, which the callers check.
    """
    return cast(Function, njit(cache=True, **OPTIONS)(function))


def step(function: Function) -> Function:
    """Compile a part of a kernel: only kernels of the same file may call it.

    Numba looks at a kernel's own file alone when it asks whether the code on disk is outdated.
    """
    return cast(Function, njit(no_cpython_wrapper=True, **OPTIONS)(function))
