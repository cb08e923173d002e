"""Predictions of one model on the folds of a dataset, under all of its readouts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import Enum
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.clips.batch import Batch
from physion.clips.clips import observed_source, whole_source
from physion.clips.source import ObservedSource, WholeSource
from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError
from physion.models.interface import Model, TrainingSettings, ask, can
from physion.readout.benchmark import V1, Benchmark
from physion.readout.decisions import Decided, Decision, NoiseDecision, Readout, decisions
from physion.readout.features import Arguments, FeatureStore, Imagined, StoredFeatures
from physion.readout.folds import Fold, Protocol, ScenarioSplit
from physion.readout.logistic import LogisticSettings
from physion.readout.model_calls import (
    call_model,
    check_finite,
    is_network,
    model_name,
    notes_of,
    to_array,
    use_device,
)
from physion.readout.settings import EvaluationSettings
from physion.readout.shipped import ShippedReadout, ShippedReadouts
from physion.readout.tables import ScenarioPredictions, describe_labels
from physion.readout.train import Trainer
from physion.trials.dataset import Dataset

# Which readouts a model supports, and how its predictions are made under each.


class Way(Enum):
    """How predictions are made."""

    ANSWERS = "the model answers"
    FEATURES = "a decision on features"
    ROLLOUTS = "a decision on rollouts"


def decision_name(model: Model, wanted: str = "") -> str:
    """Return the name of the decision: ``wanted``, the model's own, or the one that fits it."""
    if wanted:
        return wanted
    return ask(model, "decision") or ("logistic" if can(model, "encode") else "gap")


def build_decision(model: Model, wanted: str, settings: LogisticSettings) -> Decision:
    """Return the decision of a model; raise `BadInputError` if it does not fit the model."""
    name = decision_name(model, wanted)
    decision = decisions.get(name)(settings)
    if isinstance(decision, Decision):
        decision = replace(decision, tokens=ask(model, "tokens"))
    method, others = {
        "features": ("encode", "decision gap or noise"),
        "rollouts": ("imagine", "decision logistic"),
    }[decision.input]
    if not can(model, method):
        raise BadInputError(
            f"decision {name!r} needs {decision.input}, but model {model_name(model)} has no "
            f"method {method}; use the {others}"
        )
    return decision


def ways(model: Model, decision: str = "", rules: Benchmark = V1) -> dict[Readout, Way]:
    """Return the readouts that a model supports under some rules, and the way of each.

    Raises `BadInputError` for a model without any.
    """
    found: dict[Readout, Way] = {}
    if can(model, "encode"):
        if ask(model, "answers") != Readout.FULL.value:
            found[Readout.OBSERVED] = Way.FEATURES
        # A window for detection needs no more frames than a model asks for.
        if model.spec.future != 0 or (rules.window is not None and model.spec.inputs):
            found[Readout.FULL] = Way.FEATURES
    if can(model, "imagine"):
        needs = decisions.get(decision_name(model, decision))(LogisticSettings()).input
        found[Readout.OBSERVED_SIMULATED] = Way.FEATURES if needs == "features" else Way.ROLLOUTS
    if can(model, "predict") or can(model, "fit"):
        found[Readout.named(ask(model, "answers"))] = Way.ANSWERS
    if not found:
        raise BadInputError(
            f"{model_name(model)} has none of the methods encode, imagine, predict and fit, so "
            "that it cannot be evaluated"
        )
    possible = [readout for readout in Readout if readout in found]
    kept = [readout for readout in possible if readout.value in rules.readouts]
    if not kept:
        raise BadInputError(
            f"{model_name(model)} has the readouts {', '.join(r.value for r in possible)}, but "
            f"{rules.name} needs one of {', '.join(rules.readouts)}; leave out the option benchmark"
        )
    return {readout: found[readout] for readout in kept}


def choose_readouts(
    model: Model, names: tuple[str, ...], decision: str = "", rules: Benchmark = V1
) -> dict[Readout, Way]:
    """Return the requested readouts, by default all that the model supports.

    Raises `BadInputError` for a readout that the model does not support.
    """
    possible = ways(model, decision, rules)
    requested = [Readout.named(name) for name in names]
    impossible = [readout.value for readout in requested if readout not in possible]
    if impossible:
        raise BadInputError(
            f"{model_name(model)} does not support the readout {', '.join(impossible)}; "
            f"supported: {', '.join(readout.value for readout in possible)}"
        )
    return {r: way for r, way in possible.items() if not requested or r in requested}


def _fit_trials(model: Model, decision: Decision, split: ScenarioSplit) -> tuple[str, ...]:
    """Return the fit trials of a scenario; none for a decision on which nothing is fitted."""
    values = ask(model, "arguments").values()
    no_choice = isinstance(decision, NoiseDecision) and all(len(of_one) == 1 for of_one in values)
    return () if no_choice or not getattr(decision, "fits", True) else tuple(split.fit)


