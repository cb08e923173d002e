"""Measure how often `physion judge` sees what a movie shows.

    OMP_NUM_THREADS=1 python benchmarks/models/judge.py FOLDER [--count 12] [--workers 2] [--known]
                                                            [--write]

Testing trials in red and yellow are made in FOLDER/trials, ``--count`` of each scenario. Of each,
the true continuation is encoded again, by itself and after each of `CORRUPTIONS` and `FAULTS`, and
measured. One line a trial is appended to FOLDER/judge.jsonl; an interrupted run continues there.
Printed are:

1. The fraction of movies whose contact is right, clean and corrupted, by scenario, and the fraction
   by the movie only (``contact_seen``), which uses no knowledge of the true path.
2. Of each planted fault, the fraction of trials in which its measure is worse than in the clean and
   in all corrupted movies. Trials in which the fault cannot be seen are left out: the agent moves
   less than 5 pixels (freeze), or is hidden in half of the frames after the fault or more.
3. Processor seconds for a movie of 150 frames, decoding included, with a quarter of the time that
   the true movie takes: four seeds share it.

With --known nothing more is measured. With --write the tables are written to ``results/judge.md``.
"""

from __future__ import annotations

import argparse
import datetime
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import ndimage

import physion
from physion.compute.local import LocalExecutor
from physion.core.tables import markdown_table
from physion.judging.measure import KnownMovie, measure, reference_of
from physion.judging.track import AGENT, PATIENT, Tracker, with_hue
from physion.trials.dataset import Dataset
from physion.trials.making.plan import GenerateSettings
from physion.trials.share.conditioning import SEEDS
from physion.trials.video import encode_movie, read_frames

RESULTS = Path(__file__).parents[1] / "results" / "judge.md"
U8 = NDArray[np.uint8]
RATE = 30


def noisy(frames: U8) -> U8:
    """Return frames with normal noise of 15 of 255."""
    noise = np.random.default_rng(0).normal(0, 15, frames.shape)
    return np.clip(frames + noise, 0, 255).astype(np.uint8)


def moved(frames: U8) -> U8:
    """Return frames moved by 10 pixels in all: 6 to the right and 8 down; edges are repeated."""
    return np.pad(frames, ((0, 0), (8, 0), (6, 0), (0, 0)), "edge")[:, :-8, :-6]


CORRUPTIONS: dict[str, tuple[Callable[[U8], U8], int, int]] = {
    "clean": (lambda frames: frames, RATE, 18),
    "low rate": (lambda frames: frames, RATE, 38),
    "blur": (lambda frames: ndimage.gaussian_filter(frames, (0, 1.5, 1.5, 0)), RATE, 18),
    "noise": (noisy, RATE, 18),
    "hue": (lambda frames: with_hue(frames, 36), RATE, 18),
    "moved": (moved, RATE, 18),
    "24 a second": (
        lambda frames: frames[np.arange(0, len(frames), RATE / 24).round().astype(int)[:-1]],
        24,
        18,
    ),
}
"""Change of the frames, frames a second, and quality of the encoder (18 is the usual one)."""

FAULTS = {
    "freeze": ("travelled", -1),
    "vanish": ("agent_seen", -1),
    "teleport": ("jump", 1),
    "swap": ("agent_size", 1),
}
"""Measure by which a fault shows, and whether it is then large (1) or small (-1)."""


def faulty(frames: U8, first: int, reference: KnownMovie) -> dict[str, U8]:
    """Return continuations of the true movie (F, H, W, 3) with each fault from the middle on."""
    tracker = Tracker(reference.pictures[0], reference.roles)
    roles = np.stack([tracker.roles(frame) for frame in frames])
    red = np.stack([ndimage.binary_dilation(one == AGENT, iterations=2) for one in roles])
    # The agent may rest for most of the movie: what is behind it is not known.
    empty = np.median(frames, axis=(1, 2), keepdims=True).astype(np.uint8)
    without = np.where(red[..., None], empty, frames)
    middle, width = (first + len(frames)) // 2, frames.shape[2]
    teleported, swapped = without.copy(), frames.copy()
    shift = width // 4
    for place in range(len(frames)):
        y, x = np.nonzero(red[place])
        there = (x + shift) % width
        teleported[place, y, there] = frames[place, y, x]
        colors = [np.median(frames[place][mask], axis=0) if mask.any() else np.zeros(3)
                  for mask in (roles[place] == AGENT, roles[place] == PATIENT)]  # fmt: skip
        swapped[place][roles[place] == AGENT] = colors[1]
        swapped[place][roles[place] == PATIENT] = colors[0]
    parts = {"vanish": without, "teleport": teleported, "swap": swapped}
    found = {name: np.concatenate([frames[first:middle], part[middle:]])
             for name, part in parts.items()}  # fmt: skip
    frozen = np.repeat(frames[first : first + 1], len(frames) - first, axis=0)
    return {"freeze": frozen} | found


