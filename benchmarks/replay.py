"""The replay table: official command logs simulated again, one process, nothing else running.

    python benchmarks/replay.py FOLDER [--repeats 4]

writes benchmarks/results/replay.md and replay.json. Agreement is with the recorded outcomes;
speed is physics time over processor time of one core, compilation left out by a first run.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import subprocess
import sys
from pathlib import Path

RESULTS = Path(__file__).parent / "results"
TARGETS = {
    "dominoes": 0.94,
    "collide": 0.92,
    "drop": 0.90,
    "support": 0.82,
    "roll": 0.80,
    "contain": 0.80,
    "link": 0.82,
    "drape": 0.75,
}
"""Agreement to reach; for Drape the area under the curve of the smallest gap."""


def processor() -> str:
    """Name of the processor, as the system gives it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0]}, {len(names)} cores" if names else platform.processor()


def cell(value: float | None, digits: int = 3) -> str:
    """A number of a table, or a dash."""
    return "-" if value is None else f"{value:.{digits}f}"


def main() -> None:
    """Replay twice, the first time for the compiler, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--repeats", type=int, default=0)
    options = parser.parse_args()
    out = RESULTS / "replay.json"
    command = [sys.executable, "-m", "physion.cli.main", "replay", str(options.folder)]
    command += ["--workers", "1", "--json", str(out)]
    subprocess.run([*command, "--limit", "1"], check=True, stdout=subprocess.DEVNULL)
    subprocess.run([*command, "--repeats", str(options.repeats)], check=True)
    result = json.loads(out.read_text())
    rows = result["scenarios"]
    lines = [
        "# Official scenes, simulated again",
        f"{datetime.date.today()}, {processor()}, `python benchmarks/replay.py FOLDER --repeats "
        f"{options.repeats}`",
        "",
        "| scenario | trials | base rate | agreement | to reach | jittered runs agree | "
        "AUC | first contact, frames | ms a trial | times real time |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        frames = row["frame_difference"]
        lines.append(
            f"| {row['scenario']} | {row['trials']} | {cell(row['base_rate'])} | "
            f"{cell(row['agreement'])} | {TARGETS[row['scenario']]:.2f}"
            f"{' (AUC)' if row['scenario'] == 'drape' else ''} | {cell(row['ceiling'])} | "
            f"{cell(row['auc'])} | {cell(frames, 0)} | {row['milliseconds']:.0f} | "
            f"{row['real_time']:.1f} |"
        )
    rigid = [row["real_time"] for row in rows if row["scenario"] != "drape"]
    lines += [
        "",
        f"Rigid scenes, mean over scenarios: {sum(rigid) / len(rigid):.1f} times real time on one "
        f"core. Duplicates left out: {result['duplicates']}; unknown commands: "
        f"{sum(result['unknown_commands'].values())}; failures: {len(result['failures'])}.",
    ]
    text = "\n".join(lines) + "\n"
    (RESULTS / "replay.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
