"""Measure what trees that never simulate predict, and how like people they are.

    OMP_NUM_THREADS=1 python benchmarks/models/intuition.py FOLDER [--samples 8] [--write]

FOLDER is one in which ``ship_readouts.py FOLDER --trials N --official`` has computed the features
of `state-trees`, `mask-trees` and `blob-trees`. Forests are fitted on own trials, one per scenario,
and tested on the official stimuli that people saw, without those that show a contact in the
observed part, and without those of Roll with a ledge, as in the study. Three tables:

1. Accuracy by number of own trials per scenario.
2. Accuracy, r with people and r beyond the outcome: with all trials; without trials of the tested
   configuration; with the last observed frame only; the base rate of the configuration; noisy
   simulation from the true state; and means of both kinds.
3. Differences of likeness beyond the outcome between learned and simulated answers, paired over
   stimuli.

With --write they are written to ``results/intuition.md``.
"""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion import Dataset
from physion.analysis.tables import MEAN, POOLED, read_humans
from physion.compute.tasks import processor
from physion.core.names import canonical_name
from physion.data.official import official
from physion.readout.decisions import Readout
from physion.readout.evaluate import evaluate
from physion.readout.logistic import JoinedFeatures
from physion.readout.trees import fit_forest
from physion.report.compare import CompareResult, compare
from physion.scenes.sampling.sample import load_presets
from ship_readouts import SET, Features, known, make_official

RESULTS = Path(__file__).parents[1] / "results" / "intuition.md"
MODELS = ("state-trees", "mask-trees", "blob-trees")
GIVEN = {"state-trees": "states", "mask-trees": "masks", "blob-trees": "blobs"}
SCALES = (1.0, 2.0, 4.0)
"""Scales of the noise of simulations; the first is the default."""
EDGES = (0.025, 0.975)


class Trials:
    """Features and outcomes of own trials and of official stimuli, by model and scenario.

    - ``own``: table by trial with ``scenario``, ``configuration`` (without number), ``contact``.
    - ``tested``: the same of official stimuli, by stimulus, with their recorded outcome; stimuli
      that show a contact in the observed part are left out.
    """

    def __init__(self, folder: Path) -> None:
        readout, stimuli = Dataset(folder / SET), make_official(folder)
        official_names = {
            (scenario, preset.name): preset.official or ""
            for scenario in readout.index["scenario"].unique()
            for preset in load_presets(scenario).values()
        }
        index = readout.index.set_index("trial")
        names = [
            official_names[key] for key in zip(index["scenario"], index["preset"], strict=True)
        ]
        self.own = index.assign(configuration=names)[["scenario", "configuration", "contact"]]
        index = stimuli.index.set_index("trial")
        people = set(read_humans(official().humans)["stimulus"])
        asked = np.array([canonical_name(trial) in people for trial in index.index])
        tested = asked & (index["split"] == "testing").to_numpy()
        seen = index[tested & ~index["observed_contact"].astype(bool).to_numpy()]
        # A name with _2 at its end is a second name of the same configuration.
        names = [trial.rpartition("_")[0].removesuffix("_2") for trial in seen.index]
        self.tested = seen.assign(configuration=names, contact=seen["recorded_contact"])[
            ["scenario", "configuration", "contact"]
        ]
        self.stimuli = stimuli
        of_own, of_tested = Features(folder, readout, MODELS), Features(folder, stimuli, MODELS)
        self.arrays: dict[tuple[str, str], tuple[list[str], NDArray[Any], NDArray[Any]]] = {}
        self.sizes: dict[str, int] = {}
        for name in MODELS:
            for scenario, rows in self.own.groupby("scenario"):
                trials = known(of_own, name, Readout.OBSERVED, list(rows.index))
                there = list(self.tested.index[self.tested["scenario"] == scenario])
                fit, test = (
                    features.parts(name, Readout.OBSERVED, wanted)
                    for features, wanted in ((of_own, trials), (of_tested, there))
                )
                self.sizes[name] = fit[0].shape[2]
                self.arrays[name, str(scenario)] = (
                    trials, JoinedFeatures(fit).array(), JoinedFeatures(test).array(),
                )  # fmt: skip

    def predict(
        self,
        name: str,
        most: int | None = None,
        *,
        unseen: bool = False,
        columns: Callable[[NDArray[Any], int], NDArray[Any]] = lambda values, _: values,
    ) -> pd.Series:
        """Return P(contact) by stimulus.

        Parameters
        ----------
        name
            Model.
        most
            Own trials of a scenario that forests are fitted on; None: all.
        unseen
            Whether a stimulus is answered by a forest without the trials of its configuration.
        columns
            Which features are used, from all (n, D) and the number in a frame.
        """
        answers = pd.Series(np.nan, self.tested.index)
        for scenario, rows in self.tested.groupby("scenario"):
            trials, fit, test = self.arrays[name, str(scenario)]
            own = self.own.loc[trials[:most]]
            fit, test = (columns(values, self.sizes[name]) for values in (fit[:most], test))
            labels = own["contact"].to_numpy(bool)
            groups = rows["configuration"].to_numpy() if unseen else np.full(len(rows), "")
            for group in np.unique(groups):
                kept = (
                    own["configuration"].to_numpy() != group if unseen else np.full(len(own), True)
                )
                forest = fit_forest(fit[kept], labels[kept])
                answers[rows.index[groups == group]] = forest.probability(test[groups == group])
        return answers

    def base_rates(self) -> pd.Series:
        """Return the fraction of contacts of a stimulus' configuration among the own trials.

        It is (k + 1) / (n + 2) for k contacts of n trials.
        """
        counts = self.own.groupby("configuration")["contact"].agg(["sum", "size"])
        rates = (counts["sum"] + 1) / (counts["size"] + 2)
        return self.tested["configuration"].map(rates).fillna(0.5).astype(float)

    def simulated(self, folder: Path, scale: float, samples: int) -> pd.Series:
        """Return the fraction of noisy simulations from the true state with a contact."""
        done = evaluate(
            {"noisy-simulation": {"scales": [scale], "samples": samples}}, self.stimuli,
            folder / "simulations", decision="touch",
        )  # fmt: skip
        table = done.predictions.set_index("stimulus")["p_contact"].astype(float)
        return table[[canonical_name(trial) for trial in self.tested.index]].set_axis(
            self.tested.index
        )


