"""What a model saw and imagined of a trial, packed for the viewer: particles, pictures, slots."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from physion.clips.batch import PICTURES, SHOWABLE, Arrays, ImaginedTrial
from physion.core.errors import BadInputError
from physion.report.viewer.movies import AGENT, OTHERS, PATIENT
from physion.scenes.scene import OBSERVED_FRAMES, Scene
from physion.trials.share.gltf import evenly, role_of


def caption(imagined: ImaginedTrial, *, observed: bool = False) -> str:
    """Return model, weights, P(contact) and smallest gap as text.

    ``observed``: agent and patient touched in the observed part, so that the gap says nothing.
    """
    facts = []
    several = imagined.futures > 1
    if math.isfinite(imagined.probability):
        source = f" from {imagined.futures} futures" if several else ""
        facts.append(f"P(contact) {imagined.probability:.2f}{source}")
    if observed:
        facts.append("the contact was already observed")
    elif math.isfinite(imagined.gap):
        which = " of the one shown" if several else ""
        facts.append(
            f"smallest gap{which} {round(imagined.gap, 3) + 0.0:.3f} m, 0 or less is a contact"
        )
    text = f"{imagined.model} ({imagined.weights})"
    return f"{text}: {'; '.join(facts)}." if facts else f"{text}."


# --- particles: positions next to the true motion, in few bytes ---------------------------------

PARTICLES = 1500
"""Largest number of particles of a trial in the page."""
PARTICLE_BYTES = 700_000
"""Largest size of their positions before base64, which adds a third."""
REACH = 50.0
"""Metres from the origin beyond which particles are not followed: models may lose objects."""


STEPS = 65535
"""Steps of the grid on which coordinates are stored: a thirtieth of a millimetre over 2 m."""


def pack_grid(values: NDArray[np.floating]) -> dict[str, Any]:
    """Quantise points (..., 3) to a grid of `STEPS` over their bounds: ``low``, ``size`` and
    ``data``.
    """
    points = np.nan_to_num(np.asarray(values, np.float64)).reshape(-1, 3)
    low = points.min(axis=0) if len(points) else np.zeros(3)
    size = np.ptp(points, axis=0) if len(points) else np.zeros(3)
    steps = np.rint((points - low) / np.where(size > 0, size, 1.0) * STEPS)
    return {
        "low": [float(v) for v in low],
        "size": [float(v) for v in size],
        "data": base64.b64encode(steps.astype("<u2").tobytes()).decode("ascii"),
    }


def pack_particles(imagined: ImaginedTrial, scene: Scene, length: int) -> dict[str, Any]:
    """Return positions on a grid, their frames, and where each object's particles are.

    Kinematic bodies are left out unless they are agent or patient: they do not move. So are rows
    from the first that is not finite on, particles above `PARTICLES` and rows above
    `PARTICLE_BYTES`, both evenly.
    """
    positions, things = _checked_particles(imagined, scene)
    names = scene.names()
    fixed = {body.name for body in scene.bodies if body.kinematic}
    kept = [
        row
        for row, thing in enumerate(things.tolist())
        if thing >= 0 and (names[thing] not in fixed or role_of(scene, names[thing]))
    ]
    kept = sorted(kept, key=lambda row: int(things[row]))
    columns = np.array(kept, np.int64)[evenly(len(kept), PARTICLES)]
    finite = np.isfinite(positions[:, columns]).all(axis=(1, 2))
    count = len(finite) if finite.all() else int(np.argmin(finite))
    # One row may lie past the end, so that the last frames are between two.
    count = min(count, int(np.searchsorted(imagined.frames, length - 1)) + 1)
    if not len(columns) or not count:
        raise BadInputError(
            f"model {imagined.model!r} imagined no particle with a finite position of trial "
            f"{scene.name!r}"
        )
    rows = np.arange(count)[evenly(count, max(2, PARTICLE_BYTES // (6 * len(columns))))]
    points = np.clip(positions[np.ix_(rows, columns)].astype(np.float64), -REACH, REACH)
    return {
        "from": OBSERVED_FRAMES,
        "frames": [int(frame) for frame in imagined.frames[rows]],
        "points": pack_grid(points),
        "groups": _groups(things[columns], scene),
    }


def _checked_particles(
    imagined: ImaginedTrial, scene: Scene
) -> tuple[NDArray[np.floating], NDArray[np.integer]]:
    """Return particles (F, P, 3) and things (P,); raise `BadInputError` for other shapes."""
    positions = np.asarray(imagined.shown["particles"])
    things = np.asarray(imagined.shown.get("things", np.zeros(0, np.int64)))
    wanted = (len(imagined.frames), len(things), 3)
    if positions.shape != wanted or (len(things) and things.max() >= len(scene.names())):
        raise BadInputError(
            f"model {imagined.model!r}, trial {scene.name!r}: particles must be (frames, "
            f"particles, 3), here {wanted}, not {positions.shape}, and things objects of the scene"
        )
    return positions, things


def _groups(things: NDArray[np.integer], scene: Scene) -> list[dict[str, Any]]:
    """Return role, first row and number of the particles of each object; ``things`` is sorted."""
    names = scene.names()
    values, first, counts = np.unique(things, return_index=True, return_counts=True)
    return [
        {"role": role_of(scene, names[thing]), "first": int(start), "count": int(count)}
        for thing, start, count in zip(values.tolist(), first, counts, strict=True)
    ]


# --- pictures that a model saw and imagined, with the true ones, in few bytes -------------------
#
# Pictures of one kind lie in a sheet, one WebP image. Rows are frames: first those that the model
# saw, then those that it imagined.

ROWS = 48
"""Largest number of frames of a model in the page; others are left out evenly."""
SIDE = 128
"""Largest side of a picture in pixels."""
SLOTS = 12
"""Largest number of slots; later ones are left out."""
SLOT_SIDE = 64
"""Largest side of the picture of a slot in pixels."""
QUALITIES = (85, 50, 20, 1)
"""Quality settings of WebP, up to 100: the first by which a sheet is small enough, or the last."""
SHEET_BYTES = 225_000
"""Size of a sheet above which a lower quality is taken, before base64, which adds a third."""

_SHAPES = {
    "rgb": "(frames, height, width, 3) uint8",
    "boxes": "(frames, objects, 4)",
    "masks": "(frames, slots, height, width)",
    "slots": "(frames, slots, values)",
}
_AXES = {"rgb": 4, "boxes": 3, "masks": 4, "slots": 3}
_GREY, _TINT = 0.4, 0.75
"""Brightness of the grey picture behind a mask, and weight of the slot's colour on it."""


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows that the page shows: of the frames that were seen, and of the imagined ones."""

    seen: NDArray[np.int64]
    later: NDArray[np.int64]

    def of(self, seen: Any, later: Any) -> list[NDArray[Any]]:
        """Return the shown rows of two arrays, of which either may be None."""
        parts = ((seen, self.seen), (later, self.later))
        return [values[rows] for values, rows in parts if values is not None and len(rows)]


def pack_pictures(imagined: ImaginedTrial, trial: str, length: int) -> dict[str, Any]:
    """Return pictures, boxes and slots of an imagined trial, for the page's script.

    Parameters
    ----------
    imagined
        The imagined trial.
    trial
        Its name, for messages.
    length
        Frames of the true trial; later ones are left out.

    Returns
    -------
    dict
        ``frames`` of all rows, of which the first ``seen`` were seen; the sheets ``true``,
        ``imagined`` and ``masks``; ``boxes``, four numbers or null for each row and object;
        ``changes`` of the slots, ``imagined`` and ``true``; ``colors`` of boxes and of slots.

    Raises
    ------
    BadInputError
        If an array has another shape than it must have, or no row lies within the trial.
    """
    where = f"model {imagined.model!r}, trial {trial!r}"
    seen = _checked(imagined.seen, len(imagined.seen_frames), where)
    shown = _checked(imagined.shown, len(imagined.frames), where)
    true = _checked(imagined.true, len(imagined.frames), where)
    frames = np.concatenate([imagined.seen_frames, imagined.frames])
    kept = np.flatnonzero(frames < length)
    kept = kept[evenly(len(kept), ROWS)]
    first = len(imagined.seen_frames)
    rows = _Rows(kept[kept < first], kept[kept >= first] - first)
    if not len(rows.later):
        raise BadInputError(f"{where}: no imagined frame lies within the {length} of the trial")
    record: dict[str, Any] = {
        "frames": [int(frame) for frame in frames[kept]],
        "seen": len(rows.seen),
        "colors": {
            "boxes": [_css(color) for color in (AGENT, PATIENT, *OTHERS)],
            "slots": [_css(color) for color in _slot_colors()],
        },
    }
    if "rgb" in seen or "rgb" in true:
        pictures = rows.of(seen.get("rgb"), true.get("rgb"))
        record["true"] = _sheet(pictures, 0 if "rgb" in seen else len(rows.seen))
    if "rgb" in shown:
        record["imagined"] = _sheet(rows.of(None, shown["rgb"]), len(rows.seen))
    if "boxes" in shown:
        record["boxes"] = _boxes(rows, seen.get("boxes"), shown["boxes"])
    if "masks" in seen or "masks" in shown:
        record["masks"] = _mask_sheet(rows, seen, shown)
    if "slots" in shown:
        record["changes"] = _changes(rows, seen, shown, true, where)
    return record


def _checked(arrays: Arrays, count: int, where: str) -> dict[str, NDArray[Any]]:
    """Return the arrays named in ``PICTURES``, each of ``count`` rows; raise for other shapes."""
    found = {name: np.asarray(arrays[name]) for name in PICTURES if name in arrays}
    for name, values in found.items():
        fits = values.ndim == _AXES[name] and len(values) == count and values.size
        if name == "rgb":
            fits = fits and values.shape[-1] == 3 and values.dtype == np.uint8
        if name == "boxes":
            fits = fits and values.shape[-1] == 4
        if not fits:
            raise BadInputError(
                f"{where}: {name} must be {_SHAPES[name]} of {count} frames, not {values.dtype} "
                f"{values.shape}"
            )
    return found


def _sheet(parts: Sequence[NDArray[np.uint8]], first: int, each: int = 1) -> dict[str, Any]:
    """Return pictures (n, H, W, 3) as one image; all are scaled to the size of the first.

    ``first`` is the row of the first picture; there are ``each`` pictures in a row.
    """
    height, width = _fitted(parts[0].shape[1], parts[0].shape[2], SIDE)
    pictures = [_scaled(picture, height, width) for part in parts for picture in part]
    columns = math.ceil(math.sqrt(len(pictures)))
    lines = math.ceil(len(pictures) / columns)
    sheet = np.zeros((lines * height, columns * width, 3), np.uint8)
    for place, picture in enumerate(pictures):
        top, left = place // columns * height, place % columns * width
        sheet[top : top + height, left : left + width] = picture
    return {
        "data": base64.b64encode(_webp(sheet)).decode("ascii"),
        "width": width,
        "height": height,
        "columns": columns,
        "first": first,
        "rows": len(pictures) // each,
        "each": each,
    }


def _webp(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture in the best of the `QUALITIES` that takes at most `SHEET_BYTES`."""
    image, data = Image.fromarray(picture), b""
    for quality in QUALITIES:
        stream = io.BytesIO()
        image.save(stream, "WEBP", quality=quality, method=4, use_sharp_yuv=True)
        data = stream.getvalue()
        if len(data) <= SHEET_BYTES:
            break
    return data


