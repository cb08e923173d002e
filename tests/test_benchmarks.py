"""Benchmarks run seldom: what they import must still be there."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import pytest

from support.paths import ROOT

SCRIPTS = sorted((ROOT / "benchmarks").glob("*/*.py"))


def names_of(script: Path) -> set[str]:
    """Return the names that a script defines at its top level."""
    found: set[str] = set()
    for node in ast.parse(script.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.ImportFrom):
            found |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            found |= {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
    return found


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_what_a_benchmark_imports_exists(script: Path) -> None:
    for node in ast.walk(ast.parse(script.read_text())):
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
            continue
        missing = {alias.name for alias in node.names} - known
        assert not missing, f"{script.name} imports {missing} from {node.module}"


def is_module(name: str) -> bool:
    """Return whether a module of this name exists."""
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False
