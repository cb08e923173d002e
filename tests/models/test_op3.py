"""OP3: closed forms of its parts, symmetry of the slots, features and futures, bad input."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from physion.clips.batch import Batch
from physion.models.build import build_model, make_settings
from physion.models.checkpoint import tensors_of
from physion.models.op3 import (
    BroadcastConv,
    Decoded,
    Explained,
    Likelihood,
    Op3,
    Op3Settings,
    SlotDecoder,
    SlotDynamics,
    SlotInference,
    Slots,
    coordinates,
    log_likelihood,
    plain_maps,
    slope_maps,
    weighted_means,
)
from physion.models.vision import normalized_pictures
from support.moving_squares import squares, with_arrays

TINY = Op3Settings(
    image_size=16, slots=3, deterministic=4, stochastic=5, width=6, hidden=8, effect=4,
    seed_steps=2, past=2, imagined=2, context=3, future=3, weights="random",
)  # fmt: skip


def tiny(**changes: Any) -> Op3:
    return Op3(replace(TINY, **changes)).eval()


def context_of(model: Op3, clips: int = 2) -> Batch:
    return squares(clips, model.spec.context, model.spec)


def random_decoded(clips: int = 2, slots: int = 3, size: int = 4) -> Decoded:
    generator = torch.Generator().manual_seed(0)
    colors = torch.rand(clips, slots, 3, size, size, generator=generator)
    return Decoded(colors, 2 * torch.randn(clips, slots, 1, size, size, generator=generator))


def test_likelihood_matches_a_mixture() -> None:
    decoded = random_decoded()
    pictures = torch.rand(2, 3, 4, 4, generator=torch.Generator().manual_seed(1))
    found = log_likelihood(decoded, pictures, 0.2, "gaussian")
    colors = decoded.colors.permute(0, 3, 4, 1, 2)
    mixture = MixtureSameFamily(
        Categorical(decoded.masks[:, :, 0].permute(0, 2, 3, 1)), Independent(Normal(colors, 0.2), 1)
    )
    assert torch.allclose(found.pixels, mixture.log_prob(pictures.permute(0, 2, 3, 1)), atol=1e-4)


def test_released_likelihood_matches_the_published_code() -> None:
    """Far from all colours it is the logarithm of 1e-12."""
    decoded = random_decoded()
    pictures = torch.rand(2, 3, 4, 4, generator=torch.Generator().manual_seed(1))
    squared = (pictures[:, None] - decoded.colors).double().pow(2).sum(2)
    density = (-squared / (3 * 2 * 0.1**2)).exp() / (math.sqrt(0.1**6) * (2 * math.pi) ** 3)
    expected = ((decoded.masks[:, :, 0] * density).sum(1) + 1e-12).log()
    found = log_likelihood(decoded, pictures, 0.1, "released")
    assert torch.allclose(found.pixels.double(), expected, atol=1e-4)
    far = log_likelihood(decoded, pictures + 100, 0.1, "released")
    assert torch.allclose(far.pixels, torch.tensor(math.log(1e-12)))


def test_masks_sum_to_one_and_weigh_the_colours() -> None:
    torch.manual_seed(0)
    decoded = SlotDecoder(TINY)(torch.randn(2, 3, 9))
    assert decoded.colors.shape == (2, 3, 3, 16, 16) and decoded.logits.shape == (2, 3, 1, 16, 16)
    assert torch.allclose(decoded.masks.sum(1), torch.ones(2, 1, 16, 16), atol=1e-6)
    assert torch.allclose(decoded.log_masks.exp(), decoded.masks, atol=1e-6)
    alone = Decoded(decoded.colors, torch.tensor([0.0, 200, 0])[None, :, None, None, None])
    assert torch.equal(alone.picture(), decoded.colors[:, 1])


def test_what_the_refinement_sees() -> None:
    """The gradient by the masks is that of autograd; the likelihood without a slot is the rest."""
    decoded = random_decoded()
    pictures = torch.rand(2, 3, 4, 4, generator=torch.Generator().manual_seed(1))
    found = log_likelihood(decoded, pictures, 0.5, "gaussian")
    color_slope = torch.randn_like(decoded.colors)
    slopes = slope_maps(decoded, found, color_slope)
    masks = decoded.masks.clone().requires_grad_()
    by_slot = found.by_slot.exp()[:, :, None]
    (gradient,) = torch.autograd.grad(-(masks * by_slot).sum(1).log().sum(), masks)
    assert torch.allclose(slopes[:, :, :1], gradient, rtol=1e-4)
    weighted = masks.detach() * by_slot
    assert torch.allclose(slopes[:, :, 1:2], weighted.sum(1, keepdim=True), rtol=1e-4)
    others = weighted.sum(1, keepdim=True) - weighted
    assert torch.allclose(slopes[:, :, 2:3], others, atol=1e-5)
    assert torch.equal(slopes[:, :, 3:], color_slope)
    plain = plain_maps(decoded, found, pictures)
    assert torch.equal(plain[:, 1, :3], pictures) and torch.equal(plain[:, :, 3:6], decoded.colors)
    assert torch.allclose(plain[:, :, 8].sum(1), torch.ones(2, 4, 4))


@pytest.mark.parametrize("kernel", [3, 5])
def test_the_broadcast_convolution_matches_broadcast_images(kernel: int) -> None:
    torch.manual_seed(0)
    layer = BroadcastConv(7, 4, kernel)
    values = torch.randn(3, 7)
    images = values[:, :, None, None].expand(-1, -1, 8, 8)
    place = coordinates(8, values).expand(3, -1, -1, -1)
    assert torch.allclose(layer(values, 8), layer.conv(torch.cat([images, place], 1)), atol=1e-5)
    assert place[0, 0, 0].tolist() == pytest.approx(torch.linspace(-1, 1, 8).tolist())
    assert place[0, 1, :, 0].tolist() == pytest.approx(torch.linspace(-1, 1, 8).tolist())


def test_dynamics_of_permuted_slots_are_permuted() -> None:
    torch.manual_seed(0)
    dynamics, states = SlotDynamics(TINY), torch.randn(2, 5, 9)
    order = [3, 0, 4, 1, 2]
    for value, permuted in zip(dynamics(states), dynamics(states[:, order]), strict=True):
        assert torch.allclose(value[:, order], permuted, atol=1e-6)


def test_slots_move_one_another_and_not_themselves() -> None:
    torch.manual_seed(0)
    dynamics, states = SlotDynamics(TINY), torch.randn(2, 3, 9)
    changed = states.clone()
    changed[:, 2] += 1
    before, after = dynamics(states)[1], dynamics(changed)[1]
    assert (before - after).abs().amax(-1).min() > 0, "all slots feel the change of one"
    alone = dynamics(states[:, :1])[1]
    dynamics.effect.register_forward_hook(lambda _, inputs, out: 0 * out)
    without = dynamics(states)[1]
    assert torch.allclose(without[:, :1], alone, atol=1e-6), "a slot alone has no effect"
    assert not torch.allclose(without, before)


def test_beliefs_of_permuted_slots_are_permuted() -> None:
    torch.manual_seed(0)
    inference, pictures = SlotInference(TINY), torch.rand(2, 3, 16, 16)
    noise = torch.randn(3, 2, 3, 5)
    order = [2, 0, 1]

    def after(numbers: Tensor) -> Slots:
        slots = inference.start(numbers[0])
        explained = inference.explain(slots, pictures)
        refined = inference.refine(explained, pictures, numbers[1])
        return inference.predict(refined, numbers[2])

    one, other = after(noise), after(noise[:, :, order])
    assert torch.allclose(one.states[:, order], other.states, atol=1e-5)
    assert not torch.allclose(one.states[:, 0], one.states[:, 1])


def test_divergence_of_the_start_and_of_a_prediction() -> None:
    """A prediction is its own prior; the start is compared with N(0, 1)."""
    torch.manual_seed(0)
    inference = SlotInference(TINY)
    slots = inference.start(torch.randn(2, 3, 5))
    variance = nn.functional.softplus(inference.raw) + 1e-5
    by_component = 0.5 * (variance + inference.mean.pow(2) - 1 - variance.log())
    assert torch.allclose(slots.divergence(), 3 * by_component.sum().expand(2), rtol=1e-4)
    assert inference.predict(slots, slots.noise).divergence().abs().max() < 1e-6


def test_later_steps_weigh_more_and_missing_frames_do_not_count() -> None:
    """Pixels have weights too: here those of the second clip's first frame count twice."""
    slots = SlotInference(TINY).start(torch.zeros(2, 3, 5))
    likelihoods = torch.tensor([[-1.0, -10.0], [-2.0, -20.0], [-4.0, -40.0]])
    steps = []
    for frame, row in zip((0, 0, 1), likelihoods, strict=True):
        pixels = row[:, None, None].expand(2, 4, 4)
        known = Likelihood(pixels, pixels)
        steps.append((frame, Explained(slots, random_decoded(), known, -row, row)))
    valid = torch.tensor([[True, True], [True, False]])
    weights = torch.ones(2, 2, 4, 4)
    weights[1, 0] = 2
    nll, kl = weighted_means(steps, valid, weights)
    total = 2 * 1 + 2 * 2 + 3
    assert float(nll) == pytest.approx((1 * (1 + 20) + 2 * (2 + 40) + 3 * 4) / total)
    assert float(kl) == pytest.approx((1 * (1 + 10) + 2 * (2 + 20) + 3 * 4) / total)


