"""Rules of the house that no linter knows: import arrows, names that say something."""

from __future__ import annotations

import ast
import itertools
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from support.sources import parsed

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))


def test_import_arrows_hold() -> None:
    program = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_core_runs_without_torch() -> None:
    modules = ["physion.physics.rigid.engine", "physion.trials.making.generate",
               "physion.analysis.compare", "physion.report.build",
               "physion.models.noisy_simulation"]  # fmt: skip
    # Not by an empty place in sys.modules, in which scipy.stats looks for the classes of torch.
    code = (
        "import sys, importlib\n"
        "class Absent:\n"
        "    def find_spec(self, name, *rest):\n"
        "        if name.partition('.')[0] in ('torch', 'timm'): raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Absent())\n"
        f"for module in {modules}: importlib.import_module(module)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def _calls(tree: ast.AST) -> list[tuple[str, ast.Call]]:
    return [(ast.unparse(node.func), node) for node in ast.walk(tree) if isinstance(node, ast.Call)]


def _module(path: Path) -> str:
    parts = path.relative_to(ROOT / "src").with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imports(path: Path, modules: set[str]) -> set[str]:
    """Modules of the package that a module imports, inside functions and by `import_module` too."""
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            members = {f"{node.module}.{name.name}" for name in node.names}
            found |= members & modules or {node.module}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            found |= {a.value for a in node.args if isinstance(a, ast.Constant)}
    return (found & modules) - {_module(path)}


BY_NAME = {
    "physion": "public names",
    "physion.cli.help": "verbs",
    "physion.core.registry": "registered objects",
    "physion.report.figures.theme": "modules of figures",
}
"""Modules that import others by names that are not written at the call."""


def _room_levels() -> dict[str, int]:
    """Return the level of each room in the layers of the import arrows, from above."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    (layers,) = (
        contract["layers"]
        for contract in project["tool"]["importlinter"]["contracts"]
        if contract["type"] == "layers"
    )
    return {room.strip(): level for level, rooms in enumerate(layers) for room in rooms.split(":")}


@pytest.mark.slow
def test_no_import_ring() -> None:
    """Each strongly connected component of the graph of imports is a single module."""
    modules = [_module(path) for path in SOURCES]
    imports = [_imports(path, set(modules)) for path in SOURCES]
    graph = [[name in found for name in modules] for found in imports]
    count, labels = connected_components(csr_array(graph), connection="strong")
    rings = [[m for m, of in zip(modules, labels, strict=True) if of == k] for k in range(count)]
    assert not [ring for ring in rings if len(ring) > 1]


@pytest.mark.slow
def test_every_import_by_name_is_known() -> None:
    found = set()
    for path in SOURCES:
        for name, call in _calls(parsed(path)):
            written = call.args and isinstance(call.args[0], ast.Constant)
            if name.endswith(("import_module", "__import__")) and not written:
                found.add(_module(path))
    assert found == set(BY_NAME)


def test_no_module_names_one_of_a_higher_room() -> None:
    """As registries do, whose objects are imported when they are asked for."""
    levels, modules = _room_levels(), {_module(path) for path in SOURCES}
    upward = []
    for path in SOURCES:
        level = levels.get(".".join(_module(path).split(".")[:2]), -1)
        for node in ast.walk(parsed(path)):
            if not (isinstance(node, ast.Constant) and isinstance(node.value, str)):
                continue
            named = node.value.partition(":")[0]
            room = ".".join(named.split(".")[:2])
            if named == "physion.cli.main":
                continue  # the command line as a process of its own
            if named in modules and room in levels and levels[room] < level:
                upward.append(f"{_module(path)}, line {node.lineno}: {node.value}")
    assert not upward


def test_modules_have_names_that_say_something() -> None:
    vague = {"utils", "util", "helpers", "helper", "common", "misc"}
    assert not [path for path in SOURCES if {path.stem, path.parent.name} & vague]


FILES = ("csv", "parquet", "json", "jsonl.gz", "py")
ELSEWHERE = {"datasets.load_dataset"}
"""Names of other libraries that the package does not import."""


def test_references_in_texts_name_what_exists() -> None:
    """Each `module.name` in a docstring or comment: the module exists and has the name."""
    words: dict[str, set[str]] = {}
    texts = {path: path.read_text() for path in SOURCES}
    for path, text in texts.items():
        parts = _module(path).split(".")
        words.setdefault(parts[-1], set()).update(re.findall(r"\w+", text))
        for folder, member in itertools.pairwise(parts):
            words.setdefault(folder, set()).add(member)
    wrong = []
    for path, text in texts.items():
        for written in re.findall(r"(?<!`)`([a-z_]\w*(?:\.[A-Za-z_]\w*)+)`(?!`)", text):
            first, second = written.split(".")[:2]
            foreign = first in sys.stdlib_module_names or f"import {first}" in text
            known = second in words.get(first, ()) or foreign or written in ELSEWHERE
            if not known and not written.endswith(FILES):
                wrong.append(f"{path.relative_to(ROOT)}: {written}")
            if first == "physion" and any(
                member not in words.get(folder, ()) and folder.islower()
                for folder, member in itertools.pairwise(written.split("."))
            ):
                wrong.append(f"{path.relative_to(ROOT)}: {written}")
    assert not wrong


SAME_BYTES = [
    path
    for path in SOURCES
    if path.relative_to(ROOT / "src" / "physion").parts[0]
    in {"numerics", "scenes", "physics", "rendering"}
]
"""What lies between a seed and the stored bytes."""
ANY_ORDER = {
    *("sum", "nansum", "mean", "nanmean", "average", "std", "var", "prod", "trace", "reduceat"),
    *("dot", "vdot", "inner", "outer", "matmul", "tensordot", "einsum", "kron"),
    *("linalg", "fft", "convolve", "correlate", "interp", "polyfit", "partition", "argpartition"),
}
BY_LIBRARY = {
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "arctan2", "asin", "acos", "atan"),
    *("atan2", "sinh", "cosh", "tanh", "exp", "exp2", "expm1", "log", "log2", "log10", "log1p"),
    *("power", "pow", "hypot", "dist", "cbrt", "float_power", "logaddexp", "sinc"),
}
BY_TAILS = {"normal", "lognormal", "exponential", "gamma", "beta", "dirichlet"}
METHODS = {"sum", "mean", "std", "var", "prod", "trace", "dot"}
LIBRARIES = {"np", "numpy", "math", "scipy"}
KNOWN_IMPORTS = {"numpy.typing", "scipy.spatial", "scipy.stats"}
PLAIN_IMPORTS = {("numpy", "np"), ("math", None)}


@pytest.mark.parametrize("path", SAME_BYTES, ids=lambda path: str(path.relative_to(ROOT / "src")))
def test_nothing_between_seed_and_bytes_depends_on_the_processor(path: Path) -> None:
    """BLAS, the C library and numpy's SIMD loops choose their algorithms by processor."""
    found = []
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.BinOp | ast.AugAssign):
            if isinstance(node.op, ast.MatMult):
                found.append(f"line {node.lineno}: @")
            if isinstance(node.op, ast.Pow) and not _small_power(node):
                found.append(f"line {node.lineno}: ** {ast.unparse(node)}")
        if isinstance(node, ast.Attribute):
            library = isinstance(node.value, ast.Name) and node.value.id in LIBRARIES
            banned = ANY_ORDER | BY_LIBRARY if library else METHODS
            if node.attr in banned and ast.unparse(node) != "math.prod":
                found.append(f"line {node.lineno}: {ast.unparse(node)}")
        if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in BY_TAILS:
            found.append(f"line {node.lineno}: {ast.unparse(node.func)}")
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("argsort"):
            kinds = {ast.unparse(w.value) for w in node.keywords if w.arg == "kind"}
            if not kinds & {"'stable'", "'mergesort'"}:
                found.append(f"line {node.lineno}: argsort without kind='stable'")
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "sum" and not _counts(node):
            found.append(f"line {node.lineno}: sum of floats, whose order Python 3.12 changed")
        if isinstance(node, ast.Attribute) and node.attr == "uniform":
            found.append(f"line {node.lineno}: {ast.unparse(node)}")
        if isinstance(node, ast.ImportFrom):
            known = node.module in KNOWN_IMPORTS
            if str(node.module).partition(".")[0] in LIBRARIES and not known:
                found.append(f"line {node.lineno}: from {node.module} import")
        if isinstance(node, ast.Import):
            names = {(alias.name, alias.asname) for alias in node.names}
            strange = {n for n in names if n[0].partition(".")[0] in LIBRARIES} - PLAIN_IMPORTS
            found += [f"line {node.lineno}: import {name} as {other}" for name, other in strange]
    assert not found


