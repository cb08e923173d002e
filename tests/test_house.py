"""Rules of the house that no linter knows: import arrows, safe reads, names that say something."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))


def test_import_arrows_hold() -> None:
    program = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    "module",
    ["physion.physics.mujoco_engine", "physion.trials.generate", "physion.analysis",
     "physion.report", "physion.models.noisy_simulation"],
)  # fmt: skip
def test_the_core_runs_without_torch(module: str) -> None:
    # Not by an empty place in sys.modules, in which scipy.stats looks for the classes of torch.
    code = (
        "import sys, importlib\n"
        "class Absent:\n"
        "    def find_spec(self, name, *rest):\n"
        "        if name.partition('.')[0] in ('torch', 'timm'): raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Absent())\n"
        f"importlib.import_module({module!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def _calls(tree: ast.AST) -> list[tuple[str, ast.Call]]:
    return [(ast.unparse(node.func), node) for node in ast.walk(tree) if isinstance(node, ast.Call)]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT / "src")))
def test_untrusted_files_stay_data(path: Path) -> None:
    for name, call in _calls(ast.parse(path.read_text())):
        words = {word.arg: ast.unparse(word.value) for word in call.keywords}
        assert name not in {"eval", "exec", "pickle.load", "pickle.loads", "yaml.load"}, name
        assert words.get("shell") != "True" and words.get("allow_pickle") != "True"
        if name.endswith("torch.load"):
            assert words.get("weights_only") == "True"


def test_modules_have_names_that_say_something() -> None:
    vague = {"utils", "util", "helpers", "helper", "common", "misc"}
    assert not [path for path in SOURCES if {path.stem, path.parent.name} & vague]


def _compiled(path: Path) -> set[str]:
    """Names of the functions of a file that numba compiles."""
    return {
        node.name
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
        and any("njit" in (text := ast.unparse(d)) or text in {"kernel", "step"}
                for d in node.decorator_list)
    }  # fmt: skip


def test_compiled_code_calls_its_own_file_alone() -> None:
    """Numba asks only a kernel's own file whether the machine code on disk is outdated."""
    owners = {name: path for path in SOURCES for name in _compiled(path)}
    strangers = []
    for path in SOURCES:
        mine = _compiled(path)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and node.name in mine:
                called = {name for name, _ in _calls(node)}
                strangers += [
                    f"{path.name}: {node.name} calls {name} of {owners[name].name}"
                    for name in called
                    if name in owners and name not in mine
                ]
    assert owners and not strangers
