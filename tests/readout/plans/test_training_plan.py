"""Plans of trainings: what they consist of, what is skipped, what fails, how long they take."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physion.core.errors import BadInputError, PhysionError
from physion.models.checkpoint import read_checkpoint
from physion.readout.plans.estimates import (
    DONE,
    EARLIER,
    MEASURED,
    duration,
    estimate_plan,
    time_left,
)
from physion.readout.plans.selection import (
    ModelChoice,
    count_seeds,
    parse_protocols,
    split_names,
)
from physion.readout.plans.tasks import TrainingTask
from physion.training.loop import TrainingOverrides
from physion.training.protocols import Training
from physion.trials.dataset import Dataset
from support.plans.make_plans import (
    EVERY,
    FAILS,
    FILE,
    IMAGINING,
    SETS,
    make_training_plan,
)


def weights_of(folder: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in folder.rglob("model.safetensors")}


def test_a_plan_is_models_by_protocols_by_scenarios_by_seeds(dots: Dataset, tmp_path: Path) -> None:
    plan = make_training_plan(dots, tmp_path, [IMAGINING, FAILS])
    assert [(t.choice, t.planned.name, t.seed) for t in plan.tasks] == [
        (model, name, seed) for seed in (0, 1) for model in (IMAGINING, FAILS) for name in SETS
    ]
    assert len({task.key for task in plan.tasks}) == len(plan.tasks)
    assert plan.pending == plan.tasks and not list(tmp_path.iterdir())
    only = make_training_plan(dots, tmp_path, protocols=EVERY[1:], scenario="drop")
    assert [task.planned.name for task in only.tasks] == ["no_drop", "drop"] * 2
    with pytest.raises(BadInputError, match="a scenario needs"):
        make_training_plan(dots, tmp_path, scenario="drop")


def test_lists_on_the_command_line() -> None:
    assert split_names("a, b,a,,c", "model") == ("a", "b", "c")
    assert parse_protocols("only,all") == (Training.ONLY, Training.ALL)
    assert count_seeds(4, 3) == (4, 5, 6)
    with pytest.raises(PhysionError, match="all-but"):
        parse_protocols("all,al-but")
    for wrong in (lambda: split_names(" ,", "model"), lambda: count_seeds(0, 0)):
        with pytest.raises(BadInputError):
            wrong()


def test_what_is_done_is_skipped_and_seeds_draw_the_initial_weights(
    dots: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = make_training_plan(dots, tmp_path, protocols=[Training.ALL]).run()
    assert [trained["loaded"] for _, trained in results.trained] == [False, False]
    folders = [Path(trained["folder"]) for _, trained in results.trained]
    one, other = (read_checkpoint(folder / "model.safetensors")[0] for folder in folders)
    assert all((one[name] != other[name]).any() for name in one if name.endswith("weight"))
    before = weights_of(tmp_path)
    more = make_training_plan(dots, tmp_path, protocols=[Training.ALL, Training.ONLY], seeds=(0,))
    assert [task.planned.name for task in more.pending] == ["collide", "drop"]
    more.run()
    kept = weights_of(tmp_path)
    assert len(kept) == 4 and before.items() <= kept.items()

    def build(*_: Any, **__: Any) -> None:
        raise AssertionError("a plan that is done builds no model")

    monkeypatch.setattr("physion.readout.plans.model_facts.build_model", build)
    moved = tmp_path.with_name(f"{tmp_path.name} moved")
    tmp_path.rename(moved)
    again = make_training_plan(dots, moved, protocols=[Training.ALL])
    assert again.pending == []
    known = [trained for _, trained in again.run().trained]
    assert [trained["loaded"] for trained in known] == [True, True]
    assert [Path(trained["folder"]) for trained in known] == [
        moved / "training" / f.name for f in folders
    ]


def test_a_training_that_is_missing_or_was_changed_is_done_again(
    dots: Dataset, tmp_path: Path
) -> None:
    plan = make_training_plan(dots, tmp_path, seeds=(0,))
    plan.run()
    before = weights_of(tmp_path)
    removed, changed = sorted(tmp_path.rglob("model.safetensors"))[:2]
    removed.unlink()
    changed.write_bytes(changed.read_bytes()[:-1] + b"x")
    again = make_training_plan(dots, tmp_path, seeds=(0,))
    assert len(again.pending) == 2
    results = again.run()
    loaded = {Path(t["folder"]).name: t["loaded"] for _, t in results.trained}
    assert not loaded[removed.parent.name] and not loaded[changed.parent.name]
    assert weights_of(tmp_path) == before


def test_other_inputs_are_another_task(dots: Dataset, tmp_path: Path) -> None:
    make_training_plan(dots, tmp_path, protocols=[Training.ALL], seeds=(0,)).run()

    def pending(*models: ModelChoice, **changes: Any) -> int:
        models = models or (IMAGINING,)
        plan = make_training_plan(dots, tmp_path, models, [Training.ALL], (0,), **changes)
        return len(plan.pending)

    assert pending() == 0 and pending(encoder_batch=2, accelerator="auto") == 0
    assert pending(replace(IMAGINING, options={"hidden": 5})) == 1
    assert pending(overrides=TrainingOverrides(steps=7)) == 1
    fewer = Dataset(dots.folder)
    fewer.index = fewer.index.drop(index=0).reset_index(drop=True)
    assert make_training_plan(fewer, tmp_path, protocols=[Training.ALL], seeds=(0,)).pending


def test_an_edited_file_is_another_model(dots: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "own" / "my_model.py"
    file.parent.mkdir()
    text = "from support.plans.plan_models import Imagining as Mine\n"
    file.write_text(text)
    choice = ModelChoice(f"{file}:Mine")

    def pending() -> int:
        plan = make_training_plan(dots, tmp_path / "out", [choice], [Training.ALL], (0,))
        return len(plan.pending)

    make_training_plan(dots, tmp_path / "out", [choice], [Training.ALL], (0,)).run()
    assert pending() == 0
    (file.parent / "beside.py").write_text("NUMBER = 1\n")
    assert pending() == 1


def test_a_training_that_fails_is_reported_and_the_rest_goes_on(
    dots: Dataset, tmp_path: Path
) -> None:
    seen: list[tuple[str, bool, int]] = []

    def show(task: TrainingTask, reason: str, left: Sequence[TrainingTask]) -> None:
        seen.append((task.label, bool(reason), len(left)))

    plan = make_training_plan(dots, tmp_path, [FAILS, IMAGINING], seeds=(3,))
    results = plan.run(on_task=show)
    assert [task.planned.name for task, _ in results.failed] == ["all", "no_collide", "drop"]
    assert all("no drop, please" in reason for _, reason in results.failed)
    assert all("\n" not in reason for _, reason in results.failed)
    assert len(results.trained) == 7 and len(seen) == 10
    assert seen[0] == (f"{FAILS.name}, all, seed 3", True, 9) and seen[-1][2] == 0
    # What failed is tried again, what did not is not.
    again = make_training_plan(dots, tmp_path, [FAILS], seeds=(3,))
    assert [t.planned.name for t in again.pending] == ["all", "no_collide", "drop"]


def test_a_plan_of_one_training_raises_its_error(dots: Dataset, tmp_path: Path) -> None:
    plan = make_training_plan(dots, tmp_path, [FAILS], [Training.ALL], seeds=(0,))
    with pytest.raises(BadInputError, match="no drop, please"):
        plan.run()


def test_a_mistake_stops_the_plan_before_anything_is_trained(dots: Dataset, tmp_path: Path) -> None:
    for wrong, message in (
        (ModelChoice(f"{FILE}:NothingToTrain"), "nothing to train"),
        (ModelChoice(f"{FILE}:Imaginin"), "Imagining"),
        (replace(FAILS, options={"hiden": 3}), "hiden"),
    ):
        with pytest.raises(PhysionError, match=message):
            make_training_plan(dots, tmp_path, [IMAGINING, wrong]).run()
    with pytest.raises(BadInputError, match="steps must be at least 1"):
        make_training_plan(dots, tmp_path, overrides=TrainingOverrides(steps=0))
    assert not list(tmp_path.iterdir())


def test_a_full_disk_stops_the_plan(
    dots: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("physion.training.loop.write_atomic", full)
    plan = make_training_plan(dots, tmp_path)
    with pytest.raises(PhysionError, match="No space left on device; 0 of 10 are done"):
        plan.run()


def test_the_progress_of_a_plan_counts_the_steps_of_all_trainings(
    dots: Dataset, tmp_path: Path
) -> None:
    steps: list[tuple[str, int, int]] = []

    def progress(what: str, done: int, total: int) -> None:
        steps.append((what, done, total))

    make_training_plan(dots, tmp_path, protocols=[Training.ONLY], seeds=(0,)).run(progress)
    of_plan = [(done, total) for what, done, total in steps if what == "plan"]
    assert of_plan == [(step, 12) for step in range(1, 13)]
    assert {what for what, *_ in steps} == {"plan", "this training"}


def test_the_estimate_says_what_it_comes_from_and_writes_nothing(
    dots: Dataset, tmp_path: Path
) -> None:
    plan = make_training_plan(dots, tmp_path, protocols=[Training.ONLY], seeds=(0, 1))
    estimates = estimate_plan(plan)
    assert [each.source for each in estimates] == [MEASURED] * 4
    assert all(each.seconds is not None and each.seconds > 0 for each in estimates)
    assert [each.steps for each in estimates] == [6] * 4
    assert not list(tmp_path.iterdir())
    assert time_left(plan, plan.tasks) == ""
    make_training_plan(dots, tmp_path, protocols=[Training.ONLY], seeds=(0,)).run()
    later = make_training_plan(dots, tmp_path, protocols=[Training.ONLY], seeds=(0, 1))
    estimates = estimate_plan(later)
    assert [each.source for each in estimates] == [DONE, DONE, EARLIER, EARLIER]
    assert [each.seconds for each in estimates[:2]] == [0, 0]
    longer = make_training_plan(
        dots, tmp_path, protocols=[Training.ONLY], seeds=(0,),
        overrides=TrainingOverrides(steps=6000),
    )  # fmt: skip
    slow, quick = estimate_plan(longer)[0].seconds, estimates[2].seconds
    records = [
        json.loads(path.read_bytes()) for path in (tmp_path / "plan" / "trainings").iterdir()
    ]
    step = np.median([record["values"]["speed"]["step"] for record in records])
    assert slow is not None and quick is not None
    assert slow - quick == pytest.approx((6000 - 6) * step)
    assert time_left(later, later.pending).startswith(", about ")


def test_an_estimate_that_cannot_be_made_says_why(dots: Dataset, tmp_path: Path) -> None:
    plan = make_training_plan(dots, tmp_path, [FAILS], [Training.ALL_BUT], seeds=(0,))
    reasons = {e.task.planned.name: (e.seconds, e.source) for e in estimate_plan(plan)}
    assert reasons["no_collide"][0] is None and "no drop, please" in reasons["no_collide"][1]


def test_features_are_counted_once(dots: Dataset, tmp_path: Path) -> None:
    """A frozen encoder computes the features of a trial for the first training that needs them."""
    from support.tiny_models import TINY

    choice = ModelChoice("frozen-encoder", TINY)
    overrides = TrainingOverrides(steps=2)
    plan = make_training_plan(dots, tmp_path, [choice], EVERY, (0,), overrides)
    by_name = {each.task.planned.name: each.seconds for each in estimate_plan(plan)}
    assert by_name["all"] > 2 * by_name["collide"]  # type: ignore[operator]
    assert by_name["collide"] == by_name["drop"] == by_name["no_drop"]
    make_training_plan(dots, tmp_path, [choice], [Training.ALL], (0,), overrides).run()
    (record,) = (tmp_path / "plan" / "trainings").iterdir()
    speed = json.loads(record.read_bytes())["values"]["speed"]
    assert speed["trial"] > 0 and speed["step"] > 0 and speed["rest"] >= 0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.25, "0.2 s"),
        (42.4, "42 s"),
        (150, "2 min"),
        (3500, "58 min"),
        (3599, "1 h 0 min"),
        (7830, "2 h 10 min"),
    ],
)
def test_durations_have_two_units(seconds: float, text: str) -> None:
    assert duration(seconds) == text
