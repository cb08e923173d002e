"""One HTML page that needs nothing beside it: no network, no script, no other file."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from pathlib import Path

import pandas as pd

from physion.analysis.comparison import Comparison
from physion.analysis.tables import MEAN, POOLED, in_order
from physion.errors import BadInputError
from physion.report import blocks

EXPECTED_METHODS = ("Engine", "Renderer", "Readout", "Encoder weights", "Noise of the simulation")
"""Choices that are made outside the analysis; the page says so where the caller names none."""

SVG_LIMIT = 500_000
"""Bytes above which a figure is embedded as PNG, since thousands of points make a heavy drawing."""

_MIME = {
    ".mp4": "video/mp4",
    ".webm": "video/webm",
    ".gif": "image/gif",
    ".png": "image/png",
    ".jpg": "image/jpeg",
}


@dataclass(frozen=True)
class Picture:
    """A figure in two themes, as bytes by kind: ``svg`` and ``png``, of the dark one that which
    `page_kind` names."""

    name: str
    light: Mapping[str, bytes]
    dark: Mapping[str, bytes]


@dataclass(frozen=True)
class ReportInputs:
    """All that a report is made of.

    - ``comparison``: from `physion.analysis.compare`.
    - ``title``: the heading.
    - ``methods``: choices made outside the analysis, in words; those of `EXPECTED_METHODS` that
      are absent are printed as not stated.
    - ``movies``: file by stimulus (mp4, webm, gif, png or jpg); others than are shown do no harm.
    - ``movie_count``, ``movie_bytes``: at most so many movies, and so many bytes of them in all.
    - ``scatter_limit``: at most so many models in the scatter figure; the caption names the rest.
    """

    comparison: Comparison
    title: str = "Models and people on physical prediction"
    methods: Mapping[str, str] = field(default_factory=dict)
    movies: Mapping[str, Path] = field(default_factory=dict)
    movie_count: int = 8
    movie_bytes: int = 20_000_000
    scatter_limit: int = 12

    def scatter_agents(self) -> list[str]:
        """The models of the scatter figure: the first ones, in the order of the predictions."""
        return self.comparison.agents[: self.scatter_limit]


def page_kind(figure: Mapping[str, bytes]) -> str:
    """As what a figure is embedded: ``svg``, or ``png`` where the drawing would be too heavy."""
    return "svg" if len(figure["svg"]) <= SVG_LIMIT else "png"


def widest_gaps(comparison: Comparison, count: int) -> pd.DataFrame:
    """The stimuli on which a model and people differ most, at most ``count`` rows.

    Models take turns, each naming the stimulus of its largest |P(contact) - share of yes| that is
    not yet there; ties go by name. Stimuli whose simulated outcome is not the official one are
    passed over, since there it is the physics that differs and not the model. Rows of
    ``comparison.stimuli``: that of the model which named it.
    """
    rows = comparison.stimuli
    rows = rows[(rows["label"] == rows["simulated"]) & rows["gap"].notna()]
    rows = rows.assign(size=rows["gap"].abs())
    ranked = rows.sort_values(["size", "stimulus"], ascending=[False, True], kind="stable")
    queues = [list(own.index) for _, own in ranked.groupby("agent", sort=False)]
    queues.sort(key=lambda queue: comparison.agents.index(rows.loc[queue[0], "agent"]))
    chosen: list[int] = []
    seen: set[str] = set()
    while len(chosen) < count and any(queues):
        for queue in queues:
            while queue and rows.loc[queue[0], "stimulus"] in seen:
                queue.pop(0)
            if queue and len(chosen) < count:
                chosen.append(queue.pop(0))
                seen.add(str(rows.loc[chosen[-1], "stimulus"]))
    return rows.loc[chosen]


def render_page(inputs: ReportInputs, pictures: Sequence[Picture]) -> str:
    """The page as text; the same inputs give the same text. Raises `BadInputError` for a movie."""
    comparison = inputs.comparison
    shown = {picture.name: picture for picture in pictures}
    parts = [
        _summary(inputs),
        blocks.section("Scores", blocks.overall_table(comparison, MEAN, "Mean over scenarios")),
        blocks.details("All stimuli pooled", blocks.overall_table(comparison, POOLED)),
        blocks.section("Accuracy by scenario", _figure(shown["accuracy"], _accuracy_words(inputs))),
        blocks.details("Accuracy as a table", blocks.matrix(comparison, "accuracy")),
    ]
    if comparison.has_people:
        parts += [
            blocks.section(
                "Stimulus by stimulus", _figure(shown["scatter"], _scatter_words(inputs))
            ),
            blocks.details("Pearson r by scenario, as a table", blocks.matrix(comparison, "r")),
            blocks.section("Where model and people differ most", _gaps(inputs)),
        ]
    parts += [
        blocks.section("Trials whose simulated outcome differs", blocks.changed(comparison)),
        blocks.section("How this was made", _methods(inputs)),
        blocks.section("What was left out", blocks.dropped(comparison)),
    ]
    return _TEMPLATE.format(
        title=escape(inputs.title), style=_style(), body="\n".join(part for part in parts if part)
    )


_TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; \
media-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
<main>
<h1>{title}</h1>
{body}
</main>
</body>
</html>
"""


