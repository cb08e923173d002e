"""Tables that the analysis reads: predictions, answers of people, outcomes, attributes of stimuli.

Each is described by the columns that it has; `physion.core.tables` reads by such descriptions.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import OFFICIAL_SCENARIOS, SCENARIOS, canonical_name, scenario_of
from physion.core.tables import Column, check_table, must, read_csv, refuse_duplicates

SCENARIO = must("scenario", "choice", "Scenario, by our name or the official one",
                choices=(*SCENARIOS, *OFFICIAL_SCENARIOS))  # fmt: skip
"""Column of the eight scenarios in a released table."""


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as plain values for JSON; NaN becomes null."""
    rows: list[dict[str, Any]] = json.loads(table.to_json(orient="records", double_precision=15))
    return rows


# Scenarios in tables of results: names of summary rows, order, and lists of stimuli in files.

MEAN = "mean"
"""Name of the row that averages the scores of the scenarios with equal weights."""

POOLED = "pooled"
"""Name of the row over the stimuli of all scenarios, so that larger scenarios count more."""


def in_order(scenarios: Iterable[object]) -> list[str]:
    """Return the scenarios that occur: the eight in the order of the paper, then others by name."""
    present = {str(name) for name in scenarios}
    return [name for name in SCENARIOS if name in present] + sorted(present - set(SCENARIOS))


def scenario_name(name: str) -> str:
    """Return our name of a scenario from our spelling or the official one, in any case.

    Raises `UnknownNameError` with the closest names.
    """
    lower = name.strip().lower()
    if lower in SCENARIOS:
        return lower
    if lower not in OFFICIAL_SCENARIOS:
        raise UnknownNameError("scenario", name, {*SCENARIOS, *OFFICIAL_SCENARIOS})
    return OFFICIAL_SCENARIOS[lower]


