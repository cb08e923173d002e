"""Find the red agent and the yellow patient in the frames of a movie by their colours.

A pixel has the colour of a role if its hue is within `HUES` degrees of the role's, and its
saturation and value are not much less. The role's colour is measured where the trial knows it: in
its first frame, whose ids are stored. Pixels that already had such a colour there, without being
the object, do not count as long as they do not change. The object is all large connected parts that
remain; the agent those near its last position, or where there are none, those that are not much
smaller than it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

Floats = NDArray[np.float64]
U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]

AGENT, PATIENT = 1, 2
HUES = {AGENT: 11.0, PATIENT: 12.0}
"""Degrees of hue on either side that belong to a role. Other bodies have other hues, or are darker
or paler (`physion.scenes.looks.ROLE_HUES`)."""
LEAST = {AGENT: (0.72, 0.35), PATIENT: (0.6, 0.4)}
"""Smallest saturation and smallest value, as fractions of the role's, by role."""
UNCHANGED = 45
"""Largest change of a channel, of 255, of a pixel that still shows what it showed at first."""
SMALLEST = 6
"""Pixels of the smallest object that is seen."""
PART = 0.15
"""Smallest part of an object, as a fraction of the largest one."""
REACH = 0.08
"""How far an object moves from one frame to the next, as a fraction of the width."""
MOST_SHIFT = 0.1
"""Largest shift of a whole movie that is found, as a fraction of the width."""
SHIFTED_HUES = (8.0, 45.0)
"""Smallest and largest shift of all hues that is found, degrees."""

_EIGHT = np.ones((3, 3))


class RoleColors(NamedTuple):
    """Hue in degrees, saturation and value of agent and patient."""

    agent: tuple[float, float, float]
    patient: tuple[float, float, float]


def hsv(rgb: NDArray[Any]) -> tuple[Floats, Floats, Floats]:
    """Return hue in degrees, saturation and value (...) of sRGB (..., 3) in 0..255."""
    colors = np.asarray(rgb, np.float64) / 255
    red, green, blue = np.moveaxis(colors, -1, 0)
    value, spread = colors.max(axis=-1), np.ptp(colors, axis=-1)
    safe = np.where(spread > 0, spread, 1)
    hue = np.select(
        [value == red, value == green],
        [(green - blue) / safe % 6, (blue - red) / safe + 2],
        (red - green) / safe + 4,
    )
    return 60 * hue, np.where(value > 0, spread / np.where(value > 0, value, 1), 0), value


def palette_of(first: U8, roles: U8) -> RoleColors:
    """Return the palette from a picture (H, W, 3) and the roles (H, W) of its pixels."""
    found = []
    for role in HUES:
        hue, saturation, value = hsv(first[roles == role])
        bright = value >= np.median(value)  # edges and shadows mix with what is around
        mean = np.angle(np.exp(1j * np.deg2rad(hue[bright])).mean(), deg=True) % 360
        medians = (float(np.median(values[bright])) for values in (saturation, value))
        found.append((float(mean), next(medians), next(medians)))
    agent, patient = found
    return RoleColors(agent, patient)


def _bins(rgb: U8) -> NDArray[np.uint16]:
    """Return the row of `_COLORS` next to each pixel (H, W, 3): 32 steps of each channel."""
    bins = rgb[..., 0].astype(np.uint16) >> 3
    for channel in (1, 2):
        bins <<= 5
        bins |= rgb[..., channel] >> 3
    return np.asarray(bins)


_LEVELS = np.arange(32) * 8 + 4
_COLORS = np.stack(np.meshgrid(_LEVELS, _LEVELS, _LEVELS, indexing="ij"), -1).reshape(-1, 3)
_HSV = hsv(_COLORS)


def _table(palette: RoleColors) -> U8:
    """Return the role (0: none) of each of `_COLORS`."""
    hue, saturation, value = _HSV
    apart = [np.abs((hue - own + 180) % 360 - 180) for own, *_ in palette]
    table = np.zeros(len(_COLORS), np.uint8)
    for role, own, distance, other in zip(HUES, palette, apart, apart[::-1], strict=True):
        least, dark = LEAST[role]
        strong = (saturation >= least * own[1]) & (value >= dark * own[2])
        table[strong & (distance <= HUES[role]) & (distance <= other)] = role
    return table


@dataclass(frozen=True)
class Seen:
    """Object in one frame: pixels, centre (x, y) in pixels, mean colour; outline (n, 2).

    ``area`` is 0, and all else without meaning, where it is not seen.
    """

    area: int
    center: Floats
    color: Floats
    outline: Floats


NOWHERE = Seen(0, np.full(2, np.nan), np.full(3, np.nan), np.zeros((0, 2)))


