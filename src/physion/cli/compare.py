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
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    import pandas as pd

    from physion.analysis.check import Checked, Reference
    from physion.analysis.population import PopulationResults
    from physion.analysis.published.claims import PublishedResults
    from physion.report.compare import CompareResult


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
    """Table of the stimuli (stimulus) that each session, or each scenario, must have; if not given,
    expected.csv next to the responses, else the stimuli that half of the scenario's sessions
    answered."""
    accept_rules: tuple[str, ...] = ()
    """Exclusion rules that may leave out more than a third of a scenario's sessions: streak,
    alternation, familiarization, low_accuracy, slow, incomplete, repeated."""
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
    trial_pages: bool = False
    """Also write a page for each stimulus, to trials/ in the folder of the report."""
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
    from physion.cli.output import print_scores, print_warnings
    from physion.report.compare import compare
    from physion.report.html import movies_of

    movies = {} if options.dataset is None else movies_of(options.dataset)
    result = compare(
        options.predictions,
        humans=options.humans,
        responses=options.responses,
        labels=options.labels,
        sessions=options.sessions,
        rules=options.rules,
        expected=options.expected,
        accept_rules=options.accept_rules,
        simulated=options.simulated,
        where=options.where,
        attributes=options.attributes,
        groups=options.groups,
        population=options.population,
        exclude=options.exclude or (),
        rollout_errors=options.rollout_errors,
        resamples=options.resamples,
        seed=options.seed,
    )
    page = result.report(
        options.out or Path("runs/report"), movies=movies, trial_pages=options.trial_pages
    )
    print_warnings(result.warnings)
    if options.json:
        from physion.analysis.tables import records

        numbers = json_module.loads((page.parent / "report.json").read_text(encoding="utf-8"))
        scores = records(result.scores)
        print(json_module.dumps({"report": str(page), "scores": scores, **numbers}))
    else:
        _print_left_out(result)
        _print_changed(result)
        print_scores(result, page)
        if result.population is not None:
            _print_population(result.population)
    return 0


def _print_population(results: PopulationResults) -> None:
    """Print consensus and agreement in the mean over scenarios, and differences by scenario."""
    from physion.analysis.tables import MEAN

    consensus, agreement = (
        t[t["scenario"] == MEAN] for t in (results.consensus, results.agreement)
    )
    _print("")
    first = consensus[["population", "members", "ties", "stimuli"]].assign(
        **_texts(consensus, {"accuracy of the consensus": "consensus", "of a member": "member"}),
        **{"SD of members": consensus["member_sd"]},
    )
    _show("Populations: mean over scenarios; 95 % intervals over stimuli", first)
    kappas = {"kappa of members": "kappa_members", "kappa of majorities": "kappa_majorities"}
    apart = {"members disagree": "disagreement_members",
             "majorities disagree": "disagreement_majorities"}  # fmt: skip
    second = agreement[["first", "second"]].assign(**_texts(agreement, kappas | apart))
    _show("Two members, and two majorities (of one population: of its halves)", second)
    if len(results.differences):
        names = {"of the consensus": "consensus", "of a member": "member"}
        third = results.differences[["population", "scenario", "stimuli"]].assign(
            **_texts(results.differences, names)
        )
        _show("Accuracy less people's", third)


def _texts(table: pd.DataFrame, columns: Mapping[str, str]) -> dict[str, list[str]]:
    """Return columns of a table with their intervals as texts, by heading."""
    from physion.report.compare import with_interval

    return {
        heading: [with_interval(row, name) for _, row in table.iterrows()]
        for heading, name in columns.items()
    }


def _print_left_out(result: CompareResult) -> None:
    """Say how many stimuli of the predictions are left out, and why."""
    from physion.analysis.comparison import NOT_PREDICTED
    from physion.report.inputs import ReportInputs

    if isinstance(result.inputs, ReportInputs):
        dropped = result.inputs.comparison.dropped
        given = dropped[(dropped["model"] != "") & (dropped["reason"] != NOT_PREDICTED)]
        counts = given.groupby("reason", sort=False)["stimuli"].max()
        for reason, count in counts.items():
            _print(f"note: {count} stimuli left out: {reason}")


