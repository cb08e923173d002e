"""Pairs of movies with equal pictures up to a frame, after which one of them is impossible.

Two simulated worlds A and B of a scene differ in one thing, in a way that leaves all else as it is
up to frame ``start``. Four trials follow from them: A and B themselves, and the two that change
from one world to the other at ``start``:

    A A  possible      A B  impossible
    B B  possible      B A  impossible

Every beginning and every end occurs once in a possible movie and once in an impossible one, as in
IntPhys 2: only their conjunction tells. The kinds, with X a body that can move:

- ``vanish``: B is without X. X vanishes, or appears out of nothing.
- ``teleport``: in B X is somewhere else. X is suddenly there, or back.
- ``swap``: in B two bodies have each other's places.
- ``stop-in-air``: in B there is a fixed shelf, on which the falling X lands. X stops in the air
  where no shelf is, or falls through the shelf.
- ``pass-through``: B is without a body Y that X meets. X passes through Y, which stays where it is,
  or is deflected where nothing is.

In about half of the quadruples a screen rises before ``start``, hides what changes, and sinks. The
trials are called ``TRIAL+pair.KIND.N`` with N from 0 to 3 in an order that does not tell which are
possible. They have no labels. ``parameters["pair"]`` of their scene says all (`Pair`).

References
----------
F. Bordes and others, IntPhys 2, arXiv 2506.09849, 2025.
"""

from __future__ import annotations

import copy
import itertools
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.seeds import generator, stable_hash
from physion.core.settings import as_json, read_settings
from physion.numerics.linear_algebra import norm
from physion.numerics.rotations import rotate_vectors
from physion.physics.engine import Engine, make_engine
from physion.physics.trajectory import Contacts, Trajectory
from physion.rendering.renderer import Renderer
from physion.scenes.looks import COLORS_OF
from physion.scenes.scene import Body, BodyEvent, Look, Quat, Scene, Vec3
from physion.scenes.shapes.primitives import shape
from physion.trials.dataset import Dataset
from physion.trials.making.plan import PAIR, TrialTask
from physion.trials.making.whatif import AFTER, MARK

KINDS = ("vanish", "teleport", "swap", "stop-in-air", "pass-through")
SHELF, SCREEN = "shelf", "screen"

FIRST, LEFT = 30, 31
"""First frame at which worlds may change, and frames that are left then at least."""
EQUAL = 1e-3
"""Metres, and parts of a quaternion, below which a pose is the same in both worlds."""
FAR = 0.1
"""Metres by which X differs between the worlds within `LEFT` frames of the change, at least."""
SHIFTS = (0.5, 0.8)
"""Metres by which X is displaced in *teleport*."""
FALLING, MOVING, RESTING = 0.5, 0.3, 0.05
"""Metres per second: X falls, X moves, Y rests."""
DROP = 0.15
"""Metres above the floor at which X stops, at least."""
SHELF_SIDE, SHELF_THICKNESS = 1.6, 0.03
"""Side of the shelf in extents of X, and its thickness in metres."""
SIZE, SEEN = 96, 10
"""Side of the pictures, and pixels of X in them, by which X counts as seen."""
RISE, HOLD, TURN = 18, 12, 12
"""The screen begins to rise so many frames before ``start``, begins to sink so many after it, and
takes so many for either."""
CLEAR, NEAREST, MARGIN, THICKNESS = 0.25, 0.8, 0.08, 0.04
"""Metres: of the screen in front of all bodies, at least from the camera, beyond what it hides, and
its thickness."""


@dataclass(frozen=True)
class Pair:
    """What the scene of one of the four trials says about it.

    - ``kind``: one of `KINDS`. ``base``: the trial that both worlds come from.
    - ``start``: first frame that shows the second world. ``frames``: of the movie.
    - ``body``: X. ``hidden``: whether a screen hides the change.
    - ``first``, ``then``: the worlds before and after, 0 or 1.
    - ``worlds``: both worlds as `Scene.to_json` writes them, parsed.
    """

    kind: str
    base: str
    start: int
    frames: int
    body: str
    hidden: bool
    first: int
    then: int
    worlds: tuple[dict[str, Any], dict[str, Any]]

    @property
    def possible(self) -> bool:
        """Whether all of the trial shows one world."""
        return self.first == self.then

    @classmethod
    def of(cls, scene: Scene) -> Pair | None:
        """Return what a scene says; None for a trial that belongs to no pair."""
        if PAIR not in scene.parameters:
            return None
        return read_settings(cls, scene.parameters[PAIR], f"scene {scene.name!r}: {PAIR}")


