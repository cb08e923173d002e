"""Machine code on disk is that of the present sources of a kernel and of all that it calls."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from physion.numerics.kernel import _StampedFiles

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


@pytest.mark.slow
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


CONSTANTS = """
from physion.numerics.kernel import kernel

@kernel
def added(x, y):
    return x + y

@kernel
def total(x):
    return added(x, 1) + added(x, 2) + added(1, x)

print(total(5), len(added.signatures))
"""


@pytest.mark.slow
def test_constants_in_calls_compile_a_kernel_once(tmp_path: Path) -> None:
    (tmp_path / "constants.py").write_text(CONSTANTS)
    command = [sys.executable, "-c", "import constants"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["19", "1"]


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


@pytest.mark.nightly
@pytest.mark.slow
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


STEP = """
import os, sys
from physion.numerics.kernel import kernel

if sys.argv[1:]:
    # The process is killed after the given number of files of the cache was written.
    left = int(sys.argv[1])
    replace = os.replace
    def replace_and_die(source, target):
        global left
        left -= 1
        replace(source, target)
        if left == 0:
            os._exit(9)
    os.replace = replace_and_die

@kernel
def step(x):
    return x + {number}

print(step(1), sum(step.stats.cache_hits.values()))
"""


def _run_step(folder: Path, number: int, killed_after: int | None = None) -> str:
    """Run the kernel `step` that adds ``number``; return its result and reads from disk."""
    (folder / "step.py").write_text(STEP.format(number=number))
    arguments = [] if killed_after is None else [str(killed_after)]
    done = subprocess.run(
        [sys.executable, str(folder / "step.py"), *arguments],
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == (0 if killed_after is None else 9), done.stderr
    return done.stdout.strip()


@pytest.mark.nightly
@pytest.mark.slow
def test_code_of_equal_sources_is_read_in_another_folder(tmp_path: Path) -> None:
    (tmp_path / "first").mkdir()
    assert _run_step(tmp_path / "first", 1) == "2 0"
    shutil.copytree(tmp_path / "first", tmp_path / "second", copy_function=shutil.copyfile)
    assert _run_step(tmp_path / "second", 1) == "2 1"


def _cache_files(folder: Path) -> set[str]:
    return {path.name for path in (folder / "__pycache__").iterdir() if path.name[:5] == "step."}


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("files", [1, 2])
def test_a_worker_killed_between_two_files_leaves_no_older_code(tmp_path: Path, files: int) -> None:
    assert _run_step(tmp_path, 1) == "2 0"
    _run_step(tmp_path, 5, killed_after=files)
    # The index is the last file, so the code is found exactly if it was written.
    assert _run_step(tmp_path, 5) == f"6 {files - 1}"
    assert _run_step(tmp_path, 5) == "6 1"


@pytest.mark.nightly
@pytest.mark.slow
def test_an_older_worker_that_ends_later_leaves_no_older_code(tmp_path: Path) -> None:
    """Numba's own files have one name for all sources, so the last writer would win."""
    assert _run_step(tmp_path, 1) == "2 0"
    older = {
        name: (tmp_path / "__pycache__" / name).read_bytes() for name in _cache_files(tmp_path)
    }
    assert _run_step(tmp_path, 5) == "6 0"
    newer = _cache_files(tmp_path)
    assert len(newer) == len(older) == 2 and not newer & set(older)
    for name, content in older.items():
        (tmp_path / "__pycache__" / name).write_bytes(content)
    assert _run_step(tmp_path, 5) == "6 1"
    assert _run_step(tmp_path, 1) == "2 1"


@pytest.mark.nightly
@pytest.mark.slow
def test_files_of_older_sources_are_deleted(tmp_path: Path) -> None:
    _run_step(tmp_path, 1)
    folder = tmp_path / "__pycache__"
    python = f"py{sys.version_info[0]}{sys.version_info[1]}{sys.abiflags}"
    older = [f"step.step-3.{python}.nbi", f"step.step-3.{python}.1.nbc"]
    others = [f"step.other-3.{python}.nbi", "step.step-3.py30.nbi", "steps.step-3.nbi"]
    for name in (*older, *others):
        (folder / name).write_bytes(b"")
    before = _cache_files(tmp_path)
    _run_step(tmp_path, 5)
    after = _cache_files(tmp_path)
    assert after & before == {others[0], others[1]} and (folder / others[2]).exists()
    assert len(after - before) == 2


def test_each_type_of_argument_has_its_own_code(tmp_path: Path) -> None:
    """Two workers that compile for two types at once both begin with an empty index."""
    pair = _StampedFiles(str(tmp_path), "step.step-3.py311", ("source",))
    pair.save("whole", b"code for whole numbers")
    (index,) = tmp_path.glob("*.nbi")
    index.unlink()
    pair.save("float", b"code for floats")
    assert pair.load("whole") is None and pair.load("float") == b"code for floats"
    pair.save("whole", b"code for whole numbers")
    assert pair.load("whole") == b"code for whole numbers"
    assert pair.load("float") == b"code for floats"
