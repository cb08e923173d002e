"""What the code of a model raised, in one line. This module does not import torch."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path

from physion.errors import BadInputError, PhysionError

_MEMORY_TEXTS = ("out of memory", "can't allocate memory", "not enough memory", "alloc_failed")
"""Parts of the messages by which torch reports that memory is used up; cuBLAS and cuDNN write the
last one."""


class OutOfMemoryError(PhysionError):
    """Error for a model that needs more memory than there is."""


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an exception of numpy or torch says that memory is used up."""
    torch = sys.modules.get("torch")
    if isinstance(error, MemoryError) or (torch and isinstance(error, torch.OutOfMemoryError)):
        return True
    text = str(error).lower()
    return isinstance(error, RuntimeError) and any(part in text for part in _MEMORY_TEXTS)


def describe_raised(error: Exception, model: str, method: str) -> BadInputError:
    """Return the error that names model, method, and the line that raised ``error``."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return BadInputError(
        f"model {model!r}: {method} raised {type(error).__name__}: {' '.join(str(error).split())} "
        f"({Path(last.filename).name}, line {last.lineno})"
    )