def is_pair(trial: str) -> bool:
    """Return whether a trial is one of four, by its name."""
    return f"{MARK}{PAIR}." in trial


def without_pairs(dataset: Dataset) -> Dataset:
    """Return the dataset without movies of pairs, which have no outcome."""
    paired = dataset.index["trial"].map(is_pair).astype(bool)
    if not paired.any():
        return dataset
    rest = copy.copy(dataset)
    rest.index = dataset.index[~paired].reset_index(drop=True)
    vars(rest).pop("_rows", None)
    return rest


def motion_of(scene: Scene, engine: Engine) -> Trajectory:
    """Return the motion of the scene of any trial: simulated, and of a pair put together.

    Before ``start`` it is the first world's, then the second one's. A body that the second world
    lacks, and that is still drawn, stays where it was.
    """
    pair = Pair.of(scene)
    if pair is None:
        return engine.simulate(scene)
    worlds = [Scene.from_values(values) for values in pair.worlds]
    before, after = (
        engine.simulate(worlds[number], frames=pair.frames) for number in (pair.first, pair.then)
    )
    start, bodies, last = pair.start, len(worlds[0].bodies), pair.frames - 1
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(before, name)[:start], getattr(after, name)[start:]])
        for name in ("positions", "rotations", "velocities", "angular_velocities")
    }
    shown, there = scene.present(last), worlds[pair.then].present(last)
    for row in range(bodies):
        if shown[row] and not there[row]:
            for name in ("positions", "rotations"):
                arrays[name][start:, row] = arrays[name][start - 1, row]
            for name in ("velocities", "angular_velocities"):
                arrays[name][start:, row] = 0
    for body in scene.bodies[bodies:]:
        path = _path(body, scene.events, pair.frames)
        still = np.zeros_like(path)
        turned = np.broadcast_to(np.array(body.rotation, np.float32), (pair.frames, 4))
        for name, values in zip(arrays, (path, turned, still, still), strict=True):
            arrays[name] = np.concatenate([arrays[name], values[:, None]], axis=1)
    return replace(
        before,
        **arrays,
        contacts=_join_contacts(scene, before.contacts, after.contacts, start),
        completed=False,
    )


def _path(body: Body, events: Sequence[BodyEvent], frames: int) -> NDArray[np.float32]:
    """Return where a body (F, 3) is that only events move."""
    path = np.empty((frames, 3), np.float32)
    path[:] = body.position
    for event in events:
        if event.body == body.name and event.position is not None:
            path[event.frame :] = event.position
    return path


def _join_contacts(scene: Scene, before: Contacts, after: Contacts, start: int) -> Contacts:
    """Return the contacts of both worlds, each in its frames, of bodies that are there."""
    early, late = before.frame < start, after.frame >= start
    fields = {
        name: np.concatenate([getattr(before, name)[early], getattr(after, name)[late]])
        for name in ("frame", "bodies", "point", "normal", "impulse")
    }
    present = {frame: np.array([*scene.present(frame), True]) for frame in {0, start}}
    # The floor, body -1, is always there.
    there = np.where(
        (fields["frame"] < start)[:, None],
        present[0][fields["bodies"]],
        present[start][fields["bodies"]],
    )
    return Contacts(**{name: values[there.all(axis=1)] for name, values in fields.items()})


# The four trials of a quadruple.


@dataclass(frozen=True)
class Quadruple:
    """Two worlds with the same bodies, which are alike but for one thing before ``start``.

    A body that a world lacks appears when the movie is over. ``comes_and_goes``: whether X is there
    as the motion says, as in *vanish*; a shelf, or a body that X meets, belongs to the beginning.
    """

    kind: str
    worlds: tuple[Scene, Scene]
    start: int
    body: str
    comes_and_goes: bool = False


def check_kinds(kinds: Sequence[str]) -> None:
    """Raise `UnknownNameError` for a kind that is not one of `KINDS`."""
    for kind in kinds:
        if kind not in KINDS:
            raise UnknownNameError("kind of pairs", kind, KINDS)


