"""Plan of a dataset: a task for each trial, and the settings that all trials share."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.seeds import trial_seed
from physion.core.settings import OPTION_ONLY
from physion.physics.engine import DEFAULT_ENGINE, engines
from physion.scenes.sampling.build import scenarios as known_scenarios
from physion.scenes.sampling.sample import default_presets, get_preset
from physion.scenes.scene import FRAME_TIME, PLAYBACK_RATE, Scene
from physion.trials.files import MAX_SIDE, SAFE_NAME, TrialPaths
from physion.trials.trial_file import PASSES

SPLITS = ("training", "readout", "testing", "familiarization")
"""Splits: for a model's own training, for its readout, for the test that models and people take,
and for people's practice."""

SPLIT_LOOKS: Mapping[str, tuple[str, ...]] = {
    "training": ("free",),
    "readout": ("redyellow",),
    "testing": ("redyellow", "free"),
    "familiarization": ("redyellow", "free"),
}
"""Looks of each split; the first is the trial's own. Training shows no colour cues, readout shows
them, testing and familiarization have both (people see the free colours)."""
FULL_COUNTS = {"training": 2000, "readout": 1000, "testing": 150, "familiarization": 10}
"""Trials per scenario in each split, as in the original study."""
PAIR = "pair"
"""Key of ``Scene.parameters`` of the movies of `physion.trials.making.pairs`."""
WHATIF, BASE_CONTACT = "whatif", "base_contact"
"""Keys of ``Scene.parameters`` of the variants of `physion.trials.making.whatif`: what was changed
(with a cue, which test and value, which decide the outcome), and the outcome without the change."""
ANSWERS = (PAIR, WHATIF, BASE_CONTACT)
"""Keys of ``Scene.parameters`` that tell what a model is asked: no model receives them."""
PLAYBACK_RATES = {"slow": PLAYBACK_RATE, "real": round(1 / FRAME_TIME)}


@dataclass(frozen=True)
class TrialTask:
    """One trial to make, fully determined by the fields of this class and the settings.

    - ``dataset``, ``scenario``, ``split``, ``index``: name of the trial; with ``attempt`` they
      determine the seed of a sampled scene.
    - ``preset``: parameter set to sample from; None for the scenario's own parameters.
    - ``scene``: imported scene; None to sample one.
    - ``recorded_contact``: outcome recorded with an imported scene, if known.
    - ``presets``: parameter sets to choose from. `physion.trials.making.choose` fills in
      ``preset``, ``attempt`` and ``robust`` in their place.
    - ``attempt``: number of scenes sampled for this trial and rejected before.
    - ``robust``: fraction of jittered simulations with the same outcome, if measured.
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
        """Return the seed of all random numbers of the trial."""
        return trial_seed(self.dataset, self.scenario, self.split, self.index, self.attempt)


@dataclass(frozen=True)
class GenerateSettings:
    """Settings with which the trials of one folder are chosen, rendered and stored."""

    width: int = 256
    """Pixels, even."""
    height: int = 256
    """Pixels, even."""
    look: Literal["redyellow", "free", "split"] = "split"
    """Colours of the movies: agent red and patient yellow, or the free colours of the scene. With
    'split', training is free, readout red and yellow, testing and familiarization both. Every trial
    with movies also has a map of agent and patient."""
    movies: bool = True
    """Make movies and maps; otherwise trials have only trial files."""
    labels: Annotated[bool, OPTION_ONLY] = True
    """Store labels of all trials. If false, trials of the split training have neither labels nor
    a map of agent and patient."""
    playback: Literal["slow", "real"] = "slow"
    """Slow movies show 0.01 s of physics per frame at 30 frames per second, as the official ones:
    3.33 times slower than real time. Real ones show 100 frames per second."""
    passes: tuple[str, ...] = ()
    """Image passes to store (color depth normals ids flow). All can also be rendered later."""
    compatible: Annotated[bool, OPTION_ONLY] = False
    """Compress with gzip, which every HDF5 reader supports, instead of zstd."""
    jitters: int = 8
    """Number of jittered simulations that measure how robust each label is; 0 for none."""
    robust: Annotated[float, OPTION_ONLY] = 0.0
    """Smallest accepted fraction of jittered simulations with the trial's outcome."""
    min_visible: Annotated[float, OPTION_ONLY] = 0.0005
    """Smallest accepted fraction of the first frame that agent and patient each cover."""
    engine: str = DEFAULT_ENGINE
    """Engine that moves the bodies (see physion ls engines); mujoco has no cloth."""
    observed_contact: Annotated[bool, OPTION_ONLY] = False
    """Accept trials for readout, testing and familiarization also if agent and patient touch in the
    observed part, as the official sets do."""

    def __post_init__(self) -> None:
        sides = self.width, self.height
        if min(sides) < 2 or max(sides) > MAX_SIDE or self.width % 2 or self.height % 2:
            raise BadInputError(
                f"movies need an even width and height from 2 to {MAX_SIDE}, not {self.width} x "
                f"{self.height}"
            )
        unknown = sorted(set(self.passes) - set(PASSES))
        if unknown:
            raise BadInputError(f"unknown passes {unknown}; known: {sorted(PASSES)}")
        if self.engine not in engines:
            raise UnknownNameError("engine", self.engine, engines.names())
        if self.look not in ("redyellow", "free", "split"):
            raise BadInputError(f"unknown look {self.look!r}; known: redyellow, free, split")
        if self.playback not in PLAYBACK_RATES:
            raise BadInputError(f"unknown playback {self.playback!r}; known: slow, real")
        if self.jitters < 0:
            raise BadInputError(f"jitters must be at least 0, not {self.jitters}")
        for name, value in (("robust", self.robust), ("min_visible", self.min_visible)):
            if not 0 <= value <= 1:
                raise BadInputError(f"{name} must lie in 0..1, not {value}")
        if self.robust and not self.jitters:
            raise BadInputError("robust needs jittered simulations, and jitters is 0")
        if self.passes and not self.movies:
            raise BadInputError("image passes are stored with movies only; leave one of them out")

    def stored(self) -> dict[str, Any]:
        """Return the settings as they are stored with a dataset.

        The engine is left out, because its whole name with all versions is stored next to them.
        """
        values = dataclasses.asdict(self)
        del values["engine"]
        if self.labels:
            del values["labels"]  # as in folders that are older than this setting
        return values

    def stores_labels(self, split: str) -> bool:
        """Return whether trials of a split are stored with labels and maps."""
        return self.labels or split != "training"

    def looks(self, split: str) -> tuple[str, ...]:
        """Return the looks of the movies of a split; the first is the trial's own."""
        return SPLIT_LOOKS[split] if self.look == "split" else (self.look,)

    @property
    def playback_rate(self) -> int:
        """Frames per second of the movies."""
        return PLAYBACK_RATES[self.playback]


