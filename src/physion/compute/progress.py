"""Callbacks through which long-running functions report how far they are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

T = TypeVar("T")


class Track(Protocol):
    """Callback that wraps a loop: it passes items on and shows how many are done.

    `physion.cli.output.track` is the one of the command line.
    """

    def __call__(self, items: Iterable[T], what: str, total: int, /) -> Iterator[T]:
        """Yield ``items``, of which there are ``total``; ``what`` is the label to show."""
        ...


class Progress(Protocol):
    """Callback for functions with nested loops, called after each step.

    `physion.cli.output.Stages` is the one of the command line.
    """

    def __call__(self, what: str, done: int, total: int, /) -> None:
        """Show that ``done`` of ``total`` steps of the stage ``what`` are finished."""
        ...


def tracked(items: Iterable[T], what: str, total: int, track: Track | None) -> Iterator[T]:
    """Yield ``items`` through ``track``, or as they are if it is None."""
    yield from items if track is None else track(items, what, total)
