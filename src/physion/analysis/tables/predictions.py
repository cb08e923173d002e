"""Predictions of models: tables with the column names of the official result files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from physion.analysis.tables.csv_table import as_booleans, as_numbers, read_csv, require_columns
from physion.analysis.tables.stimuli import scenario_name
from physion.core.errors import BadInputError
from physion.core.names import OFFICIAL_SCENARIOS, SCENARIOS, canonical_name, scenario_of

REQUIRED = (
    "Model",
    "Readout Type",
    "Predicted Prob_true",
    "Predicted Outcome",
    "Actual Outcome",
    "Stimulus Name",
)
"""Columns without which a table of predictions cannot be compared."""

READOUTS = {"A": "full", "B": "observed+simulated", "C": "observed"}
"""The letters of the official files and the protocols that they stand for."""

PROTOCOLS = {"same": "only", "all but this": "all-but"}
"""Name of a training protocol by the value that the tables hold."""
DATASETS = (
    "Encoder Pre-training Dataset",
    "Encoder Training Dataset",
    "Dynamics Training Dataset",
    "Readout Train Data",
)
"""Columns of the scenario(s) on which a part was trained. They distinguish models of one name only
in relation to the tested scenario."""

DISTINGUISHING = (
    "Init",
    "Encoder Type",
    "Dynamics Type",
    "Encoder Pre-training Task",
    "Encoder Pre-training Seed",
    "Encoder Training Task",
    "Encoder Training Seed",
    "Dynamics Training Task",
    "Dynamics Training Seed",
    *DATASETS,
)
"""Further columns that distinguish models of one name; all of them may be absent."""


def read_predictions(paths: list[Path]) -> pd.DataFrame:
    """Read and check the rows of several CSV files of predictions; see `check_predictions`."""
    if not paths:
        raise BadInputError("no file of predictions was given")
    tables = []
    for path in paths:
        raw = read_csv(path, REQUIRED)
        tables.append(check_predictions(raw, str(path)))
    return name_models(pd.concat(tables, ignore_index=True))


def check_predictions(table: pd.DataFrame, where: str = "predictions") -> pd.DataFrame:
    """Return one row a model and stimulus with our column names, in the order of ``table``.

    Columns: ``model`` (the name), ``readout`` (*observed*, *observed+simulated*, *full*, or another
    name), ``stimulus`` (canonical), ``scenario`` (None if unknown), ``p_contact`` (0 to 1),
    ``predicted`` and ``actual`` (bool), and those of `DISTINGUISHING` that are present, as text.
    ``actual`` is the outcome of the trial that the model was shown, so for our own simulations the
    simulated outcome; ``recorded`` is the official one if a column *Recorded Outcome* contains it
    (bool), else None; ``observed_contact`` says likewise, from *Observed Contact*, whether the
    contact happened in the observed part. Raises `BadInputError`.
    """
    require_columns(table, REQUIRED, where)
    table = table.reset_index(drop=True)
    stimulus = table["Stimulus Name"].astype(str).map(canonical_name)
    checked = pd.DataFrame(
        {
            "model": _text(table["Model"]),
            "readout": _text(table["Readout Type"]).replace(READOUTS),
            "stimulus": stimulus,
            "scenario": _scenarios(table, stimulus),
            "p_contact": as_numbers(table["Predicted Prob_true"], 0, 1, where),
            "predicted": as_booleans(table["Predicted Outcome"], where),
            "actual": as_booleans(table["Actual Outcome"], where),
            "recorded": _optional(table, "Recorded Outcome", where),
            "observed_contact": _optional(table, "Observed Contact", where),
        }
    )
    blank = (checked["model"] == "") | (checked["stimulus"] == "")
    if blank.any():
        row = int(np.flatnonzero(blank.to_numpy())[0]) + 1
        raise BadInputError(f"{where}: row {row} names no model or no stimulus")
    for column in DISTINGUISHING:
        checked[column] = _text(table[column]) if column in table.columns else ""
    for column in DATASETS:
        checked[column] = _relative(checked[column], checked["scenario"])
    return checked


def name_models(predictions: pd.DataFrame) -> pd.DataFrame:
    """Return ``predictions`` with ``agent``, a unique name for each model.

    It is model and readout and, if several models share these, also what distinguishes them
    (training set, seed, ...). Raises `BadInputError` if one model predicts a stimulus twice, or if
    two models were shown trials of one name but of different scenario, outcome or observed contact.
    """
    agent = predictions["model"] + " · " + predictions["readout"]
    for column in DISTINGUISHING:
        if column not in predictions:
            continue
        values = predictions[column].astype(str)
        several = values.groupby([predictions["model"], predictions["readout"]]).transform(
            "nunique"
        )
        agent = agent.where(several < 2, agent + f" · {column.lower()} " + values)
    named = predictions.assign(agent=agent)
    twice = named[named.duplicated(["agent", "stimulus"])]
    if len(twice):
        row = twice.iloc[0]
        raise BadInputError(f"{row['agent']!r} predicts {row['stimulus']!r} twice; keep one row")
    _refuse_two_scenarios(named)
    for column, what in (("actual", "outcomes"), ("observed_contact", "observed contacts")):
        if column not in named:
            continue
        several = named.groupby("stimulus")[column].nunique()
        if (several > 1).any():
            raise BadInputError(
                f"two models were shown {several[several > 1].index[0]!r} with different {what}; "
                "compare models on one set of trials"
            )
    return named


def _refuse_two_scenarios(named: pd.DataFrame) -> None:
    scenarios = named.groupby("stimulus")["scenario"].unique()
    several = scenarios[scenarios.map(len) > 1]
    if len(several):
        both = " and ".join(map(str, several.iloc[0]))
        raise BadInputError(
            f"{several.index[0]!r} is predicted in two scenarios, {both}; compare models on one "
            "set of trials"
        )


def _text(values: pd.Series) -> pd.Series:
    """Return values as text, empty if absent, and seeds without the decimals that pandas adds."""
    words = values.astype(object).where(values.notna(), "").map(str).str.strip()
    return words.str.replace(r"^(\d+)\.0$", r"\1", regex=True).replace({"nan": "", "None": ""})


def _scenarios(table: pd.DataFrame, stimulus: pd.Series) -> pd.Series:
    """Return the scenario of each row by its stimulus, else by *Readout Test Data*, else None."""
    known = {*SCENARIOS, *OFFICIAL_SCENARIOS}
    tested = table.get("Readout Test Data", pd.Series("", index=table.index)).astype(str)
    result = [
        scenario_of(name) or (scenario_name(test) if test.lower() in known else None)
        for name, test in zip(stimulus, tested, strict=True)
    ]
    return pd.Series(result, index=table.index, dtype=object)


def _optional(table: pd.DataFrame, column: str, where: str) -> pd.Series:
    """Return a column of True and False as bool; None where it is empty or absent."""
    result = pd.Series(None, index=table.index, dtype=object)
    if column not in table.columns:
        return result
    words = _text(table[column])
    given = words != ""
    result[given] = as_booleans(words[given], where).tolist()
    return result


def _relative(trained: pd.Series, scenario: pd.Series) -> pd.Series:
    """Return ``same`` if the training scenario is the tested one; all else is unchanged.

    Otherwise a model trained on each scenario in turn would count as eight models. An absent
    training scenario stays absent, even for a stimulus of unknown scenario.
    """
    ours = trained.map(lambda name: OFFICIAL_SCENARIOS.get(name.lower(), name.lower()))
    left_out = trained.str.lower().str.startswith(("all_but", "no_"))
    relative = trained.where((trained == "") | (ours != scenario.fillna("")), "same")
    return relative.where(~left_out, "all but this")
