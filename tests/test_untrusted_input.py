"""No program of the repository can run what a file contains: the syntax trees have no such call."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from support.sources import parsed

ROOT = Path(__file__).parents[1]
PROGRAMS = sorted(
    path
    for folder in ("src", "benchmarks", "docs", "examples")
    for path in (ROOT / folder).rglob("*.py")
)
FORBIDDEN = {
    *("eval", "exec", "builtins.eval", "builtins.exec", "os.system", "os.popen"),
    *("subprocess.getoutput", "subprocess.getstatusoutput", "commands.getoutput"),
    *("pickle.load", "pickle.loads", "pickle.Unpickler", "cloudpickle.load", "cloudpickle.loads"),
    *("dill.load", "dill.loads", "joblib.load", "marshal.load", "marshal.loads", "shelve.open"),
    *("pandas.read_pickle", "yaml.load", "yaml.load_all", "yaml.unsafe_load", "yaml.full_load"),
}
"""Calls that run what they read, or give a text to a shell."""
FALSE_ONLY = {"shell", "allow_pickle"}
"""Keywords that may be false alone."""
REQUIRED = {"torch.load": ("weights_only", True), "tarfile.open().extractall": ("filter", "data")}
"""Calls that need a keyword with this value."""


def imported_names(tree: ast.AST) -> dict[str, str]:
    """Return what imported names stand for: ``numpy`` for ``np``, ``pickle.load`` for ``load``."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {each.asname: each.name for each in node.names if each.asname}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {each.asname or each.name: f"{node.module}.{each.name}" for each in node.names}
    return names


def find_unsafe(tree: ast.AST) -> list[str]:
    """Return the calls that could run what a file contains, with their lines."""
    names = imported_names(tree)
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        first, dot, rest = ast.unparse(node.func).partition(".")
        name = names.get(first, first) + dot + rest
        words = {word.arg: word.value for word in node.keywords}
        unsafe = name in FORBIDDEN
        for keyword in FALSE_ONLY & words.keys():
            value = words[keyword]
            unsafe |= not (isinstance(value, ast.Constant) and value.value is False)
        if name.endswith(".extractall"):
            name = "tarfile.open().extractall"
        if name in REQUIRED:
            keyword, wanted = REQUIRED[name]
            value = words.get(keyword)
            unsafe |= not (isinstance(value, ast.Constant) and value.value == wanted)
        if unsafe:
            found.append(f"line {node.lineno}: {ast.unparse(node)}")
    return found


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_stay_data(path: Path) -> None:
    assert not find_unsafe(parsed(path))


@pytest.mark.parametrize(
    "code",
    [
        "eval(text)",
        "import pickle\npickle.load(file)",
        "import pickle as p\np.loads(data)",
        "from pickle import load as read\nread(file)",
        "from os import system\nsystem('ls')",
        "import subprocess\nsubprocess.run('ls', shell=True)",
        "import subprocess\nsubprocess.run('ls', shell=wanted)",
        "import numpy as np\nnp.load(path, allow_pickle=True)",
        "import torch\ntorch.load(path)",
        "import torch\ntorch.load(path, weights_only=False)",
        "import yaml\nyaml.load(text, Loader=yaml.Loader)",
        "import pandas as pd\npd.read_pickle(path)",
        "archive.extractall(folder)",
    ],
)
def test_the_search_finds_what_is_unsafe(code: str) -> None:
    assert len(find_unsafe(ast.parse(code))) == 1


@pytest.mark.parametrize(
    "code",
    [
        "model.eval()",
        "import subprocess\nsubprocess.run(['ls'], shell=False)",
        "import torch\ntorch.load(path, weights_only=True)",
        "import yaml\nyaml.safe_load(text)",
        "archive.extractall(folder, filter='data')",
    ],
)
def test_the_search_lets_safe_calls_be(code: str) -> None:
    assert not find_unsafe(ast.parse(code))


def test_scripts_of_the_shell_evaluate_nothing() -> None:
    folders = ("examples", "benchmarks", "docs")
    scripts = [*(ROOT / ".ci").iterdir(), *(p for f in folders for p in (ROOT / f).rglob("*.sh"))]
    for script in scripts:
        words = script.read_text(encoding="utf-8").split()
        assert "eval" not in words and not any("curl" in word for word in words), script
