"""Scores without the trials whose contact already happened in the observed part.

There nothing is left to predict: a model that sees the contact is right without physics.
"""

from __future__ import annotations

import pandas as pd

from physion.analysis.models.anchors import anchor_scores, with_kind
from physion.analysis.models.score_tables import score_table
from physion.analysis.tables.stimuli import in_order

SETTING = "Contact in the observed part"
"""Name of the setting that says which trials `later_scores` leaves out."""


def observed_contacts(predictions: pd.DataFrame) -> pd.Series:
    """Return by stimulus whether the contact was observed, for the stimuli for which it is known.

    ``predictions``: from `predictions.name_models`; a model that knows suffices for all.
    """
    known = predictions[predictions["observed_contact"].notna()].drop_duplicates("stimulus")
    return known.set_index("stimulus")["observed_contact"].astype(bool)


def later_scores(stimuli: pd.DataFrame, level: float = 0.95) -> tuple[pd.DataFrame, str]:
    """Return the scores of models and anchors on trials without observed contact, and a sentence.

    Parameters
    ----------
    stimuli
        As `comparison.Comparison.stimuli`. Trials of which it is not known whether the contact was
        observed (``observed_contact`` is None) are left out too.
    level
        Level of the intervals.

    Returns
    -------
    The rows of models, then of computed anchors, with the columns of `anchors.with_kind`; empty if
    nothing is known or left. The sentence says what was left out, or why the table is empty.
    """
    each = stimuli.drop_duplicates("stimulus")
    if each["observed_contact"].isna().all():
        return pd.DataFrame(), (
            "not known: the predictions have no column Observed Contact, so there are no scores "
            "without such trials"
        )
    observed, later = each["observed_contact"] == True, each["observed_contact"] == False  # noqa: E712
    counts = [
        f"{name} {int(observed[own].sum())} of {int(own.sum())}"
        for name in in_order(each["scenario"])
        if (own := each["scenario"] == name).any()
    ]
    words = f"{int(observed.sum())} of {len(each)} stimuli ({', '.join(counts)})"
    if unknown := int(each["observed_contact"].isna().sum()):
        words += f"; not known for {unknown} more, which are left out too"
    kept = stimuli[stimuli["stimulus"].isin(each.loc[later, "stimulus"])]
    if kept.empty:
        return pd.DataFrame(), f"{words}; none is left, so there are no scores without them"
    parts = [with_kind(score_table(kept, level)), anchor_scores(kept, level)]
    return pd.concat([part for part in parts if len(part)], ignore_index=True), words