def pair_tasks(
    dataset: Dataset,
    trials: Sequence[str],
    kinds: Sequence[str],
    engine: str,
    progress: Progress | None = None,
) -> list[TrialTask]:
    """Return tasks for four trials of each of ``trials`` and each kind that its scene allows.

    Raises `UnknownNameError` for a kind that is not one of `KINDS`, and `BadInputError` if there is
    no trial, or none that allows any of them.
    """
    check_kinds(kinds)
    if not trials:
        raise BadInputError("pairs are made of testing trials, and there are none: --split testing")
    known, run, tasks = dataset.known_trials(), make_engine(engine), []
    for name in tracked(trials, "finding pairs", len(trials), progress):
        trial = dataset.trial(name)
        for kind in dict.fromkeys(kinds):
            names = [f"{name}{MARK}{PAIR}.{kind}.{number}" for number in range(4)]
            found = None
            if not known.issuperset(names):
                found = quadruple(trial.scene, trial.trajectory, kind, run)
            else:
                tasks += [_task(trial, dataset.trial(one).scene) for one in names]
            if found is not None:
                scenes = four_scenes(found, name, len(trial.trajectory), run)
                tasks += [
                    _task(trial, replace(scene, name=called))
                    for scene, called in zip(scenes, names, strict=True)
                ]
    if not tasks:
        raise BadInputError(
            f"no trial of {dataset.folder} allows pairs of the kinds {', '.join(kinds)}: cloth has "
            "none, and X must move freely and be seen; make more trials, or of other scenarios"
        )
    return tasks


def _task(trial: Any, scene: Scene) -> TrialTask:
    meta = trial.metadata
    return TrialTask(meta.dataset, meta.scenario, meta.split, AFTER + meta.index, scene=scene)


def four_scenes(group: Quadruple, base: str, frames: int, engine: Engine) -> list[Scene]:
    """Return the scenes of the four trials, in an order that does not tell which are possible.

    ``base`` is the name of the trial that they come from, ``frames`` the length of the movies.
    """
    screen: tuple[Body, tuple[BodyEvent, ...]] | None = None
    if stable_hash("hidden", base, group.kind) % 2:
        paths = [engine.simulate(world, frames=frames) for world in group.worlds]
        screen = _screen(group, paths)
    worlds = tuple(json.loads(world.to_json()) for world in group.worlds)
    scenes = []
    for first, then in itertools.product((0, 1), (0, 1)):
        scene = group.worlds[first]
        events = scene.events
        if group.comes_and_goes and first != then:
            events = tuple(event for event in events if event.body != group.body)
            kind = "vanish" if first == 0 else "appear"
            events = (BodyEvent(group.start, group.body, kind), *events)
        bodies = scene.bodies
        if screen is not None:
            bodies, events = (*bodies, screen[0]), (*events, *screen[1])
        pair = {
            "kind": group.kind,
            "base": base,
            "start": group.start,
            "frames": frames,
            "body": group.body,
            "hidden": screen is not None,
            "first": first,
            "then": then,
            "worlds": worlds,
        }
        scenes.append(
            replace(
                scene,
                bodies=bodies,
                events=tuple(sorted(events, key=lambda event: event.frame)),
                parameters={
                    **scene.parameters,
                    PAIR: as_json(pair),
                    COLORS_OF: group.worlds[0].physics_digest(),
                },
            )
        )
    order = sorted(range(4), key=lambda part: stable_hash("order", base, group.kind, part))
    return [scenes[part] for part in order]


# The worlds of each kind.


def quadruple(scene: Scene, path: Trajectory, kind: str, engine: Engine) -> Quadruple | None:
    """Return two worlds of a kind for a scene that moves along ``path``; None if it allows none."""
    frames = len(path)
    if scene.cloths or scene.events or frames < FIRST + LEFT:
        return None
    rng = generator("pair", scene.name, kind)
    find = {
        "vanish": _vanish,
        "teleport": _teleport,
        "swap": _swap,
        "stop-in-air": _stop,
        "pass-through": _pass,
    }[kind]
    for worlds, watched, latest, fixed in find(scene, path, engine, rng):
        paths = [engine.simulate(world, frames=frames) for world in worlds]
        others = [
            row for row, body in enumerate(scene.bodies)
            if body.name not in watched and not body.scenery
        ]  # fmt: skip
        latest = min(latest(paths), _alike(paths, others), frames - LEFT)
        if latest < FIRST:
            continue
        start = latest if fixed else int(rng.integers(FIRST, latest + 1))
        found = Quadruple(kind, worlds, start, watched[0], kind == "vanish")
        if _differs(found, paths) and _seen(found, paths, watched):
            return found
    return None


