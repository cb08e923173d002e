"""Calibration of P(contact)."""

from __future__ import annotations

import matplotlib
import pandas as pd
from matplotlib.figure import Figure

from physion.analysis.models import figure_tables as tables
from physion.report.figures.registry import BY_STIMULUS, register_figure
from physion.report.figures.theme import LIGHT, Plot, Theme, label, panels, style
from physion.report.inputs import ReportInputs


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


def calibration_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw reliability curves: the fraction of contact by predicted P(contact); one panel a model.

    ``table``: see `figure_tables.calibration_table`. The area of a point is proportional to its
    stimuli.
    """
    agents = list(table["agent"].unique())
    columns = 3 if len(agents) <= 6 else 5
    with matplotlib.rc_context(style(theme)):
        width = 11 / columns
        figure, axes = panels(len(agents), columns, (width, width + 0.2), above=0.5,
                              sharex=True, sharey=True)  # fmt: skip
        for axis, agent in zip(axes, agents, strict=True):
            rows = table[(table["agent"] == agent) & (table["stimuli"] > 0)]
            axis.plot([0, 1], [0, 1], color=theme.faint, linewidth=1, linestyle=":")
            axis.vlines(rows["mean_p"], rows["low"], rows["high"], color=theme.palette[0],
                        linewidth=1.1)  # fmt: skip
            axis.plot(rows["mean_p"], rows["share"], color=theme.palette[0], linewidth=0.8)
            fraction = rows["stimuli"] / rows["stimuli"].sum()
            axis.scatter(rows["mean_p"], rows["share"], s=8 + 160 * fraction, zorder=3,
                         color=theme.palette[0], edgecolors=theme.ink, linewidths=0.6)  # fmt: skip
            words = label(agent, 30 if columns == 5 else 44)
            brier = table.loc[table["agent"] == agent, "brier"].iloc[0]
            axis.set_title(f"{words}\nBrier {brier:.3f}", fontsize=8, loc="left")
            axis.set_xlim(-0.03, 1.03)
            axis.set_ylim(-0.03, 1.03)
            axis.set_aspect("equal")
            axis.set_xticks([0, 0.5, 1])
            axis.set_yticks([0, 0.5, 1])
        figure.supxlabel("P(contact) of the model", fontsize=10)
        figure.supylabel("share of stimuli with contact", fontsize=10)
    return figure
