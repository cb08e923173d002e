"""Every verb shows examples with --help, and each example is a command line that it takes."""

from __future__ import annotations

import shlex

import pytest
import tyro

from physion.cli.help import EXAMPLES, VERBS, find_module, module_of
from physion.cli.main import main


def subverbs(verb: str) -> list[str]:
    return [f"{verb} {word}" for word in getattr(module_of(verb), "SUBVERBS", {})]


def test_every_verb_and_subverb_has_examples() -> None:
    assert set(EXAMPLES) == {*VERBS, *(name for verb in VERBS for name in subverbs(verb))}


@pytest.mark.parametrize(
    ("name", "line"), [(name, line) for name, lines in EXAMPLES.items() for line in lines]
)
def test_examples_are_parsed(name: str, line: str) -> None:
    words = shlex.split(line.partition(" > ")[0])
    assert words[0] == "physion"
    module, taken = find_module(words[1:])
    assert name.split() == words[1 : 1 + taken] or name == words[1]
    # Raises SystemExit for an unknown option or a value of a wrong type.
    tyro.cli(module.Options, args=words[1 + taken :])


@pytest.mark.parametrize("words", [["verify"], ["experiment", "simulate"]])
def test_help_ends_with_options_and_shows_examples(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert "Examples:" in lines
    assert set(EXAMPLES[" ".join(words)]) <= set(lines)
