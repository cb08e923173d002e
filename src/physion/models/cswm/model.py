"""C-SWM: contrastively trained structured world model.

Tensors (B clips, T pictures, h = ``config.stacked``, S = T - h + 1 states, K slots of D values):

- pictures (B, T, 3, H, W). Each run of h successive ones is stacked to 3 h channels.
- states (B, S, K, D), at the last picture of each run.
- features (B, T, K D): slots of the states, one after the other. As in the published code, the
  first state stands for the h - 1 frames before it too.
- next state z' = z + T(z), or z + T(z, z - z_before) with a ``memory`` of 2
  (`networks.SlotTransition`): motion is known from several pictures in one state, or from two
  states.

Source: docs/official-system.md, section 5, and Kipf et al. 2020 (`networks`, `contrast`).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from physion.errors import BadInputError
from physion.models.batch import Batch, Provenance, Rollout, Spec
from physion.models.cswm.config import CswmConfig
from physion.models.cswm.contrast import (
    all_pairs_loss,
    energy,
    hinge_loss,
    rank_next_states,
)
from physion.models.cswm.networks import SlotEncoder, SlotExtractor, SlotTransition
from physion.models.torch_model import initial_weights
from physion.models.vision.model import VisionModel, VisionOptions
from physion.models.vision.pictures import normalized_pictures

NAME, VERSION = "cswm", 1


class Cswm(VisionModel):
    """Slots of pictures, trained to be predictable, and different in different states."""

    def __init__(self, config: CswmConfig, options: VisionOptions) -> None:
        spec = Spec(
            image_size=config.image_size,
            mean=(0.0, 0.0, 0.0),
            std=(1.0, 1.0, 1.0),
            framewise=config.stacked == 1,
        )
        super().__init__(NAME, VERSION, config, config.training, options, spec)
        self.config = config
        self.window = config.stacked + config.memory - 1 + config.transitions
        with initial_weights("cswm", options.seed):
            self.extractor = SlotExtractor(
                3 * config.stacked, config.channels, config.slots, config.kernels, config.strides
            )
            pixels = self.extractor.map_size(config.image_size) ** 2
            self.encoder = SlotEncoder(pixels, config.hidden, config.slot_size)
            self.transition = SlotTransition(
                config.memory * config.slot_size, config.slot_size, config.hidden
            )
        if config.memory == 2:
            # An untrained network predicts that nothing changes.
            nn.init.zeros_(self.transition.change.weight)
            nn.init.zeros_(self.transition.change.bias)

    def provenance(self) -> Provenance:
        """Return name, size and origin of the weights."""
        return self.origin("convolutional slots", "graph network", "contrastive")

    def encode(self, batch: Batch) -> Tensor:
        """Return the features (B, T, K D) of the pictures of a batch."""
        states = self._states(batch).flatten(2)
        before = states[:, :1].expand(-1, self.config.stacked - 1, -1)
        return torch.cat([before, states], 1)

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: Any) -> Rollout:
        """Roll the transition out from the end of the context.

        It is deterministic: all samples are equal, and ``seed`` has no effect. With the knob
        ``show`` above 0, ``shown`` holds the imagined states under ``slots`` (B, S, future, K, D),
        and under ``context_masks`` the maps (B, T, K, h, w) of the context.
        """
        features = self.encode(context) if context.features is None else context.features
        states = features[:, -self.config.memory :]
        states = states.view(*states.shape[:2], self.config.slots, -1)
        imagined = []
        for _ in range(self.spec.future):
            states = torch.cat([states[:, 1:], self._predicted(states)], 1)
            imagined.append(states[:, -1].flatten(1))
        future = torch.stack(imagined, 1)[:, None].expand(-1, samples, -1, -1)
        if knobs.get("show", 0) <= 0:
            return Rollout(features=future)
        maps = self.maps(context)
        before = maps[:, :1].expand(-1, self.config.stacked - 1, -1, -1, -1)
        slots = future.reshape(*future.shape[:3], self.config.slots, -1)
        shown = {"slots": slots, "context_masks": torch.cat([before, maps], 1).float()}
        return Rollout(features=future, shown=shown)

    def maps(self, batch: Batch) -> Tensor:
        """Return the maps of the slots (B, S, K, h, w), in 0..1, of the pictures."""
        stacked = self._stacked(batch)
        out: Tensor = self.extractor(stacked.flatten(0, 1))
        return out.view(*stacked.shape[:2], *out.shape[1:])

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the contrastive loss of the transitions of a batch, and its two parts."""
        states = self._states(batch)
        return self._contrast(states, self._predicted(states[:, :-1]))

    def baseline(self, batch: Batch) -> Tensor:
        """Return the loss with the present state as the prediction of the next one."""
        states = self._states(batch)
        return self._contrast(states, states[:, self.config.memory - 1 : -1])["loss"]

    def next_state_ranks(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the ranks of the true next states among all states of a batch.

        The candidates are the B S states of all clips at all steps, among them the present one of
        each transition.

        Returns
        -------
        ranks : Tensor
            Of the predictions, B (S - memory).
        copied : Tensor
            The same for the present state as the prediction.
        """
        states, memory = self._states(batch), self.config.memory
        rows = torch.arange(states.shape[0] * states.shape[1], device=states.device)
        true = rows.view(states.shape[:2])[:, memory:].flatten()
        candidates = states.flatten(2).flatten(0, 1)
        predictions = (self._predicted(states[:, :-1]), states[:, memory - 1 : -1])
        ranks, copied = (
            rank_next_states(value.flatten(2).flatten(0, 1), true, candidates)
            for value in predictions
        )
        return ranks, copied

    def _contrast(self, states: Tensor, predicted: Tensor) -> dict[str, Tensor]:
        """Return the loss of states (B, S, K, D), the last ones of which were predicted."""
        config = self.config
        apart = energy(predicted, states[:, config.memory :], config.sigma).mean()
        if config.negatives == "permuted":
            flat = states[:, config.memory - 1 : -1].flatten(0, 1)
            order = torch.randperm(len(flat)).to(flat.device)
            far = hinge_loss(flat, flat[order], config.sigma, config.hinge)
        else:
            far = all_pairs_loss(states, config.sigma, config.hinge)
        return {"loss": apart + far, "next": apart, "negatives": far}

    def _predicted(self, states: Tensor) -> Tensor:
        """Return the states (B, S - memory + 1, K, D) that follow each of ``states`` (B, S, K, D).

        With a memory of 2, the first state has no prediction.
        """
        known = now = states[:, self.config.memory - 1 :]
        if self.config.memory == 2:
            known = torch.cat([now, now - states[:, :-1]], -1)
        change: Tensor = self.transition(known.flatten(0, 1))
        return now + change.view(now.shape)

    def _states(self, batch: Batch) -> Tensor:
        """Return the states (B, S, K, D) of a batch."""
        maps = self.maps(batch)
        out: Tensor = self.encoder(maps.flatten(0, 1))
        return out.view(*maps.shape[:2], *out.shape[1:])

    def _stacked(self, batch: Batch) -> Tensor:
        """Return runs of h pictures as (B, S, 3 h, H, W), the oldest first."""
        pictures = normalized_pictures(batch, self.spec, self.name)
        stacked = self.config.stacked
        if pictures.shape[1] < stacked:
            raise BadInputError(
                f"{self.name}: a state needs {stacked} pictures, and a clip has only "
                f"{pictures.shape[1]}"
            )
        runs = pictures.unfold(1, stacked, 1)  # (B, S, 3, H, W, h)
        return runs.permute(0, 1, 5, 2, 3, 4).flatten(2, 3)
