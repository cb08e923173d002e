"""Our mixed models beside R's: lme4 with lmerTest, and glmmTMB, on the same data.

The stored numbers come from ``benchmarks/analysis/mixed_fixtures.py``. Coefficients are compared
in units of their standard errors. glmer stops a little early where a variance is zero,
hence its 1 %.
"""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pandas as pd
import pytest

from physion.analysis.mixed import MixedFit, fit_linear, fit_logistic
from support.mixed_cases import CASES, STORED, digest, published
from support.official import official_folder

BIG = {"big", "times big"}
SHARE = {"glmmTMB": 1e-3, "lme4": 1e-2}


def cases(kind: str) -> list[object]:
    names = [name for name, case in CASES.items() if case.kind == kind]
    marks = {True: [pytest.mark.slow, pytest.mark.nightly], False: []}
    return [pytest.param(name, marks=marks[name in BIG]) for name in names]


def stored(name: str, fitter: str) -> pd.DataFrame:
    """R's numbers of one case and fitter by (quantity, term)."""
    table = pd.read_csv(STORED, dtype=str, keep_default_na=False)
    rows = table[(table["case"] == name) & (table["fitter"] == fitter)]
    assert len(rows), f"run benchmarks/analysis/mixed_fixtures.py --case {name!r}"
    return rows.set_index(["quantity", "term"])["value"]


@cache
def fit(name: str) -> MixedFit:
    case = CASES[name]
    if case.data is published and official_folder() is None:
        pytest.skip("the official data is absent: set PHYSION_OFFICIAL to its folder")
    data = case.data()
    assert digest(data) == stored(name, "data")["digest", ""], "the data changed: redo the fixtures"
    return (fit_logistic if case.kind == "logistic" else fit_linear)(case.formula, data)


def in_r_names(term: str) -> str:
    return re.sub(r"\[T\.(.*?)\]", r"\1", term).replace("Intercept", "(Intercept)")


def ours(fitted: MixedFit, quantity: str) -> pd.Series:
    if quantity == "sd":
        groups = fitted.random["group"].replace("residual", "Residual")
        return pd.Series(fitted.random["sd"].to_numpy(), index=groups)
    table = fitted.table.rename(columns={"t": "statistic"})
    return pd.Series(table[quantity].to_numpy(), index=table["term"].map(in_r_names))


def theirs(numbers: pd.Series, quantity: str) -> pd.Series:
    values = numbers[quantity].astype(float)
    # lme4 writes nested groups the other way round.
    return values.rename(index={"readout:scenario": "scenario:readout"})


@pytest.mark.parametrize("fitter", ["glmmTMB", "lme4"])
@pytest.mark.parametrize("name", cases("logistic"))
def test_logistic_models_agree_with_r(name: str, fitter: str) -> None:
    fitted, numbers, share = fit(name), stored(name, fitter), SHARE[fitter]
    assert fitted.converged
    se = ours(fitted, "se")
    b = theirs(numbers, "b")
    assert len(b) == len(se)
    assert (np.abs(ours(fitted, "b")[b.index] - b) < share * se[b.index]).all()
    np.testing.assert_allclose(se[b.index], theirs(numbers, "se"), rtol=share)
    sd = theirs(numbers, "sd")
    np.testing.assert_allclose(ours(fitted, "sd")[sd.index], sd, rtol=share, atol=1e-3)
    log_likelihood = float(numbers["loglik", ""])
    assert log_likelihood - 2e-4 < fitted.log_likelihood < log_likelihood + 2e-3


@pytest.mark.parametrize("name", cases("linear"))
def test_linear_models_agree_with_lmertest(name: str) -> None:
    fitted, numbers = fit(name), stored(name, "lme4")
    assert fitted.converged
    se = ours(fitted, "se")
    b = theirs(numbers, "b")
    assert len(b) == len(se)
    assert (np.abs(ours(fitted, "b")[b.index] - b) < 1e-5 * se[b.index]).all()
    for quantity in ("se", "df", "statistic"):
        np.testing.assert_allclose(
            ours(fitted, quantity)[b.index], theirs(numbers, quantity), rtol=1e-4, err_msg=quantity
        )
    np.testing.assert_allclose(ours(fitted, "p")[b.index], theirs(numbers, "p"), atol=1e-5)
    sd = theirs(numbers, "sd")
    np.testing.assert_allclose(ours(fitted, "sd")[sd.index], sd, rtol=1e-4, atol=1e-6)
    assert abs(fitted.log_likelihood - float(numbers["loglik", ""])) < 1e-5
    assert fitted.singular == bool(float(numbers["singular", ""]))


@pytest.mark.parametrize(
    "name", ["times nested", "times alike", "models", "readouts", "inside", "published models"]
)
def test_joint_tests_match_anova(name: str) -> None:
    fitted, numbers = fit(name), stored(name, "lme4")
    terms = list(numbers["joint F"].index)
    assert terms == [term for term in fitted.terms if term != "Intercept"]
    for term in terms:
        test = fitted.joint_test(term)
        assert test.df1 == float(numbers["joint df1", term])
        assert test.statistic == pytest.approx(float(numbers["joint F", term]), rel=1e-4)
        assert test.df2 == pytest.approx(float(numbers["joint df2", term]), rel=1e-4)
        assert test.p == pytest.approx(float(numbers["joint p", term]), rel=1e-2, abs=1e-12)


@pytest.mark.parametrize("name", ["three groups", "alike", "times alike"])
def test_a_variance_of_zero_is_exactly_zero_and_said(name: str) -> None:
    fitted = fit(name)
    group = "scenario" if name == "three groups" else "participant"
    zero = fitted.random.set_index("group")["sd"] == 0
    assert fitted.singular and list(zero.index[zero]) == [group]
    assert any("singular" in warning and group in warning for warning in fitted.warnings)
