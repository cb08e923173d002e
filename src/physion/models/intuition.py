"""Intuition: P(contact) from what was observed, learned from the outcomes of own trials.

All scenarios have the same networks. They simulate nothing and know no physics: they have seen
many trials and how they ended. An object is a token, which holds its track over the observed frames
2, 5, ..., 44, from the true state (`intuition-states`), from its true mask (`intuition-masks`), or
from the mask that a network finds in pictures (`intuition-pixels`, `physion.models.segmentation`):

    x_k = f(track_k, place_k - place_agent, place_k - place_patient, d track_k, constants_k),

where places are a part of the track (`VIEWS`). L blocks of attention over the objects, in no order,
lead to the answer

    P(contact) = sigmoid( g(x_agent, x_patient, mean_k x_k) ).

Changes d track_k(t) = track_k(t) - track_k(t - 1) are read of masks only: states hold velocities.
They are 0 in the first frame and where the object is missing in one of both. Next to the values
they are small, so f reads them in their own standard deviations.

Networks that read different things make different errors. So there are three of masks, whose
probabilities are averaged: one reads all, one all but reaches, and one neither reaches nor changes.
Of found masks, whose borders may flicker, a fourth reads what the third reads (`READINGS`).

The loss is the cross entropy of the outcomes. Which object is agent, patient or probe is one of its
constants. In training a trial is mirrored at random; an answer is the mean of both images, and of
several networks if there are ``members``.

References
----------
J. Lee et al., Set transformer, ICML 2019: attention over objects without an order.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from physion.clips.batch import (
    AGENT_ID,
    FIRST_OTHER_ID,
    LAST_OBSERVED,
    PATIENT_ID,
    Batch,
    Motion,
    Provenance,
    Spec,
)
from physion.core.errors import BadInputError
from physion.models.baselines.motion import F64, motions, observed_motion
from physion.models.baselines.trees import mask_blob, mask_box
from physion.models.checkpoint import load_named
from physion.models.interface import (
    LearnsFrom,
    SizedSettings,
    Sizes,
    TrainingSettings,
)
from physion.models.segmentation import SIDE, segment, segmentation_version
from physion.models.torch_model import TorchModel, initial_weights, weights_digest
from physion.numerics.linear_algebra import norm
from physion.numerics.rotations import rotate_vectors, rotation_matrices
from physion.scenes.scene import Scene
from physion.scenes.shapes.primitives import shape

# What a token holds. Columns of a track are of every frame, constants of the object. A mirror image
# of a trial has the same columns in another order, some with the other sign.

STATE, MASK, PIXELS = "states", "masks", "pixels"
INPUTS = {STATE: "state", MASK: "ids", PIXELS: "rgb"}
"""What is seen, as an input of a `Spec`."""
VERSIONS = {STATE: 1, MASK: 2, PIXELS: 2}
"""Version of tokens by what is seen.

2 of masks, also of found ones: tokens hold how far they reach in twelve directions."""
_CORNERS = tuple(f"corner {x}{y}{z}" for x in "-+" for y in "-+" for z in "-+")
TURNS = tuple(turn for turn in range(16) if turn % 4)
"""Directions in a picture, in 16ths of a turn from right over down; the box has the other four."""
_REACHES = tuple(f"reach {turn}" for turn in TURNS)


@dataclass(frozen=True)
class TokenColumns:
    """Columns of tokens.

    - ``track``, ``constants``: names of columns; the first of a track says if the object is there.
    - ``place``: columns of a track that are also given relative to agent and patient.
    - ``negated``: columns with the other sign in the mirror image. ``swapped``: pairs of columns
      that change places there.
    """

    track: tuple[str, ...]
    constants: tuple[str, ...]
    place: tuple[str, ...]
    negated: frozenset[str]
    swapped: tuple[tuple[str, str], ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all columns of a token in one frame."""
        return self.track + self.constants

    def mirror(self) -> tuple[list[int], list[float]]:
        """Return from which column each comes in the mirror image, and its factor."""
        partner = {a: b for pair in self.swapped for a, b in (pair, pair[::-1])}
        order = [self.columns.index(partner.get(name, name)) for name in self.columns]
        return order, [-1.0 if name in self.negated else 1.0 for name in self.columns]