def test_sizes_and_their_names() -> None:
    assert build_model("op3").provenance().model == "op3-small"
    paper, released = (
        make_settings(Op3Settings, "op3", {"size": size}) for size in ("paper", "released")
    )
    assert (paper.slots, paper.deterministic, paper.stochastic) == (8, 64, 64)
    assert released.density == "released"
    as_paper = {"context": 0, "future": None, "context_at": "end", "density": "gaussian"}
    assert replace(released, size="paper", **as_paper) == paper
    assert tiny(density="released").digest() != tiny().digest()


def test_weights_fit_any_number_of_slots() -> None:
    model = build_model("op3", slots=7, weights="random")
    assert isinstance(model, Op3) and model.name == "op3-small-7-slots"
    assert model.encode(squares(1, 2, model.spec)).shape == (1, 2, 7 * 32)
    assert tensors_of(model).keys() == tensors_of(tiny()).keys()


def test_features_are_computed_in_the_mode_without_gradients() -> None:
    """And leave none in the weights; the beliefs are refined all the same."""
    model = tiny()
    context = context_of(model)
    with torch.inference_mode():
        features = model.encode(context)
        future = model.imagine(context, 1, 0).features
    with torch.no_grad():
        assert torch.equal(model.encode(context), features)
    assert not features.requires_grad and not future.requires_grad
    assert all(weight.grad is None for weight in model.parameters())


