"""Reader of the result tables that the original study released, complete and checked.

A row of the released tables is one *run*: a model with a seed, a training protocol and a readout,
tested on one scenario. Two properties matter for averages:

- readout ``D`` exists for SVG and RPIN alone and repeats readout ``C`` (*observed*) to the last
  digit, so that an average over all rows counts *observed* twice for these two;
- SVG has four runs of three seeds: seed 1 is in two result files, with different numbers.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from physion.analysis.tables.csv_table import as_numbers, read_csv, refuse_duplicates
from physion.analysis.tables.predictions import READOUTS
from physion.analysis.tables.responses import read_humans
from physion.analysis.tables.stimuli import scenario_name
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import SCENARIOS, is_ledge

MODELS = {
    "SVG": "SVG",
    "OP3": "OP3",
    "CSWM": "CSWM",
    "RPIN": "RPIN",
    "VGGFrozenMLP": "pVGG-mlp",
    "VGGFrozenLSTM": "pVGG-lstm",
    "DEITFrozenMLP": "pDEIT-mlp",
    "DEITFrozenLSTM": "pDEIT-lstm",
    "GNS": "GNS",
    "GNS-ransac": "GNS-R",
    "DPI": "DPI",
}
"""The names of the released tables and those of the paper, in the order of the paper."""

END_TO_END = ("SVG", "OP3", "CSWM", "RPIN")
PRETRAINED = ("pVGG-mlp", "pVGG-lstm", "pDEIT-mlp", "pDEIT-lstm")
PARTICLES = ("GNS", "GNS-R", "DPI")

FIRST_SEED = ("SVG", "RPIN")
"""Models with several seeds, of which the paper's main figure shows seed 0 alone."""

OBSERVED_AGAIN = "observed (second copy)"
"""Readout ``D`` of the released tables."""

READOUT_NAMES = {**READOUTS, "D": OBSERVED_AGAIN}

TRAININGS = {"all": "all", "all_but_this": "all-but", "same": "only"}
"""The words of the released tables for the training protocols, and those of the paper."""

STIMULI, LEDGES = 150, 56
"""Stimuli of a scenario that people saw, and those of Roll with a ledge, which are not released."""

_KEY = ["scenario", "ModelID"]
_FACTS = (
    "Model",
    "Readout Type",
    "Dynamics Training Dataset Type",
    "Encoder Training Seed",
    "Dynamics Training Seed",
    "Visual encoder architecture",
)
_RUN = re.compile(r"_readout_[A-D]_(?P<file>.*)$")


@dataclass(frozen=True)
class PublishedTables:
    """Released results as tables with the names of the paper.

    - ``runs``: one row a run and scenario: ``scenario``, ``model``, ``readout``, ``training``,
      ``seed`` (int), ``file`` (name of the result file), ``encoder`` (the architecture in the
      table), ``accuracy`` (0 to 1), ``kappa_low``, ``kappa``, ``kappa_high`` (2.5th, 50th, 97.5th
      percentile over participants of Cohen's kappa), ``kappa_stimuli``;
    - ``people``: one row a scenario: ``accuracy`` with ``accuracy_low``, ``accuracy_high``
      (bootstrap over participants), ``zone_low``, ``zone_high`` (2.5th and 97.5th percentile of
      participants), ``kappa_low``, ``kappa``, ``kappa_high`` (percentiles over pairs), ``half_r``,
      ``half_r_low``, ``half_r_high`` (r of random halves of the people);
    - ``stimuli``: from `responses.read_humans`;
    - ``dropped``: ``table``, ``reason``, ``rows``: rows of one table that the other lacks.
    """

    runs: pd.DataFrame
    people: pd.DataFrame
    stimuli: pd.DataFrame
    dropped: pd.DataFrame

    @property
    def distinct(self) -> pd.DataFrame:
        """Runs without the second copy of *observed*."""
        return self.runs[self.runs["readout"] != OBSERVED_AGAIN]

    @property
    def first_seeds(self) -> pd.DataFrame:
        """`distinct` with seed 0 alone of `FIRST_SEED`, as the paper's main figure has them: one
        row a model, scenario, training and readout.
        """
        runs = self.distinct
        return runs[~runs["model"].isin(FIRST_SEED) | (runs["seed"] == 0)]


