"""Our presets beside the official configurations of their names: contact rates and lengths.

    python benchmarks/physics/presets.py [OFFICIAL/scenes] [--scenario X] [--count 40] [--write]

samples and simulates ``--count`` trials of every published preset. The difference between two
contact rates has the standard error sqrt(p (1 - p) (1/n + 1/m)), p being the rate of both together;
"within" means at most two of them. Lengths are compared by medians where the folder of official
scenes holds the configuration's trials, else by means. ``--write`` keeps the table in
benchmarks/results/presets.md and presets.json.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import statistics
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from physion.compute.local import LocalExecutor
from physion.compute.tasks import processor_and_cores
from physion.core.errors import BadSceneError
from physion.core.seeds import trial_seed
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.scenes.sampling.build import scenarios
from physion.scenes.sampling.sample import Preset, get_preset, load_presets, sample_scene
from replay import RESULTS, cell

GOAL = 0.85
"""Share of presets whose contact rate is to be within two standard errors."""


@dataclass(frozen=True)
class Task:
    """One trial to sample and simulate."""

    scenario: str
    preset: str
    index: int


@dataclass(frozen=True)
class Made:
    """What became of a task; ``frames`` is 0 where the scene could not be placed."""

    task: Task
    contact: bool = False
    frames: int = 0


@dataclass(frozen=True)
class Row:
    """One preset beside its configuration. Rates are shares; ``error`` is of their difference."""

    scenario: str
    preset: str
    trials: int
    unplaced: int
    contact: int
    rate: float
    official_rate: float
    error: float
    within: bool
    pooled_rate: float
    pooled_within: bool
    mean_frames: float
    median_frames: float
    official_mean_frames: float
    official_median_frames: float | None
    frames_within: bool


def make(task: Task) -> Made:
    """Sample and simulate one trial."""
    seed = trial_seed("presets", task.scenario, task.preset, task.index)
    try:
        scene = sample_scene(task.scenario, seed, get_preset(task.scenario, task.preset).params)
    except BadSceneError:
        return Made(task)
    trajectory = simulate(scene)
    return Made(task, label_contact(scene, trajectory).contact, len(trajectory))


def difference(ones: int, count: int, others: int, of: int) -> tuple[float, bool]:
    """Standard error of the difference of two rates, and whether it is within two of them."""
    if not count or not of:
        return math.nan, False
    both = (ones + others) / (count + of)
    error = math.sqrt(both * (1 - both) * (1 / count + 1 / of))
    return error, abs(ones / count - others / of) <= 2 * error


def official_median(folder: Path | None, preset: Preset) -> float | None:
    """Median length of the configuration's trials, None where they are not at hand."""
    file = folder / preset.scenario / str(preset.official) / "metadata.json" if folder else None
    if file is None or not file.is_file():
        return None
    return float(statistics.median(trial["num_frames"] for trial in json.loads(file.read_text())))


def compare(preset: Preset, made: list[Made], folder: Path | None) -> Row:
    """Set what was made of a published preset beside what was published."""
    published = preset.published
    assert published is not None
    frames = [trial.frames for trial in made if trial.frames]
    contact, count = sum(trial.contact for trial in made), len(frames)
    error, within = difference(contact, count, published.contact, published.trials)
    pooled = published.contact + published.readout_contact
    pooled_trials = published.trials + published.readout_trials
    ours = (statistics.fmean(frames), statistics.median(frames)) if frames else (math.nan, math.nan)
    median = official_median(folder, preset)
    ratio = ours[0] / published.frames if median is None else ours[1] / median
    return Row(
        scenario=preset.scenario,
        preset=preset.name,
        trials=count,
        unplaced=len(made) - count,
        contact=contact,
        rate=contact / count if count else math.nan,
        official_rate=published.contact / published.trials,
        error=error,
        within=within,
        pooled_rate=pooled / pooled_trials,
        pooled_within=difference(contact, count, pooled, pooled_trials)[1],
        mean_frames=ours[0],
        median_frames=ours[1],
        official_mean_frames=published.frames,
        official_median_frames=median,
        frames_within=abs(ratio - 1) <= 0.25,
    )


def table(rows: list[Row], command: str) -> str:
    """The rows in Markdown, with the shares that count."""
    lines = [
        "# Presets beside the official configurations",
        f"{datetime.date.today()}, {processor_and_cores()}, `{command}`",
        "",
        "| scenario | preset | trials | contact | official, test | standard error | within two | "
        "official, test and readout | within two | frames: mean, median | official | "
        "within 25 % |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    yes = {True: "yes", False: "**no**"}
    for row in rows:
        median = cell(row.official_median_frames, 0)
        lines.append(
            f"| {row.scenario} | {row.preset} | {row.trials} | {row.rate:.2f} | "
            f"{row.official_rate:.2f} | {row.error:.2f} | {yes[row.within]} | "
            f"{row.pooled_rate:.2f} | {yes[row.pooled_within]} | {row.mean_frames:.0f}, "
            f"{row.median_frames:.0f} | {row.official_mean_frames:.0f}, {median} | "
            f"{yes[row.frames_within]} |"
        )
    lines += ["", *(f"- {name}: {value}" for name, value in summary(rows).items())]
    return "\n".join(lines) + "\n"


def summary(rows: list[Row]) -> dict[str, str]:
    """Shares of the presets that agree."""

    def share(hits: int) -> str:
        return f"{hits} of {len(rows)}, {hits / len(rows):.0%}"

    return {
        "contact rate within two standard errors of the test trials'": (
            f"{share(sum(row.within for row in rows))} (to reach: {GOAL:.0%})"
        ),
        "the same, test and readout trials together": share(sum(row.pooled_within for row in rows)),
        "lengths within 25 %": share(sum(row.frames_within for row in rows)),
        "scenes that could not be placed": str(sum(row.unplaced for row in rows)),
    }


def main() -> None:
    """Make the trials, print the table, and keep it if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", help="folder of the official scenes")
    parser.add_argument("--scenario", default="all")
    parser.add_argument("--preset", default="", help="only presets whose name contains this")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    names = scenarios.names() if options.scenario == "all" else options.scenario.split(",")
    presets = [
        preset
        for name in names
        for preset in load_presets(name).values()
        if preset.published and options.preset in preset.name
    ]
    tasks = {
        f"{preset.scenario}/{preset.name}/{index}": Task(preset.scenario, preset.name, index)
        for preset in presets
        for index in range(options.count)
    }
    made: dict[tuple[str, str], list[Made]] = {}
    for outcome in LocalExecutor(options.workers).map(make, tasks):
        trial = outcome.value
        made.setdefault((trial.task.scenario, trial.task.preset), []).append(trial)
        if sys.stderr.isatty():
            print(f"\r{sum(map(len, made.values()))} of {len(tasks)}", end="", file=sys.stderr)
    rows = [
        compare(preset, made[preset.scenario, preset.name], options.folder) for preset in presets
    ]
    command = f"python benchmarks/physics/presets.py{' FOLDER' if options.folder else ''}"
    command += f" --scenario {options.scenario} --count {options.count}"
    text = table(rows, command + f" --workers {options.workers}")
    data = json.dumps(
        {"summary": summary(rows), "presets": [asdict(row) for row in rows]}, indent=1
    )
    print(data if options.json else text)
    if options.write:
        (RESULTS / "presets.md").write_text(text)
        (RESULTS / "presets.json").write_text(data + "\n")


if __name__ == "__main__":
    main()
