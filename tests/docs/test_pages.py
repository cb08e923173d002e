"""Links of the pages lead somewhere, their commands are accepted, and their code runs."""

from __future__ import annotations

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
import tyro

from physion.cli.help import find_module
from physion.scenes.sampling.sample import parse_presets
from support.paths import ROOT
from support.sources import parsed

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
RUNNING = [
    *("how-to/add-a-figure", "how-to/add-a-metric", "how-to/add-a-scenario", "how-to/add-a-shape"),
    *("how-to/clusters", "how-to/official-data", "how-to/own-engine"),
]
"""Pages whose Python runs as printed; blocks that begin with a file name become that file."""


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str) -> list[str]:
    found = re.findall(rf"^ *```{language}\n(.*?)^ *```", page.read_text(), re.S | re.M)
    return [str(block) for block in found]


def commands(page: Path) -> list[str]:
    """Return the lines of shell blocks that call ``physion``, without what stands around them."""
    text = "".join(blocks(page, "sh")).replace("\\\n", " ")
    lines = [re.split(r"\s#\s", part)[0].strip() for part in re.split(r"\n|&&", text)]
    return [line for line in lines if re.match(r"(\.venv/bin/)?physion ", line)]


def run(arguments: list[str], folder: Path) -> str:
    environment = os.environ | {
        "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{folder}",
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "HOME": str(folder),
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{arguments}: {done.stdout}{done.stderr}"
    return done.stdout


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_named_files_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link]
    assert all((page.parent / link).exists() for link in links), links
    paths = re.findall(r"`((?:src/physion|tests|benchmarks|examples)/[\w/.*-]+)`", text)
    named = [path for path in paths if "NAME" not in path]
    assert all(list(ROOT.glob(path.rstrip("/"))) for path in named), named


PAPER = DOCS / "explanation" / "paper.md"
STATUSES = ("as written, with", "as written", "otherwise, because", "not possible here")


def paper_rows() -> list[list[str]]:
    """Return the cells of the statements: number, statement, status and places."""
    rows = re.findall(r"^\| (\d+) \| (.+) \| (.+) \| (.+) \|$", PAPER.read_text(), re.M)
    return [list(row) for row in rows]


def status_of(cell: str) -> str:
    """Return the one of `STATUSES` that a cell begins with."""
    endings = (" ", "(;|$)", " ", ": ")
    pairs = zip(STATUSES, endings, strict=True)
    return next((status for status, end in pairs if re.match(status + end, cell)), cell)


def test_counts_of_the_paper_match_its_rows() -> None:
    rows = paper_rows()
    assert [int(row[0]) for row in rows] == list(range(1, len(rows) + 1))
    counts = Counter(status_of(row[2]) for row in rows)
    assert set(counts) == set(STATUSES)
    head = PAPER.read_text().partition("\n## ")[0]
    printed = {a: int(b) for a, b in re.findall(r"^\| ([\w, ]*?) ?\| .+ \| (\d+) \|$", head, re.M)}
    assert printed == {**counts, "": len(rows)}, counts
    listed = re.findall(r"\d+", ", ".join(re.findall(r"^- .+: ([\d, ]+)\.$", head, re.M)))
    impossible = [row[0] for row in rows if status_of(row[2]) == "not possible here"]
    assert sorted(listed, key=int) == impossible


@pytest.mark.slow
def test_places_of_the_paper_exist() -> None:
    for number, _, _, cell in paper_rows():
        places = re.findall(r"`([^`]+)`", cell)
        assert ", ".join(f"`{place}`" for place in places) == cell, number
        for place in places:
            path, _, name = place.partition(":")
            assert (ROOT / path).exists(), f"row {number}: {place}"
            assert has_name(ROOT / path, name), f"row {number}: {place}"


def has_name(path: Path, name: str) -> bool:
    """Return whether a module defines a name, or another file contains a text."""
    if not name or path.suffix != ".py":
        return not name or name in path.read_text(encoding="utf-8")
    return name in names_of(path)


@cache
def names_of(path: Path) -> frozenset[str]:
    return frozenset(defined_names(parsed(path).body))


def defined_names(body: Iterable[ast.stmt], prefix: str = "") -> list[str]:
    """Return what statements define: functions, classes, values, and these of classes, dotted."""
    found: list[str] = []
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            found.append(prefix + node.name)
        if isinstance(node, ast.ClassDef):
            found += defined_names(node.body, f"{prefix}{node.name}.")
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            parts = (part for target in targets for part in ast.walk(target))
            found += [prefix + part.id for part in parts if isinstance(part, ast.Name)]
    return found


