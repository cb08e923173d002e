"""Mixed models of a report: known parameters are found again; groups of models."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import statsmodels.formula.api as smf
from statsmodels.stats.multitest import multipletests

from physion.analysis.comparison import compare_scores
from physion.analysis.intervals import Bootstrap
from physion.analysis.model_tests import MixedTable, fits_of_models, fits_of_people, group_contrasts
from physion.analysis.people.results import PeopleResults, analyse_people
from physion.analysis.tables import MEAN, POOLED, attributes_from_table, name_models
from physion.core.errors import BadInputError
from support.simulated_people import as_responses, simulate_study

KNOWN = {"correct": -0.12, "yes": 0.05, "hundred": -0.4, "scenario[T.roll]": 0.25}
SPREAD = {"participant": 0.25, "stimulus": 0.15, "residual": 0.3}


def timed_study(people: int, stimuli: int) -> PeopleResults:
    """People whose log response times are a linear function of their answers, plus noise."""
    trials, _ = simulate_study(people, stimuli, seed=1)
    draw = np.random.default_rng(2)

    def effect(column: str, sd: float) -> np.ndarray:
        codes, names = pd.factorize(trials[column])
        return draw.normal(0, sd, len(names))[codes]

    log_rt = (
        6.4
        + KNOWN["correct"] * trials["correct"]
        + KNOWN["yes"] * (trials["response"] == "yes")
        + KNOWN["hundred"] * trials["trial"] / 100
        + KNOWN["scenario[T.roll]"] * (trials["scenario"] == "roll")
        + effect("participant", SPREAD["participant"])
        + effect("stimulus", SPREAD["stimulus"])
        + draw.normal(0, SPREAD["residual"], len(trials))
    )
    responses = as_responses(trials.assign(rt_ms=np.exp(log_rt)))
    return analyse_people(responses, bootstrap=Bootstrap(resamples=50))


@pytest.fixture(scope="module")
def fits() -> dict[str, MixedTable]:
    seen: list[tuple[int, int]] = []
    fits = fits_of_people(timed_study(30, 60), lambda _, done, total: seen.append((done, total)))
    assert seen == [(done, len(fits)) for done in range(len(fits) + 1)]
    return {one.name: one for one in fits}


@pytest.mark.nightly
@pytest.mark.slow
def test_the_parameters_of_log_normal_response_times_are_found_again(
    fits: dict[str, MixedTable],
) -> None:
    fit = fits["response_times"].fit
    assert fit is not None and fit.converged and not fit.singular
    rows = fit.table.set_index("term").loc[list(KNOWN)]
    assert (np.abs(rows["b"] - pd.Series(KNOWN)) < 3 * rows["se"]).all()
    # The standard errors are small enough for the test to mean something.
    assert rows.loc["correct", "se"] < 0.03 and rows.loc["hundred", "se"] < 0.06
    sd = fit.random.set_index("group")["sd"]
    assert dict(sd) == pytest.approx(SPREAD, rel=0.2)
    # exp(b) is the factor of the median response time.
    assert np.exp(rows.loc["scenario[T.roll]", "b"]) == pytest.approx(np.exp(0.25), rel=0.25)


@pytest.mark.slow
def test_attributes_of_stimuli_enter_the_model_of_single_answers() -> None:
    """A known effect of an attribute on the log odds is found, in standard deviations."""
    trials, _ = simulate_study(40, 60, seed=3)
    draw = np.random.default_rng(0)
    stimuli = trials[["stimulus", "scenario"]].drop_duplicates().reset_index(drop=True)
    stimuli["mass of block"] = draw.normal(50, 4, len(stimuli))
    stimuli["mass-of block"] = np.random.default_rng(1).normal(50, 4, len(stimuli))
    centred = (stimuli.set_index("stimulus")["mass of block"] - 50) / 4
    effect = trials["stimulus"].map(centred).to_numpy() * 0.8
    right = draw.random(len(trials)) < 1 / (1 + np.exp(-0.8 - effect))
    response = np.where(right == trials["label"], "yes", "no")
    people = analyse_people(
        as_responses(trials.assign(response=response, correct=right)),
        attributes=attributes_from_table(stimuli),
        bootstrap=Bootstrap(resamples=20),
    )
    (found,) = (one for one in fits_of_people(people) if one.name == "attributes")
    terms = "mass_of_block + mass_of_block_"  # names that differ in a sign only are two terms
    assert found.fit is not None and found.formula.startswith(f"correct ~ {terms} + scenario")
    row = found.fit.table.set_index("term").loc["mass_of_block"]
    assert abs(row["b"] - 0.8) < 3 * row["se"] and row["se"] < 0.1


# --- groups of models ---------------------------------------------------------------------------

GROUPS = {"svg": "vision", "cswm": "vision", "rpin": "vision", "dpi": "particles",
          "gns": "particles", "guess": "none"}  # fmt: skip
SKILL = {"vision": 0.2, "particles": 0.6, "none": 0.0}


def trained_models() -> pd.DataFrame:
    """Predictions of six models on four scenarios, each with two readouts and two trainings."""
    draw = np.random.default_rng(5)
    parts = []
    for model, group in GROUPS.items():
        for readout, more in (("observed", 0.0), ("full", 0.2)):
            for protocol, less in (("all", 0.0), ("only", -0.1)):
                for scenario in ("collide", "drop", "roll", "link"):
                    label = np.arange(60) % 2 == 0
                    right = draw.random(60) < 0.5 + (SKILL[group] + more + less) / 2
                    names = [f"{scenario}_{k:03d}" for k in range(60)]
                    parts.append(pd.DataFrame({
                        "model": model, "readout": readout, "protocol": protocol,
                        "stimulus": names, "scenario": scenario,
                        "p_contact": np.where(right == label, 0.9, 0.1), "outcome": label,
                        "family": group,
                    }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


@pytest.mark.nightly
@pytest.mark.slow
def test_contrasts_of_groups_match_the_balanced_design() -> None:
    """Without further random terms the balanced model is least squares with fixed scenarios."""
    rows = trained_models()
    rows = rows[(rows["readout"] == "observed") & (rows["protocol"] == "all")]
    named = name_models(rows.drop(columns="family")).assign(family=rows["family"].to_numpy())
    comparison = compare_scores(named, None)
    table = group_contrasts(comparison, named, ["family"])
    first = table[table["formula"] == "accuracy ~ group + (1|scenario)"]
    assert first[["first", "second"]].to_numpy().tolist() == [
        ["vision", "particles"], ["vision", "none"], ["particles", "none"],
    ]  # fmt: skip
    assert first["models_first"].tolist() == [3, 3, 2]
    scores = comparison.scores[~comparison.scores["scenario"].isin([MEAN, POOLED])]
    scores = scores.assign(family=scores["base_model"].map(GROUPS))
    fixed = smf.ols("accuracy ~ C(family, Treatment('vision')) + C(scenario)", scores).fit()
    means = scores.groupby("family")["accuracy"].mean()
    for row in first.itertuples():
        assert row.b == pytest.approx(means[row.first] - means[row.second])
        names = [f"C(family, Treatment('vision'))[T.{name}]" for name in (row.first, row.second)]
        weights = [(names[0] == term) * 1.0 - (names[1] == term) for term in fixed.params.index]
        expected = fixed.t_test(weights)
        assert row.se == pytest.approx(float(expected.sd.item()), rel=0.02)
        assert row.t == pytest.approx(row.b / row.se)
    assert first["p_holm"].tolist() == pytest.approx(multipletests(first["p"], method="holm")[1])
    # With an intercept of each model the test is about other models, so it is more careful.
    with_models = table[table["formula"].str.endswith("(1|base_model)")].reset_index(drop=True)
    assert (with_models["se"] >= first["se"].to_numpy() * 0.999).all()
    assert (with_models["df"] < first["df"].to_numpy()).all()


@pytest.mark.nightly
@pytest.mark.slow
def test_readout_and_training_are_terms_of_their_own() -> None:
    named = name_models(trained_models().drop(columns="family"))
    fits = {one.name: one for one in fits_of_models(compare_scores(named, None), named)}
    assert fits["readouts"].formula == (
        "accuracy ~ readout + (1|scenario) + (1|training) + (1|base_model)"
    )
    assert fits["trainings"].formula == (
        "accuracy ~ training + (1|scenario) + (1|readout) + (1|base_model)"
    )
    for name, term, expected in (
        ("readouts", "readout[T.full]", 0.1),
        ("trainings", "training[T.only]", -0.05),
    ):
        fit = fits[name].fit
        assert fit is not None
        row = fit.table.set_index("term").loc[term]
        assert abs(row["b"] - expected) < 3 * row["se"] and row["se"] < 0.02
    contrasts = group_contrasts(compare_scores(named, None), named, ["protocol"])
    one = contrasts[contrasts["formula"].str.endswith("(1|base_model)")].iloc[0]
    trainings = fits["trainings"].fit
    assert trainings is not None
    assert one["b"] == pytest.approx(-trainings.table["b"].iloc[1])
    assert one["p"] == pytest.approx(trainings.table["p"].iloc[1])


@pytest.mark.nightly
@pytest.mark.slow
def test_bad_groups_are_refused() -> None:
    rows = trained_models()
    named = name_models(rows.drop(columns="family"))
    comparison = compare_scores(named, None)
    with pytest.raises(BadInputError, match="has several values"):
        group_contrasts(comparison, named.assign(odd=np.arange(len(named)) % 2), ["odd"])
    with pytest.raises(BadInputError, match="same value for all models"):
        group_contrasts(comparison, named.assign(same="x"), ["same"])
