"""Baselines that know the outcome, what people answered, or whether the contact was seen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physion.core.errors import BadInputError
from physion.core.names import scenario_of
from physion.models import build_model
from physion.models.baselines.answers import read_people
from support.crossing_bodies import batch_of, crossing, some_crossings

DOMINOES = "pilot_dominoes_1mid_boxroom"


def write_humans(folder: Path, rows: str, labels: str | None) -> Path:
    """Write an official folder of people's answers, with outcomes in the folder next to it."""
    humans = folder / "humans"
    humans.mkdir()
    (humans / "human_accuracy-dominoes_pilot-production_1_testing.csv").write_text(rows)
    if labels is not None:
        (folder / "stimuli").mkdir()
        (folder / "stimuli" / "stimulus_names_and_labels.csv").write_text(labels)
    return humans


def test_outcome_is_that_of_the_whole_motion() -> None:
    batch = batch_of([crossing(touch=(50,)), crossing(), crossing(touch=(3, 4))])
    assert build_model("outcome").predict(batch).tolist() == [1, 0, 1]


def test_known_outcomes_replace_simulated_ones() -> None:
    names = ("known_img.mp4", "known", "pilot-redyellow_0001", "simulated")
    batch = batch_of([crossing(name=name, touch=(50,)) for name in names])
    model = build_model("outcome", outcomes={"known": False, "pilot_0001": False})
    assert model.predict(batch).tolist() == [0, 0, 0, 1]
    shown = model.with_outcomes({"known": True, "simulated": False})
    assert shown.predict(batch).tolist() == [0, 0, 0, 0], "the outcomes of the option come first"
    assert model.predict(batch).tolist() == [0, 0, 0, 1], "the model stays as it is"
    assert shown.digest() != model.digest()


def test_known_outcomes_need_no_motion() -> None:
    batch = batch_of([crossing(name="movie", agent=(float("nan"), 0.0, 0.0))])
    assert build_model("outcome", outcomes={"movie": True}).predict(batch).tolist() == [1]


def test_outcome_refuses_the_observed_part_of_an_unknown_trial() -> None:
    with pytest.raises(BadInputError, match="'cut': outcome needs the whole motion"):
        build_model("outcome").predict(batch_of([crossing(name="cut", frames=45)]))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"a": "yes"}, "outcome.a must be true or false"),
        ({"a": True, "a.mp4": False}, "'a' is there"),
    ],
)
def test_wrong_outcomes_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        build_model("outcome", outcomes=wrong)


def test_people_answer_as_the_mapping_says() -> None:
    model = build_model("majority-of-people", humans={"a": 0.25, "b_img.mp4": 1})
    batch = batch_of([crossing(name=name) for name in ("b", "a-redyellow", "b")])
    assert model.predict(batch).tolist() == [1, 0.25, 1]


def test_stimuli_that_nobody_answered_are_counted() -> None:
    batch = batch_of([crossing(name=name) for name in ("a", "b", "c")])
    with pytest.raises(BadInputError, match=r"answers of people to 2 of 3 stimuli.* 'b'"):
        build_model("majority-of-people", humans={"a": 0.25}).predict(batch)
    with pytest.raises(BadInputError, match=r"no answers at all.*option humans"):
        build_model("majority-of-people").predict(batch)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        *((value, "not a fraction from 0 to 1") for value in (1.5, -0.1)),
        *((value, "humans") for value in (float("nan"), "many", None)),
    ],
)
def test_fractions_lie_between_0_and_1(wrong: Any, says: str) -> None:
    with pytest.raises(BadInputError, match=says):
        build_model("majority-of-people", humans={"a": wrong})


def test_correct_answers_become_yes_by_the_outcome(tmp_path: Path) -> None:
    rows = f"stim_ID,correct,c\n{DOMINOES}_0001,0.9,10\n{DOMINOES}_0002,0.75,8\n"
    rows += f"{DOMINOES}-redyellow_0001,0.1,9\n"
    labels = f"stim_ID,label\n{DOMINOES}_0001,True\n{DOMINOES}_0002_img,False\n"
    people = read_people(write_humans(tmp_path, rows, labels))
    assert people == {f"{DOMINOES}_0001": 0.9, f"{DOMINOES}_0002": 0.25}


