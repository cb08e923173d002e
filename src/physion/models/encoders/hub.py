"""Any image or video encoder of the library transformers: ``hf:NAME``, without dynamics.

NAME is a repository of huggingface.co, or a folder with its files: ``config.json``,
``model.safetensors``, and ``preprocessor_config.json`` or ``video_preprocessor_config.json``, from
which statistics, image size and number of frames are taken. No code of a repository is run.

Features are (B, T, D) of an image encoder, and (B, T / n, D) of a video encoder whose patches have
n frames, where its tokens are ordered by time; otherwise each clip has one time step.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import transformers
from torch import Tensor, nn
from transformers.utils.hub import cached_file

from physion.clips.batch import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    LAST_OBSERVED,
    Batch,
    Provenance,
    Spec,
)
from physion.core.errors import BadInputError
from physion.core.settings import read_json
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
    offline_without_network,
    pool_maps,
    weights_sha256,
)
from physion.models.interface import ModelSettings
from physion.models.torch_model import TorchModel, initial_weights, weights_digest
from physion.models.vision import normalized_pictures
from physion.scenes.scene import OBSERVED_FRAMES

HF, PUBLISHED = "hf:", "published"
FRAMES = 16
"""Frames of a clip where an encoder was published with more than the observed part has."""
_FILES = ("video_preprocessor_config.json", "preprocessor_config.json")
_VERSION = 1
"""To be raised with every change that alters features."""


@dataclass(frozen=True, kw_only=True)
class HubSettings(ModelSettings):
    """Settings of an encoder of transformers; what is None is as published.

    - ``weights``: ``published`` or ``random``. ``seed``: of random weights.
    - ``image_size``: pixels per side. ``frames``: of a clip of a video encoder.
    - ``stride``: frames of the motion between two frames; None: 6, or of a video encoder as many as
      let a clip fill the observed part. ``future``: see `Spec`.
    - ``layer``: block of a transformer, counted from 1, whose output the features are; None is the
      ``last_hidden_state`` of transformers: of the last block, after its norm, but of CLIP before
      it. Networks whose blocks are divided into stages have no such option.
    - ``pooling``: ``pooled`` (the class token of an image encoder that has one, else the mean),
      ``mean`` of the tokens of patches, ``grid``, means in cells, or ``attentive``, means in cells
      that the decision of this name reads.
    """

    weights: str = PUBLISHED
    image_size: int | None = None
    frames: int | None = None
    stride: int | None = None
    future: int | None = None
    layer: int | None = None
    pooling: Pooling = POOLED
    seed: int = 0

    def __post_init__(self) -> None:
        check_pooling(self.pooling)
        if self.weights not in (PUBLISHED, RANDOM):
            raise BadInputError(f"weights must be {PUBLISHED} or {RANDOM}, not {self.weights!r}")


class HubEncoder(TorchModel):
    """Frozen encoder of transformers; its protocols are *observed* and *full*."""

    decision = "logistic"
    settings: HubSettings

    def __init__(self, settings: HubSettings) -> None:
        super().__init__()
        self.settings, self.source = settings, settings.model.removeprefix(HF)
        if not settings.model.startswith(HF) or not self.source:
            raise BadInputError("an encoder of transformers is called hf:NAME, such as hf:a/b")
        try:
            with (
                contextlib.nullcontext()
                if Path(self.source).is_dir()
                else offline_without_network()
            ):
                self.network, config, processor = self._load()
        except (OSError, ValueError, KeyError, ImportError) as error:
            raise BadInputError(
                f"{settings.model!r} could not be loaded ({type(error).__name__}: "
                f"{first_line(error)}); name a repository of huggingface.co or a folder with "
                "config.json and model.safetensors"
            ) from error
        if config.model_type == "vit_mae":  # which would also shuffle them at a ratio of 0
            raise BadInputError(
                f"{settings.model} leaves out patches at random, so that its features are random; "
                "use such weights of timm, as in timm:vit_base_patch16_224.mae"
            )
        tubelet: Any = getattr(config, "tubelet_size", None) or 1
        patch: Any = getattr(config, "patch_size", None) or (tubelet if _several(tubelet) else 0)
        self.patch = int(patch[-1] if _several(patch) else patch)
        self.tubelet = int(tubelet[0] if _several(tubelet) else tubelet)
        known = getattr(config, "num_frames", None) or getattr(config, "frames_per_clip", None)
        fits = known is not None and known <= LAST_OBSERVED + 1
        self.frames = (settings.frames or (known if fits else FRAMES)) if known else 1
        self._check_frames(known)
        stride = settings.stride or (6 if not known else LAST_OBSERVED // max(self.frames - 1, 1))
        mean, std = _statistics(settings.model, processor)
        self.spec = Spec(
            image_size=settings.image_size or _image_size(config, processor),
            mean=mean,
            std=std,
            stride=stride,
            context=self.frames if known else 0,
            future=settings.future,
            framewise=not known,
        )
        self._chosen: list[Tensor] = []
        self.decision = decision_of(settings.pooling)
        if known or settings.pooling in CELLWISE:
            shape = self._shape_on_meta()
            side = self.spec.image_size // (self.patch or 1)
            sides = shape[2:] if len(shape) == 4 else (side, side)
            cells = math.prod(min(CELLS, length) for length in sides)
            self.tokens = cells if settings.pooling in CELLWISE else 1
        if settings.layer is not None:
            lists = [part for part in self.network.modules() if isinstance(part, nn.ModuleList)]
            blocks = max(lists, key=len, default=nn.ModuleList())
            inner = [part for one in lists for part in one.modules() if part is not one]
            if any(isinstance(part, nn.ModuleList) for part in inner):
                raise BadInputError(
                    f"the blocks of {settings.model} are divided into stages; leave out layer"
                )
            if not 1 <= settings.layer <= len(blocks):
                raise BadInputError(
                    f"{settings.model} has the layers 1 to {len(blocks)}, not {settings.layer}"
                )
            blocks[settings.layer - 1].register_forward_hook(self._keep)

    def _load(self) -> tuple[nn.Module, Any, Mapping[str, Any]]:
        """Return the network, the configuration of its part that sees, and its preprocessing."""
        transformers.logging.set_verbosity_error()  # what is missing is an error below
        transformers.logging.disable_progress_bar()
        config = transformers.AutoConfig.from_pretrained(self.source, trust_remote_code=False)
        found = (_file(self.source, name) for name in _FILES)
        path = next((path for path in found if path is not None), None)
        processor = read_json(path, dict[str, Any]) if path is not None else {}
        self.init = RANDOM
        if self.settings.weights == RANDOM:
            with initial_weights("hub encoder", self.source, self.settings.seed):
                network = transformers.AutoModel.from_config(config)
        else:
            network, report = transformers.AutoModel.from_pretrained(
                self.source, config=config, use_safetensors=True, trust_remote_code=False,
                output_loading_info=True, dtype=torch.float32,
            )  # fmt: skip
            # What would stay random. A pooler comes after the features.
            missing = [n for n in sorted(report["missing_keys"]) if "pool" not in n]
            missing += [str(name) for name in report.get("mismatched_keys", ())]
            if missing:
                raise BadInputError(
                    f"the weights of {self.settings.model} lack {missing[0]}"
                    + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
                )
            local = sorted(Path(self.source).glob("*.safetensors"))
            digests = [weights_sha256(path) for path in local]
            sha256 = digests[0] if len(digests) == 1 else weights_digest(digests)
            self.init = f"local:{sha256[:12]}" if local else f"hub:{self.source}"
        network = getattr(network, "vision_model", network)
        if config.model_type == "vjepa2":  # without its predictor
            network = network.encoder
        return (
            network.eval().requires_grad_(False),
            getattr(config, "vision_config", config),
            processor,
        )

    def _check_frames(self, known: int | None) -> None:
        """Raise `BadInputError` for an option ``frames`` that does not fit the network."""
        model, given = self.settings.model, self.settings.frames
        if given is not None and not known:
            raise BadInputError(f"{model} is a network of images; leave out frames")
        if given is not None and not 1 <= given <= OBSERVED_FRAMES:
            raise BadInputError(
                f"frames of {model} must be 1 to {OBSERVED_FRAMES}, which are observed, not {given}"
            )
        if known and self.frames % self.tubelet:
            raise BadInputError(
                f"{model} joins {self.tubelet} frames; choose frames that are a multiple of it, "
                f"not {self.frames}"
            )

    @torch.no_grad()
    def _shape_on_meta(self) -> tuple[int, ...]:
        """Return the shape of the output for one input; only shapes are computed.

        Raises `BadInputError` unless the network takes such clips or pictures.
        """
        tensors = (*self.network.named_parameters(), *self.network.named_buffers())
        shapes = {name: torch.empty_like(value, device="meta") for name, value in tensors}
        side = self.spec.image_size
        frames = () if self.spec.framewise else (self.frames,)
        clip = torch.empty(1, *frames, 3, side, side, device="meta")
        try:
            output: Any = torch.func.functional_call(self.network, shapes, (clip,))
            return tuple(output.last_hidden_state.shape)
        except (RuntimeError, ValueError) as error:
            raise BadInputError(
                f"{self.settings.model} takes no clips of {self.frames} frames with {side} pixels "
                f"per side; choose frames and image_size as published ({first_line(error)})"
            ) from error

    def _keep(self, block: nn.Module, given: Any, output: Any) -> None:
        self._chosen.append(output[0] if isinstance(output, tuple) else output)

    @torch.no_grad()
    def encode(self, batch: Batch) -> Tensor:
        """Return features (B, T', D) of pictures (B, T, H, W, 3)."""
        pictures = normalized_pictures(batch, self.spec, self.name())
        clips, steps = pictures.shape[:2]
        if self.spec.framewise:
            return (
                self._pool(self._tokens(pictures.flatten(0, 1)), 1).float().view(clips, steps, -1)
            )
        parts = clips_of(pictures, self.frames)
        features = self._pool(self._tokens(parts), self.frames // self.tubelet)
        return features.float().reshape(clips, -1, features.shape[-1])

    def _tokens(self, pictures: Tensor) -> Tensor:
        """Return tokens (N, tokens, D), or a map (N, D, rows, columns)."""
        self._chosen.clear()
        network: Any = self.network
        output = network(pictures).last_hidden_state
        tokens: Tensor = self._chosen.pop() if self._chosen else output
        return tokens

    def _pool(self, tokens: Tensor, times: int) -> Tensor:
        """Return features (N, times, D), or (N, 1, D) if times are not separable."""
        pooling, count = self.settings.pooling, len(tokens)
        if tokens.ndim == 4:
            maps = tokens[:, None]
        else:
            side = self.spec.image_size // self.patch if self.patch else 0
            first = tokens.shape[1] - times * side * side
            if pooling == POOLED and first > 0 and times == 1:
                return tokens[:, :1]
            if side and first >= 0 and (times == 1 or first == 0):
                maps = tokens[:, first:].reshape(count, times, side, side, -1)
                maps = maps.permute(0, 1, 4, 2, 3)
            elif pooling in CELLWISE:
                raise BadInputError(f"{self.settings.model} has no map; use pooling=pooled")
            else:
                return tokens.mean(1, keepdim=True)
        return pool_maps(maps, pooling)

    def digest(self) -> str:
        """Return the SHA-256 of settings, versions and weights."""
        settings = dataclasses.asdict(self.settings)
        settings.pop("weights")  # which count as they are
        parts = [_VERSION, settings, repr(self.spec), torch.__version__, transformers.__version__]
        return weights_digest(parts, self.state_dict().items())

    def name(self) -> str:
        """Return the name for tables: the last part of the name of repository or folder."""
        settings = self.settings
        pooling = settings.pooling if settings.pooling != POOLED else ""
        layer = "" if settings.layer is None else f"layer{settings.layer}"
        parts = ["random" * (self.init == RANDOM), Path(self.source).name, pooling, layer]
        return "-".join(part for part in parts if part)

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        return Provenance(
            model=self.name(),
            init=self.init,
            encoder_type=type(self.network).__name__,
            encoder_pretraining_seed=str(self.settings.seed) if self.init == RANDOM else "",
            versions=f"torch {torch.__version__}, transformers {transformers.__version__}",
        )


def _file(source: str, name: str) -> Path | None:
    """Return a file of a repository or folder; None if it has no such file."""
    try:
        path = cached_file(source, name, _raise_exceptions_for_missing_entries=False)
    except OSError:
        return None
    return None if path is None else Path(path)


def _several(value: Any) -> bool:
    return isinstance(value, list | tuple)


def _statistics(
    model: str, processor: Mapping[str, Any]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return mean and standard deviation of channels in 0..1; refuse other preprocessing."""
    factor = processor.get("rescale_factor") or 1 / 255
    factor = factor if processor.get("do_rescale", True) else 1
    unlike = [
        f"{name} {processor[name]}"
        for name in ("rescale_offset", "offset", "do_flip_channel_order")
        if processor.get(name)
    ]
    if not math.isclose(factor, 1 / 255, rel_tol=1e-6):
        unlike.append(f"rescale_factor {factor}")
    if unlike:
        raise BadInputError(
            f"{model} needs pictures with {unlike[0]}, which are not made here; encode them "
            "elsewhere (physion export --layout features-request)"
        )
    if not processor.get("do_normalize", True):
        return (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    mean: Any = processor.get("image_mean") or IMAGENET_MEAN
    std: Any = processor.get("image_std") or IMAGENET_STD
    (m0, m1, m2), (s0, s1, s2) = (v if _several(v) else (v, v, v) for v in (mean, std))
    return (m0, m1, m2), (s0, s1, s2)


def _image_size(config: Any, processor: Mapping[str, Any]) -> int:
    """Return the pixels per side with which a network was published."""
    for size in (processor.get("crop_size"), processor.get("size")):
        value = size.get("height") if isinstance(size, Mapping) else size
        if isinstance(value, int):
            return value
    size = getattr(config, "image_size", None) or getattr(config, "crop_size", None) or 224
    return int(size if isinstance(size, int) else size[0])
