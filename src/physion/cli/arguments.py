"""Read the options of a verb from the command line; what is wrong becomes one line.

The classes ``Options`` of the verbs are read by tyro. Here are the names of values in its help
(``--count INTEGER``), and the sentences for options, values and choices that do not exist.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import re
import types
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, fields, is_dataclass, replace
from functools import cache
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import tyro

# Not a public module of tyro, so pyproject.toml asks for one version of tyro only.
from tyro import _errors

from physion.core.errors import BadInputError
from physion.core.settings import OPTION_ONLY, field_types, parse_pairs, read_pairs, read_settings

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    T = TypeVar("T", bound=DataclassInstance)

VALUES = {
    "option": "NAME=VALUE",
    "task": "NAME=VALUE",
    "where": "COLUMN=VALUE",
    "mark": "TRIAL=REASON",
    "groups": "COLUMN",
    "base_url": "URL",
    "url": "URL",
    "host": "ADDRESS",
    "behind_proxy": "ADDRESS",
    "session": "REFERENCE",
    "participant": "ID",
    "contact": "TEXT",
    "title": "TEXT",
    "creator": "TEXT",
    "license": "TEXT",
    "version": "TEXT",
    "published": "DATE",
}
"""What the help calls the value of an option, by the option's name; of others by their type."""
_TYPES = {int: "INTEGER", float: "NUMBER", str: "NAME", Path: "PATH"}


def read_options(options: Any, args: Sequence[str], prog: str, description: str) -> Any:
    """Return an instance of the class ``options`` of a verb, filled from the command line.

    Parameters
    ----------
    options
        Dataclass whose fields are the options, with their help as text below each field.
    args
        Words of the command line after the verb.
    prog, description
        The verb, such as ``physion generate``, and the first part of its help.

    Raises
    ------
    BadInputError
        For an unknown option, a missing or impossible value, or a word too many.
    SystemExit
        After ``--help`` was printed.
    """
    known = _described(options)
    seen: set[str] = set()
    for word, following in zip_longest(args, args[1:], fillvalue="--"):
        if word == "--":
            break
        name = word.partition("=")[0].replace("_", "-")
        if not re.match(r"--?[A-Za-z]", word):
            continue
        if name not in known:
            raise no_such("option", name, known, f"{prog} --help")
        value = VALUES.get(name[2:], "")
        if "=" not in value:
            continue
        if name in seen:  # tyro would take the last one
            raise BadInputError(f"{name} is given twice: write all its values after one {name}")
        seen.add(name)
        if word == name and following.startswith("--"):
            raise BadInputError(f"{name} needs a value: {value} ({prog} --help explains it)")
    with _errors.on_parse_error(_refuse):
        return tyro.cli(
            options,
            args=list(args),
            prog=prog,
            description=description,
            config=(tyro.conf.DisallowNone,),
        )


def take_options(settings: T, pairs: Iterable[str]) -> tuple[T, list[str]]:
    """Return settings whose fields without an option of their own come from ``--option``.

    Parameters
    ----------
    settings
        Dataclass, whose fields with `OPTION_ONLY` are taken from ``pairs``; a field that holds
        settings itself takes ``FIELD.NAME=VALUE``.
    pairs
        Texts NAME=VALUE.

    Returns
    -------
    settings, rest
        The settings with these values, and the pairs that name none of these fields.

    Raises
    ------
    BadInputError
        If a value has another type, is out of range or given twice.
    """
    kinds = field_types(type(settings))
    own: dict[str, list[str]] = {
        k: [] for k, kind in kinds.items() if OPTION_ONLY in get_args(kind)
    }
    rest: list[str] = []
    for pair in pairs:
        key, sign, _ = pair.partition("=")
        if not sign:
            raise BadInputError(
                f"--option takes NAME=VALUE, not {pair!r}; other words stand before it"
            )
        # A file of a model, logistic.py:Net:NAME, may have the name of a setting.
        own.get("" if ":" in key else key.partition(".")[0], rest).append(pair)
    values: dict[str, Any] = {}
    for name, given in own.items():
        current = getattr(settings, name)
        if given and is_dataclass(current):
            if plain := [pair for pair in given if not pair.startswith(f"{name}.")]:
                raise BadInputError(f"--option takes {name}.NAME=VALUE, not {plain[0]!r}")
            nested = [pair.removeprefix(f"{name}.") for pair in given]
            values[name] = read_pairs(type(current), nested, f"--option {name}")
        elif given:
            found = parse_pairs(given, "--option")[name]
            values[name] = read_settings(kinds[name], found, f"--option {name}")
    return replace(settings, **values), rest


def no_such(kind: str, name: str, known: Iterable[str], where: str) -> BadInputError:
    """Return the error for an unknown verb or option, with the closest known one.

    Parameters
    ----------
    kind, name
        What it should be, and what was written.
    known
        All that there are.
    where
        Command that lists them.
    """
    close = difflib.get_close_matches(name, list(known), n=1)
    meant = f": did you mean {close[0]}?" if close else ""
    return BadInputError(f"no such {kind} {name}{meant} ({where} lists all)")


