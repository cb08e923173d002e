"""Index and files of a dataset: read, checked, and described; marks of unusable trials."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.cli.main import main as cli
from physion.clips.batch import Spec
from physion.clips.clips import observed_source, whole_source
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import digest_path
from physion.report.html import movies_of
from physion.report.viewer.build import ViewerOptions, build_viewer
from physion.trials.dataset import UNUSABLE, Dataset, mark_unusable, read_unusable
from physion.trials.index import COLUMNS, index_bytes, read_index, write_index
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_scenes
from physion.trials.official.export_folder import export_official
from physion.trials.share.card import write_card
from physion.trials.state import DRAWN
from support.hand_made import make_by_hand, make_scene
from support.viewer_dataset import make_dataset


def make(folder: Path) -> None:
    tasks = plan_scenes("tests", [make_scene(name) for name in "abc"])
    assert not make_trials(folder, tasks, make=make_by_hand, executor=SerialExecutor()).failed


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "set"
    make(folder)
    return folder


TYPES = {**COLUMNS, "contact": "bool", "observed_contact": "bool"}
"""Types of a complete index; where labels are not stored, these two may be missing."""


def test_the_index_comes_back_with_its_types(finished: Path, tmp_path: Path) -> None:
    table = read_index(finished)
    assert {name: str(table[name].dtype) for name in COLUMNS} == TYPES
    pd.testing.assert_frame_equal(
        table, pd.read_parquet(finished / "index.parquet"), check_dtype=False
    )
    write_index(tmp_path, table)
    assert (tmp_path / "index.parquet").read_bytes() == (finished / "index.parquet").read_bytes()


def test_an_index_without_what_was_drawn_is_read_and_made_again(
    finished: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "set"
    make(folder)
    whole = read_index(folder)
    assert whole["drawn_room"].notna().all() and whole["drawn_agent_mass"].notna().all()
    write_index(folder, whole.drop(columns=list(DRAWN)))
    table = read_index(folder)
    assert {name: str(table[name].dtype) for name in COLUMNS} == TYPES
    assert table[list(DRAWN)].isna().all(axis=None)
    make(folder)
    pd.testing.assert_frame_equal(read_index(folder), whole)


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


@pytest.mark.slow
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


# Every reader of a movie or a trial compares it with its SHA-256 in the index, unless told not.


RGB = Spec(image_size=16, future=1)
STATE = Spec(inputs=("state",), image_size=16, future=1)
READERS: dict[str, tuple[str, Callable[[Path, Path, bool], Any]]] = {
    "trial": ("trial_file", lambda data, out, verify: Dataset(data, verify=verify).trial("a")),
    "frames": ("movie", lambda data, out, verify: Dataset(data, verify=verify).frames("a")),
    "observed frames": (
        "observed_movie",
        lambda data, out, verify: Dataset(data, verify=verify).observed_frames("a"),
    ),
    "observed movies for models": (
        "observed_movie",
        lambda data, out, verify: observed_source(Dataset(data, verify=verify), RGB).context(["a"]),
    ),
    "whole movies for models": (
        "movie",
        lambda data, out, verify: whole_source(Dataset(data, verify=verify), RGB).whole(["a"]),
    ),
    "motions for models": (
        "trial_file",
        lambda data, out, verify: observed_source(Dataset(data, verify=verify), STATE).context(
            ["a"]
        ),
    ),
    "view of movies": (
        "movie",
        lambda data, out, verify: build_viewer(
            data, out / "v.html", ViewerOptions(details=0), verify=verify
        ),
    ),
    "view of trials": (
        "trial_file",
        lambda data, out, verify: build_viewer(
            data, out / "v.html", ViewerOptions(details=0), verify=verify
        ),
    ),
    "card": ("observed_movie", lambda data, out, verify: write_card(data, out, verify=verify)),
}
"""What is read of trial ``a``, and the reader of a dataset, into a folder, with a check or not."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "set"
    tasks = plan_scenes("tests", [make_scene("a", cloth=False), make_scene("b", cloth=False)])
    settings = GenerateSettings(look="redyellow", jitters=0)
    report = make_trials(folder, tasks, settings, make=make_by_hand, executor=SerialExecutor())
    assert not report.failed
    return folder


