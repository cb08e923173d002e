"""What is expected of every object before it is fitted, from masks, and depth with an error.

Depth with an error of 2 % leaves an object uncertain by 8 cm at 4 m. More is known: where it meets
the floor, what it stands on, how large such things are, how fast it falls. A network, trained on
own scenes whose depth had such errors, reads this off. With x_k what the masks and depth of object
k show in frames `FRAMES`, and r_kl the differences of places and ends of two objects,

    h_k = f(x_k),    h_k <- h_k + g(h_k, sum_l m(h_k, h_l, r_kl))    three times,

it gives probabilities of the shapes of the library, and means and standard deviations of: the error
e of the object's depth, as ln(1 + e) in units of `ERROR`; the height of its lower end in the first
frame; the logarithms of its height and of the sides of the box around it, along the axes of the
world; and the place of its middle, from the centroid of its mask. Depth is divided by 1 + e, and
the rest is what the fit expects (`masks.Expected`).

Without depth every object is first taken to stand on the floor, where the ray through its lowest
pixels meets it (`assumed_depth`). Another network of the same kind, which was trained with such
depth, gives e in each of the frames besides: nothing else says that an object is in the air, or
moves towards the camera.

Places are in axes of the camera: x is ahead, y to the left, z up, the origin below the camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from physion.clips.batch import AGENT_ID, PATIENT_ID, SCENERY_ID
from physion.models.checkpoint import load_packaged
from physion.models.seeing.masks import Expected
from physion.models.seeing.pixels import SeenFrame, picture_of
from physion.models.seeing.solids import library
from physion.scenes.scene import FRAME_TIME, GRAVITY

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

FOLDER = "physion.data.seeing"
WEIGHTS = {True: "expected.safetensors", False: "expected-masks.safetensors"}
"""Package and files of the weights, with and without depth."""
ERROR = 0.02
"""Relative error of depth in the training."""
FRAMES = (0, 10, 20, 30, 38, 44)
"""Frames that the network sees."""
MOST = 15
"""Objects that it sees: agent, patient, and those with the most pixels."""
CROP = 16
"""Pixels per side of the picture of a mask."""
COLUMNS = 36
"""Numbers of an object in a frame, see `_of_frame`."""
VALUES = len(FRAMES) * COLUMNS + 2 * CROP**2 + 2
"""Numbers of an object: of its frames, its mask in the first and last one that show it, and its
roles."""
MEASURED = 5
"""Numbers that are predicted besides place and shape: error, lower end, height, sides."""
FALLS = 0.15
"""Part of the free fall by which an object may fall farther or less far than freely."""
NEAREST, FARTHEST = 0.5, 12.0
"""Range of depth in metres in which an object is taken to stand on the floor."""
FEW = 4
"""Pixels below which an object is not seen."""
SPREAD = 1.5
"""Factor of the standard deviations, since fits have errors of their own."""
LEAST = {"factor": 0.002, "low": 0.01, "height": 0.08, "wide": 0.05, "narrow": 0.05, "middle": 0.01}
"""Least standard deviations, metres or of logarithms."""


@dataclass(frozen=True, eq=False)
class Tokens:
    """What the network sees of a trial.

    - ``numbers``: of the objects, as in ``Batch.ids``. ``values`` (K, `VALUES`).
    - ``axes`` (3, 3), ``origin`` (3,): a point is ``origin + axes @ p`` in the world, with p along
      the axes of the camera.
    """

    numbers: tuple[int, ...]
    values: F32
    axes: F64
    origin: F64


def tokens_of(ids: NDArray[np.uint8], depth: NDArray[np.floating], camera: F64) -> Tokens:
    """Return what the network sees.

    Parameters
    ----------
    ids, depth
        (T, H, W) of the frames `FRAMES`, as in `physion.clips.batch.Batch`; depth has an error.
    camera
        View and projection matrix (2, 4, 4).
    """
    pictures = [picture_of(one, other, camera) for one, other in zip(ids, depth, strict=True)]
    ahead = camera[0, 2, :3]
    angle = np.arctan2(ahead[1], ahead[0])
    axes = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    origin = pictures[0].origin * (1, 1, 0)
    pixels = {int(number): int((ids == number).sum()) for number in np.unique(ids)}
    pixels.pop(SCENERY_ID, None)
    ranked = sorted(pixels, key=lambda n: (n not in (AGENT_ID, PATIENT_ID), -pixels[n]))
    numbers = tuple(sorted(ranked[:MOST]))
    rows = []
    for number in numbers:
        frames, masks = zip(
            *(_of_frame(picture, number, axes, origin) for picture in pictures), strict=True
        )
        seen = [mask for mask in masks if mask is not None] or [np.zeros((CROP, CROP), np.float32)]
        roles = [number == AGENT_ID, number == PATIENT_ID]
        rows.append(np.concatenate([*frames, seen[0].ravel(), seen[-1].ravel(), roles]))
    return Tokens(numbers, np.array(rows, np.float32).reshape(-1, VALUES), axes, origin)


def _of_frame(picture: SeenFrame, number: int, axes: F64, origin: F64) -> tuple[F32, F32 | None]:
    """Return the numbers of an object in a frame, zeros if it is not seen, and its mask.

    In turn: 1; median depth; square root of the pixels times depth, and its logarithm without
    depth; by which part the floor under its lowest pixels is farther away; how much of what is
    below these is other objects; centroid (3) and ends of the box around it (6), at that depth;
    depth in 3 x 3 cells of its mask less the median (9), and pixels in them (9); whether the border
    of the picture cuts it off above, below, and on the left.
    """
    mask = picture.ids == number
    count = int(mask.sum())
    if count < FEW:
        return np.zeros(COLUMNS, np.float32), None
    depth, vectors = picture.depth[mask], picture.vectors[mask]
    middle = float(np.median(depth))
    rows, columns = np.nonzero(mask)
    points = (picture.origin + vectors * middle - origin) @ axes
    centroid = points.mean(0)
    lowest = vectors[rows >= rows.max()].mean(0)
    floor = -picture.origin[2] / lowest[2] if lowest[2] < -1e-4 else 50.0
    cells, counts = np.zeros((3, 3)), np.zeros((3, 3))
    cell = (
        (rows - rows.min()) * 3 // (rows.max() - rows.min() + 1),
        (columns - columns.min()) * 3 // (columns.max() - columns.min() + 1),
    )
    np.add.at(cells, cell, depth)
    np.add.at(counts, cell, 1)
    relative = np.where(counts > 0, cells / np.maximum(counts, 1) - middle, 0.0)
    height, width = mask.shape
    below = picture.ids[min(rows.max() + 2, height - 1), columns[rows >= rows.max() - 1]]
    others = np.mean((below != SCENERY_ID) & (below != number))
    size = np.sqrt(count) / np.hypot(height, width)
    values = np.concatenate(
        [
            [1.0, middle, size * middle, np.log(size), np.clip(floor / middle - 1, -1, 1), others],
            centroid,
            points.min(0) - centroid,
            points.max(0) - centroid,
            3 * relative.ravel(),
            (counts / count).ravel(),
            [rows.min() == 0, rows.max() == height - 1, columns.min() == 0],
        ]
    )
    return values.astype(np.float32), _small(rows, columns)


def _small(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> F32:
    """Return a mask (CROP, CROP), in a square around its pixels."""
    side = max(rows.max() - rows.min(), columns.max() - columns.min()) + 1
    top = (rows.max() + rows.min() + 1) / 2 - side / 2
    left = (columns.max() + columns.min() + 1) / 2 - side / 2
    cell = (
        ((rows + 0.5 - top) / side * CROP).astype(int).clip(0, CROP - 1),
        ((columns + 0.5 - left) / side * CROP).astype(int).clip(0, CROP - 1),
    )
    small = np.zeros((CROP, CROP), np.float32)
    np.add.at(small, cell, 1.0)
    return np.asarray(np.minimum(small / max(1.0, (side / CROP) ** 2), 1.0), np.float32)


class ExpectationNetwork(nn.Module):
    """Tokens of objects to what is expected of them.

    ``mean`` and ``sd``: of the numbers of frames in the training. ``depth``: whether it is seen.
    """

    mean: Tensor
    sd: Tensor

    def __init__(self, *, depth: bool = True, width: int = 96, rounds: int = 3) -> None:
        super().__init__()
        numbers = len(FRAMES) * COLUMNS
        self.crop = nn.Sequential(nn.Linear(2 * CROP**2, 96), nn.GELU(), nn.Linear(96, 48))
        self.own = nn.Sequential(
            nn.Linear(numbers + 2 * (len(FRAMES) - 1) + 48 + 2, 192),
            nn.GELU(),
            nn.Linear(192, width),
        )
        self.pair = nn.ModuleList(
            nn.Sequential(nn.Linear(2 * width + 30, 96), nn.GELU(), nn.Linear(96, width))
            for _ in range(rounds)
        )
        self.join = nn.ModuleList(
            nn.Sequential(
                nn.LayerNorm(2 * width), nn.Linear(2 * width, 128), nn.GELU(), nn.Linear(128, width)
            )
            for _ in range(rounds)
        )
        outputs = 2 * MEASURED + len(library()) + 6 + 2 * len(FRAMES) * (not depth)
        self.out = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 128), nn.GELU(), nn.Linear(128, outputs)
        )
        self.register_buffer("mean", torch.zeros(numbers))
        self.register_buffer("sd", torch.ones(numbers))

    def forward(self, values: Tensor, there: Tensor) -> Tensor:
        """Return what is expected (B, K, .) of objects (B, K, `VALUES`) that are ``there`` (B, K).

        In turn: means and logarithms of standard deviations of `MEASURED` numbers in turn, logits
        of the shapes, and the same as first of the middle and, without depth, of e in each frame
        (`split`).
        """
        batch, objects = there.shape
        other = ~torch.eye(objects, dtype=torch.bool, device=there.device)
        trial, first, second = (there[:, :, None] & there[:, None, :] & other).nonzero().T
        place = torch.full(there.shape, -1, dtype=torch.long, device=there.device)
        place[there] = torch.arange(int(there.sum()), device=there.device)
        i, j = place[trial, first], place[trial, second]
        chosen = values[there]
        frames = frames_of(chosen)
        apart = self._apart(frames, i, j)
        own = ((frames.flatten(-2) - self.mean) / self.sd).clamp(-6, 6)
        masks, roles = chosen[..., own.shape[-1] : -2], chosen[..., -2:]
        state = self.own(torch.cat([own, self._fall(frames), self.crop(masks), roles], -1))
        for pair, join in zip(self.pair, self.join, strict=True):
            said = pair(torch.cat([state[i], state[j], apart], -1))
            heard = torch.zeros_like(state).index_add(0, i, said)
            state = state + join(torch.cat([state, heard], -1))
        found = self.out(state)
        out = torch.zeros(batch, objects, found.shape[-1], device=found.device)
        out[there] = found
        return out

    @staticmethod
    def _fall(frames: Tensor) -> Tensor:
        """Return by how much objects fall farther than freely, and whether they do (N, 2 (T - 1)).

        A part of the free fall g t^2 / 2. What falls freely seems to fall 1 + e times as far.
        """
        times = torch.tensor(FRAMES[1:], device=frames.device) * FRAME_TIME
        free = GRAVITY * times**2 / 2
        both = frames[:, :1, 0] * frames[:, 1:, 0]
        farther = (frames[:, :1, 8] - frames[:, 1:, 8]) / free - 1
        near = both * (farther.abs() < FALLS)
        return torch.cat([farther / (FALLS / 3) * near, near], -1)

    @staticmethod
    def _apart(frames: Tensor, i: Tensor, j: Tensor) -> Tensor:
        """Return the differences (P, 30) of pairs of objects in three frames."""
        ends = [frames[..., 8:9] + frames[..., at : at + 1] for at in (11, 14)]
        places = torch.cat([frames[..., 6:9], *ends], -1)
        parts = []
        for frame in (0, 2, len(FRAMES) - 1):
            both = (frames[i, frame, 0] * frames[j, frame, 0])[:, None]
            a, b = places[i, frame], places[j, frame]
            across = torch.stack([a[:, 3] - b[:, 4], a[:, 4] - b[:, 3]], -1) * both
            apart = (a - b) * both
            level = apart[:, :2].square().sum(-1, keepdim=True).sqrt()
            touches = 0.05 / (across.abs().amin(-1, keepdim=True) + 0.05)
            parts += [apart, across, level, both, touches]
        return torch.cat(parts, -1)


def frames_of(values: Tensor) -> Tensor:
    """Return the numbers (B, K, T, `COLUMNS`) of frames in ``values`` (B, K, `VALUES`)."""
    numbers = values[..., : len(FRAMES) * COLUMNS]
    return numbers.reshape(*values.shape[:-1], len(FRAMES), COLUMNS)


def split(out: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the parts of what the network gives, of all measured numbers first the mean.

    Measured numbers (..., `MEASURED`, 2), logits of shapes, middle (..., 3, 2), e of the frames
    (..., T, 2), with T = 0 if depth is seen.
    """
    ends = np.cumsum([2 * MEASURED, len(library()), 6])
    measured, shapes, middle, errors = out.tensor_split(ends.tolist(), -1)
    pairs = [part.reshape(*part.shape[:-1], -1, 2) for part in (measured, middle)]
    frames = errors.reshape(*errors.shape[:-1], errors.shape[-1] // 2, 2)
    return pairs[0], shapes, pairs[1], frames


@cache
def _network(depth: bool) -> ExpectationNetwork:
    """Return the network with the weights of the package."""
    return load_packaged(partial(ExpectationNetwork, depth=depth), FOLDER, WEIGHTS[depth])


def assumed_depth(ids: NDArray[np.uint8], camera: F64) -> F64:
    """Return the depth (T, H, W) of masks if everything stands on the floor, metres.

    Scenery is the floor, and `FARTHEST` where that is farther away. An object has one depth in a
    frame, where the ray through the middle of its lowest row of pixels meets the floor.
    """
    blank = np.zeros(ids.shape[1:])
    seen = picture_of(ids[0], blank, camera)
    floor = floor_depth(-seen.origin[2], seen.vectors[..., 2])
    depth = np.repeat(floor[None], len(ids), axis=0)
    for picture, of in zip(ids, depth, strict=True):
        for number in np.unique(picture[picture != SCENERY_ID]):
            mask = picture == number
            rows, _ = np.nonzero(mask)
            lowest = seen.vectors[mask][rows == rows.max(), 2].mean()
            of[mask] = floor_depth(-seen.origin[2], lowest)
    return depth


def floor_depth(height: Any, slopes: Any) -> Any:
    """Return the depth at which rays meet the floor, from `NEAREST` to `FARTHEST`, metres.

    ``height``: of the floor above the camera, which is negative. ``slopes``: height of rays at
    depth 1.
    """
    down = np.minimum(slopes, height / FARTHEST)
    return np.maximum(height / down, NEAREST)


def expect(
    frames: Sequence[int], ids: NDArray[np.uint8], depth: NDArray[np.floating] | None, camera: F64
) -> tuple[F64, Mapping[int, Expected]]:
    """Return depth with less error, and what is expected of the objects by number.

    Parameters
    ----------
    frames
        (T,) numbers of the frames. Where one of `FRAMES` is missing, the nearest is taken.
    ids, depth, camera
        (T, H, W), (T, H, W) and (2, 4, 4), as in `physion.clips.batch.Batch`. Depth may be None.
    """
    rows = [int(np.argmin(np.abs(np.array(frames) - frame))) for frame in FRAMES]
    given = depth is not None
    better = np.array(assumed_depth(ids, camera) if depth is None else depth, np.float64)
    tokens = tokens_of(ids[rows], better[rows], camera)
    found = dict[int, Expected]()
    if not tokens.numbers:
        return better, found
    there = torch.ones(1, len(tokens.numbers), dtype=torch.bool)
    with torch.no_grad():
        out = _network(given)(torch.from_numpy(tokens.values)[None], there)[0].double()
    names = [each.name for each in library()]
    measured, logits, middles, errors = (part.numpy() for part in split(out))
    shapes = torch.log_softmax(torch.from_numpy(logits), -1).numpy()
    for k, number in enumerate(tokens.numbers):
        means, logs = measured[k].T
        spreads = SPREAD * np.exp(np.clip(logs, -5, 3))
        error, low, height, wide, narrow = (
            (float(mean), max(float(spread), LEAST[name]))
            for name, mean, spread in zip(LEAST, means, spreads, strict=False)
        )
        if given:
            better[ids == number] /= np.exp(ERROR * error[0])
        else:
            nearer = np.exp(-ERROR * errors[k, :, 0])
            for row, frame in enumerate(frames):
                better[row][ids[row] == number] *= np.interp(frame, FRAMES, nearer)
        seen = frames_of(torch.from_numpy(tokens.values[k]))[:, [0, 6, 7, 8]].double().numpy()
        shown = seen[seen[:, 0] > 0]
        middle = None
        if len(shown):
            place = tokens.origin + tokens.axes @ (shown[0, 1:] + middles[k, :, 0])
            spread = SPREAD * np.exp(np.clip(middles[k, :, 1], -6, 3))
            middle = place, np.maximum(spread, LEAST["middle"])
        found[number] = Expected(
            factor_error=max(ERROR * error[1], LEAST["factor"]),
            shapes=dict(zip(names, shapes[k].tolist(), strict=True)),
            low=low, height=height, wide=wide, narrow=narrow, axes=tokens.axes, middle=middle,
        )  # fmt: skip
    return better, found
