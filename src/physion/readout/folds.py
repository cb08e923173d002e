"""Which trials train dynamics, which fit a readout, and which are then predicted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from physion.errors import BadInputError
from physion.seeds import stable_hash
from physion.training.protocols import Training, TrainingSet, training_sets

TRAINING, READOUT, TESTING = "training", "readout", "testing"
"""Names of the splits in the index."""


@dataclass(frozen=True)
class Asked:
    """One scenario in a round: fit a readout on ``fit``, then predict ``test``."""

    scenario: str
    fit: tuple[str, ...]
    test: tuple[str, ...]


@dataclass(frozen=True)
class Round:
    """One training of dynamics on ``train`` and all the readouts that use it.

    ``fold`` counts the parts of a cross-fit; -1 where the dataset has a readout split of its own.
    No trial of any ``test`` is in ``train`` or in any ``fit`` of its round.
    """

    training: TrainingSet
    train: tuple[str, ...]
    asked: tuple[Asked, ...]
    fold: int


def plan_rounds(index: pd.DataFrame, protocol: Training, folds: int, seed: int) -> list[Round]:
    """The rounds of an evaluation; every trial of the testing split is predicted once.

    Readouts are fitted on the split *readout*, and dynamics trained on *training* (or, without
    one, on *readout*). A dataset whose scenarios lack a readout split is cross-fitted: its testing
    trials are dealt into ``folds`` parts, balanced by label, and each part is predicted by what
    was fitted on the others. Trials that are the same physics (equal ``digest``) stay in one part,
    and a readout or training trial whose physics occurs in a tested trial is not used.
    """
    tested = index[index["split"] == TESTING]
    if len(tested) == 0:
        raise BadInputError(f"the dataset has no trial in the split {TESTING!r} to predict")
    scenarios = sorted(set(tested["scenario"]))
    known = set(tested["digest"])
    others = index[(index["split"] != TESTING) & ~index["digest"].isin(known)]
    fit = others[others["split"] == READOUT]
    train = others[others["split"] == TRAINING]
    sets = training_sets(protocol, scenarios)
    if set(scenarios) <= set(fit["scenario"]):
        pool = train if len(train) else fit
        return [_round(s, pool, fit, tested, -1) for s in sets]
    if folds < 2:
        raise BadInputError(f"a cross-fit needs at least 2 folds, not {folds}")
    part = deal(tested, folds, seed)
    rounds = []
    for fold in sorted(set(part.values())):
        held = tested["trial"].map(part) == fold
        rest = pd.concat([fit, tested[~held]])
        pool = train if len(train) else rest
        rounds += [_round(s, pool, rest, tested[held], fold) for s in sets]
    return rounds


def deal(table: pd.DataFrame, folds: int, seed: int) -> Mapping[str, int]:
    """The part (0 to folds - 1) of each trial: balanced by scenario and label, same by same digest.

    Depends on seed, digests and labels alone, not on the order of rows.
    """
    part: dict[str, int] = {}
    for _, rows in table.groupby("scenario", sort=True):
        groups = rows.groupby("digest")["contact"].mean()
        order = sorted(groups.index, key=lambda d: (groups[d] > 0.5, stable_hash(seed, str(d))))
        place = {digest: i % folds for i, digest in enumerate(order)}
        part |= {
            str(trial): place[digest]
            for trial, digest in zip(rows["trial"], rows["digest"], strict=True)
        }
    return part


def _round(
    training: TrainingSet, pool: pd.DataFrame, fit: pd.DataFrame, test: pd.DataFrame, fold: int
) -> Round:
    asked = [
        Asked(scenario, _trials(fit, (scenario,)), _trials(test, (scenario,)))
        for scenario in training.asked
    ]
    kept = tuple(one for one in asked if one.test)
    return Round(training, _trials(pool, training.trained), kept, fold)


def _trials(table: pd.DataFrame, scenarios: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(sorted(str(t) for t in table["trial"][table["scenario"].isin(scenarios)]))
