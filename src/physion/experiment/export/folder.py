"""A folder of exported files that is there whole or not at all, and replaces only its own kind."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from physion.atomic import folder_lock, sync_folder
from physion.errors import BadInputError

MANIFEST = "export.json"
FORMAT = "physion experiment export"
_SECRET = 0o700
"""Others on the machine do not read what people answered."""


@contextlib.contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """A folder to write into, which becomes ``out`` once all is on the disk.

    What is written must hold `MANIFEST` by `write_manifest`. An ``out`` that is there is replaced
    where it is an export that nobody added anything to, or empty; `BadInputError` otherwise.
    """
    out = Path(os.path.abspath(out))  # noqa: PTH100 - resolve() would follow a link
    out.parent.mkdir(parents=True, exist_ok=True)
    part, old = (out.with_name(f".{out.name}.{ending}") for ending in ("part", "old"))
    for path in (part, old):
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise BadInputError(f"{path} is in the way; take it away")
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
    """Write `MANIFEST`: ``facts`` and which files there are. It is written last."""
    manifest = {"format": FORMAT, **facts, **_contents(folder)}
    text = json.dumps(manifest, indent=2, ensure_ascii=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")


def _contents(folder: Path) -> dict[str, Any]:
    """How many files and folders there are but the manifest, and a hash of their names."""
    names = []
    for at, folders, files in os.walk(folder):
        inside = Path(at).relative_to(folder)
        names += [(inside / name).as_posix() for name in (*folders, *files)]
    ours = sorted(name for name in names if name not in (MANIFEST, ".lock"))
    hashed = hashlib.sha256("\n".join(ours).encode("utf-8", "surrogateescape")).hexdigest()
    return {"entries": len(ours), "names_sha256": hashed}


def _refuse_others(out: Path) -> None:
    """`BadInputError` where replacing ``out`` would delete what is not ours."""
    if not out.is_symlink() and not out.exists():
        return
    if out.is_symlink() or not out.is_dir():
        raise BadInputError(f"{out} is no folder; choose another one with --out")
    if not any(out.iterdir()):
        return
    try:
        manifest = json.loads((out / MANIFEST).read_bytes())
        ours = isinstance(manifest, dict) and manifest.get("format") == FORMAT
    except (OSError, ValueError, RecursionError):
        ours = False
    if not ours:
        raise BadInputError(f"{out} holds something else; choose another folder with --out")
    found = _contents(out)
    if any(manifest.get(name) != value for name, value in found.items()):
        raise BadInputError(
            f"{out} is an export to which files were added, or of which some are missing; move "
            "your own away, or choose another folder with --out"
        )


def _tidy(out: Path, old: Path) -> None:
    """Undo what an export that was killed while it swapped folders has left."""
    if not old.exists():
        return
    if out.exists():
        shutil.rmtree(old)
    else:
        old.rename(out)


def _empty(folder: Path) -> None:
    for entry in folder.iterdir():
        if entry.name == ".lock":
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def _sync_all(folder: Path) -> None:
    """Bring everything to the disk: at once, since a call for each of 10,000 files takes long."""
    if hasattr(os, "sync"):
        os.sync()
        return
    for path in folder.rglob("*"):  # pragma: no cover - Windows
        if path.is_file():
            with path.open("rb+") as file:
                os.fsync(file.fileno())


def _swap(part: Path, out: Path, old: Path) -> None:
    (part / ".lock").unlink(missing_ok=True)
    there = out.exists()
    if there:
        out.rename(old)
    try:
        part.rename(out)
    except BaseException:
        if there:
            old.rename(out)
        raise
    sync_folder(out.parent)
    if there:
        shutil.rmtree(old)
