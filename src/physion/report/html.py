"""Parts of every page: numbers and names as text, tables, figures, movies, and the frame around.

No function here or in the modules of the sections writes HTML: each fills macros of the templates,
which escape every text, and returns `Markup`.
"""

from __future__ import annotations

import base64
import io
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from PIL import Image

from physion.core.errors import BadInputError
from physion.core.html import Markup, environment, macros_of
from physion.core.names import canonical_name
from physion.core.version import MADE_WITH
from physion.scenes.scene import OBSERVED_FRAMES

MACROS = macros_of("physion.report")
"""Macros of all pages."""
NO_VALUE = "–"
"""What stands on pages for an undefined number (NaN)."""


def plural(count: int, noun: str) -> str:
    """Return count and noun, such as ``1 model``, ``2 models``, ``2 stimuli``."""
    many = noun.removesuffix("us") + "i" if noun.endswith("us") else noun + "s"
    return f"{count} {noun if count == 1 else many}"


def listed(names: Sequence[str]) -> str:
    """Return names with commas and, before the last one, ``and``."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def number(value: float, digits: int = 2) -> str:
    """Return a number with this many decimals, or `NO_VALUE`.

    Negative numbers have a minus sign (not a hyphen); a rounded zero has none.
    """
    if pd.isna(value):
        return NO_VALUE
    # Adding zero turns -0.0 into 0.0.
    return f"{round(float(value), digits) + 0.0:.{digits}f}".replace("-", "−")


def percent(value: float) -> str:
    """Return a fraction in percent, or `NO_VALUE`."""
    return f"{100 * value:.0f} %" if np.isfinite(value) else NO_VALUE


def p_value(value: float) -> str:
    """Return a p value with three decimals, or ``< 0.001``."""
    if pd.isna(value):
        return NO_VALUE
    return "< 0.001" if value < 0.001 else number(value, 3)


# --- frame of a page, which needs no network, no script and no other file -------------------------

SVG_LIMIT = 500_000
"""Bytes above which a figure is embedded as PNG: thousands of points are slow to draw as SVG."""


@dataclass(frozen=True)
class Picture:
    """Figure in two themes as bytes by kind: ``svg`` and ``png``, of the dark one only the kind
    that `page_kind` names; ``caption``: the text below it.
    """

    name: str
    light: Mapping[str, bytes]
    dark: Mapping[str, bytes]
    caption: str = ""


@dataclass(frozen=True)
class Section:
    """Part of a page under a heading."""

    title: str
    content: Markup

    @property
    def anchor(self) -> str:
        """Heading as the target of links in the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def page_kind(figure: Mapping[str, bytes]) -> str:
    """Return the format for embedding a figure: ``svg``, or ``png`` if the drawing is too large."""
    return "svg" if len(figure["svg"]) <= SVG_LIMIT else "png"


def render_document(title: str, lead: Markup, sections: Sequence[Section], mark: str = "") -> str:
    """Return the page as text: heading, ``lead``, contents if there are sections, these.

    ``mark``: text that stays in view at the top of the page and begins the title of its window.
    """
    return environment("physion.report").get_template("page.html").render(
        title=title, lead=lead, sections=sections, mark=mark, made_with=MADE_WITH, style=style()
    )  # fmt: skip


def style() -> Markup:
    """Return the style sheet of all pages of reports."""
    text = files("physion.report").joinpath("templates", "report.css").read_text(encoding="utf-8")
    return Markup(text)


def figure(picture: Picture) -> Markup:
    """Return a figure with its caption, light or dark as the reader's system asks."""
    kind = page_kind(picture.light)
    mime = {"svg": "image/svg+xml", "png": "image/png"}[kind]
    light, dark = (data_uri(mime, theme[kind]) for theme in (picture.light, picture.dark))
    return Markup(MACROS.figure(light, dark, picture.caption, f"figures/{picture.name}.csv"))


def data_uri(mime: str, data: bytes) -> Markup:
    """Return a data URI that contains the bytes; it has no sign that needs escaping."""
    return Markup(f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}")


# --- tables, lists, paragraphs --------------------------------------------------------------------

BASELINES = "Baselines: what a score is worth"
"""Heading of the rows of baselines in a table."""

