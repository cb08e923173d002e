"""RPIN: region proposal interaction network, which predicts boxes.

Tensors (B clips, T frames, h = ``settings.history``, K objects, states of C x p x p values):

- boxes (B, T, K, 4): centre and size in 0..1, without NaN (`known_boxes`).
- states (B, T, K, C, p, p): regions of the boxes in the feature maps of the pictures.
- features (B, T, K (C p p + 4)): state and box of each object, one object after the other, from
  left to right as they lie at the last observed frame (`from_left`), so that their order does not
  say which object is the agent. They are zeros for an object that no frame of the clip shows.

The boxes come from the ids, as in the published experiments: the model is supervised by them.
The published code encodes no boxes apart from the regions; here the box and its last change are
part of the state (`Dynamics`).

Source: docs/official-system.md, section 5, and Qi et al. 2021.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import roi_align

from physion.clips.batch import LAST_OBSERVED, Batch, Provenance, Rollout, Spec
from physion.core.errors import BadInputError
from physion.models.checkpoint import load_named
from physion.models.interface import Sizes, TrainingSettings
from physion.models.torch_model import initial_weights
from physion.models.vision import (
    VisionModel,
    VisionSettings,
    mean_of_counted,
    normalized_pictures,
)

NAME, VERSION = "rpin", 1

_PAPER: Mapping[str, Any] = {
    "image_size": 256, "objects": 10, "rollout": 11, "width": 256, "groups": 32, "depth": 4,
}  # fmt: skip
_RELEASED: Mapping[str, Any] = {
    **_PAPER, "context_at": "start", "context": 5, "future": 11,
    "history": 5, "sampling": 1, "aligned": False, "outputs": "published",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RpinSettings(VisionSettings):
    """Settings of RPIN; also see `SizedSettings`.

    - ``image_size``: pixels per side. ``objects``: rows of boxes K.
    - ``history``: observed frames h from which the next one is predicted. ``rollout``: frames that
      are predicted in training.
    - ``width``: channels of the feature maps and states; the first convolution has a quarter of
      them. ``groups``: of group normalisation. ``depth``: scales of the hourglass.
    - ``pool``: cells per side of a region. ``sampling``: points per side of a cell, and
      ``aligned``: whether pixel centres, not corners, are at whole numbers (`RoIAlign`).
    - ``margin``: part of width and height by which a box is enlarged before its region is cut out.
    - ``outputs``: what is decoded: ``boxes``, the changes of centre and size; or ``published``, the
      change of the centre and, on its own, the centre, in pixels, while sizes stay.
    - ``offset_weight``, ``position_weight``: of the published loss.
    """

    model: str = NAME
    stride: int = 9
    objects: int = 8
    history: int = 4
    rollout: int = 8
    width: int = 32
    groups: int = 4
    depth: int = 2
    pool: int = 3
    sampling: int = 2
    aligned: bool = True
    margin: float = 0.1
    outputs: Literal["boxes", "published"] = "boxes"
    offset_weight: float = 100.0
    position_weight: float = 1.0

    sizes: ClassVar[Sizes] = {"small": {}, "paper": _PAPER, "released": _RELEASED}

    def __post_init__(self) -> None:
        self.at_least(
            1, "image_size", "objects", "history", "rollout", "width", "groups", "depth", "pool",
            "sampling",
        )  # fmt: skip


_SMALL_TRAINING = TrainingSettings(
    steps=1800,
    batch=16,
    learning_rate=1e-3,
    schedule="cosine",
    warmup=30,
    clip=1.0,
    validate_every=100,
    log_every=20,
    checkpoint_every=100,
)
_PAPER_TRAINING = replace(_SMALL_TRAINING, steps=100_000, learning_rate=2e-4, warmup=2000)
TRAINING: Mapping[str, TrainingSettings] = {
    "small": _SMALL_TRAINING,
    "paper": _PAPER_TRAINING,
    # The published code makes a new Adam at every step, which equals betas of 0.
    "released": replace(
        _PAPER_TRAINING,
        steps=1_000_000,
        learning_rate=2e-6,
        weight_decay=1e-6,
        betas=(0.0, 0.0),
        schedule="constant",
        warmup=0,
        clip=0.0,
    ),
}


# Boxes of objects as centre and size, (x, y, w, h) in 0..1 of the picture.
#
# An object that no frame of a clip shows is absent: its boxes are zeros, and its size tells.

UNIT = 0.02
"""Unit of changes of boxes and of errors, as part of the picture's side. A body that moves at
1 m/s, 3 m from the camera, moves 0.03 in 0.09 s."""


def known_boxes(boxes: Tensor) -> Tensor:
    """Return centres and sizes of all objects at all frames.

    In a frame that does not show it, an object has its last box, or before the first its first one.

    Parameters
    ----------
    boxes : Tensor
        Left, top, right, bottom (B, T, K, 4); NaN where an object is not seen.

    Returns
    -------
    known : Tensor
        (B, T, K, 4), without NaN; zeros for objects that no frame shows.
    """
    seen = boxes.isfinite().all(-1)
    steps = torch.arange(boxes.shape[1], device=boxes.device)[:, None]
    last = torch.where(seen, steps, -1).cummax(1).values
    first = seen.to(torch.uint8).argmax(1, keepdim=True)
    rows = torch.where(last >= 0, last, first)
    filled = boxes.gather(1, rows[..., None].expand(boxes.shape))
    return to_center(filled.nan_to_num(0.0))


def is_present(known: Tensor) -> Tensor:
    """Return which objects (...) of boxes (..., 4) as `known_boxes` gives them are not absent."""
    return known[..., 2] > 0


def from_left(known: Tensor, row: int) -> Tensor:
    """Return the objects (B, K) from left to right as they lie in frame number ``row`` of a clip.

    Objects that are absent come last. ``known`` (B, T, K, 4) are boxes as `known_boxes` gives them.
    """
    now = known[:, row]
    place = torch.where(is_present(now), now[..., 0], torch.inf)
    return place.argsort(dim=1, stable=True)


def to_center(boxes: Tensor) -> Tensor:
    """Return centre and size (..., 4) of left, top, right and bottom."""
    low, high = boxes[..., :2], boxes[..., 2:]
    return torch.cat([(low + high) / 2, high - low], -1)


def to_edges(boxes: Tensor) -> Tensor:
    """Return left, top, right and bottom (..., 4) of centre and size."""
    center, size = boxes[..., :2], boxes[..., 2:]
    return torch.cat([center - size / 2, center + size / 2], -1)


def last_changes(boxes: Tensor) -> Tensor:
    """Return the change in `UNIT` of boxes (B, T, K, 4) from the frame before, 0 for the first."""
    return torch.diff(boxes, dim=1, prepend=boxes[:, :1]) / UNIT


def constant_velocity(known: Tensor, steps: int) -> Tensor:
    """Continue the last two of known boxes (B, T, K, 4) at constant velocity, as (B, steps, K, 4).

    With a single known box they stay where they are.
    """
    last = known[:, -1]
    change = last - known[:, -2] if known.shape[1] > 1 else torch.zeros_like(last)
    ahead = torch.arange(1, steps + 1, device=known.device, dtype=known.dtype)
    return last[:, None] + ahead[:, None, None] * change[:, None]


# Hourglass network: feature maps with a quarter of the resolution of the pictures.
#
# References
# ----------
# A. Newell, K. Yang and J. Deng, Stacked hourglass networks for human pose estimation, ECCV 2016;
#   one
# stack, with group normalisation as in RPIN (Qi et al. 2021, appendix A).


class Bottleneck(nn.Module):
    """Residual block x + f(x): normalisation, ReLU and convolution, thrice, half as wide inside."""

    def __init__(self, inputs: int, outputs: int, groups: int) -> None:
        super().__init__()
        inner = outputs // 2
        self.layers = nn.Sequential(
            *(nn.GroupNorm(groups, inputs), nn.ReLU(), nn.Conv2d(inputs, inner, 1)),
            *(nn.GroupNorm(groups, inner), nn.ReLU(), nn.Conv2d(inner, inner, 3, padding=1)),
            *(nn.GroupNorm(groups, inner), nn.ReLU(), nn.Conv2d(inner, outputs, 1)),
        )
        same = inputs == outputs
        self.skip = nn.Identity() if same else nn.Conv2d(inputs, outputs, 1)

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps (N, outputs, H, W)."""
        out: Tensor = self.skip(maps) + self.layers(maps)
        return out


