"""Metadata of a trial: names, settings and versions."""

from __future__ import annotations

from dataclasses import dataclass

from physion.errors import BadInputError

MAX_SIDE = 4096
"""Largest width or height in pixels of pictures and movies."""
MAX_FRAMES = 10_000
"""Largest number of frames of a trial."""
MAX_RATE = 1000
"""Most frames per second of a movie."""


@dataclass(frozen=True)
class Metadata:
    """Origin and settings of a trial; nothing in it depends on the time of its making.

    Parameters
    ----------
    trial, dataset, scenario, split
        Names; that of the trial is unique in the dataset.
    index
        Position in the split of the scenario, from 0.
    preset
        Name of the scenario's parameter set; None for an imported scene.
    seed
        Entropy of the trial's `SeedSequence` in hexadecimal; None for an imported scene.
    look
        Colours of the trial's movies, one of `physion.scenes.looks.LOOKS`.
    width, height
        Size of the pictures in pixels.
    frames, observed_frames
        Number of frames of the whole trial, and of the part shown before the prediction.
    frame_time
        Seconds of physics per frame.
    playback_rate
        Frames per second of the movies.
    completed
        True if everything came to rest before the time limit.
    engine, renderer, package
        Names with versions.
    digest
        SHA-256 of the trajectory.
    scene_digest
        SHA-256 of everything that determines the motion (`Scene.physics_digest`).
    attempt
        Number of scenes sampled for this trial and rejected before; None for an imported scene.
    movies, free_movies
        Whether there are movies and a map, and further movies in free colours.
    recorded_contact
        Outcome that an imported scene was recorded with, else None.
    """

    trial: str
    dataset: str
    scenario: str
    split: str
    index: int
    preset: str | None
    seed: str | None
    look: str
    width: int
    height: int
    frames: int
    observed_frames: int
    frame_time: float
    playback_rate: int
    completed: bool
    engine: str
    renderer: str
    package: str
    digest: str
    scene_digest: str
    attempt: int | None = None
    movies: bool = True
    free_movies: bool = False
    recorded_contact: bool | None = None

    @property
    def physics_seconds(self) -> float:
        """Duration in the simulated world, in seconds."""
        return (self.frames - 1) * self.frame_time

    @property
    def playback_seconds(self) -> float:
        """Duration of the movie, in seconds."""
        return self.frames / self.playback_rate

    @property
    def imported(self) -> bool:
        """Whether the motion comes from another simulator."""
        return self.engine.startswith("imported")

    def check(self, where: str) -> None:
        """Raise `BadInputError` for numbers that no trial has; ``where`` names the file."""
        bounds = {
            "width": MAX_SIDE,
            "height": MAX_SIDE,
            "frames": MAX_FRAMES,
            "observed_frames": self.frames,
            "playback_rate": MAX_RATE,
        }
        for name, most in bounds.items():
            if not 1 <= getattr(self, name) <= most:
                raise BadInputError(
                    f"{where}: metadata: {name} must be 1 to {most}, not {getattr(self, name)}"
                )
        if not (self.index >= 0 and self.frame_time > 0):
            raise BadInputError(
                f"{where}: metadata: index must not be negative and frame_time positive, not "
                f"{self.index} and {self.frame_time}"
            )
