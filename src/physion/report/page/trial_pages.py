"""A page for each stimulus, and the list of them; written on demand next to the report."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from html import escape

import pandas as pd

from physion.analysis.tables.stimuli import in_order
from physion.report.inputs import ReportInputs
from physion.report.page.blocks import paragraph, percent, table
from physion.report.page.cards import KEY, answers, describe, outcome
from physion.report.page.document import render_document
from physion.report.page.movies import PageMovies
from physion.report.words import number, protocol_names

FOLDER = "trials"
"""Name of the folder that holds one page for each stimulus; it lies next to ``report.html``."""


def page_name(stimulus: str) -> str:
    """Return the file name of a stimulus' page; characters that are unsafe in names are replaced.

    A hash of the name keeps two stimuli apart that would be called alike.
    """
    safe = re.sub(r"[^A-Za-z0-9_-]+", "-", stimulus)[:100]
    if safe == stimulus and stimulus != "index":
        return f"{stimulus}.html"
    return f"{safe}-{hashlib.sha256(stimulus.encode()).hexdigest()[:12]}.html"


def trial_pages(inputs: ReportInputs) -> Iterator[tuple[str, str]]:
    """Yield file name and text of every page: one for each stimulus, then the list.

    Each page contains its movie and needs no other file. Raises `BadInputError` for a movie that
    cannot be read.
    """
    groups = dict(list(inputs.comparison.stimuli.groupby("stimulus", sort=False)))
    names = _ordered(inputs)
    for position, stimulus in enumerate(names):
        before = names[position - 1] if position else None
        after = names[position + 1] if position + 1 < len(names) else None
        page = _page(inputs, groups[stimulus], before, after)
        yield page_name(stimulus), protocol_names(page)
    yield "index.html", protocol_names(_index(inputs, [groups[name] for name in names]))


def _ordered(inputs: ReportInputs) -> list[str]:
    """Return the stimuli by scenario, then by name."""
    rows = inputs.comparison.stimuli.drop_duplicates("stimulus")
    return [
        str(name)
        for scenario in in_order(rows["scenario"])
        for name in sorted(rows.loc[rows["scenario"] == scenario, "stimulus"])
    ]


def _page(inputs: ReportInputs, rows: pd.DataFrame, before: str | None, after: str | None) -> str:
    first = rows.iloc[0]
    movies = PageMovies(inputs.movies, inputs.page_bytes)
    movie = movies.show(first["stimulus"], describe(rows))
    links = [("the report", "../report.html"), ("all stimuli", "index.html")]
    links += [("previous", page_name(before))] if before is not None else []
    links += [("next", page_name(after))] if after is not None else []
    ways = " · ".join(f'<a href="{escape(to)}">{words}</a>' for words, to in links)
    body = (
        f"{paragraph(_facts(first))}"
        f'<div class="trial">{movie}<div><p>{escape(inputs.question)} {outcome(first)}</p>'
        f"{answers(rows)}</div></div>"
        f'<p class="note">{escape(KEY)}</p>{_answers(rows)}'
    )
    lead = f'<p class="ways">{ways}</p>{body}'
    return render_document(first["stimulus"], lead, [], inputs.mark)


def _facts(first: pd.Series) -> str:
    """Return scenario, outcomes and people's answers as one sentence."""
    words = {True: "contact", False: "no contact"}
    official, simulated = words[bool(first["label"])], words[bool(first["simulated"])]
    outcomes = f"official outcome {official}, simulated {simulated}"
    if pd.isna(first["p_yes"]):
        return f"Scenario {first['scenario']}; {outcomes}."
    return (
        f"Scenario {first['scenario']}; {outcomes}; {first['count']:.0f} people, of whom "
        f"{percent(first['p_yes'])} say yes and {percent(first['human_accuracy'])} are right."
    )


def _answers(rows: pd.DataFrame) -> str:
    """Return the table of the models' answers."""
    people = rows["p_yes"].notna().all()
    cells = []
    for _, row in rows.iterrows():
        line = [escape(str(row["model"])), escape(str(row["readout"])), number(row["p_contact"], 3)]
        line.append("contact" if row["predicted"] else "no contact")
        line.append("yes" if bool(row["predicted"]) == bool(row["label"]) else "no")
        cells.append([*line, number(row["gap"])] if people else line)
    header = ["model", "readout", "P(contact)", "answer", "right"]
    return table([*header, "P less people"] if people else header, cells)


def _index(inputs: ReportInputs, groups: list[pd.DataFrame]) -> str:
    people = inputs.comparison.has_people
    cells = []
    for rows in groups:
        first = rows.iloc[0]
        right = (rows["predicted"].astype(bool) == rows["label"].astype(bool)).sum()
        name = str(first["stimulus"])
        line = [f'<a href="{escape(page_name(name))}"><code>{escape(name)}</code></a>']
        line += [escape(str(first["scenario"])), outcome(first)]
        line += [percent(first["human_accuracy"])] if people else []
        cells.append([*line, f"{right} of {len(rows)}"])
    header = ["stimulus", "scenario", "outcome", *(["people right"] if people else [])]
    body = table([*header, "models right"], cells)
    lead = '<p class="ways"><a href="../report.html">the report</a></p>'
    return render_document("Every stimulus", lead + body, [], inputs.mark)
