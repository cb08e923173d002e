"""Measure this machine: simulation, rendering and making of trials, one row for each scenario.

Times are of the processor, on one core. On a machine that does other work at the same time they are
longer. The README has the same quantities on the project's machine.
"""

from __future__ import annotations

import dataclasses
import json as json_module
import os
from dataclasses import dataclass

import pandas as pd

from physion.cli.output import Stages, console
from physion.cli.text_table import text_table
from physion.compute.tasks import processor
from physion.core.errors import BadInputError
from physion.core.version import MADE_WITH
from physion.scenes.sampling.build import scenarios

COLUMNS = {
    "scenario": "scenario",
    "simulate_ms": "simulate, ms",
    "real_time": "times real time",
    "agreement": "agree",
    "color_ms": "colour, ms a frame",
    "passes_ms": "all passes",
    "choose_s": "choose, s a trial",
    "make_s": "make",
    "frames_per_s": "frames/s a core",
    "megabytes": "MB",
}
"""Columns of the table by the field of `BenchRow`."""


@dataclass(frozen=True)
class Options:
    """Options of ``physion bench``."""

    scenario: str = "all"
    """Name of a scenario, or all."""
    count: int = 2
    """Official scenes and trials of each scenario."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Measure and print the table."""
    if options.count < 1:
        raise BadInputError(f"--count must be 1 or more, not {options.count}")
    names = scenarios.names() if options.scenario == "all" else [options.scenario]
    for name in names:
        scenarios.get(name)
    # Imported late: loading the compiled renderer takes time.
    from physion.cli.bench.measure import measure

    rows = []
    with Stages() as stages:
        stages("measuring", 0, len(names))
        for done, name in enumerate(names, start=1):
            rows.append(measure(name, options.count))
            stages("measuring", done, len(names))
    machine = processor()
    if options.json:
        values = {"package": MADE_WITH, "machine": machine, "cores": os.cpu_count()}
        found = [dataclasses.asdict(row) for row in rows]
        print(json_module.dumps(values | {"count": options.count, "scenarios": found}, indent=1))
        return 0
    table = pd.DataFrame(map(dataclasses.asdict, rows)).rename(columns=COLUMNS)
    title = f"{MADE_WITH}, {machine}, one of {os.cpu_count()} cores"
    console.print(text_table(table, title), markup=False, soft_wrap=True)
    return 0
