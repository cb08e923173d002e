"""Frame of a page that needs no network, no script and no other file."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files

from physion.core.version import MADE_WITH

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
