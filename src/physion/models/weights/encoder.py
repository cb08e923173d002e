"""Frozen timm encoders with pretrained, packaged, local or random weights."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import timm
import torch
from huggingface_hub import constants as hub
from torch import nn

from physion.errors import BadInputError, UnknownNameError
from physion.models.torch_model import initial_weights
from physion.models.weights.grid import GRID, POOLED, GridFeatures, Pooling, check_pooling
from physion.models.weights.packages import WeightsPackage, timm_efficientnet_names
from physion.models.weights.source import IMAGENET, TIMM, EncoderWeights
from physion.models.weights.state_dicts import first_line, load_fitting, read_state_dict


def check_encoder_name(name: str) -> None:
    """Raise `UnknownNameError` with the closest names unless timm knows ``name``."""
    if not timm.is_model(name):
        raise UnknownNameError("timm encoder", name, timm.list_models())


def create_encoder(
    name: str, image_size: int, weights: EncoderWeights, pooling: Pooling = POOLED
) -> nn.Module:
    """Build a frozen timm encoder without its classifier, in evaluation mode.

    It maps (batch, 3, image_size, image_size) float32 to (batch, features). With ``pooled`` these
    are the input of timm's classifier: the class token of a transformer, the pooled map of a
    convolutional network, and for VGG the second fully connected layer before its ReLU, as in the
    released code. With ``grid`` they keep positions: see `GridFeatures`.
    """
    check_encoder_name(name)
    check_pooling(pooling)
    package = weights.package
    if package is not None:
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
    features = GridFeatures(encoder, name) if pooling == GRID else encoder
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


def feature_size(name: str, image_size: int, pooling: Pooling = POOLED) -> int:
    """Return the number of features of one frame, without creating the weights."""
    check_encoder_name(name)
    check_pooling(pooling)
    with torch.device("meta"):
        encoder = _create(name, image_size)
        if pooling == GRID:
            encoder = GridFeatures(encoder, name)
        features = encoder.eval()(torch.zeros(1, 3, image_size, image_size))
    if features.ndim != 2:
        raise BadInputError(f"encoder {name!r} gives {tuple(features.shape)}, not a row per frame")
    return int(features.shape[1])


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


def _check_belongs(name: str, package: WeightsPackage) -> None:
    if name != package.encoder:
        raise BadInputError(
            f"package {package.name} holds weights of {package.encoder!r}, not of {name!r}; "
            f"use encoder={package.encoder}, or other weights"
        )


def _tag(name: str, weights: EncoderWeights) -> str:
    """Return the tag of timm's weights that are wanted, empty for weights of another source.

    Raises `BadInputError` if timm has none, or if its first ones are not those of ImageNet
    classification but ``imagenet`` is wanted.
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
