"""Shared by the tests of sources: a dataset whose movies show what its motions say."""

from __future__ import annotations

import pytest

from physion.trials.dataset import Dataset
from support.official_hand_made import make_dataset


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A rigid trial and one with cloth: 50 frames of 32 pixels, movies in both looks."""
    return Dataset(make_dataset(tmp_path_factory.mktemp("made")))
