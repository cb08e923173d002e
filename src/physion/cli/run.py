"""Run the whole pipeline: scenes, physics, rendering, trials, models, readouts, report.

Without options, a balanced sample of the official scenes that ship with the package is simulated
and rendered, models predict them, and all are compared with the people of the original study. A
second run resumes, and a larger --limit only adds.
"""

from __future__ import annotations

import json as json_module
import time
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from physion.analysis.tables import records
from physion.cli.arguments import take_options
from physion.cli.output import Stages, print_line, print_scores, print_warnings
from physion.pipeline import RunSettings, chosen_models, run
from physion.readout.settings import options_by_model


@dataclass(frozen=True)
class Options:
    """Options of ``physion run``."""

    settings: Annotated[RunSettings, tyro.conf.arg(name="")] = field(default_factory=RunSettings)
    """Scenes, models, folder and sizes."""
    option: tuple[str, ...] = ()
    """Settings of the models or of their training as NAME=VALUE, such as steps=1000; of one model
    as MODEL:NAME=VALUE, such as noisy-simulation:samples=50. Of the run: encoder_batch=1, clips
    that a network encodes at a time (default: 4); lower it when memory runs out."""
    json: bool = False
    """Print one JSON object instead of a table."""


def main(options: Options) -> int:
    """Run the whole pipeline, or what is missing of it; return 1 if something failed."""
    started = time.monotonic()
    settings, of_models = take_options(options.settings, options.option)
    given = options_by_model(chosen_models(settings), of_models)
    with Stages(at_once=True) as stages:
        done = run(settings, options=given, progress=stages, on_evaluated=stages.note_evaluated)
    print_warnings(done.warnings)
    if options.json:
        rows = records(done.result.scores)
        answer = {"report": str(done.report), "scores": rows, "failures": done.failures}
        print(json_module.dumps(answer, indent=1))
        return 1 if done.failures else 0
    for failure in done.failures:
        print_line(f"failed: {failure}")
    minutes, seconds = divmod(round(time.monotonic() - started), 60)
    print_scores(done.result, done.report, f", made in {minutes} min {seconds} s")
    return 1 if done.failures else 0
