"""Video encoders without dynamics: VideoMAE, VideoMAE v2, V-JEPA 2 and 2.1.

A clip of n = ``frames`` frames becomes tubelets, patches of two frames; the network gives a token
(D,) of each, which depends on the whole clip. The context is one such clip, and it ends with the
last observed frame. What follows, which *full* reads, is encoded in further clips of n frames, so
that no feature of the context depends on a later frame. The last one repeats the last frame.

Features are (B, T / 2, D), the means of the tokens at one time; with ``grid`` (B, T / 2, R C D),
the means in R x C cells (`weights.GRID`).
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
from transformers.models.vjepa2.modeling_vjepa2 import VJEPA2RopeAttention

from physion.clips.batch import Batch, Provenance, Spec
from physion.core.errors import BadInputError
from physion.models.encoders.encoder import SMALL
from physion.models.encoders.weights import (
    CELLS,
    CELLWISE,
    POOLED,
    RANDOM,
    Pooling,
    check_pooling,
    clips_of,
    decision_of,
    first_line,
    load_fitting,
    offline_without_network,
    pool_maps,
    read_state_dict,
    weights_sha256,
)
from physion.models.interface import ModelSettings, settings_of_size
from physion.models.torch_model import TorchModel, initial_weights, weights_digest
from physion.models.vision import normalized_pictures

# Networks of video encoders of the library transformers, and their weights.
#
# References
# ----------
# Tong et al. 2022, VideoMAE. Wang et al. 2023, VideoMAE V2. Assran et al. 2025, V-JEPA 2. For 2.1
# arXiv 2603.14482, and ``app/vjepa_2_1`` of facebookresearch/vjepa2.

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
    - ``width``, ``depth``, ``heads``: of the transformer. ``mlp``: units of a hidden layer, as a
      multiple of the width.
    - ``layer``: block, counted from 1, whose output the features are, before any norm; None is the
      last, after the norm.
    - ``stride``: frames of the motion between two frames of a clip. ``future``: frames after the
      context, up to the end of the movie by default.
    - ``pooling``: ``pooled`` (or ``mean``, which is the same here), ``grid``, or ``attentive``, a
      grid that the decision of this name reads. ``seed``: of random weights.
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
    mlp: float = 4.0
    layer: int | None = None
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
        if self.layer is not None and not 1 <= self.layer <= self.depth:
            raise BadInputError(
                f"{self.model} has the layers 1 to {self.depth}, not {self.layer}; leave out layer "
                "for the last one after its norm"
            )


@dataclass(frozen=True, slots=True)
class VideoFamily:
    """Kind of video encoder.

    - ``name``: of its models. ``task``, ``dataset``: what trained the named weights.
    - ``build``: returns the network for settings, which maps (B, T, 3, H, W) to tokens.
    - ``renamed``: pairs of a part of a tensor's name in a file and its replacement.
      A tensor of queries, keys and values in one, called ``qkv``, is then divided into the three.
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
        intermediate_size=round(settings.mlp * settings.width),
        use_mean_pooling=False,
        **({"layer_norm_eps": 1e-6} if settings.model == "VideoMAEv2" else {}),
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
        mlp_ratio=settings.mlp,
        pred_num_hidden_layers=1,  # of the predictor, which features do not need
    )
    encoder: nn.Module = transformers.VJEPA2Model(library_config).encoder
    return encoder


