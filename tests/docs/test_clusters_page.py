"""The commands of the page on clusters are accepted, and its code runs."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import tyro

from physion.cli.help.verbs import find_module
from support.paths import ROOT

PAGE = (ROOT / "docs" / "clusters.md").read_text(encoding="utf-8")


def test_the_commands_are_accepted() -> None:
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, re.S)
    lines = [
        line for block in blocks for line in block.replace("\\\n", "").splitlines()
        if line.startswith("physion ")
    ]  # fmt: skip
    assert len(lines) == 4
    for line in lines:
        words = shlex.split(line)
        module, taken = find_module(words[1:])
        options = tyro.cli(module.Options, args=words[1 + taken :])
        assert options.compute.executor in {"slurm", "ray"}


def test_the_code_runs(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    script = tmp_path / "page.py"
    script.write_text(code, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, script],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0].startswith("1 TypeError: bad operand type")
    assert "TypeError" in done.stdout.splitlines()[1]
