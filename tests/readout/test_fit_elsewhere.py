"""Readouts that are fitted on one dataset and tested on another."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from physion.core.errors import BadInputError
from physion.core.files import digest_of
from physion.readout.evaluate import evaluate
from physion.trials.dataset import Dataset
from physion.trials.index import write_index
from support.moving_dots import make_dots

SCENARIOS = ("collide", "drop")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dots")
    make_dots(folder / "tested", {"testing": 6, "readout": 4}, SCENARIOS)
    make_dots(folder / "fit", {"readout": 12}, SCENARIOS)
    make_dots(folder / "both", {"testing": 6, "readout": 12}, SCENARIOS)
    return folder


def test_predictions_are_equal_to_one_dataset_with_both_parts(folder: Path) -> None:
    apart = evaluate("blob-centroids", folder / "tested", folder / "a", fit=folder / "fit")
    whole = evaluate("blob-centroids", folder / "both", folder / "b").predictions
    table = apart.predictions
    pd.testing.assert_frame_equal(table.drop(columns="fit_on"), whole.drop(columns="fit_on"))
    assert (table["fit_trials"] == 12).all() and set(whole["fit_on"]) == {""}
    index = Dataset(folder / "fit").index
    rows = zip(index["scenario"], index["digest"], index["contact"], strict=True)
    digest = digest_of("\n".join(sorted(f"{s} {d} {int(c)}" for s, d, c in rows)))
    assert set(table["fit_on"]) == {f"fit {digest[:12]}"}
    again = evaluate("blob-centroids", folder / "tested", folder / "a", fit=folder / "fit")
    assert again.evaluated[0].done
    assert again.paths != evaluate("blob-centroids", folder / "tested", folder / "a").paths


def changed(folder: Path, name: str, **columns: object) -> Path:
    """Return a copy of the set ``fit`` whose index has other values in the first readout trial."""
    index = Dataset(folder / "fit").index.copy()
    for column, value in columns.items():
        index.loc[0, column] = value
    (folder / name).mkdir()
    write_index(folder / name, index)
    return folder / name


def test_a_motion_that_is_tested_fits_nothing(folder: Path) -> None:
    tested = Dataset(folder / "tested").index
    digest = tested["digest"][tested["split"] == "testing"].iloc[0]
    both = changed(folder, "leak", digest=digest)
    with pytest.raises(BadInputError, match=r"1 trials of .*leak have motions of tested trials"):
        evaluate("blob-centroids", folder / "tested", folder / "c", fit=both)


@pytest.mark.parametrize(
    ("column", "value", "what"),
    [
        ("look", "free", "look"),
        ("width", 128, "size of the movies"),
        ("playback_seconds", 1.0, "frame rate"),
    ],
)
def test_pictures_of_another_kind_are_refused(
    folder: Path, column: str, value: object, what: str
) -> None:
    other = changed(folder, f"other-{column}", **{column: value})
    with pytest.raises(BadInputError, match=f"the {what} of tested trials is"):
        evaluate("blob-centroids", folder / "tested", folder / "c", fit=other)


def test_a_scenario_without_trials_is_named(folder: Path) -> None:
    make_dots(folder / "drops", {"readout": 4}, ("drop",))
    with pytest.raises(BadInputError, match="has no trial of collide in the split readout"):
        evaluate("blob-centroids", folder / "tested", folder / "c", fit=folder / "drops")


def test_two_trials_of_one_name_are_refused(folder: Path) -> None:
    index = Dataset(folder / "tested").index
    index["split"] = "readout"
    (folder / "names").mkdir()
    write_index(folder / "names", index)
    with pytest.raises(BadInputError, match="both have a trial 'collide_testing_0000'"):
        evaluate("blob-centroids", folder / "tested", folder / "c", fit=folder / "names")
