"""Contrastive loss of C-SWM, and the rank of the true next state.

With slots z (K of them) the distance of two states is the energy

    H(a, b) = 1 / (2 sigma^2) * mean_k |a_k - b_k|^2,

and the loss of a transition from z to z', with a negative state n, is

    L = H(z + T(z), z') + max(0, hinge - H(z, n)).

In place of one negative for each state, `all_pairs_loss` takes all pairs of states of a batch.

References
----------
Kipf et al. 2020, equations 2 and 3; metrics in section 4.3. As in their code, the negative is
compared with the present state, while equation 3 compares it with the next one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


def energy(one: Tensor, other: Tensor, sigma: float) -> Tensor:
    """Return the energy (...) of pairs of states (..., K, D)."""
    return (one - other).pow(2).sum(-1).mean(-1) / (2 * sigma**2)


def hinge_loss(states: Tensor, negatives: Tensor, sigma: float, hinge: float) -> Tensor:
    """Return the mean hinge loss of pairs of states (..., K, D) that should be far apart."""
    return (hinge - energy(states, negatives, sigma)).clamp(min=0).mean()


def all_pairs_loss(states: Tensor, sigma: float, hinge: float) -> Tensor:
    """Return the hinge loss of all pairs of different states of clips (B, T, K, D).

    It is the sum of two means, one over pairs from different clips and one over pairs of different
    steps of the same clip. Each has the weight of the first term of a transition's loss: with less,
    slots that never change can cost least.
    """
    clips, steps, slots = states.shape[:3]
    flat = states.flatten(2).flatten(0, 1)
    squares = flat.pow(2).sum(1)
    apart = (squares[:, None] + squares - 2 * flat @ flat.T).clamp(min=0)
    losses = (hinge - apart / (2 * sigma**2 * slots)).clamp(min=0)
    clip = torch.arange(clips, device=flat.device).repeat_interleave(steps)
    same = clip[:, None] == clip
    itself = torch.eye(len(flat), dtype=torch.bool, device=flat.device)
    kinds = [losses[pairs] for pairs in (~same, same & ~itself)]
    return torch.stack([kind.mean() for kind in kinds if len(kind)]).sum()


@dataclass(frozen=True)
class Ranking:
    """How often the true next state is the nearest one, and the mean reciprocal rank."""

    hits: float
    reciprocal: float


def rank_next_states(predicted: Tensor, true: Tensor, candidates: Tensor) -> Tensor:
    """Return the rank of each true next state among the candidates, by distance.

    Parameters
    ----------
    predicted : Tensor
        Predicted states (N, D).
    true : Tensor
        Row of the true next state of each prediction in ``candidates`` (N), integers.
    candidates : Tensor
        States (M, D), among them the true ones.

    Returns
    -------
    ranks : Tensor
        (N), from 1, the nearest, to M. Of equally distant states each counts as half a rank before
        the true one, so that equal states are not ranked by chance.
    """
    # Differences, not products: squared distances that are small beside the states stay exact.
    apart = torch.stack([(candidates - row).pow(2).sum(-1) for row in predicted])
    own = apart.gather(1, true[:, None])
    nearer, equal = (apart < own).sum(1), (apart == own).sum(1) - 1
    return 1 + nearer + equal / 2


def ranking(ranks: Tensor) -> Ranking:
    """Return hits at rank 1 and the mean reciprocal rank of ranks (N)."""
    values = ranks.double()
    return Ranking(float((values == 1).double().mean()), float((1 / values).mean()))