def scored(answers: dict[str, pd.Series]) -> CompareResult:
    """Return the comparison of answers with people and outcomes, by name."""
    table = pd.concat(
        pd.DataFrame(
            {"stimulus": [canonical_name(t) for t in p.index], "model": name, "p_contact": p.values}
        )
        for name, p in answers.items()
    )
    return compare(table.assign(readout="observed"), humans="official")


def rigid_accuracy(trials: Trials, answers: pd.Series) -> float:
    """Return the mean accuracy over the seven rigid scenarios, by recorded outcomes."""
    right = (answers > 0.5) == trials.tested["contact"].astype(bool)
    return float(right.groupby(trials.tested["scenario"]).mean().drop("drape").mean())


def learning(trials: Trials) -> list[str]:
    """Return the rows of the table of accuracies by number of trials."""
    largest = min(len(one[0]) for one in trials.arrays.values())
    counts = [n for n in (100, 200, 400, 800) if n < largest] + [largest]
    rows = []
    for count in counts:
        values = [rigid_accuracy(trials, trials.predict(name, count)) for name in MODELS]
        rows.append(f"| {count} | " + " | ".join(f"{value:.3f}" for value in values) + " |")
        print(rows[-1], flush=True)
    return rows


def last_frame(values: NDArray[Any], size: int) -> NDArray[Any]:
    """Return the features of the last observed frame."""
    return values[:, -size:]


def shown(value: float) -> str:
    """Return three digits of a number, - for NaN."""
    return "-" if np.isnan(value) else f"{value:.3f}"


def likeness_rows(
    trials: Trials, answers: dict[str, pd.Series], result: CompareResult
) -> list[str]:
    """Return the rows of the table of accuracy and likeness."""
    scores = result.scores[result.scores["readout"] == "observed"].set_index(
        ["base_model", "scenario"]
    )
    rows = []
    for name, p in answers.items():
        mean, pooled = scores.loc[name, MEAN], scores.loc[name, POOLED]
        span = [
            f"{pooled[r]:.3f} ({pooled[f'{r}_low']:.3f} to {pooled[f'{r}_high']:.3f})"
            for r in ("r", "r_beyond_outcome")
        ]
        rows.append(
            f"| {name} | {rigid_accuracy(trials, p):.3f} | {mean['accuracy']:.3f} | "
            f"{' | '.join(span)} | {shown(mean['r'])} | {shown(mean['r_beyond_outcome'])} |"
        )
        print(rows[-1], flush=True)
    return rows