def test_features_are_of_what_was_seen_so_far() -> None:
    model = tiny()
    batch = squares(2, 5, model.spec)
    whole = model.encode(batch)
    assert whole.shape == (2, 5, 27) and not model.spec.framewise
    assert torch.allclose(model.encode(batch.steps(slice(0, 3))), whole[:, :3], atol=1e-5)
    later = batch.rgb.clone()
    later[:, 3:] = 0
    poisoned = model.encode(with_arrays(batch, rgb=later))
    assert torch.equal(poisoned[:, :3], whole[:, :3])
    assert not torch.equal(poisoned[:, 3], whole[:, 3])


def test_futures_follow_from_seed_and_name_of_the_trial() -> None:
    model = tiny()
    context = context_of(model, 3)
    futures = model.imagine(context, 3, 7, show=1.0)
    values = futures.features
    assert values.shape == (3, 3, 3, 27)
    assert not torch.allclose(values[:, 0], values[:, 1])
    assert not torch.equal(values, model.imagine(context, 3, 8).features)
    assert torch.equal(values, model.imagine(context, 3, 7).features)
    fewer = model.imagine(context.select([2, 0]), 1, 7)
    assert torch.allclose(fewer.features, values[[2, 0], :1], atol=1e-5)
    assert fewer.shown == {}
    rgb, masks = futures.shown["rgb"], futures.shown["masks"]
    assert rgb.shape == (3, 3, 3, 16, 16, 3) and rgb.dtype == torch.uint8
    assert masks.shape == (3, 3, 3, 3, 16, 16)
    assert torch.allclose(masks.sum(3), torch.ones(3, 3, 3, 16, 16), atol=1e-5)


def test_every_step_of_a_future_starts_from_samples_with_noise_of_their_own() -> None:
    """Step by step: the dynamics see z = mean + sqrt(softplus(raw) + 1e-5) noise of that step, and
    the features hold the mean."""
    model = tiny()
    context = context_of(model)
    with torch.no_grad():
        for head in (model.slots.dynamics.mean, model.slots.dynamics.raw):
            head[-1].weight.normal_()
        found = model.imagine(context, 2, 7).features
        pictures = normalized_pictures(context, model.spec, model.name)
        last = model._watch(pictures)[1][-1]
        noise = model.imagined_noise(context.trials, 7, (2, 4, 3, 5)).float()
        assert noise.shape == (4, 4, 3, 5) and len(noise.unique()) == noise.numel()
        fixed, mean, raw = (
            part.repeat_interleave(2, 0) for part in (last.deterministic, last.mean, last.raw)
        )
        for step in range(3):
            z = mean + (nn.functional.softplus(raw) + 1e-5).sqrt() * noise[:, step]
            changes = model.slots.dynamics(torch.cat([fixed, z], -1))
            fixed, mean, raw = fixed + changes[0], z + changes[1], raw + changes[2]
            expected = torch.cat([fixed, mean], -1).flatten(1).view(2, 2, -1)
            assert torch.allclose(found[:, :, step], expected, atol=1e-4)


