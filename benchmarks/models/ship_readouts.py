"""Fit the readouts that ship, and evaluate them on the official stimuli that people saw.

    OMP_NUM_THREADS=1 python benchmarks/models/ship_readouts.py FOLDER --trials 1000 --full 1000
    OMP_NUM_THREADS=1 python benchmarks/models/ship_readouts.py FOLDER --official --write

Four steps, each resumed by the same command:

1. Motions without movies: readout trials of the published configurations, as in the paper, red and
   yellow, also with contacts in the observed part; and the official stimuli, whose motions none of
   the readout trials may have.
2. Features of every model, from pictures rendered on demand. A picture is drawn once for all models
   that see it at that size.
3. Readouts of every model, kind and scenario, with their accuracy by cross-validation, written to
   the package with a card. Scenarios with fewer than 100 trials that are finished are left out, and
   the card says how many trials were fitted.
4. With --official, their accuracy on the official stimuli, with the recorded outcomes; with --write
   it is written to ``results/readouts.md``.

--only names models. Without --trials motions and features are not made, only read.
"""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
from numpy.typing import NDArray

import physion
from physion import Dataset
from physion.analysis.statistics.paired import mcnemar_exact
from physion.analysis.tables import POOLED
from physion.clips.batch import Spec
from physion.clips.rendered import MotionRenderer
from physion.clips.source import ObservedSource, TrialReaders, WholeSource
from physion.clips.states import TrialMotions
from physion.compute.local import SerialExecutor
from physion.compute.tasks import processor
from physion.core.names import canonical_name
from physion.data.official import official
from physion.models.build import build_model
from physion.models.interface import ask
from physion.readout.decisions import Readout
from physion.readout.evaluate import evaluate
from physion.readout.features import FeatureStore, StoredFeatures
from physion.readout.folds import describe_fit
from physion.readout.logistic import JoinedFeatures, LogisticSettings, fit_weights
from physion.readout.shipped import ShippedReadout, write_readouts
from physion.readout.trees import Forest, cross_validate, fit_forest
from physion.report.compare import compare
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_scenes

SHIPPED = Path(__file__).parents[2] / "src/physion/data/readouts"
RESULTS = Path(__file__).parents[1] / "results" / "readouts.md"
SET = "readout-1000"
"""Name of the set, which is the seed of its trials."""
COMMAND = (
    "physion generate FOLDER/readout-1000 --split readout --count {count} --no-movies --look "
    "redyellow --jitters 0 --option observed_contact=true --name readout-1000"
)
MODELS: Mapping[str, tuple[str, Mapping[str, Any], tuple[Readout, ...]]] = {
    "state-trees": ("state-trees", {}, (Readout.OBSERVED,)),
    "mask-trees": ("mask-trees", {}, (Readout.OBSERVED, Readout.FULL)),
    "blob-trees": ("blob-trees", {}, (Readout.OBSERVED, Readout.FULL)),
    "blob-centroids": ("blob-centroids", {}, (Readout.OBSERVED, Readout.FULL)),
    "tf_efficientnet_lite0": ("pEffNetLite0-mlp", {}, (Readout.OBSERVED, Readout.FULL)),
    "random-tf_efficientnet_lite0": (
        "pEffNetLite0-mlp", {"weights": "random"}, (Readout.OBSERVED, Readout.FULL)
    ),
    "cswm-small": ("cswm", {}, tuple(Readout)),
    "rpin-small": ("rpin", {}, tuple(Readout)),
    "svg-small": ("svg", {}, tuple(Readout)),
    "op3-small": ("op3", {}, tuple(Readout)),
}  # fmt: skip
"""By name of the file: model, options and kinds of readouts. The dynamics of pEffNetLite0 do not
ship, so that they are trained, and their readouts fitted, where it is evaluated."""


LEAST = 100
"""Smallest number of fit trials of a scenario. With 25 to 50, cross-validated accuracies of the
blobs were at chance level (2026-11-25)."""
LAST = 302
"""Frame after which readouts see nothing: of 1,629 official trials, eight have a first contact
later, of Support and Link, and weights of all 602 frames would not fit into the package."""


SETTINGS = GenerateSettings(movies=False, look="redyellow", jitters=0, observed_contact=True)
"""Of all own sets."""


