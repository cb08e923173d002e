"""Predictions of one model on the folds of a dataset, under all of its protocols."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import Batch
from physion.clips.clips import observed_source, whole_source
from physion.clips.source import ObservedSource, WholeSource
from physion.compute.local import SerialExecutor
from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError
from physion.models.interface import Model, ask, can
from physion.readout.decisions import FeatureReader, Reading, RolloutReader, readers
from physion.readout.features import (
    FeatureStore,
    Knobs,
    Outcomes,
    RolloutStore,
    StoredFeatures,
    all_knobs,
    stack_outcomes,
)
from physion.readout.folds import Fold, ScenarioSplit
from physion.readout.logistic import ReadoutConfig
from physion.readout.model_calls import call_model, check_finite, is_network, to_array
from physion.readout.protocols import Readout
from physion.readout.settings import EvaluationConfig
from physion.readout.tables import ScenarioPredictions, describe_labels
from physion.trials.dataset import Dataset

# Which readout protocols a model supports, and how its predictions are made under each.


class Way(Enum):
    """How predictions are made."""

    ANSWERS = "the model answers"
    FEATURES = "a reader of features"
    ROLLOUTS = "a reader of rollouts"


def reader_name(model: Model, wanted: str = "") -> str:
    """Return the name of the reader: ``wanted``, the model's own, or the one that fits it."""
    if wanted:
        return wanted
    return ask(model, "decision") or ("logistic" if can(model, "encode") else "gap")


def build_reader(model: Model, wanted: str, config: ReadoutConfig) -> FeatureReader | RolloutReader:
    """Return the reader of a model; raise `BadInputError` if it does not fit the model."""
    name = reader_name(model, wanted)
    reader = readers.get(name)(config)
    if reader.input == "features" and not can(model, "encode"):
        raise BadInputError(
            f"reader {name!r} reads features, but model {model.provenance().model} has no "
            "method encode; use the reader gap or noise"
        )
    if reader.input == "rollouts" and not can(model, "imagine"):
        raise BadInputError(
            f"reader {name!r} reads rollouts, but model {model.provenance().model} has no "
            "method imagine; use the reader logistic"
        )
    return reader


def ways(model: Model, reader: str = "") -> dict[Readout, Way]:
    """Return the readout protocols that a model supports, and the way of each.

    Raises `BadInputError` for a model without any.
    """
    found: dict[Readout, Way] = {}
    if can(model, "encode"):
        found[Readout.OBSERVED] = Way.FEATURES
        if model.spec.future:
            found[Readout.FULL] = Way.FEATURES
    if can(model, "imagine"):
        by_features = readers.get(reader_name(model, reader))(ReadoutConfig()).input == "features"
        found[Readout.OBSERVED_SIMULATED] = Way.FEATURES if by_features else Way.ROLLOUTS
    if can(model, "predict") or can(model, "fit"):
        found[Readout.named(ask(model, "answers"))] = Way.ANSWERS
    if not found:
        raise BadInputError(
            f"{_name(model)} has none of the methods encode, imagine, predict and fit, so that it "
            "cannot be evaluated"
        )
    return {readout: found[readout] for readout in Readout if readout in found}


def choose_readouts(model: Model, names: tuple[str, ...], reader: str = "") -> dict[Readout, Way]:
    """Return the requested protocols, by default all that the model supports.

    Raises `BadInputError` for a protocol that the model does not support.
    """
    possible = ways(model, reader)
    requested = [Readout.named(name) for name in names]
    impossible = [readout.value for readout in requested if readout not in possible]
    if impossible:
        raise BadInputError(
            f"{_name(model)} does not support the readout protocol {', '.join(impossible)}; "
            f"supported: {', '.join(readout.value for readout in possible)}"
        )
    return {r: way for r, way in possible.items() if not requested or r in requested}


def _name(model: Any) -> str:
    return str(model.provenance().model)


_UNKNOWN = float("nan")
_ANSWER_TRIALS = 16
"""Trials of which a model is asked at a time."""


@dataclass(frozen=True)
class TrainingLosses:
    """Losses of a training on held-out trials, and name and seed of the training."""

    name: str
    seed: str
    validation: float
    baseline: float


