"""Train models of intuition on own trials in memory, and compare them with forests.

    OMP_NUM_THREADS=1 python benchmarks/models/intuition_trials.py FOLDER --trials 1000 --official
    OMP_NUM_THREADS=1 python benchmarks/models/train_intuition.py FOLDER [--write]

The trainer is the one of `physion train`; the same command resumes. The last tenth of the own
trials of every scenario trains nothing: on them, and on the official stimuli without a contact in
the observed part, models are tested, also each of their networks alone, and compared with forests
that saw the same training trials, where their features are stored. With --start a training begins
from other weights; with --steps 0, too, nothing is trained, and these weights are tested on all own
trials. Predictions of official stimuli go to FOLDER/predictions, where
``intuition.py --predictions`` reads them, weights to FOLDER/training. --weights names a folder for
the weights of all scenarios as float16.
Other trainings answer what a network has to have seen: --counts, the first trials of each scenario
only; --unseen, without the configuration of the tested trial and those that differ from it in room
and scenery only (`FOLDS` trainings, each without a part of these kinds); --all-but, without its
scenario. With --write the section of each model in ``results/intuition_networks.md`` is replaced,
with these trainings a section of ``results/MODEL_unseen.md``, of one model at a time.
"""

from __future__ import annotations

import argparse
import datetime
import json
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from intuition_controls import slope
from intuition_trials import kinds, load, names_stored
from physion.clips.batch import Batch, Spec
from physion.compute.tasks import processor
from physion.core.files import digest_of
from physion.models.build import build_untrained
from physion.models.checkpoint import BUILT_AS, tensors_of, write_checkpoint
from physion.models.interface import ask
from physion.readout.trees import fit_forest
from physion.training.loop import CARD
from physion.training.train import train_model
from vision_models import write_section

RESULTS = Path(__file__).parents[1] / "results"
FOLDS = 5
"""Parts of the configurations of each scenario."""
SAME = {
    "intuition-states": "state-trees", "intuition-masks": "mask-trees",
    "intuition-pixels": "blob-trees",
}  # fmt: skip
"""Forests that see as much as a network."""
TOGETHER = 64
"""Trials that are predicted at a time."""


class OwnSource:
    """Source of the context of trials whose features `intuition_trials.load` read."""

    def __init__(self, spec: Spec, made: Mapping[str, NDArray[Any]]) -> None:
        self.spec, self._made = spec, made
        self.rows = {str(trial): row for row, trial in enumerate(made["trial"])}

    def length(self, trial: str) -> int:
        """Return the observed frames, which are all."""
        return 45

    def key(self, trial: str, part: str) -> str:
        """Return a digest of the trial's scene."""
        return digest_of(str(self._made["scene"][self.rows[trial]]))

    def context(self, trials: Sequence[str]) -> Batch:
        """Return which frames are observed."""
        frames = np.tile(np.array(self.spec.context_frames()), (len(trials), 1))
        return Batch(tuple(trials), frames, np.ones(frames.shape, np.bool_))


