"""Send simulated participants through a study, by HTTP as a browser does: a pilot of the server.

Their sessions are marked as simulated for good and never counted with people. They are right with a
probability that depends on person and stimulus; for that they read the outcomes in the study
folder, which the server never sends. The same --seed sends the same people: who finished before
stays as is, who left comes back (to the end with --dropouts 0). Exit code 1 where a participant did
not get through.
"""

from __future__ import annotations

import asyncio
import json as json_module
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from physion.experiment.simulated.participants import SimulationPlan, Visit
    from physion.experiment.study.study import Study


@dataclass(frozen=True)
class Options:
    """Who goes through which study."""

    study: Annotated[Path, tyro.conf.Positional]
    """Study folder, the one that is served."""
    participants: int = 20
    """So many, spread over the scenarios in turn."""
    scenario: str | None = None
    """One scenario; all of the study if not given."""
    url: str | None = None
    """A running server, such as http://127.0.0.1:8000; if not given, one is started and stopped."""
    database: str | None = None
    """URL of a PostgreSQL database for the server that is started."""
    pace: float = 0.0
    """Seconds before each answer; people take about 6."""
    seed: int = 0
    """Other seeds send other people."""
    dropouts: float = 0.1
    """Share of people who close the page before a random test trial."""
    at_once: int = 50
    """Most people at the same time."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Simulate; 1 if someone was refused or got no answer."""
    from physion.cli.experiment.experiment import require_extra

    require_extra()
    from physion.experiment.simulated.participants import SimulationPlan, simulate
    from physion.experiment.study.identity import Secrets
    from physion.experiment.study.study import load_study

    _check(options)
    study = load_study(options.study)
    secrets = Secrets.load(options.study)
    with _server(options) as url, _progress(options) as visited:
        plan = SimulationPlan(
            url=url,
            participants=options.participants,
            scenario=options.scenario,
            pace=options.pace,
            seed=options.seed,
            dropouts=options.dropouts,
            at_once=options.at_once,
        )
        visits = asyncio.run(simulate(study, secrets, plan, visited))
    _print(summary(study, plan, visits), options.json)
    return 1 if any(visit.outcome in ("refused", "failed") for visit in visits) else 0


def summary(study: Study, plan: SimulationPlan, visits: list[Visit]) -> dict[str, Any]:
    """What is printed: outcomes, answers, repeated requests, accuracy, reasons of failures."""
    right = [visit.result.accuracy for visit in visits if visit.result is not None]
    return {
        "study": study.name,
        "url": plan.url,
        "participants": len(visits),
        **Counter(visit.outcome.replace(" ", "_") for visit in visits),
        "answers": sum(len(visit.answers) for visit in visits),
        "asked_again": sum(visit.retries for visit in visits),
        "mean_accuracy": round(sum(right) / len(right), 4) if right else None,
        "reasons": dict(Counter(visit.reason for visit in visits if visit.reason)),
    }


def _check(options: Options) -> None:
    from physion.errors import BadInputError

    if options.participants < 1 or options.at_once < 1:
        raise BadInputError("--participants and --at-once must be 1 or more")
    if options.database is not None and options.url is not None:
        raise BadInputError("--database goes with a server that is started here, not with --url")
    if not 0 <= options.dropouts <= 1:
        raise BadInputError(f"--dropouts must be from 0 to 1, not {options.dropouts:g}")
    if not 0 <= options.pace <= 3600:
        raise BadInputError(f"--pace must be from 0 to 3600 seconds, not {options.pace:g}")


@contextmanager
def _server(options: Options) -> Iterator[str]:
    if options.url is not None:
        yield options.url.rstrip("/")
        return
    from physion.experiment.simulated.server_process import ServerProcess

    with ServerProcess(options.study, options.database) as server:
        yield server.url


@contextmanager
def _progress(options: Options) -> Iterator[Any]:
    from physion.cli.output import Stages

    with Stages() as stages:
        done = 0

        def visited(visit: Visit) -> None:
            nonlocal done
            done += 1
            stages("participants", done, options.participants)

        stages("participants", 0, options.participants)
        yield visited


def _print(found: dict[str, Any], json: bool) -> None:
    from physion.cli.output import console

    if json:
        print(json_module.dumps(found))
        return
    outcomes = ("done", "done_before", "left", "refused", "failed")
    words = [f"{found[name]} {name.replace('_', ' ')}" for name in outcomes if name in found]
    line = f"{', '.join(words)}; {found['answers']} answers, {found['asked_again']} asked again"
    if found["mean_accuracy"] is not None:
        line += f", mean accuracy {found['mean_accuracy']:.3f}"
    console.print(line, markup=False, soft_wrap=True)
    for reason, count in found["reasons"].items():
        console.print(f"{count} times: {reason}", markup=False, soft_wrap=True)