def read_stimulus_list(path: Path) -> list[str]:
    """Read the canonical names from a text file with one stimulus a line."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(f"{path} cannot be read as a list of stimuli: {error}") from error
    names = [canonical_name(line) for line in text.splitlines() if line.strip()]
    if not names:
        raise BadInputError(f"{path} names no stimulus; it should have one a line")
    return names


def check_excluded_names(exclude: Iterable[str], known: Collection[str]) -> None:
    """Raise `UnknownNameError` for the first excluded stimulus that no table contains.

    A misspelt name would exclude nothing. Official names of scenarios of which ``known``, the
    stimuli of all tables, holds no other stimulus are accepted: one list may serve many files.
    """
    names = {canonical_name(name) for name in known}
    scenarios = {scenario_of(name) for name in names} - {None}
    for name in map(canonical_name, exclude):
        elsewhere = scenario_of(name) is not None and scenario_of(name) not in scenarios
        if name not in names and not elsewhere:
            raise UnknownNameError("stimulus to exclude", name, names)


# Predictions of models.

READOUTS = {"A": "full", "B": "observed+simulated", "C": "observed"}
"""The letters of the official files and the readouts that they stand for."""

DETECTION = READOUTS["A"]
"""The readout that sees the outcome. It detects and people predict, so that its accuracy is given,
and not its likeness to people."""

ONLY, ALL_BUT = "only", "all-but"
"""Training protocols: only on the tested scenario, or on all but that one."""

PREDICTIONS: tuple[Column, ...] = (
    must("stimulus", "text", "Name of the trial", also=("Stimulus Name", "stim_ID")),
    must(
        "p_contact",
        "number",
        "Probability that agent and patient touch",
        low=0,
        high=1,
        also=("Predicted Prob_true", "probability", "prob", "p"),
    ),
    Column("model", "text", "Name of the model; absent: the name of the file", may_be_empty=False,
           also=("Model",)),
    Column("readout", "text", "What the readout saw", also=("Readout Type",)),
    Column("scenario", "text", "Scenario of the trial", also=("Readout Test Data",)),
    Column("predicted", "flag", "The answer; absent: p_contact > 0.5", also=("Predicted Outcome",)),
    Column("outcome", "flag", "Contact in the trial as the model was shown it; absent: the "
           "official outcome", also=("Actual Outcome",)),
    Column("recorded_outcome", "flag", "Contact in the official recording",
           also=("Recorded Outcome",)),
    Column("observed_contact", "flag", "Contact in the observed part", also=("Observed Contact",)),
    Column("inputs", "text", "What the model was given of a trial", also=("Inputs",)),
    Column("frames", "text", "Frames that the model saw of a trial, and how many a second"),
    Column("benchmark", "text", "Rules of the evaluation: v1 or v1.5"),
    Column("check", "text", "Verdict of physion check: passed, refused, ..."),
    Column("fit_on", "text", "Set whose trials fitted the readout, with the start of its digest; "
           "empty: trials of the tested set, or no fit"),
    Column("init", "text", "Weights that the model started from", also=("Init",)),
    Column("protocol", "text", "Scenarios of the training: all, all-but, only, one",
           also=("Dynamics Training Dataset",)),
    Column("dynamics_training_dataset", "text", "The training scenario of protocol one (several "
           "are joined by +), whatever the tested one"),
    Column("seed", "text", "Seed of the training", also=("Dynamics Training Seed",)),
    Column("encoder_type", "text", "", also=("Encoder Type",)),
    Column("dynamics_type", "text", "", also=("Dynamics Type",)),
    Column("encoder_pretraining_task", "text", "", also=("Encoder Pre-training Task",)),
    Column("encoder_pretraining_dataset", "text", "", also=("Encoder Pre-training Dataset",)),
    Column("encoder_pretraining_seed", "text", "", also=("Encoder Pre-training Seed",)),
    Column("encoder_training_task", "text", "", also=("Encoder Training Task",)),
    Column("encoder_training_dataset", "text", "", also=("Encoder Training Dataset",)),
    Column("encoder_training_seed", "text", "", also=("Encoder Training Seed",)),
    Column("dynamics_training_task", "text", "", also=("Dynamics Training Task",)),
    Column("readout_training_dataset", "text", "", also=("Readout Train Data",)),
)  # fmt: skip
"""One row per model and stimulus. Needed are ``stimulus`` and ``p_contact`` only; the other headers
in ``also`` come from the official files."""

DATASETS = ("encoder_pretraining_dataset", "encoder_training_dataset", "protocol",
            "readout_training_dataset")  # fmt: skip
"""Columns of the scenario(s) on which a part was trained. They distinguish models of one name only
in relation to the tested scenario."""

DISTINGUISHING = (
    *("benchmark", "protocol", "dynamics_training_dataset", "seed", "init"),
    *("encoder_type", "dynamics_type"),
    *("encoder_pretraining_task", "encoder_pretraining_dataset", "encoder_pretraining_seed"),
    *("encoder_training_task", "encoder_training_dataset", "encoder_training_seed"),
    *("dynamics_training_task", "readout_training_dataset"),
)
"""Further columns that distinguish models of one name; all of them may be absent."""


def read_predictions(paths: Sequence[Path]) -> pd.DataFrame:
    """Read and check the rows of several CSV files of predictions; see `check_predictions`."""
    if not paths:
        raise BadInputError("no file of predictions was given")
    return join_predictions(
        [(str(path), check_predictions(read_csv(path), str(path), path.stem)) for path in paths]
    )


def join_predictions(tables: Sequence[tuple[str, pd.DataFrame]]) -> pd.DataFrame:
    """Return tables of `check_predictions`, each with its file, as one table of `name_models`."""
    rows = pd.concat([table for _, table in tables], ignore_index=True)
    return name_models(rows, [where for where, table in tables for _ in range(len(table))])


def check_predictions(
    table: pd.DataFrame, where: str = "predictions", name: str = "model"
) -> pd.DataFrame:
    """Return one row per model and stimulus with the columns of `PREDICTIONS`.

    Parameters
    ----------
    table
        Table with the columns of `PREDICTIONS`, of which only two must be there.
    where
        What it is called in messages.
    name
        Name of the model if the table has no column ``model``.

    Returns
    -------
    All columns of `PREDICTIONS`: ``stimulus`` by its canonical name; ``readout`` as a word; flags
    as bool, or None where unknown; the text that is absent is empty; columns of `DATASETS` in
    relation to the tested scenario (`ONLY`, `ALL_BUT`).

    Raises
    ------
    BadInputError
        For a missing column or the first cell that is not allowed.
    """
    checked = check_table(table, PREDICTIONS, where)
    rows = pd.DataFrame(index=checked.index)
    for column in PREDICTIONS:
        given = checked.get(column.name)
        if column.kind == "number":
            rows[column.name] = given
        elif column.kind == "flag":
            rows[column.name] = _known_flags(given, checked.index)
        else:
            rows[column.name] = "" if given is None else _without_decimals(given)
    if "model" not in checked:
        rows["model"] = name
    rows["readout"] = rows["readout"].replace(READOUTS)
    rows["stimulus"] = rows["stimulus"].map(canonical_name)
    rows["scenario"] = _scenarios(rows["scenario"], rows["stimulus"])
    rows["predicted"] = rows["predicted"].where(rows["predicted"].notna(), rows["p_contact"] > 0.5)
    rows["predicted"] = rows["predicted"].astype(bool)
    for dataset in DATASETS:
        rows[dataset] = _relative(rows[dataset], rows["scenario"])
    return rows


_WORDS = {"protocol": "", "dynamics_training_dataset": "trained on "}
"""Words before the value of a column in the name of a model, where they are not its name."""


def name_models(predictions: pd.DataFrame, files: Sequence[str] = ()) -> pd.DataFrame:
    """Return ``predictions`` with a unique ``model`` for each row of results, and ``base_model``.

    The unique name is model and readout and, if several models share these, also what
    distinguishes them (protocol, seed, ...). A table that is not of `check_predictions` is checked
    first; one with ``base_model`` is returned as it is. Raises `BadInputError` if one model
    predicts a stimulus twice, or if two models were shown trials of one name but of different
    scenarios. ``files``: where each row was read, for messages.
    """
    if "base_model" in predictions:
        return predictions
    if set(predictions.columns) != {column.name for column in PREDICTIONS}:
        predictions = check_predictions(predictions)
    base, model = predictions["model"], _unique_names(predictions)
    named = predictions.assign(base_model=base, model=model)
    twice = np.flatnonzero(named.duplicated(["model", "stimulus"]))
    if len(twice):
        of = named[["model", "stimulus"]].iloc[twice[0]]
        rows = np.flatnonzero((named[["model", "stimulus"]] == of).all(axis=1))[:2]
        places = _places(*(files[row] for row in rows)) if len(files) else "; keep one row"
        raise BadInputError(f"{of['model']!r} predicts {of['stimulus']!r} twice{places}")
    scenarios = named.groupby("stimulus")["scenario"].unique()
    several_scenarios = scenarios[scenarios.map(len) > 1]
    if len(several_scenarios):
        both = " and ".join(map(str, several_scenarios.iloc[0]))
        raise BadInputError(
            f"{several_scenarios.index[0]!r} is predicted in two scenarios, {both}; compare models "
            "on one set of trials"
        )
    return named


def _unique_names(predictions: pd.DataFrame) -> pd.Series:
    """Return model and readout of each row and, where models share these, what distinguishes them.

    ``predictions``: with the name of the model, as it was given, in ``model``.
    """
    base, readout = predictions["model"], predictions["readout"]
    model = base.where(readout == "", base + " · " + readout)
    for column in DISTINGUISHING:
        if column not in predictions:
            continue
        values = predictions[column].astype(str)
        several = values.groupby([base, readout]).transform("nunique")
        words = _WORDS.get(column, column.replace("_", " ") + " ")
        added = f" · {words}" + values.where(values != "", "not stated")
        if column == "dynamics_training_dataset":  # only models of protocol one have it
            added = added.where(values != "", "")
        model = model.where(several < 2, model + added)
    return model


SEEDS = ("seed", "encoder_pretraining_seed", "encoder_training_seed")
"""Columns in which the members of a population of models differ."""


def population_names(predictions: pd.DataFrame) -> dict[str, str]:
    """Return the population of each model: all that differs is its seed, or file of weights.

    ``predictions``: from `name_models`. Weights from local files are checkpoints of one model.
    """
    alike = predictions.assign(model=predictions["base_model"], **dict.fromkeys(SEEDS, ""))
    if "init" in alike:
        local = alike["init"].str.startswith("local:")
        alike["init"] = alike["init"].mask(local, "local")
    pairs = zip(predictions["model"], _unique_names(alike), strict=True)
    return {str(model): str(name) for model, name in pairs}


def _places(one: str, other: str) -> str:
    """Return where a stimulus is predicted twice, and what to do."""
    if one == other:
        return f" in {one}; keep one row"
    made = [Path(name) for name in (one, other) if Path(name).is_file()]
    older = f" ({min(made, key=lambda path: path.stat().st_mtime)} is older)" if made[1:] else ""
    return f", in {one} and in {other}; leave out one{older}, or rename its model"


def _without_decimals(values: pd.Series) -> pd.Series:
    """Return text without the decimals that pandas adds to seeds, and an empty text for none."""
    words = values.str.replace(r"^(\d+)\.0$", r"\1", regex=True)
    return words.replace({"nan": "", "None": ""})


def _known_flags(values: pd.Series | None, index: pd.Index) -> pd.Series:
    """Return True, False, or None where nothing is known."""
    result = pd.Series(None, index=index, dtype=object)
    if values is not None:
        known = values.notna()
        result[known] = [bool(value) for value in values[known]]
    return result


def _scenarios(given: pd.Series, stimulus: pd.Series) -> pd.Series:
    """Return the scenario of each row by its stimulus, else as it was given, else None."""
    known = {*SCENARIOS, *OFFICIAL_SCENARIOS}
    result = [
        scenario_of(name) or (scenario_name(said) if said.lower() in known else None)
        for name, said in zip(stimulus, given, strict=True)
    ]
    return pd.Series(result, index=stimulus.index, dtype=object)


def _relative(trained: pd.Series, scenario: pd.Series) -> pd.Series:
    """Return `ONLY` if the training scenario is the tested one, and `ALL_BUT` where it is left out.

    Otherwise a model trained on each scenario in turn would count as eight models. An absent
    training scenario stays absent, even for a stimulus of unknown scenario.
    """
    ours = trained.map(lambda name: OFFICIAL_SCENARIOS.get(name.lower(), name.lower()))
    left_out = trained.str.lower().str.startswith(("all_but", "no_"))
    relative = trained.where((trained == "") | (ours != scenario.fillna("")), ONLY)
    return relative.where(~left_out, ALL_BUT)


# Accuracy of people for each stimulus, from the official tables.
#
# The official files contain, for each stimulus, the fraction of correct answers and the number of
# people. The official data has three sets of people: everybody (column ``correct`` of
# ``stimulus_names_and_labels.csv``), a first exclusion (the files read here, 66 to 96 people) and
# a stricter one (``human_accuracy_by_scenario.csv``, 1 to 8 people fewer). The means of the last
# two differ by at most 0.005.

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


HUMANS: tuple[Column, ...] = (
    must("stimulus", "text", "Name of the trial", also=("stim_ID",)),
    must("accuracy", "number", "Fraction of right answers", low=0, high=1, also=("correct",)),
    must("count", "number", "People", low=1, high=1e9, also=("c",)),
)
"""One row per stimulus; the other headers are the official ones."""


def _read_file(path: Path, scenario: str, redyellow: bool) -> pd.DataFrame:
    rows = check_table(read_csv(path), HUMANS, str(path))
    # Either file can contain rows of the older experiment, so the names of the stimuli count too.
    red = rows["stimulus"].str.contains("-redyellow") | redyellow
    names = rows["stimulus"].map(canonical_name)
    refuse_duplicates(names, str(path))
    table = rows.assign(stimulus=names, scenario=scenario_name(scenario), redyellow=red)
    return table[["stimulus", "scenario", "accuracy", "count", "redyellow"]]


def _choose_look(table: pd.DataFrame, dominoes: DominoesLook, folder: Path) -> pd.DataFrame:
    """Return one row per Dominoes stimulus: of one look, or of both weighted by their people."""
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
        raise BadInputError(f"{folder} has Dominoes of the look {other!r} only; ask for that")
    return table[~in_dominoes | wanted].drop(columns="redyellow")


LABELS: tuple[Column, ...] = (
    must("stimulus", "text", "Name of the trial", also=("stim_ID",)),
    must("contact", "flag", "Do agent and patient touch?", also=("label", "outcome")),
)
"""One row per stimulus; the other headers come from the official file."""


def read_labels(path: Path) -> dict[str, bool]:
    """Read the outcome by canonical stimulus from a table of `LABELS`.

    Such are the official ``stimulus_names_and_labels.csv`` and the package's ``labels.csv``, but
    not ``readout_labels.csv``, which is about the trials on which readouts are trained; some of
    these have the names of test trials. Raises `BadInputError`.
    """
    rows = check_table(read_csv(path), LABELS, str(path))
    names = rows["stimulus"].map(canonical_name)
    refuse_duplicates(names, str(path))
    return {str(name): bool(value) for name, value in zip(names, rows["contact"], strict=True)}


def read_human_zone(path: Path) -> pd.DataFrame:
    """Read what only single participants give from ``human_accuracy_by_scenario.csv``.

    Columns: ``scenario`` (ours), ``low``, ``high``: the 2.5th and the 97.5th percentile of the
    accuracies of single participants, and ``bootstrap_low``, ``bootstrap_high``, if the file has
    them: the interval of their mean by drawing participants.
    """
    columns = (
        SCENARIO,
        must("low", "number", "2.5th percentile", low=0, high=1, also=("pct_2.5",)),
        must("high", "number", "97.5th percentile", low=0, high=1, also=("pct_97.5",)),
        Column("bootstrap_low", "number", "Interval of the mean", low=0, high=1, also=("ci_lb",)),
        Column("bootstrap_high", "number", "Interval of the mean", low=0, high=1, also=("ci_ub",)),
    )
    zone = check_table(read_csv(path), columns, str(path))
    zone = zone.assign(scenario=zone["scenario"].replace(OFFICIAL_SCENARIOS))
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


# Attributes of stimuli: how many elements, distractors and occluders a scene contains, and whatever
# else a table says of it.
#
# Two sources, each named in the column ``source``: the official names of stimuli, which contain
# the counts, and any table with a row per stimulus, all of whose columns count. A table has
# precedence over names (`better_attributes`); names that are known to be wrong are corrected
# (`MISLABELLED`). What a source does not contain is NaN.

ATTRIBUTES = ("elements", "distractors", "occluders")
"""``elements``: objects that the physics is about besides probe, agent and zone: dominoes between
the first and the last, blocks of the tower, links. ``distractors``, ``occluders``: objects that
take no part, behind the scene and in front of it."""

COLUMNS = ("stimulus", "scenario", "configuration", *ATTRIBUTES, "room", "source")

MISLABELLED = {"pilot_dominoes_4mid_tdwroom": {"elements": 8.0}}
"""Configurations whose name belies what was generated, and what their metadata say: this one's
``num_middle_objects`` is 8 (docs/official-system.md, section 3.9). ``source`` stays *name*."""

_NUMBERED = re.compile(r"_?\d{4}$")
_PATTERNS: dict[str, tuple[re.Pattern[str], ...]] = {
    "elements": (re.compile(r"_(\d+)mid"), re.compile(r"_nb(\d+)_")),
    "distractors": (re.compile(r"_(\d+)_dis(?:_|$)"), re.compile(r"_dis(\d+)"),
                    re.compile(r"_d(\d+)chairs")),
    "occluders": (re.compile(r"_(\d+)_occ(?:_|$)"), re.compile(r"_occ(\d+)"),
                  re.compile(r"_o(\d+)(?:plants|full)")),
}  # fmt: skip
_ALWAYS_ONE_EACH = ("contain",)
"""Whose configurations all have one distractor and one occluder (but not in their names)."""


def attributes_from_names(stimuli: Iterable[str]) -> pd.DataFrame:
    """Return the attributes that official names contain, with `MISLABELLED` ones corrected.

    One row per stimulus with `COLUMNS`. A name without scenery (``..._simple_box``) means none: 0.
    ``elements`` are NaN if the name contains none or, as in Link, a range. Raises `BadInputError`
    for a name of no official scenario.
    """
    rows = [_from_name(canonical_name(name)) for name in stimuli]
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    refuse_duplicates(table["stimulus"], "the stimuli")
    return table


def _from_name(stimulus: str) -> dict[str, Any]:
    scenario = scenario_of(stimulus)
    if scenario is None:
        raise BadInputError(
            f"{stimulus!r} is not an official name; give a table of attributes instead"
        )
    configuration = _NUMBERED.sub("", stimulus)
    result = {name: _first(patterns, configuration) for name, patterns in _PATTERNS.items()}
    if scenario in _ALWAYS_ONE_EACH:
        result |= {"distractors": 1.0, "occluders": 1.0}
    for name in ("distractors", "occluders"):
        if np.isnan(result[name]):
            result[name] = 0.0
    if "midRM1" in configuration:
        result["elements"] -= 1
    if scenario in ("link", "contain"):
        result["elements"] = np.nan
    result |= MISLABELLED.get(configuration, {})
    room = "tdw" if "tdw" in configuration else "box"
    return {"stimulus": stimulus, "scenario": scenario, "configuration": configuration, **result,
            "room": room, "source": "name"}  # fmt: skip


def _first(patterns: tuple[re.Pattern[str], ...], text: str) -> float:
    for pattern in patterns:
        if match := pattern.search(text):
            return float(match[1])
    return float("nan")


ATTRIBUTE_TABLE: tuple[Column, ...] = (
    must("stimulus", "text", "Name of the trial", also=("trial",)),
    must("scenario", "text", "Scenario of the trial"),
    Column("configuration", "text", "Name of the settings that the trial was drawn from"),
    Column("room", "text", "Room of the trial"),
    *(Column(name, "number", f"Number of {name}", low=0) for name in ATTRIBUTES),
)
"""One row per stimulus of one's own, such as the index of a dataset."""


