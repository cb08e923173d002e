"""Plant defects that make results silently wrong, one at a time; print which tests notice them.

    python benchmarks/planted.py [--room ROOM ...] [--only TEXT] [--everyday] [--missed]
    python benchmarks/planted.py --check | --table

Each file `planted/ROOM.toml` beside this script lists the defects of one room:

    [[defect]]
    name = "gravity-of-the-moon"            # unique
    file = "scenes/scene.py"                # below src/physion
    old = "GRAVITY = 9.81"                  # occurs exactly once in the file
    new = "GRAVITY = 1.62"
    means = "Everything falls six times more slowly."
    tests = ["tests/physics"]               # what is run; by default tests/ROOM

A copy of the checkout gets the defect, and three stages run until one notices it: the everyday
tests, the slow ones, and the golden digests (which a new digest would bless). A test that fails
also without the defect notices nothing: the result is then `invalid` and names the test.

Results are kept, one line per defect, in `results/planted.jsonl`. A defect is run again if its
entry has changed, or with --missed if neither everyday nor slow tests noticed it. Interrupt at any
time. With --everyday only the first stage is run, and what it misses is not recorded. --check only
compares the texts with the code. --table only prints the results.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

ROOT = Path(__file__).parents[1]
TABLES = Path(__file__).parent / "planted"
RESULTS = Path(__file__).parent / "results" / "planted.jsonl"
COPIED = ("src", "tests", "docs", "examples", "benchmarks", "pyproject.toml", "README.md")
DIGESTS = "tests/trials/test_same_bytes.py"
GOLDEN = f"{DIGESTS}::test_trials_are_those_of_this_version"
OFFICIAL = {"PHYSION_OFFICIAL": str(ROOT.parent / "shared" / "official")}
"""Where tests look for the data of the study; by default next to the checkout, not to its copy."""
STAGES = {"everyday": "not slow and not alone", "slow": "slow", "digests": "not alone"}
"""Tests of each stage, by their marks."""
MISSED = ("digests", "not noticed", "invalid")
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)
TIME_LIMIT = 1800
"""Seconds of one stage. A test that never ends has noticed the defect."""
ALL_PASSED, SOME_FAILED, NONE_FOUND = 0, 1, 5
"""Exit codes of pytest."""


@dataclass(frozen=True)
class Defect:
    """One entry of a table: ``old`` becomes ``new`` in ``file``, which ``means`` something."""

    name: str
    file: str
    old: str
    new: str
    means: str
    tests: tuple[str, ...] = ()

    @property
    def room(self) -> str:
        """Return the room of the file."""
        return self.file.split("/")[0]

    @property
    def key(self) -> str:
        """Return a digest of the entry."""
        return hashlib.sha256(repr(dataclasses.astuple(self)).encode()).hexdigest()[:16]

    def planted(self) -> str:
        """Return the text of the file with the defect."""
        text = (ROOT / "src" / "physion" / self.file).read_text(encoding="utf-8")
        count = text.count(self.old)
        if count != 1 or self.old == self.new:
            raise SystemExit(f"{self.name}: {self.file} holds the old text {count} times, not once")
        return text.replace(self.old, self.new)


def read_defects() -> list[Defect]:
    """Read the tables of all rooms."""
    defects = []
    for path in sorted(TABLES.glob("*.toml")):
        for entry in tomllib.loads(path.read_text(encoding="utf-8"))["defect"]:
            entry["tests"] = tuple(entry.get("tests") or [f"tests/{entry['file'].split('/')[0]}"])
            defects.append(Defect(**entry))
    names = [defect.name for defect in defects]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise SystemExit(f"two defects are called {', '.join(repeated)}")
    return defects


def read_results() -> dict[str, dict[str, Any]]:
    """Return the last result of each defect by the digest of its entry."""
    lines = RESULTS.read_text(encoding="utf-8").splitlines() if RESULTS.is_file() else []
    return {result["key"]: result for result in map(json.loads, lines)}


def copy_checkout(folder: Path) -> None:
    """Copy the checkout with its compiled kernels, as hard links where the disk has them."""

    def link(source: str, target: str) -> None:
        try:
            os.link(source, target)
        except OSError:
            shutil.copy2(source, target)

    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, copy_function=link)
        else:
            link(str(ROOT / name), str(folder / name))


def run_tests(folder: Path, tests: Sequence[str], marks: str) -> tuple[int, str]:
    """Run tests in a copy until one fails; return pytest's exit code and the failing test."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-p", "no:cacheprovider"]
    command += ["-m", marks, *tests] + ([] if DIGESTS in tests[0] else ["--ignore", DIGESTS])
    settings = {**OFFICIAL, **os.environ, "PYTHONPATH": str(folder / "src"), "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, cwd=folder, env=settings, capture_output=True, text=True, timeout=TIME_LIMIT
        )
    except subprocess.TimeoutExpired:
        return SOME_FAILED, "a test that does not end"
    if done.returncode < 0:
        return SOME_FAILED, "a crash of the process"
    failed = FAILED.search(done.stdout)
    if failed is None and done.returncode not in (ALL_PASSED, NONE_FOUND):
        raise SystemExit(f"pytest cannot run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode, failed[1] if failed else ""


def try_defect(defect: Defect, stages: Sequence[str], right_without: set[str]) -> dict[str, Any]:
    """Return which stage notices the defect, and the test that does.

    ``right_without`` holds tests that were seen to pass without a defect; more are added.
    """
    started = time.monotonic()
    noticed, by = "not noticed", ""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy_checkout(folder)
        file = folder / "src" / "physion" / defect.file
        right = file.read_text(encoding="utf-8")
        # A new file, since the one in the copy may be a hard link.
        file.unlink()
        file.write_text(defect.planted(), encoding="utf-8")
        for stage in stages:
            tests = defect.tests if stage != "digests" else (GOLDEN,)
            code, by = run_tests(folder, tests, STAGES[stage])
            if code not in (ALL_PASSED, NONE_FOUND):
                noticed = stage
                break
        if "::" in by and by not in right_without:
            file.write_text(right, encoding="utf-8")
            if run_tests(folder, (by,), "not alone")[0] != ALL_PASSED:
                noticed = "invalid"
            else:
                right_without.add(by)
    seconds = round(time.monotonic() - started)
    result = {"key": defect.key, "room": defect.room, "name": defect.name, "noticed": noticed}
    return {**result, "by": by, "seconds": seconds, "means": defect.means}


def print_table(defects: Sequence[Defect], results: dict[str, dict[str, Any]]) -> None:
    """Print the number of defects of each room by stage, and those that tests have missed."""
    found = [results[defect.key] for defect in defects if defect.key in results]
    rows = pd.DataFrame(found, columns=["room", "noticed", "name", "by", "means"])
    columns = ("planted", *STAGES, "not noticed", "invalid")
    counts = pd.crosstab(rows["room"], rows["noticed"]).reindex(columns=columns, fill_value=0)
    counts["planted"] = counts.sum(axis=1)
    counts.loc["all"] = counts.sum()
    print(f"| room | {' | '.join(columns)} |\n|---{'|---:' * len(columns)}|")
    for room, numbers in counts.iterrows():
        print(f"| {room} | {' | '.join(str(number) for number in numbers)} |")
    missed = rows[rows["noticed"].isin(MISSED)]
    print(*(f"\n{r.noticed}: {r.room}/{r.name}: {r.means} {r.by}" for r in missed.itertuples()))
    if waiting := len(defects) - len(found):
        print(f"\n{waiting} defects were not run with their present entries.")


def main() -> None:
    """Run the defects that have no result yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--room", nargs="+", help="only defects of these rooms")
    parser.add_argument("--only", default="", help="only defects whose name contains this")
    parser.add_argument("--everyday", action="store_true", help="run only the everyday tests")
    parser.add_argument("--missed", action="store_true", help="run those again that were missed")
    parser.add_argument("--check", action="store_true", help="only compare texts with the code")
    parser.add_argument("--table", action="store_true", help="only print the results")
    options = parser.parse_args()
    defects = [
        defect
        for defect in read_defects()
        if options.only in defect.name and (not options.room or defect.room in options.room)
    ]
    for defect in defects:
        defect.planted()
    if options.check:
        print(f"{len(defects)} defects fit the code")
        return
    results = read_results()
    right_without: set[str] = set()
    for number, defect in enumerate([] if options.table else defects, start=1):
        old = results.get(defect.key)
        if old and not (options.missed and old["noticed"] in MISSED):
            continue
        stages = list(STAGES)[:1] if options.everyday else list(STAGES)
        result = try_defect(defect, stages, right_without)
        if not (options.everyday and result["noticed"] in MISSED):
            results[defect.key] = result
            with RESULTS.open("a", encoding="utf-8") as file:
                file.write(json.dumps(result) + "\n")
        where = f"{number}/{len(defects)} {defect.room}/{defect.name}"
        print(f"{where}: {result['noticed']} {result['by']} ({result['seconds']} s)", flush=True)
    print_table(defects, results)


if __name__ == "__main__":
    main()
