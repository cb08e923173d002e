"""The picture of the first screen: accuracy against likeness to people, one mark per row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox

from physion.analysis.results import one_row_each
from physion.report.figures.theme import FIRST, LIGHT, Plot, Theme, register_figure, style
from physion.report.inputs import ReportInputs

COLUMNS = ["row", "group", "given", "accuracy", "accuracy_low", "accuracy_high", "kappa",
           "kappa_low", "kappa_high"]  # fmt: skip
ZONE = ["zone_low", "zone_high", "zone_kappa_low", "zone_kappa_high"]
GROUPS = {
    "people": "people",
    "pixels": "models from pixels",
    "state": "models from true states or masks",
    "unknown": "models, inputs not stated",
    "baseline": "baselines",
}
"""Kinds of marks and their names in the key."""
_SPREAD = [(x, y) for far in (7, 15, 26, 40) for x, y in
           ((far, 0), (-far, 0), (far, far), (-far, far), (far, -far), (-far, -far), (0, far),
            (0, -far))]  # fmt: skip
"""Places of a name, in points from its mark, the best ones first."""
_LEADER = 20
"""Points from which on a thin line leads from a name to its mark."""


@register_figure("overview", section=FIRST, order=0)
def overview(inputs: ReportInputs) -> Plot | None:
    """Return accuracy against kappa with people of one row per model."""
    if not inputs.comparison.has_people:
        return None
    rows = inputs.results()
    table = rows.loc[one_row_each(rows) & rows["kappa"].notna(), COLUMNS]
    table = table.assign(**dict.fromkeys(ZONE, np.nan))
    caption = (
        "To the right: more right answers; upwards: more like single people (Cohen's kappa). Bars: "
        "95 % intervals. Dotted: guessing."
    )
    if inputs.zone is not None:
        table[ZONE] = [value for pair in inputs.zone for value in pair]
        caption += (
            " Grey: the zone of people of the study on all its stimuli, the middle 95 % of "
            "participants and of pairs of them, mean of the bounds over scenarios."
        )
    if (table["group"] == "published").any():
        caption += " Hollow: published for the study's own stimuli, not run here."
    return Plot("overview", caption, table.reset_index(drop=True), overview_figure)


_PER_LINE = 3
"""Entries of a line of the legend."""


def overview_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw one mark per row with its name; ``table``: `COLUMNS` and `ZONE`."""
    marks = {
        "people": (theme.ink, "*", 11.0),
        "pixels": (theme.palette[0], "o", 6.5),
        "state": (theme.palette[5], "s", 6.0),
        "unknown": (theme.palette[2], "^", 6.5),
        "baseline": (theme.faint, "d", 5.0),
    }
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(6.6, 4.9))
        FigureCanvasAgg(figure)
        zone = table[ZONE].iloc[0].to_numpy(np.float64)
        kinds = [_kind(group, given) for group, given in zip(table["group"], table["given"],
                                                             strict=True)]  # fmt: skip
        handles = _handles(table, kinds, marks, zone, theme)
        lines = -(-len(handles) // _PER_LINE)
        axis = figure.add_axes((0.1, 0.105, 0.885, 0.8 - 0.035 * max(lines - 2, 0)))
        if np.isfinite(zone).all():
            left, right, low, high = zone
            axis.add_patch(Rectangle((left, low), right - left, high - low, linewidth=0,
                                     facecolor=theme.zone, alpha=0.7, zorder=0))  # fmt: skip
        axis.axvline(0.5, color=theme.faint, linestyle=":", linewidth=1, zorder=1)
        axis.axhline(0.0, color=theme.faint, linestyle=":", linewidth=1, zorder=1)
        for (_, row), kind in zip(table.iterrows(), kinds, strict=True):
            _mark(axis, row, *marks[kind], theme)
        axis.set_xlabel("accuracy", fontsize=10)
        axis.set_ylabel("likeness to single people (kappa)", fontsize=10)
        x, y = (table[name].to_numpy(np.float64) for name in ("accuracy", "kappa"))
        axis.set_xlim(min(0.4, *x, *_known(zone[:2])) - 0.01, max(1.0, *x) + 0.02)
        axis.set_ylim(min(-0.05, *y) - 0.04, max(*y, *_known(zone[2:])) + 0.05)
        names = [str(name).removesuffix(" *").partition(" · ")[0] for name in table["row"]]
        _place_names(axis, x, y, names, kinds, theme)
        figure.legend(handles=handles, loc="upper center", ncols=_PER_LINE, fontsize=8,
                      columnspacing=1.2, handletextpad=0.4)  # fmt: skip
    return figure


def _kind(group: str, given: str) -> str:
    if group in ("people", "baseline"):
        return group
    if not given:
        return "unknown"
    return "state" if "state" in given or "masks" in given else "pixels"


def _known(values: Any) -> list[float]:
    return [float(value) for value in values if np.isfinite(value)]


def _mark(axis: Axes, row: pd.Series, colour: str, marker: str, size: float, theme: Theme) -> None:
    x, y = float(row["accuracy"]), float(row["kappa"])
    bars: dict[str, Any] = {"color": colour, "linewidth": 0.9, "alpha": 0.55, "zorder": 2}
    for name, fixed in (("accuracy", y), ("kappa", x)):
        ends = [float(row[f"{name}_{end}"]) for end in ("low", "high")]
        if np.isfinite(ends).all() and row["group"] != "baseline":
            along = (ends, [fixed] * 2) if name == "accuracy" else ([fixed] * 2, ends)
            axis.plot(*along, **bars)
    hollow = row["group"] == "published" or str(row["row"]).endswith(" *")
    axis.plot(x, y, linestyle="", marker=marker, markersize=size, markeredgewidth=1.2, color=colour,
              markerfacecolor=theme.paper if hollow else colour, zorder=3)  # fmt: skip


def _place_names(
    axis: Axes, x: Any, y: Any, names: Sequence[str], kinds: Sequence[str], theme: Theme
) -> None:
    """Write each name near its mark, where it covers neither another name nor a mark."""
    figure = axis.get_figure()
    canvas = figure.canvas  # type: ignore[union-attr]
    assert isinstance(canvas, FigureCanvasAgg)
    renderer: Any = canvas.get_renderer()  # type: ignore[no-untyped-call]
    frame = axis.get_window_extent()
    dots = axis.transData.transform(np.column_stack([x, y]))
    taken = [Bbox.from_bounds(px - 5, py - 5, 10, 10) for px, py in dots]
    # Names are above the bars that cross them, and below the marks.
    halo: dict[str, Any] = {"path_effects": [withStroke(linewidth=4, foreground=theme.paper)]}
    # People first, then from the rare upper right to the crowd at chance.
    order = sorted(range(len(names)), key=lambda k: (kinds[k] != "people", -y[k], names[k]))
    for k in order:
        best = None
        for dx, dy in _SPREAD:
            text = axis.annotate(
                names[k], (x[k], y[k]), (dx, dy), textcoords="offset points", fontsize=8,
                ha="left" if dx > 0 else "right" if dx < 0 else "center", va="center", zorder=2.5,
                color=theme.faint if kinds[k] == "baseline" else theme.ink, **halo,
                arrowprops={"arrowstyle": "-", "color": theme.faint, "linewidth": 0.6, "shrinkA": 0,
                            "shrinkB": 3} if max(abs(dx), abs(dy)) >= _LEADER else None,
            )  # fmt: skip
            box = Bbox.from_extents(*_text_box(text, renderer))
            inside = (
                frame.x0 < box.x0 and box.x1 < frame.x1 and frame.y0 < box.y0 < box.y1 < frame.y1
            )
            covered = sum(box.overlaps(other) for j, other in enumerate(taken) if j != k)
            if inside and not covered:
                best = text
                taken.append(box)
                break
            text.remove()
        if best is None:
            axis.annotate(names[k], (x[k], y[k]), (7, 0), textcoords="offset points", fontsize=6,
                          va="center", zorder=2.5, color=theme.faint, **halo)  # fmt: skip


def _text_box(text: Any, renderer: Any) -> tuple[float, float, float, float]:
    text.update_positions(renderer)
    box = matplotlib.text.Text.get_window_extent(text, renderer)
    return box.x0, box.y0, box.x1, box.y1


def _handles(
    table: pd.DataFrame, kinds: Sequence[str], marks: dict[str, tuple[str, str, float]], zone: Any,
    theme: Theme,
) -> list[Any]:  # fmt: skip
    dot: dict[str, Any] = {"linestyle": "", "markersize": 6.5}
    handles: list[Any] = [
        Line2D([], [], marker=marker, color=colour, label=GROUPS[kind], **dot)
        for kind, (colour, marker, _) in marks.items()
        if kind in kinds
    ]
    if (table["group"] == "published").any():
        words = "hollow: published, not run here"
        hollow = {"markerfacecolor": theme.paper, "color": theme.ink, "marker": "o", **dot}
        handles.append(Line2D([], [], label=words, **hollow))
    if np.isfinite(zone).all():
        handles.append(Patch(facecolor=theme.zone, alpha=0.7, label="zone of people, all stimuli"))
    return handles