def read_published(folder: Path) -> PublishedTables:
    """Read the released tables in ``folder``, which contains ``results/`` and ``humans/``.

    Raises `BadInputError` for what is missing, out of range or occurs twice, and for a table that
    was cut.
    """
    results = folder / "results"
    if not results.is_dir():
        raise BadInputError(f"{folder} has no folder results; give the folder of the official data")
    runs, dropped = _read_runs(results)
    stimuli = read_humans(folder / "humans")
    _check_sizes(stimuli, folder / "humans")
    return PublishedTables(runs, _read_people(results), stimuli, dropped)


def _check_whole(models: pd.Series, scenarios: pd.Series, path: Path) -> None:
    """Refuse a table in which a model has more runs in one scenario than in another."""
    counts = pd.crosstab(models, scenarios).reindex(columns=list(SCENARIOS), fill_value=0)
    for model, runs in counts.iterrows():
        few, most = runs.idxmin(), int(runs.max())
        if runs[few] < most:
            raise BadInputError(
                f"{path}: {model} has {runs[few]} rows of {few} and {most} of {runs.idxmax()}: the "
                "table is cut, copy it again"
            )


def _check_sizes(stimuli: pd.DataFrame, folder: Path) -> None:
    """Refuse tables of people that have other numbers of stimuli than the released ones."""
    counts = stimuli[~stimuli["stimulus"].map(is_ledge)]["scenario"].value_counts()
    for scenario in SCENARIOS:
        released = STIMULI - (LEDGES if scenario == "roll" else 0)
        if counts.get(scenario, 0) != released:
            raise BadInputError(
                f"{folder}: the table of {scenario} has {counts.get(scenario, 0)} stimuli, the "
                f"released one {released}; it may be cut: copy it again"
            )


def in_paper_order(table: pd.DataFrame, columns: Sequence[str]) -> pd.DataFrame:
    """Sort ``table`` by ``columns``, models and scenarios in the order of the paper."""
    ranks = {"model": list(MODELS.values()), "scenario": [*SCENARIOS]}
    rank = {
        name: table[name].map({value: at for at, value in enumerate(order)}).fillna(len(order))
        for name, order in ranks.items()
        if name in columns
    }
    ordered = table.assign(**{f"_{name}": values for name, values in rank.items()})
    keys = [f"_{name}" if name in rank else name for name in columns]
    return ordered.sort_values(keys, kind="stable")[list(table.columns)].reset_index(drop=True)


