"""Reader of the result tables that the original study released, complete and checked.

A row of the released tables is one *run*: a model with a seed, a training protocol and a readout,
tested on one scenario. Two properties matter for averages:

- readout ``D`` exists for SVG and RPIN only and repeats readout ``C`` (*observed*) to the last
  digit, so that an average over all rows counts *observed* twice for these two;
- SVG has four runs of three seeds: seed 1 is in two result files, with different numbers.

After the reader: the published accuracies next to what readers expect, the panels of the main
figure, statements about people, and the supplementary figures.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import lcm
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.intervals import Bootstrap, wilson
from physion.analysis.people.effects import below_chance_level
from physion.analysis.people.measures import spearman_brown
from physion.analysis.statistics.agreement import correlation_from_sums
from physion.analysis.tables import MEAN, READOUTS, SCENARIO, read_humans
from physion.analysis.with_participants import released_zone
from physion.core.errors import BadInputError
from physion.core.names import OFFICIAL_SCENARIOS, SCENARIOS
from physion.core.tables import Column, check_table, must, read_csv, refuse_duplicates

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
"""The names in the released tables and in the paper, in the order of the paper."""

END_TO_END = ("SVG", "OP3", "CSWM", "RPIN")
PRETRAINED = ("pVGG-mlp", "pVGG-lstm", "pDEIT-mlp", "pDEIT-lstm")
PARTICLES = ("GNS", "GNS-R", "DPI")

FIRST_SEED = ("SVG", "RPIN")
"""Models with several seeds, of which the paper's main figure shows seed 0 only."""

OBSERVED_AGAIN = "observed (second copy)"
"""Readout ``D`` of the released tables."""

READOUT_NAMES = {**READOUTS, "D": OBSERVED_AGAIN}

TRAININGS = {"all": "all", "all_but_this": "all-but", "same": "only"}
"""The words of the released tables for the training protocols, and the words of the paper."""

_RUN_COLUMNS = (
    SCENARIO,
    must("run", "text", "Model, protocol, readout and file", also=("ModelID",)),
    must("model", "text", "Name of the model", also=("Model",)),
)
ACCURACIES: tuple[Column, ...] = (
    *_RUN_COLUMNS,
    must("readout", "text", "What the readout saw", also=("Readout Type",)),
    must("training", "text", "Scenarios of the training", also=("Dynamics Training Dataset Type",)),
    Column("seed", "integer", "Seed of the encoder; empty: it was not trained", required=True,
           low=0, also=("Encoder Training Seed",)),
    Column("dynamics_seed", "integer", "Seed of the dynamics", required=True, low=0,
           also=("Dynamics Training Seed",)),
    Column("encoder", "text", "Its architecture", required=True,
           also=("Visual encoder architecture",)),
    must("accuracy", "number", "Fraction of right answers", low=0, high=1,
         also=("model_correct",)),
)  # fmt: skip
"""Columns of ``model_human_accuracies.csv``."""

KAPPAS: tuple[Column, ...] = (
    *_RUN_COLUMNS,
    must("kappa_low", "number", "2.5th percentile", low=-1, high=1, also=("Cohens_k_lb",)),
    must("kappa", "number", "Median", low=-1, high=1, also=("Cohens_k_med",)),
    must("kappa_high", "number", "97.5th percentile", low=-1, high=1, also=("Cohens_k_ub",)),
    must("kappa_stimuli", "integer", "Stimuli", low=1, also=("num_datapoints",)),
)
"""Columns of ``model_human_CohensK.csv``: kappa with participants."""

PEOPLE = {
    "human_accuracy_by_scenario.csv": {
        "accuracy": "obs_mean", "accuracy_low": "ci_lb", "accuracy_high": "ci_ub",
        "zone_low": "pct_2.5", "zone_high": "pct_97.5"},
    "human_pairwiseCohensKs_by_scenario.csv": {
        "kappa_low": "corr_lb", "kappa": "corr_med", "kappa_high": "corr_ub"},
    "human_pairwiseCorrs_by_scenario.csv": {
        "half_r": "r_mean", "half_r_low": "r_lb", "half_r_high": "r_ub"},
}  # fmt: skip
"""Files of people by scenario, and their columns by ours."""

