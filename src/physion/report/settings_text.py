"""Settings about participants and inputs of models as text, for the page."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import pandas as pd

from physion.analysis.people.completeness import Expected
from physion.analysis.people.participants import Kind, check_labels
from physion.analysis.people.results import (
    PeopleResults,
    analyse_people,
    read_any_responses,
    rules_called,
)
from physion.analysis.select_sessions import keep_where
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.csv_table import read_csv
from physion.report.words import plural


def read_by_model(paths: Sequence[Path], column: str) -> dict[str, str]:
    """Return a column of files of predictions by model, for those files that have it.

    A model whose rows differ has all values, joined by ``or``.
    """
    found: dict[str, dict[str, None]] = {}
    for path in paths:
        table = read_csv(path, ["Model"])
        if column in table.columns:
            for model, given in zip(table["Model"], table[column], strict=True):
                if given:
                    found.setdefault(model.strip(), {})[given] = None
    return {model: " or ".join(values) for model, values in found.items()}


def people_from_files(
    responses: Sequence[Path],
    sessions: Path | None,
    rules: str,
    labels: Mapping[str, bool] | None,
    excluded: list[str],
    exclude_ledge: bool,
    draws: Bootstrap,
    *,
    expected: Expected | None = None,
    accept_rules: Collection[str] = (),
    participants: Kind = "people",
    attributes: pd.DataFrame | None = None,
    where: Sequence[str] = (),
) -> PeopleResults:
    """Read responses and run every analysis of people."""
    chosen = rules_called(rules)
    read = keep_where(read_any_responses(responses, sessions, participants), where)
    if labels is not None:
        check_labels(read, labels)
    return analyse_people(
        read,
        rules=chosen,
        expected=expected,
        accept_rules=accept_rules,
        attributes=attributes,
        exclude=excluded,
        exclude_ledge=exclude_ledge,
        bootstrap=draws,
    )


def describe_people(responses: Sequence[Path], people: PeopleResults) -> str:
    """Describe the responses and the flagged sessions."""
    flags = people.tables["flags"]
    kind = "simulated" if people.mark else "single"
    return (
        f"answers of {kind} participants from {', '.join(path.name for path in responses)}: "
        f"{len(flags)} sessions, {int(flags['flagged'].sum())} of them flagged by the rules "
        f"“{people.rules.name}” and left out of the main analysis"
    )


def describe_expected(people: PeopleResults, given: bool) -> str:
    """Describe how many stimuli a session must have, and how many sessions lack some."""
    flags = people.tables["flags"]
    counts = flags.groupby("scenario")["expected"].agg(["min", "max"])
    each = ", ".join(
        f"{name} {row['min']}" + (f" to {row['max']}" if row["max"] > row["min"] else "")
        for name, row in counts.iterrows()
    )
    by = (
        "by the study's list"
        if given
        else "stimuli that at least half of the scenario's sessions answered"
    )
    return f"{by}: {each}; {plural(int(flags['incomplete'].sum()), 'session')} lacked some"


def describe_intervals(draws: Bootstrap) -> str:
    """Describe the intervals of results about people."""
    return (
        f"{draws.level:.0%} percentile bootstrap, people drawn within each scenario, "
        f"{draws.resamples} resamples, seed {draws.seed}"
    )


def describe_attributes(people: PeopleResults) -> str:
    """Describe where the attributes of the stimuli come from."""
    sources = people.tables["attributes"]["source"].value_counts()
    stimuli = len(people.tables["by_stimulus"])
    return (
        f"of {stimuli} stimuli {sources.get('table', 0)} by the table that was given, "
        f"{sources.get('name', 0)} by their official names, {stimuli - sources.sum()} not known"
    )
