"""Intervals of models and of their agreement with people, for `interval_coverage.py`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd

from coverage_studies import F64, MODELS, SCENARIOS, Coverage, Size, Study
from physion.analysis.intervals import Variance, jackknife
from physion.analysis.metrics import all_metrics, metrics
from physion.analysis.model_tests import PooledStimuli, paired_tests
from physion.analysis.rollout_errors import CONSTANT_VELOCITY, rollout_error_table
from physion.analysis.sample import Resampled, Sample
from physion.analysis.scores import score_table
from physion.analysis.statistics.agreement import correlate_rows
from physion.analysis.tables import MEAN, POOLED
from physion.analysis.with_participants import sample_of_models, sampling_variances
from physion.core.seeds import generator

LEFT_OUT = ("accuracy_simulated", "r_same", "euclid_over_n")
"""Metrics that equal others where the simulated outcome is the official one, or up to a factor."""


def measures(coverage: Coverage, drawn: Resampled, size: Size, repeats: int) -> None:
    """Every metric of every model, of one scenario and of the mean over eight."""
    computes: dict[str, Callable[[Sample], F64]] = {}
    for metric in all_metrics():
        if drawn not in metric.resampled or metric.name in LEFT_OUT:
            continue
        if coverage.wants(*(f"mean of 8: {model}: {metric.name}" for model in MODELS)):
            computes[metric.name] = metric
        pair = f"two people: {metric.name}"
        if metric.two_people is not None and coverage.wants(f"mean of 8: {pair}"):
            computes[pair] = metric.of_two_people
    if not computes:
        return
    values: dict[str, list[F64]] = {}
    variances: dict[str, list[Variance]] = {}
    for study in coverage.studies(drawn, size, repeats):
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
            what = name if name.startswith("two people") else f"{MODELS[k]}: {name}"
            for r in range(repeats):
                variance = Variance(spread.value[r, k], spread.df[r, k])
                one = float(value[r, k])
                coverage.add(what, drawn, size, one, *variance.interval(one, 0.95, scale))
            # Of independent scenarios; their population is the same, so is the expected value.
            mean = np.array([value[group, k].mean() for group in groups])
            total = np.array([spread.value[group, k].sum() for group in groups])
            parts = np.array([(spread.value[g, k] ** 2 / spread.df[g, k]).sum() for g in groups])
            with np.errstate(invalid="ignore"):
                df = np.where(total > 0, total**2 / parts, 1.0)
            for r in range(repeats):
                variance = Variance(total[r] / SCENARIOS**2, df[r])
                one = float(mean[r])
                coverage.add(f"mean of 8: {what}", drawn, size, one,
                             *variance.interval(one, 0.95, scale))  # fmt: skip


def of_stimuli(coverage: Coverage, size: Size, repeats: int) -> None:
    """Differences between models, and r in a third of the stimuli."""
    pairs = [f"{a} less {b}: r" for a in MODELS for b in MODELS]
    easy = [f"{name}: r, easy stimuli" for name in MODELS]
    wanted = [coverage.wants(*names) for names in (pairs, easy)]
    if not any(wanted):
        return
    for study in coverage.studies("stimuli", size, repeats):
        if wanted[0]:
            _differences(coverage, size, study)
        if wanted[1]:
            _easy(coverage, size, study)


def _differences(coverage: Coverage, size: Size, study: Study) -> None:
    """Add differences of two models in r on all stimuli."""
    pooled = PooledStimuli(
        names=MODELS,
        p_contact=study.p_contact,
        correct=((study.p_contact > 0.5) == study.label).astype(np.float64),
        label=study.label,
        p_yes=study.p_yes,
        scenario=("drop",) * len(study.label),
    )
    for row in paired_tests(pooled, permutations=1).to_dict("records"):
        what = f"{row['first']} less {row['second']}: r"
        coverage.add(what, "stimuli", size, row["r_difference"], row["r_difference_low"],
                     row["r_difference_high"])  # fmt: skip


def _easy(coverage: Coverage, size: Size, study: Study) -> None:
    easy = study.right >= 2 / 3
    p_yes, without = study.p_yes[easy], 1 - np.eye(int(easy.sum()))
    y = np.broadcast_to(p_yes, without.shape)
    for k, name in enumerate(MODELS):
        x = study.p_contact[k : k + 1, easy]
        r = float(correlate_rows(x, p_yes[None])[0])
        left = correlate_rows(np.where(without > 0, x, np.nan), y)
        variance = jackknife(left[:, None]).of(0)
        coverage.add(f"{name}: r, easy stimuli", "stimuli", size, r,
                     *variance.interval(r, 0.95, "correlation"))  # fmt: skip


def rollout_errors(coverage: Coverage, size: Size, repeats: int) -> None:
    """Mean errors of rollouts: log-normal ones of a model, exponential ones of the baseline."""
    shapes = {"model": "log-normal", CONSTANT_VELOCITY: "exponential"}
    if not coverage.wants(*(f"mean of 8: rollout error, {name}" for name in shapes.values())):
        return
    rng, stimuli = generator("rollout errors", *size), size[1]
    scenario = np.repeat([f"s{k}" for k in range(SCENARIOS)], stimuli)
    names = np.arange(len(scenario)).astype(str)
    for _ in range(repeats):
        errors = pd.DataFrame(
            {"model": "model", "scenario": scenario, "stimulus": names, "seconds": 0.03,
             "error": rng.lognormal(0, 1, len(names)),
             "baseline": rng.exponential(1, len(names))}
        )  # fmt: skip
        table = rollout_error_table(errors).set_index(["panel", "model"])
        for model, shape in shapes.items():
            for panel, row in table.xs(model, level="model").iterrows():
                prefix = "mean of 8: " if panel == MEAN else ""
                coverage.add(f"{prefix}rollout error, {shape}", "stimuli", size, row["value"],
                             row["low"], row["high"])  # fmt: skip


def pooled(coverage: Coverage, size: Size, repeats: int) -> None:
    """The rows of all stimuli pooled and of the mean of the table of scores."""
    named = f"8 x {size[0]} x {size[1]}"
    shown = ("accuracy", "r", "kappa_from_averages", "rmsd", "r_beyond_outcome")
    scores = [f"good, {where}: {name}" for where in (MEAN, POOLED) for name in shown]
    if not coverage.wants(*scores):
        return
    drawn = coverage.studies("stimuli", size, SCENARIOS * repeats)
    for _ in range(repeats):
        parts = {f"s{k}": next(drawn) for k in range(SCENARIOS)}
        rows = [_good(name, study, size[0]) for name, study in parts.items()]
        table = score_table(pd.concat(rows, ignore_index=True)).set_index("scenario")
        for where in (MEAN, POOLED):
            for name in shown:
                row = table.loc[where]
                coverage.add(f"good, {where}: {name}", "stimuli", named, row[name],
                             row[f"{name}_low"], row[f"{name}_high"])  # fmt: skip


def _good(scenario: str, study: Study, people: int) -> pd.DataFrame:
    """Return the rows of the model *good* as a table of a comparison has them."""
    p_contact, label = study.p_contact[1], study.label.astype(bool)
    return pd.DataFrame(
        {
            "model": "good", "base_model": "good", "readout": "", "scenario": scenario,
            "stimulus": [f"{scenario} {k:03d}" for k in range(len(label))],
            "p_contact": p_contact, "predicted": p_contact > 0.5, "label": label,
            "simulated": label, "count": people, "p_yes": study.p_yes,
            "human_accuracy": study.right,
        }
    )  # fmt: skip