def _read_runs(results: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    accuracies = results / "model_human_accuracies.csv"
    kappas = results / "model_human_CohensK.csv"
    measured = ("Cohens_k_lb", "Cohens_k_med", "Cohens_k_ub", "num_datapoints")
    left = read_csv(accuracies, (*_KEY, *_FACTS, "model_correct"))
    right = read_csv(kappas, (*_KEY, "Model", *measured))
    for table, path in ((left, accuracies), (right, kappas)):
        refuse_duplicates(table["scenario"] + " / " + table["ModelID"], str(path))
        models = _named(table["Model"].str.strip(), MODELS, str(path))
        _check_whole(models, table["scenario"].map(scenario_name), path)
    where = str(accuracies)
    runs = pd.DataFrame(
        {
            "scenario": left["scenario"].map(scenario_name),
            "model": _named(left["Model"].str.strip(), MODELS, where),
            "readout": _named(left["Readout Type"], READOUT_NAMES, where),
            "training": _named(left["Dynamics Training Dataset Type"], TRAININGS, where),
            "seed": _seeds(left, where),
            "file": left["ModelID"].map(_file_of),
            "encoder": left["Visual encoder architecture"],
            "accuracy": as_numbers(left["model_correct"], 0, 1, where),
            "key": left["scenario"] + " / " + left["ModelID"],
        }
    )
    agreed = _kappas(right, str(kappas))
    joined = runs.merge(agreed, on="key", how="inner", validate="one_to_one")
    unmatched = [
        (path.name, "no row of the same run in the other table", len(table) - len(joined))
        for path, table in ((accuracies, left), (kappas, right))
    ]
    dropped = pd.DataFrame(unmatched, columns=["table", "reason", "rows"])
    if joined.empty:
        raise BadInputError(f"{accuracies} and {kappas} have no run in common")
    table = joined.drop(columns="key")
    return in_paper_order(table, ["model", "scenario"]), dropped[dropped["rows"] > 0]


def _kappas(table: pd.DataFrame, where: str) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "key": table["scenario"] + " / " + table["ModelID"],
            "kappa_low": as_numbers(table["Cohens_k_lb"], -1, 1, where),
            "kappa": as_numbers(table["Cohens_k_med"], -1, 1, where),
            "kappa_high": as_numbers(table["Cohens_k_ub"], -1, 1, where),
            "kappa_stimuli": as_numbers(table["num_datapoints"], 1, 1e6, where).astype(int),
        }
    )


def _named(values: pd.Series, names: dict[str, str], where: str) -> pd.Series:
    result = values.map(names)
    if result.isna().any():
        row = int(np.flatnonzero(result.isna())[0])
        unknown = UnknownNameError(str(values.name), str(values.iloc[row]), names)
        raise BadInputError(f"{where}: row {row + 1} of column {values.name!r}: {unknown}")
    return result


def _seeds(table: pd.DataFrame, where: str) -> pd.Series:
    """Return the seed of the encoder, or of the dynamics if the encoder was not trained."""
    encoder_seed = table["Encoder Training Seed"]
    texts = encoder_seed.where(encoder_seed.str.strip() != "", table["Dynamics Training Seed"])
    numbers = as_numbers(texts.rename("Encoder Training Seed"), 0, 1e9, where)
    return pd.Series(numbers.astype(int), index=table.index)


def _file_of(run: str) -> str:
    match = _RUN.search(run)
    return match["file"] if match else run


def _read_people(results: Path) -> pd.DataFrame:
    right = _by_scenario(
        results / "human_accuracy_by_scenario.csv",
        {"obs_mean": "accuracy", "ci_lb": "accuracy_low", "ci_ub": "accuracy_high",
         "pct_2.5": "zone_low", "pct_97.5": "zone_high"},
    )  # fmt: skip
    kappa = _by_scenario(
        results / "human_pairwiseCohensKs_by_scenario.csv",
        {"corr_lb": "kappa_low", "corr_med": "kappa", "corr_ub": "kappa_high"},
    )
    halves = _by_scenario(
        results / "human_pairwiseCorrs_by_scenario.csv",
        {"r_mean": "half_r", "r_lb": "half_r_low", "r_ub": "half_r_high"},
    )
    people = right.join(kappa, how="outer").join(halves, how="outer")
    if people.isna().any(axis=None):
        name = people.index[people.isna().any(axis=1)][0]
        raise BadInputError(f"{results}: not every table of people has scenario {name!r}")
    return in_paper_order(people.rename_axis("scenario").reset_index(), ["scenario"])


def _by_scenario(path: Path, columns: dict[str, str]) -> pd.DataFrame:
    raw = read_csv(path, ("scenario", *columns))
    scenario = raw["scenario"].map(scenario_name)
    refuse_duplicates(scenario, str(path))
    values = {ours: as_numbers(raw[theirs], -1, 1, str(path)) for theirs, ours in columns.items()}
    return pd.DataFrame(values, index=pd.Index(scenario))