Rows = Sequence[Sequence[str]]
"""Rows of cells; a cell is text, or what a macro made."""


def details(title: str, content: str) -> Markup:
    """Return a part that opens on a click; nothing without content."""
    return Markup(MACROS.details(title, content)) if content else Markup()


def heading(text: str) -> Markup:
    """Return a heading within a section."""
    return Markup(MACROS.heading(text))


def paragraph(text: str, kind: str = "") -> Markup:
    """Return text as a paragraph; ``kind``: its class in the style sheet."""
    return Markup(MACROS.paragraph(text, kind))


def notes(items: Sequence[str]) -> Markup:
    """Return a list in small print, or nothing without items."""
    return Markup(MACROS.notes(items))


def definition_list(values: Mapping[str, str]) -> Markup:
    """Return names and their meanings as a list."""
    return Markup(MACROS.definitions(values))


def warnings(texts: Sequence[str], mark: str = "") -> Markup:
    """Return warnings as a framed list, or nothing if there are none but the ``mark`` of the
    page.
    """
    return Markup(MACROS.warnings([text for text in texts if text != mark]))


def undefined(reason: str) -> Markup:
    """Return `NO_VALUE` with its reason on hovering."""
    return Markup(MACROS.undefined(NO_VALUE, reason))


def interval(row: pd.Series, key: str, low: str = "", high: str = "", digits: int = 2) -> Markup:
    """Return a value with its interval in small print; a dash with its reason if undefined.

    ``low`` and ``high``: columns of the bounds, if they are not ``key`` with _low and _high.
    """
    if pd.isna(row[key]):
        return undefined(str(row.get("reason", "")))
    bounds = row.get(low or f"{key}_low", np.nan), row.get(high or f"{key}_high", np.nan)
    return Markup(MACROS.with_small(number(row[key], digits), spread(*bounds, digits=digits)))


def compared(cell: str, reliably: str) -> Markup:
    """Return a cell in bold if it is reliably *better* than people, in italics if *worse*."""
    return Markup(MACROS.compared(cell, reliably))


def spread(low: float, high: float, digits: int = 2) -> str:
    """Return the bounds of an interval as text."""
    if pd.isna(low):
        return "no interval"
    return f"{number(low, digits)} to {number(high, digits)}"


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
        """Return the cell."""
        value = row.get(self.key)
        if self.kind == "interval":
            return interval(row, self.key, self.low, self.high, self.digits)
        if self.kind == "text":
            return "" if value is None or value != value else str(value)
        if pd.isna(value):
            return undefined(str(row.get("reason", "")))
        if self.kind == "count":
            return str(round(float(value)))
        if self.kind == "p":
            return p_value(float(value))
        return percent(float(value)) if self.kind == "percent" else number(value, self.digits)


def rows_table(rows: pd.DataFrame, columns: Sequence[PageColumn], caption: str = "") -> Markup:
    """Return a table of some columns of ``rows``, with reasons of undefined numbers listed below
    it.

    Rows whose ``kind`` is baseline, if there is such a column, follow the others as a group. A
    table without rows is left out.
    """
    if rows.empty:
        return Markup()
    cells = [[column.cell(row) for column in columns] for _, row in rows.iterrows()]
    is_baseline = [kind == "baseline" for kind in rows.get("kind", [""] * len(rows))]
    first, baselines = (
        [line for line, baseline in zip(cells, is_baseline, strict=True) if baseline is which]
        for which in (False, True)
    )
    headings = [column.heading for column in columns]
    return table(headings, first, caption, (BASELINES, baselines)) + _reasons(rows, columns)


def _reasons(rows: pd.DataFrame, columns: Sequence[PageColumn]) -> Markup:
    """Return the values of ``reason`` once each, with the rows that they are about."""
    if "reason" not in rows:
        return Markup()
    given = rows[rows["reason"].astype(str).str.len() > 0]
    items = []
    for reason, subset in given.groupby("reason", sort=False):
        named = [str(row[columns[0].key]) for _, row in subset.iterrows()]
        who = ", ".join(dict.fromkeys(named)) if len(set(named)) <= 8 else f"{len(named)} rows"
        items.append(f"{who}: {reason}")
    return notes(items)


