"""What judging gives: tables, their comparison with people, and a page of movies by scenario."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from physion.core.files import write_atomic
from physion.core.html import Markup, joined, macros_of
from physion.judging.measure import COLUMNS
from physion.report.html import (
    MACROS,
    PageMovies,
    Section,
    number,
    paragraph,
    plural,
    render_document,
)
from physion.trials.video import encode_movie, open_movie, read_frames

if TYPE_CHECKING:
    from physion.report.compare import CompareResult

CARD = "card.json"
JUDGED = "judged"
_NAMED = 5
"""Names in a warning."""
PAGE_BYTES = 15_000_000
"""Largest size of a page with its movies."""
MOST_SHOWN = 6
"""Trials of a scenario whose movies are shown: those with a wrong outcome first."""
_TRIALS = macros_of("physion.report", "trials.html")


@dataclass(frozen=True)
class MovieCard:
    """What a user says of the movies.

    - ``protocol``: name of the rules, `PROTOCOL`. ``model``: name of the row of results.
    - ``conditioning``, ``prompt``: what the model was given, as text.
    - ``first_frame``: the frame of the trial that the first frame of each movie shows.
    - ``seeds``: folders of the movies.
    """

    protocol: str
    model: str
    conditioning: str
    prompt: str
    first_frame: int
    seeds: list[str]


@dataclass(frozen=True)
class Judged:
    """Result of `judge`.

    - ``card``: what the user says of the movies.
    - ``movies``: one row per trial and seed: ``trial``, ``scenario``, ``seed``, ``status``
      (*judged*, or why not), ``true_contact``, ``true_frame``, ``observed_contact`` (whether they
      truly touch in the observed part already; also if that is not known), and the measures of
      `COLUMNS`.
    - ``seeds``: one row per seed, then *mean* and *sd* over them: ``movies``, ``right`` (fraction
      of all movies asked for that show the true outcome; missing ones do not; without trials with
      ``observed_contact``), and the means of all measures.
    - ``complete``: all movies of at least `SEEDS` seeds were judged.
    - ``paths``: tables by name: movies, seeds, tracks (agent's centre and distance by frame, and
      the true ones), predictions (P(contact) of each trial without ``observed_contact`` over its
      seeds, for `physion.compare`).
    - ``true``: true movies by trial. ``generated``: folder of the generated ones.
    - ``unknown``: what lies in that folder but is not judged, as paths in it: folders of movies
      that the card does not name, and movies of trials that the dataset does not have.
    """

    card: MovieCard
    movies: pd.DataFrame
    seeds: pd.DataFrame
    complete: bool
    paths: Mapping[str, Path]
    true: Mapping[str, Path]
    generated: Path
    unknown: tuple[str, ...] = ()

    @cached_property
    def compared(self) -> CompareResult:
        """The comparison of the predictions with true outcomes and answers of people."""
        # Imported late: the processes that measure movies need no statistics.
        from physion.report.compare import compare

        return compare(self.paths["predictions"])

    def report(self, folder: Path | str) -> Path:
        """Write ``judge.html``, and the page of the comparison into ``report/``; return the first.

        Parameters
        ----------
        folder
            Folder of both.
        """
        path = Path(folder) / "judge.html"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, _page(self).encode())
        self.compared.report(path.parent / "report")
        return path

    @property
    def missing(self) -> pd.DataFrame:
        """Rows of the movies that were not judged."""
        return self.movies[self.movies["status"] != JUDGED]

    @property
    def warnings(self) -> list[str]:
        """What lies in the folder but is not judged, and what does not count, a line each."""
        found = []
        if self.unknown:
            more = ", ..." if len(self.unknown) > _NAMED else ""
            found.append(
                "not judged, because the card does not name the seed or the dataset has no such "
                f"trial ({len(self.unknown)}): {', '.join(self.unknown[:_NAMED])}{more}"
            )
        left = self.movies["trial"][self.movies["observed_contact"]].nunique()
        if left:
            found.append(
                f"{plural(left, 'trial')} with a contact in the observed part, or where that is "
                "not known: left out of right and of the comparison"
            )
        return found


def verdict(judged: Judged) -> str:
    """Return the state of a folder of movies in one line."""
    missing, count = len(judged.missing), len(judged.movies)
    state = "complete" if judged.complete else "not complete"
    return (
        f"{judged.card.model}: {state}, {count - missing} of {plural(count, 'movie')} judged by "
        f"{judged.card.protocol}"
    )


def described(judged: Judged) -> pd.DataFrame:
    """Return measures as texts: one row per measure, with mean and sd over the seeds."""
    table = judged.seeds.set_index("seed")
    meanings = {
        "right": "fraction of all movies asked for that show the true outcome; a missing one does "
        "not; without trials with a contact in the observed part",
        **COLUMNS,
    }
    rows = [
        {
            "measure": name,
            "mean": number(table.loc["mean", name], 3),
            "sd of seeds": number(table.loc["sd", name], 3),
            "meaning": meaning,
        }
        for name, meaning in meanings.items()
        if name in table
    ]
    return pd.DataFrame(rows)


def _page(judged: Judged) -> str:
    """Return the page: the verdict, measures, what is missing, movies of some trials."""
    card, table, missing = judged.card, described(judged), judged.missing
    facts = {
        "conditioning": card.conditioning,
        "prompt": card.prompt,
        "first frame": str(card.first_frame),
        "seeds": ", ".join(card.seeds),
    }
    lead = joined(
        [
            paragraph(verdict(judged), "lead"),
            *(paragraph(text) for text in judged.warnings),
            _table([CARD, ""], pd.DataFrame(facts.items())),
            _table(list(table.columns), table),
        ]
    )
    sections = []
    if len(missing):
        rows = _table(["trial", "seed", "why"], missing[["trial", "seed", "status"]])
        sections.append(Section("Missing movies, which count as wrong", rows))
    left = PAGE_BYTES
    shown = (judged.movies["status"] == JUDGED) & ~judged.movies["observed_contact"]
    for scenario, own in judged.movies[shown].groupby("scenario"):
        right = own["contact"].astype(bool) == own["true_contact"]
        order = own.assign(right=right).sort_values(["right", "trial"], kind="stable")
        cards = []
        for row in order.drop_duplicates("trial").head(MOST_SHOWN).itertuples():
            trial, seed = str(row.trial), str(row.seed)
            movie, left = _side_by_side(
                judged.generated / seed / f"{trial}.mp4", judged.true[trial], card.first_frame, left
            )
            words = ["contact" if yes else "no contact" for yes in (row.contact, row.true_contact)]
            kind = "right" if row.right else "wrong"
            outcome = _TRIALS.outcome("contact" if row.contact else "none", words[0])
            name = f"{trial}, seed {seed}. Truly {words[1]}: {kind}."
            cards.append(_TRIALS.card("generated | true", outcome, movie, "", name))
        sections.append(Section(str(scenario), Markup(_TRIALS.cards(cards, "pairs"))))
    return render_document(f"Movies of {card.model}", lead, sections)


def _table(header: list[str], rows: pd.DataFrame) -> Markup:
    return Markup(MACROS.table(header, [("", rows.astype(str).to_numpy().tolist())]))


def _side_by_side(generated: Path, true: Path, first: int, left: int) -> tuple[Markup, int]:
    """Return a generated movie and the true one next to it, and the bytes that are left."""
    truth = read_frames(true)
    with open_movie(generated) as one, open_movie(true) as other:
        step = one.properties.rate / other.properties.rate
        rate = round(other.properties.rate)
    frames = read_frames(generated, size=(truth.shape[1], truth.shape[2]))
    truth = truth[min(first, len(truth) - 1) :]
    at = np.minimum(np.round(np.arange(len(truth)) * step).astype(int), len(frames) - 1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "movie.mp4"
        path.write_bytes(encode_movie(np.concatenate([frames[at], truth], axis=2), rate=rate))
        movies = PageMovies({"both": path}, left)
        return movies.show("both", "the generated movie, and next to it the true one"), movies.left
