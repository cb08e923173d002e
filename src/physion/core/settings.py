"""Read settings and JSON or TOML that somebody else may have written, with every value checked.

Dataclasses (or pydantic models) declare what is expected; pydantic checks it strictly: a number in
quotes, an unknown key or NaN is refused. `parse_json` also refuses repeated keys and nesting
without end. Each error is one line that names the field: ``scene.bodies[0].mass must be ...``.

Scenes, presets, metadata of trial files, options of models and studies are all read here.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import math
import re
import reprlib
import tomllib
import types
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from physion.core.errors import BadInputError
from physion.core.files import read_plain

if TYPE_CHECKING:  # pydantic is imported when something is read, since it takes 0.1 s
    from pydantic import ConfigDict, TypeAdapter, ValidationError
    from pydantic_core import ErrorDetails

T = TypeVar("T")

MAX_DEPTH = 100
"""Deepest nesting of lists and objects that is read; real files have less than 10 levels."""
MAX_BYTES = 1 << 28
"""Largest file that is read."""


STRICT: ConfigDict = {"strict": True, "extra": "forbid", "allow_inf_nan": False}
"""Configuration of all that is read; pydantic models take it as their ``model_config``."""

OPTION_ONLY = "only by --option"
"""In the type of a field, ``Annotated[int, OPTION_ONLY]``: the command line sets it by
``--option NAME=VALUE`` only."""

_REPR = reprlib.Repr()
_REPR.maxlevel, _REPR.maxlist, _REPR.maxdict, _REPR.maxstring, _REPR.maxlong = 3, 4, 4, 60, 40

_EXPECTED = {
    "bool": "true or false",
    "int": "a whole number",
    "float": "a finite number",
    "finite": "a finite number",
    "string": "a text",
    "none": "null",
    "tuple": "a list",
    "list": "a list",
    "dict": "an object",
    "mapping": "an object",
    "dataclass": "an object",
    "model": "an object",
}
"""What a value must be, by the first word of pydantic's name for the error."""


def read_json(path: Path, kind: type[T]) -> T:
    """Read a JSON file as ``kind`` (see `read_settings`)."""
    return read_settings(kind, parse_json(_text(path), str(path)), str(path))


