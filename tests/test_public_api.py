"""The names of `import physion`: they are lazy, typed, described, and each is exported once."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

import physion
from support.sources import parsed

ROOT = Path(__file__).parents[1]


def _seen_by_type_checkers() -> dict[str, str]:
    """Return the modules of the public names that the package imports for type checkers."""
    tree = ast.parse((ROOT / "src" / "physion" / "__init__.py").read_text())
    (block,) = (
        node
        for node in tree.body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    return {
        alias.name: node.module or ""
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


NAMES = _seen_by_type_checkers()


def public(name: str) -> Any:
    """Return what a name stands for; the package ``clips`` stands for its function."""
    found = getattr(physion, name)
    return found.clips.clips if name == "clips" else found


def test_the_names_are_listed_before_they_are_used() -> None:
    code = "import physion; print(*dir(physion))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == sorted([*NAMES, "__version__"])


def test_the_import_brings_nothing_with_it() -> None:
    code = """
import sys
import physion
assert physion.__version__
heavy = {"numpy", "pandas", "torch", "numba", "scipy", "h5py", "av"} & set(sys.modules)
assert not heavy, heavy
physion.sample_scene
assert "torch" not in sys.modules and "av" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_the_object_of_its_module(name: str) -> None:
    found = public(name)
    assert found is getattr(importlib.import_module(NAMES[name]), name)
    assert found.__module__ == NAMES[name] and found.__name__ == name


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'simulat'"):
        _ = physion.simulat  # type: ignore[attr-defined]


def test_every_exported_name_is_in_one_list() -> None:
    lists = {}
    for path in (ROOT / "src").rglob("*.py"):
        for node in parsed(path).body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
                lists[path] = ast.literal_eval(node.value)
    assert len(lists) > 3
    counts = Counter(name for names in lists.values() for name in names)
    assert not {name for name, count in counts.items() if count > 1}
    assert set(lists[ROOT / "src" / "physion" / "__init__.py"]) == {*NAMES, "__version__"}


@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_and_result_is_described(name: str) -> None:
    found = public(name)
    text = inspect.getdoc(found) or ""
    described = text.partition("Parameters\n---")[2]
    for parameter in inspect.signature(found).parameters:
        if parameter != "self":
            assert re.search(rf"^[\w*, ]*\b{parameter}\b[\w, ]*$", described, re.M), parameter
    assert "Raises\n---" in text or name == "label_contact"
    if not inspect.isclass(found):
        assert "Returns\n---" in text


@pytest.mark.parametrize("name", NAMES)
def test_examples_in_docstrings_are_true(name: str) -> None:
    found = public(name)
    module = importlib.import_module(NAMES[name])
    finder = doctest.DocTestFinder(recurse=False)
    runner = doctest.DocTestRunner()
    for test in finder.find(found, name, module=module):
        assert runner.run(test).failed == 0, name


def test_the_version_matches_the_distribution() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == physion.__version__
