"""The index: every changed bit is noticed, and so is every column of a wrong type."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.cli.main import main as cli
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError
from physion.core.files import digest_path
from physion.trials.dataset import Dataset
from physion.trials.index import COLUMNS, index_bytes, read_index, write_index
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import plan_scenes
from support.hand_made import make_by_hand, make_scene


def make(folder: Path) -> None:
    tasks = plan_scenes("tests", [make_scene(name) for name in "abc"])
    assert not make_trials(folder, tasks, make=make_by_hand, executor=SerialExecutor()).failed


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "set"
    make(folder)
    return folder


def test_the_index_comes_back_with_its_types(finished: Path, tmp_path: Path) -> None:
    table = read_index(finished)
    assert {name: str(table[name].dtype) for name in COLUMNS} == dict(COLUMNS)
    pd.testing.assert_frame_equal(
        table, pd.read_parquet(finished / "index.parquet"), check_dtype=False
    )
    write_index(tmp_path, table)
    assert (tmp_path / "index.parquet").read_bytes() == (finished / "index.parquet").read_bytes()


def test_every_flipped_bit_is_noticed(finished: Path, tmp_path: Path) -> None:
    content = (finished / "index.parquet").read_bytes()
    digest = digest_path(finished / "index.parquet").read_bytes()
    digest_path(tmp_path / "index.parquet").write_bytes(digest)
    for place in np.linspace(0, len(content) * 8 - 1, 200).astype(int):
        changed = bytearray(content)
        changed[place // 8] ^= 1 << (place % 8)
        (tmp_path / "index.parquet").write_bytes(changed)
        with pytest.raises(BadInputError, match="run the command that made the dataset again"):
            read_index(tmp_path)


def test_generate_makes_a_damaged_index_again(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    make(folder)
    path = folder / "index.parquet"
    content = bytearray(path.read_bytes())
    content[200] ^= 4
    path.write_bytes(content)
    with pytest.raises(BadInputError, match=r"index\.parquet was changed"):
        Dataset(folder)
    make(folder)
    assert path.read_bytes() == (finished / "index.parquet").read_bytes()
    assert len(Dataset(folder)) == 3


@pytest.mark.parametrize(
    ("column", "value", "says"),
    [
        ("contact", "perhaps", "column 'contact' must hold true or false, not .*string"),
        ("contact", 1, "column 'contact' must hold true or false, not int64"),
        ("frames", "many", "column 'frames' must hold whole numbers, not .*string"),
        ("frames", 60.5, "column 'frames' must hold whole numbers, not double"),
        ("index", None, "column 'index' must hold whole numbers, not null"),
        ("index", pd.array([1, None, 2], dtype="Int64"), "column 'index' lacks 1 values"),
        ("trial", 7, "column 'trial' must hold text, not int64"),
        ("robust", "high", "column 'robust' must hold numbers, not .*string"),
        ("digest", [b"x"] * 3, "column 'digest' must hold text, not binary"),
        ("digest", [["x"]] * 3, "column 'digest' must hold text, not list"),
    ],
)
def test_wrong_types_are_one_line(
    finished: Path, tmp_path: Path, column: str, value: Any, says: str, capsys: Any
) -> None:
    read_index(finished).assign(**{column: value}).to_parquet(tmp_path / "index.parquet")
    with pytest.raises(BadInputError, match=says) as error:
        read_index(tmp_path)
    assert "\n" not in str(error.value)
    for verb in (["verify"], ["view"], ["export", "--layout", "card"]):
        assert cli([verb[0], str(tmp_path), *verb[1:]]) == 2
        assert capsys.readouterr().err.startswith("physion: ")


def test_text_of_invalid_bytes_is_one_line(finished: Path, tmp_path: Path) -> None:
    content = index_bytes(read_index(finished).assign(digest="ZZZZZZZZ"))
    assert content.count(b"ZZZZZZZZ") >= 1
    (tmp_path / "index.parquet").write_bytes(content.replace(b"ZZZZZZZZ", b"\xff" * 8))
    with pytest.raises(BadInputError, match=r"index\.parquet cannot be read"):
        read_index(tmp_path)
