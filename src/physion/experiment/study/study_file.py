"""Reading and writing of ``study.toml``: parsing, checking, and output with comments."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from physion.errors import BadInputError, UnknownNameError
from physion.experiment.study.study_checks import KEYS, TABLES, Key

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


def check_tables(tables: Mapping[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    """Check all values of a ``study.toml``; return them by table (empty: top level) and key.

    Optional keys that are missing in the file are missing in the result.

    Raises
    ------
    BadInputError
        A value is not allowed, or a key is missing or unknown. The message names the file, the key
        and the allowed values, or the known keys closest to an unknown one.
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
            where = f"{path}, [{table}]" if table else str(path)
            raise BadInputError(f"{where}: {UnknownNameError('key', name, known)}")


def _toml(value: Any) -> str:
    """Return a value in TOML syntax."""
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(one) for one in value)}]"
    # Texts have no control characters, so their JSON strings are valid TOML strings.
    return json.dumps(value, ensure_ascii=False)
