"""Intuition from pixels: P(contact) from pictures, with masks, boxes and motion as further targets.

An eye finds agent (red), patient (yellow) and what else helps in nine observed frames: mask logits
m_s of S slots at a quarter of the resolution, and a map of features F. Of slot s it reads, with
weights w_s = sigmoid(m_s) / sum sigmoid(m_s) over the pixels p,

    area a_s = mean_p sigmoid(m_sp),   place c_s = sum_p w_sp p,   content h_s = sum_p w_sp F_p.

Agent and patient also hold what the red and the yellow pixels tell at full resolution: area, mean,
deviations, covariance and box, as `physion.models.baselines.trees` has them. What a slot holds over
time is a token of the network that the other models of intuition have
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

import torch
from torch import Tensor, nn
from torch.nn import functional

from physion.clips.batch import AGENT_ID, PATIENT_ID, Batch, Spec
from physion.core.errors import BadInputError
from physion.models.checkpoint import load_named
from physion.models.interface import RANDOM, SizedSettings, Sizes, TrainingSettings
from physion.models.interface import settings_of_size as of_size
from physion.models.intuition import CONTEXT, STRIDE, Intuition, TokenNetwork
from physion.models.torch_model import initial_weights
from physion.models.vision import normalized_pictures
from physion.scenes.looks import RED, ROLE_HUES, STRONG_SATURATION, STRONG_VALUE, YELLOW

SEEN = (0, 2, 5, 7, 9, 11, 12, 13, 14)
"""Which frames of the context are looked at: 2, 8, 17, 23, 29, 35, 38, 41 and 44."""
LATE = 2
"""Seen frames over which motion is measured, from 38 to 44."""

_MEDIUM: Mapping[str, Any] = {
    "channels": (32, 64, 128, 192), "width": 192, "layers": 4, "content": 32,
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
    - ``shift``: largest number of pixels by which pictures are moved in training.
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
    shift: int = 6

    sizes: ClassVar[Sizes] = {"small": {}, "medium": _MEDIUM}

    @classmethod
    def defaults(cls, model: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings of a size; a model starts from random weights, since none ship."""
        return {"weights": RANDOM, **of_size(model, cls.sizes, options.get("size", "small"))}

    def __post_init__(self) -> None:
        self.at_least(1, "image_size", "content", "width", "layers", "heads")
        self.at_least(2, "slots")
        self.at_least(0, "dropout", "targets", "jitter", "shift")
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
    "medium": replace(
        _SMALL_TRAINING, steps=12000, batch=256, precision="bf16-mixed", checkpoint_every=1000
    ),
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
    """Pictures (N, 5, H, W) to features and mask logits of slots at a quarter of the resolution."""

    def __init__(self, channels: tuple[int, int, int, int], slots: int) -> None:
        super().__init__()
        first, second, third, fourth = channels
        # Three colours, and which pixels are red and which yellow.
        self.stem = nn.Sequential(nn.Conv2d(5, first, 5, stride=2, padding=2), nn.GELU())
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


# What red and yellow pixels tell.

_BLOB = 10


def colored(rgb: Tensor) -> Tensor:
    """Return which pixels of pictures (..., H, W, 3), uint8, are red, and yellow: (..., 2, H, W).

    The rule is the one of `physion.models.baselines.pixels.color_masks`.
    """
    colors = rgb.float() / 255
    red, green, blue = colors.unbind(-1)
    value, spread = colors.amax(-1), colors.amax(-1) - colors.amin(-1)
    strong = (spread >= STRONG_SATURATION * value) & (value >= STRONG_VALUE) & (spread > 0)
    strong &= value > blue
    hue = torch.where(red >= green, green - blue, 2 * spread + blue - red)
    hue = hue / (6 * spread.clamp(min=1e-6))
    ranges = [ROLE_HUES[color] for color in (RED, YELLOW)]
    return torch.stack([strong & (low <= hue) & (hue <= high) for low, high in ranges], -3)


