"""The mixed models' mathematics: likelihoods against their definitions, gradients, invariances."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from physion.analysis.mixed.design import Groupings, build_design
from physion.analysis.mixed.fit import Factor, LinearModel, LogisticModel, fit_linear, fit_logistic
from support.simulated_answers import AnswerDesign, simulate_answers

CROSSED = "(1|participant) + (1|stimulus)"
THREE = "(1|participant) + (1|stimulus) + (1|scenario)"


def answers(seed: int = 0, crossed: bool = True, skipped: float = 0.2) -> pd.DataFrame:
    design = AnswerDesign(3, 8, 6, crossed=crossed, participant_sd=0.8, skipped=skipped)
    return simulate_answers(design, seed)


def indicators(groupings: Groupings) -> np.ndarray:
    z = np.zeros((groupings.n, groupings.q))
    for rows in groupings.rows:
        z[np.arange(groupings.n), rows] = 1
    return z


@settings(max_examples=40, deadline=None)
@given(
    sizes=st.lists(st.integers(1, 9), min_size=1, max_size=4),
    seed=st.integers(0, 2**32 - 1),
    parts=st.integers(1, 3),
)
def test_the_equations_match_the_dense_matrices(sizes: list[int], seed: int, parts: int) -> None:
    """Whatever the groupings, linked or not: log|H|, H^-1, and their uses."""
    draw = np.random.default_rng(seed)
    n = 60
    part = np.sort(draw.integers(0, parts, n))
    raw = [part * size + draw.integers(0, size, n) for size in sizes]
    groupings = Groupings([np.unique(one, return_inverse=True)[1] for one in raw])
    weights = draw.random(n) + 0.01
    deviations = draw.random(len(sizes)) * 2
    scale = deviations[groupings.owner]
    z = indicators(groupings)
    dense = z.T @ (weights[:, None] * z)
    h = np.eye(groupings.q) + scale[:, None] * dense * scale
    counts = groupings.counts(weights)
    factor = Factor(groupings, counts, scale)
    right = draw.normal(size=(groupings.q, 2))
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(h)[1])
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(h, right), atol=1e-9)
    np.testing.assert_allclose(groupings.multiply(counts, right), dense @ right, atol=1e-9)
    inverse, known = factor.inverse(), np.linalg.inv(h)
    np.testing.assert_allclose(inverse.diagonal, np.diag(known), atol=1e-9)
    scaled = z * scale
    leverage = np.einsum("nq,qr,nr->n", scaled, known, scaled)
    leverages = factor.leverages(inverse)
    np.testing.assert_allclose(factor.at_rows(leverages), leverage, atol=1e-9)
    trace = groupings.by_grouping(np.diag(known @ (scale[:, None] * dense)))
    np.testing.assert_allclose(factor.slopes(inverse), trace, atol=1e-9)


def test_scenarios_with_their_own_people_become_blocks() -> None:
    design = build_design(f"correct ~ 1 + {CROSSED}", simulate_answers(AnswerDesign(3, 70, 80)))
    blocks = Groupings([group.codes for group in design.groups]).counts().cross
    assert [block.shape for block in blocks] == [(80, 70)] * 3


def test_levels_that_share_256_rows_are_linked() -> None:
    codes = np.repeat(np.arange(80), 256)
    groupings = Groupings([codes, codes // 2])
    assert sum(block.sum() for block in groupings.counts().cross) == len(codes)


def differences(value: Callable[[np.ndarray], float], at: np.ndarray) -> np.ndarray:
    """The gradient by central differences."""
    shifts = 1e-4 * np.eye(len(at))
    return np.array([(value(at + one) - value(at - one)) / 2e-4 for one in shifts])


def dense_laplace(y: np.ndarray, x: np.ndarray, z: np.ndarray, b: np.ndarray, sd: np.ndarray):
    """Log of the normal approximation around the mode, from its definition."""

    def negative(u: np.ndarray) -> float:
        eta = x @ b + z @ (sd * u)
        normal = -(u @ u) / 2 - len(u) * np.log(2 * np.pi) / 2
        return -float(y @ eta - np.logaddexp(0, eta).sum() + normal)

    found = minimize(negative, np.zeros(len(sd)), method="BFGS", options={"gtol": 1e-8})
    mean = 1 / (1 + np.exp(-(x @ b + z @ (sd * found.x))))
    scaled = z * sd
    hessian = np.eye(len(sd)) + scaled.T @ ((mean * (1 - mean))[:, None] * scaled)
    return -found.fun + len(sd) * np.log(2 * np.pi) / 2 - np.linalg.slogdet(hessian)[1] / 2


@pytest.mark.parametrize("random", [CROSSED, THREE, "(1|participant)"])
def test_logistic_likelihood_is_laplaces_and_its_gradient_is_right(random: str) -> None:
    design = build_design(f"correct ~ elements + {random}", answers(1))
    model = LogisticModel(design)
    m = len(design.groups)
    at = np.concatenate([[0.7, -0.3], [0.6, 1.3, 0.4][:m]])
    value, gradient = model.objective(at)
    sd = at[2:][model.groupings.owner]
    z = indicators(model.groupings)
    assert -value == pytest.approx(dense_laplace(design.y, model.x, z, at[:2], sd), abs=1e-5)
    numeric = differences(lambda point: model.objective(point)[0], at)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-5)


def test_logistic_gradient_where_a_deviation_is_zero_or_turned_round() -> None:
    model = LogisticModel(build_design(f"correct ~ elements + {THREE}", answers(2)))
    at = np.array([0.7, -0.3, 0.6, 0.0, 0.4])
    value, gradient = model.objective(at)
    assert gradient[3] == 0
    numeric = differences(lambda point: model.objective(point)[0], at)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-5)
    at[2] = -at[2]
    turned, slope = model.objective(at)
    assert turned == pytest.approx(value, abs=1e-9)
    assert slope[2] == pytest.approx(-gradient[2], abs=1e-6)


def test_restricted_likelihood_matches_the_marginal_covariance() -> None:
    design = build_design(f"log_rt ~ elements + scenario + {CROSSED}", answers(3))
    model = LinearModel(design)
    ratios = np.array([0.6, 1.4])
    value, gradient = model.profiled(ratios)
    sigma2 = model.solve(ratios).sigma2
    z = indicators(model.groupings) * ratios[model.groupings.owner]
    v = sigma2 * (np.eye(len(design.y)) + z @ z.T)
    inside = design.x.T @ np.linalg.solve(v, design.x)
    b = np.linalg.solve(inside, design.x.T @ np.linalg.solve(v, design.y))
    full = multivariate_normal(design.x @ b, v).logpdf(design.y)
    p = design.x.shape[1]
    restricted = full + p * np.log(2 * np.pi) / 2 - np.linalg.slogdet(inside)[1] / 2
    assert -value == pytest.approx(restricted, abs=1e-6)
    np.testing.assert_allclose(model.coefficients(model.solve(ratios)), b, atol=1e-9)
    numeric = differences(lambda point: model.profiled(point)[0], ratios)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-5)


def test_satterthwaite_is_exact_where_a_classical_test_exists() -> None:
    """Balanced groups: a group-level effect has the t test of the group means, levels - 2."""
    draw = np.random.default_rng(4)
    group = np.repeat(np.arange(12), 7)
    table = pd.DataFrame({"g": group, "x": (group % 2).astype(float)})
    table["y"] = 0.5 * table["x"] + draw.normal(0, 1, 12)[group] + draw.normal(0, 0.5, len(group))
    fitted = fit_linear("y ~ x + (1|g)", table)
    means = table.groupby("g").mean()
    odd, even = means["y"][means["x"] == 1], means["y"][means["x"] == 0]
    pooled = (odd.var(ddof=1) + even.var(ddof=1)) / 2
    row = fitted.table.iloc[1]
    assert row["b"] == pytest.approx(odd.mean() - even.mean())
    assert row["se"] == pytest.approx(np.sqrt(pooled * 2 / 6), rel=1e-6)
    assert row["df"] == pytest.approx(10, rel=1e-4)


def test_known_effects_are_found_again() -> None:
    design = AnswerDesign(4, 60, 60, crossed=True, participant_sd=0.5, stimulus_sd=0.8)
    table = simulate_answers(design, seed=3)
    fitted = fit_logistic(
        f"correct ~ scenario + elements + distractors + occluders + {CROSSED}", table
    )
    slopes = fitted.table.set_index("term").loc[["elements", "distractors", "occluders"]]
    assert (np.abs(slopes["b"] - np.array(design.slopes)) < 3 * slopes["se"]).all()
    sd = fitted.random.set_index("group")["sd"]
    assert sd["participant"] == pytest.approx(0.5, rel=0.25)
    assert sd["stimulus"] == pytest.approx(0.8, rel=0.15)
    # The modes follow the people's shares of correct answers.
    shares = table.groupby("participant")["correct"].mean()
    assert np.corrcoef(shares, fitted.effects["participant"][shares.index])[0, 1] > 0.95


BOTH = pytest.mark.parametrize(
    ("fitter", "response"), [(fit_logistic, "correct"), (fit_linear, "log_rt")]
)
FEW = settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))


@pytest.mark.nightly
@pytest.mark.slow
@BOTH
@FEW
@given(seed=st.integers(0, 10_000))
def test_names_and_order_of_rows_do_not_matter(fitter, response: str, seed: int) -> None:
    formula = f"{response} ~ occluders + {CROSSED}"
    table = answers(5)
    draw = np.random.default_rng(seed)
    other = table.sample(frac=1, random_state=seed).reset_index(drop=True)
    for name in ("participant", "stimulus"):
        levels = other[name].unique()
        fresh = dict(zip(levels, draw.permutation(len(levels)), strict=True))
        other[name] = other[name].map(fresh)
    one, two = fitter(formula, table), fitter(formula, other)
    columns = [name for name in one.table if name != "term"]
    np.testing.assert_allclose(one.table[columns], two.table[columns], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(one.random["sd"], two.random["sd"], rtol=1e-4, atol=1e-6)
    assert one.log_likelihood == pytest.approx(two.log_likelihood, abs=1e-6)


@FEW
@given(shift=st.floats(-1e4, 1e4), factor=st.floats(0.01, 100))
def test_shifting_and_stretching_the_response(shift: float, factor: float) -> None:
    table = answers(6)
    formula = f"log_rt ~ scenario + elements + {CROSSED}"
    one = fit_linear(formula, table).table
    moved = fit_linear(formula, table.assign(log_rt=factor * table["log_rt"] + shift)).table
    wanted = factor * one["b"] + shift * (one["term"] == "Intercept")
    np.testing.assert_allclose(moved["b"], wanted, rtol=1e-6, atol=1e-5 * factor)
    np.testing.assert_allclose(moved["se"], factor * one["se"], rtol=1e-4)
    np.testing.assert_allclose(moved["df"], one["df"], rtol=1e-3)


@FEW
@given(shift=st.floats(-100, 100), factor=st.floats(0.01, 100))
def test_units_of_a_covariate_do_not_matter(shift: float, factor: float) -> None:
    table = answers(7)
    formula = f"correct ~ elements + {CROSSED}"
    one = fit_logistic(formula, table)
    two = fit_logistic(formula, table.assign(elements=factor * table["elements"] + shift))
    assert two.log_likelihood == pytest.approx(one.log_likelihood, abs=1e-6)
    assert two.table["b"][1] * factor == pytest.approx(one.table["b"][1], rel=1e-4, abs=1e-6)
    assert two.table["z"][1] == pytest.approx(one.table["z"][1], rel=1e-3, abs=1e-5)


def test_swapping_the_two_answers_turns_the_coefficients_round() -> None:
    table = answers(8)
    formula = f"correct ~ scenario + {CROSSED}"
    one = fit_logistic(formula, table)
    two = fit_logistic(formula, table.assign(correct=1 - table["correct"]))
    np.testing.assert_allclose(one.table["b"], -two.table["b"], rtol=1e-5, atol=1e-7)
    assert one.log_likelihood == pytest.approx(two.log_likelihood, abs=1e-7)


def test_recoding_a_factor_leaves_its_joint_test() -> None:
    table = answers(9)
    by_level = fit_logistic(f"correct ~ scenario + {CROSSED}", table)
    by_sum = fit_logistic(f"correct ~ C(scenario, Sum) + {CROSSED}", table)
    one, two = by_level.joint_test("scenario"), by_sum.joint_test("C(scenario, Sum)")
    assert one.statistic == pytest.approx(two.statistic, rel=1e-3)
    assert (one.df1, one.df2) == (two.df1, two.df2) == (2, np.inf)
    assert one.p == pytest.approx(two.p, rel=1e-3)


def test_a_level_of_an_interval_widens_it() -> None:
    table = answers(10)
    narrow = fit_linear(f"log_rt ~ elements + {CROSSED}", table, level=0.8).table
    wide = fit_linear(f"log_rt ~ elements + {CROSSED}", table, level=0.99).table
    assert (narrow["low"] > wide["low"]).all() and (narrow["high"] < wide["high"]).all()
    np.testing.assert_allclose(narrow["b"], (wide["low"] + wide["high"]) / 2)