def judge_trial(task: tuple[Path, str]) -> dict[str, Any]:
    """Return the measures of all movies of a trial."""
    folder, trial = task
    dataset = Dataset(folder)
    opened, frames = dataset.trial(trial), dataset.frames(trial)
    first = opened.metadata.observed_frames
    start = time.process_time()
    reference = reference_of(opened, frames, RATE)
    shared = (time.process_time() - start) / len(frames) / SEEDS
    movies = {name: (change(frames[first:]), rate, crf)
              for name, (change, rate, crf) in CORRUPTIONS.items()}  # fmt: skip
    movies |= {name: (movie, RATE, 18) for name, movie in faulty(frames, first, reference).items()}
    shown = float((reference.tracks.area[(first + len(frames)) // 2 :, 0] > 0).mean())
    labels, rows, spent, count = opened.known_labels(), {}, 0.0, 0
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "movie.mp4"
        for name, (movie, rate, crf) in movies.items():
            path.write_bytes(encode_movie(movie, rate=rate, crf=crf))
            start = time.process_time()
            rows[name] = measure(read_frames(path), rate, first, reference)[0]
            spent, count = spent + time.process_time() - start, count + len(movie)
    return {"trial": trial, "scenario": opened.scene.scenario, "contact": labels.contact,
            "first_frame": labels.first_frame, "seconds": 150 * (spent / count + shared),
            "shown": shown, "movies": rows}  # fmt: skip


def tables(rows: list[dict[str, Any]]) -> list[pd.DataFrame]:
    """Return the tables of contacts, of the movie only, and of faults."""
    contact: list[dict[str, Any]] = []
    seen: list[dict[str, Any]] = []
    scenarios = sorted({row["scenario"] for row in rows})
    groups = {name: [row for row in rows if row["scenario"] == name] for name in scenarios}
    rigid = [row for row in rows if row["scenario"] != "drape"]
    for name, own in (groups | {"rigid": rigid, "all": rows}).items():
        line = {"scenario": name, "trials": len(own)}
        for key, out in (("contact", contact), ("contact_seen", seen)):
            right = {
                change: [row["movies"][change][key] == row["contact"] for row in own]
                for change in CORRUPTIONS
            }
            out.append(line | {change: float(np.mean(all_of)) for change, all_of in right.items()})
    faults = []
    for fault, (measured, sign) in FAULTS.items():
        shown = [row for row in rows if visible(row, fault)]
        worse = [
            all(
                sign * (row["movies"][fault][measured] - (row["movies"][other][measured] or 0)) > 0
                for other in CORRUPTIONS
            )
            for row in shown
        ]
        faults.append({"fault": fault, "measure": measured, "trials": len(shown),
                       "worse than clean and corrupted": float(np.mean(worse))})  # fmt: skip
    return [pd.DataFrame(table) for table in (contact, seen, faults)]


def visible(row: dict[str, Any], fault: str) -> bool:
    """Return whether a fault can be seen in a trial."""
    if fault == "freeze":
        return bool(row["movies"]["freeze"]["trajectory_end"] or 0) and bool(
            row["movies"]["freeze"]["trajectory_end"] > 5
        )
    return bool(row["shown"] > 0.5)


def mistakes(row: dict[str, Any]) -> list[str]:
    """Return the corruptions after which the contact of a trial is wrong."""
    return [name for name in CORRUPTIONS if row["movies"][name]["contact"] != row["contact"]]


def main() -> None:
    """Make the trials, judge all movies, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--known", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    folder = options.folder / "trials"
    if not (folder / "index.parquet").exists():
        settings = GenerateSettings(look="redyellow", jitters=0)
        physion.generate(folder, "all", {"testing": options.count}, name="judge", settings=settings)
    index = Dataset(folder).index
    # One trial of each scenario after the other, so that an interrupted run has some of all.
    order = index.groupby("scenario", observed=True).cumcount()
    trials = index.assign(order=order)[order < options.count].sort_values("order")["trial"]
    done = options.folder / "judge.jsonl"
    rows = [json.loads(line) for line in done.read_text().splitlines()] if done.exists() else []
    there = {row["trial"] for row in rows}
    known = set() if options.known else set(map(str, trials))
    todo = {trial: (folder, trial) for trial in sorted(known - there, key=list(trials).index)}
    with done.open("a") as out:
        for outcome in LocalExecutor(options.workers).map(judge_trial, todo):
            assert outcome.value is not None, outcome.error
            rows.append(outcome.value)
            out.write(json.dumps(outcome.value) + "\n")
            out.flush()
    lines = [
        "# Judging movies",
        "",
        f"`python benchmarks/models/judge.py FOLDER --count {options.count}`, {len(rows)} trials, "
        f"{datetime.date.today()}. Fraction of movies whose contact is right; then by the movie "
        "only; then faults.",
    ]
    for table in tables(rows):
        cells = [[f"{v:.3f}" if isinstance(v, float) else str(v) for v in row]
                 for row in [table.columns, *table.to_numpy().tolist()]]  # fmt: skip
        lines += ["", markdown_table(cells[0], cells[1:])]
    seconds = np.mean([row["seconds"] for row in rows])
    wrong = [f"{row['trial']} ({', '.join(bad)})" for row in rows if (bad := mistakes(row))]
    lines += ["", f"Processor seconds for a movie of 150 frames: {seconds:.2f}.", "",
              f"Wrong contacts: {'; '.join(wrong) or 'none'}."]  # fmt: skip
    print("\n".join(lines))
    if options.write:
        RESULTS.write_text("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
