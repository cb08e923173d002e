"""Features and outcomes that a model gives for a batch of clips, checked and split by trial."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.models.batch import Batch, Rollout
from physion.models.interface import Model
from physion.readout.features.stored_features import FEATURES
from physion.readout.model_calls import call_model, check_finite, model_name, to_array

GAP, CONTACT = "gap", "contact"
Arrays = Mapping[str, NDArray[Any]]
"""Arrays of one trial, by name."""


def encode_clips(model: Model, batch: Batch) -> list[Arrays]:
    """Return the features (T', D) of every clip of a batch."""
    clips, steps = batch.frames.shape[:2]
    value = call_model(model, "encode", batch)
    expected = steps if model.spec.framewise else None
    features = to_array(value, model, "encode gave features", (clips, expected, None), ("float32",))
    if features.shape[1] > steps:
        raise BadInputError(
            f"model {model_name(model)!r}: encode gave features of {features.shape[1]} time "
            f"steps for clips of {steps} frames"
        )
    check_finite(features, model, "encode gave features", batch.trials)
    return _split({FEATURES: features}, clips)


def imagine_clips(
    model: Model, batch: Batch, samples: int, seed: int, knobs: Mapping[str, float]
) -> list[Arrays]:
    """Return features (S * future, D), gap (S) and contact (S) of every clip, if given."""
    rollout = call_model(model, "imagine", batch, samples, seed, **knobs)
    if not isinstance(rollout, Rollout):
        raise BadInputError(
            f"model {model_name(model)!r}: imagine gave {type(rollout).__name__}, expected Rollout"
        )
    clips, future = len(batch), model.spec.future
    expected: dict[str, tuple[tuple[int | None, ...], tuple[str, ...]]] = {
        FEATURES: ((clips, samples, future, None), ("float32",)),
        GAP: ((clips, samples), ("float64", "float32")),
        CONTACT: ((clips, samples), ("bool",)),
    }
    arrays: dict[str, NDArray[Any]] = {}
    for name, (shape, dtypes) in expected.items():
        value = getattr(rollout, name)
        if value is None:
            continue
        what = f"imagine gave {name}"
        arrays[name] = to_array(value, model, what, shape, dtypes)
        check_finite(arrays[name], model, what, batch.trials)
    if not arrays:
        raise BadInputError(
            f"model {model_name(model)!r}: imagine gave none of features, gap and contact"
        )
    if FEATURES in arrays:
        features = arrays[FEATURES]
        arrays[FEATURES] = features.reshape(clips, samples * future, features.shape[-1])
    if GAP in arrays:
        arrays[GAP] = arrays[GAP].astype(np.float64)
    return _split(arrays, clips)


def _split(arrays: Mapping[str, NDArray[Any]], clips: int) -> list[Arrays]:
    """Return copies by clip: the model may use its own arrays again."""
    return [{name: value[row].copy() for name, value in arrays.items()} for row in range(clips)]
