"""Training loop: seeded, resumable with identical results on a CPU, stopped by a bad loss.

The losses of the steps stay on the device and are read every ``log_every`` steps, so that the
device does not wait for the processor at every step.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from physion.clips.batch import Batch
from physion.clips.movies import background
from physion.core.errors import BadInputError, PhysionError
from physion.core.files import has_digest, write_atomic
from physion.core.seeds import stable_hash
from physion.models.build import describe_raised, is_out_of_memory
from physion.models.checkpoint import (
    WEIGHTS,
    DamagedFileError,
    check_same,
    load_tensors,
    read_checkpoint,
    tensors_of,
    versions,
    write_checkpoint,
)
from physion.models.interface import TrainingSettings, ask, can
from physion.training.windows import Request, Windows, step_request, validation_requests

# Losses of a model: checked, wrapped for Fabric, and averaged over held-out clips.

LOSS = "loss"


class Given:
    """Batch on its way through Fabric, which would take a frozen dataclass apart."""

    __slots__ = ("batch",)

    def __init__(self, batch: Batch) -> None:
        self.batch = batch


class Learner(nn.Module):
    """Module whose ``forward`` is the loss of a model, for Fabric to wrap."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, given: Given) -> dict[str, Tensor]:
        """Return the loss and its parts; only the loss has a gradient."""
        losses = losses_of(self.model, given.batch)
        return {name: v if name == LOSS else v.detach() for name, v in losses.items()}


@contextmanager
def evaluating(model: nn.Module, fabric: Fabric) -> Iterator[None]:
    """Set a model to evaluation mode without gradients; random numbers drawn inside are local."""
    model.eval()
    try:
        with torch.no_grad(), fabric.autocast(), torch.random.fork_rng(devices=[]):
            yield
    finally:
        model.train()


def call(model: Any, method: str, batch: Batch) -> Any:
    """Return what a method of a model returns; what it raises names model, method and line."""
    try:
        return ask(model, method)(batch)
    except PhysionError:
        raise
    except Exception as error:
        if is_out_of_memory(error):
            raise
        raise describe_raised(error, model.provenance().model, method) from error


def losses_of(model: Any, batch: Batch) -> dict[str, Tensor]:
    """Return loss and parts of a batch; raise `BadInputError` if they are not scalars."""
    name = model.provenance().model
    losses = call(model, "loss", batch)
    if not isinstance(losses, Mapping) or LOSS not in losses:
        raise BadInputError(f"model {name!r}: loss must give a mapping with {LOSS!r}")
    for part, value in losses.items():
        if not isinstance(value, Tensor) or value.ndim != 0:
            found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise BadInputError(f"model {name!r}: loss gave {part} as {found}, expected a scalar")
    if torch.is_grad_enabled() and not losses[LOSS].requires_grad:
        raise BadInputError(f"model {name!r}: loss gave a loss that depends on no weight")
    return dict(losses)


def mean_over(
    function: Callable[[Batch], Mapping[str, Tensor]],
    windows: Windows,
    requests: list[Request],
    fabric: Fabric,
    seed: int,
) -> dict[str, float]:
    """Return the means, weighted by clips, of what ``function`` gives for ``requests``.

    The batches are divided among the processes. Random operations are seeded by ``seed`` and the
    number of the batch.
    """
    rank, processes = fabric.global_rank, fabric.world_size
    sums: Tensor | None = None
    names: tuple[str, ...] = ()
    # A process without a batch of its own computes the first one and gives it no weight.
    own = list(range(rank, len(requests), processes)) or [0]
    batches = background([requests[number] for number in own], windows.read)
    for number, batch in zip(own, batches, strict=True):
        weight = len(batch) if number % processes == rank else 0
        torch.manual_seed(stable_hash("validation", seed, number) % 2**63)
        values = function(batch.to(fabric.device))
        names = ordered(values)
        row = torch.stack([values[name].detach().float() for name in names])
        row = torch.cat([row * weight, row.new_tensor([weight])])
        sums = row if sums is None else sums + row
    reduced = fabric.all_reduce(sums, reduce_op="sum") if sums is not None else None
    assert isinstance(reduced, Tensor), "there is a batch"
    *totals, count = reduced.double().cpu().tolist()
    return {name: total / count for name, total in zip(names, totals, strict=True)}


