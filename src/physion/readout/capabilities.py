"""Which readout protocols a model supports, and how its predictions are made under each."""

from __future__ import annotations

from enum import Enum
from typing import Any

from physion.errors import BadInputError
from physion.models.interface import Encodes, Fits, HasReader, Imagines, Model, Predicts
from physion.readout.logistic import ReadoutConfig
from physion.readout.protocols import Readout
from physion.readout.readers.reader import FeatureReader, RolloutReader, readers


class Way(Enum):
    """How predictions are made."""

    ANSWERS = "the model answers"
    FEATURES = "a reader of features"
    ROLLOUTS = "a reader of rollouts"


def reader_name(model: Model, wanted: str = "") -> str:
    """Return the name of the reader: ``wanted``, the model's own, or the one that fits it."""
    if wanted:
        return wanted
    if isinstance(model, HasReader):
        return model.reader
    return "logistic" if isinstance(model, Encodes) else "gap"


def build_reader(model: Model, wanted: str, config: ReadoutConfig) -> FeatureReader | RolloutReader:
    """Return the reader of a model; raise `BadInputError` if it does not fit the model."""
    name = reader_name(model, wanted)
    reader = readers.get(name)(config)
    if reader.input == "features" and not isinstance(model, Encodes):
        raise BadInputError(
            f"reader {name!r} reads features, but model {model.provenance().model} has no "
            "method encode; use the reader gap or noise"
        )
    if reader.input == "rollouts" and not isinstance(model, Imagines):
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
    if isinstance(model, Encodes):
        found[Readout.OBSERVED] = Way.FEATURES
        if model.spec.future:
            found[Readout.FULL] = Way.FEATURES
    if isinstance(model, Imagines):
        by_features = readers.get(reader_name(model, reader))(ReadoutConfig()).input == "features"
        found[Readout.OBSERVED_SIMULATED] = Way.FEATURES if by_features else Way.ROLLOUTS
    if isinstance(model, Predicts | Fits):
        found[Readout.named(model.answers)] = Way.ANSWERS
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
