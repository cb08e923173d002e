"""Weights of a training in place of the initial weights of an encoder.

A training of a frozen encoder stores the dynamics alone. Its metadata say with which encoder it
was trained, so that the model is built with that encoder, before the dynamics are loaded.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from physion.errors import BadInputError
from physion.models.checkpoints.checkpoint import read_checkpoint
from physion.models.checkpoints.trained import BUILT_AS, trained_file
from physion.models.encoders.settings import EncoderConfig
from physion.models.weights import EncoderWeights


def before_training(config: EncoderConfig) -> tuple[EncoderConfig, Path | None]:
    """Return the settings of a model before its training, and the file with its trained weights.

    ``weights`` and ``seed`` are those of the training if ``config.weights`` is one; otherwise the
    settings are returned as they are, with None.

    Raises
    ------
    DamagedFileError
        If the file was cut or changed.
    BadInputError
        If it does not say with which encoder it was trained.
    """
    path = EncoderWeights(config.weights).path
    file = trained_file(path) if path is not None else None
    if file is None:
        return config, None
    _, metadata = read_checkpoint(file)
    try:
        settings = metadata[BUILT_AS]["settings"]
        return replace(config, weights=str(settings["weights"]), seed=int(settings["seed"])), file
    except (KeyError, TypeError, ValueError) as error:
        raise BadInputError(
            f"checkpoint {file} does not say with which encoder it was trained: it is one of "
            "another model, or was written before physion stored that; train the model again"
        ) from error