def table(
    header: Sequence[str], rows: Rows, caption: str = "", below: tuple[str, Rows] = ("", ())
) -> Markup:
    """Return a table, whose first column names the rows.

    ``below``: a further group of rows under a heading of its own, if it has rows.
    """
    return Markup(MACROS.table(header, [("", rows), below], caption))


def stimulus_link(stimulus: str, links: Mapping[str, str]) -> Markup:
    """Return the name of a stimulus, as a link if ``links`` has its movie."""
    name = MACROS.code(stimulus)
    return Markup(MACROS.link(links[stimulus], name) if stimulus in links else name)


def relative_links(movies: Mapping[str, Path], folder: Path) -> dict[str, str]:
    """Return the addresses of movies by stimulus, relative to ``folder``."""
    base = folder.resolve()
    return {
        stimulus: Path(os.path.relpath(path.resolve(), base)).as_posix()
        for stimulus, path in movies.items()
    }


# --- movies inside a page, within its limit of bytes, each with a still picture -------------------

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

    Raises `BadInputError` if ``folder`` is not a dataset or has no testing trial, or if a movie
    does not have its SHA-256 in the index.
    """
    from physion.trials.dataset import Dataset

    dataset = Dataset(folder)
    trials = dict.fromkeys(dataset.trials("testing"))
    if not trials:
        raise BadInputError(f"{folder} has no testing trial, so no movie that people saw")
    movies = {trial: file for trial, file in dataset.files("movie").items() if trial in trials}
    for file in movies.values():
        if file.path.is_file():
            file.check()
    return {canonical_name(trial): file.path for trial, file in movies.items()}


def check_movies(movies: Mapping[str, Path], stimuli: Iterable[str]) -> None:
    """Raise `BadInputError` for a movie to be shown that is absent or of a wrong kind."""
    for stimulus in stimuli:
        path = movies.get(stimulus)
        if path is not None and _mime(path) and not path.is_file():
            raise BadInputError(f"the movie of {stimulus!r} is not there: {path}")


@dataclass
class PageMovies:
    """Movies of one page.

    - ``files``: file by stimulus.
    - ``left``: bytes that the page may still take; each movie that is shown takes some.
    """

    files: Mapping[str, Path]
    left: int

    def show(self, stimulus: str, description: str) -> Markup:
        """Return the movie of a stimulus; a picture or a sentence if it cannot be shown.

        ``description``: for readers who do not see it. It plays without sound while it is in
        view; for people who ask for reduced motion it plays when they mark a box. Returns nothing
        if no movie of any stimulus was given. Raises `BadInputError` if its file cannot be read or
        is not a movie.
        """
        if not self.files:
            return Markup()
        path = self.files.get(stimulus)
        if path is None:
            return paragraph("no movie given", "none")
        poster = make_poster(path)
        for shown in (_element(path, stimulus, description, poster), _still(poster, description)):
            if shown and len(shown) <= self.left:
                self.left -= len(shown)
                return shown
        return paragraph(_TOO_LARGE, "none")


_TOO_LARGE = "movie left out: the page would grow too large"


def _element(path: Path, stimulus: str, description: str, poster: bytes) -> Markup:
    mime = _mime(path)
    try:
        data = data_uri(mime, path.read_bytes())
    except OSError as error:
        raise BadInputError(f"the movie of {stimulus!r} cannot be read: {error}") from error
    if mime.startswith("image/"):
        return Markup(MACROS.picture(data, description))
    still = data_uri("image/jpeg", poster) if poster else ""
    return Markup(MACROS.movie(data, still, description))


def _still(poster: bytes, description: str) -> Markup:
    if not poster:
        return Markup()
    return Markup(MACROS.still(data_uri("image/jpeg", poster), description, _TOO_LARGE))


def make_poster(path: Path) -> bytes:
    """Return the last observed picture of a movie as JPEG: what people saw when they answered.

    A shorter movie gives its last picture; a file that is not a movie, or one that cannot be
    decoded here (a browser may still play it), gives b"".
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
        raise BadInputError(f"{path} cannot be shown as a movie; use one of {', '.join(_MIME)}")
    return mime
