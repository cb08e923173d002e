"""Models next to single people: against plain loops and scikit-learn."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
from sklearn.metrics import cohen_kappa_score

from physion.analysis.compare import PeopleComparison, all_results, compare_everywhere, tidy_scores
from physion.analysis.intervals import Bootstrap, Variance, degrees_of_freedom
from physion.analysis.metrics import measure_metrics, metrics
from physion.analysis.people.effects import difficulty_third, r_by_third
from physion.analysis.people.measures import ScenarioAnswers, answers_of, split_halves
from physion.analysis.people.results import analyse_people
from physion.analysis.sample import Resampled
from physion.analysis.scores import (
    MAJORITY,
    OUTCOME,
    TWO_PEOPLE,
    against_people,
    runs_table,
    shown_average,
)
from physion.analysis.statistics import agreement
from physion.analysis.statistics.agreement import correctness
from physion.analysis.tables import MEAN, POOLED
from physion.analysis.with_participants import (
    RELEASED_R,
    Models,
    human_zones,
    measure_models,
    measure_table,
    model_pairs,
    models_of,
    released_r_zone,
    released_zone,
    sample_of_models,
    sampling_variances,
)
from physion.core.errors import BadInputError
from support.simulated_people import study

Array = npt.NDArray[np.float64]
FEW = Bootstrap(resamples=50)
MEASURES = [metric.name for metric in measure_metrics()]


@pytest.fixture(scope="module")
def answers() -> ScenarioAnswers:
    test = study(people=12, stimuli=25, scenarios=("collide",), seed=1).test
    return answers_of(test.drop(index=test.index[[5, 60, 61]]), "collide")


@pytest.fixture(scope="module")
def models(answers: ScenarioAnswers) -> Models:
    generator = np.random.default_rng(0)
    p = np.vstack([answers.p_yes(), generator.random(25), np.full(25, 0.8), generator.random(25)])
    p[3, [0, 7]] = np.nan
    predicted = np.where(np.isnan(p), np.nan, p > 0.5)
    return Models(("people", "chance", "always", "gaps"), p, predicted)


def measures(models: Models, answers: ScenarioAnswers) -> pd.DataFrame:
    return measure_table(measure_models(models, answers, bootstrap=FEW))


def plain(
    k: int, models: Models, answers: ScenarioAnswers, people: npt.ArrayLike, stimuli: npt.ArrayLike
) -> dict[str, float]:
    """Every measure of model ``k`` by definition, on people and stimuli drawn by their numbers."""
    who, what = np.asarray(people), np.asarray(stimuli)
    yes, correct = answers.yes[np.ix_(who, what)], answers.correct[np.ix_(who, what)]
    p, said, label = models.p_contact[k, what], models.predicted[k, what], answers.label[what]
    with np.errstate(invalid="ignore"):
        share, right = np.nanmean(yes, axis=0), np.nanmean(correct, axis=0)
    known = np.isfinite(p)
    p, said, label = p[known], said[known], label[known]
    yes, correct, share, right = yes[:, known], correct[:, known], share[known], right[known]

    def kappa(a: Array, b: Array) -> float:
        both = np.isfinite(a) & np.isfinite(b)
        if len({*a[both], *b[both]}) < 2:
            return float("nan")
        return float(cohen_kappa_score(a[both], b[both]))

    mean = float(np.nanmean([kappa(row, said) for row in yes]))
    among = [kappa(yes[i], yes[j]) for i in range(len(who)) for j in range(i)
             if who[i] != who[j]]  # fmt: skip
    agreeing = np.mean(np.where(said == 1, share, 1 - share))
    by_chance = said.mean() * share.mean() + (1 - said.mean()) * (1 - share.mean())
    average = float((agreeing - by_chance) / (1 - by_chance))
    skill = (2 * np.mean(said == label) - 1) * (2 * np.mean(right) - 1)
    x, y, z = (v - np.where(label == 1, v[label == 1].mean(), v[label == 0].mean())
               for v in (p, share, said))  # fmt: skip
    return {
        "kappa_from_averages": average,
        "kappa_beyond_outcome": float(average - skill),
        "kappa_within_outcomes": float(2 * np.mean(z * y) / (1 - by_chance)),
        "r_beyond_outcome": agreement.pearson(x, y),
        "accuracy": float(np.mean(said == label)),
        "difference": float(np.mean(said == label) - np.mean(right)),
        "r": agreement.pearson(p, share),
        "rmsd": np.sqrt(np.mean((p - share) ** 2)),
        "euclid_over_n": float(np.sqrt(np.sum((p - share) ** 2)) / len(p)),
        "kappa": mean,
        "kappa_gap": mean - float(np.nanmean(among)),
        "error_consistency": float(
            np.nanmean([kappa(row, (said == label).astype(float)) for row in correct])
        ),
    }


@pytest.mark.filterwarnings("ignore:Mean of empty slice")
def test_every_measure_is_what_it_says(models: Models, answers: ScenarioAnswers) -> None:
    table = measures(models, answers)
    assert len(table) == 4 * len(MEASURES)
    for k, name in enumerate(models.names):
        expected = plain(k, models, answers, range(12), range(25))
        if name == "gaps":  # kappa among people is of all stimuli, of which it lacks some
            expected["kappa_gap"] = float("nan")
        found = table[table["model"] == name].set_index("measure")
        for measure, value in expected.items():
            assert found.loc[measure, "value"] == pytest.approx(value, abs=1e-9, nan_ok=True)
        assert (found["stimuli"] == (23 if name == "gaps" else 25)).all()
    undefined = table[table["value"].isna()]
    lacking = undefined["measure"] == "kappa_gap"
    assert set(undefined["model"][lacking]) == {"gaps"}
    assert undefined["reason"][lacking].str.contains("lacks some").all()
    undefined = undefined[~lacking]
    assert set(undefined["model"]) == {"always"} and set(undefined["measure"]) == {
        "r", "r_beyond_outcome",
    }  # fmt: skip
    assert undefined["reason"].str.contains("P\\(contact\\) is constant").all()


@pytest.mark.nightly
@pytest.mark.slow
def test_intervals_match_leaving_out_people_or_stimuli(
    models: Models, answers: ScenarioAnswers
) -> None:
    table = measures(models, answers).set_index(["model", "measure"])
    people, stimuli = range(12), range(25)
    whole = plain(1, models, answers, people, stimuli)
    for what, n in (("people", 12), ("stimuli", 25)):
        without = [
            plain(1, models, answers, [i for i in people if what != "people" or i != k],
                  [s for s in stimuli if what != "stimuli" or s != k])
            for k in range(n)
        ]  # fmt: skip
        for measure in MEASURES:
            row = table.loc[("chance", measure)]
            found = (row[f"low_{what}"], row[f"high_{what}"])
            if measure == "accuracy" and what == "people":
                assert np.isnan(found).all() and "do not enter" in row["reason"]
                continue
            values = np.array([value[measure] for value in without])
            df = np.asarray(n - 1.0)
            if measure != "accuracy":
                df = degrees_of_freedom(values - values.mean(), np.asarray(float(n)))
            variance = Variance(np.asarray((n - 1) * np.var(values)), df)
            expected = variance.interval(whole[measure], 0.95, metrics.get(measure).scale)
            if what == "stimuli":
                assert found == pytest.approx(expected, abs=1e-9), (what, measure)
            else:  # less what is bilinear in two people, which is little for this model
                width = (found[1] - found[0]) / (expected[1] - expected[0])
                assert 0.85 < width <= 1 + 1e-9, (what, measure)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("drawn", ["people", "both"])
def test_a_perfect_model_lies_in_its_interval_as_often_as_it_should(drawn: Resampled) -> None:
    """The noise of people's averages counts once: in the value, not again in the interval."""
    rng = np.random.default_rng(5)
    chosen = {name: metrics.get(name) for name in ("rmsd", "r")}
    rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in chosen}
    true = rng.beta(0.8, 0.8, 60)
    for _ in range(120):
        if drawn == "both":
            true = rng.beta(0.8, 0.8, 60)
        lean = 1 / (1 + np.exp(-0.3 * rng.normal(size=(40, 1)) - np.log(true / (1 - true))))
        yes = (rng.random((40, 60)) < lean).astype(float)
        names = tuple(map(str, range(60)))
        answers = ScenarioAnswers("drop", names[:40], names[:40], names, yes,
                                  np.arange(60) % 2.0, np.full(yes.shape, np.nan))  # fmt: skip
        models = Models(("perfect",), true[None], (true[None] > 0.5).astype(float))
        value = {name: float(metric(sample_of_models(models, answers))[0, 0])
                 for name, metric in chosen.items()}  # fmt: skip
        for name, variance in sampling_variances(models, answers, chosen, drawn).items():
            low, high = variance.of(0).interval(value[name], 0.95, metrics.get(name).scale)
            rows[name].append((value[name], low, high, float(np.sqrt(variance.value[0]))))
    for name, found in rows.items():
        values, low, high, sd = np.array(found).T
        inside = (low < values.mean()) & (values.mean() < high)
        assert 0.88 <= inside.mean() <= 0.995, name
        assert np.mean(sd) == pytest.approx(np.std(values), rel=0.25), name
        assert ((low < values) & (values < high)).all(), name