class Hourglass(nn.Module):
    """Maps at ``depth`` lower resolutions, each half of the one before, added up again."""

    def __init__(self, depth: int, width: int, groups: int) -> None:
        super().__init__()
        self.level = Bottleneck(width, width, groups)
        self.before = Bottleneck(width, width, groups)
        self.inner = (
            Hourglass(depth - 1, width, groups) if depth > 1 else Bottleneck(width, width, groups)
        )
        self.after = Bottleneck(width, width, groups)

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps of the same shape (N, width, H, W); H and W are multiples of 2^depth."""
        low = self.after(self.inner(self.before(functional.max_pool2d(maps, 2))))
        out: Tensor = self.level(maps) + functional.interpolate(low, scale_factor=2)
        return out


class Backbone(nn.Module):
    """Pictures (N, 3, H, W) to maps (N, width, H / 4, W / 4)."""

    def __init__(self, width: int, depth: int, groups: int) -> None:
        super().__init__()
        narrow, half = width // 4, width // 2
        self.stem = nn.Sequential(
            nn.Conv2d(3, narrow, 7, stride=2, padding=3),
            nn.GroupNorm(groups, narrow),
            nn.ReLU(),
            Bottleneck(narrow, half, groups),
            nn.MaxPool2d(2),
            Bottleneck(half, half, groups),
            Bottleneck(half, width, groups),
        )
        self.hourglass = Hourglass(depth, width, groups)
        self.head = nn.Sequential(
            Bottleneck(width, width, groups),
            nn.Conv2d(width, width, 1),
            nn.GroupNorm(groups, width),
            nn.ReLU(),
            nn.Conv2d(width, width, 1),
        )

    def forward(self, pictures: Tensor) -> Tensor:
        """Return the feature maps."""
        out: Tensor = self.head(self.hourglass(self.stem(pictures)))
        return out


# Object states and their interaction.
#
# The state s_k of an object is a small map (C, p, p): the region of its box in the feature maps.
# With boxes b, their last changes v in `UNIT` and h observed frames, x_k^t = s_k^t + E (b_k^t,
# v_k^t), and for every frame t of the history
#
#     e_k = a( f(x_k) + sum_{l != k} r(x_k, x_l) ),    z_k^t = g(e_k, x_k),
#
# with weights of their own for each of the h places in time. The next state is
#
#     s_k = p( z_k^{1}, ..., z_k^{h} ).
#
# r is one convolution of both states and a ReLU, r = relu(W_1 x_k + W_2 x_l), so that both
# products are computed once for each object. The sum runs over objects that are present.
#
# References
# ----------
# H. Qi et al., Learning long-term visual dynamics with region proposal interaction networks, ICLR
# 2021, sections 3.1 and 3.2.


def convolution(inputs: int, outputs: int) -> nn.Sequential:
    """Return a convolution of 3 x 3 cells that keeps the size, and a ReLU."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU())


