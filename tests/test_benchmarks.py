"""Benchmarks run seldom: what they import must still be there."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path

import pytest

from support.paths import ROOT

OPTIONAL = {"gpboost", "pymer4", "bambi", "mixedlm", "interlace", "lme", "inspect_ai"}
"""Packages that only some comparisons need."""
SCRIPTS = sorted((ROOT / "benchmarks").glob("*/*.py"))


def names_of(script: Path) -> set[str]:
    """Return the names that a script defines at its top level."""
    found: set[str] = set()
    for node in ast.parse(script.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.ImportFrom):
            found |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Assign):
            found |= {n.id for t in node.targets for n in ast.walk(t) if isinstance(n, ast.Name)}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.add(node.target.id)
    return found


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_what_a_benchmark_imports_exists(script: Path) -> None:
    tree = ast.parse(script.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            missing = {a.name for a in node.names if not is_found(script, a.name)}
            assert not missing, f"{script.name} imports {missing}"
        if not isinstance(node, ast.ImportFrom) or node.module in (None, "__future__"):
            continue
        assert node.module is not None
        sibling = script.with_name(f"{node.module}.py")
        if sibling.is_file():
            known = names_of(sibling)
        elif node.module.partition(".")[0] == "physion":
            module = importlib.import_module(node.module)
            known = {a.name for a in node.names if hasattr(module, a.name)}
            known |= {a.name for a in node.names if is_module(f"{node.module}.{a.name}")}
        else:
            assert is_found(script, node.module), f"{script.name} imports {node.module}"
            continue
        missing = {alias.name for alias in node.names} - known
        assert not missing, f"{script.name} imports {missing} from {node.module}"


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_folders_that_a_benchmark_looks_into_exist(script: Path) -> None:
    text = script.read_text()
    above = re.findall(r"Path\(__file__\)\.parents\[(\d)\]((?: / \"[\w./]+\")*)", text)
    for number, parts in above:
        path = script.parents[int(number)].joinpath(*re.findall(r"\"([^\"]+)\"", parts))
        assert path.exists() or path.suffix, f"{script.name} looks into {path}"
    if 'with_suffix(".R")' in text:
        assert script.with_suffix(".R").is_file()
    if re.search(r"^ROOT\b", text, re.MULTILINE):
        assert "ROOT = Path(__file__).parents[2]\n" in text


def is_found(script: Path, name: str) -> bool:
    """Return whether a benchmark can import a module: of its folder, installed, or of the tests."""
    top = name.partition(".")[0]
    if top in OPTIONAL or script.with_name(f"{top}.py").is_file():
        return True
    if top == "support":
        # By itself, or by the script of its folder that it imports before.
        imported = re.findall(r"^from (\w+) import", script.read_text(), re.MULTILINE)
        files = [script, *(script.with_name(f"{name}.py") for name in imported)]
        texts = [path.read_text() for path in files if path.is_file()]
        return any(re.search(r'(parents\[2\]|ROOT)\)? / "tests"\)\)', text) for text in texts)
    return is_module(top)


def is_module(name: str) -> bool:
    """Return whether a module of this name exists."""
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False