def test_a_person_as_a_model_stands_in_the_zone_of_people(answers: ScenarioAnswers) -> None:
    zones = human_zones(answers, split_halves(answers.yes, 50)).set_index(["measure", "of"])
    others = np.arange(12) != 4
    rest = ScenarioAnswers(answers.scenario, answers.sessions[:11], answers.participants[:11],
                   answers.stimuli, answers.yes[others], answers.label,
                   answers.log_rt[others])  # fmt: skip
    as_model = Models(("person",), answers.yes[4:5], answers.yes[4:5])
    table = measures(as_model, rest).set_index("measure")["value"]
    every = {}
    for k in range(12):
        chosen = np.arange(12) != k
        known = np.isfinite(answers.yes[k])
        share = np.nanmean(answers.yes[chosen], axis=0)
        every[k] = agreement.pearson(answers.yes[k, known], share[known])
    assert table["r"] == pytest.approx(every[4])
    expected = np.percentile(list(every.values()), [2.5, 50, 97.5])
    found = zones.loc[("r", "participants"), ["low", "median", "high"]]
    np.testing.assert_allclose(found.to_numpy(dtype=float), expected)
    assert zones.loc[("accuracy", "participants"), "mean"] == pytest.approx(
        np.mean(np.nanmean(answers.correct, axis=1))
    )
    assert zones.loc[("kappa", "pairs"), "values"] == 66
    assert zones.loc[("kappa", "pairs"), "mean"] == pytest.approx(
        zones.loc[("kappa", "participants"), "mean"]
    )
    # Halves are averages of several people, so they agree better than one person with the rest.
    assert zones.loc[("r", "halves"), "low"] > zones.loc[("r", "participants"), "median"]


