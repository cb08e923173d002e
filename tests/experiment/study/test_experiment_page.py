"""The pages on studies name all verbs, valid options and settings, and all tables."""

from __future__ import annotations

import importlib
import re
import shlex
from dataclasses import fields
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.cli.experiment.experiment import SUBVERBS
from physion.experiment.store.database import METADATA
from physion.experiment.study.settings import KEYS

DOCS = Path(__file__).parents[3] / "docs"
PAGE = "".join(
    (DOCS / name).read_text()
    for name in ("tutorials/study.md", "how-to/run-a-study.md", "reference/study.md")
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
    given = re.findall(r"`([a-z_]+) = ([^`]+)`", PAGE)
    keys = {key.name: key for key in KEYS}
    values = {"true": True, "false": False}
    assert len(given) >= 5
    for name, written in given:
        value: object = written.strip('"') if written.startswith('"') else written
        if written.startswith("["):
            value = re.findall(r'"([^"]+)"', written)
        elif written in values:
            value = values[written]
        elif written.isdigit():
            value = int(written)
        keys[name].check(value)


def test_every_table_is_described() -> None:
    described = re.findall(r"^\| `([a-z_]+)` \|", PAGE, flags=re.MULTILINE)
    assert set(described) == set(METADATA.tables)