def ordered(losses: Mapping[str, Tensor]) -> tuple[str, ...]:
    """Return the names of the losses: the loss itself first, then its parts by name."""
    return (LOSS, *sorted(name for name in losses if name != LOSS))


# Learning rate of a step: warm-up, then constant, cosine, or lowered when validation stalls.

_THRESHOLD = 1e-4
"""Relative decrease of the validation loss that counts as an improvement, as in torch."""


def learning_rate(settings: TrainingSettings, step: int, factor: float = 1.0) -> float:
    """Return the learning rate of a step.

    With base rate r, w steps of warm-up and n steps in all, step k (from 0) has

    - k < w: r (k + 1) / w,
    - k >= w, ``cosine``: r (1 + cos(pi (k - w) / (n - w))) / 2, which would be 0 at step n,
    - k >= w, otherwise: r.

    It is multiplied by ``factor`` of `Plateau`.
    """
    rate = settings.learning_rate * factor
    if step < settings.warmup:
        return rate * (step + 1) / settings.warmup
    if settings.schedule == "cosine":
        done = (step - settings.warmup) / max(settings.steps - settings.warmup, 1)
        return rate * (1 + math.cos(math.pi * done)) / 2
    return rate


@dataclass
class Plateau:
    """Factor of the learning rate that falls when the validation loss stops falling.

    The rule is torch's ``ReduceLROnPlateau``: after more than ``patience`` validations in
    a row that are not lower than the best one by a ten-thousandth, the rate is lowered.
    """

    factor: float = 1.0
    best: float | None = None
    waited: int = 0

    def update(self, loss: float, settings: TrainingSettings) -> None:
        """Take the loss of a validation into account."""
        if self.best is None or loss < self.best - abs(self.best) * _THRESHOLD:
            self.best, self.waited = loss, 0
            return
        self.waited += 1
        if self.waited > settings.plateau_patience:
            self.factor, self.waited = self.factor * settings.plateau_factor, 0


# How far a training is: what a checkpoint holds in addition to weights and optimiser.


@dataclass
class TrainingState:
    """How far a training is, as stored in its checkpoints.

    - ``step``: finished steps.
    - ``recent``: values of the steps since the last line of the metrics, by name.
    - ``loss``: mean loss of the last interval of ``log_every`` steps.
    - ``validation``, ``baseline``: of the last validation; NaN without one.
    """

    step: int = 0
    recent: list[dict[str, float]] = field(default_factory=list)
    plateau: Plateau = field(default_factory=Plateau)
    loss: float = math.nan
    validation: float = math.nan
    baseline: float = math.nan

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> TrainingState:
        """Return the state with the given fields, as `dataclasses.asdict` gives them."""
        return cls(**{**values, "plateau": Plateau(**values["plateau"])})


# Metrics of a training: ``metrics.jsonl``, to which lines are appended, and TensorBoard events.

METRICS, EVENTS = "metrics.jsonl", "events"


class MetricsLog:
    """Log of the metrics of a training, one JSON object per line, in the order of steps.

    It is opened at a step: later lines, of a training that was stopped after its checkpoint, are
    removed, so that a resumed training neither repeats nor loses a line. If the extra
    ``tensorboard`` is installed, event files in the folder ``events`` hold the same numbers.

    Parameters
    ----------
    folder
        Folder of the training, which exists.
    step
        Number of steps of the checkpoint from which training continues; 0 for a new training.
    """

    def __init__(self, folder: Path, step: int) -> None:
        path = folder / METRICS
        kept = _lines_until(path, step)
        text = "".join(line + "\n" for line in kept)
        if not path.is_file() or path.read_bytes() != text.encode():
            write_atomic(path, text.encode())
        # Kept open, and appended to: nothing that was written is written again.
        self._file = path.open("a", encoding="utf-8")
        self._events = _open_events(folder / EVENTS)
        for line in kept:
            self._add_events(json.loads(line))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Append the values after ``step`` steps; one that is not finite becomes null."""
        line: dict[str, Any] = {"step": step}
        line |= {name: value if math.isfinite(value) else None for name, value in values.items()}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()
        self._add_events(line)

    def sync(self) -> None:
        """Wait until all lines are on the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())
        if self._events is not None:
            self._events.flush()

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        if self._events is not None:
            self._events.close()

    def _add_events(self, line: Mapping[str, Any]) -> None:
        if self._events is not None:
            for name, value in line.items():
                if name != "step" and value is not None:
                    self._events.add_scalar(name, value, int(line["step"]))


