"""Accuracy of people for each stimulus, from the official tables.

The official files contain, for each stimulus, the fraction of correct answers and the number of
people. The official data has three sets of people: everybody (column ``correct`` of
``stimulus_names_and_labels.csv``), a first exclusion (the files read here, 66 to 96 people) and a
stricter one (``human_accuracy_by_scenario.csv``, 1 to 8 people fewer). The means of the last two
differ by at most 0.005.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pandas as pd

from physion.analysis.tables.csv_table import as_booleans, as_numbers, read_csv, refuse_duplicates
from physion.analysis.tables.stimuli import scenario_name
from physion.core.errors import BadInputError
from physion.core.names import SCENARIOS, canonical_name

DominoesLook = Literal["plain", "redyellow", "pooled"]
"""Which people count for Dominoes: those who saw free colours with flashing overlays (the ones of
the paper), those who saw a red agent and a yellow patient, or both weighted by their number."""

LABELS_FILE = "stimulus_names_and_labels.csv"
"""The official file of the outcomes of all stimuli that people saw."""

_FILE = re.compile(r"human_accuracy-(?P<scenario>[a-zA-Z]+)(?P<red>-redyellow)?_pilot-.*\.csv$")


def read_humans(folder: Path, dominoes: DominoesLook = "plain") -> pd.DataFrame:
    """Read the answers of people by stimulus from a folder of ``human_accuracy-*.csv`` files.

    Columns: ``stimulus`` (canonical name), ``scenario`` (ours), ``accuracy`` (fraction of correct
    answers, 0 to 1), ``count`` (people, 1 or more). Rows are sorted by scenario and stimulus.

    Raises `BadInputError` for a missing or empty folder, a missing column, a value out of range, a
    stimulus that occurs twice, or a look of Dominoes that does not exist.
    """
    if dominoes not in get_args(DominoesLook):
        raise BadInputError(f"dominoes is {dominoes!r}; choose plain, redyellow or pooled")
    if not folder.is_dir():
        raise BadInputError(f"{folder} is not a folder; give the one with human_accuracy-*.csv")
    files = [
        (path, match) for path in sorted(folder.iterdir()) if (match := _FILE.match(path.name))
    ]
    if not files:
        raise BadInputError(f"{folder} holds no human_accuracy-<scenario>_pilot-*.csv")
    tables = [_read_file(path, match["scenario"], bool(match["red"])) for path, match in files]
    humans = _choose_look(pd.concat(tables, ignore_index=True), dominoes, folder)
    refuse_duplicates(humans["stimulus"], str(folder))
    order = humans["scenario"].map(SCENARIOS.index)
    humans = humans.assign(order=order).sort_values(["order", "stimulus"], kind="stable")
    return humans.drop(columns="order").reset_index(drop=True)


def _read_file(path: Path, scenario: str, redyellow: bool) -> pd.DataFrame:
    raw = read_csv(path, ("stim_ID", "correct", "c"))
    # Either file can contain rows of the older experiment, so the names of the stimuli count too.
    red = raw["stim_ID"].str.contains("-redyellow") | redyellow
    table = pd.DataFrame(
        {
            "stimulus": raw["stim_ID"].map(canonical_name),
            "scenario": scenario_name(scenario),
            "accuracy": as_numbers(raw["correct"], 0, 1, str(path)),
            "count": as_numbers(raw["c"], 1, 1e9, str(path)),
            "redyellow": red,
        }
    )
    refuse_duplicates(table["stimulus"], str(path))
    return table


def _choose_look(table: pd.DataFrame, dominoes: DominoesLook, folder: Path) -> pd.DataFrame:
    """Return one row a Dominoes stimulus: of one look, or of both weighted by their people."""
    in_dominoes = table["scenario"] == "dominoes"
    if dominoes == "pooled":
        total = table["accuracy"] * table["count"]
        both = table.assign(total=total).groupby(["scenario", "stimulus"], as_index=False)
        pooled = both[["total", "count"]].sum()
        pooled["accuracy"] = pooled["total"] / pooled["count"]
        return pooled[["stimulus", "scenario", "accuracy", "count"]]
    wanted = table["redyellow"] == (dominoes == "redyellow")
    if in_dominoes.any() and not (in_dominoes & wanted).any():
        other = "redyellow" if dominoes == "plain" else "plain"
        raise BadInputError(f"{folder} has Dominoes of the look {other!r} alone; ask for that")
    return table[~in_dominoes | wanted].drop(columns="redyellow")


def read_labels(path: Path) -> dict[str, bool]:
    """Read the official outcome by canonical stimulus from ``stimulus_names_and_labels.csv``.

    Not from ``readout_labels.csv``, which is about the trials on which readouts are trained; some
    of these have the names of test trials. Raises `BadInputError`.
    """
    raw = read_csv(path, ("stim_ID", "label"))
    names = raw["stim_ID"].map(canonical_name)
    refuse_duplicates(names, str(path))
    outcomes = as_booleans(raw["label"], str(path))
    return {str(name): bool(value) for name, value in zip(names, outcomes, strict=True)}


def read_human_zone(path: Path) -> pd.DataFrame:
    """Read the middle 95 % of participants by scenario from ``human_accuracy_by_scenario.csv``.

    Columns: ``scenario`` (ours), ``low``, ``high``: the 2.5th and the 97.5th percentile of the
    accuracies of single participants, which per-stimulus tables do not contain.
    """
    raw = read_csv(path, ("scenario", "pct_2.5", "pct_97.5"))
    zone = pd.DataFrame(
        {
            "scenario": raw["scenario"].map(scenario_name),
            "low": as_numbers(raw["pct_2.5"], 0, 1, str(path)),
            "high": as_numbers(raw["pct_97.5"], 0, 1, str(path)),
        }
    )
    refuse_duplicates(zone["scenario"], str(path))
    return zone


def find_next_to(humans: Path, sibling: str, name: str) -> Path | None:
    """Return the official file ``name`` in or next to the folder of people's answers.

    It may also be in the folder ``sibling`` next to that folder. None if it is in none of these.
    """
    parent = humans.resolve().parent
    paths = (humans / name, parent / name, parent / sibling / name)
    return next((place for place in paths if place.is_file()), None)


def with_labels(humans: pd.DataFrame, labels: Mapping[str, bool]) -> pd.DataFrame:
    """Return ``humans`` with ``label`` and ``p_yes``, the fraction of people who answered yes.

    ``p_yes`` is the accuracy if the label is True, else one minus it. Stimuli without a label get
    NaN in both (``label`` is then of dtype object).
    """
    known = {canonical_name(name): bool(value) for name, value in labels.items()}
    label = humans["stimulus"].map(known).astype(object)
    accuracy = humans["accuracy"].to_numpy(dtype=np.float64)
    p_yes = np.where(label == True, accuracy, 1 - accuracy)  # noqa: E712 - NaN is neither
    p_yes = np.where(label.isna(), np.nan, p_yes)
    return humans.assign(label=label, p_yes=p_yes)
