"""The pages about a model and an engine of one's own: files, code and commands run as printed."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import ROOT

EXAMPLES = ROOT / "examples" / "my_model"
BIN = Path(sys.executable).parent


def read_page(name: str) -> str:
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def run(arguments: list[str], folder: Path) -> None:
    environment = os.environ | {
        "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{folder}",
        "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}",
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{arguments}: {done.stdout}{done.stderr}"


def test_the_engine_of_the_page_runs(tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", read_page("own-engine"), re.S)
    assert len(blocks) == 3 and blocks[0].startswith("# my_engine.py\n")
    (tmp_path / "my_engine.py").write_text(blocks[0], encoding="utf-8")
    run([sys.executable, "-c", "\n".join(blocks[1:])], tmp_path)
    assert len(list(tmp_path.glob("sliding-trials/testing/collide/*.h5"))) == 2


def test_the_page_shows_the_examples_as_they_are() -> None:
    blocks = re.findall(r"```python\n# (my_\w+\.py)\n(.*?)```", read_page("own-model"), re.S)
    assert {name for name, _ in blocks} == {path.name for path in EXAMPLES.glob("*.py")}
    for name, text in blocks:
        assert text == (EXAMPLES / name).read_text(encoding="utf-8"), name


@pytest.mark.slow
def test_the_commands_of_the_model_page_lead_to_a_report(tmp_path: Path) -> None:
    page = read_page("own-model")
    for path in EXAMPLES.glob("*.py"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    commands = [
        line
        for block in re.findall(r"```sh\n(.*?)```", page, re.S)
        for line in block.splitlines()
        if line.startswith("physion ")
    ]
    assert [shlex.split(line)[1] for line in commands] == ["run", "evaluate", "compare"]
    for line in commands:
        run(["bash", "-c", line], tmp_path)
    scripts = re.findall(r"```python\n(?!# my_)(.*?)```", page, re.S)
    assert len(scripts) == 2
    run([sys.executable, "-c", "\n".join(scripts)], tmp_path)
    names = {path.name.partition("-")[0] for path in tmp_path.rglob("predictions/*.csv")}
    assert names >= {"MyEncoder", "my"}
    report = (tmp_path / "runs" / "report" / "report.html").read_text(encoding="utf-8")
    assert "MyEncoder" in report and "my rule" in report


@pytest.mark.parametrize("page", ["own-model", "own-engine"])
def test_paths_and_links_of_the_pages_exist(page: str) -> None:
    text = read_page(page)
    paths = re.findall(r"`((?:src|tests)/[\w/.]+)`", text)
    links = re.findall(r"\]\(([^)#]+)", text)
    assert paths and all((ROOT / path).exists() for path in paths)
    assert all((ROOT / "docs" / link).exists() for link in links), links


@pytest.mark.slow
def test_the_python_of_the_readme_runs(tmp_path: Path) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    assert len(blocks) == 2 and all(f"physion.{name}(" in text for name in ("simulate", "evaluate"))
    for number, block in enumerate(blocks):
        script = tmp_path / f"readme_{number}.py"
        script.write_text(block, encoding="utf-8")
        run([sys.executable, str(script)], tmp_path)
