"""How the loops of this package are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile ``function`` with numba on its first call, and keep the machine code on disk.

    One thread, and no reordering of sums (no ``fastmath``): equal input gives equal bytes.
    ``error_model="numpy"`` lets a division by zero give infinity, which the callers check.
    """
    compiled = numba.njit(cache=True, error_model="numpy", nogil=True)(function)
    return cast(Function, compiled)
