"""Models x protocols x seeds: what is done, what is not done again, and what fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

import physion
from physion.analysis.tables import read_predictions
from physion.compute.local import LocalExecutor, SerialExecutor
from physion.compute.tasks import Executor, TaskOutcome
from physion.core.errors import BadInputError, PhysionError
from physion.models.checkpoint import read_checkpoint
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings, TrainSettings, choose_models
from physion.readout.tables import summarise_accuracy
from physion.trials.dataset import Dataset
from support import cell_models
from support.moving_dots import make_dots

FILE = cell_models.__file__
IMAGINING, FAILS = f"{FILE}:Imagining", f"{FILE}:FailsOnDrop"
UNTRAINED = f"{FILE}:NothingToTrain"
EVERY = ("all", "all-but", "only")
CPU = TrainSettings(accelerator="cpu")
QUICK = EvaluationSettings(accelerator="cpu", logistic=LogisticSettings(grid=(1e-2, 1.0)))


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    counts = {"training": 4, "readout": 6, "testing": 4}
    return make_dots(tmp_path_factory.mktemp("dots"), counts, ("collide", "drop"))


class Elsewhere:
    """Executor that is not of this machine, as Slurm or Ray; it passes tasks on."""

    def __init__(self, inner: Executor) -> None:
        self.inner = inner

    def map(self, function: Callable[..., Any], tasks: Mapping[str, Any]) -> Iterator[Any]:
        yield from self.inner.map(function, tasks)


class FullDisk:
    """Executor on which nothing can be written."""

    def map(self, function: Callable[..., Any], tasks: Mapping[str, Any]) -> Iterator[Any]:
        yield from (TaskOutcome(key, error="No space left on device", errno=28) for key in tasks)


class FullDiskHere(FullDisk, LocalExecutor):
    """The same, of this machine."""


def files(folder: Path, pattern: str) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob(pattern)
    }


def stamps(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.slow
def test_trainings_are_models_by_protocols_by_sets_by_seeds(dots: Dataset, tmp_path: Path) -> None:
    given: dict[str, Any] = {"protocols": EVERY, "seeds": 2, "seed": 5, "settings": CPU}
    planned = physion.train(IMAGINING, dots, tmp_path, dry_run=True, **given).planned
    sets = ["all", "no_collide", "no_drop", "collide", "drop"]
    assert [(one.name, one.seed) for one in planned] == [(n, s) for s in (5, 6) for n in sets]
    assert not any(one.done for one in planned) and not list(tmp_path.iterdir())
    done = physion.train(IMAGINING, dots.folder, tmp_path, **given)
    assert [one.folder for one in done.trained] == [one.folder for one in planned]
    assert not done.failed and not any(one.loaded for one in done.trained)
    first, other = (
        read_checkpoint(one.folder / "model.safetensors")[0]
        for one in (done.trained[0], done.trained[5])
        if one.folder is not None
    )
    assert all((first[name] != other[name]).any() for name in first if name.endswith("weight"))
    before = stamps(tmp_path / "training")
    again = physion.train(IMAGINING, dots, tmp_path, **given)
    assert all(one.loaded for one in again.trained) and stamps(tmp_path / "training") == before
    planned = physion.train(IMAGINING, dots, tmp_path, dry_run=True, **given).planned
    assert all(one.done for one in planned)


@pytest.mark.nightly
@pytest.mark.slow
def test_each_scenario_trains_a_model_that_is_tested_on_all(dots: Dataset, tmp_path: Path) -> None:
    given: dict[str, Any] = {"protocols": ("only", "one"), "settings": QUICK}
    table = physion.evaluate(IMAGINING, dots, tmp_path, **given).predictions
    assert len(list((tmp_path / "training").iterdir())) == 2, "both protocols have the same weights"
    one = table[table["protocol"] == "one"]
    pairs = one.groupby(["dynamics_training_dataset", "scenario", "readout"])["stimulus"]
    sizes = pairs.agg(["size", "nunique"])
    assert (sizes == 4).all(axis=None) and len(sizes) == 2 * 2 * 3
    only = table[table["protocol"] == "only"]
    assert (only["dynamics_training_dataset"] == "").all() and len(only) == len(one) / 2
    # What was trained on the tested scenario is the same in both.
    same = one[one["dynamics_training_dataset"] == one["scenario"]]
    keys = ["readout", "scenario", "stimulus"]
    both = only.merge(same, on=keys, suffixes=("", "_one"))
    assert len(both) == len(only) and (both["p_contact"] == both["p_contact_one"]).all()
    other = one[one["dynamics_training_dataset"] != one["scenario"]].merge(only, on=keys)
    simulated = other[other["readout"] == "observed+simulated"]
    assert (simulated["validation_loss_x"] != simulated["validation_loss_y"]).all()
    for (_, trained, tested), rows in one.groupby(
        ["readout", "dynamics_training_dataset", "scenario"]
    ):
        hits = ((rows["p_contact"] > 0.5) == rows["outcome"]).mean()
        assert rows["test_accuracy"].to_numpy() == pytest.approx(hits), (trained, tested)
    scores = summarise_accuracy(one).set_index(["protocol", "readout", "scenario"])["accuracy"]
    assert set(scores.index.get_level_values(0)) == {"one: collide", "one: drop"}
    rows = one[(one["readout"] == "full") & (one["dynamics_training_dataset"] == "drop")]
    rows = rows[rows["scenario"] == "collide"]
    hits = ((rows["p_contact"] > 0.5) == rows["outcome"]).mean()
    assert scores["one: drop", "full", "collide"] == hits
    planned = physion.train(IMAGINING, dots, tmp_path, dry_run=True, protocols="one", settings=CPU)
    assert [(one.name, one.done) for one in planned.planned] == [("collide", True), ("drop", True)]
    (single,) = physion.train(
        IMAGINING, dots, tmp_path, dry_run=True, protocols="one", scenario="drop", settings=CPU
    ).planned
    assert single.name == "drop"
    with pytest.raises(BadInputError, match="all-but, only or one"):
        physion.train(IMAGINING, dots, tmp_path, dry_run=True, scenario="drop", settings=CPU)


@pytest.mark.slow
def test_a_training_that_is_missing_or_was_changed_is_done_again(
    dots: Dataset, tmp_path: Path
) -> None:
    given: dict[str, Any] = {"protocols": "only", "settings": CPU}
    physion.train(IMAGINING, dots, tmp_path, **given)
    before = files(tmp_path, "model.safetensors")
    removed, changed = sorted(tmp_path.rglob("model.safetensors"))
    removed.unlink()
    changed.write_bytes(changed.read_bytes()[:-1] + b"x")
    again = physion.train(IMAGINING, dots, tmp_path, **given)
    assert not any(one.loaded for one in again.trained)
    assert files(tmp_path, "model.safetensors") == before


def test_other_inputs_are_another_training(dots: Dataset, tmp_path: Path) -> None:
    def place(**changes: Any) -> Path:
        settings = TrainSettings(accelerator="cpu", **changes.pop("settings", {}))
        (one,) = physion.train(
            IMAGINING, changes.pop("dataset", dots), tmp_path, options=changes, settings=settings,
            dry_run=True,
        ).planned  # fmt: skip
        return one.folder

    assert place() == place() == place(settings={"encoder_batch": 2}) == place(log_every=1)
    fewer = Dataset(dots.folder)
    trained = fewer.index["split"] == "training"
    fewer.index = fewer.index.drop(index=fewer.index.index[trained][0]).reset_index(drop=True)
    others = [place(hidden=5), place(steps=7), place(seed=3), place(dataset=fewer)]
    assert len({place(), *others}) == 5


@pytest.mark.nightly
@pytest.mark.slow
def test_evaluations_have_all_readouts_and_a_second_run_only_reads(
    dots: Dataset, tmp_path: Path
) -> None:
    given: dict[str, Any] = {"protocols": EVERY, "seeds": 2, "settings": QUICK}
    done = physion.evaluate([UNTRAINED, IMAGINING], dots, tmp_path, **given)
    assert not done.failed and not done.problems
    # Nothing of it is trained, so that protocols and seeds would give the same rows again.
    cells = [(one.model, one.protocol, one.seed) for one in done.evaluated]
    assert cells == [
        ("nothing to train", "", 0),
        *(("Imagining", protocol, seed) for seed in (0, 1) for protocol in EVERY),
    ]
    table = done.predictions
    for (model, _, _), rows in table.groupby(["model", "protocol", "seed"]):
        wanted = {"observed", "full"}
        if model == "Imagining":
            wanted.add("observed+simulated")
        assert set(rows["readout"]) == wanted and len(rows) == len(wanted) * 2 * 4
    # The comparison reads all tables together: no model predicts a stimulus twice.
    assert len(read_predictions(done.paths)) == len(table)
    again = physion.evaluate([UNTRAINED, IMAGINING], dots, tmp_path, **given)
    assert all(one.done for one in again.evaluated) and again.paths == done.paths
    assert set(done.scores["seeds"]) == {1, 2}


@pytest.mark.slow
def test_evaluate_finds_what_was_trained_and_one_protocol_is_a_part_of_all(
    dots: Dataset, tmp_path: Path
) -> None:
    physion.train(IMAGINING, dots, tmp_path, protocols="all-but", settings=CPU)
    before = stamps(tmp_path / "training")
    done = physion.evaluate(IMAGINING, dots, tmp_path, protocols="all-but", settings=QUICK)
    assert stamps(tmp_path / "training") == before and set(done.predictions["protocol"]) == {
        "all-but"
    }
    drop = physion.evaluate(
        IMAGINING, dots, tmp_path, protocols="all-but", scenario="drop", settings=QUICK
    )
    assert set(drop.predictions["scenario"]) == {"drop"} and drop.paths != done.paths
    whole = done.predictions[done.predictions["scenario"] == "drop"].reset_index(drop=True)
    assert (drop.predictions["p_contact"] == whole["p_contact"]).all()
    untrained = physion.evaluate(UNTRAINED, dots, tmp_path, scenario="drop", settings=QUICK)
    assert set(untrained.predictions["scenario"]) == {"drop"}


def test_a_mistake_is_found_before_anything_is_done(dots: Dataset, tmp_path: Path) -> None:
    def train(models: Any, **given: Any) -> None:
        physion.train(models, dots, tmp_path, settings=CPU, **given)

    for wrong, message in (
        ([IMAGINING, UNTRAINED], "nothing to train"),
        ([IMAGINING, f"{FILE}:Imaginin"], "Imagining"),
        ({IMAGINING: {}, FAILS: {"hiden": 3}}, "hiden"),
        ([], "no model"),
        ([IMAGINING, IMAGINING], "twice"),
    ):
        with pytest.raises(PhysionError, match=message):
            train(wrong)
    for given, message in (
        ({"options": {"steps": 0}}, "steps must be at least 1"),
        ({"options": {"steps": "many"}}, "steps"),
        ({"protocols": "al-but"}, "all-but"),
        ({"scenario": "drop"}, "a scenario needs"),
        ({"seeds": 0}, "seeds must be at least 1"),
    ):
        with pytest.raises(PhysionError, match=message):
            train(IMAGINING, **given)
    assert not list(tmp_path.iterdir())


def test_options_are_of_the_model_or_of_its_training() -> None:
    one, other = choose_models(
        {"cswm": {"steps": 5}, "chance": {}}, {"steps": 7, "betas": [0, 0.9]}
    )
    assert one.training == {"steps": 5, "betas": (0.0, 0.9)} and other.training["steps"] == 7
    (frozen,) = choose_models("frozen-encoder", {"encoder": "test_vit", "clip": 1})
    assert dict(frozen.options) == {"encoder": "test_vit"} and frozen.training == {"clip": 1.0}


def test_weights_that_ship_are_the_default_and_trainings_start_from_random_ones() -> None:
    (shipped,) = choose_models("gns", {"weights": "shipped"})
    (chosen,) = choose_models("gns")
    assert shipped.build(0).trained and not chosen.build(0, untrained=True).trained
    # What the user asks for stays.
    assert shipped.build(0, untrained=True).trained


@pytest.mark.nightly
@pytest.mark.slow
def test_cells_on_an_executor_match_this_process(dots: Dataset, tmp_path: Path) -> None:
    given: dict[str, Any] = {"seed": 3, "settings": CPU}
    trained = physion.train(
        [FAILS, IMAGINING], dots, tmp_path / "cells", executor=Elsewhere(LocalExecutor(2)), **given
    )
    assert list(trained.failed) == [f"{FAILS}, all, seed 3"] and len(trained.trained) == 1
    physion.train(IMAGINING, dots, tmp_path / "here", **given)
    weights = files(tmp_path / "cells", "model.safetensors")
    assert weights and weights == files(tmp_path / "here", "model.safetensors")
    for name, executor in (("cells", Elsewhere(SerialExecutor())), ("here", None)):
        done = physion.evaluate(
            IMAGINING, dots, tmp_path / name, seeds=2, settings=QUICK, executor=executor
        )
        assert len(done.evaluated) == 2 and not done.failed
    tables = files(tmp_path / "cells", "predictions/*.csv")
    assert len(tables) == 2 and tables == files(tmp_path / "here", "predictions/*.csv")


def test_a_full_disk_ends_all(dots: Dataset, tmp_path: Path) -> None:
    for function, settings in ((physion.train, CPU), (physion.evaluate, QUICK)):
        with pytest.raises(PhysionError, match="No space left"):
            function(IMAGINING, dots, tmp_path, seeds=2, settings=settings, executor=FullDisk())


@pytest.mark.nightly
@pytest.mark.slow
def test_an_executor_of_this_machine_has_no_cells_as_tasks(dots: Dataset, tmp_path: Path) -> None:
    given: dict[str, Any] = {"executor": FullDiskHere(1), "seeds": 2}
    assert len(physion.train(IMAGINING, dots, tmp_path, settings=CPU, **given).trained) == 2
    assert len(physion.evaluate(IMAGINING, dots, tmp_path, settings=QUICK, **given).evaluated) == 2
