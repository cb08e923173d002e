"""Tables of the figures: each figure draws exactly its table.

Tables of scores (`MEASURE_COLUMNS`) have models, then baselines; the others have models only.
Each function returns one table, plain rows and columns, that is written next to the figure as CSV.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from physion.analysis.compare import PeopleComparison
from physion.analysis.comparison import ANOTHER, Comparison, with_training
from physion.analysis.intervals import mean_of, variance_of_mean
from physion.analysis.people.effects import THIRDS, below_chance_level, difficulty_third, r_by_third
from physion.analysis.scores import COMPUTED, baseline_stimuli, kind_of
from physion.analysis.statistics.agreement import pearson
from physion.analysis.tables import ALL_BUT, DETECTION, MEAN, ONLY, POOLED, READOUTS, in_order
from physion.analysis.with_participants import released_zone
from physion.core.names import SCENARIOS

PARTICIPANTS = "95 % of participants"
HALVES = "95 % of random halves"
SCENARIO_ZONE = "paper's band: bootstrap of scenario means"
HALVES_ZONE = "paper's band: r of halves, mean over scenarios"
"""What the zone of a row is, in words of the figure's key."""

BASELINE = "baseline"
"""``kind`` of baselines in the tables of scores."""

MEASURE_COLUMNS = (
    "panel", "model", "kind", "value", "low", "high", "people", "people_is", "zone_low",
    "zone_high", "zone", "reason",
)  # fmt: skip
"""``panel``: scenario or `MEAN`; ``kind``: what the mark says: the readout, or `BASELINE`;
``people`` and ``people_is``: the dashed line and its name; ``zone``: what the band is."""

GROUPED_COLUMNS = ("panel", "model", "group", "value", "low", "high", "people", "stimuli", "reason")

GENERALIZATION_COLUMNS = ("model", "trained", "tested", "stimuli", "accuracy", "people",
                          "difference")  # fmt: skip


def accuracy_table(comparison: Comparison) -> pd.DataFrame:
    """Return accuracy by scenario and model, with people; `MEASURE_COLUMNS`."""
    people = _accuracy_of_people(comparison)
    return _measure(_scores(comparison, "accuracy"), people, "people")


