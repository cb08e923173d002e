"""C-SWM: contrastively trained structured world model.

Tensors (B clips, T pictures, h = ``config.history``, K slots of D values):

- pictures (B, T, 3, H, W). Each run of h successive ones is stacked to 3 h channels, so that a
  state can hold velocities.
- states (B, T - h + 1, K, D), at the last picture of each run.
- features (B, T, K D): slots of the states, one after the other. As in the published code, the
  first state stands for the h - 1 frames before it too.
- next state z' = z + T(z) (`networks.SlotTransition`).

Source: docs/official-system.md, section 5, and Kipf et al. 2020 (`networks`, `contrast`).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from physion.errors import BadInputError
from physion.models.batch import Batch, Provenance, Rollout, Spec
from physion.models.cswm.config import CswmConfig
from physion.models.cswm.contrast import (
    energy,
    hinge_loss,
    rank_next_states,
    states_of_other_clips,
    states_of_other_steps,
)
from physion.models.cswm.networks import SlotEncoder, SlotExtractor, SlotTransition
from physion.models.vision.model import VisionModel, VisionOptions
from physion.models.vision.pictures import normalized_pictures
from physion.seeds import stable_hash

NAME, VERSION = "cswm", 1


class Cswm(VisionModel):
    """Slots of pictures, trained such that the next ones can be predicted and told from others."""

    def __init__(self, config: CswmConfig, options: VisionOptions) -> None:
        spec = Spec(
            image_size=config.image_size,
            mean=(0.0, 0.0, 0.0),
            std=(1.0, 1.0, 1.0),
            framewise=config.history == 1,
        )
        super().__init__(NAME, VERSION, config, config.training, options, spec)
        self.config = config
        self.window = config.history + config.transitions
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(stable_hash("cswm", options.seed) % 2**63)
            self.extractor = SlotExtractor(
                3 * config.history, config.channels, config.slots, config.kernels, config.strides
            )
            pixels = self.extractor.map_size(config.image_size) ** 2
            self.encoder = SlotEncoder(pixels, config.hidden, config.slot_size)
            self.transition = SlotTransition(config.slot_size, config.hidden)

    def provenance(self) -> Provenance:
        """Return name, size and origin of the weights."""
        return self.origin("convolutional slots", "graph network", "contrastive")

    def encode(self, batch: Batch) -> Tensor:
        """Return the features (B, T, K D) of the pictures of a batch."""
        states = self._states(batch).flatten(2)
        before = states[:, :1].expand(-1, self.config.history - 1, -1)
        return torch.cat([before, states], 1)

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: Any) -> Rollout:
        """Roll the transition out from the last state of the context.

        It is deterministic: all samples are equal, and ``seed`` has no effect.
        """
        features = self.encode(context) if context.features is None else context.features
        state = features[:, -1].view(len(features), self.config.slots, -1)
        imagined = []
        for _ in range(self.spec.future):
            state = state + self.transition(state)
            imagined.append(state.flatten(1))
        future = torch.stack(imagined, 1)[:, None]
        return Rollout(features=future.expand(-1, samples, -1, -1))

    def maps(self, batch: Batch) -> Tensor:
        """Return the maps of the slots (B, T - h + 1, K, h, w), in 0..1, of the pictures."""
        stacked = self._stacked(batch)
        out: Tensor = self.extractor(stacked.flatten(0, 1))
        return out.view(*stacked.shape[:2], *out.shape[1:])

    def prepare(self, sample: Batch) -> None:
        """Do nothing: there are no statistics."""

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the contrastive loss of the transitions of a batch, and its two parts."""
        states = self._states(batch)
        now = states[:, :-1]
        return self._contrast(states, now + self._changes(now))

    def baseline(self, batch: Batch) -> Tensor:
        """Return the loss with the present state as the prediction of the next one."""
        states = self._states(batch)
        return self._contrast(states, states[:, :-1])["loss"]

    def next_state_ranks(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the ranks of the true next states among all states of a batch.

        Clips of the same length in time are ranked: the candidates (B (T - h + 1) of them) are the
        states of all clips at all steps, among them the present one of each transition.

        Returns
        -------
        ranks : Tensor
            Of the predictions, (B (T - h)).
        copied : Tensor
            The same for the present state as the prediction.
        """
        states = self._states(batch)
        now = states[:, :-1]
        rows = torch.arange(states.shape[0] * states.shape[1], device=states.device)
        true = rows.view(states.shape[:2])[:, 1:].flatten()
        candidates = states.flatten(2).flatten(0, 1)
        predictions = (now + self._changes(now), now)
        ranks, copied = (
            rank_next_states(value.flatten(2).flatten(0, 1), true, candidates)
            for value in predictions
        )
        return ranks, copied

    def _contrast(self, states: Tensor, predicted: Tensor) -> dict[str, Tensor]:
        """Return the loss of predictions (B, T - 1, K, D) of states (B, T, K, D)."""
        config = self.config
        now = states[:, :-1]
        apart = energy(predicted, states[:, 1:], config.sigma).mean()
        if config.negatives == "permuted":
            flat = now.flatten(0, 1)
            order = torch.randperm(len(flat)).to(flat.device)
            far = hinge_loss(flat, flat[order], config.sigma, config.hinge)
        else:
            steps = states_of_other_steps(states)[:, :-1]
            clips = states_of_other_clips(now)
            far = hinge_loss(now, steps, config.sigma, config.hinge)
            if len(clips):
                far = (far + hinge_loss(now, clips, config.sigma, config.hinge)) / 2
        return {"loss": apart + far, "next": apart, "negatives": far}

    def _changes(self, states: Tensor) -> Tensor:
        """Return the predicted changes of states (B, T, K, D)."""
        out: Tensor = self.transition(states.flatten(0, 1))
        return out.view(states.shape)

    def _states(self, batch: Batch) -> Tensor:
        """Return the states (B, T - h + 1, K, D) of a batch."""
        maps = self.maps(batch)
        out: Tensor = self.encoder(maps.flatten(0, 1))
        return out.view(*maps.shape[:2], *out.shape[1:])

    def _stacked(self, batch: Batch) -> Tensor:
        """Return runs of h pictures as (B, T - h + 1, 3 h, H, W), the oldest first."""
        pictures = normalized_pictures(batch, self.spec, self.name)
        history = self.config.history
        if pictures.shape[1] < history:
            raise BadInputError(
                f"{self.name}: a state needs {history} pictures, and a clip has only "
                f"{pictures.shape[1]}"
            )
        runs = pictures.unfold(1, history, 1)  # (B, runs, 3, H, W, h)
        return runs.permute(0, 1, 5, 2, 3, 4).flatten(2, 3)
