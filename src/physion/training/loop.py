"""Training loop: seeded, resumable with identical results on a CPU, stopped by a bad loss.

The losses of the steps stay on the device and are read every ``log_every`` steps, so that the
device does not wait for the processor at every step.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any

import torch
from lightning_fabric import Fabric
from torch import Tensor

from physion.errors import BadInputError, PhysionError
from physion.models.batch import Batch
from physion.models.checkpoints.checkpoint import load_tensors, tensors_of
from physion.models.interface import HasBaseline
from physion.models.settings import TrainingSettings
from physion.seeds import stable_hash
from physion.training.folder import CheckpointContent, TrainingFolder
from physion.training.losses import (
    LOSS,
    Given,
    Learner,
    call,
    evaluating,
    losses_of,
    mean_over,
    ordered,
)
from physion.training.metrics_log import MetricsLog
from physion.training.schedule import learning_rate
from physion.training.sources.background import background
from physion.training.state import TrainingState
from physion.training.windows import Request, Windows, step_request, validation_requests

_AHEAD = 8
"""Largest number of batches that are read ahead."""
_OPTIMIZERS = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}


class TrainingStoppedError(PhysionError):
    """Error for a loss or weight that became NaN or infinite; the last checkpoint is kept."""


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Windows of the training trials, and of the trials held out for validation."""

    training: Windows
    held_out: Windows | None