_RUN = re.compile(r"_readout_[A-D]_(?P<file>.*)$")


@dataclass(frozen=True)
class PublishedTables:
    """Released results as tables with the names of the paper.

    - ``runs``: one row per run and scenario: ``scenario``, ``model``, ``readout``, ``training``,
      ``seed`` (int), ``file`` (name of the result file), ``encoder`` (the architecture in the
      table), ``accuracy`` (0 to 1), ``kappa_low``, ``kappa``, ``kappa_high`` (2.5th, 50th, 97.5th
      percentile over participants of Cohen's kappa), ``kappa_stimuli``;
    - ``people``: one row per scenario: ``accuracy`` with ``accuracy_low``, ``accuracy_high``
      (bootstrap over participants), ``zone_low``, ``zone_high`` (2.5th and 97.5th percentile of
      participants), ``kappa_low``, ``kappa``, ``kappa_high`` (percentiles over pairs), ``half_r``,
      ``half_r_low``, ``half_r_high`` (r of random halves of the people);
    - ``stimuli``: from `read_humans`;
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
        """`distinct` with seed 0 only of `FIRST_SEED`, as the paper's main figure has them: one row
        per model, scenario, training and readout.
        """
        runs = self.distinct
        return runs[~runs["model"].isin(FIRST_SEED) | (runs["seed"] == 0)]


def read_published(folder: Path) -> PublishedTables:
    """Read the released tables in ``folder``, which contains ``results/`` and ``humans/``.

    Raises `BadInputError` for what is missing, out of range or occurs twice.
    """
    results = folder / "results"
    if not results.is_dir():
        raise BadInputError(f"{folder} has no folder results; give the folder of the official data")
    runs, dropped = _read_runs(results)
    stimuli = read_humans(folder / "humans")
    return PublishedTables(runs, _read_people(results), stimuli, dropped)


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
    paths = results / "model_human_accuracies.csv", results / "model_human_CohensK.csv"
    left, right = (
        _read_released(path, columns)
        for path, columns in zip(paths, (ACCURACIES, KAPPAS), strict=True)
    )
    for table, path in ((left, paths[0]), (right, paths[1])):
        refuse_duplicates(table["scenario"] + " / " + table["run"], str(path))
    seeds = left["seed"].where(left["seed"].notna(), left["dynamics_seed"])
    if seeds.isna().any():
        row = int(np.flatnonzero(seeds.isna())[0])
        raise BadInputError(f"{paths[0]}: row {row + 1} has no seed of encoder or dynamics")
    runs = pd.DataFrame(
        {
            **{name: left[name] for name in ("scenario", "model", "readout", "training")},
            "seed": seeds.astype(int),
            "file": left["run"].map(_file_of),
            "encoder": left["encoder"],
            "accuracy": left["accuracy"],
            "run": left["run"],
        }
    )
    agreed = right.drop(columns="model").astype({"kappa_stimuli": int})
    joined = runs.merge(agreed, on=["scenario", "run"], how="inner", validate="one_to_one")
    unmatched = [
        (path.name, "no row of the same run in the other table", len(table) - len(joined))
        for path, table in zip(paths, (left, right), strict=True)
    ]
    dropped = pd.DataFrame(unmatched, columns=["table", "reason", "rows"])
    if joined.empty:
        raise BadInputError(f"{paths[0]} and {paths[1]} have no run in common")
    table = joined.drop(columns="run")
    return in_paper_order(table, ["model", "scenario"]), dropped[dropped["rows"] > 0]


def _read_released(path: Path, columns: Sequence[Column]) -> pd.DataFrame:
    """Read a released table, with the names of the paper for models, readouts and trainings."""
    table = check_table(read_csv(path), columns, str(path))
    for name, names in (("model", MODELS), ("readout", READOUT_NAMES), ("training", TRAININGS)):
        if name in table:
            table[name] = table[name].str.strip().map(names)
    return table.assign(scenario=table["scenario"].replace(OFFICIAL_SCENARIOS))


def _file_of(run: str) -> str:
    match = _RUN.search(run)
    return match["file"] if match else run


def _read_people(results: Path) -> pd.DataFrame:
    tables = []
    for name, headers in PEOPLE.items():
        numbers = [must(ours, "number", "", low=-1, high=1, also=(theirs,))
                   for ours, theirs in headers.items()]  # fmt: skip
        table = _read_released(results / name, (SCENARIO, *numbers))
        refuse_duplicates(table["scenario"], str(results / name))
        tables.append(table.set_index("scenario"))
    people = pd.concat(tables, axis=1)
    if people.isna().any(axis=None):
        name = people.index[people.isna().any(axis=1)][0]
        raise BadInputError(f"{results}: not every table of people has scenario {name!r}")
    return in_paper_order(people.rename_axis("scenario").reset_index(), ["scenario"])


# Published table of model accuracies by scenario, next to the setting that readers expect.
#
# The table of the paper's supplement (S1) names no protocol. Each of its 88 values is the mean
# over all rows that the released results have for a model and a scenario: every readout, every
# training protocol, every run. It thus mixes *detection* (readout *full*, which sees the outcome)
# with *prediction*. A reader expects the paper's main setting: trained on *all* scenarios, readout
# *observed+simulated*.

EXPECTED = {"training": "all", "readout": "observed+simulated"}
"""The setting that the paper's main figure shows."""

