"""Mixed models: what they refuse and leave out, and the same numbers as in R.

The numbers of R come from ``benchmarks/analysis/mixed_fixtures.py``. Coefficients are compared in
units of their standard errors. glmer stops a little early where a variance is zero, hence its 1 %.
"""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pandas as pd
import pytest

from physion.analysis.mixed import MixedFit, fit_linear, fit_logistic
from physion.core.errors import BadInputError, UnknownNameError
from support.mixed_cases import CASES, STORED, digest, published
from support.official import official_folder
from support.simulated_answers import AnswerDesign, simulate_answers

CROSSED = "(1|participant) + (1|stimulus)"


@pytest.fixture
def table() -> pd.DataFrame:
    return simulate_answers(AnswerDesign(3, 10, 8, crossed=True), seed=1)


@pytest.mark.parametrize(
    ("formula", "said"),
    [
        ("correct scenario", "cannot be read"),
        ("correct ~ elements + (1|participant", "cannot be read"),
        ("correct ~ log(elements) + (1|participant)", "cannot be read"),
        ("correct ~ I(elements**2) + (1|participant)", "functions of columns"),
        ("correct ~ elements + I(elements**2) + (1|participant)", "functions of columns"),
        ("correct ~ scenario + scenario:elements + (1|participant)", "without its parts"),
        ("correct ~ scenario:elements + (1|participant)", "without its parts"),
        ("correct ~ scenario", "needs random intercepts"),
        ("correct ~ scenario + (elements|participant)", "takes only these"),
        ("correct ~ scenario + (1|participant) + (1|participant)", "are the same"),
        ("correct ~ elements + (1|participant) + (1|copy)", "are the same"),
        ("correct ~ scenario + (1|scenario) + (1|participant)", "are the same"),
        ("correct ~ 0 + elements + (1|participant)", "no intercept"),
        ("correct ~ elements + twice + (1|participant)", "rank deficient"),
        ("correct ~ elements + nothing + (1|participant)", "rank deficient"),
        ("correct ~ elements + endless + (1|participant)", "infinite"),
        ("endless ~ elements + (1|participant)", "infinite"),
        ("constant ~ elements + (1|participant)", "constant"),
        ("scenario ~ elements + (1|participant)", "not numeric"),
        ("correct ~ elements + (1|one)", "1 level"),
        ("correct ~ unknown + (1|participant)", "no row"),
    ],
)
@pytest.mark.parametrize("fitter", [fit_logistic, fit_linear])
def test_bad_formulas_and_columns_are_refused(
    fitter, table: pd.DataFrame, formula: str, said: str
) -> None:
    table = table.assign(
        twice=2 * table["elements"] + 1,
        nothing=0,
        endless=np.where(np.arange(len(table)) == 3, np.inf, table["elements"]),
        constant=1,
        one="a",
        copy=table["participant"].str.upper(),
        unknown=np.nan,
    )
    with pytest.raises(BadInputError, match=said):
        fitter(formula, table)


def test_unknown_columns_are_said_with_the_closest(table: pd.DataFrame) -> None:
    for formula in ("correct ~ scenari + (1|participant)", "correct ~ elements + (1|scenari)"):
        with pytest.raises(UnknownNameError, match="'scenari'; closest: scenario"):
            fit_linear(formula, table)


@pytest.mark.parametrize(
    ("fitter", "formula", "change", "said"),
    [
        (fit_logistic, f"log_rt ~ elements + {CROSSED}", lambda rows: rows, "two classes"),
        (fit_logistic, f"correct ~ elements + {CROSSED}", lambda rows: rows[rows["correct"] == 1],
         "constant"),
        # Half always say yes, half always no: the deviation grows without end.
        (fit_logistic, "yes ~ elements + (1|participant)",
         lambda rows: rows.assign(yes=pd.factorize(rows["participant"])[0] % 2), "answer alike"),
        (fit_linear, "log_rt ~ elements + (1|row)",
         lambda rows: rows.assign(row=np.arange(len(rows))), "rank"),
        (fit_linear, f"log_rt ~ elements + {CROSSED}",
         lambda rows: rows.assign(log_rt=3 + 2 * rows["elements"]), "exactly"),
        (fit_linear, "log_rt ~ elements * distractors + (1|participant)",
         lambda rows: rows.iloc[[0, 9, 40]], "rank"),
        (fit_logistic, f"correct ~ scenario + {CROSSED}",
         lambda rows: rows.assign(correct=rows["correct"].mask(rows["scenario"] == "support", 1)),
         r"\[T.support\] is not determined .perfect separation"),
        (fit_logistic, f"correct ~ elements + {CROSSED}",
         lambda rows: rows.assign(correct=(rows["elements"] > 5).astype(int)),
         "elements is not determined"),
    ],
)  # fmt: skip
def test_answers_that_determine_no_model_are_refused(
    fitter, formula: str, change, said: str, table: pd.DataFrame
) -> None:
    with pytest.raises(BadInputError, match=said):
        fitter(formula, change(table))


