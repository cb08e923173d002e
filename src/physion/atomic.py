"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from physion.errors import PhysionError

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows
    fcntl = None  # type: ignore[assignment]

PART_SUFFIX = ".part"
"""How the name of a file that is still being written ends."""


def write_atomic(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write ``data`` to ``path`` so that no reader ever sees a part of it, not even after a crash.

    The bytes go to a temporary name in the same folder, to the disk, and only then take the
    place of ``path``. The temporary name belongs to this call alone, so that two writers of one
    path do not meet. ``mode`` holds from the first byte on (less the process's umask): 0o600 for
    secrets. Raises ``OSError`` (disk full, no permission, ...) with nothing left behind.
    """
    # A short name of its own: adding to a long file name could pass the system's limit.
    part = path.with_name(f".{os.getpid()}-{secrets.token_hex(8)}{PART_SUFFIX}")
    try:
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        try:
            view = memoryview(data)
            while len(view) > 0:
                view = view[os.write(descriptor, view) :]
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        os.replace(part, path)  # noqa: PTH105 - the plain call is what a test can make fail
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def remove_leftovers(folder: Path) -> int:
    """Delete what killed writers left under ``folder``; the count of deleted files.

    Only for the one process that has the folder to itself: it would take away the temporary
    files of writers that are still alive.
    """
    leftovers = list(folder.rglob(f".*{PART_SUFFIX}"))
    for part in leftovers:
        part.unlink(missing_ok=True)
    return len(leftovers)


def sync_folder(folder: Path) -> None:
    """Make the renaming itself survive a power cut, where the system can sync a folder."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Have ``folder`` to oneself among the processes of this machine that ask for it too.

    Raises `PhysionError` at once where another one has it. The system gives the lock back when
    its holder dies, so a killed process leaves nothing to clean up.
    """
    if fcntl is None:  # pragma: no cover - no such locks on this system
        yield
        return
    path = folder / ".lock"
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise PhysionError(
                f"another process is writing into {folder}; wait for it, or choose another folder"
            ) from None
        # The holder before may have deleted the file between our opening and our locking it.
        if _same(path, descriptor):
            break
        os.close(descriptor)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def _same(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
