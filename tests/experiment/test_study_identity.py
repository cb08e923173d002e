"""Keys, hashes, signatures, trial orders with their checks, and signed media URLs."""

from __future__ import annotations

import os
import re
import stat
from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from physion.core.errors import BadInputError
from physion.experiment.study.identity import (
    SECRET_FILE,
    Secrets,
    check_password,
    check_signature,
    hash_token,
    new_reference,
    new_token,
    participant_hash,
    set_password,
    sign,
)
from physion.experiment.study.media import read_media_path, sign_media
from physion.experiment.study.orders import (
    draw_buttons,
    fixations,
    individual_order_seed,
    instructed_response,
    prepared_order_seed,
    session_trials,
    trial_order,
)
from physion.experiment.study.settings import Attention, Timing
from physion.experiment.study.stimuli import ATTENTION, STIMULI_FILE
from physion.experiment.study.study import Study, load_study, write_settings
from support.experiment.tiny_study import make_tiny_study

KEYS = Secrets(b"a" * 32, b"b" * 32)


def test_keys_are_kept_only_for_their_owner(tmp_path: Path) -> None:
    made = Secrets.create(tmp_path, "a long password")
    path = tmp_path / SECRET_FILE
    assert Secrets.load(tmp_path) == made
    assert b"a long password" not in path.read_bytes()
    assert "a long" not in repr(made) and made.hash_key.hex() not in repr(made)
    with pytest.raises(BadInputError, match="there already"):
        Secrets.create(tmp_path, "another password")
    if os.name == "posix":
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        path.chmod(0o640)
        with pytest.raises(BadInputError, match="chmod 600"):
            Secrets.load(tmp_path)


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"version": 1, "hash_key": "zz"}',
                                     b'{"version": 2}', b"\xff", b"[" * 5000])  # fmt: skip
def test_damaged_keys_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / SECRET_FILE
    with pytest.raises(BadInputError, match="there is no"):
        Secrets.load(tmp_path)
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(BadInputError, match=r"damaged|version"):
        Secrets.load(tmp_path)


def test_passwords(tmp_path: Path) -> None:
    secrets = Secrets.create(tmp_path)
    assert not check_password(secrets, "")
    changed = set_password(tmp_path, "first password")
    assert (changed.hash_key, changed.link_key) == (secrets.hash_key, secrets.link_key)
    assert changed.password_hash.startswith("$argon2id$")
    assert check_password(Secrets.load(tmp_path), "first password")
    for wrong in ("first passwor", "", "x" * 5000, "\ud800 first password"):
        assert not check_password(changed, wrong)
    with pytest.raises(BadInputError, match="8 to"):
        set_password(tmp_path, "short")
    assert not check_password(replace(changed, password_hash="no hash"), "first password")


@given(st.lists(st.text(max_size=20), min_size=1, max_size=4),
       st.lists(st.text(max_size=20), min_size=1, max_size=4))  # fmt: skip
def test_signatures_are_of_the_words_and_their_bounds(one: list[str], other: list[str]) -> None:
    assert check_signature(KEYS, sign(KEYS, *one), *one)
    assert check_signature(KEYS, sign(KEYS, *one), *other) == (one == other)
    assert not check_signature(replace(KEYS, link_key=b"c" * 32), sign(KEYS, *one), *one)


def test_hashes_need_the_key_and_keep_sources_apart() -> None:
    hashed = participant_hash(KEYS, "prolific", "5f1e")
    assert re.fullmatch("[0-9a-f]{32}", hashed)
    assert hashed == participant_hash(KEYS, "prolific", "5f1e")
    others = {
        participant_hash(KEYS, "sona", "5f1e"),
        participant_hash(KEYS, "prolific5", "f1e"),
        participant_hash(replace(KEYS, hash_key=b"c" * 32), "prolific", "5f1e"),
    }
    assert len(others) == 3 and hashed not in others


def test_tokens_and_references_do_not_repeat() -> None:
    assert len({new_token() for _ in range(1000)}) == 1000
    assert len({new_reference() for _ in range(1000)}) == 1000
    assert re.fullmatch("[2-9A-HJ-NP-Z]{4}-[2-9A-HJ-NP-Z]{4}", new_reference())
    assert len(hash_token("\ud800")) == 64  # whatever a header holds


def test_orders_depend_only_on_the_seed(small_study: Study) -> None:
    order = trial_order(small_study, "collide", 11)
    assert order["familiarization"] == small_study.phase("collide", "familiarization")
    assert set(order["test"]) == set(small_study.phase("collide", "test"))
    shuffled = replace(small_study, stimuli=small_study.stimuli[::-1])
    assert trial_order(shuffled, "collide", 11) == order
    # Pinned: an upgrade must not change the order of a session that is under way.
    assert [stimulus.place for stimulus in order["test"]] == [1, 0, 3, 2]
    assert session_trials(small_study, "drop") == {"familiarization": 3, "test": 4}


def test_every_order_is_as_likely(small_study: Study) -> None:
    seeds = [
        individual_order_seed(small_study, "drop", f"person {number}") for number in range(4800)
    ]
    assert all(0 <= seed < 2**63 for seed in seeds)
    orders = Counter(
        tuple(stimulus.place for stimulus in trial_order(small_study, "drop", seed)["test"])
        for seed in seeds
    )
    assert len(orders) == 24
    # 200 expected each, standard deviation 13.8.
    assert min(orders.values()) > 140 and max(orders.values()) < 260


