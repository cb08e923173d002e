"""Text of the viewer's page: template, style, script and data, all escaped.

Everything that comes from trials goes into blocks of JSON, which the script shows as text. The
page's policy allows only its own script and style, by their hashes, and no network.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from physion.core.errors import BadInputError
from physion.core.version import MADE_WITH

SCRIPTS = (
    "dom",
    "player",
    "timeline",
    "matrix",
    "webgl",
    "motion",
    "particles",
    "pictures",
    "predictions",
    "scene3d",
    "grid",
    "detail",
    "main",
)
"""Parts of the script in the order in which they need each other."""


@dataclass(frozen=True)
class TrialData:
    """Data of one trial: its ``card`` in the grid, its small ``movie``, and the ``detail`` view."""

    card: Mapping[str, Any]
    movie: Mapping[str, Any]
    detail: Mapping[str, Any]


def render_viewer(
    title: str,
    trials: Sequence[TrialData],
    totals: Mapping[str, int],
    shapes: Mapping[str, Any],
) -> str:
    """Return the page as text. ``totals``: trials of each scenario; ``shapes``: see
    `pack_shapes`.
    """
    style, script = _style(), _script()
    blocks = [
        _block("cards", [trial.card for trial in trials]),
        _block("totals", totals),
        _block("shapes", shapes),
    ]
    for number, trial in enumerate(trials):
        blocks.append(_block(f"movie-{number}", trial.movie))
        blocks.append(_block(f"detail-{number}", trial.detail))
    return Template(_part("page.html")).substitute(
        policy=_policy(style, script),
        title=escape(title),
        made_with=MADE_WITH,
        style=style,
        blocks="\n".join(blocks),
        script=script,
    )


def embed_json(value: Any) -> str:
    """Return JSON without ``<``, ``>`` and ``&``, so that it cannot end its element."""
    try:
        text = json.dumps(value, separators=(",", ":"), sort_keys=True, allow_nan=False)
    except ValueError as error:
        raise BadInputError(f"a trial holds a number that is none: {error}") from error
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def _block(name: str, value: Any) -> str:
    return f'<script type="application/json" id="{name}">{embed_json(value)}</script>'


def _policy(style: str, script: str) -> str:
    rules = {
        "default-src": "'none'",
        "script-src": _hash(script),
        "style-src": _hash(style),
        "media-src": "blob:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _style() -> str:
    """Return the style of the report, followed by that of the viewer."""
    report = files("physion.report").joinpath("report.css").read_text(encoding="utf-8")
    return "\n" + report + _part("viewer.css")


def _script() -> str:
    parts = "\n".join(_part(f"{name}.js") for name in SCRIPTS)
    return f'\n(() => {{\n"use strict";\n{parts}}})();\n'


def _part(name: str) -> str:
    return files("physion.report").joinpath("viewer", name).read_text(encoding="utf-8")
