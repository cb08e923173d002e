"""Reading and writing of ``study.toml``: parsing, checking, and output with comments."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError, UnknownNameError
from physion.experiment.study.study_checks import KEYS, TABLES, Key

MOST_ENTRIES = 50
"""Tables of one list."""
HEAD = """\
# Settings of this study. Texts are in texts/, stimuli in stimuli.csv (which is never served).
# To run it: physion experiment serve FOLDER
"""


def parse_toml(path: Path, content: bytes) -> dict[str, Any]:
    """Parse the content of a TOML file that was read from ``path``."""
    try:
        return tomllib.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{path} is not TOML: {error}") from error


def check_tables(
    tables: Mapping[str, Any], path: Path, lists: Collection[str] = ()
) -> dict[str, dict[str, Any]]:
    """Check all values of a ``study.toml``; return them by table (empty: top level) and key.

    Optional keys that are missing in the file are missing in the result. ``lists``: names of lists
    of tables, which `check_list` reads.

    Raises
    ------
    BadInputError
        A value is not allowed, or a key is missing or unknown. The message names the file, the key
        and the allowed values, or the known keys closest to an unknown one.
    """
    top = {key.name for key in KEYS if not key.table} | {*TABLES, *lists}
    _refuse_unknown(path, "", tables, top)
    values: dict[str, dict[str, Any]] = {name: {} for name in ("", *TABLES)}
    for name in TABLES:
        part = tables.get(name, {})
        if not isinstance(part, Mapping):
            raise BadInputError(f"{path}: {name} must be a table, [{name}], not {part!r}")
        _refuse_unknown(path, f"[{name}]", part, {key.name for key in KEYS if key.table == name})
    for table, part in values.items():
        given = tables.get(table, {}) if table else tables
        part |= _check_keys(path, [key for key in KEYS if key.table == table], given)
    return values


def check_list(
    tables: Mapping[str, Any], path: Path, name: str, keys: Sequence[Key]
) -> list[dict[str, Any]]:
    """Check a list of tables ``[[NAME]]`` of a ``study.toml``; return the values of each by key.

    Raises the errors of `check_tables`.
    """
    entries = tables.get(name, [])
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise BadInputError(f"{path}: {name} must be tables, [[{name}]], not {entries!r:.100}")
    if len(entries) > MOST_ENTRIES:
        raise BadInputError(f"{path}: there can be at most {MOST_ENTRIES} tables [[{name}]]")
    for entry in entries:
        _refuse_unknown(path, f"[[{name}]]", entry, {key.name for key in keys})
    return [_check_keys(path, keys, entry) for entry in entries]


def format_list(
    name: str, keys: Sequence[Key], about: str, entries: Sequence[Mapping[str, Any]], path: Path
) -> str:
    """Return the text of a list of tables ``[[NAME]]``, as `check_list` reads it.

    ``about`` and the meanings of the keys are written as comments above the list. Keys whose value
    is None are left out.
    """
    comments = [*about.splitlines(), *(f"  {key.name}: {key.about}" for key in keys)]
    lines = ["\n", *(f"# {line}\n" for line in comments)]
    for entry in entries:
        lines.append(f"\n[[{name}]]\n")
        given = [key for key in keys if entry[key.name] is not None]
        lines += [f"{k.name} = {_toml(_checked(path, k, entry[k.name]))}\n" for k in given]
    return "".join(lines)


def _check_keys(path: Path, keys: Sequence[Key], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the checked values of the given keys; refuse a required one that is missing."""
    values = {}
    for key in keys:
        if key.name in given:
            values[key.name] = _checked(path, key, given[key.name])
        elif key.required:
            where = f"{path}, [[{key.table}]]," if key.table else str(path)
            raise BadInputError(f"{where} lacks {key.name}: {' '.join(key.about.split())}")
    return values


def format_tables(values: Mapping[str, Mapping[str, Any]], path: Path) -> str:
    """Return the text of a ``study.toml`` from which `check_tables` reads the same values.

    ``values`` may have further keys, which are ignored. `BadInputError` names the key of a value
    that `check_tables` would refuse.
    """
    lines = [HEAD]
    for name in ("", *TABLES):
        if name:
            lines.append(f"\n# {TABLES[name]}\n[{name}]\n")
        for key in (key for key in KEYS if key.table == name):
            value = _checked(path, key, values[name][key.name])
            comment = "".join(f"# {line}\n" for line in key.about.splitlines())
            lines.append(f"{comment}{key.name} = {_toml(value)}\n")
    return "".join(lines)


def _checked(path: Path, key: Key, value: Any) -> Any:
    """Check one value; `BadInputError` names file, key and allowed values."""
    name = f"{key.table}.{key.name}" if key.table else key.name
    try:
        return key.check(value)
    except ValueError as error:
        shown = repr(list(value) if isinstance(value, tuple) else value)
        raise BadInputError(f"{path}: {name} must be {error}, not {shown[:200]}") from error


def _refuse_unknown(path: Path, table: str, given: Mapping[str, Any], known: set[str]) -> None:
    for name in given:
        if name not in known:
            where = f"{path}, {table}" if table else str(path)
            raise BadInputError(f"{where}: {UnknownNameError('key', name, known)}")


def _toml(value: Any) -> str:
    """Return a value in TOML syntax."""
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(one) for one in value)}]"
    # Texts have no control characters, so their JSON strings are valid TOML strings.
    return json.dumps(value, ensure_ascii=False)
