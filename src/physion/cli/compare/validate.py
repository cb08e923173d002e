"""Check files of predictions, and of responses: columns, values, duplicates, leakage of splits.

Predictions are also checked against the stimuli and outcomes of the responses. Rows are counted
from 1 below the header. Exit code 1 where a file has an error, else 0.
"""

from __future__ import annotations

import json as json_module
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from physion.analysis.check import Checked, Reference


@dataclass(frozen=True)
class Options:
    """Prediction files, and what they are checked against."""

    predictions: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Prediction files with the official column names."""
    responses: tuple[Path, ...] = ()
    """Answers of single participants: our export or the study's raw files."""
    sessions: Path | None = None
    """Table of sessions of our export."""
    expected: Path | None = None
    """List of the stimuli that each session must contain (default: expected.csv in the folder of
    the responses)."""
    humans: Path | None = None
    """Folder with human_accuracy-*.csv; the official outcomes are looked for next to it."""
    labels: Path | None = None
    """Official outcomes (stim_ID, label): the stimuli that should be predicted."""
    index: Path | None = None
    """Dataset, or its index (parquet or CSV): which trials there are, and of which split."""
    fitted: Path | None = None
    """List of the stimuli on which the readout was fitted, one a line."""
    json: bool = False
    """Print one JSON list, an object a file."""


def main(options: Options) -> int:
    """Print the faults; return 1 if one of them is an error."""
    from physion.analysis.check import check_predictions_file
    from physion.core.errors import BadInputError

    if not options.predictions and not options.responses:
        raise BadInputError("no file of predictions or --responses was given")
    reference = _reference(options)
    found = []
    if options.responses:
        checked, outcomes = _responses(options, reference.labels)
        found.append(checked)
        if reference.labels is None and outcomes:
            reference = replace(reference, labels=outcomes)
    found += [check_predictions_file(path, reference) for path in options.predictions]
    if options.json:
        print(json_module.dumps([{**asdict(each), "errors": each.errors} for each in found]))
    else:
        for each in found:
            _print(each)
    return 1 if any(each.errors for each in found) else 0


def _responses(
    options: Options, labels: Mapping[str, bool] | None
) -> tuple[Checked, dict[str, bool]]:
    """Check the responses, and return the outcomes of the stimuli that people answered."""
    from physion.analysis.check import check_responses
    from physion.analysis.people.exclusions import find_expected, read_expected

    path = options.expected or find_expected(options.responses)
    checked, responses = check_responses(
        options.responses,
        options.sessions,
        labels,
        None if path is None else read_expected(path),
    )
    if responses is None:
        return checked, {}
    rows = responses.test.drop_duplicates("stimulus")
    return checked, dict(zip(rows["stimulus"], rows["label"].astype(bool), strict=True))


def _reference(options: Options) -> Reference:
    from physion.analysis.check import Reference, read_index
    from physion.analysis.tables import LABELS_FILE, find_next_to, read_labels, read_stimulus_list
    from physion.core.errors import BadInputError

    labels = options.labels
    if labels is None and options.humans is not None:
        labels = find_next_to(options.humans, "stimuli", LABELS_FILE)
        if labels is None:
            raise BadInputError(f"no {LABELS_FILE} lies near {options.humans}; give --labels")
    return Reference(
        labels=None if labels is None else read_labels(labels),
        index=None if options.index is None else read_index(options.index),
        fitted=None if options.fitted is None else read_stimulus_list(options.fitted),
    )


def _print(checked: Checked) -> None:
    from physion.cli.output import console

    for fault in checked.faults:
        console.print(f"{checked.file}: {fault}", markup=False, soft_wrap=True)
    for words in checked.not_checked:
        console.print(f"{checked.file}: not checked: {words}", markup=False, soft_wrap=True)
    warnings = len(checked.faults) - checked.errors
    counted = f"{len(checked.models)} models"
    if checked.people:
        counted = ", ".join(f"{scenario}: {n} people" for scenario, n in checked.people.items())
    summary = f"{checked.rows} rows, {counted}, {checked.errors} errors, "
    console.print(f"{checked.file}: {summary}{warnings} warnings", markup=False, soft_wrap=True)