_BLOB = (
    "there", "area", "x", "y", "width", "height", "slant", "left", "top", "right", "bottom",
)  # fmt: skip
"""Columns of a track of masks without reaches."""
_MASKS = TokenColumns(
    track=(*_BLOB, *_REACHES),
    constants=("agent", "patient"),
    place=("x", "y"),
    negated=frozenset(("x", "slant", "left", "right")),
    swapped=(
        ("left", "right"),
        *((f"reach {turn}", f"reach {(8 - turn) % 16}") for turn in TURNS if turn % 8 < 4),
    ),
)
VIEWS: Mapping[str, TokenColumns] = {
    STATE: TokenColumns(
        track=(
            "there", "x", "y", "z", "axis x", "axis y", "axis z", "up x", "up y", "up z",
            "vx", "vy", "vz", "wx", "wy", "wz",
        ),
        constants=(
            "agent", "patient", "probe", "cloth", "fixed", "length", "width", "height", "filled",
            *_CORNERS,
        ),
        place=("x", "y", "z"),
        negated=frozenset(("y", "axis y", "up y", "vy", "wx", "wz")),
        swapped=tuple((f"corner {x}-{z}", f"corner {x}+{z}") for x in "-+" for z in "-+"),
    ),
    MASK: _MASKS,
    PIXELS: _MASKS,
}  # fmt: skip
"""Columns by what is seen.

- ``states``: centre of the bounding box in metres, directions of two axes of the body, velocity
  and angular velocity (asinh of m/s and rad/s); size in metres, fraction of the bounding box that
  the shape fills, and how far it reaches into the corners of the box. The origin lies on the floor
  below the patient, the first axis points to the agent, both at the last observed frame.
- ``masks``, true or found in ``pixels``: square root of the area, mean, standard deviations and
  covariance of the pixels, and the box around them from the middle of the picture, and how far the
  pixels reach from their mean in twelve directions, in fractions of the picture. Reaches tell how a
  body is turned.
"""


@dataclass(frozen=True)
class Reading:
    """What a network reads of tokens: columns of tracks, and whether their changes, too.

    The first column is *there*.
    """

    track: tuple[str, ...]
    changes: bool = False


_OF_MASKS = (
    Reading(_MASKS.track, changes=True), Reading(_BLOB, changes=True), Reading(_BLOB),
)  # fmt: skip
READINGS: Mapping[str, tuple[Reading, ...]] = {
    STATE: (Reading(VIEWS[STATE].track),),
    MASK: _OF_MASKS,
    PIXELS: (*_OF_MASKS, Reading(_BLOB)),
}
"""What the networks of a model read, by what is seen; with more members from the first again."""


# Tokens of states.


def state_tokens(
    motion: Motion, trial: str, frames: NDArray[np.int64], objects: int
) -> NDArray[np.float32]:
    """Return the tokens (T, K, D) of the observed part of a motion, zeros for absent objects.

    The first three are agent, patient and probe (the object that is pushed; nothing where it is one
    of these), then come the objects nearest to the line from agent to patient. Scenery is left out.
    """
    seen = observed_motion(motion, trial)
    scene, view = seen.scene, VIEWS[STATE]
    names, roles = scene.names(), scene.roles
    tracks, there = _tracks(seen, np.append(frames, LAST_OBSERVED))
    now = tracks[-1, :, :3]
    agent, patient = names.index(roles.agent), names.index(roles.patient)
    chosen = _nearest(scene, now, there[-1], objects)
    ahead = now[agent, :2] - now[patient, :2]
    length = float(norm(ahead))
    x, y = ahead / length if length > 0 else (1.0, 0.0)
    axes = np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])
    origin = np.array([*now[patient, :2], 0.0])
    vectors = tracks[:-1, chosen].reshape(len(frames), len(chosen), -1, 3).copy()
    vectors[:, :, 0] -= origin
    turned = (vectors @ axes.T).reshape(len(frames), len(chosen), -1)
    turned[..., -6:] = np.arcsinh(turned[..., -6:])
    tokens = np.zeros((len(frames), objects, len(view.columns)), np.float32)
    # The probe has the third place, also where another object takes part in its stead.
    places = [0, 1, *range(3 - (chosen[2:3] == [_probe(scene)]), objects)][: len(chosen)]
    present = there[:-1].take(chosen, axis=1)
    tracked = np.concatenate([present[..., None], turned * present[..., None]], -1)
    constants = np.array([_constants(scene, index) for index in chosen])
    ever = np.asarray(present.any(axis=0))
    repeated = np.broadcast_to(constants, (len(frames), *constants.shape))
    tokens[:, places] = np.concatenate([tracked, repeated * ever[:, None]], -1)
    return tokens


