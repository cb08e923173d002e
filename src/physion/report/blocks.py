"""The pieces of the report page: tables, lists and cards, every text escaped."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
import pandas as pd

from physion.analysis.comparison import Comparison
from physion.analysis.tables import MEAN, POOLED, in_order

DASH = "–"


def section(title: str, content: str) -> str:
    """A part of the page under a heading; ``content`` is HTML."""
    return f"<section><h2>{escape(title)}</h2>\n{content}</section>"


def details(title: str, content: str) -> str:
    """A part that opens on a click; ``content`` is HTML."""
    return f"<details><summary>{escape(title)}</summary>\n{content}</details>"


def plural(count: int, noun: str) -> str:
    """``1 model``, ``2 models``, ``2 stimuli``."""
    many = noun.removesuffix("us") + "i" if noun.endswith("us") else noun + "s"
    return f"{count} {noun if count == 1 else many}"


def number(value: float, digits: int = 2) -> str:
    """A number with so many decimals, a minus that is one, no minus zero, a dash for NaN."""
    if not np.isfinite(value):
        return DASH
    # Adding zero turns -0.0 into 0.0.
    return f"{round(float(value), digits) + 0.0:.{digits}f}".replace("-", "−")


def interval(row: pd.Series, key: str) -> str:
    """A value with its interval in small print, as HTML; the reason on hovering where undefined."""
    if not np.isfinite(row[key]):
        return f'<span class="none" title="{escape(str(row["reason"]))}">{DASH}</span>'
    low, high = row[f"{key}_low"], row[f"{key}_high"]
    spread = f"{number(low)} to {number(high)}" if np.isfinite(low) else "no interval"
    return f"{number(row[key])} <small>{spread}</small>"


def table(header: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """A table; the header and the caption are text, the cells are HTML."""
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


def overall_table(comparison: Comparison, which: str, caption: str = "") -> str:
    """A row a model: accuracy against both outcomes, beside people; r with its ceiling; RMSD."""
    rows = comparison.scores[comparison.scores["scenario"] == which]
    header = ["model", "readout", "stimuli", "accuracy", "against simulated outcome"]
    if comparison.has_people:
        header += ["people", "difference", "Pearson r", "r, same outcome", "ceiling of r", "RMSD"]
    cells = []
    for _, row in rows.iterrows():
        line = [escape(_model_words(row)), escape(row["readout"]), str(row["stimuli"])]
        keys = ["accuracy", "accuracy_simulated"]
        if comparison.has_people:
            keys += ["human_accuracy", "difference", "r", "r_same"]
        line += [interval(row, key) for key in keys]
        if comparison.has_people:
            line += [number(row["ceiling"]), interval(row, "rmsd")]
        cells.append(line)
    reasons = [
        f"<li>{escape(row['agent'])}: {escape(row['reason'])}</li>"
        for _, row in rows.iterrows()
        if row["reason"]
    ]
    notes = f'<ul class="notes">{"".join(reasons)}</ul>' if reasons else ""
    return table(header, cells, caption) + notes


def _model_words(row: pd.Series) -> str:
    """The model's name with what tells it from others of that name, but without the readout."""
    head = f"{row['model']} · {row['readout']}"
    return str(row["model"]) + str(row["agent"]).removeprefix(head)


def matrix(comparison: Comparison, key: str) -> str:
    """A score by model (rows) and scenario (columns), people on top."""
    scores = comparison.scores
    columns = [*in_order(comparison.stimuli["scenario"]), MEAN, POOLED]
    rows = []
    if comparison.has_people:
        rows.append([f"<em>{_people_title(key)}</em>", *_people_cells(comparison, key, columns)])
    for agent in comparison.agents:
        own = scores[scores["agent"] == agent].set_index("scenario")
        cells = [interval(own.loc[name], key) if name in own.index else DASH for name in columns]
        rows.append([escape(agent), *cells])
    return table(["", *columns], rows)


def _people_title(key: str) -> str:
    return "people" if key == "accuracy" else "ceiling"


def _people_cells(comparison: Comparison, key: str, columns: Sequence[str]) -> list[str]:
    people = comparison.people.set_index("scenario").assign(reason="")
    if key == "accuracy":
        return [interval(people.loc[name], key) if name in people.index else "" for name in columns]
    return [number(people.loc[name, "ceiling"]) if name in people.index else "" for name in columns]


def people(comparison: Comparison) -> str:
    """The people by scenario."""
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
                zone if np.isfinite(row["zone_low"]) else DASH,
                number(row["reliability"], 3),
                number(row["ceiling"], 3),
            ]
        )
    return table([*header, "reliability", "ceiling of r"], rows, "People")


def definitions() -> str:
    """What the columns mean."""
    meaning = {
        "accuracy": "share of the model's answers that equal the official outcome; people: mean "
        "over stimuli of the share who are right, on the same stimuli",
        "against simulated outcome": "the same answers against the outcome of the trial as it was "
        "simulated for the model",
        "Pearson r": "correlation over stimuli of P(contact) with the share of people who say yes, "
        "that is, with the average person; “same outcome”: without the stimuli whose simulated "
        "outcome is not the official one, as there people and model saw different events",
        "RMSD": "root of the mean squared difference of these two",
        DASH: "undefined; the reason stands below the table or shows on hovering",
    }
    rows = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in meaning.items())
    return f"<h3>What the numbers mean</h3><dl>{rows}</dl>"


def changed(comparison: Comparison) -> str:
    """The trials whose simulated outcome is not the official one, with every model's P(contact)."""
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
        line = [f"<code>{escape(row['stimulus'])}</code>", escape(row["scenario"])]
        line += [_outcome(row["label"]), _outcome(row["simulated"])]
        line += [_percent(row["p_yes"])] if comparison.has_people else []
        cells.append(line)
    listing = details(f"{plural(len(rows), 'trial')}, one by one", table(header, cells))
    return (
        f"<p>{len(rows)} of {comparison.stimuli['stimulus'].nunique()} stimuli: {escape(words)}. "
        "There the models were shown another event than people saw, so accuracy is given against "
        "both outcomes and r also without them.</p>" + listing
    )


def dropped(comparison: Comparison) -> str:
    """Counts of what was left out, and why."""
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


def card(comparison: Comparison, row: pd.Series, movie: str) -> str:
    """One stimulus: its movie (HTML), outcome, what people and what every model said."""
    own = comparison.stimuli[comparison.stimuli["stimulus"] == row["stimulus"]]
    bars = [_bar("people say yes", row["p_yes"], "human")]
    for _, answer in own.iterrows():
        kind = "model named" if answer["agent"] == row["agent"] else "model"
        bars.append(_bar(str(answer["agent"]), answer["p_contact"], kind))
    return (
        f"<article>{movie}<h3>{escape(row['scenario'])}: {_outcome(row['label'])}</h3>"
        f"<p><code>{escape(row['stimulus'])}</code></p>{''.join(bars)}</article>"
    )


def _bar(name: str, value: float, kind: str) -> str:
    """A labelled bar; a ``meter`` would be coloured by the browser as good or bad."""
    width = number(100 * value, 0)
    return (
        f'<div class="bar {kind}"><span>{escape(name)}</span><b>{_percent(value)}</b>'
        f'<i style="width:{width}%"></i></div>'
    )


def _outcome(value: bool) -> str:
    return "contact" if value else "no contact"


def _percent(value: float) -> str:
    return f"{100 * value:.0f} %" if np.isfinite(value) else DASH
