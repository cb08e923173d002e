"""Readers of tables from outside: complete and checked, or refused with one clear message."""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import check_digest, digest_path
from physion.core.names import OFFICIAL_SCENARIOS, SCENARIOS, canonical_name, scenario_of

Array = npt.NDArray[np.float64]


def read_csv(path: Path, columns: Iterable[str]) -> pd.DataFrame:
    """Read the CSV file at ``path`` as text; it must have ``columns`` and at least one row.

    Raises `BadInputError` for a file that is absent, of another kind, empty, lacks a column, or
    was changed since this package wrote it with its SHA-256.
    """
    content = _read_checked(path)
    try:
        table = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False, encoding="utf-8")
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise BadInputError(f"{path} is not a CSV table: {error}") from error
    require_columns(table, columns, str(path))
    if table.empty:
        raise BadInputError(f"{path} has a header and no rows")
    return table


def read_table(path: Path, columns: Iterable[str]) -> pd.DataFrame:
    """Read a parquet table with its types, or a CSV file as text (`read_csv`).

    Raises `BadInputError` as `read_csv` does.
    """
    if path.suffix.lower() != ".parquet":
        return read_csv(path, columns)
    content = _read_checked(path)
    try:
        table = pd.read_parquet(io.BytesIO(content), engine="pyarrow")
    except (OSError, ValueError) as error:
        raise BadInputError(f"{path} is not a parquet table: {error}") from error
    require_columns(table, columns, str(path))
    return table


def _read_checked(path: Path) -> bytes:
    """Return the bytes of a file, compared with the SHA-256 in its digest file, if there is one."""
    if not path.is_file():
        raise BadInputError(f"{path} is not a file")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise BadInputError(f"{path} cannot be read: {error.strerror}") from error
    digest = digest_path(path).name
    check_digest(path, content, f"make it again, or delete {digest} to use the table as it is")
    return content


def require_columns(table: pd.DataFrame, columns: Iterable[str], where: str) -> None:
    """Raise `BadInputError` unless ``table`` has every one of ``columns``."""
    missing = [column for column in columns if column not in table.columns]
    if missing:
        result = ", ".join(map(str, table.columns[:12]))
        raise BadInputError(f"{where} lacks the column(s) {', '.join(missing)}; it has: {result}")


def as_numbers(values: pd.Series, low: float, high: float, where: str) -> Array:
    """Return ``values`` as finite float64 in [low, high]; `BadInputError` names the first other
    one.
    """
    numbers: Array = np.asarray(pd.to_numeric(values, errors="coerce"), dtype=np.float64)
    good = np.isfinite(numbers) & (numbers >= low) & (numbers <= high)
    if not good.all():
        row = int(np.flatnonzero(~good)[0])
        raise BadInputError(
            f"{where}: row {row + 1} of column {values.name!r} holds {values.iloc[row]!r}; "
            f"expected a number from {low:g} to {high:g}"
        )
    return numbers


def as_booleans(values: pd.Series, where: str) -> npt.NDArray[np.bool_]:
    """Return ``values`` as bool: True/False, 1/0 or yes/no in any case; else raise
    `BadInputError`.
    """
    meaning = {"true": True, "1": True, "1.0": True, "yes": True}
    meaning |= {"false": False, "0": False, "0.0": False, "no": False}
    result = [meaning.get(str(value).strip().lower()) for value in values]
    for row, value in enumerate(result):
        if value is None:
            raise BadInputError(
                f"{where}: row {row + 1} of column {values.name!r} holds {values.iloc[row]!r}; "
                "expected True or False"
            )
    return np.array(result, dtype=bool)


def refuse_duplicates(names: pd.Series, where: str) -> None:
    """Raise `BadInputError` with the first name that occurs twice."""
    twice = names[names.duplicated()]
    if len(twice):
        raise BadInputError(f"{where}: {twice.iloc[0]!r} stands in two rows; keep one")


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


# Predictions of models: tables with the column names of the official result files.

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
    """Return ``predictions`` with a unique ``model`` for each row of results, and ``base_model``.

    The unique name is model and readout and, if several models share these, also what
    distinguishes them (training set, seed, ...). Raises `BadInputError` if one model predicts a
    stimulus twice, or if two models were shown trials of one name but of different scenario,
    outcome or observed contact.
    """
    model = predictions["model"].where(
        predictions["readout"] == "", predictions["model"] + " · " + predictions["readout"]
    )
    for column in DISTINGUISHING:
        if column not in predictions:
            continue
        values = predictions[column].astype(str)
        several = values.groupby([predictions["model"], predictions["readout"]]).transform(
            "nunique"
        )
        model = model.where(several < 2, model + f" · {column.lower()} " + values)
    named = predictions.assign(base_model=predictions["model"], model=model)
    twice = named[named.duplicated(["model", "stimulus"])]
    if len(twice):
        row = twice.iloc[0]
        raise BadInputError(f"{row['model']!r} predicts {row['stimulus']!r} twice; keep one row")
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


# Attributes of stimuli: how many elements, distractors and occluders a scene contains.
#
# Two sources, each named in the column ``source``: the official names of stimuli, which contain
# the counts, and any table with the columns, such as that of one's own stimuli. A table has
# precedence over names (`better_attributes`); names that are known to be wrong are corrected
# (`MISLABELLED`). What a source does not contain is NaN.

ATTRIBUTES = ("elements", "distractors", "occluders")
"""``elements``: objects that the physics is about beside probe, agent and zone: dominoes between
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

    One row a stimulus with `COLUMNS`. A name without scenery (``..._simple_box``) means none: 0.
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
        raise BadInputError(f"{stimulus!r} is no official name; give a table of attributes instead")
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


def attributes_from_table(table: pd.DataFrame, where: str = "table of attributes") -> pd.DataFrame:
    """Return the attributes of a table with ``stimulus``, ``scenario`` and any of `ATTRIBUTES`."""
    require_columns(table, ["stimulus", "scenario"], where)
    given = [name for name in ATTRIBUTES if name in table]
    if not given:
        raise BadInputError(f"{where} has none of the columns {', '.join(ATTRIBUTES)}")
    result = table[["stimulus", "scenario"]].assign(configuration="", room="", source="table")
    result["stimulus"] = result["stimulus"].map(canonical_name)
    for name in ("configuration", "room"):
        if name in table:
            result[name] = table[name]
    for name in ATTRIBUTES:
        numbers = pd.to_numeric(table[name], errors="coerce") if name in table else np.nan
        result[name] = numbers
    refuse_duplicates(result["stimulus"], where)
    return result[list(COLUMNS)].reset_index(drop=True)


def better_attributes(first: pd.DataFrame, second: pd.DataFrame) -> pd.DataFrame:
    """Return ``first`` with the stimuli added that only ``second`` contains."""
    missing = second[~second["stimulus"].isin(first["stimulus"])]
    return pd.concat([first, missing], ignore_index=True)
