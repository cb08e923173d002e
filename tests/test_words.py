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

LEFT: dict[str, int] = {
    "analysis": 6,
    "cli": 2,
    "experiment": 1,
    "report": 9,
    "scenes": 3,
    "trials": 5,
}
"""Banned words that are still in use, by folder. Lower these numbers, never raise them."""

LEFT_CLASSES: frozenset[str] = frozenset(["Params"])
"""Class names that still exist more than once. Remove names, never add any."""


@cache
def banned_words() -> tuple[frozenset[str], frozenset[str]]:
    """Return the words banned from names, and those from first lines of docstrings."""
    table = GLOSSARY.read_text().partition("## Say this, not that")[2]
    rows = [line.strip("| ").split("|") for line in table.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in row] for row in rows[2:]]

    def words(column: int) -> frozenset[str]:
        texts = [row[column] for row in cells if len(row) > column]
        return frozenset(word.strip() for text in texts for word in text.split(",") if word.strip())

    return words(2), words(3)


def name_parts(name: str) -> set[str]:
    """Split a name at underscores and capitals: ``fit_ReadoutX`` into fit, readout, x."""
    return {part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


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
def test_banned_words_only_become_fewer(folder: str) -> None:
    hits = [
        f"{path.relative_to(PACKAGE)}, {hit}"
        for path in SOURCES
        if path.relative_to(PACKAGE).parts[0] == folder
        for hit in find_banned(ast.parse(path.read_text()))
    ]
    allowed = LEFT.get(folder, 0)
    assert len(hits) <= allowed, f"{len(hits)} > {allowed}; see docs/glossary.md\n" + "\n".join(
        hits
    )


def test_the_search_finds_banned_words() -> None:
    assert len(banned_words()[0]) > 10 and "share of" in banned_words()[1]
    code = 'def fit_share(rng, chance):\n    """Say it in words."""\n\nclass RoundTrip: pass\n'
    assert len(find_banned(ast.parse(code))) == 4
    assert not find_banned(ast.parse('def background(surround):\n    """Draw."""\n'))


def test_a_class_name_exists_once() -> None:
    """Except `Options`, which every verb of the command line has."""
    names = Counter(
        node.name
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert {name for name, count in names.items() if count > 1} - {"Options"} <= LEFT_CLASSES


def test_citations_of_the_official_system_exist() -> None:
    sections = set(re.findall(r"^#{2,3} (\d+(?:\.\d+)?)\b", OFFICIAL.read_text(), re.MULTILINE))
    assert {"0", "3.8", "9"} <= sections
    cited = re.compile(
        r"docs/official-system\.md,\s+(?:#\s*)?(?:sections?\s+)?((?:[\d.]*\d(?:,\s|\s+and\s)?)+)"
    )
    count = 0
    for path in [*SOURCES, *PACKAGE.rglob("*.toml")]:
        text = path.read_text()
        unknown = re.findall(r"reference/[\w-]+\.|(?<!docs/)official-system\.md", text)
        assert not unknown, f"{path}: cites {unknown}, not docs/official-system.md"
        for match in cited.finditer(text):
            count += 1
            numbers = re.findall(r"\d+(?:\.\d+)?", match[1])
            assert numbers and set(numbers) <= sections, f"{path}: {match[0]!r}"
    assert count >= 30
