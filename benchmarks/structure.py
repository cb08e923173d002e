"""Measure the structure of the package at one or several commits; print one table.

    python benchmarks/structure.py [ROOT ...] [--evaluate COMMAND ...]

ROOT is a checkout, by default this one. A commit to compare with is checked out by
`git worktree add ../before COMMIT`. The table has a column per ROOT:

- lines and files of each room (Python and web, without vendored libraries), of tests, benchmarks;
- files on the way of `generate`, `evaluate` and `compare`: each verb runs on a tiny case, and in
  all its processes the files of the package are noted that are imported, and those of which a
  function is called other than by an import. Compiled kernels count as imported only;
- places that compute a SHA-256 (calls), that refuse input (`raise` of an input error), and that say
  what is done (functions named done, whole, finished, complete, kept, valid, intact or seal);
- visible options of each verb, from its `--help`;
- seconds of `import physion` and `physion --help`, the median of five.

COMMAND is the command line of `evaluate`, with {data} and {out}, for all ROOTs or one for each.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import pandas as pd

ROOT = Path(__file__).parents[1]
WEB = {".js", ".css", ".html"}
INPUT_ERRORS = {"BadInputError", "BadSceneError", "UnknownNameError"}
DONE = re.compile(
    r"(?:^|_)(?:done|whole|finished|complete|kept|valid|intact|seal|sealed|is_fresh)(?:_|$)"
)
GENERATE = (
    "generate {data} --scenario drop --split all --count 4 --width 64 --height 64 --jitters 0 "
    "--workers 1"
)
EVALUATE = "evaluate cswm {data} --out {out} --workers 1"
COMPARE = "compare {predictions} --humans official --out {out}"
TIMES = 5

TRACER = '''
"""Note which files of the package are imported and called; imported by every Python process."""
import os, sys, threading

ROOT, LOG = os.environ["STRUCTURE_ROOT"], os.environ["STRUCTURE_LOG"]
seen, imports = set(), threading.local()

def note(kind, name):
    if (kind, name) in seen:
        return
    seen.add((kind, name))
    with open(LOG, "a") as file:
        file.write(kind + " " + name + "\\n")

def trace(frame, event, argument):
    if event not in ("call", "return"):
        return
    code = frame.f_code
    if not code.co_filename.startswith(ROOT):
        return
    module = code.co_name == "<module>" and frame.f_globals.get("__name__") != "__main__"
    if module:
        imports.depth = getattr(imports, "depth", 0) + (1 if event == "call" else -1)
    if event == "call":
        if module:
            note("imported", code.co_filename)
        elif code.co_flags & 1 and not getattr(imports, "depth", 0):  # bodies of classes have not 1
            note("called", code.co_filename)

threading.setprofile(trace)
sys.setprofile(trace)
'''


def rooms(root: Path) -> dict[str, str]:
    """Return ``lines (files)`` of each room, of the whole package, of tests and benchmarks."""
    lines: Counter[str] = Counter()
    files: Counter[str] = Counter()
    package = root / "src" / "physion"
    for path in sorted(package.rglob("*")):
        parts = path.relative_to(package).parts
        if not path.is_file() or "vendor" in parts or path.suffix not in WEB | {".py"}:
            continue
        room = parts[0] if len(parts) > 1 else "(top)"
        kind = "py" if path.suffix == ".py" else "web"
        for key in (f"{room}, {kind}", f"all, {kind}"):
            lines[key] += len(path.read_text(encoding="utf-8").splitlines())
            files[key] += path.name != "__init__.py"
    for folder in ("tests", "benchmarks"):
        for path in (root / folder).rglob("*.py"):
            lines[folder] += len(path.read_text(encoding="utf-8").splitlines())
            files[folder] += 1
    return {f"lines (files): {key}": f"{lines[key]:,} ({files[key]})" for key in sorted(lines)}


def places(root: Path) -> dict[str, str]:
    """Count calls of SHA-256, refusals of input, and functions that say what is done."""
    hashes, refusals, done = [], [], []
    for path in (root / "src" / "physion").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = ast.unparse(node.func).rpartition(".")[2] if isinstance(node, ast.Call) else ""
            if name in ("sha256", "file_digest"):
                hashes.append(path)
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                refused = ast.unparse(node.exc.func).rpartition(".")[2]
                refusals += [path] * (refused in INPUT_ERRORS)
            if isinstance(node, ast.FunctionDef) and DONE.search(node.name):
                done.append(path)
    kinds = {
        "that compute a SHA-256": hashes,
        "that refuse input": refusals,
        "that say what is done": done,
    }
    return {f"places {kind}": f"{len(p)} in {len(set(p))} files" for kind, p in kinds.items()}


def physion(root: Path, words: list[str], **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line of a checkout."""
    path = os.pathsep.join([*filter(None, [environment.pop("first", "")]), str(root / "src")])
    return subprocess.run(
        [sys.executable, "-m", "physion.cli.main", *words],
        env={**os.environ, "COLUMNS": "200", "PYTHONPATH": path, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def options(root: Path) -> dict[str, str]:
    """Count the options that the help of each verb shows."""
    verbs = re.findall(r"^  ([a-z][a-z-]*) +\w", physion(root, ["--help"]).stdout, re.MULTILINE)
    counts = {}
    for verb in verbs:
        text = physion(root, [verb, "--help"]).stdout
        shown = set(re.findall(r"^\W*(--[a-z][a-z0-9-]*)", text, re.MULTILINE)) - {"--help"}
        counts[verb] = len(shown)
    return {"verbs": str(len(verbs))} | {f"options: {v}": str(n) for v, n in counts.items()}


def seconds(root: Path) -> dict[str, str]:
    """Return the medians of the times of `import physion` and `physion --help`."""
    environment = {**os.environ, "PYTHONPATH": str(root / "src")}
    commands = {
        "seconds: import physion": [sys.executable, "-c", "import physion"],
        "seconds: physion --help": [sys.executable, "-m", "physion.cli.main", "--help"],
    }
    found = {}
    for name, command in commands.items():
        times = []
        for _ in range(TIMES):
            begin = time.perf_counter()
            subprocess.run(command, env=environment, capture_output=True, check=True)
            times.append(time.perf_counter() - begin)
        found[name] = f"{statistics.median(times):.2f}"
    return found


def trace(root: Path, words: list[str], folder: Path) -> str:
    """Run a verb; return how many files of the package were called, and imported."""
    (folder / "tracer").mkdir(exist_ok=True)
    (folder / "tracer" / "sitecustomize.py").write_text(TRACER)
    log = folder / f"{words[0]}.log"
    log.write_text("")
    done = physion(
        root,
        words,
        first=str(folder / "tracer"),
        STRUCTURE_ROOT=str(root / "src" / "physion") + os.sep,
        STRUCTURE_LOG=str(log),
    )
    if done.returncode not in (0, 1):
        return f"failed: {done.stderr.strip().splitlines()[-1]}"
    lines = set(log.read_text().splitlines())
    called, imported = (sum(line.startswith(k) for line in lines) for k in ("called", "imported"))
    return f"{called} called, {imported} imported"


def official_predictions(root: Path, path: Path) -> None:
    """Write predictions of 80 official stimuli in the columns of the official result files."""
    labels = pd.read_csv(root / "src/physion/data/official_study/labels.csv").iloc[::5][:80]
    contact = labels["contact"].astype(bool)
    pd.DataFrame(
        {
            "Model": "tiny",
            "Readout Type": "C",
            "Predicted Prob_true": [0.2 + 0.01 * (i % 60) for i in range(len(labels))],
            "Predicted Outcome": [i % 60 > 30 for i in range(len(labels))],
            "Actual Outcome": contact,
            "Recorded Outcome": contact,
            "Stimulus Name": labels["stimulus"],
        }
    ).to_csv(path, index=False)


def ways(root: Path, commands: dict[str, str]) -> dict[str, str]:
    """Return the files on the way of each command."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        official_predictions(root, folder / "predictions.csv")
        found = {}
        for verb, command in commands.items():
            text = command.format(
                data=folder / "data",
                out=folder / f"out-{verb}",
                predictions=folder / "predictions.csv",
            )
            found[f"files on the way: {command.split(' --')[0]}"] = trace(
                root, text.split(), folder
            )
        return found


def main() -> None:
    """Measure each checkout and print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("roots", nargs="*", type=Path, default=[ROOT], metavar="ROOT")
    parser.add_argument("--generate", nargs="*", default=[GENERATE])
    parser.add_argument("--evaluate", nargs="*", default=[EVALUATE])
    parser.add_argument("--compare", nargs="*", default=[COMPARE])
    parser.add_argument("--only", default="", help="measure only rows that begin so")
    chosen = parser.parse_args()
    columns = {}
    for number, root in enumerate(path.resolve() for path in chosen.roots):
        given = {verb: getattr(chosen, verb) for verb in ("generate", "evaluate", "compare")}
        commands = {verb: texts[min(number, len(texts) - 1)] for verb, texts in given.items()}
        head = ["git", "-C", str(root), "rev-parse", "--short", "HEAD"]
        commit = subprocess.run(head, capture_output=True, text=True, check=False).stdout.strip()
        found: dict[str, str] = {}
        parts = {
            "lines": lambda root=root: rooms(root),
            "places": lambda root=root: places(root),
            "options": lambda root=root: options(root),
            "seconds": lambda root=root: seconds(root),
            "files": lambda root=root, commands=commands: ways(root, commands),
        }
        for name, measure in parts.items():
            if name.startswith(chosen.only):
                found |= measure()
        columns[commit or root.name] = found
    rows = list(dict.fromkeys(name for found in columns.values() for name in found))
    print(f"| | {' | '.join(columns)} |")
    print(f"|---|{'---|' * len(columns)}")
    for name in rows:
        cells = [found.get(name, "-") for found in columns.values()]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
