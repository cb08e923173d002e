"""Training of a model on trials, resumed where it was interrupted, or loaded where it is done."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning_fabric import Fabric
from torch import nn

from physion.clips.source import Part, WholeSource
from physion.compute.tasks import Progress
from physion.core.errors import BadInputError
from physion.core.files import digest_of, folder_lock, json_digest, remove_leftovers
from physion.core.seeds import generator, stable_hash
from physion.core.tables import markdown_table
from physion.models.build import OutOfMemoryError, is_out_of_memory
from physion.models.checkpoint import (
    BUILT_AS,
    WEIGHTS,
    load_tensors,
    tensors_of,
    versions,
)
from physion.models.interface import TrainingSettings, ask, can
from physion.training.devices import Devices, make_fabric, memory_advice, move_to_device
from physion.training.loop import (
    CHECKPOINT,
    TrainingData,
    TrainingFolder,
    TrainingLoop,
    TrainingState,
    call,
    evaluating,
)
from physion.training.windows import (
    SAMPLE_CLIPS,
    SAMPLE_FEATURES,
    ClipWindows,
    FeatureWindows,
    LabelledContexts,
    TrialFeatures,
    hold_out,
    window_length,
)

# Model card of a trained model: what it is, its data, settings, versions and losses.


def model_card(
    model: Any,
    data: str,
    trials: Sequence[str],
    settings: TrainingSettings,
    seed: int,
    metadata: Mapping[str, Any],
    state: TrainingState,
) -> str:
    """Return the text of a model card, in Markdown.

    Parameters
    ----------
    model
        Trained model.
    data
        Name of the set of trials, such as ``all`` or ``no_drop``.
    trials
        Names of the trials.
    settings, seed
        Of the training.
    metadata
        Metadata of the file of the model: provenance, versions, hash of the config.
    state
        State after the last step.
    """
    provenance = {name: value for name, value in metadata["provenance"].items() if value}
    counts = Counter(trial.partition("_")[0] for trial in trials)
    scenarios = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
    options = dataclasses.asdict(chosen) if (chosen := ask(model, "settings")) else {}
    labels = "on the outcomes of trials" if ask(model, "learns_outcomes") else "without labels"
    losses = {
        f"training, mean of the last {settings.log_every} steps": state.loss,
        "held-out trials": state.validation,
        "held-out trials, trivial predictor": state.baseline,
    }
    return "\n\n".join(
        [
            f"# {provenance['model']}, trained on {data}",
            f"Model trained {labels} by `physion train`. Whether it predicts contacts is "
            "measured by `physion evaluate`.",
            "## Model\n" + _table(provenance),
            *(["## Options\n" + _table(options)] if options else []),
            f"## Data\n{len(trials)} trials, by the start of their names: {scenarios}. "
            f"Fraction held out for validation: {settings.held_out:g}.",
            "## Training\n" + _table({**dataclasses.asdict(settings), "seed": seed}),
            "## Losses\n" + _table({k: v for k, v in losses.items() if not math.isnan(v)}),
            "## Versions\n" + _table({**metadata["versions"], "config": metadata["config_hash"]}),
            "## Licence\nThat of the trials and of the initial weights; the code of physion is "
            "under the MIT licence.",
            "## Use\nBuild the model with the same options, then load the weights:\n\n"
            "```python\n"
            "from pathlib import Path\n\n"
            "from physion.models.checkpoint import load_weights\n\n"
            f'load_weights(Path("{WEIGHTS}"), model)\n'
            "```\n",
        ]
    )


def _table(values: Mapping[str, Any]) -> str:
    rows = [(name, _text(value)) for name, value in values.items()]
    return markdown_table(["", ""], rows, tight=True)


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


Features = Callable[[Sequence[str]], Sequence[TrialFeatures]]

_NOT_HASHED = ("log_every", "checkpoint_every")
"""Settings that do not change the weights, only how often something is written."""


@dataclass(frozen=True)
class TrainedModel:
    """Result of a training.

    - ``model``, ``seed``: what was trained. ``name``: of the set of trials. ``folder``: its files,
      None if nothing is kept.
    - ``loss``: mean of the last ``log_every`` steps. ``validation``: of held-out trials, and
      ``baseline`` of a predictor that has learnt nothing; NaN if there is none.
    - ``config_hash``: of everything that determines the weights.
    - ``loaded``: whether it was there before. ``notes``: files that were found damaged.
    """

    model: str
    name: str
    seed: int
    folder: Path | None
    steps: int
    loss: float
    validation: float
    baseline: float
    config_hash: str
    loaded: bool
    notes: tuple[str, ...]


def train_model(
    model: Any,
    source: WholeSource,
    trials: Sequence[str],
    *,
    seed: int,
    name: str,
    folder: Path | None,
    settings: TrainingSettings | None = None,
    features: Features | None = None,
    outcomes: Mapping[str, bool] | None = None,
    accelerator: str = "auto",
    fabric: Fabric | None = None,
    progress: Progress | None = None,
) -> TrainedModel:
    """Train ``model`` in place; it ends on the device of ``fabric``, in evaluation mode.

    If ``folder`` holds the same training, its weights are loaded if it is done, and it is resumed
    if it is not, with the results of an uninterrupted one (to the bit on a CPU).

    Parameters
    ----------
    model
        A torch ``Module`` with a loss, with its initial weights.
    source
        Source of clips with the model's ``spec``.
    trials
        Training trials; a part of them is held out for validation.
    seed
        Of the batches, the held-out trials, and random operations in the model.
    name
        Name of the set of trials, for the folder and the model card.
    folder
        Folder of all trainings, in which ``<model>-<name>-<hash>`` is created; None keeps nothing.
    settings
        Optimiser and schedule; by default the model's.
    features
        Returns features (n, T, D) of whole clips, or of contexts for a model that learns outcomes,
        for models that learn from features.
    outcomes
        Whether agent and patient touch, by trial, for a model that learns outcomes.
    accelerator
        Lightning's name of the device: auto, cpu, cuda, ...
    fabric
        Several devices (`make_fabric`), in place of ``accelerator``.
    progress
        Called after every step.

    Raises
    ------
    BadInputError
        If the model cannot be trained, a checkpoint is of other versions of the libraries, or the
        outcome of a trial is needed and not known.
    TrainingStoppedError
        If a loss or weight is not finite.
    OutOfMemoryError
        If memory is used up; the message names the setting to lower.
    """
    check_trainable(model)
    if not trials:
        raise BadInputError(f"there is no trial to train {model.provenance().model!r} on")
    settings = settings if settings is not None else ask(model, "training_settings")
    fabric = fabric or make_fabric(Devices(accelerator), settings.precision)
    config = training_inputs(model, source, trials, settings, seed, outcomes)
    config_hash = json_digest(config)
    kept = None
    if folder is not None:
        kept = TrainingFolder(training_path(folder, model, name, config))
    move_to_device(fabric, model)
    done = kept.finished() if kept is not None else None
    if kept is not None and done is not None:
        load_tensors(done.path, done.tensors, model)
        model.eval()
        if fabric.is_global_zero:  # a process that was killed may have left it
            (kept.path / CHECKPOINT).unlink(missing_ok=True)
        state = TrainingState.of(done.metadata["state"])
        return _result(model, name, seed, kept, state, config_hash, True)
    metadata = {
        "config": config,
        "config_hash": config_hash,
        "versions": versions(),
        "provenance": dataclasses.asdict(model.provenance()),
        BUILT_AS: ask(model, "built_as")(),
    }
    with _writing(kept, fabric), memory_advice(settings):
        stored = kept.resumable() if kept is not None else None
        fabric.barrier()
        if kept is not None and fabric.is_global_zero:
            remove_leftovers(kept.path)
        fabric.barrier()
        data = _windows(model, source, trials, settings, seed, features, outcomes, fabric)
        if stored is None:
            _prepare(model, data, seed, fabric)
        loop = TrainingLoop(
            model,
            data,
            settings,
            seed,
            fabric,
            folder=kept,
            describe=metadata,
            progress=_named(progress, f"training {name}") if fabric.is_global_zero else None,
        )
        if stored is not None:
            loop.resume(stored)
        loop.run()
        with evaluating(model, fabric):
            calibrate(model, source, data.training.trials, seed)
        model.eval()
        if kept is not None and fabric.is_global_zero:
            card = model_card(model, name, trials, settings, seed, metadata, loop.state)
            kept.finish(tensors_of(model), loop.metadata(), card)
        fabric.barrier()
    return _result(model, name, seed, kept, loop.state, config_hash, False)


def check_trainable(model: Any) -> None:
    """Raise `BadInputError` if a model has nothing to train."""
    if not (isinstance(model, nn.Module) and can(model, "loss")):
        raise BadInputError(f"model {model.provenance().model!r} has nothing to train")


def training_path(folder: Path, model: Any, name: str, inputs: Mapping[str, Any]) -> Path:
    """Return the folder of a training, named by a hash of all that determines the weights."""
    title = re.sub(r"[^A-Za-z0-9._-]+", "-", f"{model.provenance().model}-{name}")
    return folder / f"{title}-{json_digest(inputs)[:12]}"


def training_inputs(
    model: Any,
    source: WholeSource,
    trials: Sequence[str],
    settings: TrainingSettings,
    seed: int,
    outcomes: Mapping[str, bool] | None = None,
) -> dict[str, Any]:
    """Return JSON values of everything that determines the weights."""
    keys = []
    labelled = ask(model, "learns_outcomes")
    known = _known_outcomes(model, trials, outcomes) if labelled else {}
    for trial in trials:
        end = f" {known[trial]}" if labelled else ""
        part: Part = "context" if labelled else "whole"
        keys.append(f"{trial} {source.key(trial, part)}{end}\n")
    chosen = dataclasses.asdict(settings)
    learns_from = ask(model, "learns_from")
    return {
        "model": model.digest(),
        "features": ask(model, "encoder_digest")() if learns_from == "features" else "",
        "trials": digest_of("".join(keys)),
        "settings": {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in chosen.items()
            if name not in _NOT_HASHED
        },
        "seed": seed,
        "learns_from": learns_from,
        "window": window_length(model),
    }


def _known_outcomes(
    model: Any, trials: Sequence[str], outcomes: Mapping[str, bool] | None
) -> Mapping[str, bool]:
    """Return the outcomes; raise `BadInputError` if one of a trial is not known."""
    known = outcomes or {}
    unknown = [trial for trial in trials if trial not in known]
    if unknown:
        raise BadInputError(
            f"model {model.provenance().model!r} learns outcomes, but {len(unknown)} trials are "
            f"stored without, such as {unknown[0]!r}; generate trials with labels"
        )
    return known


@contextlib.contextmanager
def _writing(folder: TrainingFolder | None, fabric: Fabric) -> Iterator[None]:
    """Let no other process of this machine train in the same folder."""
    if folder is None or not fabric.is_global_zero:
        yield
        return
    folder.path.mkdir(parents=True, exist_ok=True)
    with folder_lock(folder.path):
        yield


def _windows(
    model: Any,
    source: WholeSource,
    trials: Sequence[str],
    settings: TrainingSettings,
    seed: int,
    features: Features | None,
    outcomes: Mapping[str, bool] | None,
    fabric: Fabric,
) -> TrainingData:
    rows, held = hold_out(len(trials), settings.held_out, seed)
    window = window_length(model)
    labelled = ask(model, "learns_outcomes")
    chosen, rest = (tuple(trials[row] for row in part) for part in (rows, held))
    if ask(model, "learns_from") != "features":
        if labelled:
            known = _known_outcomes(model, trials, outcomes)
            made = [
                LabelledContexts(part, known, source.context, SAMPLE_CLIPS)
                for part in (chosen, rest)
            ]
            return TrainingData(made[0], made[1] if len(held) else None)
        chooses = model if can(model, "start_probabilities") else None
        training = ClipWindows(source, chosen, window, chooses)
        held_out = ClipWindows(source, rest, window)
        return TrainingData(training, held_out if len(held) else None)
    if features is None:
        raise BadInputError(f"model {model.provenance().model!r} is trained on features")
    with fabric.rank_zero_first():  # which stores them for the others
        values = features(trials)
    frames = [source.length(trial) for trial in trials]
    first, second = (
        FeatureWindows(model.spec, trials, values, frames, part, window) for part in (rows, held)
    )
    if labelled:
        known = _known_outcomes(model, trials, outcomes)
        one, other = (
            LabelledContexts(names, known, of_part.context, SAMPLE_FEATURES)
            for names, of_part in ((chosen, first), (rest, second))
        )
        return TrainingData(one, other if len(held) else None)
    return TrainingData(first, second if len(held) else None)


def _prepare(model: Any, data: TrainingData, seed: int, fabric: Fabric) -> None:
    """Let the model set its statistics from training clips."""
    sample = data.training.sample(seed)
    with evaluating(model, fabric):
        torch.manual_seed(stable_hash("prepare", seed) % 2**63)
        try:
            call(model, "prepare", sample.to(fabric.device))
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            raise OutOfMemoryError(
                f"prepare ran out of memory with {len(sample)} clips; use a smaller image_size or "
                "size of the model"
            ) from error


def calibrate(model: Any, source: WholeSource, trials: Sequence[str], seed: int) -> None:
    """Let a model set what depends on its trained weights from whole training trials.

    Nothing happens to a model without a method ``calibrate``.
    """
    if not can(model, "calibrate"):
        return
    order = generator("calibrate", seed).permutation(len(trials))[
        : ask(model, "calibration_trials")
    ]
    chosen = source.whole([trials[row] for row in np.sort(order)])
    torch.manual_seed(stable_hash("calibrate", seed) % 2**63)
    network: Any = model
    call(model, "calibrate", chosen.to(next(network.parameters()).device))


def _named(progress: Progress | None, what: str) -> Callable[[int, int], None] | None:
    if progress is None:
        return None
    return lambda done, total: progress(what, done, total)


def _result(
    model: Any,
    name: str,
    seed: int,
    folder: TrainingFolder | None,
    state: TrainingState,
    config_hash: str,
    loaded: bool,
) -> TrainedModel:
    return TrainedModel(
        model=model.provenance().model,
        name=name,
        seed=seed,
        folder=folder.path if folder is not None else None,
        steps=state.step,
        loss=state.loss,
        validation=state.validation,
        baseline=state.baseline,
        config_hash=config_hash,
        loaded=loaded,
        notes=tuple(folder.notes) if folder is not None else (),
    )
