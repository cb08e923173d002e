"""Atomic writing of files, and locks on folders."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from physion.errors import BadInputError, PhysionError

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows
    fcntl = None  # type: ignore[assignment]

PART_SUFFIX = ".part"
"""Suffix of files that are still being written."""


def write_atomic(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write ``data`` to ``path`` such that no reader sees a partial file, even after a crash.

    The bytes are written to a temporary file in the same folder and synced to disk; then the
    temporary file is renamed to ``path``. Its name is unique, so concurrent writers of one path do
    not interfere.

    Parameters
    ----------
    path
        File to write or replace.
    data
        Content.
    mode
        Permissions from creation on, reduced by the umask; 0o600 for secrets.

    Raises
    ------
    OSError
        If writing fails (disk full, no permission, ...); the temporary file is removed.
    """
    # Short and independent of `path`: extending a long file name could exceed the system's limit.
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
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            # That of a failed write names no file, that of others the temporary one.
            error.filename, error.filename2 = str(path), None
        raise
    sync_folder(path.parent)


def remove_leftovers(folder: Path) -> int:
    """Delete temporary files of interrupted writers under ``folder``; return their number.

    The caller must hold the lock of the folder: temporary files of running writers would be
    deleted too.
    """
    leftovers = list(folder.rglob(f".*{PART_SUFFIX}"))
    for part in leftovers:
        part.unlink(missing_ok=True)
    return len(leftovers)


def sync_folder(folder: Path) -> None:
    """Sync a folder to disk so that a renaming survives a power failure; only on POSIX systems."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold an exclusive lock on ``folder`` among the processes of this machine.

    Raises `PhysionError` at once if another process holds it. The operating system releases the
    lock when its holder ends, so a killed process needs no cleaning up.
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
        # The previous holder may have deleted the file after it was opened here.
        if _is_same_file(path, descriptor):
            break
        os.close(descriptor)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


@contextlib.contextmanager
def folder_for_writing(folder: Path) -> Iterator[None]:
    """Create ``folder`` if it is missing, and hold its lock while files are written into it.

    Raises `BadInputError` in place of an `OSError` of the block, and `PhysionError` as
    `folder_lock`.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with folder_lock(folder):
            yield
    except OSError as error:
        raise BadInputError(f"cannot write into {folder}: {error.strerror or error}") from error


def _is_same_file(path: Path, descriptor: int) -> bool:
    """Return whether ``path`` is the open file with this descriptor."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
