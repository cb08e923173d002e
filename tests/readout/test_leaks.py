"""No prediction uses what it must not: every registered model on changed copies of a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.clips.batch import Spec
from physion.clips.clips import whole_source
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError
from physion.models.build import models
from physion.readout.evaluate import evaluate
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings
from physion.trials.dataset import Dataset
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_dataset
from support.late_motions import make_late_motions
from support.leak_checks import with_exchanged_futures, with_permuted_labels, with_poisoned_futures
from support.moving_dots import make_dots
from support.tiny_models import OPTIONS, TINY
from support.viewer_dataset import make_dataset

QUICK = EvaluationSettings(accelerator="cpu", logistic=LogisticSettings(grid=(1e-2, 1.0)))
TREES = {"blob-trees", "mask-trees", "state-trees"}
KINDS = {
    "VideoMAE", "blob-centroids", "chance", "constant-motion", "copy-last-frame", "cswm",
    "dpi", "frozen-encoder", "gns", "intuition-masks", "intuition-pixels", "intuition-states",
    "mask-trees", "noisy-simulation",
}  # fmt: skip
"""Quick models of each kind; the nightly tests have the others."""
PREDICTING = ("observed", "observed+simulated")


def make(folder: Path, readout: int) -> Dataset:
    tasks = plan_dataset("leaks", ("collide",), {"training": 2, "readout": readout, "testing": 2})
    settings = GenerateSettings(width=64, height=64, look="redyellow", jitters=0)
    assert not make_trials(folder, tasks, settings, executor=SerialExecutor()).failed
    dataset = Dataset(folder)
    fitted = dataset.index[dataset.index["split"] == "readout"]["contact"]
    assert fitted.nunique() == 2, "otherwise a readout would say the same of every trial"
    return dataset


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make(tmp_path_factory.mktemp("made") / "leaks", readout=4)


@pytest.fixture(scope="module")
def poisoned(made: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return with_poisoned_futures(made, tmp_path_factory.mktemp("poisoned") / "data")


@pytest.fixture(scope="module")
def trees(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Dataset]:
    """Four trials would be one leaf of a tree, whose answer is always the same."""
    folder = tmp_path_factory.mktemp("trees")
    made = make(folder / "leaks", readout=16)
    return made, with_poisoned_futures(made, folder / "poisoned" / "data")


def predict(dataset: Dataset, name: str, folder: Path) -> pd.DataFrame:
    options: dict[str, Any] = {**OPTIONS.get(name, {}), "steps": 3}
    table = evaluate(name, dataset, folder, options=options, settings=QUICK).predictions
    return table.set_index(["readout", "stimulus"])["p_contact"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in KINDS else pytest.mark.nightly)
        for name in sorted({*models.names()} - TREES)
    ],
)
def test_what_follows_the_observed_part_changes_no_prediction(
    name: str, made: Dataset, poisoned: Dataset, tmp_path: Path
) -> None:
    check_predictions(name, made, poisoned, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in KINDS else pytest.mark.nightly)
        for name in sorted(TREES)
    ],
)
def test_what_follows_the_observed_part_changes_no_tree(
    name: str, trees: tuple[Dataset, Dataset], tmp_path: Path
) -> None:
    check_predictions(name, *trees, tmp_path)


def check_predictions(name: str, made: Dataset, poisoned: Dataset, folder: Path) -> None:
    before = predict(made, name, folder / "before")
    after = predict(poisoned, name, folder / "after")
    kept = before.index.get_level_values("readout").isin(PREDICTING)
    assert kept.any()
    assert before[kept].to_numpy().tobytes() == after[kept].to_numpy().tobytes()
    if (~kept).any():
        assert not before[~kept].equals(after[~kept]), "the noise is seen where it may be"


@pytest.mark.slow
def test_the_copy_is_poisoned_where_it_should_be(made: Dataset, poisoned: Dataset) -> None:
    for trial in made.trials("testing"):
        clean, changed = made.trial(trial).trajectory, poisoned.trial(trial).trajectory
        assert np.array_equal(clean.positions[:45], changed.positions[:45])
        assert not np.isclose(clean.positions[45:], changed.positions[45:]).all(axis=2).any()
        assert (changed.contacts.frame < 45).all()
        frames = made.frames(trial), poisoned.frames(trial)
        assert np.abs(frames[0][45:].astype(int) - frames[1][45:]).mean() > 20
        assert np.abs(frames[0][:40].astype(int) - frames[1][:40]).mean() < 5
        paths = made.paths(trial).observed_movie, poisoned.paths(trial).observed_movie
        assert paths[0].read_bytes() == paths[1].read_bytes()
    for trial in made.trials("training"):
        assert made.paths(trial).movie.read_bytes() == poisoned.paths(trial).movie.read_bytes()
    with pytest.raises(BadInputError, match="exists"):
        with_poisoned_futures(made, poisoned.folder)


@pytest.mark.slow
def test_motions_continue_like_another_trial(tmp_path: Path) -> None:
    """The trials have different lengths; clips of the copy can be read, and their boxes."""
    made = make_late_motions(tmp_path / "data", {"testing": 4}, more=3)
    exchanged = with_exchanged_futures(made, tmp_path / "exchanged", motions=True)
    trials = made.trials()
    motions = [made.trial(trial).trajectory for trial in trials]
    for trial, own in zip(trials, motions, strict=True):
        opened = exchanged.trial(trial)
        changed = opened.trajectory
        assert np.array_equal(own.positions[:45], changed.positions[:45])
        (partner,) = [
            m for m in motions if np.array_equal(m.positions[45:], changed.positions[45:])
        ]
        assert partner is not own and len(changed) == len(partner) != len(own)
        assert np.array_equal(changed.velocities[45:], partner.velocities[45:])
        frames = [f for f in own.contacts.frame if f < 45]
        frames += [f for f in partner.contacts.frame if f >= 45]
        assert changed.contacts.frame.tolist() == frames and 10 in frames
        assert opened.labels == made.trial(trial).labels
        row = exchanged.index.set_index("trial").loc[trial]
        assert row["digest"] == opened.metadata.digest == changed.digest()
        assert row["frames"] == opened.metadata.frames == len(exchanged.frames(trial))
        assert row["playback_seconds"] == pytest.approx(len(partner) / 30)
    spec = Spec(inputs=("rgb", "boxes"), image_size=32, stride=9, future=12)
    batches = [whole_source(dataset, spec).whole(trials) for dataset in (made, exchanged)]
    before, after = (np.nan_to_num(np.asarray(batch.boxes)) for batch in batches)
    assert np.array_equal(before[:, :5], after[:, :5]) and not np.array_equal(before, after)


def test_a_trial_without_a_partner_is_named(tmp_path: Path) -> None:
    alone = make_dots(tmp_path / "data", {"testing": 1}, ("drop",))
    with pytest.raises(BadInputError, match=r"drop_testing_0000.*only one"):
        with_exchanged_futures(alone, tmp_path / "exchanged")
    cloth = Dataset(make_dataset(tmp_path / "cloth"))
    with pytest.raises(BadInputError, match=r"has cloth, whose motion fits no other trial"):
        with_exchanged_futures(
            cloth, tmp_path / "more", cloth.index["split"].unique(), motions=True
        )


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    counts = {"training": 2, "readout": 24, "testing": 40}
    return make_dots(tmp_path_factory.mktemp("dots") / "data", counts, ("drop",))


def accuracy_of_full(dataset: Dataset, folder: Path, **options: Any) -> float:
    settings = EvaluationSettings(readouts=("full",), accelerator="cpu", logistic=QUICK.logistic)
    options = {**TINY, "steps": 20, "batch": 4, "warmup": 0, **options}
    table = evaluate(
        "frozen-encoder", dataset, folder, options=options, settings=settings
    ).predictions
    return float(((table["p_contact"] > 0.5) == table["outcome"]).mean())


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("fine_tuned", [False, True], ids=["frozen", "fine-tuned"])
def test_full_falls_to_chance_with_exchanged_futures_and_permuted_labels(
    fine_tuned: bool, dots: Dataset, tmp_path: Path
) -> None:
    """Of 40 trials, 3 standard errors of chance are .24."""
    exchanged = with_exchanged_futures(dots, tmp_path / "exchanged")
    assert accuracy_of_full(dots, tmp_path / "a", fine_tuned=fine_tuned) > 0.74
    fallen = accuracy_of_full(exchanged, tmp_path / "b", fine_tuned=fine_tuned)
    assert abs(fallen - 0.5) < 0.24
    permuted = with_permuted_labels(dots)
    assert not permuted.index["contact"].equals(dots.index["contact"])
    assert permuted.index["contact"].sum() == dots.index["contact"].sum()
    # The movies are the same, so that training and features need not be made again.
    guessed = accuracy_of_full(permuted, tmp_path / "a", fine_tuned=fine_tuned)
    assert abs(guessed - 0.5) < 0.24
