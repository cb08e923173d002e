"""Files: atomic writing, locks of folders, digest files, and safe reading."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError, PhysionError

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
            # The error of a failed write names no file, other errors the temporary one.
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

    Raises `BadInputError` for a file in place of a folder and for an `OSError` of the block, and
    `PhysionError` as `folder_lock`.
    """
    if folder.is_file():
        raise BadInputError(f"{folder} is a file; give a folder to write into")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with folder_lock(folder):
            yield
    except OSError as error:
        raise BadInputError(f"cannot write into {folder}: {error.strerror or error}") from error


@contextlib.contextmanager
def new_folder(folder: Path, mode: int = 0o777) -> Iterator[Path]:
    """Yield an empty folder that is renamed to ``folder`` when the block is done and on disk.

    An existing ``folder`` is replaced: the caller checks before that nothing in it is lost. After
    an error, and after a kill with the next call, all is as it was.

    Parameters
    ----------
    folder
        Folder to make or replace.
    mode
        Permissions, reduced by the umask; 0o700 for what other users must not read.
    """
    folder = Path(os.path.abspath(folder))  # noqa: PTH100 - resolve() would follow a link
    folder.parent.mkdir(parents=True, exist_ok=True)
    part, old = (folder.with_name(f".{folder.name}{end}") for end in (PART_SUFFIX, ".old"))
    for path in (part, old):
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise BadInputError(f"{path} is a link or not a folder; remove it")
    part.mkdir(mode=mode, exist_ok=True)
    with folder_lock(part):
        # An earlier call may have been killed while it wrote, or between the renamings.
        for path in part.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            elif path.name != ".lock":
                path.unlink()
        if old.exists() and not folder.exists():
            old.rename(folder)
        elif old.exists():
            shutil.rmtree(old)
        try:
            yield part
            _sync_all(part)
            (part / ".lock").unlink(missing_ok=True)
            if folder.exists():
                folder.rename(old)
            try:
                part.rename(folder)
            except BaseException:
                if old.exists():
                    old.rename(folder)
                raise
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
        sync_folder(folder.parent)
        if old.exists():
            shutil.rmtree(old)


def _sync_all(folder: Path) -> None:
    """Flush all files to disk, with one system call, since 10,000 single ones would be slow."""
    if hasattr(os, "sync"):
        os.sync()
        return
    for path in folder.rglob("*"):  # pragma: no cover - Windows
        if path.is_file():
            with path.open("rb+") as file:
                os.fsync(file.fileno())


def _is_same_file(path: Path, descriptor: int) -> bool:
    """Return whether ``path`` is the open file with this descriptor."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


# SHA-256 of files: how it is computed, stored in a digest file, and checked.
#
# A digest file ``NAME.sha256`` lies next to what people exchange or keep: the index, predictions,
# weights, official data. Its one line is what ``sha256sum --check`` reads. Trial files hold
# their SHA-256 in their own header (`physion.trials.trial_file`).

SUFFIX = ".sha256"
"""Ending of a digest file, after the whole name of its file."""


def digest_of(data: bytes | str) -> str:
    """Return the hexadecimal SHA-256 of bytes, or of a text in UTF-8."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()


def file_sha256(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file; `OSError` if it cannot be read."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_digest(values: Any, parts: Iterable[bytes] = ()) -> str:
    """Return the hexadecimal SHA-256 of JSON values, whatever the order of keys, and of bytes."""
    sha = hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode())
    for part in parts:
        sha.update(part)
    return sha.hexdigest()


