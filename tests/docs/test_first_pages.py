"""The commands and code of the pages on first steps and on official data run as printed."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import tyro

from physion.cli.help.verbs import find_module
from support.paths import ROOT

BIN = Path(sys.executable).parent
ABSENT = {"CHECKOUT", "OFFICIAL-FILES", "study", "my-study", "trials"}
"""Words of the page on official data that stand for files of the reader."""


def blocks(page: str, language: str) -> list[str]:
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


def run(arguments: list[str], folder: Path) -> str:
    environment = os.environ | {
        "PYTHONPATH": str(ROOT / "src"),
        "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}",
        "HOME": str(folder),
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{arguments}: {done.stdout}{done.stderr}"
    return done.stdout


@pytest.mark.slow
def test_the_commands_of_the_quick_start_run(tmp_path: Path) -> None:
    install, *others = blocks("quick-start", "sh")
    assert "pip install" in install and len(others) == 4
    for line in "".join(others).splitlines():
        run(["bash", "-c", line], tmp_path)
    assert (tmp_path / "runs" / "first" / "report" / "report.html").is_file()
    assert (tmp_path / "trials" / "view.html").is_file()
    assert len(list((tmp_path / "runs" / "models" / "predictions").glob("*.csv"))) == 2
    assert (tmp_path / ".local/share/bash-completion/completions/physion").stat().st_size > 1000


@pytest.mark.slow
def test_the_commands_on_official_data_run(tmp_path: Path) -> None:
    lines = [line for block in blocks("official-data", "sh") for line in block.splitlines()]
    ran = 0
    for line in lines:
        words = shlex.split(line)
        assert words[0] == "physion"
        if ABSENT & set(words):
            module, taken = find_module(words[1:])
            tyro.cli(module.Options, args=words[1 + taken :])
        else:
            run(["bash", "-c", line], tmp_path)
            ran += 1
    assert ran == 3 and len(lines) > 6
    (code,) = blocks("official-data", "python")
    assert len(run([sys.executable, "-c", code], tmp_path).split()) == 3
