"""OP3: K slots that explain a picture together, and that predict how they go on.

The steps of `op3.inference` follow a schedule: the slots of the first frame are refined
``seed_steps`` times; those of each later frame that is seen are predicted, then refined once; those
of the frames after them are only predicted. With the objective O_i after step i = 1, 2, ..., for
the picture of its frame,

    loss = sum_i i O_i / sum_i i / pixels

where moving pixels (`physion.models.vision.moving`) have the weight 1 + w, w = 0 as published.

Features are the states of all slots, with the means of their random part: after the refinement for
frames that are seen, after the prediction for imagined ones. When features are computed, the slots
of all trials start from the same random numbers, so that a slot tends to hold the same thing.

Source: Veerapaneni et al. 2020, "Entity Abstraction in Visual Model-Based Reinforcement Learning";
docs/vision-models.md says in what the sizes differ from the published code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from physion.models.batch import Batch, Provenance, Rollout
from physion.models.op3.config import Op3Config, Op3Options
from physion.models.op3.inference import Explained, SlotInference, Slots
from physion.models.op3.pixels import Decoded
from physion.models.torch_model import initial_weights
from physion.models.vision.clips import context_pictures, window_pictures
from physion.models.vision.moving import future_error, moving_pixels
from physion.models.vision.picture_model import PictureModel
from physion.models.vision.pictures import normalized_pictures
from physion.seeds import generator

NAME = "op3"
VERSION = 1
"""To be raised with every change of what equal weights compute, or of the training."""

Noise = Callable[[], Tensor]
"""Function that gives standard normal numbers (B, K, Rs), new ones at every call."""


@dataclass(frozen=True, eq=False)
class TrainingClips:
    """Objective of training clips, a scalar, with its parts; and the imagined pictures."""

    objective: Tensor
    nll: Tensor
    kl: Tensor
    imagined: Tensor


class Op3(PictureModel):
    """Model of pictures as slots, and of how they move one another."""

    def __init__(self, config: Op3Config, options: Op3Options) -> None:
        super().__init__(NAME, VERSION, config, options, samples=options.samples, framewise=False)
        self.config = config
        if options.slots:
            self.name += f"-{options.slots}-slots"
        with initial_weights("op3", options.seed):
            self.slots = SlotInference(config)

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        encoder = f"{self.config.slots} slots {self.config.image_size} px"
        return self.origin(encoder, "interaction network", "pictures of slots")

    def encode(self, batch: Batch) -> Tensor:
        """Return the states of the slots (B, T, K R) after each frame was seen."""
        return self._watch(normalized_pictures(batch, self.spec, self.name))[0]

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: float) -> Rollout:
        """Return the states (B, S, future, K R) of ``samples`` futures; no frame of them is seen.

        They follow from ``seed`` and the name of the trial alone. With the knob ``show`` above 0,
        ``shown`` holds pictures, ``rgb`` (B, S, future, H, W, 3) uint8, and ``masks``
        (B, S, future, K, H, W) float32, and under ``context_masks`` those of the frames that were
        seen (B, T, K, H, W).
        """
        _, seen = self._watch(context_pictures(context, self.spec, self.name))
        slots = seen[-1]
        config, clips = self.config, len(context)
        shape = (samples, config.future + 1, config.slots, config.stochastic)
        draws = [generator(NAME, seed, trial).standard_normal(shape) for trial in context.trials]
        noise = torch.from_numpy(np.concatenate(draws)).to(slots.mean)
        shows = knobs.get("show", 0) > 0
        features, shown, found = [], [], []
        with torch.no_grad():
            if shows:
                found = [self.slots.decoder(beliefs.states) for beliefs in seen]
            state = _repeated(slots, samples, noise[:, 0])
            for step in range(config.future):
                state = self.slots.predict(state, noise[:, step + 1])
                features.append(state.features())
                if shows:
                    shown.append(self.slots.decoder(state.states))
        values = torch.stack(features, 1).float().view(clips, samples, config.future, -1)
        return Rollout(features=values, shown=_shown(shown, found, clips, samples))

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss of training clips, and what it consists of.

        Training: ``loss`` in nats a pixel, ``nll``, ``kl`` by clip, and ``error``, the squared
        error of the imagined frames. In a validation ``loss`` is the squared error of moving pixels
        of the imagined frames (`physion.models.vision.moving`), ``error`` that of all pixels, and
        ``objective`` the loss of the training.
        """
        pictures = window_pictures(batch, self.spec, self.name, self.window)
        # A validation is without gradients, which the refinement needs.
        with torch.enable_grad():
            clips = self._run(pictures, batch.valid)
        error = future_error(clips.imagined, pictures, batch.valid)
        if self.training:
            parts = {"nll": clips.nll, "kl": clips.kl, "error": error.pixels}
            return {"loss": clips.objective, **parts}
        parts = {"error": error.pixels, "objective": clips.objective}
        return {name: part.detach() for name, part in {"loss": error.moving, **parts}.items()}

    def _run(self, pictures: Tensor, valid: Tensor) -> TrainingClips:
        """Return the objective of training clips (B, T, 3, H, W)."""
        config, inference = self.config, self.slots
        clips, frames, _, height, width = pictures.shape

        def noise() -> Tensor:
            return torch.randn(clips, config.slots, config.stochastic).to(pictures)

        slots, steps, imagined = inference.start(noise()), [], []
        explained = inference.explain(slots, pictures[:, 0])
        for frame in range(frames):
            picture = pictures[:, frame]
            if frame:
                explained = inference.explain(inference.predict(explained.slots, noise()), picture)
                steps.append((frame, explained))
            if frame >= config.past:
                imagined.append(explained.decoded.picture())
                continue
            for _ in range(1 if frame else config.seed_steps):
                refined = inference.refine(explained, picture, noise())
                explained = inference.explain(refined, picture)
                steps.append((frame, explained))
        moves = nn.functional.pad(moving_pixels(pictures), (0, 0, 0, 0, 1, 0))
        nll, kl = weighted_means(steps, valid, 1 + config.motion * moves)
        objective = nll + config.beta * kl / (height * width)
        return TrainingClips(objective, nll, kl, torch.stack(imagined, 1))

    def _watch(self, pictures: Tensor) -> tuple[Tensor, list[Slots]]:
        """Return features (B, T, K R) of clips (B, T, 3, H, W), and beliefs after each frame."""
        config, inference = self.config, self.slots
        rng = generator(NAME, "slots")
        features, beliefs = [], []
        # The refinement needs gradients, which tensors of the inference mode cannot have.
        with torch.inference_mode(False), torch.enable_grad():
            seen = pictures.clone()
            shape = (config.slots, config.stochastic)

            def noise() -> Tensor:
                values = torch.from_numpy(rng.standard_normal(shape)).to(seen)
                return values.expand(len(seen), -1, -1)

            slots = inference.start(noise())
            for frame in range(seen.shape[1]):
                if frame:
                    slots = inference.predict(slots, noise())
                for _ in range(1 if frame else config.seed_steps):
                    explained = inference.explain(slots.detached(), seen[:, frame])
                    slots = inference.refine(explained, seen[:, frame], noise())
                features.append(slots.features().detach())
                beliefs.append(slots.detached())
            return torch.stack(features, 1).float(), beliefs


