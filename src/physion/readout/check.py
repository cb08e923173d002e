"""Black-box test of a model: does any prediction depend on what it must not depend on?

A model is evaluated on a few trials, and again on copies of them in which one thing is changed
(`physion.readout.changes`). What follows the observed part, outcomes, names, order, and everything
about files but their pictures and motions must not move a prediction. How much other changes move
predictions is shown, and how accurate a twin with random weights and one that knows only blobs are.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import wilcoxon

from physion.compute.run_tasks import FATAL_ERRNOS
from physion.compute.tasks import Executor, Progress, tracked
from physion.core.errors import BadInputError, PhysionError, UnknownNameError, one_line
from physion.core.seeds import generator
from physion.models.build import OutOfMemoryError, build_model
from physion.models.feature_table import FeatureTable
from physion.models.interface import Model, ask, can
from physion.readout.benchmark import benchmark_of
from physion.readout.changes import CHANGES, Change, ChangedTrials, copy_others, take_trials
from physion.readout.decisions import Readout
from physion.readout.evaluation import Evaluation, run_evaluations
from physion.readout.folds import READOUT, TESTING
from physion.readout.model_calls import check_identity
from physion.readout.predictor import ways
from physion.readout.settings import ChosenModel, EvaluationSettings, choose_models
from physion.trials.dataset import Dataset
from physion.trials.making.generate import generate
from physion.trials.making.plan import GenerateSettings

PASSED, REFUSED, SHOWN = "passed", "refused", "shown"
"""Verdicts; ``shown``: the change may move predictions."""
UNDECIDED = "not decided"
"""Verdict of a model of which no change was judged."""
NOT_CHECKED = "not possible: a table"
"""Verdict of a change that cannot be made to a table of features, which knows trials by their names
only."""
OF_TABLES, TELLS = ("again", "labels"), "outcome"
"""Changes that are made to a table of features, and the test that is only for tables."""
AS_TABLE = f"{PASSED}, as a table"
"""Outcome of a table of features, of which few changes can be judged."""
ROUNDING = 1e-3
"""Largest change of P(contact), of the range of all predictions, where trials are in other batches,
in which sums are rounded differently."""
CHANCE = 1e-3
"""Level of the test whether random numbers that follow the names explain what moved."""
SCENARIOS, SIZE = ("collide", "drop"), 64
"""Scenarios of the trials that are made if no dataset is given, and pixels per side."""
BLOBS, TWIN = "blob-centroids", "random twin"
_OTHERS = {
    TWIN: "The same architecture with random weights, or random numbers in place of features",
    BLOBS: "Centroids and areas of red and yellow pixels, in place of the model",
}
_TELLS = "Nothing: no single number of the features may tell all outcomes"

COLUMNS = (
    "change", "what", "readout", "trials", "moved", "largest", "mean", "accuracy",
    "accuracy_changed", "verdict", "note",
)  # fmt: skip
"""Columns of `CheckedModel.table`.

- ``change``: name in `physion.readout.changes.CHANGES`, or of another model; ``what`` it is.
  ``readout``: observed, observed+simulated or full.
- ``trials``: tested ones. ``moved``: those whose P(contact) is another one. ``largest``, ``mean``:
  absolute change of P(contact).
