"""Folds of an evaluation: which trials train the dynamics, fit a readout, and are predicted.

A protocol says which scenarios train the dynamics that are tested on a scenario: *all*, *all-but*
the tested one, or *only* the tested one. With *one*, each scenario trains dynamics that are tested
on all.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import pandas as pd

from physion.clips.batch import Spec
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import digest_of
from physion.core.seeds import stable_hash
from physion.scenes.scene import PLAYBACK_RATE
from physion.trials.dataset import Dataset, JoinedDataset
from physion.trials.making.whatif import parts_of

TRAINING, READOUT, TESTING = "training", "readout", "testing"
"""Names of the splits in the index."""
_COLUMNS = ["trial", "scenario", "split", "contact", "digest"]


class Protocol(Enum):
    """Training protocol; the value is its name in tables.

    The study has the first three; ``one`` is the generalisation of its supplement.
    """

    ALL = "all"
    ALL_BUT = "all-but"
    ONLY = "only"
    ONE = "one"

    @classmethod
    def named(cls, name: str) -> Protocol:
        """Return the protocol called ``name``; raise `UnknownNameError` with the closest names."""
        try:
            return cls(name)
        except ValueError:
            raise UnknownNameError("training protocol", name, [p.value for p in cls]) from None


@dataclass(frozen=True, slots=True)
class TrainingSet:
    """Scenarios that train the dynamics (``trained``), and those tested with it (``tested``).

    ``name`` is ``all``, ``no_<scenario>`` or ``<scenario>``.
    """

    name: str
    trained: tuple[str, ...]
    tested: tuple[str, ...]


def training_sets(
    protocol: Protocol, tested: Sequence[str], others: Iterable[str] = ()
) -> list[TrainingSet]:
    """Return the trainings that a protocol needs: one in all, or one per scenario.

    Scenarios that train are those ``tested``, and ``others`` that have trials to train on.
    """
    names, known = tuple(sorted(set(tested))), tuple(sorted({*tested, *others}))
    if not names:
        raise BadInputError("there is no scenario to train on")
    if protocol is Protocol.ALL:
        return [TrainingSet("all", known, names)]
    if protocol is Protocol.ONLY:
        return [TrainingSet(name, (name,), (name,)) for name in names]
    if protocol is Protocol.ONE:
        return [TrainingSet(name, (name,), names) for name in known]
    if len(known) < 2:
        raise BadInputError(f"all-but needs two scenarios or more; there is only {names[0]!r}")
    return [
        TrainingSet(f"no_{name}", tuple(n for n in known if n != name), (name,)) for name in names
    ]


@dataclass(frozen=True)
class ScenarioSplit:
    """The trials of one scenario that fit a readout, and those that it predicts."""

    scenario: str
    fit: tuple[str, ...]
    test: tuple[str, ...]


@dataclass(frozen=True)
class Fold:
    """One training of the dynamics and the scenarios that are predicted with it.

    ``number`` counts the folds of a cross-validation from 0; it is -1 where the dataset has a
    readout split of its own. No trial of any ``test`` is in ``train`` or in any ``fit`` of the
    same fold.
    """

    training: TrainingSet
    train: tuple[str, ...]
    scenarios: tuple[ScenarioSplit, ...]
    number: int


def plan_folds(index: pd.DataFrame, protocol: Protocol, folds: int, seed: int) -> list[Fold]:
    """Return the folds of an evaluation, in which every testing trial is predicted once.

    With the protocol *one* it is predicted once for each scenario that trains.

    Readouts are fitted on the readout split; dynamics are trained on the training split, or on
    the readout split where there is none, also on scenarios that are not tested. If a tested
    scenario has no readout trial, the testing trials are cross-validated instead: they are divided
    into ``folds`` groups, and each group is predicted by what was fitted on the others.

    Trials with the same physics (equal ``digest``) always share a group, and a readout or training
    trial with the physics of a testing trial is not used.

    Parameters
    ----------
    index
        Index of a dataset.
    protocol
        Which scenarios train the dynamics.
    folds
        Number of groups of a cross-validation, at least 2.
    seed
        Seed of the assignment to groups.

    Raises
    ------
    BadInputError
        If there is no testing trial, or fewer than 2 folds for a cross-validation.
    """
    index = index[_COLUMNS]  # since rows are selected several times, and an index is wide
    tested = index[index["split"] == TESTING]
    if len(tested) == 0:
        raise BadInputError(f"the dataset has no trial in the split {TESTING!r} to predict")
    scenarios = sorted(set(tested["scenario"]))
    known = set(tested["digest"])
    others = index[(index["split"] != TESTING) & ~index["digest"].isin(known)]
    fit = others[others["split"] == READOUT]
    train = others[others["split"] == TRAINING]
    if set(scenarios) <= set(fit["scenario"]):
        pool = train if len(train) else fit
        sets = training_sets(protocol, scenarios, pool["scenario"])
        return [_make_fold(s, pool, fit, tested, -1) for s in sets]
    if folds < 2:
        raise BadInputError(f"a cross-validation needs at least 2 folds, not {folds}")
    numbers = assign_folds(tested, folds, seed)
    planned = []
    for number in sorted(set(numbers.values())):
        held = tested["trial"].map(numbers) == number
        rest = pd.concat([fit, tested[~held]])
        pool = train if len(train) else rest
        sets = training_sets(protocol, scenarios, pool["scenario"])
        planned += [_make_fold(s, pool, rest, tested[held], number) for s in sets]
    return planned


def join_for_fit(tested: Dataset, fit: Dataset) -> Dataset:
    """Return a dataset with the testing trials of one and the training and readout of another.

    Raises `BadInputError` if there is no testing trial, a scenario has nothing to fit a readout on,
    or a motion is in both.
    """
    if not (tested.index["split"] == TESTING).any():
        raise BadInputError(f"{tested.folder} has no trial in the split {TESTING!r} to predict")
    joined = JoinedDataset([(tested, (TESTING,)), (fit, (TRAINING, READOUT))])
    index = joined.index
    of_test = index["split"] == TESTING
    without = set(index["scenario"][of_test]) - set(index["scenario"][index["split"] == READOUT])
    if without:
        raise BadInputError(
            f"{fit.folder} has no trial of {min(without)} in the split {READOUT} to fit on, which "
            f"{tested.folder} tests; add some, or choose another set"
        )
    known = dict(zip(index["digest"][of_test], index["trial"][of_test], strict=True))
    both = index[~of_test & index["digest"].isin(known.keys())]
    if len(both):
        row = both.iloc[0]
        raise BadInputError(
            f"{len(both)} trials of {fit.folder} have motions of tested trials, such as "
            f"{row['trial']!r} of {known[row['digest']]!r}; fit on a set without them"
        )
    return joined


def check_labels(index: pd.DataFrame) -> None:
    """Raise `BadInputError` if a trial that is tested, or fits a readout, has no outcome."""
    without = index[index["split"].isin((TESTING, READOUT)) & index["contact"].isna()]
    if len(without):
        raise BadInputError(
            f"{len(without)} trials to predict or to fit on are stored without labels, such as "
            f"{without['trial'].iloc[0]!r}; evaluate trials with labels, or put these into the "
            f"split {TRAINING}"
        )


def check_pictures(index: pd.DataFrame, spec: Spec, *, rendered: bool) -> None:
    """Raise `BadInputError` unless tested and fitted trials show a model pictures of one kind.

    Looks and frame rates must agree, and so must the sizes of movies, unless pictures are rendered.
    """
    if not spec.sees_pictures:
        return
    rate = (index["frames"] / index["playback_seconds"]).round(3)
    facts = index[["split", "look"]].assign(rate=rate, size=index["width"].astype(str))
    facts["size"] += " x " + index["height"].astype(str)
    tested, fit = (facts[facts["split"] == split] for split in (TESTING, READOUT))
    for name, what in (("look", "look"), ("rate", "frame rate"), ("size", "size of the movies")):
        if name == "size" and rendered:
            continue
        if set(tested[name]) != set(fit[name]):
            raise BadInputError(
                f"the {what} of tested trials is {_listed(tested[name])}, of those that fit the "
                f"readout {_listed(fit[name])}; use sets that agree"
                + (", or render all pictures (--rendered)" if name == "size" else "")
            )


def unlike_shipped(index: pd.DataFrame, spec: Spec, *, rendered: bool) -> list[str]:
    """Return how tested trials differ from those on which readouts that ship were fitted.

    Pictures of these were rendered at the model's own size, for movies at `PLAYBACK_RATE`.
    """
    if not spec.sees_pictures:
        return []
    tested = index[index["split"] == TESTING]
    found = []
    rates = (tested["frames"] / tested["playback_seconds"]).round(3)
    if set(rates) - {PLAYBACK_RATE}:
        found.append(f"a frame rate of {_listed(rates)}/s, not {PLAYBACK_RATE}/s")
    stored = "rgb" in spec.inputs and not rendered and index["movie_sha256"].notna().any()
    small = tested[tested[["width", "height"]].min(axis=1) < spec.image_size]
    oblong = tested[tested["width"] != tested["height"]]
    if stored and len(oblong):
        sizes = oblong["width"].astype(str) + " x " + oblong["height"].astype(str)
        found.append(f"movies of {_listed(sizes)} pixels, which are squeezed to squares")
    if stored and len(small):
        sizes = small["width"].astype(str) + " x " + small["height"].astype(str)
        found.append(
            f"stored movies of {_listed(sizes)} pixels, and the model sees {spec.image_size} "
            "(--rendered draws them at that size)"
        )
    return found


def _listed(values: pd.Series[Any]) -> str:
    return " and ".join(sorted(str(value) for value in set(values)))


def describe_fit(fit: Dataset) -> str:
    """Return the name of the folder of a set, and the start of the digest of its readout trials.

    The digest is the SHA-256 of scenarios, motions and outcomes, in any order. Trials without an
    outcome fit nothing and do not count.
    """
    index = fit.index[(fit.index["split"] == READOUT) & fit.index["contact"].notna()]
    rows = zip(index["scenario"], index["digest"], index["contact"], strict=True)
    digest = digest_of("\n".join(sorted(f"{s} {d} {int(c)}" for s, d, c in rows)))
    return f"{fit.folder.name} {digest[:12]}"


def training_folds(index: pd.DataFrame, protocol: Protocol, folds: int, seed: int) -> list[Fold]:
    """Return the folds that an evaluation of a dataset would train on.

    They come from `plan_folds`. A dataset without testing trials has no scenario to predict: its
    folds train on the split training, or readout where there is none.

    Raises
    ------
    BadInputError
        If there is nothing to train on.
    """
    if (index["split"] == TESTING).any():
        return plan_folds(index, protocol, folds, seed)
    pool = index[index["split"] == TRAINING]
    if len(pool) == 0:
        pool = index[index["split"] == READOUT]
    if len(pool) == 0:
        raise BadInputError(
            f"the dataset has no trial in the splits {TRAINING}, {READOUT} or {TESTING} to train on"
        )
    sets = training_sets(protocol, sorted(set(pool["scenario"])))
    return [Fold(s, _trials(pool, s.trained), (), -1) for s in sets]


def select_scenario(folds: Sequence[Fold], scenario: str) -> list[Fold]:
    """Return the folds in which a scenario is tested, without the other scenarios; all if empty.

    Raises `UnknownNameError` if the scenario is not tested.
    """
    if not scenario:
        return list(folds)
    known = {tested for fold in folds for tested in fold.training.tested}
    if scenario not in known:
        raise UnknownNameError("scenario of the dataset", scenario, known)
    return [
        replace(fold, scenarios=tuple(s for s in fold.scenarios if s.scenario == scenario))
        for fold in folds
        if scenario in fold.training.tested
    ]


def assign_folds(table: pd.DataFrame, folds: int, seed: int) -> Mapping[str, int]:
    """Return the fold (0 to folds - 1) of each trial, balanced by scenario and label.

    Trials with equal digests get the same fold, and so do a trial and its variants. The result
    depends on seed, digests and labels only, not on the order of rows.
    """
    assigned: dict[str, int] = {}
    for _, rows in table.groupby("scenario", sort=True):
        rows = rows.assign(digest=_digests_of_groups(rows))
        groups = rows.groupby("digest")["contact"].mean()
        order = sorted(groups.index, key=lambda d: (groups[d] > 0.5, stable_hash(seed, str(d))))
        numbers = {digest: i % folds for i, digest in enumerate(order)}
        assigned |= {
            str(trial): numbers[digest]
            for trial, digest in zip(rows["trial"], rows["digest"], strict=True)
        }
    return assigned


def _digests_of_groups(rows: pd.DataFrame) -> list[str]:
    """Return for each trial the digest of the one that it is a variant of, or its own.

    Variants without their trial have the digest of the first of them by name.
    """
    names = [parts_of(str(name)) for name in rows["trial"]]
    found: dict[str, str] = {}
    for (base, change), digest in sorted(zip(names, map(str, rows["digest"]), strict=True)):
        if change == "":
            found[base] = digest
        else:
            found.setdefault(base, digest)
    return [found[base] for base, _ in names]


def _make_fold(
    training: TrainingSet, pool: pd.DataFrame, fit: pd.DataFrame, test: pd.DataFrame, number: int
) -> Fold:
    splits = [
        ScenarioSplit(scenario, _trials(fit, (scenario,)), _trials(test, (scenario,)))
        for scenario in training.tested
    ]
    kept = tuple(split for split in splits if split.test)
    return Fold(training, _trials(pool, training.trained), kept, number)


def _trials(table: pd.DataFrame, scenarios: tuple[str, ...]) -> tuple[str, ...]:
    """Return the sorted names of the trials of ``scenarios``."""
    return tuple(sorted(str(t) for t in table["trial"][table["scenario"].isin(scenarios)]))
