"""Callback through which long-running functions report how far they are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

T = TypeVar("T")


class Progress(Protocol):
    """Callback that is called after each step, and with ``done`` 0 where a loop begins.

    `physion.cli.output.Stages` is the one of the command line.
    """

    def __call__(self, what: str, done: int, total: int, /) -> None:
        """Show that ``done`` of ``total`` steps of the stage ``what`` are finished."""
        ...


def tracked(items: Iterable[T], what: str, total: int, progress: Progress | None) -> Iterator[T]:
    """Yield ``items``, of which there are ``total``; ``progress`` learns when each was used."""
    if progress is None:
        yield from items
        return
    progress(what, 0, total)
    for done, item in enumerate(items, start=1):
        yield item
        progress(what, done, total)