def test_true_and_false_are_one_and_zero(table: pd.DataFrame) -> None:
    formula = f"correct ~ elements + {CROSSED}"
    numbers = fit_logistic(formula, table).table
    for kind in (bool, "boolean", object):
        pd.testing.assert_frame_equal(
            fit_logistic(formula, table.assign(correct=table["correct"].astype(kind))).table,
            numbers,
        )


def test_missing_rows_are_counted_and_said(table: pd.DataFrame) -> None:
    formula = f"correct ~ elements + {CROSSED}"
    holes = table.astype({"correct": float}).copy()
    holes.loc[[0, 5], "correct"] = np.nan
    holes.loc[[5, 7, 9], "elements"] = np.nan
    holes.loc[11, "participant"] = None
    holes.loc[20:40, "distractors"] = np.nan
    fitted = fit_logistic(formula, holes)
    assert fitted.rows == len(table) - 5 and fitted.left_out == 5
    assert "5 of 240 rows are left out" in fitted.warnings[0]
    whole = fit_logistic(formula, table.drop([0, 5, 7, 9, 11]))
    pd.testing.assert_frame_equal(fitted.table, whole.table)
    assert whole.left_out == 0


def test_strong_effects_are_not_taken_for_separation() -> None:
    draw = np.random.default_rng(0)
    n = 3000
    table = pd.DataFrame({"x": draw.normal(0, 1, n), "g": draw.integers(0, 20, n)})
    table["y"] = (draw.random(n) < 1 / (1 + np.exp(-12 * table["x"]))).astype(int)
    fitted = fit_logistic("y ~ x + (1|g)", table)
    assert fitted.converged
    assert fitted.table["b"][1] == pytest.approx(12, abs=3 * fitted.table["se"][1])


def test_one_row_per_level_is_warned_of(table: pd.DataFrame) -> None:
    fitted = fit_logistic("correct ~ elements + (1|row)", table.assign(row=np.arange(len(table))))
    assert any("hardly more rows than levels" in warning for warning in fitted.warnings)


def test_categories_that_do_not_occur_are_no_effects(table: pd.DataFrame) -> None:
    kinds = ["link", "support", "dominoes", "collide"]
    ordered = table.assign(scenario=pd.Categorical(table["scenario"], kinds))
    names = fit_logistic(f"correct ~ scenario + {CROSSED}", ordered).table["term"]
    assert tuple(names) == ("Intercept", "scenario[T.dominoes]", "scenario[T.collide]")


def test_columns_with_blanks_and_flags(table: pd.DataFrame) -> None:
    named = table.rename(columns={"elements": "number of elements", "participant": "the person"})
    named["flagged"] = named["the person"].isin(["p0001", "p0004"])
    formula = "correct ~ flagged + `number of elements` + (1|`the person`) + (1|stimulus)"
    fitted = fit_logistic(formula, named)
    assert list(fitted.table["term"]) == ["Intercept", "flagged", "number of elements"]
    assert list(fitted.random["group"]) == ["the person", "stimulus"]


def test_unknown_terms_have_no_joint_test(table: pd.DataFrame) -> None:
    fitted = fit_linear(f"log_rt ~ scenario + {CROSSED}", table)
    with pytest.raises(UnknownNameError, match="scenario"):
        fitted.joint_test("scenarios")


# --- beside R: lme4 with lmerTest, and glmmTMB, on the same data --------------------------------


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
