"""Text of numbers and names, as page and figures write them."""

from __future__ import annotations

import base64
import io
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from PIL import Image

from physion.analysis.comparison import Comparison
from physion.analysis.tables import in_order
from physion.core.errors import BadInputError
from physion.core.names import canonical_name
from physion.core.version import MADE_WITH
from physion.scenes.scene import OBSERVED_FRAMES


def plural(count: int, noun: str) -> str:
    """Return count and noun, such as ``1 model``, ``2 models``, ``2 stimuli``."""
    many = noun.removesuffix("us") + "i" if noun.endswith("us") else noun + "s"
    return f"{count} {noun if count == 1 else many}"


def listed(names: Sequence[str]) -> str:
    """Return names with commas and, before the last one, ``and``."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def number(value: float, digits: int = 2) -> str:
    """Return a number with this many decimals, or ``NaN``.

    Negative numbers have a minus sign (not a hyphen); a rounded zero has none.
    """
    if pd.isna(value):
        return "NaN"
    # Adding zero turns -0.0 into 0.0.
    return f"{round(float(value), digits) + 0.0:.{digits}f}".replace("-", "−")


def protocol_names(text: str) -> str:
    """Return ``text``; names of training protocols need no replacement any more."""
    return text


# Frame of a page that needs no network, no script and no other file.

SVG_LIMIT = 500_000
"""Bytes above which a figure is embedded as PNG: thousands of points are slow to draw as SVG."""


@dataclass(frozen=True)
class Picture:
    """Figure in two themes as bytes by kind: ``svg`` and ``png``, of the dark one only the kind
    that `page_kind` names; ``words``: the caption.
    """

    name: str
    light: Mapping[str, bytes]
    dark: Mapping[str, bytes]
    words: str = ""


@dataclass(frozen=True)
class Section:
    """Part of a page under a heading; ``content`` is HTML."""

    title: str
    content: str

    @property
    def anchor(self) -> str:
        """Heading as the target of links in the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def page_kind(figure: Mapping[str, bytes]) -> str:
    """Return the format for embedding a figure: ``svg``, or ``png`` if the drawing is too large."""
    return "svg" if len(figure["svg"]) <= SVG_LIMIT else "png"


def render_document(title: str, lead: str, sections: Sequence[Section], mark: str = "") -> str:
    """Return the page as text: heading, ``lead`` (HTML), contents if there are sections, these.

    ``mark``: text that stays in view at the top of the page and begins the title of its window.
    """
    links = "".join(f'<li><a href="#{s.anchor}">{escape(s.title)}</a></li>' for s in sections)
    parts = [
        f'<section id="{s.anchor}"><h2>{escape(s.title)}</h2>\n{s.content}</section>'
        for s in sections
    ]
    nav = f'<nav aria-label="Contents"><ul>{links}</ul></nav>' if links else ""
    return _TEMPLATE.format(
        window=escape(f"{mark}: {title}" if mark else title),
        mark=f'<p class="mark">{escape(mark)}</p>\n' if mark else "",
        title=escape(title),
        made_with=MADE_WITH,
        style=_style(),
        body="\n".join([lead, nav, *parts]),
    )


_TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="generator" content="{made_with}">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; \
media-src data:; style-src 'unsafe-inline'">
<title>{window}</title>
<style>
{style}</style>
</head>
<body>
{mark}<main>
<h1>{title}</h1>
{body}
</main>
</body>
</html>
"""


def _style() -> str:
    return files("physion.report").joinpath("report.css").read_text(encoding="utf-8")


def figure(picture: Picture) -> str:
    """Return a figure with its caption, light or dark as the reader's system asks."""
    kind = page_kind(picture.light)
    mime = {"svg": "image/svg+xml", "png": "image/png"}[kind]
    light, dark = (data_uri(mime, theme[kind]) for theme in (picture.light, picture.dark))
    return (
        f'<figure><picture><source media="(prefers-color-scheme: dark)" srcset="{dark}">'
        f'<img src="{light}" alt="{escape(picture.words)}"></picture>'
        f"<figcaption>{escape(picture.words)} Table: <code>figures/{picture.name}.csv</code>."
        "</figcaption></figure>"
    )


def data_uri(mime: str, data: bytes) -> str:
    """Return a data URI that contains the bytes."""
    return f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"


# Building blocks of the report page: tables, lists and cards; every text is escaped.

