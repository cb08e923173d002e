"""Machine code on disk is discarded when a kernel that it calls has changed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

INNER = """
from physion.numerics.kernel import kernel

@kernel
def inner(x):
    return x + {number}
"""
OUTER = """
from inner import inner
from physion.numerics.kernel import kernel

@kernel
def middle(x):
    return inner(x)

@kernel
def outer(x):
    return 2 * middle(x)

print(outer(1), sum(outer.stats.cache_hits.values()))
"""


def test_a_changed_callee_in_another_file_is_compiled_again(tmp_path: Path) -> None:
    (tmp_path / "outer.py").write_text(OUTER)
    printed = []
    for number in (1, 1, 5):
        (tmp_path / "inner.py").write_text(INNER.format(number=number))
        env = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": str(tmp_path)}
        done = subprocess.run(
            [sys.executable, "-c", "import outer"],
            env=env,
            capture_output=True,
            text=True,
            check=True,
        )
        printed.append(done.stdout.strip())
    # (result, read from disk)
    assert printed == ["4 0", "4 1", "12 0"]


RECORD = """
from typing import NamedTuple
from physion.numerics.kernel import kernel

class {name}(NamedTuple):
    x: float

@kernel
def read(record):
    return record.x

print(read({name}(3.0)))
"""


def test_an_index_that_names_a_renamed_class_is_compiled_again(tmp_path: Path) -> None:
    env = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": str(tmp_path)}
    for name in ("Before", "After"):
        (tmp_path / "record.py").write_text(RECORD.format(name=name))
        done = subprocess.run(
            [sys.executable, "-c", "import record"],
            env=env,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.stdout.strip() == "3.0", done.stderr