def test_the_released_zone_is_another_thing(official: Path) -> None:
    """The grey band over eight scenario means is far narrower than that of participants."""
    table = pd.read_csv(official / "results" / "human_accuracy_by_scenario.csv")
    mean, low, high = released_zone(table["obs_mean"])
    assert mean == pytest.approx(table["obs_mean"].mean()) and low < mean < high
    assert high - low < 0.6 * float(np.mean(table["pct_97.5"] - table["pct_2.5"]))
    with pytest.raises(BadInputError, match="defined"):
        released_zone([0.7, np.nan])


def test_the_band_of_r_is_undefined_where_a_scenario_has_none(answers: ScenarioAnswers) -> None:
    one = human_zones(answers, split_halves(answers.yes, 50))
    other = human_zones(answers, np.full(50, np.nan))
    assert released_r_zone(pd.concat([one, one]))["low"].notna().all()
    band = released_r_zone(pd.concat([one, other])).iloc[0]
    assert np.isnan([band["low"], band["high"]]).all() and band["undefined"] == 1


# --- tables in, models out ----------------------------------------------------------------------


def test_tables_become_models_and_what_has_no_counterpart_is_counted(
    answers: ScenarioAnswers,
) -> None:
    rows = pd.DataFrame(
        [(model, stimulus, 0.7, True) for model in ("b", "a") for stimulus in answers.stimuli],
        columns=["model", "stimulus", "p_contact", "predicted"],
    )
    rows.loc[0, "stimulus"] = "somewhere else"
    models, dropped = models_of(rows, answers)
    assert models.names == ("b", "a") and np.isnan(models.p_contact).sum() == 1
    assert dropped.to_numpy().tolist() == [
        ["b", "people did not see it", 1],
        ["b", "the model does not predict it", 1],
    ]
    with pytest.raises(BadInputError, match="twice"):
        models_of(pd.concat([rows, rows.iloc[[3]]]), answers)
    nothing, dropped = models_of(rows.assign(stimulus=rows.index.astype(str)), answers)
    table = measures(nothing, answers)
    assert table["value"].isna().all() and table["reason"].str.contains("predicts none").all()
    assert dropped["stimuli"].sum() == 100