class Tracker:
    """Tracker of agent and patient through the frames of one movie.

    Parameters
    ----------
    first
        First frame of the trial (H, W, 3).
    roles
        Pixels (H, W) of the agent (1) and the patient (2) in it.
    last
        Where the agent was before the movie: middle (x, y), radius, and its largest area so far.
    """

    def __init__(
        self, first: U8, roles: U8, last: tuple[Floats, float, float] | None = None
    ) -> None:
        self._table = _table(palette_of(first, roles))
        # Smooth edges of an object are not something else of its colour.
        near = ndimage.binary_dilation(roles > 0, _EIGHT, iterations=2)
        self._same = np.flatnonzero((self._table[_bins(first)] > 0) & ~near)
        self._first = first.reshape(-1, 3)[self._same].astype(np.int16)
        self._last = last

    def see(self, rgb: U8) -> tuple[Seen, Seen]:
        """Return agent and patient in the next frame (H, W, 3)."""
        roles = self.roles(rgb)
        return self._find(rgb, roles, AGENT), self._find(rgb, roles, PATIENT)

    def roles(self, rgb: U8) -> U8:
        """Return the roles (0: none) of the pixels (H, W) of a frame (H, W, 3)."""
        roles = self._table[_bins(rgb)]
        change = np.abs(rgb.reshape(-1, 3)[self._same] - self._first).max(axis=-1, initial=0)
        roles.reshape(-1)[self._same[change < UNCHANGED]] = 0
        return roles

    def _find(self, rgb: U8, roles: U8, role: int) -> Seen:
        mask = roles == role
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        if not len(rows):
            return NOWHERE
        # All that follows needs only the rectangle around the pixels of the role.
        top, left = int(rows[0]), int(columns[0])
        box = (slice(top, int(rows[-1]) + 1), slice(left, int(columns[-1]) + 1))
        labels, count = ndimage.label(mask[box], _EIGHT)
        size = np.bincount(labels.reshape(-1), minlength=count + 1)
        size[0] = 0  # what has no label
        kept = size >= max(SMALLEST, PART * size.max())
        if not kept.any():
            return NOWHERE
        if role == AGENT and self._last is not None:
            middle, radius, largest = self._last
            flat = np.flatnonzero(labels)
            part, (y, x) = labels.reshape(-1)[flat], np.divmod(flat, labels.shape[1])
            across, down = (
                np.bincount(part, places, minlength=count + 1) / np.maximum(size, 1) + start
                for places, start in ((x, left), (y, top))
            )
            apart = np.hypot(across - middle[0], down - middle[1])
            near = (size >= SMALLEST) & (apart <= REACH * roles.shape[1] + radius)
            if near.any():
                kept = near & (size >= PART * size[near].max())
            else:
                kept &= size >= PART * largest  # what is elsewhere must be as large
                if not kept.any():
                    return NOWHERE
        around = np.zeros((labels.shape[0] + 2, labels.shape[1] + 2), np.bool_)
        own = around[1:-1, 1:-1]
        own[:] = kept[labels]
        edge = own & ~(around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:])
        outline = (np.argwhere(edge)[:, ::-1] + (left, top)).astype(np.float64)
        area = int(np.count_nonzero(own))
        sums = [own.sum(axis=0) @ np.arange(own.shape[1]), own.sum(axis=1) @ np.arange(len(own))]
        center = np.array(sums) / area + (left, top)
        if role == AGENT:
            largest = max(area, self._last[2] if self._last else 0)
            self._last = center, float(np.hypot(*(outline - center).T).max()), largest
        color = own.reshape(-1).astype(np.float32) @ rgb[box].reshape(-1, 3).astype(np.float32)
        return Seen(area, center, color.astype(np.float64) / area, outline)


def shift_between(one: U8, other: U8) -> tuple[int, int]:
    """Return the shift (right, down) in whole pixels that best moves ``other`` onto ``one``.

    By the phase of their Fourier transforms; (0, 0) unless it makes them more alike by a fifth.
    """
    first, second = (picture.astype(np.float64).mean(axis=-1) for picture in (one, other))
    height, width = first.shape
    window = np.outer(np.hanning(height), np.hanning(width))
    cross = np.fft.rfft2((first - first.mean()) * window)
    cross = cross * np.conj(np.fft.rfft2((second - second.mean()) * window))
    peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-9), s=first.shape)
    down, right = (int(place) for place in np.unravel_index(np.argmax(peak), peak.shape))
    dy, dx = (down + height // 2) % height - height // 2, (right + width // 2) % width - width // 2
    most = int(MOST_SHIFT * width)
    if (dx, dy) == (0, 0) or max(abs(dx), abs(dy)) > most:
        return 0, 0
    inner = (slice(most, height - most), slice(most, width - most))
    before = np.abs(first - second)[inner].mean()
    after = np.abs(first - np.roll(second, (dy, dx), (0, 1)))[inner].mean()
    return (dx, dy) if after <= 0.8 * before else (0, 0)


def hue_between(one: U8, other: U8) -> float:
    """Return by how many degrees the hues of ``one`` are shifted from ``other``; 0 if unclear."""
    (h, s, v), (k, t, w) = hsv(one), hsv(other)
    strong = (s > 0.4) & (t > 0.4) & (v > 0.2) & (w > 0.2)
    if strong.sum() < 30:
        return 0.0
    mean = np.exp(1j * np.deg2rad((h - k)[strong])).mean()
    degrees = float(np.angle(mean, deg=True))
    clear = abs(mean) > 0.9 and SHIFTED_HUES[0] <= abs(degrees) <= SHIFTED_HUES[1]
    return degrees if clear else 0.0


def with_hue(pictures: U8, degrees: float) -> U8:
    """Return pictures (T, H, W, 3) with all hues shifted by some degrees."""
    shifted = np.empty_like(pictures)
    for place, picture in enumerate(pictures):
        hue, *others = Image.fromarray(picture).convert("HSV").split()
        moved = hue.point([round(step + degrees / 360 * 256) % 256 for step in range(256)])
        shifted[place] = np.asarray(Image.merge("HSV", (moved, *others)).convert("RGB"))
    return shifted
