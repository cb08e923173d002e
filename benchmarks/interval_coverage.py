"""How often 95 % intervals of the analysis contain what they are about.

    nice -n 15 python benchmarks/interval_coverage.py [--repeats 800] [--size 40x60 100x150]
        [--write]

Studies are simulated again and again, and intervals of scores, of people and of their agreement are
computed by the package's own functions. Not simulated are those of paired differences of RMSD and
kappa, mixed models, hypotheses, effects of flags, ranks, and the published tables. An interval is
about the expected value of the number with other people, other stimuli, or both, of the same
number; that value is the mean over all repeats. Coverage is the
fraction of repeats whose interval contains it. Its standard error is 1.3 % with 300 repeats, 0.8 %
with 800; for means over eight scenarios, which are groups of repeats drawn at random, it is larger.

The logit of P(yes) of a person at a stimulus is s (m + 0.4 b) + 0.3 a: s is 1 at contacts and -1
otherwise, m normal with mean 1.2 and standard deviation 1.3 over stimuli, a and b standard normal
over people (leaning to yes, and ability). Models:

- perfect: P(contact) is the fraction of yes of infinitely many people;
- good, poor: logit 0.8 s m + 1.0 e and 0.3 s m + 1.5 e with e standard normal;
- outcome: P(contact) 0.95 at contacts and 0.05 otherwise, reversed at a sixth of the stimuli.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.analysis.metrics import all_metrics, metrics
from physion.analysis.models.model_people import Models, sample_of_models
from physion.analysis.models.sampling_variance import sampling_variances
from physion.analysis.models.score_tables import score_table
from physion.analysis.people.answers import ScenarioAnswers
from physion.analysis.people.biases import learning, side_bias, yes_bias
from physion.analysis.people.people import accuracy_by_scenario, agreement_by_scenario
from physion.analysis.sample import RESAMPLED, Resampled, Sample
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.statistics.calibration import reliability_curve
from physion.analysis.statistics.correlation import correlate_resampled
from physion.analysis.statistics.jackknife import Variance, jackknife, variance_of_mean
from physion.analysis.statistics.paired import compare_models
from physion.seeds import generator

F64 = NDArray[np.float64]
RESULTS = Path(__file__).parent / "results" / "interval_coverage.md"
SIZES = ((40, 60), (100, 150))
MODELS = ("perfect", "good", "poor", "outcome")
SCENARIOS = 8
BOUNDS = (93, 97)
"""Per cent of repeats that the interval should contain the value in."""
LEFT_OUT = ("accuracy_simulated", "r_same")
"""Metrics that equal others where the simulated outcome is the official one."""


@dataclass(frozen=True)
class Study:
    """Answers of people (n, s) to stimuli with labels (s,), and P(contact) of `MODELS` (m, s)."""

    yes: F64
    label: F64
    p_contact: F64

    def answers(self) -> ScenarioAnswers:
        people, stimuli = self.yes.shape
        names = tuple(f"p{k:03d}" for k in range(people))
        stimulus = tuple(f"s{k:03d}" for k in range(stimuli))
        nothing = np.full(self.yes.shape, np.nan)
        return ScenarioAnswers("drop", names, names, stimulus, self.yes, self.label, nothing)

    def models(self) -> Models:
        return Models(MODELS, self.p_contact, (self.p_contact > 0.5).astype(np.float64))

    def test(self, rng: np.random.Generator) -> pd.DataFrame:
        """Test rows as `participants.Responses` has them, each person with an own order."""
        people, stimuli = self.yes.shape
        person = np.repeat(np.arange(people), stimuli)
        order = rng.permuted(np.tile(np.arange(stimuli), (people, 1)), axis=1)
        name = np.char.add("p", np.char.zfill(person.astype(str), 3))
        yes = self.yes.ravel().astype(bool)
        label = np.tile(self.label.astype(bool), people)
        return pd.DataFrame(
            {
                "scenario": "drop",
                "session": name,
                "participant": name,
                "stimulus": np.tile(np.arange(stimuli).astype(str), people),
                "trial": order.ravel(),
                "yes": yes,
                "label": label,
                "correct": yes == label,
                "log_rt": np.nan,
                "rt_ms": np.nan,
                "buttons": np.where(person % 2, "no-yes", "yes-no"),
            }
        )


def studies(drawn: Resampled, people: int, stimuli: int, repeats: int) -> Iterator[Study]:
    """Simulate studies in which people, stimuli, or both differ from one to the next."""
    fixed = generator("coverage, fixed", drawn, people, stimuli)
    rng = generator("coverage", drawn, people, stimuli)
    pool = generator("coverage, all people").normal(size=(2, 2000))
    persons = fixed.normal(size=(2, people))
    scenes = fixed.normal(size=(4, stimuli))
    sign = np.where(np.arange(stimuli) % 2 == 0, 1.0, -1.0)
    for _ in range(repeats):
        if drawn != "stimuli":
            persons = rng.normal(size=(2, people))
        if drawn != "people":
            scenes = rng.normal(size=(4, stimuli))
        easy = 1.2 + 1.3 * scenes[0]
        true = logistic(sign * (easy + 0.4 * pool[1, :, None]) + 0.3 * pool[0, :, None]).mean(0)
        p = logistic(sign * (easy + 0.4 * persons[1, :, None]) + 0.3 * persons[0, :, None])
        reversed_ = scenes[3] < -0.967
        p_contact = np.stack(
            [
                true,
                logistic(0.8 * sign * easy + scenes[1]),
                logistic(0.3 * sign * easy + 1.5 * scenes[2]),
                np.where((sign > 0) != reversed_, 0.95, 0.05),
            ]
        )
        yes = (rng.random(p.shape) < p).astype(np.float64)
        yield Study(yes, (sign > 0).astype(np.float64), p_contact)


def logistic(x: F64) -> F64:
    return np.asarray(1 / (1 + np.exp(-x)))


class Coverage:
    """Values, lows and highs of intervals over repeats, by a name."""

    def __init__(self) -> None:
        self.rows: dict[tuple[str, ...], list[tuple[float, float, float]]] = {}

    def add(self, key: tuple[str, ...], value: float, low: float, high: float) -> None:
        self.rows.setdefault(key, []).append((value, low, high))

    def table(self) -> pd.DataFrame:
        """One row a name: ``repeats``, ``value`` (mean), ``width`` (mean), ``inside`` (%), of which
        the interval lies ``below`` or ``above`` the value, and ``undefined``.
        """
        records = []
        for key, rows in self.rows.items():
            value, low, high = np.array(rows).T
            truth = np.nanmean(value)
            known = np.isfinite(low) & np.isfinite(high)
            below, above = high[known] < truth, low[known] > truth
            records.append(
                {
                    **dict(zip(("what", "drawn", "size"), key, strict=True)),
                    "repeats": len(rows),
                    "value": truth,
                    "width": np.mean(high[known] - low[known]),
                    "inside": 100 * np.mean(~(below | above)),
                    "below": 100 * np.mean(below),
                    "above": 100 * np.mean(above),
                    "undefined": int(np.sum(~known)),
                }
            )
        return pd.DataFrame(records)


# --- measures of models -------------------------------------------------------------------------


def measures(coverage: Coverage, drawn: Resampled, size: tuple[int, int], repeats: int) -> None:
    """Every metric of every model, of one scenario and of the mean over eight."""
    chosen = [m for m in all_metrics() if drawn in m.resampled and m.name not in LEFT_OUT]
    pairs = {f"two people: {m.name}": m.of_two_people for m in chosen if m.two_people is not None}
    computes: dict[str, Callable[[Sample], F64]] = {**{m.name: m for m in chosen}, **pairs}
    named = f"{size[0]} x {size[1]}"
    values: dict[str, list[F64]] = {}
    variances: dict[str, list[Variance]] = {}
    for study in studies(drawn, *size, repeats):
        models, answers = study.models(), study.answers()
        sample = sample_of_models(models, answers)
        for name, variance in sampling_variances(models, answers, computes, drawn).items():
            values.setdefault(name, []).append(computes[name](sample)[0])
            variances.setdefault(name, []).append(variance)
    rng = generator("groups of scenarios", repeats)
    groups = [rng.choice(repeats, SCENARIOS, replace=False) for _ in range(repeats)]
    for name in values:
        value = np.array(values[name])
        spread = Variance(
            np.array([one.value for one in variances[name]]),
            np.array([one.df for one in variances[name]]),
        )
        scale = metrics.get(name.removeprefix("two people: ")).scale
        for k in range(value.shape[1]):
            what = name if name in pairs else f"{MODELS[k]}: {name}"
            _add(coverage, (what, drawn, named), value[:, k], spread.value[:, k], spread.df[:, k],
                 scale)  # fmt: skip
            # Of independent scenarios; their population is the same, so is the expected value.
            mean = np.array([value[group, k].mean() for group in groups])
            total = np.array([spread.value[group, k].sum() for group in groups])
            parts = np.array([(spread.value[g, k] ** 2 / spread.df[g, k]).sum() for g in groups])
            with np.errstate(invalid="ignore"):
                df = np.where(total > 0, total**2 / parts, 1.0)
            _add(coverage, (f"mean of 8: {what}", drawn, named), mean, total / SCENARIOS**2, df,
                 scale)  # fmt: skip


def _add(coverage, key, values, variances, dfs, scale) -> None:  # type: ignore[no-untyped-def]
    for value, variance, df in zip(values, variances, dfs, strict=True):
        low, high = Variance(variance, df).interval(float(value), 0.95, scale)
        coverage.add(key, float(value), low, high)


# --- other intervals of stimuli -----------------------------------------------------------------


def of_stimuli(coverage: Coverage, size: tuple[int, int], repeats: int) -> None:
    """Differences of r, r in a third of the stimuli, calibration, means of skewed errors."""
    named, key = f"{size[0]} x {size[1]}", "stimuli"
    rng = generator("skewed errors", *size)
    for study in studies("stimuli", *size, repeats):
        p_yes, p = study.yes.mean(axis=0), study.p_contact
        tests = compare_models(
            list(MODELS), ((p > 0.5) == study.label).astype(np.float64), p, p_yes, permutations=1
        )
        for row in tests.to_dict("records"):
            coverage.add(
                (f"{row['first']} less {row['second']}: r", key, named),
                row["r_difference"], row["r_difference_low"], row["r_difference_high"],
            )  # fmt: skip
        right = np.where(study.label == 1, p_yes, 1 - p_yes)
        easy = right >= 2 / 3
        without = 1 - np.eye(int(easy.sum()))
        y = np.broadcast_to(p_yes[easy], without.shape)
        ones = np.ones((1, int(easy.sum())))
        for k, name in enumerate(MODELS):
            x = p[k : k + 1, easy]
            r = float(correlate_resampled(x, p_yes[None, easy], ones)[0, 0])
            variance = jackknife(correlate_resampled(x, y, without)).of(0)
            coverage.add((f"{name}: r, easy stimuli", key, named), r,
                         *variance.interval(r, 0.95, "correlation"))  # fmt: skip
        bin_ = reliability_curve(p[1], study.label).iloc[8]
        coverage.add(("good: calibration, P 0.8 to 0.9", key, named), bin_["share"], bin_["low"],
                     bin_["high"])  # fmt: skip
        errors = rng.lognormal(0, 1, size[1])
        spread = variance_of_mean(errors)
        coverage.add(("mean of log-normal errors (rollouts)", key, named), float(errors.mean()),
                     *spread.interval(float(errors.mean()), 0.95, "positive"))  # fmt: skip


def pooled(coverage: Coverage, size: tuple[int, int], repeats: int) -> None:
    """The row of all stimuli pooled, and of the mean, of the table of scores."""
    named = f"8 x {size[0]} x {size[1]}"
    drawn = studies("stimuli", *size, SCENARIOS * repeats)
    for _ in range(repeats):
        parts = []
        for scenario in range(SCENARIOS):
            study = next(drawn)
            p_yes, label = study.yes.mean(axis=0), study.label.astype(bool)
            parts.append(
                pd.DataFrame(
                    {
                        "agent": "good", "model": "good", "readout": "", "scenario": f"s{scenario}",
                        "stimulus": [f"s{scenario} {k:03d}" for k in range(len(label))],
                        "p_contact": study.p_contact[1], "predicted": study.p_contact[1] > 0.5,
                        "label": label, "simulated": label, "count": size[0], "p_yes": p_yes,
                        "human_accuracy": np.where(label, p_yes, 1 - p_yes),
                    }
                )
            )  # fmt: skip
        table = score_table(pd.concat(parts, ignore_index=True)).set_index("scenario")
        for where in ("mean", "pooled"):
            for name in ("accuracy", "r", "kappa_from_averages", "rmsd", "r_beyond_outcome"):
                row = table.loc[where]
                coverage.add((f"good, {where}: {name}", "stimuli", named), row[name],
                             row[f"{name}_low"], row[f"{name}_high"])  # fmt: skip


# --- people -------------------------------------------------------------------------------------


def of_people(coverage: Coverage, size: tuple[int, int], repeats: int) -> None:
    """Accuracy, agreement, biases and practice: numbers about people alone."""
    named = f"{size[0]} x {size[1]}"
    draws = Bootstrap()
    rng = generator("orders of trials", *size)
    for study in studies("people", *size, repeats):
        test = study.test(rng)
        tables = [(accuracy_by_scenario(test, draws), "people: accuracy", _bounds("accuracy"))]
        agreement = agreement_by_scenario(test, draws, halves=2)
        for measure in ("kappa", "correlation"):
            rows = agreement[agreement["measure"] == measure]
            tables.append((rows, f"people: {measure} of pairs", _bounds("mean")))
        bias = yes_bias(test, draws)
        tables += [(bias, f"people: {name}", _bounds(name))
                   for name in ("bias", "d_prime", "criterion")]  # fmt: skip
        tables.append((side_bias(test, draws), "people: left presses", _bounds("left")))
        tables.append((learning(test), "people: practice", ("b", "low", "high")))
        for rows, what, columns in tables:
            value, low, high = rows.iloc[0][list(columns)].astype(float)
            coverage.add((what, "people", named), value, low, high)


def _bounds(name: str) -> tuple[str, str, str]:
    return name, f"{name}_low", f"{name}_high"


# --- report -------------------------------------------------------------------------------------


def markdown(table: pd.DataFrame, seconds: float, command: str) -> str:
    """The table as text: a summary by number, then every interval outside 93 to 97 %."""
    outside = table[~table["inside"].between(*BOUNDS)]
    each = table[~table["what"].str.startswith("mean of 8")]
    lines = [
        f"## {datetime.date.today()}, {platform.machine()}, `{command}`",
        "",
        f"{len(table)} intervals, {seconds:.0f} s of processor. "
        f"{_counted(each, 'of one scenario')}; {_counted(table.drop(each.index), 'of means')}.",
        "",
        "| number | intervals | lowest % | mean % | highest % | outside 93 to 97 % |",
        "|---|---|---|---|---|---|",
    ]
    for name, rows in table.groupby(table["what"].map(_number), sort=False):
        inside = rows["inside"]
        lines.append(
            f"| {name} | {len(rows)} | {inside.min():.1f} | {inside.mean():.1f} | "
            f"{inside.max():.1f} | {int((~inside.between(*BOUNDS)).sum())} |"
        )
    head = ["number", "drawn", "people x stimuli", "repeats", "mean value", "mean width",
            "inside %", "interval below %", "interval above %", "undefined"]  # fmt: skip
    lines += ["", "### Outside 93 to 97 %", "", "| " + " | ".join(head) + " |",
              "|" + "---|" * len(head)]  # fmt: skip
    lines += [
        f"| {row['what']} | {row['drawn']} | {row['size']} | {row['repeats']} | "
        f"{row['value']:.3f} | {row['width']:.3f} | {row['inside']:.1f} | {row['below']:.1f} | "
        f"{row['above']:.1f} | {row['undefined']} |"
        for row in outside.to_dict("records")
    ]
    return "\n".join(lines) + "\n"


def _counted(table: pd.DataFrame, what: str) -> str:
    inside = table["inside"]
    good = int(inside.between(*BOUNDS).sum())
    return (
        f"{good} of the {len(table)} {what} contain the expected value in 93 to 97 % of repeats "
        f"(all: {inside.min():.1f} to {inside.max():.1f} %, mean {inside.mean():.1f} %)"
    )


def _number(what: str) -> str:
    """The name without the model, and whether it is a mean."""
    mean, _, rest = what.rpartition("mean of 8: ")
    model, _, name = rest.rpartition(": ")
    name = name if model in (*MODELS, "two people") else rest
    return f"{name}, mean of 8" if mean or what.startswith("mean of 8") else name


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=800)
    sizes = [f"{people}x{stimuli}" for people, stimuli in SIZES]
    parser.add_argument("--size", nargs="+", default=sizes, help="people x stimuli")
    parser.add_argument("--write", action="store_true", help="write results/interval_coverage.md")
    options = parser.parse_args()
    coverage, began = Coverage(), time.process_time()

    def done(what: str) -> None:
        print(f"{what}: {time.process_time() - began:.0f} s", flush=True)

    for size in [(int(n), int(s)) for n, s in (text.split("x") for text in options.size)]:
        for drawn in RESAMPLED:
            measures(coverage, drawn, size, options.repeats)
            done(f"measures, {drawn} drawn, {size}")
        of_stimuli(coverage, size, options.repeats)
        of_people(coverage, size, options.repeats)
        done(f"others, {size}")
    pooled(coverage, SIZES[0], max(2, options.repeats // 4))
    command = f"python benchmarks/interval_coverage.py --repeats {options.repeats}"
    command += f" --size {' '.join(options.size)}"
    table = coverage.table()
    text = markdown(table, time.process_time() - began, command)
    print(text)
    if options.write:
        table.round(4).to_csv(RESULTS.with_suffix(".csv"), index=False, lineterminator="\n")
        RESULTS.write_text(
            "# Coverage of the intervals\n\nWhat is simulated: `benchmarks/interval_coverage.py`. "
            "Every interval: `interval_coverage.csv`.\n\n" + text
        )


if __name__ == "__main__":
    main()
