"""The Jinja environment of the pages, and its filters for times, percentages and missing values."""

from __future__ import annotations

import unicodedata
from datetime import UTC, datetime
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from physion.experiment.experimenter.access.login import PATH

NONE = "–"


def date_time(seconds: float | None) -> str:
    """Format a Unix time as ``2026-03-01 14:05`` in UTC."""
    if seconds is None:
        return NONE
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M")


def time_of_day(seconds: float | None) -> str:
    """Format a Unix time as ``14:05:09`` in UTC."""
    return NONE if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%H:%M:%S")


def percent(fraction: float | None, places: int = 0) -> str:
    """Format a fraction (0..1) in percent."""
    return NONE if fraction is None else f"{100 * fraction:.{places}f} %"


def in_seconds(ms: float | None) -> str:
    """Format milliseconds as seconds with two decimal places."""
    return NONE if ms is None else f"{ms / 1000:.2f} s"


def minutes(value: float | None) -> str:
    """Format minutes as ``12 min``, ``3 h 05`` or ``2 d 4 h``."""
    if value is None:
        return NONE
    whole = round(value)
    if whole < 60:
        return f"{whole} min"
    hours, rest = divmod(whole, 60)
    return f"{hours} h {rest:02d}" if hours < 24 else f"{hours // 24} d {hours % 24} h"


def visible(text: str) -> str:
    """Return a text with codes for invisible characters, such as those that reverse its order."""
    return "".join(
        f"\\u{ord(character):04x}" if unicodedata.category(character) in ("Cf", "Cc") else character
        for character in text
    )


def or_dash(value: object) -> object:
    """Return the value, or a dash if it is missing."""
    return NONE if value is None or value == "" else value


def yes_no(value: bool | None) -> str:
    """Format a boolean that may be missing."""
    return NONE if value is None else ("yes" if value else "no")


def make_environment(**shared: Any) -> Environment:
    """Return the Jinja environment; everything is escaped, undefined names are errors.

    ``shared``: variables that all templates can use.
    """
    environment = Environment(
        loader=PackageLoader(__package__, "templates"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = (
        date_time, time_of_day, percent, in_seconds, minutes, visible, or_dash, yes_no,
    )  # fmt: skip
    environment.filters.update({function.__name__: function for function in filters})
    environment.globals.update(shared, path=PATH)
    return environment
