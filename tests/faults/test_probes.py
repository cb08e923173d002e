"""docs/explanation/reliability.md names a test for every probe, and each of them exists."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "explanation" / "reliability.md"
PROBES = 34


def rows() -> dict[int, str]:
    """Return the rows of the table of probes by number."""
    found = re.findall(r"^\| (\d+) \|(.*)\|$", PAGE.read_text(), re.MULTILINE)
    assert len({number for number, _ in found}) == len(found), "a probe stands in two rows"
    return {int(number): text for number, text in found}


def named_tests(text: str) -> list[tuple[str, str]]:
    """Return files and functions of the tests that a text names as ``FILE::test``."""
    return re.findall(r"`([\w/]+\.py)::(test_\w+)`", text)


def test_every_probe_has_a_row() -> None:
    assert sorted(rows()) == list(range(1, PROBES + 1))


@pytest.mark.parametrize("number", range(1, PROBES + 1))
def test_the_tests_of_a_probe_exist(number: int) -> None:
    text = rows()[number]
    tests = named_tests(text)
    assert tests or "not possible yet" in text
    for file, name in tests:
        tree = ast.parse((ROOT / "tests" / file).read_text())
        functions = {n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)}
        assert name in functions, f"tests/{file} has no {name}"


def test_the_other_named_tests_exist_too() -> None:
    for file, name in named_tests(PAGE.read_text()):
        assert f"def {name}(" in (ROOT / "tests" / file).read_text(), f"{file}::{name}"
