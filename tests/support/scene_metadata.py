"""Attributes of official stimuli by the metadata of their scenes, to check names against."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physion.analysis.tables import COLUMNS
from physion.core.names import canonical_name


def attributes_from_metadata(folder: Path) -> pd.DataFrame:
    """Return attributes from all ``<scenario>/<configuration>/metadata.json`` under ``folder``."""
    rows = []
    for path in sorted(folder.glob("*/*/metadata.json")):
        trials = json.loads(path.read_text(encoding="utf-8"))
        rows += [_row(trial, path.parents[1].name, path.parent.name) for trial in trials]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _row(trial: dict[str, Any], scenario: str, configuration: str) -> dict[str, Any]:
    def count(key: str) -> float:
        return float(pd.to_numeric(str(trial.get(key)), errors="coerce"))

    removed = str(trial.get("remove_middle")).lower() == "true"
    # The generator of Drop inherits a count of 0 that has no meaning.
    counted = scenario in ("dominoes", "support")
    return {
        "stimulus": canonical_name(trial["stimulus_name"]),
        "scenario": scenario,
        "configuration": configuration,
        "elements": count("num_middle_objects") - removed if counted else np.nan,
        "distractors": count("num_distractors"),
        "occluders": count("num_occluders"),
        "room": re.sub(r"^b?'?([a-z]*)'?$", r"\1", str(trial.get("room", ""))),
        "source": "metadata",
    }
