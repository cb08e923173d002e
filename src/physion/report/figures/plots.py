"""The figures of the report: for each the inputs that it needs, its table and its caption."""

from __future__ import annotations

from functools import partial

import pandas as pd
from matplotlib.figure import Figure

from physion.analysis.models import figure_tables as tables
from physion.report.figures.by_scenario import generalization_figure, grouped_figure, measure_figure
from physion.report.figures.by_stimulus import (
    calibration_figure,
    difficulty_figure,
    response_time_figure,
    scatter_figure,
)
from physion.report.figures.registry import (
    BY_SCENARIO,
    BY_STIMULUS,
    TRAINING,
    register_figure,
)
from physion.report.figures.theme import Plot, Theme
from physion.report.inputs import ReportInputs

_BAND = (
    " Hatched, in the mean over scenarios: the band of the paper, a bootstrap over the scenario "
    "means, which shows how scenarios differ and not how participants do."
)

_PROTOCOLS = (
    "Training: all scenarios together (all), all but the tested one (all-but), the tested one "
    "alone (only)."
)


@register_figure("accuracy", section=BY_SCENARIO, heading="Accuracy", order=10)
def accuracy(inputs: ReportInputs) -> Plot:
    """Return accuracy by scenario and model."""
    comparison = inputs.comparison
    caption = "Fraction of answers that equal the official outcome, with bootstrap intervals."
    if comparison.has_people:
        caption += " Dashed: people on the stimuli that any model predicts."
        if comparison.people["zone_low"].notna().any():
            caption += " Grey: the middle 95 % of participants."
        caption += _BAND
    table = tables.accuracy_table(comparison)
    return Plot("accuracy", f"{caption} Dotted: chance.", table, partial(_measure, "accuracy"))


@register_figure("r", section=BY_SCENARIO, heading="Correlation with the average person", order=20)
def correlation(inputs: ReportInputs) -> Plot | None:
    """Return Pearson's r with the average person, by scenario and model."""
    if not inputs.comparison.has_people:
        return None
    zones = None if inputs.beside is None else inputs.beside.zones
    caption = (
        "Pearson's r of P(contact) with the fraction of people who say yes, with intervals by "
        "drawing stimuli. Dashed: the noise ceiling, which a model that knows the true fractions "
        "is expected to reach."
    )
    if zones is not None:
        caption += (
            " Grey: the middle 95 % of single participants, each with the average of the others; "
            "they answer yes or no, which lowers r, so that a model can exceed them. Hatched, in "
            "the mean: the band of the paper, r between random halves of the people."
        )
    return Plot("r", caption, tables.r_table(inputs.comparison, zones), partial(_measure, "r"))


@register_figure(
    "kappa", section=BY_SCENARIO, heading="Agreement with single participants", order=30
)
def kappa(inputs: ReportInputs) -> Plot | None:
    """Return Cohen's kappa with participants, by scenario and model."""
    if inputs.beside is None:
        return None
    caption = (
        "Cohen's kappa of a model with each participant, mean over participants; intervals draw "
        "people and stimuli. Dashed: the mean kappa of people with each other; grey: the middle "
        "95 % of participants, each by the mean kappa with the others." + _BAND
    )
    table = tables.kappa_table(inputs.comparison, inputs.beside)
    return Plot("kappa", caption, table, partial(_measure, "kappa"))


@register_figure("effects", section=TRAINING, order=40)
def effects(inputs: ReportInputs) -> Plot | None:
    """Return accuracy by readout and by training protocol."""
    if inputs.predictions is None:
        return None
    table = tables.effects_table(inputs.comparison, inputs.predictions)
    if table.empty:
        return None
    caption = (
        "Accuracy by readout protocol and by training protocol, mean over scenarios, seeds of "
        "one model averaged; intervals draw stimuli. Readout full sees the whole movie. "
        f"{_PROTOCOLS}"
    )
    caption += " Dashed: people." if inputs.comparison.has_people else ""
    return Plot("effects", caption, table, _grouped_accuracy)


@register_figure("generalization", section=TRAINING, order=50)
def generalization(inputs: ReportInputs) -> Plot | None:
    """Return accuracy by training and tested scenario."""
    if inputs.predictions is None:
        return None
    table = tables.generalization_table(inputs.comparison, inputs.predictions)
    if table.empty:
        return None
    people = inputs.comparison.has_people
    base = "that of people on the same stimuli" if people else "0.5, the accuracy of guessing"
    caption = f"Trained on (rows) and tested on (columns): accuracy less {base}. {_PROTOCOLS}"
    return Plot("generalization", caption, table, generalization_figure)