def _print_changed(result: CompareResult) -> None:
    """Name the stimuli whose simulated outcome is not the recorded one."""
    from physion.report.inputs import ReportInputs

    if not isinstance(result.inputs, ReportInputs) or result.inputs.comparison.changed.empty:
        return
    comparison = result.inputs.comparison
    names, shown = list(comparison.changed["stimulus"]), 5
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    _print(
        f"note: {len(names)} of {comparison.stimuli['stimulus'].nunique()} stimuli ended otherwise "
        f"in a simulation than recorded; the recorded outcome counts: {', '.join(names[:shown])}"
        f"{more} (tables/changed_outcomes.csv)"
    )


# --- check ---------------------------------------------------------------------------------------


def _check(options: Options) -> int:
    """Print the faults; return 1 if one of them is an error."""
    from physion.analysis.check import check_predictions_file
    from physion.core.errors import BadInputError

    if not options.predictions and not options.responses:
        raise BadInputError("nothing to check: give files of predictions, or --responses")
    reference = _reference(options)
    found = []
    if options.responses:
        checked, outcomes = _check_responses(options, reference.labels)
        found.append(checked)
        if reference.labels is None and outcomes:
            reference = replace(reference, labels=outcomes)
    found += [check_predictions_file(path, reference) for path in options.predictions]
    if options.json:
        print(json_module.dumps([{**asdict(each), "errors": each.errors} for each in found]))
    else:
        for each in found:
            _print_checked(each)
    return 1 if any(each.errors for each in found) else 0


def _reference(options: Options) -> Reference:
    from physion.analysis.check import Reference, read_index
    from physion.analysis.tables import LABELS_FILE, read_stimulus_list
    from physion.core.errors import BadInputError
    from physion.report.compare import read_averages, read_outcomes

    labels = read_outcomes(options.labels)
    if labels is None and options.humans is not None:
        _, labels, _, _ = read_averages(options.humans)
        if labels is None:
            raise BadInputError(f"no {LABELS_FILE} lies near {options.humans}; give --labels")
    return Reference(
        labels=labels,
        index=None if options.dataset is None else read_index(options.dataset),
        fitted=None if options.fitted is None else read_stimulus_list(options.fitted),
    )


def _check_responses(
    options: Options, labels: Mapping[str, bool] | None
) -> tuple[Checked, dict[str, bool]]:
    """Check the responses, and return the outcomes of the stimuli that people answered."""
    from physion.analysis.check import check_responses
    from physion.analysis.people.exclusions import find_expected, read_expected
    from physion.analysis.people.results import rules_called

    path = options.expected or find_expected(options.responses)
    checked, responses = check_responses(
        options.responses,
        options.sessions,
        labels,
        None if path is None else read_expected(path),
        rules_called(options.rules, options.responses),
    )
    if responses is None:
        return checked, {}
    rows = responses.test.drop_duplicates("stimulus")
    return checked, dict(zip(rows["stimulus"], rows["label"].astype(bool), strict=True))


def _print_checked(checked: Checked) -> None:
    from physion.cli.output import counted

    for fault in checked.faults:
        _print(f"{checked.file}: {fault}")
    for words in checked.not_checked:
        _print(f"{checked.file}: not checked: {words}")
    errors, warnings = checked.errors, len(checked.faults) - checked.errors
    what = counted(len(checked.models), "model")
    if checked.people:
        what = ", ".join(
            f"{scenario}: {counted(n, 'person', 'people')}"
            for scenario, n in checked.people.items()
        )
    _print(
        f"{checked.file}: {counted(checked.rows, 'row')}, {what}, {counted(errors, 'error')}, "
        f"{counted(warnings, 'warning')}"
    )


# --- published numbers ---------------------------------------------------------------------------