def _lines_until(path: Path, step: int) -> list[str]:
    """Return the whole lines of a file up to ``step``; a cut or damaged line ends them."""
    kept: list[str] = []
    if not path.is_file():
        return kept
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            inside = int(json.loads(line)["step"]) <= step
        except (ValueError, KeyError, TypeError):
            break
        if not inside:
            break
        kept.append(line)
    return kept


def _open_events(folder: Path) -> Any:
    """Return a writer of new event files; None without the extra ``tensorboard``."""
    try:
        from tensorboardX import SummaryWriter
    except ModuleNotFoundError:
        return None
    # Written again from the metrics, since events of lines that were removed would stay.
    shutil.rmtree(folder, ignore_errors=True)
    return SummaryWriter(str(folder))


# Folder of one training: a checkpoint while it runs, weights and model card when it is done.

CHECKPOINT, CARD = "checkpoint.safetensors", "model_card.md"


@dataclass(frozen=True, eq=False)
class CheckpointContent:
    """Content of a checkpoint, or of the file of a trained model."""

    path: Path
    tensors: Mapping[str, Tensor]
    metadata: Mapping[str, Any]


class TrainingFolder:
    """Files of one training, in the folder ``path``, whose name holds a hash of all inputs.

    When the training is done, the weights are written without the state of the optimiser, and the
    checkpoint is deleted. A damaged file is deleted, and ``notes`` says so.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []

    def finished(self) -> CheckpointContent | None:
        """Return the trained model, if there is one.

        Weights without a digest file come from a process that was killed before it had written
        all; its checkpoint is still there.
        """
        return self._read(WEIGHTS) if has_digest(self.path / WEIGHTS) else None

    def resumable(self) -> CheckpointContent | None:
        """Return the checkpoint, if there is one.

        Raises `BadInputError` if it was written by other versions of the libraries, with which the
        results would be a mixture.
        """
        found = self._read(CHECKPOINT)
        if found is not None:
            check_same(found.path, "version", found.metadata["versions"], versions())
        return found

    def finish(self, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any], card: str) -> None:
        """Write the trained model and its card, and delete the checkpoint."""
        write_atomic(self.path / CARD, card.encode())
        write_checkpoint(self.path / WEIGHTS, tensors, metadata, kept=True)
        (self.path / CHECKPOINT).unlink(missing_ok=True)

    def _read(self, name: str) -> CheckpointContent | None:
        path = self.path / name
        if not path.is_file():
            return None
        try:
            return CheckpointContent(path, *read_checkpoint(path))
        except DamagedFileError as error:
            path.unlink(missing_ok=True)
            self.notes.append(f"{error}; it is deleted, and training starts from the beginning")
            return None


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
        A torch ``Module`` with a loss, already on its device.
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
        Metadata of a checkpoint, to which the state is added.
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
                log = stack.enter_context(closing(MetricsLog(self._folder.path, state.step)))
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
            "state": asdict(self.state),
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
            if log is not None:
                log.sync()
            if self._folder is not None and not last:
                tensors = tensors_of(self._model, self._optimizer)
                write_checkpoint(self._folder.path / CHECKPOINT, tensors, self.metadata())

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
        """Compute the loss of held-out trials; after the last step also the baseline's loss."""
        model, state, windows = self._model, self.state, self._data.held_out
        assert windows is not None
        requests = validation_requests(windows, self._settings.batch, self._seed)
        shared = (windows, requests, self._fabric, self._seed)
        with evaluating(model, self._fabric):
            values = mean_over(lambda batch: losses_of(model, batch), *shared)
            if last and can(model, "baseline"):
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