def blobs_of_masks(masks: Tensor) -> Tensor:
    """Return area, mean, deviations, covariance and box (..., 10) of masks (..., H, W).

    These are the values of `physion.models.baselines.trees.mask_blob`.
    """
    height, width = masks.shape[-2:]
    x, y = (
        (torch.arange(side, device=masks.device, dtype=masks.dtype) + 0.5) / side
        for side in (width, height)
    )
    rows, columns = masks.sum(-1), masks.sum(-2)
    counts = rows.sum(-1)
    most = counts.clamp(min=1)
    center_x, center_y = (columns * x).sum(-1) / most, (rows * y).sum(-1) / most
    # From the mean, since differences of squares lose digits.
    from_x, from_y = x - center_x[..., None], y - center_y[..., None]
    spread_x = ((columns * from_x**2).sum(-1) / most).sqrt()
    spread_y = ((rows * from_y**2).sum(-1) / most).sqrt()
    slant = ((masks * from_x[..., None, :]).sum(-1) * from_y).sum(-1) / most
    box, there = boxes_of_masks(masks)
    values = [counts / (height * width), center_x, center_y, spread_x, spread_y, slant]
    found = torch.cat([torch.stack(values, -1), box], -1)
    nothing = found.new_tensor([0, 0.5, 0.5, 0, 0, 0, 0.5, 0.5, 0.5, 0.5])
    return torch.where(there[..., None], found, nothing)


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
        track = 3 + _BOX + settings.content + _BLOB
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
        self.center = nn.Buffer(torch.zeros(_BLOB))
        self.scale = nn.Buffer(torch.ones(_BLOB))
        load_named(self, settings.weights)

    def prepare(self, sample: Batch) -> None:
        """Set base rate, mean and deviation of what a colour tells, unless weights were given."""
        super().prepare(sample)
        if self.trained:
            return
        blobs = blobs_of_masks(self._pictures(sample)[:, :, 3:])
        shown = blobs[blobs[..., 0] > 0]
        if len(shown) > 1:
            self.center.copy_(shown.mean(0))
            self.scale.copy_(shown.std(0).clamp(min=1e-4))

    def logits(self, batch: Batch) -> Tensor:
        """Return logits (2, B) of the trial and of its mirror image."""
        pictures = self._pictures(batch)
        return torch.stack([self._look(image)[0] for image in (pictures, pictures.flip(-1))])

    def seen(self, batch: Batch) -> Tensor:
        """Return whether red and yellow are both seen in some frame (B,).

        Raises `BadInputError` if none of several trials shows any: they have another look.
        """
        shown = colored(batch.rgb.to(self.device)).flatten(-2).any(-1).any(1)
        if len(shown) > 1 and not shown.any():
            raise BadInputError(
                f"{self.name}: in {len(shown)} trials, such as {batch.trials[0]!r}, nothing is red "
                "or yellow; it sees agent and patient by these colours only, so take trials in the "
                "look redyellow"
            )
        return shown.all(1)

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss, its parts, and how many answers are right."""
        pictures, ids = self._pictures(batch), self._ids(batch)
        turned = torch.rand(len(batch), device=pictures.device) < 0.5
        by = torch.randint(-self.settings.shift, self.settings.shift + 1, (2, len(batch)))
        pictures = _moved(_flipped(pictures, turned), by.to(turned.device))
        ids = _moved(_flipped(ids, turned), by.to(turned.device))
        spread = self.settings.jitter
        gain, lift = (
            torch.randn(len(batch), 1, 1, 1, 1, device=pictures.device) * spread for _ in range(2)
        )
        colors = pictures[:, :, :3] * (1 + gain) + lift
        answers, masks, boxes, motion = self._look(torch.cat([colors, pictures[:, :, 3:]], 2))
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
        """Return what is found in pictures (B, T, 5, H, W).

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
        features, masks = self.eye(pictures.flatten(0, 1))
        # Places and motion need all digits of float32, also where the eye computes with half.
        with torch.autocast(pictures.device.type, enabled=False):
            blobs = blobs_of_masks((pictures[:, :, 3:] > 0.5).float())
            return self._judge(features.float(), masks.float(), blobs)

    def _judge(
        self, features: Tensor, masks: Tensor, blobs: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what `_look` does, from the maps of the eye and the blobs (B, T, 2, 10)."""
        clips, steps = blobs.shape[:2]
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
        # Slots that are not named have no colour.
        scaled = ((blobs - self.center) / self.scale).clamp(-10, 10)
        told = functional.pad(scaled, (0, 0, 0, masks.shape[1] - 2)).flatten(0, 1)
        held = torch.cat([place - 0.5, area, half, self.content(inside), told], -1)
        shape = (clips, steps, masks.shape[1])
        tracks = held.view(*shape, -1).transpose(1, 2).flatten(2)
        motion = self.motion(tracks)
        kind = torch.eye(shape[2], device=tracks.device, dtype=tracks.dtype).expand(clips, -1, -1)
        there = torch.ones(clips, shape[2], dtype=torch.bool, device=tracks.device)
        logits = self.network(torch.cat([tracks, kind], -1), there)
        return logits, masks.view(*shape, height, width), boxes.view(*shape, -1), motion

    def _pictures(self, batch: Batch) -> Tensor:
        """Return the pictures (B, 9, 5, H, W) that are looked at: colours, red, yellow."""
        self._check_frames(batch)
        pictures = normalized_pictures(batch, self.spec, self.name)[:, list(SEEN)]
        return torch.cat([pictures, colored(batch.rgb[:, list(SEEN)]).float()], 2)

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


def _moved(pictures: Tensor, by: Tensor) -> Tensor:
    """Return pictures (B, ..., H, W) moved by pixels (2, B), zeros where nothing was."""
    out = pictures
    for axis, moved in zip((-2, -1), by, strict=True):
        side = pictures.shape[axis]
        source = torch.arange(side, device=by.device) - moved[:, None]
        place = [len(moved), *[1] * (pictures.ndim - 1)]
        place[axis] = side
        inside = ((source >= 0) & (source < side)).view(place)
        index = source.clamp(0, side - 1).view(place).expand_as(out)
        out = out.gather(axis, index) * inside
    return out


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
