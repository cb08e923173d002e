"""Models with an image encoder: sizes and names, trained weights, fine-tuning, what is learned."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import timm
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional

from physion.clips.batch import Batch
from physion.core.errors import BadInputError, UnknownNameError
from physion.models.build import build_model
from physion.models.checkpoint import WEIGHTS, load_weights, tensors_of, write_checkpoint
from physion.models.encoders.encoder import (
    FAMILIES,
    FINE_TUNING,
    RELEASED_TRAINING,
    EncoderModel,
    FineTunedEncoder,
)
from physion.models.encoders.weights import (
    IMAGENET,
    EncoderWeights,
    create_encoder,
    feature_size,
    input_statistics,
)
from physion.models.interface import TrainingSettings
from physion.readout.evaluate import evaluate
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings
from physion.training.devices import Devices, make_fabric
from physion.training.train import train_model
from support.moving_dots import make_dots
from support.squares_source import SquaresSource
from support.tiny_models import TINY
from support.trained_models import MovingValues

ALL = [(family, size) for family, sizes in FAMILIES.items() for size in sizes]


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(("family", "size"), ALL)
def test_family_and_size_stand_in_the_name(family: str, size: str) -> None:
    model: Any = build_model(f"{family}-lstm", size=size, hidden=2)
    pretraining = {"pEffNetLite0": " (ImageNet)", "pHEDVGG16": " (edges)"}.get(family, "")
    pooling = "-mean" if family == "pHEDVGG16" else ""
    assert model.provenance().model == f"{family}-lstm-{size}{pretraining}"
    assert model.provenance().encoder_pretraining_task
    random = build_model(f"{family}-lstm", size=size, hidden=2, weights="random").provenance()
    assert (
        random.model == f"random-{model.settings.encoder}{pooling}-lstm-{size}"
        and random.init == "random"
    )
    assert random.encoder_pretraining_task == random.encoder_pretraining_dataset == ""


def test_encoders_match_the_paper_and_of_the_released_code() -> None:
    expected = {
        ("pVGG-mlp", "paper"): ("vgg19", 4096),
        ("pVGG-mlp", "released"): ("vgg16_bn", 4096),
        ("pDeIT-mlp", "paper"): ("deit_base_patch16_224", 768),
        ("pDeIT-mlp", "released"): ("deit_base_patch16_224", 768),
        ("pDINO-mlp", "released"): ("vit_small_patch16_224", 384),
    }
    for (name, size), (encoder, features) in expected.items():
        model: Any = build_model(name, size=size, hidden=2, weights="random")
        assert (model.provenance().encoder_type, model.feature_size) == (encoder, features)
        assert model.spec.image_size == 224 and model.settings.residual is False
        assert model.settings.standardised is (size == "paper")


def test_another_encoder_does_not_bear_the_name_of_the_family(tmp_path: Path) -> None:
    names = [
        build_model("pVGG-mlp", encoder="resnet18", hidden=2).provenance().model,
        build_model("pDINO-mlp", weights=IMAGENET, hidden=2).provenance().model,
        build_model("frozen-encoder", encoder="vgg19", hidden=2).provenance().model,
    ]
    assert names == ["resnet18-mlp", "vit_small_patch16_224-mlp", "vgg19-mlp"]
    path = tmp_path / "dino.safetensors"
    save_file({"a": torch.zeros(1)}, path)
    own = build_model("pDINO-mlp", weights=str(path), hidden=2).provenance()
    assert own.model == "pDINO-mlp-small" and own.init.startswith("local:")


def test_weights_of_timm_are_named_by_their_tag() -> None:
    weights = EncoderWeights("timm:lvd142m")
    assert weights.init() == weights.identity() == "timm:lvd142m"
    assert weights.pretraining() == ("DINOv2", "LVD-142M")
    assert EncoderWeights("timm:other").pretraining() == ("", "other")
    assert weights.path is None and weights.downloaded
    # Statistics belong to the weights: those of "augreg" are .5, those of "dino" ImageNet's.
    name = "vit_small_patch16_224"
    assert input_statistics(name, EncoderWeights("timm:dino"))[0] == (0.485, 0.456, 0.406)
    assert input_statistics(name, EncoderWeights("timm:augreg_in1k"))[0] == (0.5, 0.5, 0.5)


@pytest.mark.parametrize(
    ("encoder", "weights", "known"),
    [
        ("vit_small_patch16_224", "timm:dinosaur", "timm:dino"),
        ("vit_small_patch14_dinov2", "imagenet", "timm:lvd142m"),
        ("test_vit", "timm:", "timm:r160_in1k"),
    ],
)
def test_weights_that_timm_lacks_are_refused_at_once(
    encoder: str, weights: str, known: str
) -> None:
    with pytest.raises(BadInputError, match=rf"timm has no weights '{weights}'.*{known}") as caught:
        build_model("frozen-encoder", encoder=encoder, weights=weights, image_size=112)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_dinov2_weights_as_published_are_read_at_another_image_size(tmp_path: Path) -> None:
    name, path = "vit_small_patch14_dinov2", tmp_path / "w.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        published: Any = timm.create_model(name, pretrained=False)
    save_file(published.state_dict(), path)
    encoder: Any = create_encoder(name, 56, EncoderWeights(str(path)))
    assert published.pos_embed.shape == (1, 37 * 37 + 1, 384)
    assert encoder.pos_embed.shape == (1, 4 * 4 + 1, 384)
    for one, other in zip(encoder.blocks.parameters(), published.blocks.parameters(), strict=True):
        assert torch.equal(one, other)
    pictures = torch.rand(2, 3, 56, 56, generator=torch.Generator().manual_seed(0))
    assert encoder(pictures).shape == (2, 384)
    grid = create_encoder(name, 56, EncoderWeights(str(path)), "grid")
    assert grid(pictures).shape == (2, 16 * 384)


def test_released_training_is_adam_that_is_created_anew_at_every_step() -> None:
    target = torch.tensor([3.0, -2.0, 0.5])

    def loss(weight: torch.Tensor) -> torch.Tensor:
        return ((weight - target) ** 2 * torch.tensor([1.0, 4.0, 0.1])).sum()

    anew, kept = (torch.zeros(3, requires_grad=True) for _ in range(2))
    settings = RELEASED_TRAINING
    lasting = torch.optim.Adam([kept], lr=settings.learning_rate, betas=settings.betas)
    for _ in range(5):
        fresh = torch.optim.Adam([anew], lr=1e-2)
        for optimizer, weight in ((fresh, anew), (lasting, kept)):
            optimizer.zero_grad()
            loss(weight).backward()
            optimizer.step()
    # The first step of Adam with any decay rates is lr * g / (|g| + eps).
    assert torch.allclose(anew, kept, atol=1e-7)
    assert torch.allclose(kept.detach(), torch.tensor([0.05, -0.05, 0.05]), atol=1e-5)


def test_training_follows_the_size() -> None:
    settings = {
        size: build_model("pVGG-mlp", size=size, weights="random", hidden=2).training_settings  # type: ignore[attr-defined]
        for size in ("paper", "released")
    }
    assert settings["released"] == RELEASED_TRAINING != settings["paper"]
    model: Any = build_model("pVGG-mlp", **TINY, fine_tuned=True)
    assert model.training_settings == FINE_TUNING


def test_without_standardisation_features_stay_as_they_are() -> None:
    model = build_model("frozen-encoder", **TINY, standardised=False)
    assert isinstance(model, EncoderModel)
    features = torch.randn(3, 9, model.feature_size) * 5 + 2
    model.set_scale(features)
    assert torch.equal(model.standardise(features), features)


def test_a_rollout_predicts_from_the_last_features_and_its_own_predictions() -> None:
    """z' = z_c + d(z_1, ..., z_c) with standardised z and dynamics d that halve the oldest one."""
    model: Any = build_model("frozen-encoder", **{**TINY, "context": 3, "future": 4})
    model.dynamics.forward = lambda window: 0.5 * window[:, 0]
    features = 5 * torch.randn(2, 3, model.feature_size) + 2
    model.set_scale(features)
    center, scale = features.flatten(0, 1).mean(0), float(model.scale)
    flat = features.flatten(0, 1).double()
    assert scale == pytest.approx(float(((flat - flat.mean(0)) ** 2).mean().sqrt()), rel=1e-5)
    known = list(((features - center) / scale).unbind(1))
    for _ in range(4):
        known.append(known[-1] + 0.5 * known[-3])
    expected = torch.stack(known[3:], 1) * scale + center
    batch = MovingValues(2, spec=model.spec).context(["drop_0000", "roll_0001"])
    found = model.imagine(dataclasses.replace(batch, features=features, future=4), 2, 0).features
    assert torch.allclose(found, expected[:, None].expand(-1, 2, -1, -1), atol=1e-4)