Found = Iterator[tuple[tuple[Scene, Scene], list[str], Any, bool]]
"""Two worlds; the bodies in which they differ, X first; a function of both motions that returns
the last frame at which one may become the other; and whether it must be that one."""


def _movable(scene: Scene) -> list[Body]:
    """Return the bodies that can be X: free, single ones, the agent first."""
    joined = {name for joint in scene.joints for name in (joint.parent, joint.child)}
    free = [
        body for body in scene.bodies
        if not (body.kinematic or body.scenery or body.name in joined)
    ]  # fmt: skip
    return sorted(free, key=lambda body: body.name != scene.roles.agent)


def _without(scene: Scene, name: str, frames: int) -> Scene:
    """Return the scene in which a body appears only when the movie is over."""
    return replace(scene, events=(*scene.events, BodyEvent(frames, name, "appear")))


def _vanish(scene: Scene, path: Trajectory, engine: Engine, rng: np.random.Generator) -> Found:
    frames = len(path)
    for body in _movable(scene):
        yield (scene, _without(scene, body.name, frames)), [body.name], lambda paths: frames, False


def _teleport(scene: Scene, path: Trajectory, engine: Engine, rng: np.random.Generator) -> Found:
    for body in _movable(scene):
        row = scene.index(body.name)
        for number in rng.permutation(8)[:4].tolist():
            # Eight directions, whose diagonal ones are longer.
            x, y = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)][number]
            shift = (x * SHIFTS[number % 2], y * SHIFTS[number % 2], 0.0)
            world = _shifted(scene, {body.name: shift})

            def latest(paths: list[Trajectory], row: int = row, shift: Vec3 = shift) -> int:
                # X moves in the same way in both worlds: it meets nothing.
                there = paths[1].positions[:, row] - np.array(shift, np.float32)
                return _first_apart(paths[0].positions[:, row], there, 5 * EQUAL)

            yield (scene, world), [body.name], latest, False


def _swap(scene: Scene, path: Trajectory, engine: Engine, rng: np.random.Generator) -> Found:
    # Bodies first change places at random. Else each would have its usual place, as red has in
    # Dominoes, and its place would tell which world a part of a movie shows.
    free = _movable(scene)
    places = [free[number].position for number in rng.permutation(len(free)).tolist()]
    scene = _shifted(
        scene,
        {
            body.name: tuple(b - a for a, b in zip(body.position, place, strict=True))
            for body, place in zip(free, places, strict=True)
        },
    )
    for one, other in itertools.combinations(_movable(scene), 2):
        step = tuple(b - a for a, b in zip(one.position, other.position, strict=True))
        back = tuple(-part for part in step)
        world = _shifted(scene, {one.name: step, other.name: back})
        rows = [scene.index(one.name), scene.index(other.name)]

        def latest(paths: list[Trajectory], rows: list[int] = rows) -> int:
            still = [
                _first_apart(each.positions[:, row], each.positions[:1, row], 5 * EQUAL)
                for each in paths for row in rows
            ]  # fmt: skip
            return min(still)

        yield (scene, world), [one.name, other.name], latest, False


