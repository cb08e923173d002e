"""A study from a dataset of ours: which trials people see, and in which places.

Of each scenario as many testing trials with as without contact are drawn, and as many
familiarization trials, whose order is the same for everybody.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from physion.analysis.tables.stimuli import SCENARIOS
from physion.errors import BadInputError, UnknownNameError
from physion.experiment.study.media import Source
from physion.seeds import generator
from physion.trials.dataset import Dataset
from physion.trials.layout import TrialPaths

Look = Literal["free", "redyellow"]
SPLITS = {"familiarization": "familiarization", "test": "testing"}
"""Split of a dataset from which a phase takes its trials."""
TEST, PRACTICE = 150, 10
"""Trials of a session, as in the study."""


@dataclass(frozen=True)
class Choice:
    """What was chosen; ``notes`` say where fewer were there than asked for."""

    sources: tuple[Source, ...]
    notes: tuple[str, ...] = ()

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Scenarios in the order of the paper, others after them."""
        found = {source.scenario for source in self.sources}
        return tuple(in_paper_order(found))


def choose_trials(
    dataset: Path,
    *,
    scenarios: Sequence[str] = (),
    test: int = TEST,
    practice: int = PRACTICE,
    look: Look = "free",
    seed: int = 0,
) -> Choice:
    """Testing and familiarization trials of a dataset; of all its tested scenarios by default.

    ``test`` and ``practice`` are even: half with contact, half without. The same dataset and seed
    give the same choice. `BadInputError` where a scenario has no trial of one kind, where trials
    have no movies, or none in the ``look``.
    """
    found = Dataset(dataset)
    tested = set(found.index["scenario"][found.index["split"] == SPLITS["test"]])
    if not tested:
        raise BadInputError(f"{dataset} has no testing trials; physion generate makes them")
    for name in scenarios:
        if name not in tested:
            raise UnknownNameError(f"scenario of the testing trials of {dataset}:", name, tested)
    counts = {"familiarization": practice, "test": test}
    sources, notes = [], []
    for name in scenarios or in_paper_order(tested):
        for phase, count in counts.items():
            rows, note = _draw(found, name, phase, count, seed)
            sources += [_source(found, row, phase, i, look) for i, row in enumerate(rows)]
            notes += [note] if note else []
    return Choice(tuple(sources), tuple(notes))


def choose_familiarization(
    dataset: Path, scenario: str, *, count: int = PRACTICE, look: Look = "free", seed: int = 0
) -> Choice:
    """The familiarization trials alone; as `choose_trials`."""
    found = Dataset(dataset)
    rows, note = _draw(found, scenario, "familiarization", count, seed)
    sources = [_source(found, row, "familiarization", i, look) for i, row in enumerate(rows)]
    return Choice(tuple(sources), (note,) if note else ())


def in_paper_order(scenarios: set[str]) -> Iterator[str]:
    """Known scenarios in the order of the paper, then others in alphabetical order."""
    yield from (name for name in SCENARIOS if name in scenarios)
    yield from sorted(scenarios - set(SCENARIOS))


def check_even(count: int, option: str) -> None:
    """`BadInputError` unless half of so many trials can have contact."""
    if count < 2 or count % 2:
        raise BadInputError(
            f"{option} must be even and 2 or more, half with contact and half without, not {count}"
        )


def _draw(
    dataset: Dataset, scenario: str, phase: str, count: int, seed: int
) -> tuple[list[dict[str, Any]], str]:
    """Rows of the index in their places, and a note where there are fewer than asked for."""
    check_even(count, "--test" if phase == "test" else "--practice")
    split = SPLITS[phase]
    table = dataset.index
    table = table[(table["split"] == split) & (table["scenario"] == scenario)]
    kinds = [table[table["contact"] == contact] for contact in (True, False)]
    half = min(count // 2, *map(len, kinds))
    if half == 0:
        lacking = "with" if len(kinds[0]) == 0 else "without"
        raise BadInputError(
            f"{dataset.folder} has no {split} trial of {scenario} {lacking} contact; make some: "
            f"physion generate {dataset.folder} --scenario {scenario} --split {split} "
            f"--count {count}"
        )
    # Each kind has a stream of its own, so that more trials of the one do not redraw the other.
    chosen = pd.concat([_sample(kind, half, scenario, phase, seed) for kind in kinds])
    order = generator("study places", seed, scenario, phase)
    rows = chosen.iloc[order.permutation(len(chosen))].to_dict("records")
    note = ""
    if 2 * half < count:
        note = f"{scenario}: {2 * half} {split} trials in place of {count}: no more are balanced"
    return rows, note


def _sample(kind: pd.DataFrame, half: int, scenario: str, phase: str, seed: int) -> pd.DataFrame:
    contact = str(bool(kind["contact"].iloc[0]))
    draws = generator("study trials", seed, scenario, phase, contact)
    return kind.iloc[draws.permutation(len(kind))[:half]]


def _source(dataset: Dataset, row: dict[str, Any], phase: str, place: int, look: Look) -> Source:
    paths = TrialPaths(dataset.folder, row["split"], row["scenario"], row["trial"])
    free = row["look"] != look
    columns = {"movie": "movie", "observed": "observed_movie", "map": "map"}
    files = {"movie": paths.movie, "observed": paths.observed_movie, "map": paths.map}
    if free:
        if look != "free" or pd.isna(row["free_movie"]):
            raise BadInputError(
                f"trial {row['trial']} of {dataset.folder} has no movie in the look {look!r}, only "
                f"{row['look']!r}; choose --look {row['look']}, or generate with --look {look}"
            )
        columns |= {"movie": "free_movie", "observed": "free_observed_movie"}
        files |= {"movie": paths.free_movie, "observed": paths.free_observed_movie}
    digests = {name: row[f"{column}_sha256"] for name, column in columns.items()}
    lacking = [name for name, digest in digests.items() if pd.isna(digest)]
    if lacking:
        raise BadInputError(
            f"trial {row['trial']} of {dataset.folder} has no {lacking[0]} file; generate trials "
            "with movies"
        )
    return Source(
        stimulus=str(row["trial"]),
        scenario=str(row["scenario"]),
        phase=phase,
        place=place,
        label=bool(row["contact"]),
        look=look,
        movie=files["movie"],
        observed=files["observed"],
        map=files["map"],
        frames=int(row["observed_frames"]),
        digests=digests,
    )