def test_windows_are_followed_by_the_next_feature() -> None:
    model: Any = build_model("frozen-encoder", **{**TINY, "context": 3, "future": 4})
    times = torch.arange(6.0)[None, :, None] + torch.tensor([0.0, 100.0])[:, None, None]
    windows, following = model.windows(times)
    rows = [[0, 1, 2], [1, 2, 3], [2, 3, 4], [100, 101, 102], [101, 102, 103], [102, 103, 104]]
    assert windows[..., 0].tolist() == rows
    assert following[:, 0].tolist() == [row[-1] + 1 for row in rows]


# Encoder models with the weights of a training: the model is the one that was trained.

FEW: dict[str, Any] = {**TINY, "image_size": 32, "context": 2, "future": 2}
QUICK = TrainingSettings(steps=3, batch=4, learning_rate=1e-2, held_out=0.25)


def make(**options: Any) -> Any:
    return build_model("frozen-encoder", **{**FEW, **options})


def train(model: Any, folder: Path) -> Path:
    """Train a model in place; return the folder of the training."""
    source = MovingValues(count=8, spec=model.spec)
    result = train_model(
        model, source, source.trials, seed=0, name="all", folder=folder, settings=QUICK,
        features=lambda trials: list(model.encode(source.whole(trials).to("cpu")).numpy()),
        accelerator="cpu",
    )  # fmt: skip
    assert result.folder is not None
    return result.folder


