"""Analyses of people: against scipy and plain loops, known truths, and the official tables."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
import statsmodels.api as sm
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats
from statsmodels.stats.multitest import multipletests

from physion.analysis.intervals import Bootstrap
from physion.analysis.people.effects import (
    HYPOTHESES,
    accuracy_by_background,
    answer_rows,
    background,
    below_chance_level,
    below_chance_level_p,
    difficulty_third,
    regress_attributes,
    regress_hypotheses,
    side_bias,
    with_attributes,
    yes_bias,
)
from physion.analysis.people.measures import (
    accuracy_by_participant,
    accuracy_by_scenario,
    accuracy_by_stimulus,
    agreement_by_scenario,
    answers_of,
    item_statistics,
    spearman_brown,
    split_halves,
)
from physion.analysis.people.responses import Responses
from physion.analysis.statistics import agreement
from physion.analysis.statistics.agreement import correlate_rows, pair_values, pairwise_kappa
from physion.analysis.tables import (
    ATTRIBUTES,
    COLUMNS,
    MISLABELLED,
    attribute_names,
    attributes_from_names,
    attributes_from_table,
    better_attributes,
    read_humans,
    read_labels,
    with_labels,
)
from physion.core.errors import BadInputError
from physion.core.names import canonical_name
from support.simulated_people import study

Array = npt.NDArray[np.float64]
FEW = Bootstrap(resamples=200)


@pytest.fixture(scope="module")
def made() -> Responses:
    return study(people=24, stimuli=30, scenarios=("collide", "roll"), seed=1)


@pytest.fixture(scope="module")
def official_people(official: Path) -> pd.DataFrame:
    labels = read_labels(official / "stimuli" / "stimulus_names_and_labels.csv")
    return with_labels(read_humans(official / "humans"), labels)


# --- accuracy --------------------------------------------------------------------------------


def test_accuracies_match_plain_grouping(made: Responses) -> None:
    test = made.test
    by_stimulus = accuracy_by_stimulus(test, FEW).set_index("stimulus")
    plain = test.groupby("stimulus")["correct"].mean()
    np.testing.assert_allclose(by_stimulus["accuracy"].loc[plain.index], plain)
    yes = test.groupby("stimulus")["yes"].mean()
    np.testing.assert_allclose(by_stimulus["consistency"].loc[yes.index], np.maximum(yes, 1 - yes))
    rt = test.groupby("stimulus")["log_rt"].mean()
    np.testing.assert_allclose(by_stimulus["mean_log_rt"].loc[rt.index], rt)
    assert (by_stimulus["count"] == 24).all()
    inside = by_stimulus["accuracy"].between(
        by_stimulus["accuracy_low"], by_stimulus["accuracy_high"]
    )
    assert inside.all()
    people = accuracy_by_participant(test).set_index("session")["accuracy"]
    plain = test.groupby("session")["correct"].mean()
    np.testing.assert_allclose(people.loc[plain.index], plain)
    table = accuracy_by_scenario(test, FEW).set_index("scenario")
    own = plain[plain.index.str.startswith("roll")]
    expected = stats.ttest_1samp(own, 0.5)
    row = table.loc["roll"]
    assert row["accuracy"] == pytest.approx(own.mean())
    assert (row["t"], row["p"]) == pytest.approx((expected.statistic, expected.pvalue))
    assert (row["zone_low"], row["zone_high"]) == pytest.approx(np.percentile(own, [2.5, 97.5]))
    assert table.loc["mean", "accuracy"] == pytest.approx(table["accuracy"].iloc[:2].mean())
    assert "not one sample" in table.loc["mean", "reason"]
    assert row["sd"] == pytest.approx(own.std(ddof=1)) and row["df"] == 23
    drawn = {name: FEW.weights(f"people of {name}", 24) @ plain[plain.index.str.startswith(name)]
             / 24 for name in ("collide", "roll")}  # fmt: skip
    for where, values in (("roll", drawn["roll"]), ("mean", np.mean(list(drawn.values()), axis=0))):
        ends = table.loc[where, "accuracy_low"], table.loc[where, "accuracy_high"]
        assert ends == pytest.approx(np.percentile(values, [2.5, 97.5]))


def test_people_who_are_too_few_or_too_alike_get_reasons(made: Responses) -> None:
    one = made.test[made.test["session"] == "roll-s001"]
    row = accuracy_by_scenario(one, FEW).iloc[0]
    assert np.isnan(row["accuracy_low"]) and "only one person" in row["reason"]
    alike = agreement_by_scenario(one, FEW, halves=10)
    assert alike["mean"].isna().all() and alike["reason"].str.contains("no pair").all()
    same = made.test.assign(yes=True)
    same["correct"] = same["label"]
    table = agreement_by_scenario(same, FEW, halves=10).set_index(["scenario", "measure"])
    row = table.loc[("roll", "kappa")]
    assert row["undefined"] == row["values"] == 24 * 23 / 2 and np.isnan(row["median"])
    assert "constant answers" in row["reason"]
    scenario = accuracy_by_scenario(same, FEW).iloc[0]
    assert np.isnan(scenario["t"]) and "same accuracy" in scenario["reason"]
    with pytest.raises(BadInputError, match="no test answer"):
        accuracy_by_scenario(made.test.iloc[:0])


# --- agreement --------------------------------------------------------------------------------


def test_pairs_are_summarised_as_they_are(made: Responses) -> None:
    table = agreement_by_scenario(made.test, FEW, halves=50).set_index(["scenario", "measure"])
    values = pair_values(pairwise_kappa(answers_of(made.test, "collide").yes))
    row = table.loc[("collide", "kappa")]
    assert row["mean"] == pytest.approx(values.mean())
    expected = np.percentile(values, [2.5, 50, 97.5])
    assert (row["low"], row["median"], row["high"]) == pytest.approx(expected)
    assert row["mean_low"] < row["mean"] < row["mean_high"]
    halves, whole = table.loc[("collide", "split_half")], table.loc[("collide", "spearman_brown")]
    assert halves["mean"] < whole["mean"] and halves["values"] == 50


def test_spearman_brown_doubles_the_number_of_people() -> None:
    r = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    np.testing.assert_allclose(spearman_brown(r), [np.nan, -2.0, 0.0, 2 / 3, 1.0])


def test_halves_of_people_give_what_their_number_makes_likely() -> None:
    """Independent answers: the mean r of halves is the reliability of half the people."""
    generator = np.random.default_rng(0)
    p = generator.beta(2, 2, 400)
    yes = (generator.random((40, 400)) < p).astype(float)
    r = split_halves(yes, 200)
    whole = agreement.reliability(yes.mean(axis=0), np.full(400, 40))
    assert np.mean(r) == pytest.approx(whole / (2 - whole), abs=0.02)
    assert np.mean(spearman_brown(r)) == pytest.approx(whole, abs=0.02)
    np.testing.assert_array_equal(r, split_halves(yes, 200))
    assert not np.array_equal(r, split_halves(yes, 200, seed=1))


arrays = st.tuples(st.integers(1, 4), st.integers(3, 20)).flatmap(
    lambda shape: hnp.arrays(
        np.float64, shape, elements=st.sampled_from([0.0, 0.2, 0.5, 0.9, 1.0, np.nan])
    )
)


@settings(deadline=None, max_examples=50)
@given(arrays, st.integers(0, 50))
def test_correlations_of_many_match_each(x: Array, seed: int) -> None:
    generator = np.random.default_rng(seed)
    y = np.where(generator.random(x.shape) < 0.2, np.nan, generator.random(x.shape))
    rows = correlate_rows(x, y)
    for k in range(len(x)):
        known = np.isfinite(x[k]) & np.isfinite(y[k])
        plain = agreement.pearson(x[k, known], y[k, known])
        assert rows[k] == pytest.approx(plain, abs=1e-7, nan_ok=True)


# --- stimuli that fool people -------------------------------------------------------------------


def test_below_chance_is_scipys_binomial_test_and_guards_against_many_looks() -> None:
    accuracy, count = np.array([0.3, 0.5, 0.0]), np.array([60, 40, 5])
    expected = [stats.binomtest(round(a * n), n, 0.5, "less").pvalue
                for a, n in zip(accuracy, count, strict=True)]  # fmt: skip
    np.testing.assert_allclose(below_chance_level_p(accuracy, count), expected)
    generator = np.random.default_rng(0)
    guessed = pd.DataFrame({"stimulus": np.arange(3000).astype(str), "scenario": "x", "count": 80,
                            "accuracy": generator.binomial(80, 0.5, 3000) / 80})  # fmt: skip
    found = below_chance_level(guessed)
    assert 30 < found["released"].sum() < 150 and found["exact"].sum() <= 1
    with pytest.raises(BadInputError, match="must lie in"):
        below_chance_level_p([1.2], [3])
    assert difficulty_third([np.nan, 0.2, 0.5, 0.9]).tolist()[1:] == ["hard", "chance", "easy"]
    assert pd.isna(difficulty_third([np.nan]).iloc[0])


# --- biases, practice, background ---------------------------------------------------------------


def test_biases_are_means_over_people_by_hand(made: Responses) -> None:
    test = made.test.drop(index=made.test.index[[3, 40]])
    rows = test[test["scenario"] == "collide"]
    z, yes, base = [], [], []
    for _, own in rows.groupby("session"):
        touch, said = own["label"].to_numpy(bool), own["yes"].to_numpy(bool)
        rates = [(said[part].sum() + 0.5) / (part.sum() + 1) for part in (touch, ~touch)]
        z.append(stats.norm.ppf(rates))
        yes.append(said.mean())
        base.append(touch.mean())
    hit, alarm = np.array(z).T
    found = yes_bias(test, FEW).set_index("scenario").loc["collide"]
    expected = {"d_prime": hit - alarm, "criterion": -(hit + alarm) / 2,
                "bias": np.array(yes) - np.array(base)}  # fmt: skip
    for name, values in expected.items():
        assert found[name] == pytest.approx(values.mean())
        drawn = FEW.weights("people of collide", 24) @ values / 24
        ends = found[f"{name}_low"], found[f"{name}_high"]
        assert ends == pytest.approx(np.percentile(drawn, [2.5, 97.5]))
    groups = [own["yes"].mean() for _, own in rows.groupby("session")]
    order = rows.groupby("session")["buttons"].first().eq("yes-no").to_numpy()
    left, right = np.array(groups)[order], np.array(groups)[~order]
    side = side_bias(test, FEW).set_index("scenario").loc["collide"]
    assert side["left"] == pytest.approx((left.mean() + 1 - right.mean()) / 2)
    assert side["p"] == pytest.approx(stats.ttest_ind(left, right, equal_var=False).pvalue)


def test_biases_that_cannot_be_known_say_why(made: Responses) -> None:
    one_outcome = made.test[made.test["label"]]
    found = yes_bias(one_outcome, FEW)
    assert found["d_prime"].isna().all() and found["reason"].str.contains("one outcome").all()
    blind = side_bias(made.test.drop(columns="buttons"), FEW)
    assert blind["left"].isna().all() and (blind["unknown"] == 24).all()
    assert blind["reason"].str.contains("fewer than two").all()


def test_background_is_counted_and_related_to_accuracy(made: Responses) -> None:
    sessions = made.sessions
    table = background(sessions)
    assert table.groupby("question")["sessions"].sum().eq(48).all()
    assert set(table["question"]) == {"age", "gender", "difficulty"}
    blank = background(sessions.assign(gender="", age=pd.array([pd.NA] * 48, dtype="Int64")))
    assert set(blank.loc[blank["question"].isin(["age", "gender"]), "answer"]) == {"(none)"}
    accuracy = accuracy_by_participant(made.test).set_index("session")["accuracy"]
    rank = accuracy.rank()
    by_skill = sessions.assign(difficulty=6 - np.ceil(sessions["session"].map(rank) / 48 * 5))
    found = accuracy_by_background(made.test, by_skill).set_index("question")
    assert found.loc["difficulty", "statistic"] < -0.5 and found.loc["difficulty", "p"] < 1e-3
    assert found.loc["gender", "test"] == "kruskal-wallis" and found.loc["gender", "p"] > 1e-3
    alike = accuracy_by_background(made.test, sessions.assign(age=30, gender="a"))
    assert alike.set_index("question").loc[["age", "gender"], "reason"].ne("").all()


def test_own_questions_are_counted_and_related_to_accuracy(made: Responses) -> None:
    """A right answer goes with accuracy, a number with nothing, and names stay apart."""
    accuracy = accuracy_by_participant(made.test).set_index("session")["accuracy"]
    able = made.sessions["session"].map(accuracy) > accuracy.median()
    sessions = made.sessions.assign(
        mental_rotation_right=able,
        hours=np.arange(48) % 7,
        games=pd.array(["often", None] * 24, dtype=object),
    )
    own = ("mental_rotation_right", "hours", "games")
    counted = background(sessions, own).set_index(["question", "answer"])["sessions"]
    assert counted["mental_rotation_right", "True"] == able.sum()
    assert counted["games", "(none)"] == counted["games", "often"] == 24
    found = accuracy_by_background(made.test, sessions, own).set_index("question")
    assert list(found.index[-3:]) == list(own)
    assert found.loc["mental_rotation_right", "test"] == "kruskal-wallis"
    relative = accuracy_by_participant(made.test)
    relative["a"] = relative["accuracy"] - relative.groupby("scenario")["accuracy"].transform(
        "mean"
    )
    by_person = relative.groupby("session")["a"].mean().reindex(sessions["session"])
    groups = [by_person[able.to_numpy()], by_person[~able.to_numpy()]]
    assert found.loc["mental_rotation_right", "p"] == pytest.approx(stats.kruskal(*groups).pvalue)
    assert found.loc["hours", "test"] == "spearman"
    wanted = stats.spearmanr(sessions["hours"], by_person).statistic
    assert found.loc["hours", "statistic"] == pytest.approx(wanted)
    assert found.loc["games", "reason"].startswith("fewer than two groups")


# --- attributes and hypotheses ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "elements", "distractors", "occluders", "room"),
    [
        ("pilot_dominoes_2mid_J020R15_d3chairs_o1plants_tdwroom_2_0004_img", 2, 3, 1, "tdw"),
        ("pilot_dominoes_4midRM1_boxroom_0001", 3, 0, 0, "box"),
        ("pilot_dominoes_4mid_boxroom_0001", 4, 0, 0, "box"),
        ("pilot_dominoes_4mid_tdwroom_0001", 8, 0, 0, "tdw"),
        ("pilot_dominoes_SJ020_d3chairs_o1plants_tdwroom_0001", np.nan, 3, 1, "tdw"),
        ("pilot_dominoes_1mid_J025R45_o1full_tdwroom_0001", 1, 0, 1, "tdw"),
        ("pilot_towers_nb4_fr015_SJ000_gr-01_mono1_dis1_occ1_boxroom_0003", 4, 1, 1, "box"),
        ("pilot_it2_collision_yeet_tdw_2_dis_2_occ_0001", np.nan, 2, 2, "tdw"),
        ("pilot_it2_drop_simple_box_0001", np.nan, 0, 0, "box"),
        ("pilot-containment-cone-plate_0006", np.nan, 1, 1, "box"),
        ("pilot_linking_nl1-8_ms03_aCylcap_bCyl_occ1_dis1_tdwroom_0001", np.nan, 1, 1, "tdw"),
        ("test13_0011", np.nan, 0, 0, "box"),
    ],
)
def test_official_names_are_read(
    name: str, elements: float, distractors: int, occluders: int, room: str
) -> None:
    row = attributes_from_names([name]).iloc[0]
    assert row[list(ATTRIBUTES)].tolist() == pytest.approx(
        [elements, distractors, occluders], nan_ok=True
    )
    assert row["room"] == room


def attributes_from_metadata(folder: Path) -> pd.DataFrame:
    """Return attributes from all ``<scenario>/<configuration>/metadata.json`` under ``folder``."""
    rows = []
    for path in sorted(folder.glob("*/*/metadata.json")):
        trials = json.loads(path.read_text(encoding="utf-8"))
        rows += [metadata_row(trial, path.parents[1].name, path.parent.name) for trial in trials]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def metadata_row(trial: dict[str, Any], scenario: str, configuration: str) -> dict[str, Any]:
    def count(key: str) -> float:
        return float(pd.to_numeric(str(trial.get(key)), errors="coerce"))

    removed = str(trial.get("remove_middle")).lower() == "true"
    # The generator of Drop inherits a count of 0 that has no meaning.
    counted = scenario in ("dominoes", "support")
    return {
        "stimulus": canonical_name(trial["stimulus_name"]),
        "scenario": scenario,
        "configuration": configuration,
        "elements": count("num_middle_objects") - removed if counted else np.nan,
        "distractors": count("num_distractors"),
        "occluders": count("num_occluders"),
        "room": re.sub(r"^b?'?([a-z]*)'?$", r"\1", str(trial.get("room", ""))),
        "source": "metadata",
    }


def test_names_with_their_correction_say_what_the_metadata_say(
    official_people: pd.DataFrame, official: Path
) -> None:
    names = attributes_from_names(official_people["stimulus"])
    metadata = attributes_from_metadata(official / "scenes")
    joined = metadata.merge(names, on="stimulus", suffixes=("", "_name"))
    assert len(joined) > 500
    assert joined["room"].eq(joined["room_name"]).all()
    for name in ATTRIBUTES:
        both = joined[[name, f"{name}_name"]]
        differ = joined[(both[name] != both[f"{name}_name"]) & both.notna().any(axis=1)]
        assert differ.empty
    corrected = joined[joined["configuration"].isin(MISLABELLED)]
    assert len(corrected) == 3 and (corrected["elements_name"] == 8).all()
    best = better_attributes(metadata, names).set_index("stimulus")
    assert best.index.is_unique and set(official_people["stimulus"]) <= set(best.index)
    assert (best[best["configuration"] == "pilot_dominoes_4mid_tdwroom"]["elements"] == 8).all()


def test_attributes_from_tables_and_bad_names() -> None:
    table = pd.DataFrame({"stimulus": ["a_img", "b"], "scenario": "drop", "occluders": ["1", ""]})
    found = attributes_from_table(table.rename(columns={"stimulus": "trial"}))
    assert found["stimulus"].tolist() == ["a", "b"] and found["occluders"].iloc[0] == 1
    assert np.isnan(found["occluders"].iloc[1]) and found["elements"].isna().all()
    with pytest.raises(BadInputError, match="row 2 of column 'occluders' holds 'x'"):
        attributes_from_table(table.assign(occluders=["1", "x"]))
    with pytest.raises(BadInputError, match="has no column"):
        attributes_from_table(table[["stimulus", "scenario"]])
    with pytest.raises(BadInputError, match="not an official name"):
        attributes_from_names(["collide_0001"])
    with pytest.raises(BadInputError, match="stands in two rows"):
        attributes_from_names(["test13_0011", "test13_0011_img"])


def test_every_column_of_a_table_is_an_attribute() -> None:
    table = pd.DataFrame(
        {"stimulus": ["a", "b", "c"], "scenario": "drop", "jitter": ["0.5", "", "2"],
         "tilted": [True, False, True], "shape": ["cone", "", "cube"]}
    )  # fmt: skip
    found = attributes_from_table(table)
    names = ["elements", "distractors", "occluders", "room", "jitter", "tilted", "shape"]
    assert attribute_names(found) == [*names, "configuration"]
    assert found["jitter"].tolist() == pytest.approx([0.5, np.nan, 2], nan_ok=True)
    assert found["tilted"].tolist() == [1.0, 0.0, 1.0]
    assert found["shape"].tolist()[::2] == ["cone", "cube"] and found["shape"].isna()[1]
    with pytest.raises(BadInputError, match="'label', as the answers; rename it"):
        attributes_from_table(table.assign(label=1))
    # Of the index of a dataset what was drawn counts, and not what keeps books.
    index = table.assign(scene_digest="x", seed="1", frames=9, robust=1.0, drawn_agent_mass=2.0)
    names = attribute_names(attributes_from_table(index))
    assert {"robust", "drawn_agent_mass"} <= set(names)
    assert not {"jitter", "seed", "frames", "scene_digest"} & set(names)


def robust_slope(x: np.ndarray, y: np.ndarray, scenario: np.ndarray) -> tuple[float, float]:
    """Least squares with an intercept for each scenario, and HC3, written out."""
    design = np.column_stack([x, *(scenario == name for name in np.unique(scenario))]).astype(float)
    bread = np.linalg.inv(design.T @ design)
    b = bread @ design.T @ y
    leverage = np.einsum("ij,jk,ik->i", design, bread, design)
    scaled = design * ((y - design @ b) / (1 - leverage))[:, None]
    return b[0], np.sqrt((bread @ scaled.T @ scaled @ bread)[0, 0])


@pytest.mark.slow
def test_accuracy_by_attributes_single_and_together() -> None:
    generator = np.random.default_rng(1)
    stimuli = stimuli_table(0, -0.05)
    stimuli["mass"] = 100 + generator.normal(size=120)
    stimuli["shape"] = generator.choice(["cone", "cube", "pipe"], 120)
    stimuli["accuracy"] += 0.04 * (stimuli["mass"] - 100) + 0.2 * (stimuli["shape"] == "cube")
    stimuli = stimuli.assign(double=2 * stimuli["mass"], constant=3.0, configuration="c")
    stimuli.loc[:9, "distractors"] = np.nan
    names = ["occluders", "mass", "shape", "distractors", "double", "constant", "elements",
             "configuration"]  # fmt: skip
    table = regress_attributes(stimuli, names)
    assert list(table["scenario"].unique()) == ["drop", "link", "roll", "all"]
    single = table[(table["scenario"] == "all") & (table["fit"] == "single")].set_index("attribute")
    x, y, scenario = (stimuli[name].to_numpy() for name in ("mass", "accuracy", "scenario"))
    row = single.loc["mass"]
    assert (row["b"], row["se"]) == pytest.approx(robust_slope(x, y, scenario))
    apart = stimuli["mass"] - stimuli.groupby("scenario")["mass"].transform("mean")
    assert row["b_sd"] == pytest.approx(row["b"] * np.sqrt((apart**2).sum() / 117))
    within = y - stimuli.groupby("scenario")["accuracy"].transform("mean")
    assert row["r2"] == pytest.approx(np.corrcoef(apart, within)[0, 1] ** 2)
    assert row["p_term"] == pytest.approx(row["p"]) and row["df"] == 120 - 4
    shape = single.loc["shape"]
    assert shape["level"].tolist() == ["cube", "pipe"] and shape["p_term"].nunique() == 1
    assert shape["p_term"].iloc[0] < 0.001 and shape["p"].iloc[1] > 0.01
    assert single.loc["distractors", ["stimuli", "left_out"]].tolist() == [110, 10]
    assert (
        single.loc["constant", "reason"] == single.loc["configuration", "reason"] == "does not vary"
    )
    assert single.loc["elements", "reason"] == "not known"
    tested = single[~single.index.duplicated()]["p_term"].dropna()
    assert single.loc["mass", "p_holm"] == pytest.approx(multipletests(tested, method="holm")[1][
        list(tested.index).index("mass")])  # fmt: skip
    both = table[(table["scenario"] == "all") & (table["fit"] == "together")]
    both = both.set_index("attribute")
    assert "follows from other" in both.loc["double", "reason"]
    assert "configuration" not in both.index
    known = stimuli[stimuli["distractors"].notna()]
    design = pd.get_dummies(known[["occluders", "mass", "shape", "distractors", "scenario"]],
                            columns=["shape", "scenario"], dtype=float)  # fmt: skip
    design = design.drop(columns="shape_cone")
    fit = sm.OLS(known["accuracy"], design).fit(cov_type="HC3", use_t=True)
    for name in ("occluders", "mass", "distractors"):
        assert both.loc[name, "b"] == pytest.approx(fit.params[name])
        assert both.loc[name, "se"] == pytest.approx(fit.bse[name])
    assert both.loc["shape", "b"].tolist() == pytest.approx(
        fit.params[["shape_cube", "shape_pipe"]].tolist()
    )


def test_attributes_that_say_too_much_are_refused_with_a_reason() -> None:
    stimuli = stimuli_table(0, 0.0).assign(name=[f"n{k}" for k in range(120)])
    table = regress_attributes(stimuli, ["name"])
    assert table["b"].isna().all() and table["reason"].eq("too few stimuli for it").all()
    flat = regress_attributes(stimuli.assign(accuracy=0.5), ["occluders"])
    assert flat["reason"].eq("accuracy does not vary").all()
    assert regress_attributes(stimuli, []).empty


def stimuli_table(seed: int, effect: float) -> pd.DataFrame:
    generator = np.random.default_rng(seed)
    scenario = np.repeat(["drop", "roll", "link"], [60, 40, 20])
    occluders = generator.integers(0, 3, 120).astype(float)
    accuracy = 0.7 + 0.1 * (scenario == "roll") + effect * occluders
    accuracy += generator.normal(0, 0.05 * (1 + occluders))
    return pd.DataFrame(
        {"stimulus": [f"s{k}" for k in range(120)], "scenario": scenario, "accuracy": accuracy,
         "occluders": occluders, "distractors": generator.integers(0, 2, 120).astype(float),
         "elements": np.nan, "mean_log_rt": 7 - accuracy + generator.normal(0, 0.1, 120)}
    )  # fmt: skip


def test_slopes_and_robust_errors_match_statsmodels() -> None:
    stimuli = stimuli_table(0, -0.05)
    found = regress_hypotheses(stimuli).set_index(["hypothesis", "scenario"])
    dummies = pd.get_dummies(stimuli["scenario"], dtype=float)
    for rows, name in ((stimuli, "all"), (stimuli[stimuli["scenario"] == "drop"], "drop")):
        for key in ("H2", "H3", "H4"):
            hypothesis = HYPOTHESES[key]
            design = pd.concat([rows[hypothesis.predictor], dummies.loc[rows.index]], axis=1)
            design = design.loc[:, (design != 0).any()]
            fit = sm.OLS(rows[hypothesis.outcome], design).fit(cov_type="HC3", use_t=True)
            row = found.loc[(key, name)]
            assert (row["b"], row["se"], row["p"]) == pytest.approx(
                (fit.params.iloc[0], fit.bse.iloc[0], fit.pvalues.iloc[0]), rel=1e-6
            )
            assert row["df"] == fit.df_resid
            assert (row["low"], row["high"]) == pytest.approx(fit.conf_int().iloc[0].tolist())
    for effect, verdict in ((-0.05, "yes"), (0.05, "opposite"), (0.0, "not shown")):
        verdicts = regress_hypotheses(stimuli_table(0, effect)).set_index("hypothesis")
        assert verdicts.loc["H3", "as_predicted"].iloc[-1] == verdict
    assert found.loc[("H4", "all"), "p"] < 1e-6
    left_out = {"drop": 60, "roll": 40, "link": 20, "all": 120}
    assert found.loc["H1", "left_out"].to_dict() == left_out
    assert found.loc["H1", "reason"].str.contains("not known").all()


def test_confounded_and_constant_attributes_say_so() -> None:
    stimuli = stimuli_table(1, 0.0)
    together = regress_hypotheses(stimuli.assign(distractors=stimuli["occluders"]))
    chosen = together["hypothesis"].isin(["H2", "H3"])
    assert together.loc[chosen, "reason"].str.contains("cannot be distinguished").all()
    constant = regress_hypotheses(stimuli.assign(occluders=1.0)).set_index("hypothesis")
    assert constant.loc["H3", "reason"].str.contains("does not vary").all()
    silent = regress_hypotheses(stimuli.drop(columns="mean_log_rt")).set_index("hypothesis")
    assert silent.loc["H4", "reason"].eq("no column mean_log_rt").all()


def test_single_answers_are_laid_out_for_the_mixed_models(made: Responses) -> None:
    by_stimulus = accuracy_by_stimulus(made.test, FEW)
    generator = np.random.default_rng(0)
    attributes = by_stimulus[["stimulus", "scenario"]].assign(
        elements=generator.integers(1, 5, len(by_stimulus)), distractors=0, occluders=1
    )
    rows = answer_rows(made.test, with_attributes(by_stimulus, attributes_from_table(attributes)))
    assert len(rows) == len(made.test) and rows.notna().all(axis=None)
    for hypothesis in HYPOTHESES.values():
        named = set(hypothesis.formula.replace("(1|", "").replace(")", "").split())
        assert named - {"~", "+"} <= set(rows.columns)


def test_dropping_rows_leaves_other_stimuli_as_they_were(made: Responses) -> None:
    whole = accuracy_by_stimulus(made.test, FEW).set_index("stimulus")
    part = replace(made, trials=made.trials[made.trials["stimulus"] != "roll_003"])
    fewer = accuracy_by_stimulus(part.test, FEW).set_index("stimulus")
    pd.testing.assert_frame_equal(fewer, whole.drop("roll_003"))


# --- items --------------------------------------------------------------------------------


def test_item_rest_is_the_correlation_with_the_other_answers() -> None:
    test = study(people=15, stimuli=12, scenarios=("drop",), seed=4).test
    test = test.drop(index=test.index[[3, 40]])
    table = item_statistics(test).set_index("stimulus")
    wide = test.pivot(index="session", columns="stimulus", values="correct").astype(float)
    for name in wide.columns:
        own = wide[name].dropna()
        rest = wide.drop(columns=name).mean(axis=1).loc[own.index]
        row = table.loc[name]
        assert row["difficulty"] == pytest.approx(own.mean()) and row["people"] == len(own)
        if own.nunique() > 1:
            assert row["item_rest"] == pytest.approx(np.corrcoef(own, rest)[0, 1])
        else:
            assert np.isnan(row["item_rest"]) and "all answers" in row["reason"]
