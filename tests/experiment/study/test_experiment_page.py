"""The pages on studies name all verbs, valid options and settings, and all tables."""

from __future__ import annotations

import importlib
import re
import shlex
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.cli.experiment.experiment import SUBVERBS
from physion.experiment.store.database import METADATA
from physion.experiment.study.settings import (
    StudySettings,
    all_keys,
    parse_settings,
    settings_table,
)

DOCS = Path(__file__).parents[3] / "docs"
PAGE = "".join(
    (DOCS / name).read_text()
    for name in (
        "tutorials/study.md",
        "how-to/run-a-study.md",
        "reference/study.md",
        "how-to/compare.md",
    )
)


def _commands() -> list[list[str]]:
    """Return the words of every `physion experiment` command on the page."""
    joined = PAGE.replace("\\\n", " ")
    found = re.findall(r"physion (experiment [a-z]+[^\n`#]*)", joined)
    return [shlex.split(line) for line in found]


def test_every_command_has_its_verb_and_options() -> None:
    commands = _commands()
    assert {words[1] for words in commands} >= set(SUBVERBS)
    for words in commands:
        options = importlib.import_module(SUBVERBS[words[1]]).Options
        known = {field.name for field in fields(options)}
        for word in words[2:]:
            if word.startswith("--"):
                name = word.removeprefix("--").removeprefix("no-").replace("-", "_")
                assert name in known, " ".join(words)


def test_every_setting_that_is_given_is_one_that_the_file_may_have() -> None:
    given = re.findall(r"`([a-z_]+ = [^`]+)`", PAGE)
    tables = {key.name: key.table for key in reversed(all_keys())}
    assert len(given) >= 5
    needed = {"name": "n", "version": "1", "title": "t", "contact": "c", "scenarios": ["collide"]}
    for line in given:
        name = line.partition(" ")[0]
        content = f"[{tables[name]}]\n{line}" if tables[name] else line
        settings = parse_settings(needed | tomllib.loads(content), Path(line))
        assert isinstance(settings, StudySettings)


def test_the_table_of_settings_is_generated() -> None:
    """To make it anew, print `settings_table()` into the section Settings."""
    assert settings_table() in PAGE


def test_every_table_is_described() -> None:
    described = re.findall(
        r"^\| `([a-z_]+)` \|", PAGE.partition("## Settings")[0], flags=re.MULTILINE
    )
    assert set(described) == set(METADATA.tables)