def parse_json(text: str, where: str, error: type[BadInputError] = BadInputError) -> Any:
    """Parse JSON; raise ``error`` if it is broken, repeats a key or is nested too deeply."""

    def as_dict(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        values = dict(pairs)
        if len(values) < len(pairs):
            repeated = next(k for k, n in Counter(key for key, _ in pairs).items() if n > 1)
            raise error(f"{where}: key {shown(repeated)} is repeated in one object")
        return values

    try:
        data = json.loads(text, object_pairs_hook=as_dict)
    except RecursionError:
        raise error(f"{where} is nested deeper than {MAX_DEPTH} levels") from None
    except ValueError as problem:
        raise error(f"{where} is not JSON: {problem}") from problem
    level = [data] if isinstance(data, list | dict) else []
    for _ in range(MAX_DEPTH):
        level = [
            child
            for item in level
            for child in (item.values() if isinstance(item, dict) else item)
            if isinstance(child, list | dict)
        ]
        if not level:
            return data
    raise error(f"{where} is nested deeper than {MAX_DEPTH} levels")


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Parse TOML; raise `BadInputError` if it is broken."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as problem:
        raise BadInputError(f"{where} is not TOML: {problem}") from problem


def read_settings(
    kind: type[T], data: Any, where: str, error: type[BadInputError] = BadInputError
) -> T:
    """Build ``kind`` from parsed JSON or TOML, or from options, with every value checked.

    Parameters
    ----------
    kind
        A dataclass, a pydantic model (with `STRICT`), or any other type that pydantic can check,
        such as ``dict[str, int]``. Fields that hold neither numbers, texts nor dataclasses are
        declared as ``Any``.
    data
        Texts, numbers, lists and mappings. Tuples count as lists, and numbers of numpy as numbers.
        A whole number is accepted for a float.
    where
        Name of the value in errors; fields are appended as in ``scene.bodies[0].mass``.
    error
        Class of the errors raised.

    Raises
    ------
    BadInputError
        For an unknown or missing key and for a value of the wrong type, with the path of the field
        and the closest known name.
    """
    from pydantic import ValidationError

    try:
        # As JSON, since pydantic takes lists for tuples, and objects for dataclasses, only there.
        text = json.dumps([data], default=_plain)
        (value,) = _adapter(typing.cast("Any", kind)).validate_json(text)
    except ValidationError as problem:
        raise error(_describe(problem, kind, data, where)) from None
    except (TypeError, ValueError) as problem:
        raise error(f"{where}: {problem}") from problem
    if "NaN" in text or "Infinity" in text:
        _check_finite(data, where, error)
    return typing.cast("T", value)


def split_names(texts: str | Iterable[str], what: str) -> list[str]:
    """Return the names in lists with commas, each once; `BadInputError` if there is none."""
    listed = [texts] if isinstance(texts, str) else list(texts)
    found = [name.strip() for text in listed for name in text.split(",")]
    names = [name for name in dict.fromkeys(found) if name]
    if not names:
        raise BadInputError(f"{','.join(listed)!r} names no {what}")
    return names


def read_pairs(kind: type[T], pairs: Iterable[str], where: str) -> T:
    """Build ``kind`` from texts NAME=VALUE of the command line, as `read_settings` does."""
    return read_settings(kind, parse_pairs(pairs, where), where)


def parse_pairs(pairs: Iterable[str], where: str) -> dict[str, Any]:
    """Return the values of texts NAME=VALUE of the command line by name.

    A value that is not JSON is a text. A name with a dot, as in ``sbatch.account=physics``, sets an
    entry of a mapping, whose values are texts.
    """
    values: dict[str, Any] = {}
    for pair in pairs:
        name, sign, text = pair.partition("=")
        if not (name and sign):
            raise BadInputError(f"{where} takes NAME=VALUE, not {pair!r}")
        name, dot, entry = name.partition(".")
        if dot:
            holder = values.setdefault(name, {})
            if not isinstance(holder, dict) or entry in holder:
                raise BadInputError(f"{where}: {name}.{entry} is given twice")
            holder[entry] = text
            continue
        if name in values:
            raise BadInputError(f"{where}: {name} is given twice")
        try:
            values[name] = json.loads(text)
        except (ValueError, RecursionError):
            # Also .9 and 1., which are no JSON.
            number = re.fullmatch(r"[+-]?(\d+\.|\.\d+)", text)
            values[name] = float(text) if number else text
    return values


def check_keys(data: Iterable[str], known: Iterable[str], where: str) -> None:
    """Raise `BadInputError` for the first key that is not ``known``, with the closest one."""
    names = list(known)
    for key in data:
        if key not in names:
            raise BadInputError(f"{where}: {_unknown(key, names)}")


def field_types(kind: Any) -> Mapping[str, Any]:
    """Return the declared type of each field of a dataclass, with annotations, by field name."""
    return _cached_field_types(kind)


@functools.cache
def _cached_field_types(kind: Any) -> Mapping[str, Any]:
    hints = typing.get_type_hints(kind, include_extras=True)
    names = (field.name for field in dataclasses.fields(kind))
    return types.MappingProxyType({name: hints[name] for name in names})


def flatten(values: Mapping[Any, Any], *, lists: bool = False) -> dict[str, Any]:
    """Return nested values by their paths, such as ``camera.fov``.

    With ``lists``, also the parts of lists of objects or lists, as in ``bodies[0].mass``.
    """
    flat: dict[str, Any] = {}
    for key, value in values.items():
        parts: Any = None
        if isinstance(value, Mapping):
            parts = {f"{key}.{name}": part for name, part in value.items()}
        elif (
            lists
            and isinstance(value, list)
            and any(isinstance(one, Mapping | list) for one in value)
        ):
            parts = {f"{key}[{place}]": part for place, part in enumerate(value)}
        flat |= {str(key): value} if parts is None else flatten(parts, lists=lists)
    return flat


def as_json(values: Any, default: Callable[[Any], Any] | None = None) -> Any:
    """Return values as JSON reads them again; ``default`` is the one of `json.dumps`."""
    return json.loads(json.dumps(values, default=default))


def shown(value: Any) -> str:
    """Return a value as short text for an error message, whatever its size."""
    return _REPR.repr(value)


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    """Return what checks a list of one ``kind``; within a list, dataclasses take `STRICT`."""
    from pydantic import TypeAdapter

    return TypeAdapter(tuple[kind], config=STRICT)


def _plain(value: Any) -> Any:
    """Return a value that JSON does not know as one that it knows."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return dict(value)
    to_list: Callable[[], Any] | None = getattr(value, "tolist", None)  # numbers of numpy
    if to_list is not None:
        return to_list()
    raise TypeError(f"{shown(value)} is not a text, number, list or object")


def _text(path: Path) -> str:
    try:
        return read_plain(path, MAX_BYTES, follow_links=True).decode()
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path} cannot be read: {error}") from error


def _children(item: Any) -> Iterable[tuple[Any, Any]]:
    if isinstance(item, Mapping):
        return item.items()
    return enumerate(item) if isinstance(item, list | tuple) else ()


def _check_finite(data: Any, where: str, error: type[BadInputError]) -> None:
    """Raise ``error`` for a number that is not finite, also in a field of type ``Any``."""
    if isinstance(data, float) and not math.isfinite(data):
        raise error(f"{where} must be a finite number, not {data}")
    for key, value in _children(data):
        _check_finite(value, where + _step(key), error)


def _describe(problem: ValidationError, kind: Any, data: Any, where: str) -> str:
    """Return the first error of pydantic as one line; a key that is unknown comes first."""
    errors = problem.errors(include_url=False)
    first = next((one for one in errors if _is_unknown(one)), errors[0])
    path, expected, value = where, kind, data
    keys = []
    for key in first["loc"][1:]:  # without the list that holds the value
        children = dict(_children(value))
        if key in children:
            keys.append(key)
            path, expected, value = path + _step(key), _part(expected, key), children[key]
    if first["type"] in ("missing", "missing_argument"):
        if isinstance(first["loc"][-1], int):
            return f"{path} must hold {len(typing.get_args(expected))} values, not {len(value)}"
        missing = [repr(one["loc"][-1]) for one in errors if one["type"] == first["type"]
                   and one["loc"][:-1] == first["loc"][:-1]]  # fmt: skip
        return f"{path}: missing {', '.join(missing)}"
    if _is_unknown(first):
        holder = functools.reduce(_part, keys[:-1], kind)
        place = where + "".join(map(_step, keys[:-1]))
        return f"{place}: {_unknown(keys[-1], _fields(holder))}"
    return f"{path} {_wanted(first, value)}"


def _is_unknown(error: ErrorDetails) -> bool:
    return error["type"] in ("extra_forbidden", "unexpected_keyword_argument")


def _unknown(key: Any, known: Iterable[str]) -> str:
    names = list(known)
    close = difflib.get_close_matches(str(key), names, n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"unknown key {shown(key)}; {hint}known: {', '.join(names)}"


def _wanted(error: ErrorDetails, value: Any) -> str:
    """Return what was expected in place of ``value``."""
    kind, limits = error["type"], error.get("ctx", {})
    if kind in ("too_short", "too_long"):
        count = limits.get("max_length", limits.get("min_length"))
        return f"must hold {count} values, not {len(value)}"
    if kind == "literal_error":
        return f"must be {limits['expected']}, not {shown(value)}"
    expected = _EXPECTED.get(kind.partition("_")[0])
    if expected and kind.endswith(("_type", "_parsing", "_number", "_from_float")):
        return f"must be {expected}, not {shown(value)}"
    message = error["msg"].removeprefix("Value error, ")
    return f"is {shown(value)}: {message[:1].lower()}{message[1:]}"


def _step(key: Any) -> str:
    """Return a key or number of a list as a part of a path: ``.mass``, ``[0]``, ``['a b']``."""
    return f".{key}" if isinstance(key, str) and key.isidentifier() else f"[{shown(key)}]"


def _part(kind: Any, key: Any) -> Any:
    """Return the type of the field or item ``key`` of a type, or Any."""
    known = _fields(kind)
    if key in known:
        return known[key]
    arguments = typing.get_args(kind)
    if typing.get_origin(kind) is typing.Annotated:
        return _part(arguments[0], key)
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        return next((part for one in arguments if (part := _part(one, key)) is not Any), Any)
    if isinstance(key, int) and arguments:
        return arguments[min(key, len([one for one in arguments if one is not Ellipsis]) - 1)]
    return arguments[-1] if arguments else Any


def _fields(kind: Any) -> Mapping[str, Any]:
    """Return the types of the fields of a dataclass or pydantic model, else nothing."""
    if typing.get_origin(kind) is typing.Annotated:
        return _fields(typing.get_args(kind)[0])
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return field_types(kind)
    fields = getattr(kind, "model_fields", {})
    return {name: field.annotation for name, field in fields.items()}
