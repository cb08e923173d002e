"""The table of predictions, with the column names of the official result files."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from physion.clips.batch import Provenance
from physion.core.files import write_with_digest
from physion.core.version import MADE_WITH
from physion.readout.protocols import Readout

OFFICIAL_COLUMNS = (
    "Model",
    "Readout Train Data",
    "Readout Test Data",
    "Train Accuracy",
    "Test Accuracy",
    "Readout Type",
    "Predicted Prob_false",
    "Predicted Prob_true",
    "Predicted Outcome",
    "Actual Outcome",
    "Stimulus Name",
    "Encoder Type",
    "Dynamics Type",
    "Encoder Pre-training Task",
    "Encoder Pre-training Dataset",
    "Encoder Pre-training Seed",
    "Encoder Training Task",
    "Encoder Training Dataset",
    "Encoder Training Seed",
    "Dynamics Training Task",
    "Dynamics Training Dataset",
    "Dynamics Training Seed",
)
"""Columns of the official files, in their order (docs/official-system.md, section 5.5)."""

ORDER = ("Protocol", "Readout Test Data", "Stimulus Name")
"""Columns by which the rows are sorted."""

OWN_COLUMNS = (
    "Protocol",
    "Init",
    "Inputs",
    "Recorded Outcome",
    "Observed Contact",
    "Fit Labels",
    "Fit Trials",
    "Fold",
    "Readout C",
    "CV Accuracy",
    "Reader",
    "Noise Scale",
    "Gap Threshold",
    "Validation Loss",
    "Copy-last Loss",
    "Note",
    "Versions",
)
"""Columns that this package adds.

- ``Protocol``: readout protocol by its name. ``Init``: initial weights of the model.
- ``Inputs``: what the model was given of a trial: names of `models.batch.INPUTS` with commas,
  ``outcomes``, ``answers of people``, or ``base rate`` (nothing of the trial).
- ``Recorded Outcome``: outcome in the official recording, empty where there is none;
  ``Actual Outcome`` is that of the trial as simulated here.
- ``Observed Contact``: whether agent and patient touched in the observed part already.
- ``Fit Labels``: outcomes that the readout or the noise level was fitted on (`describe_labels`).
- ``Fit Trials``: number of trials in the fit. ``Fold``: fold of a cross-validation, or -1.
- ``Reader``: what turned features or rollouts into probabilities. ``Noise Scale`` and
  ``Gap Threshold`` (metres): what it fitted. ``Copy-last Loss``: of the trivial predictor.
