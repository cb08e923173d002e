"""Intuition from pixels: P(contact) from pictures, with masks, boxes and motion as further targets.

An eye finds agent (red), patient (yellow) and what else helps in nine observed frames: mask logits
m_s of S slots at a quarter of the resolution, and a map of features F. Of slot s it reads, with
weights w_s = sigmoid(m_s) / sum sigmoid(m_s) over the pixels p,

    area a_s = mean_p sigmoid(m_sp),   place c_s = sum_p w_sp p,   content h_s = sum_p w_sp F_p.

What a slot holds over time is a token of the network that the other models of intuition have
(`physion.models.intuition`). The loss is

    cross entropy of the outcome + targets * ( cross entropy of the masks of agent and patient
        + mean distance of their boxes + 10 * mean distance of their motion ),

where boxes and motion (the change of the place over the last frames) come from the true masks,
which only the training sees. Where a frame does not show an object, it has no box and no motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from physion.clips.batch import AGENT_ID, PATIENT_ID, Batch, Spec
from physion.core.errors import BadInputError
from physion.models.baselines.pixels import color_masks
from physion.models.checkpoint import load_named
from physion.models.interface import RANDOM, SizedSettings, Sizes, TrainingSettings
from physion.models.interface import settings_of_size as of_size
from physion.models.intuition import CONTEXT, STRIDE, Intuition, TokenNetwork
from physion.models.torch_model import initial_weights
from physion.models.vision import normalized_pictures

SEEN = (0, 2, 5, 7, 9, 11, 12, 13, 14)
"""Which frames of the context are looked at: 2, 8, 17, 23, 29, 35, 38, 41 and 44."""
LATE = 2
"""Seen frames over which motion is measured, from 38 to 44."""

_MEDIUM: Mapping[str, Any] = {
    "image_size": 128, "channels": (32, 64, 128, 256), "width": 192, "layers": 4, "content": 32,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PixelIntuitionSettings(SizedSettings):
    """Settings of intuition from pixels; also see `SizedSettings`.

    - ``image_size``: pixels per side, a multiple of 16.
    - ``channels``: of the maps with 1/2, 1/4, 1/8 and 1/16 of the resolution.
    - ``slots``: agent, patient, and others that are not named.
    - ``content``: values that a token takes from the features of a slot in each frame.
    - ``width``, ``layers``, ``heads``, ``dropout``: of the network that reads tokens.
    - ``targets``: weight of masks, boxes and motion in the loss; 0 learns the outcome only.
    - ``jitter``: standard deviation of the change of brightness and contrast in training.
    """

    model: str = "intuition-pixels"
    image_size: int = 96
    channels: tuple[int, int, int, int] = (16, 32, 64, 96)
    slots: int = 6
    content: int = 16
    width: int = 96
    layers: int = 3
    heads: int = 4
    dropout: float = 0.1
    targets: float = 1.0
    jitter: float = 0.1

    sizes: ClassVar[Sizes] = {"small": {}, "medium": _MEDIUM}

    @classmethod
    def defaults(cls, model: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings of a size; a model starts from random weights, since none ship."""
        return {"weights": RANDOM, **of_size(model, cls.sizes, options.get("size", "small"))}

    def __post_init__(self) -> None:
        self.at_least(1, "image_size", "content", "width", "layers", "heads")
        self.at_least(2, "slots")
        self.at_least(0, "dropout", "targets", "jitter")
        if self.image_size % 16 or self.width % self.heads or min(self.channels) < 1:
            raise BadInputError(
                f"{self.model}: image_size must be a multiple of 16, width of heads, and channels "
                f"above 0, not {self.image_size}, {self.width} of {self.heads}, {self.channels}"
            )


_SMALL_TRAINING = TrainingSettings(
    steps=6000, batch=32, optimizer="adamw", learning_rate=1e-3, weight_decay=0.02,
    schedule="cosine", warmup=200, clip=1.0, validate_every=500, log_every=50, checkpoint_every=100,
)  # fmt: skip
TRAINING: Mapping[str, TrainingSettings] = {
    "small": _SMALL_TRAINING,
    "medium": replace(_SMALL_TRAINING, steps=12000, batch=128, precision="bf16-mixed"),
}


# The eye.


