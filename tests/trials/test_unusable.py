"""Marks of unusable trials in a dataset's folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from physion.core.errors import BadInputError, UnknownNameError
from physion.trials.dataset import UNUSABLE, Dataset, mark_unusable, read_unusable
from support.viewer_dataset import make_dataset


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return Dataset(make_dataset(tmp_path / "set"))


def test_marks_are_added_changed_and_taken_back(dataset: Dataset) -> None:
    assert read_unusable(dataset) == {}
    mark_unusable(dataset, {"drop_1": "clips,\n  twice", "drop_0": "dark"})
    assert read_unusable(dataset) == {"drop_0": "dark", "drop_1": "clips, twice"}
    text = (dataset.folder / UNUSABLE).read_text()
    assert text == 'trial,reason\ndrop_0,dark\ndrop_1,"clips, twice"\n'
    mark_unusable(dataset, {"drop_0": " ", "drop_1": "flickers"})
    assert read_unusable(dataset) == {"drop_1": "flickers"}


def test_a_file_of_a_spreadsheet_with_more_columns_is_read(dataset: Dataset) -> None:
    text = "\ufefftrial,by,reason\r\ndrop_0,Ada,dark\r\n"
    (dataset.folder / UNUSABLE).write_text(text, encoding="utf-8")
    assert read_unusable(dataset) == {"drop_0": "dark"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trial\ndrop_0\n", "lacks the column.s. reason"),
        ("", "is not a CSV table"),
        ("trial,reason\ndrop_0,\n", "row 1 of column 'reason' holds ''"),
        ("trial,reason\ndrop_0,a\ndrop_9,b\n", "row 2: the dataset has no trial 'drop_9'"),
    ],
)
def test_bad_files_are_refused(dataset: Dataset, text: str, message: str) -> None:
    (dataset.folder / UNUSABLE).write_text(text)
    with pytest.raises(BadInputError, match=message):
        read_unusable(dataset)


def test_unknown_trials_are_refused_and_nothing_is_written(dataset: Dataset) -> None:
    with pytest.raises(UnknownNameError, match="closest: drop_0"):
        mark_unusable(dataset, {"drop_1": "dark", "dorp_0": "dark"})
    assert not (dataset.folder / UNUSABLE).exists()
