"""What a model may see: batches and clips of trials.

``physion.clips(dataset, ...)`` returns the clips of a dataset: see `physion.clips.clips.clips`. The
name stands for the function and for this package, so that the package can be called.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _CallableModule(ModuleType):
    def __call__(self, *args: Any, **options: Any) -> Any:
        """Return clips of a dataset; see `physion.clips.clips.clips`."""
        from physion.clips.clips import clips

        return clips(*args, **options)


sys.modules[__name__].__class__ = _CallableModule
