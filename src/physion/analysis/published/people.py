"""Statements of the paper about people, and what the released tables of people contain."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy import stats

from physion.analysis.models.zones import released_zone
from physion.analysis.people.people import spearman_brown
from physion.analysis.published.tables import PublishedTables
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.stimuli import MEAN

RECRUITED = 800
PEOPLE_EXCLUDED = 112
THIRDS = ((0.0, 1 / 3, "hard", 0.10), (1 / 3, 2 / 3, "chance", 0.22), (2 / 3, 1.0, "easy", 0.68))
"""Accuracy of people from, to, the paper's word for such stimuli, and the share that it prints."""


def people_by_scenario(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return one row a scenario, then the mean over scenarios.

    Columns: those of `PublishedTables.people`; ``half_r_full`` (split-half r corrected by Spearman
    and Brown to all of the people: 2 r / (1 + r); the released numbers are not corrected);
    ``stimuli`` and ``participants`` of the tables by stimulus, ``accuracy_by_stimulus`` (their
    mean; a laxer exclusion than ``accuracy``), ``below_chance`` (stimuli on which p + 1.96 sqrt(p
    (1 - p) / n) < 0.5). In the row of the mean ``zone_low`` and ``zone_high``, likewise of kappa,
    are the paper's grey bands (`zones.released_zone`), and so are ``half_r_low`` and
    ``half_r_high`` for r (as `zones.released_r_zone`).
    """
    draws = bootstrap or Bootstrap()
    stimuli = tables.stimuli
    right = stimuli["accuracy"]
    margin = 1.96 * np.sqrt(right * (1 - right) / stimuli["count"])
    own = (
        stimuli.assign(below=right + margin < 0.5)
        .groupby("scenario")
        .agg(
            stimuli=("stimulus", "size"),
            participants=("count", "max"),
            accuracy_by_stimulus=("accuracy", "mean"),
            below_chance=("below", "sum"),
        )
    )
    table = tables.people.merge(own, left_on="scenario", right_index=True, how="left")
    table.insert(
        table.columns.get_loc("half_r_high") + 1,
        "half_r_full",
        spearman_brown(table["half_r"].to_numpy(np.float64)),
    )
    return pd.concat([table, pd.DataFrame([_mean_row(table, draws)])], ignore_index=True)


def _mean_row(table: pd.DataFrame, draws: Bootstrap) -> dict[str, object]:
    row: dict[str, object] = {"scenario": MEAN}
    averaged = ["half_r", "half_r_low", "half_r_high", "half_r_full", "accuracy_by_stimulus"]
    row |= {name: float(table[name].mean()) for name in averaged}
    row |= {name: int(table[name].sum()) for name in ("stimuli", "participants", "below_chance")}
    for name, low, high in (
        ("accuracy", "zone_low", "zone_high"),
        ("kappa", "kappa_low", "kappa_high"),
    ):
        row[name], row[low], row[high] = released_zone(table[name].to_numpy(np.float64), draws)
    return row


def people_claims(tables: PublishedTables) -> pd.DataFrame:
    """Return the paper's statements about people: ``claim``, ``printed``, ``ours``, ``note``."""
    means = tables.people["accuracy"].to_numpy(dtype=np.float64)
    test = stats.ttest_1samp(means, 0.5)
    stimuli = tables.stimuli
    answered = stimuli.groupby("scenario")["count"].max()
    rows: list[tuple[str, str, str, str]] = [
        (
            "participants after exclusions",
            f"{RECRUITED} - {PEOPLE_EXCLUDED} = {RECRUITED - PEOPLE_EXCLUDED}",
            f"{answered.sum():.0f}",
            "sum over scenarios of the people behind the tables by stimulus",
        ),
        (
            "proportion correct over scenarios",
            "0.71",
            f"{means.mean():.3f}",
            "0.71 is the mean of the particle models; see the regressions",
        ),
        (
            "people against chance",
            "t = 27.5, p < 1e-7",
            f"t({len(means) - 1}) = {test.statistic:.1f}, p = {test.pvalue:.1e}",
            "scenario means against 0.5; the printed t is against 0, of particle models",
        ),
    ]
    for low, high, word, share in THIRDS:
        own = stimuli["accuracy"]
        # A stimulus on the border belongs to the middle third.
        if word == "hard":
            found = own < high
        elif word == "easy":
            found = own > low
        else:
            found = own.between(low, high)
        rows.append(
            (
                f"{word} stimuli (accuracy {low:.0%} to {high:.0%})",
                f"{share:.0%}",
                f"{found.mean():.1%}",
                f"{int(found.sum())} of {len(own)} stimuli, Roll's ledges left out",
            )
        )
    return pd.DataFrame(rows, columns=["claim", "printed", "ours", "note"])