def features_of(model: EncoderModel) -> tuple[torch.Tensor, torch.Tensor]:
    """Return features of a context, and of what the dynamics imagine to follow it."""
    source = MovingValues(count=2, spec=model.spec)
    context = source.context(source.trials).to("cpu")
    seen = model.encode(context)
    known = Batch(context.trials, context.frames, context.valid, features=seen, future=2)
    with torch.no_grad():
        return seen, model.imagine(known, 1, 0).features


@pytest.mark.parametrize("fine_tuned", [False, True])
@pytest.mark.parametrize("name", ["", WEIGHTS], ids=["folder", "file"])
def test_weights_of_a_training_give_the_trained_model(
    tmp_path: Path, fine_tuned: bool, name: str
) -> None:
    model = make(fine_tuned=fine_tuned, seed=3)
    untrained = features_of(model)[1]
    folder = train(model, tmp_path)
    # The seed of the random encoder is that of the training.
    loaded = make(fine_tuned=fine_tuned, seed=0, weights=str(folder / name))
    assert loaded.digest() == model.digest() and loaded.encoder_digest() == model.encoder_digest()
    for own, trained in zip(features_of(loaded), features_of(model), strict=True):
        assert torch.equal(own, trained)
    assert not torch.equal(features_of(loaded)[1], untrained)
    assert loaded.trained and not model.trained
    before, after = model.provenance(), loaded.provenance()
    assert after.init.startswith("local:") and before.init == "random"
    assert (after.model, after.encoder_type) == (before.model, before.encoder_type)
    assert after.encoder_pretraining_seed == before.encoder_pretraining_seed == "3"


