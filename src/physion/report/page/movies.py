"""Stimuli that a page shows, and their movies within a limit of bytes."""

from __future__ import annotations

from html import escape
from pathlib import Path

import pandas as pd

from physion.analysis.models.comparison import Comparison
from physion.errors import BadInputError
from physion.report.inputs import ReportInputs
from physion.report.page import blocks
from physion.report.page.document import data_uri
from physion.stimulus_names import canonical_name

_MIME = {
    ".mp4": "video/mp4",
    ".webm": "video/webm",
    ".gif": "image/gif",
    ".png": "image/png",
    ".jpg": "image/jpeg",
}


def movies_of(folder: Path) -> dict[str, Path]:
    """Return the movies of a dataset's testing trials, by canonical stimulus, for `ReportInputs`.

    Raises `BadInputError` if ``folder`` is no dataset or has no testing trial.
    """
    from physion.trials.dataset import Dataset

    dataset = Dataset(folder)
    trials = dataset.trials("testing")
    if not trials:
        raise BadInputError(f"{folder} has no testing trial, so no movie that people saw")
    return {canonical_name(trial): dataset.paths(trial).movie for trial in trials}


def widest_gaps(comparison: Comparison, count: int) -> pd.DataFrame:
    """Return the stimuli on which a model and people differ most, at most ``count`` rows.

    Models alternate: each adds the stimulus with its largest |P(contact) - P(yes)| that is not yet
    chosen; ties are resolved by name. Stimuli whose simulated outcome is not the official one are
    skipped, since there the physics differs and not the model. The result has rows of
    ``comparison.stimuli``, each of the model that added it.
    """
    rows = comparison.stimuli
    rows = rows[(rows["label"] == rows["simulated"]) & rows["gap"].notna()]
    rows = rows.assign(size=rows["gap"].abs())
    ranked = rows.sort_values(["size", "stimulus"], ascending=[False, True], kind="stable")
    queues = [list(subset.index) for _, subset in ranked.groupby("agent", sort=False)]
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


def gaps(inputs: ReportInputs) -> str:
    """Return a card for each of the largest differences, with its movie within the limit of
    bytes.
    """
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
    """Raise `BadInputError` for a movie to be shown that is absent or of a wrong kind."""
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
    """Return a movie or picture as HTML, and its bytes; text instead if it cannot be shown."""
    if path is None:
        return '<p class="none">no movie given</p>', 0
    mime = _mime(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInputError(f"the movie of {stimulus!r} cannot be read: {error}") from error
    if len(data) > budget:
        return '<p class="none">movie left out: the page would grow too large</p>', 0
    uri = data_uri(mime, data)
    if mime.startswith("image/"):
        return f'<img src="{uri}" alt="{escape(stimulus)}">', len(data)
    return f'<video src="{uri}" controls loop muted playsinline preload="auto"></video>', len(data)
