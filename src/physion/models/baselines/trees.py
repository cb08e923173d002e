"""Baselines that have seen outcomes and know no physics: trees on blobs, masks and states.

`blob-trees`, `mask-trees` and `state-trees` each turn the observed part of a trial into numbers,
from which trees predict P(contact) (`physion.readout.trees`): from the red and yellow pixels, from
the masks of five objects, or from the true state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import AGENT_ID, FIRST_OTHER_ID, LAST_OBSERVED, PATIENT_ID, Batch, Spec
from physion.core.errors import BadInputError
from physion.models.baselines.motion import F64, Baseline, motions, observed_motion
from physion.models.baselines.pixels import BlobCentroids, PixelSettings, color_masks, pictures
from physion.models.interface import ModelSettings
from physion.numerics.linear_algebra import norm
from physion.numerics.rotations import rotate_vectors, rotation_matrices
from physion.physics.trajectory import State
from physion.scenes.scene import Scene
from physion.scenes.shapes.primitives import shape

# What the masks of two objects, or more, tell over time.

_OF_BLOB = (
    "area", "x", "y", "width", "height", "slant", "left", "top", "right", "bottom",
)  # fmt: skip
_BETWEEN = ("x", "y", "distance", "gap")


def _names(first: str, second: str, others: Sequence[str] = ()) -> tuple[str, ...]:
    frame = [f"{mask} {name}" for mask in (first, second, *others) for name in _OF_BLOB]
    frame += [f"{first} to {second} {name}" for name in _BETWEEN]
    return (*frame, *(f"change of {name}" for name in frame))


BLOB_FEATURES = _names("red", "yellow")
"""Features of a frame: area, mean, standard deviations and covariance of the pixels of each colour,
and the box around them, .5 where there is no such pixel; vector and distance from the mean of the
red to the mean of the yellow pixels, and distance of their boxes; and the changes of all these
since the frame before, 0 in the first. Positions are fractions of width (to the right) and height
(downwards), areas of the picture."""


def mask_features(masks: Sequence[NDArray[np.bool_]]) -> NDArray[np.float32]:
    """Return the features of a clip (T, D), as in `BLOB_FEATURES`, from masks (T, H, W) each.

    The first two masks show agent and patient.
    """
    return blob_features([mask_blob(mask) for mask in masks])


def blob_features(blobs: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return the features of a clip (T, D) from what `mask_blob` tells (T, 10) of each mask."""
    red, yellow = blobs[:2]
    apart = yellow[:, 1:3] - red[:, 1:3]
    # Distance of boxes (left, top, right, bottom) along each axis.
    beyond = np.maximum(yellow[:, 6:8] - red[:, 8:10], red[:, 6:8] - yellow[:, 8:10])
    between = [np.hypot(*apart.T), np.hypot(*np.maximum(beyond, 0).T)]
    values = np.column_stack([*blobs, apart, *between])
    return np.column_stack([values, np.diff(values, axis=0, prepend=values[:1])])


