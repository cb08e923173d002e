"""Appearance and registry of figures: colours, marks that need no colour, and the bytes.

The colours come from Okabe and Ito; every difference of colour is also one of hatch or marker. The
bytes depend on the tables and on the version of matplotlib, not on the time or the process.
"""

from __future__ import annotations

import importlib
import io
import math
import pkgutil
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from physion.core.registry import Registry
from physion.report.inputs import ReportInputs


@dataclass(frozen=True)
class Theme:
    """Colours of page and figures: paper, ink, faint lines, human zone, palette."""

    name: str
    paper: str
    ink: str
    faint: str
    zone: str
    palette: tuple[str, ...]

    def mark(self, index: int) -> tuple[str, str]:
        """Return colour and marker of the ``index``-th of things to distinguish."""
        return self.palette[index % len(self.palette)], MARKERS[index % len(MARKERS)]


_OKABE_ITO = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#B8A800")
_BRIGHT = ("#4FA8E0", *_OKABE_ITO[1:4], "#A5DAF5", *_OKABE_ITO[5:])
LIGHT = Theme("light", "#ffffff", "#1b1f24", "#8a9099", "#d9dde3", (*_OKABE_ITO, "#4d4d4d"))
DARK = Theme("dark", "#15181d", "#e6e8eb", "#7d848e", "#3a414b", (*_BRIGHT, "#c9c9c9"))

HATCHES = ("", "///", "...", "xx", "\\\\\\", "ooo", "++", "--")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")


@dataclass(frozen=True)
class Plot:
    """Figure as data: it draws ``table`` and nothing else.

    ``name``: of its files; ``caption``: the text below it; ``draw``: draws the table in a theme.
    """

    name: str
    caption: str
    table: pd.DataFrame
    draw: Callable[[pd.DataFrame, Theme], Figure]


def panels(
    count: int, columns: int, size: tuple[float, float], above: float = 0.9, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure of ``count`` panels, each about ``size`` inches, and its axes row by row.

    With fewer panels than ``columns`` the rest of the width stays empty, so that panels have the
    size that they have in other figures. ``above`` is space for the legend. Of panels that share an
    axis only the outer ones have ticks with numbers, see `outer`. Call it inside
    ``rc_context(style(theme))``.
    """
    rows = math.ceil(count / columns)
    width, height = size
    figure = Figure(figsize=(width * columns, height * rows + above), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False, **shared).flat)
    for axis in axes[count:]:
        axis.set_visible(False)
    for index, axis in enumerate(axes[:count]):
        outer(axis, index, count, columns, shared)
    return figure, axes[:count]


def outer(axis: Axes, index: int, count: int, columns: int, shared: Mapping[str, Any]) -> None:
    """Remove ticks without numbers, and add them to a panel with no panel below."""
    if shared.get("sharex"):
        last = index + columns >= count
        axis.tick_params(axis="x", bottom=last, labelbottom=last)
    if shared.get("sharey"):
        first = index % columns == 0
        axis.tick_params(axis="y", left=first, labelleft=first)


def legend(figure: Figure, handles: Sequence[Any], columns: int) -> None:
    """Draw one legend for all panels, above them."""
    figure.legend(
        handles=list(handles), loc="outside upper center", ncols=min(columns, len(handles))
    )


def label(model: str, width: int = 48) -> str:
    """Return the name of a model for an axis, as on the page, broken into lines."""
    return textwrap.fill(str(model), width)


def title(axis: Axes, text: str) -> None:
    """Set the heading of a panel."""
    axis.set_title(text, fontsize=10, fontweight="bold", loc="left")


_METADATA: dict[str, dict[str, None]] = {
    "svg": {"Date": None},
    "png": {"Software": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
}
"""Entries that differ with time and program, by format."""


def figure_bytes(figure: Figure, kind: str) -> bytes:
    """Return a figure as ``svg``, ``png`` or ``pdf``, without date, version or random names.

    Letters of an SVG are outlines, which look the same everywhere. A PDF embeds its font, so that
    its letters can be edited and searched.
    """
    buffer = io.BytesIO()
    letters: Any = {"svg.hashsalt": "physion", "svg.fonttype": "path", "pdf.fonttype": 42}
    with matplotlib.rc_context(letters):
        figure.savefig(buffer, format=kind, dpi=150, metadata=_METADATA[kind])
    # The layout is the same for every format and slow to compute.
    figure.set_layout_engine("none")
    return buffer.getvalue()


def darkened(svg: bytes) -> bytes:
    """Return the SVG of a light figure in the colours of the dark theme, without drawing it again.

    Colours that are not of the light theme stay.
    """
    pairs = zip(_colors(LIGHT), _colors(DARK), strict=True)
    dark = {old.lower().encode(): new.lower().encode() for old, new in pairs}
    return re.sub(rb"#[0-9a-f]{6}\b", lambda match: dark.get(match[0], match[0]), svg)


def _colors(theme: Theme) -> tuple[str, ...]:
    return theme.paper, theme.ink, theme.faint, theme.zone, *theme.palette


def style(theme: Theme) -> Any:
    """Return settings for ``rc_context``; the type in matplotlib would list every key."""
    return {
        "font.family": "DejaVu Sans",
        "font.size": 9,
        "text.color": theme.ink,
        "axes.labelcolor": theme.ink,
        "axes.edgecolor": theme.faint,
        "axes.facecolor": theme.paper,
        "figure.facecolor": theme.paper,
        "savefig.facecolor": theme.paper,
        "xtick.color": theme.ink,
        "ytick.color": theme.ink,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "hatch.linewidth": 0.8,
        # The user's matplotlib settings must not change the report.
        "text.usetex": False,
        "text.parse_math": False,
        "path.simplify": True,
    }


# --- registry of figures ------------------------------------------------------------------------
#
# A figure is a function from `ReportInputs` to a `Plot`, decorated with `register_figure`. The
# modules of this folder are imported, and those that other packages name under the entry points
# ``physion.figures``. ``docs/how-to/add-a-figure.md`` shows how to add one.

FIRST = "First screen"
BY_SCENARIO = "By scenario"
TRAINING = "Readout and training"
BY_STIMULUS = "Stimulus by stimulus"
"""Sections of the page that contain figures; `FIRST` is the space before the first section."""

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
