"""Clips rendered on demand from motions: no file is read or written, and no movie encoded.

Boxes are small, but ids of pixels have to be rendered for them. They are kept by trial and frame.
Most of the time goes into the preparation of a scene, so that a trial that is read a second time is
rendered as a whole: later windows of it need no rendering for their boxes.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import (
    AGENT_ID,
    FIRST_OTHER_ID,
    LAST_OBSERVED,
    PATIENT_ID,
    PIXELS,
    SCENERY_ID,
    Batch,
    Motion,
    Spec,
)
from physion.clips.source import FutureFrameError, ObservedBatches, TrialReaders, WholeBatches
from physion.clips.states import CutMotions, cut_motion, motion_digest
from physion.core.errors import BadInputError
from physion.core.version import version_digest
from physion.rendering.camera import projection_matrix, view_matrix
from physion.rendering.renderer import PASSES, VERSION, Renderer
from physion.scenes.looks import in_look
from physion.scenes.scene import Scene

# Boxes of objects that were rendered before, kept in memory by trial and frame.

MOST_BYTES = 2**28
"""Bytes that the boxes of one reader take at most: those of 100,000 frames are 13 MB at 8 objects
of 16 bytes."""


@dataclass(frozen=True, eq=False)
class BoxesOfTrial:
    """Boxes (F, K, 4) of the frames of a trial, and which of them are known (F,)."""

    boxes: NDArray[np.float32]
    known: NDArray[np.bool_]

    @classmethod
    def unknown(cls, frames: int, objects: int) -> BoxesOfTrial:
        """Return those of a trial of which nothing is known yet."""
        shape = (frames, objects, 4)
        return cls(np.full(shape, np.nan, np.float32), np.zeros(frames, np.bool_))

    @property
    def bytes(self) -> int:
        """Size in memory."""
        return self.boxes.nbytes + self.known.nbytes


class KeptBoxes:
    """Boxes of trials; the trials that were used longest ago are forgotten first.

    Threads may share it. Another process that receives it starts with an empty one.

    Parameters
    ----------
    objects
        Rows K of the boxes of a frame.
    most_bytes
        Largest size in memory; 0 keeps nothing.
    """

    def __init__(self, objects: int, most_bytes: int = MOST_BYTES) -> None:
        self._objects, self._most_bytes = objects, most_bytes
        self._trials: OrderedDict[str, BoxesOfTrial] = OrderedDict()
        self._bytes, self._lock = 0, threading.Lock()

    @property
    def bytes(self) -> int:
        """Size in memory of what is kept."""
        return self._bytes

    def get(
        self, trial: str, frames: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the boxes (T, K, 4) of frames (T,), and which are known (T,); copies."""
        with self._lock:
            kept = self._trials.get(trial)
            if kept is None:
                kept = BoxesOfTrial.unknown(len(frames), self._objects)
                return kept.boxes, kept.known
            self._trials.move_to_end(trial)
            return kept.boxes[frames], kept.known[frames]

    def missing(self, trial: str) -> NDArray[np.int64]:
        """Return the frames of a trial whose boxes are not known; none if it is not kept at all."""
        with self._lock:
            kept = self._trials.get(trial)
            return np.zeros(0, np.int64) if kept is None else np.flatnonzero(~kept.known)

    def add(
        self, trial: str, length: int, frames: NDArray[np.int64], boxes: NDArray[np.float32]
    ) -> None:
        """Keep the boxes (T, K, 4) of frames (T,) of a trial with ``length`` frames."""
        with self._lock:
            kept = self._trials.get(trial)
            if kept is None:
                kept = BoxesOfTrial.unknown(length, self._objects)
                self._trials[trial] = kept
                self._bytes += kept.bytes
            kept.boxes[frames], kept.known[frames] = boxes, True
            while self._bytes > self._most_bytes:
                self._bytes -= self._trials.popitem(last=False)[1].bytes

    def __reduce__(self) -> tuple[Any, ...]:
        # A lock cannot be sent to another process.
        return KeptBoxes, (self._objects, self._most_bytes)


