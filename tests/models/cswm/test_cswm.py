"""C-SWM: closed forms of its loss and metrics, symmetry of the transition, states of clips."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from physion.errors import BadInputError
from physion.models.build import build_model
from physion.models.cswm.config import cswm_config
from physion.models.cswm.contrast import (
    energy,
    hinge_loss,
    rank_next_states,
    ranking,
    states_of_other_clips,
    states_of_other_steps,
)
from physion.models.cswm.networks import SlotExtractor, SlotTransition
from support.moving_squares import squares, with_arrays


def model_of(**options: Any) -> Any:
    return build_model("cswm", **options).eval()  # type: ignore[attr-defined]


def test_energy_of_given_states() -> None:
    """Slots (3, 4) and (0, 1) against zeros: (25 + 1) / 2 / (2 * 0.25) = 26."""
    states = torch.tensor([[[3.0, 4.0], [0.0, 1.0]]])
    assert energy(states, torch.zeros_like(states), 0.5).tolist() == [26.0]
    assert energy(states, states, 0.5).tolist() == [0.0]
    assert energy(states, torch.zeros_like(states), 1.0).tolist() == [6.5]


def test_hinge_loss_of_given_states() -> None:
    """Energies 0, 0.5 and 8 with the hinge 1 cost 1, 0.5 and 0."""
    states = torch.tensor([[[0.0]], [[0.5]], [[2.0]]])
    assert hinge_loss(states, torch.zeros_like(states), 0.5, 1.0).item() == pytest.approx(0.5)


class _Still(nn.Module):
    """Transition that predicts a given change of every slot."""

    def __init__(self, change: float) -> None:
        super().__init__()
        self.change = change

    def forward(self, slots: torch.Tensor) -> torch.Tensor:
        return torch.full_like(slots, self.change)


def test_loss_of_states_that_move_by_a_constant() -> None:
    """One slot, of value 10 c + t: the right transition costs 0, a copy 1 / (2 sigma^2)."""
    model = model_of()
    clip, step = torch.arange(4.0)[:, None], torch.arange(4.0)
    states = (10 * clip + step)[..., None, None]
    model._states = lambda batch: states
    model.transition = _Still(1.0)
    assert model.loss(None) == {"loss": 0.0, "next": 0.0, "negatives": 0.0}
    assert model.baseline(None).item() == pytest.approx(2.0)
    model.transition = _Still(0.5)
    assert model.loss(None)["loss"].item() == pytest.approx(2 * 0.25)


def test_without_a_transition_the_loss_is_that_of_the_baseline() -> None:
    model = model_of()
    model.transition = _Still(0.0)
    batch = squares(3, model.window, model.spec)
    torch.manual_seed(0)
    loss = model.loss(batch)["loss"].item()
    torch.manual_seed(0)
    assert model.baseline(batch).item() == pytest.approx(loss)


def test_negatives_are_other_clips_and_other_steps() -> None:
    states = torch.arange(12.0).view(3, 4, 1, 1)
    for seed in range(20):
        torch.manual_seed(seed)
        clips, steps = states_of_other_clips(states), states_of_other_steps(states)
        assert ((clips - states).abs() % 4 == 0).all() and (clips != states).all()
        assert torch.equal(steps // 4, states // 4) and (steps != states).all()
    assert len(states_of_other_clips(states[:1])) == 0


def test_a_single_clip_has_the_negatives_of_its_other_steps() -> None:
    model = model_of()
    losses = model.loss(squares(1, model.window, model.spec))
    assert losses["loss"].isfinite() and losses["negatives"] > 0


def test_published_negatives_are_a_permutation_of_the_batch() -> None:
    model = model_of(size="released")
    states = torch.tensor([0.0, 1.0])[:, None, None, None].expand(-1, 2, 1, 1)
    losses = set()
    for seed in range(20):
        torch.manual_seed(seed)
        losses.add(model._contrast(states, states[:, :-1])["loss"].item())
    assert losses == {0.0, 1.0}, "each state has the other one as negative, or each itself"


def test_ranks_of_given_states() -> None:
    candidates = torch.tensor([[0.0], [1.0], [3.0], [7.0]])
    predicted = torch.tensor([[0.9], [2.1], [100.0], [2.0]])
    true = torch.tensor([1, 0, 3, 2])
    ranks = rank_next_states(predicted, true, candidates)
    # The last one has 1 and 3 at an equal distance: half a rank.
    assert ranks.tolist() == [1.0, 3.0, 1.0, 1.5]
    result = ranking(ranks)
    assert result.hits == 0.5
    assert result.reciprocal == pytest.approx((1 + 1 / 3 + 1 + 1 / 1.5) / 4)


def test_ranks_of_a_collapsed_model_are_those_of_guessing() -> None:
    ranks = rank_next_states(torch.zeros(5, 3), torch.arange(5), torch.zeros(100, 3))
    assert ranks.tolist() == [50.5] * 5


def test_the_true_next_state_is_first_for_the_right_transition_and_never_for_a_copy() -> None:
    model = model_of()
    states = (10 * torch.arange(20.0)[:, None] + torch.arange(5.0))[..., None, None]
    model._states = lambda batch: states
    model.transition = _Still(1.0)
    ranks, copied = model.next_state_ranks(None)
    assert len(ranks) == 80 and ranking(ranks) == ranking(torch.ones(80))
    assert ranking(copied).hits == 0 and ranking(copied).reciprocal <= 0.5


def test_the_transition_follows_the_order_of_the_slots() -> None:
    torch.manual_seed(0)
    transition = SlotTransition(4, 16)
    slots, order = torch.randn(3, 5, 4), torch.tensor([3, 0, 4, 1, 2])
    changes = transition(slots)
    assert torch.allclose(transition(slots[:, order]), changes[:, order], atol=1e-5)
    assert not torch.allclose(changes[:, order], changes, atol=1e-2)


def test_every_slot_depends_on_every_other() -> None:
    torch.manual_seed(0)
    transition = SlotTransition(2, 8)
    slots = torch.randn(1, 4, 2, requires_grad=True)
    for row in range(4):
        (slopes,) = torch.autograd.grad(transition(slots)[0, row].sum(), slots)
        assert (slopes[0].abs().sum(-1) > 0).all()


@pytest.mark.parametrize("size", ["small", "paper", "released"])
def test_maps_have_the_computed_size(size: Any) -> None:
    config = cswm_config(size)
    extractor = SlotExtractor(3, 4, config.slots, config.kernels, config.strides).eval()
    with torch.no_grad():
        maps = extractor(torch.zeros(1, 3, config.image_size, config.image_size))
    side = extractor.map_size(config.image_size)
    assert maps.shape == (1, config.slots, side, side)


def test_a_state_is_made_of_successive_pictures_the_oldest_first() -> None:
    model = model_of(size="released")
    count = model.spec.context + 1
    size = model.spec.image_size
    bright = 10 * torch.arange(count, dtype=torch.uint8)
    rgb = bright.view(1, -1, 1, 1, 1).expand(1, count, size, size, 3)
    stacked = model._stacked(with_arrays(squares(1, count, model.spec), rgb=rgb))
    assert stacked.shape == (1, 2, 21, size, size)
    values = stacked[0, :, ::3, 0, 0] * 255
    assert torch.allclose(values, torch.stack([bright[:7], bright[1:]]).float())


def test_features_begin_with_the_first_state_as_published() -> None:
    model = model_of()
    batch = squares(2, 4, model.spec)
    with torch.no_grad():
        features, states = model.encode(batch), model._states(batch).flatten(2)
    assert torch.equal(features[:, 1:], states) and torch.equal(features[:, 0], states[:, 0])


def test_a_clip_that_is_too_short_is_refused() -> None:
    model = model_of(size="released")
    with pytest.raises(BadInputError, match="a state needs 7 pictures, and a clip has only 6"):
        model.encode(squares(1, 6, model.spec))


def test_betas_of_zero_are_an_adam_that_is_made_anew_at_every_step() -> None:
    betas = cswm_config("released").training.betas
    start = torch.randn(5, generator=torch.Generator().manual_seed(0))
    kept, renewed = start.clone().requires_grad_(), start.clone().requires_grad_()
    optimizer = torch.optim.Adam([kept], 5e-4, betas=betas)
    for step in range(4):
        for weights, used in ((kept, optimizer), (renewed, torch.optim.Adam([renewed], 5e-4))):
            used.zero_grad()
            (weights.pow(3).sum() * (step + 1)).backward()
            used.step()
    assert torch.allclose(kept, renewed, atol=1e-7) and not torch.allclose(kept, start, atol=1e-4)


def test_maps_are_shown_for_every_state() -> None:
    model = model_of()
    with torch.no_grad():
        maps = model.maps(squares(2, 5, model.spec))
    assert maps.shape == (2, 4, 6, 16, 16)
    assert bool((maps > 0).all()) and bool((maps < 1).all())