def mask_blob(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the features called `_OF_BLOB` (T, 10) of the pixels in masks (T, H, W)."""
    _, height, width = mask.shape
    # What lies outside the box around the pixels of all frames is not counted.
    down, across = mask_box(mask)
    mask = mask[:, down, across]
    x, y = ((np.arange(side) + 0.5) / side for side in (width, height))
    x, y = x[across], y[down]
    rows, columns = mask.sum(axis=2), mask.sum(axis=1)
    counts = rows.sum(axis=1)
    most = np.maximum(counts, 1)
    center_x, center_y = columns @ x / most, rows @ y / most
    spread_x = columns @ x**2 / most - center_x**2
    spread_y = rows @ y**2 / most - center_y**2
    slant = (mask @ x) @ y / most - center_x * center_y
    has_row, has_column = rows > 0, columns > 0
    left = (across.start + has_column.argmax(axis=1)) / width
    top = (down.start + has_row.argmax(axis=1)) / height
    right = (across.stop - has_column[:, ::-1].argmax(axis=1)) / width
    bottom = (down.stop - has_row[:, ::-1].argmax(axis=1)) / height
    deviations = [np.sqrt(np.maximum(spread, 0)) for spread in (spread_x, spread_y)]
    box = [left, top, right, bottom]
    values = np.column_stack(
        [counts / (height * width), center_x, center_y, *deviations, slant, *box]
    )
    values[counts == 0] = [0, 0.5, 0.5, 0, 0, 0, 0.5, 0.5, 0.5, 0.5]
    return values.astype(np.float32)


def mask_box(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the rows and columns that hold all pixels of masks (T, H, W); the first if none do."""
    rows, columns = (np.asarray(mask.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    return _extent(rows), _extent(columns)


def _extent(line: NDArray[np.bool_]) -> slice:
    """Return from the first to the last true value of a line; the first value if none is true."""
    found = np.flatnonzero(line)
    return slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 1)


# Baseline `blob-trees`: what red and yellow pixels tell over time.


@dataclass(frozen=True, kw_only=True)
class BlobTreesSettings(PixelSettings):
    """Settings of `BlobTrees`: see `PixelSettings`."""

    image_size: int = 128


class BlobTrees(BlobCentroids):
    """Encoder of what the red and the yellow pixels of a frame tell, for the decision *trees*.

    Like `BlobCentroids` it knows no shape, no depth and no other object, and nothing of physics. It
    shows how many outcomes follow from where two blobs are and how they move.
    """

    name = "blob-trees"
    decision = "trees"

    def __init__(self, settings: BlobTreesSettings) -> None:
        Baseline.__init__(self, settings)
        # Changes need the frame before.
        self.spec = dataclasses.replace(settings.spec(), framewise=False)

    def encode(self, batch: Batch) -> NDArray[np.float32]:
        """Return the features called `BLOB_FEATURES` (B, T, D) of every frame."""
        rgb = pictures(batch, self.spec.image_size, self.name)
        return np.stack([mask_features(color_masks(frames)) for frames in rgb])


# Baseline `mask-trees`: the same from true masks, also of the largest other objects.

OTHERS = 3
"""Other objects that `mask-trees` sees: those with the most pixels in the observed frames."""


@dataclass(frozen=True, kw_only=True)
class MaskTreesSettings(PixelSettings):
    """Settings of `MaskTrees`: see `PixelSettings`."""

    image_size: int = 64


class MaskTrees(Baseline):
    """Encoder of what the masks of agent, patient and three other objects tell, for *trees*.

    The others are those with the most pixels in the observed frames, the largest first. It knows no
    shape, no depth and no physics.
    """

    name = "mask-trees"
    sees = "masks"
    decision = "trees"

    def __init__(self, settings: MaskTreesSettings) -> None:
        super().__init__(settings)
        self.spec = dataclasses.replace(settings.spec(), inputs=("ids",), framewise=False)

    def encode(self, batch: Batch) -> NDArray[np.float32]:
        """Return features (B, T, D) of every frame, as `BLOB_FEATURES` with other objects."""
        if batch.ids is None:
            raise BadInputError(f"{self.name} needs the objects of pixels (input ids)")
        return np.stack([self._encode_clip(ids) for ids in batch.ids])

    def _encode_clip(self, ids: NDArray[np.uint8]) -> NDArray[np.float32]:
        pixels = np.bincount(ids[: self.spec.context].ravel(), minlength=256)[FIRST_OTHER_ID:]
        others = FIRST_OTHER_ID + np.argsort(-pixels, kind="stable")[:OTHERS]
        seen = [ids == number for number in (AGENT_ID, PATIENT_ID, *others)]
        return mask_features(seen)


# Baseline `state-trees`: the true state of agent, patient, probe and the objects around them.

NEAREST = 6
"""Other objects that `state-trees` sees: those nearest to the line from agent to patient."""
_OF_OBJECT = (
    *("present", "cloth", "x", "y", "z", "axis x", "axis y", "axis z", "up x", "up y", "up z"),
    *("vx", "vy", "vz", "wx", "wy", "wz", "length", "width", "height"),
)
_SLOTS = ("agent", "patient", "probe", *(f"object {number}" for number in range(1, NEAREST + 1)))
STATE_FEATURES = (
    *(f"{slot} {name}" for slot in _SLOTS for name in _OF_OBJECT),
    *("ahead", "up", "distance", "approach"),
)
"""Features of a frame: of every object whether it is there and whether it is cloth, the centre of
its bounding box, directions of two of its axes, velocity, angular velocity and size; then the
distance from patient to agent on the ground and in height, in all, and how fast it grows.

Metres, seconds and radians, with the origin on the floor below the patient and the first axis
towards the agent, both at the last observed frame. A cloth is the mean of its vertices."""


@dataclass(frozen=True, kw_only=True)
class StateTreesSettings(ModelSettings):
    """Settings of `StateTrees`: frames of a clip, as in `Spec`."""

    stride: int = 11
    context: int = 5


class StateTrees(Baseline):
    """Encoder of the true state of nine objects, for the decision *trees*.

    Agent, patient and probe (the object that is pushed), and the `NEAREST` other ones in the order
    of their distance from the patient. It knows shapes only by their size, no friction and no
    physics. A simulator from the same state should predict better.
    """

    name = "state-trees"
    sees = "true state"
    decision = "trees"

    def __init__(self, settings: StateTreesSettings) -> None:
        super().__init__(settings)
        self.spec = Spec(
            inputs=("state",), stride=settings.stride, context=settings.context, future=0,
            context_at="end", framewise=False,
        )  # fmt: skip

    def encode(self, batch: Batch) -> NDArray[np.float32]:
        """Return the features called `STATE_FEATURES` (B, T, D) of every frame."""
        clips = zip(motions(batch, self.name), batch.trials, batch.frames, strict=True)
        rows = []
        for motion, trial, frames in clips:
            seen = observed_motion(motion, trial)
            slots, place = _slots_and_place(seen.scene, seen.trajectory.state(LAST_OBSERVED))
            states = [seen.trajectory.state(int(frame)) for frame in frames]
            rows.append([_state_row(seen.scene, state, slots, place) for state in states])
        return np.array(rows, np.float32).reshape(len(batch), -1, len(STATE_FEATURES))


@dataclass(frozen=True)
class Thing:
    """Body or cloth at one instant: centre (3,), rotation (4,), velocities (3,), extents (3,)."""

    cloth: bool
    center: F64
    rotation: F64
    velocity: F64
    angular_velocity: F64
    size: F64


def find_thing(scene: Scene, state: State, name: str | None) -> Thing | None:
    """Return the body or cloth called ``name``, None if the scene or the instant has none."""
    if name is None:
        return None
    index = scene.index(name)
    if not scene.present(state.frame)[index]:
        return None
    if index >= len(scene.bodies):
        return _cloth(scene, state, index - len(scene.bodies))
    body = scene.bodies[index]
    low, high = shape(body.shape).bounds * np.asarray(body.scale)
    rotation = state.rotations[index]
    return Thing(
        cloth=False,
        center=state.positions[index] + rotate_vectors(rotation, (low + high) / 2),
        rotation=rotation,
        velocity=state.velocities[index],
        angular_velocity=state.angular_velocities[index],
        size=high - low,
    )


def _cloth(scene: Scene, state: State, number: int) -> Thing:
    """Return cloth ``number`` as the mean of its vertices."""
    counts = [cloth.resolution**2 for cloth in scene.cloths]
    rows = slice(sum(counts[:number]), sum(counts[: number + 1]))
    return Thing(
        cloth=True,
        center=state.cloth_vertices[rows].mean(axis=0),
        rotation=np.array([1.0, 0.0, 0.0, 0.0]),
        velocity=state.cloth_velocities[rows].mean(axis=0),
        angular_velocity=np.zeros(3),
        size=np.asarray(scene.cloths[number].size, np.float64),
    )


def _slots_and_place(scene: Scene, state: State) -> tuple[list[str | None], tuple[F64, F64]]:
    """Return the names of the objects in the order of `_SLOTS`, and origin (3,) and axes (3, 3).

    The rows of the axes are towards the agent, to its left, and up. Where agent or patient is not
    there, the other one is the origin, and the axes are the axes of the world.
    """
    roles = scene.roles
    agent, patient = (find_thing(scene, state, name) for name in (roles.agent, roles.patient))
    near, far = patient or agent, agent or patient
    start = np.zeros(3) if near is None else near.center
    way = np.zeros(3) if far is None else far.center - start
    length = float(norm(way[:2]))
    ahead = way[:2] / length if length > 0 else np.array([1.0, 0.0])
    axes = np.array([[ahead[0], ahead[1], 0], [-ahead[1], ahead[0], 0], [0, 0, 1.0]])
    others = {}
    for name in scene.names():
        if name not in (roles.agent, roles.patient, roles.probe):
            thing = find_thing(scene, state, name)
            if thing is not None:
                others[name] = thing.center - start
    along = float(way @ way) or 1.0
    # Distance from the line between the centres of patient and agent.
    aside = {n: float(norm(c - way * np.clip(c @ way / along, 0, 1))) for n, c in others.items()}
    nearest = sorted(others, key=lambda name: aside[name])[:NEAREST]
    nearest.sort(key=lambda name: float(norm(others[name])))
    slots = [roles.agent, roles.patient, roles.probe, *nearest]
    origin = np.array([start[0], start[1], 0.0])
    return [*slots, *[None] * (len(_SLOTS) - len(slots))], (origin, axes)


def _state_row(
    scene: Scene, state: State, slots: Sequence[str | None], place: tuple[F64, F64]
) -> F64:
    """Return the features called `STATE_FEATURES` of one instant."""
    origin, axes = place
    things = [find_thing(scene, state, name) for name in slots]
    agent, patient = things[:2]
    between = np.zeros(4)
    if agent is not None and patient is not None:
        way, speed = agent.center - patient.center, agent.velocity - patient.velocity
        distance = float(norm(way))
        growth = float(way @ speed) / distance if distance else 0.0
        between = np.array([float(norm(way[:2])), way[2], distance, growth])
    return np.concatenate([*(_object_row(thing, origin, axes) for thing in things), between])


def _object_row(thing: Thing | None, origin: F64, axes: F64) -> F64:
    """Return the features of one object, in the order of `_OF_OBJECT`."""
    if thing is None:
        return np.zeros(len(_OF_OBJECT))
    turned = rotation_matrices(thing.rotation)
    vectors = [thing.center - origin, turned[:, 0], turned[:, 2]]
    vectors += [thing.velocity, thing.angular_velocity]
    flags = [1.0, float(thing.cloth)]
    return np.concatenate([flags, *(axes @ vector for vector in vectors), thing.size])
