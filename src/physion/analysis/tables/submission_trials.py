"""Checks of the trials that a file predicts: known, complete, and test trials only.

Names alone do not identify test trials: 1184 of the 1200 official test names are also names of
(other) readout trials. Leakage is therefore checked with an index of the dataset, a list of fitted
stimuli, or a column ``Split``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from physion.analysis.tables.predictions import DATASETS, DISTINGUISHING, READOUTS
from physion.analysis.tables.submission_rows import Fault, booleans, each
from physion.core.names import canonical_name, is_ledge, scenario_of

TESTING = ("testing", "test")
"""Names of the split that may be predicted."""


@dataclass(frozen=True)
class Reference:
    """What a submission is checked against; what is None is not checked.

    - ``labels``: official outcome of every stimulus that should be predicted, by canonical name;
    - ``index``: the trials of a dataset: ``trial``, ``split``, and optionally ``digest`` (of the
      motion) and ``scene_digest``;
    - ``fitted``: canonical names of the stimuli on which the readout was fitted.
    """

    labels: Mapping[str, bool] | None = None
    index: pd.DataFrame | None = None
    fitted: Collection[str] | None = None


def labels(
    table: pd.DataFrame, stimulus: pd.Series, labels: Mapping[str, bool] | None
) -> list[Fault]:
    """Check the outcomes of the file against the official ones."""
    if labels is None:
        return []
    official = stimulus.map(dict(labels)).astype(object)
    faults: list[Fault] = []
    if "Recorded Outcome" in table.columns:
        recorded = booleans(table["Recorded Outcome"])
        wrong = recorded.notna() & official.notna() & (recorded != official)
        faults += each(wrong, table, stimulus, "label", "Recorded Outcome", "the official outcome")
    shown = booleans(table["Actual Outcome"])
    changed = int((shown.notna() & official.notna() & (shown != official)).sum())
    if changed:
        faults.append(
            Fault(
                "label",
                f"the outcome of the trial shown is not the official one in {changed} rows; the "
                "official one is compared with",
                column="Actual Outcome",
                level="warning",
            )
        )
    return faults


def coverage(table: pd.DataFrame, stimulus: pd.Series, against: Reference) -> list[Fault]:
    """Find unknown stimuli, and known ones without a prediction."""
    wanted: set[str] = set(against.labels or ())
    trials: set[str] = set()
    if against.index is not None:
        names = against.index["trial"].map(canonical_name)
        trials = set(names)
        if not wanted:
            wanted = set(names[against.index["split"].isin(TESTING)])
    if not wanted and not trials:
        return []
    faults = []
    for row in np.flatnonzero(~stimulus.isin(wanted | trials).to_numpy()):
        name = str(stimulus.iloc[row])
        # Models of the study were also tested on trials that no person saw.
        official = against.labels is not None and scenario_of(name) is not None
        message = "people did not see it: it is not compared" if official else "no such stimulus"
        level = "warning" if official else "error"
        faults.append(Fault("unknown", message, int(row) + 1, name, "Stimulus Name", level))
    return faults + _missing(table, stimulus, wanted, against)


def _missing(
    table: pd.DataFrame, stimulus: pd.Series, wanted: set[str], against: Reference
) -> list[Fault]:
    scenario = _scenario_by_name(wanted, against)
    faults = []
    apart = [name for name in DISTINGUISHING if name in table.columns and name not in DATASETS]
    keys = [table[name] for name in ("Model", "Readout Type", *apart)]
    for (model, readout, *_), rows in stimulus.groupby(keys, sort=False):
        given = set(rows)
        absent: dict[str, list[str]] = {}
        for name in sorted(wanted - given):
            absent.setdefault(scenario[name], []).append(name)
        for where, names in absent.items():
            whole = not any(scenario.get(name) == where for name in given)
            ledges = all(map(is_ledge, names))
            what = f"no stimulus of {where}" if whole else f"{len(names)} stimuli of {where} lack"
            what += "" if whole else f" a prediction, the first is {names[0]}"
            what += " (Roll's ledges, which are not compared)" if ledges else ""
            level = "warning" if whole or ledges else "error"
            message = f"{model} · {READOUTS.get(readout, readout)}: {what}"
            faults.append(Fault("missing", message, column="Stimulus Name", level=level))
    return faults


def _scenario_by_name(names: set[str], against: Reference) -> dict[str, str]:
    result: dict[str, str] = {}
    if against.index is not None and "scenario" in against.index.columns:
        trials = against.index["trial"].map(canonical_name)
        result = dict(zip(trials, against.index["scenario"].astype(str), strict=True))
    return {name: result.get(name) or scenario_of(name) or "no known scenario" for name in names}


def leaks(table: pd.DataFrame, stimulus: pd.Series, against: Reference) -> list[Fault]:
    """Find stimuli on which a readout or a model may have been fitted."""
    reason = pd.Series("", index=table.index, dtype=object)
    if "Split" in table.columns:
        split = table["Split"].str.strip().str.lower()
        reason = reason.mask(~split.isin(["", *TESTING]), "column Split says it is no test trial")
    if against.fitted is not None:
        on = stimulus.isin({canonical_name(name) for name in against.fitted})
        reason = reason.mask(on, "the readout was fitted on it")
    copies: list[Fault] = []
    if against.index is not None:
        names = against.index.assign(name=against.index["trial"].map(canonical_name))
        of = stimulus.map(names.drop_duplicates("name").set_index("name")["split"].astype(str))
        other = of.notna() & ~of.isin(TESTING)
        reason = reason.mask(other, "in the dataset it is a trial of the split " + of.fillna(""))
        copies = _twins(stimulus, against.index)
    reason = reason.mask(_cross_fitted(table), "")
    result = [
        _leak(str(reason.iloc[row]), int(row), stimulus)
        for row in np.flatnonzero((reason != "").to_numpy())
    ]
    return result + copies


def _leak(message: str, row: int, stimulus: pd.Series) -> Fault:
    return Fault("leak", message, row + 1, str(stimulus.iloc[row]), "Stimulus Name")


def _cross_fitted(table: pd.DataFrame) -> pd.Series:
    """Return rows whose readout was fitted on other folds of the set (``Fold`` >= 0)."""
    if "Fold" not in table.columns:
        return pd.Series(False, index=table.index)
    return pd.to_numeric(table["Fold"], errors="coerce").fillna(-1) >= 0


def _twins(stimulus: pd.Series, index: pd.DataFrame) -> list[Fault]:
    """Find test trials whose scene or motion equals that of a trial of another split."""
    faults = []
    seen = index["trial"].map(canonical_name).isin(set(stimulus))
    testing = index[index["split"].isin(TESTING) & seen]
    others = index[~index["split"].isin(TESTING)]
    for column, what in (("digest", "motion"), ("scene_digest", "scene")):
        if column not in index.columns:
            continue
        of = others.dropna(subset=[column]).drop_duplicates(column).set_index(column)["trial"]
        for trial, value in zip(testing["trial"], testing[column], strict=True):
            if isinstance(value, str) and value and value in of.index:
                name = canonical_name(str(trial))
                row = int(np.flatnonzero((stimulus == name).to_numpy())[0])
                message = f"trial {of[value]!r} of another split has the same {what}"
                faults.append(_leak(message, row, stimulus))
    return faults
