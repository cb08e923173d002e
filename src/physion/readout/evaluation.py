"""The evaluations of models on a dataset: predictions of every testing trial.

What is done is known from the name of the table, which holds a hash of all its inputs.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd

from physion.clips.batch import LAST_OBSERVED, Provenance
from physion.compute.tasks import Executor, Progress, tracked
from physion.core.errors import BadInputError
from physion.core.files import digest_path, is_whole, json_digest
from physion.core.version import __version__
from physion.models.feature_table import FeatureTable
from physion.models.interface import Model, TrainingSettings, ask, can
from physion.readout.benchmark import Benchmark, benchmark_of
from physion.readout.decisions import Readout, decisions
from physion.readout.folds import (
    TESTING,
    Protocol,
    ScenarioSplit,
    check_labels,
    check_pictures,
    describe_fit,
    join_for_fit,
    plan_folds,
    unlike_shipped,
)
from physion.readout.logistic import LogisticSettings
from physion.readout.model_calls import check_identity, is_network
from physion.readout.predictor import Predictor, Way, choose_readouts, decision_name
from physion.readout.settings import (
    Cell,
    ChosenModel,
    EvaluationSettings,
    open_dataset,
    plan_cells,
    run_cells,
    runner_of_cells,
)
from physion.readout.shipped import ShippedReadouts, find_readouts
from physion.readout.tables import (
    ScenarioPredictions,
    file_name,
    make_table,
    read_table,
    summarise_accuracy,
    true_outcomes,
    write_table,
)
from physion.trials.dataset import Dataset, JoinedDataset
from physion.trials.files import MOVIE_ALONE

NOTHING_TO_FIT = "no trial to fit|one answer only"
"""Notes of `physion.readout.logistic.fit_readout` where it predicts the base rate."""
_VERSION = 12
"""To be increased with every change that can alter the table of an evaluation."""
_NOT_HASHED = (
    "protocols", "seeds", "encoder_batch", "accelerator", "rollout_errors", "twin", "benchmark",
)  # fmt: skip
"""Settings of where and how an evaluation runs, or of others than this one, or hashed by name."""
_HASHED_COLUMNS = [
    "trial", "scenario", "split", "contact", "digest", "look", "trial_file_sha256", "movie_sha256",
    "observed_movie_sha256", "recorded_contact", "observed_contact",
]  # fmt: skip
"""Columns of the index that a table depends on."""


@dataclass(frozen=True)
class EvaluatedModel:
    """A model under one training protocol with one seed.

    - ``model``, ``protocol``, ``seed``: which; ``protocol`` is empty if it was not trained.
    - ``path``: table of predictions. ``rollout_errors``: errors of imagined motion, if asked for.
    - ``done``: whether the table was there before.
    - ``problems``: reasons of trials without a prediction, by name.
    - ``warnings``: why a readout that ships may not fit, or was not used, in sentences.
    """

    model: str
    protocol: str
    seed: int
    path: Path
    rollout_errors: Path | None
    done: bool
    problems: Mapping[str, str]
    warnings: tuple[str, ...] = ()

    def accuracies(self) -> dict[str, float]:
        """Return the mean accuracy over scenarios by name and readout of the model.

        The outcome is the recorded one, where it is known.
        """
        table = read_table(self.path)
        right = table.assign(right=(table["p_contact"] > 0.5) == true_outcomes(table))
        keys = ["model", "init", "readout"]
        means = right.groupby([*keys, "scenario"])["right"].mean().groupby(keys).mean()
        return {
            " · ".join(name for name in (model, readout) if name): float(mean)
            for (model, _, readout), mean in means.items()
        }


@dataclass(frozen=True)
class Evaluation:
    """What `physion.evaluate` did.

    - ``evaluated``: one entry for every model, training protocol and seed.
    - ``failed``: reasons of those that failed, by model, protocol and seed.
    - ``without_twin``: names of models whose random twin was asked for and cannot be made.
    """

    evaluated: Sequence[EvaluatedModel]
    failed: Mapping[str, str]
    without_twin: Sequence[str] = ()

    @property
    def paths(self) -> list[Path]:
        """Tables of predictions."""
        return [one.path for one in self.evaluated]

    @cached_property
    def predictions(self) -> pd.DataFrame:
        """All predictions, with the columns `physion.readout.tables.COLUMNS`."""
        tables = [read_table(path) for path in self.paths]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    @property
    def scores(self) -> pd.DataFrame:
        """Accuracies, as mean and spread over seeds (`summarise_accuracy`).

        The outcome is the recorded one, where it is known.
        """
        return summarise_accuracy(self.predictions)

    @property
    def warnings(self) -> list[str]:
        """What may be wrong with predictions, in sentences.

        Readouts that ship and may not fit, models without a twin, and predictions without a trial
        to fit a readout on.
        """
        found = list(dict.fromkeys(words for one in self.evaluated for words in one.warnings))
        if self.without_twin:
            found.append(
                f"{', '.join(self.without_twin)}: no random twin can be made of a table of "
                "features or a class of your own; evaluate one with random weights as another model"
            )
        if self.predictions.empty:
            return found
        unfit = self.predictions[self.predictions["note"].str.contains(NOTHING_TO_FIT)]
        found += [
            f"{model}, readout {readout}: {len(rows)} predictions are the same number, since "
            f"the readout had {reason}; add trials of the split readout with both outcomes"
            for (model, readout, reason), rows in unfit.groupby(["model", "readout", "note"])
        ]
        return found

    @property
    def problems(self) -> dict[str, str]:
        """Reasons of the trials without a prediction, by model and trial."""
        return {
            f"{one.model}: {trial}": reason
            for one in self.evaluated
            for trial, reason in one.problems.items()
        }


def run_evaluations(
    chosen: Sequence[ChosenModel],
    dataset: Dataset | Path | str,
    out: Path,
    settings: EvaluationSettings,
    *,
    fit: Dataset | Path | str | None = None,
    verdicts: Mapping[str, str] = MappingProxyType({}),
    stored: Mapping[str, Path] = MappingProxyType({}),
    executor: Executor | None = None,
    progress: Progress | None = None,
    dry_run: bool = False,
    on_evaluated: Callable[[EvaluatedModel], None] | None = None,
) -> Evaluation:
    """Evaluate every model under every protocol with every seed.

    Parameters
    ----------
    chosen
        The models.
    dataset, out, settings, fit, executor, progress, dry_run, on_evaluated
        As of `physion.evaluate`.
    verdicts
        By name of a model the verdict of its check, for the column ``check``.
    stored
        By trial the folder of what models compute of it, for trials that several evaluations with
        different ``out`` share.
    """
    for name in settings.readouts:
        Readout.named(name)
    if settings.decision:
        decisions.get(settings.decision)
    cells = plan_cells(
        chosen,
        settings,
        functools.partial(_is_trained, settings=settings),
        every_seed=settings.untrained,
        twins=settings.twin,
    )
    finished = None if dry_run else on_evaluated
    elsewhere = None if dry_run else runner_of_cells(executor)
    trials, fit_on = open_dataset(dataset, elsewhere), ""
    if fit is not None:
        other = open_dataset(fit, elsewhere)
        trials = join_for_fit(trials, other)
    index, scenario = trials.index, settings.scenario
    check_labels(index[index["scenario"] == scenario] if scenario else index)
    if fit is not None:
        fit_on = describe_fit(other)
    # Processes elsewhere may have another working directory.
    folder = out if elsewhere is None else out.absolute()
    work = _Evaluate(trials, folder, settings, fit_on, dict(verdicts), dict(stored))
    do: Callable[[Cell], EvaluatedModel] = work
    if elsewhere is None:
        do = functools.partial(work, executor=executor, progress=progress, dry_run=dry_run)
    built = [cell for cell in cells if settings.twin and cell.built is not None]
    lacking = [cell.chosen.name for cell in built if cell.chosen.lacks_twin(cell.built)]
    return Evaluation(
        *run_cells(cells, do, out, "evaluations", elsewhere, progress, finished),
        tuple(dict.fromkeys(lacking)),
    )


def _is_trained(model: Any, settings: EvaluationSettings) -> bool:
    """Return whether an evaluation trains a model, so that protocol and seed matter."""
    rules = benchmark_of(model, settings.benchmark)
    if settings.untrained or not (is_network(model) and can(model, "loss")):
        return False
    if ask(model, "trained"):
        return False
    # What is trained on features predicts features, which the other readouts do not need.
    needed = Readout.OBSERVED_SIMULATED.value in (settings.readouts or rules.readouts)
    return ask(model, "learns_from") != "features" or ask(model, "learns_outcomes") or needed


@dataclass(frozen=True)
class _Evaluate:
    """Function that evaluates a cell, with all that a process needs for it."""

    dataset: Dataset
    out: Path
    settings: EvaluationSettings
    fit_on: str = ""
    verdicts: Mapping[str, str] = field(default_factory=dict)
    stored: Mapping[str, Path] = field(default_factory=dict)

    def __call__(
        self,
        cell: Cell,
        executor: Executor | None = None,
        progress: Progress | None = None,
        *,
        dry_run: bool = False,
    ) -> EvaluatedModel:
        """Predict every testing trial, unless that is done."""
        model, settings = cell.take_model(), self.settings
        rules = benchmark_of(model, settings.benchmark)
        index = rules.select(self.dataset.index)
        settings = dataclasses.replace(settings, logistic=rules.logistic(settings.logistic))
        if cell.chosen.stays_random(model):
            settings = dataclasses.replace(settings, untrained=True)
        training = cell.chosen.settings_of(model) if cell.protocol is not None else None
        provenance = check_identity(model)
        if isinstance(self.dataset, JoinedDataset):
            check_pictures(index, model.spec, rendered=settings.rendered)
        ways = choose_readouts(model, settings.readouts, settings.decision, rules)
        if Way.ROLLOUTS in ways.values():
            # Another decision on the same rollouts is another row.
            asked, own = decision_name(model, settings.decision), decision_name(model)
            name = provenance.model if asked == own else f"{provenance.model}-{asked}"
            provenance = dataclasses.replace(provenance, model=name)
        if not provenance.inputs:
            provenance = dataclasses.replace(provenance, inputs=", ".join(model.spec.inputs))
        self._check_look(model)
        shipped = None if rules.together else self._shipped(model, cell.chosen)
        path = self._table(cell, model, training, provenance, ways, shipped, rules)
        errors_path = self.out / "rollout-errors" / path.name if settings.rollout_errors else None
        if errors_path is not None:
            from physion.readout.rollout_error import check_moves_objects, rollout_error

            check_moves_objects(model)
            if cell.protocol is Protocol.ONE:
                raise BadInputError("rollout errors need another protocol than one: one per trial")
        done = is_whole(path) and (errors_path is None or is_whole(errors_path))
        protocol = cell.protocol.value if cell.protocol is not None else ""
        evaluated = EvaluatedModel(
            provenance.model, protocol, cell.seed, path, errors_path, done, {}
        )
        if dry_run:
            return evaluated
        protocol_of_folds = cell.protocol or Protocol.ALL
        planned = plan_folds(index, protocol_of_folds, settings.folds, cell.seed)
        folds = rules.arrange(planned, settings.scenario)
        splits = [split for fold in folds for split in fold.scenarios]
        features = [readout for readout, way in ways.items() if way is Way.FEATURES]
        warnings = () if rules.together else self._warnings(model, cell.chosen, splits, features)
        evaluated = dataclasses.replace(evaluated, warnings=warnings)
        if done:
            return evaluated
        used = {trial for split in splits for trial in (*split.fit, *split.test)}
        needed = dict.fromkeys(sorted(used), LAST_OBSERVED)
        needed |= rules.last_frames(index[index["trial"].isin(used)])
        ask(model, "check_trials")(needed, self.dataset.known_trials())
        predictor = Predictor(
            self.dataset,
            model,
            ways,
            settings,
            training=training,
            protocol=cell.protocol,
            seed=cell.seed,
            folder=self.out,
            shipped=shipped,
            fit_on=self.fit_on,
            rules=rules,
            stored=self.stored,
            executor=executor,
            progress=progress,
        )
        predictions: list[ScenarioPredictions] = []
        errors: list[pd.DataFrame] = []
        try:
            for fold in tracked(folds, "folds", len(folds), progress):
                predictions += predictor.predict(fold)
                if errors_path is not None:
                    # Now, since the model has the weights that were trained for this fold.
                    tested = [t for split in fold.scenarios for t in split.test]
                    known = [t for t in tested if t not in predictor.problems]
                    errors.append(rollout_error(self.dataset, model, known, progress=progress))
        finally:
            predictor.restore()
        row = index.iloc[0]
        rate = round(float(row["frames"] / row["playback_seconds"]), 3)
        frames: Callable[..., str] = functools.partial(rules.describe_frames, model.spec, rate=rate)
        if isinstance(model, FeatureTable):
            frames = lambda readout, scenario: model.frames  # noqa: E731
        verdict = self.verdicts.get(cell.chosen.name, "")
        table = make_table(predictions, provenance, index, rules.name, frames, verdict)
        if table.empty:
            reason = next(iter(predictor.problems.values()), "there is no trial to predict")
            raise BadInputError(f"{provenance.model} predicts no trial: {reason}")
        # Another name than a complete table has, so that the next run retries these trials.
        partial = path.with_suffix(".partial.csv")
        if predictor.problems:
            path = partial
        write_table(table, path)
        if errors_path is not None:
            errors_path = errors_path.with_name(path.name)
            write_table(pd.concat(errors, ignore_index=True).round(6), errors_path)
        if not predictor.problems:
            for old in (partial, self.out / "rollout-errors" / partial.name):
                old.unlink(missing_ok=True)
                digest_path(old).unlink(missing_ok=True)
        problems = dict(predictor.problems)
        return dataclasses.replace(
            evaluated, path=path, rollout_errors=errors_path, problems=problems
        )

    def _shipped(self, model: Model, chosen: ChosenModel) -> ShippedReadouts | None:
        """Return the readouts that ship for a model and may be used; None to fit them."""
        return self._offered(model, chosen) if self._looks() == {"redyellow"} else None

    def _offered(self, model: Model, chosen: ChosenModel) -> ShippedReadouts | None:
        """Return the readouts that ship for a model, unless the settings ask for others."""
        settings = self.settings
        anew = settings.readout_from == "fit" or settings.logistic != LogisticSettings()
        if (
            anew
            or chosen.fits
            or self.fit_on
            or settings.decision not in ("", decision_name(model))
        ):
            return None
        return find_readouts(model)

    def _looks(self) -> set[str]:
        index = self.dataset.index
        return set(index["look"][index["split"] == TESTING])

    def _check_look(self, model: Model) -> None:
        """Raise `BadInputError` if tested trials have another look than the model needs.

        Of movies that were imported without a motion the look is not known.
        """
        index = self.dataset.index
        tested = index[(index["split"] == TESTING) & (index["engine"] != MOVIE_ALONE)]
        if (look := ask(model, "look")) and (others := set(tested["look"]) - {look}):
            cue = ", or --option cue=true, which takes them from true masks of the first frame"
            raise BadInputError(
                f"{model.provenance().model} finds agent and patient by the colours of the look "
                f"{look}, but tested trials have the look {' and '.join(sorted(others))}; use "
                f"trials made with --look {look}{cue if hasattr(model.settings, 'cue') else ''}"
            )

    def _warnings(
        self,
        model: Model,
        chosen: ChosenModel,
        splits: Sequence[ScenarioSplit],
        readouts: Sequence[Readout],
    ) -> tuple[str, ...]:
        """Return how the tested trials differ from what weights or readouts that ship have seen.

        Of readouts only if some would be used for ``readouts``.
        """
        name, rendered = model.provenance().model, self.settings.rendered
        unlike = unlike_shipped(self.dataset.index, model.spec, rendered=rendered)
        if look := ask(model, "look"):
            if self._looks() - {look}:
                unlike.append(
                    f"movies were imported, and may not have the colours of the look {look}"
                )
            return tuple(
                f"{name}: predictions may be wrong, since it was trained on other trials: {words}"
                for words in unlike
            )
        offered = self._offered(model, chosen)
        if offered is None:
            return ()
        pairs = [(offered.find(one, split.scenario), split) for one in readouts for split in splits]
        if not any(known and known.fit_trials > len(split.fit) for known, split in pairs):
            return ()
        if (looks := self._looks()) != {"redyellow"}:
            return (
                f"{name}: the readouts that ship are for red and yellow trials and are not used, "
                f"since the look of the tested ones is {' and '.join(sorted(looks))}",
            )
        return tuple(f"{name}: the readouts that ship may not fit: {words}" for words in unlike)

    def _table(
        self,
        cell: Cell,
        model: Model,
        training: TrainingSettings | None,
        provenance: Provenance,
        ways: Mapping[Readout, Way],
        shipped: ShippedReadouts | None,
        rules: Benchmark,
    ) -> Path:
        """Return the table, named by a hash of trials, labels, model, settings and code."""
        settings = dataclasses.asdict(self.settings) | {"readouts": [r.value for r in ways]}
        settings["readout"] = settings.pop("readout_from")  # so that hashes stay
        settings |= {"protocol": cell.protocol and cell.protocol.value, "seed": cell.seed}
        settings |= {"rules": [rules.name, rules.last, rules.window, rules.together, rules.grid]}
        kept = {name: value for name, value in settings.items() if name not in _NOT_HASHED}
        options = dataclasses.asdict(chosen) if (chosen := ask(model, "settings")) else {}
        of_training = dataclasses.asdict(training) if training is not None else {}
        facts = dataclasses.asdict(provenance)
        inputs = [_VERSION, __version__, kept, facts, options, of_training, model.digest()]
        inputs.append(shipped.sha256 if shipped is not None else self.fit_on)
        inputs += filter(None, [self.verdicts.get(cell.chosen.name)])
        trials = self.dataset.index[_HASHED_COLUMNS].to_csv(index=False).encode()
        name = f"{file_name(provenance.model)}-{json_digest(inputs, [trials])[:12]}.csv"
        return self.out / "predictions" / name
