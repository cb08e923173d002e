"""Atomic creation of an export folder, which replaces an older export but nothing else."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError
from physion.core.files import folder_lock, sync_folder

MANIFEST = "export.json"
FORMAT = "physion experiment export"
_SECRET = 0o700
"""Mode of the folder: other users of the machine must not read the answers."""


@contextlib.contextmanager
def atomic_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder, which is renamed to ``out`` when everything is on disk.

    The caller must finish with `write_manifest`. An existing ``out`` is replaced if it is empty or
    an unchanged export; otherwise `BadInputError` is raised.
    """
    out = Path(os.path.abspath(out))  # noqa: PTH100 - resolve() would follow a link
    out.parent.mkdir(parents=True, exist_ok=True)
    part, old = (out.with_name(f".{out.name}.{ending}") for ending in ("part", "old"))
    for path in (part, old):
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise BadInputError(f"{path} is a link or not a folder; remove it")
    part.mkdir(mode=_SECRET, exist_ok=True)
    with folder_lock(part):
        _tidy(out, old)
        _refuse_others(out)
        _empty(part)
        try:
            yield part
            _sync_all(part)
            _swap(part, out, old)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise


def write_manifest(folder: Path, facts: dict[str, Any]) -> None:
    """Write `MANIFEST` with ``facts`` and a summary of the files; must be called last."""
    manifest = {"format": FORMAT, **facts, **_contents(folder)}
    text = json.dumps(manifest, indent=2, ensure_ascii=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")


def _contents(folder: Path) -> dict[str, Any]:
    """Return the number of files and folders besides the manifest, and a hash of their names."""
    names = []
    for at, folders, files in os.walk(folder):
        inside = Path(at).relative_to(folder)
        names += [(inside / name).as_posix() for name in (*folders, *files)]
    ours = sorted(name for name in names if name not in (MANIFEST, ".lock"))
    hashed = hashlib.sha256("\n".join(ours).encode("utf-8", "surrogateescape")).hexdigest()
    return {"entries": len(ours), "names_sha256": hashed}


def _refuse_others(out: Path) -> None:
    """Raise `BadInputError` if replacing ``out`` would delete anything but an export."""
    if not out.is_symlink() and not out.exists():
        return
    if out.is_symlink() or not out.is_dir():
        raise BadInputError(f"{out} is not a folder; choose another one with --out")
    if not any(out.iterdir()):
        return
    try:
        manifest = json.loads((out / MANIFEST).read_bytes())
        ours = isinstance(manifest, dict) and manifest.get("format") == FORMAT
    except (OSError, ValueError, RecursionError):
        ours = False
    if not ours:
        raise BadInputError(f"{out} contains something else; choose another folder with --out")
    if any(manifest.get(name) != value for name, value in _contents(out).items()):
        raise BadInputError(
            f"{out} is an export to which files were added, or of which some are missing; move "
            "your files elsewhere, or choose another folder with --out"
        )


def _tidy(out: Path, old: Path) -> None:
    """Restore or remove the old folder that an export left when killed during the swap."""
    if not old.exists():
        return
    if out.exists():
        shutil.rmtree(old)
    else:
        old.rename(out)


def _empty(folder: Path) -> None:
    """Delete the content of a folder except its lock."""
    for entry in folder.iterdir():
        if entry.name == ".lock":
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def _sync_all(folder: Path) -> None:
    """Flush all files to disk, with one system call, since 10,000 single ones would be slow."""
    if hasattr(os, "sync"):
        os.sync()
        return
    for path in folder.rglob("*"):  # pragma: no cover - Windows
        if path.is_file():
            with path.open("rb+") as file:
                os.fsync(file.fileno())


def _swap(part: Path, out: Path, old: Path) -> None:
    """Rename ``part`` to ``out``; an existing ``out`` is moved to ``old`` and then deleted."""
    (part / ".lock").unlink(missing_ok=True)
    replaces = out.exists()
    if replaces:
        out.rename(old)
    try:
        part.rename(out)
    except BaseException:
        if replaces:
            old.rename(out)
        raise
    sync_folder(out.parent)
    if replaces:
        shutil.rmtree(old)