def _stage(inputs: int, outputs: int) -> nn.Sequential:
    """Return layers that halve the resolution, and a residual block."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=2, padding=1),
        nn.GroupNorm(min(8, outputs), outputs),
        nn.GELU(),
        _Residual(outputs),
    )


class _Residual(nn.Module):
    """Maps x + f(x), f being two convolutions."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1),
            nn.GroupNorm(min(8, width), width),
            nn.GELU(),
            nn.Conv2d(width, width, 3, padding=1),
        )

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps of the same shape."""
        out: Tensor = maps + self.layers(maps)
        return out


class Eye(nn.Module):
    """Pictures (N, 3, H, W) to features and mask logits of slots at a quarter of the resolution."""

    def __init__(self, channels: tuple[int, int, int, int], slots: int) -> None:
        super().__init__()
        first, second, third, fourth = channels
        self.stem = nn.Sequential(nn.Conv2d(3, first, 5, stride=2, padding=2), nn.GELU())
        self.stages = nn.ModuleList(
            [_stage(first, second), _stage(second, third), _stage(third, fourth)]
        )
        self.lift = nn.Conv2d(fourth, third, 1)
        self.join = nn.Conv2d(third, second, 1)
        self.last = _Residual(second)
        self.masks = nn.Conv2d(second, slots, 1)

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Return features (N, C, H / 4, W / 4) and mask logits (N, S, H / 4, W / 4)."""
        quarter = self.stages[0](self.stem(pictures))
        eighth = self.stages[1](quarter)
        sixteenth = self.stages[2](eighth)
        eighth = eighth + functional.interpolate(self.lift(sixteenth), scale_factor=2)
        quarter = quarter + functional.interpolate(self.join(eighth), scale_factor=2)
        features = self.last(quarter)
        return features, self.masks(features)


# The model.

_BOX = 4


