"""Boxes of objects as centre and size, (x, y, w, h) in 0..1 of the picture.

An object that no frame of a clip shows is absent: its boxes are zeros, and its size tells.
"""

from __future__ import annotations

import torch
from torch import Tensor

UNIT = 0.02
"""Unit of changes of boxes and of errors, as part of the picture's side. A body that moves at
1 m/s, 3 m from the camera, moves 0.03 in 0.09 s."""


def known_boxes(boxes: Tensor) -> Tensor:
    """Return centres and sizes of all objects at all frames.

    In a frame that does not show it, an object has its last box, or before the first its first one.

    Parameters
    ----------
    boxes : Tensor
        Left, top, right, bottom (B, T, K, 4); NaN where an object is not seen.

    Returns
    -------
    known : Tensor
        (B, T, K, 4), without NaN; zeros for objects that no frame shows.
    """
    seen = boxes.isfinite().all(-1)
    steps = torch.arange(boxes.shape[1], device=boxes.device)[:, None]
    last = torch.where(seen, steps, -1).cummax(1).values
    first = seen.to(torch.uint8).argmax(1, keepdim=True)
    rows = torch.where(last >= 0, last, first)
    filled = boxes.gather(1, rows[..., None].expand(boxes.shape))
    return to_center(filled.nan_to_num(0.0))


def is_present(known: Tensor) -> Tensor:
    """Return which objects (...) of boxes (..., 4) as `known_boxes` gives them are not absent."""
    return known[..., 2] > 0


def to_center(boxes: Tensor) -> Tensor:
    """Return centre and size (..., 4) of left, top, right and bottom."""
    low, high = boxes[..., :2], boxes[..., 2:]
    return torch.cat([(low + high) / 2, high - low], -1)


def to_edges(boxes: Tensor) -> Tensor:
    """Return left, top, right and bottom (..., 4) of centre and size."""
    center, size = boxes[..., :2], boxes[..., 2:]
    return torch.cat([center - size / 2, center + size / 2], -1)


def last_changes(boxes: Tensor) -> Tensor:
    """Return the change in `UNIT` of boxes (B, T, K, 4) from the frame before, 0 for the first."""
    return torch.diff(boxes, dim=1, prepend=boxes[:, :1]) / UNIT


def constant_velocity(known: Tensor, steps: int) -> Tensor:
    """Return boxes (B, steps, K, 4) that go on as the last two of known ones (B, T, K, 4).

    With a single known box they stay where they are.
    """
    last = known[:, -1]
    change = last - known[:, -2] if known.shape[1] > 1 else torch.zeros_like(last)
    ahead = torch.arange(1, steps + 1, device=known.device, dtype=known.dtype)
    return last[:, None] + ahead[:, None, None] * change[:, None]
