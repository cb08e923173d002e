"""Speed of physics, pictures and trials beside another checkout, in turns, on the same scenes.

    python benchmarks/physics/side_by_side.py OTHER/src [--seeds 10] [--rounds 3] [--write]

Each round starts one process a checkout, which for sampled scenes of every scenario measures the
processor time of

- ``physics``: 150 frames of motion,
- ``color SIZE``: a frame of colour at SIZE x SIZE pixels, without the first one,
- ``passes``: a frame of all five passes at 256 x 256 pixels,
- ``clip SIZE COUNT``: COUNT frames of colour with the simulation and all set-up,
- ``trial``: all files of a readout trial, with both movies and the map, without choosing its scene.

Of each, the median over scenes counts. Printed is the median over rounds of the other checkout's
time over this one's: 2 is twice as fast. Below it are the times of this checkout, ms. ``--write``
keeps both in benchmarks/results/side_by_side.md.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

from physion.compute.tasks import processor_and_cores
from physion.scenes.sampling.build import scenarios

RESULTS = Path(__file__).parents[1] / "results"
HERE = Path(__file__).parents[2] / "src"
WORK = """
import dataclasses, json, statistics, sys, tempfile, time
from pathlib import Path
from physion import sample_scene, simulate
from physion.rendering.renderer import PASSES, Renderer
from physion.trials.making.make import make_trial
from physion.trials.making.plan import GenerateJob, GenerateSettings, TrialTask

SIZES, CLIPS = (64, 128, 224, 256, 512), ((64, 7), (64, 25), (128, 7), (128, 25))

def clip(scene, size, count):
    renderer = Renderer(scene, simulate(scene, frames=150), size, size)
    for frame in range(2, 2 + 6 * min(count, 24), 6):
        renderer.render(frame)
    if count > 24:
        renderer.render(149)

def measure(scenario, number, folder, note):
    def timed(name, work, parts=1):
        start = time.process_time()
        result = work()
        note(name, (time.process_time() - start) / parts)
        return result
    scene = dataclasses.replace(sample_scene(scenario, number), name=f"{scenario}_{number}")
    motion = timed("physics", lambda: simulate(scene, frames=150))
    frames = range(5, 150, 10)
    for size in SIZES:
        renderer = Renderer(scene, motion, size, size)
        renderer.render(0)
        timed(f"color {size}", lambda: [renderer.render(f) for f in frames], len(frames))
        if size == 256:
            renderer.render(0, PASSES)
            timed("passes", lambda: [renderer.render(f, PASSES) for f in frames], len(frames))
    for size, count in CLIPS:
        timed(f"clip {size} {count}", lambda: clip(scene, size, count))
    task = TrialTask("benchmark", scenario, "readout", number, scene=scene)
    timed("trial", lambda: make_trial(GenerateJob(task, folder, GenerateSettings())))

found = {}
with tempfile.TemporaryDirectory() as folder:
    for scenario in sys.argv[2:]:
        measure(scenario, int(sys.argv[1]), Path(folder), lambda *_: None)  # loads compiled code
        times = {}
        for number in range(int(sys.argv[1])):
            measure(scenario, number, Path(folder), lambda n, s: times.setdefault(n, []).append(s))
        found[scenario] = {name: statistics.median(values) for name, values in times.items()}
        print(scenario, file=sys.stderr, flush=True)
print(json.dumps(found))
"""

Times = dict[str, dict[str, float]]
"""Seconds by scenario and quantity."""


def measure(source: Path, seeds: int, names: list[str]) -> Times:
    """Return the times of one checkout."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", WORK, str(seeds), *names],
        env={**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        check=True,
    )
    return dict(json.loads(done.stdout))


def table(values: Times, digits: int) -> list[str]:
    """Return a table with one row for each scenario, and the geometric mean."""
    columns = list(next(iter(values.values())))
    means = {c: statistics.geometric_mean([row[c] for row in values.values()]) for c in columns}
    lines = [f"| scenario | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    for name, row in {**values, "geometric mean": means}.items():
        lines.append(f"| {name} | {' | '.join(f'{row[c]:.{digits}f}' for c in columns)} |")
    return lines


def main() -> None:
    """Measure in turns and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", type=Path)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--scenarios", nargs="+", default=sorted(scenarios.names()))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    other, names = options.other.resolve(), options.scenarios
    rounds = [
        (measure(HERE, options.seeds, names), measure(other, options.seeds, names))
        for _ in range(options.rounds)
    ]
    ratios: Times = {}
    here: Times = {}
    for scenario, row in rounds[0][0].items():
        ratios[scenario] = {
            c: statistics.median(b[scenario][c] / a[scenario][c] for a, b in rounds) for c in row
        }
        here[scenario] = {
            c: 1000 * statistics.median(a[scenario][c] for a, _ in rounds) for c in row
        }
    lines = ["Times as fast:", "", *table(ratios, 2), "", "Processor time here, ms:", ""]
    lines += table(here, 1)
    print("\n".join(lines))
    if options.write:
        commit = subprocess.run(
            ["git", "-C", str(other), "rev-parse", "--short", "HEAD"],
            stdout=subprocess.PIPE, text=True, check=True,
        ).stdout.strip()  # fmt: skip
        title = [
            f"# Processor time of this version beside that of commit {commit}",
            f"`python benchmarks/physics/side_by_side.py OTHER/src --seeds {options.seeds} "
            f"--rounds {options.rounds} --write`, {datetime.date.today()}, "
            f"{processor_and_cores()}. The head of the script says what is measured.",
            "",
        ]
        (RESULTS / "side_by_side.md").write_text("\n".join([*title, *lines]) + "\n")


if __name__ == "__main__":
    main()