def make_set(folder: Path, count: int, tested: Dataset) -> Dataset:
    """Return the set with at least ``count`` readout trials per scenario, none of them tested."""
    if count:
        physion.generate(folder / SET, "all", {"readout": count}, name=SET, settings=SETTINGS,
                         executor=SerialExecutor())  # fmt: skip
    return without_motions(Dataset(folder / SET), tested)


def without_motions(dataset: Dataset, *tested: Dataset) -> Dataset:
    """Leave out the trials of a dataset that have the motion of a tested one, and return it.

    A sampled scene can be one of the study to the byte: Dominoes has few random numbers.
    """
    known = pd.concat([other.index["digest"] for other in tested])
    dataset.index = dataset.index[~dataset.index["digest"].isin(known)]
    return dataset


def make_official(folder: Path) -> Dataset:
    """Return the official stimuli that people saw, as testing trials."""
    data, trials = official(), {}
    for trial in data.trials:
        if canonical_name(trial.scene.name) in data.labels:
            trials[trial.scene.name] = trial
    recorded = {name: trial.outcome.contact for name, trial in trials.items()}
    scenes = [trial.scene for trial in trials.values()]
    tasks = plan_scenes("official", scenes, "testing", recorded)
    settings = GenerateSettings(movies=False, look="redyellow", jitters=0, min_visible=0.0)
    make_trials(folder / "official", tasks, settings, executor=SerialExecutor())
    return Dataset(folder / "official")


# Features. Those of a picture are computed by all models before the next trial is drawn.


