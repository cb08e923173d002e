"""Many files, one after the other failing alone: how export and import go through their work."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from physion.compute.executor import Executor
from physion.errors import PhysionError
from physion.trials.making.generate import HOPELESS, Track

T = TypeVar("T")


@dataclass(frozen=True)
class OfficialReport:
    """What an export or import did.

    ``made`` and ``kept`` name trials that were written and that were there already; ``failed``
    says why, by name. ``notes`` are what one should know of a trial, by name. ``index`` is the
    path of the list of all.
    """

    made: tuple[str, ...]
    kept: tuple[str, ...]
    failed: Mapping[str, str]
    notes: Mapping[str, tuple[str, ...]]
    index: Path

    @property
    def exit_code(self) -> int:
        """0, or 1 where a trial failed."""
        return 1 if self.failed else 0


def run_all(
    function: Callable[[T], Any],
    jobs: Mapping[str, T],
    executor: Executor | None,
    track: Track | None,
    what: str,
    out: Path,
) -> tuple[dict[str, Any], dict[str, str]]:
    """Results of the jobs by name, in their order, and why the others failed.

    ``executor`` is by default one process a core; ``track`` shows progress under the name
    ``what``. Raises `PhysionError` where nothing more can be written into ``out``.
    """
    if executor is None:
        from physion.compute.local import LocalExecutor

        executor = LocalExecutor()
    results: dict[str, Any] = {}
    failed: dict[str, str] = {}
    outcomes = executor.map(function, jobs)
    try:
        for outcome in track(outcomes, what, len(jobs)) if track else outcomes:
            if outcome.error is None:
                results[outcome.key] = outcome.value
            elif outcome.errno in HOPELESS:
                raise PhysionError(
                    f"cannot write into {out}: {outcome.error}; {len(results)} new trials are "
                    "whole, and the same command goes on from there"
                )
            else:
                failed[outcome.key] = outcome.error
    finally:
        # Workers must have stopped before the folder is given to someone else.
        if isinstance(outcomes, Generator):
            outcomes.close()
    return {name: results[name] for name in jobs if name in results}, failed
