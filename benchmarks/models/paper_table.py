"""The paper's models, trained here under its protocols, and its claims tested on them.

    export OMP_NUM_THREADS=1
    python benchmarks/models/paper_table.py FOLDER --plan            # what it would do, with times
    python benchmarks/models/paper_table.py FOLDER --write           # everything, for days
    python benchmarks/models/paper_table.py FOLDER --scale medium --models cswm dpi --write
    python benchmarks/models/paper_page.py --write                   # the page of what is stored

The first command is resumed by the same command:

1. Sets in FOLDER: ``fit`` with training trials, which hold no labels, and readout trials; ``own``
   and ``official``, which are tested: sampled trials, and the packaged scenes that people saw.
   They have movies of 64 px, since a training from pictures reads each trial many times. With
   --rendered they hold motions only, and pictures are rendered whenever they are read.
2. Trainings of each model under *all* (with several seeds), *all-but* and *only* (eight each), and
   the three readouts on both tested sets.
3. *one* for C-SWM, RPIN and DPI-Net: each model of *only* tested on every scenario of the official
   stimuli, with the readout *observed+simulated*.

With --write the predictions and held-out losses of every finished part, a model under a protocol,
are stored in ``results/paper``, from which `paper_page` makes claims, figures and matrices next to
the published ones. So parts can be computed at different times, and on different machines: the same
seeds make the same trials.

The plan is printed before. Its times come from few trials and steps, measured once and kept in
FOLDER/speed.json. The processor time of every part, also of interrupted runs, is added up in
FOLDER/seconds.json. --trials, --readout, --tested, --official and --steps change a scale; larger
numbers only add trials.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

import physion
from paper_claims import GENERALISED, IMAGENET, NAMES, TESTED
from paper_page import PROTOCOLS, Stored, trainings
from physion import Dataset
from physion.analysis.published.tables import PARTICLES
from physion.cli.output import text_table
from physion.compute.local import SerialExecutor
from physion.compute.tasks import processor
from physion.core.files import write_atomic
from physion.core.names import SCENARIOS
from physion.data.official import PACKAGED, humans_folder
from physion.models.build import build_untrained
from physion.pipeline import plan_official
from physion.readout.evaluation import Evaluation
from physion.readout.tables import read_table
from physion.readout.train import Trainings
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, TrialTask
from ship_readouts import without_motions

MODELS = tuple(name for name in NAMES if name != "gns-ransac")
FIT, OUT, SPEED = "fit", "models", "speed"
PIXELS = 64
"""Side of the movies, as of the pictures that most models see."""
VALIDATIONS = 12
"""Validations of a training."""


@dataclass(frozen=True)
class Scale:
    """How much is computed.

    - ``trials``, ``readout``, ``tested``: training, readout and tested own trials a scenario.
    - ``official``: official stimuli a scenario, balanced by outcome; 0: all.
    - ``steps``: fraction of the steps that each model has by default.
    - ``seeds``: seeds of *all*; the other protocols have one.
    """

    trials: int
    readout: int
    tested: int
    official: int
    steps: float
    seeds: int


SCALES = {
    "full": Scale(1000, 1000, 150, 0, 0.25, 3),
    "medium": Scale(200, 120, 40, 60, 0.12, 1),
    "small": Scale(60, 100, 30, 30, 0.1, 1),
    "tiny": Scale(2, 4, 2, 2, 0.001, 1),
}


@dataclass(frozen=True)
class Part:
    """A model under a protocol, with all its seeds, in a folder.

    ``rendered``: whether the sets have no movies.
    """

    folder: Path
    model: str
    protocol: str
    scale: Scale
    rendered: bool = False

    @property
    def name(self) -> str:
        """Name in the plan and in the times."""
        return f"{self.model}, {self.protocol}"

    @property
    def steps(self) -> int:
        """Steps of a training."""
        own = build_untrained(self.model).training_settings.steps  # type: ignore[attr-defined]
        return max(2, round(own * self.scale.steps))

    @property
    def tested(self) -> tuple[str, ...]:
        """Sets that are tested: under *one* only what people saw, for the matrices."""
        return TESTED[:1] if self.protocol == "one" else TESTED

    @property
    def seeds(self) -> int:
        """Number of seeds."""
        return self.scale.seeds if self.protocol == "all" else 1

    @property
    def fitted(self) -> int:
        """Number of trials a scenario that fit a decision: none of particle models."""
        return 0 if NAMES[self.model] in PARTICLES else self.scale.readout

    def options(self, steps: int = 0) -> dict[str, dict[str, Any]]:
        """Return the model with its options: random weights, steps, and how often it validates."""
        steps = steps or self.steps
        own: dict[str, Any] = {"steps": steps, "validate_every": max(1, steps // VALIDATIONS)}
        return {self.model: own if self.model in IMAGENET else {"weights": "random", **own}}

    def shared(self) -> dict[str, Any]:
        """Return the settings that training and evaluation have in common.

        Encoders see rendered pictures of their own size; their features are computed once.
        """
        return {"protocols": (self.protocol,), "seeds": self.seeds, "accelerator": "cpu",
                "rendered": self.rendered or self.model in IMAGENET}  # fmt: skip

    def fit_set(self) -> Dataset:
        """Return the set that models are trained and readouts are fitted on."""
        return without_motions(
            Dataset(self.folder / FIT), *(Dataset(self.folder / t) for t in TESTED)
        )

    def train(self, *, dry_run: bool = False, steps: int = 0) -> Trainings:
        """Train what is missing."""
        return physion.train(
            self.options(steps), self.fit_set(), self.folder / OUT, dry_run=dry_run,
            **self.shared(),
        )  # fmt: skip

    def evaluate(self, tested: str, *, dry_run: bool = False, steps: int = 0) -> Evaluation:
        """Evaluate on a set what was trained."""
        readouts = ("observed+simulated",) if self.protocol == "one" else ()
        return physion.evaluate(
            self.options(steps), self.folder / tested, self.folder / OUT, fit=self.fit_set(),
            readouts=readouts, dry_run=dry_run, **self.shared(),
        )  # fmt: skip

    def stored(self) -> Stored | None:
        """Return what is stored of this part, or None if it is not finished."""
        planned = self.train(dry_run=True).planned
        if not all(one.done for one in planned):
            return None
        tables = []
        for tested in self.tested:
            evaluated = self.evaluate(tested, dry_run=True).evaluated
            if not all(one.done for one in evaluated):
                return None
            tables += [read_table(one.path).assign(tested=tested) for one in evaluated]
        predictions = pd.concat(tables, ignore_index=True).assign(model=NAMES[self.model])
        return Stored(
            self.model, self.protocol, dataclasses.asdict(self.scale), self.steps, self.rendered,
            [held_out(one.folder) for one in planned], f"{datetime.date.today()}, {processor()}",
            predictions,
        )  # fmt: skip


def held_out(folder: Path) -> tuple[float, float]:
    """Return the held-out loss of a training after two thirds of its steps, and at the end."""
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    found = [(row["step"], row["validation/loss"]) for row in map(json.loads, lines)
             if "validation/loss" in row]  # fmt: skip
    last_step, last = found[-1]
    before = [loss for step, loss in found if step <= 2 * last_step / 3] or [found[0][1]]
    return before[-1], last


def official_tasks(limit: int, scenarios: Sequence[str]) -> list[TrialTask]:
    """Return the tasks of the packaged scenes that people saw, ``limit`` a scenario (0: all)."""
    packaged = Path(PACKAGED)
    plan = plan_official(packaged, humans_folder(packaged), limit)
    return [t for t in plan.tasks if t.split == "testing" and t.scenario in scenarios]


def make_sets(folder: Path, scale: Scale, scenarios: Sequence[str], *, rendered: bool) -> int:
    """Make what is missing of the three sets; return the number of trials.

    ``rendered``: without movies.
    """
    here, size = SerialExecutor(), {} if rendered else {"width": PIXELS, "height": PIXELS}
    pixels: dict[str, Any] = {"jitters": 0, "movies": not rendered, **size}
    counts = {"training": scale.trials, "readout": scale.readout}
    fit = GenerateSettings(labels=False, observed_contact=True, **pixels)
    physion.generate(folder / FIT, scenarios, counts, name="paper", settings=fit, executor=here)
    own = GenerateSettings(look="redyellow", observed_contact=True, **pixels)
    physion.generate(
        folder / "own", scenarios, {"testing": scale.tested}, name="paper", settings=own,
        executor=here,
    )  # fmt: skip
    tasks = official_tasks(scale.official, scenarios)
    seen = GenerateSettings(look="redyellow", min_visible=0.0, **pixels)
    make_trials(folder / "official", tasks, seen, executor=here)
    return sum(counts.values(), scale.tested) * len(scenarios) + len(tasks)


@contextmanager
def timed(folder: Path, part: str) -> Iterator[None]:
    """Add the processor time of a part to FOLDER/seconds.json, also if it is interrupted."""
    path, start = folder / "seconds.json", time.process_time()
    try:
        yield
    finally:
        seconds = json.loads(path.read_text()) if path.is_file() else {}
        seconds[part] = seconds.get(part, 0.0) + time.process_time() - start
        write_atomic(path, json.dumps(seconds, indent=1).encode())


def measure(folder: Path, parts: Sequence[Part]) -> dict[str, float]:
    """Return seconds of making a trial, and of a step and of a tested trial by model.

    They are measured on `SCALES` *tiny* where FOLDER/speed.json does not hold them.
    """
    path, scale = folder / "speed.json", SCALES["tiny"]
    known: dict[str, float] = json.loads(path.read_text()) if path.is_file() else {}
    of_model = {part.model: part for part in parts}
    missing = [name for name in of_model if f"{name}: trial" not in known]
    if "trial" not in known or missing:
        start = time.process_time()
        rendered = any(part.rendered for part in parts)
        trials = make_sets(folder / SPEED, scale, SCENARIOS, rendered=rendered)
        known.setdefault("trial", (time.process_time() - start) / trials)
    for name in missing:
        part = dataclasses.replace(
            of_model[name], folder=folder / SPEED, protocol="all", scale=scale
        )
        part.train(steps=2)  # which loads everything
        ends = []
        for steps in (4, 24):
            ends.append(time.process_time())
            part.train(steps=steps)
        ends.append(time.process_time())
        known[f"{name}: step"] = max(0.0, ends[2] - 2 * ends[1] + ends[0]) / 20
        part.evaluate("official", steps=4)
        encoded = (part.fitted + scale.official) * len(SCENARIOS)
        known[f"{name}: trial"] = (time.process_time() - ends[2]) / encoded
        write_atomic(path, json.dumps(known, indent=1).encode())
    return known


def plan(folder: Path, parts: Sequence[Part], scale: Scale, scenarios: Sequence[str]) -> str:
    """Return the table of all parts with their times.

    Evaluations under *one* encode no whole movie, so that theirs are upper bounds.
    """
    speed = measure(folder, parts)
    spent = folder / "seconds.json"
    used = json.loads(spent.read_text()) if spent.is_file() else {}
    count = len(scenarios)
    stimuli = len(official_tasks(scale.official, scenarios))
    made = (scale.trials + scale.readout + scale.tested) * count + stimuli
    rows = [("sets", 0, 0, 0.0, made, made * speed["trial"])]
    for part in parts:
        trained = {"all": part.seeds, "one": 0}.get(part.protocol, count)
        seen = part.seeds * ((part.fitted + scale.tested) * count + stimuli)
        if part.protocol == "one":
            seen = count * (part.fitted * count + stimuli)
        training = trained * part.steps * speed[f"{part.model}: step"]
        rows.append((part.name, trained, part.steps, training, seen,
                     seen * speed[f"{part.model}: trial"]))  # fmt: skip
    columns = ["part", "trainings", "steps", "training_s", "trials", "trials_s"]
    table = pd.DataFrame(rows, columns=columns)
    table["used_s"] = [used.get(name, 0.0) for name in table["part"]]
    hours = (table["training_s"] + table["trials_s"]).sum() / 3600
    title = (
        f"Plan: {table['trainings'].sum()} trainings, about {hours:.1f} hours of processor time in "
        f"all; used_s was used so far"
    )
    return text_table(table.round(0).astype(dict.fromkeys(columns[1:], int)), title)


def main(arguments: Sequence[str] | None = None) -> None:
    """Do all parts, and store them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scale", choices=SCALES, default="full")
    for field in dataclasses.fields(Scale):
        parser.add_argument(f"--{field.name}", type=float if field.name == "steps" else int)
    parser.add_argument("--models", nargs="+", choices=NAMES, default=MODELS)
    parser.add_argument("--protocols", nargs="+", choices=PROTOCOLS, default=PROTOCOLS)
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, default=SCENARIOS)
    parser.add_argument("--rendered", action="store_true", help="make no movies")
    parser.add_argument("--plan", action="store_true", help="print the plan only")
    parser.add_argument("--write", action="store_true")
    chosen = parser.parse_args(arguments)
    given = {f.name: getattr(chosen, f.name) for f in dataclasses.fields(Scale)}
    changed = {name: value for name, value in given.items() if value is not None}
    scale = dataclasses.replace(SCALES[chosen.scale], **changed)
    folder = chosen.folder
    folder.mkdir(parents=True, exist_ok=True)
    parts = [
        Part(folder, model, protocol, scale, chosen.rendered)
        for protocol in chosen.protocols
        for model in chosen.models
        if protocol != "one" or model in GENERALISED
    ]
    print(plan(folder, parts, scale, chosen.scenarios), flush=True)
    if chosen.plan:
        return
    with timed(folder, "sets"):
        make_sets(folder, scale, chosen.scenarios, rendered=chosen.rendered)
    finished = []
    for part in parts:
        print(f"{time.strftime('%H:%M:%S')} {part.name}", flush=True)
        with timed(folder, part.name):
            failed = {**part.train().failed}
            for tested in part.tested:
                failed |= part.evaluate(tested).failed
        for label, reason in failed.items():
            print(f"failed: {label}: {reason}", flush=True)
        stored = part.stored()
        if stored is not None:
            finished.append(stored)
            if chosen.write:
                stored.write()
    print(text_table(trainings(finished), "Finished parts"))


if __name__ == "__main__":
    main()