class Pictures:
    """Reader of rendered clips that keeps what it read last, for models with equal pictures."""

    def __init__(self, motions: TrialMotions, size: int, looks: Mapping[str, str]) -> None:
        self._motions, self._size, self._looks = motions, size, looks
        self._renderers: dict[tuple[str, int], MotionRenderer] = {}
        self._kept: dict[tuple[str, int], dict[int, NDArray[Any]]] = {}
        self._trial = ""

    def reader(self, spec: Spec) -> Any:
        """Return a reader of the inputs of a `Spec`, as `physion.clips.clips` opens it."""
        whole = MotionRenderer(
            self._motions, spec.inputs, self._size, spec.objects, self._looks
        )  # fmt: skip
        pictures = self

        class Reader:
            identity = staticmethod(whole.identity)

            @staticmethod
            def read(trial: str, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
                return {n: pictures.read(trial, frames, n, spec.objects) for n in spec.inputs}

        return Reader()

    def read(self, trial: str, frames: NDArray[Any], name: str, objects: int) -> NDArray[Any]:
        """Return one input of a clip; no frame is drawn twice for models one after the other."""
        if trial != self._trial:
            self._kept, self._trial = {}, trial
        kept = self._kept.setdefault((name, objects), {})
        missing = np.array(sorted(set(frames.tolist()) - set(kept)), np.int64)
        if len(missing):
            renderer = self._renderers.setdefault(
                (name, objects),
                MotionRenderer(self._motions, [name], self._size, objects, self._looks),
            )
            kept |= dict(zip(missing.tolist(), renderer.read(trial, missing)[name], strict=True))
        return np.stack([kept[frame] for frame in frames.tolist()])


class Features:
    """Features of a dataset by all models, computed trial by trial and stored as evaluations do."""

    def __init__(self, folder: Path, dataset: Dataset, models: Mapping[str, Any]) -> None:
        self.index = dataset.index.set_index("trial")
        self.models = models
        self.store = FeatureStore(folder / "models" / "features", batch=1)
        looks = dict(zip(dataset.index["trial"], dataset.index["look"], strict=True))
        files = dataset.files("trial_file")
        lengths = {
            kind: dict(zip(dataset.index["trial"], dataset.index[kind].astype(int), strict=True))
            for kind in ("observed_frames", "frames")
        }
        motions = {observed: TrialMotions(files, observed=observed) for observed in (True, False)}
        pictures: dict[tuple[bool, int], Pictures] = {}
        self.sources: dict[str, WholeSource] = {}
        for name, model in self.models.items():
            spec, readers = model.spec, {}
            for observed in (True, False):
                kind = "observed_frames" if observed else "frames"
                if not spec.sees_pictures:
                    readers[observed] = TrialReaders(lengths[kind], [], motions[observed])
                    continue
                key = observed, spec.image_size
                shown = pictures.setdefault(
                    key, Pictures(motions[observed], spec.image_size, looks)
                )
                readers[observed] = TrialReaders(lengths[kind], [shown.reader(spec)])
            self.sources[name] = WholeSource(ObservedSource(spec, readers[True]), readers[False])

    def steps(self, name: str, scenario: str) -> int:
        """Return how many steps a model imagines: to the end of the longest trial, or `LAST`."""
        longest = int(self.index["frames"][self.index["scenario"] == scenario].max())
        return int(self.models[name].spec.steps_after(min(longest, LAST + 1)))

    def parts(self, name: str, readout: Readout, trials: Sequence[str]) -> list[StoredFeatures]:
        """Return the features that a readout gets, computed where they are not stored."""
        model, source = self.models[name], self.sources[name]
        if readout is Readout.FULL:
            return [self.store.encoded(model, source, trials, "whole")]
        context = self.store.encoded(model, source, trials, "context")
        if readout is Readout.OBSERVED:
            return [context]
        scenarios = self.index["scenario"][list(trials)]
        (imagined,) = self.store.imagined(
            model, source, trials, samples=ask(model, "samples"), seed=ask(model, "seed") or 0,
            arguments={}, context=context,
            future={t: self.steps(name, s) for t, s in scenarios.items()},
        ).values()  # fmt: skip
        simulated = imagined.features()
        assert simulated is not None, "these models give features"
        return [context, simulated]


def built(names: Sequence[str]) -> dict[str, Any]:
    """Return models of `MODELS` by name."""
    return {name: build_model(MODELS[name][0], **MODELS[name][1]) for name in names}


def interleaved(index: pd.DataFrame) -> list[str]:
    """Return the trials, one of each scenario in turn."""
    order = index.groupby("scenario").cumcount()
    return [str(trial) for trial in index.assign(order=order).sort_values("order")["trial"]]


def compute(features: Features, trials: Sequence[str], full: int) -> None:
    """Compute the features of trials by all models; of whole movies for the first ones only."""
    for number, trial in enumerate(trials, start=1):
        for name in features.models:
            _, _, readouts = MODELS[name]
            for readout in readouts:
                if readout is not Readout.FULL or number <= full:
                    features.parts(name, readout, [trial])
        if number % 20 == 0:
            print(f"{datetime.datetime.now():%H:%M:%S} {number} of {len(trials)}", flush=True)


# Readouts.


class Missing(Exception):
    """A clip that would have to be read."""


def known(features: Features, name: str, readout: Readout, trials: Sequence[str]) -> list[str]:
    """Return the trials whose features are stored."""
    found, source = [], features.sources[name]
    with ExitStack() as stack:
        for part in ("context", "whole"):
            stack.enter_context(mock.patch.object(source, part, side_effect=Missing))
        for trial in trials:
            with suppress(Missing):
                features.parts(name, readout, [trial])
                found.append(trial)
    return found


def fit(features: Features, name: str, readout: Readout) -> dict[str, ShippedReadout]:
    """Return the readouts of a model by scenario, fitted on all trials with stored features."""
    fitted = {}
    for scenario, rows in features.index.groupby("scenario"):
        trials = known(features, name, readout, list(rows.index))
        labels = rows["contact"][trials].to_numpy(bool)
        if len(trials) < LEAST or len(set(labels.tolist())) < 2:
            continue
        parts = features.parts(name, readout, trials)
        if readout is Readout.FULL:
            steps = features.models[name].spec.context + features.steps(name, str(scenario))
            parts = [parts[0].with_steps(steps)]
        if ask(features.models[name], "decision") == "trees":
            array = JoinedFeatures(parts).array()
            accuracy = cross_validate(array, labels, LogisticSettings())
            forest = fit_forest(array, labels)
            made: Any = Forest(forest.feature, forest.value, forest.train_accuracy, accuracy)
        else:
            made = fit_weights(parts, labels)
        fitted[str(scenario)] = ShippedReadout(
            made, parts[-1].shape[1], parts[-1].shape[2], len(trials), ""
        )
    return fitted


def ship(features: Features, dataset: Dataset, name: str) -> None:
    """Fit the readouts of a model, and write them with a card.

    The command on the card makes features of at least as many trials as were fitted.
    """
    model_name, options, readouts = MODELS[name]
    fitted = {
        (readout, scenario): one
        for readout in readouts
        for scenario, one in fit(features, name, readout).items()
    }
    if not fitted:
        return
    model = features.models[name]
    trials = {
        readout: sorted({one.fit_trials for (r, _), one in fitted.items() if r is readout})
        for readout in readouts
    }
    counts = ", ".join(
        f"*{r.value}* {' to '.join(map(str, dict.fromkeys((n[0], n[-1]))))}"
        for r, n in trials.items() if n
    )  # fmt: skip
    fit_on = f"{SET} {describe_fit(dataset).split()[-1]}"
    path = SHIPPED / f"{name}.safetensors"
    write_readouts(path, model.readout_digest(), fit_on, fitted)
    scenarios = sorted({scenario for _, scenario in fitted})
    accuracies = [
        [f"{fitted[r, s].fitted.cv_accuracy:.3f}" if (r, s) in fitted else "-" for s in scenarios]
        for r in readouts
    ]
    rows = [f"| *{r.value}* | {' | '.join(a)} |" for r, a in zip(readouts, accuracies, strict=True)]
    count = int(dataset.index.groupby("scenario").size().max())
    whole = max(trials.get(Readout.FULL, []), default=0)
    most = max(max(n, default=0) for n in trials.values())
    use = f"physion evaluate {model_name} TRIALS" + "".join(
        f" --option {key}={value}" for key, value in options.items()
    )
    text = [
        f"# Readouts of {name}",
        "",
        f"Used by `{use}`, where trials are red and yellow; `--readout-from fit` fits others.",
        "",
        "| | |",
        "|---|---|",
        f"| digest of the model for readouts | {model.readout_digest()} |",
        f"| set, with the start of its digest | {fit_on} |",
        f"| trials that were fitted, a scenario | {counts} |",
        f"| date, processor | {datetime.date.today()}, {processor()}, one thread |",
        f"| bytes | {path.stat().st_size} |",
        "",
        "Accuracy by five-fold cross-validation on the trials that were fitted:",
        "",
        f"| readout | {' | '.join(scenarios)} |",
        f"|---{'|---' * len(scenarios)}|",
        *rows,
        "",
        "The set was made by",
        f"`{COMMAND.format(count=count)}`, features and readouts by",
        f"`python benchmarks/models/ship_readouts.py FOLDER --only {name} --trials {most} "
        f"--full {whole}`.",
    ]
    path.with_suffix(".md").write_text("\n".join(text) + "\n")
    print(name, path.stat().st_size, "bytes", *rows, sep="\n  ", flush=True)


# Official stimuli.


def hits(table: pd.DataFrame) -> pd.Series[Any]:
    """Return for each trial whether its prediction is right, by the recorded outcome if any."""
    recorded = table.get("recorded_outcome", pd.Series("", index=table.index)).fillna("")
    truth = recorded.where(recorded != "", table["outcome"]).astype(str) == "True"
    found = (table["p_contact"] > 0.5) == truth
    return found.set_axis(pd.MultiIndex.from_frame(table[["scenario", "stimulus"]]))


def accuracy(hit: pd.Series[Any]) -> str:
    """Return the mean of scenarios with its 95 % interval over stimuli, and that of rigid ones.

    The interval is 1.96 sqrt(sum of p (1 - p) / n) / scenarios to both sides.
    """
    found = hit.groupby(level="scenario").agg(["mean", "size"])
    variance = found["mean"] * (1 - found["mean"]) / found["size"]
    mean, half = found["mean"].mean(), 1.96 * np.sqrt(variance.sum()) / len(found)
    rigid = found["mean"].drop("drape", errors="ignore").mean()
    return f"{mean:.3f} ({mean - half:.3f} to {mean + half:.3f}) | {rigid:.3f}"


def score(folder: Path, dataset: Dataset, names: Sequence[str]) -> str:
    """Return the table of accuracies on the official stimuli, and of likeness to people.

    r is pooled over stimuli, with the jackknife intervals of `physion.compare`.
    """
    rows, hit = [], {}
    for name in names:
        model_name, options, readouts = MODELS[name]
        # Readouts that ship are used where they were fitted on more trials than a fold would be.
        done = evaluate(
            {model_name: dict(options)}, dataset, folder / "models", folds=2,
            readouts=tuple(readout.value for readout in readouts), rendered=True,
        )  # fmt: skip
        table = done.predictions
        scores = compare(table, humans="official").scores
        of_model = scores["readout"] != ""
        pooled = scores[of_model & (scores["scenario"] == POOLED)].set_index("readout")
        for readout in readouts:
            own = table[table["readout"] == readout.value]
            hit[name, readout] = hits(own)
            by_scenario = hits(own).groupby(level="scenario").mean()
            fit, trials = own["cv_accuracy"].groupby(own["scenario"]).first(), own["fit_trials"]
            like = [
                "-" if readout is Readout.FULL else
                f"{pooled.loc[readout.value, r]:.2f} ({pooled.loc[readout.value, f'{r}_low']:.2f} "
                f"to {pooled.loc[readout.value, f'{r}_high']:.2f})"
                for r in ("r", "r_beyond_outcome")
            ]  # fmt: skip
            rows.append(
                f"| {name} | *{readout.value}* | {trials.max()} | "
                f"{fit.mean():.3f} | {accuracy(hits(own))} | {' | '.join(like)} | "
                f"{' | '.join(f'{value:.2f}' for value in by_scenario)} |"
            )
            scenarios = [*by_scenario.index]
            print(rows[-1], flush=True)
    twins = []
    for (name, readout), of_model in hit.items():
        of_twin = hit.get((f"random-{name}", readout))
        if of_twin is not None:
            found = mcnemar_exact(of_model, of_twin[of_model.index])
            twins.append(
                f"| {name} | *{readout.value}* | {of_model.mean() - of_twin.mean():+.3f} | "
                f"{found.only_first} | {found.only_second} | {found.p:.2g} |"
            )
    stimuli = int((dataset.index["split"] == "testing").sum())
    columns = ["model", "readout", "trials fitted", "own trials", "official", "rigid"]
    columns += ["r with people", "r beyond the outcome", *scenarios]
    head = f"| {' | '.join(columns)} |"
    return "\n".join(
        [
            "# Readouts that ship",
            f"`python benchmarks/models/ship_readouts.py FOLDER --official --write`, "
            f"{datetime.date.today()}, {processor()}.",
            "",
            f"Accuracy, mean of eight scenarios: by cross-validation on the own trials that fitted "
            f"the readout, and on {stimuli} official stimuli that people saw, by the recorded "
            "outcome, with 95 % intervals over stimuli; mean of the seven rigid scenarios; r with "
            "people's answers, and the same given the outcome, pooled, with 95 % jackknife "
            "intervals; accuracy of each scenario.",
            "",
            head,
            "|---" * (head.count("|") - 1) + "|",
            *rows,
            "",
            "Against the random twin, the same network with random weights: difference of the "
            "accuracies over all stimuli, stimuli on which only one of both is right, and p of "
            "McNemar's exact test.",
            "",
            "| model | readout | difference | only the model | only the twin | p |",
            "|---|---|---|---|---|---|",
            *twins,
        ]
    )


def main() -> None:
    """Make what is missing, and write the readouts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trials", type=int, default=0, help="motions and features, a scenario")
    parser.add_argument("--full", type=int, help="trials whose whole movies are seen, a scenario")
    parser.add_argument("--only", nargs="*", choices=MODELS, default=list(MODELS))
    parser.add_argument("--no-fit", action="store_true", help="no readouts are written")
    parser.add_argument("--official", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    stimuli = make_official(options.folder)
    dataset = make_set(options.folder, options.trials, stimuli)
    features = Features(options.folder, dataset, built(options.only))
    count = len(set(dataset.index["scenario"]))
    if options.trials:
        whole = options.trials if options.full is None else options.full
        chosen = interleaved(dataset.index)[: options.trials * count]
        compute(features, chosen, whole * count)
    if not options.no_fit:
        for name in options.only:
            ship(features, dataset, name)
    if options.official:
        tested = stimuli.index[stimuli.index["split"] == "testing"]
        of_stimuli = Features(options.folder, stimuli, built(options.only))
        compute(of_stimuli, interleaved(tested), len(tested))
        text = score(options.folder, stimuli, options.only)
        print(text)
        if options.write:
            RESULTS.write_text(text + "\n")


if __name__ == "__main__":
    main()
