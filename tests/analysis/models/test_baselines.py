"""Baselines: closed forms, the official people, and that models and baselines stay apart."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
from sklearn.metrics import cohen_kappa_score

from physion.analysis.compare import compare_everywhere
from physion.analysis.comparison import SETTING, Comparison, compare_scores
from physion.analysis.intervals import Bootstrap
from physion.analysis.metrics import metrics
from physion.analysis.sample import sample_of_rows
from physion.analysis.scores import (
    BASELINE_MODELS,
    COMPUTED,
    MAJORITY,
    OUTCOME,
    TWO_PEOPLE,
    baseline_stimuli,
    kind_of,
)
from physion.analysis.tables import MEAN, POOLED, read_humans, read_labels
from support.simulated_people import study

Array = npt.NDArray[np.float64]
QUICK = Bootstrap(resamples=200)
STEMS = {"collide": "pilot_it2_collision_simple_box", "drop": "pilot_it2_drop_simple_box"}
NAMES = [(scenario, f"{stem}_{i:04d}") for scenario, stem in STEMS.items() for i in range(12)]
LABELS = {name: k % 2 == 0 for k, (_, name) in enumerate(NAMES)}


def humans(accuracy: npt.ArrayLike | None = None, count: float = 20.0) -> pd.DataFrame:
    drawn = np.random.default_rng(0).integers(5, 20, len(NAMES)) / 20
    table = pd.DataFrame(NAMES, columns=["scenario", "stimulus"])
    return table.assign(accuracy=drawn if accuracy is None else accuracy, count=count)


def predictions(model: str = "m", seed: int = 1, **columns: object) -> pd.DataFrame:
    p = np.random.default_rng(seed).random(len(NAMES))
    table = {
        "Model": model,
        "Readout Type": "C",
        "Predicted Prob_true": p,
        "Predicted Outcome": p > 0.5,
        "Actual Outcome": list(LABELS.values()),
        "Stimulus Name": list(LABELS),
        **columns,
    }
    return pd.DataFrame(table)


def compared(given: pd.DataFrame | None = None, people: pd.DataFrame | None = None) -> Comparison:
    given = predictions() if given is None else given
    return compare_scores(given, humans() if people is None else people, LABELS, bootstrap=QUICK)


def row_of(table: pd.DataFrame, model: str, scenario: str = MEAN) -> pd.Series:
    (row,) = table[(table["model"] == model) & (table["scenario"] == scenario)].iloc
    return row


# --- closed forms --------------------------------------------------------------------------------


def test_the_outcome_is_right_and_its_kappa_matches_the_table_of_answers() -> None:
    people, truth = humans(), np.array(list(LABELS.values()), dtype=float)
    row = row_of(compared().baselines, OUTCOME, POOLED)
    right = people["accuracy"].to_numpy()
    p_yes = np.where(truth == 1, right, 1 - right)
    assert row["accuracy"] == 1 and row["human_accuracy"] == pytest.approx(right.mean())
    assert row["r"] == pytest.approx(np.corrcoef(truth, p_yes)[0, 1])
    rows = baseline_stimuli(compared().stimuli)
    np.testing.assert_allclose(rows.loc[rows["model"] == OUTCOME, "gap"], truth - p_yes)
    # As single answers of 20 people to each stimulus, and the outcome 20 times.
    said = np.concatenate([np.arange(20) < round(20 * p) for p in p_yes])
    expected = cohen_kappa_score(np.repeat(truth == 1, 20), said)
    assert row["kappa_from_averages"] == pytest.approx(expected)


def test_the_outcome_has_no_r_beyond_itself_and_says_why() -> None:
    table = compared().baselines
    row = row_of(table, OUTCOME, "collide")
    assert np.isnan(row["r_beyond_outcome"]) and np.isnan(row["r_beyond_outcome_low"])
    assert "P(contact) is constant given the outcome" in row["reason"]
    assert "r beyond the outcome: undefined in collide, drop" in row_of(table, OUTCOME)["reason"]
    assert row_of(table, OUTCOME)["kappa_within_outcomes"] == pytest.approx(0, abs=1e-12)


def test_the_majority_is_right_and_agrees_as_its_answers_do() -> None:
    people, truth = humans(), np.array(list(LABELS.values()))
    p_yes = np.where(truth, people["accuracy"], 1 - people["accuracy"])
    row = row_of(compared().baselines, MAJORITY, POOLED)
    assert row["accuracy"] == pytest.approx(np.mean((p_yes > 0.5) == truth))
    best = np.maximum(p_yes, 1 - p_yes).mean()
    said, yes = (p_yes > 0.5).mean(), p_yes.mean()
    chance = said * yes + (1 - said) * (1 - yes)
    assert row["kappa_from_averages"] == pytest.approx((best - chance) / (1 - chance))


def test_two_people_agree_as_all_pairs_of_them_do() -> None:
    people, truth = humans(count=20), np.array(list(LABELS.values()))
    p_yes = np.where(truth, people["accuracy"], 1 - people["accuracy"])
    row = row_of(compared().baselines, TWO_PEOPLE, POOLED)
    agreeing = []
    for p in p_yes:
        answers = np.arange(20) < round(20 * p)
        pairs = [answers[i] == answers[j] for i in range(20) for j in range(i)]
        agreeing.append(np.mean(pairs))
    chance = p_yes.mean() ** 2 + (1 - p_yes.mean()) ** 2
    expected = (np.mean(agreeing) - chance) / (1 - chance)
    assert row["kappa_from_averages"] == pytest.approx(expected)
    human = people["accuracy"].mean()
    assert row["accuracy"] == pytest.approx(human)
    assert row["kappa_beyond_outcome"] == pytest.approx(expected - (2 * human - 1) ** 2)
    assert row[["rmsd", "r_beyond_outcome", "difference"]].isna().all()
    low, high = row[["kappa_from_averages_low", "kappa_from_averages_high"]]
    assert low < expected < high


def test_r_of_one_person_is_that_with_the_average_of_the_others() -> None:
    rng = np.random.default_rng(0)
    count, stimuli = 12, 3000
    yes = (rng.random((count, stimuli)) < rng.beta(2, 1.5, stimuli)).astype(float)
    # Other people at each stimulus: nobody has an own fraction of yes.
    yes = rng.permuted(yes, axis=0)
    p_yes = yes.mean(axis=0)
    rows = pd.DataFrame({"p_contact": 0.5, "predicted": True, "label": True, "simulated": True,
                         "p_yes": p_yes, "human_accuracy": p_yes, "count": count})  # fmt: skip
    found = metrics.get("r").of_two_people(sample_of_rows(rows, np.ones((1, stimuli))))[0, 0]
    others = (yes.sum(axis=0) - yes) / (count - 1)
    each = [np.corrcoef(one, rest)[0, 1] for one, rest in zip(yes, others, strict=True)]
    assert found == pytest.approx(np.mean(each), abs=0.003)
    # An average that contains the person would count the noise of their answers twice.
    included = [np.corrcoef(one, p_yes)[0, 1] for one in yes]
    assert np.mean(included) > found + 0.03
    row = row_of(compared().baselines, TWO_PEOPLE, POOLED)
    assert row["r_low"] < row["r"] < row["r_high"]
    assert row["r_same"] == row["r"] and "same outcome" not in row["reason"]


def test_people_who_all_agree_have_an_r_of_one() -> None:
    row = row_of(compared(people=humans(np.ones(24))).baselines, TWO_PEOPLE, POOLED)
    assert row["r"] == pytest.approx(1)


def test_one_person_makes_no_pair() -> None:
    people = humans(np.arange(24) % 3 / 2, count=1)
    row = row_of(compared(people=people).baselines, TWO_PEOPLE)
    assert row[["kappa_from_averages", "r"]].isna().all() and np.isfinite(row["accuracy"])
    assert "kappa: undefined in collide, drop" in row["reason"]


# --- beyond the outcome --------------------------------------------------------------------------


def test_people_themselves_are_wholly_beyond_the_outcome() -> None:
    people, truth = humans(), np.array(list(LABELS.values()))
    p_yes = np.where(truth, people["accuracy"], 1 - people["accuracy"])
    given = predictions(**{"Predicted Prob_true": p_yes, "Predicted Outcome": p_yes > 0.5})
    row = row_of(compared(given).scores, "m · observed")
    assert row["r_beyond_outcome"] == pytest.approx(1)
    assert row["kappa_beyond_outcome"] > 0.1 and row["kappa_within_outcomes"] > 0.1


def test_partial_r_matches_the_textbook() -> None:
    people, truth = humans(), np.array(list(LABELS.values()), dtype=float)
    given = predictions()
    row = row_of(compared(given).scores, "m · observed", POOLED)
    x = given["Predicted Prob_true"].to_numpy()
    y = np.where(truth == 1, people["accuracy"], 1 - people["accuracy"])
    r = np.corrcoef([x, y, truth])
    expected = (r[0, 1] - r[0, 2] * r[1, 2]) / np.sqrt((1 - r[0, 2] ** 2) * (1 - r[1, 2] ** 2))
    assert row["r_beyond_outcome"] == pytest.approx(expected)
    assert row["r_beyond_outcome_low"] < expected < row["r_beyond_outcome_high"]


def test_of_a_single_outcome_partial_r_is_r() -> None:
    always = dict.fromkeys(LABELS, True)
    given = predictions(**{"Actual Outcome": True})
    scores = compare_scores(given, humans(), always, bootstrap=QUICK).scores
    row = row_of(scores, "m · observed", "drop")
    assert row["r_beyond_outcome"] == pytest.approx(row["r"])


# --- models and baselines ------------------------------------------------------------------------


def test_baselines_that_come_as_predictions_are_marked_and_follow_the_models() -> None:
    given = pd.concat([predictions("state-trees", 2), predictions("m"), predictions("z", 3)])
    found = compared(given)
    assert found.names[0] == "state-trees · observed"
    assert found.models == ["m · observed", "z · observed"]
    order = list(dict.fromkeys(found.all_scores["model"]))
    assert order == [*found.models, "state-trees · observed", *COMPUTED]
    kinds = found.all_scores.drop_duplicates("model").set_index("model")["kind"]
    assert set(kinds[found.models]) == {"model"}
    assert set(kinds[["state-trees · observed", *COMPUTED]]) == {"baseline"}
    assert kind_of("my outcome · observed") == "model"


def test_every_baseline_of_the_package_is_known_by_name() -> None:
    """The analysis may not import the models, so it has their names a second time."""
    source = Path(__file__).parents[3] / "src" / "physion" / "models" / "build.py"
    found = re.findall(r'"([\w-]+)": "physion\.models\.baselines\.', source.read_text())
    packaged = set(found)
    assert {"chance", "constant-motion"} <= packaged <= BASELINE_MODELS


def test_baselines_are_about_the_stimuli_that_any_model_predicts() -> None:
    half = predictions().iloc[:12]
    other = predictions("other", 2).iloc[6:18]
    found = compared(pd.concat([half, other]))
    assert row_of(found.baselines, OUTCOME, POOLED)["stimuli"] == 18
    alone = compared(half)
    assert row_of(alone.baselines, OUTCOME, POOLED)["stimuli"] == 12


def test_without_people_there_is_no_baseline() -> None:
    found = compare_scores(predictions(), None, LABELS, bootstrap=QUICK)
    assert found.baselines.empty and list(found.baselines.columns) == list(found.scores.columns)
    assert list(found.all_scores["model"].unique()) == ["m · observed"]


# --- contacts in the observed part ---------------------------------------------------------------


def observed() -> Array:
    return np.array([k % 6 == 0 for k in range(len(NAMES))])


def test_scores_without_observed_contacts_match_the_other_stimuli() -> None:
    given = predictions(**{"Observed Contact": observed()})
    found = compared(given)
    rest = compare_scores(
        predictions()[~observed()], humans()[~observed()], LABELS, bootstrap=QUICK
    )
    expected = pd.concat([rest.scores, rest.baselines], ignore_index=True)
    pd.testing.assert_frame_equal(found.later, expected)
    assert found.settings[SETTING] == "4 of 24 stimuli (collide 2 of 12, drop 2 of 12)"


@pytest.mark.slow
def test_one_model_that_knows_the_observed_contacts_suffices() -> None:
    knows = predictions(**{"Observed Contact": observed()})
    found = compared(pd.concat([predictions("other", 2), knows]))
    assert set(found.later["model"]) == {"m · observed", "other · observed", *COMPUTED}
    more = np.arange(len(NAMES)) % 4 == 0
    odd = predictions("other", 2, **{"Observed Contact": more})
    later = compared(pd.concat([knows, odd])).later
    kept = (~observed() & ~more).sum()
    assert row_of(later, "m · observed", POOLED)["stimuli"] == kept


def test_stimuli_without_a_known_observed_contact_are_left_out_and_counted() -> None:
    words = np.where(observed(), "True", "False").astype(object)
    words[[1, 2]] = ""
    found = compared(predictions(**{"Observed Contact": words}))
    assert row_of(found.later, "m · observed", POOLED)["stimuli"] == 18
    assert "not known for 2 more" in found.settings[SETTING]


def test_where_observed_contacts_are_not_known_the_settings_say_so() -> None:
    found = compared()
    assert found.later.empty and "no values of observed_contact" in found.settings[SETTING]
    everything = compared(predictions(**{"Observed Contact": True}))
    assert everything.later.empty and "none is left" in everything.settings[SETTING]


# --- single participants -----------------------------------------------------


def test_with_participants_baselines_stand_next_to_models() -> None:
    test = study(people=8, stimuli=16, scenarios=("collide", "roll"), seed=2).test
    stimuli = test.drop_duplicates("stimulus")["stimulus"]
    p = np.random.default_rng(0).random(len(stimuli))
    given = pd.DataFrame({"model": "m", "stimulus": stimuli, "p_contact": p, "predicted": p > 0.5})
    found = compare_everywhere(given, test, QUICK)
    scores = found.scores.set_index(["scenario", "model", "measure"])
    assert list(found.scores["model"].unique()) == ["m", *COMPUTED]
    kinds = found.scores.drop_duplicates("model").set_index("model")["kind"]
    assert kinds.to_dict() == {"m": "model"} | dict.fromkeys(COMPUTED, "baseline")
    zones = found.zones.set_index(["scenario", "measure", "of"])
    row = scores.loc[("collide", TWO_PEOPLE, "kappa")]
    assert row["value"] == pytest.approx(zones.loc[("collide", "kappa", "pairs"), "mean"])
    for what in ("people", "stimuli", "both"):
        assert row[f"low_{what}"] < row["value"] < row[f"high_{what}"]
    right = test[test["scenario"] == "roll"]["correct"].mean()
    assert scores.loc[("roll", TWO_PEOPLE, "accuracy"), "value"] == pytest.approx(right)
    assert scores.loc[("mean", OUTCOME, "accuracy"), "value"] == 1
    best = scores.xs("kappa", level="measure").loc["mean", "value"]
    assert best.idxmax() == MAJORITY
    assert found.pairs.empty  # they are about what was predicted


# --- official data -------------------------------------------------------------------------------


@pytest.mark.slow
def test_baselines_of_the_official_people(official: Path) -> None:
    people = read_humans(official / "humans")
    labels = read_labels(official / "stimuli" / "stimulus_names_and_labels.csv")
    truth = people["stimulus"].map(labels).astype(bool)
    given = pd.DataFrame(
        {"Model": "m", "Readout Type": "C", "Predicted Prob_true": 0.5, "Predicted Outcome": False,
         "Actual Outcome": truth, "Stimulus Name": people["stimulus"]}
    )  # fmt: skip
    baselines = compare_scores(given, people, labels, bootstrap=QUICK).baselines
    two = row_of(baselines, TWO_PEOPLE)
    assert two["accuracy"] == pytest.approx(0.745, abs=0.0005)
    assert two["r"] == pytest.approx(0.69, abs=0.03)
    outcome = row_of(baselines, OUTCOME)
    assert outcome["kappa_from_averages"] == pytest.approx(0.49, abs=0.005)
    assert row_of(baselines, OUTCOME, POOLED)["r"] == pytest.approx(0.683, abs=0.0005)
    majority = row_of(baselines, MAJORITY)
    # .808 where the two stimuli with as many yes as no count as yes; here they count as no.
    assert majority["accuracy"] == pytest.approx(0.808, abs=0.002)
    assert majority["kappa_from_averages"] == pytest.approx(0.64, abs=0.006)
    # The released kappas are medians over pairs of the participants that passed the stricter
    # exclusion, with each one's own fraction of yes: about .02 higher than from the averages.
    released = pd.read_csv(official / "results" / "human_pairwiseCohensKs_by_scenario.csv")
    assert released["corr_med"].mean() == pytest.approx(0.50, abs=0.005)
    assert two["kappa_from_averages"] == pytest.approx(released["corr_med"].mean(), abs=0.02)
    names = {"clothiness": "drape", "collision": "collide", "containment": "contain",
             "linking": "link", "rollingsliding": "roll", "towers": "support"}  # fmt: skip
    medians = released.set_index(released["scenario"].replace(names))["corr_med"]
    for scenario, median in medians.items():
        row = row_of(baselines, TWO_PEOPLE, str(scenario))
        assert row["kappa_from_averages"] == pytest.approx(median, abs=0.03)
    accuracy = pd.read_csv(official / "results" / "human_accuracy_by_scenario.csv")
    for name, mean in zip(accuracy["scenario"], accuracy["obs_mean"], strict=True):
        row = row_of(baselines, TWO_PEOPLE, names.get(name, name))
        assert row["accuracy"] == pytest.approx(mean, abs=0.005)
