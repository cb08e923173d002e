"""Judge a folder of generated movies: what is there, the measures of each, a table of all.

A folder holds ``card.json`` (`MovieCard`) and a movie ``SEED/TRIAL.mp4`` of each trial and seed, as
`physion.trials.share.conditioning` asks for. A movie that is missing, damaged, too short or of
another shape is named and counted as missing; it is never right. Measures are kept in the output
folder under the digest of all that they depend on, so that the same call continues.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physion.compute.run_tasks import run_tasks
from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError
from physion.core.files import (
    file_sha256,
    folder_for_writing,
    json_digest,
    write_atomic,
    write_with_digest,
)
from physion.core.settings import read_json
from physion.judging.measure import COLUMNS, KnownMovie, measure, reference_of
from physion.judging.result import CARD, JUDGED, Judged, MovieCard
from physion.trials.dataset import Dataset
from physion.trials.files import MAX_FRAMES, MAX_SIDE
from physion.trials.share.conditioning import PROTOCOL, SEEDS
from physion.trials.share.items import items_of, true_movie
from physion.trials.video import open_movie, read_frames

SHAPES = 0.02
"""Largest difference of width by height from the trial's, as a fraction."""
RATES = (4.0, 240.0)
"""Smallest and largest rate of a movie, frames a second."""
_MOVIES = {".mp4", ".m4v", ".mov", ".webm", ".mkv", ".avi", ".gif"}
"""Endings of files that may be movies."""
_VERSION = 4
"""To be increased with every change that can alter a measure."""


@dataclass(frozen=True)
class _Job:
    """Movies of one trial, by seed, with what they are judged by."""

    dataset: Path
    trial: str
    first_frame: int
    movies: dict[str, Path]
    result: Path
    true: Path