RESERVED = frozenset(
    {"accuracy", "accuracy_low", "accuracy_high", "count", "label", "p_yes", "consistency"}
    | {"mean_log_rt", "participant", "correct", "log_rt"}
)
"""Columns of answers, which no attribute may be called."""

INDEX_ATTRIBUTES = ("robust", "agent_fraction", "patient_fraction")
"""Columns of a dataset's index that are attributes of its trials, like `ATTRIBUTES` and what begins
with ``drawn_``. All others keep books."""


def attributes_from_table(table: pd.DataFrame, where: str = "table of attributes") -> pd.DataFrame:
    """Return the attributes of a table of `ATTRIBUTE_TABLE`, with every other column.

    Columns: `COLUMNS`, then the others. Those that hold only numbers, or True and False, are float
    (NaN if empty); the rest are text (None if empty). Of a dataset's index (known by its column
    ``scene_digest``) `INDEX_ATTRIBUTES` and what was drawn are taken. Raises `BadInputError` if no
    attribute is left, or if one has a name in `RESERVED`.
    """
    rows = check_table(table, ATTRIBUTE_TABLE, where)
    described = {name for column in ATTRIBUTE_TABLE for name in (column.name, *column.also)}
    others = [str(name) for name in table if name not in {*described, "source"}]
    if "scene_digest" in table:
        others = [n for n in others if n in INDEX_ATTRIBUTES or n.startswith("drawn_")]
    if taken := sorted(RESERVED & set(others)):
        raise BadInputError(f"{where}: a column is called {taken[0]!r}, as the answers; rename it")
    if not {*ATTRIBUTES, "configuration", "room"} & set(rows) and not others:
        raise BadInputError(f"{where} has no column but the stimulus and its scenario")
    rows = rows.assign(**{name: _attribute(table[name]) for name in others})
    rows = rows.assign(stimulus=rows["stimulus"].map(canonical_name), source="table")
    refuse_duplicates(rows["stimulus"], where)
    absent = [name for name in ("configuration", "room") if name not in rows]
    return rows.assign(**dict.fromkeys(absent, "")).reindex(columns=[*COLUMNS, *others])


def _attribute(column: pd.Series) -> pd.Series:
    """Return a column as numbers if all of its cells are some or empty, else as text."""
    text = column.astype(object).where(column.notna(), "").astype(str).str.strip()
    text = text.reset_index(drop=True)
    empty = text == ""
    flags = text.str.lower().map({"true": "1", "false": "0"})
    numbers = pd.to_numeric(flags.fillna(text).where(~empty), errors="coerce").astype(np.float64)
    if np.isfinite(numbers[~empty]).all():
        return numbers
    return text.where(~empty, None)


def attribute_names(attributes: pd.DataFrame) -> list[str]:
    """Return the columns that hold attributes, the name of the configuration last."""
    names = [str(name) for name in attributes if name not in ("stimulus", "scenario", "source")]
    return sorted(names, key=lambda name: name == "configuration")


def better_attributes(first: pd.DataFrame, second: pd.DataFrame) -> pd.DataFrame:
    """Return ``first`` with the stimuli added that only ``second`` contains."""
    missing = second[~second["stimulus"].isin(first["stimulus"])]
    return pd.concat([first, missing], ignore_index=True)