_UNKNOWN = float("nan")
_Made = tuple[Decided, tuple[str, ...], tuple[str, ...]]
"""What was decided, and the fit and tested trials of which that could be done."""
_ANSWER_TRIALS = 16
"""Trials of which a model is asked at a time."""


class Predictor:
    """Predictions of one model.

    Under *observed* and *observed+simulated* everything is computed from an observed source, which
    cannot reach a later frame. Whole trials are opened for *full*, and to train on trials that the
    fold does not test.

    Parameters
    ----------
    dataset
        Trials.
    model
        Model, which has its initial weights after `restore`.
    ways
        Readouts, and how predictions are made under each.
    settings
        Settings of the evaluation.
    training
        Settings of the training; None if the model is not trained.
    protocol, seed
        Training protocol, None if the model is not trained, and seed.
    folder
        Output folder.
    shipped
        Readouts that ship for the model, which are not fitted here.
    fit_on
        Name and digest of the set with the fit trials; empty if they are the dataset's own.
    rules
        Which frames are shown.
    stored
        By trial the folder of its features, where it is not in ``folder``.
    executor
        Runs simulations; by default they run in this process.
    progress
        Called after every finished item.
    """

    def __init__(
        self,
        dataset: Dataset,
        model: Model,
        ways: Mapping[Readout, Way],
        settings: EvaluationSettings,
        *,
        folder: Path,
        training: TrainingSettings | None = None,
        protocol: Protocol | None = None,
        seed: int = 0,
        shipped: ShippedReadouts | None = None,
        fit_on: str = "",
        rules: Benchmark = V1,
        stored: Mapping[str, Path] = MappingProxyType({}),
        executor: Executor | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.dataset, self.model, self.ways, self.settings = dataset, model, ways, settings
        self.rules = rules
        self.seed, self.progress = seed, progress
        self._protocol, self._shipped, self._fit_on = protocol, shipped, fit_on
        index = dataset.index.set_index("trial")
        self._frames, known = index["frames"], index["recorded_contact"]
        self._labels = pd.DataFrame(
            {
                # Missing ones are of trials that only train dynamics (`folds.check_labels`).
                "simulated": index["contact"],
                "recorded": known.where(known.notna(), index["contact"]),
                "known": known.notna(),
            }
        )
        self._store = FeatureStore(
            folder / "features",
            batch=settings.encoder_batch,
            executor=executor,
            elsewhere=stored,
        )
        self.problems: dict[str, str] = self._store.problems
        """Reasons of trials that could not be predicted, by name."""
        self._trainer: Trainer | None = None
        use_device(model, settings.accelerator)
        if training is not None:  # of networks only
            from physion.training.devices import Devices, make_fabric

            self._trainer = Trainer(
                model,
                self._whole,
                self._store,
                dataset.index,
                training,
                folder / "training",
                make_fabric(Devices(settings.accelerator), training.precision),
                progress,
            )

    def predict(self, fold: Fold) -> list[ScenarioPredictions]:
        """Return the predictions of a fold, one entry per scenario and readout."""
        losses = (_UNKNOWN, _UNKNOWN)
        if self._trainer is not None:
            trained = self._trainer.train(fold, self.seed)
            losses = trained.validation, trained.baseline
        if Way.ROLLOUTS in self.ways.values():
            # All at once, so that all processes have work.
            decision = build_decision(self.model, self.settings.decision, self.settings.logistic)
            self._imagined(fold.scenarios, decision)
        return [
            self._predict_scenario(fold, split, readout, way, losses)
            for split in fold.scenarios
            for readout, way in self.ways.items()
        ]

    def restore(self) -> None:
        """Give the model its initial weights again, if it was trained."""
        if self._trainer is not None:
            self._trainer.restore()

    @cached_property
    def _observed(self) -> ObservedSource:
        return observed_source(
            self.dataset,
            self.model.spec,
            rendered=self.settings.rendered,
            last=self.rules.last_frames(self.dataset.index),
        )

    @cached_property
    def _whole(self) -> WholeSource:
        index = self.dataset.index
        return whole_source(
            self.dataset,
            self.model.spec,
            rendered=self.settings.rendered,
            last=self.rules.last_frames(index),
            # A table of features needs no frames.
            windows=self.rules.windows(self.rules.select(index)) if self.model.spec.inputs else {},
        )

    def _longest(self, split: ScenarioSplit) -> int:
        """Return the frames of the longest trial that the readout of a scenario sees."""
        return int(self._frames.loc[[*split.fit, *split.test]].max())

    def _future(self, split: ScenarioSplit) -> dict[str, int]:
        """Return how many steps are imagined of each trial: equally many, to the longest's end."""
        steps = self.model.spec.steps_after(self._longest(split))
        return dict.fromkeys((*split.fit, *split.test), steps)

    def _predict_scenario(
        self,
        fold: Fold,
        split: ScenarioSplit,
        readout: Readout,
        way: Way,
        losses: tuple[float, float],
    ) -> ScenarioPredictions:
        decision = None
        known = None
        if self._shipped is not None and way is Way.FEATURES:
            known = self._shipped.find(readout, split.scenario)
        if known is not None and known.fit_trials > len(split.fit):
            return self._predict_shipped(known, split, readout)
        if way is Way.ANSWERS:
            decided, fit, test = self._answer(split, readout)
        else:
            decision = build_decision(self.model, self.settings.decision, self.settings.logistic)
            decide = self._decide_on_features if way is Way.FEATURES else self._decide_on_rollouts
            decided, fit, test = decide(decision, split, readout)
        if decision is None and not can(self.model, "fit"):
            fit = ()
        recorded = decision is None or decision.labels == "recorded"
        # Weights that were never trained, since the user wants it so.
        learns = can(self.model, "loss") and not ask(self.model, "trained")
        untrained = self.settings.untrained and learns
        trained = self._trainer is not None
        return ScenarioPredictions(
            scenario=split.scenario,
            readout=readout.value,
            trials=test,
            decided=decided,
            fit_trials=len(fit),
            fold=fold.number,
            fit_labels=describe_labels([recorded and self._labels["known"][t] for t in fit]),
            fit_on=self._fit_on if fit else "",
            decision="" if decision is None else decision_name(self.model, self.settings.decision),
            protocol=self._protocol.value if trained and self._protocol else "",
            dynamics_training_dataset=fold.training.name if self._protocol is Protocol.ONE else "",
            seed=str(self.seed) if trained or untrained else "",
            validation_loss=losses[0],
            copy_last_loss=losses[1],
            note="; ".join(filter(None, ("untrained" if untrained else "", decided.note))),
        )

    def _predict_shipped(
        self, known: ShippedReadout, split: ScenarioSplit, readout: Readout
    ) -> ScenarioPredictions:
        """Return the predictions of a readout that ships."""
        future = dict.fromkeys(split.test, known.steps)
        return ScenarioPredictions(
            scenario=split.scenario,
            readout=readout.value,
            trials=split.test,
            decided=known.decide(self._parts(split.test, readout, future)),
            fit_trials=known.fit_trials,
            fold=-1,
            fit_labels="simulated",
            fit_on=known.fit_on,
            decision=decision_name(self.model),
        )

    def _labels_of(self, trials: Sequence[str], kind: str) -> NDArray[np.bool_]:
        labels: NDArray[np.bool_] = self._labels[kind].loc[list(trials)].to_numpy(bool)
        return labels

    def _decide_on_features(
        self, decision: Decision, split: ScenarioSplit, readout: Readout
    ) -> _Made:
        trials, future = [*split.fit, *split.test], self._future(split)
        if split.fit:  # so that no batch holds trials of both kinds
            self._parts(split.fit, readout, future)
        parts = self._parts(trials, readout, future)
        rows = np.arange(len(trials))
        count = len(split.fit)
        fit = [part.select(rows[:count]) for part in parts]
        test = [part.select(rows[count:]) for part in parts]
        labels = self._labels_of(split.fit, decision.labels)
        return decision.decide(fit, labels, test), split.fit, split.test

    def _parts(
        self, trials: Sequence[str], readout: Readout, future: Mapping[str, int]
    ) -> list[StoredFeatures]:
        """Return the features that a decision gets under a readout; they are joined in time."""
        if readout.sees_future:
            return [self._store.encoded(self.model, self._whole, trials, "whole", self.progress)]
        context = self._store.encoded(self.model, self._observed, trials, "context", self.progress)
        if readout is Readout.OBSERVED:
            return [context]
        samples, seed, arguments = self._rollout_settings()
        first = {name: values[:1] for name, values in arguments.items()}
        (imagined,) = self._store.imagined(
            self.model,
            self._observed,
            trials,
            samples=samples,
            seed=seed,
            arguments=first,
            future=future,
            context=context,
            progress=self.progress,
        ).values()
        simulated = imagined.features()
        if simulated is None:
            raise BadInputError(
                f"model {model_name(self.model)!r}: imagine gave no features, which the "
                f"decision {decision_name(self.model, self.settings.decision)!r} needs"
            )
        return [context, simulated]

    def _rollout_settings(self) -> tuple[int, int, Mapping[str, tuple[float, ...]]]:
        model = self.model
        samples, seed, arguments = (ask(model, name) for name in ("samples", "seed", "arguments"))
        return samples, self.seed if seed is None else seed, arguments

    def _imagined(
        self, splits: Sequence[ScenarioSplit], decision: Decision
    ) -> dict[Arguments, Imagined]:
        """Return what could be imagined of the trials that a decision needs, with all arguments."""
        fit: dict[str, int] = {}
        test: dict[str, int] = {}
        for split in splits:
            steps = self._future(split)
            fit |= {trial: steps[trial] for trial in _fit_trials(self.model, decision, split)}
            test |= {trial: steps[trial] for trial in split.test}
        samples, seed, arguments = self._rollout_settings()
        model = self.model
        shared = ask(model, "trials_together")
        imagined: dict[Arguments, Imagined] = {}
        # The trials to fit on first, so that no group holds trials of both kinds.
        for future in ([fit] if fit else []) + [fit | test]:
            imagined = self._store.imagined(
                model,
                self._observed,
                list(future),
                samples=samples,
                seed=seed,
                arguments=arguments,
                future=future,
                # A network stays in this process, unless it says otherwise.
                together=shared if is_network(model) else max(shared, 1),
                progress=self.progress,
            )
        return imagined

    def _decide_on_rollouts(self, decision: Decision, split: ScenarioSplit, _: Readout) -> _Made:
        found = self._imagined([split], decision)
        wanted = _fit_trials(self.model, decision, split)
        fit = tuple(trial for trial in wanted if trial not in self.problems)
        test = tuple(trial for trial in split.test if trial not in self.problems)
        if wanted and not fit:
            reason = self.problems[wanted[0]]
            raise BadInputError(f"no trial of {split.scenario} to fit on was imagined: {reason}")
        if not test:
            return Decided(np.empty(0), _UNKNOWN), fit, test
        labels = self._labels_of(fit, decision.labels)
        near = {arguments: imagined.outcomes(fit) for arguments, imagined in found.items()}
        tested = {arguments: imagined.outcomes(test) for arguments, imagined in found.items()}
        decided = decision.decide(near, labels, tested)
        notes = {trial: next(iter(found.values())).note(trial) for trial in test}
        return replace(decided, notes=notes), fit, test

    def _answer(self, split: ScenarioSplit, readout: Readout) -> _Made:
        """Ask the model itself, after it was fitted on the fit trials if it can be."""
        source: Any = self._whole if readout.sees_future else self._observed
        read = source.context
        if readout.sees_future:
            read = partial(source.whole, length=self._longest(split))
        asked: Any = self.model
        accuracy = _UNKNOWN
        if can(self.model, "fit"):
            fit_batch = read(split.fit)
            labels = self._labels_of(split.fit, "recorded")
            asked = call_model(self.model, "fit", fit_batch, labels, self.seed)
            if len(labels):
                accuracy = float(np.mean((self._probability(asked, fit_batch) > 0.5) == labels))
        predicted: dict[str, float] = {}
        notes: dict[str, str] = {}
        for start in range(0, len(split.test), _ANSWER_TRIALS):
            group = split.test[start : start + _ANSWER_TRIALS]
            predicted |= self._ask(asked, read, group, notes)
            if self.progress is not None:
                self.progress("trials", start + len(group), len(split.test))
        probability = np.array(list(predicted.values()), np.float64)
        decided = Decided(probability, accuracy, notes=notes)
        return decided, split.fit, tuple(predicted)

    def _ask(
        self, asked: Any, read: Any, group: Sequence[str], notes: dict[str, str]
    ) -> dict[str, float]:
        """Return the answers by trial; if a trial fails, the others are asked for one by one.

        What the model says about them is added to ``notes``.
        """
        try:
            batch = read(group)
            answers = self._probability(asked, batch)
        except BadInputError as error:
            if len(group) > 1:
                singles = [self._ask(asked, read, [one], notes) for one in group]
                return {t: p for single in singles for t, p in single.items()}
            self.problems[group[0]] = str(error)
            return {}
        notes |= zip(group, notes_of(asked, batch), strict=True)
        return dict(zip(group, answers.tolist(), strict=True))

    def _probability(self, asked: Any, batch: Batch) -> NDArray[np.float64]:
        what, kinds = "predict gave probabilities", ("float64", "float32")
        values = to_array(
            call_model(asked, "predict", batch), self.model, what, (len(batch),), kinds
        )
        check_finite(values, self.model, what, batch.trials)
        outside = np.flatnonzero((values < 0) | (values > 1))
        if len(outside):
            raise BadInputError(
                f"model {model_name(self.model)!r}, trial "
                f"{batch.trials[outside[0]]!r}: predict gave {values[outside[0]]}, not a "
                "probability"
            )
        return values.astype(np.float64)
