"""The page of the published results: its numbers are those of the tables, its bytes repeat."""

from __future__ import annotations

import json
import re
from html import unescape
from pathlib import Path

import pandas as pd
import pytest

from physion.analysis.figure_tables import SCENARIO_ZONE
from physion.analysis.published.claims import PublishedResults, published_results
from physion.report.published import build_published_report

FIGURES = [*(f"panel_{name}" for name in "acde"), "figure_s1", "figure_s3"]


@pytest.fixture(scope="module")
def results(official: Path) -> PublishedResults:
    return published_results(official)


@pytest.fixture(scope="module")
def built(results: PublishedResults, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_published_report(results, tmp_path_factory.mktemp("pub"))


@pytest.mark.nightly
@pytest.mark.slow
def test_page_shows_published_and_expected_means(built: Path) -> None:
    whole = re.sub(r"<(style|figure)>.*?</\1>", " ", built.read_text(encoding="utf-8"), flags=re.S)
    text = " ".join(unescape(re.sub(r"<[^>]+>", " ", whole)).split())
    table = pd.read_csv(built.parent / "tables" / "accuracies.csv")
    for column in ("published", "expected"):
        values = table.loc[table["model"] == "DPI", column]
        words = " ".join(f"{value:.3f}" for value in [*values, values.mean()])
        assert f"DPI {words}" in text
    assert "mix detection into prediction" in text
    assert "released table calls pVGG a Transformer" in text
    assert "only when readout full, which sees the outcome, is pooled in" in text
    for name in ("S2", "S4", "S5"):
        assert re.search(rf"Figures that the released tables do not determine .* {name} ", text)
    assert "interval by the paper's way" in text


@pytest.mark.nightly
@pytest.mark.slow
def test_four_panels_with_their_tables(built: Path) -> None:
    names = {path.name for path in (built.parent / "figures").iterdir()}
    assert names == {f"{name}.{kind}" for name in FIGURES for kind in ("svg", "pdf", "png", "csv")}
    values = json.loads((built.parent / "published.json").read_text())
    assert len(values["tables"]["accuracies"]) == 88
    panel = pd.read_csv(built.parent / "figures" / "panel_a.csv")
    assert set(panel.loc[panel["panel"] == "mean", "zone"]) == {SCENARIO_ZONE}
    assert panel["value"].notna().all() and len(panel) == 99
