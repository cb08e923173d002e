"""Models next to averages of people: which stimuli count, the scores, and what contradicts itself.

`compare_scores` joins predictions, answers of people and outcomes, counts what is left out, and
refuses or warns of tables that contradict each other: outcomes that are the wrong way round, or a
table that was cut, give plausible numbers. `later_scores` gives the scores without the trials whose
contact was already observed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from physion.analysis.intervals import LEVEL, Bootstrap
from physion.analysis.people.responses import EXCLUDED, LEDGE
from physion.analysis.scores import baseline_scores, kind_of, people_table, score_table, with_kind
from physion.analysis.tables import MEAN, ONLY, in_order, name_models, with_labels
from physion.core.errors import BadInputError
from physion.core.names import (
    OFFICIAL_SCENARIOS,
    SCENARIOS,
    canonical_name,
    is_ledge,
    scenario_of,
)

# Checks of tables that contradict each other: errors where sure, else warnings.

SURE = 1e-3
"""Probability under chance below which outcomes that mostly differ are called opposite."""

BELOW_CHANCE = -4.0
"""z of a model's accuracy, against independent answers, below which it is called opposite."""

FEW = 10
"""Number of stimuli below which a comparison comes with a warning."""


def check_size(stimuli: pd.DataFrame) -> list[str]:
    """Return a warning if a model was compared on fewer than `FEW` stimuli."""
    fewest = int(stimuli.groupby("model")["stimulus"].nunique().min())
    if fewest >= FEW:
        return []
    counted = "1 stimulus" if fewest == 1 else f"{fewest} stimuli"
    return [f"compared on only {counted}: intervals and correlations of so few say little"]


def check_probabilities(predictions: pd.DataFrame) -> list[str]:
    """Return a warning for each model whose predicted outcomes contradict its probabilities.

    ``predictions``: from `read_predictions`. A P(contact) of 0.5 contradicts nothing.
    Raises `BadInputError` for a model that contradicts itself in so many rows that chance is
    excluded (binomial test against one half, p < `SURE`) and whose P(contact) is larger where it
    predicts no contact: then it is the probability of no contact. A model with another threshold
    than 0.5 is only warned of.
    """
    found = []
    for model, rows in predictions.groupby("model", sort=False):
        p = rows["p_contact"]
        against = (p != 0.5) & ((p > 0.5) != rows["predicted"])
        count = int(against.sum())
        if not count:
            continue
        first = rows[against].iloc[0]
        what = (
            f"{model}: predicted contradicts p_contact in {count} of "
            f"{len(rows)} rows, the first is {first['stimulus']!r} ({first['predicted']}, "
            f"{first['p_contact']:g})"
        )
        opposite = p[rows["predicted"]].mean() < p[~rows["predicted"]].mean()
        if opposite and stats.binom.sf(count - 1, len(rows), 0.5) < SURE:
            raise BadInputError(
                f"{what}; p_contact must be the probability of a contact, and True in predicted "
                "must mean a contact"
            )
        found.append(f"{what}: accuracy and kappa use the outcome, r and RMSD the probability")
    return found


def check_outcomes(stimuli: pd.DataFrame) -> list[str]:
    """Return a warning for each scenario whose official outcomes are mostly not those shown.

    ``stimuli``: from `Comparison`. Raises `BadInputError` where so many differ that
    chance is excluded (binomial test against one half, p < `SURE`): then the labels are opposite.
    """
    found = []
    single = stimuli.drop_duplicates("stimulus")
    for scenario in in_order(single["scenario"]):
        rows = single[single["scenario"] == scenario]
        differ = int((rows["label"].astype(bool) != rows["simulated"].astype(bool)).sum())
        if 2 * differ <= len(rows):
            continue
        what = (
            f"{scenario}: the official outcome differs from the trial shown to the models "
            f"(outcome) in {differ} of {len(rows)} stimuli"
        )
        if stats.binom.sf(differ - 1, len(rows), 0.5) < SURE:
            raise BadInputError(
                f"{what}: the outcomes of one of the two tables are opposite; True must mean a "
                "contact in the labels and in the predictions"
            )
        found.append(f"{what}, so models and people were asked about different events")
    return found