- ``accuracy``, ``accuracy_changed``: fraction of right predictions before and after the change.
- ``verdict``: passed, refused, or shown, where the change may move predictions. ``note``: why.
"""


@dataclass(frozen=True)
class CheckedModel:
    """What the check of a model found.

    - ``model``: its name. ``table``: a row for every change and readout, with `COLUMNS`.
    - ``warnings``: why the check could say less than it should, in sentences.
    """

    model: str
    table: pd.DataFrame
    warnings: Sequence[str]

    @property
    def refused(self) -> list[str]:
        """Names of the changes that moved predictions which must not move."""
        rows = self.table[self.table["verdict"] == REFUSED]
        return list(dict.fromkeys(rows["change"]))

    @property
    def passed(self) -> bool:
        """Whether a change was judged, and no prediction moved that must not."""
        return not self.refused and bool((self.table["verdict"] == PASSED).any())

    @property
    def verdict(self) -> str:
        """The result in one line."""
        if self.refused:
            return f"{self.model} refused: predictions depend on {', '.join(self.refused)}"
        if not self.passed:
            return f"{self.model} {UNDECIDED}: {self._undecided()}"
        held = self.table["change"][self.table["verdict"] == PASSED].nunique()
        no = int((self.table["verdict"] == NOT_CHECKED).sum())
        more = f"; {no} changes are not possible for a table of features" if no else ""
        return (
            f"{self.model} passed: none of {held} changes moved a prediction that must stay{more}"
        )

    @property
    def outcome(self) -> str:
        """The result for a table: passed, not decided, or refused with the changes."""
        if self.refused:
            return f"{REFUSED}: {', '.join(self.refused)}"
        if self.passed and (self.table["verdict"] == NOT_CHECKED).any():
            return AS_TABLE
        return PASSED if self.passed else UNDECIDED

    def _undecided(self) -> str:
        """Return why no change was judged."""
        rows = self.table[
            self.table["change"].isin([c.name for c in CHANGES.values() if c.must_hold])
        ]
        if (rows["verdict"] == NOT_CHECKED).any():
            return "none of these changes is possible for a table of features"
        if rows.empty:
            return "no change was made that must not move a prediction"
        notes = [note for note in rows["note"] if note]
        return notes[0] if notes else "the readout full may see all that was changed"

    def __str__(self) -> str:
        return f"{self.table.drop(columns=['what', 'note']).to_string(index=False)}\n{self.verdict}"


def check_model(
    chosen: ChosenModel,
    dataset: Dataset | Path | str | None,
    out: Path,
    settings: EvaluationSettings,
    *,
    trials: int = 80,
    changes: Sequence[str] = (),
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> CheckedModel:
    """Check one model, with arguments as of `physion.check`."""
    for name in changes:
        if name not in CHANGES:
            raise UnknownNameError("change", name, CHANGES)
    if trials < 1:
        raise BadInputError(f"trials must be at least 1 (--trials), not {trials}")
    settings = dataclasses.replace(
        settings, untrained=True, seeds=1, twin=False, rollout_errors=False
    )
    built = chosen.build(settings.seed)
    name = check_identity(built).model
    if not settings.readouts:
        rules = benchmark_of(built, settings.benchmark)
        possible = [readout.value for readout in ways(built, settings.decision, rules)]
        predicting = tuple(readout for readout in possible if readout != Readout.FULL.value)
        settings = dataclasses.replace(settings, readouts=predicting)
    out.mkdir(parents=True, exist_ok=True)
    if dataset is None:
        opened: Dataset = _made(out / "trials", trials, executor, progress)
    else:
        opened = Dataset(dataset) if isinstance(dataset, str | Path) else dataset
    wanted = [CHANGES[name] for name in changes or CHANGES]
    with tempfile.TemporaryDirectory(dir=out, prefix="copies-") as folder:
        first = take_trials(opened, Path(folder) / "first", trials)
        large = copy_others(opened, first.folder)
        features = built if isinstance(built, FeatureTable) else None
        if features is not None:
            features.check_trials(first.trials(), opened.known_trials())
            built = features = features.of_trials(first.trials())
        work = _Check(built, first, settings, executor)
        rows = []
        for change in tracked(wanted, "changes", len(wanted), progress):
            made = features is None or change.name in OF_TABLES
            rows += work.rows(change) if made else work.left(change)
        if features is not None:
            rows += work.rows_of_outcome(features)
        if not changes:
            twin = chosen.random_twin(built) if features is None else None
            rows += work.rows_of_others(twin)
        table = pd.DataFrame(rows, columns=list(COLUMNS))
        warnings = work.warnings()
        if large:
            warnings.append(
                f"{len(large)} files are too large to be copied, such as {large[0]}: what a model "
                "reads of them is not checked; move them out of the dataset to check without them"
            )
        return CheckedModel(name, table, warnings)


def check_models(
    models: Sequence[ChosenModel],
    dataset: Dataset | Path | str,
    out: Path,
    settings: EvaluationSettings,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> dict[str, str]:
    """Return the outcome of a check of each model by its name, as `physion.evaluate` writes it.

    Only the changes that must not move a prediction are made.
    """
    changes = [change.name for change in CHANGES.values() if change.must_hold]
    found = {}
    for chosen in models:
        done = check_model(
            chosen, dataset, out, settings, changes=changes, executor=executor, progress=progress
        )
        found[chosen.name] = done.outcome
    return found


def _made(
    folder: Path, count: int, executor: Executor | None, progress: Progress | None
) -> Dataset:
    """Make the trials on which a model is checked if no dataset is given."""
    half = max(2, count // (2 * len(SCENARIOS)))
    return generate(
        folder,
        SCENARIOS,
        {"readout": half, "testing": half},
        name="check",
        settings=GenerateSettings(width=SIZE, height=SIZE, look="redyellow", jitters=0),
        executor=executor,
        progress=progress,
    )


class _Check:
    """The evaluations of one check: on the first trials, and on changed copies of these."""

    def __init__(
        self, model: Model, first: Dataset, settings: EvaluationSettings, executor: Executor | None
    ) -> None:
        self._model, self._first, self._settings = model, first, settings
        self._executor = executor
        self._repeats = False  # whether `again` could be predicted
        self._left_out: list[str] = []
        done = self._evaluate(model, first)
        self._before = done.predictions
        tested = first.trials(TESTING)
        missing = {t: why for one in done.evaluated for t, why in one.problems.items()}
        if lost := [trial for trial in tested if trial in missing]:
            self._left_out.append(
                f"{len(lost)} of {len(tested)} tested trials have no prediction and are not "
                f"judged, such as {lost[0]}: {missing[lost[0]]}"
            )
        self._readouts = list(dict.fromkeys(self._before["readout"]))

    def rows(self, change: Change) -> list[dict[str, Any]]:
        """Return the rows of `COLUMNS` of one change, one for every readout."""
        if change.pictures:
            reason = "pictures are rendered" if self._settings.rendered else ""
            if self._first.index["observed_movie_sha256"].isna().any():
                reason = "trials have none"
            if reason:
                self._left_out.append(f"{change.name} is skipped: it changes movies, and {reason}")
                return []
        folder = self._first.folder.parent / "changed"
        last = benchmark_of(self._model, self._settings.benchmark).last
        trials = ChangedTrials(self._first, folder, generator("check", change.name), last=last)
        try:
            change.apply(trials)
            after, why = self._predict(self._model, trials.finish()), ""
            self._repeats |= change.name == "again"
        except PhysionError as error:
            if not change.must_hold:
                self._left_out.append(f"{change.name} is not shown: {one_line(error)}")
                return []
            if _is_of_the_machine(error) or change.name == "again":
                raise
            after, why = self._before[:0], one_line(error)
        finally:
            shutil.rmtree(folder)
        if why and not self._repeats:
            self.rows(CHANGES["again"])  # raises if the change is not the reason
        rows = []
        for readout, before in self._before.groupby("readout"):
            if readout == Readout.FULL.value and not change.must_hold:
                continue  # it sees the whole movies, in which nothing was changed
            names = before["stimulus"].map(trials.names)
            found = after[after["readout"] == readout].set_index("stimulus")["p_contact"]
            compared = _compared(before, found.reindex(names).to_numpy())
            rows.append({"change": change.name, "what": change.what, "readout": readout})
            rows[-1] |= compared
            rows[-1] |= self._judged(change, str(readout), before, found.reindex(names).to_numpy())
            if why:
                rows[-1]["note"] = why
        return rows

    def _judged(
        self, change: Change, readout: str, before: pd.DataFrame, after: NDArray[np.float64]
    ) -> dict[str, str]:
        """Return verdict and note of a change."""
        if not change.must_hold or (change.later and readout == Readout.FULL.value):
            return {"verdict": SHOWN, "note": ""}
        missing = int(np.isnan(after).sum())
        if missing:
            return {"verdict": REFUSED, "note": f"{missing} trials have no prediction"}
        moved = np.abs(after - before["p_contact"].to_numpy()).max()
        if moved <= (ROUNDING * np.ptp(before["p_contact"]) if change.renames else 0):
            return {"verdict": PASSED, "note": "rounding" if moved else ""}
        if not (change.renames and self._imagines(readout)):
            return {"verdict": REFUSED, "note": ""}
        if not self._draws:
            return {"verdict": REFUSED, "note": "another seed moves no prediction"}
        # The names determine the random numbers of an imagined future. Others may make it another
        # one, but not worse.
        worse = _scores(before, before["p_contact"].to_numpy()) - _scores(before, after)
        if 0.5 ** np.count_nonzero(worse) > CHANCE:
            few = "random numbers follow the names; too few trials moved to tell that from a leak"
            return {"verdict": SHOWN, "note": few}
        p = float(wilcoxon(worse, alternative="greater").pvalue)
        return {
            "verdict": REFUSED if p < CHANCE else PASSED,
            "note": f"random numbers follow the names; names tell the outcome: p = {p:.2g}",
        }

    def _imagines(self, readout: str) -> bool:
        return readout == Readout.OBSERVED_SIMULATED.value and can(self._model, "imagine")

    @functools.cached_property
    def _draws(self) -> bool:
        """Whether another seed moves predictions of imagined futures."""
        seed, other = ask(self._model, "seed"), copy.copy(self._model)
        other.seed = (self._settings.seed if seed is None else seed) + 1
        simulated = (Readout.OBSERVED_SIMULATED.value,)
        found = self._predict(other, self._first, readouts=simulated).set_index("stimulus")
        before = self._before[self._before["readout"] == simulated[0]].set_index("stimulus")
        return bool((found["p_contact"].reindex(before.index) != before["p_contact"]).any())

    def left(self, change: Change) -> list[dict[str, Any]]:
        """Return the rows of a change that is not possible for a table of features."""
        return [
            {"change": change.name, "what": change.what, "readout": readout}
            | {"trials": len(rows), "verdict": NOT_CHECKED, "note": ""}
            for readout, rows in self._before.groupby("readout")
        ]

    def rows_of_outcome(self, table: FeatureTable) -> list[dict[str, Any]]:
        """Return the row that says whether a number of a table of features is the outcome."""
        known = self._first.index[self._first.index["contact"].notna()]
        outcomes = dict(zip(known["trial"], known["contact"].astype(bool), strict=True))
        place, chance = table.telling(outcomes)
        rows = []
        for readout in self._readouts:
            verdict, note = PASSED, ""
            if place:
                verdict, note = REFUSED, f"{place} tells all {len(outcomes)} outcomes"
            if readout == Readout.FULL.value or chance > CHANCE:
                verdict = SHOWN
                note = note if chance <= CHANCE else "too few trials to tell that from chance"
            rows.append({"change": TELLS, "what": _TELLS, "readout": readout})
            rows[-1] |= {"trials": len(outcomes), "verdict": verdict, "note": note}
        return rows

    def rows_of_others(self, twin: ChosenModel | None) -> list[dict[str, Any]]:
        """Return rows that compare the model with its random twin, and with blobs."""
        others: dict[str, Callable[[], Model]] = {}
        model = self._model
        if isinstance(model, FeatureTable):
            others[TWIN] = lambda: model.random_twin(generator("check", TWIN))
        elif twin is not None:
            others[TWIN] = functools.partial(twin.build, self._settings.seed)
        if self._has_pictures():
            others[BLOBS] = functools.partial(build_model, BLOBS)
        rows: list[dict[str, Any]] = []
        for name, build in others.items():
            try:
                rows += self._rows_of_other(name, build())
            except PhysionError as error:
                self._left_out.append(f"{name} is not shown: {one_line(error)}")
        return rows

    def _rows_of_other(self, name: str, other: Model) -> list[dict[str, Any]]:
        # A twin decides as the model does.
        decision = self._settings.decision if name == TWIN else ""
        able = [readout.value for readout in ways(other, decision)]
        asked = tuple(readout for readout in self._readouts if readout in able)
        if not asked:
            return []
        found = self._predict(other, self._first, readouts=asked, decision=decision)
        own, note, rows = self._before, "", []
        if name == TWIN and (own["fit_on"] != "").any() and (found["fit_on"] == "").all():
            own = self._predict(self._model, self._first, readouts=asked, readout_from="fit")
            note = "both with readouts that are fitted on these trials"
        for readout, before in own.groupby("readout"):
            if readout in asked:
                same = found[found["readout"] == readout].set_index("stimulus")["p_contact"]
                after = same.reindex(before["stimulus"]).to_numpy()
                rows.append({"change": name, "what": _OTHERS[name], "readout": readout})
                rows[-1] |= {**_compared(before, after), "verdict": SHOWN, "note": note}
        return rows

    def _has_pictures(self) -> bool:
        return set(self._first.index["look"]) == {"redyellow"}

    def _predict(self, model: Model, dataset: Dataset, **changes: Any) -> pd.DataFrame:
        """Return the table of predictions of the tested trials of a dataset."""
        return self._evaluate(model, dataset, **changes).predictions

    def _evaluate(self, model: Model, dataset: Dataset, **changes: Any) -> Evaluation:
        """Evaluate a model on the tested trials of a dataset; its predictions are read already.

        What the model computes of trials that fit the readout, which no change touches, is kept.
        """
        near = self._first.folder.parent
        kept = dict.fromkeys(self._first.trials(READOUT), near / "kept")
        with tempfile.TemporaryDirectory(dir=near) as folder:
            done = run_evaluations(
                choose_models(model),
                dataset,
                Path(folder),
                dataclasses.replace(self._settings, **changes),
                stored=kept,
                executor=self._executor,
            )
            _ = done.predictions  # which must be read before the folder is deleted
            return done

    def warnings(self) -> list[str]:
        """Return why the check could say less than it should."""
        found = list(self._left_out)
        for readout, rows in self._before.groupby("readout"):
            if (rows.groupby("scenario")["p_contact"].nunique() == 1).all():
                found.append(
                    f"readout {readout}: all predictions of a scenario are the same number, which "
                    "hides what they depend on; take more trials"
                )
        return found


def _is_of_the_machine(error: BaseException | None) -> bool:
    """Return whether an error is about memory or the disk, whatever the model reads."""
    while error is not None:
        if isinstance(error, OutOfMemoryError):
            return True
        if isinstance(error, OSError) and error.errno in FATAL_ERRNOS:
            return True
        error = error.__cause__
    return False


def _scores(before: pd.DataFrame, p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability that predictions gave to what happened."""
    return np.where(before["outcome"].to_numpy(), p, 1 - p)


def _compared(before: pd.DataFrame, after: NDArray[np.float64]) -> dict[str, Any]:
    """Return how much predictions of one readout moved, and the accuracies."""
    first, outcome = before["p_contact"].to_numpy(), before["outcome"].to_numpy()
    known = ~np.isnan(after)
    apart = np.abs(after - first)[known]
    right = (after > 0.5) == outcome
    return {
        "trials": len(first),
        "moved": int((apart > 0).sum()),
        "largest": float(apart.max()) if len(apart) else float("nan"),
        "mean": float(apart.mean()) if len(apart) else float("nan"),
        "accuracy": float(((first > 0.5) == outcome).mean()),
        "accuracy_changed": float(right[known].mean()) if len(apart) else float("nan"),
    }
