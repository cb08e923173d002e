"""SVG: networks as published, what decodes what, sampled futures, bad input."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from physion.clips.batch import Batch
from physion.models.build import build_model, make_settings
from physion.models.svg import CodePredictor, Decoder, Encoder, GaussianPredictor, Svg, SvgSettings
from physion.models.vision import copy_error, moving_pixels
from support.moving_squares import squares, with_arrays

TINY = SvgSettings(
    image_size=16, width=4, code=6, latent=3, hidden=8, past=3, imagined=2, context=4, future=3,
    weights="random",
)  # fmt: skip


def sized(size: str, **options: Any) -> SvgSettings:
    return make_settings(SvgSettings, "svg", {"size": size, **options})


def tiny(**changes: Any) -> Svg:
    return Svg(replace(TINY, **changes)).eval()


def context_of(model: Svg, clips: int = 2) -> Batch:
    return squares(clips, model.spec.context, model.spec)


@pytest.mark.parametrize("backbone", ["dcgan", "vgg"])
@pytest.mark.parametrize("size", [16, 64, 128])
def test_the_decoder_mirrors_the_encoder(backbone: Any, size: int) -> None:
    config = replace(TINY, backbone=backbone, image_size=size)
    codes, skips = Encoder(config)(torch.rand(2, 3, size, size))
    assert codes.shape == (2, 6) and codes.abs().max() <= 1
    first = size if backbone == "vgg" else size // 2
    assert [skip.shape[-1] for skip in skips] == [first >> stage for stage in range(len(skips))]
    assert skips[-1].shape[-1] == (8 if backbone == "vgg" else 4)
    pictures = Decoder(config)(codes, skips)
    assert pictures.shape == (2, 3, size, size) and 0 <= pictures.min() <= pictures.max() <= 1


def convolutions(network: nn.Module) -> list[tuple[int, int, int]]:
    """Return inputs, outputs and kernel of all convolutions in order."""
    kinds = (nn.Conv2d, nn.ConvTranspose2d)
    return [
        (part.in_channels, part.out_channels, part.kernel_size[0])
        for part in network.modules()
        if isinstance(part, kinds)
    ]


def test_paper_has_the_published_layers() -> None:
    """Of vgg_64 and dcgan_128 with one code of 128."""
    vgg = sized("paper")
    stages = [(64, 2), (128, 2), (256, 3), (512, 3)]
    expected, before = [], 3
    for width, count in stages:
        for _ in range(count):
            expected.append((before, width, 3))
            before = width
    assert convolutions(Encoder(vgg)) == [*expected, (512, 128, 4)]
    assert convolutions(Decoder(vgg)) == [
        (128, 512, 4), (1024, 512, 3), (512, 512, 3), (512, 256, 3), (512, 256, 3), (256, 256, 3),
        (256, 128, 3), (256, 128, 3), (128, 64, 3), (128, 64, 3), (64, 3, 3),
    ]  # fmt: skip
    dcgan = sized("paper", backbone="dcgan", image_size=128)
    assert convolutions(Encoder(dcgan)) == [
        (3, 64, 4), (64, 128, 4), (128, 256, 4), (256, 512, 4), (512, 512, 4), (512, 128, 4),
    ]  # fmt: skip
    assert convolutions(Decoder(dcgan)) == [
        (128, 512, 4), (1024, 512, 4), (1024, 256, 4), (512, 128, 4), (256, 64, 4), (128, 3, 4),
    ]  # fmt: skip


def test_sizes_and_their_names() -> None:
    small, released = build_model("svg"), sized("released")
    assert small.provenance().model == "svg-small" and small.spec.image_size == 64
    assert released.skip == "before" and sized("paper").skip == "last"
    named = build_model("svg", backbone="vgg", image_size=32, weights="random")
    assert isinstance(named, Svg) and named.name == "svg-small-vgg-32"
    assert named.encode(squares(1, 2, named.spec)).shape == (1, 2, 64)


def test_a_sequence_is_the_same_step_by_step() -> None:
    torch.manual_seed(0)
    codes = torch.randn(2, 5, 6)
    for network in (CodePredictor(6, TINY), GaussianPredictor(TINY)):
        whole = network(codes)[0]
        state, steps = None, []
        for step in range(5):
            out = network(codes[:, step : step + 1], state)
            state = out[-1]
            steps.append(out[0])
        assert torch.allclose(torch.cat(steps, 1), whole, atol=1e-6)


class FirstSkips(nn.Module):
    """Decoder that keeps the skip connections, and shows gray."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[Tensor] = []

    def forward(self, codes: Tensor, skips: list[Tensor]) -> Tensor:
        self.seen.append(skips[0])
        return torch.full((len(codes), 3, 16, 16), 0.5) + 0 * codes.sum()


