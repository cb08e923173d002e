"""The table of results: people, models that were run, and published numbers, by accuracy.

Page, terminal and the picture of the first screen show this one table (`results_table`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
import pandas as pd

from physion.analysis.published.tables import EXPECTED, MODELS, PARTICLES, PublishedTables
from physion.analysis.scores import MAJORITY, OUTCOME, TWO_PEOPLE, scenario_counts, shown_average
from physion.core.names import SCENARIOS

MARK = " *"
"""End of the names of published rows, which were not run here."""
MARKED = (
    "* published, not run here: trained on all scenarios, readout observed+simulated, the study's "
    "stimuli, mean over scenarios"
)
RESULTS = (
    "row", "group", "readout", "given", "frames", "benchmark", "check", "fit_on", "stimuli",
    "scenarios", "accuracy", "accuracy_low", "accuracy_high", "r", "r_low", "r_high", "kappa",
    "kappa_low", "kappa_high", "beyond", "beyond_low", "beyond_high", "source",
)  # fmt: skip
"""Columns of the table of results. ``beyond``: r with people beyond the outcome.

- ``group``: people, model, baseline or published. ``given``: what a row was given of a trial.
- ``frames``: first and last frame that it saw, and how many a second, if its predictions say so.
- ``benchmark``: rules of the evaluation, v1 or v1.5; ``check``: verdict of a check; ``fit_on``:
  another set, with its digest, that fitted the readout; likewise.
- ``scenarios``: of how many scenarios the averages are; NaN if published.
"""

SEEN = ("frames", "benchmark", "check", "fit_on")
"""Columns that predictions may have, too."""

GIVEN = {
    "rgb": "pixels",
    "ids": "true masks",
    "state": "true state",
    "outcomes": "outcome",
}
"""Short words for values of the column *Inputs* of predictions; others stand as they are."""

STUDY = "Bear et al. (2021), released tables"
PAPER_NAMES = {"DPI": "DPI-Net", "GNS-R": "GNS-RANSAC", "CSWM": "C-SWM"}
OTHER_STUDIES = (("V-JEPA 2 ViT-L", "pixels; people there .742", 0.732, "arXiv:2609.22788"),)
"""Accuracies over all eight scenarios that others published: name, given, accuracy, source."""


def published_rows(tables: PublishedTables, scenarios: Collection[str]) -> pd.DataFrame:
    """Return the people and the models of the study as rows of the table of results.

    Parameters
    ----------
    tables
        The released tables.
    scenarios
        Scenarios over which accuracy and kappa are averaged with equal weights.

    Returns
    -------
    rows
        `RESULTS`: people, then the eleven models, trained on all scenarios, with the readout
        observed+simulated, each the mean of its seeds; of all eight scenarios also
        `OTHER_STUDIES`. Intervals, r and numbers of stimuli were not published; kappa is the
        median over participants, or over pairs of them.
    """
    people = tables.people[tables.people["scenario"].isin(scenarios)]
    records = [_published("people of the study", "movie", people, "people")]
    runs = tables.distinct
    runs = runs[(runs[list(EXPECTED)] == pd.Series(EXPECTED)).all(axis=1)]
    runs = runs[runs["scenario"].isin(scenarios)]
    for model in MODELS.values():
        given = "true state" if model in PARTICLES else "pixels"
        name = PAPER_NAMES.get(model, model.replace("DEIT", "DeIT"))
        records.append(_published(name, given, runs[runs["model"] == model]))
    if set(scenarios) == set(SCENARIOS):
        records += [
            {"row": name + MARK, "group": "published", "given": given, "frames": "", "check": "",
             "benchmark": "v1", "accuracy": accuracy, "source": source}
            for name, given, accuracy, source in OTHER_STUDIES
        ]  # fmt: skip
    return pd.DataFrame(records).reindex(columns=list(RESULTS))


def _published(
    name: str, given: str, rows: pd.DataFrame, group: str = "published"
) -> dict[str, object]:
    """Return a row with the means over scenarios of the means of the seeds."""
    means = rows.groupby("scenario")[["accuracy", "kappa"]].mean().mean()
    about = {"row": name + MARK, "group": group, "given": given, "frames": "", "benchmark": "v1"}
    about |= {"check": "", "source": STUDY}
    return {**about, "accuracy": means["accuracy"], "kappa": means["kappa"]}


def zone_of_people(
    tables: PublishedTables, scenarios: Collection[str]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the middle 95 % of participants (accuracy) and of pairs of them (kappa).

    Each is the mean of its bounds over the scenarios.
    """
    people = tables.people[tables.people["scenario"].isin(scenarios)]
    columns = ["zone_low", "zone_high", "kappa_low", "kappa_high"]
    low, high, least, most = people[columns].mean().tolist()
    return (low, high), (least, most)


