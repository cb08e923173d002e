"""Response times of people against their accuracy, by stimulus."""

from __future__ import annotations

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from physion.analysis.models import figure_tables as tables
from physion.analysis.statistics.agreement import pearson
from physion.analysis.tables.stimuli import in_order
from physion.report.figures.registry import BY_STIMULUS, register_figure
from physion.report.figures.theme import LIGHT, Plot, Theme, panels, style, title
from physion.report.inputs import ReportInputs
from physion.report.words import number

CAPTION = (
    "Mean over people of the natural logarithm of their response times to a stimulus, against the "
    "accuracy of people on it, with the least-squares line. Preregistered: the less accurate, the "
    "slower."
)


@register_figure("response_time", section=BY_STIMULUS, heading="Response times", order=100)
def response_time(inputs: ReportInputs) -> Plot | None:
    """Return response times against accuracy."""
    if inputs.people is None:
        return None
    table = tables.response_time_table(inputs.people.tables["by_stimulus"])
    if table["mean_log_rt"].isna().all():
        return None
    return Plot("response_time", CAPTION, table, response_time_figure)


def response_time_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw the mean log response time of a stimulus against its accuracy, by scenario, with a line.

    ``table``: see `figure_tables.response_time_table`.
    """
    scenarios = in_order(table["scenario"])
    with matplotlib.rc_context(style(theme)):
        size = (11 / 4, 2.5)
        figure, axes = panels(len(scenarios), 4, size, above=0.3, sharex=True, sharey=True)
        for index, (axis, scenario) in enumerate(zip(axes, scenarios, strict=True)):
            rows = table[(table["scenario"] == scenario) & table["mean_log_rt"].notna()]
            x = rows["accuracy"].to_numpy(dtype=np.float64)
            y = rows["mean_log_rt"].to_numpy(dtype=np.float64)
            colour, marker = theme.mark(index)
            axis.plot(x, y, linestyle="", marker=marker, color=colour, markersize=3.6, alpha=0.7,
                      markeredgewidth=0)  # fmt: skip
            r = pearson(x, y)
            if np.isfinite(r):
                slope, level = np.polyfit(x, y, 1)
                ends = np.array([x.min(), x.max()])
                axis.plot(ends, level + slope * ends, color=theme.ink, linewidth=1.3)
            title(axis, scenario)
            axis.set_title(f"r = {number(r)}", fontsize=8.5, loc="right")
            axis.set_xlim(-0.03, 1.03)
            axis.set_xticks([0, 0.5, 1])
        figure.supxlabel("accuracy of people on a stimulus", fontsize=10)
        figure.supylabel("mean log response time (log ms)", fontsize=10)
    return figure