class TrainingLoop:
    """Training of one model.

    Parameters
    ----------
    model
        `Learns` and a torch ``Module``, already on its device.
    data
        Windows for training and validation.
    settings
        Optimiser and schedule.
    seed
        Of the batches and of random operations in the model.
    fabric
        Devices.
    folder
        Where checkpoints and metrics are kept; None keeps nothing.
    describe
        Returns the metadata of a checkpoint, to which the state is added.
    progress
        Called after every step.
    """

    def __init__(
        self,
        model: Any,
        data: TrainingData,
        settings: TrainingSettings,
        seed: int,
        fabric: Fabric,
        *,
        folder: TrainingFolder | None,
        describe: Mapping[str, Any],
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self._model, self._data, self._settings, self._seed = model, data, settings, seed
        self._fabric, self._describe, self._progress = fabric, describe, progress
        # Only the first process writes.
        self._folder = folder if fabric.global_rank == 0 else None
        self._kept = folder is not None
        self.state = TrainingState()
        self._unread: list[Tensor] = []
        self._unread_trials: list[tuple[str, ...]] = []
        self._names: tuple[str, ...] = ()
        self._parts = settings.accumulate * fabric.world_size
        trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
        _check(settings, data, fabric.world_size, trained)
        self._optimizer = _OPTIMIZERS[settings.optimizer](
            trained,
            lr=settings.learning_rate,
            betas=settings.betas,
            weight_decay=settings.weight_decay,
        )
        self._learner, self._wrapped = fabric.setup(Learner(model), self._optimizer)

    def resume(self, stored: CheckpointContent) -> None:
        """Load a checkpoint."""
        # After the set-up, so that the optimiser's state is on the device of the weights.
        load_tensors(stored.path, stored.tensors, self._model, self._optimizer)
        self.state = TrainingState.of(stored.metadata["state"])
        self._fabric.strategy.precision.load_state_dict(stored.metadata["precision"])

    def run(self) -> None:
        """Train until the last step.

        Raises
        ------
        TrainingStoppedError
            If a loss or weight is not finite; the message names the steps, and the trials of that
            loss.
        BadInputError
            If the model gives no usable loss.
        """
        settings, state = self._settings, self.state
        self._model.train()
        with ExitStack() as stack:
            log = None
            if self._folder is not None:
                log = stack.enter_context(MetricsLog(self._folder.path, state.step))
            requests = self._requests(state.step)
            ahead = min(max(2, os.cpu_count() or 1), _AHEAD)
            batches: Any = background(requests, self._data.training.read, ahead=ahead)
            stack.enter_context(closing(batches))
            for step in range(state.step, settings.steps):
                self._step(step, batches)
                state.step = step + 1
                self._after_step(log)
                if self._progress is not None:
                    self._progress(state.step, settings.steps)
        self._model.eval()

    def metadata(self) -> dict[str, Any]:
        """Return the metadata of a checkpoint of the present state."""
        return {
            **self._describe,
            "step": self.state.step,
            "state": self.state.to_json(),
            "precision": self._fabric.strategy.precision.state_dict(),
        }

    def _requests(self, first: int) -> Iterator[Request]:
        """Yield what this process reads from step ``first`` on."""
        settings, fabric = self._settings, self._fabric
        size = settings.batch * settings.accumulate
        for step in range(first, settings.steps):
            request = step_request(self._data.training, size, self._seed, step)
            for index in range(settings.accumulate):
                yield request.part(index * fabric.world_size + fabric.global_rank, self._parts)

    def _step(self, step: int, batches: Iterator[Batch]) -> None:
        """Do one step of the optimiser."""
        settings, fabric = self._settings, self._fabric
        rate = learning_rate(settings, step, self.state.plateau.factor)
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        self._optimizer.zero_grad(set_to_none=True)
        values: list[Tensor] = []
        trials: list[str] = []
        for index in range(settings.accumulate):
            batch = next(batches).to(fabric.device)
            trials += batch.trials
            last = index + 1 == settings.accumulate
            part = index * fabric.world_size + fabric.global_rank
            # Seeded by the step, so that no state of a generator has to be stored.
            with (
                torch.random.fork_rng(devices=[]),
                fabric.no_backward_sync(self._learner, enabled=not last),
            ):
                torch.manual_seed(stable_hash("step", self._seed, step, part) % 2**63)
                losses = self._learner(Given(batch))
                fabric.backward(losses[LOSS] / settings.accumulate)
            values.append(self._stack(losses))
        if settings.clip > 0:
            fabric.clip_gradients(
                self._learner, self._wrapped, max_norm=settings.clip, error_if_nonfinite=False
            )
        self._wrapped.step()
        self._unread.append(torch.stack(values).mean(0))
        self._unread_trials.append(tuple(dict.fromkeys(trials)))

    def _after_step(self, log: MetricsLog | None) -> None:
        """Read losses, validate and write a checkpoint where it is time."""
        settings, state = self._settings, self.state
        last = state.step == settings.steps
        logs = last or state.step % settings.log_every == 0
        held_out = self._data.held_out is not None
        validates = held_out and (last or state.step % settings.validate_every == 0)
        saves = self._kept and (last or state.step % settings.checkpoint_every == 0)
        if logs or validates or saves:
            self._read_losses()
        if logs:
            means = {f"train/{k}": v for k, v in _means(state.recent).items()}
            state.loss, state.recent = means[f"train/{LOSS}"], []
            rate = learning_rate(settings, state.step - 1, state.plateau.factor)
            if log is not None:
                log.write(state.step, {**means, "learning_rate": rate})
        if validates:
            self._validate(log, last)
        if saves:
            self._check_weights()
            if log is not None and self._folder is not None and not last:
                log.sync()
                self._folder.save(tensors_of(self._model, self._optimizer), self.metadata())
            elif log is not None:
                log.sync()

    def _read_losses(self) -> None:
        """Move the losses of the last steps from the device, and stop at one that is not finite."""
        if not self._unread:
            return
        reduced = self._fabric.all_reduce(torch.stack(self._unread), reduce_op="mean")
        assert isinstance(reduced, Tensor)
        rows, trials = reduced.double().cpu().tolist(), self._unread_trials
        self._unread, self._unread_trials = [], []
        first = self.state.step - len(rows) + 1
        for index, row in enumerate(rows):
            if not math.isfinite(row[0]):
                found = f"the loss of step {first + index} is {row[0]}"
                raise self._stopped(f"{found} (trials {', '.join(trials[index])})", first)
        self.state.recent += [dict(zip(self._names, row, strict=True)) for row in rows]

    def _check_weights(self) -> None:
        """Stop if a weight is not finite: a step can spoil it though its loss was finite."""
        weights = dict(self._model.named_parameters())
        finite = torch.stack([value.isfinite().all() for value in weights.values()])
        if not bool(finite.all()):
            name = next(name for name, good in zip(weights, finite, strict=True) if not good)
            raise self._stopped(f"{name} is not finite", self.state.step)

    def _stopped(self, reason: str, first: int) -> TrainingStoppedError:
        last = self.state.step
        steps = f"step {last}" if first >= last else f"steps {first} to {last}"
        return TrainingStoppedError(
            f"training stopped after {steps}: {reason}; the checkpoint before stays. Lower the "
            "learning rate, clip the gradients, or check the trials"
        )

    def _validate(self, log: MetricsLog | None, last: bool) -> None:
        """Compute the loss of held-out trials; after the last step also that of the baseline."""
        model, state, windows = self._model, self.state, self._data.held_out
        assert windows is not None
        requests = validation_requests(windows, self._settings.batch, self._seed)
        shared = (windows, requests, self._fabric, self._seed)
        with evaluating(model, self._fabric):
            values = mean_over(lambda batch: losses_of(model, batch), *shared)
            if last and isinstance(model, HasBaseline):
                trivial = mean_over(lambda batch: {LOSS: call(model, "baseline", batch)}, *shared)
                state.baseline = trivial[LOSS]
        state.validation = values[LOSS]
        if not math.isfinite(state.validation):
            raise self._stopped("the loss of the held-out trials is not finite", state.step)
        if self._settings.schedule == "plateau":
            state.plateau.update(state.validation, self._settings)
        if log is not None:
            log.write(state.step, {f"validation/{name}": v for name, v in values.items()})

    def _stack(self, losses: Mapping[str, Tensor]) -> Tensor:
        names = ordered(losses)
        if self._names and names != self._names:
            raise BadInputError(
                f"the model's loss has the parts {list(names)}, before {list(self._names)}; they "
                "must be the same at every step"
            )
        self._names = names
        return torch.stack([losses[name].detach().float() for name in names])


def _check(
    settings: TrainingSettings, data: TrainingData, processes: int, trained: Sequence[Tensor]
) -> None:
    if not trained:
        raise BadInputError("the model has no weight that can be trained")
    if settings.batch % processes != 0:
        raise BadInputError(
            f"training: batch {settings.batch} cannot be divided among {processes} devices; "
            f"choose a multiple of {processes}"
        )
    if settings.schedule == "plateau" and data.held_out is None:
        raise BadInputError("training: the schedule plateau needs held_out above 0")


def _means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    names = sorted(rows[0], key=lambda name: (name != LOSS, name))
    return {name: math.fsum(row[name] for row in rows) / len(rows) for name in names}