@register_figure("scatter", section=BY_STIMULUS, heading="Models against people", order=60)
def scatter(inputs: ReportInputs) -> Plot | None:
    """Return P(contact) against the fraction of people who say yes."""
    comparison, shown = inputs.comparison, inputs.scatter_agents()
    if not comparison.has_people:
        return None
    caption = (
        "P(contact) of each model (rows) against the fraction of people who say yes, by scenario; "
        "one point a stimulus."
    )
    if len(comparison.changed):
        caption += " Hollow: the simulated outcome is not the official one."
    rest = comparison.agents[inputs.scatter_limit :]
    if rest:
        caption += f" Not drawn, but in tables/stimuli.csv: {', '.join(map(str, rest))}."
    return Plot("scatter", caption, tables.scatter_table(comparison, shown), scatter_figure)


@register_figure("thirds", section=BY_STIMULUS, heading="Hard, chance and easy stimuli", order=70)
def thirds(inputs: ReportInputs) -> Plot | None:
    """Return r within hard, chance and easy stimuli."""
    if not inputs.comparison.has_people:
        return None
    caption = (
        "Pearson's r with the average person within the stimuli on which people are right up to a "
        "third of the time (hard), from two thirds on (easy), and between (chance); all scenarios "
        "pooled, intervals draw stimuli. Within hard and easy stimuli the answers of people nearly "
        "determine the outcome, so a model that is always right has r below 0 in hard ones."
    )
    answers = None if inputs.people is None else inputs.people.kept.test
    if answers is not None:
        caption += (
            " Dashed: mean r between random halves of the people within the same stimuli; grey: "
            "the middle 95 % of these r. A half is a noisier average than all people, with whom "
            "models are correlated."
        )
    table = tables.thirds_table(inputs.comparison, answers)
    return Plot("thirds", f"{caption} Dotted: chance.", table, partial(_measure, "r"))


@register_figure("calibration", section=BY_STIMULUS, heading="Calibration of P(contact)", order=80)
def calibration(inputs: ReportInputs) -> Plot:
    """Return the reliability curves."""
    caption = (
        "Reliability: of the stimuli to which a model gives about this P(contact), the fraction "
        "that ends in contact, in ten bins with Wilson's 95 % intervals; the area of a point is "
        "proportional to its stimuli. The outcome is the official one. Dotted: calibrated. The "
        "Brier score is the mean squared difference of P(contact) and outcome: 0 is perfect, 0.25 "
        "that of P = 0.5."
    )
    table = tables.calibration_table(inputs.comparison)
    return Plot("calibration", caption, table, calibration_figure)


@register_figure("difficulty", section=BY_STIMULUS, heading="Stimuli that mislead people", order=90)
def difficulty(inputs: ReportInputs) -> Plot | None:
    """Return the distribution of people's accuracy over stimuli."""
    if not inputs.comparison.has_people:
        return None
    caption = (
        "Accuracy of people by stimulus. The tail: stimuli that people get wrong more often than "
        "by guessing, by the study's rule (accuracy + 1.96 standard errors below 0.5, not "
        "corrected for the number of stimuli), and those that an exact binomial test also finds "
        "after correction (false discovery rate 5 % by Benjamini and Hochberg, all stimuli "
        "together)."
    )
    by_stimulus = None if inputs.people is None else inputs.people.tables["by_stimulus"]
    table = tables.difficulty_table(inputs.comparison, by_stimulus)
    return Plot("difficulty", caption, table, difficulty_figure)


@register_figure("response_time", section=BY_STIMULUS, heading="Response times", order=100)
def response_time(inputs: ReportInputs) -> Plot | None:
    """Return response times against accuracy."""
    if inputs.people is None:
        return None
    table = tables.response_time_table(inputs.people.tables["by_stimulus"])
    if table["mean_log_rt"].isna().all():
        return None
    caption = (
        "Mean over people of the natural logarithm of their response times to a stimulus, against "
        "the accuracy of people on it, with the least-squares line. Preregistered: the less "
        "accurate, the slower."
    )
    return Plot("response_time", caption, table, response_time_figure)


def _measure(measure: str, table: pd.DataFrame, theme: Theme) -> Figure:
    return measure_figure(table, measure, theme)


def _grouped_accuracy(table: pd.DataFrame, theme: Theme) -> Figure:
    return grouped_figure(table, "accuracy", 0.5, theme)