BASELINES = "Baselines: what a score is worth"
"""Heading of the rows of baselines in a table."""


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

    Rows whose ``kind`` is baseline, if there is such a column, follow the others as a group.
    """
    cells = [[column.cell(row) for column in columns] for _, row in rows.iterrows()]
    is_baseline = [kind == "baseline" for kind in rows.get("kind", [""] * len(rows))]
    first, baselines = (
        [line for line, baseline in zip(cells, is_baseline, strict=True) if baseline is which]
        for which in (False, True)
    )
    headings = [column.heading for column in columns]
    return table(headings, first, caption, (BASELINES, baselines)) + notes(rows, columns)


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
    keys = ["model", "reason"]
    totals = rows.groupby(keys, sort=False)["stimuli"].sum().reset_index()
    cells = [
        [escape(row["model"] or "people"), escape(row["reason"]), str(row["stimuli"])]
        for _, row in totals.iterrows()
    ]
    return table(["whose", "reason", "stimuli"], cells)


def _outcome(value: bool) -> str:
    return "contact" if value else "no contact"


def percent(value: float) -> str:
    """Return a fraction in percent, or ``NaN``."""
    return f"{100 * value:.0f} %" if np.isfinite(value) else "NaN"


# Movies inside a page, within its limit of bytes, each with a still picture.

_MIME = {
    ".mp4": "video/mp4",
    ".webm": "video/webm",
    ".gif": "image/gif",
    ".png": "image/png",
    ".jpg": "image/jpeg",
}
_POSTER_SIDE = 256
"""Largest side of a still picture in pixels."""


def movies_of(folder: Path) -> dict[str, Path]:
    """Return the movies of a dataset's testing trials, by canonical stimulus, for `ReportInputs`.

    Raises `BadInputError` if ``folder`` is no dataset or has no testing trial, or if a movie does
    not have its SHA-256 in the index.
    """
    from physion.trials.dataset import Dataset

    dataset = Dataset(folder)
    trials = dict.fromkeys(dataset.trials("testing"))
    if not trials:
        raise BadInputError(f"{folder} has no testing trial, so no movie that people saw")
    for trial, file in dataset.files("movie").items():
        if trial in trials and file.path.is_file():
            file.check()
    return {canonical_name(trial): dataset.paths(trial).movie for trial in trials}


def check_movies(movies: Mapping[str, Path], stimuli: Iterable[str]) -> None:
    """Raise `BadInputError` for a movie to be shown that is absent or of a wrong kind."""
    for stimulus in stimuli:
        path = movies.get(stimulus)
        if path is not None and _mime(path) and not path.is_file():
            raise BadInputError(f"the movie of {stimulus!r} is not there: {path}")


@dataclass
class PageMovies:
    """Movies of one page as HTML.

    - ``files``: file by stimulus.
    - ``left``: bytes of HTML that the page may still take; each movie that is shown takes some.
    """

    files: Mapping[str, Path]
    left: int

    def show(self, stimulus: str, description: str) -> str:
        """Return the movie of a stimulus; a picture or a sentence if it cannot be shown.

        ``description``: for readers who do not see it. It plays without sound while it is in
        view; for people who ask for reduced motion it plays when they mark a box. Returns "" if no
        movie of any stimulus was given. Raises `BadInputError` if its file cannot be read or is no
        movie.
        """
        if not self.files:
            return ""
        path = self.files.get(stimulus)
        if path is None:
            return '<p class="none">no movie given</p>'
        poster = make_poster(path)
        for html in (_element(path, stimulus, description, poster), _still(poster, description)):
            if html and len(html) <= self.left:
                self.left -= len(html)
                return html
        return f'<p class="none">{_TOO_LARGE}</p>'


_TOO_LARGE = "movie left out: the page would grow too large"


def _element(path: Path, stimulus: str, description: str, poster: bytes) -> str:
    mime = _mime(path)
    try:
        data = data_uri(mime, path.read_bytes())
    except OSError as error:
        raise BadInputError(f"the movie of {stimulus!r} cannot be read: {error}") from error
    label = escape(description)
    if mime.startswith("image/"):
        return f'<img src="{data}" alt="{label}" loading="lazy">'
    still = data_uri("image/jpeg", poster) if poster else ""
    shown = f'poster="{still}" ' if still else ""
    # Browsers start a movie without sound when it comes into view. For people who ask for less
    # motion the style sheet hides it behind the picture until they mark the box.
    picture = f'<img src="{still}" alt="{label}" loading="lazy">' if still else ""
    return (
        f'<div class="movie"><label><input type="checkbox"> play the movie</label>{picture}'
        f'<video src="{data}" {shown}autoplay preload="none" controls loop muted playsinline '
        f'aria-label="{label}"></video></div>'
    )


def _still(poster: bytes, description: str) -> str:
    if not poster:
        return ""
    picture = data_uri("image/jpeg", poster)
    return (
        f'<div class="still"><img src="{picture}" alt="{escape(description)}">'
        f"<small>{_TOO_LARGE}</small></div>"
    )


def make_poster(path: Path) -> bytes:
    """Return the last observed picture of a movie as JPEG: what people saw when they answered.

    A shorter movie gives its last picture; a file that is no movie, or one that cannot be decoded
    here (a browser may still play it), gives b"".
    """
    from physion.trials.video import count_frames, read_chosen

    if not _mime(path).startswith("video/"):
        return b""
    try:
        last = max(0, min(OBSERVED_FRAMES, count_frames(path)) - 1)
        picture = Image.fromarray(read_chosen(path, [last])[0])
    except BadInputError:
        return b""
    picture.thumbnail((_POSTER_SIDE, _POSTER_SIDE))
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=80)
    return buffer.getvalue()


def _mime(path: Path) -> str:
    mime = _MIME.get(path.suffix.lower())
    if mime is None:
        raise BadInputError(f"{path} is no movie for a page; use one of {', '.join(_MIME)}")
    return mime
