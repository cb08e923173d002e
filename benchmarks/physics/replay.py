"""The replay table: official command logs simulated again, one process, nothing else running.

    python benchmarks/physics/replay.py FOLDER [--repeats 8] [--engines physion,mujoco]

writes benchmarks/results/replay.md and replay.json. The first engine also simulates every trial
``--repeats`` times with jitter; the others run once. Agreement is with the recorded outcomes; speed
is physics time over processor time of one core, compilation left out by a first run. The other
columns are described in docs/explanation/physics.md.
"""

from __future__ import annotations

import argparse
import datetime
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from physion.compute.tasks import processor_and_cores

RESULTS = Path(__file__).parents[1] / "results"
TARGETS = {
    "dominoes": 0.98,
    "collide": 0.95,
    "drop": 0.96,
    "roll": 0.92,
    "support": 0.84,
    "contain": 0.84,
    "link": 0.82,
    "drape": 0.86,
}
"""Agreement to reach; for Drape the area under the curve of the smallest gap."""
COLUMNS = {
    "scenario": ("scenario", None),
    "engine": ("engine", None),
    "trials": ("trials", 0),
    "base rate": ("base_rate", 3),
    "agreement": ("agreement", 3),
    "jittered runs, agreement": ("jittered_agreement", 3),
    "ceiling": ("ceiling", 3),
    "Brier": ("brier", 3),
    "log score": ("log_score", 3),
    "AUC": ("auc", 3),
    "first contact, frames": ("frame_difference", 1),
    "final position, m": ("final_error", 4),
    "ms a trial": ("milliseconds", 0),
    "times real time": ("real_time", 1),
}
"""Columns of the table: field of `physion.physics.replay.ReplayRow`, and digits of a number."""


def cell(value: str | float | None, digits: int | None) -> str:
    """A cell of the table: a text, a number, or a dash."""
    if value is None:
        return "-"
    return f"{value:.{digits}f}" if isinstance(value, int | float) else value


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Lines of the table, with the agreement to reach after the agreement."""
    heads, lines = [*COLUMNS], []
    at = heads.index("agreement") + 1
    heads.insert(at, "to reach")
    for row in rows:
        cells = [cell(row[name], digits) for name, digits in COLUMNS.values()]
        unit = " (AUC)" if row["scenario"] == "drape" else ""
        cells.insert(at, f"{TARGETS[row['scenario']]:.2f}{unit}")
        lines.append(f"| {' | '.join(cells)} |")
    return [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *lines]


def main() -> None:
    """Replay twice, the first time for the compiler, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--engines", default="physion,mujoco")
    options = parser.parse_args()
    out = RESULTS / "replay.json"
    rows: list[dict[str, Any]] = []
    for number, engine in enumerate(options.engines.split(",")):
        command = [sys.executable, "-m", "physion.cli.main", "replay", str(options.folder)]
        command += ["--workers", "1", "--json", str(out), "--engines", engine]
        subprocess.run([*command, "--limit", "1"], check=True, stdout=subprocess.DEVNULL)
        repeats = options.repeats if number == 0 else 0
        subprocess.run([*command, "--repeats", str(repeats)], check=True)
        result = json.loads(out.read_text())
        rows += result["scenarios"]
    result.pop("trials")
    out.write_text(json.dumps({**result, "scenarios": rows}, indent=2) + "\n")
    lines = [
        "# Official scenes, simulated again",
        f"{datetime.date.today()}, {processor_and_cores()}, "
        "`python benchmarks/physics/replay.py FOLDER --repeats "
        f"{options.repeats} --engines {options.engines}`. "
        "docs/explanation/physics.md describes the columns.",
        "Jittered runs: the first engine only.",
        "",
        *table(rows),
        "",
    ]
    for engine in options.engines.split(","):
        rigid = [r for r in rows if r["engine"] == engine and r["scenario"] != "drape"]
        speed, agreement = (
            sum(row[name] for row in rigid) / len(rigid) for name in ("real_time", "agreement")
        )
        lines.append(
            f"Rigid scenes, mean over scenarios, engine {engine}: agreement {agreement:.3f}, "
            f"{speed:.1f} times real time on one core."
        )
    lines.append(
        f"Duplicates left out: {result['duplicates']}; unknown commands: "
        f"{sum(result['unknown_commands'].values())}; failures: {len(result['failures'])}."
    )
    text = "\n".join(lines) + "\n"
    (RESULTS / "replay.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