def _style() -> str:
    return files("physion.report").joinpath("report.css").read_text(encoding="utf-8")


def _summary(inputs: ReportInputs) -> str:
    comparison = inputs.comparison
    stimuli = comparison.stimuli["stimulus"].nunique()
    scenarios = in_order(comparison.stimuli["scenario"])
    words = [
        f"{blocks.plural(len(comparison.agents), 'model')} on {blocks.plural(stimuli, 'stimulus')} "
        f"of {blocks.plural(len(scenarios), 'scenario')} ({', '.join(scenarios)})."
    ]
    if comparison.has_people:
        mean = comparison.people.set_index("scenario").loc[MEAN]
        words.append(
            f"People: mean accuracy {mean['accuracy']:.3f} over scenarios, about "
            f"{mean['people']:.0f} participants a stimulus."
        )
    else:
        words.append("No answers of people were given: the models stand alone here.")
    if len(comparison.changed):
        words.append(
            f"In {len(comparison.changed)} of these stimuli the simulated outcome is not the "
            "official one; accuracy is given against both."
        )
    return f'<p class="lead">{escape(" ".join(words))}</p>'


def _methods(inputs: ReportInputs) -> str:
    stated = dict.fromkeys(EXPECTED_METHODS, "not stated") | dict(inputs.methods)
    choices = {**stated, **inputs.comparison.settings}
    rows = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in choices.items())
    people = blocks.people(inputs.comparison) if inputs.comparison.has_people else ""
    return f"<dl>{rows}</dl>{blocks.definitions()}{people}"


def _accuracy_words(inputs: ReportInputs) -> str:
    words = "Share of answers that equal the official outcome, with bootstrap intervals."
    if inputs.comparison.has_people:
        words += " Dashed: people on the stimuli that any model predicts."
        if inputs.comparison.people["zone_low"].notna().any():
            words += " Band: the middle 95 % of participants."
    return words + " Dotted: chance."


def _scatter_words(inputs: ReportInputs) -> str:
    words = "P(contact) of the model against the share of people who say yes; one point a stimulus."
    if len(inputs.comparison.changed):
        words += " Hollow: the simulated outcome is not the official one."
    rest = inputs.comparison.agents[inputs.scatter_limit :]
    return words + (f" Not drawn: {', '.join(rest)}." if rest else "")


def _figure(picture: Picture, words: str) -> str:
    kind = page_kind(picture.light)
    mime = {"svg": "image/svg+xml", "png": "image/png"}[kind]
    light, dark = (_data_uri(mime, theme[kind]) for theme in (picture.light, picture.dark))
    return (
        f'<figure><picture><source media="(prefers-color-scheme: dark)" srcset="{dark}">'
        f'<img src="{light}" alt="{escape(words)}"></picture>'
        f"<figcaption>{escape(words)}</figcaption></figure>"
    )


def _data_uri(mime: str, data: bytes) -> str:
    return f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"


def _gaps(inputs: ReportInputs) -> str:
    """A card for each of the widest gaps, with its movie while the budget of bytes lasts."""
    chosen = widest_gaps(inputs.comparison, inputs.movie_count)
    if chosen.empty:
        return "<p>None: every simulated outcome differs from the official one.</p>"
    cards, left = [], inputs.movie_bytes
    for _, row in chosen.iterrows():
        movie, used = _movie(inputs.movies.get(row["stimulus"]), row["stimulus"], left)
        left -= used
        cards.append(blocks.card(inputs.comparison, row, movie))
    words = (
        "The stimuli of the largest difference between P(contact) and the share of people who say "
        "yes, models taking turns; only stimuli whose simulated outcome is the official one."
    )
    kind = "cards" if left < inputs.movie_bytes else "cards bare"
    return f'<p>{escape(words)}</p><div class="{kind}">{"".join(cards)}</div>'


def check_movies(inputs: ReportInputs) -> None:
    """Raise `BadInputError` for a movie that would be shown and is absent or of a wrong kind."""
    if not inputs.comparison.has_people:
        return
    for stimulus in widest_gaps(inputs.comparison, inputs.movie_count)["stimulus"]:
        path = inputs.movies.get(stimulus)
        if path is not None and _mime(path) and not path.is_file():
            raise BadInputError(f"the movie of {stimulus!r} is not there: {path}")


def _mime(path: Path) -> str:
    mime = _MIME.get(path.suffix.lower())
    if mime is None:
        raise BadInputError(f"{path} is no movie for a page; use one of {', '.join(_MIME)}")
    return mime


def _movie(path: Path | None, stimulus: str, budget: int) -> tuple[str, int]:
    """A movie or picture as HTML, and its bytes; words in its place where it cannot be shown."""
    if path is None:
        return '<p class="none">no movie given</p>', 0
    mime = _mime(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInputError(f"the movie of {stimulus!r} cannot be read: {error}") from error
    if len(data) > budget:
        return '<p class="none">movie left out: the page would grow too large</p>', 0
    uri = _data_uri(mime, data)
    if mime.startswith("image/"):
        return f'<img src="{uri}" alt="{escape(stimulus)}">', len(data)
    return f'<video src="{uri}" controls loop muted playsinline preload="auto"></video>', len(data)