def _tracks(seen: Motion, frames: NDArray[np.int64]) -> tuple[F64, NDArray[np.bool_]]:
    """Return of every object (T, N, 15) centre, two axes, velocities; and whether it is there."""
    scene, trajectory = seen.scene, seen.trajectory
    bodies = len(scene.bodies)
    tracks = np.zeros((len(frames), len(scene.names()), 15))
    rotations = trajectory.rotations[frames].astype(np.float64)
    boxes = [_bounds(body.shape) * np.asarray(body.scale) for body in scene.bodies]
    middles = np.array([box.mean(axis=0) for box in boxes]).reshape(-1, 3)
    turned = rotation_matrices(rotations)
    tracks[:, :bodies, :3] = trajectory.positions[frames] + rotate_vectors(rotations, middles)
    tracks[:, :bodies, 3:6], tracks[:, :bodies, 6:9] = turned[..., 0], turned[..., 2]
    tracks[:, :bodies, 9:12] = trajectory.velocities[frames]
    tracks[:, :bodies, 12:15] = trajectory.angular_velocities[frames]
    start = 0
    for number, cloth in enumerate(scene.cloths):
        rows = slice(start, start := start + cloth.resolution**2)
        own = tracks[:, bodies + number]
        states = [trajectory.state(int(frame)) for frame in frames]
        own[:, :3] = [state.cloth_vertices[rows].mean(axis=0) for state in states]
        own[:, 3:9] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        own[:, 9:12] = [state.cloth_velocities[rows].mean(axis=0) for state in states]
    there = np.array([scene.present(int(frame)) for frame in frames])
    return tracks, there


def _probe(scene: Scene) -> int:
    """Return the index of the probe; -1 if it is agent or patient, or if there is none."""
    roles = scene.roles
    named = roles.probe is not None and roles.probe not in (roles.agent, roles.patient)
    return scene.names().index(roles.probe) if named and roles.probe is not None else -1


def _nearest(scene: Scene, now: F64, there: NDArray[np.bool_], objects: int) -> list[int]:
    """Return agent, patient, probe if there is one, and the objects nearest to the line."""
    names = scene.names()
    first = [names.index(scene.roles.agent), names.index(scene.roles.patient)]
    first += [probe] if (probe := _probe(scene)) >= 0 else []
    start, way = now[first[1]], now[first[0]] - now[first[1]]
    along = np.clip((now - start) @ way / (float(way @ way) or 1.0), 0, 1)
    aside = norm(now - start - along[:, None] * way)
    scenery = [body.scenery for body in scene.bodies] + [False] * len(scene.cloths)
    others = [i for i in range(len(names)) if there[i] and not scenery[i] and i not in first]
    free = objects - (3 if objects > 2 else 2)
    return [*first[:objects], *sorted(others, key=lambda index: float(aside[index]))[:free]]


def _constants(scene: Scene, index: int) -> list[float]:
    """Return the constants of one object, as in `VIEWS`."""
    names, roles = scene.names(), scene.roles
    flags = [float(names[index] == name) for name in (roles.agent, roles.patient, roles.probe)]
    if index >= len(scene.bodies):
        return [*flags, 1.0, 0.0, *scene.cloths[index - len(scene.bodies)].size, 0.0, *[0.0] * 8]
    body = scene.bodies[index]
    low, high = _bounds(body.shape) * np.asarray(body.scale)
    return [*flags, 0.0, float(body.kinematic), *(high - low), *_reach(body.shape)]


@functools.cache
def _bounds(name: str) -> F64:
    """Return the smallest and largest coordinates (2, 3) of a shape at unit scale."""
    return shape(name).bounds


@functools.cache
def _reach(name: str) -> tuple[float, ...]:
    """Return which fraction of its bounding box a shape fills, and its reach into the 8 corners.

    The reach is the largest d . v of the vertices v, in coordinates of -1 to 1 in the box, in the
    direction d of a corner: 1 for a cube, 1 / sqrt(3) for a sphere.
    """
    low, high = shape(name).bounds
    points = (shape(name).mesh.vertices - (low + high) / 2) / ((high - low) / 2)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = (points @ (signs / 3).T).max(axis=0)
    return (float(shape(name).volume / np.prod(high - low)), *(float(c) for c in corners))


