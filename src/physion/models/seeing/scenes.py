"""From the observed frames of a trial to its scene and state at the last of them.

1. Every object is fitted in frame 0, or where most of it is seen (`bodies.find`).
2. Objects that rest on others are fitted again from the bottom up: their lower end is expected at
   the top of what they stand on, and their centre above and below their neighbours. What rests on
   nothing that is seen reaches down to what is below it, or to the floor, and an upper end reaches
   up to what stands on it, where that is hidden. A fit is kept only if it is nearly as good as
   before. Then objects of one shape get the same scales where that fits as well (`bodies.alike`).
3. Every object is followed through the later frames (`bodies.follow`).
4. Velocities of the centres of mass follow from the last three poses, at the times t1, t2, t3. With
   the differences v12, v23 and a = (v23 - v12) / ((t3 - t1) / 2): if a is within 4 m/s2 of gravity
   g, the object flies, and the velocity is the slope of the line through x + g t^2 / 2 (upwards),
   minus g (t3 - h / 2), with h a frame: the velocity of the engine is the one of its last step.
   Otherwise it is v23 + a (t3 - t2 - h) / 2, without the second term if a is above 15 m/s2; for an
   object that is seen in the last two frames this is v23, the velocity of the last step. Angular
   velocities follow from the last two poses; what turns about an axis of symmetry cannot be seen. A
   ball that is on something has w = min(v / r, 7, 2.5 (v0 - v) / r), with v0 its largest speed:
   friction turns it until it rolls.
5. What cannot be seen is expected as it is in our own presets: one density per product of scales,
   a lower one of rings, one friction, and flat targets, ramps and very large things that do not
   move. Nothing is concluded from an object that has not moved so far. A pole, an upright cylinder
   that is much higher than wide, is expected to be joined to what it stands on and to what lies on
   it, unless they have moved apart.

With a sheet of cloth (`cloth.sheet_of`) only steps 1 and 2 are done for the other objects, which
stay: in the engine cloth pushes nothing. The cloth is simulated from frame 0 on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from physion.clips.batch import AGENT_ID, LAST_OBSERVED, PATIENT_ID, SCENERY_ID
from physion.core.errors import BadInputError
from physion.models.gaps import gap_of_bodies
from physion.models.noisy_simulation import ObservedTrial, cut_trial
from physion.models.seeing.bodies import alike, find, follow, moved_with, refine
from physion.models.seeing.cloth import sheet_of, with_stiffness
from physion.models.seeing.pixels import LEAST_PIXELS, Rays, SeenFrame, floor_height, picture_of
from physion.models.seeing.solids import FREE, POSE, Placed, Prior, cost_of, fit
from physion.physics.engine import DEFAULT_ENGINE, Engine, simulate
from physion.physics.rigid.bodies import body_mass
from physion.physics.trajectory import State
from physion.scenes.scene import (
    FLOORS,
    FRAME_TIME,
    GRAVITY,
    OBSERVED_FRAMES,
    Body,
    Camera,
    Cloth,
    Ending,
    Joint,
    Look,
    Roles,
    Scene,
    SurfaceMaterial,
    vec3,
)

F64 = NDArray[np.float64]

MOST_OBJECTS = 15
"""Largest number of objects of a trial."""
RAYS = 1500
"""Rays to which the shape and the size of an object are fitted. Its later poses need fewer."""
CLEAR_PIXELS = 40
"""Pixels in frame 0 with which an object is fitted there."""
DENSITY, RING_DENSITY = 32.0, 4.0
"""kg per product of scales (m3): medians over the movable bodies, and the rings among them, of 12
scenes of the default preset of each rigid scenario (benchmarks/models/seeing.py --priors)."""
SURFACE = SurfaceMaterial(0.5, 0.5, 0.0)
"""Friction and restitution: the same medians, rounded."""
TARGET_SURFACE = SurfaceMaterial(1.0, 0.1, 0.0)
"""Surface of flat targets in our presets."""
FLAT_TARGET, LARGE = 0.15, 3.0
"""Height in metres below which a target does not move, and length above which nothing does."""
VESSELS = ("bowl", "pipe", "torus")
"""Shapes that hold other objects."""
RAMP = "ramp_with_platform"
RAMP_FRICTION = 0.01
"""Friction of the ramps of our presets."""
HOLE = 0.6
"""Width of what may go through a ring, as a fraction of the width of the ring."""
UPRIGHT = 0.98
"""Cosine of the largest tilt of what stands upright."""
POLE = 3.0
"""Height of a cylinder, in widths, above which it is a pole."""
APART = 0.02
"""Metres by which objects have moved against each other that are not joined."""
POOR_FIT = 0.1
"""Cost above which an object is called no shape of the library."""
ON_TOP = 0.3
"""Metres above a support up to which an object may stand on it."""
CHANGED = 0.004
"""Cost by which a later frame must fit worse before the size is questioned, and by which an object
may fit worse that is made to reach the floor."""
NEARLY = 0.002
"""Cost by which an object may fit worse on what it stands on, or up to what stands on it."""
TOO_SHORT = 0.005
"""Metres that an object lacks below or above, from which on it is made longer."""
TOUCHING = 0.003
"""Gap in metres at which objects count as touching."""
FASTEST_SPIN = 7.0
"""Radians per second that the engine allows."""
RAISED = 0.01
"""Distance in metres from the floor up to which lower ends say how high objects rest."""
SETTLING = 4.0
SHOCK = 15.0
"""Accelerations in m/s2: distance from gravity of what flies, and of what has just been hit."""


@dataclass(frozen=True, eq=False)
class Track:
    """One object: its poses ``placed`` in the ``frames`` in which it is seen, in order."""

    number: int
    frames: tuple[int, ...]
    placed: tuple[Placed, ...]


@dataclass(frozen=True, eq=False)
class SeenTrial:
    """What was seen of a trial.

    - ``trial``: scene and state at the last observed frame; None if agent or patient was never
      seen. The bodies are called by their numbers in `physion.clips.batch.Batch.ids`.
    - ``tracks``: the objects without cloths. ``note``: what was not seen, or not well; empty for
      nothing.
    - ``weighted``: what it may have been, with positive weights; by default only ``trial``.
    """

    trial: ObservedTrial | None
    tracks: tuple[Track, ...]
    note: str
    weighted: tuple[tuple[ObservedTrial, float], ...] = ()

    def shared(self, samples: int) -> list[tuple[ObservedTrial, int]]:
        """Return every trial that it may have been, and how many of the samples it gets.

        Sample i gets the one in whose part of the sum of weights (i + 1/2) / samples is.
        """
        if self.trial is None:
            return []
        weighted = self.weighted or ((self.trial, 1.0),)
        ends = np.cumsum([weight for _, weight in weighted])
        places = np.searchsorted(ends / ends[-1], (np.arange(samples) + 0.5) / samples)
        counts = np.bincount(places, minlength=len(weighted))
        return [(trial, int(n)) for (trial, _), n in zip(weighted, counts, strict=True) if n]


def numbers_of(ids: NDArray[np.uint8]) -> list[int]:
    """Return the numbers of the objects; raise `BadInputError` for more than `MOST_OBJECTS`."""
    numbers = [int(n) for n in np.unique(ids) if n != SCENERY_ID]
    if len(numbers) > MOST_OBJECTS:
        raise BadInputError(
            f"a trial shows {len(numbers)} objects; seeing fits at most {MOST_OBJECTS}"
        )
    return numbers


FRAMES = (0, 8, 16, 24, 30, 34, 38, 40, 42, 43, 44)
"""Frames that are looked at."""


def see_trial(
    name: str,
    frames: Sequence[int],
    ids: NDArray[np.uint8],
    depth: NDArray[np.floating],
    camera: F64,
    engine: Engine | str = DEFAULT_ENGINE,
) -> SeenTrial:
    """Return scene and state of a trial from its observed frames.

    Parameters
    ----------
    name
        Of the trial.
    frames
        (T,) numbers of the frames.
    ids, depth, camera
        (T, H, W), (T, H, W) and (2, 4, 4), as in `physion.clips.batch.Batch`.
    engine
        That simulates what a cloth does in the observed frames.

    Raises
    ------
    BadInputError
        For more than `MOST_OBJECTS` objects, or another camera than a pinhole camera.
    BadSceneError
        For a cloth with an engine that simulates none.
    """
    numbers = numbers_of(ids)
    rows = {int(frame): row for row, frame in enumerate(frames)}
    chosen = [frame for frame in FRAMES if frame in rows] or sorted(rows)
    pictures = {f: picture_of(ids[rows[f]], depth[rows[f]], camera) for f in chosen}
    floor = floor_height(pictures[chosen[0]])
    notes: list[str] = []
    found: dict[int, tuple[int, Placed]] = {}
    rays_of: dict[int, Rays] = {}
    cloths: dict[int, Cloth] = {}
    if chosen[0] == 0 and len(chosen) > 1:
        early = [pictures[frame] for frame in chosen[:2]]
        sheets = {n: sheet_of(n, early[0], early[1], floor, look_of(n)) for n in numbers}
        cloths = {n: sheet for n, sheet in sheets.items() if sheet is not None}
    for number in numbers:
        if number in cloths:
            continue
        pixels = {frame: picture.pixels(number) for frame, picture in pictures.items()}
        first = chosen[0]
        base = first if pixels[first] >= CLEAR_PIXELS else max(chosen, key=lambda f: pixels[f])
        rays = pictures[base].rays(number, RAYS)
        if rays is None:
            notes.append(f"object {number} has fewer than {LEAST_PIXELS} pixels")
            continue
        placed = find(rays, Prior(floor=floor))
        found[number], rays_of[number] = (base, placed), rays
        if placed.cost > POOR_FIT:
            notes.append(f"object {number} is no known shape, nearest {placed.solid.name}")
        if base != first:
            notes.append(f"object {number} is first fitted in frame {base}")
    found = _stacked(found, rays_of, pictures, floor)
    same = alike({n: placed for n, (_, placed) in found.items()}, rays_of, Prior(floor=floor))
    found = {n: (base, same[n]) for n, (base, _) in found.items()}
    if cloths:
        tracks = tuple(Track(n, (base,), (placed,)) for n, (base, placed) in found.items())
        notes += [f"object {n} is taken for a sheet of cloth" for n in cloths]
        notes += [
            f"object {n} is taken to rest, but does not"
            for n, (_, placed) in found.items()
            if not _rests(n, placed, pictures)
        ]
    else:
        tracks = tuple(_track(number, *found[number], pictures, floor) for number in found)
        notes += [
            f"object {track.number} is last seen in frame {track.frames[-1]}"
            for track in tracks
            if track.frames[-1] != LAST_OBSERVED
        ]
    unseen = [
        word
        for number, word in ((AGENT_ID, "agent"), (PATIENT_ID, "patient"))
        if number not in found and number not in cloths
    ]
    notes += [f"the {word} is never seen" for word in unseen]
    note = "; ".join(notes)
    if unseen:
        return SeenTrial(None, tracks, note)
    if not cloths:
        return SeenTrial(_observed(name, tracks, floor, camera), tracks, note)
    flat = tuple(cloths.values())
    trial, *drawn = (
        # Scenes have different names, so that each gets noise of its own.
        _draped(f"{name} {rank}", tracks, each, floor, camera, engine)
        for rank, each in enumerate((flat, *with_stiffness(flat)))
    )
    return SeenTrial(trial, tracks, note, tuple((each, 1.0) for each in drawn))


# Objects on others.


def _stacked(
    fits: Mapping[int, tuple[int, Placed]],
    rays_of: Mapping[int, Rays],
    pictures: Mapping[int, SeenFrame],
    floor: float,
) -> dict[int, tuple[int, Placed]]:
    """Fit resting objects again, from the bottom up, so that they stand on something.

    ``rays_of`` are the rays to which they were fitted.
    """
    frames = sorted(pictures)
    result = dict(fits)
    first = [n for n in fits if fits[n][0] == frames[0]]
    first.sort(key=lambda n: float(result[n][1].middle()[2]))
    resting = [n for n in first if _rests(n, fits[n][1], pictures)]
    for number in first:
        placed = result[number][1]
        bottom, height = placed.extent_z()[0], float(placed.middle()[2])
        below = [
            (top, other)
            for other in resting
            if number in resting
            and other != number
            and (top := result[other][1].extent_z()[1]) < min(bottom + ON_TOP, height)
            and top > bottom - ON_TOP
            and _carries(result[other][1], placed)
        ]
        if not below:
            # Also what falls is there in the first frame.
            tops = (result[n][1].extent_z()[1] for n in first if _carries(result[n][1], placed))
            level = max((top for top in tops if top < bottom), default=floor)
            grounded = _grounded(placed, rays_of[number], level)
            if number in resting or _rests(number, grounded, pictures):
                result[number] = (frames[0], grounded)
            continue
        top, support = max(below)
        if result[support][1].solid.name.startswith((*VESSELS, RAMP)):
            continue
        above = [
            n for n in resting if n != number and _stands_on(result[n][1], placed)
        ]  # so far as known
        if bottom > top:
            # Its upper end may be hidden by what stands on it.
            lower = result[support][1]
            higher = _reaching(lower, lower.extent_z()[0], bottom)
            cost = math.inf if higher is None else cost_of(higher, rays_of[support])
            if higher is not None and cost < lower.cost + NEARLY:
                result[support], top = (frames[0], replace(higher, cost=cost)), bottom
        neighbours = [result[support][1], *(result[n][1] for n in above)]
        center = np.mean([each.middle()[:2] for each in neighbours], axis=0)
        prior = Prior(floor, top, 0.3, (float(center[0]), float(center[1])), 0.05)
        longer = _reaching(placed, top, placed.extent_z()[1])
        starts = [placed] if longer is None else [placed, longer]
        again = refine(starts, rays_of[number], prior)
        if again.cost < placed.cost + NEARLY:
            result[number] = (frames[0], again)
    return result


def _carries(lower: Placed, upper: Placed) -> bool:
    """Return whether an object can stand on another below it, and does not go through its hole."""
    through = lower.solid.name == "torus"
    through = through and upper.size()[:2].max() < HOLE * lower.size()[:2].min()
    return lower is not upper and not through and _overlap(upper, lower)


def _grounded(placed: Placed, rays: Rays, floor: float) -> Placed:
    """Return a resting object with nothing close below it as one that reaches down to ``floor``.

    What hides its lower end hides how long it is. It stays as it is where that does not fit.
    """
    longer = _reaching(placed, floor, placed.extent_z()[1])
    if longer is None:
        return placed
    found = refine([longer], rays, Prior(floor, floor, 3.0))
    return found if found.cost < placed.cost + CHANGED else placed


def _reaching(placed: Placed, low: float, high: float) -> Placed | None:
    """Return an upright object as one that reaches from a height up to another one.

    None if it lacks less than `TOO_SHORT` at both ends, or is not upright.
    """
    bottom, top = placed.extent_z()
    axis = int(np.argmax(np.abs(placed.rotation[2])))
    change = max(bottom - low, high - top)
    if change < TOO_SHORT or abs(placed.rotation[2, axis]) < UPRIGHT:
        return None
    scale, before = placed.scale.copy(), placed.middle()
    scale[axis] *= (high - low) / (top - bottom)
    longer = replace(placed, scale=scale)
    shift = before - longer.middle() + np.array([0, 0, (low + high - bottom - top) / 2])
    return moved_with(longer, shift)


def _rests(number: int, placed: Placed, pictures: Mapping[int, SeenFrame]) -> bool:
    """Return whether an object of the first frame is still where it was in the second."""
    frames = sorted(pictures)
    rays = pictures[frames[min(1, len(frames) - 1)]].rays(number)
    return rays is not None and cost_of(placed, rays) < 1.5 * placed.cost + 0.02


def _overlap(a: Placed, b: Placed) -> bool:
    """Return whether the middle of one object lies above or below the box of the other."""
    for one, other in ((a, b), (b, a)):
        corners = other.corners()[:, :2]
        middle = one.middle()[:2]
        if (corners.min(axis=0) < middle).all() and (middle < corners.max(axis=0)).all():
            return True
    return False


def _stands_on(upper: Placed, lower: Placed) -> bool:
    gap = upper.extent_z()[0] - lower.extent_z()[1]
    return abs(gap) < 0.03 and _overlap(upper, lower)


# Poses in later frames, and velocities.


def _track(
    number: int, base: int, start: Placed, pictures: Mapping[int, SeenFrame], floor: float
) -> Track:
    """Return an object with its poses from the frame on in which it was fitted."""
    track = _followed(number, base, start, pictures, floor)
    last, rays = track.placed[-1], pictures[track.frames[-1]].rays(number)
    before = pictures[base].rays(number)
    if rays is None or before is None or last.cost < start.cost + CHANGED:
        return track
    # It shows other sides now, which may tell its size.
    prior = Prior(floor=floor)
    free = fit(last, rays, FREE, prior, widths=(0.01, 0.004), steps=12)
    again = fit(replace(start, scale=free.scale), before, POSE, prior, widths=(0.02, 0.004))
    if free.cost > last.cost / 2 or again.cost > start.cost + CHANGED:
        return track
    return _followed(number, base, again, pictures, floor)


def _followed(
    number: int, base: int, start: Placed, pictures: Mapping[int, SeenFrame], floor: float
) -> Track:
    """Return an object of a known size with its poses."""
    frames, poses, means = [base], [start], []
    rays = pictures[base].rays(number)
    means.append(start.middle() if rays is None else rays.points().mean(axis=0))
    for frame in sorted(f for f in pictures if f > base):
        rays = pictures[frame].rays(number)
        if rays is None:
            continue
        mean = rays.points().mean(axis=0)
        guesses = [moved_with(poses[-1], mean - means[-1])]
        if len(poses) > 1:
            passed = (frame - frames[-1]) / (frames[-1] - frames[-2])
            ahead = moved_with(poses[-1], (poses[-1].position - poses[-2].position) * passed)
            turn = Rotation.from_matrix(poses[-1].rotation @ poses[-2].rotation.T).as_rotvec()
            turned = Rotation.from_rotvec(turn * passed).as_matrix() @ ahead.rotation
            ahead = replace(ahead, rotation=turned)
            guesses = [ahead, *guesses, moved_with(ahead, guesses[0].middle() - ahead.middle())]
        placed, _ = follow(poses[-1], rays, floor, guesses)
        frames.append(frame)
        poses.append(placed)
        means.append(mean)
    return Track(number, tuple(frames), tuple(poses))


def center_of_mass(placed: Placed) -> F64:
    """Return the centre of mass (3,) of a placed solid of one density, metres."""
    scale = tuple(float(s) for s in placed.scale)
    body = Body("", placed.solid.name, (0.0, 0.0, 0.0), scale)  # type: ignore[arg-type]
    return np.asarray(placed.position + placed.rotation @ body_mass(body).center)


def velocities(track: Track) -> tuple[F64, F64, bool]:
    """Return velocity (3,), angular velocity (3,), and whether the object flies, when last seen.

    In m/s and rad/s.
    """
    times = FRAME_TIME * np.array(track.frames, np.float64)
    places = np.array([center_of_mass(placed) for placed in track.placed])
    if len(times) < 2:
        return np.zeros(3), np.zeros(3), False
    steps = np.diff(places, axis=0) / np.diff(times)[:, None]
    velocity, flies = steps[-1], False
    if len(steps) > 1:
        acceleration = (steps[-1] - steps[-2]) / ((times[-1] - times[-3]) / 2)
        from_falling = acceleration + np.array([0, 0, GRAVITY])
        flies = float(np.linalg.norm(from_falling)) < SETTLING
        if flies:
            level = places[-3:] + np.outer(times[-3:] ** 2, (0, 0, GRAVITY / 2))
            spread = times[-3:] - times[-3:].mean()
            slope = spread @ level / (spread @ spread)
            velocity = slope - np.array([0, 0, GRAVITY * (times[-1] - FRAME_TIME / 2)])
        elif np.linalg.norm(acceleration) < SHOCK:
            velocity = steps[-1] + acceleration * (times[-1] - times[-2] - FRAME_TIME) / 2
    before, last = track.placed[-2:]
    turn = Rotation.from_matrix(last.rotation @ before.rotation.T).as_rotvec()
    spin = turn / (times[-1] - times[-2])
    speeds = np.linalg.norm(steps, axis=1)
    spin = _with_unseen_spin(last, spin, velocity, float(speeds.max()), flies)
    rate = float(np.linalg.norm(spin))
    return velocity, spin * min(1.0, FASTEST_SPIN / max(rate, 1e-9)), flies


def _with_unseen_spin(placed: Placed, spin: F64, velocity: F64, fastest: float, flies: bool) -> F64:
    """Return an angular velocity which about an axis of symmetry is set by rolling."""
    solid = placed.solid
    if solid.symmetry != 0.0:
        return spin
    axis = placed.rotation[:, 2]
    seen = np.zeros(3) if solid.ball else spin - axis * (axis @ spin)
    level = np.array([-velocity[1], velocity[0], 0.0])
    speed = float(np.linalg.norm(level))
    if flies or speed < 1e-6 or (not solid.ball and abs(axis[2]) > 0.3):
        return np.asarray(seen)
    radius = float(placed.size()[:2].mean()) / 2
    rate = min(speed / radius, FASTEST_SPIN, 2.5 * max(fastest - speed, 0.0) / radius)
    rolling = level / speed * rate
    return np.asarray(seen + (rolling if solid.ball else axis * (axis @ rolling)))


# The scene.


def _observed(name: str, tracks: Sequence[Track], seen_floor: float, camera: F64) -> ObservedTrial:
    """Return scene and state at the last observed frame."""
    poses, speeds, spins = [], [], []
    for track in tracks:
        placed, velocity, spin = _last(track, tracks, seen_floor)
        poses.append(placed)
        speeds.append(velocity)
        spins.append(spin)
    floor = _resting_floor(tracks, seen_floor)
    bodies = tuple(
        body_of(track.number, placed, floor) for track, placed in zip(tracks, poses, strict=True)
    )
    for i, body in enumerate(bodies):
        if body.kinematic:
            speeds[i], spins[i] = np.zeros(3), np.zeros(3)
    scene = Scene(
        name,
        "seen",
        bodies,
        Roles(str(AGENT_ID), str(PATIENT_ID)),
        camera_of(camera),
        joints=joints_of(tracks, bodies),
        floor=floor,
        ending=Ending(),
    )
    state = State(
        LAST_OBSERVED,
        np.array([body.position for body in bodies]),
        np.array([body.rotation for body in bodies]),
        np.array(speeds),
        np.array(spins),
        np.zeros((0, 3)),
        np.zeros((0, 3)),
    )
    return ObservedTrial(scene, state, _touched(tracks))


def _draped(
    name: str, tracks: Sequence[Track], cloths: tuple[Cloth, ...], seen_floor: float, camera: F64,
    engine: Engine | str,
) -> ObservedTrial:  # fmt: skip
    """Return the scene with cloths that fall from the first frame on, and its state at the last.

    All bodies stay where they are.
    """
    floor = _resting_floor(tracks, seen_floor)
    bodies = (body_of(track.number, track.placed[0], floor) for track in tracks)
    scene = Scene(
        name,
        "seen",
        tuple(replace(body, kinematic=True) for body in bodies),
        Roles(str(AGENT_ID), str(PATIENT_ID)),
        camera_of(camera),
        cloths=cloths,
        floor=floor,
        ending=Ending(),
    )
    return cut_trial(scene, simulate(scene, engine=engine, frames=OBSERVED_FRAMES))


def camera_of(matrices: F64) -> Camera:
    """Return the camera of a view and a projection matrix (2, 4, 4)."""
    view, projection = matrices
    origin = -view[:3, :3].T @ view[:3, 3]
    angle = 2 * math.atan(1 / abs(float(projection[1, 1])))
    return Camera(vec3(origin), vec3(origin + view[2, :3]), angle)


def _last(track: Track, tracks: Sequence[Track], floor: float) -> tuple[Placed, F64, F64]:
    """Return pose, velocity and angular velocity of an object at the last observed frame.

    What is not seen there has moved with what holds it, if it was last seen in a vessel, and has
    otherwise kept its velocity, or fallen, but not through the floor.
    """
    velocity, spin, flies = velocities(track)
    placed, frame = track.placed[-1], track.frames[-1]
    missing = FRAME_TIME * (LAST_OBSERVED - frame)
    if missing <= 0:
        return placed, velocity, spin
    for other in tracks:
        if other is track or frame not in other.frames or other.frames[-1] != LAST_OBSERVED:
            continue
        before, after = other.placed[other.frames.index(frame)], other.placed[-1]
        if before.solid.name not in VESSELS or not _holds(before, placed):
            continue
        turn = after.rotation @ before.rotation.T
        position = after.position + turn @ (placed.position - before.position)
        moved, _, _ = velocities(other)
        return replace(placed, position=position, rotation=turn @ placed.rotation), moved, spin
    fall = np.array([0, 0, GRAVITY if flies else 0.0])
    placed = moved_with(placed, velocity * missing - fall * missing**2 / 2)
    below = floor - placed.extent_z()[0]
    if below > 0:
        return moved_with(placed, np.array([0, 0, below])), velocity * (1, 1, 0), spin
    return placed, velocity - fall * missing, spin


def _holds(vessel: Placed, placed: Placed) -> bool:
    """Return whether the middle of an object is above the bottom of a vessel and near its axis."""
    local = vessel.rotation.T @ (placed.middle() - vessel.position)
    size = vessel.size()
    return bool(np.hypot(*(local[:2] / size[:2])) < 0.5 and 0 < local[2] < 1.5 * size[2])


def body_of(number: int, placed: Placed, floor: float) -> Body:
    """Return an object as a body, with the mass and the surface that are expected."""
    low, high = placed.extent_z()
    patient, ramp = number == PATIENT_ID, placed.solid.name.startswith(RAMP)
    flat = patient and high - low < FLAT_TARGET
    surface = TARGET_SURFACE if flat else SURFACE
    if ramp:
        surface = SurfaceMaterial(RAMP_FRICTION, RAMP_FRICTION, 0.0)
    density = RING_DENSITY if placed.solid.name == "torus" else DENSITY
    return Body(
        str(number),
        placed.solid.name,
        vec3(placed.position),
        vec3(placed.scale),
        _quaternion(placed.rotation),
        max(1e-3, density * float(np.prod(placed.scale))),
        surface,
        kinematic=bool(flat or ramp or placed.size().max() > LARGE),
        look=look_of(number),
    )


def look_of(number: int) -> Look:
    """Return red for the agent, yellow for the patient, grey for any other object."""
    colors = {AGENT_ID: (1.0, 0.0, 0.0), PATIENT_ID: (1.0, 1.0, 0.0)}
    return Look(colors.get(number, (0.6, 0.6, 0.6)))


def joints_of(tracks: Sequence[Track], bodies: Sequence[Body]) -> tuple[Joint, ...]:
    """Return the joints of poles with what they stand on, and with what lies on them."""
    joints = []
    movable = [t for t, body in zip(tracks, bodies, strict=True) if not body.kinematic]
    for pole in movable:
        placed = pole.placed[0]
        size, upright = placed.size(), abs(float(placed.rotation[2, 2])) > UPRIGHT
        if placed.solid.name != "cylinder" or not upright or size[2] < POLE * size[:2].max():
            continue
        for other in movable:
            if other is pole or _moved_apart(pole, other):
                continue
            if _stands_on(placed, other.placed[0]):
                joints.append(Joint(str(other.number), str(pole.number)))
            elif _stands_on(other.placed[0], placed):
                joints.append(Joint(str(pole.number), str(other.number)))
    return tuple(joints)


def _moved_apart(a: Track, b: Track) -> bool:
    """Return whether one object has moved against another."""
    shared = sorted(set(a.frames) & set(b.frames))
    if not shared or shared[0] != a.frames[0] or shared[0] != b.frames[0]:
        return True
    places = []
    for frame in (shared[0], shared[-1]):
        first, second = (track.placed[track.frames.index(frame)] for track in (a, b))
        places.append(second.rotation.T @ (first.middle() - second.middle()))
    return bool(np.linalg.norm(places[1] - places[0]) > APART)


def _resting_floor(tracks: Sequence[Track], seen: float) -> float:
    """Return the height on which the lowest objects rest, among heights of floors of our rooms.

    In some rooms objects rest a few millimetres above what is drawn. It is the height nearest to
    the median of the lower ends near the floor.
    """
    heights = [track.placed[0].extent_z() for track in tracks]
    near = [low - seen for low, high in heights if abs(low - seen) < RAISED and high - low > 0.05]
    raised = float(np.median(near)) if near else 0.0
    return seen + min(sorted(set(FLOORS.values())), key=lambda height: abs(height - raised))


def _touched(tracks: Sequence[Track]) -> bool:
    """Return whether agent and patient touch in a frame in which both are seen."""
    by_number = {track.number: track for track in tracks}
    agent, patient = by_number[AGENT_ID], by_number[PATIENT_ID]
    at = dict(zip(patient.frames, patient.placed, strict=True))
    if patient.placed[0].size().min() <= 0:
        return False
    pair = [body_of(t.number, t.placed[0], 0.0) for t in (agent, patient)]
    gap, _ = gap_of_bodies(pair, [np.zeros(3), np.zeros(3)])
    for frame, a in zip(agent.frames, agent.placed, strict=True):
        b = at.get(frame)
        if b is None:
            continue
        turn = np.ascontiguousarray(b.rotation.T @ a.rotation)
        shift = np.ascontiguousarray(b.rotation.T @ (a.position - b.position))
        if gap(turn, shift) < TOUCHING:
            return True
    return False


def _quaternion(matrix: F64) -> tuple[float, float, float, float]:
    x, y, z, w = (float(value) for value in Rotation.from_matrix(matrix).as_quat())
    return (w, x, y, z)
