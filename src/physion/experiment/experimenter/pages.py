"""Templates to HTML, and how moments, shares and times are written in them."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from physion.experiment.experimenter.access.login import PATH

NONE = "–"


def moment(seconds: float | None) -> str:
    """``2026-03-01 14:05`` in UTC."""
    if seconds is None:
        return NONE
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M")


def clock(seconds: float | None) -> str:
    """``14:05:09`` in UTC."""
    return NONE if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%H:%M:%S")


def percent(share: float | None, places: int = 0) -> str:
    """A share of 1 in percent."""
    return NONE if share is None else f"{100 * share:.{places}f} %"


def in_seconds(ms: float | None) -> str:
    """Milliseconds as seconds with two places."""
    return NONE if ms is None else f"{ms / 1000:.2f} s"


def minutes(value: float | None) -> str:
    """``12 min``, ``3 h 05``, ``2 d 4 h``."""
    if value is None:
        return NONE
    whole = round(value)
    if whole < 60:
        return f"{whole} min"
    hours, rest = divmod(whole, 60)
    return f"{hours} h {rest:02d}" if hours < 24 else f"{hours // 24} d {hours % 24} h"


def known(value: object) -> object:
    """A dash for what is not known."""
    return NONE if value is None or value == "" else value


def yes_no(value: bool | None) -> str:
    """Words for a flag that may not be known."""
    return NONE if value is None else ("yes" if value else "no")


def make_environment(**shared: Any) -> Environment:
    """Jinja with everything escaped; a name that a template misspells is an error."""
    environment = Environment(
        loader=PackageLoader(__package__, "templates"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = (moment, clock, percent, in_seconds, minutes, known, yes_no)
    environment.filters.update({function.__name__: function for function in filters})
    environment.globals.update(shared, path=PATH)
    return environment
