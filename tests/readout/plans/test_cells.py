"""Trainings and evaluations of a plan as tasks of an executor: same files, same failures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from physion.compute.local import LocalExecutor, SerialExecutor
from physion.compute.tasks import TaskOutcome
from physion.core.errors import BadInputError, PhysionError
from physion.training.protocols import Training
from physion.trials.dataset import Dataset
from support.plans.make_plans import FAILS, IMAGINING, make_evaluation_plan, make_training_plan

ALL = [Training.ALL]


def files(folder: Path, pattern: str) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob(pattern)
    }


class FullDisk(SerialExecutor):
    """Executor on which nothing can be written."""

    def map(self, function: Callable[..., Any], tasks: Mapping[str, Any]) -> Iterator[Any]:
        yield from (TaskOutcome(key, error="No space left on device", errno=28) for key in tasks)


@pytest.mark.slow
def test_trainings_on_an_executor_are_those_of_this_process(dots: Dataset, tmp_path: Path) -> None:
    seen: list[tuple[str, int]] = []
    plan = make_training_plan(dots, tmp_path / "cells", [FAILS, IMAGINING], ALL, seeds=(3,))
    results = plan.run(
        on_task=lambda task, reason, left: seen.append((reason, len(left))),
        cells=LocalExecutor(2),
    )
    (failed,) = results.failed
    assert failed[0].choice == FAILS and "no drop, please" in failed[1]
    assert sorted(left for _, left in seen) == [0, 1]
    here = make_training_plan(dots, tmp_path / "here", [IMAGINING], ALL, seeds=(3,))
    here.run()
    weights = files(tmp_path / "cells", "model.safetensors")
    assert weights and weights == files(tmp_path / "here", "model.safetensors")
    ((_, trained),) = results.trained
    assert Path(trained["folder"]).is_dir() and not trained["loaded"]
    # A second run finds what the tasks have done.
    again = make_training_plan(dots, tmp_path / "cells", [FAILS, IMAGINING], ALL, seeds=(3,))
    assert [task.choice for task in again.pending] == [FAILS]


@pytest.mark.slow
def test_evaluations_on_an_executor_are_those_of_this_process(
    dots: Dataset, tmp_path: Path
) -> None:
    plan = make_evaluation_plan(dots, tmp_path / "cells", protocols=ALL)
    results = plan.run(cells=SerialExecutor())
    assert len(results.evaluated) == 2 and not results.failed and not results.problems
    make_evaluation_plan(dots, tmp_path / "here", protocols=ALL).run()
    tables = files(tmp_path / "cells", "predictions/*.csv")
    assert len(tables) == 2 and tables == files(tmp_path / "here", "predictions/*.csv")
    assert not make_evaluation_plan(dots, tmp_path / "cells", protocols=ALL).pending


def test_a_full_disk_ends_the_plan(dots: Dataset, tmp_path: Path) -> None:
    for plan in (make_training_plan(dots, tmp_path), make_evaluation_plan(dots, tmp_path)):
        with pytest.raises(PhysionError, match="No space left"):
            plan.run(cells=FullDisk())


def test_a_task_of_other_data_or_code_is_refused(dots: Dataset, tmp_path: Path) -> None:
    for plan in (make_training_plan(dots, tmp_path), make_evaluation_plan(dots, tmp_path)):
        with pytest.raises(BadInputError, match="other data"):
            plan.do("no such key")
