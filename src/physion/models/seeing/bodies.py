"""Shape, scale and pose of one object from rays of a frame, and its poses in later frames.

`find` starts every shape of the library upright, from the box around the points that are seen, with
some rotations about the vertical. A side of the box along which almost nothing is seen gets a
fraction of the median side, away from the camera. If no upright shape fits, other rotations follow,
few and then more, but not for what is flat. The best ones are fitted again with more rays: with
free scales, with equal scales along x and y, and with three equal ones. Among those that fit nearly
as well, the simplest is taken; proportions that do not occur in our presets cost something. What
fits well is fitted once more, to all rays and with small c.

`alike` gives objects of one shape the same scales, where that fits as well.

`follow` moves what was found to where it fits in a later frame. What fits where it was has not
moved.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from physion.core.seeds import generator
from physion.models.seeing.pixels import Rays
from physion.models.seeing.solids import (
    EQUAL,
    FREE,
    POSE,
    ROUND,
    TURNS,
    Placed,
    Prior,
    Solid,
    cost_of,
    fit,
    library,
)
from physion.numerics.rotations import axis_angle_matrix, rotation_matrices

F64 = NDArray[np.float64]

FEW, SOME, MANY = 140, 280, 600
"""Rays of the first search, of the second one, and of the choice between what they found. Only what
fits well is fitted to all rays."""
YAWS, FLAT_YAWS = 3, 9
"""Rotations about the vertical from which a shape that is not round starts, and of flat ones."""
FLAT = 0.06
"""Height of what is flat, as a fraction of its largest extent. Too large a plate meets free rays in
no more than its thickness, so that nothing draws its edges back: the start must be a good one."""
HIDDEN, HIDDEN_PART = 0.3, 0.8
"""Side of the seen box, as a fraction of the median one, below which it counts as hidden, and its
size then."""
ENOUGH, ROUGH, GOOD = 0.0004, 0.01, 0.0005
"""Cost that ends the search, the same of a ball, whose drawn mesh has corners, and difference of
costs below which the simpler solution is taken; a tenth of the cost is added to it."""
SHARP, EQUAL_WEIGHT = (0.002, 0.001), 0.1
"""First and last c of the last fit of what fits well, and weight of equal scales there."""
FITS, EXACT = {"bowl": 0.06, "sphere": 0.016}, 0.004
"""Cost up to which a shape is accepted, `EXACT` for the others. The collision pieces of bowls and
their drawn meshes differ by a millimetre, and the ball that is fitted has no corners."""
TALLEST = {"cube": math.inf, "cylinder": 12.0, "bowl": 1.2, "torus": 0.4}
TALL, LONGEST = 4.5, 3.5
"""Largest height of a shape in its own frame, over its mean width (`TALL` of shapes that are not
named), and largest length over width, of all but cubes. A pole that is hidden at both ends, such
as among rings, would fit a cone of 30 m, too. In scenes of our presets the heights are up to 10 of
cylinders, 0.9 of bowls, 0.25 of rings and 3.5 of the others, the lengths up to 3."""
LEVEL = ("cube", "cylinder", "torus")
"""Shapes that may be flat, as `FLAT` says; in our presets these are targets."""
UNLIKELY = 0.1
"""Cost that is added to a shape with other proportions. What is seen well has them if it must."""
NEAR_FLOOR = 0.04
"""Height in metres of the lowest seen point up to which an object is taken to reach the floor."""
ALIKE, WORSE = 0.7, 0.001
"""Largest difference of logarithms of the scales of two objects that may be alike, and cost, with
the last c of `SHARP`, by which one may fit worse with the scales of the other."""
ROTATIONS = (16, 64)
"""Random rotations that are tried first, and all that are tried where none of these fits."""
KEPT = 5
PER_SHAPE = 2
"""Solutions that are fitted again, and how many of them have one shape."""
EXPECTED = 0.05
"""Weight of the distance from where an object that is followed is expected."""
SAME, STILL = 1.3, 0.008
"""Factor and summand of the cost up to which an object counts as not moved."""
LOST = 0.015
"""Cost above which an object that is followed may have turned further."""
ANGLES = (math.pi / 6, math.pi / 3, math.pi / 2)
"""Angles by which it may have turned."""


def find(rays: Rays, prior: Prior) -> Placed:
    """Return the shape of the library, with scale and pose, that fits rays best.

    ``rays``: of an object that is seen. ``prior``: what is expected of its pose.
    """
    choice = library()
    few, some = rays.first(FEW), rays.first(SOME)
    low, high = _box(np.eye(3), rays)
    flat = bool(high[2] - low[2] < FLAT * (high - low).max() and low[2] < prior.floor + NEAR_FLOOR)
    found: list[Placed] = []
    for each in choice:
        starts = [
            fit(start, few, FREE, prior, widths=(0.02 if flat else 0.05, 0.01), steps=7)
            for start in _upright(each, rays, prior.floor, flat)
        ]
        starts.sort(key=lambda placed: cost_of(placed, few, 0.01))
        polished = [
            fit(start, some, FREE, prior, widths=(0.02, 0.004), steps=8)
            for start in starts[: 4 if flat else 1]
        ]
        found.append(min(polished, key=lambda placed: placed.cost))
        if _enough(found[-1]):
            break
    for first, last in itertools.pairwise((0, *ROTATIONS)):
        if flat or any(_fits(placed) for placed in found):
            break
        starts = [
            fit(start, few, FREE, prior, widths=(0.05, 0.015), steps=5)
            for each in choice
            for start in _any_rotation(each, rays, _rotations()[first:last])
        ]
        starts.sort(key=lambda placed: cost_of(placed, few, 0.015))
        for start in _several(starts, 8):
            found.append(fit(start, some, FREE, prior, widths=(0.02, 0.004), steps=10))
            if _enough(found[-1]):
                break
    # Unlikely ones last, but the best of all among those that are fitted again, each once.
    found.sort(key=lambda placed: placed.cost)
    likely = [placed for placed in found if not _unlikely(placed)]
    kept = _several([*likely, *found], KEPT - 1) + found[:1]
    return refine(list({id(placed): placed for placed in kept}.values()), rays, prior)


def refine(starts: Sequence[Placed], rays: Rays, prior: Prior) -> Placed:
    """Return the simplest of the solutions near some starts that fit nearly as well as the best."""
    order = list(TURNS)
    tried: list[tuple[float, Placed, F64]] = []
    many = rays.first(MANY)
    for start in starts:
        rank = 0.0003 * order.index(start.solid.name)
        whole = fit(start, many, FREE, prior, widths=(0.01, 0.004), steps=10)
        if whole.cost >= GOOD:
            # Points far outside pull nothing: their cost is at its limit.
            wider = fit(_covering(whole, many), many, FREE, prior, widths=(0.01, 0.004), steps=10)
            whole = min(whole, wider, key=lambda placed: placed.cost)
        allowed = GOOD + 0.1 * whole.cost
        tried.append((whole.cost + rank + 2 * allowed, whole, FREE))
        for tied in _squares(whole):
            tied = fit(tied, many, ROUND, prior, widths=(0.02, 0.004), steps=10)
            tried.append((tied.cost + rank + allowed, tied, ROUND))
        scale = np.full(3, np.exp(np.mean(np.log(whole.scale))))
        if np.abs(np.log(scale / whole.scale)).max() < 0.3:
            tied = _centred(replace(whole, scale=scale), whole.middle())
            tied = fit(tied, many, EQUAL, prior, widths=(0.02, 0.004), steps=10)
            tried.append((tied.cost + rank, tied, EQUAL))
    _, best, free = min(tried, key=lambda one: one[0] + _unlikely(one[1]))
    if best.cost >= GOOD:
        return best
    # Every drawn point fits, so that borders are known better than to the usual width.
    prior = replace(prior, equal=EQUAL_WEIGHT)
    sharp = fit(best, rays, free, prior, widths=SHARP, steps=10)
    return replace(sharp, cost=cost_of(sharp, rays))


def _covering(placed: Placed, rays: Rays) -> Placed:
    """Return a solid, longer along its axes until it reaches all points that are seen."""
    low, high = _box(placed.rotation, rays, 0.0)
    middle, half = placed.middle() @ placed.rotation, placed.size() / 2
    low, high = np.minimum(low, middle - half), np.maximum(high, middle + half)
    return _filling(placed.solid, placed.rotation, low, high)


def _unlikely(placed: Placed) -> float:
    """Return `UNLIKELY` for what is taller, longer or flatter than in our presets; else 0."""
    wide, deep, high = (placed.solid.high - placed.solid.low) * placed.scale
    tallest = TALLEST.get(placed.solid.name, TALL)
    likely = placed.solid.name == "cube" or max(wide, deep) <= LONGEST * min(wide, deep)
    likely = likely and high <= tallest * math.sqrt(wide * deep)
    likely = likely and (placed.solid.name in LEVEL or high >= FLAT * max(wide, deep))
    return 0.0 if likely else UNLIKELY


def _fits(placed: Placed) -> bool:
    """Return whether no other rotation has to be looked for."""
    return placed.cost + _unlikely(placed) < FITS.get(placed.solid.name, EXACT)


def _enough(placed: Placed) -> bool:
    """Return whether nothing better has to be looked for."""
    return placed.cost + _unlikely(placed) < (ROUGH if placed.solid.ball else ENOUGH)


def _squares(placed: Placed) -> Iterator[Placed]:
    """Yield solids with equal scales along x and y; the shorter side may be partly hidden.

    It is made as long as the other one towards both sides, and towards either.
    """
    scale = placed.scale.copy()
    short = int(np.argmin(scale[:2]))
    scale[:2] = scale[:2].max()
    hidden = (scale - placed.scale)[short] * (placed.solid.high - placed.solid.low)[short] / 2
    known = hidden < 0.05 * placed.size()[short]
    for side in (0.0,) if known else (0.0, 1.0, -1.0):
        shift = side * hidden * placed.rotation[:, short]
        yield _centred(replace(placed, scale=scale), placed.middle() + shift)


def alike(fits: Mapping[int, Placed], rays: Mapping[int, Rays], prior: Prior) -> dict[int, Placed]:
    """Return solids; all of one shape get the same scales where that fits as well.

    What is hidden of one is seen of another. Where all three scales of a solid are equal, nothing
    is hidden that has to be known. The scales with which most others fit as well are taken first.
    """
    result = dict(fits)
    groups: dict[str, set[int]] = {}
    for number, placed in fits.items():
        if np.ptp(placed.scale) > 0.01 * placed.scale.max() and placed.cost < GOOD:
            groups.setdefault(placed.solid.name, set()).add(number)
    for left in groups.values():
        pairs = {
            (giver, number): _scaled_as(fits[giver], fits[number], rays[number], prior)
            for giver, number in itertools.permutations(sorted(left), 2)
        }
        while len(left) > 1:
            options = []
            for giver in sorted(left):
                taken = {n: other for n in left - {giver} if (other := pairs[giver, n])}
                total = sum(cost_of(other, rays[n], SHARP[1]) for n, other in taken.items())
                options.append((len(taken), -total, giver, taken))
            count, _, giver, taken = max(options, key=lambda option: option[:3])
            if not count:
                break
            result |= taken
            left -= {giver, *taken}
    return result


def _scaled_as(giver: Placed, placed: Placed, rays: Rays, prior: Prior) -> Placed | None:
    """Return a solid with the scales of another one; None if it does not fit as well then.

    Of boxes the scales along x and y may change places.
    """
    turned = giver.scale[[1, 0, 2]] if giver.solid.name == "cube" else giver.scale
    scale = min(
        (giver.scale, turned), key=lambda scale: float(np.abs(np.log(scale / placed.scale)).max())
    )
    change = np.log(scale / placed.scale)
    if np.abs(change).max() > ALIKE:
        return None
    axis = int(np.argmax(np.abs(change)))
    shift = (scale - placed.scale)[axis] * (placed.solid.high - placed.solid.low)[axis] / 2
    best: Placed | None = None
    for side in (0.0, 1.0, -1.0):
        middle = placed.middle() + side * shift * placed.rotation[:, axis]
        other = _centred(replace(placed, scale=scale), middle)
        other = fit(other, rays, POSE, prior, widths=(0.01, SHARP[1]), steps=10)
        if best is None or other.cost < best.cost:
            best = other
    assert best is not None
    if best.cost > cost_of(placed, rays, SHARP[1]) + WORSE:
        return None
    return replace(best, cost=cost_of(best, rays))


def follow(
    before: Placed, rays: Rays, floor: float, guesses: Sequence[Placed] = ()
) -> tuple[Placed, bool]:
    """Return the pose in a later frame, and whether it is another one.

    Parameters
    ----------
    before
        The last known pose.
    rays
        Of the later frame.
    floor
        Height in metres that nothing is below.
    guesses
        Other poses from which the search starts; the first one is expected.
    """
    some = rays.first(SOME)
    if cost_of(before, some) <= SAME * before.cost + STILL:
        return before, False
    # Where both ends are hidden, it is taken to move along its axis as before.
    ahead = (*guesses, before)[0]
    middle, low = ahead.middle(), ahead.extent_z()[0]
    center = (float(middle[0]), float(middle[1]))
    prior = Prior(floor, low, EXPECTED, center, EXPECTED)
    starts = [before, *guesses]
    found = [fit(s, some, POSE, prior, widths=(0.03, 0.004), steps=10) for s in starts]
    best = min(found, key=lambda placed: placed.cost)
    if best.cost > LOST + before.cost:
        turns = [turn @ best.rotation for angle in ANGLES for turn in _axis_turns(angle)]
        turns += _rotations()[: ROTATIONS[0]]
        turned = [replace(best, rotation=rotation) for rotation in turns]
        few = rays.first(FEW)
        wide = [
            fit(_centred(placed, best.middle()), few, POSE, prior, widths=(0.03, 0.01), steps=6)
            for placed in turned
        ]
        wide.sort(key=lambda placed: cost_of(placed, few, 0.01))
        found = [fit(s, some, POSE, prior, widths=(0.02, 0.004), steps=10) for s in wide[:3]]
        best = min([best, *found], key=lambda placed: placed.cost)
    best = fit(best, rays, POSE, prior, widths=(0.006, 0.004), steps=6)
    return replace(best, cost=max(best.cost, before.cost / 2)), True


def moved_with(placed: Placed, shift: F64) -> Placed:
    """Return a placed solid moved by ``shift`` (3,), metres."""
    return replace(placed, position=placed.position + shift)


def _several(placed: Sequence[Placed], count: int) -> list[Placed]:
    """Return the first ones, at most `PER_SHAPE` of a shape."""
    kept: list[Placed] = []
    for each in placed:
        if sum(k.solid is each.solid for k in kept) < PER_SHAPE and len(kept) < count:
            kept.append(each)
    return kept


def _upright(each: Solid, rays: Rays, floor: float, flat: bool) -> Iterator[Placed]:
    """Yield starts of an upright shape; what is seen near the floor stands on it."""
    turns = FLAT_YAWS if flat else YAWS + (each.symmetry > math.pi)
    turns = 1 if each.symmetry == 0.0 else turns
    for number in range(turns):
        yaw = each.symmetry * number / turns
        rotation = axis_angle_matrix(np.array([0.0, 0.0, 1.0]), yaw)
        low, high = _box(rotation, rays)
        if low[2] < floor + NEAR_FLOOR:
            low[2] = min(floor, high[2] - 1e-3)
            yield _filling(each, rotation, *_extended(low, high, rotation, rays, (0, 1)))
            if flat:
                low, high = _box(rotation, rays, 0.0)
                low[2] = min(floor, high[2] - 1e-3)
                yield _filling(each, rotation, low, high)
        else:
            yield _filling(each, rotation, *_extended(low, high, rotation, rays, (0, 1, 2)))
            if each.name == "torus":
                # A ring is lower than `_extended` takes it to be.
                ring = _filling(each, rotation, *_extended(low, high, rotation, rays, (0, 1)))
                yield _centred(
                    replace(ring, scale=ring.scale[:2].max() * np.ones(3)), ring.middle()
                )


def _any_rotation(each: Solid, rays: Rays, rotations: Sequence[F64]) -> Iterator[Placed]:
    """Yield starts of a shape with rotations; a ball needs none."""
    if not each.ball:
        for rotation in rotations:
            box = _box(rotation, rays)
            yield _filling(each, rotation, *_extended(*box, rotation, rays, (0, 1, 2)))


def _box(rotation: F64, rays: Rays, outside: float = 0.01) -> tuple[F64, F64]:
    """Return lowest and highest coordinates (3,) of the seen points along axes with a rotation.

    A fraction ``outside`` of the points lies beyond each side.
    """
    low, high = np.quantile(rays.points() @ rotation, (outside, 1 - outside), axis=0)
    return low, np.maximum(high, low + 1e-3)


def _extended(
    low: F64, high: F64, rotation: F64, rays: Rays, axes: Sequence[int]
) -> tuple[F64, F64]:
    """Return a box that is larger, away from the camera, along axes where little is seen of it."""
    low, high = low.copy(), high.copy()
    usual = float(np.median(high - low))
    away = (low + high) / 2 - rays.origin @ rotation
    for axis in axes:
        if high[axis] - low[axis] < HIDDEN * usual:
            if away[axis] >= 0:
                high[axis] = low[axis] + HIDDEN_PART * usual
            else:
                low[axis] = high[axis] - HIDDEN_PART * usual
    return low, high


def _filling(each: Solid, rotation: F64, low: F64, high: F64) -> Placed:
    """Return a shape that fills a box along axes with a rotation."""
    scale = (high - low) / (each.high - each.low)
    middle = (low + high) / 2 - scale * (each.low + each.high) / 2
    return Placed(each, rotation @ middle, rotation, scale)


def _centred(placed: Placed, middle: F64) -> Placed:
    """Return a placed solid whose middle is at a point (3,)."""
    return moved_with(placed, middle - placed.middle())


@cache
def _rotations() -> tuple[F64, ...]:
    """Return rotation matrices, uniform in the space of rotations."""
    values = generator("seeing", "rotations of a shape").standard_normal((ROTATIONS[-1], 4))
    values /= np.linalg.norm(values, axis=1, keepdims=True)
    return tuple(rotation_matrices(values))


def _axis_turns(angle: float) -> list[F64]:
    """Return rotations by an angle about the six directions of the axes."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return [axis_angle_matrix(axis, angle) for axis in axes]
