"""Training protocols: which scenarios train the dynamics that are tested on a scenario."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from physion.core.errors import BadInputError, UnknownNameError


class Training(Enum):
    """Training protocol; the value is its name in the study."""

    ALL = "all"
    ALL_BUT = "all-but"
    ONLY = "only"

    @classmethod
    def named(cls, name: str) -> Training:
        """Return the protocol called ``name``; raise `UnknownNameError` with the closest names."""
        try:
            return cls(name)
        except ValueError:
            raise UnknownNameError("training protocol", name, [t.value for t in cls]) from None


@dataclass(frozen=True, slots=True)
class TrainingSet:
    """Scenarios that train the dynamics (``trained``), and those tested with it (``tested``).

    ``name`` is the value of *Dynamics Training Dataset*: ``all``, ``no_<scenario>`` or
    ``<scenario>``.
    """

    name: str
    trained: tuple[str, ...]
    tested: tuple[str, ...]


def set_name(protocol: Training, scenario: str) -> str:
    """Return the name of the `TrainingSet` of a tested scenario."""
    return {
        Training.ALL: "all",
        Training.ALL_BUT: f"no_{scenario}",
        Training.ONLY: scenario,
    }[protocol]


def training_sets(protocol: Training, scenarios: Sequence[str]) -> list[TrainingSet]:
    """Return the trainings that a protocol needs: one in all, or one per scenario."""
    names = tuple(sorted(set(scenarios)))
    if not names:
        raise BadInputError("there is no scenario to train on")
    if protocol is Training.ALL:
        return [TrainingSet("all", names, names)]
    if protocol is Training.ONLY:
        return [TrainingSet(set_name(protocol, name), (name,), (name,)) for name in names]
    if len(names) < 2:
        raise BadInputError(f"all-but needs two scenarios or more; there is only {names[0]!r}")
    return [
        TrainingSet(set_name(protocol, name), tuple(n for n in names if n != name), (name,))
        for name in names
    ]