def cut_regions(
    maps: Tensor, boxes: Tensor, pool: int, margin: float, *, sampling: int, aligned: bool
) -> Tensor:
    """Return the regions of boxes in feature maps (RoIAlign).

    Parameters
    ----------
    maps : Tensor
        Feature maps (N, C, H, W).
    boxes : Tensor
        Centres and sizes (N, K, 4) in 0..1.
    pool : int
        Cells p per side of a region.
    margin : float
        Part of width and height by which boxes are enlarged.
    sampling : int
        Points per side of a cell that are averaged.
    aligned : bool
        Whether the centre of the first pixel is at 0.5, and not at 0.

    Returns
    -------
    regions : Tensor
        (N, K, C, p, p).
    """
    count, objects = boxes.shape[:2]
    enlarged = torch.cat([boxes[..., :2], boxes[..., 2:] * (1 + margin)], -1)
    height, width = maps.shape[-2:]
    edges = to_edges(enlarged) * edges_scale(boxes, width, height)
    rows = torch.arange(count, device=boxes.device).repeat_interleave(objects)
    listed = torch.cat([rows[:, None].to(edges.dtype), edges.flatten(0, 1)], 1)
    regions: Tensor = roi_align(
        maps, listed.to(maps.dtype), pool, sampling_ratio=sampling, aligned=aligned
    )
    return regions.view(count, objects, maps.shape[1], pool, pool)


