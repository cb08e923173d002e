"""``study.toml`` as text: read into checked tables, and written with a comment above each key."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from physion.errors import BadInputError, UnknownNameError
from physion.experiment.study.study_checks import KEYS, TABLES, Key

HEAD = """\
# What this study decides. Words are in texts/, stimuli in stimuli.csv (which is never served).
# Look at it with: physion experiment serve FOLDER
"""


def parse_toml(path: Path, content: bytes) -> dict[str, Any]:
    """The tables of a TOML file that was read from ``path``; `BadInputError` where it is none."""
    try:
        return tomllib.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{path} is not TOML: {error}") from error


def check_tables(tables: Mapping[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    """The values of a ``study.toml``, checked: by table (empty: the top) and key.

    Keys that may be left out and are, are left out. `BadInputError` names the file, the key, and
    what is allowed, or for an unknown key the closest ones.
    """
    top = {key.name for key in KEYS if not key.table} | set(TABLES)
    _refuse_unknown(path, "", tables, top)
    values: dict[str, dict[str, Any]] = {name: {} for name in ("", *TABLES)}
    for name in TABLES:
        part = tables.get(name, {})
        if not isinstance(part, Mapping):
            raise BadInputError(f"{path}: {name} must be a table, [{name}], not {part!r}")
        _refuse_unknown(path, name, part, {key.name for key in KEYS if key.table == name})
    for key in KEYS:
        given = tables.get(key.table, {}) if key.table else tables
        if key.name in given:
            values[key.table][key.name] = _checked(path, key, given[key.name])
        elif key.required:
            raise BadInputError(f"{path} lacks {key.name}: {' '.join(key.about.split())}")
    return values


def tables_to_toml(values: Mapping[str, Mapping[str, Any]], path: Path) -> str:
    """The text of a ``study.toml``; `check_tables` gives the values back.

    ``values`` may hold more than the keys. `BadInputError` names the key of a value that could not
    be read back from ``path``.
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
    name = f"{key.table}.{key.name}" if key.table else key.name
    try:
        return key.check(value)
    except ValueError as error:
        shown = repr(list(value) if isinstance(value, tuple) else value)
        raise BadInputError(f"{path}: {name} must be {error}, not {shown[:200]}") from error


def _refuse_unknown(path: Path, table: str, given: Mapping[str, Any], known: set[str]) -> None:
    for name in given:
        if name not in known:
            where = f"{path}, [{table}]" if table else str(path)
            raise BadInputError(f"{where}: {UnknownNameError('key', name, known)}")


def _toml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(one) for one in value)}]"
    # Texts hold no control characters, and so a JSON string is a TOML string.
    return json.dumps(value, ensure_ascii=False)
