"""Records of finished tasks: valid as long as their files are as they were."""

from __future__ import annotations

import math
from importlib.metadata import EntryPoints, entry_points
from pathlib import Path

import pytest

from physion.readout.plans import keys as plan_keys
from physion.readout.plans.keys import choice_key, key_of
from physion.readout.plans.records import Records
from physion.readout.plans.selection import ModelChoice


def test_a_record_comes_back_while_its_files_stay(tmp_path: Path) -> None:
    records = Records(tmp_path, "trainings")
    weights = tmp_path / "training" / "model"
    weights.parent.mkdir()
    weights.write_text("weights")
    key = key_of("one")
    assert records.read(key) is None and records.all() == []
    records.write(key, {"loss": 0.5, "baseline": math.nan}, [weights])
    assert records.read(key) == {"loss": 0.5, "baseline": None} == records.all()[0]
    assert Records(tmp_path, "evaluations").read(key) is None
    weights.write_text("others!")
    assert records.read(key) is None and records.all() == []


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b'{"values": {}}', b'{"files": {}}', b"\xff"]
)
def test_a_damaged_record_is_none(tmp_path: Path, content: bytes) -> None:
    records = Records(tmp_path, "trainings")
    key = key_of("one")
    records.write(key, {})
    (path,) = (tmp_path / "plan" / "trainings").iterdir()
    path.write_bytes(content)
    assert records.read(key) is None


def test_keys_tell_options_and_files_apart(tmp_path: Path) -> None:
    weights = tmp_path / "weights.safetensors"
    weights.write_text("a")
    choices = [
        ModelChoice("dpi"),
        ModelChoice("gns"),
        ModelChoice("dpi", {"size": "paper"}),
        ModelChoice("dpi", {"weights": str(weights)}),
    ]
    keys = [choice_key(choice) for choice in choices]
    assert len(set(keys)) == 4 and keys == [choice_key(choice) for choice in choices]
    weights.write_text("bc")
    assert choice_key(choices[3]) != keys[3] and choice_key(choices[2]) == keys[2]
    assert choice_key(ModelChoice("dpi", {"weights": "x" * 5000})) not in keys


def test_installed_packages_are_searched_for_models_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each search opens a file of every installed package."""
    searches = []

    def search(**asked: str) -> EntryPoints:
        searches.append(asked)
        return entry_points(**asked)

    monkeypatch.setattr(plan_keys, "entry_points", search)
    plan_keys._plugins.cache_clear()
    keys = [choice_key(ModelChoice(name)) for name in ("dpi", "gns", "cswm")]
    assert len(set(keys)) == 3 and len(searches) == 1