def test_every_step_of_a_training_has_noise_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """The start, 2 + 1 refinements with what is seen, and 3 predictions."""
    model, drawn = tiny().train(), []
    randn = torch.randn

    def recorded(*size: int) -> Tensor:
        drawn.append(randn(*size))
        return drawn[-1]

    monkeypatch.setattr(torch, "randn", recorded)
    model.loss(squares(2, model.window, model.spec))
    assert [value.shape for value in drawn] == [(2, 3, 5)] * (1 + 3 + 3)
    assert len({float(value.sum()) for value in drawn}) == len(drawn)


def test_the_loss_is_by_pixel_with_beta_times_the_divergence() -> None:
    losses = []
    for beta in (0.0, 0.5):
        model = tiny(beta=beta).train()
        torch.manual_seed(0)
        model.slots.refine = lambda explained, picture, noise: explained.slots  # type: ignore
        losses.append(model.loss(squares(2, model.window, model.spec)))
    for beta, parts in zip((0.0, 0.5), losses, strict=True):
        expected = parts["nll"] + beta * parts["kl"] / 16**2
        assert parts["loss"].item() == pytest.approx(expected.item(), rel=1e-6)
    assert losses[0]["kl"].item() == pytest.approx(losses[1]["kl"].item(), rel=1e-6)
    assert losses[0]["kl"] > 0.1


def test_masks_of_seen_frames_belong_to_their_refined_slots() -> None:
    model = tiny()
    context = context_of(model, 2)
    shown = model.imagine(context, 3, 7, show=1.0).shown
    masks = shown["context_masks"]
    assert masks.shape == (2, context.rgb.shape[1], 3, 16, 16) and masks.dtype == torch.float32
    assert torch.allclose(masks.sum(2), torch.ones(masks.shape[0], masks.shape[1], 16, 16))
    # Those of a frame do not depend on the frames after it, nor on the futures.
    later = context.rgb.clone()
    later[:, -1] = 255 - later[:, -1]
    other = model.imagine(with_arrays(context, rgb=later), 1, 0, show=1.0).shown["context_masks"]
    assert torch.equal(other[:, :-1], masks[:, :-1]) and not torch.equal(other[:, -1], masks[:, -1])
    pictures = normalized_pictures(context, model.spec, model.name)
    last = model._watch(pictures)[1][-1]
    with torch.no_grad():
        expected = model.slots.decoder(last.states).masks[:, :, 0]
    assert torch.equal(masks[:, -1], expected)


def test_a_validation_is_of_frames_that_are_not_seen() -> None:
    model = tiny()
    batch = squares(2, model.window, model.spec)
    later = batch.rgb.clone()
    later[:, 2:] = 0
    shown, losses = [], []
    for rgb in (batch.rgb, later):
        torch.manual_seed(0)
        pictures = rgb.permute(0, 1, 4, 2, 3).float() / 255
        shown.append(model._run(pictures, batch.valid).imagined.detach())
        torch.manual_seed(0)
        with torch.no_grad():
            losses.append(model.loss(with_arrays(batch, rgb=rgb)))
    assert shown[0].shape == (2, 2, 3, 16, 16) and torch.equal(shown[0], shown[1])
    assert losses[0]["error"] != losses[1]["error"]
    true = batch.rgb[:, 2:].permute(0, 1, 4, 2, 3).float() / 255
    assert losses[0]["error"].item() == pytest.approx(float((shown[0] - true).pow(2).mean()))
    assert set(losses[0]) == {"loss", "error", "objective"}
    assert not any(value.requires_grad for value in losses[0].values())
    assert float(model.baseline(batch)) > 0


def test_every_weight_is_trained() -> None:
    model = tiny().train()
    model.loss(squares(2, model.window, model.spec))["loss"].backward()
    assert all(weight.grad is not None for weight in model.parameters())
