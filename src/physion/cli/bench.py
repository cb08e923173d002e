"""Measurement of this machine (``physion doctor --bench``), one row for each scenario.

Times are of the processor, on one core, for simulation, rendering and the making of trials. On a
machine that does other work at the same time they are longer.
"""

from __future__ import annotations

import dataclasses
import json as json_module
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from physion.cli.output import Stages, print_line, text_table
from physion.compute.tasks import processor
from physion.core.errors import BadInputError
from physion.core.version import MADE_WITH
from physion.data.official import official
from physion.physics.engine import simulate
from physion.physics.replay import Replay, ReplayTask, replay_trial, summarise
from physion.rendering.renderer import PASSES, Renderer
from physion.scenes.sampling.build import scenarios
from physion.scenes.sampling.sample import sample_scene
from physion.trials.making.choose import choose
from physion.trials.making.make import make_trial
from physion.trials.making.plan import GenerateJob, GenerateSettings, plan_dataset
from physion.trials.trial_file import Trial

SIDE = 256
"""Width and height of the pictures, as in the study."""
COLUMNS = {
    "scenario": "scenario",
    "simulate_ms": "simulate, ms",
    "real_time": "times real time",
    "agreement": "agree",
    "color_ms": "colour, ms a frame",
    "passes_ms": "all passes",
    "choose_s": "choose, s a trial",
    "make_s": "make",
    "frames_per_s": "frames/s a core",
    "megabytes": "MB",
}
"""Columns of the table by the field of `BenchRow`."""


def print_bench(scenario: str, count: int, as_json: bool) -> None:
    """Measure a scenario, or ``all``, with ``count`` scenes and trials of each; print the table."""
    if count < 1:
        raise BadInputError(f"--count must be 1 or more, not {count}")
    names = scenarios.names() if scenario == "all" else [scenario]
    for name in names:
        scenarios.get(name)
    rows = []
    with Stages() as stages:
        stages("measuring", 0, len(names))
        for done, name in enumerate(names, start=1):
            rows.append(measure(name, count))
            stages("measuring", done, len(names))
    machine = processor()
    if as_json:
        values = {"package": MADE_WITH, "machine": machine, "cores": os.cpu_count()}
        found = [dataclasses.asdict(row) for row in rows]
        print(json_module.dumps(values | {"count": count, "scenarios": found}, indent=1))
        return
    table = pd.DataFrame(map(dataclasses.asdict, rows)).rename(columns=COLUMNS)
    title = f"{MADE_WITH}, {machine}, one of {os.cpu_count()} cores"
    print_line(text_table(table, title))


@dataclass(frozen=True)
class BenchRow:
    """Mean processor times of a scenario; NaN where nothing was measured.

    - ``simulate_ms``: of the simulation of an official scene; ``real_time``: physics time over it;
    - ``agreement``: fraction of these scenes whose simulated outcome is the recorded one;
    - ``color_ms``, ``passes_ms``: of a frame, in colour and in all passes;
    - ``choose_s``, ``make_s``: of a readout trial: the choice of its scene, with eight jittered
      simulations, and its files; ``frames_per_s``: frames of the trials over both;
      ``megabytes``: of the files of a trial.
    """

    scenario: str
    simulate_ms: float
    real_time: float
    agreement: float
    color_ms: float
    passes_ms: float
    choose_s: float
    make_s: float
    frames_per_s: float
    megabytes: float


def measure(scenario: str, count: int) -> BenchRow:
    """Return the measurements of ``count`` official scenes, frames and trials of a scenario."""
    found = official().trial_set(scenario, count).trials
    replays: list[Replay] = [replay_trial(ReplayTask(trial)) for trial in found]
    (replayed,) = summarise(replays)
    scene = sample_scene(scenario, 0)
    motion = simulate(scene)
    renderer = Renderer(scene, motion, SIDE, SIDE)
    frames = range(0, len(motion) - 1, max(1, (len(motion) - 1) // (4 * count)))[: 4 * count]
    color = _mean_ms(lambda frame: renderer.render(frame), frames)
    passes = _mean_ms(lambda frame: renderer.render(frame, PASSES), frames)
    choose_s, make_s, made, size = _trials(scenario, count)
    return BenchRow(
        scenario,
        simulate_ms=replayed.milliseconds,
        real_time=replayed.real_time,
        agreement=replayed.agreement,
        color_ms=color,
        passes_ms=passes,
        choose_s=choose_s / count,
        make_s=make_s / count,
        frames_per_s=made / (choose_s + make_s),
        megabytes=size / count / 1e6,
    )


def _mean_ms(render: Callable[[int], object], frames: range) -> float:
    """Return the mean processor time of a frame in milliseconds, without the first call."""
    render(frames[0])
    started = time.process_time()
    for frame in frames:
        render(frame)
    return (time.process_time() - started) * 1000 / len(frames)


def _trials(scenario: str, count: int) -> tuple[float, float, int, int]:
    """Return processor seconds to choose and to make trials, and their frames and bytes."""
    settings = GenerateSettings(width=SIDE, height=SIDE)
    choosing = making = 0.0
    frames = size = 0
    with tempfile.TemporaryDirectory() as name:
        # The first trial loads compiled code, and is not counted.
        for number, task in enumerate(plan_dataset("bench", [scenario], {"readout": count + 1})):
            begin = time.process_time()
            filled, _ = choose(GenerateJob(task, Path(name), settings))
            chosen = time.process_time()
            job = GenerateJob(filled, Path(name), settings)
            make_trial(job)
            if number:
                making += time.process_time() - chosen
                choosing += chosen - begin
                frames += Trial.open(job.paths.trial_file).metadata.frames
                size += sum(p.stat().st_size for p in Path(name).rglob("*") if p.is_file())
            for path in Path(name).rglob("*"):
                if path.is_file():
                    path.unlink()
    return choosing, making, frames, size
