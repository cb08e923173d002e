"""How long the export of a large study takes.

    python benchmarks/experiment/export.py [--write]

Makes a database of 10,000 finished sessions in eight scenarios, each of one participant with 10
practice and 150 test answers (1.6 million rows), with details as long as the pages send them, in
the order in which 100 people at once would have answered. Then a process of its own exports all of
it in every layout: from the opened database to the files on the disk. Making the database is not
counted; it has just been written, so that most of it is in the system's memory. The aim is under
20 s and 4 GB. ``--database`` takes the URL of an empty PostgreSQL database in place of SQLite.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import insert

from physion.compute.tasks import processor
from physion.core.names import SCENARIOS
from physion.experiment.export.export_study import export_study
from physion.experiment.store.database import (
    ANSWERS,
    EVENTS,
    PARTICIPANTS,
    SESSIONS,
    STUDIES,
    create_database,
    open_database,
)
from physion.experiment.study.stimuli import Stimulus
from physion.experiment.study.study import Study

RESULTS = Path(__file__).parents[1] / "results"
PRACTICE, TEST = 10, 150
AT_ONCE = 100
AIM_S, AIM_BYTES = 20.0, 4 * 10**9
BEGAN = 1_790_000_000.0
AGENT = (
    "Mozilla/5.0 (X11; Linux x86_64) AppleWebKit/537.36 (KHTML, like Gecko) Chrome/150.0.0.0 "
    "Safari/537.36"
)


def study_of(folder: Path) -> Study:
    """A study as the export needs it: no media."""
    stimuli = tuple(
        Stimulus(f"{scenario}_{phase[:4]}_{place:04d}", scenario, phase, place, place % 2 == 0,
                 "", "", "", 45, 0, 30.0, 256, 256, "free")
        for scenario in SCENARIOS
        for phase, count in (("familiarization", PRACTICE), ("test", TEST))
        for place in range(count)
    )  # fmt: skip
    return Study(folder=folder, name="benchmark", version="1", title="Benchmark of the export",
                 contact="nobody", scenarios=SCENARIOS, stimuli=stimuli, digest="d" * 64,
                 stimuli_digest="e" * 64)  # fmt: skip


def sessions_of(study: Study, count: int) -> list[dict[str, Any]]:
    """Rows of finished sessions."""
    rng = np.random.default_rng(0)
    rows = []
    for number in range(count):
        began = BEGAN + 20.0 * number + float(rng.random())
        name, participant = rng.bytes(16).hex(), rng.bytes(16).hex()
        rows.append({
            "session": name, "participant": participant, "kind": "person", "source": "prolific",
            "scenario": study.scenarios[number % len(study.scenarios)], "study": study.digest,
            "reference": name[:8], "order_seed": number, "order_number": 0, "language": "en",
            "buttons": ("yes-no", "no-yes")[number % 2], "started_at": began,
            "consent_version": "1", "consented_at": began + 20, "instructed_at": began + 90,
            "ready_at": began + 200, "demographics_at": began + 1200, "finished_at": began + 1240,
            "answered_familiarization": PRACTICE, "answered_test": TEST, "loads": 1,
            "last_seen": began + 1240, "age": int(rng.integers(18, 70)),
            "gender": ("female", "male")[number % 2], "education": "bachelor",
            "difficulty": int(rng.integers(1, 6)), "technical_problems": False,
            "feedback": "=nothing, really\n- thank you; it was fun" if number % 3 else None,
            "device": {"user_agent": AGENT, "refresh_hz": 59.94, "screen_width": 1920,
                       "screen_height": 1080, "pixel_ratio": 1.0, "touch": False},
        })  # fmt: skip
    return rows


def answers_of(study: Study, sessions: list[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    """Rows of answers, some at a time: of as many sessions at once, trial by trial."""
    rng = np.random.default_rng(1)
    stimuli = {name: study.phase(name, "familiarization") + study.phase(name, "test")
               for name in study.scenarios}  # fmt: skip
    for first in range(0, len(sessions), AT_ONCE):
        chosen = sessions[first : first + AT_ONCE]
        orders = [PRACTICE + rng.permutation(TEST) for _ in chosen]
        for trial in range(PRACTICE + TEST):
            practice = trial < PRACTICE
            rt = np.exp(rng.normal(6.6, 0.5, len(chosen)))
            yes = rng.random(len(chosen)) < 0.5
            fixation = rng.integers(500, 1501, len(chosen))
            rows = []
            for place, session in enumerate(chosen):
                shown = trial if practice else orders[place][trial - PRACTICE]
                start = round(float(fixation[place]) + 2010.1, 1)
                frames = [[round(start + 33.3667 * k, 1), k, k + 1] for k in range(45)]
                details = {"attempts": 1, "flashes": [250.1, 500.2, 750.1, 1000.3, 1250.2, 1500.1],
                           "frames": frames, "play_ms": 12.3, "ended_ms": start + 1510.2,
                           "enabled_ms": start + 1520.5, "visibility": [], "shown_width": 512,
                           "shown_height": 512}  # fmt: skip
                rows.append({
                    "session": session["session"],
                    "phase": "familiarization" if practice else "test",
                    "trial": trial if practice else trial - PRACTICE,
                    "key": f"{first + place:032x}-{trial:03d}",
                    "stimulus": stimuli[session["scenario"]][shown].stimulus,
                    "response": "yes" if yes[place] else "no",
                    "rt_ms": round(float(rt[place]), 1), "input": "mouse",
                    "fixation_ms": round(float(fixation[place]) + 3.4, 1), "cue_ms": 2003.2,
                    "frames_expected": 45, "frames_shown": 45, "frames_dropped": 0,
                    "movie_ms": 1466.7, "visibility_changes": 0, "window_width": 1280,
                    "window_height": 720, "resumed": False,
                    "answered_at": session["started_at"] + 210 + 6.1 * trial,
                    "details": json.dumps(details, separators=(",", ":")),
                })  # fmt: skip
            yield rows


def fill(study: Study, count: int) -> int:
    """Make the database; bytes of details."""
    engine = create_database(study.folder)
    sessions, size = sessions_of(study, count), 0
    with engine.begin() as connection:
        connection.execute(insert(STUDIES), {
            "digest": study.digest, "name": study.name, "version": study.version,
            "stimuli_digest": study.stimuli_digest, "settings": {}, "first_served": BEGAN,
        })  # fmt: skip
        people = [{"participant": row["participant"], "first_seen": BEGAN} for row in sessions]
        connection.execute(insert(PARTICIPANTS), people)
        connection.execute(insert(SESSIONS), sessions)
        connection.execute(insert(EVENTS), [
            {"session": row["session"], "kind": kind, "at_ms": 1000.5, "data": {"trial": 3},
             "stored_at": row["started_at"]}
            for row in sessions for kind in ("hidden", "visible", "resized")
        ])  # fmt: skip
        for rows in answers_of(study, sessions):
            size += sum(len(row["details"]) for row in rows)
            connection.execute(insert(ANSWERS), rows)
    engine.dispose()
    return size


def measure(study: Study) -> dict[str, Any]:
    """Export once; seconds, greatest memory, rows and size of what was written."""
    engine = open_database(study.folder)
    start, cpu = time.perf_counter(), time.process_time()
    report = export_study(engine, study, study.folder / "export")
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    files = [path for path in report.out.rglob("*") if path.is_file()]
    return {
        "wall_s": round(wall, 1),
        "cpu_s": round(cpu, 1),
        "memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "sessions": sum(sum(states.values()) for states in report.sessions.values()),
        "rows": report.rows,
        "files": len(files),
        "written_bytes": sum(path.stat().st_size for path in files),
    }


def as_markdown(found: dict[str, Any]) -> str:
    """The result as a page."""
    lines = [
        "# Export of a large study",
        "",
        f"{datetime.now(UTC):%Y-%m-%d}, {processor()}, {os.cpu_count()} cores, "
        f"`{found['command']}`",
        "",
        f"{found['sessions']:,} sessions, {found['rows']['trials']:,} answers, "
        f"{found['details_bytes'] / 1e9:.2f} GB of details. All layouts; on the disk at the end.",
        "",
        "| | measured | aim |",
        "|---|---|---|",
        f"| seconds | {found['wall_s']:.1f} | under {AIM_S:.0f} |",
        f"| seconds of processor time | {found['cpu_s']:.1f} | |",
        f"| memory at most, GB | {found['memory_bytes'] / 1e9:.2f} | under {AIM_BYTES / 1e9:.0f} |",
        f"| files | {found['files']:,} | |",
        f"| written, GB | {found['written_bytes'] / 1e9:.2f} | |",
        f"| load average before | {found['load_average']} | |",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=10_000)
    parser.add_argument("--folder", type=Path, help="an empty folder in which all stays")
    parser.add_argument("--write", action="store_true", help="write a page into results/")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measure(study_of(arguments.folder))))
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        size = fill(study_of(folder), arguments.sessions)
        load = round(os.getloadavg()[0], 1)
        words = [sys.executable, __file__, "--measure", "--folder", str(folder)]
        done = subprocess.run(words, check=True, stdout=subprocess.PIPE)
        found = json.loads(done.stdout)
    options = "" if arguments.sessions == 10_000 else f" --sessions {arguments.sessions}"
    found |= {
        "details_bytes": size,
        "load_average": load,
        "command": f"python benchmarks/experiment/export.py{options} --write",
        "met": found["wall_s"] < AIM_S and found["memory_bytes"] < AIM_BYTES,
    }
    print(json.dumps(found, indent=2))
    if arguments.write:
        name = "experiment_export"
        (RESULTS / f"{name}.md").write_text(as_markdown(found))


if __name__ == "__main__":
    main()
