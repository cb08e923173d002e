"""Fit of solids to masks, where the depth of what is seen has an error.

`solids` takes depth as exact. Here a depth D is known to a relative error E: each object's depth
has a common factor s, which is fitted too, and each pixel an error of its own. Residuals, in
standard deviations:

- ray on the object, which meets the solid at depth e:  W (e - s D) / (E D)
- ray on the object that misses the solid:  g / S, with g the least distance from a piece, in
  metres, halfway between the planes that let the ray in and out
- free ray:  d / S, with d the depth below the surface halfway along its way through the solid
- ln(s) / E, and weak expectations of equal scales. Where more is expected of the object
  (`Expected`), the standard deviation of ln(s) is the one expected, and further residuals are the
  differences of sizes, lower end and middle from what is expected, all times `TRUST`.

S is `EDGE`, the precision of the border of a mask. W < 1, since errors of a surface are not
independent from pixel to pixel. Residuals r of rays are limited, r / sqrt(1 + (r / L)^2), as masks
of what is partly hidden end too early.

Parameters are the logarithms of the scales (tied for a round shape), x and y, the rotation
about the vertical (or a rotation vector, of what is not upright), z of what stands on nothing
known, and ln(s). The sum of squares is minimised by the method of Levenberg and Marquardt with
differences for derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from physion.core.seeds import generator
from physion.models.seeing.bodies import moved_with
from physion.models.seeing.pixels import Rays
from physion.models.seeing.solids import Placed, Solid, library, place, solid
from physion.numerics.kernel import kernel
from physion.numerics.rotations import axis_angle_matrix, rotation_matrices

F64 = NDArray[np.float64]

EDGE = 0.004
"""Standard deviation of the border of a mask, metres."""
COARSE = (0.05, 0.015)
"""The same at the start of a search for a plate."""
WEIGHT = 0.35
"""Of residuals of depth."""
MOST_DEPTH, MOST_EDGE = 3.0, 6.0
"""Limits of residuals of depth and of borders, in standard deviations."""
STEP = 3e-4
"""Change of a parameter for the derivatives."""
FEW = 140
"""Rays of the search over starts."""
SIMPLER = 0.0008
"""Cost by which a shape must fit better than one that comes before it in the library."""
TRUST = 4.0
"""Weight of what is expected. There are hundreds of residuals of rays, whose errors are alike, so
that they would count for too much."""
LIKELY = 0.04
"""Cost of a shape whose probability is less by a factor of e."""
LEAST_LIKELY = -4.5
"""Log probability of a shape that is tried."""
UNKNOWN = 1e6
"""Standard deviation of what is not known."""
LEAST_SIZE = 1e-3
"""Metres, for logarithms."""
UPRIGHT_COST = 0.09
"""Cost above which an upright shape does not fit."""
NOT_UPRIGHT = 0.02
"""Cost that is added for a shape that is not upright."""
ROTATIONS = 16
"""Rotations from which shapes that are not upright start."""
PLATE = 0.01
"""Height in metres of flat targets in our presets."""
EQUAL = ("sphere", "platonic", "octahedron")
"""Shapes with three equal scales in our presets."""
ROUND = ("cylinder", "cone", "pipe", "torus", "bowl", "pyramid", "pentagon")
"""Shapes with equal scales along x and y."""
UP = np.array([0.0, 0.0, 1.0])


@kernel
def _trace(
    world: F64,
    starts: NDArray[np.int64],
    position: F64,
    rotation: F64,
    scale: F64,
    middle: F64,
    origin: F64,
    vectors: F64,
    depth: F64,
    on: NDArray[np.bool_],
    entries: F64,
    out: F64,
) -> None:
    """Write for each ray the depth where it enters the solid, NaN if it misses, and its distance.

    ``out`` is the distance of a ray on the object that misses it, the depth below the surface of a
    free ray, and 0 otherwise, in metres. Other parameters are as in `solids`.
    """
    pieces, planes = len(starts) - 1, len(world)
    offsets, slopes = np.empty(planes), np.empty(planes)
    for k in range(planes):
        offsets[k] = world[k, 3]
        for i in range(3):
            offsets[k] -= world[k, i] * origin[i]
    local, ray = np.empty(3), np.empty(3)
    for i in range(3):
        local[i] = 0.0
        for j in range(3):
            local[i] += rotation[j, i] * (origin[j] - position[j])
        local[i] = local[i] / scale[i] - middle[i]
    narrow = min(scale[0], scale[1], scale[2])
    for n in range(len(depth)):
        entries[n], out[n] = np.nan, 0.0
        if pieces == 0:
            a = b = c = 0.0
            for i in range(3):
                ray[i] = 0.0
                for j in range(3):
                    ray[i] += rotation[j, i] * vectors[n, j]
                ray[i] /= scale[i]
                a += ray[i] * ray[i]
                b += ray[i] * local[i]
                c += local[i] * local[i]
            square = b * b - a * (c - 0.25)
            enter = leave = at = -b / a
            if square > 0.0:
                enter, leave = (-b - np.sqrt(square)) / a, (-b + np.sqrt(square)) / a
                if on[n]:
                    entries[n] = enter
                    continue
            if not on[n]:
                if square <= 0.0 or enter >= depth[n]:
                    continue
                at = (enter + min(leave, depth[n])) / 2
            size = np.sqrt(max(c + at * (2 * b + at * a), 0.0))
            out[n] = max((size - 0.5) if on[n] else (0.5 - size), 0.0) * narrow
            continue
        for k in range(planes):
            slopes[k] = 0.0
            for i in range(3):
                slopes[k] += world[k, i] * vectors[n, i]
        first, deepest, least = np.inf, 0.0, np.inf
        for piece in range(pieces):
            enter, leave, outside = -np.inf, np.inf, False
            for k in range(starts[piece], starts[piece + 1]):
                if slopes[k] < -1e-12:
                    enter = max(enter, offsets[k] / slopes[k])
                elif slopes[k] > 1e-12:
                    leave = min(leave, offsets[k] / slopes[k])
                elif offsets[k] < 0.0:
                    outside = True
            meets = enter < leave and leave > 0.0 and not outside
            if meets and on[n]:
                first = min(first, enter)
                continue
            if (meets and enter >= depth[n]) or not (meets or on[n]):
                continue
            at = (enter + leave) / 2 if on[n] else (max(enter, 0.0) + min(leave, depth[n])) / 2
            largest = -np.inf
            for k in range(starts[piece], starts[piece + 1]):
                largest = max(largest, at * slopes[k] - offsets[k])
            if on[n]:
                least = min(least, largest)
            else:
                deepest = max(deepest, -largest)
        if not on[n]:
            out[n] = deepest
        elif first < np.inf:
            entries[n] = first
        else:
            out[n] = least


def traced(placed: Placed, rays: Rays) -> tuple[F64, F64]:
    """Return for each ray the depth where it enters a solid (NaN: it misses), and its distance."""
    s = placed.solid
    entries, out = np.empty(len(rays.depth)), np.empty(len(rays.depth))
    _trace(
        place(placed), s.starts, placed.position, placed.rotation, placed.scale,
        (s.low + s.high) / 2, rays.origin, rays.vectors, rays.depth, rays.on, entries, out,
    )  # fmt: skip
    return entries, out


Normal = tuple[float, float]
"""Mean and standard deviation."""


@dataclass(frozen=True, eq=False)
class Expected:
    """What is expected of an object before it is fitted.

    - ``factor_error``: standard deviation of ln(s). ``shapes``: log probability by name.
    - ``low``: height of the lower end in the first frame, metres; ``height``, ``wide`` and
      ``narrow``: logarithms of its height and of the sides of the box around it, metres.
    - ``middle``: place (3,) in the world and standard deviations (3,) along ``axes`` (3, 3); None
      if it is not seen.
    """

    factor_error: float
    shapes: Mapping[str, float]
    low: Normal
    height: Normal
    wide: Normal
    narrow: Normal
    axes: F64
    middle: tuple[F64, F64] | None

    def in_another_frame(self) -> Expected:
        """Return what is expected where only sizes and shape are the same."""
        return replace(self, low=(0.0, UNKNOWN), middle=None)

    def residuals(self, placed: Placed, *, flat: bool, stands: bool) -> list[float]:
        """Return residuals of a solid.

        ``flat``: its height is given. ``stands``: so is its lower end.
        """
        corners = placed.corners()
        sides = np.sort(np.ptp(corners[:, :2], axis=0))
        found = [
            _gap(math.log(max(sides[1], LEAST_SIZE)), self.wide),
            _gap(math.log(max(sides[0], LEAST_SIZE)), self.narrow),
        ]
        if self.middle is not None:
            apart = self.axes.T @ (placed.middle() - self.middle[0])
            found += [_gap(d, (0.0, e)) for d, e in zip(apart, self.middle[1], strict=True)]
        low, high = placed.extent_z()
        if not flat:
            found.append(_gap(math.log(max(high - low, LEAST_SIZE)), self.height))
            if not stands:
                found.append(_gap(low, self.low))
        return found


def _gap(value: float, expected: Normal) -> float:
    """Return how far a value is from what is expected; more than six deviations count less."""
    r = (value - expected[0]) / expected[1]
    return float(TRUST * r / math.sqrt(1 + (r / 6) ** 2))


@dataclass(eq=False)
class MaskFit:
    """Fit of one solid to the rays of a frame, near a start.

    - ``error``: relative error of depth. ``factor_error``: of ln s, about ``factor``.
    - ``rest``: height of what the object stands on, metres; None if it is not known.
    - ``upright``: whether it only turns about the vertical.
    - ``expected``: what is expected of the object, if anything is known.
    - ``sizes``: *free*, *flat* (the height is given) or *given*. ``edge``: standard deviation of
      borders; a larger one first, since far from them limited residuals have no slope.

    After `solve`: ``placed``, with the mean of squares as its cost, ``log_factor`` ln s, and
    `covariance`, from which `drawn` makes other solids that fit nearly as well.
    """

    rays: Rays
    error: float
    rest: float | None = None
    upright: bool = True
    sizes: str = "free"
    factor: float = 0.0
    factor_error: float | None = None
    edge: float = EDGE
    expected: Expected | None = None
    start: Placed = field(init=False)
    values: F64 = field(init=False)

    def _ties(self) -> F64:
        """Return how the free parameters of size change the logarithms of the scales (3, K)."""
        name = self.start.solid.name
        if self.sizes == "given":
            return np.zeros((3, 0))
        if self.sizes == "flat":
            return np.eye(3)[:, :2]
        if name in EQUAL:
            return np.ones((3, 1))
        return np.array([[1.0, 0], [1, 0], [0, 1]]) if name in ROUND else np.eye(3)

    def _size(self) -> int:
        turns = 1 if self.upright else 3
        return int(self._ties().shape[1]) + 2 + turns + int(self.rest is None) + 1

    def at(self, values: F64) -> tuple[Placed, float]:
        """Return the solid and ln s of parameters."""
        start, ties = self.start, self._ties()
        k = ties.shape[1]
        scale = np.exp(np.log(start.scale) + ties @ values[:k])
        shift = np.array([values[k], values[k + 1], 0.0])
        turn = values[k + 2] * UP if self.upright else values[k + 2 : k + 5]
        angle = float(np.linalg.norm(turn))
        rotation = start.rotation
        if angle > 1e-9:
            rotation = axis_angle_matrix(turn / angle, angle) @ rotation
        if self.rest is None:
            shift[2] = values[-2]
        moved = replace(start, position=start.position + shift, rotation=rotation, scale=scale)
        if self.rest is not None:
            moved = standing(moved, self.rest)
        return moved, float(values[-1])

    def residuals(self, values: F64) -> F64:
        """Return the residuals of parameters."""
        placed, factor = self.at(values)
        entries, out = traced(placed, self.rays)
        on = self.rays.on
        seen, error = self.rays.depth[on], self.error
        ahead = np.where(np.isnan(entries[on]), 0.0, entries[on] - seen * math.exp(factor))
        ahead = WEIGHT * np.where(np.isnan(entries[on]), 0.0, ahead) / (error * seen)
        edges = out / self.edge
        known = self.factor_error or error
        if self.expected is not None and not self.factor_error:
            known = self.expected.factor_error / TRUST
        prior = [(factor - self.factor) / known]
        if self.expected is not None and self.sizes != "given":
            flat, stands = self.sizes == "flat", self.rest is not None
            prior += self.expected.residuals(placed, flat=flat, stands=stands)
        logs = np.log(placed.scale)
        if self.sizes == "flat":
            prior.append(logs[0] - logs[1])
        elif self.sizes == "free":
            prior += [2 * (logs[0] - logs[1]), logs[2] - (logs[0] + logs[1]) / 2]
        if self.rest is None and self.sizes == "free":
            prior.append(min(0.0, placed.extent_z()[0]) / 0.003)
        return np.concatenate([_limited(ahead, MOST_DEPTH), _limited(edges, MOST_EDGE), prior])

    def cost(self, start: Placed) -> float:
        """Return the mean of the squares of a start."""
        other = replace(self)
        other.start = start
        r = other.residuals(np.zeros(other._size()))
        return float(r @ r) / len(r)

    def solve(self, start: Placed, steps: int) -> Placed:
        """Fit near a start; return the solid."""
        self.start = start
        values = np.zeros(self._size())
        r = self.residuals(values)
        cost, damping = float(r @ r), 1e-2
        for _ in range(steps):
            slopes = self._slopes(values, r)
            matrix, gradient = slopes.T @ slopes, slopes.T @ r
            for _ in range(4):
                damped = matrix + damping * np.diag(np.diag(matrix) + 1e-9)
                tried = values - np.linalg.solve(damped, gradient).clip(-0.3, 0.3)
                new = self.residuals(tried)
                if float(new @ new) < cost:
                    break
                damping *= 5
            else:
                break
            gain = cost - float(new @ new)
            values, r, cost, damping = tried, new, float(new @ new), max(damping / 5, 1e-6)
            if gain < 1e-4 * cost:
                break
        self.values = values
        placed, self.log_factor = self.at(values)
        self.placed = replace(placed, cost=cost / len(r))
        return self.placed

    def _slopes(self, values: F64, r: F64) -> F64:
        columns = []
        for i in range(len(values)):
            moved = values.copy()
            moved[i] += STEP
            columns.append((self.residuals(moved) - r) / STEP)
        return np.stack(columns, axis=1)

    def spread(self, most: float = 0.2, inflation: float = 1.5) -> F64:
        """Return L (K, K), with which parameters L u, u standard normal, fit nearly as well.

        ``most``: largest standard deviation of a principal axis. ``inflation``: factor of all,
        since residuals of neighbouring rays are not independent.
        """
        slopes = self._slopes(self.values, self.residuals(self.values))
        inverse = np.linalg.inv(slopes.T @ slopes + 1e-6 * np.eye(len(self.values)))
        variances, axes = np.linalg.eigh((inverse + inverse.T) / 2)
        return np.asarray(inflation * axes * np.sqrt(variances.clip(0, most**2)))


def _limited(r: F64, most: float) -> F64:
    return np.asarray(r / np.sqrt(1 + (r / most) ** 2))


def standing(placed: Placed, level: float) -> Placed:
    """Return a solid moved up or down until its lower end is at a height, metres."""
    return moved_with(placed, np.array([0, 0, level - placed.extent_z()[0]]))


def drawn_nearer(placed: Placed, origin: F64, level: float) -> Placed:
    """Return a solid that looks the same from ``origin``, with its lower end at a height."""
    factor = (level - origin[2]) / (placed.extent_z()[0] - origin[2])
    position = origin + factor * (placed.position - origin)
    return replace(placed, position=position, scale=placed.scale * abs(factor))


# Starts.


def _filled(each: Solid, rotation: F64, low: F64, high: F64, rest: float | None) -> Placed:
    """Return a shape that fills a box along axes with a rotation, with scales tied."""
    high = np.maximum(high, low + 0.01)
    scale = (high - low) / (each.high - each.low)
    if each.name in EQUAL:
        scale[:] = np.exp(np.log(scale).mean())
    elif each.name in ROUND:
        scale[:2] = np.exp(np.log(scale[:2]).mean())
    middle = (low + high) / 2 - scale * (each.low + each.high) / 2
    placed = Placed(each, rotation @ middle, rotation, scale)
    return placed if rest is None else standing(placed, rest)


def _boxes(rays: Rays, rotation: F64, rest: float | None) -> Iterator[tuple[F64, F64]]:
    """Yield boxes (low, high) along axes with a rotation, from which a search may start."""
    vectors, depth = rays.vectors[rays.on], rays.depth[rays.on]
    facing = rays.origin + vectors * np.median(depth)
    low, high = np.quantile(facing @ rotation, (0.01, 0.99), axis=0)
    side = max(*(high - low)[:2], 0.02)
    away = facing.mean(axis=0) - rays.origin
    away /= np.linalg.norm(away)
    middle = (low + high) / 2 + (away * (1, 1, 0) * side * 0.35) @ rotation
    half = np.array([side, side, max(high[2] - low[2], 0.02)]) / 2
    yield middle - half, middle + half
    low, high = np.quantile(rays.points() @ rotation, (0.04, 0.96), axis=0)
    if rest is not None and low[2] < rest + 0.08:
        low[2] = rest
    yield low, high
    down = vectors[:, 2] < -1e-3
    if rest is None or np.count_nonzero(down) < 5:
        return
    for height in (0.03, 0.12):
        along = (rest + height / 2 - rays.origin[2]) / vectors[down, 2]
        flat = (rays.origin + vectors[down] * along[:, None]) @ rotation
        low, high = np.quantile(flat, (0.03, 0.97), axis=0)
        low[2], high[2] = rest, rest + height
        yield low, high


def _upright(each: Solid, rays: Rays, rest: float | None, turns: int) -> Iterator[Placed]:
    """Yield upright starts of a shape."""
    count = 1 if each.symmetry == 0.0 else turns * (1 + (each.symmetry > math.pi))
    for number in range(count):
        rotation = axis_angle_matrix(UP, each.symmetry * number / count)
        for low, high in _boxes(rays, rotation, rest):
            yield _filled(each, rotation, low, high, rest)


def _any_rotation(each: Solid, rays: Rays) -> Iterator[Placed]:
    """Yield starts of a shape in all rotations; none of a ball, which is always upright."""
    values = generator("seeing", "rotations of a mask").standard_normal((ROTATIONS, 4))
    values /= np.linalg.norm(values, axis=1, keepdims=True)
    low, high = next(_boxes(rays, np.eye(3), None))
    start = _filled(each, np.eye(3), low, high, None)
    for rotation in [] if each.ball else rotation_matrices(values):
        turned = replace(start, rotation=rotation)
        yield moved_with(turned, start.middle() - turned.middle())


def _first(fits: Iterable[tuple[float, MaskFit]], count: int) -> list[MaskFit]:
    """Return the fits of lowest cost, one of a shape."""
    kept: dict[str, MaskFit] = {}
    for _, each in sorted(fits, key=lambda pair: pair[0]):
        kept.setdefault(each.placed.solid.name, each)
    return list(kept.values())[:count]


def find_shape(
    rays: Rays,
    error: float,
    rest: float | None = None,
    known: Placed | None = None,
    expected: Expected | None = None,
) -> MaskFit:
    """Return the fit of the shape of the library that explains rays best.

    Parameters
    ----------
    rays
        Of an object that is seen.
    error
        Relative error of depth.
    rest
        Height of what it stands on, metres; None if it is not known. Only then it may be turned.
    known
        A solid that fits without ``rest``: the search starts there, too, and ends there if that
        fits as well as before.
    """
    few, ranked, ranks = rays.first(FEW), [], [each.name for each in library()]
    likely = list(library())
    if expected is not None:
        likely = [each for each in likely if expected.shapes[each.name] > LEAST_LIKELY]

    def rank(one: MaskFit) -> float:
        name = one.placed.solid.name
        if expected is not None:
            return one.placed.cost - LIKELY * expected.shapes[name]
        return one.placed.cost + SIMPLER * ranks.index(name)

    def polished(starts: Iterable[MaskFit], steps: int = 12) -> list[MaskFit]:
        fits = []
        for each in starts:
            fits.append(MaskFit(rays, error, rest, each.upright, expected=expected))
            fits[-1].solve(each.placed, steps)
        return fits

    def searched(each: Solid, turns: int, most: int) -> list[tuple[float, MaskFit]]:
        starts = list(_upright(each, rays, rest, turns))
        if known is not None and known.solid is each:
            starts.append(standing(known, rest or 0.0))
            starts.append(drawn_nearer(known, rays.origin, rest or 0.0))
        trial = MaskFit(few, error, rest, expected=expected)
        starts.sort(key=trial.cost)
        fits = []
        for start in starts[:most]:
            one = MaskFit(few, error, rest, expected=expected)
            one.solve(start, 8)
            fits.append((rank(one), one))
        return fits

    if known is not None:
        found = polished(_first(searched(known.solid, 4, 8), 1), 15)
        if found[0].placed.cost < 1.3 * known.cost + 0.01:
            return found[0]
        ranked += searched(known.solid, 4, 8)
    for each in likely:
        ranked += searched(each, 3, 2)
    best = polished(_first(ranked, 4))
    if min(map(rank, best)) > UPRIGHT_COST / 1.5:
        for near in _first(ranked, 6):
            best += polished(_first(searched(near.placed.solid, 6, 6), 1))
    if rest is None and min(map(rank, best)) > UPRIGHT_COST:
        turned = []
        for each in likely:
            for start in _any_rotation(each, rays):
                one = MaskFit(few, error, None, False, expected=expected)
                one.solve(start, 4)
                turned.append((rank(one), one))
        best += polished(_first(turned, 4), 20)
    return min(best, key=lambda one: rank(one) + NOT_UPRIGHT * (not one.upright))


def find_plate(rays: Rays, error: float, expected: Expected | None = None) -> MaskFit:
    """Return the fit of a flat target on the floor: a plate or a ring of the height `PLATE`."""
    fits = []
    for name in ("cube", "torus"):
        each, few, tried = solid(name), rays.first(FEW), []
        for upright in _upright(each, rays, 0.0, 6):
            away = (upright.middle() - rays.origin) * (1, 1, 0)
            away *= upright.size()[:2].mean() / np.linalg.norm(away)
            starts = []
            for factor, part in ((1.0, 0.0), (1.3, -0.15), (1.3, 0.15), (1.7, -0.35), (1.7, 0.35)):
                # What the border of the picture cuts off, or something hides, is to one side.
                scale = upright.scale * (factor, factor, 1.0)
                scale[2] = PLATE / (each.high - each.low)[2]
                wide = replace(upright, scale=scale)
                wide = moved_with(wide, upright.middle() + part * away - wide.middle())
                starts.append(standing(wide, 0.0))
            coarse = MaskFit(few, error, 0.0, sizes="flat", expected=expected, edge=COARSE[0])
            for start in sorted(starts, key=coarse.cost)[:2]:
                for edge in COARSE:
                    start = MaskFit(
                        few, error, 0.0, sizes="flat", expected=expected, edge=edge
                    ).solve(start, 12)
                tried.append(start)
        tried.sort(key=lambda placed: placed.cost)
        for start in tried[:2]:
            fits.append(MaskFit(rays, error, 0.0, sizes="flat", expected=expected))
            fits[-1].solve(start, 15)
    rings = [NOT_UPRIGHT / 2 * (one.placed.solid.name == "torus") for one in fits]
    if expected is not None:
        rings = [-LIKELY * expected.shapes[one.placed.solid.name] for one in fits]
    return min(zip(fits, rings, strict=True), key=lambda pair: pair[0].placed.cost + pair[1])[0]
