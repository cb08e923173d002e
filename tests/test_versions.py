"""Tables and pages say which version of the package made them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from physion.cli.main import main
from physion.clips.batch import Provenance
from physion.core.html import Markup
from physion.core.version import MADE_WITH, __version__
from physion.readout.decisions import Decided
from physion.readout.tables import ScenarioPredictions, make_table
from physion.report.html import render_document
from physion.report.viewer.build import render_viewer

GENERATOR = f'<meta name="generator" content="physion {__version__}">'


def test_pages_name_the_version() -> None:
    assert GENERATOR in render_document("title", Markup(), [])
    assert GENERATOR in render_viewer("title", [], {})


@pytest.mark.parametrize(
    ("stated", "written"),
    [
        ("torch 2.11", f"torch 2.11, {MADE_WITH}"),
        (f"engine 3, {MADE_WITH}", f"engine 3, {MADE_WITH}"),
        ("", MADE_WITH),
    ],
)
def test_each_row_of_predictions_names_the_version(stated: str, written: str) -> None:
    trials = ("a", "b")
    decided = Decided(np.array([0.2, 0.7]), 1.0)
    part = ScenarioPredictions("drop", "observed", trials, decided, 4, -1, "")
    index = pd.DataFrame(
        {"trial": trials, "scenario": "drop", "contact": True, "observed_contact": False,
         "recorded_contact": None}
    )  # fmt: skip
    table = make_table([part], Provenance("model", "none", versions=stated), index)
    assert list(table["versions"]) == [written] * 2


@pytest.mark.slow
def test_numbers_of_a_replay_name_the_version(tmp_path: Path) -> None:
    path = tmp_path / "replay.json"
    command = ["replay", "--scenario", "drop", "--limit", "1", "--workers", "1"]
    assert main([*command, "--json", str(path)]) == 0
    assert json.loads(path.read_text())["package"] == MADE_WITH
