"""The verb import-official, and the word official in place of a folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from physion.cli.main import main
from physion.cli.official.read import humans_folder, read_trials
from physion.data import official as packaged


def test_a_checkout_is_converted_and_read_in_place_of_the_package(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["import-official", str(official), str(tmp_path / "made"), "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["trials"] == 874 and made["answered"] == 1144
    assert read_trials(tmp_path / "made").trials == list(packaged().trials)
    assert humans_folder(tmp_path / "made") == tmp_path / "made" / "humans"


def test_official_means_the_package_unless_there_is_such_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert humans_folder(Path("official")) == packaged().humans
    (tmp_path / "official").mkdir()
    assert humans_folder(Path("official")) == Path("official")


def test_trials_are_chosen_by_scenario_and_limit() -> None:
    chosen = read_trials(Path("official"), "link", 3).trials
    assert [trial.scene.scenario for trial in chosen] == ["link"] * 3


def test_another_layout_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["import-official", str(tmp_path), str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "holds no human_accuracy" in error and error.count("\n") == 1
