"""Networks of video encoders of the library transformers, and their weights.

References
----------
Tong et al. 2022, VideoMAE. Assran et al. 2025, V-JEPA 2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import transformers
from huggingface_hub import hf_hub_download
from torch import Tensor, nn

from physion.errors import BadInputError
from physion.models.torch_model import initial_weights
from physion.models.weights import RANDOM, Pooling, read_state_dict
from physion.models.weights.encoder import offline_without_network
from physion.models.weights.grid import POOLED, check_pooling
from physion.models.weights.state_dicts import first_line, load_fitting, weights_sha256

HUB = "hub:"
TUBELET = 2
"""Frames of a tubelet."""


@dataclass(frozen=True, slots=True)
class VideoConfig:
    """Settings of a video encoder.

    - ``weights``: ``hub:NAME`` of a repository of huggingface.co, ``random``, or the path of a
      state dict.
    - ``image_size``, ``patch``: pixels per side. ``frames``: of a clip, a multiple of 2.
    - ``width``, ``depth``, ``heads``: of the transformer.
    - ``stride``: frames of the motion between two frames of a clip. ``later``: clips of the future.
    - ``pooling``: ``pooled`` or ``grid``. ``seed``: of random weights.
    """

    weights: str = RANDOM
    image_size: int = 224
    patch: int = 16
    frames: int = 16
    width: int = 384
    depth: int = 12
    heads: int = 6
    stride: int = 2
    later: int = 3
    pooling: Pooling = POOLED
    seed: int = 0

    def __post_init__(self) -> None:
        check_pooling(self.pooling)
        if min(self.frames, self.image_size, self.patch, self.width, self.depth, self.heads) < 1:
            raise BadInputError("a video encoder needs sizes of at least 1")
        if self.frames % TUBELET or self.image_size % self.patch or self.width % self.heads:
            raise BadInputError(
                f"a video encoder needs an even number of frames, not {self.frames}; an image size "
                f"that is a multiple of patch, not {self.image_size} of {self.patch}; a width that "
                f"is a multiple of heads, not {self.width} of {self.heads}"
            )


@dataclass(frozen=True, slots=True)
class VideoFamily:
    """Kind of video encoder.

    - ``name``: of its models. ``task``, ``dataset``: what trained the named weights.
    - ``build``: returns the network of a config, which maps (B, T, 3, H, W) to tokens.
    - ``renamed``: pairs of a part of a tensor's name in a file and its replacement.
    - ``unused``: starts of names, once replaced, of tensors that features do not need.
    - ``sizes``: configs by size.
    """

    name: str
    task: str
    dataset: str
    build: Callable[[VideoConfig], nn.Module]
    renamed: tuple[tuple[str, str], ...]
    unused: tuple[str, ...]
    sizes: Mapping[str, VideoConfig]


def _videomae(config: VideoConfig) -> nn.Module:
    settings = transformers.VideoMAEConfig(
        image_size=config.image_size,
        patch_size=config.patch,
        num_frames=config.frames,
        tubelet_size=TUBELET,
        hidden_size=config.width,
        num_hidden_layers=config.depth,
        num_attention_heads=config.heads,
        intermediate_size=4 * config.width,
        use_mean_pooling=False,
    )
    network: nn.Module = transformers.VideoMAEModel(settings)
    return network


def _vjepa2(config: VideoConfig) -> nn.Module:
    settings = transformers.VJEPA2Config(
        crop_size=config.image_size,
        patch_size=config.patch,
        frames_per_clip=config.frames,
        tubelet_size=TUBELET,
        hidden_size=config.width,
        num_hidden_layers=config.depth,
        num_attention_heads=config.heads,
        pred_num_hidden_layers=1,  # of the predictor, which features do not need
    )
    encoder: nn.Module = transformers.VJEPA2Model(settings).encoder
    return encoder


VIDEOMAE = VideoFamily(
    name="VideoMAE",
    task="masked autoencoder of videos",
    dataset="Kinetics-400",
    build=_videomae,
    # A network that was trained further to classify has the norm of the mean token, fc_norm, in
    # place of the norm of each token.
    renamed=(
        ("videomae.", ""),
        ("attention.q_bias", "attention.query.bias"),
        ("attention.v_bias", "attention.value.bias"),
        ("fc_norm.", "layernorm."),
    ),
    unused=("decoder.", "encoder_to_decoder.", "mask_token", "classifier."),
    sizes=MappingProxyType(
        {
            "small": VideoConfig(weights=f"{HUB}MCG-NJU/videomae-small-finetuned-kinetics"),
            "paper": VideoConfig(weights=f"{HUB}MCG-NJU/videomae-base", width=768, heads=12),
        }
    ),
)
VJEPA2 = VideoFamily(
    name="V-JEPA2",
    task="joint-embedding prediction of videos",
    dataset="VideoMix22M",
    build=_vjepa2,
    renamed=(("vjepa2.", ""), ("encoder.", "")),
    unused=("predictor.", "pooler.", "classifier."),
    sizes=MappingProxyType(
        {
            "small": VideoConfig(),
            "paper": VideoConfig(
                weights=f"{HUB}facebook/vjepa2-vitl-fpc64-256",
                image_size=256,
                width=1024,
                depth=24,
                heads=16,
            ),
        }
    ),
)


def create_video_encoder(family: VideoFamily, config: VideoConfig) -> tuple[nn.Module, str]:
    """Build a frozen network in evaluation mode, and return it with the origin of its weights.

    The origin is ``random``, ``hub:<name>`` or ``local:<start of the file's SHA-256>``.

    Raises
    ------
    BadInputError
        If the weights cannot be had or are those of another network; the message names tensors
        that differ.
    """
    with initial_weights("video encoder", family.name, config.seed):
        network = family.build(config)
    origin = config.weights
    if config.weights != RANDOM:
        path = _weights_file(config.weights)
        if not config.weights.startswith(HUB):
            origin = f"local:{weights_sha256(path)[:12]}"
        state = _renamed(read_state_dict(path), family)
        unused = [name for name in state if name.startswith(family.unused)]
        load_fitting(network, state, unused=unused, where=str(path), name=family.name)
    return network.eval().requires_grad_(False), origin


def _renamed(state: Mapping[str, Tensor], family: VideoFamily) -> dict[str, Tensor]:
    """Return tensors under the names that the network has for them."""
    renamed = {}
    for name, value in state.items():
        for old, new in family.renamed:
            name = name.replace(old, new, 1)
        renamed[name] = value
    return renamed


def _weights_file(weights: str) -> Path:
    """Return the path of a state dict, after it was downloaded if need be."""
    if not weights.startswith(HUB):
        return Path(weights)
    name = weights.removeprefix(HUB)
    try:
        with offline_without_network():
            return Path(hf_hub_download(name, "model.safetensors"))
    except Exception as error:
        # The exceptions of the downloader depend on its version.
        raise BadInputError(
            f"weights {weights!r} could not be fetched ({type(error).__name__}: "
            f"{first_line(error)}); use weights=<file> with a state dict, or weights=random (the "
            "tables name it)"
        ) from error
