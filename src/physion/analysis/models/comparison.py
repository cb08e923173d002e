"""Comparison of models with people: the selection of trials, and every table of results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from physion.analysis.models.anchors import anchor_scores, kind_of, with_kind
from physion.analysis.models.contradictions import (
    check_accuracy,
    check_labels_of_people,
    check_outcomes,
    check_probabilities,
)
from physion.analysis.models.observed_contact import SETTING, later_scores, observed_contacts
from physion.analysis.models.score_tables import people_table, score_table
from physion.analysis.people.participants import EXCLUDED, LEDGE
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.predictions import check_predictions, name_models
from physion.analysis.tables.responses import with_labels
from physion.core.errors import BadInputError
from physion.core.names import canonical_name, is_ledge

NO_LABEL = "no official outcome is known"
NOT_SEEN = "people did not see it"
NOT_PREDICTED = "the model does not predict it"
NO_SCENARIO = "its scenario is not known"


@dataclass(frozen=True)
class Comparison:
    """Tables that compare models with people.

    - ``scores``: `score_tables.score_table` of what was predicted, with ``kind``: model, or anchor
      for models named in `anchors.ANCHOR_MODELS`.
    - ``anchors``: the same of the anchors that need no predictions (`anchors.COMPUTED`), on the
      stimuli that any model predicts; empty without people.
    - ``later``: the rows of both without the trials whose contact was observed, see
      `observed_contact.later_scores`; empty if that is not known.
    - ``people``: see `score_tables.people_table`, for the stimuli that any model predicts; empty
      without people.
    - ``stimuli``: one row a model and stimulus that both answered: ``agent``, ``model``,
      ``readout``, ``scenario``, ``stimulus``, ``p_contact``, ``predicted``, ``label`` (official),
      ``simulated``, ``human_accuracy``, ``count``, ``p_yes``, ``gap`` (p_contact - p_yes),
      ``observed_contact`` (True, False, or None if it is not known).
    - ``changed``: the stimuli whose simulated outcome is not the official one, one row each.
    - ``dropped``: excluded stimuli: ``agent`` (empty: excluded for all), ``scenario``, ``reason``,
      ``stimuli`` (count).
    - ``settings``: the settings as text for the report, by name.
    - ``warnings``: what may make the scores wrong, one sentence each (`contradictions`).
    """

    scores: pd.DataFrame
    anchors: pd.DataFrame
    later: pd.DataFrame
    people: pd.DataFrame
    stimuli: pd.DataFrame
    changed: pd.DataFrame
    dropped: pd.DataFrame
    settings: Mapping[str, str]
    warnings: tuple[str, ...] = ()

    @property
    def agents(self) -> list[str]:
        """Names of the models in the order of the predictions."""
        return [str(name) for name in self.stimuli["agent"].unique()]

    @property
    def models(self) -> list[str]:
        """Names of the models that are no anchors; if all are, of all."""
        return [name for name in self.agents if kind_of(name) == "model"] or self.agents

    @property
    def all_scores(self) -> pd.DataFrame:
        """The rows of ``scores`` and ``anchors``: models, anchors by models, computed anchors."""
        parts = [self.scores[self.scores["kind"] == kind] for kind in ("model", "anchor")]
        parts += [self.anchors]
        return pd.concat([part for part in parts if len(part)], ignore_index=True)

    @property
    def has_people(self) -> bool:
        """Whether answers of people were given."""
        return not self.people.empty


def compare_scores(
    predictions: pd.DataFrame,
    humans: pd.DataFrame | None,
    labels: Mapping[str, bool] | None = None,
    *,
    zone: pd.DataFrame | None = None,
    zone_origin: str = "",
    participants: bool = False,
    exclude: Iterable[str] = (),
    exclude_ledge: bool = True,
    bootstrap: Bootstrap | None = None,
) -> Comparison:
    """Compare models with people on the stimuli that people saw and the model predicts.

    Parameters
    ----------
    predictions
        Official column names (`predictions.check_predictions`); *Actual Outcome* is the outcome of
        the trial that the model was shown.
    humans
        Table from `responses.read_humans`, or None for the accuracies of the models alone.
    labels
        Official outcome by stimulus. For a stimulus without one the column *Recorded Outcome* of
        the predictions is used and, without people, the simulated outcome.
    zone
        Table from `responses.read_human_zone` or from the accuracies of single participants, with
        ``scenario``, ``low`` and ``high``.
    zone_origin
        Source of the zone as text.
    participants
        Whether other tables draw single participants for their intervals, for the settings.
    exclude
        Stimuli to exclude.
    exclude_ledge
        Whether to exclude the Roll stimuli with a ledge, as the study does.
    bootstrap
        Draws for the intervals.

    Returns
    -------
    The tables; everything that was excluded is counted in ``dropped``.

    Raises
    ------
    BadInputError
        If no stimulus is left, or a model or the tables contradict themselves.
    """
    draws = bootstrap or Bootstrap()
    rows = predictions if "agent" in predictions else name_models(check_predictions(predictions))
    unwanted = {canonical_name(name) for name in exclude}
    known = _recorded(rows)
    known |= {canonical_name(name): bool(value) for name, value in (labels or {}).items()}
    if humans is None:
        people = _nobody(rows, known)
    elif known:
        people = with_labels(humans, known)
    else:
        raise BadInputError("people's answers need the official outcomes: give the labels")
    warnings = check_probabilities(rows) + check_labels_of_people(people, set(rows["stimulus"]))
    people, dropped_people = _drop(people, unwanted, exclude_ledge)
    stimuli = _join(rows, people)
    dropped = [dropped_people, *_unmatched(rows, people, unwanted, exclude_ledge)]
    if stimuli.empty:
        seen = people["stimulus"].iloc[0] if len(people) else "nothing"
        raise BadInputError(
            "no stimulus was both seen by people and predicted; people saw for instance "
            f"{seen!r}, the predictions name {rows['stimulus'].iloc[0]!r}"
        )
    warnings += check_outcomes(stimuli) + check_accuracy(stimuli)
    answered = people[people["stimulus"].isin(stimuli["stimulus"])]
    scores = with_kind(score_table(stimuli, draws.level))
    later, observed = later_scores(stimuli, draws.level)
    return Comparison(
        scores=scores,
        anchors=anchor_scores(stimuli, draws.level).reindex(columns=scores.columns),
        later=later.reindex(columns=scores.columns),
        people=people.iloc[:0]
        if humans is None
        else people_table(answered, _whole(zone, people, stimuli), draws.level),
        stimuli=stimuli,
        changed=_changed(stimuli),
        dropped=pd.concat(dropped, ignore_index=True),
        settings=_settings(humans is not None, unwanted, exclude_ledge, draws)
        | {SETTING: observed}
        | (_intervals_with_participants(draws) if participants else {})
        | (_describe_zone(zone, zone_origin) if humans is not None else {}),
        warnings=tuple(warnings),
    )


def _recorded(rows: pd.DataFrame) -> dict[str, bool]:
    """Return the official outcomes that the predictions contain."""
    given = rows[rows["recorded"].notna()].drop_duplicates("stimulus")
    pairs = zip(given["stimulus"], given["recorded"], strict=True)
    return {str(stimulus): bool(value) for stimulus, value in pairs}


def _nobody(rows: pd.DataFrame, known: Mapping[str, bool]) -> pd.DataFrame:
    """Return the stimuli of the predictions as a table of people whose answers are NaN."""
    people = rows.drop_duplicates("stimulus")[["stimulus", "scenario", "actual"]]
    label = people["stimulus"].map(known).astype(object)
    people = people.assign(
        label=label.where(label.notna(), people["actual"]),
        accuracy=np.nan,
        count=np.nan,
        p_yes=np.nan,
    )
    return people.drop(columns="actual")


def _drop(
    people: pd.DataFrame, unwanted: set[str], exclude_ledge: bool
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return ``people`` without excluded stimuli and those without a label, and the counts."""
    reason = pd.Series("", index=people.index, dtype=object)
    reason = reason.mask(people["scenario"].isna(), NO_SCENARIO)
    reason = reason.mask(people["label"].isna(), NO_LABEL)
    purpose = _purpose(people["stimulus"], unwanted, exclude_ledge)
    reason = reason.mask(purpose != "", purpose)
    kept = reason == ""
    left_out = people[~kept].assign(reason=reason[~kept], agent="")
    return people[kept].reset_index(drop=True), _count(left_out)


