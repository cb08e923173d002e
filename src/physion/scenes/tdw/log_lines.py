"""Reading of command logs: lines are grouped by trial, and errors are reported with their line."""

from __future__ import annotations

import gzip
import json
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from physion.errors import BadInputError
from physion.plain_files import read_plain

Command: TypeAlias = dict[str, Any]

MAX_LOG_BYTES = 1 << 27
"""Largest size of an uncompressed log, and of metadata; the largest official one has a few MB."""
MAX_LINE_BYTES = 1 << 24
"""Longest line of a log that is decompressed; its parsed commands take some hundred MB."""


@dataclass(frozen=True)
class ImportFailure:
    """Trial that could not be imported, with file, trial (None for all of the file) and reason."""

    file: str
    trial: str | None
    message: str

    def __str__(self) -> str:
        where = self.file if self.trial is None else f"{self.file}, trial {self.trial}"
        return f"{where}: {self.message}"


@dataclass
class CommandLog:
    """Content of a command log.

    - ``setup``: commands before the first trial.
    - ``trials``: by trial tag, the (line number, commands) of every frame.
    - ``failures``: trials with a broken line; they are not in ``trials``.
    """

    setup: list[Command] = field(default_factory=list)
    trials: dict[str, list[tuple[int, list[Command]]]] = field(default_factory=dict)
    failures: list[ImportFailure] = field(default_factory=list)


def find_logs(root: Path) -> list[Path]:
    """Return all command logs in the folder ``root``, sorted by path."""
    if not root.exists():
        raise BadInputError(
            f"{root} does not exist; give official (the packaged scenes), a folder that "
            "physion import-official made, or one with official command logs"
        )
    if not root.is_dir():
        raise BadInputError(f"{root} is a file; give the folder that holds the command logs")
    found = [*root.rglob("tdw_commands.json"), *root.rglob("tdw_commands.json.gz")]
    logs = sorted(path for path in found if path.is_file())
    if not logs:
        raise BadInputError(f"{root} holds no tdw_commands.json or tdw_commands.json.gz")
    return logs


def read_metadata(path: Path) -> dict[str, dict[str, Any]]:
    """Read the records of ``metadata.json`` by trial number (as text).

    The number is the end of the stimulus name (``..._0012`` is trial 12), or the index of the
    record in the file if the name has none.
    """
    try:
        data = json.loads(read_plain(path, MAX_LOG_BYTES, follow_links=True).decode())
    except BadInputError:
        if not path.exists():
            raise BadInputError(f"{path} is missing; it holds the outcomes of the trials") from None
        raise
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{path} cannot be read: {error}") from error
    if not isinstance(data, list) or not all(isinstance(record, dict) for record in data):
        raise BadInputError(f"{path} must be a list with one object per trial")
    records = {}
    for position, record in enumerate(data):
        match = re.search(r"_(\d{4,})$", str(record.get("stimulus_name")))
        records[str(int(match.group(1)) if match else position)] = record
    return records


def read_command_log(path: Path) -> CommandLog:
    """Read a log, compressed or not; `BadInputError` if it cannot be read to its end."""
    log, broken, last = CommandLog(), set(), ""
    try:
        for number, line in enumerate(_lines(path), 1):
            if not line.strip():
                continue
            # A line whose end is missing belongs to the same trial as the line before.
            tag = _tag(line) or last
            last = tag
            try:
                commands = _parse_line(line)
            except BadInputError as error:
                broken.add(tag)
                message = f"line {number}: {error}"
                log.failures.append(ImportFailure(str(path), tag or None, message))
                continue
            if tag == "None":
                log.setup += commands
            else:
                log.trials.setdefault(tag, []).append((number, commands))
    except (OSError, EOFError, UnicodeDecodeError, zlib.error) as error:
        raise BadInputError(f"{path} cannot be read to its end: {error}") from error
    if not (log.trials or log.failures):
        raise BadInputError(f"{path} holds no trial")
    for tag in broken:
        log.trials.pop(tag, None)
    return log


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a log; `BadInputError` before more than the limits is decompressed."""
    opener: Callable[..., Any] = gzip.open if path.suffix == ".gz" else open
    size = 0
    with opener(path, "rb") as file:
        while line := file.readline(MAX_LINE_BYTES + 1):
            size += len(line)
            if len(line) > MAX_LINE_BYTES:
                raise BadInputError(f"{path} has a line of more than {MAX_LINE_BYTES} bytes")
            if size > MAX_LOG_BYTES:
                raise BadInputError(f"{path} has more than {MAX_LOG_BYTES} bytes uncompressed")
            yield line.decode("utf-8")


def _tag(line: str) -> str:
    match = re.search(r"trial (\S+)\s*$", line[-40:])
    return match.group(1) if match else ""


def _parse_line(line: str) -> list[Command]:
    try:
        value, _ = json.JSONDecoder().raw_decode(line.lstrip())
    except (json.JSONDecodeError, RecursionError) as error:
        raise BadInputError(f"is not JSON: {error}") from error
    commands = value if isinstance(value, list) else [value]
    if not all(isinstance(c, dict) and isinstance(c.get("$type"), str) for c in commands):
        raise BadInputError('holds something that is not a command with a "$type"')
    if not _tag(line):
        raise BadInputError('does not end in "trial N"')
    return commands