def _published(options: Options) -> int:
    """Print the published numbers next to ours; write a page if asked."""
    from physion.analysis.published.claims import published_results
    from physion.data.official import PACKAGED, find_official
    from physion.report.published import build_published_report, published_numbers

    folder = options.humans or Path(PACKAGED)
    data = find_official(folder)
    results = published_results(folder if data is None else data.results.parent)
    page = None if options.out is None else build_published_report(results, options.out)
    if options.json:
        print(json_module.dumps(published_numbers(results), indent=1))
        return 0
    _print_published(results)
    if page is not None:
        _print(f"report: {page}")
    return 0


def _print_published(results: PublishedResults) -> None:
    from physion.analysis.published.claims import TITLES
    from physion.analysis.published.tables import grid

    tables, words = results.tables, results.descriptions
    accuracies = tables["accuracies"]
    _show("Accuracy as published (means of all released rows)", grid(accuracies, "published"))
    _show("Accuracy, trained on all, observed+simulated", grid(accuracies, "expected"))
    _say(words["accuracies"])
    for name, measure in (("panel_a", "accuracy"), ("panel_c", "kappa")):
        table = tables[name]
        mean = table[table["scenario"] == "mean"]
        ends = ["low", "high", "people", "zone_low", "zone_high", "in_zone"]
        _show(TITLES[name], mean[["model", measure, *ends]])
    for name, column in (("panel_d", "readout"), ("panel_e", "training")):
        _show(TITLES[name], _wide(tables[name], column))
    _say(words["panels"])
    _show(TITLES["accuracy_kappa"], tables["accuracy_kappa"])
    _say(words["accuracy_kappa"])
    for name in ("figure_s3", "not_made"):
        _show(TITLES[name], tables[name])
    _print_regressions(tables["regressions"])
    _say(words["regressions"])
    people = ["scenario", "accuracy", "accuracy_low", "accuracy_high", "printed", "zone_low"]
    people += ["zone_high", "kappa", "half_r", "half_r_full"]
    counts = ["participants", "stimuli", "below_chance"]
    _show(TITLES["people"], tables["people"][[*people, *counts]])
    _show(TITLES["people_claims"], tables["people_claims"])
    _say(words["people"])
    if len(tables["left_out"]):
        _show(TITLES["left_out"], tables["left_out"])


def _wide(table: pd.DataFrame, column: str) -> pd.DataFrame:
    names = list(dict.fromkeys(table["model"])), list(dict.fromkeys(table[column]))
    wide = table.pivot(index="model", columns=column, values="accuracy")
    return wide.reindex(index=names[0], columns=names[1]).reset_index()


def _print_regressions(table: pd.DataFrame) -> None:
    import pandas as pd

    from physion.analysis.published.claims import TITLES

    rows = []
    for row in table.to_dict("records"):
        printed = [f"{key} {row[f'printed_{key}']}" for key in "btp" if row[f"printed_{key}"]]
        rows.append(
            {
                "claim": row["claim"],
                "printed": ", ".join(printed),
                **{fit: _estimate(row, fit) for fit in ("run", "once", "asked")},
                "figures": row["met"],
            }
        )
    _show(TITLES["regressions"], pd.DataFrame(rows))
    for row in table.to_dict("records"):
        _print(f"{row['claim']}: compares {row['compared']}. {row['differs']}")


def _estimate(row: Mapping[Any, Any], fit: str) -> str:
    b, t, df, p = (float(str(row[f"{fit}_{name}"])) for name in ("b", "t", "df", "p"))
    return f"b {b:.3f}, t({df:.0f}) {t:.1f}, p {p:.1g}"


def _show(title: str, table: pd.DataFrame) -> None:
    from physion.cli.output import text_table

    _say(text_table(table, title))


def _say(text: str) -> None:
    _print(text + "\n")


def _print(text: str) -> None:
    from physion.cli.output import console

    console.print(text, markup=False, soft_wrap=True)
