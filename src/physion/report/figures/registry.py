"""Registry of the figures of a report, so that a new figure is one new file below this folder.

A figure is a function from `ReportInputs` to a `Plot`, decorated with `register_figure`. All
modules of this folder and its sub-folders are imported, and those that other packages name under
the entry points ``physion.figures``. ``docs/how-to/add-a-figure.md`` shows how to add one.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass

from physion.core.registry import Registry
from physion.report.figures.theme import Plot
from physion.report.inputs import ReportInputs

BY_SCENARIO = "By scenario"
TRAINING = "Readout and training"
BY_STIMULUS = "Stimulus by stimulus"
"""Sections of the page that contain figures."""

MakePlot = Callable[[ReportInputs], Plot | None]


@dataclass(frozen=True)
class FigureEntry:
    """A figure of the report.

    - ``name``: of its files, unique;
    - ``make``: from the inputs to the plot, or None if they do not permit it;
    - ``section``, ``heading``: the place in the page; an empty heading is left out;
    - ``order``: figures of a section are sorted by it.
    """

    name: str
    make: MakePlot
    section: str
    heading: str
    order: int


figures: Registry[FigureEntry] = Registry("figure")
"""Every figure by name."""


def register_figure(
    name: str, *, section: str, heading: str = "", order: int = 1000
) -> Callable[[MakePlot], MakePlot]:
    """Register the decorated function as a figure; see `FigureEntry` for the parameters."""

    def add(make: MakePlot) -> MakePlot:
        figures.register(name)(FigureEntry(name, make, section, heading, order))
        return make

    return add


def all_figures() -> list[FigureEntry]:
    """Return every figure, sorted by order and name."""
    package = importlib.import_module("physion.report.figures")
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        importlib.import_module(module.name)
    entries = [figures.get(name) for name in figures.names()]
    return sorted(entries, key=lambda entry: (entry.order, entry.name))


def make_plots(inputs: ReportInputs) -> list[Plot]:
    """Return the figures that these inputs permit, in order; one without a value is left out."""
    made = [entry.make(inputs) for entry in all_figures()]
    return [plot for plot in made if plot is not None and len(plot.table)]
