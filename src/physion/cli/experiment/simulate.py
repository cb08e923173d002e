"""Run simulated participants through a study over HTTP, as a browser does, to test the server.

Their sessions are permanently marked as simulated and never counted with people. They answer
correctly with a probability that depends on person and stimulus; for this they read the outcomes in
the study folder, which the server never sends. They take as long as people, unless simulated_speed
in study.toml lets them be faster. The same --seed gives the same participants: those who have
finished are left as they are, those who dropped out continue (to the end with --dropouts 0). The
exit status is 1 if any participant was refused or failed.
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
    from physion.experiment.simulated import SimulatedVisit, SimulationPlan
    from physion.experiment.study.study import Study


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment simulate``."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    participants: int = 20
    """Number of participants, distributed over the scenarios in turn."""
    scenario: str | None = None
    """Only this scenario. Default: all scenarios of the study."""
    url: str | None = None
    """URL of a running server, such as http://127.0.0.1:8000. Default: start one and stop it."""
    seed: int = 0
    """Seed of the participants."""
    dropouts: float = 0.1
    """Fraction of participants who close the page before a random test trial."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Simulate; return exit status 1 if any participant was refused or failed."""
    from physion.experiment.simulated import SimulationPlan, simulate
    from physion.experiment.study.identity import Secrets
    from physion.experiment.study.study import load_study

    _check(options)
    study = load_study(options.study)
    secrets = Secrets.load(options.study)
    _tell_duration(study, options)
    with _server(options) as url, _progress(options) as visited:
        plan = SimulationPlan(
            url=url,
            participants=options.participants,
            scenario=options.scenario,
            seed=options.seed,
            dropouts=options.dropouts,
        )
        visits = asyncio.run(simulate(study, secrets, plan, visited))
    _print(summary(study, plan, visits), options.json)
    return 1 if any(visit.outcome in ("refused", "failed") for visit in visits) else 0


def _tell_duration(study: Study, options: Options) -> None:
    """Print how long a participant takes, if that is more than a minute."""
    from physion.cli.output import console
    from physion.experiment.simulated import minutes_each

    minutes = max(minutes_each(study, scenario) for scenario in study.scenarios)
    if minutes > 1 and not options.json:
        console.print(
            f"each participant takes about {minutes:.0f} minutes, as people do; simulated_speed in "
            f"{options.study / 'study.toml'} makes them faster",
            markup=False,
            soft_wrap=True,
        )


def summary(study: Study, plan: SimulationPlan, visits: list[SimulatedVisit]) -> dict[str, Any]:
    """Return counts of outcomes, answers and repeated requests, mean accuracy, failure reasons."""
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
    """Check that the options are valid and consistent."""
    from physion.core.errors import BadInputError

    if options.participants < 1:
        raise BadInputError("--participants must be 1 or more")
    if not 0 <= options.dropouts <= 1:
        raise BadInputError(f"--dropouts must be from 0 to 1, not {options.dropouts:g}")


@contextmanager
def _server(options: Options) -> Iterator[str]:
    """Yield the URL of the given server, or of one that is started for the duration."""
    if options.url is not None:
        yield options.url.rstrip("/")
        return
    from physion.experiment.server_process import ServerProcess

    with ServerProcess(options.study) as server:
        yield server.url


@contextmanager
def _progress(options: Options) -> Iterator[Any]:
    """Display a progress bar; yield the function to call after each participant."""
    from physion.cli.output import Stages

    with Stages() as stages:
        done = 0

        def visited(visit: SimulatedVisit) -> None:
            nonlocal done
            done += 1
            stages("participants", done, options.participants)

        stages("participants", 0, options.participants)
        yield visited


def _print(values: dict[str, Any], json: bool) -> None:
    """Print the summary as text or JSON."""
    from physion.cli.output import console

    if json:
        print(json_module.dumps(values))
        return
    outcomes = ("done", "done_before", "left", "screened_out", "refused", "failed")
    words = {"left": "dropped out"}
    counts = [
        f"{values[name]} {words.get(name, name.replace('_', ' '))}"
        for name in outcomes
        if name in values
    ]
    repeated = f"{values['asked_again']} requests repeated"
    line = f"{', '.join(counts)}; {values['answers']} answers, {repeated}"
    if values["mean_accuracy"] is not None:
        line += f", mean accuracy {values['mean_accuracy']:.3f}"
    console.print(line, markup=False, soft_wrap=True)
    for reason, count in values["reasons"].items():
        console.print(f"{count} times: {reason}", markup=False, soft_wrap=True)