MOST_STIMULI = 400
"""No scenario of the study was tested on more."""


def accuracy_table(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return the published mean of each model and scenario and the value that a reader expects.

    Columns: ``model``, ``scenario``; ``published`` with ``published_low``, ``published_high``
    (bootstrap over the rows that it averages: variation with other protocols and seeds, not with
    other stimuli) and ``paper_low``, ``paper_high`` (`paper_intervals`), ``rows`` (number of rows),
    ``without_copies`` (the mean with *observed* once); ``people`` with ``people_low`` and
    ``people_high`` (bootstrap over participants), and ``reliably``: *better* or *worse* where the
    interval by the paper's way and people's do not overlap, else empty;
    ``expected`` with ``expected_low``, ``expected_high`` (Wilson's 95 % interval: other stimuli of
    the kind), ``runs`` (seeds averaged in it), ``stimuli`` (tested; see `count_tested`),
    ``difference`` (expected - published).
    """
    draws = bootstrap or Bootstrap()
    counts = count_tested(tables.runs)
    once = tables.distinct
    by_paper = paper_intervals(tables, draws)
    people = tables.people.set_index("scenario")
    records = []
    for (model, scenario), rows in tables.runs.groupby(["model", "scenario"], sort=False):
        values = rows["accuracy"].to_numpy(dtype=np.float64)
        weights = draws.weights(f"{model} {scenario}", len(values))
        low, high = draws.interval(weights @ values / len(values))
        own = once.loc[once.index.intersection(rows.index)]
        cell = own[(own[list(EXPECTED)] == pd.Series(EXPECTED)).all(axis=1)]["accuracy"]
        expected = float(cell.mean()) if len(cell) else float("nan")
        stimuli = counts[(model, scenario)]
        expected_low, expected_high = wilson(expected, stimuli)
        right, worst, best = people.loc[
            scenario, ["accuracy", "accuracy_low", "accuracy_high"]
        ]  # fmt: skip
        paper_low, paper_high = by_paper[(model, scenario)]
        records.append(
            {
                "model": model,
                "scenario": scenario,
                "published": float(values.mean()),
                "published_low": low,
                "published_high": high,
                "paper_low": paper_low,
                "paper_high": paper_high,
                "people": right,
                "people_low": worst,
                "people_high": best,
                "reliably": "better" if paper_low > best else "worse" if paper_high < worst else "",
                "rows": len(rows),
                "without_copies": float(own["accuracy"].mean()),
                "expected": expected,
                "expected_low": float(expected_low),
                "expected_high": float(expected_high),
                "runs": len(cell),
                "stimuli": stimuli,
                "difference": expected - float(values.mean()),
            }
        )
    return in_paper_order(pd.DataFrame(records), ["model", "scenario"])


def paper_intervals(
    tables: PublishedTables, bootstrap: Bootstrap | None = None
) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the interval of each published value by the paper's way, by (model, scenario).

    The released notebook calls ``tidyboot_mean`` on the table grouped by model and scenario, which
    resamples the rows of the whole table, ungrouped, with one row of people a scenario, and then
    averages each group. So the number of rows of a value differs between draws, and the intervals
    are wider than intervals from drawing its own rows. A draw without a row of the value is left
    out.
    """
    draws = bootstrap or Bootstrap()
    runs = tables.runs
    weights = draws.weights("published table", len(runs) + len(tables.people))[:, : len(runs)]
    accuracy = runs["accuracy"].to_numpy(dtype=np.float64)
    found = {}
    for (model, scenario), positions in runs.groupby(["model", "scenario"]).indices.items():
        drawn = weights[:, positions]
        with np.errstate(divide="ignore", invalid="ignore"):
            means = drawn @ accuracy[positions] / drawn.sum(axis=1)
        found[(str(model), str(scenario))] = draws.interval(means)
    return found


def grid(table: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return one column of `accuracy_table` as models by scenarios, with their mean last."""
    wide = table.pivot(index="model", columns="scenario", values=column)
    wide = wide.reindex(index=list(dict.fromkeys(table["model"])))
    wide = wide[[name for name in SCENARIOS if name in wide]]
    return wide.assign(mean=wide.mean(axis=1, skipna=False)).reset_index().rename_axis(columns=None)


def count_tested(runs: pd.DataFrame) -> dict[tuple[str, str], int]:
    """Return how many stimuli each model was tested on, by (model, scenario).

    The released tables do not contain it; the accuracies are fractions, so the number follows from
    their denominators. Models see all test trials of a scenario, including those that no person
    saw.
    """
    largest: dict[tuple[str, str], int] = {}
    common = dict.fromkeys(runs["scenario"], 1)
    for (model, scenario), rows in runs.groupby(["model", "scenario"], sort=False):
        found = [_denominator(value) for value in rows["accuracy"]]
        largest[(model, scenario)] = max(found)
        together = lcm(*found)
        if together <= MOST_STIMULI:
            common[scenario] = max(common[scenario], together)
    return {
        (model, scenario): common[scenario] if common[scenario] % n == 0 else n
        for (model, scenario), n in largest.items()
    }


def _denominator(fraction: float) -> int:
    return Fraction(fraction).limit_denominator(MOST_STIMULI).denominator


def copies_of_observed(tables: PublishedTables) -> tuple[int, int]:
    """Count the rows with the second copy of *observed*: those equal to the first one, and all."""
    cell = ["model", "scenario", "training", "seed", "file"]
    runs = tables.runs
    again = runs[runs["readout"] == OBSERVED_AGAIN].set_index(cell)["accuracy"]
    first = runs[runs["readout"] == "observed"].set_index(cell)["accuracy"]
    return int((again == first.reindex(again.index)).sum()), len(again)


def describe_averages(tables: PublishedTables) -> str:
    """Return what a published value averages, counted in the tables at hand, as text."""
    equal, copies = copies_of_observed(tables)
    counts = tables.runs.groupby("model")["accuracy"].size() / tables.runs["scenario"].nunique()
    per_model = ", ".join(f"{model} {n:g}" for model, n in counts[counts > 3].items())
    few = ", ".join(str(model) for model in counts[counts <= 3].index)
    words = (
        "Each published value is the plain mean of all released rows of a model and a scenario: "
        "every readout (full, observed+simulated, observed), every training protocol (all, "
        "all-but, only) and every run. Readout full sees the whole movie, so the published values "
        f"mix detection into prediction. Rows averaged by model: {per_model}; {few} have the three "
        "training protocols. "
    )
    if copies:
        twice = " and ".join(
            tables.runs[tables.runs["readout"] == OBSERVED_AGAIN]["model"].unique()
        )
        words += (
            f"For {twice} observed counts twice: their readout D repeats C in {equal} of {copies} "
            "rows. "
        )
    files = tables.runs.groupby(["model", "seed", "scenario"])["file"].nunique()
    for (model, seed), number in files.groupby(["model", "seed"]).max().items():
        if number > 1:
            words += f"Seed {seed} of {model} stands in {number} result files, with other numbers. "
    return words + (
        "Next to it stands the cell that a reader expects: trained on all scenarios, readout "
        "observed+simulated, the mean of the seeds."
    )


# Panels of the paper's main comparison as tables: accuracy, kappa, readouts, trainings.
#
# Panels A to C show training *all* and readout *observed+simulated*; panels D and E vary the
# readout and the training. All show the first seed of SVG and RPIN, as the released code selects.
# The intervals of the panels are bootstraps over the eight scenario values. Panel B (r with the
# average person) needs the predictions for single stimuli, which the released tables do not
# contain.

READOUT_ORDER = ("observed", "observed+simulated", "full")

SELECTION = (
    "All panels show only seed 0 of SVG and RPIN, as the released code selects. Panels A and C: "
    "training all, readout observed+simulated. Panel D: training all; particle models have one "
    "readout. Panel E: readout observed+simulated. Intervals of a mean are a "
    "bootstrap over the scenario values, seeded (the released code drew without a seed). “Zone” "
    "in a scenario's row is the middle 95 % of participants (accuracy) or of pairs of them "
    "(kappa); in the row of the mean it is the paper's grey band, a bootstrap over the scenario "
    "means, which does not say how participants differ. Kappa of a model is the median over "
    "participants, though the paper speaks of a mean. Panel B is missing: r with the average "
    "person cannot be had from the released tables, which hold no prediction for a single stimulus."
)


def panel_a(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return the accuracy of each model and of people by scenario; see `_measure`."""
    return _measure(tables, "accuracy", bootstrap or Bootstrap())


def panel_c(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return Cohen's kappa of each model with participants, median over them; see `_measure`."""
    return _measure(tables, "kappa", bootstrap or Bootstrap())


def panel_d(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return accuracy by readout, trained on all scenarios, averaged over scenarios.

    Columns: ``model``, ``readout``, ``scenarios`` (averaged), ``accuracy`` with ``low`` and
    ``high``.
    """
    runs = tables.first_seeds
    rows = runs[(runs["training"] == EXPECTED["training"]) & ~runs["model"].isin(PARTICLES)]
    return _by(rows, "readout", READOUT_ORDER, bootstrap or Bootstrap())


def panel_e(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return accuracy by training protocol, readout observed+simulated; columns as `panel_d`, with
    ``training`` instead of ``readout``.
    """
    runs = tables.first_seeds
    rows = runs[runs["readout"] == EXPECTED["readout"]]
    return _by(rows, "training", tuple(TRAININGS.values()), bootstrap or Bootstrap())


def _measure(tables: PublishedTables, measure: str, draws: Bootstrap) -> pd.DataFrame:
    """Return one row per model and scenario, then its mean over scenarios.

    Columns: ``model``, ``scenario``, the measure with ``low`` and ``high`` (of the mean: bootstrap
    over scenarios; of a kappa: percentiles over participants; else NaN), ``people`` (their value)
    with ``zone_low``, ``zone_high``, and ``in_zone`` (whether the model is within; None without a
    zone).
    """
    runs = tables.first_seeds
    chosen = runs[(runs[list(EXPECTED)] == pd.Series(EXPECTED)).all(axis=1)]
    own = chosen[["model", "scenario", measure]].copy()
    if measure == "kappa":
        own[["low", "high"]] = chosen[["kappa_low", "kappa_high"]]
    else:
        own[["low", "high"]] = np.nan
    zone = ["zone_low", "zone_high"] if measure == "accuracy" else ["kappa_low", "kappa_high"]
    people = tables.people[["scenario", measure, *zone]]
    people.columns = pd.Index(["scenario", "people", "zone_low", "zone_high"])
    mean, low, high = released_zone(people["people"].to_numpy(dtype=np.float64), draws)
    means = [
        {"model": model, "scenario": MEAN, **_mean(rows[measure], measure, draws),
         "people": mean, "zone_low": low, "zone_high": high}
        for model, rows in own.groupby("model", sort=False)
    ]  # fmt: skip
    table = in_paper_order(
        pd.concat([own.merge(people, on="scenario"), pd.DataFrame(means)], ignore_index=True),
        ["model", "scenario"],
    )
    inside = table[measure].between(table["zone_low"], table["zone_high"])
    return table.assign(in_zone=inside)


def _by(rows: pd.DataFrame, what: str, order: Sequence[str], draws: Bootstrap) -> pd.DataFrame:
    records = []
    for (model, value), cells in rows.groupby(["model", what], sort=False):
        record: dict[str, object] = {"model": model, what: value, "scenarios": len(cells)}
        record |= _mean(cells["accuracy"], "accuracy", draws)
        records.append(record)
    table = pd.DataFrame(records)
    table = table.assign(place=table[what].map({name: at for at, name in enumerate(order)}))
    return in_paper_order(table, ["model", "place"]).drop(columns="place")


def _mean(values: pd.Series, measure: str, draws: Bootstrap) -> dict[str, float]:
    array = values.to_numpy(dtype=np.float64)
    weights = draws.weights("scenarios", len(array))
    low, high = draws.interval(weights @ array / len(array))
    return {measure: float(array.mean()), "low": low, "high": high}


# Statements of the paper about people, and what the released tables of people contain.

PRINTED = {
    "dominoes": 0.693, "support": 0.763, "collide": 0.809, "contain": 0.767,
    "drop": 0.744, "link": 0.643, "roll": 0.883, "drape": 0.678,
}  # fmt: skip
"""Accuracy of people as the row of people in the paper's table of accuracies has it."""

RECRUITED = 800
PEOPLE_EXCLUDED = 112
THIRDS = ((0.0, 1 / 3, "hard", 0.10), (1 / 3, 2 / 3, "chance", 0.22), (2 / 3, 1.0, "easy", 0.68))
"""Accuracy of people from, to; the paper's word for such stimuli; its printed fraction."""


def people_by_scenario(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return one row per scenario, then the mean over scenarios.

    Columns as in `PublishedTables.people`; ``printed`` (`PRINTED`) and ``printed_inside`` (whether
    it lies in the interval ``accuracy_low``, ``accuracy_high`` of the released accuracy);
    ``half_r_full`` (split-half r corrected by Spearman and Brown to all of the people:
    2 r / (1 + r); the released numbers are not corrected);
    ``stimuli`` and ``participants`` of the tables by stimulus, ``accuracy_by_stimulus`` (their
    mean; a laxer exclusion than ``accuracy``), ``below_chance`` (stimuli on which p + 1.96 sqrt(p
    (1 - p) / n) < 0.5). In the row of the mean ``zone_low`` and ``zone_high``, likewise of kappa,
    are the paper's grey bands (`released_zone`), and so are ``half_r_low`` and
    ``half_r_high`` for r (as `released_r_zone`).
    """
    draws = bootstrap or Bootstrap()
    stimuli = tables.stimuli
    right = stimuli["accuracy"]
    margin = 1.96 * np.sqrt(right * (1 - right) / stimuli["count"])
    own = (
        stimuli.assign(below=right + margin < 0.5)
        .groupby("scenario")
        .agg(
            stimuli=("stimulus", "size"),
            participants=("count", "max"),
            accuracy_by_stimulus=("accuracy", "mean"),
            below_chance=("below", "sum"),
        )
    )
    table = tables.people.merge(own, left_on="scenario", right_index=True, how="left")
    printed = table["scenario"].map(PRINTED)
    table["printed"] = printed
    table["printed_inside"] = printed.between(table["accuracy_low"], table["accuracy_high"])
    table.insert(
        table.columns.get_loc("half_r_high") + 1,
        "half_r_full",
        spearman_brown(table["half_r"].to_numpy(np.float64)),
    )
    return pd.concat([table, pd.DataFrame([_mean_row(table, draws)])], ignore_index=True)


def _mean_row(table: pd.DataFrame, draws: Bootstrap) -> dict[str, object]:
    row: dict[str, object] = {"scenario": MEAN}
    averaged = ["half_r", "half_r_low", "half_r_high", "half_r_full", "accuracy_by_stimulus"]
    averaged += ["printed"]
    row |= {name: float(table[name].mean()) for name in averaged}
    row |= {name: int(table[name].sum()) for name in ("stimuli", "participants", "below_chance")}
    for name, low, high in (
        ("accuracy", "zone_low", "zone_high"),
        ("kappa", "kappa_low", "kappa_high"),
    ):
        row[name], row[low], row[high] = released_zone(table[name].to_numpy(np.float64), draws)
    return row


def people_claims(tables: PublishedTables) -> pd.DataFrame:
    """Return the paper's statements about people: ``claim``, ``printed``, ``ours``, ``note``."""
    means = tables.people["accuracy"].to_numpy(dtype=np.float64)
    test = stats.ttest_1samp(means, 0.5)
    stimuli = tables.stimuli
    answered = stimuli.groupby("scenario")["count"].max()
    rows: list[tuple[str, str, str, str]] = [
        (
            "participants after exclusions",
            f"{RECRUITED} - {PEOPLE_EXCLUDED} = {RECRUITED - PEOPLE_EXCLUDED}",
            f"{answered.sum():.0f}",
            "sum over scenarios of the people behind the tables by stimulus",
        ),
        (
            "proportion correct over scenarios",
            "0.71",
            f"{means.mean():.3f}",
            "0.71 is the mean of the particle models; see the regressions",
        ),
        (
            "people against chance",
            "t = 27.5, p < 1e-7",
            f"t({len(means) - 1}) = {test.statistic:.1f}, p = {test.pvalue:.1e}",
            "scenario means against 0.5; the printed t is against 0, of particle models",
        ),
    ]
    for low, high, word, share in THIRDS:
        own = stimuli["accuracy"]
        # A stimulus on the border belongs to the middle third.
        if word == "hard":
            found = own < high
        elif word == "easy":
            found = own > low
        else:
            found = own.between(low, high)
        rows.append(
            (
                f"{word} stimuli (accuracy {low:.0%} to {high:.0%})",
                f"{share:.0%}",
                f"{found.mean():.1%}",
                f"{int(found.sum())} of {len(own)} stimuli, Roll's ledges left out",
            )
        )
    rows.append(_printed_row(tables.people))
    return pd.DataFrame(rows, columns=["claim", "printed", "ours", "note"])


def _printed_row(people: pd.DataFrame) -> tuple[str, str, str, str]:
    """Return which printed accuracies of people lie outside the interval of the released ones."""
    rows = people.assign(printed=people["scenario"].map(PRINTED))
    outside = rows[~rows["printed"].between(rows["accuracy_low"], rows["accuracy_high"])]
    rest = rows.drop(index=outside.index)
    apart = (rest["printed"] - rest["accuracy"]).abs().max()
    named = list(outside.itertuples(index=False))
    return (
        "people in the table of accuracies",
        ", ".join(f"{row.scenario} {row.printed:.3f}" for row in named),
        ", ".join(f"{row.scenario} {row.accuracy:.3f}" for row in named),
        "outside the interval by drawing participants ("
        + ", ".join(f"{row.accuracy_low:.3f} to {row.accuracy_high:.3f}" for row in named)
        + f"); the other {len(rest)} scenarios differ by at most {apart:.3f}",
    )


# Supplementary figures of the paper from its released tables, and how kappa follows accuracy.

Array = npt.NDArray[np.float64]

S3_MODEL = "DPI"
"""The model that figure S3 sets against people."""

NOT_MADE = {
    "Panel B": "r with the average person needs a model's prediction for each stimulus, which the "
    "released tables do not hold",
    "S1, examples": "the movies of the stimuli below chance are no part of the released tables",
    "S2": "r within hard, chance and easy stimuli needs a model's prediction for each stimulus, "
    "and single answers of people for their halves",
    "S4": "accuracy of DPI and people by stimulus needs a prediction of DPI for each stimulus",
    "S5": "models trained on one scenario and tested on another: the released rows of training "
    "“only” are tested only on the scenario of their training",
}
"""Figures that the released tables do not determine, and the reason."""


def figure_s1(tables: PublishedTables) -> pd.DataFrame:
    """Return the accuracy of people by stimulus: the top of figure S1, for all eight scenarios.

    Columns: see `effects.below_chance_level`.
    """
    return below_chance_level(tables.stimuli)


def figure_s3(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return the accuracy of `S3_MODEL` and of people by scenario, and the mean over scenarios.

    Columns: ``model``, ``scenario``, ``accuracy``, ``people``, ``difference`` (model - people). The
    model is trained on all scenarios, its readout is observed+simulated. The model is tested on all
    test stimuli, also on those that people did not see.
    """
    rows = panel_a(tables, bootstrap)
    rows = rows[rows["model"] == S3_MODEL].reset_index(drop=True)
    table = rows[["model", "scenario", "accuracy", "people"]]
    return table.assign(difference=table["accuracy"] - table["people"])


def accuracy_and_kappa(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return how strongly kappa with participants follows accuracy, over the cells of panels A, C.

    Columns: ``over`` (what the points are), ``models``, ``points``, ``r`` (Pearson) with
    ``r_low`` and ``r_high`` (percentile bootstrap that draws models with all of their scenarios).
    The rows: means of all models, and of vision models only; cells of model and scenario; and r
    within a scenario, averaged over scenarios, which no difference between scenarios can cause.
    """
    draws = bootstrap or Bootstrap()
    keys = ["model", "scenario"]
    cells = panel_a(tables, draws)[[*keys, "accuracy"]].merge(
        panel_c(tables, draws)[[*keys, "kappa"]], on=keys
    )
    accuracy, kappa = (
        cells.pivot(index="model", columns="scenario", values=name)
        .drop(columns=MEAN)
        .to_numpy(dtype=np.float64)
        for name in ("accuracy", "kappa")
    )
    # The rows of a pivot are sorted by name.
    models = sorted(cells["model"].unique())
    vision = np.array([name not in PARTICLES for name in models])
    records = []
    for over, x, y in (
        ("means of models over scenarios", accuracy.mean(axis=1), kappa.mean(axis=1)),
        ("the same, vision models only", accuracy[vision].mean(axis=1),
         kappa[vision].mean(axis=1)),
        ("cells of model and scenario", accuracy, kappa),
    ):  # fmt: skip
        columns = x.reshape(len(x), -1), y.reshape(len(y), -1)
        records.append(_correlation(over, *columns, pooled=True, draws=draws))
    within = "models within a scenario, mean over scenarios"
    records.append(_correlation(within, accuracy, kappa, pooled=False, draws=draws))
    return pd.DataFrame(records)


def _correlation(
    over: str, x: Array, y: Array, *, pooled: bool, draws: Bootstrap
) -> dict[str, object]:
    """Correlate x and y (models, scenarios): all cells together, or by column and then averaged."""
    models, scenarios = x.shape
    weights = draws.weights(over, models)

    def correlate(drawn: Array) -> Array:
        groups = [slice(None)] if pooled else [slice(k, k + 1) for k in range(scenarios)]
        return np.asarray(np.mean([_weighted_r(x[:, g], y[:, g], drawn) for g in groups], axis=0))

    low, high = draws.interval(correlate(weights))
    return {"over": over, "models": models, "points": x.size,
            "r": float(correlate(np.ones((1, models)))[0]), "r_low": low,
            "r_high": high}  # fmt: skip


def _weighted_r(x: Array, y: Array, weights: Array) -> Array:
    """Return Pearson's r over all cells (models, k) for each row of weights (b, models), (b,)."""
    x, y = x - x.mean(), y - y.mean()
    sums = (weights @ values.sum(axis=1) for values in (x, y, x * x, y * y, x * y))
    return correlation_from_sums(weights.sum(axis=1) * x.shape[1], *sums)
