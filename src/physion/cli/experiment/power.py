"""Power of a planned study: how often an effect is found with so many people and stimuli.

Studies are simulated from the fractions of yes of stimuli that people have answered.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Options:
    """The effect, the sizes, and the people whose answers are drawn."""

    humans: Path = Path("official")
    """Answers of people by stimulus: official (the package's own), or a folder with
    human_accuracy-*.csv."""
    labels: Path | None = None
    """Official outcomes (stim_ID, label); if not given, looked for next to the folder of people."""
    responses: tuple[Path, ...] = ()
    """Answers of single participants, such as of a pilot, in place of --humans."""
    sessions: Path | None = None
    """Table of sessions of our export."""
    scenario: str = ""
    """Only stimuli of this scenario."""
    question: Literal["models", "groups"] = "models"
    """Two models differ in r with people, or two groups of people in accuracy."""
    effect: float = 0.1
    """Difference of r, or of accuracy, that is to be found."""
    base: float = 0.5
    """r of the worse model."""
    alike: float = 0.5
    """r of the two models with each other, given the fractions of yes."""
    person_sd: float = 0.35
    """Standard deviation of persons in log odds."""
    people: tuple[int, ...] = (20, 40, 60, 100)
    """Numbers of people; with groups, in each of them."""
    stimuli: tuple[int, ...] = (30, 60, 100, 150)
    """Numbers of stimuli."""
    repeats: int = 400
    """Simulated studies of each size."""
    seed: int = 0
    """Seed of the simulation."""
    json: bool = False
    """Print one JSON list, an object a size."""


def main(options: Options) -> int:
    """Print the power of every size."""
    from physion.analysis.people.power import PlannedEffect, power_table
    from physion.cli.output import console, text_table

    planned = PlannedEffect(
        options.question, options.effect, options.base, options.alike, options.person_sd
    )
    table = power_table(
        _fractions(options),
        planned,
        options.people,
        options.stimuli,
        repeats=options.repeats,
        seed=options.seed,
    )
    if options.json:
        print(json_module.dumps(table.to_dict("records")))
        return 0
    wide = table.pivot(index="people", columns="stimuli", values="power").reset_index()
    wide.columns = ["people \\ stimuli", *(str(name) for name in wide.columns[1:])]
    what = {"models": "r of two models", "groups": "accuracy of two groups of people"}
    title = f"Power: difference of {options.effect:g} in {what[options.question]}"
    console.print(text_table(wide, title), markup=False, soft_wrap=True)
    note = f"{options.repeats} simulated studies of each size; --json adds the intervals"
    console.print(note, markup=False, soft_wrap=True)
    return 0


def _fractions(options: Options) -> pd.DataFrame:
    """Return ``p_yes``, ``count`` and ``label`` of the stimuli that people answered."""
    from physion.analysis.tables import LABELS_FILE, with_labels
    from physion.core.errors import BadInputError
    from physion.report.compare import read_averages

    if options.responses:
        from physion.analysis.people.measures import accuracy_by_stimulus
        from physion.analysis.people.results import read_any_responses

        test = read_any_responses(options.responses, options.sessions).test
        rows = accuracy_by_stimulus(test)
    else:
        people, labels, _, _ = read_averages(options.humans, options.labels)
        if labels is None:
            raise BadInputError(f"no {LABELS_FILE} lies near {options.humans}; give --labels")
        rows = with_labels(people, labels)
        rows = rows[rows["label"].notna()]
    if options.scenario:
        rows = rows[rows["scenario"] == options.scenario]
        if rows.empty:
            raise BadInputError(f"nobody answered a stimulus of scenario {options.scenario!r}")
    return rows
