"""Random slopes: likelihoods against dense matrices, fits against statsmodels, known effects."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal
from statsmodels.regression.mixed_linear_model import MixedLM

from physion.analysis.mixed.design import (
    Design,
    RandomEffects,
    RandomTerm,
    build_design,
    split_formula,
)
from physion.analysis.mixed.fit import LogisticModel, SlopesModel, fit_linear, fit_logistic
from physion.core.errors import BadInputError

FORMULAS = {
    "correlated": "{y} ~ x + (1 + x|person) + (1|item)",
    "uncorrelated": "{y} ~ x + (1 + x||person) + (1|item)",
    "slope alone": "{y} ~ x + (0 + x|person) + (1|item)",
    "two slopes": "{y} ~ x + w + (x + w|person) + (1 + x|item)",
    "of a category": "{y} ~ kind + (kind|person) + (1|item)",
}


def simulate(
    people: int = 12, items: int = 10, seed: int = 0, sd: tuple[float, float] = (0.7, 0.5),
    r: float = 0.4, shift: float = 2.0,
) -> pd.DataFrame:  # fmt: skip
    """People x items with an intercept and a slope of each person, of correlation ``r``."""
    draw = np.random.default_rng(seed)
    person, item = (index.ravel() for index in np.indices((people, items)))
    x = draw.normal(shift, 1, people * items)
    covariance = np.array([[sd[0] ** 2, r * sd[0] * sd[1]], [r * sd[0] * sd[1], sd[1] ** 2]])
    effects = draw.multivariate_normal([0, 0], covariance, people)
    slope = effects[person, 1] * (x - shift)
    linear = 0.5 + 0.6 * (x - shift) + effects[person, 0] + slope + draw.normal(0, 0.4, items)[item]
    return pd.DataFrame(
        {
            "person": np.char.add("p", person.astype(str)),
            "item": np.char.add("i", item.astype(str)),
            "x": x,
            "w": draw.normal(0, 1, len(x)),
            "kind": np.array(["a", "b"])[draw.integers(0, 2, len(x))],
            "time": linear + draw.normal(0, 0.5, len(x)),
            "correct": (draw.random(len(x)) < 1 / (1 + np.exp(-linear))).astype(int),
        }
    )


def dense(design: Design, random: RandomEffects, at: np.ndarray) -> np.ndarray:
    """Z times a root of the covariance of all random effects, written out: (n, q)."""
    columns = []
    for group, root in zip(design.groups, random.roots(at), strict=True):
        indicators = np.eye(group.levels)[group.codes]
        columns += [indicators * effect[:, None] for effect in (group.columns @ root).T]
    return np.hstack(columns)


def differences(value: Callable[[np.ndarray], float], at: np.ndarray) -> np.ndarray:
    shifts = 1e-4 * np.eye(len(at))
    return np.array([(value(at + one) - value(at - one)) / 2e-4 for one in shifts])


@pytest.mark.parametrize("which", FORMULAS)
def test_restricted_likelihood_and_its_gradient(which: str) -> None:
    design = build_design(FORMULAS[which].format(y="time"), simulate())
    model = SlopesModel(design)
    at = np.random.default_rng(1).normal(0.4, 0.5, len(model.random.entry_of))
    value, gradient = model.profiled(at)
    solution = model.solve(at)
    a = dense(design, model.random, at)
    v = solution.sigma2 * (np.eye(len(design.y)) + a @ a.T)
    inside = design.x.T @ np.linalg.solve(v, design.x)
    b = np.linalg.solve(inside, design.x.T @ np.linalg.solve(v, design.y))
    full = multivariate_normal(design.x @ b, v).logpdf(design.y)
    p = design.x.shape[1]
    restricted = full + p * np.log(2 * np.pi) / 2 - np.linalg.slogdet(inside)[1] / 2
    assert -value == pytest.approx(restricted, abs=1e-6)
    np.testing.assert_allclose(model.coefficients(solution), b, atol=1e-8)
    unit = solution.sigma2 * model.backward(solution.unit_covariance)
    np.testing.assert_allclose(unit, np.linalg.inv(inside), atol=1e-9)
    numeric = differences(lambda point: model.profiled(point)[0], at)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-5)
    for k, change in enumerate(model.covariance_changes(solution)):
        step = 1e-5 * np.eye(len(at))[k]
        up, down = (model.solve(point).unit_covariance for point in (at + step, at - step))
        np.testing.assert_allclose(change, (up - down) / 2e-5, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("which", FORMULAS)
def test_laplaces_likelihood_and_its_gradient(which: str) -> None:
    design = build_design(FORMULAS[which].format(y="correct"), simulate())
    model = LogisticModel(design)
    at = np.random.default_rng(2).normal(0.4, 0.3, model.p + len(model.random.entry_of))
    value, gradient = model.objective(at)
    a = dense(design, model.random, at[model.p :])
    fixed = model.x @ at[: model.p]

    def negative(u: np.ndarray) -> float:
        eta = fixed + a @ u
        return -float(design.y @ eta - np.logaddexp(0, eta).sum() - u @ u / 2)

    def slope(u: np.ndarray) -> np.ndarray:
        return u - a.T @ (design.y - 1 / (1 + np.exp(-fixed - a @ u)))

    mode = minimize(negative, np.zeros(a.shape[1]), jac=slope, method="BFGS",
                    options={"gtol": 1e-8})  # fmt: skip
    mean = 1 / (1 + np.exp(-fixed - a @ mode.x))
    hessian = np.eye(a.shape[1]) + a.T @ ((mean * (1 - mean))[:, None] * a)
    assert value == pytest.approx(mode.fun + np.linalg.slogdet(hessian)[1] / 2, abs=1e-6)
    numeric = differences(lambda point: model.objective(point)[0], at)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-5)


def test_one_group_agrees_with_statsmodels() -> None:
    table = simulate(people=30, items=20, seed=3)
    fitted = fit_linear("time ~ x + (x|person)", table)
    other = MixedLM.from_formula("time ~ x", table, groups="person", re_formula="~x").fit(reml=True)
    assert fitted.converged and not fitted.singular
    assert fitted.log_likelihood == pytest.approx(other.llf, abs=1e-5)
    np.testing.assert_allclose(fitted.table["b"], other.fe_params, rtol=1e-4)
    np.testing.assert_allclose(fitted.table["se"], other.bse_fe, rtol=1e-3)
    covariance = other.cov_re.to_numpy()
    sd = np.sqrt([*np.diag(covariance), other.scale])
    np.testing.assert_allclose(fitted.random["sd"], sd, rtol=2e-3)
    r = covariance[0, 1] / sd[0] / sd[1]
    assert fitted.correlations["r"].tolist() == pytest.approx([r], abs=3e-3)
    assert list(fitted.random["effect"]) == ["Intercept", "x", ""]


def test_degrees_of_freedom_match_the_persons_own_slopes() -> None:
    """Balanced: the mean slope has the t test of the slopes of each person, people - 1."""
    people, times = 14, np.arange(8.0)
    draw = np.random.default_rng(5)
    own = draw.multivariate_normal([1.0, 0.5], [[1, 0.2], [0.2, 0.3]], people)
    noise = draw.normal(0, 0.4, (people, len(times)))
    y = own[:, :1] + own[:, 1:] * times + noise
    table = pd.DataFrame(
        {"g": np.repeat(np.arange(people), len(times)), "x": np.tile(times, people), "y": y.ravel()}
    )
    fitted = fit_linear("y ~ x + (x|g)", table)
    slopes = np.array([np.polyfit(times, row, 1)[0] for row in y])
    row = fitted.table.iloc[1]
    assert row["b"] == pytest.approx(slopes.mean())
    assert row["se"] == pytest.approx(slopes.std(ddof=1) / np.sqrt(people), rel=1e-5)
    assert row["df"] == pytest.approx(people - 1, rel=1e-3)


@pytest.mark.parametrize(("fitter", "y"), [(fit_linear, "time"), (fit_logistic, "correct")])
def test_the_origin_of_a_slope_does_not_matter_if_it_is_correlated(fitter, y: str) -> None:
    table = simulate(people=30, items=20, seed=4)
    moved = table.assign(x=10 * table["x"] + 300)
    one = fitter(f"{y} ~ x + (x|person) + (1|item)", table)
    two = fitter(f"{y} ~ x + (x|person) + (1|item)", moved)
    # The restricted likelihood has the unit of the columns in its determinant.
    unit = np.log(10) if y == "time" else 0.0
    assert one.log_likelihood == pytest.approx(two.log_likelihood + unit, abs=1e-5)
    sd_one, sd_two = (fit.random["sd"].to_numpy() for fit in (one, two))
    assert sd_two[1] == pytest.approx(sd_one[1] / 10, rel=1e-3)
    column = "t" if y == "time" else "z"
    assert two.table[column][1] == pytest.approx(one.table[column][1], rel=1e-3)


def test_known_slopes_of_answers_are_found_again() -> None:
    table = simulate(people=150, items=80, seed=6)
    table = table.assign(x=table["x"] - 2)
    fitted = fit_logistic("correct ~ x + (x|person) + (1|item)", table)
    row = fitted.table.set_index("term").loc["x"]
    assert abs(row["b"] - 0.6) < 3 * row["se"]
    assert fitted.random["sd"].tolist() == pytest.approx([0.7, 0.5, 0.4], abs=0.12)
    assert fitted.correlations["r"][0] == pytest.approx(0.4, abs=0.25)
    assert list(fitted.effects) == ["person", "person: x", "item"]
    alone = fit_logistic("correct ~ x + (1|person) + (1|item)", table)
    # Without the slopes the mean slope seems surer than it is.
    assert alone.table["se"][1] < 0.8 * row["se"]
    assert "converged" in fitted.summary() and "0.5" in fitted.summary()


def test_uncorrelated_effects_are_two_terms() -> None:
    table = simulate(people=30, items=20, seed=4)
    one = fit_linear("time ~ x + (1 + x||person)", table)
    two = fit_linear("time ~ x + (1|person) + (0 + x|person)", table)
    assert one.log_likelihood == pytest.approx(two.log_likelihood, abs=1e-9)
    assert one.correlations.empty and len(one.random) == 3
    assert one.parameters == 5


def test_a_slope_that_nobody_has_is_estimated_as_zero_and_said() -> None:
    for seed in range(20):
        table = simulate(people=20, items=30, seed=seed, sd=(0.7, 0.0), r=0.0)
        fitted = fit_linear("time ~ x + (1 + x||person)", table)
        if fitted.singular:
            break
    assert fitted.singular and fitted.converged
    assert fitted.random["sd"][1] == 0
    assert any("singular" in warning and "person: x" in warning for warning in fitted.warnings)


def test_perfectly_correlated_effects_are_said() -> None:
    table = simulate(people=12, items=6, seed=1, sd=(0.7, 0.5), r=1.0)
    fitted = fit_linear("time ~ x + (x|person)", table)
    assert fitted.singular and abs(fitted.correlations["r"][0]) == pytest.approx(1)
    assert any("perfectly correlated" in warning for warning in fitted.warnings)


def test_a_model_that_does_not_converge_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("physion.analysis.mixed.fit.CLOSE", -1.0)
    fitted = fit_linear("time ~ x + (x|person)", simulate())
    assert not fitted.converged and "NOT CONVERGED" in fitted.summary()
    assert any("did not converge" in w and "|| group" in w for w in fitted.warnings)


def test_random_terms_are_taken_apart() -> None:
    _, fixed, terms = split_formula("y ~ log(x) + (1 + log(x)||g) + (x|g:h) + (1|k)")
    assert fixed == "log(x)"
    assert terms == [
        RandomTerm("g", ("g",), "1 + log(x)", correlated=False),
        RandomTerm("g:h", ("g", "h"), "x"),
        RandomTerm("k", ("k",)),
    ]


@pytest.mark.parametrize(
    ("random", "said"),
    [
        ("(1 + nowhere|person)", "no column 'nowhere'"),
        ("(|person)", "are written"),
        ("(x|person) + (1|person)", "random intercept twice for 'person'"),
        ("(x|person) + (0 + x|person)", "slope of 'x' twice"),
        ("(1 + x + twice|person)", "random effects of 'person' depend on each other"),
        ("(1 + easy|item)", "'easy' does not vary within the levels of 'item'"),
        ("(0|person)", "no effect varies"),
        ("(x|row)", "has as many random effects as there are rows|does not vary"),
        ("(log(x - 1000)|person)", "not finite"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_slopes_that_cannot_be_fitted_are_refused(random: str, said: str) -> None:
    table = simulate()
    table = table.assign(twice=2 * table["x"], row=np.arange(len(table)), easy=table["item"].map(
        {name: float(k) for k, name in enumerate(table["item"].unique())}
    ))  # fmt: skip
    with pytest.raises(BadInputError, match=said):
        fit_linear(f"time ~ x + {random}", table)
