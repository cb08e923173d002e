"""What happened in the observed frames, as simulations that are compared with the masks.

The scene of the first frame is at rest (`resting`), and whatever moves then was pushed, falls, or
was moved by another object. A hypothesis is a scene within the errors of the fits, and at most one
push; it is simulated through the observed frames, and its masks are compared with those seen:

    mismatch of an object in a frame = |A xor B| / (|A| + |B| + 8) + min(1, d / 15) / 2,

with A its pixels in a picture of `SIZE` pixels a side, B its simulated ones, d the distance of
their centroids in pixels. Pixels of scenery that may hide objects do not count. The loss is the
mean over frames and objects; agent and patient count twice. Each object whose mask does not change
between the first and the last frame, but which the hypothesis moves, adds `MOVED` times its weight
in this mean.

1. The scene without errors and without push is simulated. The first object that moves otherwise is
   the one that was pushed; velocity and frame follow from its centroids, taken to the height of
   its middle, or from a flight, if that explains them much better. With o the camera, u_t the unit
   vector to the centroid a time t after the push, m the place on the ray to the first centroid that
   is as deep as the middle at rest, and g = (0, 0, 9.81 m/s^2), the velocity v of a flight is that
   with the least sum of |u_t x (m + v t - g t^2 / 2 - o)|^2.
2. Hypotheses are drawn in rounds, each from a normal distribution around the best ones so far:
   first only the push, and the places of what stands on nothing, then everything.
3. What the masks of the last frame contradict is fitted to them again, with its size, and its
   velocity is that between the last frames. Without depth it stays about as far away as in the
   hypothesis. What has not moved by its mask is put back where it was in the first frame, at rest.
   So each of the best hypotheses gives a scene and a state at the last observed frame, with a
   weight that falls with its loss.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from physion.clips.batch import AGENT_ID, LAST_OBSERVED, PATIENT_ID, SCENERY_ID
from physion.core.errors import PhysionError
from physion.core.seeds import generator
from physion.models.noisy_simulation import ObservedTrial, joint_roots
from physion.models.seeing.bodies import moved_with
from physion.models.seeing.expected import NEAREST, expect
from physion.models.seeing.masks import MaskFit, traced
from physion.models.seeing.pixels import Rays, picture_of
from physion.models.seeing.resting import (
    Resting,
    UncertainFrame,
    resting_scene,
    stacked,
    uncertain_frame,
)
from physion.models.seeing.scenes import SeenTrial, Track, body_of, camera_of, joints_of, numbers_of
from physion.models.seeing.solids import Placed
from physion.numerics.rotations import rotation_matrices
from physion.physics.engine import Engine, simulate
from physion.physics.labels import label_contact
from physion.physics.trajectory import State, Trajectory
from physion.rendering.renderer import Renderer
from physion.scenes.scene import (
    FRAME_TIME,
    GRAVITY,
    OBSERVED_FRAMES,
    Ending,
    Push,
    Roles,
    Scene,
    vec3,
)

F64 = NDArray[np.float64]
Ids = NDArray[np.uint8]

SIZE = 96
"""Pixels per side of the pictures in which hypotheses are compared."""
COMPARED = 9
"""Frames in which they are compared."""
MISSED = 15.0
"""Distance of centroids, in pixels, that counts as no match."""
OTHERWISE = 0.12
"""Rise of the mismatch with which an object moves otherwise than simulated."""
STARTED, FAST = 0.5, 2.0
"""Pixels that it has moved by then, and within four frames, if it was pushed strongly."""
FLIGHT, RISES, FASTEST, BETTER = 20, 0.5, 12.0, 0.1
"""Frames from which a flight follows, its least velocity upwards and largest speed, m/s, and the
largest mean square of its distances, as a part of what a level motion has."""
ROUNDS, DRAWN, BEST = (3, 2), 40, 8
"""Rounds of both stages, hypotheses of a round, and those that the next one is drawn around."""
NARROWEST = (0.08, 0.4)
"""Least standard deviations of the next round, of what was drawn from the start and of the rest."""
KEPT, TEMPERATURE = 12, 0.01
"""Hypotheses that are kept, and the difference of losses at which the weight falls by 1/e."""
CONTRADICTED = 0.12
"""Mismatch in the last frame above which an object is fitted there again."""
UNCHANGED = 0.02
"""Part of the pixels of an object that may differ between the first and the last frame, if it has
not moved."""
SHIFT = 0.02
"""Metres from its first place at which a simulated object has moved."""
MOVED = 0.2
"""Loss of moving all objects that have not moved."""
LAST_FRAMES = (36, 40)
"""Frames from which, to the last one, its velocity follows."""
POORLY = 0.3
"""Loss above which hypotheses explain the masks poorly."""
SAME_FACTOR, SAME_DEPTH = 0.004, 0.02
"""Standard deviation of ln s of an object between frames; without depth, of the logarithm of its
depth, about the depth in the hypothesis."""


@dataclass(frozen=True, eq=False)
class _Tried:
    """A simulated hypothesis: its ``loss`` and the mismatches (T, K) of frames and objects.

    ``moved`` (K,): objects that it moves and that have not moved.
    """

    values: F64
    loss: float
    mismatches: F64
    moved: NDArray[np.bool_]
    scene: Scene
    path: Trajectory


class Video:
    """The observed masks, and how well simulations explain them.

    Parameters
    ----------
    pictures
        By frame.
    camera
        View and projection matrix (2, 4, 4).
    numbers
        Of the objects.
    depth
        Whether depth is seen.
    """

    def __init__(
        self,
        pictures: Mapping[int, UncertainFrame],
        camera: F64,
        numbers: Sequence[int],
        *,
        depth: bool = True,
    ) -> None:
        self.depth = depth
        self.frames, self.camera, self.numbers = sorted(pictures), camera, list(numbers)
        seen = pictures[self.frames[0]].seen
        self.origin, (height, width) = seen.origin, seen.ids.shape
        rows = ((np.arange(SIZE) + 0.5) * height / SIZE).astype(np.int64)
        columns = ((np.arange(SIZE) + 0.5) * width / SIZE).astype(np.int64)
        chosen = np.ix_(rows, columns)
        self.ids = np.stack([pictures[f].seen.ids[chosen] for f in self.frames])
        self.before = np.stack([pictures[f].before[chosen] for f in self.frames])
        self.centroids = self._centroids(self.ids)
        every = np.linspace(1, len(self.frames) - 1, min(COMPARED, len(self.frames)))
        self.compared = sorted({round(row) for row in every})
        weights = [2.0 if number in (AGENT_ID, PATIENT_ID) else 1.0 for number in self.numbers]
        self.weights = np.array(weights) / sum(weights)
        self.still = np.array([self._unchanged(number) for number in self.numbers])

    def _unchanged(self, number: int) -> bool:
        """Return whether an object has not moved, by its masks in the first and the last frame.

        Pixels that another object hides in one of them say nothing.
        """
        first, last = self.ids[0], self.ids[-1]
        then, now = first == number, last == number
        changed = (then & (last == SCENERY_ID)) | (now & (first == SCENERY_ID))
        pixels = np.count_nonzero(then) + np.count_nonzero(now)
        common = 2 * np.count_nonzero(then & now) >= np.count_nonzero(then) > 0
        return bool(common and np.count_nonzero(changed) <= UNCHANGED * pixels)

    def moved(self, scene: Scene, path: Trajectory) -> NDArray[np.bool_]:
        """Return which objects (K,) a simulation moves that have not moved.

        With one, all that are joined to it.
        """
        shift = path.positions[self.frames[-1]] - path.positions[self.frames[0]]
        moved = self.still & (np.linalg.norm(shift, axis=1) > SHIFT)
        roots = joint_roots(scene)
        return np.asarray(np.isin(roots, roots[moved]))

    def _centroids(self, ids: Ids) -> F64:
        """Return the centroids (T, K, 2), column and row, of objects; NaN of what is not seen."""
        out = np.full((len(ids), len(self.numbers), 2), np.nan)
        for t, picture in enumerate(ids):
            for k, number in enumerate(self.numbers):
                rows, columns = np.nonzero(picture == number)
                if len(rows):
                    out[t, k] = columns.mean(), rows.mean()
        return out

    def mismatches(self, scene: Scene, path: Trajectory, rows: Sequence[int]) -> F64:
        """Return the mismatches (len(rows), K) of a simulation."""
        renderer = Renderer(scene, path, SIZE, SIZE)
        numbers = np.array([SCENERY_ID, *(int(body.name) for body in scene.bodies)], np.uint8)
        drawn = np.stack([numbers[renderer.render(self.frames[row], ("ids",)).ids] for row in rows])
        out = np.zeros((len(rows), len(self.numbers)))
        centroids = self._centroids(drawn)
        for t, row in enumerate(rows):
            counts = ~self.before[row]
            for k, number in enumerate(self.numbers):
                seen, made = self.ids[row] == number, drawn[t] == number
                area = np.count_nonzero(seen) + np.count_nonzero(made)
                wrong = np.count_nonzero((seen ^ made) & counts) / (area + 8)
                apart = float(np.hypot(*(centroids[t, k] - self.centroids[row, k])))
                far = (MISSED if area else 0.0) if math.isnan(apart) else apart
                out[t, k] = wrong + min(1.0, far / MISSED) / 2
        return out

    def shift(self, k: int) -> F64:
        """Return how far the centroid of an object is from its first place, by frame, pixels."""
        apart = np.hypot(*(self.centroids[:, k] - self.centroids[0, k]).T)
        return np.asarray(np.where(np.isfinite(apart), apart, 0.0))

    def places(self, k: int, height: float, rows: Sequence[int]) -> tuple[F64, F64]:
        """Return frames and places (N, 2) of a centroid on the level of a height, metres.

        Only up to the first frame in which that is not known.
        """
        frames, places = [], []
        for row in rows:
            ray = self.ray(k, row)
            along = (height - self.origin[2]) / ray[2] if abs(ray[2]) > 1e-3 else -1.0
            if not along > 0:
                break
            frames.append(float(self.frames[row]))
            places.append((self.origin + along * ray)[:2])
        return np.array(frames), np.array(places).reshape(-1, 2)

    def ray(self, k: int, row: int) -> F64:
        """Return the vector (3,) to depth 1 of a centroid; NaN of what is not seen."""
        view, projection = self.camera
        x = (2 * (self.centroids[row, k, 0] + 0.5) / SIZE - 1) / projection[0, 0]
        y = (1 - 2 * (self.centroids[row, k, 1] + 0.5) / SIZE) / projection[1, 1]
        return np.asarray(np.array([x, y, 1.0]) @ view[:3, :3])


@dataclass(frozen=True, eq=False)
class PushGuess:
    """Push of an object: ``mean`` and ``spread`` (7,) of what is drawn.

    Velocity along x and y (m/s), place of the push above the middle and to one side of it (parts of
    the size), frame, velocity upwards, logarithm of the factor of the mass.
    """

    number: int
    mean: F64
    spread: F64

    def push(self, placed: Placed, mass: float, values: F64) -> tuple[Push, float]:
        """Return the push of standard normal ``values``, and the mass of the object."""
        x, y, over, aside, frame, up, heavier = self.mean + self.spread * values
        mass *= float(np.exp(np.clip(heavier, -2, 2)))
        velocity = np.array([x, y, up])
        across = np.array([-y, x, 0.0]) / max(math.hypot(x, y), 1e-6)
        size = placed.size()
        point = placed.middle() + across * np.clip(aside, -0.5, 0.5) * size[:2].mean()
        point[2] += np.clip(over, -0.5, 0.5) * size[2]
        impulse = mass * velocity
        frame = int(np.clip(round(frame), 0, LAST_OBSERVED - 1))
        return Push(str(self.number), vec3(impulse), vec3(point), frame), mass


def see_uncertain(
    frames: Sequence[int],
    ids: Ids,
    depth: NDArray[np.floating] | None,
    camera: F64,
    error: float,
    engine: Engine,
) -> SeenTrial:
    """Return what was seen of a trial whose depth has an error, or is not seen.

    Parameters
    ----------
    frames
        (T,) numbers of the frames.
    ids, depth, camera
        (T, H, W), (T, H, W) and (2, 4, 4), as in `physion.clips.batch.Batch`. Depth may be None.
    error
        Relative error of depth, of an object in all frames and of each pixel; also of what is
        expected without depth.
    engine
        That simulates.

    Raises
    ------
    BadInputError
        As `scenes.see_trial`.
    """
    numbers, seen_depth = numbers_of(ids), depth is not None
    depth, expected = expect(frames, ids, depth, camera)
    pictures = {
        int(frame): uncertain_frame(picture_of(ids[row], depth[row], camera), error)
        for row, frame in enumerate(frames)
    }
    objects = resting_scene(pictures, numbers, error, expected)
    notes = [
        f"object {one.number} is first fitted in frame {one.frame}"
        for one in objects.values()
        if one.frame != min(pictures)
    ]
    unseen = [
        f"the {word} is never seen"
        for number, word in ((AGENT_ID, "agent"), (PATIENT_ID, "patient"))
        if number not in objects
    ]
    if unseen:
        return SeenTrial(None, (), "; ".join(notes + unseen))
    video = Video(pictures, camera, list(objects), depth=seen_depth)
    tried = _search(video, objects, _pushed(video, objects, engine), engine)[:KEPT]
    if not tried:
        return SeenTrial(None, (), "; ".join([*notes, "no hypothesis could be simulated"]))
    if tried[0].loss > POORLY:
        notes.append(f"simulations explain the masks poorly ({tried[0].loss:.2f})")
    weights = np.exp([-(each.loss - tried[0].loss) / TEMPERATURE for each in tried])
    found = [_observed(video, objects, pictures, each, rank) for rank, each in enumerate(tried)]
    tracks = _tracks(video, objects, tried[0], found[0].state)
    return SeenTrial(found[0], tracks, "; ".join(notes), tuple(zip(found, weights, strict=True)))


def _simulated(
    video: Video,
    solids: Mapping[int, Placed],
    engine: Engine,
    guess: PushGuess | None,
    values: F64 | None = None,
) -> tuple[Scene, Trajectory]:
    """Return a hypothesis as a scene, and its observed frames."""
    bodies = [body_of(number, solids[number], 0.0) for number in video.numbers]
    pushes: tuple[Push, ...] = ()
    if guess is not None and values is not None:
        k = video.numbers.index(guess.number)
        push, mass = guess.push(solids[guess.number], bodies[k].mass, values)
        pushes, bodies[k] = (push,), replace(bodies[k], mass=mass)
    first = video.frames[0]
    tracks = [Track(number, (first,), (solids[number],)) for number in video.numbers]
    scene = Scene(
        "seen", "seen", tuple(bodies), Roles(str(AGENT_ID), str(PATIENT_ID)),
        camera_of(video.camera), joints=joints_of(tracks, bodies), floor=0.0, ending=Ending(),
        pushes=pushes,
    )  # fmt: skip
    return scene, simulate(scene, engine=engine, frames=OBSERVED_FRAMES)


def _pushed(video: Video, objects: Mapping[int, Resting], engine: Engine) -> PushGuess | None:
    """Return the push of the object that is the first to move otherwise than without a push."""
    scene, path = _simulated(video, stacked(objects), engine, None)
    every = list(range(len(video.frames)))
    mismatches = video.mismatches(scene, path, every)
    rises = mismatches - mismatches[0]
    for fast in (FAST, STARTED):
        found = []
        for k, number in enumerate(video.numbers):
            one, shift = objects[number], video.shift(k)
            falls = one.fit.rest is None and one.placed.extent_z()[0] > 0.15
            if falls or one.frame != video.frames[0]:
                continue
            started = np.flatnonzero((shift > STARTED) & (rises[:, k] > OTHERWISE))
            rows = [row for row in started.tolist() if shift[row : row + 4].max() > fast]
            if rows:
                late = shift[min(rows[0] + 2, len(shift) - 1)]
                found.append((int(rows[0]), -float(late), k))
        for row, _, k in sorted(found)[:1]:
            placed = objects[video.numbers[k]].placed
            return _flight(video, k, row, placed) or _guess(video, k, row, placed)
    return None


def _flight(video: Video, k: int, row: int, placed: Placed) -> PushGuess | None:
    """Return the push of an object that flies from a row on; None where no flight is seen.

    A motion on the level of its middle is fitted in the same way, to compare.
    """
    away = float(video.camera[0, 2, :3] @ (placed.middle() - video.origin))
    rest, frames = video.ray(k, 0) * away, np.array(video.frames)
    found: dict[bool, list[tuple[float, int, F64]]] = {True: [], False: []}
    for start in range(video.frames[max(0, row - 2)], video.frames[row] + 1):
        rows = np.flatnonzero((frames > start) & (frames <= start + FLIGHT))
        times = (frames[rows] - start) * FRAME_TIME
        rays = np.array([video.ray(k, r) for r in rows.tolist()]).reshape(-1, 3)
        if start + FLIGHT > frames[-1] or not np.isfinite(rays).all():
            continue
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = np.cross(rays[:, None], np.eye(3)).transpose(0, 2, 1)
        for flies in (True, False):
            middle = np.tile(rest, (len(rows), 1))
            middle[:, 2] -= flies * GRAVITY * times**2 / 2
            matrix = (across * times[:, None, None])[..., : 2 + flies].reshape(-1, 2 + flies)
            wanted = -np.einsum("nij,nj->ni", across, middle).ravel()
            velocity = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
            apart = float(np.square(matrix @ velocity - wanted).mean())
            found[flies].append((apart, start, velocity))
    if not found[True]:
        return None
    apart, start, velocity = min(found[True], key=lambda one: one[0])
    speed, level = float(np.linalg.norm(velocity)), min(one[0] for one in found[False])
    if apart > BETTER * level or velocity[2] < RISES or speed > FASTEST:
        return None
    x, y, up = velocity.tolist()
    # A push of a frame acts in the step that leads to it.
    mean = np.array([x, y, 0.0, 0.0, start + 1, up, 0.0])
    wide = 0.1 * speed + 0.05
    return PushGuess(video.numbers[k], mean, np.array([wide, wide, 0.25, 0.12, 1.0, wide, 0.6]))


def _guess(video: Video, k: int, row: int, placed: Placed) -> PushGuess | None:
    """Return the push of an object whose motion is seen from a row on.

    Its velocity is the largest of the first three steps: later it has met something.
    """
    rows = range(max(0, row - 2), min(len(video.frames), row + 7))
    frames, places = video.places(k, float(placed.middle()[2]), rows)
    if len(frames) < 3:
        return None
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    if steps.max() < 1e-5:
        return None
    start = int(np.argmax(steps > 0.3 * steps.max()))
    fastest = start + int(np.argmax(steps[start : start + 3]))
    velocity = (places[fastest + 1] - places[fastest]) / (frames[fastest + 1] - frames[fastest])
    speed = float(np.linalg.norm(velocity))
    passed = float((places[fastest] - places[0]) @ velocity) / speed**2
    frame = float(
        np.clip(
            frames[fastest] - passed, frames[max(start - 1, 0)],
            frames[min(start + 1, len(frames) - 1)],
        )
    )  # fmt: skip
    velocity, speed = velocity / FRAME_TIME, max(speed / FRAME_TIME, 0.3)
    side, up = 0.2 * speed + 0.1, 0.15 * speed + 0.05
    mean = np.array([*velocity, 0.0, 0.0, frame, 0.1 * speed, 0.0])
    return PushGuess(video.numbers[k], mean, np.array([side, side, 0.25, 0.12, 1.5, up, 0.6]))


def _search(
    video: Video, objects: Mapping[int, Resting], guess: PushGuess | None, engine: Engine
) -> list[_Tried]:
    """Return all hypotheses that were simulated, best first."""
    early = [np.full(one.spread.shape[1], one.fit.rest is None) for one in objects.values()]
    drawn_early = np.concatenate([*early, np.full(7 * (guess is not None), True)])
    scenes = len(drawn_early) - 7 * (guess is not None)
    rng = generator("seeing", "hypotheses")
    mean, spread = np.zeros(len(drawn_early)), drawn_early.astype(float)
    tried: list[_Tried] = []
    for stage, rounds in enumerate(ROUNDS):
        if stage == 1:
            spread = np.where(drawn_early, spread.clip(0.2), 0.7)
        for _ in range(rounds if spread.any() else 0):
            drawn = mean + spread * rng.standard_normal((DRAWN, len(mean)))
            drawn[0] = mean
            for values in drawn:
                try:
                    solids = stacked(objects, values[:scenes])
                    scene, path = _simulated(video, solids, engine, guess, values[scenes:])
                except PhysionError:
                    continue
                mismatches = video.mismatches(scene, path, video.compared)
                loss = float((mismatches @ video.weights).mean())
                loss += 0.002 * float(np.mean(values[:scenes] ** 2))
                moved = video.moved(scene, path)
                loss += MOVED * float(video.weights @ moved)
                tried.append(_Tried(values, loss, mismatches, moved, scene, path))
            tried.sort(key=lambda each: each.loss)
            del tried[4 * DRAWN :]
            best = np.array([each.values for each in tried[:BEST]])
            if not len(best):
                return []
            mean, least = best.mean(axis=0), NARROWEST[0]
            spread = best.std(axis=0)
            if stage == 0:
                spread = np.where(drawn_early, spread.clip(least), 0.0)
            else:
                spread = np.maximum(spread, np.where(drawn_early, least, NARROWEST[1]))
    return tried


def _observed(
    video: Video,
    objects: Mapping[int, Resting],
    pictures: Mapping[int, UncertainFrame],
    tried: _Tried,
    rank: int,
) -> ObservedTrial:
    """Return scene and state at the last observed frame, corrected by its masks.

    Scenes are named by their rank, so that each gets noise of its own.
    """
    scene, path, last = tried.scene, tried.path, video.frames[-1]
    state, first = path.state(LAST_OBSERVED), path.state(video.frames[0])
    positions, rotations = state.positions.copy(), state.rotations.copy()
    velocities, spins = state.velocities.copy(), state.angular_velocities.copy()
    wrong, moved = tried.mismatches[-1] > CONTRADICTED, tried.moved
    positions[moved], rotations[moved] = first.positions[moved], first.rotations[moved]
    velocities[moved] = spins[moved] = 0.0
    agent, patient = (video.numbers.index(number) for number in (AGENT_ID, PATIENT_ID))
    touched = bool(label_contact(scene, path).contact)
    # An agent that moves a patient that has not moved is elsewhere, too.
    wrong[agent] |= touched and moved[patient]
    for k, number in enumerate(video.numbers):
        if not wrong[k] or moved[k] or number == PATIENT_ID:
            continue
        one, fits = objects[number], {}
        for frame in (*LAST_FRAMES, last):
            rays = pictures[frame].rays(number, 240) if frame in pictures else None
            if rays is not None:
                axis = None if video.depth else video.camera[0, 2, :3]
                fits[frame] = _refitted(one, _placed(one, tried, frame, k), rays, axis)
        if last not in fits:
            continue
        placed = fits.pop(last)
        positions[k] = placed.position
        rotations[k] = np.roll(Rotation.from_matrix(placed.rotation).as_quat(), 1)
        if fits:
            frame = min(fits)
            passed = (last - frame) * FRAME_TIME
            velocities[k] = (placed.middle() - fits[frame].middle()) / passed
    touched &= not wrong[agent] and not moved[agent]
    corrected = State(
        LAST_OBSERVED, positions, rotations, velocities, spins,
        state.cloth_vertices, state.cloth_velocities,
    )  # fmt: skip
    return ObservedTrial(replace(scene, name=f"seen {rank}", pushes=()), corrected, touched)


def _tracks(
    video: Video, objects: Mapping[int, Resting], tried: _Tried, state: State
) -> tuple[Track, ...]:
    """Return the poses of the objects in a hypothesis, the last ones corrected."""
    tracks = []
    for k, number in enumerate(video.numbers):
        shown = [video.frames[0]] * len(video.frames) if tried.moved[k] else video.frames
        placed = [_placed(objects[number], tried, frame, k) for frame in shown]
        rotation = rotation_matrices(state.rotations[k : k + 1])[0]
        placed[-1] = replace(placed[-1], position=state.positions[k], rotation=rotation)
        tracks.append(Track(number, tuple(video.frames), tuple(placed)))
    return tuple(tracks)


def _placed(one: Resting, tried: _Tried, frame: int, k: int) -> Placed:
    """Return an object in a frame of a hypothesis."""
    rotation = rotation_matrices(tried.path.rotations[frame, k : k + 1].astype(np.float64))[0]
    position = tried.path.positions[frame, k].astype(np.float64)
    scale = np.array(tried.scene.bodies[k].scale)
    return Placed(one.placed.solid, position, rotation, scale)


def _refitted(one: Resting, start: Placed, rays: Rays, axis: F64 | None) -> Placed:
    """Return an object in another frame, with its size, near a start or where its mask is.

    ``axis`` (3,): of the camera, if depth is not seen, so that it is as far away as the start; a
    start that is too near to be seen stays.
    """
    factor, deviation = one.fit.log_factor, SAME_FACTOR
    median, center = float(np.median(rays.depth[rays.on])), rays.vectors[rays.on].mean(axis=0)
    if axis is None:
        depth = median * math.exp(factor)
    else:
        depth = float(axis @ (start.middle() - rays.origin))
        if depth < NEAREST:
            return start
    there = moved_with(start, rays.origin + center * depth - start.middle())
    if axis is not None:
        entries, _ = traced(there, rays)
        front = entries[rays.on]
        front = front[front > 0]  # A large object may have the camera inside.
        near = float(np.median(front)) if len(front) else depth
        factor, deviation = math.log(near / median), SAME_DEPTH
    found = []
    for guess in (start, there):
        fit = MaskFit(rays, one.fit.error, None, False, "given", factor, deviation)
        found.append(fit.solve(guess, 8))
    return min(found, key=lambda placed: placed.cost)
