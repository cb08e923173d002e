"""The benchmark of the paper's claims: its contrasts on made-up predictions, and a tiny run."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.analysis.published.tables import read_published
from physion.core.errors import BadInputError
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
    means = scores[scores["scenario"] == "mean"].set_index(["base_model", "readout"])["accuracy"]
    runs = claims.stored_official(released).tables.runs.groupby(["model", "readout"])["accuracy"]
    assert runs.mean()["CSWM", "full"] == pytest.approx(means["cswm-small", "full"], abs=1e-4)
    # Of EfficientNet two readouts, of particle models one.
    assert len(runs) == 4 * 3 + 2 + 3
    lines = claims.SMALL.read_text().splitlines()
    mean = next(line for line in lines if line.startswith("dpi-small") and " mean " in line)
    own = claims.stored_own(released)
    accuracy = own.tables.runs.groupby("model")["accuracy"].mean()["DPI"]
    assert accuracy == pytest.approx(float(mean.split()[-1]), abs=1e-3) and own.trials == 480


@pytest.mark.nightly
@pytest.mark.slow
def test_a_tiny_run_is_resumed_and_tests_other_scenarios(
    claims: Any, tmp_path: Path, capsys: Any
) -> None:
    table = importlib.import_module("paper_table")
    (tmp_path / "speed.json").write_text('{"trial": 1, "cswm: step": 36, "cswm: trial": 1}')
    chosen = ["--scale", "tiny", "--scenarios", "collide", "roll", "--models", "cswm"]
    table.main([str(tmp_path), *chosen, "--plan"])
    # 1 + 2 + 2 trainings of 6 steps; 20 trials are made, 16 encoded three times, 12 twice
    assert "5 trainings, about 0.3 hours" in capsys.readouterr().out
    assert not (tmp_path / "fit").exists()
    scale = table.SCALES["tiny"]
    assert table.make_sets(tmp_path, scale, ["collide", "roll"], rendered=True) == 20
    part = table.Part(tmp_path, "cswm", "one", scale, rendered=True)
    assert part.stored() is None
    first = part.train()
    assert [one.name for one in first.trained] == ["collide", "roll"] and not first.failed
    assert all(one.loaded for one in part.train().trained)
    assert not part.evaluate("official").failed
    page = importlib.import_module("paper_page")
    for done in (part, table.Part(tmp_path, "cswm", "only", scale, rendered=True)):
        done.evaluate("own")
        done.evaluate("official")
        done.stored().write(tmp_path / "stored")
    only, one = page.read_stored(tmp_path / "stored")
    assert only.protocol == "only" and set(only.predictions["tested"]) == {"official", "own"}
    assert (
        set(one.predictions["tested"]) == {"official"} and one.predictions["outcome"].dtype == bool
    )
    assert len(only.losses) == 2 and np.isfinite(only.losses).all()
    text = page.write_page([only, one], tmp_path, write=False)
    assert "| cswm | only | 2 | 2 | 6 | 0.001 |" in text and "- *all*: CSWM" in text
    assert "not computed" in page.write_page([one], tmp_path, write=False)
    seen = only.predictions
    for other in (
        replace(only, scale={**only.scale, "trials": 3}),
        replace(only, predictions=seen[seen["stimulus"] != seen["stimulus"].iloc[0]]),
    ):
        other.write(tmp_path / "stored")
        with pytest.raises(BadInputError, match="cswm under one and cswm under only"):
            page.read_stored(tmp_path / "stored")
    released = read_published(official().results.parent)
    tested = claims.tested_of(one.predictions, released, people=True)
    pairs = tested.across.runs.groupby("training").size()
    assert pairs.to_dict() == {"only": 2, "another scenario": 2} and tested.tables.runs.empty
    assert set(tested.matrices["trained"]) == {"collide", "roll"} and len(tested.matrices) == 4
