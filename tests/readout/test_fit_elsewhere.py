"""Readouts that are fitted on one dataset and tested on another."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
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


@pytest.mark.nightly
@pytest.mark.slow
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


@pytest.mark.slow
def test_a_motion_that_is_tested_fits_nothing(folder: Path) -> None:
    tested = Dataset(folder / "tested").index
    digest = tested["digest"][tested["split"] == "testing"].iloc[0]
    both = changed(folder, "leak", digest=digest)
    with pytest.raises(BadInputError, match=r"1 trials of .*leak have motions of tested trials"):
        evaluate("blob-centroids", folder / "tested", folder / "c", fit=both)


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_scenario_without_trials_is_named(folder: Path) -> None:
    make_dots(folder / "drops", {"readout": 4}, ("drop",))
    with pytest.raises(BadInputError, match="has no trial of collide in the split readout"):
        evaluate("blob-centroids", folder / "tested", folder / "c", fit=folder / "drops")


@pytest.mark.slow
def test_two_trials_of_one_name_are_refused(folder: Path) -> None:
    index = Dataset(folder / "tested").index
    index["split"] = "readout"
    (folder / "names").mkdir()
    write_index(folder / "names", index)
    with pytest.raises(BadInputError, match="both have a trial 'collide_testing_0000'"):
        evaluate("blob-centroids", folder / "tested", folder / "c", fit=folder / "names")


@pytest.mark.slow
def test_a_file_of_features_may_have_all_trials_of_both_sets(folder: Path) -> None:
    sets = [Dataset(folder / "tested").index, Dataset(folder / "fit").index]
    chosen = pd.concat(sets).drop_duplicates("trial")
    features = np.random.default_rng(0).normal(size=(len(chosen), 1, 3))
    arrays = {"names": chosen["trial"].to_numpy(str), "frames": [44], "features": features}
    np.savez(folder / "all.npz", **arrays)
    # Readout trials of the tested set, under names that the other set does not have.
    index = sets[0].copy()
    own = index["split"] == "readout"
    index.loc[own, "trial"] = "own_" + index["trial"][own]
    (folder / "named").mkdir()
    write_index(folder / "named", index)
    arrays["names"] = np.append(arrays["names"], index["trial"][own].to_numpy(str))
    arrays["features"] = np.pad(features, ((0, own.sum()), (0, 0), (0, 0)))
    np.savez(folder / "own.npz", **arrays)
    tables = [
        evaluate(str(path), tested, folder / "d", fit=folder / "fit").predictions
        for path, tested in (
            (folder / "all.npz", folder / "tested"),
            (folder / "own.npz", folder / "named"),
        )
    ]
    assert (tables[0]["p_contact"] == tables[1]["p_contact"]).all() and len(tables[0]) == 12


@pytest.mark.slow
def test_labels_of_other_scenarios_are_not_needed(folder: Path) -> None:
    index = Dataset(folder / "fit").index.copy()
    index["contact"] = index["contact"].astype("boolean")
    index.loc[index["scenario"] == "drop", "contact"] = pd.NA
    shutil.copytree(folder / "fit", folder / "unlabelled")
    write_index(folder / "unlabelled", index)
    model, tested, fit = "blob-centroids", folder / "tested", folder / "unlabelled"
    done = evaluate(model, tested, folder / "e", fit=fit, scenario="collide").predictions
    assert set(done["scenario"]) == {"collide"} and done["stimulus"].nunique() == 6
    for scenario in ("", "drop"):
        with pytest.raises(BadInputError, match=r"12 trials .* are stored without labels"):
            evaluate(model, tested, folder / "e", fit=fit, scenario=scenario)
