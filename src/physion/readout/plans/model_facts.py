"""What a plan has to know of a model, kept so that it is built only when it is used."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physion.models.build import build_model, is_file_name, load_from_file
from physion.models.interface import ask, can
from physion.readout.model_calls import is_network
from physion.readout.plans.keys import choice_key, code_key, key_of
from physion.readout.plans.records import Records
from physion.readout.plans.selection import ModelChoice

SEED = "seed"
"""Name of the option of initial weights; a model that has it gets the seed of its task."""


@dataclass(frozen=True)
class ModelFacts:
    """Facts about a model.

    - ``learns``: it can be trained. ``trained``: it came with trained weights.
    - ``seeded``: it has an option ``seed``. ``init``: its initial weights.
    - ``diet``, ``steps``: of its training, empty and 0 for a model that does not learn.
    """

    learns: bool
    trained: bool
    seeded: bool
    init: str
    diet: str
    steps: int

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> ModelFacts | None:
        """Return the facts with the given JSON values; None if some are missing."""
        try:
            return cls(**values)
        except TypeError:
            return None


class KnownModels:
    """Facts about models, read from the records of an output folder or from the built model.

    Parameters
    ----------
    folder
        Output folder of a plan.
    """

    def __init__(self, folder: Path) -> None:
        self._records = Records(folder, "models")
        self._facts: dict[str, ModelFacts] = {}
        self._keys: dict[str, str] = {}

    def facts(self, choice: ModelChoice) -> ModelFacts:
        """Return the facts about a model, which is built if they are not recorded."""
        key = self.key(choice)
        if key not in self._facts:
            stored = ModelFacts.of(self._records.read(key) or {})
            self._facts[key] = stored if stored is not None else _ask(choice)
        return self._facts[key]

    def record(self, choice: ModelChoice) -> bool:
        """Write the facts about a model down; return False if its files were edited meanwhile."""
        if choice_key(choice) != self.choice_key(choice):
            return False
        self._records.write(self.key(choice), dataclasses.asdict(self.facts(choice)))
        return True

    def build(self, choice: ModelChoice, seed: int) -> Any:
        """Build a model with the seed of its task, unless the user set one of its weights."""
        options = dict(choice.options)
        if self.facts(choice).seeded:
            options.setdefault(SEED, seed)
        return build_model(choice.name, **options)

    def key(self, choice: ModelChoice) -> str:
        """Return the key of a model and of the code."""
        return key_of("model", code_key(), self.choice_key(choice))

    def choice_key(self, choice: ModelChoice) -> str:
        """Return `choice_key` as it was when it was first asked for."""
        name = repr(choice)
        if name not in self._keys:
            self._keys[name] = choice_key(choice)
        return self._keys[name]


def _ask(choice: ModelChoice) -> ModelFacts:
    """Build a model and return the facts about it."""
    model: Any = build_model(choice.name, **choice.options)
    learns = is_network(model) and can(model, "loss")
    return ModelFacts(
        learns=learns,
        trained=bool(ask(model, "trained")),
        seeded=_has_seed(choice, model),
        init=model.provenance().init,
        diet=ask(model, "diet") if learns else "",
        steps=ask(model, "training_settings").steps if learns else 0,
    )


def _has_seed(choice: ModelChoice, model: Any) -> bool:
    if is_file_name(choice.name):
        factory: Any = load_from_file(choice.name)
        return SEED in inspect.signature(factory).parameters
    config = ask(model, "settings")
    return dataclasses.is_dataclass(config) and any(
        field.name == SEED for field in dataclasses.fields(config)
    )
