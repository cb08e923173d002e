"""Error of imagined motion over time."""

from __future__ import annotations

from typing import Any

import matplotlib
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from physion.analysis.models.rollout_errors import CONSTANT_VELOCITY
from physion.analysis.tables.stimuli import MEAN
from physion.report.figures.registry import BY_SCENARIO, register_figure
from physion.report.figures.theme import Plot, Theme, label, legend, panels, style, title
from physion.report.inputs import ReportInputs

_DASHES = ("-", (0, (6, 1.5)), "-.", (0, (1, 1)))
"""Lines of models, so that they differ without colour."""


@register_figure("rollout_error", section=BY_SCENARIO, heading="Error of imagined motion", order=35)
def rollout_error(inputs: ReportInputs) -> Plot | None:
    """Return the error of rollouts over time by scenario and model."""
    table = inputs.rollout_errors
    if table is None or table.empty:
        return None
    caption = (
        "Distance of the centres of objects between imagined and true motion, mean over objects "
        "and trials, over the time after the last observed frame. Bands: 95 % intervals, "
        f"which draw trials. Dotted: {CONSTANT_VELOCITY} from the last two observed steps, cut off "
        "where it leaves the panel. The panels have different scales."
    )
    return Plot("rollout_error", caption, table, draw)


def draw(table: pd.DataFrame, theme: Theme) -> Figure:
    """Draw curves with bands, one panel a scenario; ``table``: see `rollout_errors.COLUMNS`."""
    names = list(table["panel"].unique())
    models = list(table.loc[table["kind"] == "model", "agent"].unique())
    lines: dict[str, dict[str, Any]] = {
        agent: {"color": theme.mark(place)[0], "linestyle": _DASHES[place % len(_DASHES)]}
        for place, agent in enumerate(models)
    }
    lines[CONSTANT_VELOCITY] = {"color": theme.ink, "linestyle": ":"}
    with matplotlib.rc_context(style(theme)):
        figure, axes = panels(len(names), min(3, len(names)), (3.6, 2.2), sharex=True)
        for axis, name in zip(axes, names, strict=True):
            rows = table[table["panel"] == name]
            for agent, line in lines.items():
                own = rows[rows["agent"] == agent].sort_values("seconds")
                axis.plot(own["seconds"], own["value"], linewidth=1.5, **line)
                axis.fill_between(
                    own["seconds"], own["low"], own["high"], color=line["color"], alpha=0.18,
                    linewidth=0,
                )  # fmt: skip
            top = rows.loc[rows["kind"] == "model", ["value", "high"]].max().max()
            base = rows.loc[rows["kind"] == "baseline", "value"].max()
            axis.set_ylim(0, 1.05 * max(top, min(base, 2 * top), 1e-3))
            axis.set_xlim(0, table["seconds"].max())
            title(axis, "mean over scenarios" if name == MEAN else str(name))
        figure.supxlabel("seconds of physics after the last observed frame", fontsize=10)
        figure.supylabel("error (m)", fontsize=10)
        handles = [Line2D([], [], label=label(agent), **line) for agent, line in lines.items()]
        legend(figure, handles, 3)
    return figure
