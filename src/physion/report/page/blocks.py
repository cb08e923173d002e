"""Building blocks of the report page: tables, lists and cards; every text is escaped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np
import pandas as pd

from physion.analysis.metrics import Metric, score_metrics
from physion.analysis.models.comparison import Comparison
from physion.analysis.tables.stimuli import MEAN, POOLED, in_order
from physion.report.words import number, plural


def details(title: str, content: str) -> str:
    """Return a part that opens on a click; ``content`` is HTML."""
    return f"<details><summary>{escape(title)}</summary>\n{content}</details>"


def p_value(value: float) -> str:
    """Return a p value with three decimals, or ``< .001``."""
    if pd.isna(value):
        return "NaN"
    return "&lt; 0.001" if value < 0.001 else number(value, 3)


def undefined(reason: str) -> str:
    """Return ``NaN`` with its reason on hovering, as HTML."""
    return f'<span class="none" title="{escape(reason)}">NaN</span>'


def interval(row: pd.Series, key: str, low: str = "", high: str = "", digits: int = 2) -> str:
    """Return a value with its interval in small print, as HTML; NaN with its reason if undefined.

    ``low`` and ``high``: columns of the bounds, if they are not ``key`` with _low and _high.
    """
    if pd.isna(row[key]):
        return undefined(str(row.get("reason", "")))
    bounds = row.get(low or f"{key}_low", np.nan), row.get(high or f"{key}_high", np.nan)
    if pd.isna(bounds[0]):
        return f"{number(row[key], digits)} <small>no interval</small>"
    spread = " to ".join(number(bound, digits) for bound in bounds)
    return f"{number(row[key], digits)} <small>{spread}</small>"


@dataclass(frozen=True)
class PageColumn:
    """Column of a table of the page: its heading, and the format of the value of ``key``."""

    heading: str
    key: str
    kind: Literal["text", "count", "number", "interval", "p", "percent"] = "number"
    digits: int = 2
    low: str = ""
    high: str = ""

    def cell(self, row: pd.Series) -> str:
        """Return the cell as HTML."""
        value = row.get(self.key)
        if self.kind == "interval":
            return interval(row, self.key, self.low, self.high, self.digits)
        if self.kind == "text":
            return "" if value is None or value != value else escape(str(value))
        if pd.isna(value):
            return undefined(str(row.get("reason", "")))
        if self.kind == "count":
            return str(round(float(value)))
        if self.kind == "p":
            return p_value(float(value))
        return percent(float(value)) if self.kind == "percent" else number(value, self.digits)


def rows_table(rows: pd.DataFrame, columns: Sequence[PageColumn], caption: str = "") -> str:
    """Return a table of some columns of ``rows``, with reasons of undefined numbers listed below
    it.
    """
    cells = [[column.cell(row) for column in columns] for _, row in rows.iterrows()]
    return table([column.heading for column in columns], cells, caption) + notes(rows, columns)


def notes(rows: pd.DataFrame, columns: Sequence[PageColumn]) -> str:
    """Return the values of ``reason`` once each, with the rows that they are about."""
    if "reason" not in rows:
        return ""
    given = rows[rows["reason"].astype(str).str.len() > 0]
    items = []
    for reason, subset in given.groupby("reason", sort=False):
        named = [str(row[columns[0].key]) for _, row in subset.iterrows()]
        who = ", ".join(dict.fromkeys(named)) if len(set(named)) <= 8 else f"{len(named)} rows"
        items.append(f"<li>{escape(who)}: {escape(str(reason))}</li>")
    return f'<ul class="notes">{"".join(items)}</ul>' if items else ""


def definition_list(values: Mapping[str, str]) -> str:
    """Return names and their meanings as a list."""
    rows = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in values.items())
    return f"<dl>{rows}</dl>"


def paragraph(text: str) -> str:
    """Return text as a paragraph."""
    return f"<p>{escape(text)}</p>"


def table(header: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """Return a table; the header and the caption are text, the cells are HTML."""
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in header)
    lines = []
    for first, *rest in rows:
        cells = "".join(f"<td>{cell}</td>" for cell in rest)
        lines.append(f'<tr><th scope="row">{first}</th>{cells}</tr>')
    above = f"<caption>{escape(caption)}</caption>" if caption else ""
    body = "\n".join(lines)
    return (
        f'<div class="wide"><table>{above}<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>\n"
    )


def shown_metrics(comparison: Comparison) -> list[Metric]:
    """Return the metrics of the table of scores that say something about this comparison.

    Without people those that need them are left out, and those about simulated outcomes if all
    simulated outcomes are the official ones.
    """
    simulated = ("accuracy_simulated", "r_same")
    return [
        metric
        for metric in score_metrics()
        if (comparison.has_people or metric.needs == "outcome")
        and not (comparison.changed.empty and metric.name in simulated)
    ]


def overall_table(comparison: Comparison, which: str, caption: str = "") -> str:
    """Return the table of scores: a row a model, the metrics, and the noise ceiling of r."""
    rows = comparison.scores[comparison.scores["scenario"] == which]
    shown = shown_metrics(comparison)
    header = ["model", "readout", "stimuli", *(metric.heading for metric in shown)]
    ceiling = header.index("RMSD") if comparison.has_people else None
    if ceiling is not None:
        header.insert(ceiling, "ceiling of r")
    cells = []
    for _, row in rows.iterrows():
        line = [escape(_describe_model(row)), escape(row["readout"]), str(row["stimuli"])]
        line += [interval(row, metric.name) for metric in shown]
        if ceiling is not None:
            line.insert(ceiling, number(row["ceiling"]))
        cells.append(line)
    reasons = [
        f"<li>{escape(row['agent'])}: {escape(row['reason'])}</li>"
        for _, row in rows.iterrows()
        if row["reason"]
    ]
    notes = f'<ul class="notes">{"".join(reasons)}</ul>' if reasons else ""
    return table(header, cells, caption) + notes


def _describe_model(row: pd.Series) -> str:
    """Return the model's name with what distinguishes it from others, but without the readout."""
    head = f"{row['model']} · {row['readout']}"
    return str(row["model"]) + str(row["agent"]).removeprefix(head)