def _purpose(stimulus: pd.Series, unwanted: set[str], exclude_ledge: bool) -> pd.Series:
    """Return the reason for which a stimulus is excluded on purpose; empty if it is not."""
    reason = pd.Series("", index=stimulus.index, dtype=object)
    reason = reason.mask(stimulus.isin(unwanted), EXCLUDED)
    return reason.mask(stimulus.map(is_ledge).astype(bool) & exclude_ledge, LEDGE)


def _join(rows: pd.DataFrame, people: pd.DataFrame) -> pd.DataFrame:
    left = rows[["agent", "model", "readout", "stimulus", "p_contact", "predicted", "actual"]]
    joined = left.merge(people, on="stimulus", how="inner", validate="many_to_one")
    joined = joined.rename(columns={"actual": "simulated", "accuracy": "human_accuracy"})
    joined["label"] = joined["label"].astype(bool)
    joined["gap"] = joined["p_contact"] - joined["p_yes"]
    observed = joined["stimulus"].map(observed_contacts(rows)).astype(object)
    joined["observed_contact"] = observed.where(observed.notna(), None)
    columns = ["agent", "model", "readout", "scenario", "stimulus", "p_contact", "predicted"]
    columns += ["label", "simulated", "human_accuracy", "count", "p_yes", "gap"]
    return joined[[*columns, "observed_contact"]]