@pytest.mark.parametrize(
    ("p", "predicted", "names", "words"),
    [
        ([[1.2, 0.1]], [[1, 0]], ("a",), "does not lie in"),
        ([[0.2, 0.1]], [[0.5, 0]], ("a",), "0, 1 or NaN"),
        ([[0.2, np.nan]], [[0, 0]], ("a",), "both"),
        ([[0.2, 0.1]], [[0, 0]], ("a", "b"), "one name"),
        ([[0.2, 0.1]] * 2, [[0, 0]] * 2, ("a", "a"), "one name"),
        ([[0.2, 0.1]], [[0]], ("a",), "shape"),
    ],
)
def test_models_that_are_none_are_refused(
    p: list[list[float]], predicted: list[list[float]], names: tuple[str, ...], words: str
) -> None:
    with pytest.raises(BadInputError, match=words):
        Models(names, np.array(p), np.array(predicted, dtype=float))


def test_models_among_themselves(models: Models, answers: ScenarioAnswers) -> None:
    found = model_pairs(models, answers).set_index(["first", "second"])
    assert len(found) == 6
    row = found.loc[("people", "chance")]
    assert row["kappa"] == pytest.approx(cohen_kappa_score(*models.predicted[:2]))
    right = correctness(models.predicted, answers.label)
    assert row["error_consistency"] == pytest.approx(cohen_kappa_score(*right[:2]))
    assert found.loc[("chance", "gaps"), "stimuli"] == 23


# --- every scenario -----------------------------------------------------------------------------


def everywhere(**changes: object) -> tuple[PeopleComparison, pd.DataFrame, pd.DataFrame]:
    test = study(people=10, stimuli=20, scenarios=("collide", "roll"), seed=8).test
    shares = test.groupby(["scenario", "stimulus"])["yes"].mean().reset_index()
    generator = np.random.default_rng(0)
    parts = [
        pd.DataFrame({"model": model, "stimulus": shares["stimulus"], "p_contact": p,
                      "predicted": p > 0.5})
        for model, p in (("people", shares["yes"]), ("chance", generator.random(len(shares))))
    ]  # fmt: skip
    predictions = pd.concat(parts, ignore_index=True).assign(**changes)
    return compare_everywhere(predictions, test, FEW), predictions, test