def _counts(node: ast.Call) -> bool:
    """Return whether a builtin sum adds counts, or arrays to a given start."""
    if len(node.args) == 2:
        return True
    element = getattr(node.args[0], "elt", None)
    text = ast.unparse(element) if element is not None else ""
    return text.startswith("len(") or text.endswith("resolution ** 2")


def _small_power(node: ast.BinOp | ast.AugAssign) -> bool:
    """Return whether a power is exact: squares of arrays and integers, and powers of 2 and -1.

    The square of a Python float goes through the C library's ``pow``; write a product.
    """
    if isinstance(node, ast.AugAssign):
        return False
    if ast.unparse(node.left) == "-1":
        return True
    if isinstance(node.left, ast.Constant) and isinstance(node.right, ast.Constant | ast.Name):
        return float(node.left.value) in {2.0, -1.0}
    return isinstance(node.right, ast.Constant) and node.right.value == 2


def test_random_numbers_come_from_seeds() -> None:
    makers = ("default_rng", "SeedSequence", "RandomState", "random.seed", "Random")
    found = [
        f"{path.relative_to(ROOT)}: line {call.lineno}"
        for path in SOURCES
        for name, call in _calls(parsed(path))
        if name.endswith(makers) and path.name != "seeds.py"
    ]
    assert not found
