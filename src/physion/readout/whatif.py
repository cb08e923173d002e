"""Does a model's prediction change where one change of the scene changes the outcome?

A pair is a trial and one of its variants (`physion.trials.making.whatif`), or two trials with the
same test whose cues differ (`physion.trials.making.cues`). With P and P' the predictions of trial
and variant, o and o' their outcomes (0 or 1):

- ``accuracy``: fraction of variants with P' on the side of o'; with a cue, of both trials;
- ``paired``: of the pairs whose outcomes differ, those with P and P' both on the right side;
- ``moved``: of the same pairs, those in which P' - P has the sign of o' - o; no change counts half;
- ``unmoved``: mean of 1 - \\|P' - P\\| over the pairs with equal outcomes.

A constant P has accuracies of the base rate, paired 0, moved .5 and unmoved 1; a coin .25 and .5.
Standard errors are of means over trials: pairs of one trial are not independent.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from physion.trials.making.whatif import CUES, pair_of, parts_of

MEASURES = ("accuracy", "paired", "moved", "unmoved")
ALL = "all"
TRAINING = ("init", "protocol", "dynamics_training_dataset", "seed")
"""Columns that tell trainings of one model apart."""
_NAMED = 6
"""Bodies in a line about removals."""


def whatif_scores(predictions: pd.DataFrame) -> pd.DataFrame:
    """Return the scores of every model and kind of change, and of all kinds together.

    Parameters
    ----------
    predictions
        Tables of `physion.evaluate`, one below the other; columns of `TRAINING` may be missing.
        Pairs of which a part is missing, or has a contact in the observed part, are left out.

    Returns
    -------
    scores
        ``model``, ``readout``, the columns of `TRAINING` that there are, ``change``, ``pairs``,
        ``changed`` (pairs whose outcomes differ), and for each measure its mean and
        ``MEASURE_se``; NaN where there is no pair, or no second trial for the error. Empty without
        variants.
    """
    groups = _groups(predictions)
    names = [*groups, "change", "pairs", "changed"]
    columns = [*names, *(f"{m}{end}" for m in MEASURES for end in ("", "_se"))]
    pairs = _pairs(predictions)
    if pairs.empty:
        return pd.DataFrame(columns=columns)
    rows = []
    for values, own in pairs.groupby(groups, sort=False):
        for change, part in [(ALL, own), *own.groupby("change")]:
            row = dict(zip(groups, values, strict=True)) | {"change": change, "pairs": len(part)}
            row["changed"] = int(part["moved"].notna().sum())
            for measure in MEASURES:
                row[measure], row[f"{measure}_se"] = mean_over_trials(part, measure)
            rows.append(row)
    return pd.DataFrame(rows, columns=columns)


def causes(predictions: pd.DataFrame) -> pd.DataFrame:
    """Return what each removal of a body does: one that ends a contact took a cause of it.

    Returns
    -------
    causes
        One row per trial and removed body, of the pairs that `whatif_scores` counts: ``trial``,
        ``removed``, ``before`` and ``after`` (whether agent and patient touch with the body and
        without it), ``changed``. Outcomes are the same for all models.
    """
    rows = _pairs(predictions)
    rows = rows[rows["change"] == "remove"]
    removed = [parts_of(name)[1].partition(".")[2] for name in rows["stimulus"]]
    before, after = (rows[name].astype(bool) for name in ("outcome_base", "outcome"))
    table = pd.DataFrame(
        {"trial": rows["base"], "removed": removed, "before": before, "after": after}
    )
    table = table.assign(changed=before != after).drop_duplicates()
    return table.sort_values(["trial", "removed"], ignore_index=True)


def causes_line(table: pd.DataFrame) -> str:
    """Return how many removals of `causes` change the outcome, and of which bodies, in one line."""
    of_body = table.groupby("removed")["changed"].agg(["sum", "size"])
    of_body = of_body.sort_values("sum", ascending=False, kind="stable")
    named = [f"{name} {row['sum']} of {row['size']}" for name, row in of_body.iterrows()]
    more = ", ..." if len(named) > _NAMED else ""
    return (
        f"{int(table['changed'].sum())} of {len(table)} removals change the outcome: "
        f"{', '.join(named[:_NAMED])}{more}"
    )


def _groups(predictions: pd.DataFrame) -> list[str]:
    """Return the columns whose values belong to one training and readout of one model."""
    return [name for name in ("model", "readout", *TRAINING) if name in predictions]


def _pairs(predictions: pd.DataFrame) -> pd.DataFrame:
    """Return the measures of each pair; NaN where one does not apply."""
    table = predictions[predictions["observed_contact"] == False].copy()  # noqa: E712
    names = [parts_of(name) for name in table["stimulus"]]
    table["base"] = [base for base, _ in names]
    table["change"] = [change.partition(".")[0] for _, change in names]
    table["pair"] = [pair_of(name)[0] for name in table["stimulus"]]
    changed = np.array([pair_of(name)[1] for name in table["stimulus"]], np.bool_)
    keys = [*_groups(predictions), "base", "pair"]
    table[keys] = table[keys].fillna("")
    variant, base = table[changed], table[~changed]
    pairs = variant.merge(base, on=keys, suffixes=("", "_base"))
    after, before = pairs["p_contact"], pairs["p_contact_base"]
    truth, old = pairs["outcome"].astype(float), pairs["outcome_base"].astype(float)
    differ = truth != old
    right, right_before = (after > 0.5) == (truth == 1), (before > 0.5) == (old == 1)
    both = (right.astype(float) + right_before) / 2
    pairs["accuracy"] = right.astype(float).where(~pairs["change"].isin(CUES), both)
    pairs["paired"] = (right & right_before).astype(float).where(differ)
    pairs["moved"] = ((1 + np.sign((after - before) * (truth - old))) / 2).where(differ)
    pairs["unmoved"] = (1 - (after - before).abs()).where(~differ)
    return pairs


def mean_over_trials(part: pd.DataFrame, measure: str) -> tuple[float, float]:
    """Return the mean of a measure over pairs, and its standard error over trials.

    ``base`` names the trial of each row. With residual sums r_i of the n trials and m pairs:
    se^2 = n / (n - 1) sum r_i^2 / m^2.
    """
    known = part[["base", measure]].dropna()
    if known.empty:
        return np.nan, np.nan
    mean = known[measure].mean()
    sums = (known[measure] - mean).groupby(known["base"]).sum()
    n = len(sums)
    if n < 2:
        return float(mean), np.nan
    return float(mean), float(np.sqrt(n / (n - 1) * (sums**2).sum()) / len(known))
