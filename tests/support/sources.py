"""Sources of the package as syntax trees, parsed once for all tests of a process."""

from __future__ import annotations

import ast
import functools
from pathlib import Path


@functools.cache
def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a file, which no test may change."""
    return ast.parse(path.read_text(encoding="utf-8"))
