"""Models with an image encoder: sizes, names, origin of the weights, training as released."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import timm
import torch
from safetensors.torch import save_file

from physion.core.errors import BadInputError
from physion.models import build_model
from physion.models.encoders.encoder import (
    FAMILIES,
    FINE_TUNING,
    RELEASED_TRAINING,
    EncoderModel,
)
from physion.models.encoders.weights import (
    IMAGENET,
    EncoderWeights,
    create_encoder,
    input_statistics,
)
from support.tiny_models import TINY

ALL = [(family, size) for family, sizes in FAMILIES.items() for size in sizes]


@pytest.mark.parametrize(("family", "size"), ALL)
def test_family_and_size_stand_in_the_name(family: str, size: str) -> None:
    model: Any = build_model(f"{family}-lstm", size=size, hidden=2)
    pretraining = " (ImageNet)" if family == "pEffNetLite0" else ""
    assert model.provenance().model == f"{family}-lstm-{size}{pretraining}"
    assert model.provenance().encoder_pretraining_task
    random = build_model(f"{family}-lstm", size=size, hidden=2, weights="random").provenance()
    assert (
        random.model == f"random-{model.settings.encoder}-lstm-{size}" and random.init == "random"
    )
    assert random.encoder_pretraining_task == random.encoder_pretraining_dataset == ""


def test_encoders_are_those_of_the_paper_and_of_the_released_code() -> None:
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


def test_unknown_sizes_list_those_of_the_family() -> None:
    with pytest.raises(BadInputError, match="pEffNetLite0-mlp has the sizes small, paper, not"):
        build_model("pEffNetLite0-mlp", size="released")


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
@pytest.mark.parametrize("name", ["vit_small_patch14_dinov2", "vit_small_patch16_224"])
def test_dino_weights_of_another_network_are_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    state = create_encoder("test_vit", 112, EncoderWeights("random")).state_dict()
    save_file(state, path)
    with pytest.raises(BadInputError, match=r"tensors differ, \d+ missing .* another shape"):
        create_encoder(name, 112, EncoderWeights(str(path)))


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