def _mask_sheet(
    rows: _Rows, seen: dict[str, NDArray[Any]], shown: dict[str, NDArray[Any]]
) -> dict[str, Any]:
    """Return a picture for each row and slot: where its mask is, the slot's colour over grey."""
    painted = []
    for arrays, chosen in ((seen, rows.seen), (shown, rows.later)):
        if "masks" not in arrays or not len(chosen):
            continue
        masks = np.clip(np.nan_to_num(arrays["masks"][chosen, :SLOTS].astype(np.float64)), 0, 1)
        pictures = arrays["rgb"][chosen] if "rgb" in arrays else None
        for row, of_row in enumerate(masks):
            painted.append(_painted(of_row, None if pictures is None else pictures[row]))
    first = 0 if "masks" in seen else len(rows.seen)
    return _sheet(painted, first, each=len(painted[0]))


def _painted(masks: NDArray[np.floating], picture: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """Return masks (K, h, w) in 0..1 as pictures (K, H, W, 3) of the size of ``picture``."""
    size = masks.shape[1:] if picture is None else picture.shape[:2]
    height, width = _fitted(size[0], size[1], SLOT_SIDE)
    grey = np.full((height, width), 255.0)
    if picture is not None:
        grey = _scaled(picture, height, width).mean(axis=2)
    grey = _GREY * grey
    bytes_of = np.rint(masks * 255).astype(np.uint8)
    weights = _TINT * np.stack([_scaled(mask, height, width) for mask in bytes_of]) / 255
    colors = np.array(_slot_colors()[: len(masks)], np.float64)[:, None, None]
    mixed = (1 - weights[..., None]) * grey[None, ..., None] + weights[..., None] * colors
    return np.asarray(np.rint(mixed), np.uint8)


def _boxes(
    rows: _Rows, seen: NDArray[Any] | None, shown: NDArray[Any]
) -> list[list[list[float] | None] | None]:
    """Return left, top, right, bottom of each row and object; null for an object without a box."""
    packed: list[list[list[float] | None] | None] = [None] * (len(rows.seen) if seen is None else 0)
    for values in rows.of(seen, shown):
        # Beyond the picture a box says no more than that it is there.
        whole = np.round(np.clip(values.astype(np.float64), -1, 2), 4).tolist()
        packed += [[box if np.isfinite(box).all() else None for box in row] for row in whole]
    return packed


def _changes(
    rows: _Rows,
    seen: dict[str, NDArray[Any]],
    shown: dict[str, NDArray[Any]],
    true: dict[str, NDArray[Any]],
    where: str,
) -> dict[str, Any]:
    """Return how far each slot is from where it was in the last frame that was seen, by row.

    Without seen slots, it is the distance from the first imagined row.
    """
    found = [arrays["slots"] for arrays in (seen, shown, true) if "slots" in arrays]
    if len({values.shape[1:] for values in found}) > 1:
        shapes = ", ".join(str(values.shape) for values in found)
        raise BadInputError(f"{where}: slots differ in number or size: {shapes}")
    before = seen.get("slots")
    start = shown["slots"][0] if before is None else before[-1]

    def change(later: NDArray[Any] | None) -> list[list[float] | None]:
        packed: list[list[float] | None] = []
        for values, chosen in ((before, rows.seen), (later, rows.later)):
            if values is None:
                packed += [None] * len(chosen)
                continue
            moved = values[chosen, :SLOTS].astype(np.float64) - start[:SLOTS]
            packed += np.round(np.nan_to_num(np.linalg.norm(moved, axis=2)), 4).tolist()
        return packed

    return {"imagined": change(shown["slots"]), "true": change(true.get("slots"))}


def _slot_colors() -> list[tuple[int, int, int]]:
    """Return the colours of the slots, which are not colours of roles."""
    return [OTHERS[slot % len(OTHERS)] for slot in range(SLOTS)]


def _css(color: tuple[int, int, int]) -> str:
    return f"rgb({', '.join(str(value) for value in color)})"


def _fitted(height: int, width: int, side: int) -> tuple[int, int]:
    """Return the size with the longer side ``side`` at most."""
    factor = min(1.0, side / max(height, width))
    return max(1, round(height * factor)), max(1, round(width * factor))


def _scaled(picture: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    if picture.shape[:2] == (height, width):
        return picture
    image = Image.fromarray(picture).resize((width, height), Image.Resampling.BILINEAR)
    return np.asarray(image)


# --- the record of a trial ----------------------------------------------------------------------


def pack_imagined(
    imagined: ImaginedTrial, scene: Scene, length: int, *, observed: bool = False
) -> dict[str, Any]:
    """Return what the page shows of an imagined trial.

    Parameters
    ----------
    imagined
        The imagined trial.
    scene
        The scene of the trial.
    length
        Frames of the true trial; the page shows no later ones.
    observed
        Whether agent and patient touched in the observed part.

    Raises
    ------
    BadInputError
        If an array has another shape than it must have, or nothing can be shown.
    """
    if not any(name in imagined.shown for name in SHOWABLE):
        raise BadInputError(
            f"model {imagined.model!r} imagined nothing that the viewer shows of trial "
            f"{scene.name!r}: it shows {', '.join(SHOWABLE)}"
        )
    record: dict[str, Any] = {
        "model": imagined.model,
        "caption": caption(imagined, observed=observed),
    }
    if "particles" in imagined.shown:
        record["particles"] = pack_particles(imagined, scene, length)
    if any(name in imagined.shown for name in PICTURES):
        record["pictures"] = pack_pictures(imagined, scene.name, length)
    return record