def test_a_table_of_fractions_is_read(tmp_path: Path) -> None:
    table = tmp_path / "people.csv"
    table.write_text("\ufeffstimulus,n,p_yes\na,7,0.5\nb_img.mp4,9,1\n", "utf-8")
    assert read_people(table) == {"a": 0.5, "b": 1.0}
    model = build_model("majority-of-people", humans=str(table))
    assert model.digest() == build_model("majority-of-people", humans={"a": 0.5, "b": 1.0}).digest()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,p_yes\na,0.5\n", "lacks the column 'stimulus'"),
        ("stim_ID,c\na,5\n", "lacks the column 'correct'"),
        ("stimulus,p_yes\na,0.5\na.mp4,0.5\n", "line 3: stimulus 'a' occurs twice"),
        ("stimulus,p_yes\na,1.5\n", "line 2: '1.5' is not a fraction"),
        ("stimulus,p_yes\na\n", "line 2: fewer values than columns"),
        ("stim_ID,correct\na,0.5\n", "line 2: the outcome of 'a'"),
        ("", "lacks the column 'stimulus'"),
    ],
)
def test_damaged_tables_are_refused(tmp_path: Path, text: str, message: str) -> None:
    table = tmp_path / "people.csv"
    table.write_text(text)
    with pytest.raises(BadInputError, match=message):
        read_people(table)


def test_missing_tables_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="holds no human_accuracy"):
        read_people(tmp_path)
    with pytest.raises(BadInputError, match=r"none\.csv: people's answers cannot be read"):
        read_people(tmp_path / "none.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadInputError, match="cannot be read"):
        read_people(tmp_path / "binary.csv")
    with pytest.raises(BadInputError, match="label 'perhaps' is not true or false"):
        read_people(write_humans(tmp_path, "stim_ID,correct\n", "stim_ID,label\na,perhaps\n"))


def test_official_people_have_the_known_accuracy(official: Path) -> None:
    """The majority is right for .808 of the stimuli of a scenario; r with the outcome is .683."""
    people = read_people(official / "humans")
    labels = {}
    for line in (official / "stimuli" / "stimulus_names_and_labels.csv").read_text().splitlines():
        cells = line.split(",")
        labels[cells[0].replace("-redyellow", "")] = cells[-1] == "True"
    known = sorted(people)
    p_yes = np.array([people[name] for name in known])
    outcomes = np.array([labels[name] for name in known])
    assert len(known) == 1144
    assert np.corrcoef(p_yes, outcomes)[0, 1] == pytest.approx(0.683, abs=0.001)
    scenarios = np.array([scenario_of(name) for name in known])
    right = ((p_yes > 0.5) == outcomes) | (p_yes == 0.5)
    means = [right[scenarios == scenario].mean() for scenario in set(scenarios)]
    assert len(means) == 8 and np.mean(means) == pytest.approx(0.808, abs=0.005)


def test_base_rate_is_that_of_trials_that_had_not_touched() -> None:
    seen, later = crossing(touch=(44,)), crossing(touch=(45,))
    fit = batch_of([seen, seen, later, later, later, later])
    labels = np.array([True, True, True, False, False, False])
    model = build_model("already-touched", margin=0.05).fit(fit, labels, 0)
    assert model.predict(batch_of([later, seen])).tolist() == [0.25, 0.95]


@pytest.mark.parametrize(("labels", "rate"), [([], 0.5), ([False], 0.01), ([True], 0.99)])
def test_base_rate_stays_within_the_margin(labels: list[bool], rate: float) -> None:
    model = build_model("already-touched").fit(
        batch_of([crossing()] * len(labels)), np.array(labels, bool), 0
    )
    assert model.predict(batch_of([crossing()])).tolist() == [rate]


def test_permuted_outcomes_leave_the_base_rate() -> None:
    fit, labels = some_crossings(80, 4)
    permuted = np.random.default_rng(0).permutation(labels)
    predicted = build_model("already-touched").fit(fit, permuted, 0).predict(fit)
    assert np.unique(predicted) == pytest.approx(labels.mean())


@pytest.mark.parametrize("margin", [-0.1, 0.5, float("nan")])
def test_wrong_margins_are_refused(margin: float) -> None:
    with pytest.raises(BadInputError, match="margin"):
        build_model("already-touched", margin=margin)


def test_labels_must_fit_the_trials() -> None:
    with pytest.raises(BadInputError, match="2 labels for 1 trials"):
        build_model("already-touched").fit(batch_of([crossing()]), np.array([True, False]), 0)
