"""Measure what models that never simulate predict, and how like people they are.

    OMP_NUM_THREADS=1 python benchmarks/models/intuition_trials.py FOLDER --trials 1000 --official
    OMP_NUM_THREADS=1 python benchmarks/models/intuition.py FOLDER [--samples 8] [--many 200]
        [--write]

Forests on what `state-trees`, `mask-trees` and `blob-trees` see are fitted on the own trials of
FOLDER, one per scenario, and tested on the official stimuli that people saw, without those that
show a contact in the observed part, without those of Roll with a ledge, as in the study, and
without Drape, since simulations of cloth are slow. Tables:

1. Accuracy by number of own trials per scenario, and how much a doubling adds.
2. Accuracy, r with people and r beyond the outcome: with all trials; without trials of the tested
   configuration, of its kind (all that differ in room and scenery only), or of its scenario; with
   the controls of `intuition_controls`; noisy simulation from the true state; mixtures of both,
   with weights fitted on own trials or, where the name says so, to people's answers to one half of
   the stimuli, and tested on the other half; predictions of other models (--predictions FILE);
   answers that have the values of another, by rank; levels of noise fitted to people in the same
   way; each network of intuition with the forests that are given the same; forests, networks of
   intuition and levels of noise together, with equal weights and with weights fitted to people.
3. What the best model could reach, from halves of the people, and the weights of mixtures.
4. Differences of likeness beyond the outcome between learned and simulated answers, paired over
   stimuli.
5. With --predictions, which say how our engine ends: the same for the stimuli that end as recorded.

With --write they are written to ``results/intuition.md``.
"""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import expit

from intuition_controls import (
    CONTROLS,
    Columns,
    best_level,
    ceiling,
    every,
    fitted_to_people,
    log_odds,
    logistic_weights,
    partial,
    slope,
    weighted,
    with_spread,
)
from intuition_trials import ended_as_recorded, kinds, load, predicted, simulated
from physion.analysis.tables import MEAN, POOLED, read_humans
from physion.compute.tasks import processor
from physion.core.names import RIGID
from physion.data.official import official
from physion.readout.trees import fit_forest
from physion.report.compare import CompareResult, compare

RESULTS = Path(__file__).parents[1] / "results" / "intuition.md"
MODELS = ("state-trees", "mask-trees", "blob-trees")
GIVEN = {"state-trees": "states", "mask-trees": "masks", "blob-trees": "blobs"}
ALIKE = {
    "intuition-states-small": "states", "intuition-masks-small": "masks",
    "intuition-pixels-small": "blobs",
}  # fmt: skip
"""Networks and the forests that are given the same: states, masks or pixels."""
SCALES = (1.0, 2.0, 4.0)
"""Scales of the noise of simulations; the first is the default."""
CONTACTS = (0.1, 0.4)
"""Levels of noise at new contacts, added to the default noise: it grows while a simulation runs."""
COUNTS = (125, 250, 500, 1000, 2000)
"""Own trials of a scenario in the learning curves."""
ELSEWHERE = 250
"""Own trials of each other scenario, for forests that have not seen the tested one."""
COMPARED = (
    "simulation, noise x 1", "simulation, many samples", "simulation, mean of the levels",
    "simulation, levels weighted to people",
)  # fmt: skip
"""Simulations with which learned answers are compared."""
EDGES = (0.025, 0.975)


