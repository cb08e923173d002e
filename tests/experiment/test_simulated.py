"""Simulated participants: their answers, and the rows of a simulation in the database."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from pathlib import Path

import httpx2
import numpy as np
import pytest

from physion.cli.main import main
from physion.core.seeds import generator
from physion.experiment.protocol import TrialMedia
from physion.experiment.server_process import ServerProcess
from physion.experiment.simulated import (
    SimulatedPerson,
    SimulatedVisit,
    SimulationPlan,
    build_answer,
    minutes_each,
    simulate,
)
from physion.experiment.study.identity import Secrets
from physion.experiment.study.settings import Attention, Plausibility, Practice
from physion.experiment.study.stimuli import Stimulus
from physion.experiment.study.study import Study
from support.experiment.experimenter_client import BASE
from support.experiment.own_questions import (
    COMPREHENSION,
    COMPREHENSION_TEXTS,
    OWN_QUESTIONS,
    OWN_TEXTS,
)
from support.experiment.serving import stored_answers, stored_sessions
from support.experiment.tiny_study import PASSWORD, make_tiny_study

COLUMNS_OF_PREDICTIONS = (
    "Model,Readout Type,Readout Test Data,Predicted Prob_true,Predicted Outcome,Actual Outcome,"
    "Stimulus Name"
)


def made_stimulus(number: int, label: bool) -> Stimulus:
    return Stimulus(
        stimulus=f"stimulus-{number}", scenario="collide", phase="test", place=number, label=label,
        movie="", map="", full="", frames=45, full_frames=0, rate=30.0, width=8, height=8,
        look="free",
    )  # fmt: skip


def test_a_person_answers_the_same_again_and_others_differ() -> None:
    stimuli = [made_stimulus(number, number % 2 == 0) for number in range(40)]
    first = [SimulatedPerson(0, 1).predict(stimulus) for stimulus in stimuli]
    assert first == [SimulatedPerson(0, 1).predict(stimulus) for stimulus in stimuli]
    assert first != [SimulatedPerson(0, 2).predict(stimulus) for stimulus in stimuli]
    assert first != [SimulatedPerson(1, 1).predict(stimulus) for stimulus in stimuli]
    assert {one.response for one in first} == {"yes", "no"}


@pytest.mark.slow
def test_people_are_right_as_often_as_they_should_be_and_slower_where_it_is_hard() -> None:
    people = [SimulatedPerson(0, number) for number in range(100)]
    stimuli = [made_stimulus(number, number % 2 == 0) for number in range(60)]
    expected = np.array([[p.probability_correct(s) for s in stimuli] for p in people])
    answers = [[p.predict(s) for s in stimuli] for p in people]
    right = np.array([[(a.response == "yes") == s.label for a, s in zip(row, stimuli, strict=True)]
                      for row in answers])  # fmt: skip
    rt = np.array([[a.rt_ms for a in row] for row in answers])
    # 6000 draws: the mean is within 0.02 (3 standard errors) of its expectation without bias.
    assert abs(right.mean() - expected.mean()) < 0.02
    assert 0.65 < right.mean() < 0.8
    easy = expected.mean(axis=0) > np.median(expected.mean(axis=0))
    assert right[:, easy].mean() > right[:, ~easy].mean() + 0.15
    assert np.log(rt[:, easy]).mean() < np.log(rt[:, ~easy]).mean()
    assert rt.min() > 0


@pytest.mark.nightly
@pytest.mark.slow
def test_answers_follow_the_rasch_model_and_log_normal_times() -> None:
    people = [SimulatedPerson(0, number) for number in range(200)]
    stimuli = [made_stimulus(number, number % 2 == 0) for number in range(60)]
    chance = np.array([[p.probability_correct(s) for s in stimuli] for p in people])
    log_odds = np.log(chance / (1 - chance))
    # The sum of a person and a stimulus: differences of people are the same for all stimuli.
    ability = log_odds[:, :1] - log_odds[:1, :1]
    np.testing.assert_allclose(log_odds - ability, np.broadcast_to(log_odds[:1], chance.shape))
    assert np.std(log_odds[:, 0]) == pytest.approx(0.35, rel=0.15)  # standard error 5 %
    assert np.std(log_odds[0]) == pytest.approx(1.3, rel=0.3)  # standard error 9 %
    easiness = [generator("easiness", s.stimulus).normal(0, 1.3) for s in stimuli]
    assert (log_odds - easiness).mean() == pytest.approx(1.2, abs=0.075)  # standard error 0.025
    # A bias towards yes does not change how often both outcomes together are right.
    rt = np.array([[p.predict(s).rt_ms for s in stimuli] for p in people])
    rest = np.log(rt) - 0.4 * (1 - chance)
    assert rest.mean() == pytest.approx(6.6, abs=0.04)  # 735 ms; standard error 0.01
    assert np.std(rest.mean(axis=1)) == pytest.approx(0.2, rel=0.15)
    assert np.std(rest - rest.mean(axis=1, keepdims=True)) == pytest.approx(0.35, rel=0.03)


def test_an_answer_is_what_the_pages_would_send() -> None:
    media = TrialMedia(
        trial=3, movie="", map="", frames=45, rate=30.0, width=8, height=8, fixation_ms=700
    )
    stimulus = made_stimulus(0, True)
    for number, by in ((1, "keyboard"), (2, "mouse")):
        person = SimulatedPerson(0, number)
        found = build_answer(2000, media, "test", person, stimulus)
        drawn = person.predict(stimulus)
        assert (found.response, found.rt_ms, found.input) == (drawn.response, drawn.rt_ms, by)
        assert (found.trial, found.fixation_ms, found.cue_ms) == (3, 700, 2000)
        assert (found.frames_shown, found.frames_dropped) == (45, 0)
        times = found.details["frames_ms"]
        assert times == pytest.approx([frame * 1000 / 30 for frame in range(45)], abs=0.051)
        assert found.movie_ms == times[-1]
    # Attention checks are answered as they ask, whatever the person would predict.
    people = [SimulatedPerson(0, number) for number in range(20)]
    for label in (True, False):
        check = replace(made_stimulus(0, label), phase="attention")
        answers = {build_answer(0, media, "test", person, check).response for person in people}
        assert answers == {"yes" if label else "no"}


def test_a_fraction_of_the_people_leaves() -> None:
    leaving = [SimulatedPerson(0, n).dropout_trial(150, 0.1) for n in range(1000)]
    trials = [trial for trial in leaving if trial is not None]
    assert 70 < len(trials) < 130
    assert min(trials) >= 0 and max(trials) < 150 and len(set(trials)) > 30
    assert all(SimulatedPerson(0, n).dropout_trial(150, 0.0) is None for n in range(100))
    # Before any of the trials, the first and the last too.
    assert {SimulatedPerson(0, n).dropout_trial(3, 1.0) for n in range(50)} == {0, 1, 2}


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    folder = tmp_path_factory.mktemp("simulated") / "study"
    return make_tiny_study(
        folder, test=4, familiarization=2, scenarios=("collide", "drop"),
        plausibility=Plausibility(simulated_speed=200.0),
    )  # fmt: skip


@pytest.fixture(scope="module")
def visits(study: Study) -> tuple[list[SimulatedVisit], list[SimulatedVisit]]:
    """Run two simulations on one server: some people leave, then they come back."""
    secrets = Secrets.load(study.folder)
    with ServerProcess(study.folder) as server:
        plan = SimulationPlan(url=server.url, participants=8, dropouts=0.5, seed=5)
        first = asyncio.run(simulate(study, secrets, plan))
        second = asyncio.run(simulate(study, secrets, replace(plan, dropouts=0.0)))
    return first, second


@pytest.mark.slow
def test_people_leave_and_come_back_and_are_simulated_in_the_data_for_good(
    study: Study, visits: tuple[list[SimulatedVisit], list[SimulatedVisit]]
) -> None:
    first, second = visits
    assert {visit.outcome for visit in first} == {"done", "left"}
    assert {visit.scenario for visit in first} == {"collide", "drop"}
    labels = {s.stimulus: s.label for s in study.stimuli}
    for before, after in zip(first, second, strict=True):
        assert after.outcome == ("done before" if before.outcome == "done" else "done"), after
        assert len(before.answers) + len(after.answers) == 6
        if before.result is not None:
            right = [(a.response == "yes") == labels[a.stimulus]
                     for a in before.answers if a.phase == "test"]  # fmt: skip
            assert len(right) == 4 and before.result.correct == sum(right)
    sessions = stored_sessions(study)
    assert len(sessions) == 8 and {session.kind for session in sessions.values()} == {"simulated"}
    assert all(session.finished_at for session in sessions.values())
    # They behave as browsers do: nothing about their sessions is impossible.
    assert {session.implausible for session in sessions.values()} == {None}
    stored = stored_answers(study)
    assert len(stored) == 48
    for visit in (*first, *second):
        for answer in visit.answers:
            row = stored[visit.reference, answer.phase, answer.trial]
            sent = (answer.key, answer.stimulus, answer.response, answer.rt_ms, 1)
            assert (row.key, row.stimulus, row.response, row.rt_ms, row.showings) == sent


@pytest.mark.slow
@pytest.mark.parametrize("with_sessions", [False, True])
@pytest.mark.usefixtures("visits")
def test_models_are_not_compared_with_only_simulated_participants(
    study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str], with_sessions: bool
) -> None:
    data, predictions = tmp_path / "data", tmp_path / "m.csv"
    assert main(["experiment", "export", str(study.folder), "--out", str(data)]) == 0
    rows = [f"m,B,{s.scenario},0.9,True,{s.label},{s.stimulus}" for s in study.stimuli]
    predictions.write_text("\n".join([COLUMNS_OF_PREDICTIONS, *rows]) + "\n")
    words = ["compare", str(predictions), "--responses", str(data / "trials.csv")]
    words += ["--sessions", str(data / "sessions.csv")] if with_sessions else []
    capsys.readouterr()
    assert main([*words, "--out", str(tmp_path / "report")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and str(data / "trials.csv") in said
    assert "only simulated participants were found (8 sessions)" in said
    assert "export the study again" in said
    assert not (tmp_path / "report").exists()


@pytest.mark.nightly
@pytest.mark.slow
def test_the_verb_serves_by_itself_and_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_tiny_study(tmp_path / "study", test=2, familiarization=1).folder
    words = ["experiment", "simulate", str(folder), "--participants", "3", "--dropouts", "0"]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["done"], found["answers"], found["reasons"]) == (3, 9, {})
    assert 0 <= found["mean_accuracy"] <= 1
    assert main(words) == 0
    assert "3 done before" in capsys.readouterr().out


def test_without_leave_of_the_study_they_take_their_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    real = make_tiny_study(tmp_path / "real", plausibility=Plausibility())
    # 16 trials of 1 s cross, 2 s cue, 1.5 s movie and some 0.8 s to answer, 10 s of reading,
    # and ten full movies of 2 s.
    assert minutes_each(real, "collide") == pytest.approx((16 * 5.3 + 10 + 20) / 60, rel=0.05)
    fast = replace(real, plausibility=Plausibility(simulated_speed=100.0))
    assert minutes_each(fast, "collide") == pytest.approx(minutes_each(real, "collide") / 100)


@pytest.mark.nightly
@pytest.mark.slow
def test_another_study_s_server_refuses_the_pilot_link(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = make_tiny_study(tmp_path / "mine", test=2, familiarization=1)
    other = make_tiny_study(tmp_path / "other", test=2, familiarization=1)
    with ServerProcess(other.folder) as server:
        words = ["--participants", "2", "--url", server.url]
        assert main(["experiment", "simulate", str(mine.folder), *words]) == 1
    out = capsys.readouterr().out
    assert "2 refused" in out and "bad_link" in out
    assert not stored_sessions(other)


@pytest.mark.parametrize(
    ("words", "option"),
    [("--participants 0", "--participants"), ("--dropouts 1.5", "--dropouts"),
     ("--scenario colide --url http://127.0.0.1:1", "collide")],
)  # fmt: skip
def test_bad_options_are_refused(
    study: Study, words: str, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["experiment", "simulate", str(study.folder), *words.split()]) == 2
    assert option in capsys.readouterr().err


@pytest.mark.nightly
@pytest.mark.slow
def test_simulated_participants_pass_all_checks(tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path, test=3, familiarization=1, obvious=1, size=64, languages=("en",),
        attention=Attention(instructed=1), practice=Practice(min_correct=1, failed="flag"),
        comprehension_questions=COMPREHENSION, questions=OWN_QUESTIONS,
        more_texts=COMPREHENSION_TEXTS + OWN_TEXTS,
    )  # fmt: skip
    with ServerProcess(study.folder) as server:
        plan = SimulationPlan(server.url, participants=4, dropouts=0.0)
        done = asyncio.run(simulate(study, Secrets.load(study.folder), plan))
        assert {visit.outcome for visit in done} == {"done"}
        assert all(visit.result is not None and visit.result.trials == 3 for visit in done)
        sessions = list(stored_sessions(study).values())
        with httpx2.Client(base_url=server.url, follow_redirects=True, timeout=60) as client:
            own = {"origin": server.url}
            client.post(f"{BASE}/login", data={"password": PASSWORD}, headers=own)
            page = client.get(f"{BASE}/sessions/{sessions[0].session}").text
    assert {row.attention_failed for row in sessions} == {0}
    assert {row.comprehension_attempts for row in sessions} == {1}
    assert all(set(row.own_answers) == {each.name for each in OWN_QUESTIONS} for row in sessions)
    for text in ("instructed_1_", "attention", "Failed checks"):
        assert text in page
