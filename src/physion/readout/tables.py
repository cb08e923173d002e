"""The table of predictions: one row per trial, training protocol and readout."""

from __future__ import annotations

import dataclasses
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from physion.clips.batch import Provenance
from physion.core.files import write_with_digest
from physion.core.version import MADE_WITH
from physion.readout.decisions import Decided

COLUMNS = (
    "model", "readout", "protocol", "init", "seed", "stimulus", "scenario", "p_contact", "outcome",
    "recorded_outcome", "observed_contact", "inputs", "frames", "benchmark", "check", "decision",
    "train_accuracy", "test_accuracy", "cv_accuracy", "fit_labels", "fit_trials", "fit_on", "fold",
    "readout_c", "noise_scale", "gap_threshold", "validation_loss", "copy_last_loss",
    "encoder_type", "encoder_pretraining_task", "encoder_pretraining_dataset",
    "encoder_pretraining_seed", "encoder_training_task", "dynamics_type", "dynamics_training_task",
    "dynamics_training_dataset", "note", "versions",
)  # fmt: skip
"""Columns of the table, in their order.

- ``readout``: observed, observed+simulated or full. ``protocol``: scenarios that trained the model:
  all, all-but, only or one; it and ``seed`` are empty for a model that was not trained.
- ``init``: initial weights of the model. ``inputs``: what the model was given of a trial: names of
  `clips.batch.INPUTS` with commas, ``outcomes``, ``answers of people``, or ``base rate`` (nothing).
- ``frames``: first and last frame that it sees, and how many a second of the movie, such as
  ``2 to 44, 5/s``; ``up to 44`` of features that were computed elsewhere; empty where it sees none
  here. ``benchmark``: rules (`readout.benchmark`).
- ``check``: verdict of `physion.check`, such as ``passed``; empty if it was not asked for.
- ``p_contact``: P(contact). ``outcome``: of the trial as it was shown; ``recorded_outcome``: of the
  official recording, empty where there is none; ``observed_contact``: whether agent and patient
  touched in the observed part already, empty if that is not known.
- ``decision``: what turned features or rollouts into probabilities. ``readout_c``, ``noise_scale``
  and ``gap_threshold`` (metres): what it fitted.
- ``train_accuracy``, ``test_accuracy``: means over all folds of a protocol, readout and scenario;
  tested by `true_outcomes`.
- ``fit_labels``: outcomes that the decision was fitted on (`describe_labels`); ``fit_trials``:
  number of trials in the fit; ``fit_on``: set that they belong to, name and digest, empty for the
  dataset's own trials; ``fold``: fold of a cross-validation, or -1.
- ``copy_last_loss``: loss of the trivial predictor on held-out trials, as ``validation_loss``.
- ``encoder_*``, ``dynamics_*``: the fields of `clips.batch.Provenance`, but
  ``dynamics_training_dataset``: the scenario that trained the model under the protocol *one*.
- ``versions``: of this package and of those that the model used.
"""

ORDER = ("readout", "dynamics_training_dataset", "scenario", "stimulus")
"""Columns by which the rows are sorted."""

_NUMBERS = (
    "p_contact", "train_accuracy", "test_accuracy", "cv_accuracy", "readout_c", "noise_scale",
    "gap_threshold", "validation_loss", "copy_last_loss",
)  # fmt: skip
"""Columns of numbers, of which some may be empty."""
_DTYPES = {
    **dict.fromkeys(COLUMNS, "str"),
    **dict.fromkeys(_NUMBERS, "float64"),
    "outcome": "bool",
    "observed_contact": "boolean",
    **dict.fromkeys(("fit_trials", "fold"), "int64"),
}
"""Types by column, of which `read_table` reads each column at once."""