# Tokens of masks.


def mask_tokens(ids: NDArray[np.uint8], objects: int) -> NDArray[np.float32]:
    """Return the tokens (T, K, D) of a clip from the objects of its pixels (T, H, W).

    The first two are agent and patient, then come the others with the most pixels in all frames.
    """
    pixels = np.bincount(ids.ravel(), minlength=256)[FIRST_OTHER_ID:]
    others = [n for n in np.argsort(-pixels, kind="stable")[: objects - 2] if pixels[n] > 0]
    numbers = [AGENT_ID, PATIENT_ID, *(FIRST_OTHER_ID + int(number) for number in others)]
    tracked = len(_MASKS.track)
    tokens = np.zeros((len(ids), objects, len(_MASKS.columns)), np.float32)
    for place, number in enumerate(numbers):
        mask = ids == number
        blob = mask_blob(mask)
        seen = blob[:, 0] > 0
        # Area, mean and box count from the middle of the picture.
        values = blob - np.array([0, 0.5, 0.5, 0, 0, 0, 0.5, 0.5, 0.5, 0.5], np.float32)
        values[:, 0] = np.sqrt(blob[:, 0])
        values = np.concatenate([values, mask_reach(mask, blob[:, 1:3])], 1)
        tokens[:, place, 0] = seen
        tokens[seen, place, 1:tracked] = values[seen]
        tokens[:, place, tracked:] = (place == 0, place == 1)
    return tokens