def beyond_outcome(p: NDArray[Any], people: NDArray[Any], outcome: NDArray[Any]) -> float:
    """Return the partial r of answers (n,) with P(yes) (n,) given the outcome (n,)."""
    left = []
    for values in (p, people):
        means = np.where(outcome, values[outcome].mean(), values[~outcome].mean())
        left.append(values - means)
    return float(np.corrcoef(*left)[0, 1])


def difference_rows(trials: Trials, answers: dict[str, pd.Series]) -> list[str]:
    """Return rows of the difference of r beyond the outcome, learned less simulated.

    Intervals are of 2000 samples of the stimuli with replacement, the same for both.
    """
    people = read_humans(official().humans).set_index("stimulus")
    names = [canonical_name(trial) for trial in trials.tested.index]
    outcome = trials.tested["contact"].to_numpy(bool)
    right = people.loc[names, "accuracy"].to_numpy(float)
    yes = np.where(outcome, right, 1 - right)
    draws = np.random.default_rng(0).integers(len(names), size=(2000, len(names)))
    everything, rows = np.arange(len(names)), []
    for learned in (name for name in answers if name.startswith(tuple(GIVEN.values()))):
        for simulated in (name for name in answers if name.startswith("simulation")):
            pair = [answers[name].to_numpy(float) for name in (learned, simulated)]
            first, second = (
                np.array([beyond_outcome(p[r], yes[r], outcome[r]) for r in (everything, *draws)])
                for p in pair
            )
            whole, (low, high) = (first - second)[0], np.quantile((first - second)[1:], EDGES)
            rows.append(f"| {learned} | {simulated} | {whole:.3f} ({low:.3f} to {high:.3f}) |")
            print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--samples", type=int, default=8, help="simulations of a stimulus")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    trials = Trials(options.folder)
    print(f"{len(trials.own)} own trials, {len(trials.tested)} official stimuli", flush=True)
    curve = learning(trials)
    answers: dict[str, pd.Series] = {}
    for name, given in GIVEN.items():
        answers[given] = trials.predict(name)
        answers[f"{given}, configuration unseen"] = trials.predict(name, unseen=True)
        answers[f"{given}, last frame"] = trials.predict(name, columns=last_frame)
    answers["base rate of the configuration"] = trials.base_rates()
    for scale in SCALES:
        answers[f"simulation, noise x {scale:g}"] = trials.simulated(
            options.folder, scale, options.samples
        )
    of_simulations = [p for name, p in answers.items() if name.startswith("simulation")]
    answers["simulation, mean of the levels"] = sum(of_simulations) / len(of_simulations)
    for given in GIVEN.values():
        both = (answers[given] + answers["simulation, mean of the levels"]) / 2
        answers[f"mean of {given} and simulation"] = both
    rows = likeness_rows(trials, answers, scored(answers))
    differences = difference_rows(trials, answers)
    text = "\n".join(
        [
            "# Learned intuition and simulation",
            f"`python benchmarks/models/intuition.py FOLDER --samples {options.samples} --write`, "
            f"{datetime.date.today()}, {processor()}: {len(trials.tested)} official stimuli "
            "without contact in the observed part, recorded outcomes.",
            "",
            "Accuracy, mean of the seven rigid scenarios, by number of own trials per scenario:",
            "",
            f"| own trials | {' | '.join(GIVEN.values())} |",
            "|---|---|---|---|",
            *curve,
            "",
            "With all own trials; r is with people's answers, intervals are of the jackknife over "
            f"stimuli; {options.samples} simulations of a stimulus from the true state:",
            "",
            "| answers | accuracy, rigid | accuracy, mean of eight | r, pooled "
            "| r beyond the outcome, pooled | r, mean of eight | r beyond, mean of eight |",
            "|---|---|---|---|---|---|---|",
            *rows,
            "",
            "Difference of r beyond the outcome, pooled, with 95 % intervals over stimuli:",
            "",
            "| learned | simulated | difference |",
            "|---|---|---|",
            *differences,
        ]
    )
    if options.write:
        RESULTS.write_text(text + "\n")


if __name__ == "__main__":
    main()
