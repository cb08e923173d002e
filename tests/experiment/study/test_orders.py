"""Orders of blocks, draws of trials, and attention checks among them."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from physion.core.errors import BadInputError
from physion.experiment.study.orders import (
    block_orders,
    block_scenarios,
    instructed_response,
    seed_with_order,
    session_trials,
    trial_order,
)
from physion.experiment.study.settings import ALL_SCENARIOS, Attention, Blocks
from physion.experiment.study.stimuli import ATTENTION, STIMULI_FILE, write_stimuli
from physion.experiment.study.study import Study, load_study, write_settings
from support.experiment.tiny_study import make_tiny_study

THREE = ("collide", "drop", "roll")
SEEDS = range(7, 60_007, 1009)


@pytest.fixture(scope="module")
def blocks_study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """A study with three scenarios of 2 familiarization and 6 test trials each."""
    folder = tmp_path_factory.mktemp("blocks") / "study"
    return make_tiny_study(
        folder, test=6, familiarization=2, scenarios=THREE, size=32,
        blocks=Blocks(all_scenarios=True, trials=4),
    )  # fmt: skip


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7, 8])
def test_each_block_is_at_each_position_and_after_each_other_equally_often(count: int) -> None:
    orders = block_orders(count)
    assert all(sorted(order) == list(range(count)) for order in orders)
    assert len(set(orders)) == len(orders)
    at = Counter((place, block) for order in orders for place, block in enumerate(order))
    assert len(at) == count * count and len(set(at.values())) == 1
    after = Counter(pair for order in orders for pair in pairwise(order))
    assert len(after) == count * (count - 1) and len(set(after.values())) == 1
    assert len(orders) == {2: 2, 3: 6, 4: 24, 5: 10, 6: 6, 7: 14, 8: 8}[count]


def test_the_seed_of_a_session_determines_the_order_of_its_blocks(blocks_study: Study) -> None:
    for number in range(6):
        seed = seed_with_order(blocks_study, 2**63 - 1, number)
        assert 0 <= seed < 2**63
        scenarios = block_scenarios(blocks_study, ALL_SCENARIOS, seed)
        assert scenarios == tuple(THREE[index] for index in block_orders(3)[number])
    assert block_scenarios(blocks_study, "drop", 5) == ("drop",)


def test_test_trials_are_drawn_with_as_many_of_either_outcome(blocks_study: Study) -> None:
    seen: set[str] = set()
    for seed in SEEDS:
        trials = session_trials(blocks_study, ALL_SCENARIOS, seed)
        assert dict(trials) == {"familiarization": 6, "test": 12}
        order = trial_order(blocks_study, ALL_SCENARIOS, seed)
        for block in trials.blocks:
            part = [order["test"][trial] for trial in block.test]
            assert {each.scenario for each in part} == {block.scenario}
            assert len({each.stimulus for each in part}) == 4
            assert sum(each.label for each in part) == 2
            practice = [order["familiarization"][trial] for trial in block.familiarization]
            assert practice == list(blocks_study.phase(block.scenario, "familiarization"))
        seen |= {each.stimulus for each in order["test"]}
    assert len(seen) == 18, "every stimulus is drawn in some session"


def test_odd_numbers_and_rare_outcomes_still_fill_a_block(blocks_study: Study) -> None:
    odd = replace(blocks_study, blocks=Blocks(all_scenarios=True, trials=3))
    first = [trial_order(odd, ALL_SCENARIOS, seed)["test"][:3] for seed in SEEDS]
    assert {sum(each.label for each in part) for part in first} == {1, 2}
    stimuli = [s for s in blocks_study.stimuli if s.phase != "test" or s.place not in (0, 2)]
    # One stimulus with contact and three without are left in each scenario.
    short = replace(blocks_study, stimuli=tuple(stimuli))
    for seed in SEEDS:
        part = trial_order(short, ALL_SCENARIOS, seed)["test"][:4]
        assert len(part) == 4 and sum(each.label for each in part) == 1


def test_only_the_first_block_can_have_familiarization(blocks_study: Study) -> None:
    study = replace(blocks_study, blocks=Blocks(all_scenarios=True, familiarization="first"))
    trials = session_trials(study, ALL_SCENARIOS, 3)
    assert dict(trials) == {"familiarization": 2, "test": 18}
    assert [len(block.familiarization) for block in trials.blocks] == [2, 0, 0]
    order = trial_order(study, ALL_SCENARIOS, 3)["familiarization"]
    assert order == study.phase(trials.blocks[0].scenario, "familiarization")


def test_sessions_of_one_scenario_have_the_same_order_as_before(blocks_study: Study) -> None:
    plain = replace(blocks_study, blocks=Blocks())
    assert plain.offered == THREE
    order = trial_order(plain, "drop", 11)["test"]
    assert [each.place for each in order] == [4, 3, 5, 0, 1, 2]
    assert session_trials(plain, "drop", 11).blocks[0].test == range(6)


def test_settings_that_no_session_can_keep_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    study = make_tiny_study(
        folder, test=2, familiarization=1, scenarios=("collide", "drop"), size=32
    )
    plain = study.stimuli_digest

    def load(blocks: Blocks, **more: object) -> Study:
        write_settings(replace(study, blocks=blocks, **more))  # type: ignore[arg-type]
        return load_study(folder)

    with pytest.raises(BadInputError, match="at least two scenarios"):
        load(Blocks(all_scenarios=True), scenarios=("drop",))
    with pytest.raises(BadInputError, match=r"blocks\.trials is 3, but collide has 2"):
        load(Blocks(all_scenarios=True, trials=3))
    digests = {load(Blocks(True)).stimuli_digest, load(Blocks(True, "first")).stimuli_digest}
    digests |= {load(Blocks(True, trials=1)).stimuli_digest, plain}
    assert len(digests) == 4, "orders of trials depend on these settings"
    assert load(Blocks(trials=1)).stimuli_digest == plain
    same = [replace(s, stimulus=s.stimulus.replace("drop", "collide")) for s in study.stimuli]
    write_stimuli(folder / STIMULI_FILE, same)
    with pytest.raises(BadInputError, match="different names"):
        load(Blocks(all_scenarios=True))


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
        assert len(order) == session_trials(checked, "drop", seed)["test"] == 12
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


def test_each_block_has_its_checks(checked: Study) -> None:
    several = replace(checked, blocks=Blocks(all_scenarios=True))
    order = trial_order(several, "all scenarios", 5)["test"]
    trials = session_trials(several, "all scenarios", 5)
    assert len(order) == trials["test"] == 24
    names = [each.stimulus for each in order if each.phase == ATTENTION]
    assert len(set(names)) == 6
    for block in trials.blocks:
        part = [order[index] for index in block.test]
        assert {each.scenario for each in part} == {block.scenario}
        assert sum(each.phase == ATTENTION for each in part) == 3


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