class RotaryAttention(VJEPA2RopeAttention):  # type: ignore[misc]
    """Attention of V-JEPA 2.1, which differs from 2 in the rotation of queries and keys.

    Features 2 i and 2 i + 1 turn by one angle p / 10000^(2 i / D); in 2, angle i belongs to
    features i and i + D / 2. Positions p of rows and columns are scaled to the range of 256 pixels,
    0 to 256 / patch - 1, whatever the size of the pictures.
    """

    def get_position_ids(self, x: Tensor, masks: Tensor | None = None) -> tuple[Tensor, ...]:
        """Return time, row and column of each token."""
        time, row, column = super().get_position_ids(x, masks)
        scale = (256 // self.config.patch_size - 1) / max(self.grid_size - 1, 1)
        return 1.0 * time, row * scale, column * scale

    def apply_rotary_embeddings(self, qk: Tensor, pos_ids: tuple[Tensor, ...]) -> Tensor:
        """Return queries or keys (B, heads, tokens, D), a third of D turned by each position."""
        parts, start = [], 0
        for positions in pos_ids:
            third = qk[..., start : start + self.d_dim]
            pairs = third.reshape(*third.shape[:-1], -1, 2)
            steps = torch.arange(self.d_dim // 2, device=qk.device) / (self.d_dim / 2)
            angles = positions[..., None] * 10000**-steps
            first, second = pairs.unbind(-1)
            cosine, sine = angles.cos(), angles.sin()
            turned = (first * cosine - second * sine, second * cosine + first * sine)
            parts.append(torch.stack(turned, -1).flatten(-2))
            start += self.d_dim
        return torch.cat([*parts, qk[..., start:]], -1).to(qk.dtype)


class ModalityEmbeddings(nn.Module):
    """Patch embeddings of V-JEPA 2.1: as in 2, plus one vector for videos."""

    def __init__(self, embeddings: nn.Module, width: int) -> None:
        super().__init__()
        self.patches = embeddings
        self.video = nn.Parameter(1e-6 * torch.randn(1, 1, width))

    def forward(self, clips: Tensor) -> Tensor:
        """Return embeddings (B, tokens, D) of clips (B, T, 3, H, W)."""
        embedded: Tensor = self.patches(clips) + self.video
        return embedded


def _vjepa21(settings: VideoSettings) -> nn.Module:
    encoder: Any = _vjepa2(settings)
    encoder.embeddings = ModalityEmbeddings(encoder.embeddings, settings.width)
    for block in encoder.layer:
        weights = block.attention.state_dict()
        block.attention = RotaryAttention(encoder.config, settings.width, settings.heads)
        block.attention.load_state_dict(weights)
    network: nn.Module = encoder
    return network


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
_PATCHES = "embeddings.patch_embeddings"
VIDEOMAEV2 = VideoFamily(
    name="VideoMAEv2",
    task="masked autoencoder of videos",
    dataset="UnlabeledHybrid-1M",
    build=_videomae,
    renamed=(
        ("model.", ""),
        ("blocks.", "encoder.layer."),
        ("patch_embed.proj.", f"{_PATCHES}.projection."),
        ("attn.proj.", "attention.output.dense."),
        ("attn.q_bias", "attention.attention.query.bias"),
        ("attn.v_bias", "attention.attention.value.bias"),
        ("attn.qkv.", "attention.attention.qkv."),
        ("norm1.", "layernorm_before."),
        ("norm2.", "layernorm_after."),
        ("mlp.fc1.", "intermediate.dense."),
        ("mlp.fc2.", "output.dense."),
        ("fc_norm.", "layernorm."),
    ),
    unused=("head.", "pos_embed"),  # positions are sines and cosines, which the network has
    sizes={
        "small": {"weights": f"{HUB}OpenGVLab/VideoMAEv2-Base", "width": 768, "heads": 12},
        "paper": {
            "weights": f"{HUB}OpenGVLab/VideoMAEv2-giant",
            "patch": 14,
            "width": 1408,
            "depth": 40,
            "heads": 16,
            "mlp": 48 / 11,
        },
    },
)
# The files, vjepa2_1_vitb_dist_vitG_384.pt and vjepa2_1_vitl_dist_vitG_384.pt, are no repository of
# the hub: ``weights`` is their path.
VJEPA21 = VideoFamily(
    name="V-JEPA2.1",
    task="joint-embedding prediction of videos",
    dataset="",
    build=_vjepa21,
    renamed=(
        ("module.", ""),
        ("backbone.", ""),
        ("blocks.", "layer."),
        ("attn.", "attention."),
        ("patch_embed.", "embeddings.patches.patch_embeddings."),
        ("video_mod_embed", "embeddings.video"),
        ("norms_block.3.", "layernorm."),
    ),
    unused=("patch_embed_img.", "img_mod_embed", "norms_block."),
    sizes={
        "small": {"image_size": 384, "width": 768, "heads": 12},
        "paper": {"image_size": 384, "width": 1024, "depth": 24, "heads": 16},
    },
)
FAMILIES = {family.name: family for family in (VIDEOMAE, VIDEOMAEV2, VJEPA2, VJEPA21)}


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
    if settings.layer is not None:
        blocks: Any = getattr(network, "encoder", network)
        blocks.layer = blocks.layer[: settings.layer]
        network.layernorm = nn.Identity()
    return network.eval().requires_grad_(False), origin


def _renamed(state: Mapping[str, Tensor], family: VideoFamily) -> dict[str, Tensor]:
    """Return tensors under the names that the network has for them."""
    renamed = {}
    for name, value in state.items():
        for old, new in family.renamed:
            name = name.replace(old, new, 1)
        parts = ("query", "key", "value") if ".qkv." in name else ("",)
        for part, piece in zip(parts, value.chunk(len(parts)), strict=True):
            renamed[name.replace(".qkv.", f".{part}.")] = piece.contiguous()
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
    """Frozen transformer on 16 frames of a video; its readouts are *observed* and *full*."""

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
        self.decision = decision_of(settings.pooling)
        cells = min(CELLS, settings.image_size // settings.patch) ** 2
        self.tokens = cells if settings.pooling in CELLWISE else 1

    @torch.no_grad()
    def encode(self, batch: Batch) -> Tensor:
        """Return features (B, T / 2, D) of pictures (B, T, H, W, 3).

        T is filled up to a multiple of ``frames`` by repeating the last picture.
        """
        pictures = normalized_pictures(batch, self.spec, self.name())
        frames, size = self.settings.frames, self.settings.image_size
        tokens: Tensor = self.network(clips_of(pictures, frames)).last_hidden_state
        side, width = size // self.settings.patch, tokens.shape[-1]
        # Clips follow each other in time, so that all tokens of a trial do.
        maps = tokens.reshape(len(pictures), -1, side, side, width).permute(0, 1, 4, 2, 3)
        return pool_maps(maps, self.settings.pooling).float()

    def digest(self) -> str:
        """Return the SHA-256 of settings, versions and weights."""
        settings = dataclasses.asdict(self.settings)
        settings.pop("weights")  # which count as they are
        if (settings["mlp"], settings["layer"]) == (4.0, None):  # as before these could be set
            del settings["mlp"], settings["layer"]
        parts = [_VERSION, self.family.name, settings, torch.__version__, transformers.__version__]
        return weights_digest(parts, self.state_dict().items())

    def name(self) -> str:
        """Return the name for tables, such as ``VideoMAE-paper`` or ``random-VideoMAE-paper``."""
        pooling, layer = self.settings.pooling, self.settings.layer
        grid = pooling if pooling in CELLWISE else ""
        parts = ["random" * (self.init == RANDOM), self.family.name, grid]
        parts += [f"layer{layer}" if layer is not None else "", self.settings.size]
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