class Trials:
    """Features and outcomes of own trials and of official stimuli, by model and scenario.

    - ``own``: table by trial with ``scenario``, ``configuration`` (without number), its ``kind``
      (`intuition_trials.kinds`), ``contact``, and ``scene``, in the order in which they were made.
    - ``tested``: the same of official stimuli, by stimulus, with their recorded outcome; stimuli
      that show a contact in the observed part are left out, and scenarios without an own trial.
    """

    def __init__(self, folder: Path) -> None:
        made, asked = load(folder / "own", MODELS), load(folder / "official", MODELS)
        made = {name: values[np.isin(made["scenario"], RIGID)] for name, values in made.items()}
        self.own, self.tested = _facts(made), _facts(asked)
        people = set(read_humans(official().humans)["stimulus"])
        kept = ~asked["observed_contact"] & np.isin(asked["trial"], list(people))
        kept &= np.isin(asked["scenario"], np.unique(made["scenario"]))
        self.tested = self.tested[kept]
        self.arrays: dict[tuple[str, str], tuple[list[str], NDArray[Any], NDArray[Any]]] = {}
        for scenario in np.unique(made["scenario"]):
            own, test = made["scenario"] == scenario, kept & (asked["scenario"] == scenario)
            for name in MODELS:
                trials = [str(trial) for trial in made["trial"][own]]
                self.arrays[name, str(scenario)] = trials, made[name][own], asked[name][test]

    def predict(
        self,
        name: str,
        most: int | None = None,
        *,
        unseen: str = "",
        fit: Columns = every,
        test: Columns = every,
    ) -> pd.Series:
        """Return P(contact) by stimulus.

        Parameters
        ----------
        name
            Model.
        most
            Own trials of a scenario that forests are fitted on; None: all.
        unseen
            ``configuration`` or ``kind``: a stimulus is answered by a forest without the trials of
            its configuration, or without those of all that differ from it in room and scenery only.
        fit, test
            Which features are used for the fit, and in the test.
        """
        answers = pd.Series(np.nan, self.tested.index)
        states = name == "state-trees"
        for scenario, rows in self.tested.groupby("scenario"):
            trials, own_values, test_values = self.arrays[name, str(scenario)]
            own = self.own.loc[trials[:most]]
            of_fit, of_test = fit(own_values[:most], states), test(test_values, states)
            labels = own["contact"].to_numpy(bool)
            groups = rows[unseen].to_numpy() if unseen else np.full(len(rows), "")
            for group in np.unique(groups):
                kept = own[unseen].to_numpy() != group if unseen else np.full(len(own), True)
                forest = fit_forest(of_fit[kept], labels[kept])
                answers[rows.index[groups == group]] = forest.probability(of_test[groups == group])
        return answers

    def predict_elsewhere(self, name: str) -> pd.Series:
        """Return P(contact) by stimulus, of a forest fitted on all other scenarios."""
        answers, states = pd.Series(np.nan, self.tested.index), name == "state-trees"
        for scenario, rows in self.tested.groupby("scenario"):
            fit, labels = [], []
            for other in (s for (n, s) in self.arrays if n == name and s != scenario):
                trials, values, _ = self.arrays[name, other]
                fit.append(every(values[:ELSEWHERE], states))
                labels.append(self.own.loc[trials[:ELSEWHERE], "contact"].to_numpy(bool))
            forest = fit_forest(np.concatenate(fit), np.concatenate(labels))
            _, _, values = self.arrays[name, str(scenario)]
            answers[rows.index] = forest.probability(every(values, states))
        return answers

    def last_own(self, count: int) -> list[str]:
        """Return the last own trials, ``count`` of each scenario."""
        lists = [t for (name, _), (t, _, _) in self.arrays.items() if name == MODELS[0]]
        return [trial for trials in lists for trial in trials[-count:]]

    def predict_own(self, name: str, chosen: Sequence[str]) -> pd.Series:
        """Return P(contact) of own trials, from forests without any of them."""
        answers, states = pd.Series(np.nan, list(chosen)), name == "state-trees"
        for scenario, rows in self.own.loc[list(chosen)].groupby("scenario"):
            trials, values, _ = self.arrays[name, str(scenario)]
            tested = np.isin(trials, rows.index)
            labels = self.own.loc[trials, "contact"].to_numpy(bool)
            columns = every(values, states)
            forest = fit_forest(columns[~tested], labels[~tested])
            places = [trials.index(trial) for trial in rows.index]
            answers[rows.index] = forest.probability(columns[places])
        return answers

    def base_rates(self) -> pd.Series:
        """Return the fraction of contacts of a stimulus' configuration among the own trials.

        It is (k + 1) / (n + 2) for k contacts of n trials.
        """
        counts = self.own.groupby("configuration")["contact"].agg(["sum", "size"])
        rates = (counts["sum"] + 1) / (counts["size"] + 2)
        return self.tested["configuration"].map(rates).fillna(0.5).astype(float)


def _facts(loaded: dict[str, NDArray[Any]]) -> pd.DataFrame:
    """Return the table of trials, by name.

    A name of a configuration with _2 at its end is its second name.
    """
    columns = ("scenario", "configuration", "contact", "scene")
    names = [str(trial) for trial in loaded["trial"]]
    table = pd.DataFrame({name: loaded[name] for name in columns}, index=names)
    table["configuration"] = table["configuration"].astype(str).str.removesuffix("_2")
    pairs = zip(table["scenario"], table["configuration"], strict=True)
    table["kind"] = [kinds(str(scenario)).get(name, name) for scenario, name in pairs]
    return table