class Learner:
    """One model, its own trials (training and held out), and the official stimuli."""

    def __init__(self, name: str, folder: Path, options: argparse.Namespace) -> None:
        self.name, self.folder, self.options = name, folder, options
        self.alone: list[dict[str, NDArray[np.float64]]] = []
        """Answers of every network of the model that was trained last."""
        read = [n for n in (name, SAME[name]) if n in names_stored(folder / "own")]
        self.own, self.asked = load(folder / "own", read), load(folder / "official", read)
        keep = ~self.asked["observed_contact"]
        keep &= np.isin(self.asked["scenario"], np.unique(self.own["scenario"]))
        self.asked = {key: values[keep] for key, values in self.asked.items()}
        self.held = np.zeros(len(self.own["trial"]), np.bool_)
        self.number = np.zeros(len(self.held), np.int64)
        for scenario in np.unique(self.own["scenario"]):
            rows = np.flatnonzero(self.own["scenario"] == scenario)
            self.held[rows[-max(len(rows) // 10, 1) :]] = True
            if options.steps == 0:
                self.held[rows] = True
            self.number[rows] = np.arange(len(rows))

    def train(
        self, name: str = "all", chosen: NDArray[np.bool_] | None = None
    ) -> dict[str, NDArray[np.float64]]:
        """Return P(contact) of held-out and official trials, of a network trained on some trials.

        Without ``chosen`` (of all own trials) these are all that are not held out.
        """
        model: Any = build_untrained(self.name, **self._options())
        if self.options.start:
            weights = str(self.options.start / f"{self.name}-small.safetensors")
            other: Any = build_untrained(self.name, **self._options(), weights=weights)
            model.load_state_dict(other.state_dict())
            model.trained, model.init = True, other.init
        self.title = model.name
        fit = ~self.held if chosen is None else ~self.held & chosen
        trials = [str(trial) for trial in self.own["trial"][fit]]
        source = OwnSource(model.spec, self.own)
        outcomes = dict(zip(trials, self.own["contact"][fit].tolist(), strict=True))
        if self.options.steps == 0:
            return self._answers(model)
        settings = ask(model, "training_settings")
        changed = {
            "steps": self.options.steps, "batch": self.options.batch,
            "learning_rate": self.options.learning_rate,
        }  # fmt: skip
        settings = replace(settings, **{name: value for name, value in changed.items() if value})

        def features(names: Sequence[str]) -> Any:
            return [self.own[self.name][source.rows[name]] for name in names]

        start = time.process_time()
        source_of_trials: Any = source
        done = train_model(
            model, source_of_trials, trials, seed=0, accelerator=self.options.accelerator,
            name=name, folder=self.folder / "training",
            settings=settings, features=features, outcomes=outcomes, progress=_say,
        )  # fmt: skip
        if self.options.weights and chosen is None:
            halves = {
                k: v.half() if v.is_floating_point() else v for k, v in tensors_of(model).items()
            }
            about = {BUILT_AS: model.built_as(), "provenance": asdict(model.provenance())}
            path = self.options.weights / f"{model.name}.safetensors"
            write_checkpoint(path, halves, about, kept=True)
            card = (done.folder / CARD).read_text().split("## Use")[0]
            card += f"## Hardware\n{device()}\n\nThe weights are rounded to float16.\n"
            path.with_suffix(".md").write_text(card)
        print(
            f"{self.name} {name}: held-out loss {done.validation:.3f}, base rate "
            f"{done.baseline:.3f}, {time.process_time() - start:.0f} s, {done.folder}", flush=True,
        )  # fmt: skip
        return self._answers(model)

    def _answers(self, model: Any) -> dict[str, NDArray[np.float64]]:
        every = np.full(len(self.asked["trial"]), True)
        own = self._predict(model, self.own, self.held)
        official = self._predict(model, self.asked, every)
        self.alone = [{"own": a, "official": b} for a, b in zip(own, official, strict=True)]
        return {"own": own.mean(0), "official": official.mean(0)}

    def train_apart(
        self, name: str, own: NDArray[Any], asked: NDArray[Any]
    ) -> dict[str, NDArray[np.float64]]:
        """Return P(contact) of networks that have not seen the group of the trial.

        ``own`` and ``asked`` are the groups of own trials and official stimuli.
        """
        held = own[self.held]
        answers = {"own": np.full(len(held), np.nan), "official": np.full(len(asked), np.nan)}
        for group in np.unique(own):
            found = self.train(f"{name}_{group}", own != group)
            for part, groups in (("own", held), ("official", asked)):
                answers[part][groups == group] = found[part][groups == group]
        if np.isnan(answers["official"]).any():
            raise SystemExit("some official stimuli are of a group without own trials; make more")
        return answers

    def configurations(self) -> list[NDArray[np.int64]]:
        """Return the number of the fold of own trials and of official stimuli."""
        folds: dict[tuple[str, str], int] = {}
        both = [self.own, self.asked]
        names = {pair for made in both for pair in _configurations(made)}
        for scenario in {scenario for scenario, _ in names}:
            inside = sorted(pair for pair in names if pair[0] == scenario)
            folds |= {pair: number % FOLDS for number, pair in enumerate(inside)}
        return [np.array([folds[pair] for pair in _configurations(made)]) for made in both]

    def forests(self) -> dict[str, NDArray[np.float64]]:
        """Return P(contact) of forests of each scenario, fitted on the same trials, if possible."""
        name = SAME[self.name]
        if name not in self.own or self.options.steps == 0:
            return {}
        counts = {"own": int(self.held.sum()), "official": len(self.asked["trial"])}
        found = {part: np.full(count, np.nan) for part, count in counts.items()}

        def answer(scenario: str) -> None:
            inside = self.own["scenario"] == scenario
            fit, rest = inside & ~self.held, self.own["scenario"][self.held] == scenario
            forest = fit_forest(_flat(self.own[name][fit]), self.own["contact"][fit])
            found["own"][rest] = forest.probability(_flat(self.own[name][inside & self.held]))
            there = self.asked["scenario"] == scenario
            found["official"][there] = forest.probability(_flat(self.asked[name][there]))

        with ThreadPoolExecutor() as pool:
            list(pool.map(answer, np.unique(self.own["scenario"])))
        return found

    def rigid(self, answers: Mapping[str, NDArray[np.float64]]) -> float:
        """Return the mean accuracy over rigid scenarios on official stimuli."""
        right = by_scenario(answers["official"], self.asked["scenario"], self.asked["contact"])
        return float(right.drop("drape", errors="ignore").mean())

    def row(
        self, name: str, answers: Mapping[str, NDArray[np.float64]], trials: int | None = None
    ) -> str:
        """Return a row of the table: accuracies of own trials and official stimuli.

        ``trials`` is the number of fit trials of a scenario where these are not all.
        """
        own, asked = self.own, self.asked
        held = {key: own[key][self.held] for key in ("scenario", "contact")}
        scores = [
            by_scenario(answers["own"], held["scenario"], held["contact"]),
            by_scenario(answers["official"], asked["scenario"], asked["contact"]),
        ]
        rigid = [one.drop("drape", errors="ignore").mean() for one in scores]
        each = " | ".join(f"{value:.2f}" for value in scores[1])
        fit = trials or self.trials_per_scenario()
        return f"| {name} | {fit} | {rigid[0]:.3f} | {rigid[1]:.3f} | {each} |"

    def trials_per_scenario(self) -> int:
        """Return the mean number of training trials of a rigid scenario."""
        fit = self.own["scenario"][~self.held & (self.own["scenario"] != "drape")]
        return int(len(fit) / len(np.unique(fit)))

    def keep(self, name: str, answers: NDArray[np.float64]) -> None:
        """Write predictions of official stimuli."""
        path = self.folder / "predictions" / f"{name.replace(' ', '-')}.csv"
        path.parent.mkdir(exist_ok=True)
        table = {"model": name, "stimulus": self.asked["trial"], "p_contact": answers}
        pd.DataFrame(table).to_csv(path, index=False)

    def _options(self) -> dict[str, Any]:
        pairs = [pair.split("=") for pair in self.options.option]
        return {key: json.loads(value) if value[0].isdigit() else value for key, value in pairs}

    @torch.no_grad()
    def _predict(
        self, model: Any, made: Mapping[str, NDArray[Any]], chosen: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Return P(contact) (members, trials) of every network of a model."""
        source, found = OwnSource(model.spec, made), []
        names = [str(trial) for trial in made["trial"][chosen]]
        for start in range(0, len(names), TOGETHER):
            batch = source.context(names[start : start + TOGETHER])
            rows = [source.rows[trial] for trial in batch.trials]
            batch = replace(batch, features=made[self.name][rows])
            batch = batch.to(model.device)
            each = model.logits(batch).sigmoid().unflatten(0, (-1, 2)).mean(1)
            each = torch.where(model.seen(batch), each, model.base_rate)
            found.append(each.cpu().numpy())
        return np.concatenate(found, axis=1).astype(np.float64)


def device() -> str:
    """Return the name of the GPU, else of the processor."""
    return torch.cuda.get_device_name() if torch.cuda.is_available() else processor()


def _configurations(made: Mapping[str, NDArray[Any]]) -> list[tuple[str, str]]:
    """Return scenario and kind of configuration of trials (`intuition_trials.kinds`).

    A name with _2 at its end is a second name.
    """
    names = (str(name).removesuffix("_2") for name in made["configuration"])
    pairs = zip(made["scenario"].tolist(), names, strict=True)
    return [(scenario, kinds(scenario).get(name, name)) for scenario, name in pairs]


def _flat(values: NDArray[Any]) -> NDArray[Any]:
    return values.reshape(len(values), -1)


def _say(what: str, done: int, total: int) -> None:
    if done % 100 == 0:
        print(f"{datetime.datetime.now():%H:%M:%S} {what} {done} of {total}", flush=True)


def by_scenario(p: NDArray[Any], scenario: NDArray[Any], contact: NDArray[Any]) -> pd.Series:
    """Return the accuracy of every scenario."""
    return pd.Series((p > 0.5) == contact).groupby(scenario).mean()


def main() -> None:
    """Train, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--models", nargs="*", choices=SAME, default=list(SAME))
    parser.add_argument("--steps", type=int, help="of the training, by default the model's own")
    parser.add_argument("--batch", type=int, default=0, help="clips a step; 0: the model's own")
    parser.add_argument("--learning-rate", type=float, default=0.0, help="0: the model's own")
    parser.add_argument("--accelerator", default="auto")
    parser.add_argument("--weights", type=Path, help="folder for weights")
    parser.add_argument("--start", type=Path, help="folder of weights to start from")
    parser.add_argument("--option", nargs="*", default=[], help="NAME=VALUE of the model")
    parser.add_argument("--counts", nargs="*", type=int, default=[], help="trials of a scenario")
    parser.add_argument("--unseen", action="store_true", help="configurations")
    parser.add_argument("--all-but", action="store_true", help="scenarios")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.steps == 0 and (options.start is None or options.write):
        raise SystemExit("--steps 0 tests the weights of --start, and writes no page")
    if options.start and (options.unseen or options.all_but):
        raise SystemExit(
            "weights of --start may have seen all: leave it out for --unseen, --all-but"
        )
    other = options.counts or options.unseen or options.all_but
    if other and len(options.models) > 1:
        raise SystemExit("--counts, --unseen and --all-but need one of --models")
    for name in options.models:
        learner = Learner(name, options.folder, options)
        title, text = section(learner)
        if options.write:
            page = f"{name}_unseen.md" if other else "intuition_networks.md"
            write_section(RESULTS / page, title, text)


def section(learner: Learner) -> tuple[str, str]:
    """Train a model as the options say; return title and text of its section of the results."""
    name, options = learner.name, learner.options
    rows: list[str] = []

    def add(row: str) -> None:
        print(row, flush=True)
        rows.append(row)

    answers = learner.train()
    learner.keep(learner.title, answers["official"])
    add(learner.row(learner.title, answers))
    if len(learner.alone) > 1:
        for number, each in enumerate(learner.alone, start=1):
            add(learner.row(f"network {number} of it alone", each))
    if forests := learner.forests():
        learner.keep(SAME[name], forests["official"])
        add(learner.row(SAME[name], forests))
        both = {part: (answers[part] + forests[part]) / 2 for part in answers}
        add(learner.row("mean of both", both))
    own, asked = learner.own, learner.asked
    fit = pd.Series(own["scenario"][~learner.held]).value_counts()
    if max(options.counts, default=0) > fit.min():
        raise SystemExit(f"--counts: some scenario has only {fit.min()} trials for training")
    most = learner.trials_per_scenario()
    rigid = []
    for count in options.counts:
        found = learner.train(f"first_{count}", learner.number < count)
        rigid.append(learner.rigid(found))
        learner.keep(f"{name}, {count} trials", found["official"])
        add(learner.row(f"{name}, {count} trials", found, count))
    groups: dict[str, Sequence[NDArray[Any]]] = {}
    if options.unseen:
        groups["kind of configuration"] = learner.configurations()
    if options.all_but:
        groups["scenario"] = own["scenario"], asked["scenario"]
    for what, (own_groups, asked_groups) in groups.items():
        short = "no" if what == "scenario" else "fold"
        found = learner.train_apart(short, own_groups, asked_groups)
        learner.keep(f"{name}, {what} unseen", found["official"])
        add(learner.row(f"{name}, {what} unseen", found))
    scenarios = [str(s) for s in np.unique(own["scenario"])]
    given = " --start WEIGHTS" * bool(options.start)
    given += f" --steps {options.steps}" * (options.steps is not None)
    given += f" --counts {' '.join(map(str, options.counts))}" * bool(options.counts)
    given += " --unseen" * options.unseen + " --all-but" * options.all_but
    lines = [
        f"`python benchmarks/models/train_intuition.py FOLDER --models {name}{given} --write`, "
        f"{datetime.date.today()}, {device()}. {len(asked['trial'])} official stimuli."
        + " The training began from weights that may have seen these own trials, also those that "
        "are held out." * bool(options.start),
        "",
        "| model | trials per rigid scenario | own, rigid | official, rigid "
        f"| {' | '.join(scenarios)} |",
        "|---|---|---|---" + "|---" * len(scenarios) + "|",
        *rows,
    ]
    if options.counts:
        rise = slope([*options.counts, most], [*rigid, learner.rigid(answers)])
        lines += ["", f"Each doubling of the trials adds, rigid: {rise:+.3f}."]
    title = f"{most} trials per rigid scenario" if groups or rigid else name
    return title, "\n".join(lines)


if __name__ == "__main__":
    main()