class PixelIntuition(Intuition):
    """Network that learns outcomes from red and yellow pictures; simulates nothing."""

    targets = ("ids",)
    sees = "pixels"
    settings: PixelIntuitionSettings

    def __init__(self, settings: PixelIntuitionSettings) -> None:
        spec = Spec(
            image_size=settings.image_size, stride=STRIDE, context=CONTEXT, future=0,
            framewise=False,
        )  # fmt: skip
        super().__init__(settings, spec, TRAINING[settings.size])
        slots, second = settings.slots, settings.channels[1]
        track = 3 + _BOX + settings.content
        with initial_weights(settings.model, settings.seed):
            self.eye = Eye(settings.channels, slots)
            self.content = nn.Linear(second, settings.content)
            self.box = nn.Linear(second, _BOX)
            self.motion = nn.Sequential(
                nn.Linear(len(SEEN) * track, settings.width),
                nn.GELU(),
                nn.Linear(settings.width, 2),
            )
            self.network = TokenNetwork(
                len(SEEN) * track + slots, settings.width, settings.layers, settings.heads,
                settings.dropout,
            )  # fmt: skip
        load_named(self, settings.weights)

    def logits(self, batch: Batch) -> Tensor:
        """Return logits (2, B) of the trial and of its mirror image."""
        pictures = self._pictures(batch)
        return torch.stack([self._look(image)[0] for image in (pictures, pictures.flip(-1))])

    def seen(self, batch: Batch) -> Tensor:
        """Return whether red and yellow are both seen in some frame (B,).

        Raises `BadInputError` for a trial that shows neither.
        """
        shown = batch.rgb.cpu().numpy()
        masks = [[mask.any() for mask in color_masks(frames)] for frames in shown]
        for trial, colors in zip(batch.trials, masks, strict=True):
            if not any(colors):
                raise BadInputError(
                    f"{self.name}, trial {trial!r}: nothing is red or yellow; it sees agent and "
                    "patient by these colours only, so take trials in the look redyellow"
                )
        return torch.tensor(np.array(masks).all(axis=1), device=self.device)

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss, its parts, and how many answers are right."""
        pictures, ids = self._pictures(batch), self._ids(batch)
        turned = torch.rand(len(batch), device=pictures.device) < 0.5
        pictures = _flipped(pictures, turned)
        ids = _flipped(ids, turned)
        spread = self.settings.jitter
        gain, shift = (
            torch.randn(len(batch), 1, 1, 1, 1, device=pictures.device) * spread for _ in range(2)
        )
        answers, masks, boxes, motion = self._look(pictures * (1 + gain) + shift)
        contact = batch.contact.to(answers.dtype)
        outcome = functional.binary_cross_entropy_with_logits(answers, contact)
        right = ((answers > 0) == batch.contact).float().mean()
        true = torch.stack([ids == number for number in (AGENT_ID, PATIENT_ID)], 2).float()
        area = functional.avg_pool2d(true.flatten(0, 1), 4).view_as(masks[:, :, :2])
        mask_loss = functional.binary_cross_entropy_with_logits(masks[:, :, :2], area)
        true_boxes, there = boxes_of_masks(true)
        box_loss = _mean((boxes[:, :, :2] - true_boxes).abs().sum(-1), there)
        places = (true_boxes[..., :2] + true_boxes[..., 2:]) / 2
        change = places[:, -1] - places[:, -1 - LATE]
        both = there[:, -1] & there[:, -1 - LATE]
        motion_loss = _mean((motion[:, :2] - change).abs().sum(-1), both)
        further = mask_loss + box_loss + 10 * motion_loss
        return {
            "loss": outcome + self.settings.targets * further,
            "outcome": outcome, "accuracy": right, "masks": mask_loss, "boxes": box_loss,
            "motion": motion_loss,
        }  # fmt: skip

    def _look(self, pictures: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what is found in pictures (B, T, 3, H, W).

        Returns
        -------
        logits : Tensor
            Of the answers (B).
        masks : Tensor
            Logits (B, T, S, H / 4, W / 4).
        boxes : Tensor
            Left, top, right, bottom (B, T, S, 4) in 0..1.
        motion : Tensor
            Change of the place (B, S, 2) over the last `LATE` frames.
        """
        clips, steps = pictures.shape[:2]
        features, masks = self.eye(pictures.flatten(0, 1))
        shown = masks.sigmoid()
        height, width = shown.shape[-2:]
        weights = shown / shown.sum((-2, -1), keepdim=True).clamp(min=1e-4)
        y, x = (
            (torch.arange(side, device=shown.device, dtype=shown.dtype) + 0.5) / side
            for side in (height, width)
        )
        place = torch.stack([(weights.sum(-2) * x).sum(-1), (weights.sum(-1) * y).sum(-1)], -1)
        area = shown.mean((-2, -1)).sqrt()[..., None]
        inside = torch.einsum("nshw,nchw->nsc", weights, features)
        # Half sizes of the box: the root of the area, times what the features say.
        half = area[..., :1] * self.box(inside).exp().clamp(max=10)
        boxes = torch.cat([place - half[..., :2], place + half[..., 2:]], -1)
        held = torch.cat([place - 0.5, area, half, self.content(inside)], -1)
        shape = (clips, steps, masks.shape[1])
        tracks = held.view(*shape, -1).transpose(1, 2).flatten(2)
        motion = self.motion(tracks)
        kind = torch.eye(shape[2], device=tracks.device, dtype=tracks.dtype).expand(clips, -1, -1)
        there = torch.ones(clips, shape[2], dtype=torch.bool, device=tracks.device)
        logits = self.network(torch.cat([tracks, kind], -1), there)
        return logits, masks.view(*shape, height, width), boxes.view(*shape, -1), motion

    def _pictures(self, batch: Batch) -> Tensor:
        """Return the pictures (B, 9, 3, H, W) that are looked at."""
        self._check_frames(batch)
        return normalized_pictures(batch, self.spec, self.name)[:, list(SEEN)]

    def _ids(self, batch: Batch) -> Tensor:
        """Return the true objects of pixels (B, 9, H, W)."""
        if batch.ids is None:
            raise BadInputError(f"{self.name} is trained on pictures and true masks (input ids)")
        ids: Tensor = batch.ids[:, list(SEEN)]
        return ids


def _flipped(pictures: Tensor, mirrored: Tensor) -> Tensor:
    """Return pictures (B, ..., W), where ``mirrored`` (B) says so in their mirror image."""
    chosen = mirrored.view(-1, *[1] * (pictures.ndim - 1))
    return torch.where(chosen, pictures.flip(-1), pictures)


def boxes_of_masks(masks: Tensor) -> tuple[Tensor, Tensor]:
    """Return left, top, right and bottom (..., 4) of masks (..., H, W), and which are there."""
    edges: list[Tensor] = []
    for axis in (-2, -1):
        line = masks.amax(axis)
        side = line.shape[-1]
        at = torch.arange(side, device=masks.device, dtype=masks.dtype)
        low = torch.where(line > 0, at, side).amin(-1) / side
        high = torch.where(line > 0, at + 1, 0).amax(-1) / side
        edges += [low, high]
    left, right, top, bottom = edges
    there = masks.flatten(-2).amax(-1) > 0
    return torch.stack([left, top, right, bottom], -1) * there[..., None], there


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    """Return the mean of the values that count; 0 if none does."""
    total: Tensor = (values * counted).sum()
    return total / counted.sum().clamp(min=1)
