"""Cards of a page: a stimulus with its movie, its outcome, and the answers of people and models."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np
import pandas as pd

from physion.report.page.blocks import details, percent, stimulus_link
from physion.report.words import number, plural

MOST_ANSWERS = 10
"""Largest number of models that a card shows at once; more of them open on a click."""
READOUT_ORDER = ("observed+simulated", "observed")
"""Readouts of which a card shows the first that a model has."""
KEY = (
    "Bars: the fraction of people who say yes, and each model's P(contact); the line marks one "
    "half. ✓: the majority, or the model's answer, is right; ✗: it is wrong."
)
READOUT_KEY = "Of a model with several readouts the cards show observed+simulated, else observed."


def card(rows: pd.DataFrame, movie: str, links: Mapping[str, str], named: str = "") -> str:
    """Return one stimulus as a card.

    Parameters
    ----------
    rows
        The rows of ``comparison.stimuli`` of this stimulus.
    movie
        Its movie as HTML.
    links
        Addresses by stimulus; the name links there.
    named
        Name of a model (``agent``) that is shown in bold and with this readout.
    """
    first = rows.iloc[0]
    return (
        f"<article><header><h3>{escape(first['scenario'])}</h3>{outcome(first)}</header>"
        f"{movie}{answers(pick_readouts(rows, named), named)}"
        f'<p class="name">{stimulus_link(first["stimulus"], links)}</p></article>'
    )


def pick_readouts(rows: pd.DataFrame, named: str = "") -> pd.DataFrame:
    """Return the rows of one readout of each model: that of ``named``, else by `READOUT_ORDER`.

    Readouts that were shown the outcome (*full*) are left out where another one is there.
    """
    seen = rows[(rows["readout"] != "full") | (rows["agent"] == named)]
    rows = rows if seen.empty else seen
    parts = []
    for _, own in rows.groupby("model", sort=False):
        if (own["agent"] == named).any():
            parts.append(own[own["agent"] == named])
            continue
        known = [name for name in READOUT_ORDER if (own["readout"] == name).any()]
        parts.append(own[own["readout"] == known[0]] if known else own)
    return pd.concat(parts)


def outcome(row: pd.Series) -> str:
    """Return what happened as a label, as HTML; with the simulated outcome if it differs."""
    kind = "contact" if row["label"] else "no contact"
    words = kind
    if bool(row["simulated"]) != bool(row["label"]):
        words += ", not in the movie" if row["label"] else ", but in the movie"
    return f'<span class="outcome {kind.replace(" ", "-")}">{words}</span>'


def describe(rows: pd.DataFrame) -> str:
    """Return a sentence about the movie of a stimulus, for readers who do not see it."""
    first = rows.iloc[0]
    happened = "they touch" if first["simulated"] else "they do not touch"
    return f"Movie of {first['stimulus']} ({first['scenario']}): {happened}"


def answers(rows: pd.DataFrame, named: str = "") -> str:
    """Return the answers of people, if there are any, and of the models as labelled bars."""
    first = rows.iloc[0]
    items = []
    if np.isfinite(first["p_yes"]):
        value = f"{percent(first['p_yes'])} <small>of {first['count']:.0f}</small>"
        right = None if first["human_accuracy"] == 0.5 else first["human_accuracy"] > 0.5
        items.append(_answer("people say yes", "", value, first["p_yes"], right, "human"))
    for _, row in rows.iterrows():
        alone = (rows["model"] == row["model"]).sum() == 1
        right = bool(row["predicted"]) == bool(row["label"])
        kind = "model named" if row["agent"] == named else "model"
        label = row["model"] if alone else row["agent"]
        value = number(row["p_contact"])
        items.append(_answer(str(label), str(row["agent"]), value, row["p_contact"], right, kind))
    # People come first and count as one.
    most = MOST_ANSWERS + len(items) - len(rows)
    shown = f'<ul class="answers">{"".join(items[:most])}</ul>'
    if len(items) > most:
        rest = f'<ul class="answers">{"".join(items[most:])}</ul>'
        shown += details(f"{plural(len(items) - most, 'further model')}", rest)
    return shown


def _answer(
    name: str, title: str, value: str, fraction: float, right: bool | None, kind: str
) -> str:
    """Return one answer; a ``meter`` would be coloured as good or bad by browsers."""
    mark, word = {True: ("✓", "right"), False: ("✗", "wrong"), None: ("–", "divided")}[right]
    hover = f' title="{escape(title)}"' if title else ""
    return (
        f'<li class="{kind}"><span{hover}>{escape(name)}</span><b>{value}</b>'
        f'<em class="{word}" role="img" aria-label="{word}">{mark}</em>'
        f'<i aria-hidden="true"><s style="width:{100 * fraction:.0f}%"></s></i></li>'
    )
