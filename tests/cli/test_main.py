"""Command line: quick help, errors in one line with exit code 2."""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from physion.cli import doctor
from physion.cli.main import OUTPUT_CLOSED, VERBS, main

PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from physion.cli.main import main; main(['--help']); "
        "heavy = {'numpy', 'torch', 'mujoco', 'tyro', 'numba', 'pandas'} & set(sys.modules); "
        "sys.exit(len(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert all(verb in done.stdout for verb in VERBS)


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([verb, "--help"])
    assert left.value.code == 0
    text = capsys.readouterr().out
    assert f"physion {verb}" in text
    # Values have names, and defaults that say nothing are left out.
    assert "STR" not in text and "{None}" not in text and "--no-json" not in text
    assert "(default: )" not in text and "(default: None)" not in text


@pytest.mark.parametrize("content", [None, "empty", "file"])
def test_bad_folders_are_one_line(
    tmp_path: Path, content: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "scenes"
    if content == "empty":
        folder.mkdir()
    elif content == "file":
        folder.write_text("not a folder")
    target = tmp_path / "table.json"
    assert main(["replay", str(folder), "--json", str(target)]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and str(folder) in message
    assert not target.exists() and not list(tmp_path.glob(".*part"))


def test_doctor_says_what_is_here(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "mujoco" in out and "H.264" in out and "write access" in out


def test_doctor_checks_every_declared_dependency(monkeypatch: pytest.MonkeyPatch) -> None:
    declared = tomllib.loads(PYPROJECT.read_text())["project"]
    extras = declared["optional-dependencies"]
    # As a wheel's metadata states them.
    lines = declared["dependencies"] + [
        f"{line} ; extra == '{name}'" for name, lines in extras.items() for line in lines
    ]
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: lines)
    found = doctor.requirements()
    assert set(found) == {"", *extras} - {"all"}
    assert {"numpy", "pydantic", "jinja2"} <= set(found[""])
    assert found["mujoco"] == ["mujoco-core"] and "uvicorn" in found["experiment"]
    assert [len(found[name]) for name in found] == [
        len(declared["dependencies"]), *(len(extras[name]) for name in found if name),
    ]  # fmt: skip


def test_doctor_names_the_command_that_installs_playwright(monkeypatch: pytest.MonkeyPatch) -> None:
    version = doctor._version
    monkeypatch.setattr(
        doctor, "_version", lambda name: None if name == "playwright" else version(name)
    )
    (check,) = (check for check in doctor.packages() if check.name == "extra dev")
    assert not check.good and not check.needed
    assert "playwright" in check.value and "-e '.[dev]'" in check.remedy


def test_doctor_refuses_a_folder_that_is_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "--folder", str(tmp_path / "nowhere")]) == 1
    assert "--folder" in capsys.readouterr().out


def test_unknown_scenarios_get_the_closest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (
        ["replay", str(tmp_path), "--scenario", "colide"],
        ["generate", str(tmp_path / "out"), "--scenario", "colide"],
    ):
        assert main(command) == 2
        message = capsys.readouterr().err
        assert message.count("\n") == 1 and "collide" in message
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("buffered", [True, False])
@pytest.mark.parametrize(
    "command",
    [
        "--help",
        "ls",
        *(pytest.param(c, marks=pytest.mark.nightly) for c in ("ls --help", "doctor")),
    ],
)
def test_a_closed_output_ends_the_command_quietly(command: str, buffered: bool) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "physion.cli.main", *command.split()],
            env={**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"},
            stdout=writer,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (OUTPUT_CLOSED, "")


@pytest.mark.slow
def test_no_output_is_no_error() -> None:
    code = "import os, sys; os.close(1); os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    done = subprocess.run(
        [sys.executable, "-c", code, "-m", "physion.cli.main", "ls"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
