"""What workers, Ray, resuming, verifying and safe writing cost when trials are made.

    python benchmarks/trials/pipeline.py [--parts workers ray thousand verify safe] [--write]

- ``workers``: trials with movies by one and by two processes, in turn; ratio of wall times.
- ``ray``: 200 trials of the readout with movies on Ray and on the local pool; ratio of wall times.
  Needs the extra 'ray'.
- ``thousand``: 1,000 trials without movies: the finished command repeated, and ``verify`` beside a
  process that only reads all files and computes their SHA-256.
- ``verify``: processor time of ``verify`` for trials with movies, four for each.
- ``safe``: trials made in this process with and without synchronizing files, in turn.

Commands start with modules that Python has compiled before, as after an installation by pip.
Nothing else may run meanwhile.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import date
from functools import cache
from pathlib import Path
from unittest import mock

import physion
from physion.compute.tasks import processor
from physion.trials.making.choose import choose
from physion.trials.making.make import make_trial
from physion.trials.making.plan import GenerateJob, GenerateSettings, plan_dataset

RESULT = Path(__file__).parents[1] / "results" / "pipeline.json"
WITH_MOVIES = ("--scenario", "collide", "--jitters", "0")
WITHOUT_MOVIES = (*WITH_MOVIES, "--split", "training", "--no-movies")
READ_ALL = """
import hashlib, pathlib, sys
for path in pathlib.Path(sys.argv[1]).rglob("*"):
    if path.is_file():
        hashlib.sha256(path.read_bytes()).hexdigest()
"""


def run(*command: str) -> tuple[float, float]:
    """Run a command; return its wall and processor seconds, its workers' included."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    nowhere = subprocess.DEVNULL
    subprocess.run(
        [sys.executable, *command], check=True, stdout=nowhere, stderr=nowhere, env=_environment()
    )
    wall, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@cache
def _environment() -> dict[str, str]:
    """Return the environment of commands, in which compiled modules are kept in a folder."""
    kept = {n: v for n, v in os.environ.items() if n != "PYTHONDONTWRITEBYTECODE"}
    folder = tempfile.mkdtemp(prefix="compiled-modules-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return {**kept, "PYTHONPYCACHEPREFIX": folder}


def cli(*arguments: object) -> tuple[float, float]:
    """Run a verb of the package likewise."""
    return run("-m", "physion.cli.main", *map(str, arguments))


@contextlib.contextmanager
def folders() -> Iterator[Callable[[], Path]]:
    """Give names of new folders, all of which are removed at the end."""
    with tempfile.TemporaryDirectory() as parent:
        yield lambda: Path(tempfile.mkdtemp(dir=parent)) / "trials"


def in_turn(
    rounds: int, count: int, what: Sequence[str], settings: dict[str, Sequence[str]]
) -> dict[str, float]:
    """Return the median wall seconds of ``generate`` under each of two settings, and their ratio.

    The ratio, first by second, is the median of those of the rounds.
    """
    seconds: dict[str, list[float]] = {name: [] for name in settings}
    with folders() as folder:
        for options in settings.values():  # modules are compiled before anything is timed
            cli("generate", folder(), "--count", 1, *what, *options)
        for _ in range(rounds):
            for name, options in settings.items():
                wall, _ = cli("generate", folder(), "--count", count, *what, *options)
                seconds[name].append(wall)
    first, second = seconds.values()
    ratio = statistics.median(a / b for a, b in zip(first, second, strict=True))
    medians = {f"{name}_s": statistics.median(walls) for name, walls in seconds.items()}
    return {"trials": count, "rounds": rounds, **medians, "ratio": ratio}


def workers() -> dict[str, float]:
    """One process and two."""
    return in_turn(3, 40, WITH_MOVIES, {"one": ("--workers", "1"), "two": ("--workers", "2")})


def ray() -> dict[str, float]:
    """Ray on this machine and the local pool."""
    what = (*WITH_MOVIES, "--split", "readout")
    return in_turn(1, 200, what, {"ray": ("--executor", "ray"), "local": ()})


def thousand() -> dict[str, float]:
    """A finished set of 1,000 trials: the same command again, and verification."""
    with folders() as folder:
        made = folder()
        command = ("generate", made, "--count", 1000, *WITHOUT_MOVIES)
        wall, _ = cli(*command)
        again, _ = cli(*command)
        reading, _ = run("-c", READ_ALL, str(made))
        verifying, spent = cli("verify", made, "--again", 0)
        megabytes = sum(path.stat().st_size for path in made.rglob("*") if path.is_file()) / 1e6
    return {
        "trials": 1000, "megabytes": megabytes, "made_s": wall, "repeated_s": again,
        "read_and_digest_s": reading, "verify_s": verifying, "verify_cpu_s": spent,
    }  # fmt: skip


def verify() -> dict[str, float]:
    """Verification of trials with movies, beside that of one trial."""
    with folders() as folder:
        many, one = folder(), folder()
        cli("generate", many, "--count", 60, *WITH_MOVIES)
        cli("generate", one, "--count", 1, *WITH_MOVIES)
        cli("verify", one, "--again", 0)
        _, spent = cli("verify", many, "--again", 0)
        _, start = cli("verify", one, "--again", 0)
    return {"trials": 60, "cpu_ms_a_trial": 1000 * (spent - start) / 59}


def safe() -> dict[str, float]:
    """Trials with movies written with and without ``fsync``."""
    settings = GenerateSettings(jitters=0)
    tasks = plan_dataset("benchmark", ["collide"], {"readout": 31})
    seconds: dict[bool, list[float]] = {True: [], False: []}
    with folders() as folder:
        for number, task in enumerate(tasks):
            filled, _ = choose(GenerateJob(task, folder(), settings))
            # The first trial loads the compiled code; the order of the two changes with each.
            for synced in (True, False) if number % 2 else (False, True):
                job = GenerateJob(filled, folder(), settings)
                with contextlib.ExitStack() as stack:
                    if not synced:
                        stack.enter_context(mock.patch.object(os, "fsync"))
                    started = time.perf_counter()
                    make_trial(job)
                    if number:
                        seconds[synced].append(time.perf_counter() - started)
    with_sync, without = (statistics.median(seconds[synced]) for synced in (True, False))
    share = statistics.median(a / b - 1 for a, b in zip(seconds[True], seconds[False], strict=True))
    return {"trials": 30, "synced_s": with_sync, "not_synced_s": without, "overhead": share}


PARTS: dict[str, Callable[[], dict[str, float]]] = {
    "workers": workers, "ray": ray, "thousand": thousand, "verify": verify, "safe": safe,
}  # fmt: skip


def main() -> None:
    """Measure the parts, print them, and write them into the results if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    for verb in ("generate", "verify"):
        cli(verb, "--help")  # compiles modules
    found = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    for name in options.parts:
        found[name] = {
            "date": date.today().isoformat(),
            "machine": processor(),
            "cores": os.cpu_count(),
            "package": physion.__version__,
            "load_before": os.getloadavg()[0],
            **PARTS[name](),
        }
        print(name, json.dumps(found[name], indent=1), flush=True)
        if options.write:
            RESULT.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