- ``Versions``: of this package and of those that the model used.
- The others are empty where they do not apply.
"""


_NUMBERS = (
    "Train Accuracy", "Test Accuracy", "Predicted Prob_false", "Predicted Prob_true",
    "Readout C", "CV Accuracy", "Noise Scale", "Gap Threshold", "Validation Loss",
    "Copy-last Loss",
)  # fmt: skip
"""Columns of numbers, of which some may be empty."""
_DTYPES = {
    **dict.fromkeys((*OFFICIAL_COLUMNS, *OWN_COLUMNS), "str"),
    **dict.fromkeys(_NUMBERS, "float64"),
    **dict.fromkeys(("Predicted Outcome", "Actual Outcome", "Observed Contact"), "bool"),
    **dict.fromkeys(("Fit Trials", "Fold"), "int64"),
}
"""Types by column, of which `read_table` reads each column at once."""


@dataclass(frozen=True)
class Evaluation:
    """Table of predictions, its file, and the reasons of trials that have none.

    ``rollout_errors``: file of the errors of imagined motion, if they were asked for.
    """

    predictions: pd.DataFrame
    path: Path
    problems: Mapping[str, str]
    rollout_errors: Path | None = None


@dataclass(frozen=True)
class ScenarioPredictions:
    """Predictions of one scenario under one protocol in one fold; arrays are over ``trials``."""

    scenario: str
    protocol: Readout
    trials: tuple[str, ...]
    probability: np.ndarray
    train_accuracy: float
    fit_trials: int
    fold: int
    fit_labels: str
    training_set: str = ""
    training_seed: str = ""
    reader: str = ""
    c: float = float("nan")
    cv_accuracy: float = float("nan")
    fitted: Mapping[str, float] = field(default_factory=dict)
    validation_loss: float = float("nan")
    copy_last_loss: float = float("nan")
    note: str = ""


def describe_labels(recorded: Sequence[bool]) -> str:
    """Return which outcomes a fit used: ``recorded``, ``simulated``, ``mixed``, or "" for no trial.

    ``recorded`` says for each fit trial whether its outcome comes from the official recording.
    """
    if not recorded:
        return ""
    if all(recorded):
        return "recorded"
    return "mixed" if any(recorded) else "simulated"


def make_table(
    predictions: list[ScenarioPredictions], provenance: Provenance, index: pd.DataFrame
) -> pd.DataFrame:
    """Return the sorted table of predictions, one row per protocol and tested trial.

    Accuracies are means over all folds of a protocol and scenario.
    """
    truth = index.set_index("trial")
    versions = provenance.versions
    if "physion " not in versions:
        versions = f"{versions}, {MADE_WITH}" if versions else MADE_WITH
    rows = []
    for part in predictions:
        for trial, p in zip(part.trials, part.probability, strict=True):
            recorded = truth["recorded_contact"][trial]
            rows.append(
                {
                    "Model": provenance.model,
                    "Readout Train Data": part.scenario,
                    "Readout Test Data": part.scenario,
                    "Train Accuracy": part.train_accuracy,
                    "Readout Type": part.protocol.letter,
                    "Predicted Prob_false": 1 - float(p),
                    "Predicted Prob_true": float(p),
                    "Predicted Outcome": bool(p > 0.5),
                    "Actual Outcome": bool(truth["contact"][trial]),
                    "Stimulus Name": trial,
                    "Encoder Type": provenance.encoder_type,
                    "Dynamics Type": provenance.dynamics_type,
                    "Encoder Pre-training Task": provenance.encoder_pretraining_task,
                    "Encoder Pre-training Dataset": provenance.encoder_pretraining_dataset,
                    "Encoder Pre-training Seed": provenance.encoder_pretraining_seed,
                    "Encoder Training Task": provenance.encoder_training_task,
                    "Dynamics Training Task": provenance.dynamics_training_task,
                    "Dynamics Training Dataset": part.training_set,
                    "Dynamics Training Seed": part.training_seed,
                    "Protocol": part.protocol.value,
                    "Init": provenance.init,
                    "Inputs": provenance.inputs,
                    "Recorded Outcome": "" if pd.isna(recorded) else bool(recorded),
                    "Observed Contact": bool(truth["observed_contact"][trial]),
                    "Fit Labels": part.fit_labels,
                    "Fit Trials": part.fit_trials,
                    "Fold": part.fold,
                    "Readout C": part.c,
                    "CV Accuracy": part.cv_accuracy,
                    "Reader": part.reader,
                    "Noise Scale": part.fitted.get("scale", float("nan")),
                    "Gap Threshold": part.fitted.get("gap", float("nan")),
                    "Validation Loss": part.validation_loss,
                    "Copy-last Loss": part.copy_last_loss,
                    "Note": part.note,
                    "Versions": versions,
                }
            )
    table = pd.DataFrame(rows, columns=[*OFFICIAL_COLUMNS, *OWN_COLUMNS])
    hits = (table["Predicted Outcome"] == table["Actual Outcome"]).astype(float)
    cells = [table["Protocol"], table["Readout Test Data"]]
    table["Test Accuracy"] = hits.groupby(cells).transform("mean")
    table["Train Accuracy"] = table["Train Accuracy"].astype(float).groupby(cells).transform("mean")
    return table.sort_values(list(ORDER), ignore_index=True)


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write a CSV file and its SHA-256; equal tables give equal bytes."""
    buffer = io.StringIO()
    table.to_csv(buffer, index=False, lineterminator="\n")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_with_digest(path, buffer.getvalue().encode())


def file_name(model: str) -> str:
    """Return the name of a model as part of a file's name: other characters become ``-``."""
    return re.sub(r"[^A-Za-z0-9._+]+", "-", model).strip("-.") or "model"


def read_table(path: Path) -> pd.DataFrame:
    """Read a table that `write_table` wrote; texts stay texts, and empty ones stay empty."""
    return pd.read_csv(
        path,
        dtype=_DTYPES,  # type: ignore[arg-type]
        keep_default_na=False,
        na_values={name: [""] for name in _NUMBERS},
    )