def check_accuracy(stimuli: pd.DataFrame) -> list[str]:
    """Return a warning for each model that is right far less often than by guessing.

    Its accuracy a is compared with the accuracy of independent answers with the same fraction of
    yes, e = p q + (1 - p)(1 - q) for fractions p of contacts and q of answers yes:
    z = (a - e) / sqrt(e (1 - e) / n) below `BELOW_CHANCE`.
    """
    found = []
    for model, rows in stimuli.groupby("model", sort=False):
        contact, yes = rows["label"].mean(), rows["predicted"].mean()
        by_chance = contact * yes + (1 - contact) * (1 - yes)
        accuracy = float((rows["label"] == rows["predicted"]).mean())
        spread = np.sqrt(by_chance * (1 - by_chance) / len(rows))
        if spread > 0 and (accuracy - by_chance) / spread < BELOW_CHANCE:
            found.append(
                f"{model} is right in {accuracy:.0%} of {len(rows)} stimuli, far less than by "
                "guessing: its answers, or the outcomes, may be opposite"
            )
    return found


def check_labels_of_people(people: pd.DataFrame, predicted: Collection[str]) -> list[str]:
    """Return a warning for each scenario with answered and predicted stimuli without an outcome.

    ``people``: answers by stimulus, with ``scenario`` and ``label``; ``predicted``: stimuli that a
    model predicts.
    """
    found = []
    both = people[people["stimulus"].isin(set(predicted)) & people["scenario"].notna()]
    for scenario in in_order(both["scenario"]):
        rows = both[both["scenario"] == scenario]
        missing = rows.loc[rows["label"].isna(), "stimulus"]
        if len(missing):
            found.append(
                f"{scenario}: {len(missing)} of {len(rows)} stimuli that people and models "
                f"answered have no official outcome, the first is {missing.iloc[0]!r}: is the "
                "table of labels cut?"
            )
    return found


def check_coverage(people: pd.DataFrame, labels: Mapping[str, bool]) -> list[str]:
    """Return a warning for each scenario whose table of people lacks stimuli with a label.

    ``people``: answers by stimulus of scenarios that were asked; ``labels``: official outcome of
    every stimulus that people saw, by canonical name. Roll's ledges may be absent.
    """
    found = []
    answered = set(people["stimulus"])
    shown = [name for name in labels if not is_ledge(name)]
    for scenario in in_order(people["scenario"]):
        names = [name for name in shown if scenario_of(name) == scenario]
        missing = [name for name in names if name not in answered]
        if missing:
            found.append(
                f"{scenario}: {len(missing)} of {len(names)} stimuli with an official outcome have "
                f"no answer of people, the first is {missing[0]!r}: is the table of people cut?"
            )
    return found


# Scores without the trials whose contact already happened in the observed part.
#
# There nothing is left to predict: a model that sees the contact is right without physics.

SETTING = "Contact in the observed part"
"""Name of the setting that says which trials `later_scores` leaves out."""


def observed_contacts(predictions: pd.DataFrame) -> pd.Series:
    """Return by stimulus whether the contact was observed, for the stimuli for which it is known.

    ``predictions``: from `name_models`; a model that knows suffices for all,
    and a contact that one simulation shows in the observed part counts for all.
    """
    known = predictions[predictions["observed_contact"].notna()]
    return known["observed_contact"].astype(bool).groupby(known["stimulus"]).any()


