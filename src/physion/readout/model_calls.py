"""Calls of the methods of a model, whose code may be a user's.

A torch ``Module`` is called on its device, in evaluation mode and without gradients; any other
model receives numpy arrays. What a model raises becomes an error that names model and method. This
module does not import torch: where torch was not imported, no model is a ``Module``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import Batch, Provenance, Rollout
from physion.core.errors import BadInputError, PhysionError
from physion.models.build import OutOfMemoryError, describe_raised, is_out_of_memory
from physion.models.interface import Model, can

MEMORY_ADVICE = "use a smaller image_size or size of the model, or fewer samples"
"""What to do if memory is used up by a single clip."""


def call_model(model: Model, method: str, batch: Batch, /, *arguments: Any, **options: Any) -> Any:
    """Return what ``model.method(batch, ...)`` returns.

    Parameters
    ----------
    model
        A torch ``Module`` receives tensors on its device and is in evaluation mode meanwhile.
    method
        Name of a method whose first argument is a batch.
    batch
        Clips, numpy arrays.
    *arguments, **options
        Further arguments.

    Raises
    ------
    OutOfMemoryError
        If memory is used up; the message names the setting to lower.
    BadInputError
        If the model lacks the method or raises an exception. A `PhysionError` is passed on.
    """
    if not can(model, method):
        raise BadInputError(f"model {model_name(model)!r} has no method {method}")
    function = getattr(model, method)
    try:
        if not is_network(model):
            return function(batch, *arguments, **options)
        with _evaluating(model):
            return function(batch.to(_device(model)), *arguments, **options)
    except PhysionError:
        raise
    except Exception as error:
        raise _explain(error, model, method, batch) from error


def encoded(model: Model, batch: Batch) -> NDArray[np.float32]:
    """Return the features (B, T', D) that a model gives for clips; of every frame if framewise."""
    features = call_model(model, "encode", batch)
    clips, steps = batch.frames.shape[:2]
    shape = (clips, steps if model.spec.framewise else None, None)
    return to_array(features, model, "encode gave features", shape, ("float32",))


def imagined(model: Model, batch: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
    """Return what a model imagines after clips; `BadInputError` unless it is a `Rollout`."""
    rollout = call_model(model, "imagine", batch, samples, seed, **arguments)
    if not isinstance(rollout, Rollout):
        raise BadInputError(
            f"model {model_name(model)!r}: imagine gave {type(rollout).__name__}, expected Rollout"
        )
    return rollout


def use_device(model: Model, accelerator: str = "auto") -> None:
    """Move a network to the device of Lightning's name; another model has none."""
    if is_network(model):
        from physion.training.devices import Devices, make_fabric, move_to_device

        move_to_device(make_fabric(Devices(accelerator)), model)


def notes_of(model: Model, batch: Batch) -> list[str]:
    """Return what the model says about its prediction for each clip; "" for nothing."""
    if not can(model, "notes"):
        return [""] * len(batch)
    notes = [str(note) for note in call_model(model, "notes", batch)]
    if len(notes) != len(batch):
        raise BadInputError(
            f"model {model_name(model)!r}: notes gave {len(notes)} texts for {len(batch)} clips"
        )
    return notes


def check_identity(model: Model) -> Provenance:
    """Return the provenance of a model, after it and the digest were found to be well formed.

    Raises `BadInputError` if one of the methods raises or returns something else.
    """
    name = type(model).__name__
    for method, kind in (("digest", str), ("provenance", Provenance)):
        try:
            value: Any = getattr(model, method)()
        except PhysionError:
            raise
        except Exception as error:
            raise describe_raised(error, name, method) from error
        if not isinstance(value, kind) or not value:
            raise BadInputError(
                f"model {name!r}: {method} gave {value!r}, expected a {kind.__name__}"
            )
    provenance: Provenance = value
    return provenance


def is_network(model: object) -> bool:
    """Return whether a model is a torch ``Module``."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(model, torch.nn.Module)


def to_array(
    value: Any, model: Model, what: str, shape: tuple[int | None, ...], dtypes: tuple[str, ...]
) -> NDArray[Any]:
    """Return what a model gave as a numpy array, after its shape and data type were checked.

    Parameters
    ----------
    value
        numpy array or tensor.
    model
        Model, for the message.
    what
        What the value is, for the message, such as ``encode gave features``.
    shape
        Expected shape; None stands for any size of at least 1.
    dtypes
        Data types that are accepted; the message names the first.

    Raises
    ------
    BadInputError
        If the value is not an array, or has another shape or data type; the message says what was
        expected and what was given.
    """
    actual = getattr(value, "shape", None)
    kind = str(getattr(value, "dtype", type(value).__name__)).removeprefix("torch.")
    fits = (
        actual is not None
        and len(actual) == len(shape)
        and all(b == a or (a is None and b > 0) for a, b in zip(shape, actual, strict=True))
    )
    if not fits or kind not in dtypes:
        got = kind if actual is None else f"{kind} {tuple(actual)}"
        sizes = ", ".join("any" if size is None else str(size) for size in shape)
        raise BadInputError(
            f"model {model_name(model)!r}: {what} as {got}, expected {dtypes[0]} ({sizes})"
        )
    if not isinstance(value, np.ndarray):
        value = value.detach().cpu().numpy()
    array: NDArray[Any] = value
    return array


def check_finite(values: NDArray[Any], model: Model, what: str, trials: tuple[str, ...]) -> None:
    """Raise `BadInputError` with the first trial, a row of ``values``, with a value not finite."""
    for trial, row in zip(trials, values, strict=True):
        finite = np.isfinite(row)
        if not finite.all():
            where = tuple(int(at) for at in np.argwhere(~finite)[0])
            place = f" at {where} of {row.shape}" if where else ""
            raise BadInputError(
                f"model {model_name(model)!r}, trial {trial!r}: {what} that are not finite "
                f"({row[where]}{place}); check its weights and its inputs"
            )


@contextmanager
def _evaluating(network: Any) -> Iterator[None]:
    """Set a network to evaluation mode without gradients; afterwards every part is as before."""
    import torch

    modes = [(part, part.training) for part in network.modules()]
    network.eval()
    try:
        with torch.inference_mode():
            yield
    finally:
        for part, training in modes:
            part.training = training


def _device(network: Any) -> Any:
    """Return the device of a network's first parameter or buffer; ``cpu`` without any."""
    for tensors in (network.parameters(), network.buffers()):
        for tensor in tensors:
            return tensor.device
    return "cpu"


def _explain(error: Exception, model: Model, method: str, batch: Batch) -> PhysionError:
    """Return the error that says in one line what a model raised."""
    name = model_name(model)
    clips, steps = batch.frames.shape[:2]
    if is_out_of_memory(error):
        advice = MEMORY_ADVICE if clips == 1 else f"lower the option encoder_batch, now {clips}"
        return OutOfMemoryError(
            f"model {name!r}: {method} ran out of memory with {clips} clips of {steps} frames at a "
            f"time; {advice}"
        )
    return describe_raised(error, name, method)


def model_name(model: Model) -> str:
    """Return the name of a model in messages."""
    return str(model.provenance().model)
