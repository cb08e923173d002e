"""What the mixed models refuse, and what they say about what they leave out."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from physion.analysis.mixed.design import build_design, split_formula
from physion.analysis.mixed.fit import fit_linear, fit_logistic
from physion.core.errors import BadInputError, UnknownNameError
from support.simulated_answers import AnswerDesign, simulate_answers

CROSSED = "(1|participant) + (1|stimulus)"


@pytest.fixture
def table() -> pd.DataFrame:
    return simulate_answers(AnswerDesign(3, 10, 8, crossed=True), seed=1)


@pytest.mark.parametrize(
    ("formula", "fixed", "random"),
    [
        ("y ~ a + (1|g)", "a", ["g"]),
        ("y~(1|g)+a*b+( 1 | h )", "a*b", ["g", "h"]),
        ("y ~ (1|g)", "1", ["g"]),
        ("y ~ 0 + C(a, Treatment('x + (y')) + (1|g:h)", "0 + C(a, Treatment('x + (y'))", ["g:h"]),
        ("y ~ a + (1|g/h)", "a", ["g", "g:h"]),
        ("`the y` ~ log(a + 1) + (1|`the g`)", "log(a + 1)", ["the g"]),
    ],
)
def test_formulas_are_taken_apart(formula: str, fixed: str, random: list[str]) -> None:
    _, found, groups = split_formula(formula)
    assert found == fixed
    assert [term.name for term in groups] == random


@pytest.mark.parametrize(
    ("formula", "said"),
    [
        ("correct scenario", "not of the form"),
        ("correct ~ ", "not of the form"),
        ("correct ~ scenario", "no random intercept"),
        ("correct ~ scenario + (elements|stimulus)", "does not vary within the levels"),
        ("correct ~ scenario + 1|participant", "with parentheses"),
        ("correct ~ scenario + (1|participant) + (1|participant)", "twice"),
        ("correct ~ scenario + + (1|participant)", "do not match"),
        ("correct ~ log(elements + (1|participant)", "do not match"),
        ("correct ~ scenari + (1|participant)", "no column 'scenari'; it has: scenario"),
        ("correct ~ scenario + (1|person)", "no column 'person'"),
        ("corect ~ scenario + (1|participant)", "no column 'corect'; it has: correct"),
        ("correct ~ elements.__class__ + (1|participant)", "not understood"),
        ("correct ~ __import__('os') + (1|participant)", "no column '__import__'"),
        ("correct ~ np.log(elements) + (1|participant)", "not understood"),
        ("correct ~ {elements} + (1|participant)", "not understood"),
        ("correct ~ 0 + (1|participant)", "no fixed effect"),
        ("correct ~ log(elements - 2) + (1|participant)", "cannot be built|not finite"),
        ("correct ~ C(scenario, Treatment('nowhere')) + (1|participant)", "cannot be built"),
        ("correct ~ elements + twice + (1|participant)", "depend on each other"),
        ("correct ~ elements + nothing + (1|participant)", "zero in every row"),
        ("correct ~ elements + endless + (1|participant)", "not finite"),
        ("constant ~ elements + (1|participant)", "constant"),
        ("scenario ~ elements + (1|participant)", "not numeric"),
        ("endless ~ elements + (1|participant)", "infinite"),
        ("correct ~ elements + (1|one)", "one level"),
        ("correct ~ elements + (1|participant) + (1|copy)", "are the same"),
        ("correct ~ scenario + (1|scenario) + (1|participant)", "already"),
        ("correct ~ unknown + (1|participant)", "no row"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
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


def test_a_logistic_response_has_two_classes(table: pd.DataFrame) -> None:
    with pytest.raises(BadInputError, match="two classes"):
        fit_logistic(f"log_rt ~ elements + {CROSSED}", table)
    with pytest.raises(BadInputError, match="constant"):
        fit_logistic(f"correct ~ elements + {CROSSED}", table[table["correct"] == 1])


def test_true_and_false_are_one_and_zero(table: pd.DataFrame) -> None:
    formula = f"correct ~ elements + {CROSSED}"
    numbers = fit_logistic(formula, table).table
    for kind in (bool, "boolean", "Int64", object):
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
    assert fitted.missing == {"correct": 2, "elements": 3, "participant": 1}
    assert "5 of 240 rows are left out" in fitted.warnings[0]
    whole = fit_logistic(formula, table.drop([0, 5, 7, 9, 11]))
    pd.testing.assert_frame_equal(fitted.table, whole.table)
    assert whole.left_out == 0 and not whole.missing


def test_perfect_separation_is_said_and_names_the_effect(table: pd.DataFrame) -> None:
    sure = table["scenario"] == "support"
    quasi = table.assign(correct=np.where(sure, 1, table["correct"]))
    with pytest.raises(BadInputError, match=r"separation: scenario\[T.support\] tell"):
        fit_logistic(f"correct ~ scenario + {CROSSED}", quasi)
    complete = table.assign(correct=(table["elements"] > 5).astype(int))
    with pytest.raises(BadInputError, match=r"separation: .*elements"):
        fit_logistic(f"correct ~ elements + {CROSSED}", complete)


def test_strong_effects_are_not_taken_for_separation() -> None:
    draw = np.random.default_rng(0)
    n = 3000
    table = pd.DataFrame({"x": draw.normal(0, 1, n), "g": draw.integers(0, 20, n)})
    table["y"] = (draw.random(n) < 1 / (1 + np.exp(-12 * table["x"]))).astype(int)
    fitted = fit_logistic("y ~ x + (1|g)", table)
    assert fitted.converged
    assert fitted.table["b"][1] == pytest.approx(12, abs=3 * fitted.table["se"][1])


def test_people_who_never_vary_are_warned_of() -> None:
    """Half always say yes, half always no: the deviation grows without end."""
    table = pd.DataFrame({"g": np.repeat(np.arange(20), 30), "x": np.tile(np.arange(30.0), 20)})
    table["y"] = table["g"] % 2
    fitted = fit_logistic("y ~ x + (1|g)", table)
    assert any("answer almost all alike" in warning for warning in fitted.warnings)


def test_one_row_per_level_is_warned_of_or_refused(table: pd.DataFrame) -> None:
    table = table.assign(row=np.arange(len(table)))
    with pytest.raises(BadInputError, match="as many levels as there are rows"):
        fit_linear("log_rt ~ elements + (1|row)", table)
    fitted = fit_logistic("correct ~ elements + (1|row)", table)
    assert any("hardly more rows than levels" in warning for warning in fitted.warnings)


def test_a_response_that_is_fully_explained_is_refused(table: pd.DataFrame) -> None:
    exact = table.assign(log_rt=3 + 2 * table["elements"])
    with pytest.raises(BadInputError, match="exactly"):
        fit_linear(f"log_rt ~ elements + {CROSSED}", exact)


def test_too_few_rows_are_refused(table: pd.DataFrame) -> None:
    with pytest.raises(BadInputError, match="too few"):
        fit_linear("log_rt ~ elements * distractors + (1|participant)", table.iloc[[0, 9, 40]])


def test_categories_that_do_not_occur_are_no_effects(table: pd.DataFrame) -> None:
    kinds = ["link", "support", "dominoes", "collide"]
    ordered = table.assign(scenario=pd.Categorical(table["scenario"], kinds))
    names = build_design(f"correct ~ scenario + {CROSSED}", ordered).names
    assert names == ("Intercept", "scenario[T.dominoes]", "scenario[T.collide]")


def test_columns_with_blanks_and_flags(table: pd.DataFrame) -> None:
    named = table.rename(columns={"elements": "number of elements", "participant": "the person"})
    named["flagged"] = named["the person"].isin(["p0001", "p0004"])
    formula = "correct ~ flagged + `number of elements` + (1|`the person`) + (1|stimulus)"
    fitted = fit_logistic(formula, named)
    assert list(fitted.table["term"]) == ["Intercept", "flagged", "number of elements"]
    assert list(fitted.effects) == ["the person", "stimulus"]


def test_unknown_terms_have_no_joint_test(table: pd.DataFrame) -> None:
    fitted = fit_linear(f"log_rt ~ scenario + {CROSSED}", table)
    with pytest.raises(UnknownNameError, match="scenario"):
        fitted.joint_test("scenarios")


def test_the_summary_says_what_was_fitted(table: pd.DataFrame) -> None:
    text = fit_linear(f"log_rt ~ scenario + {CROSSED}", table).summary()
    assert "240 rows (0 left out)" in text and "residual" in text and "converged" in text
