"""Language of the package: the glossary's words, one name per class, citations that exist."""

from __future__ import annotations

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "physion"
SOURCES = sorted(PACKAGE.rglob("*.py"))
FOLDERS = sorted({path.relative_to(PACKAGE).parts[0] for path in SOURCES})
GLOSSARY = ROOT / "docs" / "glossary.md"
OFFICIAL = ROOT / "docs" / "official-system.md"


def table_rows(heading: str) -> list[list[str]]:
    """Return the cells of the table under a heading of the glossary, without its first row."""
    section = GLOSSARY.read_text().partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split("|") for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def terms(cells: list[str]) -> frozenset[str]:
    """Return the terms of cells that list them with commas."""
    return frozenset(term.strip() for cell in cells for term in cell.split(",") if term.strip())


@cache
def banned_words() -> tuple[frozenset[str], frozenset[str]]:
    """Return the words banned from names, and those from first lines of docstrings."""
    rows = table_rows("Say this, not that")
    in_names, in_docstrings = ([row[k] for row in rows if len(row) > k] for k in (2, 3))
    return terms(in_names), terms(in_docstrings)


@cache
def allowed_terms() -> frozenset[str]:
    """Return the terms that may be parts of names although one of their words is banned."""
    return terms([row[0] for row in table_rows("Terms with such a word")])


def name_parts(name: str) -> set[str]:
    """Split a name at underscores and capitals: ``fit_ReadoutX`` into fit, readout, x.

    Terms that are allowed as a whole are left out: ``below_chance_level`` gives below.
    """
    words = " ".join(re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)).lower()
    for term in allowed_terms():
        words = re.sub(rf"\b{term}\b", " ", words)
    return set(words.split())


def find_banned(tree: ast.AST) -> list[str]:
    """Return banned words of defined names and of first docstring lines, with their line."""
    in_names, in_docstrings = banned_words()
    defined = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    hits = []
    for node in ast.walk(tree):
        if isinstance(node, (*defined, ast.arg)):
            name = node.arg if isinstance(node, ast.arg) else node.name
            hits += [f"line {node.lineno}: {name}" for _ in name_parts(name) & in_names]
        if isinstance(node, (*defined, ast.Module)) and (text := ast.get_docstring(node)):
            line = text.splitlines()[0]
            for word in in_docstrings:
                if re.search(rf"\b{word}\b", line, re.IGNORECASE):
                    hits.append(f"line {getattr(node, 'lineno', 1)}: {word!r} in {line!r}")
    return hits


@pytest.mark.parametrize("folder", FOLDERS)
def test_names_and_first_lines_hold_no_banned_word(folder: str) -> None:
    hits = [
        f"{path.relative_to(PACKAGE)}, {hit}"
        for path in SOURCES
        if path.relative_to(PACKAGE).parts[0] == folder
        for hit in find_banned(ast.parse(path.read_text()))
    ]
    assert not hits, "see docs/glossary.md\n" + "\n".join(hits)


def test_the_search_finds_banned_words() -> None:
    assert len(banned_words()[0]) > 10 and "share of" in banned_words()[1]
    code = 'def fit_share(rng, chance):\n    """Say it in words."""\n\nclass RoundTrip: pass\n'
    assert len(find_banned(ast.parse(code))) == 4
    assert not find_banned(ast.parse('def background(surround):\n    """Draw."""\n'))


def test_a_banned_word_is_allowed_in_a_term_alone() -> None:
    assert all(set(term.split()) & banned_words()[0] for term in allowed_terms())
    names = (
        "below_chance_level",
        "ChanceLevel",
        "level_of_chance",
        "chances_level",
        "chance_levels",
    )
    banned = [bool(name_parts(name) & banned_words()[0]) for name in names]
    assert banned == [False, False, True, False, True]
    assert not find_banned(ast.parse("def _desk_lamp(): pass"))
    assert len(find_banned(ast.parse("def _lamp(desk, desk_lamp_chance): pass"))) == 2


def test_a_class_name_exists_once() -> None:
    """Except `Options`, which every verb of the command line has."""
    names = Counter(
        node.name
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert {name for name, count in names.items() if count > 1} <= {"Options"}


def test_citations_of_the_official_system_exist() -> None:
    sections = set(re.findall(r"^#{2,3} (\d+(?:\.\d+)?)\b", OFFICIAL.read_text(), re.MULTILINE))
    assert {"0", "3.8", "9"} <= sections
    cited = re.compile(
        r"docs/official-system\.md,\s+(?:#\s*)?(?:sections?\s+)?((?:[\d.]*\d(?:,\s|\s+and\s)?)+)"
    )
    count = 0
    for path in [*SOURCES, *PACKAGE.rglob("*.toml")]:
        text = path.read_text()
        unknown = re.findall(r"shared/reference|(?<!docs/)official-system\.md", text)
        assert not unknown, f"{path}: cites {unknown}, not docs/official-system.md"
        for match in cited.finditer(text):
            count += 1
            numbers = re.findall(r"\d+(?:\.\d+)?", match[1])
            assert numbers and set(numbers) <= sections, f"{path}: {match[0]!r}"
    assert count >= 30
