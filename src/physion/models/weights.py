"""Weights of image encoders: timm's pretrained ones, a local file, or random ones."""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import socket
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import timm
import torch
from huggingface_hub import constants as hub
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from physion.errors import BadInputError, UnknownNameError
from physion.seeds import stable_hash

IMAGENET, RANDOM = "imagenet", "random"
_WRAPPERS = ("state_dict", "model", "model_state_dict")
"""Keys of the state dict in the checkpoints of common training scripts."""


@dataclass(frozen=True, slots=True)
class EncoderWeights:
    """Weights of an encoder: ``imagenet``, ``random`` (with a seed), or the path of a file.

    The file holds a state dict, as ``.safetensors`` or as a torch file of plain tensors, and is
    identified by its SHA-256.
    """

    source: str
    seed: int = 0

    def init(self) -> str:
        """Return the value of the column *Init*: imagenet, random, or local:<start of SHA-256>."""
        if self.source in (IMAGENET, RANDOM):
            return self.source
        return f"local:{_file_sha256(Path(self.source))[:12]}"

    def identity(self) -> str:
        """Return one string that identifies the weights."""
        if self.source == RANDOM:
            return f"random:{self.seed}:torch{torch.__version__}"
        if self.source == IMAGENET:
            return IMAGENET
        return f"local:{_file_sha256(Path(self.source))}"


def check_encoder_name(name: str) -> None:
    """Raise `UnknownNameError` with the closest names unless timm knows ``name``."""
    if not timm.is_model(name):
        raise UnknownNameError("timm encoder", name, timm.list_models())


def create_encoder(name: str, image_size: int, weights: EncoderWeights) -> nn.Module:
    """Build a frozen timm encoder without its classifier, in evaluation mode.

    It maps (batch, 3, image_size, image_size) float32 to (batch, features), the input of timm's
    classifier: the class token of a transformer, the pooled map of a convolutional network, and
    for VGG the second fully connected layer before its ReLU, as in the released code.
    """
    check_encoder_name(name)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(stable_hash("encoder", name, weights.seed) % 2**63)
        encoder = _create(name, image_size, pretrained=weights.source == IMAGENET)
    if weights.source not in (IMAGENET, RANDOM):
        _load_local(encoder, name, Path(weights.source))
    head = getattr(encoder, "pre_logits", None)
    if head is not None and hasattr(head, "act2"):
        head.act2 = nn.Identity()
    return encoder.eval().requires_grad_(False)


def feature_size(name: str, image_size: int) -> int:
    """Return the number of features of one frame, without creating the weights."""
    check_encoder_name(name)
    with torch.device("meta"):
        encoder = _create(name, image_size, pretrained=False).eval()
        features = encoder(torch.zeros(1, 3, image_size, image_size))
    if features.ndim != 2:
        raise BadInputError(f"encoder {name!r} gives {tuple(features.shape)}, not a row per frame")
    return int(features.shape[1])


def input_statistics(
    name: str,
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return mean and standard deviation of the channels with which the encoder was trained."""
    check_encoder_name(name)
    known = timm.get_pretrained_cfg(name, allow_unregistered=False)
    assert known is not None, "checked above"
    (m0, m1, m2), (s0, s1, s2) = known.mean, known.std
    return (m0, m1, m2), (s0, s1, s2)


def _create(name: str, image_size: int, *, pretrained: bool) -> nn.Module:
    known = timm.get_pretrained_cfg(name, allow_unregistered=False)
    # Only networks of a fixed input size (transformers) take this argument.
    fixed: dict[str, Any] = (
        {"img_size": image_size} if known is not None and known.fixed_input_size else {}
    )
    offline = _offline_without_network() if pretrained else contextlib.nullcontext()
    try:
        with offline:
            model: nn.Module = timm.create_model(
                name, pretrained=pretrained, num_classes=0, **fixed
            )
    except Exception as error:
        if not pretrained:
            raise
        # The exceptions of timm's downloader depend on its version.
        raise BadInputError(
            f"imagenet weights of {name!r} could not be fetched "
            f"({type(error).__name__}: {_first_line(error)}); use weights=<file> with a state dict"
            ", or weights=random (the tables name it)"
        ) from error
    return model


@contextlib.contextmanager
def _offline_without_network() -> Iterator[None]:
    """Use the local cache alone without a network; the hub would retry for most of a minute."""
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
    if convert := getattr(module, "checkpoint_filter_fn", None):
        state = convert(state, encoder)
    elif convert := getattr(module, "_filter_fn", None):
        state = convert(state)
    try:
        result = encoder.load_state_dict(state, strict=False)
    except RuntimeError as error:
        raise BadInputError(f"{path} does not fit encoder {name!r}: {error}") from error
    # Unused classifier weights are harmless; missing encoder weights would stay random.
    if result.missing_keys:
        raise BadInputError(
            f"{path} lacks {len(result.missing_keys)} tensors of encoder {name!r}, "
            f"such as {result.missing_keys[0]!r}; is it the state dict of another network?"
        )


def read_state_dict(path: Path) -> dict[str, Tensor]:
    """Read tensors by name from ``.safetensors`` or a torch file of plain tensors.

    Torch files are read with ``weights_only``, so that no code in the file is executed. Raises
    `BadInputError` for any other content.
    """
    if not path.is_file():
        raise BadInputError(
            f"weights {str(path)!r}: no such file; choose imagenet, random, or a state dict"
        )
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, SafetensorError) as error:
        raise BadInputError(
            f"{path} is refused: it is not a file of plain tensors ({_first_line(error)}); "
            "save the state dict alone, best as .safetensors"
        ) from error
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise BadInputError(f"{path} cannot be read as weights: {_first_line(error)}") from error
    while isinstance(content, dict) and (inner := _wrapped(content)) is not None:
        content = inner
    if not isinstance(content, dict) or not all(isinstance(v, Tensor) for v in content.values()):
        raise BadInputError(f"{path} holds no state dict of tensors by name")
    return content


def _wrapped(content: dict[str, Any]) -> dict[str, Any] | None:
    return next((content[k] for k in _WRAPPERS if isinstance(content.get(k), dict)), None)


def _file_sha256(path: Path) -> str:
    if not path.is_file():
        raise BadInputError(
            f"weights {str(path)!r}: no such file; choose imagenet, random, or a state dict"
        )
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or ["no message"])[0]
