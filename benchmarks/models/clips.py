"""How fast clips are read from movies, and rendered on demand, on one core.

    OMP_NUM_THREADS=1 python benchmarks/models/clips.py [--dataset FOLDER] [--write]

Trials of two scenarios are made at 128 pixels, one movie each; the frames of a clip are then read
at 64 pixels from random starts, and clips of 25 frames are rendered at 128 pixels. The cost of a
clip by its start is compared with decoding from the start of the movie. The process keeps to one
core. Other programs may use the same core: clips per second of processor time are what one core
gives, those per second of the clock are what was left to this process.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from physion.clips.batch import Spec
from physion.clips.clips import whole_source
from physion.compute.local import SerialExecutor
from physion.compute.tasks import processor
from physion.trials.dataset import Dataset
from physion.trials.making.generate import generate
from physion.trials.making.plan import GenerateSettings
from physion.trials.video import open_movie

RESULTS = Path(__file__).parents[1] / "results"
SCENARIOS, TRIALS, SIZE = ("collide", "drop"), 6, 128
STARTS = (0, 30, 60, 90, 120)
GOALS = {"movies": 60, "rendered": 5}
"""Clips a second and core that are to be reached."""


def make_dataset(folder: Path) -> Dataset:
    """Make `TRIALS` trials of each scenario with movies of `SIZE` pixels."""
    settings = GenerateSettings(width=SIZE, height=SIZE, look="redyellow", jitters=0)
    counts = {"training": TRIALS}
    return generate(
        folder, SCENARIOS, counts, name="clips", settings=settings, executor=SerialExecutor()
    )


def clips_per_second(read: Callable[[int], Any], clips: int) -> dict[str, float]:
    """Return clips per second of processor and clock, of ``read(0)`` .. ``read(clips - 1)``."""
    clock, processor = time.perf_counter(), time.process_time()
    for number in range(clips):
        read(number)
    processor, clock = time.process_time() - processor, time.perf_counter() - clock
    return {"cpu": round(clips / processor, 1), "clock": round(clips / clock, 1), "clips": clips}


def movie_clips(data: Dataset, clips: int, length: int, stride: int) -> dict[str, float]:
    """Measure clips of ``length`` frames at 64 pixels from random trials and starts."""
    source = whole_source(data, Spec(image_size=64, stride=stride))
    rng = np.random.default_rng(0)
    trials = [source.trials[row] for row in rng.integers(len(source.trials), size=clips)]
    span = 1 + (length - 1) * stride
    starts = [int(rng.integers(max(source.length(t) - span, 1))) for t in trials]
    return clips_per_second(lambda i: source.window([trials[i]], [starts[i]], length), clips)


def rendered_clips(data: Dataset, clips: int) -> dict[str, float]:
    """Measure whole clips of 25 frames, each of another trial than the one before."""
    source = whole_source(data, Spec(image_size=SIZE), rendered=True)
    count = len(source.trials)
    for trial in source.trials:  # textures are painted once in a process
        source.window([trial], [0], 1)
    return clips_per_second(lambda i: source.whole([source.trials[i % count]]), clips)


def milliseconds_by_start(data: Dataset, clips: int) -> dict[str, dict[str, float]]:
    """Return milliseconds of processor time of 16 frames from each start, with and without seeks.

    Both decode and do not convert; each is the median of ``clips`` clips.
    """
    movies = [data.paths(trial).movie for trial in data.trials()]

    def cost(start: int, seeks: bool) -> float:
        times = []
        for number in range(clips):
            begin = time.process_time()
            with open_movie(movies[number % len(movies)]) as decoder:
                first = start if seeks else 0
                for _ in decoder.pictures(range(first, start + 16)):
                    pass
            times.append(time.process_time() - begin)
        return round(1e3 * float(np.median(times)), 2)

    return {
        str(start): {"seeking": cost(start, True), "from the start": cost(start, False)}
        for start in STARTS
    }


def measure(data: Dataset, scale: int) -> dict[str, Any]:
    """Return all figures; ``scale`` multiplies the numbers of clips."""
    movie_clips(data, len(data), 1, 1)  # compile, load, check the movies
    frames = data.index["frames"]
    return {
        "date": date.today().isoformat(),
        "command": "OMP_NUM_THREADS=1 python benchmarks/models/clips.py --write",
        "machine": processor(),
        "cores_used": len(os.sched_getaffinity(0)),
        "load_average": round(os.getloadavg()[0], 1),
        "note": (
            "other programs ran on the machine: cpu figures are clips per second of processor time "
            "on one core, clock figures what was left to this process"
        ),
        "movies": f"{len(data)} of {SIZE} x {SIZE} pixels, {frames.min()}-{frames.max()} frames",
        "clips_per_second": {
            "movies, 16 frames, 64 px, stride 1": movie_clips(data, 100 * scale, 16, 1),
            "movies, 16 frames, 64 px, stride 6": movie_clips(data, 50 * scale, 16, 6),
            "rendered, 25 frames, 128 px": rendered_clips(data, 6 * scale),
        },
        "goals": GOALS,
        "cpu_ms_to_decode_16_frames_by_start": milliseconds_by_start(data, 10 * scale),
    }


def main() -> None:
    """Print the figures, and write them if asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dataset", type=Path, help="use the trials of this dataset")
    parser.add_argument("--scale", type=int, default=6, help="factor of the numbers of clips")
    parser.add_argument("--write", action="store_true", help="write benchmarks/results/clips.json")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    with tempfile.TemporaryDirectory() as folder:
        data = Dataset(arguments.dataset) if arguments.dataset else make_dataset(Path(folder))
        text = json.dumps(measure(data, arguments.scale), indent=1)
    print(text)
    if arguments.write:
        (RESULTS / "clips.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