@pytest.mark.parametrize("page", [p for p in PAGES if commands(p)], ids=name_of)
def test_commands_are_accepted(page: Path) -> None:
    for line in commands(page):
        words = shlex.split(line.split("|")[0])[1:]
        if words[-1] != "--help":
            module, taken = find_module(words)
            tyro.cli(module.Options, args=words[taken:])


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("page", RUNNING)
def test_python_runs(page: str, tmp_path: Path) -> None:
    scripts = []
    for block in blocks(DOCS / f"{page}.md", "python"):
        if match := re.match(r"# (\w+\.py)\n", block):
            (tmp_path / match[1]).write_text(block, encoding="utf-8")
        else:
            scripts.append(block)
    script = tmp_path / "the_page.py"
    script.write_text("\n".join(scripts), encoding="utf-8")
    assert scripts
    run([sys.executable, str(script)], tmp_path)


def test_the_preset_of_the_page_on_scenes_is_read() -> None:
    (toml,) = blocks(DOCS / "reference" / "scenes.md", "toml")
    presets = parse_presets(toml, "my.toml")
    assert presets["heavy_ball_slope"].params.probe.mass == (8.0, 8.0)


@pytest.mark.slow
def test_the_python_of_the_readme_runs(tmp_path: Path) -> None:
    for number, block in enumerate(blocks(ROOT / "README.md", "python")):
        script = tmp_path / f"readme_{number}.py"
        script.write_text(block, encoding="utf-8")
        assert re.search(r"\d", run([sys.executable, str(script)], tmp_path))


@pytest.fixture(scope="module")
def first_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the commands of the first tutorial ran."""
    folder = tmp_path_factory.mktemp("tutorial")
    for line in commands(DOCS / "tutorials" / "first-report.md"):
        run(["bash", "-c", line], folder)
    return folder


@pytest.mark.nightly
@pytest.mark.slow
def test_the_first_report_is_made(first_report: Path) -> None:
    assert (first_report / "runs" / "first" / "report" / "report.html").is_file()
    assert (first_report / "trials" / "view.html").is_file()
    assert len(list((first_report / "runs" / "models" / "predictions").glob("*.csv"))) == 2


@pytest.mark.nightly
@pytest.mark.slow
def test_the_page_on_own_models_leads_to_a_report(first_report: Path, tmp_path: Path) -> None:
    page = DOCS / "tutorials" / "own-model.md"
    examples = {path.name: path.read_text() for path in (ROOT / "examples/my_model").glob("*.py")}
    shown = re.findall(r"```python\n# (my_\w+\.py)\n(.*?)```", page.read_text(), re.S)
    assert dict(shown) == examples
    for name, text in examples.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    lines = commands(page)
    assert [shlex.split(line)[1] for line in lines] == ["run", "evaluate", "compare"]
    # Both tutorials make the same trials: those of the first are found by the second.
    made = first_report / "runs" / "first" / "trials"
    shutil.copytree(made, tmp_path / "runs" / "my-model" / "trials")
    for line in lines:
        run(["bash", "-c", line], tmp_path)
    scripts = [block for block in blocks(page, "python") if not block.startswith("# my_")]
    run([sys.executable, "-c", "\n".join(scripts)], tmp_path)
    names = {path.name.partition("-")[0] for path in tmp_path.rglob("predictions/*.csv")}
    assert names >= {"MyEncoder", "my"}
    report = (tmp_path / "runs" / "report" / "report.html").read_text(encoding="utf-8")
    assert "MyEncoder" in report and "my rule" in report


@pytest.mark.slow
def test_the_datasheet_lists_the_licence_of_every_dependency() -> None:
    """Those of the extra ``dev`` are tools; licences are compared with the installed packages."""
    page = (DOCS / "reference" / "datasheet.md").read_text()
    listed = dict(re.findall(r"^\| (?:`\w+` )?\| ([\w-]+) \| (.+?) \|$", page, re.M))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    groups = [project["dependencies"], *(extras[n] for n in extras if n not in ("all", "dev"))]
    names = [re.split(r"[^\w-]", needed)[0] for group in groups for needed in group]
    assert set(listed) == set(names)
    compared = 0
    for name, licence in listed.items():
        family = re.match(r"MIT|BSD|Apache|ISC|Python Software", licence)
        assert family, f"{name}: {licence}"
        try:
            found = distribution(name)
        except PackageNotFoundError:
            continue
        fields = ("License-Expression", "License", "Classifier")
        said = [text for field in fields for text in found.metadata.get_all(field) or []]
        texts = [path for path in found.files or [] if "LICENSE" in path.name]
        said += [Path(str(path.locate())).read_text(encoding="utf-8")[:3000] for path in texts]
        assert any(family[0] in text for text in said), f"{name}: {licence}, not {said}"
        compared += 1
    assert compared > 20