def test_a_family_keeps_its_name_and_its_encoder_from_a_file(tmp_path: Path) -> None:
    own = tmp_path / "encoder.safetensors"
    encoder = create_encoder("deit_tiny_patch16_224", 32, EncoderWeights("random", 5))
    save_file(encoder.state_dict(), own)
    options = {"image_size": 32, "hidden": 4, "context": 2, "future": 2}
    model: Any = build_model("pDeIT-mlp", weights=str(own), **options)
    folder = train(model, tmp_path / "trainings")
    loaded = build_model("pDeIT-mlp", weights=str(folder), **options)
    assert loaded.provenance().model == model.provenance().model == "pDeIT-mlp-small"
    assert loaded.digest() == model.digest()
    state = encoder.state_dict()
    next(iter(state.values())).view(-1)[0] += 1
    save_file(state, own)
    with pytest.raises(BadInputError, match="another model: encoder was local:"):
        build_model("pDeIT-mlp", weights=str(folder), **options)


def test_weights_of_another_training_are_refused(tmp_path: Path) -> None:
    folder = train(make(), tmp_path)
    with pytest.raises(BadInputError, match=r"settings\.hidden was 16 and is 8"):
        make(hidden=8, weights=str(folder))
    with pytest.raises(BadInputError, match=r"settings\.fine_tuned was False and is True"):
        make(fine_tuned=True, weights=str(folder))
    cswm: Any = build_model("cswm")
    other = tmp_path / "cswm.safetensors"
    write_checkpoint(other, tensors_of(cswm), {"built_as": cswm.built_as()})
    with pytest.raises(BadInputError, match="does not say with which encoder it was trained"):
        make(weights=str(other))
    with pytest.raises(BadInputError, match="weights"):
        make(weights=str(tmp_path / "absent")).encode(MovingValues(1).context(["drop_0000"]))


@pytest.mark.nightly
@pytest.mark.slow
def test_an_evaluation_does_not_train_it_again(tmp_path: Path) -> None:
    counts = {"training": 4, "readout": 8, "testing": 4}
    dots = make_dots(tmp_path / "dots", counts, ("collide",))
    folder = train(make(context=3), tmp_path / "trainings")
    config = EvaluationSettings(accelerator="cpu", logistic=LogisticSettings(grid=(1e-2,)))
    options = {**FEW, "context": 3, "weights": str(folder)}
    table = evaluate(
        "frozen-encoder", dots, tmp_path / "out", options=options, settings=config
    ).predictions
    assert table["init"].str.startswith("local:").all()
    assert np.isfinite(table["p_contact"]).all()
    assert not (tmp_path / "out" / "training").exists()


# Encoders that are trained with the dynamics: gradients, digests, features that stay different.

FEW_PICTURES: dict[str, Any] = {
    **TINY, "image_size": 32, "context": 2, "future": 2, "fine_tuned": True,
}  # fmt: skip
QUICK_TUNING = TrainingSettings(steps=3, batch=4, learning_rate=1e-3, held_out=0.25)


def fine_tuned(**options: Any) -> FineTunedEncoder:
    model = build_model("frozen-encoder", **{**FEW_PICTURES, **options})
    assert isinstance(model, FineTunedEncoder)
    return model


