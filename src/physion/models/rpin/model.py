"""RPIN: region proposal interaction network, which predicts boxes.

Tensors (B clips, T frames, h = ``config.history``, K objects, states of C x p x p values):

- boxes (B, T, K, 4): centre and size in 0..1, without NaN (`boxes.known_boxes`).
- states (B, T, K, C, p, p): regions of the boxes in the feature maps of the pictures.
- features (B, T, K (C p p + 4)): state and box of each object, one object after the other. They are
  zeros for an object that no frame of the clip shows.

The boxes are those of the ids, as in the published experiments: the model is supervised by them.
The published code encodes no boxes apart from the regions; here the box and its last change are
part of the state (`networks.Dynamics.place`).

Source: docs/official-system.md, section 5, and Qi et al. 2021 (`networks`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from physion.errors import BadInputError
from physion.models.batch import Batch, Provenance, Rollout, Spec
from physion.models.rpin.backbone import Backbone
from physion.models.rpin.boxes import (
    UNIT,
    constant_velocity,
    is_present,
    known_boxes,
    to_edges,
)
from physion.models.rpin.config import RpinConfig
from physion.models.rpin.networks import Dynamics, convolution, cut_regions
from physion.models.torch_model import initial_weights
from physion.models.vision.model import VisionModel, VisionOptions
from physion.models.vision.pictures import normalized_pictures

NAME, VERSION = "rpin", 1
_LEAST_SIZE = 1e-3
"""Least width and height of an imagined box."""


class Imagined(NamedTuple):
    """Prediction of S steps: states (B, S, K, C, p, p), boxes and decoded values (B, S, K, 4)."""

    states: Tensor
    boxes: Tensor
    decoded: Tensor


class Targets(NamedTuple):
    """What follows the history: boxes (B, S, K, 4), and where they count (B, S, K)."""

    boxes: Tensor
    counted: Tensor


class Rpin(VisionModel):
    """Network that sees pictures and boxes of objects, and predicts their boxes."""

    def __init__(self, config: RpinConfig, options: VisionOptions) -> None:
        spec = Spec(
            inputs=("rgb", "boxes"),
            image_size=config.image_size,
            mean=(0.5, 0.5, 0.5),
            std=(0.25, 0.25, 0.25),
            stride=9,
            context=5,
            future=11,
            objects=config.objects,
            framewise=False,
        )
        super().__init__(NAME, VERSION, config, config.training, options, spec)
        self.config = config
        self.window = config.history + config.rollout
        with initial_weights("rpin", options.seed):
            self.backbone = Backbone(config.width, config.depth, config.groups)
            self.region = convolution(config.width, config.width)
            self.dynamics = Dynamics(config.width, config.pool, config.history)
        if config.outputs == "boxes":
            # An untrained network predicts that nothing moves.
            nn.init.zeros_(self.dynamics.decode.weight)
            nn.init.zeros_(self.dynamics.decode.bias)

    def provenance(self) -> Provenance:
        """Return name, size and origin of the weights."""
        return self.origin("hourglass, regions of true boxes", "interaction network", "boxes")

    def encode(self, batch: Batch) -> Tensor:
        """Return features (B, T, K (C p p + 4)) of the objects of a batch."""
        boxes = self._boxes(batch)
        states = self._states(batch, boxes)
        return torch.cat([states.flatten(3), boxes], -1).flatten(2)

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: Any) -> Rollout:
        """Predict states and boxes from the last h frames of the context.

        The prediction is deterministic: all samples are equal, and ``seed`` has no effect.
        ``shown`` holds the boxes; they are NaN for absent objects.
        """
        features = self.encode(context) if context.features is None else context.features
        states, boxes = self._split(features[:, -self.config.history :])
        imagined = self._roll_out(states, boxes, self.spec.future)
        joined = torch.cat([imagined.states.flatten(3), imagined.boxes], -1).flatten(2)
        absent = ~is_present(boxes[:, -1])[:, None, :, None]
        shown = to_edges(imagined.boxes).masked_fill(absent, float("nan"))
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
        history = batch.steps(slice(0, self.config.history))
        imagined = self._roll_out(self._states(history, boxes), boxes, targets.boxes.shape[1])
        if self.config.outputs == "boxes":
            return {"loss": self._distance(imagined.boxes, targets)}
        return {"loss": self._published(imagined, boxes[:, -1:], targets)}

    def baseline(self, batch: Batch) -> Tensor:
        """Return the loss of boxes that go on at constant velocity."""
        boxes, targets = self._task(batch)
        predicted = constant_velocity(boxes, targets.boxes.shape[1])
        if self.config.outputs == "boxes":
            return self._distance(predicted, targets)
        before = torch.cat([boxes[:, -1:], predicted[:, :-1]], 1)
        change = (predicted - before)[..., :2]
        decoded = torch.cat([change, predicted[..., :2]], -1) * self.config.image_size
        imagined = Imagined(predicted, predicted, decoded)
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
        history = batch.steps(slice(0, self.config.history))
        steps = targets.boxes.shape[1]
        imagined = self._roll_out(self._states(history, boxes), boxes, steps).boxes
        counted = targets.counted.sum((0, 2))

        def error(predicted: Tensor) -> Tensor:
            apart = (predicted - targets.boxes)[..., :2].norm(dim=-1)
            mean: Tensor = (apart * targets.counted).sum((0, 2)) / counted
            return mean

        return error(imagined), error(constant_velocity(boxes, steps))

    def _roll_out(self, states: Tensor, boxes: Tensor, steps: int) -> Imagined:
        """Predict ``steps`` steps from states and boxes of h frames."""
        present = is_present(boxes[:, -1])
        rows: list[tuple[Tensor, Tensor, Tensor]] = []
        for _ in range(steps):
            state, decoded = self.dynamics(states, boxes, present)
            box = self._decoded_box(boxes[:, -1], decoded) * present[..., None]
            states = torch.cat([states[:, 1:], state[:, None]], 1)
            boxes = torch.cat([boxes[:, 1:], box[:, None]], 1)
            rows.append((state, box, decoded))
        return Imagined(*(torch.stack(part, 1) for part in zip(*rows, strict=True)))

    def _decoded_box(self, box: Tensor, decoded: Tensor) -> Tensor:
        """Return the next box (B, K, 4) from the last one and what was decoded."""
        if self.config.outputs == "published":
            return torch.cat([decoded[..., 2:] / self.config.image_size, box[..., 2:]], -1)
        moved = box + UNIT * decoded
        return torch.cat([moved[..., :2], moved[..., 2:].clamp(min=_LEAST_SIZE)], -1)

    def _distance(self, predicted: Tensor, targets: Targets) -> Tensor:
        """Return the mean smooth L1 distance of boxes (B, S, K, 4) from the true ones."""
        apart = functional.smooth_l1_loss(
            predicted / UNIT, targets.boxes / UNIT, reduction="none"
        ).sum(-1)
        return _mean(apart, targets.counted)

    def _published(self, imagined: Imagined, last: Tensor, targets: Targets) -> Tensor:
        """Return the published loss; ``last`` are the last known boxes (B, 1, K, 4)."""
        config = self.config
        true = targets.boxes[..., :2] * config.image_size
        before = torch.cat([last[..., :2] * config.image_size, true[:, :-1]], 1)
        offset, position = imagined.decoded[..., :2], imagined.decoded[..., 2:]
        errors = (
            config.offset_weight * (offset - (true - before)).pow(2)
            + config.position_weight * (position - true).pow(2)
        ).sum(-1)
        return _mean(errors, targets.counted)

    def _task(self, batch: Batch) -> tuple[Tensor, Targets]:
        """Return the boxes of the first h frames, and what follows them."""
        history = self.config.history
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

    def _boxes(self, batch: Batch) -> Tensor:
        """Return the boxes (B, T, K, 4) of all frames, as centre and size."""
        return known_boxes(self._seen(batch))

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
        config = self.config
        pictures = normalized_pictures(batch, self.spec, self.name)
        regions = cut_regions(
            self.backbone(pictures.flatten(0, 1)),
            boxes.flatten(0, 1),
            config.pool,
            config.margin,
            sampling=config.sampling,
            aligned=config.aligned,
        )
        states: Tensor = self.region(regions.flatten(0, 1))
        shaped = states.view(*boxes.shape[:3], *states.shape[1:])
        return shaped * is_present(boxes)[..., None, None, None]

    def _split(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return states and boxes of features (B, T, K (C p p + 4))."""
        config = self.config
        cells = (config.width, config.pool, config.pool)
        objects = features.view(*features.shape[:2], config.objects, -1)
        return objects[..., :-4].reshape(*objects.shape[:3], *cells), objects[..., -4:]


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    """Return the mean of the values that count; 0 if none does."""
    total: Tensor = (values * counted).sum()
    return total / counted.sum().clamp(min=1)