@pytest.mark.parametrize(("skip", "rows"), [("last", [0, 1, 2, 2]), ("before", [0, 1, 1, 1])])
def test_a_frame_is_decoded_with_the_activations_of_a_seen_one(skip: Any, rows: list[int]) -> None:
    model = tiny(skip=skip)
    batch = squares(2, model.window, model.spec)
    model.decoder = decoder = FirstSkips()
    model.train().loss(batch)
    inner = model.encoder(batch.rgb.flatten(0, 1).permute(0, 3, 1, 2).float() / 255)[1][0]
    inner = inner.unflatten(0, (2, model.window))
    assert torch.equal(decoder.seen[0], inner[:, rows].flatten(0, 1))
    decoder.seen.clear()
    with torch.no_grad():
        model.eval().loss(batch)
    last = 2 if skip == "last" else 1
    assert len(decoder.seen) == 3, "the objective, and two imagined frames"
    assert all(torch.allclose(seen, inner[:, last], atol=1e-4) for seen in decoder.seen[1:])


def test_the_loss_follows_the_equations() -> None:
    """With a gray decoder the error is known, and the weight of the divergence is beta.

    The divergence is KL(posterior || prior) = (log(w / v) + (v + (m - n)^2) / w - 1) / 2 by
    component, for the posterior N(m, v) and the prior N(n, w); the other way around it is 2.98.
    """
    model = tiny(beta=0.5, motion=0.0)
    m, v, n, w = (0.5, -1.0, 2.0), (0.25, 1.0, 4.0), (0.0, 1.0, 2.5), (1.0, 0.5, 2.0)
    with torch.no_grad():
        for network, mean, variance in ((model.posterior, m, v), (model.prior, n, w)):
            for head, values in (
                (network.mean, torch.tensor(mean)),
                (network.log_variance, torch.tensor(variance).log()),
            ):
                head.weight.zero_()
                head.bias.copy_(values)
    components = [
        (math.log(wk / vk) + (vk + (mk - nk) ** 2) / wk - 1) / 2
        for mk, vk, nk, wk in zip(m, v, n, w, strict=True)
    ]
    batch = squares(2, model.window, model.spec)
    model.decoder = FirstSkips()  # type: ignore[assignment]
    losses = model.train().loss(batch)
    true = batch.rgb[:, 1:].float() / 255
    assert losses["error"].item() == pytest.approx(float((true - 0.5).pow(2).mean()), rel=1e-5)
    assert losses["kl"].item() == pytest.approx(sum(components), rel=1e-5)
    expected = losses["error"] + 0.5 * losses["kl"]
    assert losses["loss"].item() == pytest.approx(expected.item(), rel=1e-6)


def test_the_posterior_sees_the_predicted_frame_and_the_prior_does_not() -> None:
    model = tiny().train()
    batch = squares(2, model.window, model.spec)
    later = batch.rgb.clone()
    later[:, -1] = 255 - later[:, -1]
    seen: dict[str, list[Tensor]] = {"posterior": [], "prior": []}
    for name, found in seen.items():
        getattr(model, name).register_forward_hook(
            lambda _, inputs, out, found=found: found.append(out[0])
        )
    for rgb in (batch.rgb, later):
        model.loss(with_arrays(batch, rgb=rgb))
    before, after = seen["posterior"]
    assert before.shape[1] == model.window - 1
    assert torch.allclose(before[:, :-1], after[:, :-1], atol=1e-5)
    assert (before[:, -1] - after[:, -1]).abs().max() > 1e-4
    assert torch.allclose(*seen["prior"], atol=1e-5)


def test_moving_pixels_have_a_weight_in_training() -> None:
    batch = squares(2, 5, tiny().spec)
    pictures = batch.rgb.permute(0, 1, 4, 2, 3).float() / 255
    errors = []
    for motion in (0.0, 3.0):
        model = tiny(motion=motion).train()
        model.decoder = FirstSkips()  # type: ignore[assignment]
        errors.append(float(model.loss(batch)["error"].detach()))
    squared = (pictures[:, 1:] - 0.5).pow(2).mean(2)
    moving = (squared * moving_pixels(pictures)).mean()
    assert errors[1] - errors[0] == pytest.approx(3 * float(moving), rel=1e-4) and moving > 0


def test_frames_that_a_movie_lacks_do_not_count() -> None:
    model = tiny(motion=0.0).train()
    batch = squares(2, model.window, model.spec)
    valid = batch.valid.clone()
    valid[:, -1] = False
    rgb = batch.rgb.clone()
    rgb[:, -1] = 255
    losses = []
    for pictures in (batch.rgb, rgb):
        torch.manual_seed(0)
        losses.append(model.loss(with_arrays(batch, rgb=pictures, valid=valid))["error"])
    assert torch.equal(losses[0], losses[1])


