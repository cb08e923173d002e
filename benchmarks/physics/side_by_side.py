"""Speed of physics and rendering beside another checkout, in turns, on the same scenes.

    python benchmarks/physics/side_by_side.py OTHER/src [--seeds 6] [--rounds 5] [--write]

Each round starts one process a checkout, which simulates and renders sampled scenes of every
scenario once for the compiler and once for the clock (processor time). Printed is the median over
rounds of this checkout's time over the other's: below 1 is faster. ``--write`` keeps the table in
benchmarks/results/side_by_side.md.
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
import json, sys, time
from physion import sample_scene, simulate
from physion.rendering.renderer import Renderer
times = {}
for scenario in sys.argv[2:]:
    scenes = [sample_scene(scenario, i) for i in range(int(sys.argv[1]))]
    simulate(scenes[0], frames=30)
    start = time.process_time()
    motions = [simulate(scene, frames=150) for scene in scenes]
    physics = time.process_time() - start
    passes = ("color", "depth", "normals", "ids", "flow")
    renderers = [Renderer(s, m, 256, 256) for s, m in zip(scenes, motions)]
    for renderer in renderers:
        renderer.render(0, passes)
    start = time.process_time()
    for renderer in renderers:
        for frame in range(0, 150, 15):
            renderer.render(frame, passes)
    times[scenario] = (physics, time.process_time() - start)
print(json.dumps(times))
"""


def measure(source: Path, seeds: int) -> dict[str, tuple[float, float]]:
    """Seconds of physics and of rendering by scenario, from a process of one checkout."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", WORK, str(seeds), *sorted(scenarios.names())],
        env={**os.environ, "PYTHONPATH": str(source)},
        stdout=subprocess.PIPE,
        check=True,
    )
    return {name: (pair[0], pair[1]) for name, pair in json.loads(done.stdout).items()}


def main() -> None:
    """Measure in turns and print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", type=Path)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    other = options.other.resolve()
    pairs = [
        (measure(HERE, options.seeds), measure(other, options.seeds)) for _ in range(options.rounds)
    ]
    lines = ["| scenario | physics | rendering |", "|---|---|---|"]
    ratios: list[list[float]] = [[], []]
    for scenario in pairs[0][0]:
        cells = []
        for part in (0, 1):
            ratio = statistics.median(a[scenario][part] / b[scenario][part] for a, b in pairs)
            ratios[part].append(ratio)
            cells.append(f"{ratio:.3f}")
        lines.append(f"| {scenario} | {' | '.join(cells)} |")
    means = " | ".join(f"{statistics.geometric_mean(part):.3f}" for part in ratios)
    lines.append(f"| geometric mean | {means} |")
    print("\n".join(lines))
    if options.write:
        commit = subprocess.run(
            ["git", "-C", str(other), "rev-parse", "--short", "HEAD"],
            stdout=subprocess.PIPE, text=True, check=True,
        ).stdout.strip()  # fmt: skip
        title = [
            f"# Processor time of this version over that of commit {commit}",
            f"`python benchmarks/physics/side_by_side.py OTHER/src --seeds {options.seeds} "
            f"--rounds {options.rounds} --write`, {datetime.date.today()}, "
            f"{processor_and_cores()}. Median over rounds in turns; below 1 is faster. Physics: "
            "150 frames; rendering: every pass of 10 frames at 256 x 256 pixels, the first frame "
            "left out.",
            "",
        ]
        (RESULTS / "side_by_side.md").write_text("\n".join([*title, *lines]) + "\n")


if __name__ == "__main__":
    main()
