"""Predictions and people together: which trials count, both ways of scoring, invariances."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import special, stats

from physion.analysis import Bootstrap, compare_scores, read_predictions
from physion.analysis.compare import all_results
from physion.analysis.comparison import NO_LABEL, NOT_PREDICTED, NOT_SEEN
from physion.analysis.metrics import metric_of_arrays, metrics
from physion.analysis.people.responses import EXCLUDED, LEDGE
from physion.analysis.sample import sample_of_rows
from physion.analysis.tables import (
    MEAN,
    POOLED,
    check_predictions,
    name_models,
    read_humans,
    read_labels,
)
from physion.core.errors import BadInputError
from physion.report.compare import compare

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


def score(table: pd.DataFrame, model: str, scenario: str) -> pd.Series:
    rows = table[(table["model"] == model) & (table["scenario"] == scenario)]
    assert len(rows) == 1
    return rows.iloc[0]


# --- scores ------------------------------------------------------------------------------------


def test_scores_match_the_joined_rows() -> None:
    people = humans()
    given = predictions(people)
    found = compare_scores(given, people, labels(people), bootstrap=QUICK)
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
    found = compare_scores(predictions(people), people, labels(people), bootstrap=QUICK).scores
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


def test_the_mean_counts_scenarios_and_the_pool_counts_stimuli() -> None:
    people = pd.concat(
        [humans(30).query("scenario == 'collide'"), humans(6).query("scenario == 'drop'")]
    )
    given = predictions(people)
    right = people["scenario"].eq("collide").to_numpy() == given["Actual Outcome"].to_numpy()
    given["Predicted Outcome"] = right  # accuracy 1 on collide, 0 on drop
    found = compare_scores(given, people, labels(people), bootstrap=QUICK).scores
    assert score(found, "m · observed", MEAN)["accuracy"] == pytest.approx(0.5)
    assert score(found, "m · observed", POOLED)["accuracy"] == pytest.approx(30 / 36)


def test_trials_of_another_outcome_are_listed_and_scored_both_ways() -> None:
    people = humans()
    odd = tuple(people["stimulus"].iloc[:3])
    given = predictions(people, changed=odd)
    given["Predicted Outcome"] = given["Actual Outcome"]
    found = compare_scores(given, people, labels(people), bootstrap=QUICK)
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


def test_the_official_label_and_not_the_simulation_turns_accuracy_into_yes() -> None:
    people = humans()
    plain = compare_scores(predictions(people), people, labels(people), bootstrap=QUICK)
    odd = tuple(people["stimulus"].iloc[:3])
    other = compare_scores(
        predictions(people, changed=odd), people, labels(people), bootstrap=QUICK
    )
    assert plain.stimuli["p_yes"].equals(other.stimuli["p_yes"])


def test_people_as_their_own_model_agree_perfectly() -> None:
    people = humans()
    truth = np.array(list(labels(people).values()))
    given = predictions(people)
    given["Predicted Prob_true"] = np.where(truth, people["accuracy"], 1 - people["accuracy"])
    row = score(compare_scores(given, people, labels(people)).scores, "m · observed", POOLED)
    assert row["r"] == pytest.approx(1) and row["rmsd"] == pytest.approx(0, abs=1e-12)
    assert row["r_low"] == pytest.approx(1) and row["r_high"] == pytest.approx(1)
    assert row["r"] > row["ceiling"]  # it has the noise of these very people


# --- invariances -------------------------------------------------------------------------------


def test_the_order_of_rows_changes_nothing_but_their_order() -> None:
    people = humans()
    given = pd.concat([predictions(people), predictions(people, "other", "B", seed=2)])
    plain = compare_scores(given, people, labels(people), bootstrap=QUICK)
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
    together = compare_scores(both, people, labels(people), bootstrap=QUICK).scores
    alone = compare_scores(predictions(people), people, labels(people), bootstrap=QUICK).scores
    pd.testing.assert_frame_equal(together[together["base_model"] == "m"], alone)


def test_either_look_of_a_stimulus_joins() -> None:
    people = humans()
    given = predictions(people)
    plain = compare_scores(given, people, labels(people), bootstrap=QUICK).scores
    red = given.assign(
        **{
            "Stimulus Name": given["Stimulus Name"].str[:-5]
            + "-redyellow"
            + given["Stimulus Name"].str[-5:]
        }
    )
    pd.testing.assert_frame_equal(
        compare_scores(red, people, labels(people), bootstrap=QUICK).scores, plain
    )


# --- undefined ---------------------------------------------------------------------------------


def test_constant_predictions_give_nan_with_a_reason() -> None:
    people = humans()
    given = predictions(people)
    given["Predicted Prob_true"] = 0.5
    scores = compare_scores(given, people, labels(people), bootstrap=QUICK).scores
    row = score(scores, "m · observed", "collide")
    assert np.isnan(row[["r", "r_low", "r_high"]].astype(float)).all()
    assert "P(contact) is constant" in row["reason"]
    assert np.isfinite(row[["accuracy", "accuracy_low", "rmsd", "rmsd_high"]].astype(float)).all()
    mean = score(scores, "m · observed", MEAN)
    assert np.isnan(mean["r"]) and mean["reason"].startswith("r: undefined in collide, drop")


def test_constant_in_one_scenario_leaves_no_silent_mean_of_the_rest() -> None:
    people = humans()
    given = predictions(people)
    given.loc[people["scenario"] == "drop", "Predicted Prob_true"] = 0.5
    scores = compare_scores(given, people, labels(people), bootstrap=QUICK).scores
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
    return {
        (a, r): int(n)
        for a, r, n in dropped.groupby(["model", "reason"])["stimuli"]
        .sum()
        .reset_index()
        .to_numpy()
    }


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
    ledge = (
        people["stimulus"]
        .iloc[0]
        .replace("pilot_it2_collision_simple_box", "pilot_it2_rollingSliding_simple_ledge_box")
    )
    people.loc[0, ["stimulus", "scenario"]] = [ledge, "roll"]
    kept = compare_scores(
        predictions(people), people, labels(people), exclude_ledge=False, bootstrap=QUICK
    )
    assert "roll" in set(kept.scores["scenario"]) and kept.dropped.empty
    left = compare_scores(predictions(people), people, labels(people), bootstrap=QUICK)
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
    with_labels = compare_scores(
        predictions(people, changed=odd), people, labels(people), bootstrap=QUICK
    )
    found = compare_scores(given, people, bootstrap=QUICK)
    pd.testing.assert_frame_equal(found.scores, with_labels.scores)
    assert list(found.changed["stimulus"]) == list(odd)
    given.loc[0, "Recorded Outcome"] = ""
    assert counts(compare_scores(given, people, bootstrap=QUICK).dropped)["", NO_LABEL] == 1


def test_the_zone_is_only_for_whole_scenarios() -> None:
    people = humans()
    zone = pd.DataFrame({"scenario": ["collide", "drop"], "low": 0.6, "high": 0.8})
    given = predictions(people.iloc[:-1])
    table = compare_scores(given, people, labels(people), zone=zone, bootstrap=QUICK).people
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
    found = compare_scores(
        pd.concat([same, others, everything]), people, labels(people), bootstrap=QUICK
    )
    assert [name.rsplit(" · ")[-1] for name in found.names] == ["only", "all-but", "all"]


def test_a_stray_stimulus_does_not_split_a_model() -> None:
    people = humans()
    given = predictions(people)
    stray = given.iloc[:1].assign(**{"Stimulus Name": "of_no_known_scenario_0001"})
    found = compare_scores(pd.concat([given, stray]), people, labels(people), bootstrap=QUICK)
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
    found = compare_scores(pd.concat([plain, other]), people, labels(people), bootstrap=QUICK)
    assert list(found.changed["stimulus"]) == [name]
    assert list(found.changed["models"]) == ["other · observed"]
    stimuli = found.stimuli[found.stimuli["stimulus"] == name].set_index("base_model")
    assert set(stimuli["label"]) == {labels(people)[name]}
    assert stimuli.loc["m", "simulated"] != stimuli.loc["other", "simulated"]
    alone = compare_scores(plain, people, labels(people), bootstrap=QUICK).scores
    own = found.scores[found.scores["base_model"] == "m"]
    pd.testing.assert_frame_equal(own, alone)


def test_stimulus_and_probability_are_enough() -> None:
    people = humans()
    given = predictions(people)
    short = given[["Stimulus Name", "Predicted Prob_true"]].set_axis(["stimulus", "p"], axis=1)
    found = compare_scores(short, people, labels(people), bootstrap=QUICK)
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
    direct = compare_scores(pd.concat(tables), people, labels(people), bootstrap=QUICK).scores
    read = compare_scores(read_predictions(paths), people, labels(people), bootstrap=QUICK).scores
    pd.testing.assert_frame_equal(direct, read)
    tables[0][["Stimulus Name", "Predicted Prob_true"]].to_csv(paths[0], index=False, sep=";")
    with pytest.raises(BadInputError, match=r"a\.csv separates its columns with semicolons"):
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


def test_compare_computes_all_that_a_report_draws() -> None:
    people = humans()
    both = pd.concat([predictions(people), predictions(people, model="other", seed=5)])
    found = all_results(both, people, labels(people), bootstrap=QUICK)
    direct = compare_scores(both, people, labels(people), bootstrap=QUICK)
    pd.testing.assert_frame_equal(found.comparison.scores, direct.scores)
    assert found.paired is not None and len(found.paired) == 1
    assert found.people is None and found.predictions is not None
    alone = all_results(predictions(people), None, bootstrap=QUICK)
    assert alone.paired is None and alone.comparison.people.empty


# --- metrics of three arrays ---------------------------------------------------------------------


def test_a_metric_of_arrays_equals_one_of_a_sample() -> None:
    people = humans()
    stimuli = compare_scores(predictions(people), people, labels(people), bootstrap=QUICK).stimuli
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
