"""What is to be made, and how: a task for each trial of a dataset, and the settings of all."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from physion.errors import BadInputError, UnknownNameError
from physion.scenes.sampling.preset import default_presets, get_preset
from physion.scenes.sampling.registry import scenarios as known_scenarios
from physion.scenes.scene import FRAME_TIME, PLAYBACK_RATE, Scene
from physion.seeds import trial_seed
from physion.trials.layout import SAFE_NAME, TrialPaths
from physion.trials.schema import PASSES

SPLITS = ("training", "readout", "testing", "familiarization")
"""Trials for a model's own training, for its readout, for the test that people take too, and for
people to practise on."""

SPLIT_LOOKS: Mapping[str, tuple[str, ...]] = {
    "training": ("free",),
    "readout": ("redyellow",),
    "testing": ("redyellow", "free"),
    "familiarization": ("redyellow", "free"),
}
"""Looks of each split: no cues to train on, cues to read out, and both for the tests that models
and people take (people see free colours and a map of who is who)."""
FULL_COUNTS = {"training": 2000, "readout": 1000, "testing": 150, "familiarization": 10}
"""Trials a scenario, as in the study."""
PLAYBACK_RATES = {"slow": PLAYBACK_RATE, "real": round(1 / FRAME_TIME)}


@dataclass(frozen=True)
class TrialTask:
    """One trial to make: what names it is all that decides it.

    A task without ``scene`` draws its scene from its scenario and ``preset`` (None for the
    scenario's own parameters) with a seed of (dataset, scenario, split, index, attempt).
    ``presets`` are those that it may take: `physion.trials.making.choose` fills in ``preset``,
    ``attempt``, ``robust`` and the ``scene_digest`` that the draw must have. A task with an
    imported ``scene`` takes it as it is, and ``recorded_contact`` is the outcome that it came with.
    """

    dataset: str
    scenario: str
    split: str
    index: int
    preset: str | None = None
    scene: Scene | None = None
    recorded_contact: bool | None = None
    presets: tuple[str, ...] = ()
    attempt: int = 0
    robust: float | None = None
    scene_digest: str | None = None

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
        return f"{self.scenario}_{self.split}_{self.index:04d}"

    def seed(self) -> np.random.SeedSequence:
        """Where all randomness of the trial comes from."""
        return trial_seed(self.dataset, self.scenario, self.split, self.index, self.attempt)


@dataclass(frozen=True)
class GenerateSettings:
    """How trials are chosen, rendered and stored. One folder has one of it."""

    width: int = 256
    """Pixels, even."""
    height: int = 256
    """Pixels, even."""
    look: Literal["redyellow", "free", "split"] = "split"
    """Red agent and yellow patient, or the free colours of the scene with a map of who is who.
    By split: training free, readout red and yellow, testing and familiarization both."""
    movies: bool = True
    """Make movies and maps; without them trials are states alone."""
    playback: Literal["slow", "real"] = "slow"
    """Slow movies show 0.01 s of physics as one frame of 30 a second, as the official ones, 3.33
    times slower than life. Real ones show 100 frames a second."""
    passes: tuple[str, ...] = ()
    """Image passes to store (color depth normals ids flow). Any can be rendered again later."""
    compatible: bool = False
    """Compress with gzip, which every HDF5 reader knows, in place of zstd."""
    jitters: int = 8
    """Jittered simulations that measure how robust each label is; 0 for none."""
    robust: float = 0.0
    """Least share of the jittered simulations that must end as the trial does."""
    min_visible: float = 0.0005
    """Least share of the first frame that agent and patient must each cover."""
    observed_contact: bool = False
    """Take trials for readout, testing and familiarization also if agent and patient touch inside
    the observed part, as the official sets do."""

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 2 or self.width % 2 or self.height % 2:
            raise BadInputError(
                f"movies need an even width and height, not {self.width} x {self.height}"
            )
        unknown = sorted(set(self.passes) - set(PASSES))
        if unknown:
            raise BadInputError(f"unknown passes {unknown}; known: {sorted(PASSES)}")
        if self.look not in ("redyellow", "free", "split"):
            raise BadInputError(f"unknown look {self.look!r}; known: redyellow, free, split")
        if self.playback not in PLAYBACK_RATES:
            raise BadInputError(f"unknown playback {self.playback!r}; known: slow, real")
        if self.jitters < 0 or not 0 <= self.robust <= 1 or not 0 <= self.min_visible < 1:
            raise BadInputError(
                f"jitters {self.jitters} must not be below 0, robust {self.robust} and least "
                f"visible share {self.min_visible} must lie in 0..1"
            )
        if self.robust and not self.jitters:
            raise BadInputError("a least robustness needs jittered simulations; jitters is 0")
        if self.passes and not self.movies:
            raise BadInputError("image passes are stored with movies only; leave one of them out")

    def looks(self, split: str) -> tuple[str, ...]:
        """Looks of the movies of a split; the first is the trial's own."""
        return SPLIT_LOOKS[split] if self.look == "split" else (self.look,)

    @property
    def playback_rate(self) -> int:
        """Movie frames a second."""
        return PLAYBACK_RATES[self.playback]


@dataclass(frozen=True)
class GenerateJob:
    """A task with where and how to do it: all that a worker needs."""

    task: TrialTask
    folder: Path
    settings: GenerateSettings

    @property
    def paths(self) -> TrialPaths:
        """Where the files of the trial go."""
        return TrialPaths(self.folder, self.task.split, self.task.scenario, self.task.trial)

    @property
    def looks(self) -> tuple[str, ...]:
        """Looks of the movies to make; the first is the trial's own."""
        return self.settings.looks(self.task.split)

    def complete(self) -> bool:
        """All files of the trial are there."""
        return self.paths.complete(self.settings.movies, free=len(self.looks) > 1)


def plan_dataset(
    dataset: str,
    scenarios: Iterable[str],
    counts: Mapping[str, int],
    presets: Mapping[str, Sequence[str]] | None = None,
) -> list[TrialTask]:
    """Tasks for ``counts[split]`` trials of each scenario in each split.

    ``presets`` names the presets of a scenario, which its trials take in turn, by default those
    of `default_presets`. Raising a count later adds trials and changes none. `UnknownNameError`
    for a scenario or a preset that there is not.
    """
    wanted = list(scenarios)
    for name in wanted:
        if name not in known_scenarios:
            raise UnknownNameError("scenario", name, known_scenarios.names())
    tasks = []
    for split, count in counts.items():
        for scenario in wanted:
            names = (presets or {}).get(scenario) or default_presets(scenario, split)
            for name in names:
                get_preset(scenario, name)
            tasks += [
                TrialTask(dataset, scenario, split, index, presets=tuple(names))
                for index in range(count)
            ]
    return tasks


def plan_scenes(
    dataset: str,
    scenes: Iterable[Scene],
    split: str = "testing",
    recorded: Mapping[str, bool] | None = None,
) -> list[TrialTask]:
    """Tasks for imported scenes, in their order; ``recorded`` gives outcomes by scene name."""
    outcomes = recorded or {}
    tasks = [
        TrialTask(dataset, scene.scenario, split, index, None, scene, outcomes.get(scene.name))
        for index, scene in enumerate(scenes)
    ]
    check_names(tasks)
    return tasks


def check_names(tasks: Iterable[TrialTask]) -> None:
    """Raise `BadInputError` where two tasks would write the same trial."""
    seen: set[str] = set()
    for task in tasks:
        # Some file systems take names that differ only in case for one.
        name = task.trial.lower()
        if name in seen:
            raise BadInputError(f"two trials are called {task.trial!r}; names must be unique")
        seen.add(name)
