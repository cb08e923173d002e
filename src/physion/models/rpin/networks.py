"""Object states and their interaction.

The state s_k of an object is a small map (C, p, p): the region of its box in the feature maps. With
boxes b, their last changes v in `UNIT` and h observed frames, x_k^t = s_k^t + E (b_k^t, v_k^t), and
for every frame t of the history

    e_k = a( f(x_k) + sum_{l != k} r(x_k, x_l) ),    z_k^t = g(e_k, x_k),

with weights of their own for each of the h places in time. The next state is

    s_k = p( z_k^{1}, ..., z_k^{h} ).

r is one convolution of both states and a ReLU, r = relu(W_1 x_k + W_2 x_l), so that both products
are computed once for each object. The sum runs over objects that are present.

References
----------
H. Qi et al., Learning long-term visual dynamics with region proposal interaction networks, ICLR
2021, sections 3.1 and 3.2.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchvision.ops import roi_align

from physion.models.rpin.boxes import last_changes, to_edges


def convolution(inputs: int, outputs: int) -> nn.Sequential:
    """Return a convolution of 3 x 3 cells that keeps the size, and a ReLU."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU())


def cut_regions(
    maps: Tensor, boxes: Tensor, pool: int, margin: float, *, sampling: int, aligned: bool
) -> Tensor:
    """Return the regions of boxes in feature maps (RoIAlign).

    Parameters
    ----------
    maps : Tensor
        Feature maps (N, C, H, W).
    boxes : Tensor
        Centres and sizes (N, K, 4) in 0..1.
    pool : int
        Cells p per side of a region.
    margin : float
        Part of width and height by which boxes are enlarged.
    sampling : int
        Points per side of a cell that are averaged.
    aligned : bool
        Whether the centre of the first pixel is at 0.5, and not at 0.

    Returns
    -------
    regions : Tensor
        (N, K, C, p, p).
    """
    count, objects = boxes.shape[:2]
    enlarged = torch.cat([boxes[..., :2], boxes[..., 2:] * (1 + margin)], -1)
    height, width = maps.shape[-2:]
    edges = to_edges(enlarged) * edges_scale(boxes, width, height)
    rows = torch.arange(count, device=boxes.device).repeat_interleave(objects)
    listed = torch.cat([rows[:, None].to(edges.dtype), edges.flatten(0, 1)], 1)
    regions: Tensor = roi_align(
        maps, listed.to(maps.dtype), pool, sampling_ratio=sampling, aligned=aligned
    )
    return regions.view(count, objects, maps.shape[1], pool, pool)


def edges_scale(boxes: Tensor, width: int, height: int) -> Tensor:
    """Return the factors (4) from 0..1 to pixels of left, top, right and bottom."""
    return boxes.new_tensor([width, height, width, height])


class Interaction(nn.Module):
    """Effects of objects on each other at one time; it does not depend on their order."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.alone = convolution(width, width)
        self.receiver = nn.Conv2d(width, width, 3, padding=1)
        self.sender = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.affect = convolution(width, width)
        self.join = convolution(2 * width, width)

    def forward(self, states: Tensor, present: Tensor) -> Tensor:
        """Return the effects z (B, K, C, p, p) on states of that shape; ``present`` is (B, K)."""
        flat, shape = states.flatten(0, 1), states.shape
        received = self.receiver(flat).view(shape)[:, :, None]
        sent = self.sender(flat).view(shape)[:, None]
        others = ~torch.eye(shape[1], dtype=torch.bool, device=states.device)
        counted = (present[:, None] & others)[..., None, None, None]
        relations = (torch.relu(received + sent) * counted).sum(2)
        effects = self.affect(self.alone(flat) + relations.flatten(0, 1))
        out: Tensor = self.join(torch.cat([effects, flat], 1))
        return out.view(shape)


class Dynamics(nn.Module):
    """States and boxes of h frames to the next state and what is decoded from it.

    Parameters
    ----------
    width
        Channels C of a state. ``pool``: its cells per side.
    history
        Number of frames h.
    """

    def __init__(self, width: int, pool: int, history: int) -> None:
        super().__init__()
        self.place = nn.Linear(8, width)
        self.interactions = nn.ModuleList(Interaction(width) for _ in range(history))
        self.join = nn.Sequential(nn.Conv2d(history * width, width, 1), nn.ReLU())
        self.decode = nn.Linear(width * pool * pool, 4)

    def forward(self, states: Tensor, boxes: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
        """Return the next states and their decoded values.

        Parameters
        ----------
        states : Tensor
            (B, h, K, C, p, p).
        boxes : Tensor
            Centres and sizes (B, h, K, 4).
        present : Tensor
            Which objects are there (B, K).

        Returns
        -------
        state : Tensor
            (B, K, C, p, p); zeros for absent objects.
        decoded : Tensor
            (B, K, 4).
        """
        moving = torch.cat([boxes, last_changes(boxes)], -1)
        placed = states + self.place(moving)[..., None, None]
        pairs = zip(self.interactions, placed.unbind(1), strict=True)
        effects = [interaction(now, present) for interaction, now in pairs]
        joined = torch.cat(effects, 2).flatten(0, 1)
        state = self.join(joined).view(states[:, 0].shape) * present[..., None, None, None]
        return state, self.decode(state.flatten(2))
