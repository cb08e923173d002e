"""Scores of pairs of a trial and its variant, from cases counted by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from physion.readout.whatif import causes, causes_line, whatif_scores

P = {
    # name: P(contact), outcome, contact in the observed part
    "a": (0.9, True, False),
    "a+remove.x": (0.2, False, False),  # changed, both right, moved rightly
    "a+remove.y": (0.8, False, False),  # changed, wrong, but moved rightly
    "a+mass.quarter": (0.7, True, False),  # equal, moved by .2
    "b": (0.4, True, False),
    "b+remove.x": (0.6, False, False),  # changed, both wrong, moved wrongly
    "b+remove.y": (0.4, False, False),  # changed, trial wrong, not moved
    "b+push.weaker": (0.4, True, False),  # equal, not moved, wrong
    "b+push.stronger": (0.9, True, True),  # left out
    "c": (0.9, True, True),  # left out with its variant
    "c+remove.x": (0.1, False, False),
    "d": (0.9, True, False),  # no variant
}


def table(model: str = "m", **changed: float) -> pd.DataFrame:
    rows = [
        {"model": model, "readout": "observed", "protocol": "", "seed": "", "stimulus": name,
         "p_contact": changed.get(name, p), "outcome": outcome, "observed_contact": early}
        for name, (p, outcome, early) in P.items()
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_every_measure_is_counted_by_hand() -> None:
    scores = whatif_scores(table()).set_index("change")
    assert list(scores.index) == ["all", "mass", "push", "remove"]
    whole, removed = scores.loc["all"], scores.loc["remove"]
    assert (whole["pairs"], whole["changed"]) == (6, 4)
    assert (removed["pairs"], removed["changed"]) == (4, 4)
    assert whole["accuracy"] == pytest.approx(3 / 6)
    assert removed["accuracy"] == pytest.approx(2 / 4)
    assert removed["paired"] == pytest.approx(1 / 4)
    assert removed["moved"] == pytest.approx((1 + 1 + 0 + 0.5) / 4)
    assert whole["unmoved"] == pytest.approx((0.8 + 1) / 2)
    assert scores.loc["mass", "unmoved"] == pytest.approx(0.8)
    assert np.isnan(scores.loc["mass", "unmoved_se"]) and np.isnan(removed["unmoved"])
    # Two trials, a and b, with residual sums 1 and -1 of `moved` - .625 = .75: 2 / 1 * 2 * .75^2.
    assert removed["moved_se"] == pytest.approx(np.sqrt(2 * 2 * 0.75**2) / 4)


def test_a_body_without_which_the_outcome_is_another_is_a_cause() -> None:
    more = pd.DataFrame(
        [{"model": "m", "readout": "observed", "protocol": "", "seed": "", "stimulus": name,
          "p_contact": 0.5, "outcome": outcome, "observed_contact": False}
         for name, outcome in [("e", False), ("e+remove.x", True), ("e+remove.ramp.2", False)]]
    )  # fmt: skip
    found = causes(pd.concat([table(), table("other"), more]))
    assert [tuple(row) for row in found.itertuples(index=False)] == [
        ("a", "x", True, False, True),
        ("a", "y", True, False, True),
        ("b", "x", True, False, True),
        ("b", "y", True, False, True),
        ("e", "ramp.2", False, False, False),
        ("e", "x", False, True, True),
    ]
    assert list(found) == ["trial", "removed", "before", "after", "changed"]
    assert causes_line(found) == (
        "5 of 6 removals change the outcome: x 3 of 3, y 2 of 2, ramp.2 0 of 1"
    )
    assert causes(table().iloc[:0]).empty and list(causes(table().iloc[:0])) == list(found)


def test_trials_of_a_test_with_two_cues_are_a_pair() -> None:
    cues = {
        "e": (0.9, False, False),  # in no pair
        "e+cue-mass.0.0": (0.2, False, False),  # both right
        "e+cue-mass.0.1": (0.8, True, False),
        "e+cue-mass.1.0": (0.6, True, False),  # first right, moved wrongly
        "e+cue-mass.1.1": (0.7, False, False),
        "e+cue-friction.0.0": (0.5, True, True),  # left out with the other
        "e+cue-friction.0.1": (0.5, False, False),
        "f+cue-mass.1.0": (0.3, False, False),  # first right, not moved
        "f+cue-mass.1.1": (0.3, True, False),
    }
    rows = [
        {"model": "m", "readout": "observed", "protocol": "", "seed": "", "stimulus": name,
         "p_contact": p, "outcome": outcome, "observed_contact": early}
        for name, (p, outcome, early) in cues.items()
    ]  # fmt: skip
    scores = whatif_scores(pd.DataFrame(rows)).set_index("change")
    assert list(scores.index) == ["all", "cue-mass"]
    mass = scores.loc["cue-mass"]
    assert (mass["pairs"], mass["changed"]) == (3, 3)
    assert mass["accuracy"] == pytest.approx((1 + 0.5 + 0.5) / 3)
    assert mass["paired"] == pytest.approx(1 / 3)
    assert mass["moved"] == pytest.approx((1 + 0 + 0.5) / 3)
    # Two trials, e with two pairs and f with one, with residual sums 1/3 and -1/3 of `paired`.
    assert mass["paired_se"] == pytest.approx(np.sqrt(2 * 2 / 9) / 3)


def test_models_are_scored_apart_and_sets_without_variants_not() -> None:
    both = pd.concat([table("m"), table("always", **dict.fromkeys(P, 0.9))])
    scores = whatif_scores(both).set_index(["model", "change"])
    always = scores.loc["always", "all"]
    assert (always["paired"], always["moved"], always["unmoved"]) == (0, 0.5, 1)
    assert always["accuracy"] == pytest.approx(2 / 6)
    plain = table()
    assert whatif_scores(plain[~plain["stimulus"].str.contains("+", regex=False)]).empty
    assert list(whatif_scores(table().iloc[:0]).columns)[:3] == ["model", "readout", "change"]