def test_all_scenarios_and_their_mean() -> None:
    found, predictions, test = everywhere()
    scores = found.scores.set_index(["model", "scenario", "measure"])
    for model in ("people", "chance"):
        for measure in MEASURES:
            values = scores.loc[(model, ["collide", "roll"], measure), "value"]
            assert scores.loc[(model, "mean", measure), "value"] == pytest.approx(values.mean())
    answers = answers_of(test, "roll")
    models, _ = models_of(predictions, answers)
    alone = measures(models, answers).set_index(["model", "measure"])
    here = scores.xs("roll", level="scenario").loc[alone.index]
    pd.testing.assert_frame_equal(here[alone.columns.drop("scenario")],
                                  alone.drop(columns="scenario"))  # fmt: skip
    chance = scores.loc[("chance", "mean", "r")]
    wide = scores.loc[("chance", "roll", "r")]
    assert chance["low_both"] < chance["value"] < chance["high_both"]
    assert (
        chance["high_stimuli"] - chance["low_stimuli"] < wide["high_stimuli"] - wide["low_stimuli"]
    )
    row = scores.loc[("people", "collide", "accuracy")]
    assert row["in_zone"] == (
        "yes" if row["zone_low"] <= row["value"] <= row["zone_high"] else "no"
    )
    assert scores.loc[("people", "mean", "accuracy"), "in_zone"] == ""
    assert found.dropped.empty and len(found.pairs) == 2
    halves = found.zones[found.zones["of"] == "halves"]
    (band,) = found.zones[found.zones["of"] == RELEASED_R].to_dict("records")
    assert (band["scenario"], band["measure"], band["values"]) == ("mean", "r", 2)
    for edge in ("low", "high"):
        assert band[edge] == pytest.approx(np.mean(halves[edge]))
    again, _, _ = everywhere()
    pd.testing.assert_frame_equal(found.scores, again.scores)


def test_the_preregistered_bootstrap_draws_participants(
    answers: ScenarioAnswers, models: Models
) -> None:
    draws = Bootstrap(resamples=300, seed=4)
    rows = measure_table(measure_models(models, answers, "", draws)).set_index(["model", "measure"])
    weights = draws.weights(f"people of {answers.scenario}", len(answers.sessions))
    values: dict[str, list[float]] = {"r": [], "rmsd": [], "difference": []}
    predicted, p = models.predicted[1], models.p_contact[1]
    for drawn in weights.astype(int):
        yes = np.repeat(answers.yes, drawn, axis=0)
        mean = np.nanmean(yes, axis=0)
        right = np.where(answers.label == 1, mean, 1 - mean)
        values["r"].append(np.corrcoef(p, mean)[0, 1])
        values["rmsd"].append(np.sqrt(np.mean((p - mean) ** 2)))
        values["difference"].append(np.mean(predicted == answers.label) - right.mean())
    for measure, of_draws in values.items():
        row = rows.loc[("chance", measure)]
        expected = np.percentile(of_draws, [2.5, 97.5])
        assert row[["low_bootstrap", "high_bootstrap"]].tolist() == pytest.approx(expected.tolist())
    assert np.isnan(rows.loc[("chance", "accuracy"), "low_bootstrap"])  # no people enter


def test_reliably_better_or_worse_than_people() -> None:
    people = pd.DataFrame(
        {"scenario": ["drop", "roll", MEAN], "bootstrap_low": [0.6, np.nan, np.nan],
         "bootstrap_high": [0.7, np.nan, np.nan]}
    )  # fmt: skip
    scores = pd.DataFrame(
        {"scenario": ["drop", "drop", "drop", "roll", "drop", "drop"],
         "readout": [*["observed"] * 5, "full"],
         "accuracy": [0.55, 0.6, 0.8, 0.9, np.nan, 0.8],
         "difference_low": [-0.2, -0.1, 0.01, 0.1, np.nan, np.nan],
         "difference_high": [-0.01, 0.05, 0.2, 0.3, np.nan, np.nan]}
    )  # fmt: skip
    found = against_people(scores, people)
    assert found["reliably"].tolist() == ["worse", "", "better", "better", "", ""]
    assert found["people_interval"].tolist() == ["below", "inside", "above", "", "", ""]