def later_scores(stimuli: pd.DataFrame) -> tuple[pd.DataFrame, str]:
    """Return the scores of models and baselines on trials without observed contact, and a sentence.

    ``stimuli``: as `Comparison.stimuli`. Trials of which it is not known whether the contact was
    observed (``observed_contact`` is None) are left out too.

    Returns
    -------
    The rows of models, then of computed baselines, with the columns of `with_kind`; empty if
    nothing is known or left. The sentence says what was left out, or why the table is empty.
    """
    each = stimuli.drop_duplicates("stimulus")
    if each["observed_contact"].isna().all():
        return pd.DataFrame(), (
            "not known: the predictions have no values of observed_contact, so there are no scores "
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
    parts = [with_kind(score_table(kept)), baseline_scores(kept)]
    return pd.concat([part for part in parts if len(part)], ignore_index=True), words


ANOTHER = "another scenario"
"""Training of a model on scenarios without the tested one, other than all of those (`ALL_BUT`)."""


def with_training(comparison: Comparison, predictions: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of models in ``comparison.stimuli`` with the scenarios of their training.

    ``predictions``: from `name_models`. Added columns: ``trained``, a scenario (several are joined
    by ``+``) or the protocol; ``training``, in relation to the tested scenario: *all*, `ALL_BUT`,
    `ONLY`, `ANOTHER`, or as it was given.
    """
    given = pd.Series("", index=predictions.index, dtype=object)
    for column in ("dynamics_training_dataset", "protocol", "encoder_training_dataset"):
        if column in predictions:
            given = given.where(given != "", predictions[column])
    subset = predictions[["model", "stimulus"]].assign(trained=given)
    chosen = comparison.stimuli[comparison.stimuli["model"].isin(comparison.models)]
    rows = chosen.merge(subset, on=["model", "stimulus"], how="left")
    ours = rows["trained"].map(_our_scenarios)
    rows["trained"] = ours.where(ours != ONLY, rows["scenario"])
    rows["training"] = [
        _in_relation(str(trained), str(tested))
        for trained, tested in zip(rows["trained"], rows["scenario"], strict=True)
    ]
    return rows


def _our_scenarios(trained: object) -> str:
    return "+".join(OFFICIAL_SCENARIOS.get(one.lower(), one) for one in str(trained).split("+"))


def _in_relation(trained: str, tested: str) -> str:
    if trained == tested:
        return ONLY
    parts = set(trained.split("+"))
    return ANOTHER if parts <= set(SCENARIOS) and tested not in parts else trained


NO_LABEL = "no official outcome is known"
NOT_SEEN = "people did not see it"
NOT_PREDICTED = "the model does not predict it"
NO_SCENARIO = "its scenario is not known"


@dataclass(frozen=True)
class Comparison:
    """Tables that compare models with people.

    - ``scores``: `scores.score_table` of what was predicted, with ``kind``: model, or baseline for
      models named in `scores.BASELINE_MODELS`.
    - ``baselines``: the same of the baselines that need no predictions (`scores.COMPUTED`), on
      the stimuli that any model predicts; empty without people.
    - ``later``: the rows of both without the trials whose contact was observed, see
      `later_scores`; empty if that is not known.
    - ``people``: see `people_table`, for the stimuli that any model predicts; empty
      without people.
    - ``stimuli``: one row per model and stimulus that both answered: ``model``, ``base_model``,
      ``readout``, ``scenario``, ``stimulus``, ``p_contact``, ``predicted``, ``label`` (official),
      ``simulated``, ``human_accuracy``, ``count``, ``p_yes``, ``gap`` (p_contact - p_yes),
      ``observed_contact`` (True, False, or None if it is not known).
    - ``changed``: the stimuli whose simulated outcome is not the official one, one row each, with
      the ``models`` that were shown them.
    - ``dropped``: excluded stimuli: ``model`` (empty: excluded for all), ``scenario``, ``reason``,
      ``stimuli`` (count).
    - ``settings``: the settings as text for the report, by name.
    - ``warnings``: what may make the scores wrong, one sentence each (`contradictions`).
    """

    scores: pd.DataFrame
    baselines: pd.DataFrame
    later: pd.DataFrame
    people: pd.DataFrame
    stimuli: pd.DataFrame
    changed: pd.DataFrame
    dropped: pd.DataFrame
    settings: Mapping[str, str]
    warnings: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Names of the models in the order of the predictions."""
        return [str(name) for name in self.stimuli["model"].unique()]

    @property
    def models(self) -> list[str]:
        """Names of the models that are not baselines; if all are, of all."""
        return [name for name in self.names if kind_of(name) == "model"] or self.names

    @property
    def all_scores(self) -> pd.DataFrame:
        """Scores of models, of models that are baselines, and of computed baselines."""
        parts = [self.scores[self.scores["kind"] == kind] for kind in ("model", "baseline")]
        parts += [self.baselines]
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
        Columns of `tables.PREDICTIONS`; ``outcome``: of the trial as the model was shown it.
    humans
        Table from `read_humans`, or None for the accuracies of the models only.
    labels
        Official outcome by stimulus. For a stimulus without one ``recorded_outcome`` of the
        predictions counts and, without people, the simulated outcome.
    zone
        Table from `read_human_zone` or `PeopleResults.zone`.
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
    rows = name_models(predictions)
    unwanted = {canonical_name(name) for name in exclude}
    given = {canonical_name(name): bool(value) for name, value in (labels or {}).items()}
    known = _recorded(rows, given) | given
    _refuse_two_outcomes(rows, known)
    if humans is None:
        people = _nobody(rows, known)
    elif known:
        people = with_labels(humans, known)
    else:
        raise BadInputError("people's answers need the official outcomes: give the labels")
    warnings = check_probabilities(rows) + check_labels_of_people(people, set(rows["stimulus"]))
    if humans is None:
        _refuse_unknown_stimuli(people)
    people, dropped_people = _drop(people, unwanted, exclude_ledge)
    stimuli = _join(rows, people)
    dropped = [dropped_people, *_unmatched(rows, people, unwanted, exclude_ledge)]
    if stimuli.empty:
        seen = people["stimulus"].iloc[0] if len(people) else "nothing"
        raise BadInputError(
            "no stimulus was both seen by people and predicted; people saw for instance "
            f"{seen!r}, the predictions name {rows['stimulus'].iloc[0]!r}"
        )
    warnings += check_outcomes(stimuli) + check_accuracy(stimuli) + check_size(stimuli)
    answered = people[people["stimulus"].isin(stimuli["stimulus"])]
    scores = with_kind(score_table(stimuli))
    later, observed = later_scores(stimuli)
    return Comparison(
        scores=scores,
        baselines=baseline_scores(stimuli).reindex(columns=scores.columns),
        later=later.reindex(columns=scores.columns),
        people=people.iloc[:0]
        if humans is None
        else people_table(answered, _whole(zone, people, stimuli)),
        stimuli=stimuli,
        changed=_changed(stimuli),
        dropped=pd.concat(dropped, ignore_index=True),
        settings=_settings(humans is not None, unwanted, exclude_ledge)
        | {SETTING: observed}
        | (_intervals_with_participants(draws) if participants else {})
        | (_describe_zone(zone, zone_origin) if humans is not None else {}),
        warnings=tuple(warnings),
    )


def _refuse_two_outcomes(rows: pd.DataFrame, known: Mapping[str, bool]) -> None:
    """Raise `BadInputError` if models were shown different outcomes and none is official."""
    unknown = rows[~rows["stimulus"].isin(set(known))]
    several = unknown.groupby("stimulus")["outcome"].nunique()
    if (several > 1).any():
        raise BadInputError(
            f"two models were shown {several[several > 1].index[0]!r} with different outcomes, and "
            "no official outcome is known; give the labels, or compare models on one set of trials"
        )


def _refuse_unknown_stimuli(people: pd.DataFrame) -> None:
    """Raise `BadInputError` if the scenario, or the outcome, of no predicted stimulus is known."""
    advice = {
        "scenario": "add a column scenario",
        "label": "add a column outcome, or give the labels (--labels)",
    }
    for column, words in advice.items():
        if people[column].isna().all():
            what = "outcome" if column == "label" else column
            raise BadInputError(
                f"the {what} of no predicted stimulus is known, such as of "
                f"{people['stimulus'].iloc[0]!r}; {words}"
            )


def _recorded(rows: pd.DataFrame, labels: Collection[str]) -> dict[str, bool]:
    """Return the official outcomes that the predictions contain.

    Raises `BadInputError` if they have two of a stimulus that is not in ``labels``.
    """
    known = rows[rows["recorded_outcome"].notna()]
    each = known.groupby("stimulus")["recorded_outcome"]
    two = [str(name) for name in each.nunique()[lambda n: n > 1].index if name not in labels]
    if two:
        raise BadInputError(
            f"stimuli have two values of recorded_outcome in the predictions ({len(two)}, the "
            f"first is {two[0]!r}); correct them, or give the labels"
        )
    return {str(name): bool(value) for name, value in each.first().items()}


def _nobody(rows: pd.DataFrame, known: Mapping[str, bool]) -> pd.DataFrame:
    """Return the stimuli of the predictions as a table of people whose answers are NaN."""
    people = rows.drop_duplicates("stimulus")[["stimulus", "scenario", "outcome"]]
    label = people["stimulus"].map(known).astype(object)
    people = people.assign(
        label=label.where(label.notna(), people["outcome"]),
        accuracy=np.nan,
        count=np.nan,
        p_yes=np.nan,
    )
    return people.drop(columns="outcome")


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
    left_out = people[~kept].assign(reason=reason[~kept], model="")
    return people[kept].reset_index(drop=True), _count(left_out)


def _purpose(stimulus: pd.Series, unwanted: set[str], exclude_ledge: bool) -> pd.Series:
    """Return the reason for which a stimulus is excluded on purpose; empty if it is not."""
    reason = pd.Series("", index=stimulus.index, dtype=object)
    reason = reason.mask(stimulus.isin(unwanted), EXCLUDED)
    return reason.mask(stimulus.map(is_ledge).astype(bool) & exclude_ledge, LEDGE)


def _join(rows: pd.DataFrame, people: pd.DataFrame) -> pd.DataFrame:
    left = rows[["model", "base_model", "readout", "stimulus", "p_contact", "predicted", "outcome"]]
    joined = left.merge(people, on="stimulus", how="inner", validate="many_to_one")
    joined = joined.rename(columns={"outcome": "simulated", "accuracy": "human_accuracy"})
    joined["label"] = joined["label"].astype(bool)
    shown = joined["simulated"].where(joined["simulated"].notna(), joined["label"])
    joined["simulated"] = shown.astype(bool)
    joined["gap"] = joined["p_contact"] - joined["p_yes"]
    observed = joined["stimulus"].map(observed_contacts(rows)).astype(object)
    joined["observed_contact"] = observed.where(observed.notna(), None)
    columns = ["model", "base_model", "readout", "scenario", "stimulus", "p_contact", "predicted"]
    columns += ["label", "simulated", "human_accuracy", "count", "p_yes", "gap"]
    return joined[[*columns, "observed_contact"]]


def _unmatched(
    rows: pd.DataFrame, people: pd.DataFrame, unwanted: set[str], exclude_ledge: bool
) -> list[pd.DataFrame]:
    """Count predictions without answers of people, and answers of people without a prediction."""
    extra = rows[~rows["stimulus"].isin(people["stimulus"])]
    reason = _purpose(extra["stimulus"], unwanted, exclude_ledge)
    parts = [_count(extra.assign(reason=reason.mask(reason == "", NOT_SEEN)))]
    for model, subset in rows.groupby("model", sort=False):
        missing = people[~people["stimulus"].isin(subset["stimulus"])]
        parts.append(_count(missing.assign(reason=NOT_PREDICTED, model=model)))
    return parts


def _count(rows: pd.DataFrame) -> pd.DataFrame:
    keys = ["model", "scenario", "reason"]
    if rows.empty:
        return pd.DataFrame(columns=[*keys, "stimuli"])
    filled = rows.assign(scenario=rows["scenario"].fillna("unknown"))
    return filled.groupby(keys, sort=False).size().rename("stimuli").reset_index()


def _whole(
    zone: pd.DataFrame | None, people: pd.DataFrame, stimuli: pd.DataFrame
) -> pd.DataFrame | None:
    """Return ``zone`` for scenarios with all stimuli: it does not hold for a part of them."""
    missing = set(people[~people["stimulus"].isin(stimuli["stimulus"])]["scenario"])
    missing |= {MEAN} if missing else set()
    return zone if zone is None else zone[~zone["scenario"].isin(missing)]


def _changed(stimuli: pd.DataFrame) -> pd.DataFrame:
    rows = stimuli[stimuli["label"] != stimuli["simulated"]]
    shown = rows.groupby("stimulus")["model"].agg(", ".join)
    rows = rows.drop_duplicates("stimulus")
    rows = rows.assign(models=rows["stimulus"].map(shown).astype(str))
    columns = ["scenario", "stimulus", "label", "simulated", "human_accuracy", "p_yes", "models"]
    return rows.sort_values(["scenario", "stimulus"])[columns].reset_index(drop=True)


def _settings(
    has_people: bool,
    unwanted: set[str],
    exclude_ledge: bool,
) -> dict[str, str]:
    words = {
        "Stimuli": "those that people saw and the model predicts, each model on its own set; "
        "what is left out is counted below"
        if has_people
        else "all that the models predict; no people were given",
        "Roll stimuli with a ledge": "left out, as in the study" if exclude_ledge else "kept",
        "Further stimuli left out": f"{len(unwanted)} on a list" if unwanted else "none",
        "Intervals": f"{LEVEL:.0%} jackknife intervals over stimuli within each scenario: "
        "where the score is expected with other stimuli of the same number and the same people",
        "Overall": "“mean” averages the scores of the scenarios, each counting the same; “pooled” "
        "takes all stimuli together",
    }
    if has_people:
        words["Ceiling of r"] = (
            "expected r of a model that knows the true fraction of yes: square root of the "
            "reliability that binomial sampling noise leaves, from accuracy and number of people"
        )
    return words


def _intervals_with_participants(draws: Bootstrap) -> dict[str, str]:
    return {
        "Intervals with participants": f"{LEVEL:.0%} jackknife intervals, three of them: where the "
        "measure is expected with other participants, other stimuli, or both, of the same number "
        "in each scenario. The jackknife over participants is corrected for the noise of their "
        "averages (Efron and Stein, 1981); with both, the noise of single answers counts once, "
        "and not three times as in a bootstrap of both (Owen, 2007)",
        "Intervals of people's accuracy and agreement": f"{LEVEL:.0%} percentile bootstrap over "
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
