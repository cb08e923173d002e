"""The benchmark of the paper's claims: its contrasts on made-up predictions, and a tiny run."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.analysis.published.tables import read_published
from physion.data.official import official

FOLDER = Path(__file__).parents[1] / "benchmarks" / "models"


@pytest.fixture(scope="module")
def claims() -> Iterator[Any]:
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module("paper_claims")
    sys.path.remove(str(FOLDER))


def predictions(right: dict[tuple[str, str], float]) -> pd.DataFrame:
    """Return predictions of official stimuli; ``right``: fraction by model and readout."""
    names = sorted(official().labels)[::7]
    rows = []
    for (model, readout), fraction in right.items():
        for at, name in enumerate(names):
            hit = (at * 37 % 100) / 100 < fraction
            contact = official().labels[name]
            rows.append(
                {"model": model, "readout": readout, "protocol": "all", "seed": "0",
                 "stimulus": name, "p_contact": float(contact == hit), "outcome": contact}
            )  # fmt: skip
    return pd.DataFrame(rows)


@pytest.mark.slow
def test_the_tests_of_the_paper_find_what_was_put_in(claims: Any) -> None:
    right = {("CSWM", "observed"): 0.6, ("CSWM", "observed+simulated"): 0.6,
             ("CSWM", "full"): 0.9, ("OP3", "observed"): 0.6,
             ("OP3", "observed+simulated"): 0.6, ("OP3", "full"): 0.9,
             ("DPI", "observed+simulated"): 0.95}  # fmt: skip
    released = read_published(official().results.parent)
    tested = claims.tested_of(predictions(right), released, people=True)
    found = claims.claims(released, {"official": tested}).set_index("claim")
    contrasts = {claim.name: claim.run for claim in claims.MORE}
    full = claims.fitted(contrasts["full, trained end to end"], tested.tables)
    vision = tested.tables.runs[tested.tables.runs["model"] != "DPI"]
    gain = vision.groupby("readout")["accuracy"].mean()
    assert full["b"] == pytest.approx(gain["full"] - gain["observed"])
    assert found.loc["full readout", "official_verdict"] == "same"
    assert found.loc["particle and vision models", "official_verdict"] == "same"
    assert found.loc["RPIN and CSWM", "official_verdict"] == "not computed"
    assert np.isfinite(full["p"])
    own = claims.stored_own(released).tables
    assert "reason" in claims.fitted(contrasts["DPI-Net and people"], own)  # nobody saw these


def test_stored_scores_equal_their_files(claims: Any) -> None:
    released = read_published(official().results.parent)
    scores = pd.read_csv(claims.RESULTS / "official_all.csv")
    means = scores[scores["scenario"] == "mean"].set_index(["model", "readout"])["accuracy"]
    runs = claims.stored_official(released).tables.runs.groupby(["model", "readout"])["accuracy"]
    assert runs.mean()["RPIN", "full"] == pytest.approx(means["rpin-small", "full"])
    assert len(runs) == 6 * 3 + 3
    lines = claims.SMALL.read_text().splitlines()
    mean = next(line for line in lines if line.startswith("dpi-small") and " mean " in line)
    own = claims.stored_own(released)
    accuracy = own.tables.runs.groupby("model")["accuracy"].mean()["DPI"]
    assert accuracy == pytest.approx(float(mean.split()[-1]), abs=1e-3) and own.trials == 480


@pytest.mark.slow
def test_a_tiny_run_is_resumed_and_makes_the_page(claims: Any, tmp_path: Path, capsys: Any) -> None:
    table = importlib.import_module("paper_table")
    chosen = ["--scale", "tiny", "--rendered", "--models", "cswm", "--protocols", "all", "one"]
    chosen += ["--scenarios", "collide", "roll"]
    arguments = [str(tmp_path), *chosen]
    (tmp_path / "speed.json").write_text('{"trial": 1, "cswm: step": 0.5, "cswm: trial": 0.25}')
    table.main([*arguments, "--plan"])
    assert "0 trainings" not in (planned := capsys.readouterr().out)
    assert "1 trainings, about 0.0 hours" in planned
    assert not (tmp_path / "fit").exists()
    table.main(arguments)
    first = capsys.readouterr().out
    page = first[first.index("# Results") :]
    assert "cswm | all | 6 | 1 of 1" in page
    assert "| CSWM | another scenario | observed+simulated |" in page
    part = table.Part(tmp_path, "cswm", "all", table.SCALES["tiny"], rendered=True)
    assert part.train().trained[0].loaded
    assert all(part.evaluate(name).evaluated[0].done for name in part.tested)