def test_accuracies_over_runs_draw_the_runs() -> None:
    accuracies = {"drop": [0.5, 0.6, 0.9], "roll": [0.7, 0.8, 0.6], MEAN: [0.6, 0.7, 0.75]}
    rows = [(f"svg · {run}", "svg", "model", scenario, values[run])
            for scenario, values in accuracies.items() for run in range(3)]  # fmt: skip
    rows += [("one", "one", "model", "drop", 0.4), ("svg · 0", "svg", "model", POOLED, 0.1)]
    rows += [(name, "chance", "baseline", "drop", 0.5) for name in ("chance", "chance · b")]
    columns = ["model", "base_model", "kind", "scenario", "accuracy"]
    table = runs_table(pd.DataFrame(rows, columns=columns), Bootstrap(resamples=20_000))
    assert table["base_model"].tolist() == ["svg"] * 3, "of a single run nothing can be drawn"
    assert table["scenario"].tolist() == ["drop", "roll", MEAN] and (table["runs"] == 3).all()
    for row in table.itertuples():
        values = np.array(accuracies[str(row.scenario)])
        assert row.accuracy == pytest.approx(values.mean())
        # All 27 draws of three runs.
        means = [values[list(drawn)].mean() for drawn in itertools.product(range(3), repeat=3)]
        expected = np.percentile(np.sort(means), [2.5, 97.5], method="inverted_cdf")
        assert [row.accuracy_low, row.accuracy_high] == pytest.approx(expected.tolist())


def test_what_is_missing_somewhere_is_counted_and_undefined_there() -> None:
    _, predictions, test = everywhere()
    constant = predictions["stimulus"].str.startswith("roll")
    odd = predictions.assign(p_contact=predictions["p_contact"].where(~constant, 0.5))
    odd.loc[0, "stimulus"] = "elsewhere"
    found = compare_everywhere(odd, test, FEW)
    scores = found.scores.set_index(["model", "scenario", "measure"])
    row = scores.loc[("chance", "mean", "r")]
    assert np.isnan(row["value"]) and row["reason"].startswith("undefined in roll")
    assert found.dropped.to_numpy().tolist() == [
        ["people", "unknown", "people did not see it", 1],
        ["people", "collide", "the model does not predict it", 1],
    ]
    no_roll = compare_everywhere(predictions[~constant], test, FEW)
    gone = no_roll.dropped.set_index(["model", "scenario"])["stimuli"]
    assert gone.to_dict() == {("people", "roll"): 20, ("chance", "roll"): 20}


def test_thirds_are_parted_at_their_edges() -> None:
    found = difficulty_third([0.0, 1 / 3, 0.34, 0.66, 2 / 3, 1.0, np.nan]).tolist()
    assert found[:6] == ["hard", "hard", "chance", "chance", "easy", "easy"]
    assert np.isnan(found[6])


def test_r_within_thirds_matches_their_stimuli(answers: ScenarioAnswers, models: Models) -> None:
    table = r_by_third(models.p_contact, answers.yes, answers.label)
    shares = answers.p_yes()
    third = difficulty_third(np.where(answers.label == 1, shares, 1 - shares)).to_numpy()
    for row in table[table["model"] >= 0].itertuples():
        own = (third == row.third) & np.isfinite(models.p_contact[row.model])
        expected = agreement.pearson(models.p_contact[row.model, own], shares[own])
        assert row.r == pytest.approx(expected, abs=1e-9, nan_ok=True)
        assert row.stimuli == (third == row.third).sum()
    assert table["stimuli"].sum() == 25 * 5 and (table["model"] == -1).sum() == 3


# --- one table of everything ----------------------------------------------------------------------


