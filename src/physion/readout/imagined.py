"""What models imagine of trials, as the viewer shows it (`physion view --predictions`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import SHOWABLE, Batch, Imagine, ImaginedTrial, Rollout
from physion.clips.clips import whole_source
from physion.clips.source import WholeSource
from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError
from physion.models.build import OutOfMemoryError, build_model
from physion.models.interface import Model, ask, can
from physion.readout.decisions import EndDecision, Futures, TouchDecision
from physion.readout.features import Outcomes
from physion.readout.model_calls import (
    check_identity,
    encoded,
    imagined,
    model_name,
    to_array,
    use_device,
)
from physion.trials.dataset import Dataset

Arrays = NDArray[Any]

_FUTURES: dict[str, tuple[tuple[int | None, ...], str]] = {
    "particles": ((None, None, 3), "float32"),
    "rgb": ((None, None, None, 3), "uint8"),
    "boxes": ((None, None, 4), "float32"),
    "masks": ((None, None, None, None), "float32"),
    "slots": ((None, None, None), "float32"),
}
"""Shape after the axes of trials and futures, and type, of what the viewer shows (`SHOWABLE`)."""
_TRIALS = 8
"""Trials that a model imagines at a time."""


def imagine_with(
    dataset: Dataset,
    names: Sequence[str],
    options: Mapping[str, Any],
    progress: Progress | None = None,
) -> Imagine:
    """Return the function by which the viewer asks models what they imagine.

    Parameters
    ----------
    dataset
        The dataset. Models imagine from its observed part; the true pictures that the viewer shows
        next to them are of whole trials.
    names
        Names of models; ``options`` are fields of the config of every one.
    progress
        Called after every group of trials.

    Raises
    ------
    UnknownNameError
        For an unknown model or option.
    BadInputError
        For a model that cannot imagine, or is named twice. The function itself raises it for a
        model that imagines nothing that can be shown.
    """
    models = [build_model(name, **options) for name in names]
    for model in models:
        check_identity(model)
        if not can(model, "imagine"):
            raise BadInputError(
                f"model {model_name(model)!r} imagines no future (it has no method imagine), so "
                "that no prediction can be shown; choose a model that does, such as dpi"
            )
    labels = [model_name(model) for model in models]
    if len(set(labels)) < len(labels):
        raise BadInputError(f"--predictions names a model twice: {', '.join(labels)}")

    def imagine(trials: Sequence[str]) -> dict[str, list[ImaginedTrial]]:
        imagined: dict[str, list[ImaginedTrial]] = {trial: [] for trial in trials}
        for model in models:
            for trial, one in _imagine_trials(dataset, model, trials, progress).items():
                imagined[trial].append(one)
        return imagined

    return imagine


def describe_weights(model: Model) -> str:
    """Return where the weights of a model come from, or that they are untrained."""
    init = model.provenance().init
    if can(model, "loss") and not ask(model, "trained"):
        return f"untrained, weights {init}"
    return "no weights" if init == "none" else f"weights {init}"


def _imagine_trials(
    dataset: Dataset, model: Model, trials: Sequence[str], progress: Progress | None
) -> dict[str, ImaginedTrial]:
    """Return what one model imagines of the trials."""
    use_device(model)
    source = whole_source(dataset, model.spec, rendered=_without_movies(dataset, trials))
    groups = [trials[row : row + _TRIALS] for row in range(0, len(trials), _TRIALS)]
    imagined: dict[str, ImaginedTrial] = {}
    for group in tracked(groups, f"predictions of {model_name(model)}", len(groups), progress):
        try:
            imagined |= zip(group, _imagine_group(model, source, group), strict=True)
        except OutOfMemoryError:
            if len(group) == 1:
                raise
            for trial in group:
                imagined[trial] = _imagine_group(model, source, [trial])[0]
    return imagined


def _without_movies(dataset: Dataset, trials: Sequence[str]) -> bool:
    """Return whether a trial has no movies, so that pictures must be rendered from the motion."""
    index = dataset.index
    if "movie_sha256" not in index:
        return True
    return bool(index.loc[index["trial"].isin(trials), "movie_sha256"].isna().any())


def _imagine_group(model: Model, source: WholeSource, trials: Sequence[str]) -> list[ImaginedTrial]:
    """Return what a model imagines of each trial; the first future is shown."""
    batch = _context(model, source.context(trials))
    longest = max(source.length(trial) for trial in trials)
    batch = dataclasses.replace(batch, future=model.spec.steps_after(longest))
    samples, seed = ask(model, "samples"), ask(model, "seed") or 0
    rollout = imagined(model, batch, samples, seed, show=1.0)
    shown, steps = _shown_arrays(model, rollout, len(batch), samples)
    seen = _seen_arrays(model, rollout, batch, shown)
    true = _true_arrays(model, source, trials, shown, steps) if steps == batch.future else {}
    probability, gap = _outcomes(model, rollout, len(batch), samples)
    context = model.spec.context_frames()
    frames = context[-1] + model.spec.stride * np.arange(1, steps + 1)
    return [
        ImaginedTrial(
            model=model_name(model),
            weights=describe_weights(model),
            frames=frames,
            shown=_row(shown, row),
            seen_frames=np.array(context if seen else (), np.int64),
            seen=_row(seen, row),
            true=_row(true, row),
            probability=float(probability[row]),
            gap=float(gap[row]),
            futures=samples,
        )
        for row in range(len(batch))
    ]


def _row(arrays: Mapping[str, Arrays], row: int) -> dict[str, Arrays]:
    return {name: values[row] for name, values in arrays.items()}


def _context(model: Model, batch: Batch) -> Batch:
    """Return the context of trials, with its features if the model also encodes."""
    if not can(model, "encode"):
        return batch
    return dataclasses.replace(batch, features=encoded(model, batch))


def _shown_arrays(
    model: Model, rollout: Rollout, clips: int, samples: int
) -> tuple[dict[str, Arrays], int]:
    """Return the arrays (B, F, ...) of the first future that can be shown, and F."""
    known = [name for name in SHOWABLE if name in rollout.shown]
    if not known:
        gave = ", ".join(sorted(rollout.shown)) or "only features or outcomes"
        raise BadInputError(
            f"model {model_name(model)!r} imagines nothing that can be shown: the viewer shows "
            f"{', '.join(SHOWABLE)}, and it gave {gave}"
        )
    shown: dict[str, Arrays] = {}
    steps: int | None = None
    for name in known:
        (_, *shape), dtype = _FUTURES[name]
        wanted = (clips, samples, steps, *shape)
        shown[name] = _array(model, rollout, name, wanted, dtype)[:, 0]
        steps = shown[name].shape[1]
    if "particles" in shown:
        count = shown["particles"].shape[2]
        shown["things"] = _array(model, rollout, "things", (clips, count), "int64")
    return shown, steps or 0


def _seen_arrays(
    model: Model, rollout: Rollout, batch: Batch, shown: Mapping[str, Arrays]
) -> dict[str, Arrays]:
    """Return what the model saw (B, T, ...), and the masks and slots that it found there."""
    if not set(shown) & {"rgb", "boxes", "masks", "slots"}:
        return {}
    values = {"rgb": batch.rgb, "boxes": batch.boxes if "boxes" in shown else None}
    seen: dict[str, Arrays] = {name: value for name, value in values.items() if value is not None}
    frames = len(model.spec.context_frames())
    if "context_masks" in rollout.shown:
        shape = (len(batch), frames, None, None, None)
        seen["masks"] = _array(model, rollout, "context_masks", shape, "float32")
    if "slots" in shown and batch.features is not None:
        seen["slots"] = _as_slots(model, batch.features, shown["slots"])
    return seen


def _true_arrays(
    model: Model,
    source: WholeSource,
    trials: Sequence[str],
    shown: Mapping[str, Arrays],
    steps: int,
) -> dict[str, Arrays]:
    """Return what was to be imagined (B, F, ...): pictures, and the slots that are found there."""
    spec = model.spec
    if not spec.sees_pictures:
        return {}
    whole = source.window(trials, [spec.first] * len(trials), spec.context + steps)
    true = {} if whole.rgb is None else {"rgb": whole.rgb[:, spec.context :]}
    if "slots" in shown and can(model, "encode"):
        features = encoded(model, whole)[:, spec.context :]
        true["slots"] = _as_slots(model, features, shown["slots"])
    return true


def _as_slots(model: Model, features: Arrays, slots: Arrays) -> Arrays:
    """Return features (B, T, K D) as slots (B, T, K, D), of which ``slots`` has K and D."""
    count, size = slots.shape[2:]
    if features.shape[2] != count * size:
        raise BadInputError(
            f"model {model_name(model)!r}: imagine gave {count} slots of {size} values, and encode "
            f"features of {features.shape[2]} values, which must be the values of all slots"
        )
    return features.reshape(*features.shape[:2], count, size)


def _array(
    model: Model, rollout: Rollout, name: str, shape: tuple[int | None, ...], dtype: str
) -> Arrays:
    value = rollout.shown.get(name)
    return to_array(value, model, f"imagine gave {name}", shape, (dtype,))


def _outcomes(model: Model, rollout: Rollout, clips: int, samples: int) -> tuple[Arrays, Arrays]:
    """Return P(contact) (B,) over all futures, and the gap (B,) of the first; NaN if unknown."""
    shape, unknown = (clips, samples), np.full(clips, np.nan)
    gap, end, contact = (
        None if value is None else to_array(value, model, f"imagine gave {name}", shape, dtypes)
        for name, value, dtypes in (
            ("gap", rollout.gap, ("float64", "float32")),
            ("end", rollout.end, ("float64", "float32")),
            ("contact", rollout.contact, ("bool",)),
        )
    )
    probability = unknown
    if end is not None or gap is not None or contact is not None:
        decide = (TouchDecision() if end is None else EndDecision()).decide
        futures: Futures = {(): Outcomes(contact, gap, end)}
        probability = decide({}, np.empty(0, np.bool_), futures).probability
    return probability, unknown if gap is None else gap[:, 0]
