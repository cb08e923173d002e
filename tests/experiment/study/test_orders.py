"""Orders of trials, and attention checks among them."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from physion.core.errors import BadInputError
from physion.experiment.study.orders import instructed_response, session_trials, trial_order
from physion.experiment.study.settings import Attention
from physion.experiment.study.stimuli import ATTENTION, STIMULI_FILE
from physion.experiment.study.study import Study, load_study, write_settings
from support.experiment.tiny_study import make_tiny_study


def test_the_seed_determines_the_order_of_the_test(tmp_path: Path) -> None:
    study = make_tiny_study(tmp_path, test=6, familiarization=2, scenarios=("drop",), size=32)
    order = trial_order(study, "drop", 11)
    assert [each.place for each in order["test"]] == [4, 3, 5, 0, 1, 2]
    assert order["familiarization"] == study.phase("drop", "familiarization")
    assert session_trials(study, "drop") == {"familiarization": 2, "test": 6}


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory) -> Study:
    folder = tmp_path_factory.mktemp("study")
    return make_tiny_study(
        folder, test=9, familiarization=2, obvious=1, scenarios=("collide", "drop"), size=64,
        attention=Attention(instructed=2),
    )  # fmt: skip


def test_checks_are_spread_over_the_test(checked: Study) -> None:
    plain = replace(checked, attention=Attention(), stimuli=tuple(
        each for each in checked.stimuli if each.phase != ATTENTION
    ))  # fmt: skip
    positions: Counter[int] = Counter()
    asked: Counter[str | None] = Counter()
    for seed in range(300):
        order = trial_order(checked, "drop", seed)["test"]
        assert len(order) == session_trials(checked, "drop")["test"] == 12
        kept = tuple(each for each in order if each.phase == "test")
        assert kept == trial_order(plain, "drop", seed)["test"]
        at = [index for index, each in enumerate(order) if each.phase == ATTENTION]
        assert [1 <= low <= 3 for low in at[:1]] == [True]
        assert 5 <= at[1] <= 7 and 9 <= at[2] <= 11
        positions.update(at)
        asked.update(instructed_response(order[index].stimulus) for index in at)
        for index in at:
            response = instructed_response(order[index].stimulus)
            assert response is None or order[index].label == (response == "yes")
            assert not order[index].full
        assert order == trial_order(checked, "drop", seed)["test"]
    assert min(positions[index] for index in (1, 2, 3, 5, 6, 7, 9, 10, 11)) > 60
    assert asked[None] == 300 and min(asked["yes"], asked["no"]) > 200


def test_checks_belong_to_the_stimuli_of_a_study(tmp_path: Path) -> None:
    study = make_tiny_study(tmp_path, test=2, familiarization=1, size=64)
    write_settings(replace(study, attention=Attention(instructed=1)))
    assert load_study(tmp_path).stimuli_digest != study.stimuli_digest
    write_settings(replace(study, attention=Attention(max_failed=3)))
    assert load_study(tmp_path).stimuli_digest == study.stimuli_digest
    path = tmp_path / STIMULI_FILE
    path.write_text(path.read_text().replace(",test,", ",attenton,"))
    with pytest.raises(BadInputError, match="familiarization or test or attention"):
        load_study(tmp_path)
