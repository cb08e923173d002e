"""C-SWM: closed forms of its loss and metrics, symmetry of the transition, states of clips."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from physion.core.errors import BadInputError
from physion.models.build import build_model, make_settings
from physion.models.cswm import (
    Cswm,
    CswmSettings,
    SlotExtractor,
    SlotTransition,
    all_pairs_loss,
    energy,
    hinge_loss,
    rank_next_states,
    ranking,
)
from support.moving_squares import squares, with_arrays


def model_of(**options: Any) -> Any:
    return build_model("cswm", **{"weights": "random", **options}).eval()  # type: ignore[attr-defined]


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
        return torch.full_like(slots[..., :1], self.change)


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


def test_an_untrained_network_predicts_that_nothing_changes() -> None:
    model = model_of()
    batch = squares(3, model.window, model.spec)
    loss = model.loss(batch)["loss"].item()
    assert model.baseline(batch).item() == pytest.approx(loss)


def test_loss_of_all_pairs_of_given_states() -> None:
    """Clips (0, 0.5) and (2, 2), energies 2 d^2: 0.5 in the one clip, 0 in the other, 4.5 or more
    between them; so 0.5 and 1 within clips, and 0 between."""
    states = torch.tensor([[0.0, 0.5], [2.0, 2.0]])[..., None, None]
    assert all_pairs_loss(states, 0.5, 1.0).item() == pytest.approx(0.75, abs=1e-6)
    assert all_pairs_loss(states[:1], 0.5, 1.0).item() == pytest.approx(0.5, abs=1e-6)
    assert all_pairs_loss(states[:, :1], 0.5, 1.0).item() == pytest.approx(0, abs=1e-6)
    assert all_pairs_loss(states[:, :1], 0.5, 9.0).item() == pytest.approx(1.0, abs=1e-6)


def test_the_loss_of_all_pairs_matches_the_pairs_one_by_one() -> None:
    torch.manual_seed(0)
    states = 0.3 * torch.randn(3, 4, 5, 2)
    within, between = [], []
    for a in range(12):
        for b in range(12):
            pair = states[a // 4, a % 4], states[b // 4, b % 4]
            if a != b:
                (within if a // 4 == b // 4 else between).append(hinge_loss(*pair, 0.5, 1.0))
    expected = torch.stack(within).mean() + torch.stack(between).mean()
    assert all_pairs_loss(states, 0.5, 1.0).item() == pytest.approx(expected.item(), rel=1e-5)


def test_two_states_tell_a_velocity() -> None:
    """The transition is given the present slot and its last change."""
    model = model_of()
    seen = []

    class Records(nn.Module):
        def forward(self, slots: torch.Tensor) -> torch.Tensor:
            seen.append(slots)
            return slots[..., 1:]

    model.transition = Records()
    states = torch.tensor([1.0, 3.0, 4.0])[None, :, None, None]
    assert model._predicted(states).flatten().tolist() == [5.0, 5.0]
    assert seen[0].flatten(1).tolist() == [[3.0, 2.0], [4.0, 1.0]]


def test_a_future_starts_from_the_last_two_states() -> None:
    """With a transition that predicts the last change again, states lie on a line."""
    model = model_of(slots=2, slot_size=3)

    class Same(nn.Module):
        def forward(self, slots: torch.Tensor) -> torch.Tensor:
            return slots[..., 3:]

    model.transition = Same()
    batch = squares(2, model.spec.context, model.spec)
    features = torch.randn(2, model.spec.context, 6)
    found = model.imagine(with_arrays(batch, features=features), 2, 0).features
    steps = torch.arange(1.0, 12.0)[:, None]
    last, change = features[:, -1:], features[:, -1:] - features[:, -2:-1]
    assert torch.allclose(found[:, 0], last + steps * change, atol=1e-4)
    assert torch.equal(found[:, 0], found[:, 1])


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


def test_ranks_of_a_collapsed_model_match_guessing() -> None:
    ranks = rank_next_states(torch.zeros(5, 3), torch.arange(5), torch.zeros(100, 3))
    assert ranks.tolist() == [50.5] * 5


def test_the_true_next_state_is_first_for_the_right_transition_and_never_for_a_copy() -> None:
    model = model_of()
    states = (10 * torch.arange(20.0)[:, None] + torch.arange(5.0))[..., None, None]
    model._states = lambda batch: states
    model.transition = _Still(1.0)
    ranks, copied = model.next_state_ranks(None)
    assert len(ranks) == 60 and ranking(ranks) == ranking(torch.ones(60))
    assert ranking(copied).hits == 0 and ranking(copied).reciprocal <= 0.5


def test_the_transition_follows_the_order_of_the_slots() -> None:
    torch.manual_seed(0)
    transition = SlotTransition(4, 4, 16)
    slots, order = torch.randn(3, 5, 4), torch.tensor([3, 0, 4, 1, 2])
    changes = transition(slots)
    assert torch.allclose(transition(slots[:, order]), changes[:, order], atol=1e-5)
    assert not torch.allclose(changes[:, order], changes, atol=1e-2)


def test_a_slot_changes_by_itself_and_the_sum_of_the_messages_of_all_others() -> None:
    torch.manual_seed(0)
    transition, slots = SlotTransition(2, 3, 8), torch.randn(4, 2)
    with torch.no_grad():
        for row, (slot, change) in enumerate(zip(slots, transition(slots[None])[0], strict=True)):
            pairs = [torch.cat([slot, slots[other]]) for other in range(4) if other != row]
            received = sum(transition.message(transition.edge(pair)) for pair in pairs)
            expected = transition.change(transition.node(torch.cat([slot, received])))
            assert torch.allclose(change, expected, atol=1e-5)


@pytest.mark.parametrize("size", ["small", "paper", "released"])
def test_maps_have_the_computed_size(size: Any) -> None:
    config = make_settings(CswmSettings, "cswm", {"size": size})
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
    model = Cswm(CswmSettings(stacked=3, memory=1, weights="random")).eval()
    batch = squares(2, 5, model.spec)
    with torch.no_grad():
        features, states = model.encode(batch), model._states(batch).flatten(2)
    assert states.shape[:2] == (2, 3) and torch.equal(features[:, 2:], states)
    assert torch.equal(features[:, :2], states[:, :1].expand(-1, 2, -1))
    assert not model.spec.framewise and model_of().spec.framewise


def test_a_clip_that_is_too_short_is_refused() -> None:
    model = model_of(size="released")
    with pytest.raises(BadInputError, match="a state needs 7 pictures, and a clip has only 6"):
        model.encode(squares(1, 6, model.spec))


def test_maps_are_shown_for_every_state() -> None:
    model = model_of()
    with torch.no_grad():
        maps = model.maps(squares(2, 5, model.spec))
    assert maps.shape == (2, 5, 6, 16, 16)
    assert bool((maps > 0).all()) and bool((maps < 1).all())