def results_table(
    scores: pd.DataFrame,
    inputs: Mapping[str, str] | None = None,
    published: pd.DataFrame | None = None,
    seen: pd.DataFrame | None = None,
) -> pd.DataFrame:
    """Return one row per row of the results: people first, then all others by accuracy.

    Parameters
    ----------
    scores
        From `tidy_scores`; the average is `shown_average`. Kappa is with single participants where
        their answers are known, else with the averages of people.
    inputs
        What each model was given, by its name: values of the column *Inputs*.
    published
        From `published_rows`.
    seen
        Columns `SEEN` by model (index), whose values may be empty.

    Returns
    -------
    rows
        The columns `RESULTS`.
    """
    rows = scores[scores["scenario"] == shown_average(scores)]
    kappa = "kappa" if rows["kappa"].notna().any() else "kappa_from_averages"
    base = rows["base_model"]
    names = [str(name) for name in base.where(base.notna(), rows["model"])]
    given = [_given(name, (inputs or {}).get(name, "")) for name in names]
    whole = [", whole movie" * (readout == "full") for readout in rows["readout"]]
    people = rows["model"].isin([TWO_PEOPLE, MAJORITY]) | (rows["kind"] == "people")
    values = {
        "row": rows["model"].astype(str),
        "group": rows["kind"].mask(people, "people"),
        "readout": rows["readout"],
        "given": [one + more for one, more in zip(given, whole, strict=True)],
        "stimuli": rows["stimuli"],
        "scenarios": rows["model"].map(scenario_counts(scores)),
        "source": "",
    }
    for column in SEEN:
        known = {} if seen is None else seen[column].to_dict()
        values[column] = [known.get(name, "") for name in rows["model"]]
    measures = {"accuracy": "accuracy", "r": "r", "kappa": kappa, "beyond": "r_beyond_outcome"}
    for name, column in measures.items():
        for end in ("", "_low", "_high"):
            values[f"{name}{end}"] = rows.get(f"{column}{end}", np.nan)
    parts = [pd.DataFrame(values).reindex(columns=list(RESULTS))]
    parts += [] if published is None else [published]
    table = pd.concat([part.astype(object) for part in parts], ignore_index=True).infer_objects()
    order = np.where(table["group"] == "people", np.inf, table["accuracy"].astype(float))
    return table.iloc[np.argsort(-order, kind="stable")].reset_index(drop=True)


def says_frames(results: pd.DataFrame) -> bool:
    """Return whether a row that was run here says which frames it saw, or its benchmark."""
    own = results[results["source"] == ""]
    return bool((own[["frames", "benchmark"]] != "").any(axis=None))


def frames_with_benchmark(results: pd.DataFrame) -> list[str]:
    """Return benchmark and frames of the rows of a table of results, such as v1: 2 to 44, 5/s."""
    pairs = zip(results["benchmark"], results["frames"], strict=True)
    return [": ".join(filter(None, pair)) for pair in pairs]


def scenarios_of_rows(results: pd.DataFrame) -> list[str]:
    """Return of how many scenarios each row is, such as 3 of 8; empty if all are of equally many.

    Published rows have an empty text.
    """
    counts = results["scenarios"]
    if counts.nunique() < 2:
        return []
    return ["" if pd.isna(n) else f"{n:.0f} of {counts.max():.0f}" for n in counts]


def fitted_elsewhere(results: pd.DataFrame) -> list[str]:
    """Return a sentence for each other set on which readouts of the rows were fitted."""
    known = results[results["fit_on"].fillna("") != ""]
    return [
        f"Readouts fitted on {name}: {', '.join(dict.fromkeys(rows))}"
        for name, rows in known.groupby("fit_on", sort=False)["row"]
    ]


def _given(name: str, inputs: str) -> str:
    if name in (TWO_PEOPLE, MAJORITY, "people"):
        return "movie"
    if name == OUTCOME:
        return "outcome"
    return ", ".join(GIVEN.get(one.strip(), one.strip()) for one in inputs.split(","))


_READOUTS = {"observed+simulated": 0, "observed": 1, "full": 2}
"""Rank of the readouts, of which one stands for a model."""


def one_row_each(table: pd.DataFrame) -> pd.Series:
    """Return whether a row of a table of results is the first readout of its model."""
    place = table["readout"].map(_READOUTS).fillna(0)
    base = table["row"].str.partition(" · ")[0]
    own = table["group"].isin(["model", "baseline"])
    return ~own | (place == place.groupby([table["group"], base]).transform("min"))


def fewest_rows(table: pd.DataFrame, most: int) -> pd.DataFrame:
    """Return at most ``most`` rows of a table of results, in its order.

    People are kept first, then one row of each model that was run, published rows, and further
    readouts of models; of these, the more accurate ones.
    """
    level = table["group"].map({"people": 0, "model": 1, "baseline": 1, "published": 2})
    level = level.mask(~one_row_each(table), 3)
    return table.loc[sorted(level.sort_values(kind="stable").index[:most])]
