"""Selection of a study's stimuli from a generated dataset.

For each scenario, testing and familiarization trials are drawn, half of them with contact. The
order of the familiarization trials is fixed here and the same for all participants.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import SCENARIOS
from physion.core.seeds import generator
from physion.experiment.study.init.media import StimulusSource
from physion.trials.dataset import Dataset
from physion.trials.index import TrialPaths

Look = Literal["free", "redyellow"]
SPLITS = {"familiarization": "familiarization", "test": "testing"}
"""Split of the dataset from which the trials of each phase are drawn."""
TEST, PRACTICE = 150, 10
"""Test and familiarization trials per session, as in the official study."""


@dataclass(frozen=True)
class StimulusSelection:
    """Selected stimuli; ``notes`` report where fewer were available than requested."""

    sources: tuple[StimulusSource, ...]
    notes: tuple[str, ...] = ()

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Scenarios of the stimuli, in the order of the paper, then any others by name."""
        names = {source.scenario for source in self.sources}
        return tuple(in_paper_order(names))


def choose_trials(
    dataset: Path,
    *,
    scenarios: Sequence[str] = (),
    test: int = TEST,
    practice: int = PRACTICE,
    look: Look = "free",
    seed: int = 0,
) -> StimulusSelection:
    """Select testing and familiarization trials of a dataset.

    Parameters
    ----------
    dataset
        Folder of the dataset.
    scenarios
        Scenarios to use; by default all that have testing trials.
    test, practice
        Number of test and familiarization trials per scenario; even, half of them with contact.
    look
        Colours of the movies.
    seed
        Seed of the draw. The same dataset and seed give the same selection.

    Raises
    ------
    BadInputError
        A scenario has no trial with (or without) contact, or trials have no movies in this look.
    """
    opened = Dataset(dataset)
    tested = set(opened.index["scenario"][opened.index["split"] == SPLITS["test"]])
    if not tested:
        raise BadInputError(f"{dataset} has no testing trials; physion generate makes them")
    for name in scenarios:
        if name not in tested:
            raise UnknownNameError(f"scenario of the testing trials of {dataset}:", name, tested)
    counts = {"familiarization": practice, "test": test}
    sources, notes = [], []
    for name in scenarios or in_paper_order(tested):
        for phase, count in counts.items():
            rows, note = _draw(opened, name, phase, count, seed)
            sources += [_source(opened, row, phase, i, look) for i, row in enumerate(rows)]
            notes += [note] if note else []
    return StimulusSelection(tuple(sources), tuple(notes))


def choose_familiarization(
    dataset: Path, scenario: str, *, count: int = PRACTICE, look: Look = "free", seed: int = 0
) -> StimulusSelection:
    """Select the familiarization trials of one scenario only, as `choose_trials` does."""
    opened = Dataset(dataset)
    rows, note = _draw(opened, scenario, "familiarization", count, seed)
    sources = [_source(opened, row, "familiarization", i, look) for i, row in enumerate(rows)]
    return StimulusSelection(tuple(sources), (note,) if note else ())


def in_paper_order(scenarios: set[str]) -> Iterator[str]:
    """Known scenarios in the order of the paper, then others in alphabetical order."""
    yield from (name for name in SCENARIOS if name in scenarios)
    yield from sorted(scenarios - set(SCENARIOS))


def check_even(count: int, option: str) -> None:
    """Check that ``count`` is even and positive, so that half of the trials can have contact."""
    if count < 2 or count % 2:
        raise BadInputError(
            f"{option} must be even and 2 or more, half with contact and half without, not {count}"
        )


def _draw(
    dataset: Dataset, scenario: str, phase: str, count: int, seed: int
) -> tuple[list[dict[str, Any]], str]:
    """Draw ``count`` rows of the index, half of them with contact, in random order.

    Returns the rows, and a note (else an empty text) if fewer trials were available.
    """
    check_even(count, "--test" if phase == "test" else "--practice")
    split = SPLITS[phase]
    table = dataset.index
    table = table[(table["split"] == split) & (table["scenario"] == scenario)]
    by_label = [table[table["contact"] == contact] for contact in (True, False)]
    half = min(count // 2, *map(len, by_label))
    if half == 0:
        lacking = "with" if len(by_label[0]) == 0 else "without"
        imported = dataset.index["recorded_contact"].notna().any()
        advice = (
            "for official scenes give --scenes official in place of --trials"
            if imported
            else f"to make some: physion generate {dataset.folder} --scenario {scenario} "
            f"--split {split} --count {count}"
        )
        raise BadInputError(
            f"{dataset.folder} has no {split} trial of {scenario} {lacking} contact; {advice}"
        )
    # Separate random streams for trials with and without contact: adding trials with one label
    # does not change which trials with the other label are drawn.
    chosen = pd.concat([_sample(group, half, scenario, phase, seed) for group in by_label])
    rng = generator("study places", seed, scenario, phase)
    rows = chosen.iloc[rng.permutation(len(chosen))].to_dict("records")
    note = ""
    if 2 * half < count:
        note = (
            f"{scenario}: {2 * half} {split} trials instead of {count}, since half must have "
            "contact and no more are available"
        )
    return rows, note


def _sample(group: pd.DataFrame, half: int, scenario: str, phase: str, seed: int) -> pd.DataFrame:
    """Draw ``half`` rows of a table whose rows all have the same contact label."""
    contact = str(bool(group["contact"].iloc[0]))
    rng = generator("study trials", seed, scenario, phase, contact)
    return group.iloc[rng.permutation(len(group))[:half]]


def _source(
    dataset: Dataset, row: dict[str, Any], phase: str, place: int, look: Look
) -> StimulusSource:
    """Return the source files of one row of the index, with movies in the given look."""
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
    return StimulusSource(
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