def _unmatched(
    rows: pd.DataFrame, people: pd.DataFrame, unwanted: set[str], exclude_ledge: bool
) -> list[pd.DataFrame]:
    """Count predictions without answers of people, and answers of people without a prediction."""
    extra = rows[~rows["stimulus"].isin(people["stimulus"])]
    reason = _purpose(extra["stimulus"], unwanted, exclude_ledge)
    parts = [_count(extra.assign(reason=reason.mask(reason == "", NOT_SEEN)))]
    for agent, subset in rows.groupby("agent", sort=False):
        missing = people[~people["stimulus"].isin(subset["stimulus"])]
        parts.append(_count(missing.assign(reason=NOT_PREDICTED, agent=agent)))
    return parts


def _count(rows: pd.DataFrame) -> pd.DataFrame:
    keys = ["agent", "scenario", "reason"]
    if rows.empty:
        return pd.DataFrame(columns=[*keys, "stimuli"])
    filled = rows.assign(scenario=rows["scenario"].fillna("unknown"))
    return filled.groupby(keys, sort=False).size().rename("stimuli").reset_index()


def _whole(
    zone: pd.DataFrame | None, people: pd.DataFrame, stimuli: pd.DataFrame
) -> pd.DataFrame | None:
    """Return ``zone`` for scenarios with all stimuli: it does not hold for a part of them."""
    missing = people[~people["stimulus"].isin(stimuli["stimulus"])]["scenario"]
    return zone if zone is None else zone[~zone["scenario"].isin(missing)]


def _changed(stimuli: pd.DataFrame) -> pd.DataFrame:
    rows = stimuli[stimuli["label"] != stimuli["simulated"]].drop_duplicates("stimulus")
    columns = ["scenario", "stimulus", "label", "simulated", "human_accuracy", "p_yes"]
    return rows.sort_values(["scenario", "stimulus"])[columns].reset_index(drop=True)


def _settings(
    has_people: bool,
    unwanted: set[str],
    exclude_ledge: bool,
    draws: Bootstrap,
) -> dict[str, str]:
    words = {
        "Stimuli": "those that people saw and the model predicts, each model on its own set; "
        "what is left out is counted below"
        if has_people
        else "all that the models predict; no people were given",
        "Roll stimuli with a ledge": "left out, as in the study" if exclude_ledge else "kept",
        "Further stimuli left out": f"{len(unwanted)} on a list" if unwanted else "none",
        "Intervals": f"{draws.level:.0%} jackknife intervals over stimuli within each scenario: "
        "where the score is expected with other stimuli of the same number and the same people",
        "Overall": "“mean” averages the scores of the scenarios, each counting the same; “pooled” "
        "takes all stimuli together",
    }
    if has_people:
        words["Ceiling of r"] = (
            "expected r of a model that knows the true share of yes: square root of the "
            "reliability that binomial sampling noise leaves, from accuracy and number of people"
        )
    return words


def _intervals_with_participants(draws: Bootstrap) -> dict[str, str]:
    level = f"{draws.level:.0%}"
    return {
        "Intervals with participants": f"{level} jackknife intervals, three of them: where the "
        "measure is expected with other participants, other stimuli, or both, of the same number "
        "in each scenario. The jackknife over participants is corrected for the noise of their "
        "averages (Efron and Stein, 1981); with both, the noise of single answers counts once, "
        "and not three times as in a bootstrap of both (Owen, 2007)",
        "Intervals of people's accuracy and agreement": f"{level} percentile bootstrap over "
        f"participants, as preregistered, {draws.resamples} resamples, seed {draws.seed}",
    }


def _describe_zone(zone: pd.DataFrame | None, origin: str) -> dict[str, str]:
    if zone is None:
        return {"Human zone": "not given: it needs the answers of single participants"}
    return {
        "Human zone": "2.5th to 97.5th percentile of participants' accuracies"
        + (f", {origin}" if origin else "")
        + "; only for scenarios of which all stimuli that people saw are predicted"
    }
