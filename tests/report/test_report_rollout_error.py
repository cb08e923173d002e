"""The figure of errors of imagined motion, and the option of compare that draws it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import PolyCollection

from physion.analysis import Comparison
from physion.analysis.rollout_errors import COLUMNS, CONSTANT_VELOCITY, ERRORS
from physion.cli.main import main
from physion.report.figures.by_scenario import draw_rollout_error as draw
from physion.report.figures.by_scenario import rollout_error
from physion.report.figures.theme import LIGHT
from physion.report.inputs import ReportInputs

Maker = Callable[..., Comparison]

SECONDS = (0.03, 0.06)


def table() -> pd.DataFrame:
    rows = [
        (panel, model, kind, seconds, 5, slope * seconds, slope * seconds - 0.01,
         slope * seconds + 0.02)
        for panel in ("drop", "mean")
        for model, kind, slope in (
            ("one", "model", 1.0), ("two", "model", 2.0), (CONSTANT_VELOCITY, "baseline", 50.0)
        )
        for seconds in SECONDS
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=list(COLUMNS))


def test_curves_and_bands_match_the_table() -> None:
    figure = draw(table(), LIGHT)
    drop, mean = figure.axes[:2]
    assert drop.get_title("left") == "drop" and mean.get_title("left") == "mean over scenarios"
    drawn = [line.get_xydata() for line in drop.lines]
    for points, slope in zip(drawn, (1.0, 2.0, 50.0), strict=True):
        assert np.allclose(np.asarray(points), [[s, slope * s] for s in SECONDS])
    bands = [band for band in drop.collections if isinstance(band, PolyCollection)]
    heights = [band.get_paths()[0].get_extents() for band in bands]
    assert heights[1].ymin == pytest.approx(0.05) and heights[1].ymax == pytest.approx(0.14)
    # Constant velocity, here far above the models, does not make their curves flat.
    assert drop.get_ylim()[1] < 0.4 and drop.get_ylim()[0] == 0
    styles = {str(line.get_linestyle()) for line in drop.lines}
    assert len(styles) == 3, "lines differ without colour"
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["one", "two", CONSTANT_VELOCITY]


def test_no_errors_no_figure(make_comparison: Maker) -> None:
    comparison = make_comparison()
    assert rollout_error(ReportInputs(comparison)) is None
    plot = rollout_error(ReportInputs(comparison, rollout_errors=table()))
    assert plot is not None and plot.table.equals(table())


@pytest.mark.nightly
@pytest.mark.slow
def test_compare_draws_the_errors_that_it_is_given(tmp_path: Path) -> None:
    predictions = pd.DataFrame(
        {
            "Model": "sim",
            "Readout Type": "B",
            "Predicted Prob_true": [0.9, 0.2, 0.7, 0.1],
            "Predicted Outcome": [True, False, True, False],
            "Actual Outcome": [True, False, False, False],
            "Stimulus Name": [f"pilot_it2_drop_simple_box_{i:04d}" for i in range(4)],
        }
    )
    predictions.to_csv(tmp_path / "p.csv", index=False)
    errors = pd.DataFrame(
        [("sim", "drop", f"drop_testing_{i:04d}", 3, 0.1 * i, 0.4) for i in range(4)],
        columns=[column.name for column in ERRORS],
    )
    errors.to_csv(tmp_path / "e.csv", index=False)
    arguments = ["compare", str(tmp_path / "p.csv"), "--resamples", "20"]
    arguments += ["--out", str(tmp_path / "report"), "--rollout-errors"]
    assert main([*arguments, str(tmp_path / "e.csv")]) == 0
    drawn = pd.read_csv(tmp_path / "report" / "figures" / "rollout_error.csv")
    assert drawn["value"].tolist() == pytest.approx([0.15, 0.4])
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "Error of imagined motion" in page
    assert main([*arguments, str(tmp_path / "p.csv")]) == 2