def answers_of_people(trials: Trials) -> pd.DataFrame:
    """Return how many people say ``yes`` to each stimulus, of how many (``count``)."""
    table = read_humans(official().humans).set_index("stimulus").loc[trials.tested.index]
    count = table["count"].to_numpy(np.int64)
    right = np.rint(table["accuracy"].to_numpy(float) * count).astype(np.int64)
    yes = np.where(trials.tested["contact"].to_numpy(bool), right, count - right)
    return pd.DataFrame({"yes": yes, "count": count}, index=trials.tested.index)


def scored(answers: dict[str, pd.Series]) -> CompareResult:
    """Return the comparison of answers with people and outcomes, by name."""
    table = pd.concat(
        pd.DataFrame({"stimulus": p.index, "model": name, "p_contact": p.values})
        for name, p in answers.items()
    )
    return compare(table.assign(readout="observed"), humans="official")


def rigid_accuracy(trials: Trials, answers: pd.Series) -> float:
    """Return the mean accuracy over the seven rigid scenarios, by recorded outcomes."""
    right = (answers > 0.5) == trials.tested["contact"].astype(bool)
    by_scenario = right.groupby(trials.tested["scenario"]).mean()
    return float(by_scenario.drop("drape", errors="ignore").mean())


def learning(trials: Trials) -> list[str]:
    """Return the rows of the table of accuracies by number of trials, and by how much they rise."""
    largest = min(len(one[0]) for one in trials.arrays.values())
    counts = [n for n in COUNTS if n < largest * 0.9] + [largest]
    table = []
    for count in counts:
        table.append([rigid_accuracy(trials, trials.predict(name, count)) for name in MODELS])
        print(count, table[-1], flush=True)
    heads = [*map(str, counts), "each doubling adds"]
    columns = np.array(table)
    values = [*columns, [slope(counts, column) for column in columns.T]]
    return [
        f"| {head} | " + " | ".join(f"{value:.3f}" for value in row) + " |"
        for head, row in zip(heads, values, strict=True)
    ]


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


def engine_rows(trials: Trials, answers: dict[str, pd.Series], same: pd.Series) -> list[str]:
    """Return rows of answers where our engine ends as recorded (``same``, by stimulus).

    Accuracy by outcomes of our engine, for all stimuli; for the ones that end as recorded:
    accuracy, r with people, and r beyond the outcome, pooled.
    """
    contact = trials.tested["contact"].astype(bool)
    people = answers_of_people(trials)
    yes, rows = (people["yes"] / people["count"])[same], []
    for name, p in answers.items():
        right = (p > 0.5) == (contact == same)
        means = [
            one.groupby(trials.tested["scenario"][one.index]).mean().mean()
            for one in (right, right[same])
        ]
        beyond = partial(p[same].to_numpy(), yes.to_numpy(), contact[same].to_numpy())
        cells = [*means, float(np.corrcoef(p[same], yes)[0, 1]), beyond]
        rows.append(f"| {name} | {' | '.join(f'{cell:.3f}' for cell in cells)} |")
        print(rows[-1], flush=True)
    return rows


def difference_rows(
    trials: Trials, answers: dict[str, pd.Series], kept: pd.Series | None = None
) -> list[str]:
    """Return rows of the difference of r beyond the outcome, learned less simulated.

    Intervals are of 2000 samples of the stimuli (``kept``, by stimulus, or all) with replacement,
    the same for both.
    """
    people = answers_of_people(trials)
    outcome = trials.tested["contact"].to_numpy(bool)
    yes = (people["yes"] / people["count"]).to_numpy()
    everything = np.arange(len(yes)) if kept is None else np.flatnonzero(kept)
    places = np.random.default_rng(0).integers(len(everything), size=(2000, len(everything)))
    draws, rows = everything[places], []
    learned_names = [n for n in answers if n.startswith((*GIVEN.values(), "intuition"))]
    for learned in (n for n in learned_names if "spread" not in n and "exchanged" not in n):
        for other in (name for name in answers if name in COMPARED):
            pair = [answers[name].to_numpy(float) for name in (learned, other)]
            first, second = (
                np.array([partial(p[r], yes[r], outcome[r]) for r in (everything, *draws)])
                for p in pair
            )
            whole, (low, high) = (first - second)[0], np.quantile((first - second)[1:], EDGES)
            rows.append(f"| {learned} | {other} | {whole:.3f} ({low:.3f} to {high:.3f}) |")
            print(rows[-1], flush=True)
    return rows


