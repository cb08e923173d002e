"""Read JSON that somebody else may have written into dataclasses, with every value checked.

Used for scenes, for metadata and labels of trial files, and (keys and field types) for the
parameters of scenarios. The checks are stricter than those of libraries for this task: a number in
quotes, NaN, an unknown or repeated key and JSON nested without end are all refused, and each error
is one line that names the field.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import math
import reprlib
import types
import typing
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from physion.core.errors import BadInputError

T = TypeVar("T")

MAX_DEPTH = 100
"""Deepest nesting of lists and objects that is read; real files have less than 10 levels."""

_REPR = reprlib.Repr()
_REPR.maxlevel, _REPR.maxlist, _REPR.maxdict, _REPR.maxstring, _REPR.maxlong = 3, 4, 4, 60, 40

_NAMES: dict[Any, str] = {bool: "true or false", int: "a whole number", str: "a text"}


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
    except error:
        raise
    except RecursionError:
        raise error(f"{where} is nested deeper than {MAX_DEPTH} levels") from None
    except ValueError as problem:
        raise error(f"{where} is not JSON: {problem}") from problem
    level = [data]
    for _ in range(MAX_DEPTH):
        level = [child for item in level for child in _children(item)]
        if not level:
            return data
    raise error(f"{where} is nested deeper than {MAX_DEPTH} levels")


def read_dataclass(
    kind: type[T], data: Any, where: str, error: type[BadInputError] = BadInputError
) -> T:
    """Build a dataclass from parsed JSON, checking every field against its declared type.

    Parameters
    ----------
    kind
        The dataclass. Its fields may be dataclasses, tuples, ``X | None``, numbers, texts,
        booleans, and ``Mapping`` from texts to one of these, or to ``Any`` for any JSON value
        whose numbers are finite. A whole number is accepted for a float.
    data
        What `parse_json` returned.
    where
        Name of the value in errors; fields are appended as in ``scene.bodies[0].mass``.
    error
        Class of the errors raised.

    Raises
    ------
    BadInputError
        For an unknown or missing key and for a value of the wrong type, with the path of the field.
    """
    if not isinstance(data, dict):
        raise error(f"{where} must be an object, not {shown(data)}")
    hints = field_types(kind)
    check_keys(data, hints, where, error)
    values = {
        key: read_value(hints[key], value, f"{where}.{key}", error) for key, value in data.items()
    }
    missing = _missing(kind, data)
    if missing:
        raise error(f"{where}: missing {', '.join(missing)}")
    return kind(**values)


def check_keys(
    data: Iterable[str],
    known: Iterable[str],
    where: str,
    error: type[BadInputError] = BadInputError,
) -> None:
    """Raise ``error`` for the first key that is not ``known``, with the closest one that is."""
    names = list(known)
    for key in data:
        if key not in names:
            close = difflib.get_close_matches(str(key), names, n=1)
            hint = f"did you mean {close[0]!r}? " if close else ""
            raise error(f"{where}: unknown key {shown(key)}; {hint}known: {', '.join(names)}")


def field_types(kind: Any) -> Mapping[str, Any]:
    """Return the declared type of each field of a dataclass, with annotations, by field name."""
    return _cached_field_types(kind)


@functools.cache
def _cached_field_types(kind: Any) -> Mapping[str, Any]:
    hints = typing.get_type_hints(kind, include_extras=True)
    names = (field.name for field in dataclasses.fields(kind))
    return types.MappingProxyType({name: hints[name] for name in names})


def shown(value: Any) -> str:
    """Return a value as short text for an error message, whatever its size."""
    return _REPR.repr(value)


def _missing(kind: Any, data: Mapping[str, Any]) -> list[str]:
    """Return the fields without a default that ``data`` lacks, in quotes."""
    none = dataclasses.MISSING
    return [
        repr(field.name)
        for field in dataclasses.fields(kind)
        if field.name not in data and field.default is none and field.default_factory is none
    ]


def _children(item: Any) -> Iterable[Any]:
    if isinstance(item, dict):
        return item.values()
    return item if isinstance(item, list) else ()


def read_value(kind: Any, data: Any, where: str, error: type[BadInputError] = BadInputError) -> Any:
    """Return parsed JSON as a value of the type ``kind``, or raise ``error`` that says ``where``.

    Types are those that `read_dataclass` takes for fields.
    """
    origin = typing.get_origin(kind)
    if origin is types.UnionType:
        (chosen,) = (one for one in typing.get_args(kind) if one is not types.NoneType)
        return None if data is None else read_value(chosen, data, where, error)
    if dataclasses.is_dataclass(kind):
        return read_dataclass(kind, data, where, error)  # type: ignore[arg-type]
    if origin is tuple:
        return _read_tuple(typing.get_args(kind), data, where, error)
    if kind is float:
        return _read_float(data, where, error)
    if kind is Any:
        return _read_any(data, where, error)
    if kind in _NAMES:
        if type(data) is not kind:
            raise error(f"{where} must be {_NAMES[kind]}, not {shown(data)}")
        return data
    if not isinstance(data, dict):
        raise error(f"{where} must be an object, not {shown(data)}")
    item_kind = typing.get_args(kind)[1]
    return {
        key: read_value(item_kind, value, f"{where}[{shown(key)}]", error)
        for key, value in data.items()
    }


def _read_any(data: Any, where: str, error: type[BadInputError]) -> Any:
    """Return any JSON value, or raise ``error`` for a number in it that is not finite."""
    if isinstance(data, float):
        return _read_float(data, where, error)
    if isinstance(data, dict):
        for key, value in data.items():
            _read_any(value, f"{where}[{shown(key)}]", error)
    elif isinstance(data, list):
        for i, value in enumerate(data):
            _read_any(value, f"{where}[{i}]", error)
    return data


def _read_tuple(
    kinds: tuple[Any, ...], data: Any, where: str, error: type[BadInputError]
) -> tuple[Any, ...]:
    if not isinstance(data, list):
        raise error(f"{where} must be a list, not {shown(data)}")
    if kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(data)
    if len(data) != len(kinds):
        raise error(f"{where} must hold {len(kinds)} values, not {len(data)}")
    return tuple(
        read_value(kind, item, f"{where}[{i}]", error)
        for i, (kind, item) in enumerate(zip(kinds, data, strict=True))
    )


def _read_float(data: Any, where: str, error: type[BadInputError]) -> float:
    if not isinstance(data, bool) and isinstance(data, int | float):
        try:
            number = float(data)
        except OverflowError:  # a whole number beyond the largest float
            number = math.inf
        if math.isfinite(number):
            return number
    raise error(f"{where} must be a finite number, not {shown(data)}")
