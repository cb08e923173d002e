"""What a model asks for and receives: `Spec`, `Motion`, `Batch` and `Rollout`.

This module does not import torch. Arrays of a `Batch` are numpy arrays; `Batch.to` makes tensors of
them for networks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import OBSERVED_FRAMES, Scene

LAST_OBSERVED = OBSERVED_FRAMES - 1
"""Index of the last frame that may be seen before a prediction."""
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
PIXELS = ("rgb", "ids", "depth", "boxes", "camera")
"""Inputs that are seen by the camera."""
INPUTS = (*PIXELS, "state")
"""All inputs that a `Spec` may ask for."""
SCENERY_ID, AGENT_ID, PATIENT_ID, FIRST_OTHER_ID = 0, 1, 2, 3
"""Values of ``Batch.ids``; the other bodies and cloths follow in the order of `Scene.names`."""


@dataclass(frozen=True, slots=True)
class Spec:
    """What a model asks for. Frames are frames of the motion, 0.01 s apart, one per movie frame.

    - ``inputs``: any of `INPUTS`; none for a model that needs only the names of trials.
    - ``image_size``: pixels per side; pictures are scaled to it.
    - ``mean``, ``std``: of the red, green and blue channel in 0..1. They belong to the weights; the
      model itself normalises its uint8 pictures with them.
    - ``stride``: frames between two frames of a clip (6 of a movie at 30 frames/s: 5 a second).
    - ``context``: frames of a clip that are observed; 0: all that fit into the observed part.
    - ``future``: frames that follow; None: up to the end of the movie. 0 is for a model that
      neither imagines nor reads later frames.
    - ``context_at``: where the context lies: ``end`` (..., 44 - s, 44) or ``start`` (0, s, 2 s,
      ...).
    - ``objects``: rows of ``Batch.boxes``.
    - ``framewise``: whether the features of a frame depend on that frame only, so that a clip can
      be encoded in parts.

    The defaults are as in the paper: every sixth frame up to the last observed one, 2, 8, ..., 44,
    and from there to the end of the movie. The released frozen-encoder models had ``context=7,
    context_at="start", future=18``: frames 0, 6, ..., 36, and 42, 48, ..., 144 after them.
    """

    inputs: tuple[str, ...] = ("rgb",)
    image_size: int = 224
    mean: tuple[float, float, float] = IMAGENET_MEAN
    std: tuple[float, float, float] = IMAGENET_STD
    stride: int = 6
    context: int = 0
    future: int | None = None
    context_at: Literal["start", "end"] = "end"
    objects: int = 10
    framewise: bool = True

    def __post_init__(self) -> None:
        unknown = [name for name in self.inputs if name not in INPUTS]
        if unknown:
            raise BadInputError(
                f"spec: inputs must be some of {', '.join(INPUTS)}, not {list(self.inputs)}"
            )
        least = min(self.context, self.future or 0)
        if min(self.image_size, self.stride, self.objects) < 1 or least < 0:
            raise BadInputError(
                f"spec: image size {self.image_size}, stride {self.stride} and objects "
                f"{self.objects} must be at least 1, and context {self.context} and future "
                f"{self.future} at least 0"
            )
        if not self.context:
            object.__setattr__(self, "context", LAST_OBSERVED // self.stride + 1)
        if self.context_at not in ("start", "end"):
            raise BadInputError(f"spec: context_at must be start or end, not {self.context_at!r}")
        if (self.context - 1) * self.stride > LAST_OBSERVED:
            raise BadInputError(
                f"spec: {self.context} context frames at stride {self.stride} span "
                f"{(self.context - 1) * self.stride + 1} frames, more than the {OBSERVED_FRAMES} "
                "observed ones"
            )

    @property
    def first(self) -> int:
        """Frame at which a clip starts."""
        return 0 if self.context_at == "start" else LAST_OBSERVED - (self.context - 1) * self.stride

    @property
    def sees_pictures(self) -> bool:
        """Whether the model asks for anything that the camera sees."""
        return any(name in PIXELS for name in self.inputs)

    def context_frames(self, last: int = LAST_OBSERVED) -> tuple[int, ...]:
        """Return the frames of the context, none after ``last``; all are observed.

        If fewer than ``context`` frames fit, the first one is repeated in front.
        """
        if self.context_at == "start":
            shown = tuple(range(0, last + 1, self.stride))[: self.context]
        else:
            shown = tuple(range(last, -1, -self.stride))[: self.context][::-1]
        return (shown[0],) * (self.context - len(shown)) + shown

    def steps_after(self, length: int) -> int:
        """Return how many frames follow the context in a clip of a motion of ``length`` frames.

        Without a ``future`` they are as many as it takes to reach the last frame.
        """
        if self.future is not None:
            return self.future
        left = length - 1 - self.context_frames()[-1]
        return max(0, -(-left // self.stride))

    def all_frames(self, length: int) -> tuple[int, ...]:
        """Return the frames of a whole clip of a motion of ``length`` frames."""
        steps = self.context + self.steps_after(length)
        return tuple(self.first + step * self.stride for step in range(steps))


@dataclass(frozen=True)
class Motion:
    """Scene and motion of one trial.

    Under a predicting protocol ``trajectory`` ends with frame 44 (`source.ObservedSource`).
    """

    scene: Scene
    trajectory: Trajectory


@dataclass(frozen=True, eq=False)
class Batch:
    """Clips of B trials with T frames each; what the `Spec` does not ask for is None.

    Arrays are numpy arrays, or tensors on the device of a model that is a torch ``Module``.

    - ``trials``: names (B). ``frames`` (B, T) int64: frame of the motion that each frame shows.
    - ``valid`` (B, T) bool: whether the motion has that frame. A clip that is longer than its
      trial repeats the last frame.
    - ``rgb`` (B, T, H, W, 3) uint8, sRGB.
    - ``ids`` (B, T, H, W) uint8: 0 scenery and floor, 1 agent, 2 patient, 3 and more the others.
    - ``depth`` (B, T, H, W) float32: metres along the camera's axis; infinite where nothing is.
    - ``boxes`` (B, T, K, 4) float32: left, top, right, bottom of what is visible of object id
      1..K, from 0 to 1 of width and height; NaN for an object that is not seen.
    - ``camera`` (B, 2, 4, 4) float64: view matrix (world to camera) and projection matrix.
    - ``state``: motions (B); they have all frames from 0 on, not only ``frames``.
    - ``features`` (B, T, D) float32: of a frozen encoder, if ``learns_from`` is features.
    - ``contact`` (B,) bool: outcomes, only in the training of a model that ``learns_outcomes``.
    - ``future``: steps that `Model.imagine` is asked for.
    """

    trials: tuple[str, ...]
    frames: Any
    valid: Any
    rgb: Any = None
    ids: Any = None
    depth: Any = None
    boxes: Any = None
    camera: Any = None
    state: tuple[Motion, ...] | None = None
    features: Any = None
    contact: Any = None
    future: int = 0

    def __post_init__(self) -> None:
        clips, steps = len(self.trials), self.frames.shape[-1]
        expected: dict[str, tuple[tuple[int | None, ...], str]] = {
            "frames": ((clips, steps), "int64"),
            "valid": ((clips, steps), "bool"),
            "rgb": ((clips, steps, None, None, 3), "uint8"),
            "ids": ((clips, steps, None, None), "uint8"),
            "depth": ((clips, steps, None, None), "float32"),
            "boxes": ((clips, steps, None, 4), "float32"),
            "camera": ((clips, 2, 4, 4), "float64"),
            "features": ((clips, steps, None), "float32"),
            "contact": ((clips,), "bool"),
        }
        for name, (shape, dtype) in expected.items():
            value = getattr(self, name)
            if value is not None:
                _check_array(name, value, shape, dtype)
        if self.state is not None and len(self.state) != clips:
            raise BadInputError(f"batch: {len(self.state)} motions for {clips} trials")

    def __len__(self) -> int:
        return len(self.trials)

    def arrays(self) -> dict[str, Any]:
        """Return the arrays that are not None, by name."""
        others = ("trials", "state", "future")
        names = [item.name for item in dataclasses.fields(self) if item.name not in others]
        values = {name: getattr(self, name) for name in names}
        return {name: value for name, value in values.items() if value is not None}

    def to(self, device: Any) -> Batch:
        """Return the batch with tensors on ``device``; arrays already there are not copied."""
        import torch

        def move(value: Any) -> Any:
            tensor = torch.from_numpy(value) if isinstance(value, np.ndarray) else value
            return tensor.to(device, non_blocking=True)

        return dataclasses.replace(
            self, **{name: move(value) for name, value in self.arrays().items()}
        )

    def select(self, rows: Sequence[int]) -> Batch:
        """Return the clips with the given row numbers."""
        chosen = list(rows)
        return dataclasses.replace(
            self,
            trials=tuple(self.trials[row] for row in chosen),
            state=None if self.state is None else tuple(self.state[row] for row in chosen),
            **{name: value[chosen] for name, value in self.arrays().items()},
        )

    def steps(self, chosen: slice | NDArray[np.int64]) -> Batch:
        """Return some frames of every clip, by range or number; what has no frames stays whole."""
        whole = ("camera", "contact")
        kept = {
            name: value[:, chosen] for name, value in self.arrays().items() if name not in whole
        }
        return dataclasses.replace(self, **kept)


@dataclass(frozen=True, eq=False)
class Rollout:
    """Imagined futures of B trials, S samples each; what a model does not give is None.

    - ``features`` (B, S, future, D) float32.
    - ``gap`` (B, S): smallest distance of agent and patient in metres; 0 or less is a touch.
    - ``end``, ``closest`` (B, S): their distance at the end of the future, and the smallest, less a
      fixed one at which they count as touching, of models that have such a rule.
    - ``contact`` (B, S) bool: whether they touch, of simulators that report contacts.
    - ``shown``: what the model imagined, for ``physion view``: rgb (B, S, future, H, W, 3) uint8,
      boxes (B, S, future, K, 4), masks (B, S, future, K, H, W) in 0..1, slots (B, S, future, K, D),
      whose K D values are the features, particles (B, S, F, P, 3) float32 in metres with
      ``things`` (B, P) int64, the index of each one's object in `Scene.names`, both NaN and -1
      where a trial has fewer. Rows follow the context at the stride of the `Spec`. Also masks of
      the frames of the context, context_masks (B, T, K, H, W).
    """

    features: Any = None
    gap: Any = None
    contact: Any = None
    end: Any = None
    closest: Any = None
    shown: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of a model, which is written to every row of its predictions.

    ``init`` names the initial weights: ``imagenet``, ``package:<name>``, ``local:<sha256>``,
    ``random``, or ``none`` for a model without weights. ``inputs`` says what the model uses, where
    that is not what its `Spec` asks for: ``base rate`` for one that looks at no trial. The other
    fields are columns of the official result files.
    """

    model: str
    init: str
    encoder_type: str = ""
    dynamics_type: str = ""
    encoder_pretraining_task: str = ""
    encoder_pretraining_dataset: str = ""
    encoder_pretraining_seed: str = ""
    encoder_training_task: str = ""
    dynamics_training_task: str = ""
    versions: str = ""
    inputs: str = ""