@dataclass(frozen=True)
class GenerateJob:
    """A task with folder and settings: everything that a worker needs.

    ``taken``: lowest number of a trial of this split and scenario by the digest of its physics, as
    `physion.trials.making.choose.short` gives it. A scene must not have the physics of a trial with
    a lower number.
    """

    task: TrialTask
    folder: Path
    settings: GenerateSettings
    taken: Mapping[int, int] = dataclasses.field(default_factory=dict)

    @property
    def paths(self) -> TrialPaths:
        """Paths of the files of the trial."""
        return TrialPaths(self.folder, self.task.split, self.task.scenario, self.task.trial)

    @property
    def looks(self) -> tuple[str, ...]:
        """Looks of the movies to make; the first is the trial's own."""
        return self.settings.looks(self.task.split)

    @property
    def labelled(self) -> bool:
        """Whether labels and the map of agent and patient are stored; movies of pairs have none."""
        scene = self.task.scene
        paired = scene is not None and PAIR in scene.parameters
        return self.settings.stores_labels(self.task.split) and not paired

    def complete(self) -> bool:
        """Return whether all files of the trial exist."""
        return self.paths.complete(self.settings.movies, len(self.looks) > 1, self.labelled)


def plan_dataset(
    dataset: str,
    scenarios: Iterable[str],
    counts: Mapping[str, int],
    presets: Mapping[str, Sequence[str]] | None = None,
) -> list[TrialTask]:
    """Return tasks for ``counts[split]`` trials of each scenario in each split.

    Raising a count later adds trials and changes none.

    Parameters
    ----------
    dataset
        Name of the dataset; another name gives other scenes.
    scenarios
        Names of scenarios.
    counts
        Trials per scenario, by split.
    presets
        Names of presets by scenario, which the trials take in turn; by default `default_presets`.

    Raises
    ------
    UnknownNameError
        For an unknown scenario or preset.
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
    """Return tasks for imported scenes; ``recorded`` has recorded outcomes by name of the scene."""
    outcomes = recorded or {}
    tasks = [
        TrialTask(dataset, scene.scenario, split, index, None, scene, outcomes.get(scene.name))
        for index, scene in enumerate(scenes)
    ]
    check_names(tasks)
    return tasks


def check_names(tasks: Iterable[TrialTask]) -> None:
    """Raise `BadInputError` if two tasks have the same trial name, ignoring case."""
    seen: set[str] = set()
    for task in tasks:
        # Some file systems do not distinguish upper and lower case.
        name = task.trial.lower()
        if name in seen:
            raise BadInputError(f"two trials are called {task.trial!r}; names must be unique")
        seen.add(name)
