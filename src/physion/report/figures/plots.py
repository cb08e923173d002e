"""Which figures a report has, what is in them, and the words under them."""

from __future__ import annotations

from functools import partial

import pandas as pd
from matplotlib.figure import Figure

from physion.analysis.models.comparison import Comparison
from physion.report.figures import figure_tables as tables
from physion.report.figures.by_scenario import generalization_figure, grouped_figure, measure_figure
from physion.report.figures.by_stimulus import (
    calibration_figure,
    difficulty_figure,
    response_time_figure,
    scatter_figure,
)
from physion.report.figures.theme import Plot, Theme
from physion.report.inputs import ReportInputs


def plots(inputs: ReportInputs) -> list[Plot]:
    """The figures that these inputs permit, in the order of the page."""
    comparison, people = inputs.comparison, inputs.people
    found = [_accuracy(comparison)]
    if comparison.has_people:
        found.append(_r(inputs))
    if inputs.beside is not None:
        table = tables.kappa_table(comparison, inputs.beside)
        found.append(Plot("kappa", _KAPPA, table, partial(_measure, "kappa")))
    if inputs.predictions is not None:
        found += _training(inputs, inputs.predictions)
    if comparison.has_people:
        found += [_scatter(inputs), _thirds(inputs)]
    found.append(
        Plot("calibration", _CALIBRATION, tables.calibration_table(comparison), _calibration)
    )
    if comparison.has_people:
        by_stimulus = None if people is None else people.tables["by_stimulus"]
        table = tables.difficulty_table(comparison, by_stimulus)
        found.append(Plot("difficulty", _DIFFICULTY, table, difficulty_figure))
    if people is not None:
        table = tables.response_time_table(people.tables["by_stimulus"])
        if table["mean_log_rt"].notna().any():
            found.append(Plot("response_time", _RESPONSE_TIME, table, response_time_figure))
    return found


def _accuracy(comparison: Comparison) -> Plot:
    words = "Share of answers that equal the official outcome, with bootstrap intervals."
    if comparison.has_people:
        words += " Dashed: people on the stimuli that any model predicts."
        if comparison.people["zone_low"].notna().any():
            words += " Grey: the middle 95 % of participants."
        words += _BAND
    table = tables.accuracy_table(comparison)
    return Plot("accuracy", f"{words} Dotted: chance.", table, partial(_measure, "accuracy"))


_BAND = (
    " Hatched, in the mean over scenarios: the band of the paper, a bootstrap over the scenario "
    "means, which says how these differ and not how participants do."
)


def _r(inputs: ReportInputs) -> Plot:
    zones = None if inputs.beside is None else inputs.beside.zones
    words = (
        "Pearson's r of P(contact) with the share of people who say yes, with intervals by "
        "drawing stimuli. Dashed: the ceiling, which a model that knows the true shares is "
        "expected to reach."
    )
    if zones is not None:
        words += (
            " Grey: the middle 95 % of single participants, each with the average of the others; "
            "they answer yes or no, which costs r, so that a model can pass them. Hatched, in "
            "the mean: the band of the paper, r between random halves of the people."
        )
    return Plot("r", words, tables.r_table(inputs.comparison, zones), partial(_measure, "r"))


_KAPPA = (
    "Cohen's kappa of a model with each participant, mean over participants; intervals draw people "
    "and stimuli. Dashed: the mean kappa of people with each other; grey: the middle 95 % of "
    "participants, each by the mean kappa with the others." + _BAND
)


_PROTOCOLS = (
    "Training: all scenarios together (all), all but the tested one (all-but), the tested one "
    "alone (only)."
)


def _training(inputs: ReportInputs, predictions: pd.DataFrame) -> list[Plot]:
    comparison, found = inputs.comparison, []
    table = tables.effects_table(comparison, predictions)
    if len(table):
        words = (
            "Accuracy by readout protocol and by training protocol, mean over scenarios, seeds of "
            "one model averaged; intervals draw stimuli. Readout full sees the whole movie. "
            f"{_PROTOCOLS}"
        )
        words += " Dashed: people." if comparison.has_people else ""
        found.append(Plot("effects", words, table, _grouped_accuracy))
    table = tables.generalization_table(comparison, predictions)
    if len(table):
        base = "that of people on the same stimuli" if comparison.has_people else "0.5, a guesser's"
        words = f"Trained on (rows) and tested on (columns): accuracy less {base}. {_PROTOCOLS}"
        found.append(Plot("generalization", words, table, _generalization))
    return found


def _scatter(inputs: ReportInputs) -> Plot:
    comparison, shown = inputs.comparison, inputs.scatter_agents()
    words = (
        "P(contact) of each model (rows) against the share of people who say yes, by scenario; one "
        "point a stimulus."
    )
    if len(comparison.changed):
        words += " Hollow: the simulated outcome is not the official one."
    rest = comparison.agents[inputs.scatter_limit :]
    words += f" Not drawn, but in tables/stimuli.csv: {', '.join(map(str, rest))}." if rest else ""
    return Plot("scatter", words, tables.scatter_table(comparison, shown), scatter_figure)


def _thirds(inputs: ReportInputs) -> Plot:
    words = (
        "Pearson's r with the average person within the stimuli on which people are right up to a "
        "third of the time (hard), from two thirds on (easy), and between (chance); all scenarios "
        "pooled, intervals draw stimuli. Within hard and easy stimuli the answers of people nearly "
        "tell the outcome, so that a model which is right throughout has r below 0 in hard ones."
    )
    answers = None if inputs.people is None else inputs.people.kept.test
    if answers is not None:
        words += (
            " Dashed: mean r between random halves of the people within the same stimuli; grey: "
            "the middle 95 % of these r. A half is a noisier average than all people, to whom "
            "models are held."
        )
    table = tables.thirds_table(inputs.comparison, answers)
    return Plot("thirds", f"{words} Dotted: chance.", table, partial(_measure, "r"))


_CALIBRATION = (
    "Reliability: of the stimuli to which a model gives about this P(contact), the share that ends "
    "in contact, in ten bins with Wilson's 95 % intervals; the area of a point goes with its "
    "stimuli. The outcome is the official one. Dotted: calibrated. The "
    "Brier score is the mean squared difference of P(contact) and outcome: 0 is perfect, 0.25 that "
    "of P = 0.5."
)

_DIFFICULTY = (
    "Accuracy of people by stimulus. The tail: stimuli that people get wrong more often than by "
    "guessing, by the study's rule (accuracy + 1.96 standard errors below 0.5, not corrected for "
    "the number of stimuli), and those that an exact binomial test also finds after correction "
    "(false discovery rate 5 % by Benjamini and Hochberg, all stimuli together)."
)

_RESPONSE_TIME = (
    "Mean over people of the natural logarithm of their response times to a stimulus, against "
    "the accuracy of people on it, with the line of least squares. Preregistered: the less "
    "accurate, the slower."
)


def _measure(measure: str, table: pd.DataFrame, theme: Theme) -> Figure:
    return measure_figure(table, measure, theme)


def _grouped_accuracy(table: pd.DataFrame, theme: Theme) -> Figure:
    return grouped_figure(table, "accuracy", 0.5, theme)


def _generalization(table: pd.DataFrame, theme: Theme) -> Figure:
    return generalization_figure(table, theme)


def _calibration(table: pd.DataFrame, theme: Theme) -> Figure:
    return calibration_figure(table, theme)