def edges_scale(boxes: Tensor, width: int, height: int) -> Tensor:
    """Return the factors (4) from 0..1 to pixels of left, top, right and bottom."""
    return boxes.new_tensor([width, height, width, height])


class Interaction(nn.Module):
    """Effects of objects on each other at one time; it does not depend on their order."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.alone = convolution(width, width)
        self.receiver = nn.Conv2d(width, width, 3, padding=1)
        self.sender = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.affect = convolution(width, width)
        self.join = convolution(2 * width, width)

    def forward(self, states: Tensor, present: Tensor) -> Tensor:
        """Return the effects z (B, K, C, p, p) on states of that shape; ``present`` is (B, K)."""
        flat, shape = states.flatten(0, 1), states.shape
        received = self.receiver(flat).view(shape)[:, :, None]
        sent = self.sender(flat).view(shape)[:, None]
        others = ~torch.eye(shape[1], dtype=torch.bool, device=states.device)
        counted = (present[:, None] & others)[..., None, None, None]
        relations = (torch.relu(received + sent) * counted).sum(2)
        effects = self.affect(self.alone(flat) + relations.flatten(0, 1))
        out: Tensor = self.join(torch.cat([effects, flat], 1))
        return out.view(shape)


class Dynamics(nn.Module):
    """States and boxes of h frames to the next state and what is decoded from it.

    Parameters
    ----------
    width
        Channels C of a state. ``pool``: its cells per side.
    history
        Number of frames h.
    """

    def __init__(self, width: int, pool: int, history: int) -> None:
        super().__init__()
        self.place = nn.Linear(8, width)
        self.interactions = nn.ModuleList(Interaction(width) for _ in range(history))
        self.join = nn.Sequential(nn.Conv2d(history * width, width, 1), nn.ReLU())
        self.decode = nn.Linear(width * pool * pool, 4)

    def forward(self, states: Tensor, boxes: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
        """Return the next states and their decoded values.

        Parameters
        ----------
        states : Tensor
            (B, h, K, C, p, p).
        boxes : Tensor
            Centres and sizes (B, h, K, 4).
        present : Tensor
            Which objects are there (B, K).

        Returns
        -------
        state : Tensor
            (B, K, C, p, p); zeros for absent objects.
        decoded : Tensor
            (B, K, 4).
        """
        moving = torch.cat([boxes, last_changes(boxes)], -1)
        placed = states + self.place(moving)[..., None, None]
        pairs = zip(self.interactions, placed.unbind(1), strict=True)
        effects = [interaction(now, present) for interaction, now in pairs]
        joined = torch.cat(effects, 2).flatten(0, 1)
        state = self.join(joined).view(states[:, 0].shape) * present[..., None, None, None]
        return state, self.decode(state.flatten(2))


# The model: loss, and imagination.

_LEAST_SIZE = 1e-3
"""Least width and height of an imagined box."""


class RolledOut(NamedTuple):
    """Prediction of S steps: states (B, S, K, C, p, p), boxes and decoded values (B, S, K, 4)."""

    states: Tensor
    boxes: Tensor
    decoded: Tensor


class Targets(NamedTuple):
    """What follows the history: boxes (B, S, K, 4), and where they count (B, S, K)."""

    boxes: Tensor
    counted: Tensor


class Rpin(VisionModel):
    """RPIN, which sees pictures and boxes of objects, and predicts their boxes."""

    settings: RpinSettings

    def __init__(self, settings: RpinSettings) -> None:
        spec = Spec(
            inputs=("rgb", "boxes"),
            image_size=settings.image_size,
            mean=(0.5, 0.5, 0.5),
            std=(0.25, 0.25, 0.25),
            stride=settings.stride,
            context=settings.context,
            future=settings.future,
            context_at=settings.context_at,
            objects=settings.objects,
            framewise=False,
        )
        super().__init__(VERSION, settings, TRAINING[settings.size], spec)
        self.window = settings.history + settings.rollout
        with initial_weights("rpin", settings.seed):
            self.backbone = Backbone(settings.width, settings.depth, settings.groups)
            self.region = convolution(settings.width, settings.width)
            self.dynamics = Dynamics(settings.width, settings.pool, settings.history)
        if settings.outputs == "boxes":
            # An untrained network predicts that nothing moves.
            nn.init.zeros_(self.dynamics.decode.weight)
            nn.init.zeros_(self.dynamics.decode.bias)
        load_named(self, settings.weights)

    def provenance(self) -> Provenance:
        """Return name, size and origin of the weights."""
        return self.origin("hourglass, regions of true boxes", "interaction network", "boxes")

    def encode(self, batch: Batch) -> Tensor:
        """Return features (B, T, K (C p p + 4)) of the objects of a batch."""
        boxes = known_boxes(self._seen(batch))
        order = self._order(batch, boxes)[:, None, :, None].expand_as(boxes)
        boxes = boxes.gather(2, order)
        states = self._states(batch, boxes)
        return torch.cat([states.flatten(3), boxes], -1).flatten(2)

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: Any) -> Rollout:
        """Predict states and boxes from the last h frames of the context.

        The prediction is deterministic: all samples are equal, and ``seed`` has no effect.
        ``shown`` holds the boxes, in the order of the boxes of the context; they are NaN for absent
        objects.
        """
        features = self.encode(context) if context.features is None else context.features
        states, boxes = self._split(features[:, -self.settings.history :])
        imagined = self._roll_out(states, boxes, context.future)
        joined = torch.cat([imagined.states.flatten(3), imagined.boxes], -1).flatten(2)
        absent = ~is_present(boxes[:, -1])[:, None, :, None]
        shown = to_edges(imagined.boxes).masked_fill(absent, float("nan"))
        if context.boxes is not None:
            place = self._order(context, known_boxes(self._seen(context))).argsort(dim=1)
            shown = shown.gather(2, place[:, None, :, None].expand_as(shown))
        return Rollout(
            features=joined[:, None].expand(-1, samples, -1, -1),
            shown={"boxes": shown[:, None].expand(-1, samples, -1, -1, -1)},
        )

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss of the boxes that follow the first h frames.

        With the outputs ``boxes``, it is the smooth L1 distance of centre and size in `UNIT`:
        half the square up to 1, linear beyond. ``published`` gives

            offset_weight |d - (c' - c)|^2 + position_weight |q - c'|^2

        of decoded change d and centre q, true centre c and next one c', in pixels. Objects that a
        frame does not show do not count.
        """
        boxes, targets = self._task(batch)
        history = batch.steps(slice(0, self.settings.history))
        imagined = self._roll_out(self._states(history, boxes), boxes, targets.boxes.shape[1])
        if self.settings.outputs == "boxes":
            return {"loss": self._distance(imagined.boxes, targets)}
        return {"loss": self._published(imagined, boxes[:, -1:], targets)}

    def baseline(self, batch: Batch) -> Tensor:
        """Return the loss of boxes at constant velocity."""
        boxes, targets = self._task(batch)
        predicted = constant_velocity(boxes, targets.boxes.shape[1])
        if self.settings.outputs == "boxes":
            return self._distance(predicted, targets)
        before = torch.cat([boxes[:, -1:], predicted[:, :-1]], 1)
        change = (predicted - before)[..., :2]
        decoded = torch.cat([change, predicted[..., :2]], -1) * self.settings.image_size
        imagined = RolledOut(predicted, predicted, decoded)
        return self._published(imagined, boxes[:, -1:], targets)

    def center_errors(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the mean distances of predicted centres from the true ones, by step (S).

        Returns
        -------
        errors : Tensor
            Of the prediction, as part of the picture's side; NaN for a step without any object.
        constant : Tensor
            The same for boxes at constant velocity.
        """
        boxes, targets = self._task(batch)
        history = batch.steps(slice(0, self.settings.history))
        steps = targets.boxes.shape[1]
        imagined = self._roll_out(self._states(history, boxes), boxes, steps).boxes
        counted = targets.counted.sum((0, 2))

        def error(predicted: Tensor) -> Tensor:
            apart = (predicted - targets.boxes)[..., :2].norm(dim=-1)
            mean: Tensor = (apart * targets.counted).sum((0, 2)) / counted
            return mean

        return error(imagined), error(constant_velocity(boxes, steps))

    def _roll_out(self, states: Tensor, boxes: Tensor, steps: int) -> RolledOut:
        """Predict ``steps`` steps from states and boxes of h frames."""
        present = is_present(boxes[:, -1])
        rows: list[tuple[Tensor, Tensor, Tensor]] = []
        for _ in range(steps):
            state, decoded = self.dynamics(states, boxes, present)
            box = self._decoded_box(boxes[:, -1], decoded) * present[..., None]
            states = torch.cat([states[:, 1:], state[:, None]], 1)
            boxes = torch.cat([boxes[:, 1:], box[:, None]], 1)
            rows.append((state, box, decoded))
        return RolledOut(*(torch.stack(part, 1) for part in zip(*rows, strict=True)))

    def _decoded_box(self, box: Tensor, decoded: Tensor) -> Tensor:
        """Return the next box (B, K, 4) from the last one and what was decoded."""
        if self.settings.outputs == "published":
            return torch.cat([decoded[..., 2:] / self.settings.image_size, box[..., 2:]], -1)
        moved = box + UNIT * decoded
        return torch.cat([moved[..., :2], moved[..., 2:].clamp(min=_LEAST_SIZE)], -1)

    def _distance(self, predicted: Tensor, targets: Targets) -> Tensor:
        """Return the mean smooth L1 distance of boxes (B, S, K, 4) from the true ones."""
        apart = functional.smooth_l1_loss(
            predicted / UNIT, targets.boxes / UNIT, reduction="none"
        ).sum(-1)
        return mean_of_counted(apart, targets.counted)

    def _published(self, imagined: RolledOut, last: Tensor, targets: Targets) -> Tensor:
        """Return the published loss; ``last`` are the last known boxes (B, 1, K, 4)."""
        settings = self.settings
        true = targets.boxes[..., :2] * settings.image_size
        before = torch.cat([last[..., :2] * settings.image_size, true[:, :-1]], 1)
        offset, position = imagined.decoded[..., :2], imagined.decoded[..., 2:]
        errors = (
            settings.offset_weight * (offset - (true - before)).pow(2)
            + settings.position_weight * (position - true).pow(2)
        ).sum(-1)
        return mean_of_counted(errors, targets.counted)

    def _task(self, batch: Batch) -> tuple[Tensor, Targets]:
        """Return the boxes of the first h frames, and what follows them."""
        history = self.settings.history
        all_boxes = self._seen(batch)
        if all_boxes.shape[1] <= history:
            raise BadInputError(
                f"{self.name}: a training clip needs more than {history} frames, not "
                f"{all_boxes.shape[1]}"
            )
        boxes = known_boxes(all_boxes[:, :history])
        later = all_boxes[:, history:]
        seen = later.isfinite().all(-1) & batch.valid[:, history:, None]
        counted = seen & is_present(boxes[:, -1])[:, None]
        # Where a frame does not show an object, its last box stands in; it does not count.
        return boxes, Targets(known_boxes(all_boxes)[:, history:], counted)

    def _order(self, batch: Batch, known: Tensor) -> Tensor:
        """Return the objects (B, K) of clips from left to right at the last observed frame."""
        observed = batch.frames[0] <= LAST_OBSERVED
        return from_left(known, max(int(observed.sum()) - 1, 0))

    def _seen(self, batch: Batch) -> Tensor:
        """Return the boxes of a batch, after a check of their shape."""
        boxes, rows = batch.boxes, self.spec.objects
        if boxes is None or boxes.shape[2] != rows:
            found = "none" if boxes is None else f"{boxes.shape[2]}"
            raise BadInputError(f"{self.name}: boxes of {rows} objects are needed, not {found}")
        out: Tensor = boxes
        return out

    def _states(self, batch: Batch, boxes: Tensor) -> Tensor:
        """Return the states (B, T, K, C, p, p) of objects with known boxes (B, T, K, 4)."""
        settings = self.settings
        pictures = normalized_pictures(batch, self.spec, self.name)
        regions = cut_regions(
            self.backbone(pictures.flatten(0, 1)),
            boxes.flatten(0, 1),
            settings.pool,
            settings.margin,
            sampling=settings.sampling,
            aligned=settings.aligned,
        )
        states: Tensor = self.region(regions.flatten(0, 1))
        shaped = states.view(*boxes.shape[:3], *states.shape[1:])
        return shaped * is_present(boxes)[..., None, None, None]

    def _split(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return states and boxes of features (B, T, K (C p p + 4))."""
        settings = self.settings
        cells = (settings.width, settings.pool, settings.pool)
        objects = features.view(*features.shape[:2], settings.objects, -1)
        return objects[..., :-4].reshape(*objects.shape[:3], *cells), objects[..., -4:]