def weighted_means(
    steps: list[tuple[int, Explained]], valid: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Return negative log likelihood by pixel, and divergence, of the steps of training clips.

    Parameters
    ----------
    steps
        Frame of each step, and how well it is explained.
    valid : Tensor
        Whether the movies have the frames (B, T); others do not count.
    weights : Tensor
        Of the pixels of all frames (B, T, H, W).

    Notes
    -----
    They are means over clips and steps; step i has the weight i.
    """
    counted = torch.stack([valid[:, frame] for frame, _ in steps], 1)
    numbers = torch.arange(1, len(steps) + 1, device=valid.device)
    importance = (counted * numbers).float()
    nll = [-(step.likelihood.pixels * weights[:, f]).mean((1, 2)) for f, step in steps]
    kl = [step.kl for _, step in steps]
    total = importance.sum().clamp_min(1)
    means = [(torch.stack(values, 1) * importance).sum() / total for values in (nll, kl)]
    return means[0], means[1]


def _repeated(slots: Slots, samples: int, noise: Tensor) -> Slots:
    """Return the beliefs for ``samples`` futures of every clip, which follow one another."""
    deterministic, mean, raw, prior_mean, prior_raw = (
        part.repeat_interleave(samples, 0)
        for part in (
            slots.deterministic, slots.mean, slots.raw, slots.prior_mean, slots.prior_raw,
        )
    )  # fmt: skip
    memory = (noise.new_zeros(0), noise.new_zeros(0))
    return Slots(deterministic, mean, raw, prior_mean, prior_raw, noise, memory)


def _shown(
    steps: list[Decoded], seen: list[Decoded], clips: int, samples: int
) -> dict[str, Tensor]:
    """Return what slots show at imagined steps, and the masks of frames that were seen."""
    if not steps:
        return {}
    pictures = torch.stack([step.picture() for step in steps], 1).clamp(0, 1)
    rgb = (pictures.movedim(2, -1) * 255).round().to(torch.uint8)
    futures = {
        name: value.view(clips, samples, *value.shape[1:])
        for name, value in {"rgb": rgb, "masks": _masks(steps)}.items()
    }
    return {**futures, "context_masks": _masks(seen)}


def _masks(steps: list[Decoded]) -> Tensor:
    """Return the masks (B, T, K, H, W) of T steps, float32."""
    return torch.stack([step.masks[:, :, 0] for step in steps], 1).float()
