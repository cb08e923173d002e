"""Clips rendered on demand from motions: no file is read or written, and no movie encoded.

Boxes are small (13 MB for 100,000 frames of 8 objects), but ids of pixels have to be rendered for
them. They are kept by trial and frame. Most of the time goes into the preparation of a scene, so
that a trial that is read a second time is rendered as a whole: later windows of it need no
rendering for their boxes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import (
    AGENT_ID,
    FIRST_OTHER_ID,
    PATIENT_ID,
    SCENERY_ID,
    Motion,
)
from physion.clips.states import digest_in
from physion.core.errors import BadInputError
from physion.core.version import version_digest
from physion.rendering.camera import projection_matrix, view_matrix
from physion.rendering.renderer import PASSES, VERSION, Renderer
from physion.scenes.looks import in_look
from physion.scenes.scene import Scene

_PASS = {"rgb": "color", "ids": "ids", "depth": "depth"}
"""Pass of the renderer by input of a `Spec`; boxes come from the ids."""
_MOST_OBJECTS = 255
"""Largest id of an object in ``Batch.ids``."""


class MotionRenderer:
    """Reader of what the camera sees, rendered from motions.

    - ``motions``: scene, in its free colours, and motion by trial.
    - ``inputs``: which of `PIXELS` are rendered.
    - ``size``: pixels per side.
    - ``objects``: rows of ``boxes``.
    - ``looks``: colours by trial, ``redyellow`` or ``free``.
    """

    def __init__(
        self,
        motions: Mapping[str, Motion],
        inputs: Sequence[str],
        size: int,
        objects: int,
        looks: Mapping[str, str],
    ) -> None:
        self._motions, self._inputs = motions, tuple(inputs)
        self._size, self._objects, self._looks = size, objects, looks
        self._passes = tuple(_PASS[name] for name in inputs if name in _PASS)
        self._kept: dict[str, tuple[NDArray[np.float32], NDArray[np.bool_]]] = {}

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
        """Return boxes (T, K, 4) of frames (T,), which increase; those not kept are rendered.

        Threads may render the same frames at once, with the same result.
        """
        boxes_of, known = self._kept.get(trial, (None, None))
        if boxes_of is None or known is None:
            wanted = frames
            boxes_of = np.full((len(motion.trajectory), self._objects, 4), np.nan, np.float32)
            known = np.zeros(len(boxes_of), np.bool_)
        else:
            wanted = np.zeros(0, np.int64) if known[frames].all() else np.flatnonzero(~known)
        if len(wanted):
            drawn = self._draw(trial, motion, wanted, ("ids",))["ids"]
            boxes_of[wanted] = boxes(drawn, self._objects)
            known[wanted] = True
            self._kept.setdefault(trial, (boxes_of, known))
        return boxes_of[frames]

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the boxes: another process renders its own."""
        return {**vars(self), "_kept": {}}

    def identity(self, trial: str) -> str:
        """Return look, version of the renderer, and digest of scene and motion."""
        version = f"{VERSION}.{version_digest(*PASSES)}"
        return f"rendered {self._looks[trial]} {version} {digest_in(self._motions, trial)}"


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