def clip_frames(frames: Sequence[int], length: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return which frames of a motion of ``length`` frames a clip shows, and which exist.

    Frames past the end are replaced by the last one.
    """
    wanted = np.asarray(frames, np.int64)
    return np.minimum(wanted, length - 1), wanted < length


def _check_array(name: str, value: Any, shape: tuple[int | None, ...], dtype: str) -> None:
    actual = tuple(value.shape)
    fits = len(actual) == len(shape) and all(
        wanted in (None, found) for wanted, found in zip(shape, actual, strict=True)
    )
    kind = str(value.dtype).removeprefix("torch.")
    if not fits or kind != dtype:
        wanted = tuple("any" if size is None else size for size in shape)
        raise BadInputError(f"batch: {name} must be {dtype} {wanted}, not {kind} {actual}")


# What models saw and imagined of trials, as the viewer shows it.

PICTURES = ("rgb", "boxes", "masks", "slots")
"""Names of the arrays that are shown as pictures, boxes over them, or lines."""
SHOWABLE = ("particles", *PICTURES)
"""Names of the arrays that the viewer shows."""

Arrays = Mapping[str, NDArray[Any]]

_UNKNOWN = float("nan")


def _no_frames() -> NDArray[np.int64]:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class ImaginedTrial:
    """Future of a trial as a model imagined it, and what the model says about the outcome.

    - ``model``: its name. ``weights``: their origin, or that they are untrained.
    - ``frames`` (F,): the frame of the trial that each row of ``shown`` is at, increasing.
    - ``shown``: arrays of one future, by the names of `Rollout`. The viewer shows
      ``particles`` (F, P, 3) in metres, with ``things`` (P,), the index in `Scene.names` of the
      object of each; ``rgb`` (F, H, W, 3) uint8; ``boxes`` (F, K, 4) in 0..1, NaN for none;
      ``masks`` (F, K, h, w) in 0..1; and ``slots`` (F, K, D), values of K slots.
    - ``seen_frames`` (T,), ``seen``: the frames that the model saw, before ``frames``, and what it
      saw or made of them: ``rgb``, ``boxes``, ``masks`` and ``slots``.
    - ``true``: what was to be imagined in ``frames``: ``rgb``, and ``slots`` that the model finds
      in it.
    - ``probability``: P(contact). ``gap``: smallest distance of agent and patient in the future
      that is shown, metres; 0 or less is a contact. NaN for what is unknown.
    - ``futures``: number of imagined futures, of which the first is shown.
    """

    model: str
    weights: str
    frames: NDArray[np.int64]
    shown: Arrays = field(default_factory=dict)
    seen_frames: NDArray[np.int64] = field(default_factory=_no_frames)
    seen: Arrays = field(default_factory=dict)
    true: Arrays = field(default_factory=dict)
    probability: float = _UNKNOWN
    gap: float = _UNKNOWN
    futures: int = 1


Imagine = Callable[[Sequence[str]], Mapping[str, Sequence[ImaginedTrial]]]
"""Function from the names of trials to what models imagined of each, by name."""


# Observed part of a trajectory, for models that receive states instead of images.


def cut_to_observed(scene: Scene, trajectory: Trajectory) -> Trajectory:
    """Return the first `OBSERVED_FRAMES` frames of a trajectory and their contacts.

    Raises `BadInputError` for a shorter trajectory.
    """
    if len(trajectory) < OBSERVED_FRAMES:
        raise BadInputError(
            f"trial {scene.name!r} has {len(trajectory)} frames, fewer than the "
            f"{OBSERVED_FRAMES} observed ones"
        )
    contacts = trajectory.contacts
    observed = contacts.frame < OBSERVED_FRAMES
    return replace(
        trajectory,
        positions=trajectory.positions[:OBSERVED_FRAMES],
        rotations=trajectory.rotations[:OBSERVED_FRAMES],
        velocities=trajectory.velocities[:OBSERVED_FRAMES],
        angular_velocities=trajectory.angular_velocities[:OBSERVED_FRAMES],
        cloth_vertices=trajectory.cloth_vertices[:OBSERVED_FRAMES],
        cloth_distance=trajectory.cloth_distance[:OBSERVED_FRAMES],
        contacts=replace(
            contacts,
            frame=contacts.frame[observed],
            bodies=contacts.bodies[observed],
            point=contacts.point[observed],
            normal=contacts.normal[observed],
            impulse=contacts.impulse[observed],
        ),
        completed=False,
    )
