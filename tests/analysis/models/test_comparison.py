"""Predictions and people together: which trials count, scores, invariances, contradictions."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import special, stats

from physion.analysis.compare import all_results
from physion.analysis.comparison import (
    NO_LABEL,
    NOT_PREDICTED,
    NOT_SEEN,
    Comparison,
    check_coverage,
    compare_scores,
)
from physion.analysis.intervals import Bootstrap
from physion.analysis.metrics import metric_of_arrays, metrics
from physion.analysis.model_tests import fits_of_models
from physion.analysis.people.responses import EXCLUDED, LEDGE
from physion.analysis.sample import sample_of_rows
from physion.analysis.tables import (
    MEAN,
    POOLED,
    check_predictions,
    name_models,
    read_humans,
    read_labels,
    read_predictions,
)
from physion.core.errors import BadInputError, UnknownNameError
from physion.report.compare import compare
from physion.report.page import _sentence

QUICK = Bootstrap(resamples=200)
SCENARIOS = {"collide": "pilot_it2_collision_simple_box", "drop": "pilot_it2_drop_simple_box"}


def humans(n: int = 12, seed: int = 0) -> pd.DataFrame:
    generator = np.random.default_rng(seed)
    names = [(s, f"{stem}_{i:04d}") for s, stem in SCENARIOS.items() for i in range(n)]
    return pd.DataFrame(
        {
            "stimulus": [name for _, name in names],
            "scenario": [scenario for scenario, _ in names],
            "accuracy": generator.integers(5, 20, len(names)) / 20,
            "count": 20.0,
        }
    )


def labels(table: pd.DataFrame) -> dict[str, bool]:
    return {name: int(re.findall(r"\d{4}", name)[0]) % 2 == 0 for name in table["stimulus"]}


def predictions(
    people: pd.DataFrame,
    model: str = "m",
    readout: str = "C",
    seed: int = 1,
    changed: tuple[str, ...] = (),
    **columns: object,
) -> pd.DataFrame:
    generator = np.random.default_rng(seed)
    actual = [value ^ (name in changed) for name, value in labels(people).items()]
    p = generator.random(len(people))
    return pd.DataFrame(
        {
            "Model": model,
            "Readout Type": readout,
            "Predicted Prob_true": p,
            "Predicted Outcome": p > 0.5,
            "Actual Outcome": actual,
            "Stimulus Name": people["stimulus"],
            **columns,
        }
    )


def compared(given: pd.DataFrame, people: pd.DataFrame, **settings: object) -> Comparison:
    return compare_scores(given, people, labels(people), bootstrap=QUICK, **settings)  # type: ignore[arg-type]


def score(table: pd.DataFrame, model: str, scenario: str) -> pd.Series:
    rows = table[(table["model"] == model) & (table["scenario"] == scenario)]
    assert len(rows) == 1
    return rows.iloc[0]


# --- scores ------------------------------------------------------------------------------------


def test_scores_match_the_joined_rows() -> None:
    people = humans()
    given = predictions(people)
    found = compared(given, people)
    truth = np.array(list(labels(people).values()))
    p_yes = np.where(truth, people["accuracy"], 1 - people["accuracy"])
    collide = (people["scenario"] == "collide").to_numpy()
    row = score(found.scores, "m · observed", "collide")
    answered = given["Predicted Outcome"].to_numpy()
    assert row["accuracy"] == pytest.approx((answered == truth)[collide].mean())
    assert row["human_accuracy"] == pytest.approx(people["accuracy"][collide].mean())
    p = given["Predicted Prob_true"].to_numpy()
    assert row["r"] == pytest.approx(np.corrcoef(p[collide], p_yes[collide])[0, 1])
    pooled = score(found.scores, "m · observed", POOLED)
    assert pooled["r"] == pytest.approx(np.corrcoef(p, p_yes)[0, 1])
    assert pooled["rmsd"] == pytest.approx(np.sqrt(np.mean((p - p_yes) ** 2)))
    own = found.people.set_index("scenario").loc["collide"]
    assert own["base_rate"] == pytest.approx(truth[collide].mean()) and own["people"] == 20
    assert own["yes"] == pytest.approx(p_yes[collide].mean())
    assert own["accuracy"] == pytest.approx(people["accuracy"][collide].mean())
    noise, total = np.mean(p_yes[collide] * (1 - p_yes[collide]) / 19), p_yes[collide].var(ddof=1)
    assert own["reliability"] == pytest.approx(1 - noise / total)
    assert own["ceiling"] == pytest.approx(np.sqrt(1 - noise / total))
    stimuli = found.stimuli.set_index("stimulus").loc[given["Stimulus Name"]]
    np.testing.assert_allclose(stimuli["gap"], p - p_yes)
    mean = score(found.scores, "m · observed", MEAN)
    by_scenario = found.scores[found.scores["scenario"].isin(SCENARIOS)]
    for key in ("accuracy", "human_accuracy", "r", "rmsd", "ceiling"):
        assert mean[key] == pytest.approx(by_scenario[key].mean())
    intervals = found.scores[["accuracy_low", "accuracy", "accuracy_high"]].to_numpy()
    assert (np.diff(intervals, axis=1) >= 0).all()


def test_intervals_of_accuracy_match_the_formula_in_each_scenario_and_the_mean() -> None:
    """By the logit: the jackknife variance of a fraction a of n is a (1 - a) / (n - 1)."""
    people = pd.concat(
        [humans(20).query("scenario == 'collide'"), humans(9).query("scenario == 'drop'")]
    )
    found = compared(predictions(people), people).scores
    rows = {name: score(found, "m · observed", name) for name in ("collide", "drop", MEAN)}
    a = np.array([rows[name]["accuracy"] for name in SCENARIOS])
    df = np.array([19.0, 8.0])
    variance = a * (1 - a) / df
    assert variance.min() > 0 and variance[0] != pytest.approx(variance[1])
    total = variance.sum()
    expected = {
        "collide": (a[0], variance[0], df[0]),
        "drop": (a[1], variance[1], df[1]),
        MEAN: (a.mean(), total / 4, total**2 / np.sum(variance**2 / df)),
    }
    for name, (value, own, free) in expected.items():
        reach = stats.t.ppf(0.975, free) * np.sqrt(own) / (value * (1 - value))
        ends = special.expit(special.logit(value) + np.array([-reach, reach]))
        assert rows[name][["accuracy_low", "accuracy_high"]].tolist() == pytest.approx(ends), name


def test_trials_of_another_outcome_are_listed_and_scored_both_ways() -> None:
    people = humans()
    odd = tuple(people["stimulus"].iloc[:3])
    given = predictions(people, changed=odd)
    given["Predicted Outcome"] = given["Actual Outcome"]
    found = compared(given, people)
    # The official outcome and not the simulated one turns accuracy into yes.
    assert compared(predictions(people), people).stimuli["p_yes"].equals(found.stimuli["p_yes"])
    assert list(found.changed["stimulus"]) == list(odd)
    assert (found.changed["label"] != found.changed["simulated"]).all()
    row = score(found.scores, "m · observed", "collide")
    assert row["changed"] == 3
    assert row["accuracy_simulated"] == 1
    assert row["accuracy"] == pytest.approx(9 / 12)
    kept = found.stimuli[found.stimuli["label"] == found.stimuli["simulated"]]
    kept = kept[kept["scenario"] == "collide"]
    assert row["r_same"] == pytest.approx(kept["p_contact"].corr(kept["p_yes"]))
    assert row["r_same"] != pytest.approx(row["r"])


# --- invariances -------------------------------------------------------------------------------


def test_the_order_of_rows_changes_nothing_but_their_order() -> None:
    people = humans()
    given = pd.concat([predictions(people), predictions(people, "other", "B", seed=2)])
    plain = compared(given, people)
    mixed = compare_scores(
        given.sample(frac=1, random_state=3),
        people.sample(frac=1, random_state=4),
        labels(people),
        bootstrap=QUICK,
    )
    keys = ["model", "scenario"]
    one, two = (c.scores.sort_values(keys).reset_index(drop=True) for c in (plain, mixed))
    pd.testing.assert_frame_equal(one, two)
    pd.testing.assert_frame_equal(plain.people, mixed.people)


def test_a_model_scores_the_same_with_and_without_others() -> None:
    people = humans()
    both = pd.concat([predictions(people), predictions(people.iloc[::2], "half", seed=2)])
    together = compared(both, people).scores
    alone = compared(predictions(people), people).scores
    pd.testing.assert_frame_equal(together[together["base_model"] == "m"], alone)


# --- undefined ---------------------------------------------------------------------------------


def test_constant_predictions_give_nan_with_a_reason() -> None:
    people = humans()
    given = predictions(people)
    given["Predicted Prob_true"] = 0.5
    scores = compared(given, people).scores
    row = score(scores, "m · observed", "collide")
    assert np.isnan(row[["r", "r_low", "r_high"]].astype(float)).all()
    assert "P(contact) is constant" in row["reason"]
    assert np.isfinite(row[["accuracy", "accuracy_low", "rmsd", "rmsd_high"]].astype(float)).all()
    mean = score(scores, "m · observed", MEAN)
    assert np.isnan(mean["r"]) and mean["reason"].startswith("r: undefined in collide, drop")
    # Constant in one scenario only: no silent mean of the rest.
    given = predictions(people)
    given.loc[people["scenario"] == "drop", "Predicted Prob_true"] = 0.5
    scores = compared(given, people).scores
    assert np.isnan(score(scores, "m · observed", MEAN)["r"])
    assert np.isfinite(score(scores, "m · observed", POOLED)["r"])


def test_one_stimulus_has_no_interval() -> None:
    people = humans(1)
    row = score(
        compare_scores(predictions(people), people, labels(people)).scores, "m · observed", "drop"
    )
    assert np.isnan(row["accuracy_low"]) and "one stimulus" in row["reason"]
    assert "fewer than 3" in row["reason"]


# --- what is left out --------------------------------------------------------------------------


def counts(dropped: pd.DataFrame) -> dict[tuple[str, str], int]:
    return dropped.groupby(["model", "reason"])["stimuli"].sum().to_dict()


def test_everything_left_out_is_counted() -> None:
    people = humans()
    ledge = "pilot_it2_rollingSliding_simple_ledge_box_0001"
    extra = pd.DataFrame([{"stimulus": ledge, "scenario": "roll", "accuracy": 0.5, "count": 20}])
    given = pd.concat([predictions(people.iloc[2:]), predictions(extra)])
    unseen = predictions(extra).assign(**{"Stimulus Name": "pilot_it2_drop_new_0001"})
    given = pd.concat([given, unseen])
    known = labels(people) | {ledge: True}
    del known[people["stimulus"].iloc[3]]
    found = compare_scores(
        given,
        pd.concat([people, extra]),
        known,
        exclude=[people["stimulus"].iloc[4] + "_img"],
        bootstrap=QUICK,
    )
    model = "m · observed"
    assert counts(found.dropped) == {
        ("", LEDGE): 1,
        ("", NO_LABEL): 1,
        ("", EXCLUDED): 1,
        (model, LEDGE): 1,
        (model, EXCLUDED): 1,
        (model, NOT_SEEN): 2,  # the new one, and the one without a label
        (model, NOT_PREDICTED): 2,
    }
    assert len(found.stimuli) == 24 - 4
    assert found.people.set_index("scenario").loc[MEAN, "stimuli"] == 20


def test_ledges_can_be_kept() -> None:
    people = humans()
    people.loc[0, ["stimulus", "scenario"]] = [
        "pilot_it2_rollingSliding_simple_ledge_box_0000", "roll",
    ]  # fmt: skip
    kept = compared(predictions(people), people, exclude_ledge=False)
    assert "roll" in set(kept.scores["scenario"]) and kept.dropped.empty
    left = compared(predictions(people), people)
    assert "roll" not in set(left.scores["scenario"])


def test_without_people_there_are_only_models() -> None:
    people = humans()
    found = compare_scores(predictions(people), None, bootstrap=QUICK)
    row = score(found.scores, "m · observed", "drop")
    assert row["accuracy"] == row["accuracy_simulated"]
    assert np.isnan(row["human_accuracy"]) and "no answers of people" in row["reason"]
    assert not found.has_people and found.changed.empty


def test_recorded_outcomes_stand_in_for_labels() -> None:
    people = humans()
    odd = tuple(people["stimulus"].iloc[:2])
    given = predictions(people, changed=odd)
    given["Recorded Outcome"] = [str(value) for value in labels(people).values()]
    with_labels = compared(predictions(people, changed=odd), people)
    found = compare_scores(given, people, bootstrap=QUICK)
    pd.testing.assert_frame_equal(found.scores, with_labels.scores)
    assert list(found.changed["stimulus"]) == list(odd)
    given.loc[0, "Recorded Outcome"] = ""
    assert counts(compare_scores(given, people, bootstrap=QUICK).dropped)["", NO_LABEL] == 1


def test_two_recorded_outcomes_of_a_stimulus_are_refused() -> None:
    people = humans()
    given = predictions(people).assign(**{"Recorded Outcome": list(labels(people).values())})
    other = predictions(people, "other").assign(**{"Recorded Outcome": True})
    with pytest.raises(BadInputError, match=r"two values of recorded_outcome .* \(12, the first"):
        compare_scores(pd.concat([given, other]), people)
    compared(pd.concat([given, other]), people)  # the labels decide


def test_a_model_that_lacks_scenarios_says_so_and_is_not_called_best() -> None:
    people = humans()
    right = {name: float(value) for name, value in labels(people).items()}
    drop = {name: value for name, value in right.items() if "drop" in name}
    half = {name: 1 - value if name in list(drop)[:3] else value for name, value in right.items()}
    result = compare({"drop only": drop, "both": half}, humans=people, labels=labels(people))
    table = result.summary.set_index("model")
    assert table.loc["drop only", "scenarios"] == "1 of 2"
    assert table.loc["both", "scenarios"] == "2 of 2"
    page = _sentence(result.inputs)
    assert "the model, both, in" in page and "drop only" not in page
    whole = compare({"both": half}, humans=people, labels=labels(people))
    assert "scenarios" not in whole.summary


def test_options_that_would_be_ignored_are_refused() -> None:
    with pytest.raises(BadInputError, match="rules, expected"):
        compare({"m": {"a": 0.1}}, humans=humans(), rules="official-code")
    for option in ({"dominoes": "redyellow"}, {"zone": Path("zone.csv")}):
        with pytest.raises(BadInputError, match="about averages of people"):
            compare({"m": {"a": 0.1}}, responses="trials.csv", **option)  # type: ignore[arg-type]


def test_the_zone_is_only_for_whole_scenarios() -> None:
    people = humans()
    zone = pd.DataFrame({"scenario": ["collide", "drop"], "low": 0.6, "high": 0.8})
    given = predictions(people.iloc[:-1])
    table = compared(given, people, zone=zone).people
    table = table.set_index("scenario")
    assert table.loc["collide", "zone_low"] == 0.6
    assert np.isnan(table.loc["drop", "zone_low"]) and np.isnan(table.loc[MEAN, "zone_low"])


def test_labels_of_one_class_are_said() -> None:
    people = humans()
    known = {name: value or "drop" in name for name, value in labels(people).items()}
    scores = compare_scores(predictions(people), people, known, bootstrap=QUICK).scores
    model = "m · observed"
    assert "labels: all contact" in score(scores, model, "drop")["reason"]
    assert "labels: of one class in drop" in score(scores, model, MEAN)["reason"]
    for scenario in ("collide", POOLED):
        assert "labels" not in score(scores, model, scenario)["reason"]
    never = compare_scores(
        predictions(people), people, dict.fromkeys(known, False), bootstrap=QUICK
    )
    for scenario in ("collide", POOLED):
        assert "labels: all no contact" in score(never.scores, model, scenario)["reason"]


@pytest.mark.slow
def test_the_settings_say_where_the_zone_comes_from_and_what_is_drawn() -> None:
    people = humans()
    zone = pd.DataFrame({"scenario": ["collide", "drop"], "low": 0.6, "high": 0.8})
    given = (predictions(people), people, labels(people))
    plain = compare_scores(*given, zone=zone, bootstrap=QUICK).settings
    assert "official" not in plain["Human zone"] and "not resampled" not in plain["Intervals"]
    assert "Intervals with participants" not in plain
    told = compare_scores(
        *given, zone=zone, zone_origin="from the responses", participants=True, bootstrap=QUICK
    ).settings
    assert "from the responses" in told["Human zone"]
    for word in ("participants", "stimuli", "both", "jackknife", "Efron and Stein"):
        assert word in told["Intervals with participants"]
    assert "200 resamples" in told["Intervals of people's accuracy and agreement"]
    assert "not given" in compare_scores(*given, bootstrap=QUICK).settings["Human zone"]
    assert "Human zone" not in compare_scores(given[0], None, bootstrap=QUICK).settings


def test_an_interval_without_width_says_so() -> None:
    people = humans()
    given = predictions(people)
    given["Predicted Outcome"] = given["Actual Outcome"]
    row = score(compare_scores(given, people, labels(people)).scores, "m · observed", "drop")
    assert row["accuracy_low"] == row["accuracy_high"] == 1 and "no width" in row["reason"]


def test_nothing_in_common_is_an_error() -> None:
    people = humans()
    other = people.assign(stimulus=people["stimulus"] + "_x")
    with pytest.raises(BadInputError, match=r"people saw for instance .*_0000'.*_x'"):
        compare_scores(predictions(other), people, labels(people))
    with pytest.raises(BadInputError, match="give the labels"):
        compare_scores(predictions(people), people)


# --- contradictions ---------------------------------------------------------------------------

STEM = SCENARIOS["drop"]
COUNT = 30
LABELS = {f"{STEM}_{k:04d}": k % 2 == 0 for k in range(COUNT)}


def drop_only() -> pd.DataFrame:
    """Return people on the stimuli of `LABELS`."""
    return humans(COUNT).query("scenario == 'drop'").reset_index(drop=True)


def mostly_right(right: int = 24, model: str = "m") -> pd.DataFrame:
    """Return predictions of which the first ``right`` are right."""
    truth = np.array(list(LABELS.values()))
    predicted = truth ^ (np.arange(COUNT) >= right)
    return pd.DataFrame(
        {"Model": model, "Readout Type": "B", "Predicted Outcome": predicted,
         "Predicted Prob_true": np.where(predicted, 0.8, 0.3), "Actual Outcome": truth,
         "Stimulus Name": list(LABELS)}
    )  # fmt: skip


def warnings_of(table: pd.DataFrame, labels: dict[str, bool] = LABELS) -> tuple[str, ...]:
    return compare_scores(table, drop_only(), labels, bootstrap=QUICK).warnings


def test_consistent_tables_give_no_warning() -> None:
    assert warnings_of(mostly_right()) == ()
    half = mostly_right()
    half.loc[3, ["Predicted Prob_true", "Predicted Outcome"]] = [0.5, True]
    assert warnings_of(half) == ()


def test_an_outcome_against_its_probability_is_reported() -> None:
    table = mostly_right()
    table.loc[[4, 9], "Predicted Prob_true"] = 1 - table.loc[[4, 9], "Predicted Prob_true"]
    (warning,) = warnings_of(table)
    assert "m · observed+simulated" in warning and f"{STEM}_0004" in warning
    assert "contradicts p_contact in 2 of 30 rows" in warning
    # Another threshold contradicts as well, but is no mistake.
    p = np.where(mostly_right()["Predicted Outcome"], 0.95, 0.7)
    (warning,) = warnings_of(mostly_right().assign(**{"Predicted Prob_true": p}))
    assert "in 15 of 30 rows" in warning
    with pytest.raises(BadInputError, match=r"in 30 of 30 rows.*probability of a contact"):
        warnings_of(
            mostly_right().assign(**{"Predicted Outcome": ~mostly_right()["Predicted Outcome"]})
        )


def test_opposite_labels_are_refused() -> None:
    opposite = {name: not value for name, value in LABELS.items()}
    with pytest.raises(BadInputError, match=r"drop: .* in 30 of 30 stimuli: .*opposite"):
        warnings_of(mostly_right(), opposite)
    # More than half differ, but chance could do that: a warning.
    some = {name: value ^ (k < 17) for k, (name, value) in enumerate(LABELS.items())}
    (warning,) = warnings_of(mostly_right(), some)
    assert "in 17 of 30 stimuli" in warning
    few = {name: value ^ (k < 15) for k, (name, value) in enumerate(LABELS.items())}
    assert warnings_of(mostly_right(), few) == ()


def test_answers_far_below_guessing_are_reported() -> None:
    (warning,) = warnings_of(mostly_right(2))
    assert "right in 7% of 30 stimuli" in warning
    # Always no is wrong for half of the stimuli, which is what guessing gives.
    never = mostly_right().assign(**{"Predicted Outcome": False, "Predicted Prob_true": 0.1})
    assert warnings_of(never) == ()


def test_a_comparison_on_few_stimuli_is_reported() -> None:
    (warning,) = warnings_of(mostly_right().head(9))
    assert "on only 9 stimuli" in warning
    assert warnings_of(mostly_right().head(10)) == ()


def test_missing_labels_of_predicted_stimuli_are_reported() -> None:
    known = dict(list(LABELS.items())[:25])
    (warning,) = warnings_of(mostly_right(), known)
    assert "drop: 5 of 30 stimuli" in warning and f"{STEM}_0025" in warning


def test_people_that_lack_stimuli_with_a_label_are_reported() -> None:
    assert check_coverage(drop_only(), LABELS) == []
    more = {**LABELS, f"{STEM}_0099": True, "pilot_towers_nb2_x_0001": True}
    (warning,) = check_coverage(drop_only(), more)
    assert "drop: 1 of 31 stimuli" in warning and f"{STEM}_0099" in warning
    ledge = {**LABELS, "pilot_it2_rollingSliding_simple_ledge_box_0001": True}
    assert check_coverage(drop_only(), ledge) == []


def test_a_stimulus_in_two_scenarios_is_refused() -> None:
    table = pd.concat([mostly_right(), mostly_right(model="n")]).assign(
        **{"Stimulus Name": [f"own {k % COUNT}" for k in range(2 * COUNT)],
           "Readout Test Data": ["drop"] * COUNT + ["roll"] * COUNT}
    )  # fmt: skip
    with pytest.raises(BadInputError, match="'own 0' is predicted in two scenarios, drop and roll"):
        name_models(check_predictions(table))


def test_a_misspelt_stimulus_to_exclude_is_refused() -> None:
    rows = name_models(check_predictions(mostly_right()))
    some = [f"{STEM}_0003", "pilot_towers_nb2_fr015_SJ010_mono0_dis0_occ0_tdwroom_0001"]
    results = all_results(rows, drop_only(), LABELS, exclude=some, bootstrap=QUICK)
    assert results.comparison.stimuli["stimulus"].nunique() == COUNT - 1
    for wrong in (f"{STEM}_003", "pilot_it2_drop_simpel_box_0003"):
        with pytest.raises(UnknownNameError, match=f"'{wrong}'; closest: {STEM}"):
            all_results(rows, drop_only(), LABELS, exclude=[wrong], bootstrap=QUICK)


# --- predictions -------------------------------------------------------------------------------


def test_readout_letters_get_their_names_and_seeds_tell_models_apart() -> None:
    people = humans()
    one = predictions(people, readout="B", **{"Dynamics Training Seed": 0.0})
    two = predictions(people, readout="B", seed=2, **{"Dynamics Training Seed": 1.0})
    alone = predictions(people, readout="A", **{"Dynamics Training Seed": 1.0})
    named = name_models(check_predictions(pd.concat([one, two, alone])))
    assert list(named["model"].unique()) == [
        "m · observed+simulated · seed 0",
        "m · observed+simulated · seed 1",
        "m · full",
    ]


@pytest.mark.parametrize("spelling", ["official", "ours"])
def test_training_on_each_scenario_in_turn_is_one_model(spelling: str) -> None:
    people = humans()
    names = {"collide": "collision", "drop": "drop"}
    own = people["scenario"].map(names) if spelling == "official" else people["scenario"]
    same = predictions(people, **{"Dynamics Training Dataset": own})
    others = predictions(people, seed=2, **{"Dynamics Training Dataset": "no_" + own})
    everything = predictions(people, seed=3, **{"Dynamics Training Dataset": "all"})
    found = compared(pd.concat([same, others, everything]), people)
    assert [name.rsplit(" · ")[-1] for name in found.names] == ["only", "all-but", "all"]


def test_a_stray_stimulus_does_not_split_a_model() -> None:
    people = humans()
    given = predictions(people)
    stray = given.iloc[:1].assign(**{"Stimulus Name": "of_no_known_scenario_0001"})
    found = compared(pd.concat([given, stray]), people)
    assert found.names == ["m · observed"]
    assert counts(found.dropped) == {("m · observed", NOT_SEEN): 1}


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("Predicted Prob_true", 1.5, "row 1 of column 'Predicted Prob_true'"),
        ("Predicted Prob_true", float("nan"), "row 1 of column 'Predicted Prob_true'"),
        ("Predicted Outcome", "perhaps", "expected True or False"),
        ("Model", "", "row 1 of column 'Model'.*expected a value"),
        ("Stimulus Name", " ", "row 1 of column 'Stimulus Name'.*expected a value"),
    ],
)
def test_bad_predictions_are_refused(column: str, value: object, message: str) -> None:
    given = predictions(humans()).astype(object)
    given.loc[0, column] = value
    with pytest.raises(BadInputError, match=message):
        check_predictions(given)


def test_contradictions_are_refused() -> None:
    people = humans()
    given = predictions(people)
    with pytest.raises(BadInputError, match="twice"):
        compare_scores(pd.concat([given, given]), people, labels(people))
    with pytest.raises(BadInputError, match=r"twice, in m and in a table; leave out one, or"):
        compare(
            [{"m": {"a": 0.1}}, pd.DataFrame({"stimulus": ["a"], "p_contact": 0.2, "model": "m"})]
        )
    other = predictions(people, "other", changed=(people["stimulus"].iloc[0],))
    with pytest.raises(BadInputError, match="different outcomes, and no official outcome"):
        compare_scores(pd.concat([given, other]), None)
    with pytest.raises(BadInputError, match=r"lacks the column\(s\) p_contact or Predicted Prob"):
        compare_scores(given.drop(columns="Predicted Prob_true"), people, labels(people))


def test_two_tables_of_one_model_are_named_and_the_older_one(tmp_path: Path) -> None:
    paths = [tmp_path / "m-1.csv", tmp_path / "m-2.csv"]
    for path in paths:
        predictions(humans()).to_csv(path, index=False)
    os.utime(paths[1], (0, 0))
    expected = f"twice, in {paths[0]} and in {paths[1]}; leave out one ({paths[1]} is older)"
    with pytest.raises(BadInputError, match=re.escape(expected)):
        compare(paths)
    pd.concat([predictions(humans())] * 2).to_csv(paths[0], index=False)
    with pytest.raises(BadInputError, match=re.escape(f"twice in {paths[0]}; keep one row")):
        read_predictions(paths[:1])


def test_the_official_outcome_decides_where_simulated_ones_differ() -> None:
    people = humans()
    name = people["stimulus"].iloc[0]
    plain, other = predictions(people), predictions(people, "other", changed=(name,))
    found = compared(pd.concat([plain, other]), people)
    assert list(found.changed["stimulus"]) == [name]
    assert list(found.changed["models"]) == ["other · observed"]
    stimuli = found.stimuli[found.stimuli["stimulus"] == name].set_index("base_model")
    assert set(stimuli["label"]) == {labels(people)[name]}
    assert stimuli.loc["m", "simulated"] != stimuli.loc["other", "simulated"]
    alone = compared(plain, people).scores
    own = found.scores[found.scores["base_model"] == "m"]
    pd.testing.assert_frame_equal(own, alone)


def test_stimulus_and_probability_are_enough() -> None:
    people = humans()
    given = predictions(people)
    short = given[["Stimulus Name", "Predicted Prob_true"]].set_axis(["stimulus", "p"], axis=1)
    found = compared(short, people)
    assert found.names == ["model"] and len(found.stimuli) == len(people)
    whole = compare_scores(given.assign(**{"Predicted Outcome": given["Predicted Prob_true"] > 0.5,
        "Actual Outcome": given["Stimulus Name"].map(labels(people))}), people, labels(people),
        bootstrap=QUICK)  # fmt: skip
    columns = ["scenario", "accuracy", "r", "kappa_from_averages", "rmsd", "r_low"]
    pd.testing.assert_frame_equal(found.scores[columns], whole.scores[columns])


def test_predictions_survive_their_files(tmp_path: Path) -> None:
    people = humans()
    paths = [tmp_path / "a.csv", tmp_path / "b.csv"]
    tables = [predictions(people), predictions(people, "other", "B", seed=2)]
    for path, table in zip(paths, tables, strict=True):
        table.to_csv(path, index=False)
    direct = compared(pd.concat(tables), people).scores
    read = compared(read_predictions(paths), people).scores
    pd.testing.assert_frame_equal(direct, read)
    two = tables[0][["Stimulus Name", "Predicted Prob_true"]]
    for names in (("Stimulus", " P_contact "), ("stim_ID", "prob")):
        two.set_axis(names, axis=1).to_csv(paths[0], index=False)
        assert read_predictions(paths[:1])[["stimulus", "p_contact"]].equals(
            name_models(tables[0])[["stimulus", "p_contact"]]
        )
    for mark, point, name in (
        (";", ".", "semicolons"),
        (";", ",", "semicolons"),
        ("\t", ".", "tabs"),
    ):
        two.to_csv(paths[0], index=False, sep=mark, decimal=point)
        with pytest.raises(BadInputError, match=rf"a\.csv separates its columns with {name}; save"):
            read_predictions(paths)
    two.to_parquet(paths[0])
    with pytest.raises(BadInputError, match=r"a\.csv is not a CSV table: it is no text"):
        read_predictions(paths)
    with pytest.raises(BadInputError, match="no file"):
        read_predictions([])
    with pytest.raises(BadInputError, match="not a file"):
        read_predictions([tmp_path / "none.csv"])


# --- official data -----------------------------------------------------------------------------


def test_official_people_as_a_model_reach_the_official_accuracies(official: Path) -> None:
    people = read_humans(official / "humans")
    known = read_labels(official / "stimuli" / "stimulus_names_and_labels.csv")
    truth = people["stimulus"].map(known).astype(bool).to_numpy()
    p_yes = np.where(truth, people["accuracy"], 1 - people["accuracy"])
    given = predictions(people)
    given = given.assign(
        **{"Actual Outcome": truth, "Predicted Prob_true": p_yes, "Predicted Outcome": p_yes > 0.5}
    )
    found = compare_scores(given, people, known, bootstrap=QUICK)
    assert found.dropped.empty and found.changed.empty
    mean = score(found.scores, "m · observed", MEAN)
    # The study: .747 over scenarios, of people after the stricter exclusion.
    assert mean["human_accuracy"] == pytest.approx(0.747, abs=0.003)
    assert mean["r"] == pytest.approx(1)
    # The majority of people is right more often than a single person.
    assert mean["accuracy"] > mean["human_accuracy"] + 0.05


def test_models_are_held_against_the_first_in_the_files() -> None:
    people = humans()
    both = pd.concat([predictions(people, "z"), predictions(people, "a", seed=2)])
    found = compared(both, people)
    spread = found.scores.assign(accuracy=np.linspace(0.4, 0.9, len(found.scores)) ** 2)
    models = fits_of_models(replace(found, scores=spread))[0]
    assert models.fit is not None and found.names[0] in models.about
    assert models.fit.table["term"].tolist() == ["Intercept", "model[T.a · observed]"]


# --- metrics of three arrays ---------------------------------------------------------------------


def test_a_metric_of_arrays_equals_one_of_a_sample() -> None:
    people = humans()
    stimuli = compared(predictions(people), people).stimuli
    rows = stimuli[stimuli["scenario"] == "drop"].reset_index(drop=True)
    rows["predicted"] = rows["predicted"].astype(float)
    rows.loc[2, ["p_contact", "predicted"]] = np.nan
    weights = np.vstack([np.ones(len(rows)), 1 - np.eye(len(rows)), 2 * np.eye(len(rows))[:1] + 1])
    sample = sample_of_rows(rows, weights)
    for name, function in (
        ("rmsd", lambda p, q, _: np.sqrt(np.mean((p - q) ** 2))),
        ("accuracy", lambda p, _, label: np.mean((p > 0.5) == label)),
    ):
        metric = metrics.get(name)
        found = metric_of_arrays(function, metric.needs)(sample)
        np.testing.assert_allclose(found, metric(sample), atol=1e-12)
