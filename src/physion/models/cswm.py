"""C-SWM: contrastively trained structured world model.

Tensors (B clips, T pictures, h = ``settings.stacked``, S = T - h + 1 states, K slots of D values):

- pictures (B, T, 3, H, W). Each run of h successive ones is stacked to 3 h channels.
- states (B, S, K, D), at the last picture of each run.
- features (B, T, K D): slots of the states, one after the other. As in the published code, the
  first state stands for the h - 1 frames before it too.
- next state z' = z + T(z), or z + T(z, z - z_before) with a ``memory`` of 2
  (`SlotTransition`): motion is known from several pictures in one state, or from two
  states.

Source: docs/official-system.md, section 5, and Kipf et al. 2020.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from physion.clips.batch import Batch, Provenance, Rollout, Spec
from physion.core.errors import BadInputError
from physion.models.checkpoint import load_named
from physion.models.interface import Sizes, TrainingSettings
from physion.models.torch_model import initial_weights
from physion.models.vision import (
    RELEASED_CLIPS,
    VisionModel,
    VisionSettings,
    normalized_pictures,
)

NAME, VERSION = "cswm", 1

_PAPER: Mapping[str, Any] = {
    "image_size": 224, "slots": 10, "slot_size": 128, "hidden": 512, "channels": 32,
    "kernels": (9, 5), "strides": (1, 5),
}  # fmt: skip
_RELEASED: Mapping[str, Any] = {
    **_PAPER, **RELEASED_CLIPS,
    "stacked": 7, "memory": 1, "transitions": 1, "negatives": "permuted",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CswmSettings(VisionSettings):
    """Settings of C-SWM; also see `SizedSettings`.

    - ``image_size``: pixels per side. ``stacked``: successive pictures that make one state.
    - ``memory``: states from which the next one is predicted: 1, or 2, the present one and its
      change.
    - ``slots``: number of slots K, with ``slot_size`` values each. ``hidden``: units of the hidden
      layers.
    - ``channels``: of the first convolution. ``kernels``: sizes of the two convolutions, and
      ``strides``. The first one is padded, the second is not.
    - ``sigma``: unit of distances in the energy. ``hinge``: energy from which a negative is far
      enough.
    - ``transitions``: pairs of successive states in a training clip.
    - ``negatives``: ``all`` other states of the batch (`all_pairs_loss`); or ``permuted``, as
      published: one state each, in a random order that may leave it in its place. Clips differ in
      their objects, so that without other steps the slots need not follow any motion.
    """

    model: str = NAME
    stacked: int = 1
    memory: Literal[1, 2] = 2
    slots: int = 6
    slot_size: int = 32
    hidden: int = 128
    channels: int = 16
    kernels: tuple[int, int] = (5, 2)
    strides: tuple[int, int] = (2, 2)
    sigma: float = 0.5
    hinge: float = 1.0
    transitions: int = 3
    negatives: Literal["all", "permuted"] = "all"

    sizes: ClassVar[Sizes] = {"small": {}, "paper": _PAPER, "released": _RELEASED}

    def __post_init__(self) -> None:
        self.at_least(
            1, "image_size", "stacked", "slots", "slot_size", "hidden", "channels", "transitions"
        )


_SMALL_TRAINING = TrainingSettings(
    steps=6000,
    batch=32,
    learning_rate=1e-3,
    schedule="cosine",
    warmup=50,
    validate_every=250,
    log_every=25,
    checkpoint_every=250,
)
_PAPER_TRAINING = replace(_SMALL_TRAINING, steps=100_000, learning_rate=5e-4, warmup=1000)
TRAINING: Mapping[str, TrainingSettings] = {
    "small": _SMALL_TRAINING,
    "paper": _PAPER_TRAINING,
    # The published code makes a new Adam at every step, which equals betas of 0.
    "released": replace(_PAPER_TRAINING, schedule="constant", warmup=0, betas=(0.0, 0.0)),
}


# Networks of C-SWM: extraction and encoding of slots, and their transition.
#
# - `SlotExtractor`: pictures (N, C, H, W) to K maps (N, K, h, w) in 0..1.
# - `SlotEncoder`: each map on its own to a slot z_k (N, K, D), with common weights.
# - `SlotTransition`: slots to their changes, a graph network in which every slot receives from
#   every other. With what is known of a slot, x_k = z_k, or z_k and its last change,
#
#     m_k = sum_{l != k} f(x_k, x_l),    dz_k = g(x_k, m_k)
#
# References
# ----------
# T. Kipf, E. van der Pol and M. Welling, Contrastive learning of structured world models, ICLR
# 2020, section 3 and appendix B.


class SlotExtractor(nn.Module):
    """Two convolutions, the second with one output channel a slot.

    Parameters
    ----------
    inputs
        Channels of the pictures.
    channels
        Of the first convolution.
    slots
        Number of slots K.
    kernels, strides
        Of the two convolutions.
    """

    def __init__(
        self,
        inputs: int,
        channels: int,
        slots: int,
        kernels: tuple[int, int],
        strides: tuple[int, int],
    ) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, channels, kernels[0], strides[0], padding=kernels[0] // 2)
        self.norm = nn.BatchNorm2d(channels)
        self.second = nn.Conv2d(channels, slots, kernels[1], strides[1])

    def forward(self, pictures: Tensor) -> Tensor:
        """Return the maps (N, K, h, w) of pictures (N, C, H, W)."""
        hidden = functional.leaky_relu(self.norm(self.first(pictures)))
        return torch.sigmoid(self.second(hidden))

    def map_size(self, image_size: int) -> int:
        """Return the pixels per side of the maps of pictures with ``image_size`` pixels."""
        size = image_size
        for layer in (self.first, self.second):
            padding = 2 * int(layer.padding[0])
            size = (size + padding - layer.kernel_size[0]) // layer.stride[0] + 1
        return size


def hidden_layers(inputs: int, hidden: int) -> nn.Sequential:
    """Return two hidden layers of an MLP, the second with layer normalisation."""
    return nn.Sequential(
        nn.Linear(inputs, hidden),
        nn.ReLU(),
        nn.Linear(hidden, hidden),
        nn.LayerNorm(hidden),
        nn.ReLU(),
    )


class SlotEncoder(nn.Module):
    """MLP from the pixels of a map to a slot."""

    def __init__(self, pixels: int, hidden: int, slot_size: int) -> None:
        super().__init__()
        self.hidden = hidden_layers(pixels, hidden)
        self.slot = nn.Linear(hidden, slot_size)

    def forward(self, maps: Tensor) -> Tensor:
        """Return slots (N, K, D) of maps (N, K, h, w)."""
        out: Tensor = self.slot(self.hidden(maps.flatten(2)))
        return out


class SlotTransition(nn.Module):
    """Graph network on the complete graph of the slots; it does not depend on their order.

    Parameters
    ----------
    inputs, outputs
        Number of values that are known of a slot, and of its change.
    hidden
        Units of the hidden layers.
    """

    def __init__(self, inputs: int, outputs: int, hidden: int) -> None:
        super().__init__()
        self.edge = hidden_layers(2 * inputs, hidden)
        self.message = nn.Linear(hidden, hidden)
        self.node = hidden_layers(inputs + hidden, hidden)
        self.change = nn.Linear(hidden, outputs)

    def forward(self, slots: Tensor) -> Tensor:
        """Return the changes (N, K, outputs) of slots (N, K, inputs)."""
        count = slots.shape[1]
        receivers, senders = (~torch.eye(count, dtype=torch.bool)).nonzero().T.to(slots.device)
        pairs = torch.cat([slots[:, receivers], slots[:, senders]], -1)
        # Receivers are in order, K - 1 pairs each.
        messages = self.message(self.edge(pairs)).view(len(slots), count, count - 1, -1).sum(2)
        out: Tensor = self.change(self.node(torch.cat([slots, messages], -1)))
        return out


# Contrastive loss of C-SWM, and the rank of the true next state.
#
# With slots z (K of them) the distance of two states is the energy
#
#     H(a, b) = 1 / (2 sigma^2) * mean_k |a_k - b_k|^2,
#
# and the loss of a transition from z to z', with a negative state n, is
#
#     L = H(z + T(z), z') + max(0, hinge - H(z, n)).
#
# In place of one negative for each state, `all_pairs_loss` takes all pairs of states of a batch.
#
# References
# ----------
# Kipf et al. 2020, equations 2 and 3; metrics in section 4.3. As in their code, the negative is
# compared with the present state, while equation 3 compares it with the next one.


def energy(one: Tensor, other: Tensor, sigma: float) -> Tensor:
    """Return the energy (...) of pairs of states (..., K, D)."""
    return (one - other).pow(2).sum(-1).mean(-1) / (2 * sigma**2)


def hinge_loss(states: Tensor, negatives: Tensor, sigma: float, hinge: float) -> Tensor:
    """Return the mean hinge loss of pairs of states (..., K, D) that should be far apart."""
    return (hinge - energy(states, negatives, sigma)).clamp(min=0).mean()


def all_pairs_loss(states: Tensor, sigma: float, hinge: float) -> Tensor:
    """Return the hinge loss of all pairs of different states of clips (B, T, K, D).

    It is the sum of two means, one over pairs from different clips and one over pairs of different
    steps of the same clip. Each has the weight of the first term of a transition's loss: with less,
    slots that never change can cost least.
    """
    clips, steps, slots = states.shape[:3]
    flat = states.flatten(2).flatten(0, 1)
    squares = flat.pow(2).sum(1)
    apart = (squares[:, None] + squares - 2 * flat @ flat.T).clamp(min=0)
    losses = (hinge - apart / (2 * sigma**2 * slots)).clamp(min=0)
    clip = torch.arange(clips, device=flat.device).repeat_interleave(steps)
    same = clip[:, None] == clip
    itself = torch.eye(len(flat), dtype=torch.bool, device=flat.device)
    kinds = [losses[pairs] for pairs in (~same, same & ~itself)]
    return torch.stack([kind.mean() for kind in kinds if len(kind)]).sum()


@dataclass(frozen=True)
class Ranking:
    """How often the true next state is the nearest one, and the mean reciprocal rank."""

    hits: float
    reciprocal: float


def rank_next_states(predicted: Tensor, true: Tensor, candidates: Tensor) -> Tensor:
    """Return the rank of each true next state among the candidates, by distance.

    Parameters
    ----------
    predicted : Tensor
        Predicted states (N, D).
    true : Tensor
        Row of the true next state of each prediction in ``candidates`` (N), integers.
    candidates : Tensor
        States (M, D), among them the true ones.

    Returns
    -------
    ranks : Tensor
        (N), from 1, the nearest, to M. Of equally distant states each counts as half a rank before
        the true one, so that equal states are not ranked by chance.
    """
    # Differences, not products: squared distances that are much smaller than the states stay exact.
    apart = torch.stack([(candidates - row).pow(2).sum(-1) for row in predicted])
    own = apart.gather(1, true[:, None])
    nearer, equal = (apart < own).sum(1), (apart == own).sum(1) - 1
    return 1 + nearer + equal / 2


def ranking(ranks: Tensor) -> Ranking:
    """Return hits at rank 1 and the mean reciprocal rank of ranks (N)."""
    values = ranks.double()
    return Ranking(float((values == 1).double().mean()), float((1 / values).mean()))


# The model: loss, and imagination.


class Cswm(VisionModel):
    """C-SWM: divides pictures into slots and predicts their next state; trained by contrast."""

    settings: CswmSettings

    def __init__(self, settings: CswmSettings) -> None:
        spec = Spec(
            image_size=settings.image_size,
            mean=(0.0, 0.0, 0.0),
            std=(1.0, 1.0, 1.0),
            stride=settings.stride,
            context=settings.context,
            future=settings.future,
            context_at=settings.context_at,
            framewise=settings.stacked == 1,
        )
        super().__init__(VERSION, settings, TRAINING[settings.size], spec)
        self.window = settings.stacked + settings.memory - 1 + settings.transitions
        with initial_weights("cswm", settings.seed):
            self.extractor = SlotExtractor(
                3 * settings.stacked,
                settings.channels,
                settings.slots,
                settings.kernels,
                settings.strides,
            )
            pixels = self.extractor.map_size(settings.image_size) ** 2
            self.encoder = SlotEncoder(pixels, settings.hidden, settings.slot_size)
            self.transition = SlotTransition(
                settings.memory * settings.slot_size, settings.slot_size, settings.hidden
            )
        if settings.memory == 2:
            # An untrained network predicts that nothing changes.
            nn.init.zeros_(self.transition.change.weight)
            nn.init.zeros_(self.transition.change.bias)
        load_named(self, settings.weights)

    def provenance(self) -> Provenance:
        """Return name, size and origin of the weights."""
        return self.origin("convolutional slots", "graph network", "contrastive")

    def encode(self, batch: Batch) -> Tensor:
        """Return the features (B, T, K D) of the pictures of a batch."""
        states = self._states(batch).flatten(2)
        before = states[:, :1].expand(-1, self.settings.stacked - 1, -1)
        return torch.cat([before, states], 1)

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: Any) -> Rollout:
        """Roll the transition out from the end of the context.

        It is deterministic: all samples are equal, and ``seed`` has no effect. With the argument
        ``show`` above 0, ``shown`` holds the imagined states under ``slots`` (B, S, future, K, D),
        and under ``context_masks`` the maps (B, T, K, h, w) of the context.
        """
        features = self.encode(context) if context.features is None else context.features
        states = features[:, -self.settings.memory :]
        states = states.view(*states.shape[:2], self.settings.slots, -1)
        imagined = []
        for _ in range(context.future):
            states = torch.cat([states[:, 1:], self._predicted(states)], 1)
            imagined.append(states[:, -1].flatten(1))
        future = torch.stack(imagined, 1)[:, None].expand(-1, samples, -1, -1)
        if arguments.get("show", 0) <= 0:
            return Rollout(features=future)
        maps = self.maps(context)
        before = maps[:, :1].expand(-1, self.settings.stacked - 1, -1, -1, -1)
        slots = future.reshape(*future.shape[:3], self.settings.slots, -1)
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
        return self._contrast(states, states[:, self.settings.memory - 1 : -1])["loss"]

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
        states, memory = self._states(batch), self.settings.memory
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
        settings = self.settings
        apart = energy(predicted, states[:, settings.memory :], settings.sigma).mean()
        if settings.negatives == "permuted":
            flat = states[:, settings.memory - 1 : -1].flatten(0, 1)
            order = torch.randperm(len(flat)).to(flat.device)
            far = hinge_loss(flat, flat[order], settings.sigma, settings.hinge)
        else:
            far = all_pairs_loss(states, settings.sigma, settings.hinge)
        return {"loss": apart + far, "next": apart, "negatives": far}

    def _predicted(self, states: Tensor) -> Tensor:
        """Return the states (B, S - memory + 1, K, D) that follow each of ``states`` (B, S, K, D).

        With a memory of 2, the first state has no prediction.
        """
        known = now = states[:, self.settings.memory - 1 :]
        if self.settings.memory == 2:
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
        stacked = self.settings.stacked
        if pictures.shape[1] < stacked:
            raise BadInputError(
                f"{self.name}: a state needs {stacked} pictures, and a clip has only "
                f"{pictures.shape[1]}"
            )
        runs = pictures.unfold(1, stacked, 1)  # (B, S, 3, H, W, h)
        return runs.permute(0, 1, 5, 2, 3, 4).flatten(2, 3)
