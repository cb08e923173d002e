"""The page on trial files agrees with the code, and its examples run."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.physics.labels import Labels
from physion.trials import state
from physion.trials.files import Metadata
from physion.trials.index import INDEX_COLUMNS
from physion.trials.trial_file import FIELDS, GEOMETRY, PASSES, SCHEMA, Field, Trial
from support.paths import ROOT

PAGE = (ROOT / "docs" / "reference" / "trial-files.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Run all blocks of the page in an empty folder; return the names that they define."""
    namespace: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("page"))
        for block in BLOCKS:
            exec(compile(block, "docs/reference/trial-files.md", "exec"), namespace)
        namespace["folders"] = sorted(str(p) for p in Path().rglob("*") if p.is_file())
    return namespace


@pytest.mark.nightly
@pytest.mark.slow
def test_the_examples_compute_what_they_say(names: dict[str, Any]) -> None:
    trial: Trial = names["trial"]
    frames = trial.metadata.frames
    assert names["movie"].shape == (9, 64, 64, 3) and names["movie"].dtype == np.uint8
    assert names["depth"].shape == (64, 64)
    assert names["metadata"] == dataclasses.asdict(trial.metadata)
    assert names["labels"] == dataclasses.asdict(trial.labels)
    np.testing.assert_array_equal(names["positions"], trial.trajectory.positions)
    np.testing.assert_array_equal(names["pairs"], trial.trajectory.contacts.bodies)
    assert names["names"] == trial.scene.names()
    assert names["centres"].shape == (frames, 3)
    # The centre of a convex agent lies among the pixels that show it, unless something hides it.
    rows, columns = np.nonzero(names["agent_mask"])
    u, v = names["pixels"][0]
    assert columns.min() - 1 <= u <= columns.max() + 2 and rows.min() - 1 <= v <= rows.max() + 2
    assert isinstance(names["index"], pd.DataFrame)


@pytest.mark.slow
def test_the_folders_are_as_shown(names: dict[str, Any]) -> None:
    shown = re.search(r"## Folders\n\n```\n(.*?)```", PAGE, re.DOTALL)
    assert shown is not None
    words = set(re.findall(r"[\w.<>/-]+", shown[1]))
    for path in map(Path, names["folders"]):
        assert {path.name, "/".join(path.parts[-2:])} & words, path


def _rows(fields: Mapping[str, Field], folder: str = "") -> list[str]:
    return [
        f"| `{folder}{name}` | `{field.dtype}` | ({', '.join(map(str, field.axes))}) "
        f"| {field.meaning} |"
        for name, field in fields.items()
    ]


def test_every_array_is_listed() -> None:
    for row in _rows(FIELDS) + _rows(GEOMETRY) + _rows(PASSES, "passes/"):
        assert row in PAGE
    assert f"PHYSION TRIAL {SCHEMA}\n" in PAGE


def test_every_column_is_listed() -> None:
    for name, column in INDEX_COLUMNS.items():
        if not name.endswith(("_bytes", "_sha256")):
            assert f"| `{name}` | `{column.dtype}` | {column.meaning} |" in PAGE


@pytest.mark.parametrize("kind", [Labels, Metadata])
def test_every_key_of_the_texts_is_listed(kind: Any) -> None:
    for field in dataclasses.fields(kind):
        assert re.search(rf"^\|[^|]*`{field.name}`[^|]*\|", PAGE, re.MULTILINE), field.name


def test_every_function_of_state_is_listed() -> None:
    functions = [
        name
        for name, value in vars(state).items()
        if callable(value) and value.__module__ == state.__name__ and name.islower()
    ]
    for name in functions:
        if not name.startswith("_"):
            assert re.search(rf"^\|[^|]*`{name}`[^|]*\|", PAGE, re.MULTILINE), name