def matrix(comparison: Comparison, key: str) -> str:
    """Return a score by model (rows) and scenario (columns), people on top."""
    scores = comparison.scores
    columns = [*in_order(comparison.stimuli["scenario"]), MEAN, POOLED]
    rows = []
    if comparison.has_people:
        rows.append([f"<em>{_people_title(key)}</em>", *_people_cells(comparison, key, columns)])
    for agent in comparison.agents:
        subset = scores[scores["agent"] == agent].set_index("scenario")
        cells = [
            interval(subset.loc[name], key) if name in subset.index else undefined("no predictions")
            for name in columns
        ]
        rows.append([escape(agent), *cells])
    return table(["", *columns], rows)


def _people_title(key: str) -> str:
    return "people" if key == "accuracy" else "ceiling"


def _people_cells(comparison: Comparison, key: str, columns: Sequence[str]) -> list[str]:
    people = comparison.people.set_index("scenario").assign(reason="")
    if key == "accuracy":
        return [interval(people.loc[name], key) if name in people.index else "" for name in columns]
    return [number(people.loc[name, "ceiling"]) if name in people.index else "" for name in columns]


_NO_ZONE = "known only of scenarios of which all stimuli that single participants saw are predicted"


def people(comparison: Comparison) -> str:
    """Return the table of people by scenario."""
    header = ["scenario", "stimuli", "people", "base rate", "say yes", "accuracy", "zone"]
    rows = []
    for _, row in comparison.people.assign(reason="").iterrows():
        zone = f"{number(row['zone_low'])} to {number(row['zone_high'])}"
        rows.append(
            [
                escape(row["scenario"]),
                str(row["stimuli"]),
                number(row["people"], 0),
                number(row["base_rate"]),
                number(row["yes"]),
                interval(row, "accuracy"),
                zone if np.isfinite(row["zone_low"]) else undefined(_NO_ZONE),
                number(row["reliability"], 3),
                number(row["ceiling"], 3),
            ]
        )
    return table([*header, "reliability", "ceiling of r"], rows, "People")


def definitions(comparison: Comparison) -> str:
    """Return the definitions of the columns that `overall_table` shows."""
    meaning = {metric.heading: metric.definition for metric in shown_metrics(comparison)}
    meaning |= {
        "NaN": "undefined; the reason is below the table or shown on hovering",
        "all, all-but, only": "a model's training: on all scenarios, on all but the tested one, on "
        "the tested one alone; in the files the last two are “all but this” and “same”",
    }
    return f"<h3>What the numbers mean</h3>{definition_list(meaning)}"


def changed(comparison: Comparison, links: Mapping[str, str] | None = None) -> str:
    """Return the trials whose simulated outcome is not the official one; ``links``: to their
    movies.
    """
    rows = comparison.changed
    if rows.empty:
        return "<p>None.</p>"
    counts = rows["scenario"].value_counts()
    totals = comparison.stimuli.groupby("scenario")["stimulus"].nunique()
    words = ", ".join(
        f"{name} {counts.get(name, 0)} of {totals[name]}" for name in in_order(totals.index)
    )
    header = ["stimulus", "scenario", "official", "simulated"]
    header += ["people say yes"] if comparison.has_people else []
    cells = []
    for _, row in rows.iterrows():
        line = [stimulus_link(row["stimulus"], links or {}), escape(row["scenario"])]
        line += [_outcome(row["label"]), _outcome(row["simulated"])]
        line += [percent(row["p_yes"])] if comparison.has_people else []
        cells.append(line)
    listing = details(f"{plural(len(rows), 'trial')}, one by one", table(header, cells))
    return (
        f"<p>{len(rows)} of {comparison.stimuli['stimulus'].nunique()} stimuli: {escape(words)}. "
        "There the models were shown another event than people saw, so accuracy is given against "
        "both outcomes and r also without them.</p>" + listing
    )


def stimulus_link(stimulus: str, links: Mapping[str, str]) -> str:
    """Return the name of a stimulus, as a link if ``links`` has its movie."""
    name = f"<code>{escape(stimulus)}</code>"
    return f'<a href="{escape(links[stimulus])}">{name}</a>' if stimulus in links else name


def dropped(comparison: Comparison) -> str:
    """Return counts of what was excluded, and why."""
    rows = comparison.dropped
    if rows.empty:
        return "<p>Nothing.</p>"
    keys = ["agent", "reason"]
    totals = rows.groupby(keys, sort=False)["stimuli"].sum().reset_index()
    cells = [
        [escape(row["agent"] or "people"), escape(row["reason"]), str(row["stimuli"])]
        for _, row in totals.iterrows()
    ]
    return table(["whose", "reason", "stimuli"], cells)


def _outcome(value: bool) -> str:
    return "contact" if value else "no contact"


def percent(value: float) -> str:
    """Return a fraction in percent, or ``NaN``."""
    return f"{100 * value:.0f} %" if np.isfinite(value) else "NaN"