def damage(folder: Path, column: str) -> Path:
    """Add a byte to a file of trial ``a`` that readers of its format do not look at.

    A trial file is replaced by another whole one, since its format notices every changed byte.
    """
    dataset = Dataset(folder)
    path = dataset.paths("a").all()[column]
    if column == "trial_file":
        shutil.copy(dataset.paths("b").trial_file, path)
    else:
        with path.open("ab") as file:
            file.write(b"\0\0\0\x08free")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_a_changed_file_is_refused_and_can_be_read_on_demand(
    name: str, made: Path, tmp_path: Path
) -> None:
    column, read = READERS[name]
    folder = tmp_path / "set"
    shutil.copytree(made, folder)
    read(folder, tmp_path, True)
    path = damage(folder, column)
    with pytest.raises(BadInputError) as error:
        read(folder, tmp_path, True)
    message = str(error.value)
    assert f"trial 'a': {path} was changed since it was made" in message and "\n" not in message
    read(folder, tmp_path, False)


@pytest.mark.slow
@pytest.mark.parametrize("column", ["trial_file", pytest.param("movie", marks=pytest.mark.nightly)])
def test_an_export_of_a_changed_file_fails_and_the_others_go_on(
    column: str, made: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "set"
    shutil.copytree(made, folder)
    damage(folder, column)
    done = export_official(folder, tmp_path / "out", images=False, executor=SerialExecutor())
    assert done.made == ("b",) and list(done.failed) == ["a"]
    assert "was changed since it was made" in done.failed["a"]
    again = export_official(
        folder, tmp_path / "more", images=False, verify=False, executor=SerialExecutor()
    )
    assert set(again.made) == {"a", "b"}


def test_movies_of_a_report_are_checked(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    shutil.copytree(made, folder)
    assert len(movies_of(folder)) == 2
    damage(folder, "movie")
    with pytest.raises(BadInputError, match="was changed since it was made"):
        movies_of(folder)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
@pytest.mark.parametrize("column", ["trial_file", "movie"])
def test_a_pipe_in_the_place_of_a_file_does_not_hang(
    column: str, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "set"
    shutil.copytree(made, folder)
    path = Dataset(folder).paths("a").all()[column]
    path.unlink()
    os.mkfifo(path)
    assert cli(["verify", str(folder), "--again", "0"]) == 1
    assert "is not a regular file" in capsys.readouterr().out
    with pytest.raises(BadInputError, match="is not a regular file"):
        build_viewer(folder, tmp_path / "v.html", ViewerOptions(details=0))


def test_the_verbs_can_skip_the_check(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "set"
    shutil.copytree(made, folder)
    damage(folder, "movie")
    view = ["view", str(folder), "--out", str(tmp_path / "v.html"), "--details", "0"]
    assert cli(view) == 2
    assert "was changed since it was made" in capsys.readouterr().err
    assert cli([*view, "--no-verify"]) == 0
    tables = ["export", str(folder), str(tmp_path / "s"), "--layout", "result-tables"]
    assert cli([*tables, "--no-verify"]) == 2
    assert "--no-verify does not apply to result-tables" in capsys.readouterr().err


# --- marks of unusable trials ---------------------------------------------------------------------


@pytest.fixture
def marked(tmp_path: Path) -> Dataset:
    return Dataset(make_dataset(tmp_path / "set"))


def test_marks_are_added_changed_and_taken_back(marked: Dataset) -> None:
    assert read_unusable(marked) == {}
    mark_unusable(marked, {"drop_1": "clips,\n  twice", "drop_0": "dark"})
    assert read_unusable(marked) == {"drop_0": "dark", "drop_1": "clips, twice"}
    text = (marked.folder / UNUSABLE).read_text()
    assert text == 'trial,reason\ndrop_0,dark\ndrop_1,"clips, twice"\n'
    mark_unusable(marked, {"drop_0": " ", "drop_1": "flickers"})
    assert read_unusable(marked) == {"drop_1": "flickers"}


def test_a_file_of_a_spreadsheet_with_more_columns_is_read(marked: Dataset) -> None:
    text = "\ufefftrial,by,reason\r\ndrop_0,Ada,dark\r\n"
    (marked.folder / UNUSABLE).write_text(text, encoding="utf-8")
    assert read_unusable(marked) == {"drop_0": "dark"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trial\ndrop_0\n", "lacks the column.s. reason"),
        ("", "is not a CSV table"),
        ("trial,reason\ndrop_0,\n", "row 1 of column 'reason' holds ''"),
        ("trial,reason\ndrop_0,a\ndrop_9,b\n", "row 2: the dataset has no trial 'drop_9'"),
    ],
)
def test_bad_files_are_refused(marked: Dataset, text: str, message: str) -> None:
    (marked.folder / UNUSABLE).write_text(text)
    with pytest.raises(BadInputError, match=message):
        read_unusable(marked)


def test_unknown_trials_are_refused_and_nothing_is_written(marked: Dataset) -> None:
    with pytest.raises(UnknownNameError, match="closest: drop_0"):
        mark_unusable(marked, {"drop_1": "dark", "dorp_0": "dark"})
    assert not (marked.folder / UNUSABLE).exists()
