"""Record of a finished run, by which the same command knows that there is nothing to do."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import physion
from physion.core.errors import BadInputError
from physion.core.files import file_sha256, read_sealed, write_sealed

if TYPE_CHECKING:
    from physion.cli.run.options import Options

RECORD = "run.json"
_NOT_COMPARED = ("workers", "json", "encoder_batch")
"""Options that change no result."""


def finished(options: Options, folder: Path) -> dict[str, Any] | None:
    """Return the answer of a finished run; None if options, code or a result have changed.

    Files are compared by their checksums, so that a report that was deleted, or predictions that
    were changed, are made again. Movies are not read: `physion verify` checks them.
    """
    try:
        record = read_sealed(folder / RECORD)
        if record["inputs"] != _inputs(options):
            return None
        if any(file_sha256(folder / name) != digest for name, digest in record["files"].items()):
            return None
        answer: dict[str, Any] = record["answer"]
    except (BadInputError, OSError, KeyError, TypeError, AttributeError):
        return None
    return answer


def record_finished(
    options: Options, folder: Path, files: list[Path], answer: dict[str, Any]
) -> None:
    """Write down options, code and results of a run without failures."""
    digests = {path.relative_to(folder).as_posix(): file_sha256(path) for path in files}
    record = {"inputs": _inputs(options), "files": digests, "answer": answer}
    write_sealed(folder / RECORD, record)


def _inputs(options: Options) -> str:
    """Return the SHA-256 of options, people's answers, and every file of this package."""
    settings = {k: str(v) for k, v in dataclasses.asdict(options).items() if k not in _NOT_COMPARED}
    sha = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    package = Path(physion.__file__).parent
    folders = [package, *(path for path in (options.scenes, options.humans) if path is not None)]
    for folder in folders:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            if "__pycache__" not in path.parts:
                sha.update(f"{path.relative_to(folder)} {file_sha256(path)}".encode())
    return sha.hexdigest()