def _stop(scene: Scene, path: Trajectory, engine: Engine, rng: np.random.Generator) -> Found:
    frames = len(path)
    for body in _movable(scene):
        row = scene.index(body.name)
        for frame in range(FIRST, frames - LEFT):
            place, turn = path.positions[frame, row], path.rotations[frame, row]
            corners = rotate_vectors(turn, shape(body.shape).mesh.vertices * np.array(body.scale))
            low, high = corners.min(axis=0), corners.max(axis=0)
            bottom = float(place[2] + low[2])
            if path.velocities[frame, row, 2] > -FALLING or bottom < scene.floor + DROP:
                continue
            middle = place + (low + high) / 2
            side = SHELF_SIDE * float(max(high[0] - low[0], high[1] - low[1]))
            shelf = Body(
                SHELF,
                "cube",
                (float(middle[0]), float(middle[1]), bottom - SHELF_THICKNESS),
                (side, side, SHELF_THICKNESS),
                kinematic=True,
                look=Look((0.55, 0.5, 0.45)),
            )
            with_shelf = replace(scene, bodies=(*scene.bodies, shelf))
            worlds = (_without(with_shelf, SHELF, frames), with_shelf)

            def latest(paths: list[Trajectory], row: int = row) -> int:
                landed = paths[1].contacts.frames_of(row, len(scene.bodies))
                first = int(landed[0]) if len(landed) else 0
                return first if _alike(paths, [row]) >= first else 0

            yield worlds, [body.name, SHELF], latest, True
            break


def _pass(scene: Scene, path: Trajectory, engine: Engine, rng: np.random.Generator) -> Found:
    frames, contacts = len(path), path.contacts
    movable = {scene.index(body.name) for body in _movable(scene)}
    met = set()
    for frame, (a, b) in zip(contacts.frame.tolist(), contacts.bodies.tolist(), strict=True):
        if a < 0 or (a, b) in met:
            continue
        met.add((a, b))
        if not FIRST <= frame <= frames - LEFT:
            continue
        speeds = norm(path.velocities[frame - 1].astype(np.float64))
        for x, y in ((a, b), (b, a)):
            if {x, y} <= movable and speeds[x] > MOVING and speeds[y] < RESTING:
                other = scene.bodies[y].name
                worlds = (scene, _without(scene, other, frames))

                def latest(paths: list[Trajectory], x: int = x, frame: int = frame) -> int:
                    return frame if _alike(paths, [x]) >= frame else 0

                yield worlds, [scene.bodies[x].name, other], latest, True


def _shifted(scene: Scene, shifts: dict[str, Any]) -> Scene:
    """Return the scene with bodies, and the points at which they are pushed, moved by metres."""

    def moved(name: str, place: Vec3) -> Vec3:
        x, y, z = (a + b for a, b in zip(place, shifts.get(name, (0.0, 0.0, 0.0)), strict=True))
        return (x, y, z)

    return replace(
        scene,
        bodies=tuple(
            replace(body, position=moved(body.name, body.position)) for body in scene.bodies
        ),
        pushes=tuple(
            push if push.point is None else replace(push, point=moved(push.body, push.point))
            for push in scene.pushes
        ),
    )


def _first_apart(one: NDArray[Any], other: NDArray[Any], limit: float) -> int:
    """Return the first frame in which places (F, 3) differ by more than ``limit``, or F."""
    apart = (np.abs(one - other) > limit).any(axis=-1)
    return int(np.argmax(apart)) if apart.any() else len(apart)


def _alike(paths: Sequence[Trajectory], rows: Sequence[int]) -> int:
    """Return the first frame in which one of the bodies has another pose in the second world."""
    one, other = paths
    first = [len(one)]
    for row in rows:
        first.append(_first_apart(one.positions[:, row], other.positions[:, row], EQUAL))
        first.append(_first_apart(one.rotations[:, row], other.rotations[:, row], EQUAL))
    return min(first)


def _differs(group: Quadruple, paths: Sequence[Trajectory]) -> bool:
    """Return whether X comes to differ between the worlds, if it is in both."""
    if group.comes_and_goes:
        return True
    row = group.worlds[0].index(group.body)
    after = slice(group.start, group.start + LEFT)
    step = paths[0].positions[after, row] - paths[1].positions[after, row]
    return bool(norm(step.astype(np.float64)).max() > FAR)


def _seen(group: Quadruple, paths: Sequence[Trajectory], watched: Sequence[str]) -> bool:
    """Return whether bodies are seen before and after the change, in each world that has them."""
    for world, path in zip(group.worlds, paths, strict=True):
        there = world.present(len(path) - 1)
        renderer = Renderer(world, path, SIZE, SIZE)
        after = group.start + HOLD + TURN
        for frame in (group.start - RISE, group.start - 1, group.start, after):
            ids = renderer.render(frame, ("ids",)).ids
            assert ids is not None, "ids were asked for"
            for name in watched if frame < after else watched[:1]:
                row = world.index(name)
                if there[row] and int((ids == row + 1).sum()) < SEEN:
                    return False
    return True


