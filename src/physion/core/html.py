"""Environment of Jinja2 for every page: text is escaped, and one set of macros serves all pages.

A package keeps its templates in its folder ``templates``. The macros of ``core/templates``
(tables, lists, figures, movies) are known there as ``macros.html``:
``{% import "macros.html" as macros %}``. Python reads them by `macros_of`. What a macro returns is
`Markup`, which is not escaped again; every other text is.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

__all__ = ["Markup", "environment", "joined", "macros_of"]


@cache
def environment(package: str) -> Environment:
    """Return the environment of the templates of ``package``, which is the same at every call."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("physion.core")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def macros_of(package: str, template: str = "macros.html") -> Any:
    """Return an object with the macros of a template as functions."""
    return environment(package).get_template(template).module


def joined(parts: Iterable[str]) -> Markup:
    """Return parts of a page below each other; parts that are not `Markup` are escaped."""
    return Markup("\n").join(part for part in parts if part)
