"""Compare predictions with people: a table on the terminal, and a report with figures.

PREDICTIONS are tables with at least two columns, stimulus and p_contact. What is compared:
  PREDICTIONS                    models with the people of the original study
  PREDICTIONS --responses FILE   models with the participants of a study
  PREDICTIONS --population       seeds or checkpoints of a model with people, as two populations
  --responses FILE               nothing: a report about the participants
  --check PREDICTIONS            nothing: names every bad row; exit code 1 if one has an error
  --published                    the numbers of the paper with what its released tables give
"""

from __future__ import annotations

import json as json_module
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from physion.analysis.check import Checked


@dataclass(frozen=True)
class Options:
    """Predictions and people to compare."""

    predictions: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Files of predictions. Without any, --responses gives a report about people only."""
    humans: Path | None = None
    """Answers of people by stimulus: official (shipped with the package), or a folder with
    human_accuracy-*.csv; if not given, official for stimuli of the original study."""
    responses: tuple[Path, ...] = ()
    """Answers of single participants, in place of --humans: our export or the study's raw files."""
    labels: Path | None = None
    """Outcomes: official, or a table (stimulus, contact); default: as in the people's table."""
    sessions: Path | None = None
    """Table of sessions of our export: demographics, order of sessions."""
    rules: str | None = None
    """Exclusion rules: preregistered, preregistered-only (without what the experiment's server
    found) or official-code; if not given, as in the exported study, else preregistered."""
    expected: Path | None = None
    """Table of the test stimuli of each scenario (stimulus, scenario); if not given,
    expected.csv next to the responses, else the stimuli that half of the scenario's sessions
    answered."""
    simulated: bool = False
    """Rehearse with the simulated participants of --responses; every page is marked."""
    where: tuple[str, ...] = ()
    """Only the sessions with these values, such as condition=fast; columns: condition, language,
    recruited_by, gender, education, buttons, study."""
    dataset: Path | None = None
    """Dataset of the trials: the page shows its testing movies; --check tests that no predicted
    trial, scene or motion is also in another split."""
    attributes: Path | None = None
    """Properties of the stimuli, such as their numbers of elements, distractors and occluders: a
    table (CSV, parquet) or a dataset; if not given, as official names say."""
    rollout_errors: tuple[Path, ...] = ()
    """Files of evaluate --option rollout_errors=true: a figure of the errors of imagined motion
    over time."""
    groups: tuple[str, ...] = ()
    """Compare groups of models by these columns of the predictions, such as encoder_type, or by the
    columns of a CSV file with model and any others."""
    population: bool = False
    """Take rows that differ only in their seed or file of weights as one population, and compare
    it with people as another; if no rows do, take all models together."""
    exclude: Path | None = None
    """File of stimuli to exclude, one per line."""
    fitted: Path | None = None
    """With --check: the stimuli on which the readout was fitted, one per line."""
    resamples: int = 1000
    """Draws of people for their accuracy, agreement and biases."""
    seed: int = 0
    """Seed of the draws of people, of halves of people and of permutations."""
    out: Path | None = None
    """Folder for the report; if not given, runs/report, and nothing for --published."""
    check: bool = False
    """Check the files, and compare nothing."""
    published: bool = False
    """Recompute the published numbers from the tables of --humans (default: official)."""
    json: bool = False
    """Print every table as one JSON object."""


def main(options: Options) -> int:
    """Print the table of results and where the report is."""
    from physion.core.errors import BadInputError

    if options.check and options.published:
        raise BadInputError("--check and --published are two things: give one of them")
    if options.published:
        return _published(options)
    return _check(options) if options.check else _compare(options)


def _compare(options: Options) -> int:
    from physion.cli.output import Stages, print_line, print_scores, print_warnings, text_table
    from physion.report.compare import compare, population_tables
    from physion.report.html import movies_of

    movies = {} if options.dataset is None else movies_of(options.dataset)
    with Stages() as stages:
        result = compare(
            options.predictions,
            humans=options.humans,
            responses=options.responses,
            labels=options.labels,
            sessions=options.sessions,
            rules=options.rules,
            expected=options.expected,
            simulated=options.simulated,
            where=options.where,
            attributes=options.attributes,
            groups=options.groups,
            population=options.population,
            exclude=options.exclude or (),
            rollout_errors=options.rollout_errors,
            resamples=options.resamples,
            seed=options.seed,
            progress=stages,
        )
    page = result.report(options.out or Path("runs/report"), movies=movies)
    print_warnings(result.warnings)
    if options.json:
        from physion.analysis.tables import records

        numbers = json_module.loads((page.parent / "report.json").read_text(encoding="utf-8"))
        scores = records(result.scores)
        print(json_module.dumps({"report": str(page), "scores": scores, **numbers}))
    else:
        print_scores(result, page)
        if result.population is not None:
            print_line("")
            for title, table in population_tables(result.population).items():
                print_line(text_table(table, title) + "\n")
    return 0


def _check(options: Options) -> int:
    """Print the faults; return 1 if one of them is an error."""
    from physion.report.compare import check_files

    found = check_files(
        options.predictions,
        humans=options.humans,
        responses=options.responses,
        labels=options.labels,
        sessions=options.sessions,
        rules=options.rules,
        expected=options.expected,
        dataset=options.dataset,
        fitted=options.fitted,
    )
    if options.json:
        print(json_module.dumps([{**asdict(each), "errors": each.errors} for each in found]))
    else:
        for each in found:
            _print_checked(each)
    return 1 if any(each.errors for each in found) else 0


def _print_checked(checked: Checked) -> None:
    from physion.cli.output import counted, print_line

    for fault in checked.faults:
        print_line(f"{checked.file}: {fault}")
    for words in checked.not_checked:
        print_line(f"{checked.file}: not checked: {words}")
    errors, warnings = checked.errors, len(checked.faults) - checked.errors
    what = counted(len(checked.models), "model")
    if checked.people:
        what = ", ".join(
            f"{scenario}: {counted(n, 'person', 'people')}"
            for scenario, n in checked.people.items()
        )
    print_line(
        f"{checked.file}: {counted(checked.rows, 'row')}, {what}, {counted(errors, 'error')}, "
        f"{counted(warnings, 'warning')}"
    )


def _published(options: Options) -> int:
    """Print the published numbers next to ours; write a page if asked."""
    from physion.cli.output import print_line, text_table
    from physion.data.official import PACKAGED
    from physion.report.published import (
        build_published_report,
        published_numbers,
        published_parts,
        recompute_published,
    )

    results = recompute_published(options.humans or PACKAGED)
    page = None if options.out is None else build_published_report(results, options.out)
    if options.json:
        print(json_module.dumps(published_numbers(results), indent=1))
        return 0
    for words, table in published_parts(results):
        print_line((words if table is None else text_table(table, words)) + "\n")
    if page is not None:
        print_line(f"report: {page}")
    return 0