def judge(
    folder: Path | str,
    dataset: Path | str,
    out: Path | str = "runs/judge",
    *,
    split: str = "testing",
    scenario: str | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Judged:
    """Measure generated movies and compare their outcomes with the true ones.

    Parameters
    ----------
    folder
        Movies and their card.
    dataset
        Dataset that the movies were generated from.
    out
        Folder for tables; measures that are there are not made again.
    split, scenario
        Trials that must be there.
    executor, progress
        Where to run, by default one process per core; called after each trial.

    Returns
    -------
    Judged
        Tables of movies and of seeds, and whether all is there.

    Raises
    ------
    BadInputError
        For a card that is missing or of other rules, trials without labels or all with a contact in
        the observed part, or no movie at all.
    UnknownNameError
        For an unknown split or scenario.
    """
    folder, out, known = Path(folder), Path(out), Dataset(dataset)
    card = _card(folder)
    trials = [item.trial for item in items_of(known, split=split, scenario=scenario)[::2]]
    rows = known.index.set_index("trial").loc[trials]
    if rows["observed_contact"].fillna(True).all():
        raise BadInputError(
            f"agent and patient touch in the observed part of every chosen trial of {dataset}, or "
            "that is not known: nothing is left to predict; take others"
        )
    status, digests = _what_is_there(folder, card, trials)
    jobs = {}
    for trial in trials:
        there = [seed for seed in card.seeds if status[trial, seed] == JUDGED]
        facts = [_VERSION, PROTOCOL, card.first_frame, [[s, digests[trial, s]] for s in there]]
        own = str(rows.loc[trial, "trial_file_sha256"])
        jobs[trial] = _Job(
            dataset=known.folder,
            trial=trial,
            first_frame=card.first_frame,
            movies={seed: folder / seed / f"{trial}.mp4" for seed in there},
            result=out / JUDGED / f"{trial}-{json_digest([*facts, own])[:12]}.json",
            true=out / "true" / f"{trial}-{own[:12]}.mp4",
        )
    with folder_for_writing(out):
        for name in (JUDGED, "true"):
            (out / name).mkdir(exist_ok=True)
        todo = {name: job for name, job in jobs.items() if job.movies and not job.result.is_file()}
        _, failed = run_tasks(
            _judge_trial, todo, folder=out, what="judging", executor=executor, progress=progress
        )
        movies, tracks = _collect(card, rows, jobs, status, failed)
        tables = {
            "movies": movies,
            "seeds": _by_seed(movies, card),
            "tracks": tracks,
            "predictions": _predictions(movies, card),
        }
        paths = {name: out / f"{name}.csv" for name in tables}
        for name, table in tables.items():
            write_with_digest(paths[name], table.to_csv(index=False).encode())
    complete = len(card.seeds) >= SEEDS and bool((movies["status"] == JUDGED).all())
    true = {trial: true_movie(known, trial, job.true) for trial, job in jobs.items() if job.movies}
    unknown = _unknown(folder, card, set(known.index["trial"]), aside={out, out / "true"})
    return Judged(card, movies, tables["seeds"], complete, paths, true, folder, unknown)


def _card(folder: Path) -> MovieCard:
    """Return the card of a folder; `BadInputError` if it cannot be used."""
    if not folder.is_dir():
        raise BadInputError(f"{folder} is not a folder; give the one with {CARD} and the movies")
    path = folder / CARD
    card = read_json(path, MovieCard)
    if card.protocol != PROTOCOL:
        raise BadInputError(
            f"{path}: protocol is {card.protocol!r}; this package judges by {PROTOCOL!r}: export "
            "the conditioning again, and generate what it asks for"
        )
    if not card.model.strip():
        raise BadInputError(f"{path}: model is empty; write the name of the model")
    if card.first_frame < 0:
        raise BadInputError(f"{path}: first_frame is {card.first_frame}, below 0")
    if not card.seeds or len(set(card.seeds)) < len(card.seeds):
        raise BadInputError(f"{path}: seeds must be names that differ, not {card.seeds}")
    for seed in card.seeds:
        if not seed or Path(seed).name != seed or seed.startswith("."):
            raise BadInputError(f"{path}: seed {seed!r} is not the name of a folder")
    return card


Keys = dict[tuple[str, str], str]


def _what_is_there(folder: Path, card: MovieCard, trials: list[str]) -> tuple[Keys, Keys]:
    """Return status and digest of each movie by trial and seed.

    Equal movies do not count as two seeds.
    """
    status, digests = {}, {}
    for trial in trials:
        seen: dict[str, str] = {}
        for seed in card.seeds:
            path = folder / seed / f"{trial}.mp4"
            status[trial, seed] = "missing"
            if path.is_file():
                digest = digests[trial, seed] = file_sha256(path)
                first = seen.setdefault(digest, seed)
                same = f"the same file as of seed {first}"
                status[trial, seed] = JUDGED if first == seed else same
    if not digests:
        raise BadInputError(
            f"{folder} holds no movie of these trials; the first one is looked for in "
            f"{folder / card.seeds[0] / trials[0]}.mp4"
        )
    return status, digests


def _unknown(folder: Path, card: MovieCard, trials: set[str], aside: set[Path]) -> tuple[str, ...]:
    """Return movies of unknown trials and seeds in a folder, but for the own output ``aside``."""
    found = []
    own = {path.resolve() for path in aside}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path.resolve() in own:
            continue
        if path.is_dir():
            movies = sorted(one for one in path.iterdir() if one.suffix.lower() in _MOVIES)
            if path.name in card.seeds:
                named = {f"{trial}.mp4" for trial in trials}
                found += [f"{path.name}/{one.name}" for one in movies if one.name not in named]
            elif movies:
                found.append(f"{path.name}/")
        elif path.suffix.lower() in _MOVIES:
            found.append(path.name)
    return tuple(found)


def _judge_trial(job: _Job) -> None:
    """Measure the movies of a trial and write the result; a pure function of the job."""
    dataset = Dataset(job.dataset)
    opened = dataset.trial(job.trial)
    pictures = read_frames(true_movie(dataset, job.trial, job.true))
    reference = reference_of(opened, pictures, opened.metadata.playback_rate)
    results: dict[str, Any] = {}
    for seed, path in job.movies.items():
        try:
            results[seed] = _judge_movie(path, job.first_frame, reference)
        except BadInputError as error:
            results[seed] = {"status": str(error)}
    write_atomic(job.result, json.dumps(results).encode())


def _judge_movie(path: Path, first_frame: int, reference: KnownMovie) -> dict[str, Any]:
    frames, height, width = reference.pictures.shape[:3]
    with open_movie(path) as opened:
        movie = opened.properties
    if max(movie.width, movie.height) > MAX_SIDE or not 1 <= movie.frames <= MAX_FRAMES:
        raise BadInputError(f"{path} has {movie}: too large or without frames")
    if abs(movie.width / movie.height / (width / height) - 1) > SHAPES:
        raise BadInputError(f"{path} has {movie}: another shape than the trial's movie")
    if not RATES[0] <= movie.rate <= RATES[1]:
        raise BadInputError(f"{path} has {movie}: a rate that is not {RATES[0]:g} to {RATES[1]:g}")
    lasts, seconds = movie.frames / movie.rate, (frames - 1 - first_frame) / reference.rate
    if lasts < seconds - 1e-6:  # the last frame is shown for the time of a frame
        raise BadInputError(f"{path} lasts {lasts:.2f} s; the trial lasts {seconds:.2f} s")
    pictures = read_frames(path, size=(height, width))
    measures, tracks = measure(pictures, movie.rate, first_frame, reference)
    truth = reference.tracks.at(np.minimum(np.round(tracks.frames).astype(int), frames - 1))
    columns = {"frame": tracks.frames}
    for name, seen in (("", tracks), ("true_", truth)):
        columns[f"{name}distance"] = seen.distance
        columns[f"{name}agent_x"], columns[f"{name}agent_y"] = seen.centers[:, 0].T
    return {
        "status": JUDGED,
        "measures": {name: _plain(value) for name, value in measures.items()},
        "tracks": {name: [_plain(round(float(v), 2)) for v in values]
                   for name, values in columns.items()},
    }  # fmt: skip


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _collect(
    card: MovieCard,
    facts: pd.DataFrame,
    jobs: Mapping[str, _Job],
    status: Keys,
    failed: Mapping[str, str],
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return a row per trial and seed, and the tracks of all movies."""
    rows = []
    tracks = [pd.DataFrame(columns=["frame", "trial", "seed"])]
    for trial, job in jobs.items():
        results = read_json(job.result, dict[str, Any]) if job.result.is_file() else {}
        for seed in card.seeds:
            found = results.get(seed, {})
            why = status[trial, seed]
            row = {
                "trial": trial,
                "scenario": facts.loc[trial, "scenario"],
                "seed": seed,
                "status": found.get("status", failed.get(trial, why)) if why == JUDGED else why,
                "true_contact": bool(facts.loc[trial, "contact"]),
                "true_frame": facts.loc[trial, "first_frame"],
                "observed_contact": bool(facts["observed_contact"].fillna(True)[trial]),
            }
            rows.append(row | dict.fromkeys(COLUMNS) | found.get("measures", {}))
            if "tracks" in found:
                tracks.append(pd.DataFrame(found["tracks"]).assign(trial=trial, seed=seed))
    return pd.DataFrame(rows), pd.concat(tracks[1:] or tracks, ignore_index=True)


def _by_seed(movies: pd.DataFrame, card: MovieCard) -> pd.DataFrame:
    """Return the means of each seed, their mean and their standard deviation."""
    judged = movies["status"] == JUDGED
    right = (judged & movies["contact"].eq(movies["true_contact"]))[~movies["observed_contact"]]
    numbers = movies[[name for name in COLUMNS if name != "contact_frame"]].astype(np.float64)
    lines = []
    for seed in card.seeds:
        own = movies["seed"] == seed
        line = {"movies": float((own & judged).sum()), "right": right[own].mean()}
        lines.append(line | numbers[own & judged].mean().to_dict())
    table = pd.DataFrame(lines)
    values = pd.concat([table, pd.DataFrame([table.mean(), table.std()])], ignore_index=True)
    return values.assign(seed=[*card.seeds, "mean", "sd"])[["seed", *table]]


def _predictions(movies: pd.DataFrame, card: MovieCard) -> pd.DataFrame:
    """Return P(contact) by trial: the fraction of its movies with contact; missing ones are wrong.

    With as many movies for as against, the first seed decides. Trials with a contact in the
    observed part are left out.
    """
    rows = []
    for trial, own in movies[~movies["observed_contact"]].groupby("trial", sort=True):
        truth = bool(own["true_contact"].iloc[0])
        votes = [
            bool(contact) if state == JUDGED else not truth
            for contact, state in zip(own["contact"], own["status"], strict=True)
        ]
        p = float(np.mean(votes))
        rows.append(
            {
                "stimulus": trial,
                "scenario": own["scenario"].iloc[0],
                "p_contact": p,
                "predicted": votes[0] if p == 0.5 else p > 0.5,
                "outcome": truth,
                "model": card.model,
                "inputs": card.conditioning,
            }
        )
    return pd.DataFrame(rows)