def write_with_digest(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path``, and its digest file, each atomically.

    A process that is killed in between leaves a file without digest file, never one with another
    content's digest file.
    """
    digest = digest_path(path)
    digest.unlink(missing_ok=True)
    write_atomic(path, content)
    line = f"{digest_of(content)}  {path.name}\n"
    write_atomic(digest, line.encode())


def digest_path(path: Path) -> Path:
    """Return the path of the digest file of ``path``."""
    return path.with_name(path.name + SUFFIX)


def has_digest(path: Path) -> bool:
    """Return whether a file has a digest file, right or wrong."""
    return digest_path(path).is_file()


def is_whole(path: Path) -> bool:
    """Return whether a file exists with exactly the bytes that `write_with_digest` wrote."""
    try:
        return _stored(path) == file_sha256(path)
    except (OSError, UnicodeDecodeError):
        return False


def check_digest(path: Path, content: bytes, advice: str) -> None:
    """Raise `BadInputError` if ``path`` has a digest file that is not of ``content``.

    A file without digest file is accepted: it was written by an earlier version or another program.
    ``advice`` says what to do.
    """
    if not has_digest(path):
        return
    try:
        stored = _stored(path)
    except (OSError, UnicodeDecodeError):
        stored = ""
    if stored != digest_of(content):
        raise BadInputError(
            f"{path} was changed since it was written: its SHA-256 is not the one in "
            f"{digest_path(path).name}; {advice}"
        )


def _stored(path: Path) -> str:
    return digest_path(path).read_text(encoding="utf-8").partition(" ")[0]


# Safe reading of files that somebody else may have put there: regular files of limited size.

MAX_IDS_BYTES = 10_000_000


def read_plain(path: Path, limit: int, *, follow_links: bool = False) -> bytes:
    """Read a regular file of at most ``limit`` bytes.

    Raises `BadInputError` if the file is missing, is larger, or is a folder or a pipe, or a link
    unless ``follow_links`` is set.
    """
    no_links = 0 if follow_links else getattr(os, "O_NOFOLLOW", 0)
    try:
        # Non-blocking, so that a pipe does not hang; the type is checked on the open descriptor,
        # so that the file cannot be replaced between check and read.
        flags = os.O_RDONLY | no_links | getattr(os, "O_NONBLOCK", 0)
        descriptor = os.open(path, flags | getattr(os, "O_BINARY", 0))
    except FileNotFoundError:
        raise BadInputError(f"{path} is missing") from None
    except OSError as error:
        raise BadInputError(_describe_error(path, error, follow_links)) from error
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise BadInputError(f"{path} is not a regular file")
        if status.st_size > limit:
            raise BadInputError(f"{path} has {status.st_size} bytes, more than {limit}")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            # Memory for as many bytes as are asked for is allocated before they are read.
            content = file.read(status.st_size + 1)
    except OSError as error:
        raise BadInputError(_describe_error(path, error, follow_links)) from error
    finally:
        os.close(descriptor)
    if len(content) > status.st_size:
        raise BadInputError(f"{path} grew while it was read; try again when it is complete")
    return content


def check_plain(path: Path) -> None:
    """Raise `BadInputError` unless ``path`` is a regular file and not a link."""
    try:
        status = path.lstat()
    except OSError as error:
        raise BadInputError(_describe_error(path, error, False)) from error
    if not stat.S_ISREG(status.st_mode):
        raise BadInputError(f"{path} is not a regular file; links are not followed")


def _describe_error(path: Path, error: OSError, follow_links: bool) -> str:
    """Return the message for a file that cannot be opened."""
    if path.is_symlink() and not follow_links:
        return f"{path} is a link; links are not followed, replace it by the file itself"
    if isinstance(error, FileNotFoundError):
        return f"{path} is missing"
    return f"{path} cannot be read: {error.strerror}"


def read_ids(path: Path) -> frozenset[str]:
    """Read a text file with one id a line; `BadInputError` if it has none or cannot be read."""
    try:
        lines = read_plain(path, MAX_IDS_BYTES).decode().splitlines()
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path}: not a text file in UTF-8") from error
    ids = frozenset(filter(None, (line.strip() for line in lines)))
    if not ids:
        raise BadInputError(f"{path} has no id; write one a line")
    return ids
