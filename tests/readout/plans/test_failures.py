"""What a plan says of a task that failed."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest
import torch

from physion.core.errors import MEMORY_SETTINGS, BadInputError, PhysionError
from physion.readout.plans.failures import describe_failure, stop_if_fatal


def raised(error: Exception) -> Exception:
    """The error as it is after it was raised."""
    with pytest.raises(type(error)) as caught:
        raise error
    return caught.value


def test_an_error_of_the_package_is_its_own_text() -> None:
    assert describe_failure(BadInputError("no\n  movies")) == "no movies"


def test_another_error_names_its_kind_and_line() -> None:
    text = describe_failure(raised(ValueError("wrong")))
    assert text.startswith("ValueError: wrong (test_failures.py, line ")


@pytest.mark.parametrize("error", [MemoryError(), torch.OutOfMemoryError("CUDA")])
def test_memory_that_is_used_up_names_what_to_lower(error: Exception) -> None:
    assert MEMORY_SETTINGS in describe_failure(raised(error))
    with pytest.raises(MemoryError) as caught:
        np.ones(2**50)
    assert MEMORY_SETTINGS in describe_failure(caught.value)


def test_a_full_disk_stops_the_plan(tmp_path: Path) -> None:
    error = BadInputError("features were not written")
    error.__cause__ = OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(PhysionError, match="No space left on device; 3 of 7 are done"):
        stop_if_fatal(error, tmp_path, 3, 7)
    stop_if_fatal(ValueError("only this task"), tmp_path, 3, 7)
