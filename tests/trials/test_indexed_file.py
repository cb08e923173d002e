"""Every reader of a movie or a trial compares it with its SHA-256 in the index, unless told not."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from physion.cli.main import main as cli
from physion.clips.batch import Spec
from physion.clips.clips import observed_source, whole_source
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError
from physion.report.html import movies_of
from physion.report.viewer.build import ViewerOptions, build_viewer
from physion.trials.dataset import Dataset
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_scenes
from physion.trials.official.export_folder import export_official
from physion.trials.share.card import write_card
from support.hand_made import make_by_hand, make_scene

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


@pytest.mark.parametrize("column", ["trial_file", "movie"])
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
    shards = ["export", str(folder), str(tmp_path / "s"), "--layout", "webdataset", "--no-verify"]
    assert cli(shards) == 2
    assert "--no-verify does not apply to webdataset" in capsys.readouterr().err