@pytest.mark.slow
def test_the_tidy_table_takes_intervals_about_people_and_stimuli_where_it_has_them() -> None:
    people = analyse_people(study(people=8, stimuli=16, scenarios=("collide", "roll"), seed=2),
                            bootstrap=FEW)  # fmt: skip
    stimuli = people.tables["by_stimulus"]["stimulus"]
    p = np.random.default_rng(0).random(len(stimuli))
    given = pd.DataFrame({"model": "m", "stimulus": stimuli, "p_contact": p})
    results = all_results(given, people=people, bootstrap=FEW)
    table = tidy_scores(results).set_index(["model", "scenario"])
    assert table.index.get_level_values("model").unique().tolist() == [TWO_PEOPLE, "m", OUTCOME,
                                                                       MAJORITY]  # fmt: skip
    assert results.with_people is not None
    measured = results.with_people.scores.set_index(["model", "scenario", "measure"])
    plain = results.comparison.all_scores.set_index(["model", "scenario"])
    for scenario in ("collide", "roll", MEAN):
        row = table.loc[("m", scenario)]
        assert row["interval"] == "people and stimuli"
        for name in ("accuracy", "r", "kappa", "rmsd"):
            one = measured.loc[("m", scenario, name)]
            assert row[[name, f"{name}_low", f"{name}_high"]].tolist() == pytest.approx(
                one[["value", "low_both", "high_both"]].tolist()
            ), (scenario, name)
    shown = people.tables["by_scenario"].set_index("scenario")
    averages = results.comparison.people.set_index("scenario")
    for scenario in ("collide", "roll", MEAN):
        ends = averages.loc[scenario, ["bootstrap_low", "bootstrap_high"]].tolist()
        assert ends == shown.loc[scenario, ["accuracy_low", "accuracy_high"]].tolist()
        row = table.loc[("m", scenario)]
        place = ["below", "inside", "above"][int(row["accuracy"] >= ends[0])
                                             + int(row["accuracy"] > ends[1])]  # fmt: skip
        assert row["people_interval"] == place
        better, worse = row["difference_low"] > 0, row["difference_high"] < 0
        assert row["reliably"] == ("better" if better else "worse" if worse else "")
    pooled = table.loc[("m", POOLED)]
    assert pooled["interval"] == "stimuli" and np.isnan(pooled["kappa"])
    assert pooled["r_low"] == plain.loc[("m", POOLED), "r_low"]


def test_the_average_with_more_numbers_is_shown() -> None:
    table = pd.DataFrame(
        {"kind": ["people", "model", "people", "model"], "scenario": [MEAN, MEAN, POOLED, POOLED],
         "accuracy": 0.7, "r": [0.5, 0.5, 0.5, 0.5]}
    )  # fmt: skip
    assert shown_average(table) == MEAN
    assert shown_average(table.assign(r=[0.5, np.nan, np.nan, 0.5])) == POOLED  # models decide
    assert shown_average(table[table["kind"] == "people"].assign(r=[np.nan, 0.5])) == POOLED


def test_people_and_models_are_compared_on_the_predicted_stimuli() -> None:
    people = analyse_people(study(people=8, stimuli=12, seed=3), bootstrap=FEW)
    test = people.kept.test
    first = test.drop_duplicates("stimulus").groupby("scenario")["stimulus"].head(6)
    chosen = test[test["stimulus"].isin(first) & (test["scenario"] == "collide")]
    part = chosen.drop_duplicates("stimulus")[["stimulus", "label"]]
    given = part.assign(model="m", p_contact=0.2 + 0.6 * part["label"], predicted=part["label"])
    given = given.drop(columns="label").assign(p_contact=lambda t: t["p_contact"] + t.index / 1e4)
    table = tidy_scores(all_results(given, people=people, bootstrap=FEW))
    rows = table[table["scenario"] == MEAN].set_index("model")
    assert (rows["stimuli"] == 6).all() and rows.loc["m", "accuracy"] == 1
    own = chosen.groupby("stimulus")["correct"].mean().mean()
    assert rows.loc[TWO_PEOPLE, "accuracy"] == pytest.approx(own)
    assert rows["human_accuracy"].to_numpy() == pytest.approx(own)


def test_a_model_without_a_scenario_has_the_mean_of_the_others() -> None:
    people = analyse_people(study(people=8, stimuli=12, seed=3), bootstrap=FEW)
    part = people.kept.test.drop_duplicates("stimulus")
    given = part[["stimulus"]].assign(
        model="all", predicted=part["label"], p_contact=0.2 + 0.6 * part["label"]
    )
    some = given[part["scenario"] == "collide"].assign(model="some")
    found = all_results(pd.concat([given, some]), people=people, bootstrap=FEW)
    table = tidy_scores(found).set_index(["model", "scenario"])
    assert table.loc[("some", MEAN), "r"] == table.loc[("some", "collide"), "r"]
    assert found.with_people is not None
    scores = found.with_people.scores.set_index(["model", "scenario", "measure"])
    assert scores.loc[("some", MEAN, "kappa"), "stimuli"] == 12
    assert scores.loc[("some", "collide", "accuracy"), "in_zone"] in ("yes", "no")
