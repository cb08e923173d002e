"""Shared by the tests of official files: a small dataset, and its export."""

from __future__ import annotations

from pathlib import Path

import pytest

from physion.compute.local import SerialExecutor
from physion.trials.official.export_folder import export_official
from support.official_hand_made import CLOTH, RIGID, make_dataset


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_dataset(tmp_path_factory.mktemp("official") / "dataset")


@pytest.fixture(scope="session")
def exported(dataset: Path) -> Path:
    """The dataset in the layout ``official``, with pictures."""
    out = dataset.parent / "exported"
    report = export_official(dataset, out, executor=SerialExecutor())
    assert report.made == (RIGID, CLOTH) and not report.failed and report.exit_code == 0
    return out
