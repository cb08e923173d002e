"""Lists of names: a line for each model, reader, engine and executor says what it is."""

from __future__ import annotations

import json
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import physion.core.registry
from physion.cli.ls import DESCRIBED
from physion.cli.main import main
from physion.core.registry import Registry


@pytest.mark.parametrize("kind", DESCRIBED)
def test_every_name_has_a_line_that_says_what_it_is(
    kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ls", kind]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = DESCRIBED[kind]().names()
    assert [line.partition(": ")[0] for line in lines] == names and len(names) >= 2
    texts = [line.partition(": ")[2] for line in lines]
    assert all(text.endswith(".") and len(text) > 10 for text in texts)
    assert len(set(texts)) == len(names), "each says how it differs"
    assert main(["ls", kind, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {kind: names}


def test_plug_ins_are_described_without_being_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = 'raise OSError\nclass Mine:\n    """What it is.\n\n    And more."""\nbare = 1\n'
    (tmp_path / "plug_in_of_a_test.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)

    def points(group: str) -> list[EntryPoint]:
        targets = {
            "mine": "plug_in_of_a_test:Mine",
            "bare": "plug_in_of_a_test:bare",
            "absent": "package_that_is_not_there.inner:Mine",
        }
        return [EntryPoint(name, target, group) for name, target in targets.items()]

    monkeypatch.setattr(physion.core.registry, "entry_points", points)
    fresh: Registry[object] = Registry("model")
    assert {name: fresh.describe(name) for name in fresh} == {
        "mine": "What it is.", "bare": "", "absent": "",
    }  # fmt: skip


def test_a_registered_value_is_described_by_its_docstring() -> None:
    fresh: Registry[object] = Registry("thing")

    @fresh.register("mine")
    class Mine:
        """Say what it is."""

    assert fresh.describe("mine") == "Say what it is."
