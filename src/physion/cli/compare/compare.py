"""Compare predictions with people and write the report: tables, figures, one page.

`physion compare FILES... --humans DIR`: the comparison and its report (the options below).

`physion compare --responses FILE`: a report about people alone.

`physion compare official DIR`: the published numbers beside those that can be recomputed.

`physion compare validate FILE...`: checks files of predictions and names each bad row.

`physion compare power`: how many people and stimuli a study needs.

A file that is called like one of these words is meant by ./official and so on.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

SUBVERBS = {
    "official": "physion.cli.compare.official",
    "validate": "physion.cli.compare.validate",
    "power": "physion.cli.compare.power",
}
"""Sub-commands and their modules."""


@dataclass(frozen=True)
class Options:
    """Predictions and people to compare."""

    predictions: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Prediction files with the official column names; none with --responses: people alone."""
    humans: Path | None = None
    """Answers of people by stimulus: official (those of the package), a folder made by
    physion import, or one with human_accuracy-*.csv."""
    labels: Path | None = None
    """Official outcomes (stim_ID, label); if not given, looked for next to the folder of people."""
    responses: tuple[Path, ...] = ()
    """Answers of single participants, in place of --humans: our export or the study's raw files."""
    sessions: Path | None = None
    """Table of sessions of our export: demographics, order of sessions."""
    rules: str | None = None
    """Exclusion rules: preregistered (if not given) or official-code."""
    expected: Path | None = None
    """Table of the stimuli (stimulus) that each session, or each scenario, must have; if not given,
    expected.csv beside the responses, else those that half of the scenario's sessions answered."""
    accept_rules: tuple[str, ...] = ()
    """Exclusion rules that may leave out more than a third of a scenario's sessions: streak,
    alternation, familiarization, low_accuracy, slow, incomplete, repeated."""
    simulated: bool = False
    """Rehearse with the simulated participants of --responses alone; every page is marked."""
    where: tuple[str, ...] = ()
    """Only the sessions with these values, such as condition=fast; columns: condition, language,
    recruited_by, gender, education, buttons, study."""
    attributes: Path | None = None
    """Elements, distractors, occluders of the stimuli: a table (CSV, parquet) or a dataset; if not
    given, by official names."""
    movies: Path | None = None
    """Dataset whose testing trials' movies the page shows."""
    rollout_error: tuple[Path, ...] = ()
    """Files of evaluate --rollout-error: a figure of the errors of imagined motion over time."""
    trial_pages: bool = False
    """Also write a page for each stimulus, to trials/ in the folder of the report."""
    zone: Path | None = None
    """Official percentiles of participants; if not given, looked for next to the people."""
    dominoes: Literal["plain", "redyellow", "pooled"] | None = None
    """Which people count for Dominoes in --humans; default plain: free colours, as in the paper."""
    exclude: Path | None = None
    """File of stimuli to exclude, one a line."""
    ledge: bool = False
    """Keep the Roll stimuli with a ledge, which the study excluded."""
    resamples: int | None = None
    """Draws of people for their accuracy, agreement and biases; 1000 if not given."""
    seed: int | None = None
    """Seed of these draws, of halves of people and of permutations; 0 if not given."""
    out: Path = Path("runs/report")
    """Folder for the report."""
    json: bool = False
    """Print every table of the report as one JSON object."""


def main(options: Options) -> int:
    """Write the report and print its path."""
    from physion.cli.output import console, print_warnings
    from physion.data.official import humans_folder
    from physion.report.build import compare_files

    page = compare_files(
        list(options.predictions),
        None if options.humans is None else humans_folder(options.humans),
        options.labels,
        options.out,
        exclude_ledge=not options.ledge,
        **_given(options),
    )
    numbers = json_module.loads((page.parent / "report.json").read_text(encoding="utf-8"))
    print_warnings(numbers["warnings"])
    if options.json:
        print(json_module.dumps({"report": str(page), **numbers}))
    else:
        console.print(f"report: {page}", markup=False, soft_wrap=True)
    return 0


def _given(options: Options) -> dict[str, Any]:
    """The options that were given, by the names that `compare_files` has for them."""
    from physion.analysis.intervals import Bootstrap
    from physion.core.errors import BadInputError
    from physion.report.html import movies_of

    same = ("responses", "sessions", "rules", "expected", "accept_rules", "attributes", "zone",
            "dominoes", "exclude", "trial_pages", "simulated", "where")  # fmt: skip
    found = {name: getattr(options, name) for name in same if getattr(options, name)}
    if options.rollout_error:
        found["rollout_errors"] = options.rollout_error
    draws = {"resamples": options.resamples, "seed": options.seed}
    try:
        chosen = {name: value for name, value in draws.items() if value is not None}
        found["bootstrap"] = Bootstrap(**chosen)
    except ValueError as error:
        raise BadInputError(f"--resamples {options.resamples}: {error}") from error
    if options.movies is not None:
        found["movies"] = movies_of(options.movies)
    return found