# The screen: a panel that faces the camera and rises out of the floor.
#
# In the frame of the camera, with d its horizontal direction towards what is hidden and u to the
# side, a panel at distance D hides a point at distance t, to the side s and at height z if it has,
# with the camera at height h, the places s D / t and h + (z - h) D / t.


def _screen(
    group: Quadruple, paths: Sequence[Trajectory]
) -> tuple[Body, tuple[BodyEvent, ...]] | None:
    """Return a screen that hides the change, and its movement; None if there is no place for it."""
    scene, start = group.worlds[0], group.start
    first, last = start - RISE, start + HOLD + TURN
    camera = np.array(scene.camera.position)
    covered, near = [], math.inf
    target = paths[0].positions[start, scene.index(group.body)].astype(np.float64)
    ahead = (target - camera) * (1.0, 1.0, 0.0)
    ahead = ahead / norm(ahead)
    aside = np.array([-ahead[1], ahead[0], 0.0])
    for world, path in zip(group.worlds, paths, strict=True):
        there = world.present(len(path) - 1)
        for row, body in enumerate(world.bodies):
            if body.scenery or not there[row]:
                continue
            centers, radius = _spheres(body, path, row)
            depth = ((centers - camera) * ahead).sum(axis=1)
            near = min(near, float(depth[first : last + 1].min()) - radius)
            if body.name == group.body or _changes(paths, row, start):
                rows = slice(start - 2, start + HOLD + 1)
                covered.append((centers[rows], depth[rows], radius))
    distance = near - CLEAR
    if distance < NEAREST:
        return None
    sides, heights = [], []
    for centers, depth, radius in covered:
        side = ((centers - camera) * aside).sum(axis=1)
        for sign, back in itertools.product((-radius, radius), (-radius, radius)):
            scale = distance / (depth + back)
            sides.append((side + sign) * scale)
            heights.append(camera[2] + (centers[:, 2] + sign - camera[2]) * scale)
    left, right = (float(f(np.concatenate(sides))) for f in (np.min, np.max))
    top = float(np.concatenate(heights).max()) + MARGIN
    left, right, height = left - MARGIN, right + MARGIN, top - scene.floor
    if height <= 0:
        return None
    x, y, _ = (camera + distance * ahead + (left + right) / 2 * aside).tolist()
    down = scene.floor - height - 0.02
    screen = Body(
        SCREEN,
        "cube",
        (x, y, down),
        (THICKNESS, right - left, height),
        rotation=_facing(ahead),
        scenery=True,
        look=Look((0.35, 0.4, 0.45)),
    )
    moves = []
    for frame in range(first, last + 1):
        up = min(frame - first, last - frame, TURN) / TURN
        place = (x, y, down + up * (scene.floor - down))
        moves.append(BodyEvent(frame, SCREEN, "move", place))
    return screen, tuple(moves)


def _changes(paths: Sequence[Trajectory], row: int, start: int) -> bool:
    one, other = (path.positions[start : start + HOLD + 1, row] for path in paths)
    return bool((np.abs(one - other) > EQUAL).any())


def _spheres(body: Body, path: Trajectory, row: int) -> tuple[NDArray[np.float64], float]:
    """Return the centres (F, 3) of the sphere around a body's box, and its radius, metres."""
    low, high = shape(body.shape).bounds * np.array(body.scale)
    middle = np.broadcast_to((low + high) / 2, (len(path), 3))
    turned = rotate_vectors(path.rotations[:, row].astype(np.float64), middle)
    return path.positions[:, row] + turned, float(norm(high - low)) / 2


def _facing(ahead: NDArray[np.float64]) -> Quat:
    """Return the rotation about the vertical that takes the x axis to a horizontal unit vector.

    cos(a / 2) = sqrt((1 + cos a) / 2), and sin(a / 2) has the sign of sin a.
    """
    cosine = min(max(float(ahead[0]), -1.0), 1.0)
    half = math.copysign(math.sqrt((1 - cosine) / 2), float(ahead[1]))
    return (math.sqrt((1 + cosine) / 2), 0.0, 0.0, half)
