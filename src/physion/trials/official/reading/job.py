"""Description of one import job, and the metadata that every imported trial shares.

These definitions are used both by the module that plans imports and by the modules that carry
them out; they stand here so that those need not import each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physion.physics.trajectory import Trajectory
from physion.scenes.scene import FRAME_TIME, OBSERVED_FRAMES, Scene
from physion.trials.layout import TrialPaths
from physion.trials.metadata import Metadata
from physion.version import __version__

IMPORTED = "imported"
"""Default name of a dataset that is imported from files of other authors."""


@dataclass(frozen=True)
class ImportJob:
    """One official trial to import.

    Parameters
    ----------
    source
        The HDF5 file of the trial, or its movie if there is no HDF5 file.
    paths
        Files to write; they hold the trial's name, scenario and split.
    index
        Position of the trial in its split and scenario, from 0.
    dataset
        Name of the dataset. None: keep the name stored in files that this package exported, and
        use `IMPORTED` for all others.
    contact
        Recorded outcome from the lists next to the source; None if they do not hold it.
    first_frame
        First frame of contact from the same lists; None if unknown.
    """

    source: Path
    paths: TrialPaths
    index: int
    dataset: str | None
    contact: bool | None = None
    first_frame: int | None = None


def imported_metadata(
    job: ImportJob,
    scene: Scene,
    trajectory: Trajectory,
    ids: NDArray[np.int16],
    *,
    look: str,
    movies: bool,
    rate: int,
    recorded: bool | None,
    free_movies: bool = False,
) -> Metadata:
    """Return the metadata of an imported trial.

    Parameters
    ----------
    job, scene, trajectory
        The import job, and the scene and motion that were read.
    ids
        Ids of the first frame (H, W); they give the stored picture size.
    look
        ``redyellow`` or ``free``.
    movies, free_movies
        Whether there are movies in the trial's own look, and further ones in free colours.
    rate
        Movie frames per second.
    recorded
        Outcome that the source recorded; None if it recorded none.
    """
    return Metadata(
        trial=job.paths.trial,
        dataset=job.dataset or IMPORTED,
        scenario=job.paths.scenario,
        split=job.paths.split,
        index=job.index,
        preset=None,
        seed=None,
        look=look,
        width=ids.shape[1],
        height=ids.shape[0],
        frames=len(trajectory),
        observed_frames=OBSERVED_FRAMES,
        frame_time=FRAME_TIME,
        playback_rate=rate,
        completed=bool(trajectory.completed),
        engine=trajectory.engine,
        renderer="imported",
        package=f"physion {__version__}",
        digest=trajectory.digest(),
        scene_digest=scene.physics_digest(),
        movies=movies,
        free_movies=free_movies,
        recorded_contact=recorded,
    )