@dataclass(frozen=True)
class ScenarioPredictions:
    """Predictions of one scenario, or of several together, under one readout in one fold.

    ``decided`` holds P(contact) of ``trials`` and what was fitted; the other fields are columns of
    the table.
    """

    scenario: str
    readout: str
    trials: tuple[str, ...]
    decided: Decided
    fit_trials: int
    fold: int
    fit_labels: str
    fit_on: str = ""
    protocol: str = ""
    dynamics_training_dataset: str = ""
    seed: str = ""
    decision: str = ""
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
    predictions: Sequence[ScenarioPredictions],
    provenance: Provenance,
    index: pd.DataFrame,
    benchmark: str = "",
    frames: Callable[[str, str], str] = lambda readout, scenario: "",
    verdict: str = "",
) -> pd.DataFrame:
    """Return the sorted table of predictions; ``frames``: as text, by readout and scenario."""
    truth = index.set_index("trial")
    facts = dataclasses.asdict(provenance)
    if "physion " not in facts["versions"]:
        facts["versions"] = ", ".join(filter(None, (facts["versions"], MADE_WITH)))
    rows = []
    for part in predictions:
        decided = part.decided
        shared = facts | {
            "readout": part.readout,
            "protocol": part.protocol,
            "dynamics_training_dataset": part.dynamics_training_dataset,
            "seed": part.seed,
            "benchmark": benchmark,
            "check": verdict,
            "decision": part.decision,
            "train_accuracy": decided.train_accuracy,
            "cv_accuracy": decided.cv_accuracy,
            "fit_labels": part.fit_labels,
            "fit_trials": part.fit_trials,
            "fit_on": part.fit_on,
            "fold": part.fold,
            "readout_c": decided.c,
            "noise_scale": decided.fitted.get("scale", float("nan")),
            "gap_threshold": decided.fitted.get("gap", float("nan")),
            "validation_loss": part.validation_loss,
            "copy_last_loss": part.copy_last_loss,
        }
        for trial, p in zip(part.trials, decided.probability, strict=True):
            recorded = truth["recorded_contact"][trial]
            observed = truth["observed_contact"][trial]
            rows.append(
                shared
                | {
                    "stimulus": trial,
                    "scenario": (scenario := str(truth["scenario"][trial])),
                    "frames": frames(part.readout, scenario),
                    "p_contact": float(p),
                    "note": "; ".join(filter(None, (part.note, decided.notes.get(trial, "")))),
                    "outcome": bool(truth["contact"][trial]),
                    "recorded_outcome": "" if pd.isna(recorded) else bool(recorded),
                    "observed_contact": "" if pd.isna(observed) else bool(observed),
                }
            )
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    hits = ((table["p_contact"] > 0.5) == true_outcomes(table)).astype(float)
    cells = [table[name] for name in ORDER[:-1]]
    table["test_accuracy"] = hits.groupby(cells).transform("mean")
    table["train_accuracy"] = table["train_accuracy"].astype(float).groupby(cells).transform("mean")
    return table.sort_values(list(ORDER), ignore_index=True)


def true_outcomes(table: pd.DataFrame) -> pd.Series[bool]:
    """Return the outcome of each prediction: the recorded one, where it is known."""
    recorded = table["recorded_outcome"].astype(str)
    known = recorded.isin(("True", "False"))
    return recorded.where(known, table["outcome"].astype(str)) == "True"


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
        na_values={name: [""] for name in (*_NUMBERS, "observed_contact")},
    )


MEAN = "mean"
"""Name of the rows with the mean of the scenarios."""
_MODEL = ["model", "init", "protocol", "benchmark", "readout"]
_GROUP = [*_MODEL, "scenario"]


def summarise_accuracy(table: pd.DataFrame) -> pd.DataFrame:
    """Return the accuracy of predictions by `true_outcomes`, as mean and spread over seeds.

    Parameters
    ----------
    table
        Predictions, with `COLUMNS`; none may occur twice.

    Returns
    -------
    pandas.DataFrame
        Columns ``model``, ``init``, ``protocol``, ``benchmark``, ``readout``, ``scenario``,
        ``seeds`` and ``trials`` (numbers of them), ``accuracy`` (0..1, mean), ``spread`` (standard
        deviation of a seed, n - 1; NaN for one seed). Rows with the scenario `MEAN` are of the mean
        of the scenarios of each seed, where there are several. Under the protocol *one*,
        ``protocol`` names the scenario that trained, too: ``one: drop``.
    """
    if table.empty:
        return pd.DataFrame(columns=[*_GROUP, "seeds", "trials", "accuracy", "spread"])
    hits = ((table["p_contact"] > 0.5) == true_outcomes(table)).astype(float)
    trained = table["dynamics_training_dataset"]
    protocol = table["protocol"].where(trained == "", table["protocol"] + ": " + trained)
    scored = table[[*_GROUP, "seed"]].assign(accuracy=hits, protocol=protocol)
    by_seed = scored.groupby([*_GROUP, "seed"])["accuracy"].agg(["mean", "size"]).reset_index()
    by_seed = by_seed.rename(columns={"mean": "accuracy", "size": "trials"})
    whole = by_seed.groupby([*_MODEL, "seed"]).agg(
        accuracy=("accuracy", "mean"), trials=("trials", "sum"), scenarios=("scenario", "size")
    )
    whole = whole[whole["scenarios"] > 1].reset_index().assign(scenario=MEAN)
    every = pd.concat([by_seed, whole.drop(columns="scenarios")], ignore_index=True)
    # So that the mean stands below the scenarios.
    every["last"] = every["scenario"] == MEAN
    summary = every.groupby([*_MODEL, "last", "scenario"]).agg(
        seeds=("seed", "nunique"),
        trials=("trials", "max"),
        accuracy=("accuracy", "mean"),
        spread=("accuracy", "std"),
    )
    return summary.reset_index().drop(columns="last")
