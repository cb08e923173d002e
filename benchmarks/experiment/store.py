"""How fast the store alone keeps answers.

    python benchmarks/experiment/store.py
        [--people 200] [--seconds 10] [--profile FILE]

No HTTP: so many participants as coroutines of one process, each storing its next answer as soon as
the last one is on the disk. Commits are durable as when a study is served. Prints one JSON object:
answers a second of wall time and of processor time, and the times to the acknowledgement. The HTTP
server on top of it is measured by benchmarks/experiment/load.py.
"""

from __future__ import annotations

import argparse
import asyncio
import cProfile
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from physion.experiment.protocol import Answer, Enter, PageDone, Phase
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import Timing
from physion.experiment.study.study import Study

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
TEST_TRIALS = 150


def make_study(folder: Path) -> Study:
    """The tiny study with 150 test trials; nobody asks for the movies of the further ones."""
    from support.experiment.tiny_study import make_tiny_study

    tiny = make_tiny_study(folder, test=1, timing=Timing(cue_ms=100))
    test = tiny.phase("collide", "test")[0]
    more = tuple(
        replace(test, stimulus=f"test_{place:04d}", place=place) for place in range(1, TEST_TRIALS)
    )
    return replace(tiny, stimuli=(*tiny.stimuli, *more))


async def participant(store: Store, word: str, until: float, waits: list[float]) -> None:
    """Sessions one after the other until the time is over."""
    while time.perf_counter() < until:
        enter = Enter.model_validate({"pass": word, "scenario": "collide"})
        token = (await store.enter(enter)).token
        await store.page(token, PageDone(page="consent", data={"agreed": True}))
        await store.page(token, PageDone(page="instructions"))
        phases: tuple[tuple[Phase, int], ...] = (("familiarization", 10), ("test", TEST_TRIALS))
        for phase, count in phases:
            for trial in range(count):
                if time.perf_counter() > until:
                    return
                await one_answer(store, token, phase, trial, waits)
            if phase == "familiarization":
                await store.page(token, PageDone(page="ready"))


async def one_answer(
    store: Store, token: str, phase: Phase, trial: int, waits: list[float]
) -> None:
    """Store one answer with as much beside it as a browser sends."""
    answer = Answer(
        key=f"{phase}-{trial:06d}", phase=phase, trial=trial, response="yes", rt_ms=731.25,
        input="mouse", fixation_ms=804.0, cue_ms=2001.5, frames_shown=45, frames_dropped=0,
        movie_ms=1466.7, visibility_changes=0, window_width=1280, window_height=720,
        details={"frames": [round(33.37 * frame, 2) for frame in range(45)]},
    )  # fmt: skip
    began = time.perf_counter()
    stored = await store.answer(token, answer)
    waits.append(time.perf_counter() - began)
    assert not stored.duplicate


async def _load(store: Store, word: str, people: int, seconds: float) -> list[float]:
    waits: list[float] = []
    until = time.perf_counter() + seconds
    await asyncio.gather(*(participant(store, word, until, waits) for _ in range(people)))
    return waits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--profile", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        study = make_study(Path(folder))
        secrets = Secrets.load(Path(folder))
        store = Store.open(study, secrets)
        word = make_pass(secrets, "simulated")
        profile = cProfile.Profile()
        if options.profile:
            profile.enable()
        wall, cpu = time.perf_counter(), time.process_time()
        waits = asyncio.run(_load(store, word, options.people, options.seconds))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        if options.profile:
            profile.disable()
            profile.dump_stats(options.profile)
        store.close()
    p50, p99 = 1000 * np.quantile(waits, [0.5, 0.99])
    numbers = {
        "people": options.people,
        "answers": len(waits),
        "answers_per_s": round(len(waits) / wall),
        "answers_per_cpu_s": round(len(waits) / cpu),
        "p50_ms": round(float(p50), 1),
        "p99_ms": round(float(p99), 1),
    }
    print(json.dumps(numbers))


if __name__ == "__main__":
    main()
