"""The verb run: sampled scenes, and the official ones compared with real people."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pandas as pd
import pytest

from physion.cli.main import main

SMALL = ["--limit", "2", "--size", "64", "--steps", "10", "--samples", "4", "--workers", "2"]


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file by its path in the folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }


@pytest.mark.slow
def test_sampled_scenes_to_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["run", "--out", str(tmp_path), *SMALL, "--json"]
    assert main(command) == 0
    answer = json.loads(capsys.readouterr().out)
    page = Path(answer["report"])
    assert page.is_file() and "<html" in page.read_text()
    agents = {row["model"] for row in answer["scores"]}
    assert agents == {"random-resnet18-mlp", "noisy-simulation"}
    index = pd.read_parquet(tmp_path / "trials" / "index.parquet")
    assert dict(index.groupby("split").size()) == {"readout": 12, "testing": 6}
    first = digests(tmp_path)
    assert main(command) == 0
    assert digests(tmp_path) == first, "a second run must change nothing"


@pytest.mark.slow
def test_official_scenes_against_people(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = [*SMALL, "--limit", "1"]
    command = ["run", "--scenes", str(official / "scenes"), "--humans", str(official / "humans")]
    assert main([*command, "--out", str(tmp_path), *small, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    scores = pd.DataFrame(answer["scores"])
    rows = scores[(scores["scenario"] == "pooled") & (scores["model"] == "noisy-simulation")]
    assert rows["stimuli"].item() >= 7  # one a scenario; a Roll trial with a ledge may be left out
    assert 0.5 < rows["human_accuracy"].item() < 1
    stimuli = pd.read_csv(Path(answer["report"]).parent / "tables" / "stimuli.csv")
    recorded = pd.read_parquet(tmp_path / "trials" / "index.parquet").set_index("trial")
    for row in stimuli.itertuples():
        assert row.label == recorded.loc[row.stimulus, "recorded_contact"]


def test_people_need_their_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--humans", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "--scenes" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
