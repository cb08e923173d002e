"""Assembly of the inputs of a report from checked tables: people, comparison, tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from physion.analysis import Bootstrap, compare
from physion.analysis.models.comparison import Comparison
from physion.analysis.models.people_comparison import compare_everywhere
from physion.analysis.people.participants import check_labels
from physion.analysis.people.people import accuracy_by_stimulus
from physion.analysis.statistics.calibration import calibration_table
from physion.analysis.statistics.paired import compare_models
from physion.report.inputs import ReportInputs, permutations_of
from physion.report.mixed_fits import fits_of_models, fits_of_people
from physion.report.people_results import (
    PeopleResults,
    analyse_people,
    read_any_responses,
    rules_called,
)
from physion.report.words import plural


def people_from_files(
    responses: Sequence[Path],
    sessions: Path | None,
    rules: str,
    labels: Mapping[str, bool] | None,
    excluded: list[str],
    exclude_ledge: bool,
    draws: Bootstrap,
    *,
    expected: Mapping[str, int] | None = None,
    attributes: pd.DataFrame | None = None,
) -> PeopleResults:
    """Read responses and run every analysis of people."""
    chosen = rules_called(rules)
    read = read_any_responses(responses, sessions)
    if labels is not None:
        check_labels(read, labels)
    return analyse_people(
        read,
        rules=chosen,
        expected=expected,
        attributes=attributes,
        exclude=excluded,
        exclude_ledge=exclude_ledge,
        bootstrap=draws,
    )


def people_in_words(responses: Sequence[Path], people: PeopleResults) -> str:
    """Describe the responses and the flagged sessions."""
    flags = people.tables["flags"]
    return (
        f"answers of single participants from {', '.join(path.name for path in responses)}: "
        f"{len(flags)} sessions, {int(flags['flagged'].sum())} of them flagged by the rules "
        f"“{people.rules.name}” and left out of the main analysis"
    )


def expected_in_words(people: PeopleResults, given: bool) -> str:
    """Describe how many trials a session must have, and how many sessions had fewer."""
    flags = people.tables["flags"]
    counts = flags.groupby("scenario")["expected"].agg(["min", "max"])
    each = ", ".join(
        f"{name} {row['min']}" + (f" to {row['max']}" if row["max"] > row["min"] else "")
        for name, row in counts.iterrows()
    )
    by = (
        "by the list that was given"
        if given
        else "all stimuli of the scenario that anyone answered"
    )
    return f"{by}: {each}; {plural(int(flags['incomplete'].sum()), 'session')} had fewer"


def attributes_in_words(people: PeopleResults) -> str:
    """Describe where the attributes of the stimuli come from."""
    sources = people.tables["attributes"]["source"].value_counts()
    stimuli = len(people.tables["by_stimulus"])
    return (
        f"of {stimuli} stimuli {sources.get('table', 0)} by the table that was given, "
        f"{sources.get('name', 0)} by their official names, {stimuli - sources.sum()} not known"
    )


def with_participants(
    rows: pd.DataFrame,
    people: PeopleResults,
    excluded: list[str],
    exclude_ledge: bool,
    draws: Bootstrap,
) -> ReportInputs:
    """Compare with the sessions that are not flagged, and with all complete ones."""
    settings: dict[str, Any] = {
        "exclude": excluded,
        "exclude_ledge": exclude_ledge,
        "bootstrap": draws,
    }
    main = compare(
        rows,
        people.tables["by_stimulus"],
        people.labels(),
        zone=people.zone(),
        zone_origin="from the responses themselves",
        participants=True,
        **settings,
    )
    everybody = accuracy_by_stimulus(people.whole.test, draws)
    whole = compare(rows, everybody, people.labels(), **settings)
    agents = len(main.agents)
    permutations = permutations_of(agents * (agents - 1) // 2)
    beside = compare_everywhere(main.stimuli, people.kept.test, draws, permutations=permutations)
    return ReportInputs(
        main,
        people=people,
        comparison_all=whole,
        beside=beside,
        paired=beside.tests if len(main.agents) > 1 else None,
        calibration=beside.calibration,
    )


def completed(
    inputs: ReportInputs,
    rows: pd.DataFrame,
    methods: Mapping[str, str],
    movies: Mapping[str, Path],
    draws: Bootstrap,
) -> ReportInputs:
    """Add the settings and, without participants, paired tests and calibration."""
    paired, calibration = inputs.paired, inputs.calibration
    if inputs.beside is None:
        paired = paired_table(inputs.comparison, draws)
        calibration = calibration_scores(inputs.comparison)
    fits = fits_of_models(inputs.comparison)
    if inputs.people is not None:
        fits = fits_of_people(inputs.people) + fits
    return replace(
        inputs,
        mixed=tuple(fits),
        methods=methods,
        movies=movies,
        predictions=rows,
        paired=paired,
        calibration=calibration,
    )


def _by_model(comparison: Comparison, column: str) -> pd.DataFrame:
    """Return models by stimuli of one column of ``comparison.stimuli``."""
    wide = comparison.stimuli.pivot(index="agent", columns="stimulus", values=column)
    return wide.loc[comparison.agents].astype("float64")


def paired_table(comparison: Comparison, bootstrap: Bootstrap) -> pd.DataFrame | None:
    """Return `paired.compare_models` on all stimuli together; None for one model alone."""
    if len(comparison.agents) < 2:
        return None
    rows = comparison.stimuli.assign(
        correct=comparison.stimuli["predicted"] == comparison.stimuli["label"]
    )
    p_contact = _by_model(comparison, "p_contact")
    correct = rows.pivot(index="agent", columns="stimulus", values="correct")
    correct = correct.loc[comparison.agents].astype("float64")
    by_stimulus = rows.drop_duplicates("stimulus").set_index("stimulus")
    by_stimulus = by_stimulus.reindex(p_contact.columns)
    return compare_models(
        comparison.agents,
        correct.to_numpy(),
        p_contact.to_numpy(),
        by_stimulus["p_yes"].to_numpy(dtype="float64"),
        bootstrap,
        strata=list(by_stimulus["scenario"]),
        permutations=permutations_of(len(correct) * (len(correct) - 1) // 2),
    )


def calibration_scores(comparison: Comparison) -> pd.DataFrame:
    """Return `calibration.calibration_table` of all models against the official outcomes."""
    p_contact = _by_model(comparison, "p_contact")
    truth = comparison.stimuli.drop_duplicates("stimulus").set_index("stimulus")["label"]
    return calibration_table(
        comparison.agents,
        p_contact.to_numpy(),
        truth.reindex(p_contact.columns).to_numpy(dtype="float64"),
    )
