"""Tables of predictions as the notebooks of the study read them: official columns and names.

The notebooks select scenarios as ``collision``, ``containment``, ``clothiness``, ``linking``,
``rollingsliding`` and ``towers`` (``change_names`` in ``physion/metrics.py`` of physics-models).
The columns follow docs/official-system.md, section 5.5.
"""

from __future__ import annotations

import io
from pathlib import Path

import pandas as pd

from physion.core.errors import BadInputError
from physion.core.files import check_digest, folder_for_writing, write_atomic
from physion.core.names import NAMES
from physion.core.tables import Column, check_table

_OURS = {
    "Model": "model",
    "Readout Train Data": "scenario",
    "Readout Test Data": "scenario",
    "Train Accuracy": "train_accuracy",
    "Test Accuracy": "test_accuracy",
    "Readout Type": "readout",
    "Predicted Prob_false": None,
    "Predicted Prob_true": "p_contact",
    "Predicted Outcome": None,
    "Actual Outcome": "outcome",
    "Stimulus Name": "stimulus",
    "Encoder Type": "encoder_type",
    "Dynamics Type": "dynamics_type",
    "Encoder Pre-training Task": "encoder_pretraining_task",
    "Encoder Pre-training Dataset": "encoder_pretraining_dataset",
    "Encoder Pre-training Seed": "encoder_pretraining_seed",
    "Encoder Training Task": "encoder_training_task",
    "Encoder Training Dataset": "",
    "Encoder Training Seed": "",
    "Dynamics Training Task": "dynamics_training_task",
    "Dynamics Training Dataset": "protocol",
    "Dynamics Training Seed": "seed",
}
"""Our column by the official one, in the official order; None for what is computed, "" for none."""
NEEDED = frozenset({"model", "stimulus", "scenario", "p_contact", "outcome", "readout"})
"""Columns by which a CSV file is recognised as a table of predictions."""
NO_DATASET = "none"
"""Data set of a model that was not trained on any."""
_DATASETS = ("Encoder Training Dataset", "Dynamics Training Dataset", "Readout Train Data")
EXPERIMENTS = {name: names.experiment for name, names in NAMES.items()}
"""Official name of a scenario."""
_PREDICTED = Column("predicted", "flag", "Predicted outcome, by default P(contact) above 0.5")
_READOUTS = {"full": "A", "observed+simulated": "B", "observed": "C"}
"""Official letter of a readout."""


def export_result_tables(folder: Path, out: Path) -> list[Path]:
    """Write every table of predictions under ``folder`` into ``out``, in the official form.

    Returns the paths written. The tables belong into ``results/csv/models`` of the study's
    repository.

    Raises
    ------
    BadInputError
        If there is no table of predictions, two tables have the same name, or a table is damaged.
    """
    tables: dict[str, tuple[Path, str]] = {}
    if out.resolve().is_relative_to(folder.resolve()):
        raise BadInputError(f"{out} lies in {folder}; choose a folder outside it")
    for path in sorted(folder.rglob("*.csv")):
        text = _official_text(path)
        if text is None:
            continue
        if path.name in tables:
            raise BadInputError(
                f"{tables[path.name][0]} and {path} have the same name; export one folder at a time"
            )
        tables[path.name] = path, text
    if not tables:
        raise BadInputError(
            f"{folder} has no table of predictions; give the folder that `physion evaluate` wrote"
        )
    with folder_for_writing(out):
        for name, (_, text) in tables.items():
            write_atomic(out / name, text.encode())
    return [out / name for name in tables]


def _official_text(path: Path) -> str | None:
    """Return a table in the official form; None if it is not a table of predictions."""
    try:
        content = path.read_bytes()
        if NEEDED - set(pd.read_csv(io.BytesIO(content), nrows=0).columns):
            return None
        check_digest(path, content, "run physion evaluate again")
        # As text, so that the digits of numbers stay as they are.
        table = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)
        probability = table["p_contact"].astype(float)
    except (ValueError, OSError) as error:
        raise BadInputError(f"{path} is not a table: {error}") from error
    official = pd.DataFrame(
        {name: table.get(ours or "", "") for name, ours in _OURS.items()}, index=table.index
    )
    scenario = table["scenario"].replace(EXPERIMENTS)
    protocol = official["Dynamics Training Dataset"]
    official["Readout Train Data"] = official["Readout Test Data"] = scenario
    official["Readout Type"] = official["Readout Type"].replace(_READOUTS)
    official["Predicted Prob_false"] = 1 - probability
    official["Predicted Outcome"] = probability > 0.5
    if "predicted" in table:
        given = check_table(table, (_PREDICTED,), str(path))["predicted"]
        official["Predicted Outcome"] = given.fillna(official["Predicted Outcome"]).astype(bool)
    # A training on all other scenarios is marked by ``no_``.
    official["Dynamics Training Dataset"] = protocol.mask(
        protocol == "all-but", "no_" + scenario
    ).mask(protocol == "only", scenario)
    if "dynamics_training_dataset" in table:
        one = table["dynamics_training_dataset"].replace(EXPERIMENTS)
        official["Dynamics Training Dataset"] = official["Dynamics Training Dataset"].mask(
            protocol == "one", one
        )
    # pandas reads an empty column as numbers, into which the notebooks cannot write their texts.
    official[list(_DATASETS)] = official[list(_DATASETS)].replace("", NO_DATASET)
    return str(official.to_csv(index=False, lineterminator="\n"))