def r_table(comparison: Comparison, zones: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return Pearson's r with the average person; the dashed line is its noise ceiling.

    Columns: `MEASURE_COLUMNS`. ``zones`` (`human_zones`): the range of r between random halves of
    the people; in the mean the mean of its bounds, as in `released_r_zone`.
    """
    people = comparison.people.set_index("scenario")[["ceiling"]].set_axis(["people"], axis=1)
    people = _with_zone(people, zones, "r", "halves")
    if zones is not None and MEAN in people.index:
        halves = zones[(zones["measure"] == "r") & (zones["of"] == "halves")]
        people.loc[MEAN, ["zone_low", "zone_high"]] = halves[["low", "high"]].mean().tolist()
        people.loc[MEAN, "zone"] = HALVES_ZONE
    rows = _scores(comparison, "r")
    return _measure(rows[rows["kind"] != DETECTION], people, "ceiling")


def kappa_table(comparison: Comparison, with_people: PeopleComparison) -> pd.DataFrame:
    """Return mean kappa with participants, and the mean kappa of people with each other.

    Columns: `MEASURE_COLUMNS`. Intervals draw people and stimuli.
    """
    rows = with_people.scores[with_people.scores["measure"] == "kappa"].rename(
        columns={"scenario": "panel", "low_both": "low", "high_both": "high"}
    )[["panel", "model", "value", "low", "high", "reason"]]
    readouts = comparison.scores.drop_duplicates("model").set_index("model")["readout"]
    rows = rows[rows["model"].isin([*comparison.names, *COMPUTED])]
    rows = rows.assign(kind=rows["model"].map(readouts).fillna(""))
    zones = with_people.zones
    subset = zones[(zones["measure"] == "kappa") & (zones["of"] == "participants")]
    people = subset.set_index("scenario")[["mean"]].set_axis(["people"], axis=1)
    if len(people) > 1:
        people.loc[MEAN] = people["people"].mean()
    people = _released(_with_zone(people, zones, "kappa", "participants"))
    return _measure(rows, people, "people with people")


def _scores(comparison: Comparison, key: str) -> pd.DataFrame:
    table = comparison.all_scores
    rows = table[table["scenario"] != POOLED].drop(columns="kind")
    names = {"scenario": "panel", "readout": "kind", key: "value", f"{key}_low": "low",
             f"{key}_high": "high"}  # fmt: skip
    return rows[["model", *names, "reason"]].rename(columns=names)


def _baselines_last(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of models, then of the defined baselines, which are marked."""
    baseline = rows["model"].map(kind_of) == "baseline"
    defined = rows["model"].isin(rows.loc[rows["value"].notna(), "model"])
    marked = rows.assign(kind=rows["kind"].mask(baseline, BASELINE))
    return pd.concat([marked[~baseline], marked[baseline & defined]], ignore_index=True)


def _accuracy_of_people(comparison: Comparison) -> pd.DataFrame:
    if not comparison.has_people:
        return pd.DataFrame(columns=["people", "zone_low", "zone_high", "zone"])
    table = comparison.people.set_index("scenario")
    people = table[["accuracy", "zone_low", "zone_high"]].rename(columns={"accuracy": "people"})
    people["zone"] = np.where(people["zone_low"].notna(), PARTICIPANTS, "")
    return _released(people)


def _released(people: pd.DataFrame) -> pd.DataFrame:
    """Add the paper's band in the row of the mean, if there are scenarios to draw."""
    values = people.drop(index=MEAN, errors="ignore")["people"]
    if MEAN in people.index and len(values) > 2 and values.notna().all():
        _, low, high = released_zone(values.to_numpy(dtype=np.float64))
        people.loc[MEAN, ["zone_low", "zone_high"]] = low, high
        people.loc[MEAN, "zone"] = SCENARIO_ZONE
    return people


def _with_zone(
    people: pd.DataFrame, zones: pd.DataFrame | None, measure: str, of: str
) -> pd.DataFrame:
    people = people.assign(zone_low=np.nan, zone_high=np.nan, zone="")
    if zones is None:
        return people
    subset = zones[(zones["measure"] == measure) & (zones["of"] == of)]
    for _, row in subset.iterrows():
        if row["scenario"] in people.index and np.isfinite(row["low"]):
            people.loc[row["scenario"], ["zone_low", "zone_high"]] = row["low"], row["high"]
            people.loc[row["scenario"], "zone"] = {"halves": HALVES}.get(of, PARTICIPANTS)
    return people


def _measure(rows: pd.DataFrame, people: pd.DataFrame, people_is: str) -> pd.DataFrame:
    table = _baselines_last(rows).join(people, on="panel")
    table = table.assign(people_is=people_is, zone=table["zone"].fillna(""))
    names = [*in_order(table.loc[table["panel"] != MEAN, "panel"]), MEAN]
    if len(names) == 2:
        names = names[:1]  # the mean over one scenario is that scenario
    table = table[table["panel"].isin(names)]
    order = table["panel"].map({name: rank for rank, name in enumerate(names)})
    table = table.assign(order=order).sort_values("order", kind="stable")
    return table.reset_index(drop=True)[list(MEASURE_COLUMNS)]


# --- by stimulus --------------------------------------------------------------------------------


def scatter_table(comparison: Comparison, models: Sequence[str]) -> pd.DataFrame:
    """Return P(contact) and the fraction of yes, one row per model and stimulus, in the order of
    ``models``.
    """
    columns = ["model", "scenario", "stimulus", "p_yes", "p_contact", "label", "simulated"]
    rows = comparison.stimuli[comparison.stimuli["model"].isin(models)]
    return rows[columns].reset_index(drop=True)


def people_and_models_table(comparison: Comparison, models: Sequence[str]) -> pd.DataFrame:
    """Return the accuracy of each model, and of people on the same stimuli, by scenario.

    Columns: ``model``, ``scenario`` (with `MEAN`), ``accuracy``, ``people``, in the order of
    ``models``.
    """
    rows = comparison.scores.rename(columns={"human_accuracy": "people"})
    rows = rows[(rows["scenario"] != POOLED) & rows["model"].isin(models)]
    return rows[["model", "scenario", "accuracy", "people"]].reset_index(drop=True)


def right_answers_table(comparison: Comparison, models: Sequence[str]) -> pd.DataFrame:
    """Return the accuracy of people and models by stimulus; one row per model and stimulus.

    ``p_right``: the probability that the model gives to the recorded outcome, which is its accuracy
    if it answers only 0 or 1; ``human_accuracy``: the fraction of people who are right.
    """
    columns = ["model", "scenario", "stimulus", "human_accuracy", "p_right", "label", "simulated"]
    rows = comparison.stimuli[comparison.stimuli["model"].isin(models)]
    p = rows["p_contact"]
    return rows.assign(p_right=p.where(rows["label"], 1 - p))[columns].reset_index(drop=True)


def difficulty_table(comparison: Comparison, by_stimulus: pd.DataFrame | None) -> pd.DataFrame:
    """Return the stimuli with people's accuracy and its tests; see `effects.below_chance_level`.

    ``by_stimulus``: all that people answered; without it those that any model predicts.
    """
    if by_stimulus is None:
        by_stimulus = comparison.stimuli.drop_duplicates("stimulus")
        by_stimulus = by_stimulus.rename(columns={"human_accuracy": "accuracy"})
    rows = by_stimulus.sort_values(["scenario", "stimulus"], kind="stable").reset_index(drop=True)
    return below_chance_level(rows)


def response_time_table(by_stimulus: pd.DataFrame) -> pd.DataFrame:
    """Return ``scenario``, ``stimulus``, ``count``, ``accuracy``, ``mean_log_rt``."""
    return by_stimulus[["scenario", "stimulus", "count", "accuracy", "mean_log_rt"]]


def thirds_table(comparison: Comparison, answers: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return Pearson's r with the average person for hard, at-chance and easy stimuli.

    `MEASURE_COLUMNS` and ``stimuli``, their number; one panel per third. r is computed in each
    scenario and averaged; intervals draw the scenarios, from three on, as in the paper. With the
    ``answers`` of participants (``test`` of `Responses`) the dashed line is the r of halves of them
    with each other, likewise averaged, and so are the bounds of its zone.
    """
    people = _halves_by_third(comparison, answers)
    stimuli = pd.concat([comparison.stimuli, baseline_stimuli(comparison.stimuli)])
    stimuli = stimuli[stimuli["readout"] != DETECTION]
    parts = []
    for name, words in THIRD_WORDS.items():
        rows = [
            {"model": model, "kind": subset["readout"].iloc[0]} | _third(subset, name)
            for model, subset in stimuli.groupby("model", sort=False)
        ]
        parts.append(pd.DataFrame(rows).assign(panel=words, **people[name]))
    table = _baselines_last(pd.concat(parts, ignore_index=True))
    order = table["panel"].map({words: at for at, words in enumerate(THIRD_WORDS.values())})
    table = table.assign(order=order).sort_values("order", kind="stable", ignore_index=True)
    return table[[*MEASURE_COLUMNS, "stimuli"]]


THIRD_WORDS = dict(zip(THIRDS, ("hard (up to 1/3)", "chance", "easy (from 2/3)"), strict=True))


def _third(subset: pd.DataFrame, name: str) -> dict[str, float | str]:
    """Return r of one model within one third, mean over scenarios, with its interval."""
    rows = subset.sort_values("stimulus", kind="stable")
    part = rows[(difficulty_third(rows["human_accuracy"]) == name).to_numpy()]
    found = {
        scenario: pearson(own["p_contact"], own["p_yes"])
        for scenario in in_order(rows["scenario"])
        if len(own := part[part["scenario"] == scenario])
    }
    known = [r for r in found.values() if np.isfinite(r)]
    undefined = [scenario for scenario, r in found.items() if not np.isfinite(r)]
    value, low, high = (float(np.mean(known)) if known else np.nan), np.nan, np.nan
    if len(known) > 2:
        value, low, high = released_zone(known)
    reason = f"undefined in {', '.join(undefined)}: " if undefined else ""
    reason += "fewer than 3 stimuli, or constant answers" if undefined or not known else ""
    return {"stimuli": len(part), "value": value, "low": low, "high": high, "reason": reason}


def _halves_by_third(
    comparison: Comparison, answers: pd.DataFrame | None
) -> dict[str, dict[str, float | str]]:
    """Return the r of halves of the people by third, for the columns of each third's panel."""
    none: dict[str, float | str] = {"people": np.nan, "people_is": "", "zone_low": np.nan,
                                    "zone_high": np.nan, "zone": ""}  # fmt: skip
    if answers is None:
        return dict.fromkeys(THIRDS, none)
    shown = comparison.stimuli.drop_duplicates("stimulus").set_index("stimulus")
    asked = answers[answers["stimulus"].isin(shown.index)]
    tables = []
    for scenario in in_order(shown["scenario"]):
        labels = shown.loc[shown["scenario"] == scenario, "label"]
        own = asked[asked["stimulus"].isin(labels.index)]
        yes = own.pivot(index="session", columns="stimulus", values="yes").astype("float64")
        truth = labels.loc[yes.columns].to_numpy(dtype=np.float64)
        rows = r_by_third(np.full((1, len(truth)), np.nan), yes.to_numpy(), truth)
        tables.append(rows[rows["model"] == -1])
    halves = pd.concat(tables).groupby("third")[["r", "low", "high"]].mean()
    return {
        str(name): {"people": row["r"], "people_is": "half of the people with the others",
                    "zone_low": row["low"], "zone_high": row["high"], "zone": HALVES_ZONE}
        for name, row in halves.iterrows()
    }  # fmt: skip


# --- readout and training -----------------------------------------------------------------------


def effects_table(comparison: Comparison, predictions: pd.DataFrame) -> pd.DataFrame:
    """Return accuracy by readout and by training protocol, averaged over seeds, then over
    scenarios.

    ``predictions``: from `read_predictions`. `GROUPED_COLUMNS`; the panel of readouts
    has one training protocol (*all* if it occurs), the panel of trainings one readout. A panel is
    absent if no model has two conditions. Intervals are about other stimuli.
    """
    rows = with_training(comparison, predictions)
    if len(rows.drop_duplicates(["readout", "training"])) < 2:
        return pd.DataFrame(columns=list(GROUPED_COLUMNS))
    trainings = [str(name) for name in rows["training"].unique()]
    readouts = [name for name in _READOUT_ORDER if name in set(rows["readout"])]
    readouts += sorted(set(rows["readout"]) - set(readouts))
    training = "all" if "all" in trainings else _most_common(rows["training"])
    readout = (
        "observed+simulated" if "observed+simulated" in readouts else _most_common(rows["readout"])
    )
    words = f" (trained on {training})" if training else ""
    order = [name for name in ("all", ALL_BUT, ONLY, ANOTHER) if name in trainings]
    order += sorted(set(trainings) - set(order))
    parts = [
        _effect(rows[rows["training"] == training], "readout", readouts, f"by readout{words}"),
        _effect(rows[rows["readout"] == readout], "training", order,
                f"by training (readout {readout})"),
    ]  # fmt: skip
    table = pd.concat([part for part in parts if len(part)] or [parts[0]], ignore_index=True)
    people = comparison.people.set_index("scenario")["accuracy"] if comparison.has_people else {}
    return table.assign(people=people.get(MEAN, np.nan))


_READOUT_ORDER = tuple(READOUTS[letter] for letter in "CBA")


def _most_common(values: pd.Series) -> str:
    return str(values.value_counts().index[0])


def _effect(rows: pd.DataFrame, column: str, groups: Sequence[str], panel: str) -> pd.DataFrame:
    if rows.groupby("base_model")[column].nunique().max() < 2:
        return pd.DataFrame(columns=list(GROUPED_COLUMNS))
    right = rows.assign(right=(rows["predicted"] == rows["label"]).astype(np.float64))
    records = []
    for (model, group), subset in right.groupby(["base_model", column], sort=False):
        values, variances = [], []
        for _, part in subset.groupby("scenario"):
            mean = part.groupby("stimulus")["right"].mean().sort_index().to_numpy(np.float64)
            values.append(mean.mean())
            variances.append(variance_of_mean(mean, counts=True))
        value = float(np.mean(values))
        low, high = mean_of(variances).interval(value, scale="fraction")
        records.append((panel, model, group, value, low, high, np.nan,
                        subset["stimulus"].nunique(), ""))  # fmt: skip
    table = pd.DataFrame(records, columns=list(GROUPED_COLUMNS))
    rank = {name: at for at, name in enumerate(groups)}
    models = {name: at for at, name in enumerate(rows["base_model"].unique())}
    keys = {"group": rank, "model": models}
    return table.sort_values(
        ["group", "model"], key=lambda values: values.map(keys[str(values.name)]), kind="stable"
    )


def generalization_table(comparison: Comparison, predictions: pd.DataFrame) -> pd.DataFrame:
    """Return accuracy minus people's accuracy, trained on x tested on; `GENERALIZATION_COLUMNS`.

    Seeds are averaged; models of one training only are left out. If no model was tested on another
    scenario than it was trained on, the diagonal becomes one row `ONLY`. Without people the
    difference is to 0.5, the accuracy of guessing, and ``people`` is NaN.
    """
    rows = with_training(comparison, predictions)
    several = rows.groupby(["base_model", "readout"])["training"].nunique().max() > 1
    if not set(rows["training"]) & {ONLY, ALL_BUT, ANOTHER} or not several:
        return pd.DataFrame(columns=list(GENERALIZATION_COLUMNS))
    if not (rows["training"] == ANOTHER).any():
        rows["trained"] = rows["training"]  # nothing off the diagonal: one row is enough
    rows = rows.assign(
        right=rows["predicted"] == rows["label"], model=rows["base_model"] + " · " + rows["readout"]
    )
    rows = rows[rows.groupby("model")["trained"].transform("nunique") > 1]
    keys = ["model", "trained", "scenario"]
    table = rows.groupby(keys, sort=False).agg(
        stimuli=("stimulus", "nunique"), accuracy=("right", "mean"),
        people=("human_accuracy", "mean"),
    ).reset_index().rename(columns={"scenario": "tested"})  # fmt: skip
    base = table["people"] if comparison.has_people else 0.5
    table["difference"] = table["accuracy"] - base
    first = ["all", ALL_BUT, ONLY, *SCENARIOS]
    order = {name: at for at, name in enumerate(first)}
    rank = {
        "model": {name: at for at, name in enumerate(table["model"].unique())},
        "trained": order,
        "tested": order,
    }
    ordered = table.sort_values(
        ["model", "trained", "tested"],
        key=lambda values: values.map(rank[str(values.name)]).fillna(len(first)),
        kind="stable",
    )
    return ordered[list(GENERALIZATION_COLUMNS)].reset_index(drop=True)