def mask_reach(mask: NDArray[np.bool_], mean: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return how far masks (T, H, W) reach from the means (T, 2) of their pixels, as (T, 12).

        reach(a) = max over corners (x, y) of pixels of (x - mean_x) cos(a) + (y - mean_y) sin(a)

    for the directions a of `TURNS`; x counts to the right in widths of the picture, y downwards in
    heights. It is ``-inf`` where there is no pixel.
    """
    _, height, width = mask.shape
    down, across = mask_box(mask)
    mask = mask[:, down, across]
    there = mask.any(axis=2)
    # In a row the pixel on the left or the one on the right reaches farthest.
    left = (across.start + mask.argmax(axis=2)) / width
    right = (across.stop - mask[:, :, ::-1].argmax(axis=2)) / width
    top = np.arange(down.start, down.stop) / height
    out = np.empty((len(mask), len(TURNS)))
    for column, turn in enumerate(TURNS):
        x, y = np.cos(turn * np.pi / 8), np.sin(turn * np.pi / 8)
        reach = x * (right if x > 0 else left) + y * (top + (y > 0) / height)
        farthest = np.where(there, reach, -np.inf).max(axis=1)
        out[:, column] = farthest - x * mean[:, 0] - y * mean[:, 1]
    return out.astype(np.float32)


# Settings.


@dataclass(frozen=True, kw_only=True)
class IntuitionSettings(SizedSettings):
    """Settings of a model of intuition; also see `SizedSettings`.

    - ``image_size``: pixels per side of the masks: 192 by default for true masks, always 96 from
      pixels.
    - ``objects``: tokens K. With more objects the largest masks, or the bodies nearest to the line
      from agent to patient, are kept.
    - ``width``, ``layers``, ``heads``: of the network. ``dropout``: in training.
    - ``noise``: standard deviation of noise on values of tokens and, independently, on their
      changes in training, in standard deviations of each.
    - ``members``: networks, trained at the same time, whose probabilities are averaged; by default
      as many as `READINGS` has.
    - ``cue``: from pixels only: objects may have any colours, and the masks of the first frame of
      the clip show which are agent and patient, as a cue showed people. Other masks are not looked
      at. The weights are the same.
    """

    model: str = "intuition-masks"
    image_size: int = SIDE
    objects: int = 8
    width: int = 96
    layers: int = 3
    heads: int = 4
    dropout: float = 0.1
    noise: float = 0.02
    members: int = 1
    cue: bool = False

    sizes: ClassVar[Sizes] = {"small": {}}
    any_weights: ClassVar[frozenset[str]] = SizedSettings.any_weights | {"cue"}

    @classmethod
    def defaults(cls, model: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings of a model.

        There are as many ``members`` as there are readings. States have more tokens. Masks are
        trained with more noise and dropout, with which the loss of held-out trials was smaller (of
        true masks), and true ones have more pixels.
        """
        kind = model.partition("-")[2]
        own: dict[str, Any] = {"members": len(READINGS[kind])}
        own |= {"objects": 12} if kind == STATE else {"dropout": 0.2, "noise": 0.05}
        own |= {"image_size": 192} if kind == MASK else {}
        return {**own, **super().defaults(model, options)}

    def __post_init__(self) -> None:
        self.at_least(1, "image_size", "width", "layers", "heads", "members")
        self.at_least(3, "objects")
        self.at_least(0, "dropout", "noise")
        if self.model == f"intuition-{PIXELS}" and self.image_size != SIDE:
            raise BadInputError(
                f"{self.model}: image_size must be {SIDE}, since objects are found in pictures of "
                f"this size only, not {self.image_size}"
            )
        if self.cue and self.model != f"intuition-{PIXELS}":
            raise BadInputError(
                f"{self.model} knows agent and patient; cue=true is for intuition-{PIXELS}"
            )
        if self.width % self.heads:
            raise BadInputError(
                f"{self.model}: width {self.width} must be a multiple of heads {self.heads}"
            )


STRIDE, CONTEXT = 3, 15
"""Frames 2, 5, ..., 38, 41, 44. The last ones are dense, since they tell velocities."""

TRAINING = TrainingSettings(
    steps=2500,
    batch=512,
    optimizer="adamw",
    learning_rate=1e-3,
    weight_decay=0.05,
    schedule="cosine",
    warmup=200,
    clip=1.0,
    validate_every=250,
    log_every=50,
    checkpoint_every=250,
)


# The network.


class TokenBlock(nn.Module):
    """Attention over objects and a network of each, both added to what they read (pre-norm)."""

    def __init__(self, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.before = nn.LayerNorm(width)
        self.mix = nn.Linear(width, 3 * width)
        self.join = nn.Linear(width, width)
        self.each = nn.Sequential(
            nn.LayerNorm(width),
            nn.Linear(width, 2 * width),
            nn.GELU(),
            nn.Linear(2 * width, width),
            nn.Dropout(dropout),
        )

    def forward(self, tokens: Tensor, there: Tensor) -> Tensor:
        """Return tokens (B, K, width); those that are not ``there`` (B, K) are not looked at."""
        shape = (*tokens.shape[:2], 3, self.heads, -1)
        query, key, value = self.mix(self.before(tokens)).view(shape).permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(
            query, key, value, attn_mask=there[:, None, None],
            dropout_p=self.dropout if self.training else 0.0,
        )  # fmt: skip
        tokens = tokens + self.join(mixed.transpose(1, 2).flatten(2))
        out: Tensor = tokens + self.each(tokens)
        return out


class TokenNetwork(nn.Module):
    """Tokens of objects, of ``inputs`` values each, to the logit of P(contact)."""

    def __init__(self, inputs: int, width: int, layers: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.embed = nn.Sequential(nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width))
        self.blocks = nn.ModuleList(TokenBlock(width, heads, dropout) for _ in range(layers))
        self.answer = nn.Sequential(
            nn.LayerNorm(3 * width),
            nn.Dropout(dropout),
            nn.Linear(3 * width, width),
            nn.GELU(),
            nn.Linear(width, 1),
        )

    def forward(self, values: Tensor, there: Tensor) -> Tensor:
        """Return logits (B,) of values (B, K, inputs) of tokens that are ``there`` (B, K)."""
        tokens = self.embed(values)
        for block in self.blocks:
            tokens = block(tokens, there)
        weights = there[..., None].to(tokens.dtype)
        mean = (tokens * weights).sum(1) / weights.sum(1).clamp(min=1)
        out: Tensor = self.answer(torch.cat([tokens[:, 0], tokens[:, 1], mean], -1))
        return out[:, 0]


def _changes(track: Tensor) -> tuple[Tensor, Tensor]:
    """Return the changes of a track (B, T, K, D) since the frame before (B, T - 1, K, D - 1).

    Also returned is whether the object is there in both frames, 1 or 0 (B, T - 1, K, 1). That is
    what the first column of a track says, which has no changes.
    """
    there, values = track[..., :1], track[..., 1:]
    return values[:, 1:] - values[:, :-1], there[:, 1:] * there[:, :-1]


# The model.


class Intuition(TorchModel):
    """Intuition from true states, true masks or pictures, given as tokens of objects."""

    answers = "observed"
    learns_outcomes = True
    learns_from: LearnsFrom = "features"
    training_settings = TRAINING
    settings: IntuitionSettings

    def __init__(self, settings: IntuitionSettings) -> None:
        super().__init__()
        settings.check_shipped()
        self.name = f"{settings.model}-{settings.size}"
        self.kind = settings.model.partition("-")[2]
        if self.kind != STATE:
            self.training_settings = replace(TRAINING, steps=3000)
        self.settings, self.seed, self.window = settings, settings.seed, CONTEXT
        self.spec = Spec(
            inputs=(INPUTS[self.kind], *("ids",) * settings.cue), image_size=settings.image_size,
            stride=STRIDE, context=CONTEXT, future=0, framewise=False,
        )  # fmt: skip
        self.view = VIEWS[self.kind]
        self.look = "redyellow" if self.kind == PIXELS and not settings.cue else ""
        readings = READINGS[self.kind]
        self.readings = [readings[n % len(readings)] for n in range(settings.members)]
        with initial_weights(settings.model, settings.seed):
            self.networks = nn.ModuleList(
                TokenNetwork(
                    self._inputs(reading), settings.width, settings.layers, settings.heads,
                    settings.dropout,
                )
                for reading in self.readings
            )  # fmt: skip
        columns, changing = len(self.view.columns), len(self.view.track) - 1
        self.base_rate = nn.Buffer(torch.tensor(0.5))
        self.center = nn.Buffer(torch.zeros(columns))
        self.scale = nn.Buffer(torch.ones(columns))
        changes = any(reading.changes for reading in self.readings)
        self.change_scale = nn.Buffer(torch.ones(changing)) if changes else None
        order, signs = self.view.mirror()
        self.order = nn.Buffer(torch.tensor(order), persistent=False)
        self.signs = nn.Buffer(torch.tensor(signs), persistent=False)
        load_named(self, settings.weights)
        # Until a training says otherwise: dropout and noise would change answers.
        self.eval()

    def provenance(self) -> Provenance:
        """Return name, size and origin of the weights."""
        return Provenance(
            model=self.name + "-cue" * self.settings.cue,
            init=self.init,
            encoder_type=f"{self.kind} of up to {self.settings.objects} objects"
            + ", cue in the first frame" * self.settings.cue,
            encoder_training_task="segmentation" if self.kind == PIXELS else "outcomes",
            dynamics_type="none",
            versions=f"torch {torch.__version__}",
        )

    def digest(self) -> str:
        """Return the SHA-256 of code version, settings and weights."""
        settings = {k: v for k, v in asdict(self.settings).items() if k not in ("weights", "seed")}
        made = [self.name, VERSIONS[self.kind], settings, repr(self.spec), repr(self.readings)]
        made += self._segmentation()
        return weights_digest([*made, torch.__version__], self.state_dict().items())

    def encoder_digest(self) -> str:
        """Return the SHA-256 of what determines the tokens: no weights but of the segmentation."""
        made = [self.kind, VERSIONS[self.kind], self.settings.objects, repr(self.spec)]
        return weights_digest([*made, *self._segmentation()])

    def built_as(self) -> dict[str, Any]:
        """Return what the weights were made for: name, with the size, version, and segmentation."""
        made: dict[str, Any] = {"model": self.name, "version": VERSIONS[self.kind]}
        return made | ({"segmentation": segmentation_version()} if self.kind == PIXELS else {})

    def encode(self, batch: Batch) -> Tensor:
        """Return the tokens of all objects (B, T, K D), which the training does not change."""
        self._check_frames(batch)
        objects = self.settings.objects
        if self.kind == STATE:
            shown = batch.frames.cpu().numpy()
            rows = zip(motions(batch, self.name), batch.trials, shown, strict=True)
            tokens = [state_tokens(motion, trial, of, objects) for motion, trial, of in rows]
        else:
            tokens = [mask_tokens(ids, objects) for ids in self._ids(batch)]
        return torch.from_numpy(np.stack(tokens)).flatten(2).to(self.device)

    def predict(self, batch: Batch) -> Tensor:
        """Return P(contact) (B,), the mean over networks and mirror images.

        Where agent or patient is never seen it is the base rate of the training trials.
        """
        if batch.features is None:
            batch = replace(batch, features=self.encode(batch))
        answers = self.logits(batch).sigmoid().mean(0)
        return torch.where(self.seen(batch), answers, self.base_rate)

    def notes(self, batch: Batch) -> list[str]:
        """Return for each trial whether it never shows agent or patient, or too many objects."""
        notes = []
        ids = None if self.kind == STATE else self._ids(batch)
        unseen = "agent or patient never visible"
        if self.kind == PIXELS:
            unseen = "red agent or yellow patient never visible"
        if self.settings.cue:
            unseen = "agent or patient not visible in the first frame"
        if ids is not None:
            tokens = np.stack([mask_tokens(one, self.settings.objects) for one in ids])
            batch = replace(batch, features=torch.from_numpy(tokens).flatten(2).to(self.device))
        counts = self._counts(batch, ids)
        for seen, (count, most) in zip(self.seen(batch).tolist(), counts, strict=True):
            hidden = "" if seen else f"{unseen}: base rate"
            many = f"{count} objects, only {most} are looked at" if count > most else ""
            notes.append("; ".join(filter(None, (hidden, many))))
        return notes

    def logits(self, batch: Batch) -> Tensor:
        """Return logits (2 members, B), each member of the trial and of its mirror image."""
        tokens = self._tokens(batch)
        images = (tokens, self._mirrored(tokens))
        logits = []
        for network, reading in zip(self.networks, self.readings, strict=True):
            logits += [network(*self._values(image, reading)) for image in images]
        return torch.stack(logits)

    def seen(self, batch: Batch) -> Tensor:
        """Return whether agent and patient are both seen in some frame (B,)."""
        seen: Tensor = (self._tokens(batch)[:, :, :2, 0] > 0).any(1).all(1)
        return seen

    def prepare(self, sample: Batch) -> None:
        """Set the base rate, mean and deviation of values, and deviation of their changes.

        Given weights keep their own.
        """
        if self.trained:
            return
        self.base_rate.copy_(sample.contact.float().mean())
        tokens = self._tokens(sample)
        values = tokens[tokens[..., 0] > 0]
        # What says whether something is there keeps its values.
        kept = torch.tensor([name == "there" for name in self.view.columns], device=values.device)
        self.center.copy_(values.mean(0).masked_fill(kept, 0.0))
        self.scale.copy_(values.std(0).clamp(min=1e-3).masked_fill(kept, 1.0))
        if self.change_scale is not None:
            changes, both = _changes(tokens[..., : len(self.view.track)])
            self.change_scale.copy_(changes[both[..., 0] > 0].std(0).clamp(min=1e-3))

    def baseline(self, batch: Batch) -> Tensor:
        """Return the cross entropy of the base rate."""
        odds = torch.logit(self.base_rate.clamp(0.01, 0.99)).expand(len(batch))
        return functional.binary_cross_entropy_with_logits(odds, batch.contact.float())

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the mean cross entropy of the outcomes, and how many answers are right."""
        tokens = self._tokens(batch)
        logits = []
        for network, reading in zip(self.networks, self.readings, strict=True):
            turned = torch.rand(len(batch), device=tokens.device) < 0.5
            image = torch.where(turned[:, None, None, None], self._mirrored(tokens), tokens)
            logits.append(network(*self._values(image, reading)))
        answers = torch.stack(logits)
        contact = batch.contact.float().expand_as(answers)
        right = ((answers.sigmoid().mean(0) > 0.5) == batch.contact).float().mean()
        loss = functional.binary_cross_entropy_with_logits(answers, contact)
        return {"loss": loss, "accuracy": right}

    def _tokens(self, batch: Batch) -> Tensor:
        """Return tokens (B, T, K, D) from the features of a batch, or made of what it shows."""
        tokens: Tensor = self.encode(batch) if batch.features is None else batch.features
        return tokens.view(*tokens.shape[:2], self.settings.objects, -1)

    def _mirrored(self, tokens: Tensor) -> Tensor:
        """Return the tokens of the mirror image."""
        image: Tensor = tokens[..., self.order] * self.signs
        return image

    def _inputs(self, reading: Reading) -> int:
        """Return how many values of a token a network with this reading has."""
        tracked = len(reading.track)
        changing = tracked - 1 if reading.changes else 0
        of_frame = tracked + 2 * len(self.view.place) + changing
        return CONTEXT * of_frame + len(self.view.constants)

    def _values(self, tokens: Tensor, reading: Reading) -> tuple[Tensor, Tensor]:
        """Return what a network reads of tokens (B, T, K, D), and which objects are there."""
        names = (*reading.track, *self.view.constants)
        chosen, tracked = [self.view.columns.index(name) for name in names], len(reading.track)
        tokens, present = tokens[..., chosen], tokens[..., :1]
        scaled = self._noisy((tokens - self.center[chosen]) / self.scale[chosen])
        # Presence is 0 or 1 and stays so; values of absent objects are zeros.
        scaled = torch.cat([present, scaled[..., 1:] * present], -1)
        columns = [names.index(name) for name in self.view.place]
        places, shown = scaled[..., columns], present
        relative = [
            (places - places[:, :, who, None]) * shown * shown[:, :, who, None] for who in (0, 1)
        ]
        parts = [scaled[..., :tracked], *relative]
        if reading.changes:
            assert self.change_scale is not None
            changes, both = _changes(tokens[..., :tracked])
            # The first column, presence, has no changes.
            of_column = self.change_scale[[place - 1 for place in chosen[1:tracked]]]
            changes = self._noisy(changes / of_column) * both
            # Nothing is before the first frame: no change.
            parts.append(functional.pad(changes, (0, 0, 0, 0, 1, 0)))
        tracks = torch.cat(parts, -1)
        constants = scaled[..., tracked:].sum(1) / present.sum(1).clamp(min=1)
        values = tracks.transpose(1, 2).reshape(len(tokens), tokens.shape[2], -1)
        there = (present[..., 0] > 0).any(1)
        # Attention needs something to look at.
        there = there | ~there.any(1, keepdim=True)
        return torch.cat([values, constants], -1), there

    def _noisy(self, values: Tensor) -> Tensor:
        """Return values, in standard deviations, cut to -10 to 10; in training noise is added."""
        values = values.clamp(-10, 10)
        if self.training and self.settings.noise:
            values = values + self.settings.noise * torch.randn_like(values)
        return values

    def _segmentation(self) -> list[str]:
        """Return what the masks depend on that are found in pictures; nothing of other models."""
        return [segmentation_version(), torch.__version__] if self.kind == PIXELS else []

    def _check_frames(self, batch: Batch) -> None:
        """Raise `BadInputError` for other frames than those that the model learns from."""
        wanted = self.spec.context_frames()
        shown = batch.frames.cpu().numpy() if isinstance(batch.frames, Tensor) else batch.frames
        for trial, frames in zip(batch.trials, shown.tolist(), strict=True):
            if tuple(frames) != wanted:
                listed = ", ".join(str(frame) for frame in (*wanted[:2], "...", wanted[-1]))
                raise BadInputError(
                    f"{self.name}, trial {trial!r}: frames {listed} are needed, not "
                    f"{len(frames)} frames up to {frames[-1]}; read clips with the model's spec"
                )

    def _ids(self, batch: Batch) -> NDArray[np.uint8]:
        """Return the objects of pixels (B, T, H, W), true or found, after a check of their size."""
        size, seen = self.settings.image_size, {}
        for name in self.spec.inputs:
            given = getattr(batch, name)
            if given is None or tuple(given.shape[2:4]) != (size, size):
                found = "none" if given is None else tuple(given.shape[2:4])
                what = "pictures" if name == "rgb" else "objects of pixels"
                raise BadInputError(
                    f"{self.name}: {what} (input {name}) of {size} x {size} are needed, not "
                    f"{found}; give clips of this size"
                )
            seen[name] = np.asarray(given.cpu() if isinstance(given, Tensor) else given)
        if self.kind == MASK:
            return seen["ids"]
        # Of true masks only the first frame is looked at.
        cues = [of[0] for of in seen["ids"]] if self.settings.cue else [None] * len(seen["rgb"])
        return np.stack([segment(shown, cue) for shown, cue in zip(seen["rgb"], cues, strict=True)])

    def _counts(self, batch: Batch, ids: NDArray[np.uint8] | None) -> Sequence[tuple[int, int]]:
        """Return how many objects every clip has, and how many at most are looked at."""
        most = self.settings.objects
        if ids is not None:
            return [(len(np.unique(one[one > 0])), most) for one in ids]
        scenes = [motion.scene for motion in motions(batch, self.name)]
        # The third token is the probe's, and empty without one (`_nearest`).
        return [
            (
                sum(not body.scenery for body in scene.bodies) + len(scene.cloths),
                most - (most > 2 and _probe(scene) < 0),
            )
            for scene in scenes
        ]
