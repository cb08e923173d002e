"""Error of imagined motion over time, next to the error of moving on at constant velocity.

For a trial, object i with centre c_i, and a step of s frames, k steps after frame 44:

    e(k) = mean over i of |c'_i(44 + k s) - c_i(44 + k s)|      imagined c', true c
    b(k) = the same for c'_i(44 + k s) = c_i(44) + k (c_i(44) - c_i(44 - s))
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.clips.batch import LAST_OBSERVED, Motion
from physion.clips.clips import observed_source, whole_source
from physion.compute.tasks import Progress
from physion.core.errors import BadInputError
from physion.models.interface import Model, ask
from physion.models.particles.bodies import Poses, SceneParticles, poses_of
from physion.readout.model_calls import model_name
from physion.scenes.scene import Scene
from physion.trials.dataset import Dataset

HORIZON = 105
"""Frames after frame 44 up to which errors are computed: to the usual end of a trial at rest."""
COLUMNS = (
    "model",
    "scenario",
    "stimulus",
    "frames",
    "error",
    "constant_velocity_error",
)
"""``frames`` after frame 44; errors in metres."""
_TRIALS = 16
"""Trials that a model imagines at a time."""

F64 = NDArray[np.float64]


def check_moves_objects(model: Model) -> Any:
    """Return the model; raise `BadInputError` if it gives no motion of objects.

    A model that does has the method ``futures(motions, samples, seed)`` of `ParticleSimulator`,
    which returns particles and motion from frame 44 % stride on, by motion and sample.
    """
    if not callable(getattr(model, "futures", None)):
        raise BadInputError(
            f"model {model_name(model)!r} imagines no motion of objects, so that its rollout has "
            "no error; choose a particle model such as dpi, or leave rollout_errors out"
        )
    return model


def rollout_error(
    dataset: Dataset,
    model: Model,
    trials: Sequence[str],
    *,
    horizon: int = HORIZON,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Return the errors of a model on trials, one row for each trial and step.

    Parameters
    ----------
    dataset
        The dataset. The model gets the observed part only.
    model
        Model with the method ``futures``; one future without noise is compared.
    trials
        Names of trials.
    horizon
        Frames after frame 44 up to which errors are computed.
    progress
        Called after every group of trials.

    Returns
    -------
    errors
        `COLUMNS`; see `motion_error` for what counts. Steps without any object have no row.

    Raises
    ------
    BadInputError
        If the model gives no motion of objects, or positions that are not finite; if a trial has
        no motion, as those imported from a movie.
    """
    moves = check_moves_objects(model)
    seed = ask(model, "seed") or 0
    observed, whole = observed_source(dataset, model.spec), whole_source(dataset, model.spec)
    scenarios = dict(zip(dataset.index["trial"], dataset.index["scenario"], strict=True))
    parts = []
    for start in range(0, len(trials), _TRIALS):
        group = list(trials[start : start + _TRIALS])
        cut, true = observed.context(group).state or (), whole.whole(group).state or ()
        futures = moves.futures(cut, 1, seed)
        for trial, motion, ((particles, poses),) in zip(group, true, futures, strict=True):
            if not np.isfinite(poses.centers).all():
                raise BadInputError(
                    f"model {model_name(model)!r}, trial {trial!r}: positions that are not finite; "
                    "check its weights"
                )
            rows = motion_error(motion, particles, poses, model.spec.stride, horizon)
            rows.insert(0, "model", model_name(model))
            rows.insert(1, "scenario", str(scenarios[trial]))
            rows.insert(2, "stimulus", trial)
            parts.append(rows)
        if progress is not None:
            progress("rollout errors", start + len(group), len(trials))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(COLUMNS))


def motion_error(
    motion: Motion, particles: SceneParticles, imagined: Poses, stride: int, horizon: int
) -> pd.DataFrame:
    """Return the errors of one trial: ``frames``, ``error``, ``constant_velocity_error``.

    Objects that are not kinematic count in the frames in which they are present. Where the true
    trial ended because everything was at rest, or the imagined one is shorter, the last pose holds.
    A true trial that was cut before has no later frames.

    Parameters
    ----------
    motion
        The true motion, whole.
    particles
        Particles of its objects.
    imagined
        Imagined motion, whose rows are ``stride`` frames apart; one is frame 44.
    stride, horizon
        Frames of a step, and the largest number of frames after frame 44.
    """
    scene, trajectory = motion.scene, motion.trajectory
    now = LAST_OBSERVED // stride
    steps = np.arange(1, horizon // stride + 1)
    frames = LAST_OBSERVED + stride * steps
    if not trajectory.completed:
        steps, frames = (values[frames < len(trajectory)] for values in (steps, frames))
    truth = poses_of(particles, motion, np.minimum(frames, len(trajectory) - 1).tolist()).centers
    centers = imagined.centers
    reached = centers[np.minimum(now + steps, len(centers) - 1)]
    constant = centers[now] + steps[:, None, None] * (centers[now] - centers[now - 1])
    present = [np.array(scene.present(int(frame)))[particles.things] for frame in frames]
    # Not by the kinds of particles: some models predict kinematic bodies too.
    free = np.array([not _kinematic(scene, thing) for thing in particles.things])
    counted = np.array(present, bool).reshape(len(frames), len(free)) & free
    some = counted.any(axis=1)
    return pd.DataFrame(
        {
            "frames": (stride * steps)[some],
            "error": _mean_distance(reached, truth, counted)[some],
            "constant_velocity_error": _mean_distance(constant, truth, counted)[some],
        }
    )


def _kinematic(scene: Scene, thing: int) -> bool:
    return thing < len(scene.bodies) and scene.bodies[thing].kinematic


def _mean_distance(first: F64, second: F64, counted: NDArray[np.bool_]) -> F64:
    """Return the mean distance (T,) of centres (T, K, 3) of the objects that count (T, K)."""
    distances = np.linalg.norm(first - second, axis=-1)
    count = np.maximum(counted.sum(axis=1), 1)
    mean: F64 = (distances * counted).sum(axis=1) / count
    return mean
