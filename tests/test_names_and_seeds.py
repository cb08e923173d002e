"""Registries find, refuse and suggest; seeds depend on what is made and on nothing else."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physion.core.errors import PhysionError, UnknownNameError
from physion.core.registry import Registry
from physion.core.seeds import child_generator, stable_hash, trial_seed


def test_unknown_names_get_the_three_closest() -> None:
    registry: Registry[int] = Registry("colour")
    for number, name in enumerate(("red", "yellow", "green", "mellow")):
        registry.register(name)(number)
    with pytest.raises(UnknownNameError) as raised:
        registry.get("yelow")
    assert raised.value.close == ["yellow", "mellow", "red"] or raised.value.close[0] == "yellow"
    assert len(raised.value.close) == 3 and "'yelow'" in str(raised.value)


def test_a_name_is_taken_once_and_lazy_values_load() -> None:
    registry: Registry[object] = Registry("thing", {"pi": "math:pi"})
    registry.register("one")(1)
    with pytest.raises(PhysionError, match="registered twice"):
        registry.register("one")(2)
    assert registry.get("pi") == pytest.approx(np.pi)
    assert registry.names() == ["one", "pi"] and "pi" in registry


@given(st.lists(st.one_of(st.text(max_size=5), st.integers()), max_size=4))
def test_different_parts_hash_differently(parts: list[str | int]) -> None:
    assert stable_hash(*parts) == stable_hash(*parts)
    assert stable_hash(*parts) != stable_hash(*parts, "")
    assert stable_hash("1") != stable_hash(1)


def test_seeds_are_the_same_in_any_process() -> None:
    code = (
        "from physion.core.seeds import *;"
        "print(child_generator(trial_seed('d', 'drop', 'testing', 3), 'looks').integers(2**60))"
    )
    here = child_generator(trial_seed("d", "drop", "testing", 3), "looks").integers(2**60)
    for hash_seed in ("0", "1"):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={"PYTHONHASHSEED": hash_seed, "TZ": "Asia/Tokyo"},
            capture_output=True,
            text=True,
            check=True,
        )
        assert int(done.stdout) == here


def test_streams_of_a_trial_and_trials_differ() -> None:
    seed = trial_seed("d", "drop", "testing", 3)
    draws = {
        int(child_generator(trial, name).integers(2**60))
        for trial in (
            seed,
            trial_seed("d", "drop", "readout", 3),
            trial_seed(0, "drop", "testing", 3),
        )
        for name in ("looks", "placement")
    }
    assert len(draws) == 6
