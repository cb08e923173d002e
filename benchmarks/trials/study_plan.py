"""Plan on paper of the whole study, from measured times: hours and cost. Nothing of it is run.

    OMP_NUM_THREADS=1 python benchmarks/trials/study_plan.py --write  # measure, plan, keep
    python benchmarks/trials/study_plan.py --models --cores 256 --gpus 16  # plan with kept times

The study: 25,200 trials; 11 models of the size ``paper``, each trained 17 times (on all scenarios,
on all but one, on only one) with one seed; features, rollouts and readouts of the 1000 readout and
150 testing trials of every tested scenario. The time of a trial is that of
``results/generation.json``; those of the models are measured by `study_times`, on a GPU if torch
sees one. The tasks are put on cores and GPUs by `study_schedule`.

A task of a network holds a GPU and ``cores // gpus - 1`` cores, which read for it: in a training
ahead of the steps, so that the slower of the two counts; in an evaluation before each batch, on one
core. Without GPUs it holds one core, which does both. Not counted: starting processes, checkpoints,
downloads, waiting in queues, and what fails.

Prices are assumptions: of a core and of a GPU for an hour. All cores and GPUs are paid from the
start to the end of the schedule. With times of a core alone, how many times as fast as the core a
GPU is, is an assumption too (`FASTER`).
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import os
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import torch

import physion
from physion.compute.tasks import processor
from physion.core.tables import markdown_table
from physion.readout.folds import Protocol, TrainingSet, training_sets
from physion.training.windows import VALIDATION_CLIPS
from physion.trials.making.plan import FULL_COUNTS
from study_schedule import Task, schedule
from study_times import MODELS, ModelTimes, make_trials, measure_model, measure_readout

RESULTS = Path(__file__).parents[1] / "results"
FASTER = (20, 50, 100, 200)
"""How many times as fast as one core a GPU may be, where no GPU was measured."""
READERS = 8
"""Threads that read for a training, at most, as in `physion.training.loop`."""
CHUNK = 50
"""Trials of a task that makes trials."""
SPLITS = ("training", "readout", "testing")
TRAINED = FULL_COUNTS["training"]
TESTED = FULL_COUNTS["readout"] + FULL_COUNTS["testing"]
TRIALS, ENCODERS, TRAININGS, EVALUATIONS, READOUTS = (
    "trials", "features of frozen encoders", "trainings", "features and rollouts", "readouts",
)  # fmt: skip
CORE = "cpu"
"""Name of the times that were measured on one core."""


@dataclass(frozen=True)
class Machine:
    """Cores, GPUs, and how many times as fast as the measured device a GPU is."""

    cores: int
    gpus: int = 0
    faster: float = 1.0

    @property
    def readers(self) -> int:
        """Cores that read for a GPU."""
        return max(1, min(READERS, self.cores // self.gpus - 1))

    def task(
        self, name: str, stage: str, compute: float, read: float, after: Iterable[str], ahead: bool
    ) -> Task:
        """Return the task of a network: seconds of computing and of reading, on one core each."""
        if not self.gpus:
            return Task(name, stage, compute + read, after=tuple(after))
        compute /= self.faster
        seconds = max(compute, read / self.readers) if ahead else compute + read
        return Task(name, stage, seconds, self.readers, 1, tuple(after))


@dataclass(frozen=True)
class Study:
    """Measured times: of models, of a readout, and of the trials of each scenario and split."""

    models: Sequence[ModelTimes]
    readout: Mapping[str, float]
    generation: Mapping[str, Mapping[str, Mapping[str, float]]]

    def training(self, model: ModelTimes, scenarios: int) -> tuple[float, float]:
        """Return the seconds of a training on so many scenarios: computing, reading."""
        trials = TRAINED * scenarios
        held_out = min(VALIDATION_CLIPS, trials // 10)
        validated = math.ceil(model.steps / model.validate_every) * held_out
        clips = model.steps * model.batch
        compute = clips * model.step + validated * model.validate
        compute += min(model.calibration_trials, trials) * model.imagine
        return compute, (clips + validated) * model.read_window_new

    def tasks(self, machine: Machine) -> Iterator[Task]:
        """Yield all tasks of the study."""
        names = {}
        for scenario, splits in self.generation.items():
            for split in SPLITS:
                seconds = splits[split]["choose_s"] + splits[split]["make_s"]
                starts = range(0, FULL_COUNTS[split], CHUNK)
                names[scenario, split] = [f"{scenario} {split} {start}" for start in starts]
                yield from (Task(n, TRIALS, CHUNK * seconds) for n in names[scenario, split])
        for encoder, model in {m.encoder: m for m in self.models if m.encoder}.items():
            whole = model.encode_whole, model.read_whole
            both = model.encode_context + whole[0], model.read_context + whole[1]
            for scenario in self.generation:
                for splits, (compute, read), trials in (
                    (("training",), whole, TRAINED),
                    (("readout", "testing"), both, TESTED),
                ):
                    name = f"{encoder} {scenario} {splits[0]}"
                    after = [task for split in splits for task in names[scenario, split]]
                    yield machine.task(
                        name, ENCODERS, trials * compute, trials * read, after, False
                    )
        for chosen in all_sets(tuple(self.generation)):
            for model in self.models:
                yield from self._model_tasks(model, chosen, machine, names)

    def _model_tasks(
        self,
        model: ModelTimes,
        chosen: TrainingSet,
        machine: Machine,
        names: Mapping[tuple[str, str], Sequence[str]],
    ) -> Iterator[Task]:
        """Yield a training, and the evaluations of its scenarios."""
        training = f"{model.name} {chosen.name}"
        if model.encoder:
            after = [f"{model.encoder} {scenario} training" for scenario in chosen.trained]
        else:
            after = [name for scenario in chosen.trained for name in names[scenario, "training"]]
        compute, read = self.training(model, len(chosen.trained))
        yield machine.task(training, TRAININGS, compute, read, after, True)
        for scenario in chosen.tested:
            compute, read = model.imagine, model.read_context
            if model.encoder:
                made = [f"{model.encoder} {scenario} readout"]
            else:
                made = [*names[scenario, "readout"], *names[scenario, "testing"]]
                compute += model.encode_context + model.encode_whole
                read += model.read_context * (model.learns_from == "clips") + model.read_whole
            name = f"{training} on {scenario}"
            yield machine.task(
                name, EVALUATIONS, TESTED * compute, TESTED * read, [training, *made], False
            )
            if model.feature_size:  # observed, observed and simulated, full
                features = model.feature_size * (model.context + 2 * model.whole)
                seconds = 3 * self.readout["any"] + features * self.readout["feature"]
                yield Task(f"readouts of {name}", READOUTS, seconds, after=(name,))


def all_sets(scenarios: Sequence[str]) -> list[TrainingSet]:
    """Return the 17 sets of training trials."""
    return [chosen for protocol in Protocol for chosen in training_sets(protocol, scenarios)]


def plan(study: Study, machine: Machine, prices: tuple[float, float]) -> dict[str, Any]:
    """Return length, cost and stages of the schedule of a study on a machine, in hours."""
    tasks = list(study.tasks(machine))
    length = max(schedule(tasks, machine.cores, machine.gpus).values()) / 3600
    stages: dict[str, dict[str, float]] = {}
    for task in tasks:
        row = stages.setdefault(
            task.stage, {"tasks": 0, "core_hours": 0.0, "gpu_hours": 0.0, "longest": 0.0}
        )
        held = task.seconds / 3600
        row["tasks"] += 1
        row["core_hours"] += held * task.cores
        row["gpu_hours"] += held * task.devices
        row["longest"] = max(row["longest"], held)
    slow = set()
    if machine.gpus:
        for model, chosen in itertools.product(study.models, all_sets(tuple(study.generation))):
            compute, read = study.training(model, len(chosen.trained))
            if read / machine.readers > compute / machine.faster:
                slow.add(model.name)
    return {
        **dataclasses.asdict(machine),
        "hours": length,
        "cost": length * (machine.cores * prices[0] + machine.gpus * prices[1]),
        "waits_for_reading": sorted(slow),
        "stages": stages,
    }


def models_table(study: Study) -> str:
    """Return steps, seconds of a step and hours of all trainings and evaluations by model."""
    rows = []
    sets = all_sets(tuple(study.generation))
    for model in study.models:
        sums = [sum(study.training(model, len(s.trained))) / 3600 for s in sets]
        own = Study([model], study.readout, study.generation).tasks(Machine(1))
        rest = sum(t.seconds for t in own if t.stage in (ENCODERS, EVALUATIONS, READOUTS)) / 3600
        rows.append([
            model.name, f"{model.steps:,}", str(model.batch), str(model.measured_batch),
            f"{model.batch * model.step:.3g}", f"{model.batch * model.read_window:.2g}",
            hours(max(sums)), hours(sum(sums)), hours(rest),
        ])  # fmt: skip
    head = [
        "model", "steps", "batch", "measured with", "step, s", "its reading, s",
        "longest training, h", "17 trainings, h", "features, rollouts, readouts, h",
    ]  # fmt: skip
    return markdown_table(head, rows)


def stages_table(plans: Sequence[Mapping[str, Any]], heads: Sequence[str]) -> str:
    """Return hours by stage, length and cost, one column for each plan."""
    kind = "gpu_hours" if plans[0]["gpus"] else "core_hours"
    rows = []
    for stage, first in plans[0]["stages"].items():
        on_cores = not first[kind]
        unit = "core" if on_cores or kind == "core_hours" else "GPU"
        key = "core_hours" if on_cores else kind
        cells = [hours(p["stages"][stage][key]) for p in plans]
        rows.append([f"{stage} ({first['tasks']:,} tasks), {unit} hours", *cells])
    rows.append(["longest task, hours", *(hours(longest(p)) for p in plans)])
    if plans[0]["gpus"]:
        slow = [", ".join(p["waits_for_reading"]) for p in plans]
        rows.append(["models with trainings that wait for reading", *slow])
    rows.append(["**length of the schedule, hours**", *(f"**{p['hours']:,.0f}**" for p in plans)])
    rows.append(["the same in days", *(f"{p['hours'] / 24:,.0f}" for p in plans)])
    rows.append(["cost", *(f"{p['cost']:,.0f}" for p in plans)])
    return markdown_table(["", *heads], rows)


def hours(value: float) -> str:
    """Return hours with two digits at least."""
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"


def longest(found: Mapping[str, Any]) -> float:
    """Return the hours of the longest task of a plan."""
    return max(float(row["longest"]) for row in found["stages"].values())


def report(kept: dict[str, Any], options: argparse.Namespace) -> str:
    """Return all tables as Markdown, and put the plans into ``kept``."""
    prices = options.core_price, options.gpu_price
    generation = json.loads((RESULTS / "generation.json").read_text())
    parts = [
        "# What the whole study takes",
        f"25,200 trials, {len(MODELS)} models of the size `paper`, 17 trainings each, one seed, on "
        f"{options.cores} cores and {options.gpus} GPUs. Nothing of it was run: times of single "
        "steps and trials were measured and multiplied. Prices are assumptions: "
        f"{prices[0]:g} for a core and {prices[1]:g} for a GPU an hour.",
        f"Trials: `{generation['command']}`, {generation['date']}.",
    ]
    kept["plans"] = {}
    for name, measured in kept["measured"].items():
        times = [ModelTimes(**measured["models"][m]) for m in MODELS if m in measured["models"]]
        study = Study(times, measured["readout"], generation["scenarios"])
        parts += [f"## Times, {measured['device']}", facts(measured), models_table(study)]
        if name == CORE:
            machines = [Machine(options.cores)]
            heads = [f"{options.cores} cores, no GPU"]
            title = "Everything on cores, one core a training"
        else:
            machines, heads = [Machine(options.cores, options.gpus)], [f"{options.gpus} x {name}"]
            title = f"{options.cores} cores and {options.gpus} GPUs, measured"
        kept["plans"][name] = [plan(study, machine, prices) for machine in machines]
        parts += [f"## {title}", stages_table(kept["plans"][name], heads)]
        if name == CORE and len(kept["measured"]) == 1:
            machines = [Machine(options.cores, options.gpus, faster) for faster in FASTER]
            kept["plans"]["assumed"] = [plan(study, machine, prices) for machine in machines]
            parts += [
                f"## {options.cores} cores and {options.gpus} GPUs, **assumed** speed of a GPU",
                "No GPU was measured. The columns assume that a GPU computes so many times as fast "
                "as the measured core. Reading is as measured, "
                f"{machines[0].readers} cores for each GPU.",
                stages_table(kept["plans"]["assumed"], [f"{faster} times" for faster in FASTER]),
            ]
    return "\n\n".join(parts) + "\n"


def facts(measured: Mapping[str, Any]) -> str:
    """Return when and how times were measured."""
    return (
        f"{measured['date']}, `{measured['command']}`, torch {measured['torch']}, one thread, load "
        f"{measured['load']}, physion {measured['package']}. Hours are those of this device, with "
        "the reading. A step is one of the batch of the settings, and its time that of the batch "
        "that was measured, times their ratio; its reading is that of one core. GNS and GNS-RANSAC "
        "are trained alike: the difference of their steps is the error of these measurements. The "
        "features of a frozen encoder are computed once, and stand in the rows of both its models."
    )


def measure(kept: dict[str, Any], names: Sequence[str]) -> None:
    """Measure some models, and put their times into ``kept``."""
    torch.set_num_threads(1)
    gpu = torch.cuda.is_available()
    name = torch.cuda.get_device_name() if gpu else CORE
    measured = kept.setdefault("measured", {}).setdefault(name, {"models": {}})
    measured |= {
        "device": name if gpu else f"one core, {processor()}",
        "date": date.today().isoformat(),
        "command": " ".join(["OMP_NUM_THREADS=1 python", *sys.argv]),
        "torch": torch.__version__,
        "package": physion.__version__,
        "load": round(os.getloadavg()[0], 1),
    }
    measured["readout"] = measure_readout()
    print("readout", measured["readout"], flush=True)
    with tempfile.TemporaryDirectory() as folder:
        dataset = make_trials(Path(folder) / "trials")
        for model in names:
            times = dataclasses.asdict(measure_model(model, dataset))
            measured["models"][model] = times
            print({key: v for key, v in times.items() if v}, flush=True)


def main() -> None:
    """Measure, plan, print, and write if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cores", type=int, default=64)
    parser.add_argument("--gpus", type=int, default=8)
    parser.add_argument("--core-price", type=float, default=0.04, help="of an hour")
    parser.add_argument("--gpu-price", type=float, default=2.5, help="of an hour")
    parser.add_argument(
        "--models", nargs="*", default=MODELS, choices=MODELS,
        help="measure these; without names, none: use the times that are kept",
    )  # fmt: skip
    parser.add_argument("--write", action="store_true", help="keep times and plans in results/")
    options = parser.parse_args()
    path = RESULTS / "study_plan.json"
    kept = json.loads(path.read_text()) if path.is_file() else {}
    if options.models:
        measure(kept, options.models)
        if options.write:
            path.write_text(json.dumps(kept, indent=1) + "\n")
    text = report(kept, options)
    print(text)
    if options.write:
        path.write_text(json.dumps(kept, indent=1) + "\n")
        (RESULTS / "study_plan.md").write_text(text)


if __name__ == "__main__":
    main()