def test_seeds_differ_by_study_scenario_and_participant(small_study: Study) -> None:
    other = replace(small_study, seed=1)
    seeds = {
        individual_order_seed(study, scenario, person)
        for study in (small_study, other)
        for scenario in ("collide", "drop")
        for person in ("a", "b")
    } | {prepared_order_seed(small_study, KEYS, "drop", number) for number in range(1, 126)}
    assert len(seeds) == 8 + 125
    # Few as they are, nobody without the key may try them all against what is shown.
    other_key = replace(KEYS, link_key=b"x" * 32)
    assert prepared_order_seed(small_study, other_key, "drop", 1) not in seeds


def test_fixations_lie_within_the_timing(small_study: Study) -> None:
    long = replace(small_study, timing=Timing(fixation_ms=(500, 502)))
    drawn = Counter(
        cross for seed in range(300) for cross in fixations(long, "collide", seed, "test")
    )
    assert set(drawn) == {500, 501, 502}
    assert min(drawn.values()) > 330  # of 1200, 400 expected
    # Drawn anew for each trial of either phase.
    usual = [fixations(small_study, "collide", 1, phase) for phase in ("familiarization", "test")]
    assert len({*usual[0], *usual[1]}) == len(usual[0]) + len(usual[1])
    assert usual[1] != fixations(small_study, "collide", 2, "test")
    without = replace(small_study, timing=Timing(fixation_in_familiarization=False))
    assert fixations(without, "collide", 1, "familiarization") == (0, 0, 0)


def test_buttons_are_a_fair_coin_for_each_participant(small_study: Study) -> None:
    drawn = Counter(draw_buttons(small_study, str(number)) for number in range(1000))
    assert set(drawn) == {"yes-no", "no-yes"} and min(drawn.values()) > 430


def test_addresses_of_media_lead_to_the_files(small_study: Study) -> None:
    for phase, kinds in (("familiarization", ("movie", "map", "full")), ("test", ("movie", "map"))):
        for trial, stimulus in enumerate(trial_order(small_study, "drop", 77)[phase]):
            for kind in kinds:
                path = sign_media(small_study, KEYS, "drop", 77, phase, trial, kind)
                expected = small_study.folder / getattr(stimulus, kind)
                assert read_media_path(small_study, KEYS, path) == expected
                assert stimulus.stimulus not in path and "drop" not in path


def test_other_addresses_lead_nowhere(small_study: Study) -> None:
    good = sign_media(small_study, KEYS, "drop", 77, "test", 0, "movie")
    practice = sign_media(small_study, KEYS, "drop", 77, "familiarization", 0, "movie")
    *_, hidden, tag, signature = good.split("-")
    bad = [
        good.replace("t-0-", "t-1-"), good.replace("t-0-", "t-00-"), good.replace("t-0-", "f-0-"),
        good.replace("movie", "map"), good.replace("movie", "full"),
        good.replace(hidden, f"{int(hidden, 16) ^ 1:016x}"), good.replace(hidden, "0" * 16),
        good.replace(tag, "f" * 16), good.replace(signature, f"{int(signature, 16) ^ 1:032x}"),
        practice.replace("movie", "full"), good + "0", good[:-1], good.upper(), good + "\n",
        good.replace("/media/", "/media/../"), "/media/../secret.json", "", "/media/", "\ud800",
        good.replace("t-0-", "t-٠-"), "/media/media/00000.mp4",
        sign_media(replace(small_study, scenarios=("a", "b")), KEYS, "b", 1, "test", 0, "map"),
        sign_media(small_study, KEYS, "drop", 77, "test", 99, "map"),
        sign_media(small_study, KEYS, "drop", 2**64 - 1, "test", 99, "map"),
    ]  # fmt: skip
    assert len(set(bad)) == len(bad) and good not in bad
    for path in bad:
        with pytest.raises(BadInputError, match="no such"):
            read_media_path(small_study, KEYS, path)


def test_an_address_never_means_another_movie(small_study: Study) -> None:
    path = sign_media(small_study, KEYS, "drop", 77, "test", 0, "movie")
    expected = read_media_path(small_study, KEYS, path)
    # Scenarios in another order, one more of them: the same movie.
    for scenarios in (("drop", "collide"), ("roll", "collide", "drop"), ("drop",)):
        changed = replace(small_study, scenarios=scenarios)
        assert read_media_path(changed, KEYS, path) == expected
    # Without the scenario, or with other stimuli: none.
    for other in (
        replace(small_study, scenarios=("collide",)),
        replace(small_study, stimuli_digest="0" * 64),
    ):
        with pytest.raises(BadInputError, match="no such"):
            read_media_path(other, KEYS, path)


def test_addresses_tell_nothing_of_the_seed(small_study: Study) -> None:
    """Check that the hidden part looks random and depends on seed, position and key."""
    hidden: dict[tuple[int, int, str], int] = {}
    for seed in range(200):
        for trial in range(4):
            for kind in ("movie", "map"):
                path = sign_media(small_study, KEYS, "drop", seed, "test", trial, kind)
                place, trial_shown, kind_shown, word, *_ = path[7:].split("-")
                assert (place, trial_shown, kind_shown) == ("t", str(trial), kind)
                hidden[seed, trial, kind] = int(word, 16)
    words = list(hidden.values())
    # Were a pad used twice, the difference of two words would be that of their seeds.
    assert len(set(words)) == len(words)
    pairs = list(combinations(list(hidden.items())[::7], 2))
    assert all(one ^ two != a[0] ^ b[0] for (a, one), (b, two) in pairs)
    # Each bit is set in half of 1600 words, whose seeds have 56 bits that are never set:
    # 800 expected, standard deviation 20.
    for bit in range(64):
        assert 690 < sum(word >> bit & 1 for word in words) < 910
    other_key = replace(KEYS, link_key=b"x" * 32)
    again = sign_media(small_study, other_key, "drop", 3, "test", 0, "movie").split("-")
    assert int(again[3], 16) != hidden[3, 0, "movie"]


# --- orders with attention checks -----------------------------------------------------------------


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
