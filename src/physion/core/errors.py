"""Exceptions that this package raises; each message says what to do next."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

MEMORY_SETTINGS = "lower the options encoder_batch and batch, --workers or the size of the pictures"
"""What to do when memory is used up where no model is at work."""


class PhysionError(Exception):
    """Base class of all errors of this package.

    The message says what went wrong, where, and what to do next. The command line prints it as one
    line and exits with ``exit_code``.
    """

    exit_code = 2


class UnknownNameError(PhysionError):
    """Error for a name that is not known; the message lists the closest known names.

    Parameters
    ----------
    kind
        What the name should denote, for example ``scenario``.
    name
        The unknown name.
    known
        All known names.
    advice
        What else can be done, if anything.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str], advice: str = "") -> None:
        names = sorted(known)
        close = difflib.get_close_matches(name, names, n=3, cutoff=0.0)
        hint = f"; closest: {', '.join(close)}" if close else f"; no {kind} is registered"
        super().__init__(f"unknown {kind} {name!r}{hint}{advice and '; '}{advice}")
        self.kind, self.name, self.close = kind, name, close


class BadInputError(PhysionError):
    """Error for a file, folder or value of the user that is missing, damaged or out of range."""


class BadSceneError(BadInputError):
    """Error for an inconsistent scene, for example two bodies of one name or an unfilled role."""


OWN_ENVIRONMENT = ("inspect",)
"""Extras whose dependencies exclude versions of requirements.lock."""


class MissingExtraError(PhysionError):
    """Error for a feature whose optional dependencies are not installed."""

    def __init__(self, what: str, extra: str) -> None:
        where, lock = "", " -c requirements.lock"
        if extra in OWN_ENVIRONMENT:
            where, lock = "in a virtual environment of its own: ", ""
        super().__init__(
            f"{what} needs the extra {extra!r}; {where}pip install 'physion-benchmark[{extra}]', "
            f"or in the clone pip install -e '.[{extra}]'{lock}"
        )
        self.extra = extra


def one_line(error: BaseException) -> str:
    """Return an error as one line: the file and the reason of the system, or the message.

    Errors of other kinds than these and `PhysionError` begin with their type.
    """
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        return where + " ".join(error.strerror.split())
    text = " ".join(str(error).split()) or "no message"
    return text if isinstance(error, PhysionError) else f"{type(error).__name__}: {text}"
