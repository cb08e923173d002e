"""Objects in pictures: which pixels are agent, patient, another object or scenery.

A network with an encoder and a decoder (as U-Net, Ronneberger et al., 2015) sees a picture, and
which of its pixels are red or yellow. For every pixel p it gives logits of four classes, and the
offset o(p) from p to the centre of its object, as in Panoptic-DeepLab (Cheng et al., 2020). Agent
and patient are classes. Pixels of the class of other objects vote for the places p + o(p): the
maxima of the smoothed votes are the objects, and each pixel belongs to the nearest one. Over time
an object that was last seen at time s is continued by the one nearest to where it should be,

    d = |c_t - c_s - (t - s) v|_1 + .7 |a_t - a_s|_1,

with its centre c, velocity v, and size a (square root of the area, halves of width and height);
pairs are chosen so that the sum of d is least, and none is farther apart than `FAR`.

With a cue objects may have any colours. The first picture then says which colours agent and patient
have: of the `NEIGHBORS` pixels of the first picture with the colours nearest to a pixel of a later
one, more belong to the agent (or the patient) than to anything else. Its pixels are painted red and
yellow, and everything else that is red or yellow is painted grey, before the network finds the
other objects.

The network was trained on own pictures in red and yellow, of 96 pixels a side, with true masks
(``benchmarks/models/train_segmentation.py``).
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn import functional

from physion.clips.batch import AGENT_ID, FIRST_OTHER_ID, PATIENT_ID, SCENERY_ID
from physion.models.baselines.pixels import color_masks
from physion.models.checkpoint import load_packaged, packaged_sha256

F64 = NDArray[np.float64]

VERSION = 1
"""Counts changes of this code that change what is found."""
FOLDER, WEIGHTS = "physion.data.segmentation", "segmentation.safetensors"
"""Package and file of the weights."""
SIDE = 96
"""Pixels per side of the pictures."""
CLASSES = (SCENERY_ID, AGENT_ID, PATIENT_ID, FIRST_OTHER_ID)
OFFSET = 10.0
"""Factor of the offsets that the network gives: they are in tenths of a side of the picture."""
CHANNELS = (24, 32, 64, 96)
"""Of the maps with 1/2, 1/4, 1/8 and 1/16 of the resolution."""
CELLS = 48
"""Cells of votes per side."""
LEAST_VOTES, LEAST_PIXELS = 0.6, 6
"""Smoothed votes, and pixels, below which there is no object."""
FAR = 0.12, 0.01
"""Largest d between frames, and by how much it rises with each frame in which nothing was seen."""
NEIGHBORS = 5
PAINT = {AGENT_ID: (1.0, 0.05, 0.05), PATIENT_ID: (1.0, 0.95, 0.05)}
DARKEST = 60
"""With a cue: pixels that vote, the colours of agent and patient, and their least brightness."""
MOST = 60
"""Largest number of other objects of a trial."""


class SegmentationNetwork(nn.Module):
    """Pictures (N, 5, H, W), see `network_input`, to class logits and offsets (N, 6, H, W)."""

    def __init__(self, channels: tuple[int, int, int, int] = CHANNELS) -> None:
        super().__init__()
        first, second, third, fourth = channels
        self.stem = nn.Sequential(
            nn.Conv2d(5, first, 5, stride=2, padding=2), nn.GroupNorm(8, first), nn.GELU()
        )
        self.down = nn.ModuleList(
            [_halved(first, second), _halved(second, third), _halved(third, fourth)]
        )
        self.lift = nn.ModuleList(
            [nn.Conv2d(fourth, third, 1), nn.Conv2d(third, second, 1), nn.Conv2d(second, first, 1)]
        )
        self.join = nn.ModuleList([_Residual(third), _Residual(second), _Residual(first)])
        self.out = nn.Conv2d(first, 4 * (len(CLASSES) + 2), 3, padding=1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Return logits of `CLASSES`, and the offset in x and y, in tenths of a side."""
        maps = [self.stem(pictures)]
        for down in self.down:
            maps.append(down(maps[-1]))
        joined = maps.pop()
        for lift, join in zip(self.lift, self.join, strict=True):
            joined = join(functional.interpolate(lift(joined), scale_factor=2) + maps.pop())
        return functional.pixel_shuffle(self.out(joined), 2)


