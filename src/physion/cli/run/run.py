"""Run the whole pipeline: scenes, physics, rendering, trials, models, readouts, report.

Without options, a balanced sample of the official scenes that ship with the package is simulated
and rendered, models predict them, and all are compared with the people of the original study. A
second run resumes, and a larger --limit only adds.
"""

from __future__ import annotations

import json as json_module
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physion.cli.output import Stages, console
from physion.cli.run.finished import finished, record_finished
from physion.cli.run.options import Options
from physion.core.errors import BadInputError
from physion.trials.files import INDEX

__all__ = ["Options", "main"]

if TYPE_CHECKING:
    from physion.trials.making.plan import TrialTask


def main(options: Options) -> int:
    """Run the whole pipeline, or what is missing of it; return 1 if some trials failed."""
    started = time.monotonic()
    options = _complete(options)
    assert options.out is not None
    answer, took = finished(options, options.out), ""
    if answer is None:
        answer = _run(options, options.out)
        minutes, seconds = divmod(round(time.monotonic() - started), 60)
        took = f", made in {minutes} min {seconds} s"
    if options.json:
        print(json_module.dumps(answer, indent=1))
    else:
        for failure in answer["failures"]:
            console.print(f"failed: {failure}", markup=False, soft_wrap=True)
        rows = len({row["agent"] for row in answer["scores"]})
        line = f"report, {rows} rows{took}: {answer['report']}"
        console.print(line, markup=False, soft_wrap=True)
    return 1 if answer["failures"] else 0


def _run(options: Options, folder: Path) -> dict[str, Any]:
    """Make trials, predictions and report; return the page, the scores and the failures."""
    from physion.cli.run.plan import plan_official, plan_sampled
    from physion.cli.run.predict import check_models, predict
    from physion.cli.run.report import write_report

    check_models(options)
    plan = (
        plan_sampled(options.limit)
        if options.sampled
        else plan_official(options.scenes, options.humans, options.limit)
    )
    failures = [*plan.failures, *write_trials(options, folder, plan.tasks)]
    predictions, problems = predict(options, folder)
    page, scores = write_report(options, folder, plan, predictions)
    failures += problems
    answer = {"report": str(page), "scores": scores, "failures": failures}
    if not failures:
        written = [path for path in page.parent.rglob("*") if path.suffix in (".html", ".csv")]
        files = [folder / "trials" / INDEX, *predictions, *written]
        record_finished(options, folder, files, answer)
    return answer


def _complete(options: Options) -> Options:
    """Return the options with what follows from others; raise `BadInputError` if they disagree."""
    from physion.data.official import find_official, humans_folder

    if options.sampled and options.humans is not None:
        raise BadInputError("--sampled scenes were seen by nobody: leave out --humans")
    least = 1 if options.sampled else 0
    if options.limit is not None and options.limit < least:
        raise BadInputError(f"--limit must be at least {least}, not {options.limit}")
    out = options.out or Path("runs") / ("sampled" if options.sampled else "official")
    humans = options.humans
    if not options.sampled and humans is None and find_official(options.scenes) is not None:
        humans = options.scenes
    humans = None if humans is None else humans_folder(humans)
    return replace(options, out=out, humans=humans)


def write_trials(options: Options, folder: Path, tasks: list[TrialTask]) -> list[str]:
    """Simulate, label, render and store missing trials; return the failures."""
    from physion.compute.local import LocalExecutor
    from physion.trials.making.generate import make_trials
    from physion.trials.making.plan import GenerateSettings

    with Stages() as stages:
        report = make_trials(
            folder / "trials",
            tasks,
            GenerateSettings(
                width=options.size,
                height=options.size,
                look="redyellow",
                jitters=0,
                engine=options.engine,
            ),
            executor=LocalExecutor(workers=options.workers),
            progress=stages,
        )
    return [f"{name}: {reason}" for name, reason in report.failed.items()]
