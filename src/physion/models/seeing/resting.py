"""The first frame as a scene at rest: every object stands on the floor or on another one.

Depth with an error of 2 % is wrong by 8 cm at 4 m, but what stands on the floor is where its mask
says. From the bottom up, every object is fitted by itself, and then again on each thing that it may
stand on: the floor, or the top of what is below its middle. It stays where it was, in the air, if
nothing that it may stand on explains it nearly as well, and also inside a vessel and on a ramp,
where the height at which it rests is not known. Where a height is expected (`expected`), it stands
only on what is near that.

Targets are flat in our presets and lie on the floor: a patient is a plate or a ring there unless
something else explains it much better.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import PATIENT_ID, SCENERY_ID
from physion.models.seeing.masks import (
    Expected,
    MaskFit,
    drawn_nearer,
    find_plate,
    find_shape,
    standing,
)
from physion.models.seeing.pixels import LEAST_PIXELS, Rays, SeenFrame
from physion.models.seeing.scenes import CLEAR_PIXELS, RAMP, VESSELS
from physion.models.seeing.solids import Placed

F64 = NDArray[np.float64]

RAYS = 360
"""Rays of an object."""
HIGHER, LOWER = 0.35, 1.0
"""Metres by which a fit by itself may be below what it stands on, or above, if that part is hidden:
of a cylinder, which may be a pole among rings; others `HIGHER`."""
THIN = 0.12
"""Height in metres of things in which nothing can be, so that what is above them stands on them."""
WORSE, MARGIN = 1.5, 12.0
"""Factor and summand of the sum of squares up to which an object is taken to stand on something."""
NOT_ABOVE = 50.0
"""Sum of squares that is added if it is then no longer above it."""
NOT_FLAT = 0.05
"""Expected height in metres above which a patient is no plate."""
POOR_PLATE, UNEXPECTED = 0.1, 2.0
"""Costs of a plate above which a patient may be something else, also something unexpected."""


@dataclass(frozen=True, eq=False)
class UncertainFrame:
    """A frame whose depth has a relative error.

    - ``seen``: ids, depth and rays. ``far`` (H, W): depth up to which rays are surely free of what
      is not seen there: the floor is known exactly, everything else less three errors.
    - ``before`` (H, W): scenery that stands before the floor and may hide objects.
    """

    seen: SeenFrame
    far: F64
    before: NDArray[np.bool_]

    def rays(self, number: int, count: int = RAYS) -> Rays | None:
        """Return about ``count`` rays for an object; None if it is not seen."""
        depth = np.where(self.seen.ids == number, self.seen.depth, self.far)
        return replace(self.seen, depth=depth).rays(number, count)


def uncertain_frame(seen: SeenFrame, error: float) -> UncertainFrame:
    """Return a frame as one whose depth has a relative error."""
    down = seen.vectors[..., 2]
    with np.errstate(divide="ignore"):
        floor = np.where(down < -1e-6, -seen.origin[2] / down, np.inf)
    scenery = seen.ids == SCENERY_ID
    on_floor = scenery & (seen.depth > floor * (1 - 4 * error))
    far = np.where(on_floor, floor, seen.depth * (1 - 3 * error) - 0.02)
    return UncertainFrame(seen, far, scenery & ~on_floor)


@dataclass(eq=False)
class Resting:
    """One object as it was found.

    ``number`` as in ``Batch.ids``; ``frame`` in which it was fitted; ``support``: number of what it
    stands on, None for the floor and for what stands on nothing that is known.
    """

    number: int
    frame: int
    rays: Rays
    fit: MaskFit
    support: int | None = None

    @property
    def placed(self) -> Placed:
        """The solid."""
        return self.fit.placed

    @cached_property
    def spread(self) -> F64:
        """`MaskFit.spread` of the fit."""
        return self.fit.spread()


def resting_scene(
    pictures: Mapping[int, UncertainFrame],
    numbers: Sequence[int],
    error: float,
    expected: Mapping[int, Expected],
) -> dict[int, Resting]:
    """Return the objects by number, those below before those above.

    Parameters
    ----------
    pictures
        By frame.
    numbers
        Of the objects.
    error
        Relative error of depth.
    expected
        What is expected of the objects in the first frame, by number.
    """
    first = min(pictures)
    alone = []
    for number in numbers:
        pixels = {f: int(np.count_nonzero(p.seen.ids == number)) for f, p in pictures.items()}
        clear = [f for f in sorted(pictures) if pixels[f] >= CLEAR_PIXELS]
        frame = clear[0] if clear else max(pixels, key=lambda f: pixels[f])
        rays = pictures[frame].rays(number) if pixels[frame] >= LEAST_PIXELS else None
        if rays is None:
            continue
        told = expected.get(number)
        if told is not None and frame != first:
            told = told.in_another_frame()
        alone.append(Resting(number, frame, rays, _alone(number, rays, error, told)))
    alone.sort(key=lambda one: (not _plate(one), one.placed.extent_z()[0]))
    found: list[Resting] = []
    for one in alone:
        if not _plate(one) and (one.frame == first or one.fit.upright):
            _stand(one, found, error)
        found.append(one)
    return {one.number: one for one in found}


def _alone(number: int, rays: Rays, error: float, expected: Expected | None) -> MaskFit:
    """Return the fit of an object by itself."""
    tall = expected is not None and expected.height[0] > math.log(NOT_FLAT)
    if number != PATIENT_ID or tall:
        return find_shape(rays, error, expected=expected)
    plate = find_plate(rays, error, expected)
    if plate.placed.cost < POOR_PLATE:
        return plate
    if plate.placed.cost > UNEXPECTED:
        expected = None  # Patients of the trials that trained the network are flat.
    other = find_shape(rays, error, expected=expected)
    return other if other.placed.cost < plate.placed.cost / 2 else plate


def _plate(one: Resting) -> bool:
    return one.fit.sizes == "flat"


def _stand(one: Resting, others: Sequence[Resting], error: float) -> None:
    """Fit an object again on what explains it best, if anything does nearly as well."""
    placed, expected = one.placed, one.fit.expected
    low, middle = placed.extent_z()[0], float(placed.middle()[2])
    below = [
        other
        for other in others
        if above(placed, other.placed)
        and (other.placed.extent_z()[1] < middle + 0.05 * _same_rings(placed, other.placed))
        and _carries(other, placed)
    ]
    held = [
        other
        for other in others
        if not _plate(other)
        and above(placed, other.placed)
        and (
            other.placed.solid.name.startswith(RAMP)
            or (
                other.placed.solid.name in VESSELS
                and not _same_rings(placed, other.placed)
                and middle < other.placed.extent_z()[1] + 0.6
                and other.placed.size()[0] > 0.9 * placed.size()[0]
            )
        )
    ]
    if held and low > 0.05:
        return
    levels: list[tuple[float, int | None]] = [(0.0, None)]
    levels += [(other.placed.extent_z()[1], other.number) for other in below]
    tops = [top for top, _ in levels]
    levels = [
        (level, number) for level, number in levels if not any(0 < t - level < THIN for t in tops)
    ]
    if expected is not None:
        levels = [
            (level, number)
            for level, number in levels
            if abs(level - expected.low[0]) < max(0.04, 4 * expected.low[1])
        ]
        if not levels:
            return
    if not one.fit.upright:
        level, number = min(levels, key=lambda pair: abs(low - pair[0]))
        distance = float(np.median(one.rays.depth[one.rays.on]))
        if abs(low - level) < max(0.03, 0.5 * error * distance):
            one.fit.placed = drawn_nearer(placed, one.rays.origin, level)
            one.fit.rest, one.support = level, number
        return
    by_number = {other.number: other for other in others}
    tried: list[tuple[float, int, MaskFit, int | None]] = []
    for level, number in levels:
        lower = LOWER if placed.solid.name == "cylinder" else HIGHER
        if not -HIGHER < low - level < lower:
            continue
        fit = find_shape(one.rays, error, level, placed, expected)
        squares = fit.placed.cost * len(one.rays.depth)
        if number is not None and not above(fit.placed, by_number[number].placed):
            squares += NOT_ABOVE
        tried.append((squares, len(tried), fit, number))
    if tried:
        squares, _, fit, number = min(tried, key=lambda each: each[:2])
        if squares < WORSE * placed.cost * len(one.rays.depth) + MARGIN:
            one.fit, one.support = fit, number


def _carries(lower: Resting, upper: Placed) -> bool:
    """Return whether something is known to be at the top of an object, below another one."""
    placed = lower.placed
    name = placed.solid.name
    if name.startswith(RAMP):
        return False
    if name == "torus" and not _plate(lower):
        return _same_rings(upper, placed) or _on_rim(upper, placed)
    return name not in VESSELS or (_plate(lower) and _on_rim(upper, placed))


def _same_rings(upper: Placed, lower: Placed) -> bool:
    """Return whether two rings have one axis."""
    if upper.solid.name != "torus" or lower.solid.name != "torus":
        return False
    apart = np.linalg.norm((upper.middle() - lower.middle())[:2])
    return bool(apart < 0.3 * lower.size()[0])


def _on_rim(upper: Placed, ring: Placed) -> bool:
    """Return whether the middle of an object is above a ring and not above its hole."""
    apart = np.linalg.norm((upper.middle() - ring.middle())[:2]) / (ring.size()[0] / 2)
    return bool(0.75 < apart < 1.05)


def above(upper: Placed, lower: Placed) -> bool:
    """Return whether the middle of an object is above (or below) the box of another one."""
    corners, middle = lower.corners()[:, :2], upper.middle()[:2]
    inside = (corners.min(axis=0) - 0.02 < middle) & (middle < corners.max(axis=0) + 0.02)
    return bool(inside.all())


def stacked(objects: Mapping[int, Resting], errors: F64 | None = None) -> dict[int, Placed]:
    """Return the solids, with errors of their fits; what stands on another one still does.

    ``errors``: standard normal numbers, one for each parameter of each fit in order; by default 0.
    """
    out: dict[int, Placed] = {}
    start = 0
    for number, one in objects.items():
        placed, count = one.placed, one.spread.shape[1]
        if errors is not None and count:
            values = one.fit.values + one.spread @ errors[start : start + count]
            placed, _ = one.fit.at(values)
        start += count
        if one.fit.rest is not None:
            level = one.fit.rest if one.support is None else out[one.support].extent_z()[1]
            placed = standing(placed, level)
        out[number] = placed
    return out
