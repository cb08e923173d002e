"""What the files of containers name exists: copied files, extras, options of the command line."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest
import tyro

from physion.cli.help import find_module
from support.paths import ROOT

DOCKERFILES = [ROOT / "Dockerfile", ROOT / "examples" / "server" / "Dockerfile"]
DEVCONTAINER = ROOT / ".devcontainer" / "devcontainer.json"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def steps(path: Path) -> list[tuple[str, str]]:
    """Instructions of a Dockerfile with their arguments; continued lines are joined."""
    text = re.sub(r"^#.*\n", "", path.read_text(), flags=re.M).replace("\\\n", " ")
    found = (line.partition(" ") for line in text.splitlines() if line.strip())
    return [(name, arguments.strip()) for name, _, arguments in found]


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.parent.name)
def test_copied_files_exist_and_are_all_that_the_build_needs(path: Path) -> None:
    copied = [word for name, rest in steps(path) if name == "COPY" for word in rest.split()[:-1]]
    assert copied and all((ROOT / word).exists() for word in copied)
    needed = {"pyproject.toml", "src", PROJECT["readme"], *PROJECT["license-files"][:1]}
    assert needed <= set(copied)


@pytest.mark.parametrize("path", [*DOCKERFILES, DEVCONTAINER], ids=lambda path: path.parent.name)
def test_extras_exist(path: Path) -> None:
    named = re.findall(r"(?:\.\[|EXTRAS=)([a-z,]+)", path.read_text())
    extras = {extra for text in named for extra in text.split(",")}
    assert extras and extras <= set(PROJECT["optional-dependencies"])


def test_the_command_of_the_image_is_accepted() -> None:
    (line,) = (rest for name, rest in steps(DOCKERFILES[0]) if "physion generate" in rest)
    words = shlex.split(line.partition("&&")[0])
    module, taken = find_module(words[1:])
    tyro.cli(module.Options, args=words[1 + taken :])


def test_the_development_container_is_json() -> None:
    content = json.loads(DEVCONTAINER.read_text())
    assert content["image"] and "requirements.lock" in content["postCreateCommand"]
