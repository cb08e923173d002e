"""Building blocks of the report page: tables, lists and cards; every text is escaped."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from physion.analysis.models.comparison import Comparison
from physion.analysis.tables.stimuli import in_order
from physion.report.words import number, plural

ANCHORS = "Anchors: what a score is worth"
"""Heading of the rows of anchors in a table."""


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

    Rows whose ``kind`` is anchor, if there is such a column, follow the others as a group.
    """
    cells = [[column.cell(row) for column in columns] for _, row in rows.iterrows()]
    is_anchor = [kind == "anchor" for kind in rows.get("kind", [""] * len(rows))]
    first, anchors = (
        [line for line, anchor in zip(cells, is_anchor, strict=True) if anchor is which]
        for which in (False, True)
    )
    headings = [column.heading for column in columns]
    return table(headings, first, caption, (ANCHORS, anchors)) + notes(rows, columns)


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


def warnings(texts: Sequence[str], mark: str = "") -> str:
    """Return warnings as a framed list, or nothing if there are none but the ``mark`` of the
    page.
    """
    items = "".join(f"<li>{escape(text)}</li>" for text in texts if text != mark)
    return f'<div class="warnings"><strong>Warnings</strong><ul>{items}</ul></div>' if items else ""


def paragraph(text: str) -> str:
    """Return text as a paragraph."""
    return f"<p>{escape(text)}</p>"


def table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    caption: str = "",
    below: tuple[str, Sequence[Sequence[str]]] = ("", ()),
    groups: Sequence[tuple[str, Sequence[Sequence[str]]]] = (),
) -> str:
    """Return a table; the header and the caption are text, the cells are HTML.

    ``below``, ``groups``: further groups of rows under headings of their own (text), if they have
    rows.
    """
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in header)
    above = f"<caption>{escape(caption)}</caption>" if caption else ""
    group = ""
    for heading, further in (below, *groups):
        if further:
            words = f'<th scope="rowgroup" colspan="{len(header)}"><small>{escape(heading)}</small>'
            group += f"<tbody>\n<tr>{words}</th></tr>\n{_lines(further)}\n</tbody>"
    return (
        f'<div class="wide"><table>{above}<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{_lines(rows)}\n</tbody>{group}</table></div>\n"
    )


def _lines(rows: Sequence[Sequence[str]]) -> str:
    lines = []
    for first, *rest in rows:
        cells = "".join(f"<td>{cell}</td>" for cell in rest)
        lines.append(f'<tr><th scope="row">{first}</th>{cells}</tr>')
    return "\n".join(lines)


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


def relative_links(movies: Mapping[str, Path], folder: Path) -> dict[str, str]:
    """Return the addresses of movies by stimulus, relative to ``folder``."""
    base = folder.resolve()
    return {
        stimulus: Path(os.path.relpath(path.resolve(), base)).as_posix()
        for stimulus, path in movies.items()
    }


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
