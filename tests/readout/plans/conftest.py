"""Shared by the tests of plans: trials of two scenarios."""

from __future__ import annotations

import pytest

from physion.trials.dataset import Dataset
from support.moving_dots import make_dots


@pytest.fixture(scope="session")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    counts = {"training": 4, "readout": 6, "testing": 4}
    return make_dots(tmp_path_factory.mktemp("dots"), counts, ("collide", "drop"))