def _halved(inputs: int, outputs: int) -> nn.Sequential:
    """Return layers that halve the resolution, and a residual block."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=2, padding=1),
        nn.GroupNorm(8, outputs),
        nn.GELU(),
        _Residual(outputs),
    )


class _Residual(nn.Module):
    """Maps x + f(x), f being two convolutions."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1),
            nn.GroupNorm(8, width),
            nn.GELU(),
            nn.Conv2d(width, width, 3, padding=1),
        )

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps of the same shape."""
        out: Tensor = maps + self.layers(maps)
        return out


def network_input(rgb: NDArray[np.uint8]) -> Tensor:
    """Return what the network sees of pictures (N, H, W, 3): colours, which are red, and yellow."""
    colors = torch.from_numpy(rgb).permute(0, 3, 1, 2).float() / 127.5 - 1
    return torch.cat([colors, torch.from_numpy(np.stack(color_masks(rgb), 1)).float()], 1)


def segment(rgb: NDArray[np.uint8], cue: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Return the objects of pixels (T, H, W) of the pictures of a trial.

    Numbers are as in ``Batch.ids``: `AGENT_ID`, `PATIENT_ID`, from `FIRST_OTHER_ID` the others,
    each with the same number in all pictures, and `SCENERY_ID`.

    Parameters
    ----------
    rgb
        Pictures (T, `SIDE`, `SIDE`, 3), with a red agent and a yellow patient.
    cue
        Which pixels (`SIDE`, `SIDE`) of the first picture are agent and patient, by their numbers;
        others mean nothing. With it objects may have any colours.
    """
    if cue is None:
        return follow(_objects_of(rgb))
    roles = roles_by_color(rgb, cue)
    others = follow(_objects_of(painted(rgb, roles)))
    # The network's own agent and patient are what was painted, at most.
    others[others < FIRST_OTHER_ID] = SCENERY_ID
    return np.where(roles == SCENERY_ID, others, roles)


