"""Video encoders without dynamics: VideoMAE and V-JEPA 2.

A clip of n = ``frames`` frames becomes tubelets, patches of two frames; the network gives a token
(D,) of each, which depends on the whole clip. The context is one such clip, and it ends with the
last observed frame. What follows, which *full* reads, is encoded in further clips of n frames, so
that no feature of the context depends on a later frame. The last one repeats the last frame.

Features are (B, T / 2, D), the means of the tokens at one time; with ``grid`` (B, T / 2, R C D),
the means in R x C cells (`encoder.GRID`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import transformers
from huggingface_hub import hf_hub_download
from torch import Tensor, nn

from physion.clips.batch import Batch, Provenance, Spec
from physion.core.errors import BadInputError
from physion.models.encoders.encoder import SMALL
from physion.models.encoders.weights import (
    GRID,
    POOLED,
    RANDOM,
    Pooling,
    average_cells,
    check_pooling,
    first_line,
    load_fitting,
    offline_without_network,
    read_state_dict,
    weights_sha256,
)
from physion.models.interface import ModelSettings, settings_of_size
from physion.models.torch_model import TorchModel, digest_of, initial_weights
from physion.models.vision import normalized_pictures

# Networks of video encoders of the library transformers, and their weights.
#
# References
# ----------
# Tong et al. 2022, VideoMAE. Assran et al. 2025, V-JEPA 2.

HUB = "hub:"
TUBELET = 2
"""Frames of a tubelet."""


@dataclass(frozen=True, kw_only=True)
class VideoSettings(ModelSettings):
    """Settings of a video encoder.

    - ``size``: ``small`` or ``paper``; sets the defaults of the other options.
    - ``weights``: ``hub:NAME`` of a repository of huggingface.co, ``random``, or the path of a
      state dict.
    - ``image_size``, ``patch``: pixels per side. ``frames``: of a clip, a multiple of 2.
    - ``width``, ``depth``, ``heads``: of the transformer.
    - ``stride``: frames of the motion between two frames of a clip. ``future``: frames after the
      context, up to the end of the movie by default.
    - ``pooling``: ``pooled`` or ``grid``. ``seed``: of random weights.
    """

    model: str = "VideoMAE"
    size: str = SMALL
    weights: str = RANDOM
    image_size: int = 224
    patch: int = 16
    frames: int = 16
    width: int = 384
    depth: int = 12
    heads: int = 6
    stride: int = 2
    future: int | None = None
    pooling: Pooling = POOLED
    seed: int = 0

    @classmethod
    def defaults(cls, model: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings of a size."""
        return settings_of_size(model, FAMILIES[model].sizes, options.get("size", SMALL))

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
    - ``build``: returns the network for settings, which maps (B, T, 3, H, W) to tokens.
    - ``renamed``: pairs of a part of a tensor's name in a file and its replacement.
    - ``unused``: starts of names, once replaced, of tensors that features do not need.
    - ``sizes``: settings by size.
    """

    name: str
    task: str
    dataset: str
    build: Callable[[VideoSettings], nn.Module]
    renamed: tuple[tuple[str, str], ...]
    unused: tuple[str, ...]
    sizes: Mapping[str, Mapping[str, Any]]


def _videomae(settings: VideoSettings) -> nn.Module:
    library_config = transformers.VideoMAEConfig(
        image_size=settings.image_size,
        patch_size=settings.patch,
        num_frames=settings.frames,
        tubelet_size=TUBELET,
        hidden_size=settings.width,
        num_hidden_layers=settings.depth,
        num_attention_heads=settings.heads,
        intermediate_size=4 * settings.width,
        use_mean_pooling=False,
    )
    network: nn.Module = transformers.VideoMAEModel(library_config)
    return network


def _vjepa2(settings: VideoSettings) -> nn.Module:
    library_config = transformers.VJEPA2Config(
        crop_size=settings.image_size,
        patch_size=settings.patch,
        frames_per_clip=settings.frames,
        tubelet_size=TUBELET,
        hidden_size=settings.width,
        num_hidden_layers=settings.depth,
        num_attention_heads=settings.heads,
        pred_num_hidden_layers=1,  # of the predictor, which features do not need
    )
    encoder: nn.Module = transformers.VJEPA2Model(library_config).encoder
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
    sizes={
        "small": {"weights": f"{HUB}MCG-NJU/videomae-small-finetuned-kinetics"},
        "paper": {"weights": f"{HUB}MCG-NJU/videomae-base", "width": 768, "heads": 12},
    },
)
VJEPA2 = VideoFamily(
    name="V-JEPA2",
    task="joint-embedding prediction of videos",
    dataset="VideoMix22M",
    build=_vjepa2,
    renamed=(("vjepa2.", ""), ("encoder.", "")),
    unused=("predictor.", "pooler.", "classifier."),
    sizes={
        "small": {},
        "paper": {
            "weights": f"{HUB}facebook/vjepa2-vitl-fpc64-256",
            "image_size": 256,
            "width": 1024,
            "depth": 24,
            "heads": 16,
        },
    },
)
FAMILIES = {family.name: family for family in (VIDEOMAE, VJEPA2)}


def create_video_encoder(family: VideoFamily, settings: VideoSettings) -> tuple[nn.Module, str]:
    """Build a frozen network in evaluation mode, and return it with the origin of its weights.

    The origin is ``random``, ``hub:<name>`` or ``local:<start of the file's SHA-256>``.

    Raises
    ------
    BadInputError
        If the weights cannot be had or belong to another network; the message names tensors
        that differ.
    """
    with initial_weights("video encoder", family.name, settings.seed):
        network = family.build(settings)
    origin = settings.weights
    if settings.weights != RANDOM:
        path = _weights_file(settings.weights)
        if not settings.weights.startswith(HUB):
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


_VERSION = 1
"""To be raised with every change that alters features."""


class VideoEncoder(TorchModel):
    """Frozen transformer on 16 frames of a video; its protocols are *observed* and *full*."""

    decision = "logistic"

    settings: VideoSettings

    def __init__(self, settings: VideoSettings) -> None:
        super().__init__()
        self.settings, self.family = settings, FAMILIES[settings.model]
        self.spec = Spec(
            image_size=settings.image_size,
            stride=settings.stride,
            context=settings.frames,
            future=settings.future,
            framewise=False,
        )
        self.network, self.init = create_video_encoder(self.family, settings)

    @torch.no_grad()
    def encode(self, batch: Batch) -> Tensor:
        """Return features (B, T / 2, D) of pictures (B, T, H, W, 3).

        T is filled up to a multiple of ``frames`` by repeating the last picture.
        """
        pictures = normalized_pictures(batch, self.spec, self.name())
        frames, size = self.settings.frames, self.settings.image_size
        missing = -pictures.shape[1] % frames
        last = pictures[:, -1:].expand(-1, missing, -1, -1, -1)
        pictures = torch.cat([pictures, last], dim=1)
        clips, steps = pictures.shape[:2]
        tokens: Tensor = self.network(pictures.reshape(-1, frames, 3, size, size)).last_hidden_state
        side, width = size // self.settings.patch, tokens.shape[-1]
        maps = tokens.reshape(-1, side, side, width).permute(0, 3, 1, 2)
        features = average_cells(maps) if self.settings.pooling == GRID else maps.mean((2, 3))
        return features.float().reshape(clips, steps // TUBELET, -1)

    def digest(self) -> str:
        """Return the SHA-256 of settings, versions and weights."""
        settings = dataclasses.asdict(self.settings)
        settings.pop("weights")  # which count as they are
        parts = [_VERSION, self.family.name, settings, torch.__version__, transformers.__version__]
        return digest_of(parts, self.state_dict().items())

    def name(self) -> str:
        """Return the name for tables, such as ``VideoMAE-paper`` or ``random-VideoMAE-paper``."""
        grid = "grid" * (self.settings.pooling == GRID)
        parts = ["random" * (self.init == RANDOM), self.family.name, grid, self.settings.size]
        return "-".join(part for part in parts if part)

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        named = self.init != RANDOM and self.init == self.family.sizes[self.settings.size].get(
            "weights", RANDOM
        )
        return Provenance(
            model=self.name(),
            init=self.init,
            encoder_type=self.family.name,
            encoder_pretraining_task=self.family.task if named else "",
            encoder_pretraining_dataset=self.family.dataset if named else "",
            encoder_pretraining_seed=str(self.settings.seed) if self.init == RANDOM else "",
            versions=f"torch {torch.__version__}, transformers {transformers.__version__}",
        )
