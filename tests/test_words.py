"""Language of the package: the glossary's words, one name per class, citations that exist."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from support.sources import parsed

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "physion"
SOURCES = sorted(PACKAGE.rglob("*.py"))
FOLDERS = sorted({path.relative_to(PACKAGE).parts[0] for path in SOURCES})
GLOSSARY = ROOT / "docs" / "glossary.md"
OFFICIAL = ROOT / "docs" / "official-system.md"
TEXT_FILES = {".py", ".toml", ".html", ".js", ".ts"}
ALLOWED_TEXTS = (
    "not told whether you were right",  # said to participants
    "imported: movie alone",  # stored in trial files
    "black handle and knob",
)
"""Texts with a banned word that stay."""
STORED_NAMES = frozenset({"turn_deg", "turned_push", "even_turn", "zone_share"})
"""Parameters of scenarios, which scenes store: other names would change the bytes of trials."""


def table_rows(heading: str) -> list[list[str]]:
    """Return the cells of the table under a heading of the glossary, without its first row."""
    section = GLOSSARY.read_text().partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split("|") for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def terms(cells: list[str]) -> frozenset[str]:
    """Return the terms of cells that list them with commas."""
    return frozenset(term.strip() for cell in cells for term in cell.split(",") if term.strip())


@cache
def banned_words() -> tuple[frozenset[str], frozenset[str], frozenset[str]]:
    """Return the words banned from names, from first lines of docstrings and from all texts."""
    rows = table_rows("Say this, not that")
    lists = ([row[k] for row in rows if len(row) > k] for k in (2, 3, 4))
    in_names, in_first_lines, in_texts = (terms(cells) for cells in lists)
    return in_names, in_first_lines, in_texts


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
    in_names, in_docstrings, _ = banned_words()
    defined = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    hits = []
    for node in ast.walk(tree):
        if isinstance(node, (*defined, ast.arg)):
            names = [(node.lineno, node.arg if isinstance(node, ast.arg) else node.name)]
            if isinstance(node, ast.ClassDef):
                names += [
                    (field.lineno, field.target.id)
                    for field in node.body
                    if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
                ]
            hits += [
                f"line {line}: {name}"
                for line, name in names
                if name not in STORED_NAMES
                for _ in name_parts(name) & in_names
            ]
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
        for hit in find_banned(parsed(path))
    ]
    assert not hits, "see docs/glossary.md\n" + "\n".join(hits)


def texts_of(path: Path) -> list[tuple[int, str]]:
    """Return strings and comments of Python code, or the whole of another file, with their lines.

    What is between backquotes is a name and left out. Comments of successive lines are one text.
    """
    if path.suffix != ".py":
        return [(1, re.sub(r"`+[^`\n]*`+", "``", path.read_text()))]
    texts: list[tuple[int, str]] = []
    comment = ""
    for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
        if token.type == tokenize.COMMENT:
            comment += token.string.lstrip("#:") + "\n"
        elif token.type == tokenize.STRING:
            texts.append((token.start[0], re.sub(r"`+[^`]*`+", "``", token.string)))
        elif comment and token.type not in (tokenize.NL, tokenize.NEWLINE):
            texts.append(
                (token.start[0] - comment.count("\n"), re.sub(r"`+[^`]*`+", "``", comment))
            )
            comment = ""
    return texts


def has_kernels(path: Path) -> bool:
    """Return whether a file holds compiled functions, which a new docstring would compile anew."""
    return (
        path.suffix == ".py"
        and re.search("numba|numerics.kernel import", path.read_text()) is not None
    )


def find_in_texts(path: Path) -> list[str]:
    """Return the words of a file that are banned from all texts, with their lines."""
    words = sorted(banned_words()[2])
    banned = re.compile(rf"\b(?:{'|'.join(word for word in words)})\b", re.I)
    hits = []
    for line, text in texts_of(path):
        joined = re.sub(r"\s+", " ", text)
        for allowed in ALLOWED_TEXTS:
            joined = joined.replace(allowed, "-" * len(allowed))
        hits += [
            f"line {line} on: {joined[max(0, match.start() - 30) : match.end() + 30]!r}"
            for match in banned.finditer(joined)
        ]
    return hits


@pytest.mark.parametrize("folder", FOLDERS)
def test_texts_of_the_package_hold_no_banned_word(folder: str) -> None:
    hits = [
        f"{path.relative_to(ROOT)}, {hit}"
        for path in sorted((PACKAGE / folder).rglob("*") if (PACKAGE / folder).is_dir() else [])
        if path.suffix in TEXT_FILES and not {"vendor", "data"} & set(path.parts)
        if not has_kernels(path)
        for hit in find_in_texts(path)
    ]
    assert not hits, "see docs/glossary.md\n" + "\n".join(hits)


def test_pages_of_the_documentation_hold_no_banned_word() -> None:
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    hits = [
        f"{page.relative_to(ROOT)}, {hit}"
        for page in pages
        if page not in (GLOSSARY, OFFICIAL) and page.parent.name != "results"
        for hit in find_in_texts(page)
    ]
    assert not hits, "see docs/glossary.md\n" + "\n".join(hits)


def test_names_of_tests_hold_no_banned_word() -> None:
    banned = re.compile(
        "|".join(rf"_{word.replace(' ', '_')}(?=_|$)" for word in banned_words()[2])
    )
    hits = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        for name in re.findall(r"^ *def (test_\w+)", path.read_text(), re.MULTILINE)
        if banned.search(name)
    ]
    assert not hits, "see docs/glossary.md\n" + "\n".join(hits)


def test_the_search_finds_banned_words(tmp_path: Path) -> None:
    assert len(banned_words()[0]) > 10 and "share of" in banned_words()[1]
    code = 'def fit_share(rng, chance):\n    """Say it in words."""\n\nclass RoundTrip: pass\n'
    assert len(find_banned(ast.parse(code))) == 4
    assert len(find_banned(ast.parse("class Rows:\n    words: str\n    zone_share: float\n"))) == 1
    assert not find_banned(ast.parse('def background(surround):\n    """Draw."""\n'))
    file = tmp_path / "code.py"
    file.write_text('"""Return that\n    of ``told``."""\nx = f"it is told"  # those\n# of them\n')
    assert len(find_in_texts(file)) == 3
    page = tmp_path / "page.md"
    page.write_text("The page that offers `told` and lists those\nof others.")
    assert len(find_in_texts(page)) == 1


def test_a_banned_word_is_allowed_in_a_whole_term() -> None:
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
        for node in ast.walk(parsed(path))
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