def _objects_of(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the objects of pixels (T, H, W) of each picture by itself."""
    with torch.no_grad():
        found = _network()(network_input(rgb)).double().numpy()
    return np.stack([group(of[: len(CLASSES)], of[len(CLASSES) :]) for of in found])


def roles_by_color(rgb: NDArray[np.uint8], cue: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return which pixels (T, H, W) have colours of agent or patient; see the head of the module.

    In the first picture it is the cue.
    """
    known = np.where(np.isin(cue, (AGENT_ID, PATIENT_ID)), cue, SCENERY_ID).astype(np.uint8)
    tree = cKDTree(rgb[0].reshape(-1, 3).astype(np.float64))
    _, nearest = tree.query(rgb[1:].reshape(-1, 3).astype(np.float64), NEIGHBORS)
    votes = known.ravel()[nearest]
    counts = [(votes == role).sum(1) for role in (SCENERY_ID, AGENT_ID, PATIENT_ID)]
    later = np.argmax(counts, axis=0).astype(np.uint8).reshape(rgb[1:].shape[:3])
    return np.concatenate([known[None], later])


def painted(rgb: NDArray[np.uint8], roles: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return pictures (T, H, W, 3) with a red agent and a yellow patient, and nothing else so.

    ``roles`` (T, H, W) has `AGENT_ID` and `PATIENT_ID`. A painted pixel is as bright as it was, but
    at least `DARKEST`.
    """
    out = rgb.copy()
    red, yellow = color_masks(rgb)
    strange = (red | yellow) & (roles == SCENERY_ID)
    out[strange] = rgb[strange].mean(-1, keepdims=True)
    bright = np.maximum(rgb.max(-1), DARKEST)
    for role, color in PAINT.items():
        out[roles == role] = bright[roles == role][:, None] * np.array(color)
    return out


def group(logits: F64, offsets: F64) -> NDArray[np.uint8]:
    """Return the objects of the pixels of one picture (H, W).

    Parameters
    ----------
    logits, offsets
        (4, H, W) and (2, H, W), as the network gives them.
    """
    best = logits.argmax(0)
    ids: NDArray[np.uint8] = np.array(CLASSES, np.uint8)[best]
    rows, columns = np.nonzero(ids == FIRST_OTHER_ID)
    ids[rows, columns] = SCENERY_ID
    if len(rows) < LEAST_PIXELS:
        return ids
    places = (np.stack([columns, rows], -1) + 0.5) / np.array(best.shape)[::-1]
    votes = places + offsets[:, rows, columns].T / OFFSET
    cells = np.clip((votes * CELLS).astype(int), 0, CELLS - 1)
    counts = np.zeros((CELLS, CELLS))
    np.add.at(counts, (cells[:, 1], cells[:, 0]), 1.0)
    smooth = ndimage.gaussian_filter(counts, 0.8, mode="constant")
    peaks = (smooth == ndimage.maximum_filter(smooth, 3)) & (smooth > LEAST_VOTES)
    # Neighbours with equal votes are one maximum.
    labels, count = ndimage.label(peaks, np.ones((3, 3)))
    if not count:
        return ids
    middles = np.array(ndimage.center_of_mass(peaks, labels, np.arange(1, count + 1)))
    centers = (middles[:, ::-1] + 0.5) / CELLS
    for _ in range(2):
        nearest = ((votes[:, None] - centers) ** 2).sum(-1).argmin(1)
        centers = np.stack([votes[nearest == k].mean(0) for k in np.unique(nearest)])
    nearest = ((votes[:, None] - centers) ** 2).sum(-1).argmin(1)
    number = FIRST_OTHER_ID
    for k in range(len(centers)):
        own = nearest == k
        if own.sum() >= LEAST_PIXELS and number < np.iinfo(np.uint8).max:
            ids[rows[own], columns[own]] = number
            number += 1
    return ids


def follow(ids: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the objects of pictures (T, H, W), each with the same number in all of them."""
    out = np.where(ids >= FIRST_OTHER_ID, SCENERY_ID, ids).astype(np.uint8)
    seen = np.zeros((0, 5))
    velocity, last = np.zeros((0, 2)), np.zeros(0, int)
    for time, picture in enumerate(ids):
        numbers = [int(n) for n in np.unique(picture) if n >= FIRST_OTHER_ID]
        now = np.array([_described(picture == n) for n in numbers]).reshape(-1, 5)
        steps = time - last
        ahead = seen + np.pad(velocity * steps[:, None], ((0, 0), (0, 3)))
        distance = np.abs(now - ahead[:, None]) @ np.array([1, 1, 0.7, 0.7, 0.7])
        limit = FAR[0] + FAR[1] * (steps - 1)
        own = np.full(len(numbers), -1)
        # What is too far apart costs the same, so that it does not take part in the choice.
        costs = np.minimum(distance, limit[:, None])
        for track, place in zip(*linear_sum_assignment(costs), strict=True):
            if distance[track, place] < limit[track]:
                own[place] = track
                velocity[track] = (now[place, :2] - seen[track, :2]) / steps[track]
                seen[track], last[track] = now[place], time
        for place, number in enumerate(numbers):
            if own[place] < 0 and len(seen) < MOST:
                own[place] = len(seen)
                seen = np.vstack([seen, now[place]])
                velocity, last = np.vstack([velocity, np.zeros(2)]), np.append(last, time)
            if own[place] >= 0:
                out[time][picture == number] = FIRST_OTHER_ID + own[place]
    return out


def _described(mask: NDArray[np.bool_]) -> F64:
    """Return centre, square root of the area, and halves of width and height, in sides."""
    rows, columns = np.nonzero(mask)
    height, width = mask.shape
    return np.array(
        [
            columns.mean() / width,
            rows.mean() / height,
            np.sqrt(len(rows) / mask.size),
            np.ptp(columns) / (2 * width),
            np.ptp(rows) / (2 * height),
        ]
    )


@cache
def _network() -> SegmentationNetwork:
    """Return the network with the weights of the package."""
    return load_packaged(SegmentationNetwork, FOLDER, WEIGHTS)


def segmentation_version() -> str:
    """Return the version of this code, and the start of the SHA-256 of the weights."""
    return f"{VERSION} {packaged_sha256(FOLDER, WEIGHTS)[:12]}"
