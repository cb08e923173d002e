"""Wall time of eight jittered runs of official scenes in one call: one thread beside two.

    python benchmarks/physics/jittered_runs.py FOLDER [--scenario link] [--limit 20] [--write]

Each scene is simulated eight times with 1 mm of jitter, in turns with one thread and with two; the
bytes must be the same. ``--write`` keeps the figures in benchmarks/results/jittered_runs.json.
"""

from __future__ import annotations

import argparse
import datetime
import json
import statistics
import time
from pathlib import Path

from physion.compute.tasks import processor_and_cores
from physion.core.seeds import child_generator, trial_seed
from physion.physics.labels import jitter_scene
from physion.physics.rigid.engine import RigidEngine
from physion.scenes.tdw.read_logs import read_scenes

RESULTS = Path(__file__).parents[1] / "results"
RUNS, JITTER, TARGET = 8, 0.001, 0.8


def main() -> None:
    """Measure, and print the medians over scenes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenario", default="link")
    parser.add_argument("--limit", type=int, default=20)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    trials, _ = read_scenes(options.folder, options.scenario).unique()
    trials = trials[:: max(1, len(trials) // options.limit)]
    engines = {threads: RigidEngine(threads=threads) for threads in (1, 2)}
    engines[1].simulate(trials[0].scene)
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for trial in trials:
        seed = trial_seed("jitter", trial.scene.scenario, trial.scene.name, 0)
        draws = [child_generator(seed, f"repeat {run}") for run in range(RUNS)]
        scenes = [jitter_scene(trial.scene, JITTER, draw) for draw in draws]
        digests = []
        for threads, engine in engines.items():
            start = time.perf_counter()
            paths = engine.simulate_many(scenes)
            seconds[threads].append(time.perf_counter() - start)
            digests.append([path.digest() for path in paths])
        assert digests[0] == digests[1], f"{trial.scene.name}: bytes depend on the threads"
    result = {
        "date": str(datetime.date.today()),
        "hardware": processor_and_cores(),
        "command": "python benchmarks/physics/jittered_runs.py FOLDER "
        f"--scenario {options.scenario} "
        f"--limit {options.limit} --write",
        "scenes": len(trials),
        "runs of each": RUNS,
        "median seconds, one thread": statistics.median(seconds[1]),
        "median seconds, two threads": statistics.median(seconds[2]),
        "largest seconds, two threads": max(seconds[2]),
        "seconds to reach, two threads": TARGET,
    }
    print(json.dumps(result, indent=2))
    if options.write:
        (RESULTS / "jittered_runs.json").write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