_PASS = {"rgb": "color", "ids": "ids", "depth": "depth"}
"""Pass of the renderer by input of a `Spec`; boxes are those of the ids."""
_MOST_OBJECTS = 255
"""Largest id of an object in ``Batch.ids``."""


class MotionRenderer:
    """Reader of what the camera sees, rendered from motions.

    Parameters
    ----------
    motions
        Scene, in its free colours, and motion by trial.
    inputs
        Which of `PIXELS` are rendered.
    size
        Pixels per side.
    objects
        Rows of ``boxes``.
    looks
        Colours by trial, ``redyellow`` or ``free``.
    kept_bytes
        Memory for boxes that were read before, at most; 0 keeps none.
    """

    def __init__(
        self,
        motions: Mapping[str, Motion],
        inputs: Sequence[str],
        size: int,
        objects: int,
        looks: Mapping[str, str],
        kept_bytes: int = MOST_BYTES,
    ) -> None:
        self._motions, self._inputs = motions, tuple(inputs)
        self._size, self._objects, self._looks = size, objects, looks
        self._passes = tuple(_PASS[name] for name in inputs if name in _PASS)
        self._kept_boxes = KeptBoxes(objects, kept_bytes)
        self._digests: dict[str, str] = {}

    def read(self, trial: str, frames: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Return the inputs of the clip that shows ``frames``."""
        motion = self._motions[trial]
        scene, size = motion.scene, self._size
        seen = self._passes or "boxes" in self._inputs
        arrays = self._render(trial, motion, frames) if seen else {}
        if "camera" in self._inputs:
            projection = projection_matrix(scene.camera, size, size)
            arrays["camera"] = np.stack([view_matrix(scene.camera), projection])
        return {name: arrays[name] for name in self._inputs}

    def _render(
        self, trial: str, motion: Motion, frames: NDArray[np.int64]
    ) -> dict[str, NDArray[Any]]:
        chosen, rows = np.unique(frames, return_inverse=True)
        if not np.isfinite(motion.trajectory.positions[chosen]).all():
            raise BadInputError(
                f"trial {trial!r} was imported without motion ({motion.trajectory.engine}): it "
                "cannot be rendered, only its movies can be read"
            )
        drawn = self._draw(trial, motion, chosen, self._passes) if self._passes else {}
        arrays = {name: drawn[_PASS[name]] for name in self._inputs if name in _PASS}
        if "boxes" in self._inputs:
            known = "ids" in arrays
            arrays["boxes"] = (
                boxes(arrays["ids"], self._objects) if known else self._boxes(trial, motion, chosen)
            )
        return {name: values[rows] for name, values in arrays.items()}

    def _draw(
        self, trial: str, motion: Motion, frames: NDArray[np.int64], passes: Sequence[str]
    ) -> dict[str, NDArray[Any]]:
        """Return passes of frames by name, the ids as in ``Batch.ids``."""
        scene = in_look(motion.scene, self._looks[trial])
        renderer = Renderer(scene, motion.trajectory, self._size, self._size)
        shown = [renderer.render(int(frame), passes) for frame in frames]
        drawn = {name: np.stack([getattr(frame, name) for frame in shown]) for name in passes}
        if "ids" in drawn:
            drawn["ids"] = object_ids(scene)[drawn["ids"]]
        return drawn

    def _boxes(self, trial: str, motion: Motion, frames: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return boxes (T, K, 4) of frames (T,), which increase; those not kept are rendered."""
        found, known = self._kept_boxes.get(trial, frames)
        if known.all():
            return found
        wanted = np.union1d(frames[~known], self._kept_boxes.missing(trial))
        new = boxes(self._draw(trial, motion, wanted, ("ids",))["ids"], self._objects)
        self._kept_boxes.add(trial, len(motion.trajectory), wanted, new)
        found[~known] = new[np.searchsorted(wanted, frames[~known])]
        return found

    def identity(self, trial: str) -> str:
        """Return look, version of the renderer, and digest of scene and motion."""
        if trial not in self._digests:
            self._digests[trial] = motion_digest(self._motions[trial])
        version = f"{VERSION}.{version_digest(*PASSES)}"
        return f"rendered {self._looks[trial]} {version} {self._digests[trial]}"


class RenderedSource(WholeBatches):
    """Source over motions in memory.

    Parameters
    ----------
    motions
        Scene, in its free colours, and motion by trial.
    spec
        What the batches hold.
    look
        Colours: ``redyellow`` or ``free``.
    observed
        Cut all motions at the last observed frame. Then `later`, `whole` and `window` raise
        `FutureFrameError` unless all their frames are observed.
    """

    def __init__(
        self,
        motions: Mapping[str, Motion],
        spec: Spec,
        *,
        look: str = "redyellow",
        observed: bool,
    ) -> None:
        kept = {name: cut_motion(motion) for name, motion in motions.items()} if observed else None
        context = ObservedBatches(spec, _readers(kept or CutMotions(motions), spec, look))
        super().__init__(context, _readers(kept or motions, spec, look))
        self._last = LAST_OBSERVED if observed else None

    def _read(self, trials: Sequence[str], frames: Sequence[Sequence[int]]) -> Batch:
        for trial, wanted in zip(trials, frames, strict=True):
            if self._last is not None and max(wanted) > self._last:
                raise FutureFrameError(
                    f"trial {trial!r}: frame {max(wanted)} comes after the observed part, whose "
                    f"last frame is {self._last}"
                )
        return super()._read(trials, frames)


def _readers(motions: Mapping[str, Motion], spec: Spec, look: str) -> TrialReaders:
    """Return readers of all that ``spec`` asks for."""
    inputs = [name for name in spec.inputs if name in PIXELS]
    lengths = {name: len(motion.trajectory) for name, motion in motions.items()}
    looks = dict.fromkeys(motions, look)
    reader = MotionRenderer(motions, inputs, spec.image_size, spec.objects, looks)
    return TrialReaders(
        lengths, [reader] if inputs else [], motions if "state" in spec.inputs else None
    )


def object_ids(scene: Scene) -> NDArray[np.uint8]:
    """Return the value of ``Batch.ids`` for each value of ``Frame.ids``: (1 + objects,).

    The room and scenery are 0, the agent 1, the patient 2, and the others 3 and more in the order
    of `Scene.names`. Raises `BadInputError` for a scene with more objects than fit.
    """
    names = scene.names()
    scenery = {body.name for body in scene.bodies if body.scenery}
    roles = {scene.roles.agent: AGENT_ID, scene.roles.patient: PATIENT_ID}
    others = [name for name in names if name not in scenery and name not in roles]
    numbers = {name: FIRST_OTHER_ID + index for index, name in enumerate(others)} | roles
    if max(numbers.values()) > _MOST_OBJECTS:
        raise BadInputError(
            f"scene {scene.name!r} has {len(numbers)} objects; ids of pixels hold at most "
            f"{_MOST_OBJECTS}"
        )
    return np.array([SCENERY_ID, *(numbers.get(name, SCENERY_ID) for name in names)], np.uint8)


def boxes(ids: NDArray[np.uint8], objects: int) -> NDArray[np.float32]:
    """Return left, top, right and bottom (T, objects, 4) of the pixels of the objects 1, 2, ...

    Parameters
    ----------
    ids
        (T, H, W) as ``Batch.ids``.
    objects
        Number of rows.

    Returns
    -------
    boxes
        In 0..1 of width and height: the left edge of the first pixel and the right edge of the
        last; NaN for an object that is not seen.
    """
    frames, height, width = ids.shape
    out = np.full((frames, objects, 4), np.nan, np.float32)
    for number in np.unique(ids):
        if not SCENERY_ID < number <= objects:
            continue
        mask = ids == number
        seen = mask.any(axis=(1, 2))
        columns, rows = mask[seen].any(axis=1), mask[seen].any(axis=2)
        edges = (
            columns.argmax(1) / width,
            rows.argmax(1) / height,
            1.0 - columns[:, ::-1].argmax(1) / width,
            1.0 - rows[:, ::-1].argmax(1) / height,
        )
        out[seen, number - 1] = np.stack(edges, axis=1)
    return out
