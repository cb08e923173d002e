"""Registries, which map names to scenarios, shapes, models, encoders, engines and rooms."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoints, entry_points
from pathlib import Path
from typing import Generic, TypeVar

from physion.core.errors import PhysionError, UnknownNameError

T = TypeVar("T")


class Registry(Generic[T]):
    """Mapping from names to objects of one kind, which can be imported when they are first used.

    Other packages add objects through the entry-point group ``physion.<kind>s``.

    - ``kind``: what is registered, in the singular; used in messages and in the entry-point group.
    - ``lazy``: ``"module:attribute"`` by name, for objects that `get` imports when they are asked
      for.
    - ``texts``: what `describe` returns for names that share a class or function with others.
    """

    def __init__(
        self,
        kind: str,
        lazy: dict[str, str] | None = None,
        texts: Mapping[str, str] | None = None,
    ) -> None:
        self.kind = kind
        self._texts = dict(texts or {})
        self._values: dict[str, T] = {}
        self._lazy: dict[str, str] = dict(lazy or {})
        self._plugins_read = False

    def register(self, name: str) -> Callable[[T], T]:
        """Return a decorator that registers a value as ``name``, which must be unused."""

        def add(value: T) -> T:
            if name in self._values and self._values[name] is not value:
                raise PhysionError(f"{self.kind} {name!r} is registered twice; choose another name")
            self._values[name] = value
            return value

        return add

    def get(self, name: str) -> T:
        """Return the value called ``name``, importing it if it is lazy.

        Raises `UnknownNameError`, with the closest names, if there is none.
        """
        if name not in self._values:
            self._read_plugins()
            if name not in self._lazy:
                raise UnknownNameError(self.kind, name, self.names())
            module, _, attribute = self._lazy[name].partition(":")
            loaded = importlib.import_module(module)
            # Importing the module may have registered the name by its own decorator.
            if name not in self._values:
                self._values[name] = getattr(loaded, attribute)
        return self._values[name]

    def names(self) -> list[str]:
        """Return all names in alphabetical order, without importing any value."""
        self._read_plugins()
        return sorted(self._values.keys() | self._lazy.keys())

    def describe(self, name: str) -> str:
        """Return what the value ``name`` is, in one line, without importing it.

        It is the first line of the docstring, unless the registry has a text of its own; empty
        where there is no docstring or no source file.
        """
        if name in self._texts:
            return self._texts[name]
        if name in self._values or name not in self._lazy:
            text = inspect.getdoc(self.get(name)) or ""
        else:
            module, _, attribute = self._lazy[name].partition(":")
            text = _docstring(module, attribute)
        return text.partition("\n")[0]

    def _read_plugins(self) -> None:
        if self._plugins_read:
            return
        self._plugins_read = True
        for point in _plugins(self.kind):
            self._lazy.setdefault(point.name, point.value)

    def __contains__(self, name: object) -> bool:
        return name in self.names()

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())


@cache
def plugin_names(kind: str) -> tuple[str, ...]:
    """Return the names that other packages add to the registry of a kind, without loading them.

    What is installed is read once in a process: reading takes longer than sampling a scene.
    """
    return tuple(sorted(point.name for point in _plugins(kind)))


def _plugins(kind: str) -> EntryPoints:
    return entry_points(group=f"physion.{kind}s")


def _docstring(module: str, attribute: str) -> str:
    """Return the docstring of a function or class from the source file of its module."""
    try:
        found = importlib.util.find_spec(module)
    except ModuleNotFoundError:
        return ""
    if found is None or found.origin is None or not found.origin.endswith(".py"):
        return ""
    for node in ast.parse(Path(found.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == attribute:
            return ast.get_docstring(node) or ""
    return ""