def clips(count: int = 4, frames: int = 3, size: int = 32, seed: int = 0) -> Batch:
    """A bright square that moves by some pixels each frame, on a noisy ground."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 60, (count, frames, size, size, 3), dtype=np.uint8)
    for clip in range(count):
        x, y, step = rng.integers(0, size - 14, 2).tolist() + rng.integers(1, 4, 1).tolist()
        for frame in range(frames):
            left = x + step * frame
            rgb[clip, frame, y : y + 8, left : left + 8] = (220, 180, 40)
    return Batch(
        tuple(f"t{row}" for row in range(count)),
        np.tile(np.arange(frames), (count, 1)),
        np.ones((count, frames), np.bool_),
        rgb=rgb,
    ).to("cpu")


def gradients(model: FineTunedEncoder, loss: Tensor) -> list[Tensor]:
    model.zero_grad()
    loss.backward()
    return [p.grad.clone() for p in model.parameters() if p.grad is not None]


def test_gradients_reach_encoder_and_dynamics_but_not_the_initial_encoder() -> None:
    model, batch = fine_tuned(residual=False), clips()
    model.prepare(batch)
    model.loss(batch)["loss"].backward()
    for part in (model.encoder, model.dynamics):
        assert all(p.grad is not None for p in part.parameters())
        assert sum(float(p.grad.abs().sum()) for p in part.parameters()) > 0  # type: ignore[union-attr]
    assert not any(p.requires_grad for p in model._initial[0].parameters())


def test_no_gradient_passes_through_the_target() -> None:
    model, batch = fine_tuned(residual=False, distillation=0.5), clips()
    model.prepare(batch)
    with torch.no_grad():
        for parameter in model.encoder.parameters():
            parameter += 0.01 * torch.randn(parameter.shape, generator=torch.manual_seed(0))
    initial = model._initial[0]

    def by_hand(stopped: bool) -> Tensor:
        pictures = batch.rgb.float().permute(0, 1, 4, 2, 3) / 255
        mean, std = (torch.tensor(v).view(3, 1, 1) for v in (model.spec.mean, model.spec.std))
        flat = ((pictures - mean) / std).flatten(0, 1)
        z, z0 = (
            (network(flat).view(4, 3, -1) - model.center) / model.scale
            for network in (model.encoder, initial)
        )
        target = z[:, 2].detach() if stopped else z[:, 2]
        prediction = (model.dynamics(z[:, :2]) - target).pow(2).mean()
        return prediction + 0.5 * (z - z0).pow(2).mean()

    own = gradients(model, model.loss(batch)["loss"])
    stopped, open_ = (gradients(model, by_hand(stopped)) for stopped in (True, False))
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(own, stopped, strict=True))
    assert not all(torch.allclose(a, b, atol=1e-5) for a, b in zip(own, open_, strict=True))


def test_before_training_the_loss_matches_the_frozen_encoder() -> None:
    """Residual dynamics add nothing at first, so that it is that of repeating the last feature."""
    model, batch = fine_tuned(), clips()
    model.prepare(batch)
    losses = model.loss(batch)
    assert float(losses["change"].detach()) == pytest.approx(0, abs=1e-10)
    assert float(losses["variance"]) == pytest.approx(1, rel=1e-4)
    assert float(losses["loss"].detach()) == pytest.approx(float(model.baseline(batch)), rel=1e-5)
    frozen: Any = build_model("frozen-encoder", **{**FEW_PICTURES, "fine_tuned": False})
    assert torch.equal(frozen.encode(batch), model.encode(batch))


def descend(model: FineTunedEncoder, steps: int, rate: float, *, fixed: bool) -> None:
    """Train on one batch, or on another one at each step, with clipped gradients."""
    optimizer = torch.optim.Adam(model.parameters(), lr=rate)
    for step in range(steps):
        optimizer.zero_grad()
        model.loss(clips(seed=0 if fixed else step))["loss"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()


class _WithoutDistillation(FineTunedEncoder):
    """Encoder and dynamics that are trained on the error of the next feature alone."""

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        features = self.standardise(self.features_of(self.encoder, batch))
        windows, target = self.windows(features)
        variance = features.detach().flatten(0, 1).var(0, correction=0).mean()
        return {"loss": functional.mse_loss(self.step(windows), target), "variance": variance}


@pytest.mark.nightly
@pytest.mark.slow
def test_features_of_different_pictures_stay_different() -> None:
    """Where the loss of the next feature alone makes them equal."""
    kept, lost = (fine_tuned(encoder="test_efficientnet") for _ in range(2))
    lost.__class__ = _WithoutDistillation
    unseen = clips(16, seed=1000)
    variances = []
    for model in (kept, lost):
        model.prepare(clips(16))
        descend(model, 100, FINE_TUNING.learning_rate, fixed=False)
        variances.append(float(model.loss(unseen)["variance"]))
    assert variances[0] > 0.25 and variances[1] < 0.1


@pytest.mark.parametrize("options", [{}, {"weights": "random", "dynamics": "lstm"}])
def test_the_name_says_fine_tuned(options: dict[str, Any]) -> None:
    provenance = fine_tuned(**options).provenance()
    assert provenance.model == f"random-test_vit-{options.get('dynamics', 'mlp')}-fine-tuned"
    assert provenance.encoder_training_task == "L2 on latent, distillation of the initial encoder"
    assert build_model("frozen-encoder", **TINY).provenance().encoder_training_task == ""


def test_a_training_changes_both_digests_and_its_weights_give_the_same_features(
    tmp_path: Path,
) -> None:
    model = fine_tuned()
    before = model.digest(), model.encoder_digest()
    source = MovingValues(count=8, spec=model.spec)
    result = train_model(
        model, source, source.trials, seed=0, name="all", folder=tmp_path, settings=QUICK_TUNING,
        fabric=make_fabric(Devices("cpu")),
    )  # fmt: skip
    after = model.digest(), model.encoder_digest()
    assert len({*before, *after}) == 4
    assert fine_tuned().encoder_digest() == before[1], (
        "which depends on no random number of its own"
    )
    assert result.folder is not None and np.isfinite(result.baseline)
    loaded, batch = fine_tuned(), clips()
    load_weights(result.folder / WEIGHTS, loaded)
    assert (loaded.digest(), loaded.encoder_digest()) == after
    assert torch.equal(loaded.encode(batch), model.encode(batch))
    assert not torch.equal(loaded.encode(batch), fine_tuned().encode(batch))


def test_statistics_of_batch_normalisation_stay_as_they_are() -> None:
    model = fine_tuned(encoder="test_resnet")
    batch = clips()
    model.prepare(batch)
    kept = {k: v.clone() for k, v in model.encoder.state_dict().items() if "running" in k}
    model.train()
    assert model.training and model.dynamics.training and not model.encoder.training
    model.loss(batch)["loss"].backward()
    now = model.encoder.state_dict()
    assert kept and all(torch.equal(value, now[name]) for name, value in kept.items())


@pytest.mark.nightly
@pytest.mark.slow
def test_evaluation_trains_the_encoder_of_each_fold_and_reads_its_features(tmp_path: Path) -> None:
    counts = {"training": 4, "readout": 8, "testing": 4}
    dots = make_dots(tmp_path / "dots", counts, ("collide", "drop"))
    settings = EvaluationSettings(accelerator="cpu", logistic=LogisticSettings(grid=(1e-2,)))
    options = {**FEW_PICTURES, "context": 3, "image_size": 32, "steps": 2, "batch": 2}
    table = evaluate(
        "frozen-encoder", dots, tmp_path, protocols="only", options=options, settings=settings
    ).predictions
    assert (table["model"] == "random-test_vit-mlp-fine-tuned").all()
    assert set(table["readout"]) == {"observed", "observed+simulated", "full"}
    assert np.isfinite(table["p_contact"]).all()
    # Features of two encoders, one for each training.
    assert len(list((tmp_path / "features" / "whole").iterdir())) == 2


# What dynamics learn of features of EfficientNet-Lite0 (ImageNet): squares that move.
#
# Rendered trials: `benchmarks/models/vision_models.py learn`.

NAMES = ("pEffNetLite0-mlp", "pEffNetLite0-lstm")
OPTIONS: dict[str, Any] = {"image_size": 64, "context": 3, "future": 4, "hidden": 256}
TRAINED, TESTED = 200, 60


def encoded(source: SquaresSource) -> Batch:
    """Return whole clips with their features."""
    model: Any = build_model(NAMES[0], **OPTIONS)
    clips = source.whole(source.trials).to("cpu")
    rows = np.array_split(np.arange(len(clips)), 10)
    features = torch.cat([model.encode(clips.select(part)) for part in rows])
    return dataclasses.replace(clips, features=features)


@pytest.fixture(scope="module")
def source() -> SquaresSource:
    return SquaresSource(build_model(NAMES[0], **OPTIONS).spec, TRAINED)


@pytest.fixture(scope="module")
def training(source: SquaresSource) -> NDArray[np.float32]:
    return np.asarray(encoded(source).features)


@pytest.fixture(scope="module")
def testing(source: SquaresSource) -> Batch:
    return encoded(SquaresSource(source.spec, TESTED, seed=99))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_next_feature_is_nearer_than_the_last_one(
    source: SquaresSource, training: NDArray[np.float32], testing: Batch, name: str
) -> None:
    """Untrained dynamics repeat the last feature."""

    def features(trials: Sequence[str]) -> NDArray[np.float32]:
        assert list(trials) == list(source.trials)
        return training

    model: Any = build_model(name, **OPTIONS)
    settings = dataclasses.replace(model.training_settings, steps=300)
    trained = train_model(
        model, source, source.trials, settings=settings, seed=0, name="all", folder=None,
        features=features, accelerator="cpu",
    )  # fmt: skip
    with torch.no_grad():
        error, last = float(model.loss(testing)["loss"]), float(model.baseline(testing))
    print(f"{model.name()}: {error / last:.3f} of the error of the last feature")
    assert error < 0.95 * last
    assert trained.validation < trained.baseline


def test_a_name_of_timm_is_built_as_it_was_published() -> None:
    model: Any = build_model("timm:test_vit", weights="random", hidden=2)
    assert model.spec.image_size == 160 == timm.get_pretrained_cfg("test_vit").input_size[-1]
    assert model.provenance().model == "random-test_vit-mlp"
    for name, tag in (
        ("timm:vit_small_patch14_dinov2", "lvd142m"),
        ("timm:vit_small_patch16_dinov3", "lvd1689m"),
        ("timm:vit_base_patch16_224.augreg_in21k", "augreg_in21k"),
    ):
        encoder = name.removeprefix("timm:").partition(".")[0]
        known = timm.get_pretrained_cfg(f"{encoder}.{tag}")
        model = build_model(name, hidden=2)
        assert model.provenance().init == f"timm:{tag}"
        assert model.spec.image_size == known.input_size[-1]
        assert (model.spec.mean, model.spec.std) == (known.mean, known.std)
    with pytest.raises(UnknownNameError, match="unknown timm encoder 'nonet'"):
        build_model("timm:nonet")
    with pytest.raises(BadInputError, match="timm has no weights 'timm:x' of 'test_vit'"):
        build_model("timm:test_vit.x")


def test_features_of_a_layer_are_the_output_of_that_block() -> None:
    """Compared with what a hook on the block sees; the class token is no position."""
    random = EncoderWeights("random", 3)
    whole: Any = create_encoder("test_vit", 64, random)
    seen: list[Tensor] = []
    whole.blocks[3].register_forward_hook(lambda block, given, output: seen.append(output))
    pictures = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    last = whole(pictures)
    patches = seen[0][:, whole.num_prefix_tokens :]
    chosen = create_encoder("test_vit", 64, random, layer=4)
    assert torch.allclose(chosen(pictures), patches.mean(1), atol=1e-6)
    cells = create_encoder("test_vit", 64, random, "grid", 4)(pictures)
    assert torch.allclose(cells, patches.flatten(1), atol=1e-6), "4 x 4 patches of 16 pixels"
    tokens = whole.forward_features(pictures)[:, whole.num_prefix_tokens :]
    mean = create_encoder("test_vit", 64, random, "mean")(pictures)
    assert torch.allclose(mean, tokens.mean(1), atol=1e-6) and not torch.allclose(mean, last)
    for layer, message in ((7, "no layer 7; choose 1 to 6"), (0, "no layer 0")):
        with pytest.raises(BadInputError, match=message):
            build_model("frozen-encoder", **TINY, layer=layer)


def test_the_stem_of_a_network_is_its_first_layer() -> None:
    """As the reference says of resnet18, whose stages have 64, 128, 256 and 512 channels."""
    sizes = [feature_size("resnet18", 64, "mean", layer) for layer in range(1, 6)]
    assert sizes == [64, 64, 128, 256, 512]
    with pytest.raises(BadInputError, match="choose 1 to 5"):
        feature_size("resnet18", 64, "mean", 6)


def test_a_layer_is_another_model_and_none_leaves_everything_as_it_was() -> None:
    plain: Any = build_model("frozen-encoder", **TINY)
    chosen: Any = build_model("frozen-encoder", **TINY, layer=2)
    assert chosen.name() == "random-test_vit-layer2-mlp"
    for method in ("digest", "encoder_digest", "readout_digest"):
        assert getattr(plain, method)() != getattr(chosen, method)()
    assert "layer" not in plain.built_as()["settings"], "as trainings before there was a choice"
