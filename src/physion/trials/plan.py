"""What is to be made, and how: a task for each trial of a dataset, and the settings of all."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from physion.errors import BadInputError, UnknownNameError
from physion.scenes.scenarios import scenarios as known_scenarios
from physion.scenes.scene import Scene
from physion.seeds import trial_seed
from physion.trials.layout import SAFE_NAME, TrialPaths
from physion.trials.schema import PASSES

SPLITS = ("training", "readout", "testing", "familiarization")
"""Trials for a model's own training, for its readout, for the test that people take too, and for
people to practise on."""


@dataclass(frozen=True)
class Task:
    """One trial to make: what names it is all that decides it.

    A task without ``scene`` draws its scene from its scenario and ``preset`` (None for the
    scenario's own parameters) with a seed of (dataset, scenario, split, index). A task with an
    imported ``scene`` takes it as it is, and ``recorded_contact`` is the outcome that it came
    with.
    """

    dataset: str
    scenario: str
    split: str
    index: int
    preset: str | None = None
    scene: Scene | None = None
    recorded_contact: bool | None = None

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise UnknownNameError("split", self.split, SPLITS)
        if self.index < 0:
            raise BadInputError(f"trial index {self.index} is below 0")
        for name in (self.dataset, self.scenario, self.trial):
            if not re.fullmatch(SAFE_NAME, name):
                raise BadInputError(
                    f"{name!r} cannot be a file name: use up to 200 of A-Z a-z 0-9 . _ + -"
                )

    @property
    def trial(self) -> str:
        """Name of the trial, unique in its dataset."""
        if self.scene is not None:
            return self.scene.name
        preset = f"_{self.preset}" if self.preset else ""
        return f"{self.scenario}{preset}_{self.split}_{self.index:04d}"

    def seed(self) -> np.random.SeedSequence:
        """Where all randomness of the trial comes from."""
        return trial_seed(self.dataset, self.scenario, self.split, self.index)


@dataclass(frozen=True)
class Settings:
    """How trials are rendered and stored. One folder has one of it.

    - ``width``, ``height``: pixels, even.
    - ``look``: ``redyellow`` paints the agent red and the patient yellow; ``free`` keeps the
      colours of the scene, and only the map says who is who.
    - ``passes``: image passes to keep in the trial files. None is needed: any pass can be
      rendered again from the state.
    - ``compatible``: gzip in place of zstd in the trial files.
    """

    width: int = 256
    height: int = 256
    look: Literal["redyellow", "free"] = "redyellow"
    passes: tuple[str, ...] = ()
    compatible: bool = False

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 2 or self.width % 2 or self.height % 2:
            raise BadInputError(
                f"movies need an even width and height, not {self.width} x {self.height}"
            )
        unknown = sorted(set(self.passes) - set(PASSES))
        if unknown:
            raise BadInputError(f"unknown passes {unknown}; known: {sorted(PASSES)}")
        if self.look not in ("redyellow", "free"):
            raise BadInputError(f"unknown look {self.look!r}; known: redyellow, free")


@dataclass(frozen=True)
class Job:
    """A task with where and how to do it: all that a worker needs."""

    task: Task
    folder: Path
    settings: Settings

    @property
    def paths(self) -> TrialPaths:
        """Where the files of the trial go."""
        return TrialPaths(self.folder, self.task.split, self.task.scenario, self.task.trial)


def plan_dataset(
    dataset: str,
    scenarios: Iterable[str],
    counts: Mapping[str, int],
    presets: Mapping[str, Sequence[str]] | None = None,
) -> list[Task]:
    """Tasks for ``counts[split]`` trials of each scenario in each split.

    ``presets`` names the presets of a scenario, which its trials take in turn. Raising a count
    later adds trials and changes none. `UnknownNameError` for a scenario that nobody registered.
    """
    wanted = list(scenarios)
    for name in wanted:
        if name not in known_scenarios:
            raise UnknownNameError("scenario", name, known_scenarios.names())
    tasks = []
    for split, count in counts.items():
        for scenario in wanted:
            names: Sequence[str | None] = (presets or {}).get(scenario) or (None,)
            tasks += [
                Task(dataset, scenario, split, index, names[index % len(names)])
                for index in range(count)
            ]
    return tasks


def plan_scenes(
    dataset: str,
    scenes: Iterable[Scene],
    split: str = "testing",
    recorded: Mapping[str, bool] | None = None,
) -> list[Task]:
    """Tasks for imported scenes, in their order; ``recorded`` gives outcomes by scene name."""
    outcomes = recorded or {}
    tasks = [
        Task(dataset, scene.scenario, split, index, None, scene, outcomes.get(scene.name))
        for index, scene in enumerate(scenes)
    ]
    check_names(tasks)
    return tasks


def check_names(tasks: Iterable[Task]) -> None:
    """Raise `BadInputError` where two tasks would write the same trial."""
    seen: set[str] = set()
    for task in tasks:
        # Some file systems take names that differ only in case for one.
        name = task.trial.lower()
        if name in seen:
            raise BadInputError(f"two trials are called {task.trial!r}; names must be unique")
        seen.add(name)
