"""Measures of one generated movie: contact, its time, paths, permanence, size, colour, background.

Times are frames of the trial, lengths pixels of the trial's pictures unless metres are named. The
movie is compared with the true one, which is tracked in the same way; see `COLUMNS`.

Contact is judged by rule, frame by frame:

1. *On the path*: where agent and patient are seen where and as large as they truly are, within
   `PATH` and `SIZE`, they touch if the states of the trial say so.
2. *Seen*: elsewhere they touch if in `LASTS` successive frames no more than `NEAR` lies between
   their pixels and a rigid agent, with its shape and size, stands on the patient
   (`physion.judging.ground`); of a cloth, if no pixel lies between them.

``contact_seen`` is what the second rule says by itself, in all frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from physion.judging.ground import Ground
from physion.judging.track import (
    AGENT,
    PATIENT,
    U8,
    Floats,
    Mask,
    Seen,
    Tracker,
    hue_between,
    shift_between,
    with_hue,
)
from physion.physics.labels import contact_frames
from physion.trials.trial_file import Trial

PATH, SIZE = 0.02, 0.15
"""Largest error of place and size (root of the area) on the true path, as a fraction of the width,
and of a size that is larger than a tenth of the width, as a fraction of it."""
LASTS = 5
"""Frames of the trial that a contact lasts, at the rate of the true movie."""
NEAR = 0.012
"""Largest distance of the pixels of a rigid agent and the patient, as a fraction of the width."""
STILL = 12
"""Largest change of a pixel of the background over the true movie, of 255."""

COLUMNS = {
    "contact": "agent and patient touch after the observed part",
    "contact_frame": "frame of the trial in which they first touch",
    "contact_seen": "the same as contact, by the movie only, also where it follows the true one",
    "on_path": "fraction of the frames in which agent and patient are seen as truly",
    "distance": "smallest distance of their pixels, pixels",
    "trajectory": "mean distance of the agent from its true place, pixels",
    "trajectory_end": "distance of the agent from its true place when it is last seen, pixels",
    "trajectory_metres": "median distance on the floor, below the agent's lowest pixels, metres",
    "travelled": "length of the agent's path, as a fraction of the true one",
    "jump": "largest step of the agent in 0.01 s less the largest true one, pixels",
    "agent_seen": "fraction of the frames that truly show the agent, in which it is seen",
    "patient_seen": "fraction of the frames that truly show the patient, in which it is seen",
    "agent_size": "mean absolute log2 of the agent's area by the true one",
    "patient_size": "mean absolute log2 of the patient's area by the true one",
    "agent_color": "mean difference of the agent's mean colour from the true one, of 255",
    "patient_color": "mean difference of the patient's mean colour from the true one, of 255",
    "background": "mean change of pixels that truly never change, of 255",
    "shift": "shift of the whole movie, which was undone, pixels",
    "hue": "shift of all hues, which was undone, degrees",
}
"""Measures of a movie with their meaning."""


class Tracks(NamedTuple):
    """What is seen in T frames: agent and patient (T, 2, ...), and what is between them.

    ``frames`` (T,): frames of the trial. ``area``, ``centers`` (x, y), ``colors``; ``lowest``
    (T, 2): lower edge of the agent's lowest pixels; ``distance`` (T,); ``touching`` (T,) bool.
    """

    frames: Floats
    area: Floats
    centers: Floats
    colors: Floats
    lowest: Floats
    distance: Floats
    touching: Mask

    def at(self, chosen: NDArray[Any]) -> Tracks:
        """Return the chosen frames."""
        parts: list[Any] = [values[chosen] for values in self]
        return Tracks(*parts)


@dataclass(frozen=True)
class KnownMovie:
    """What is known of a trial, to judge movies by: its true movie, its contacts, and the ground.

    - ``pictures`` (F, H, W, 3): the true movie. ``roles`` (H, W): agent and patient in its first.
    - ``tracks``: of the true movie. ``contacts``: frames in which they truly touch.
    - ``still`` (H, W): pixels that never change.
    """

    pictures: U8
    roles: U8
    rate: float
    observed: int
    ground: Ground | None
    contacts: NDArray[np.int32]
    still: Mask
    tracks: Tracks = field(repr=False)


def reference_of(trial: Trial, pictures: U8, rate: float) -> KnownMovie:
    """Return what is known of a trial from its file and its true movie (F, H, W, 3)."""
    scene = trial.scene
    agent, patient = (scene.index(name) + 1 for name in (scene.roles.agent, scene.roles.patient))
    roles = np.where(trial.ids == agent, AGENT, np.where(trial.ids == patient, PATIENT, 0))
    roles = roles.astype(np.uint8)
    ground = Ground.of(scene, trial.ids)
    some = pictures[:: max(len(pictures) // 12, 1)].astype(np.int16)
    frames = np.arange(len(pictures), dtype=np.float64)
    return KnownMovie(
        pictures=pictures,
        roles=roles,
        rate=rate,
        observed=trial.metadata.observed_frames,
        ground=ground,
        contacts=contact_frames(scene, trial.trajectory),
        still=np.asarray((np.ptp(some, axis=0) <= STILL).all(axis=-1)),
        tracks=follow(Tracker(pictures[0], roles), pictures, frames),
    )


def follow(
    tracker: Tracker,
    pictures: Iterable[U8],
    frames: Floats,
    touches: Callable[[Seen, float, int], bool] = lambda agent, distance, width: False,
    observed: int = 0,
) -> Tracks:
    """Return what a tracker sees in pictures, of which the ``frames`` of the trial are known.

    ``touches(agent, distance, width)`` is asked in frames that are not ``observed`` and show both;
    by default nothing touches.
    """
    rows = []
    for frame, picture in zip(frames, pictures, strict=True):
        agent, patient = tracker.see(picture)
        distance, lowest, touching = np.nan, np.full(2, np.nan), False
        if agent.area:
            across, down = agent.outline.T
            lowest = np.array([across[down == down.max()].mean() + 0.5, down.max() + 1])
        if agent.area and patient.area:
            distance = float(KDTree(patient.outline).query(agent.outline)[0].min())
            touching = frame >= observed and touches(agent, distance, picture.shape[1])
        rows.append((agent, patient, lowest, distance, touching))
    return Tracks(
        frames=frames,
        area=np.array([[a.area, p.area] for a, p, *_ in rows], np.float64),
        centers=np.array([[a.center, p.center] for a, p, *_ in rows]),
        colors=np.array([[a.color, p.color] for a, p, *_ in rows]),
        lowest=np.array([row[2] for row in rows]),
        distance=np.array([row[3] for row in rows], np.float64),
        touching=np.array([row[4] for row in rows], np.bool_),
    )


def measure(
    movie: U8, rate: float, first_frame: int, reference: KnownMovie
) -> tuple[dict[str, Any], Tracks]:
    """Return the measures of a movie, by `COLUMNS`, and its tracks.

    - ``movie`` (T, H, W, 3): pictures of the trial's size; ``rate``: frames a second.
    - ``first_frame``: the frame of the trial that the first one shows.
    """
    truth = reference.tracks
    frames = first_frame + np.arange(len(movie), dtype=np.float64) * (reference.rate / rate)
    last = len(truth.frames) - 1
    start = reference.pictures[min(first_frame, last)]
    dx, dy = shift_between(movie[0], start)
    if dx or dy:
        movie = np.roll(movie, (-dy, -dx), (1, 2))
    hue = hue_between(movie[0], start)
    if hue:
        movie = with_hue(movie, -hue)
    tracker = Tracker(reference.pictures[0], reference.roles, _last_seen(truth, first_frame))

    def touches(agent: Seen, distance: float, width: int) -> bool:
        ground = reference.ground
        if ground is None:
            return bool(distance <= np.sqrt(2))
        return distance <= NEAR * width and ground.touches(agent.outline)

    tracks = follow(tracker, movie, frames, touches, reference.observed)
    new = (frames >= reference.observed) & (frames <= last + 0.5)
    own, true = tracks.at(new), truth.at(np.minimum(np.round(frames[new]).astype(int), last))
    still = reference.still
    change = np.abs(movie[-1].astype(np.int16) - movie[0])[still].mean() if still.any() else np.nan
    found = {
        **_contact(own, true, reference, rate, movie.shape[2]),
        **_paths(own, true, reference.ground),
        **_objects(own, true),
        "background": float(change),
        "shift": float(np.hypot(dx, dy)),
        "hue": hue,
    }
    return {name: found[name] for name in COLUMNS}, tracks


def _last_seen(truth: Tracks, frame: int) -> tuple[Floats, float, float] | None:
    """Return where the agent truly is up to a frame, as `Tracker` takes it; None if nowhere."""
    area = truth.area[: frame + 1, 0]
    seen = np.flatnonzero(area)
    if not len(seen):
        return None
    return truth.centers[seen[-1], 0], float(np.sqrt(area[seen[-1]])), float(area.max())


def _contact(
    own: Tracks, true: Tracks, reference: KnownMovie, rate: float, width: int
) -> dict[str, Any]:
    """Return whether agent and patient touch, from which frame on, and by which rule."""
    lasts = max(2, round(LASTS * rate / reference.rate))
    seen = np.convolve(own.touching, np.ones(lasts))[lasts - 1 :] >= lasts - 0.5
    on_path = np.ones(len(own.frames), np.bool_)
    for place in range(2):
        both_hidden = (own.area[:, place] == 0) & (true.area[:, place] == 0)
        apart = np.hypot(*(own.centers - true.centers)[:, place].T)
        sizes = [np.sqrt(tracks.area[:, place]) for tracks in (own, true)]
        most = np.maximum(PATH * width, SIZE * sizes[1])
        close = (apart <= PATH * width) & (np.abs(sizes[0] - sizes[1]) <= most)
        on_path &= both_hidden | close
    # A true contact counts for the first frame that does not come before it.
    so_far = np.searchsorted(reference.contacts, own.frames, side="right")
    before = np.searchsorted(reference.contacts, reference.observed)
    touching = np.where(on_path, np.diff(so_far, prepend=before) > 0, seen)
    known = own.distance[np.isfinite(own.distance)]
    return {
        "contact": bool(touching.any()),
        "contact_frame": round(float(own.frames[touching.argmax()])) if touching.any() else None,
        "contact_seen": bool(seen.any()),
        "on_path": float(on_path.mean()) if len(on_path) else float("nan"),
        "distance": float(known.min()) if len(known) else float("nan"),
    }


def _paths(own: Tracks, true: Tracks, ground: Ground | None) -> dict[str, float]:
    """Return how far the agent is from where it truly is."""
    apart = np.hypot(*(own.centers - true.centers)[:, 0].T)
    known = np.isfinite(apart)
    steps = [_steps(tracks) for tracks in (own, true)]
    travelled = [step[:, 0].sum() for step in steps]
    metres = float("nan")
    if ground is not None:
        places = [ground.places(tracks.lowest) for tracks in (own, true)]
        between = np.linalg.norm(places[0] - places[1], axis=1)
        metres = float(np.nanmedian(between)) if np.isfinite(between).any() else metres
    return {
        "trajectory": float(apart[known].mean()) if known.any() else float("nan"),
        "trajectory_end": float(apart[known][-1]) if known.any() else float("nan"),
        "trajectory_metres": metres,
        "travelled": float(travelled[0] / travelled[1]) if travelled[1] > 0 else float("nan"),
        "jump": float(steps[0][:, 1].max(initial=0) - steps[1][:, 1].max(initial=0)),
    }


def _steps(tracks: Tracks) -> Floats:
    """Return length and speed (pixels in a frame of the trial) of each step of the agent, (S, 2).

    Steps shorter than half a pixel are noise and count as 0.
    """
    known = np.isfinite(tracks.centers[:, 0, 0])
    lengths = np.hypot(*np.diff(tracks.centers[known, 0], axis=0).T)
    times = np.maximum(np.diff(tracks.frames[known]), 1.0)
    return np.column_stack([np.where(lengths < 0.5, 0, lengths), lengths / times])


def _objects(own: Tracks, true: Tracks) -> dict[str, float]:
    """Return permanence, change of size and of colour of both objects."""
    found: dict[str, float] = {}
    for place, name in enumerate(("agent", "patient")):
        truly = true.area[:, place] > 0
        both = (own.area[:, place] > 0) & truly
        ratio = np.abs(np.log2(own.area[both, place] / true.area[both, place]))
        color = np.abs(own.colors[both, place] - true.colors[both, place])
        found |= {
            f"{name}_seen": float(both.sum() / truly.sum()) if truly.any() else float("nan"),
            f"{name}_size": float(ratio.mean()) if both.any() else float("nan"),
            f"{name}_color": float(color.mean()) if both.any() else float("nan"),
        }
    return found