def mixed_on_own(
    trials: Trials, folder: Path, answers: dict[str, pd.Series], own: int, samples: int
) -> tuple[dict[str, pd.Series], list[str]]:
    """Return mixtures whose weights are fitted on own trials, and rows of these weights.

    ``own`` trials of each scenario are simulated; forests answer trials that they have not seen.
    """
    mixed, rows, chosen = {}, [], trials.last_own(own)
    scenes = trials.own.loc[chosen, "scene"].to_dict()
    simulation = simulated(folder, scenes, SCALES[0], samples)
    outcome = trials.own.loc[chosen, "contact"].to_numpy(float)
    for name, given in GIVEN.items():
        fit = pd.DataFrame({given: trials.predict_own(name, chosen), "simulation": simulation})
        weights = logistic_weights(fit, outcome, np.ones(len(outcome)))
        default = answers[f"simulation, noise x {SCALES[0]:g}"]
        test = pd.DataFrame({given: answers[given], "simulation": default})
        mixed[f"mixed of {given} and simulation, weights of own trials"] = pd.Series(
            expit(log_odds(test) @ weights), test.index
        )
        rows.append(f"| {given}, own trials | {weights[0]:.2f} | {weights[1]:.2f} |")
    return mixed, rows


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--samples", type=int, default=8, help="simulations of a stimulus")
    parser.add_argument("--many", type=int, default=0, help="simulations of one row of its own")
    parser.add_argument("--own", type=int, default=50, help="own trials that fit weights")
    parser.add_argument("--predictions", type=Path, nargs="*", default=[], help="of other models")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    trials = Trials(options.folder)
    print(f"{len(trials.own)} own trials, {len(trials.tested)} official stimuli", flush=True)
    curve = learning(trials)
    people, scenario = answers_of_people(trials), trials.tested["scenario"].astype(str)
    outcome = trials.tested["contact"].to_numpy(bool)
    answers: dict[str, pd.Series] = {}
    for name, given in GIVEN.items():
        answers[given] = trials.predict(name)
        answers[f"{given}, configuration unseen"] = trials.predict(name, unseen="configuration")
        answers[f"{given}, kind of configuration unseen"] = trials.predict(name, unseen="kind")
        answers[f"{given}, scenario unseen"] = trials.predict_elsewhere(name)
        for control in CONTROLS:
            answers[f"{given}, {control.name}"] = trials.predict(
                name, fit=control.fit, test=control.test
            )
    given_answers: dict[str, pd.Series] = {}
    for path in options.predictions:
        table = {name: p[trials.tested.index] for name, p in predicted(path).items()}
        if twice := set(table) & set(given_answers):
            raise SystemExit(f"--predictions has two tables of {', '.join(sorted(twice))}")
        given_answers |= table
    answers |= given_answers
    answers["base rate of the configuration"] = trials.base_rates()
    scenes = trials.tested["scene"].to_dict()
    levels = pd.DataFrame(
        {
            f"simulation, noise x {scale:g}": simulated(
                options.folder, scenes, scale, options.samples
            )
            for scale in SCALES
        }
    )
    growing = pd.DataFrame(
        {
            f"simulation, noise x 1 and {level:g} at contacts": simulated(
                options.folder, scenes, SCALES[0], options.samples, level
            )
            for level in CONTACTS
        }
    )
    every_level = levels.join(growing)
    answers |= {str(name): every_level[name] for name in every_level}
    if options.many:
        many = simulated(options.folder, scenes, SCALES[0], options.many)
        answers["simulation, many samples"] = many
    answers["simulation, mean of the levels"] = levels.mean(axis=1)
    answers["simulation, level fitted to people"] = best_level(every_level, people, scenario)
    answers["simulation, levels weighted to people"] = weighted(every_level, people, scenario)
    default, weights = answers[str(levels.columns[0])], []
    learned = [n for n in given_answers if n.startswith("intuition") and "," not in n]
    for given in (*GIVEN.values(), *learned):
        answers[f"{given}, spread of simulation"] = with_spread(answers[given], default, scenario)
        answers[f"simulation, spread of {given}"] = with_spread(default, answers[given], scenario)
    for given in (*GIVEN.values(), *learned):
        both = (answers[given] + answers["simulation, mean of the levels"]) / 2
        answers[f"mean of {given} and simulation"] = both
        pair = pd.DataFrame({given: answers[given], **levels})
        mixed, found = fitted_to_people(pair, people, scenario)
        answers[f"mixed of {given} and simulation, weights fitted to people"] = mixed
        weights.append(
            f"| {given}, people | {found[:, 0].mean():.2f} | {found[:, 1:-1].sum(1).mean():.2f} |"
        )
    for name in [name for name in learned if name in ALIKE]:
        both = (answers[name] + answers[ALIKE[name]]) / 2
        answers[f"mean of {name} and {ALIKE[name]}"] = both
    together = pd.DataFrame({name: answers[name] for name in (*GIVEN.values(), *learned)})
    together = together.join(every_level)
    answers["mean of forests, networks and simulations"] = together.mean(axis=1)
    answers["forests, networks and simulations, weighted to people"] = weighted(
        together, people, scenario
    )
    mixed_own, of_own = mixed_on_own(trials, options.folder, answers, options.own, options.samples)
    answers |= mixed_own
    rows = likeness_rows(trials, answers, scored(answers))
    differences = difference_rows(trials, answers)
    engine = []
    if options.predictions:
        same = ended_as_recorded(options.predictions[0])[trials.tested.index]
        chosen = {
            name: p for name, p in answers.items()
            if name in (*GIVEN.values(), *learned)
            or (name.startswith("simulation") and "spread" not in name)
        }  # fmt: skip
        engine = [
            "",
            f"The stimuli that end with our engine as recorded: {int(same.sum())} of {len(same)}. "
            "*By our engine*: accuracy by its outcomes, of all stimuli. The other columns are of "
            "these stimuli; accuracies are means of the seven rigid scenarios, r is pooled:",
            "",
            "| answers | by our engine | accuracy | r | r beyond the outcome |",
            "|---|---|---|---|---|",
            *engine_rows(trials, chosen, same),
            "",
            "Difference of r beyond the outcome, pooled, of these stimuli:",
            "",
            "| learned | simulated | difference |",
            "|---|---|---|",
            *difference_rows(trials, answers, same),
        ]
    reliability, most = ceiling(people, outcome)
    print(f"reliability {reliability:.3f}, ceiling {most:.3f}", flush=True)
    counts = trials.own.groupby("scenario").size()
    text = "\n".join(
        [
            "# Learned intuition and simulation",
            f"`python benchmarks/models/intuition.py FOLDER --samples {options.samples} "
            f"--many {options.many} {'--predictions FILES.csv ' * bool(options.predictions)}"
            "--write`, "
            f"{datetime.date.today()}, {processor()}: {len(trials.tested)} official stimuli "
            "without contact in the observed part, recorded outcomes; own trials per scenario: "
            f"{' to '.join(str(n) for n in sorted({counts.min(), counts.max()}))}.",
            "",
            "Accuracy, mean of the seven rigid scenarios, by number of own trials per scenario:",
            "",
            f"| own trials | {' | '.join(GIVEN.values())} |",
            "|---|---|---|---|",
            *curve,
            "",
            "With all own trials; r is with people's answers, intervals are of the jackknife over "
            f"stimuli; {options.samples} simulations of a stimulus from the true state, *many "
            f"samples*: {options.many}. Noise at contacts: of the velocities after each of the "
            "first three new contacts, as a fraction of the speed before it. Without "
            f"the tested scenario, forests saw {ELSEWHERE} trials of each other one. Weights of "
            f"own trials are fitted on {options.own} of each scenario:",
            "",
            "| answers | accuracy, rigid | accuracy, mean of all | r, pooled "
            "| r beyond the outcome, pooled | r, mean of all | r beyond, mean of all |",
            "|---|---|---|---|---|---|---|",
            *rows,
            "",
            f"People's answers beyond the outcome have the reliability {reliability:.3f} (halves "
            "of the people of each stimulus, Spearman-Brown, pooled), so that no model has a "
            f"higher r beyond the outcome than {most:.3f}.",
            "",
            "Weights of log odds in the mixtures, fitted on own trials or to people (mean of "
            "two halves of the stimuli; the weights of all levels of simulation are added):",
            "",
            "| learned, fitted on | weight of learned | weight of simulation |",
            "|---|---|---|",
            *of_own,
            *weights,
            "",
            "Difference of r beyond the outcome, pooled, with 95 % intervals over stimuli:",
            "",
            "| learned | simulated | difference |",
            "|---|---|---|",
            *differences,
            *engine,
        ]
    )
    if options.write:
        RESULTS.write_text(text + "\n")


if __name__ == "__main__":
    main()