@dataclass
class Predictor:
    """Predictions of one model.

    Under *observed* and *observed+simulated* everything is computed from an observed source, which
    cannot reach a later frame. Whole trials are opened for *full*, and to train on trials that the
    fold does not test. ``problems`` maps the names of trials that could not be predicted to the
    reasons.
    """

    dataset: Dataset
    model: Model
    ways: Mapping[Readout, Way]
    config: EvaluationConfig
    folder: Path | None
    executor: Executor | None = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        index = self.dataset.index
        self._simulated = dict(zip(index["trial"], index["contact"].astype(bool), strict=True))
        known = index["recorded_contact"]
        outcomes = known.fillna(index["contact"]).astype(bool)
        self._outcomes = dict(zip(index["trial"], outcomes, strict=True))
        self._recorded = dict(zip(index["trial"], known.notna(), strict=True))
        self._features = FeatureStore(self._sub("features"), batch=self.config.encoder_batch)
        executor = self.executor if self.executor is not None else SerialExecutor()
        self._rollouts = RolloutStore(self._sub("rollouts"), executor)
        self.problems: dict[str, str] = self._rollouts.problems
        self._initial: Any = None
        if is_network(self.model):
            from physion.training.devices import Devices, make_fabric, move_to_device

            move_to_device(make_fabric(Devices(self.config.accelerator), "32-true"), self.model)
        self.model = ask(self.model, "with_outcomes")(self._outcomes)

    def predict(self, fold: Fold) -> list[ScenarioPredictions]:
        """Return the predictions of a fold, one entry per scenario and protocol."""
        losses = self._train(fold)
        if Way.ROLLOUTS in self.ways.values():
            # All at once, so that all processes have work.
            trials = [t for split in fold.scenarios for t in (*split.fit, *split.test)]
            self._imagined_outcomes(list(dict.fromkeys(trials)))
        return [
            self._predict_scenario(fold, split, readout, way, losses)
            for split in fold.scenarios
            for readout, way in self.ways.items()
        ]

    def restore(self) -> None:
        """Give the model its initial weights again, if it was trained."""
        if self._initial is not None:
            network: Any = self.model
            network.load_state_dict(self._initial)

    def _sub(self, name: str) -> Path | None:
        return self.folder / name if self.folder is not None else None

    @cached_property
    def _observed(self) -> ObservedSource:
        return observed_source(self.dataset, self.model.spec, rendered=self.config.rendered)

    @cached_property
    def _whole(self) -> WholeSource:
        return whole_source(self.dataset, self.model.spec, rendered=self.config.rendered)

    def _train(self, fold: Fold) -> TrainingLosses | None:
        """Train the model from its initial weights on the training trials of a fold."""
        model = self.model
        if self.config.untrained or not (is_network(model) and can(model, "loss")):
            return None
        if ask(model, "trained"):
            return None
        if ask(model, "diet") == "features" and Readout.OBSERVED_SIMULATED not in self.ways:
            return None
        from physion.training.train import train_model

        # Every fold starts from the same weights.
        network: Any = model
        if self._initial is None:
            self._initial = copy.deepcopy(network.state_dict())
        network.load_state_dict(self._initial)
        report = train_model(
            model,
            self._whole,
            fold.train,
            settings=self.config.apply(ask(model, "training_settings")),
            seed=self.config.seed,
            name=fold.training.name,
            folder=self._sub("training"),
            features=self._training_features,
            accelerator=self.config.accelerator,
            progress=self.progress,
        )
        seed = str(self.config.seed)
        return TrainingLosses(fold.training.name, seed, report.validation, report.baseline)

    def _training_features(self, trials: Sequence[str]) -> NDArray[np.float32]:
        stored = self._features.encoded(self.model, self._whole, trials, "whole", self.progress)
        return stored.array()

    def _predict_scenario(
        self,
        fold: Fold,
        split: ScenarioSplit,
        readout: Readout,
        way: Way,
        losses: TrainingLosses | None,
    ) -> ScenarioPredictions:
        if way is Way.ANSWERS:
            reading, fit, test, labels = self._answer(split, readout)
        elif way is Way.FEATURES:
            reading, fit, test, labels = self._read_features(split, readout)
        else:
            reading, fit, test, labels = self._read_rollouts(split)
        fits = way is not Way.ANSWERS or can(self.model, "fit")
        return ScenarioPredictions(
            scenario=split.scenario,
            protocol=readout,
            trials=test,
            probability=reading.probability,
            train_accuracy=reading.train_accuracy,
            fit_trials=len(fit) if fits else 0,
            fold=fold.number,
            fit_labels=self._describe(fit, labels) if fits else "",
            reader="" if way is Way.ANSWERS else reader_name(self.model, self.config.reader),
            training_set=losses.name if losses else "",
            training_seed=losses.seed if losses else "",
            c=reading.c,
            cv_accuracy=reading.cv_accuracy,
            fitted=reading.fitted,
            validation_loss=losses.validation if losses else _UNKNOWN,
            copy_last_loss=losses.baseline if losses else _UNKNOWN,
            note=self._note(reading.note),
        )

    def _note(self, note: str) -> str:
        untrained = self.config.untrained and can(self.model, "loss")
        return "; ".join(part for part in ("untrained" if untrained else "", note) if part)

    def _describe(self, fit: Sequence[str], labels: str) -> str:
        return describe_labels([labels == "recorded" and self._recorded[trial] for trial in fit])

    def _labels(self, trials: Sequence[str], kind: str) -> NDArray[np.bool_]:
        known = self._outcomes if kind == "recorded" else self._simulated
        return np.array([known[trial] for trial in trials], np.bool_)

    def _read_features(
        self, split: ScenarioSplit, readout: Readout
    ) -> tuple[Reading, tuple[str, ...], tuple[str, ...], str]:
        reader = build_reader(self.model, self.config.reader, self.config.readout)
        assert reader.input == "features", "the way says so"
        trials = [*split.fit, *split.test]
        parts = self._parts(trials, readout)
        rows = np.arange(len(trials))
        count = len(split.fit)
        fit = [part.select(rows[:count]) for part in parts]
        test = [part.select(rows[count:]) for part in parts]
        labels = self._labels(split.fit, reader.labels)
        return reader.read(fit, labels, test), split.fit, split.test, reader.labels

    def _parts(self, trials: Sequence[str], readout: Readout) -> list[StoredFeatures]:
        """Return the features that a reader sees under a protocol; they are joined in time."""
        if readout.sees_future:
            return [self._features.encoded(self.model, self._whole, trials, "whole", self.progress)]
        context = self._features.encoded(
            self.model, self._observed, trials, "context", self.progress
        )
        if readout is Readout.OBSERVED:
            return [context]
        samples, seed, knobs = self._rollout_settings()
        imagined, _ = self._features.imagined(
            self.model,
            self._observed,
            context,
            trials,
            samples=samples,
            seed=seed,
            knobs={name: values[0] for name, values in knobs.items()},
            progress=self.progress,
        )
        if imagined is None:
            raise BadInputError(
                f"model {self.model.provenance().model!r}: imagine gave no features, which the "
                f"reader {reader_name(self.model, self.config.reader)!r} needs"
            )
        return [context, imagined]

    def _rollout_settings(self) -> tuple[int, int, Mapping[str, tuple[float, ...]]]:
        samples, seed, knobs = (ask(self.model, name) for name in ("samples", "seed", "knobs"))
        return samples, self.config.seed if seed is None else seed, knobs

    def _imagined_outcomes(self, trials: Sequence[str]) -> dict[Knobs, dict[str, Any]]:
        """Return contacts and gaps of the trials that could be imagined, at all knobs."""
        samples, seed, knobs = self._rollout_settings()
        model = self.model
        shared = ask(model, "trials_together")
        if shared or not is_network(model):
            return self._rollouts.outcomes(
                model,
                self._observed,
                trials,
                samples=samples,
                seed=seed,
                knobs=knobs,
                together=max(shared, 1),
                progress=self.progress,
            )
        found: dict[Knobs, dict[str, Any]] = {}
        for value in all_knobs(knobs):
            _, outcomes = self._features.imagined(
                self.model,
                self._observed,
                None,
                trials,
                samples=samples,
                seed=seed,
                knobs=dict(value),
                progress=self.progress,
            )
            contact = [None] * len(trials) if outcomes.contact is None else outcomes.contact
            gap = [None] * len(trials) if outcomes.gap is None else outcomes.gap
            found[value] = dict(zip(trials, zip(contact, gap, strict=True), strict=True))
        return found

    def _read_rollouts(
        self, split: ScenarioSplit
    ) -> tuple[Reading, tuple[str, ...], tuple[str, ...], str]:
        reader = build_reader(self.model, self.config.reader, self.config.readout)
        assert reader.input == "rollouts", "the way says so"
        found = self._imagined_outcomes([*split.fit, *split.test])
        fit = tuple(trial for trial in split.fit if trial not in self.problems)
        test = tuple(trial for trial in split.test if trial not in self.problems)
        if split.fit and not fit:
            reason = self.problems[split.fit[0]]
            raise BadInputError(f"no trial of {split.scenario} to fit on was imagined: {reason}")
        if not test:
            return Reading(np.empty(0), _UNKNOWN), fit, test, reader.labels
        labels = self._labels(fit, reader.labels)
        near: dict[Knobs, Outcomes] = stack_outcomes(found, fit)
        tested: dict[Knobs, Outcomes] = stack_outcomes(found, test)
        return reader.read(near, labels, tested), fit, test, reader.labels

    def _answer(
        self, split: ScenarioSplit, readout: Readout
    ) -> tuple[Reading, tuple[str, ...], tuple[str, ...], str]:
        """Ask the model itself, after it was fitted on the fit trials if it can be."""
        source: Any = self._whole if readout.sees_future else self._observed
        read = source.whole if readout.sees_future else source.context
        asked: Any = self.model
        accuracy = _UNKNOWN
        if can(self.model, "fit"):
            fit_batch = read(split.fit)
            labels = self._labels(split.fit, "recorded")
            asked = call_model(self.model, "fit", fit_batch, labels, self.config.seed)
            if len(labels):
                accuracy = float(np.mean((self._probability(asked, fit_batch) > 0.5) == labels))
        predicted: dict[str, float] = {}
        for start in range(0, len(split.test), _ANSWER_TRIALS):
            group = split.test[start : start + _ANSWER_TRIALS]
            try:
                answers = self._probability(asked, read(group))
            except BadInputError as error:
                if len(group) == 1:
                    self.problems[group[0]] = str(error)
                    continue
                answers = self._one_by_one(asked, read, group)
            predicted |= {
                trial: float(p) for trial, p in zip(group, answers, strict=True) if np.isfinite(p)
            }
            if self.progress is not None:
                self.progress(
                    "trials", min(start + _ANSWER_TRIALS, len(split.test)), len(split.test)
                )
        probability = np.array(list(predicted.values()), np.float64)
        return Reading(probability, accuracy), split.fit, tuple(predicted), "recorded"

    def _one_by_one(self, asked: Any, read: Any, group: Sequence[str]) -> NDArray[np.float64]:
        """Return the answers for a group of which a trial fails; NaN for those that do."""
        answers = np.full(len(group), np.nan)
        for row, trial in enumerate(group):
            try:
                answers[row] = self._probability(asked, read([trial]))[0]
            except BadInputError as error:
                self.problems[trial] = str(error)
        return answers

    def _probability(self, asked: Any, batch: Batch) -> NDArray[np.float64]:
        what, kinds = "predict gave probabilities", ("float64", "float32")
        values = to_array(
            call_model(asked, "predict", batch), self.model, what, (len(batch),), kinds
        )
        check_finite(values, self.model, what, batch.trials)
        outside = np.flatnonzero((values < 0) | (values > 1))
        if len(outside):
            raise BadInputError(
                f"model {self.model.provenance().model!r}, trial "
                f"{batch.trials[outside[0]]!r}: predict gave {values[outside[0]]}, not a "
                "probability"
            )
        return values.astype(np.float64)