def test_a_validation_is_of_what_is_imagined_from_the_observed_frames() -> None:
    model = tiny()
    batch = squares(2, model.window, model.spec)
    later = batch.rgb.clone()
    later[:, model.settings.past :] = 0
    seen: list[Tensor] = []
    roll_out = model._roll_out

    def recorded(pictures: Tensor, noise: Tensor) -> Any:
        out = roll_out(pictures, noise)
        seen.append(out.pictures)
        return out

    model._roll_out = recorded  # type: ignore[method-assign]
    errors = []
    for rgb in (batch.rgb, later):
        torch.manual_seed(0)
        with torch.no_grad():
            errors.append(model.loss(with_arrays(batch, rgb=rgb)))
    assert torch.equal(seen[0], seen[1]) and errors[0]["error"] != errors[1]["error"]
    assert set(errors[0]) == {"loss", "error", "objective"}
    true = batch.rgb[:, -2:].permute(0, 1, 4, 2, 3).float() / 255
    assert errors[0]["error"].item() == pytest.approx(float((seen[0] - true).pow(2).mean()))
    pictures = batch.rgb.permute(0, 1, 4, 2, 3).float() / 255
    expected = copy_error(pictures, 2, batch.valid).moving
    assert torch.equal(model.baseline(batch), expected) and expected > 0


def test_futures_follow_from_seed_and_name_of_the_trial() -> None:
    model = tiny()
    with torch.no_grad():
        model.prior.mean.bias.normal_()
        model.predictor.out.weight.normal_()
        context = context_of(model, 3)
        futures = model.imagine(context, 3, 7, show=1.0)
        values = futures.features
        assert values.shape == (3, 3, 3, 6)
        assert not torch.allclose(values[:, 0], values[:, 1])
        assert not torch.equal(values, model.imagine(context, 3, 8).features)
        assert torch.equal(values, model.imagine(context, 3, 7).features)
        fewer = model.imagine(context.select([2, 0]), 1, 7)
    assert torch.allclose(fewer.features, values[[2, 0], :1], atol=1e-5)
    assert fewer.shown == {}
    rgb = futures.shown["rgb"]
    assert rgb.shape == (3, 3, 3, 16, 16, 3) and rgb.dtype == torch.uint8


class ShowsLatents(nn.Module):
    """Predictor whose codes are the values of z, twice."""

    def forward(self, inputs: Tensor, state: Any = None) -> tuple[Tensor, Any]:
        return torch.cat([inputs[..., -3:]] * 2, -1), state


def test_every_step_of_a_future_has_noise_of_its_own() -> None:
    """With priors N(0, 1), z of frame t are the numbers t - 1, after the 3 of seen frames."""
    model = tiny()
    model.predictor = ShowsLatents()  # type: ignore[assignment]
    with torch.no_grad():
        for weight in (*model.prior.parameters(), *model.posterior.parameters()):
            weight.zero_()
        context = context_of(model)
        codes = model.imagine(context, 2, 7).features
    noise = model.imagined_noise(context.trials, 7, (2, 6, 3)).view(2, 2, 6, 3)
    assert torch.allclose(codes[..., :3], noise[:, :, 3:].float(), atol=1e-6)


@pytest.mark.parametrize("skip", ["last", "before"])
def test_a_future_matches_the_equations(skip: Any) -> None:
    """Step by step, with z at the means: the variances are close to 0."""
    model = tiny(skip=skip)
    with torch.no_grad():
        for network in (model.prior, model.posterior):
            network.log_variance.weight.zero_()
            network.log_variance.bias.fill_(-60)
        model.predictor.out.weight.normal_()
        context = context_of(model, 1)
        codes = list(model.encode(context)[0])
        pictures = context.rgb[0].permute(0, 3, 1, 2).float() / 255
        skips = model.encoder(pictures)[1]
        row = 3 if skip == "last" else 2
        for _ in range(3):
            history = torch.stack(codes)[None]
            latents = model.posterior(history[:, 1:4])[0]
            later = model.prior(history)[0][:, 3:]
            inputs = torch.cat([history, torch.cat([latents, later], 1)], -1)
            code = model.predictor(inputs)[0][0, -1]
            picture = model.decoder(code[None], [skip[row : row + 1] for skip in skips])
            codes.append(model.encoder(picture)[0][0])
            predicted = code
        imagined = model.imagine(context, 1, 0).features[0, 0]
    assert torch.allclose(imagined[-1], predicted, atol=1e-5)