@cache
def _described(options: Any) -> tuple[str, ...]:
    """Return all options of a dataclass, and write into its annotations how the help shows them.

    Values get names, defaults that say nothing (None, no text, no names, False) are left out, and
    a switch that is off has no ``--no-`` form. A field with `OPTION_ONLY` is not an option.
    """
    names = ["-h", "--help"]
    hints, texts = get_type_hints(options, include_extras=True), _texts(options)
    for field in fields(options):
        hint = hints[field.name]
        parts = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        kind: Any = parts[0]
        extras = list(parts[1:])
        if OPTION_ONLY in extras:
            # The marker stays, for `take_options`.
            options.__annotations__[field.name] = Annotated[kind, OPTION_ONLY, tyro.conf.Suppress]
            continue
        if hasattr(kind, "__dataclass_fields__"):  # further options, without a name of their own
            names += _described(kind)
            continue
        value = _value(field.name, kind)
        shown: dict[str, Any] = {"help": texts.get(field.name)}
        if field.default is False or field.default in (None, "", ()):
            shown["help_behavior_hint"] = ""
        if tyro.conf.Positional in extras:
            if get_origin(_without_none(kind)) is not Literal:
                several = " ..." if get_origin(kind) is tuple else ""
                value = field.name.upper().replace("_", "-") + several
            shown["metavar"] = value if field.default is MISSING else f"[{value}]"
        else:
            own = [f"--{field.name.replace('_', '-')}"]
            own += [name for extra in extras for name in getattr(extra, "aliases", None) or ()]
            names += own
            if kind is bool and field.default is True:
                names += [f"--no-{name[2:]}" for name in own]
            elif kind is bool:
                extras.append(tyro.conf.FlagCreatePairsOff)
            else:
                shown["metavar"] = value
        annotated = (kind, *extras, tyro.conf.arg(**shown))
        options.__annotations__[field.name] = Annotated.__class_getitem__(annotated)  # type: ignore[attr-defined]
    return tuple(names)


def _texts(options: Any) -> dict[str, str]:
    """Return the text below each field of a dataclass, without its line breaks, by field."""
    found = {}
    for one in reversed(options.__mro__[:-1]):
        (made,) = ast.parse(inspect.getsource(one)).body
        assert isinstance(made, ast.ClassDef)
        for field, below in pairwise(made.body):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                assert isinstance(field.target, ast.Name) and isinstance(below.value, ast.Constant)
                found[field.target.id] = " ".join(str(below.value.value).split())
    return found


def _without_none(kind: Any) -> Any:
    """Return the type of an option that may be None without None."""
    if get_origin(kind) in (Union, types.UnionType):
        (kind,) = (one for one in get_args(kind) if one is not type(None))
    return kind


def _value(name: str, kind: Any) -> str:
    """Return what the help calls the value of an option; ``kind`` is its type."""
    kind = _without_none(kind)
    if get_origin(kind) is tuple:
        return f"{_value(name, get_args(kind)[0])} ..."
    if get_origin(kind) is Literal:
        return "{" + ",".join(get_args(kind)) + "}"
    return VALUES.get(name) or _TYPES.get(kind, "")


def _refuse(event: _errors.ParseErrorEvent) -> None:
    """Raise `BadInputError` for what tyro refuses; events without a sentence are left to tyro."""
    text = _sentence(event)
    if text:
        raise BadInputError(f"{text} ({event.prog} --help explains it)")


def _sentence(event: _errors.ParseErrorEvent) -> str:
    """Return what is wrong with the command line in one sentence; empty for unknown events."""
    verb = event.prog.removeprefix("physion ")
    match event:
        case _errors.MissingArgs():
            names = [_called(one.arg) for one in event.missing_arguments]
            return f"{verb} needs {' and '.join(names)}"
        case _errors.BadValue():
            return f"{_called(event.argument)} needs a value: {event.argument.lowered.metavar}"
        case _errors.InvalidChoice():
            close = difflib.get_close_matches(event.value, event.choices, n=1)
            meant = f"; did you mean {close[0]}?" if close else ""
            choices = ", ".join(event.choices)
            return f"{_called(event.argument)} takes one of {choices}, not {event.value!r}{meant}"
        case _errors.UnrecognizedArgs():
            return f"{verb} does not take {' '.join(event.tokens)!r}"
        case _errors.InstantiationFailure(argument=argument) if argument is not None:
            given = re.search(r"'(.*?)'", event.message)
            value = f", not {given[1]!r}" if given else ""
            return f"{_called(argument)} takes {argument.lowered.metavar}{value}"
    return ""


def _called(argument: Any) -> str:
    """Return the name of an argument as the help shows it."""
    if argument.is_positional():
        return str(argument.lowered.metavar).strip("[]")
    return str(argument.lowered.name_or_flags[-1])
