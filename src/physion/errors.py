"""The kinds of error that this package raises, each with what to do next."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class PhysionError(Exception):
    """What went wrong, where, and what to do next.

    The command line prints ``str(error)`` as one line and leaves with ``exit_code``.
    """

    exit_code = 2


class UnknownNameError(PhysionError):
    """A name that no registry, preset or file holds; the message gives the closest ones."""

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        names = sorted(known)
        close = difflib.get_close_matches(name, names, n=3, cutoff=0.0)
        hint = f"; closest: {', '.join(close)}" if close else f"; no {kind} is registered"
        super().__init__(f"unknown {kind} {name!r}{hint}")
        self.kind, self.name, self.close = kind, name, close


class BadInputError(PhysionError):
    """A file, folder or value from outside that is not what it should be."""


class BadSceneError(BadInputError):
    """A scene that breaks its own rules: two bodies of one name, a role without a body, ..."""


class MissingExtraError(PhysionError):
    """A part of the package whose optional dependencies are not installed."""

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(
            f"{what} needs the extra {extra!r}: pip install -e '.[{extra}]' in the clone"
        )
        self.extra = extra
